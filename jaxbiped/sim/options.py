"""Choices made before a robot walks."""

import equinox as eqx
import jax

from jaxbiped import checked
from jaxbiped.checked import Quantity
from jaxbiped.planner import FRICTION, Gait
from jaxbiped.robot import RobotParams, defaults
from jaxbiped.sim import plant
from jaxbiped.sim.plant import PAYLOAD_MODELS

DURATION = Quantity("s", 0.0, 3600.0, above=True)
"""Allowed duration of a walk."""
COMPLIANT, MJX, C_MUJOCO = "compliant", "mjx", "c_mujoco"
CONTACTS = (COMPLIANT, MJX, C_MUJOCO)
DAMPING, LINEAR = "damping", "linear"
IMPLICIT = (DAMPING, LINEAR)
AUTO, XLA, C, SCALAR = "auto", "xla", "c", "scalar"
BACKENDS = (AUTO, XLA, C, SCALAR)
MAX_TICKS = 1_000_000


class Options(eqx.Module):
    """Choices made when a simulation is prepared; another choice is another compilation."""

    dt: float = eqx.field(static=True, default=5e-4)
    """Physics tick [s]."""
    implicit: str = eqx.field(static=True, default=DAMPING)
    """What of the servos acts at the end of a tick: their `damping`, or also their stiffness (`linear`), as
    weakly damped servos with long ticks need it."""
    control_every: int = eqx.field(static=True, default=4)
    """Physics ticks in a control tick."""
    feed_forward: bool = eqx.field(static=True, default=True)
    """Add the plan's inverse dynamics to the servos' torque."""
    payload_model: str = eqx.field(static=True, default=plant.EXACT)
    """`exact` (welded cube) or `thesis` (elkahlout Eqs. 3.8-3.10)."""
    contact: str = eqx.field(static=True, default=COMPLIANT)
    """`compliant` (see `ground`), `mjx` (MuJoCo's own contacts in MJX; slower, no holes) or `c_mujoco` (C MuJoCo on the
    host, for whole walks only); see `physics`."""
    noise: bool = eqx.field(static=True, default=False)
    """Add the scenario's sensor noise."""
    delay_room: int = eqx.field(static=True, default=0)
    """Control ticks of sensor delay there is room for."""
    trace_every: int = eqx.field(static=True, default=0)
    """Control ticks between two samples of the trace; 0 for no trace."""
    backend: str = eqx.field(static=True, default=AUTO)
    """What compiles whole walks: `xla`, `c` (the system's C compiler, for a CPU; `compliant` contacts only), `scalar`
    (XLA, given the scalars that C is given; for GPUs, minutes to compile on a CPU), or `auto`: C where it can and there
    is enough to walk, and for all gradients; see `compile`."""

    def __check_init__(self) -> None:
        """Refuse options that cannot be simulated."""
        object.__setattr__(self, "dt", Quantity("s", 1e-5, 0.01).check("dt", self.dt))
        for name, least in (("control_every", 1), ("delay_room", 0), ("trace_every", 0)):
            object.__setattr__(self, name, checked.whole(name, getattr(self, name), least, MAX_TICKS))
        for name in ("feed_forward", "noise"):
            object.__setattr__(self, name, checked.Flag().check(name, getattr(self, name)))
        if self.payload_model not in PAYLOAD_MODELS:
            raise ValueError(
                f"payload_model: got {self.payload_model!r}, allowed: {', '.join(PAYLOAD_MODELS)}"
            )
        if self.contact not in CONTACTS:
            raise ValueError(f"contact: got {self.contact!r}, allowed: {', '.join(CONTACTS)}")
        if self.implicit not in IMPLICIT:
            raise ValueError(f"implicit: got {self.implicit!r}, allowed: {', '.join(IMPLICIT)}")
        if self.implicit != DAMPING and self.contact != COMPLIANT:
            raise ValueError(
                f"implicit: got {self.implicit!r}, allowed with contact {self.contact!r}: {DAMPING}"
            )
        if self.backend not in BACKENDS:
            raise ValueError(f"backend: got {self.backend!r}, allowed: {', '.join(BACKENDS)}")
        if self.backend in (C, SCALAR) and why_not(self) is not None:
            raise ValueError(f"backend: got {self.backend!r}, which has no {why_not(self)}; allowed: {XLA}")

    @property
    def control_dt(self) -> float:
        """Control tick [s]."""
        return self.dt * self.control_every


def why_not(options: Options) -> str | None:
    """Name what of the options only XLA serves; None if C and scalars serve all of them."""
    asked = {
        f"contact {options.contact!r}": options.contact != COMPLIANT,
        "noise in double precision": options.noise and bool(jax.config.values["jax_enable_x64"]),
    }
    return next((what for what, is_asked in asked.items() if is_asked), None)


def own_options(robot: RobotParams, gait: Gait) -> Options:
    """Options with which the robot's own paper simulates a gait, where its file says so; else the defaults."""
    said = defaults(robot).simulation(gait.name)
    return Options(**{name: value for name, value in said.items() if name != "friction"})


def own_friction(robot: RobotParams, gait: Gait) -> float:
    """Friction coefficient of the floor in the robot's own paper, where its file gives one; else `FRICTION`."""
    return defaults(robot).simulation(gait.name).get("friction", FRICTION)

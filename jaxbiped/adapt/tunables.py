"""What can be tuned: the few numbers of the adaptation, each with bounds, unit and the papers' default.

A name is `landing.T_mod`, `payload.settling_time`, `gait.D_s` or `gait.start_stop.x_s_first`. Defaults are those of
the variant that is tuned.
"""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbiped.adapt import landing, payload
from jaxbiped.adapt.controller import Controller
from jaxbiped.checked import Quantity
from jaxbiped.planner import GaitError, violations
from jaxbiped.planner.polynomial import as_scalar
from jaxbiped.robot import RobotParams

GAIT_ROOM = 0.3
"""How far a gait's parameter may go from where it is, as a share of it."""
SMALLEST = 0.01
"""What that share is taken of where the parameter is smaller than this, in its unit."""


@dataclass(frozen=True)
class Tunable:
    """One number of a controller."""

    name: str
    """Stage and parameter, as in a variant's TOML file."""
    low: float
    """Smallest value allowed."""
    high: float
    """Largest value allowed."""
    unit: str
    what: str
    index: tuple[int, ...] = ()
    """Place in the parameter, if that is a table."""

    @property
    def stage(self) -> str:
        """`landing`, `payload` or `gait`."""
        return self.name.split(".")[0]

    @property
    def field(self) -> str:
        """Name of the parameter in its record, dotted where that holds another record."""
        return "x_reflex" if self.index else self.name.partition(".")[2]


DECLARED = {"landing": landing.PARAMETERS, "payload": payload.PARAMETERS}
"""What the parameters of each stage are and may be."""


def _of_stage(
    name: str, low: float, high: float, what: str, field: str = "", index: tuple[int, ...] = ()
) -> Tunable:
    stage, own = name.split(".")
    declared = DECLARED[stage][field or own]
    assert isinstance(declared, Quantity)
    return Tunable(name, low, high, declared.unit, what, index)


def _offset(phase: str, foot: str, row: int, column: int) -> Tunable:
    name = f"payload.x_{foot}_{phase.replace(' ', '_')}"
    what = f"how far the reflex moves the {foot} foot forward, {phase} (thesis: 0.01 forward or back)"
    return _of_stage(name, -0.03, 0.03, what, "x_reflex", (row, column))


_PHASES = ("left swings", "right swings", "both stand")

TUNABLES: dict[str, Tunable] = {
    t.name: t
    for t in (
        _of_stage("landing.T_mod", 0.01, 0.3, "time to set the foot down (khadiv: what the plan needs)"),
        _of_stage("landing.descent_speed", 0.05, 0.5, "h over the control tick"),
        _of_stage("landing.delta_x_scale", 0.0, 2.0, "factor on delta_x (khadiv: 1)"),
        _of_stage("landing.release_share", 0.3, 1.0, "time of release over T_s (khadiv: 1)"),
        *(
            _offset(phase, foot, row, column)
            for row, phase in enumerate(_PHASES)
            for column, foot in enumerate(("left", "right"))
        ),
        _of_stage("payload.reflex_time", 0.04, 1.0, "t_refl_per (thesis: 0.1)"),
        _of_stage("payload.settling_time", 1.5, 6.0, "t_set_t (thesis: 2, then 4)"),
        _of_stage("payload.x_ref_gain", 0.0, 2.0, "share of the ZMP error by which x_ref moves (thesis: 1)"),
        _of_stage("payload.zmp_balanced", -0.1, 0.05, "balanced ZMP from the pelvis (thesis: -0.035)"),
        _of_stage("payload.threshold", 5.0, 200.0, "rise of the filtered force that starts the reflex"),
    )
}
"""By name; a gait's parameters come on top, see `find`."""


def find(names: Sequence[str], controller: Controller) -> list[Tunable]:
    """The tunables of these names for a controller.

    Args:
        names: each one of TUNABLES, a whole stage (`landing`, `payload`), or `gait.` and a parameter of the gait.
        controller: that is to be tuned.

    Raises:
        ValueError: naming what was got and what is allowed.
    """
    allowed = [name for name, t in TUNABLES.items() if getattr(controller, t.stage) is not None]
    allowed += [f"gait.{field}" for field in gait_fields(controller.gait)]
    found: list[Tunable] = []
    for name in names:
        of_stage = [TUNABLES[a] for a in allowed if a in TUNABLES and TUNABLES[a].stage == name]
        if of_stage:
            found += of_stage
        elif name in allowed:
            found.append(TUNABLES[name] if name in TUNABLES else _of_gait(name, controller))
        else:
            raise ValueError(f"tunable: got '{name}', allowed: {', '.join(allowed)}")
    if len({t.name for t in found}) != len(found) or not found:
        raise ValueError(f"tunables: got {', '.join(names) or 'none'}, allowed: at least one, each once")
    return found


def values(controller: Controller, tunables: Sequence[Tunable]) -> Float[Array, " n"]:
    """What they are in a controller."""
    return jnp.stack([_parameter(controller, t)[t.index] for t in tunables])


def apply(
    robot: RobotParams,
    controller: Controller,
    tunables: Sequence[Tunable],
    new: Float[Array | np.ndarray, " n"],
) -> Controller:
    """The controller with other values, planned anew; pure, to be differentiated."""
    gait, stages = with_values(robot, controller, tunables, jnp.asarray(new))
    return Controller(gait, **stages)


def with_values(
    robot: RobotParams, controller: Controller, tunables: Sequence[Tunable], new: Float[Array, " n"]
) -> tuple[Any, dict[str, Any]]:
    """What `apply` plans with: the gait, and the parameters of both stages by name.

    A descent goes through plans that break a constraint by a little, so that none is refused for that here.
    """
    own = {t.field: new[i] for i, t in enumerate(tunables) if t.stage == "gait"}
    gait, stages = other_gait(robot, controller.gait, own, allow_infeasible=True), {}
    for stage in ("landing", "payload"):
        planned = getattr(controller, stage)
        params = None if planned is None else planned.params
        for t, value in ((t, new[i]) for i, t in enumerate(tunables) if t.stage == stage):
            old = getattr(params, t.field)
            value = jnp.asarray(old).at[t.index].set(value) if t.index else value
            params = eqx.tree_at(
                lambda p, name=t.field: getattr(p, name), params, value, is_leaf=lambda x: x is None
            )
        stages[stage] = params
    return gait, stages


def as_tables(
    robot: RobotParams, controller: Controller, tunables: Sequence[Tunable], new: Sequence[float]
) -> dict[str, dict[str, Any]]:
    """The values as the tables of a variant's TOML file: stage, parameter, value.

    Where the gait is tuned, what the payload stage had read off the old one is kept as numbers, and the table [gait]
    says `allow_infeasible = true` if the new one breaks a constraint.
    """
    tables: dict[str, dict[str, Any]] = {}
    if controller.payload is not None and any(t.stage == "gait" for t in tunables):
        params = controller.payload.params
        read = {
            name: getattr(params, name) for name in ("zmp_balanced", "threshold", "slow_threshold", "x_stand")
        }
        tables["payload"] = {name: float(value) for name, value in read.items() if value is not None}
    for t, value in zip(tunables, new, strict=True):
        table = tables.setdefault(t.stage, {})
        if t.index:
            whole = table.setdefault(t.field, np.asarray(_parameter(controller, t), float).tolist())
            whole[t.index[0]][t.index[1]] = float(value)
        else:
            table[t.field] = float(value)
    if "gait" in tables:
        with contextlib.suppress(GaitError):  # out of reach: the file is refused where it is read
            gait = other_gait(robot, controller.gait, tables["gait"], allow_infeasible=True)
            if violations(robot, gait):
                tables["gait"]["allow_infeasible"] = True
    return tables


def _parameter(controller: Controller, t: Tunable) -> Array:
    if t.name == "landing.T_mod":
        assert controller.landing is not None
        return controller.landing.T_mod
    return jnp.asarray(attrgetter(t.field)(getattr(controller, t.stage).params))


def gait_fields(gait: Any) -> list[str]:
    """Dotted names of a gait's parameters that are one number."""
    return _numbers_in(gait.params, "")


def _numbers_in(record: Any, prefix: str) -> list[str]:
    names: list[str] = []
    for name, value in vars(record).items():
        if isinstance(value, eqx.Module):
            names += _numbers_in(value, f"{prefix}{name}.")
        elif eqx.is_array(value) and value.ndim == 0:
            names.append(f"{prefix}{name}")
    return names


def other_gait(
    robot: RobotParams, gait: Any, new: Mapping[str, Any], *, allow_infeasible: bool = False
) -> Any:
    """The gait with other values of some of its parameters, by their dotted names, planned anew.

    Args:
        robot: that walks.
        gait: to be changed.
        new: the values.
        allow_infeasible: whether to plan what breaks a constraint, too.

    Raises:
        GaitError: if it cannot be walked (only where the values are known).
    """
    if not new:
        return gait
    own = [as_scalar(value) for value in new.values()]
    params = eqx.tree_at(lambda p: [attrgetter(name)(p) for name in new], gait.params, own)
    return type(gait).make(robot, params, gait.n_steps, gait.first_swing, allow_infeasible=allow_infeasible)


def _of_gait(name: str, controller: Controller) -> Tunable:
    field = name.partition(".")[2]
    now = float(attrgetter(field)(controller.gait.params))
    room = GAIT_ROOM * max(abs(now), SMALLEST)
    declared = getattr(type(controller.gait), "quantities", {}).get(field, Quantity())
    low, high = max(now - room, declared.low), min(now + room, declared.high)
    return Tunable(name, low, high, declared.unit, "parameter of the gait")

"""What can be tuned: the few numbers of the adaptation, each with bounds, unit and the papers' default.

A name is `landing.T_mod`, `payload.settling_time` or `gait.D_s`. Defaults are those of the arm that is tuned.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbiped.adapt import landing, payload
from jaxbiped.adapt.controller import Controller
from jaxbiped.checked import Quantity
from jaxbiped.robot import RobotParams

GAIT_ROOM = 0.3
"""How far a gait's parameter may go from where it is, as a share of it."""


@dataclass(frozen=True)
class Tunable:
    """One number of a controller."""

    name: str
    """Stage and parameter, as in an arm's TOML file."""
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
        """Name of the parameter in its record."""
        return "x_reflex" if self.index else self.name.split(".")[1]


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
    """What `apply` plans with: the gait, and the parameters of both stages by name."""
    own = {t.field: new[i] for i, t in enumerate(tunables) if t.stage == "gait"}
    gait, stages = other_gait(robot, controller.gait, own), {}
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
    controller: Controller, tunables: Sequence[Tunable], new: Sequence[float]
) -> dict[str, dict[str, Any]]:
    """The values as the tables of an arm's TOML file: stage, parameter, value.

    Where the gait is tuned, what the payload stage had read off the old one is kept as numbers.
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
    return tables


def _parameter(controller: Controller, t: Tunable) -> Array:
    if t.name == "landing.T_mod":
        assert controller.landing is not None
        return controller.landing.T_mod
    stage = getattr(controller, t.stage)
    return jnp.asarray(getattr(stage.params, t.field))


def gait_fields(gait: Any) -> list[str]:
    """Names of a gait's parameters that are one number."""
    return [name for name, value in vars(gait.params).items() if eqx.is_array(value) and value.ndim == 0]


def other_gait(robot: RobotParams, gait: Any, new: Mapping[str, Any]) -> Any:
    """The gait with other values of some of its parameters, planned anew.

    Raises:
        GaitError: if it cannot be walked (only where the values are known).
    """
    if not new:
        return gait
    params = dataclasses.replace(gait.params, **new)
    return type(gait).make(robot, params, gait.n_steps, gait.first_swing)


def _of_gait(name: str, controller: Controller) -> Tunable:
    now = float(getattr(controller.gait.params, name.split(".")[1]))
    room = GAIT_ROOM * max(abs(now), 0.01)
    declared = getattr(type(controller.gait), "quantities", {}).get(name.split(".")[1], Quantity())
    low, high = max(now - room, declared.low), min(now + room, declared.high)
    return Tunable(name, low, high, declared.unit, "parameter of the gait")

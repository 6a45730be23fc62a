"""Tunables: the few numbers of the adaptation, each with bounds, unit and the papers' default.

A name is `landing.T_mod`, `payload.settling_time`, `gait.D_s` or `gait.start_stop.x_s_first`. Defaults are those of
the variant that is tuned.
"""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbiped.adapt import parameters
from jaxbiped.adapt.controller import Controller
from jaxbiped.adapt.stage import STAGES, Stage
from jaxbiped.checked import Quantity
from jaxbiped.planner import Gait, GaitError, violations
from jaxbiped.planner.polynomial import as_scalar
from jaxbiped.robot import RobotParams

GAIT_ROOM = 0.3
"""Range of a gait's parameter around its value, as a share of the value."""
SMALLEST = 0.01
"""Smallest value of which GAIT_ROOM is taken as a share, in the parameter's unit."""


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
    field: str
    """Name of the parameter in its record, dotted where that holds another record."""
    index: tuple[int, ...] = ()
    """Place in the parameter, if that is a table."""
    only_with: str = ""
    """The switch of the stage without which the parameter does nothing; empty if there is none."""

    @property
    def stage(self) -> str:
        """Name of the stage, or `gait`."""
        return self.name.split(".")[0]


def of_stage(stage: type[Stage]) -> list[Tunable]:
    """Tunables that the record of a stage declares."""
    found = []
    for name, tune in parameters.tuned(stage).items():
        quantity = parameters.declared(stage)[name]
        assert isinstance(quantity, Quantity)
        text = quantity.text.rstrip(".") + (f" ({tune.note})" if tune.note else "")
        for entry, index in (tune.entries or {name: ()}).items():
            where = (name, index, tune.only_with)
            found.append(Tunable(f"{stage.name}.{entry}", tune.low, tune.high, quantity.unit, text, *where))
    return found


def known() -> dict[str, Tunable]:
    """The tunables of all stages by name; a gait's parameters come on top, see `find`."""
    return {tunable.name: tunable for stage in STAGES.values() for tunable in of_stage(stage)}


def find(names: Sequence[str], controller: Controller) -> list[Tunable]:
    """The tunables of these names for a controller.

    Args:
        names: each one of `known`, a whole stage (`landing`, `payload`), or `gait.` and a parameter of the gait.
        controller: that is to be tuned.

    Raises:
        ValueError: naming what was got and what is allowed.
    """
    tunables = known()
    allowed = [name for name, tunable in tunables.items() if _matters(tunable, controller)]
    allowed += [f"gait.{field}" for field in gait_fields(controller.gait)]
    found: list[Tunable] = []
    for name in names:
        whole = [tunables[a] for a in allowed if a in tunables and tunables[a].stage == name]
        if whole:
            found += whole
        elif name in allowed:
            found.append(tunables[name] if name in tunables else _of_gait(name, controller))
        else:
            raise ValueError(f"tunable: got '{name}', allowed: {', '.join(allowed)}")
    if len({t.name for t in found}) != len(found) or not found:
        raise ValueError(f"tunables: got {', '.join(names) or 'none'}, allowed: at least one, each once")
    return found


def _matters(tunable: Tunable, controller: Controller) -> bool:
    """Tell whether a controller has the stage of a tunable, and on what the tunable needs."""
    stage = controller.stage(tunable.stage)
    return stage is not None and (not tunable.only_with or getattr(stage.params, tunable.only_with))


def values(controller: Controller, tunables: Sequence[Tunable]) -> Float[Array, " n"]:
    """Values of the tunables in a controller."""
    return jnp.stack([_parameter(controller, t)[t.index] for t in tunables])


def apply(
    robot: RobotParams,
    controller: Controller,
    tunables: Sequence[Tunable],
    new: Float[Array | np.ndarray, " n"],
) -> Controller:
    """The controller with other values, planned anew; pure, to be differentiated."""
    gait, stages = with_values(robot, controller, tunables, jnp.asarray(new))
    return Controller(gait, *stages)


def with_values(
    robot: RobotParams, controller: Controller, tunables: Sequence[Tunable], new: Float[Array, " n"]
) -> tuple[Gait, list[Stage]]:
    """Give what `apply` plans with: the gait, and the parameters of the stages.

    A descent goes through plans that break a constraint by a little, so that none is refused for that here.
    """
    own = {t.field: new[i] for i, t in enumerate(tunables) if t.stage == "gait"}
    gait, stages = other_gait(robot, controller.gait, own, allow_infeasible=True), []
    for stage in controller.stages:
        changed: dict[str, Array] = {}
        for t, value in ((t, new[i]) for i, t in enumerate(tunables) if t.stage == stage.name):
            old = changed.get(t.field, getattr(stage.params, t.field))
            changed[t.field] = jnp.asarray(old).at[t.index].set(value) if t.index else value
        stages.append(replace(stage.params, **changed))
    return gait, stages


def as_tables(
    robot: RobotParams, controller: Controller, tunables: Sequence[Tunable], new: Sequence[float]
) -> dict[str, dict[str, Any]]:
    """The values as the tables of a variant's TOML file: stage, parameter, value.

    Where the gait is tuned, what stages had read off the old one is kept as numbers, and the table [gait] says
    `allow_infeasible = true` if the new one breaks a constraint.
    """
    tables: dict[str, dict[str, Any]] = {}
    for stage in controller.stages if any(t.stage == "gait" for t in tunables) else ():
        read = {name: getattr(stage.params, name) for name in stage.params.read_off_plan}
        if read:
            tables[stage.name] = {name: float(value) for name, value in read.items() if value is not None}
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
    """The parameter's value; what the stage has read off the plan where the parameter is None."""
    if t.stage == "gait":
        return jnp.asarray(attrgetter(t.field)(controller.gait.params))
    stage = controller.stage(t.stage)
    value = getattr(stage.params, t.field)
    return jnp.asarray(getattr(stage, t.field) if value is None else value)


def gait_fields(gait: Gait) -> list[str]:
    """Dotted names of a gait's parameters that are one number."""
    return numbers_in(gait.params)


def numbers_in(record: eqx.Module, prefix: str = "") -> list[str]:
    """Dotted names of what is one number in a record, and in records in it."""
    names: list[str] = []
    for name, value in vars(record).items():
        if isinstance(value, eqx.Module):
            names += numbers_in(value, f"{prefix}{name}.")
        elif eqx.is_array(value) and value.ndim == 0:
            names.append(f"{prefix}{name}")
    return names


def other_gait(
    robot: RobotParams,
    gait: Gait,
    new: Mapping[str, Float[Array, ""] | float],
    *,
    allow_infeasible: bool = False,
) -> Gait:
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
    return gait.replanned(robot, params, allow_infeasible=allow_infeasible)


def _of_gait(name: str, controller: Controller) -> Tunable:
    field = name.partition(".")[2]
    now = float(attrgetter(field)(controller.gait.params))
    room = GAIT_ROOM * max(abs(now), SMALLEST)
    declared = getattr(type(controller.gait), "quantities", {}).get(field, Quantity())
    low, high = max(now - room, declared.low), min(now + room, declared.high)
    return Tunable(name, low, high, declared.unit, "parameter of the gait", field)

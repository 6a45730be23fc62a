"""Robots and gaits by the names and numbers that recipes and files give them."""

from collections.abc import Mapping
from pathlib import Path

import equinox as eqx

from jaxbiped import checked, planner, robot
from jaxbiped.adapt import variants
from jaxbiped.checked import Refusal
from jaxbiped.planner import presets

MAX_STEPS = 200
"""Longest walk of an experiment that is made by name or file."""


def load_robot(given: robot.RobotParams | str | Path) -> tuple[robot.RobotParams, str]:
    """A robot, and the file that it was read from; empty if it is a preset, or was a robot already.

    Raises:
        Refusal: naming the robot, what was got and what is allowed.
    """
    if isinstance(given, robot.RobotParams):
        return given, ""
    try:
        params = robot.load(given)
    except robot.RobotFileError as error:
        raise Refusal(f"robot: {str(error).removeprefix('robot: ')}") from None
    return params, "" if str(given) in robot.presets() else str(Path(given).absolute())


def kind_of(gait: object) -> str | None:
    """Name of the kind of a gait; None if it is not registered."""
    name = getattr(gait, "name", "")
    return name if planner.GAITS.get(name) is type(gait) else None


def own_kind(params: robot.RobotParams) -> str:
    """Name of the gait of the robot's own paper.

    Raises:
        Refusal: if none is known.
    """
    try:
        return planner.own_gait_name(params)
    except planner.GaitError as error:
        raise Refusal(f"robot, gait: {error}") from None


def plan(
    params: robot.RobotParams,
    kind: str | None = None,
    steps: int = 8,
    numbers: Mapping[str, float] | None = None,
    *,
    first_swing: int = robot.LEFT,
    allow_infeasible: bool = False,
) -> planner.Gait:
    """Plan a walk by the name of its gait.

    A preset that is known to break a constraint is planned nevertheless.

    Args:
        params: the robot that walks.
        kind: name of the gait; None for that of the robot's own paper.
        steps: number of steps.
        numbers: parameters by dotted names, instead of the preset's; all of them where the robot has no preset.
        first_swing: the foot that swings first, 0 left or 1 right.
        allow_infeasible: whether to plan what breaks a constraint, too.

    Raises:
        Refusal: naming the argument, what was got and what is allowed.
    """
    kind = own_kind(params) if kind is None else checked.Word(tuple(planner.GAITS)).check("gait", kind)
    if not 1 <= steps <= MAX_STEPS:
        raise Refusal(f"steps: got {steps}, allowed: 1 to {MAX_STEPS}")
    made = planner.GAITS[kind]
    try:
        chosen = gait_parameters(params, kind, numbers or {})
        known = planner.known_infeasible(made, params)
        allow = allow_infeasible or bool(known and variants.same(chosen, made.preset_params(params)))
        return made.make(params, chosen, steps, first_swing, allow_infeasible=allow)
    except planner.GaitError as error:
        raise Refusal(f"robot, gait: {error}") from None


def gait_parameters(params: robot.RobotParams, kind: str, numbers: Mapping[str, float]) -> eqx.Module:
    """The preset parameters of a gait for a robot, some of them changed.

    Raises:
        Refusal: for a name that the gait has not; a GaitError if the robot has no preset and one is left out.
    """
    made = planner.GAITS[kind]
    checked.refuse_unknown("gait.", numbers, made.quantities)
    if numbers.keys() < made.quantities.keys():
        numbers = {**variants.numbers_of(made.preset_params(params)), **numbers}
    return presets.record_of(made.parameters, numbers)

"""What fits a robot and its gait where nobody says otherwise: gait, simulation, floor, clock."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxbiped import checked, planner, robot, sim
from jaxbiped.adapt import variants
from jaxbiped.batch.inputs import INPUTS
from jaxbiped.checked import Refusal

GAITS = {"polynomial": planner.PolynomialGait, "cosine": planner.CosineGait}
"""Gaits by name."""
PARAMETERS = {planner.PolynomialGait: planner.PolynomialParams, planner.CosineGait: planner.CosineParams}
PRESETS = {planner.PolynomialGait: planner.polynomial_params, planner.CosineGait: planner.cosine_params}
OWN_GAIT = {"elkahlout": "cosine"}
"""The gait of each preset robot's own paper, where it is not the polynomial one."""
THESIS_FRICTION = 0.09
"""Of the floor in the thesis' experiments. The thesis does not state it: assumed, the one number chosen by its Tables
4.2 and 4.3 (`sweeps/calibrate_elkahlout.py`). On a floor with more grip no robot of its measures can pull its feet
under its body in 0.1 s."""
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


def own_gait(params: robot.RobotParams) -> str:
    """Name of the gait of the robot's own paper, or of the paper of the robot it walks like."""
    return OWN_GAIT.get(params.preset_name, "polynomial")


def kind_of(gait: Any) -> str | None:
    """Name of the kind of a gait; None if it has none."""
    return next((name for name, made in GAITS.items() if type(gait) is made), None)


def plan(
    params: robot.RobotParams,
    kind: str | None = None,
    steps: int = 8,
    numbers: Mapping[str, float] | None = None,
    *,
    first_swing: int = robot.LEFT,
    allow_infeasible: bool = False,
) -> Any:
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
    kind = own_gait(params) if kind is None else checked.Word(tuple(GAITS)).check("gait", kind)
    if not 1 <= steps <= MAX_STEPS:
        raise Refusal(f"steps: got {steps}, allowed: 1 to {MAX_STEPS}")
    made = GAITS[kind]
    try:
        chosen = gait_parameters(params, kind, numbers or {})
        known = planner.known_infeasible(made, params)
        allow = allow_infeasible or bool(known and variants.same(chosen, PRESETS[made](params)))
        return made.make(params, chosen, steps, first_swing, allow_infeasible=allow)
    except planner.GaitError as error:
        raise Refusal(f"robot, gait: {error}") from None


def gait_parameters(params: robot.RobotParams, kind: str, numbers: Mapping[str, float]) -> Any:
    """The preset parameters of a gait for a robot, some of them changed.

    Raises:
        Refusal: for a name that the gait has not; a GaitError if the robot has no preset and one is left out.
    """
    made = GAITS[kind]
    checked.refuse_unknown("gait.", numbers, made.quantities)
    if numbers.keys() < made.quantities.keys():
        numbers = {**variants.numbers_of(PRESETS[made](params)), **numbers}
    return _record(PARAMETERS[made], variants.nested(numbers))


def _record(made: Any, values: Mapping[str, Any]) -> Any:
    """A record, and records in it, by the names of their fields."""
    kinds = {field.name: field.type for field in dataclasses.fields(made)}
    return made(
        **{
            name: _record(kinds[name], value) if isinstance(value, dict) else value
            for name, value in values.items()
        }
    )


def is_thesis(params: robot.RobotParams, gait: Any) -> bool:
    """Whether this is the thesis' own walk."""
    return params.preset_name == "elkahlout" and isinstance(gait, planner.CosineGait)


def simulation_options(params: robot.RobotParams, gait: Any) -> sim.Options:
    """The thesis' own walk by its own means: no feed-forward, control every tick, trunk with load by Eqs. 3.8-3.10."""
    thesis = is_thesis(params, gait)
    return sim.Options(
        control_every=1 if thesis else 4,
        feed_forward=not thesis,
        payload_model="thesis" if thesis else "exact",
    )


def floor_friction(params: robot.RobotParams, gait: Any) -> float:
    """Friction of the floor where nobody says otherwise: THESIS_FRICTION for the thesis' own walk."""
    return THESIS_FRICTION if is_thesis(params, gait) else INPUTS["friction"].default


def clock_start(gait: Any) -> float:
    """When the clock of loading times starts, since the start of the walk [s].

    The thesis' time begins T_ini after the start of a cosine gait.
    """
    return float(gait.params.T_ini) if isinstance(gait, planner.CosineGait) else 0.0

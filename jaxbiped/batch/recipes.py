"""Experiments that are asked for again and again, made of a few numbers."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import polars as pl

from jaxbiped import sim
from jaxbiped.adapt import STAGES, Controller
from jaxbiped.adapt import variants as files_of_variants
from jaxbiped.batch import defaults
from jaxbiped.batch.draws import grid
from jaxbiped.batch.experiment import Experiment
from jaxbiped.batch.inputs import NEVER, height_column
from jaxbiped.checked import Refusal, nearest
from jaxbiped.planner import Gait
from jaxbiped.robot import RobotParams
from jaxbiped.sim.scenario import RANGES

LOADS = (2.5, 5.0, 7.5, 10.0, 12.5, 15.0)
"""The thesis' loads [kg]."""
TIMES = (0.3, 0.6, 0.9, 1.2, 1.5, 1.8, 2.1, 2.4)
"""Loading times on the gait's own clock [s]."""
HEIGHTS = tuple(0.01 * cm for cm in range(-5, 6))
"""Heights of pads and holes [m]."""
LATEST = 60.0
"""Latest loading time [s]."""
STEPS_AFTER = 4
"""Steps planned after the one of the last loading: the rest of it, the one after the recovery, and two whole ones."""


def payload(  # noqa: PLR0913
    robot: RobotParams | str | Path = "elkahlout",
    gait: str | None = None,
    variants: Iterable[str] = ("off", "original", "modified"),
    loads: Iterable[float] = LOADS,
    times: Iterable[float] = TIMES,
    friction: float | None = None,
    steps: int | None = None,
    allow_infeasible: bool = False,
    seed: int = 0,
    batch: int | None = None,
) -> Experiment:
    """Loads put on a walking robot that does not know of them: every load at every time.

    Args:
        robot: a robot, the name of a preset, or the path of a robot file.
        gait: name of the gait; None for that of the robot's own paper.
        variants: of the payload reflex, by name (`off` and those of `adapt.PayloadReflex`) or by a file (.toml).
        loads: masses [kg].
        times: when a load is put on [s], on the gait's own clock, see its `clock_start`.
        friction: of the floor; None for that of the thesis' experiments on the thesis' own walk, else 0.8.
        steps: of the walk; None for enough to complete two after the last recovery.
        allow_infeasible: whether the plan may break a constraint.
        seed: of the sensors' noise.
        batch: walks at once; None for up to 128.

    Raises:
        Refusal: naming the argument, what was got and what is allowed.
    """
    params, file = defaults.load_robot(robot)
    loads = numbers("loads", loads, "kg", 0.0, float(params.total_mass))
    times = numbers("times", times, "s", 0.0, LATEST)
    if steps is None:
        steps = _steps_until(max(times), defaults.plan(params, gait, 1, allow_infeasible=True))
    planned = defaults.plan(params, gait, steps, allow_infeasible=allow_infeasible)
    start = float(planned.clock_start)
    if max(times) + start > float(planned.duration):
        latest = float(planned.duration) - start
        raise Refusal(f"times: got {max(times):g} s, allowed: up to {latest:.4g} s with {steps} steps")
    friction = sim.own_friction(params, planned) if friction is None else friction
    (friction,) = numbers("friction", (friction,), "", RANGES["friction"].low, RANGES["friction"].high)
    scenarios = grid(load_kg=loads, load_time_s=[start + time for time in times], friction=[friction])
    return _experiment(params, file, planned, "payload", variants, scenarios, allow_infeasible, seed, batch)


def obstacles(  # noqa: PLR0913
    robot: RobotParams | str | Path = "surena3",
    gait: str | None = None,
    variants: Iterable[str] = ("off", "paper", "repaired"),
    heights: Iterable[float] = HEIGHTS,
    step: Sequence[int] = (4,),
    steps: int = 8,
    allow_infeasible: bool = False,
    seed: int = 0,
    batch: int | None = None,
) -> Experiment:
    """Obstacles or holes that the robot does not know of, of every height.

    Args:
        robot: a robot, the name of a preset, or the path of a robot file.
        gait: name of the gait; None for that of the robot's own paper.
        variants: of the landing, by name (`off` and those of `adapt.Landing`) or by a file (.toml).
        heights: of the obstacle [m], negative for a hole.
        step: steps under whose footholds they are, 0 for the first; each has one of the same height.
        steps: of the walk.
        allow_infeasible: whether the plan may break a constraint.
        seed: of the sensors' noise.
        batch: walks at once; None for up to 128.

    Raises:
        Refusal: naming the argument, what was got and what is allowed.
    """
    params, file = defaults.load_robot(robot)
    heights = numbers("heights", heights, "m", RANGES["height_m"].low, RANGES["height_m"].high)
    planned = defaults.plan(params, gait, steps, allow_infeasible=allow_infeasible)
    if not step or len(set(step)) < len(step):
        raise Refusal(f"step: got {step}, allowed: one or more steps, each once")
    for number in step:
        if not 0 <= number < steps:
            raise Refusal(f"step: got {number}, allowed: 0 to {steps - 1} with {steps} steps")
    scenarios = pl.DataFrame({height_column(number): heights for number in step})
    return _experiment(params, file, planned, "landing", variants, scenarios, allow_infeasible, seed, batch)


def walk(
    robot: RobotParams | str | Path,
    controller: Controller,
    obstacles: Mapping[int, float] | None = None,
    load_kg: float = 0.0,
    load_time_s: float = NEVER,
    name: str = "walk",
) -> Experiment:
    """One walk, over obstacles and under a load that the robot does not know of.

    Args:
        robot: a robot, the name of a preset, or the path of a robot file.
        controller: gait and adaptation.
        obstacles: heights [m] by the number of the step under whose foothold they are; negative for a hole.
        load_kg: mass of the load [kg].
        load_time_s: when it is put on [s]; 0 for one that is carried from the start.
        name: of the variant.

    Raises:
        ValueError: naming what was got and what is allowed.
    """
    params, file = defaults.load_robot(robot)
    columns = {height_column(step): height for step, height in (obstacles or {}).items()}
    columns |= {"friction": sim.own_friction(params, controller.gait)}
    if load_kg:
        columns |= {"load_kg": load_kg, "load_time_s": load_time_s}
    options = sim.own_options(params, controller.gait)
    return Experiment(params, {name: controller}, pl.DataFrame([columns]), options, robot_file=file)


def numbers(name: str, values: Iterable[float], unit: str, low: float, high: float) -> list[float]:
    """Values of an argument, each once, each within its range.

    Raises:
        Refusal: naming the argument, what was got and what is allowed.
    """
    found = list(values)
    if not found:
        raise Refusal(f"{name}: got no value, allowed: one or more from {low:g} to {high:g} {unit}")
    for value in found:
        if not (math.isfinite(value) and low <= value <= high):
            raise Refusal(f"{name}: got {value:g} {unit}, allowed: {low:g} to {high:g} {unit}")
    if len(set(found)) < len(found):
        raise Refusal(f"{name}: got a value twice, allowed: each once")
    return [float(value) for value in found]


def controllers(
    names: Iterable[str], stage: str, params: RobotParams, gait: Gait, allow_infeasible: bool = False
) -> dict[str, Controller]:
    """Controllers with one stage by the names of its variants, or by files.

    Raises:
        Refusal: naming the variant, what was got and what is allowed.
    """
    allowed = (files_of_variants.OFF, *STAGES[stage].variants)
    words = f"{', '.join(allowed)}, or a file that ends in .toml"
    found: dict[str, Controller] = {}
    for name in names:
        if name in found:
            raise Refusal(f"variants: got '{name}' twice, allowed: each once")
        if name.endswith(".toml"):
            found[name] = _from_file(name, params, gait, allow_infeasible)
        elif name in allowed:
            found[name] = Controller(gait, files_of_variants.stage_of(stage, name, params, gait))
        else:
            raise Refusal(f"variants: got '{name}', allowed: {words}{nearest(name, allowed)}")
    if not found:
        raise Refusal(f"variants: got none, allowed: {words}")
    return found


def _from_file(name: str, params: RobotParams, gait: Gait, allow_infeasible: bool) -> Controller:
    try:
        return files_of_variants.load(Path(name), params, gait, allow_infeasible)
    except Refusal as error:
        raise Refusal(f"variants: {error}") from None


def _steps_until(time: float, gait: Gait) -> int:
    """Steps of a walk that is to be completed after a load at this time on the gait's own clock [s]."""
    since_liftoff = time + float(gait.clock_start) - float(gait.timing.first_liftoff)
    return max(0, math.floor(since_liftoff / float(gait.timing.T_c))) + 1 + STEPS_AFTER


def _experiment(  # noqa: PLR0913
    params: RobotParams,
    file: str,
    gait: Gait,
    stage: str,
    names: Iterable[str],
    scenarios: pl.DataFrame,
    allow_infeasible: bool,
    seed: int,
    batch: int | None,
) -> Experiment:
    return Experiment(
        params,
        controllers(names, stage, params, gait, allow_infeasible),
        scenarios,
        sim.own_options(params, gait),
        seed=seed,
        batch=batch,
        robot_file=file,
        pages=("payload" if stage == "payload" else "obstacles",),
    )

"""From the words of `jaxbiped walk` to a robot, gait, controller and scenario; what cannot be meant is refused."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxbiped import adapt, batch, checked, robot, sim
from jaxbiped.adapt.variants import stage_of
from jaxbiped.batch import recipes
from jaxbiped.commands.choices import (
    LANDINGS,
    MODIFIED,
    OFF,
    PAPER,
    REFLEXES,
    REPAIRED,
    gait_name,
    load_variant,
    make_gait,
)
from jaxbiped.commands.common import InputError, load_robot
from jaxbiped.planner import Gait
from jaxbiped.sim.options import AUTO
from jaxbiped.sim.scenario import RANGES, require_swing_clears

VARIANTS = tuple(dict.fromkeys((*LANDINGS, *REFLEXES)))
REFLEX_VARIANTS = tuple(variant for variant in REFLEXES if variant not in LANDINGS)
DEEPEST = RANGES["height_m"].low
"""Smallest height of a pad, that of the deepest hole [m]."""
ROOM = 8
"""Rectangles that there is room for in a walk of its own, at least."""
TRACE_DT = 2e-3
"""Time between two samples of the trace [s]."""


@dataclass(frozen=True)
class Obstacle:
    """A pad under a foothold."""

    step: int
    height: float
    """Height over the ground, negative for a hole [m]."""


@dataclass(frozen=True)
class Load:
    """A payload."""

    mass: float
    """Mass [kg]."""
    time: float
    """When it is put on [s]."""
    end: float | None = None
    """When it is taken off [s]; None for one that stays."""


@dataclass(frozen=True)
class Variants:
    """Record of which version of each stage of adaptation is on."""

    landing: str
    """off, paper, repaired, or the file of a variant."""
    reflex: str
    """off, original, modified, repaired, two_speed, or the file of a variant."""

    @property
    def name(self) -> str:
        """One name for both."""
        on = {"landing": self.landing, "payload": self.reflex}
        return ", ".join(f"{stage} {word}" for stage, word in on.items() if word != OFF) or OFF


@dataclass(frozen=True)
class Setup:
    """All that a walk needs."""

    robot: robot.RobotParams
    gait: Gait
    obstacles: list[Obstacle]
    load: Load | None
    variants: Variants
    controller: adapt.Controller
    scenario: sim.Scenario
    options: sim.Options
    duration: float
    """Time to be simulated [s]."""
    experiment: batch.Experiment
    """That whose row this is."""

    @property
    def gait_name(self) -> str:
        """Name of the gait."""
        return self.gait.name


def set_up(
    robot_name: str,
    steps: int,
    given_gait: str | None,
    obstacles: Iterable[str],
    payload: Iterable[str],
    variants: Iterable[str],
    allow_infeasible: bool = False,
) -> Setup:
    """Read the arguments of `jaxbiped walk`.

    Raises:
        InputError: if one of them cannot be used.
    """
    params = load_robot("--robot", robot_name)
    gait = make_gait(params, gait_name(given_gait, params), steps, allow_infeasible)
    words = list(variants)
    of_file = _of_file(words, params, gait, allow_infeasible)
    gait = gait if of_file is None else of_file.gait
    pads, load = _obstacles(obstacles, gait), _load(payload, gait, params)
    if of_file is None:
        chosen = _variants(words, bool(pads), load is not None)
        controller = _controller(chosen, params, gait)
    else:
        controller, stages = of_file, (of_file.stage("landing"), of_file.stage("payload"))
        chosen = Variants(*(OFF if stage is None else words[0] for stage in stages))
    loaded = {} if load is None else {"load_kg": load.mass, "load_time_s": load.time}
    heights = {pad.step: pad.height for pad in pads}
    name = words[0] if of_file is not None else chosen.name
    try:
        one = recipes.walk(robot_name, controller, heights, **loaded, name=name)
    except ValueError as error:
        where, got, rest = str(error).partition("got ")
        raise InputError(f"{'--obstacle: ' if where.startswith('scenarios') else where}{got}{rest}") from None
    return of_row(one, {"variant": name, "scenario": 0, **one.table.row(0, named=True)}, chosen)


def controller_of(
    variants: Iterable[str], params: robot.RobotParams, gait: Gait, allow_infeasible: bool = False
) -> adapt.Controller:
    """A controller by the words of `--variant`, in no scenario in particular; `repaired` without any.

    Raises:
        InputError: if they cannot be used.
    """
    words = list(variants) or [REPAIRED]
    of_file = _of_file(words, params, gait, allow_infeasible)
    return _controller(_variants(words, False, False), params, gait) if of_file is None else of_file


def _controller(chosen: Variants, params: robot.RobotParams, gait: Gait) -> adapt.Controller:
    """The controller of named variants."""
    stages = (("landing", chosen.landing), ("payload", chosen.reflex))
    return adapt.Controller(gait, *(stage_of(stage, word, params, gait) for stage, word in stages))


def of_row(experiment: batch.Experiment, row: Mapping[str, Any], variants: Variants | None = None) -> Setup:
    """One row of an experiment as a walk of its own.

    Args:
        experiment: what is walked.
        row: its inputs, and `variant` and `scenario`.
        variants: of its stages; the variant's name for every stage that it has if not given.
    """
    controller = experiment.variants[row["variant"]]
    chosen = experiment.table[row["scenario"]]
    scenario = jax.tree.map(lambda leaf: leaf[0], batch.scenarios_of(chosen, experiment.pads))
    options = experiment.simulation
    heights = {step: row[batch.height_column(step)] for step in batch.steps_of(chosen.columns)}
    end = row.get("load_end_s", batch.NEVER)  # of a table of version 0.1: no such input yet
    loaded = row["load_kg"] > 0.0 and row["load_time_s"] < batch.NEVER
    names = [OFF if controller.stage(name) is None else row["variant"] for name in ("landing", "payload")]
    return Setup(
        robot=experiment.robot,
        gait=controller.gait,
        obstacles=[Obstacle(step, height) for step, height in heights.items() if height],
        load=Load(row["load_kg"], row["load_time_s"], end if end < batch.NEVER else None) if loaded else None,
        variants=variants or Variants(landing=names[0], reflex=names[1]),
        controller=controller,
        scenario=_roomy(scenario),
        options=replace(options, trace_every=max(1, round(TRACE_DT / options.control_dt)), backend=AUTO),
        duration=experiment.durations[row["variant"]],
        experiment=experiment,
    )


def _roomy(scenario: sim.Scenario) -> sim.Scenario:
    """The same with room for ROOM rectangles, so that walks over few and over many obstacles are one program."""

    def filled(leaf: Array) -> Array:
        more = max(ROOM - leaf.shape[0], 0)
        return jnp.concatenate([leaf, jnp.zeros((more, *leaf.shape[1:]), leaf.dtype)])

    return replace(scenario, terrain=jax.tree.map(filled, scenario.terrain))


_Number = TypeVar("_Number", int, float)


def _number(argument: str, got: str, form: str, text: str, kind: Callable[[str], _Number]) -> _Number:
    try:
        value = kind(text)
        finite = math.isfinite(value)
    except (ValueError, OverflowError):
        raise InputError(f"{argument}: got '{got}', allowed: {form}") from None
    if not finite:
        raise InputError(f"{argument}: got '{got}', allowed: {form} with finite numbers")
    return value


def _obstacles(words: Iterable[str], gait: Gait) -> list[Obstacle]:
    """Read obstacles, STEP:HEIGHT, each step once, at most as high as the swing foot goes."""
    form = "STEP:HEIGHT, a whole number and meters, such as 3:0.03 or 4:-0.02"
    last = int(gait.timing.n_steps) - 1
    found: dict[int, Obstacle] = {}
    for word in words:
        parts = word.split(":")
        if len(parts) != 2:
            raise InputError(f"--obstacle: got '{word}', allowed: {form}")
        step = _number("--obstacle", word, form, parts[0], int)
        height = _number("--obstacle", word, form, parts[1], float)
        if not 0 <= step <= last:
            raise InputError(
                f"--obstacle: got step {step} in '{word}', allowed: 0 to {last} with --steps {last + 1}"
            )
        if step in found:
            raise InputError(f"--obstacle: got step {step} twice, allowed: one obstacle under each step")
        if height < DEEPEST:
            raise InputError(f"--obstacle: got height {height:g} m in '{word}', allowed: >= {DEEPEST:g} m")
        try:
            require_swing_clears(gait, {step: height})
        except ValueError as error:
            allowed = str(error).partition("allowed: ")[2]
            raise InputError(f"--obstacle: got height {height:g} m in '{word}', allowed: {allowed}") from None
        found[step] = Obstacle(step, height)
    return list(found.values())


def _load(words: Iterable[str], gait: Gait, params: robot.RobotParams) -> Load | None:
    """Read the load, MASS@TIME, at most one."""
    form = "MASS@TIME, kilograms and seconds, such as 15@2.4"
    given = list(words)
    if not given:
        return None
    if len(given) > 1:
        raise InputError(f"--payload: got {len(given)} ({', '.join(given)}), allowed: one")
    word, parts = given[0], given[0].split("@")
    if len(parts) != 2:
        raise InputError(f"--payload: got '{word}', allowed: {form}")
    mass, time = (_number("--payload", word, form, text, float) for text in parts)
    most, end = min(float(params.total_mass), RANGES["load_kg"].high), float(gait.duration)
    if not 0.0 < mass <= most:
        raise InputError(
            f"--payload: got mass {mass:g} kg in '{word}', allowed: > 0 and <= {most:.4g} kg, the robot's"
        )
    if not 0.0 <= time <= end:
        raise InputError(
            f"--payload: got time {time:g} s in '{word}', allowed: 0 to {end:.4g} s, the planned walk"
        )
    return Load(mass, time)


def _of_file(
    words: list[str], params: robot.RobotParams, gait: Gait, allow_infeasible: bool
) -> adapt.Controller | None:
    """The controller of a variant's file, with its own gait; None if the words name no file."""
    if not any(word.endswith(".toml") for word in words):
        return None
    if len(words) > 1:
        raise InputError(f"--variant: got {' '.join(words)}, allowed: a file (.toml) by itself")
    return load_variant("--variant", Path(words[0]), params, gait, allow_infeasible)


def _variants(words: list[str], has_obstacles: bool, has_load: bool) -> Variants:
    """Choose the variants; without words, those the walk calls for.

    `repaired` stands for whichever stage no other word is for.
    """
    for word in words:
        if word not in VARIANTS:
            raise InputError(
                f"--variant: got '{word}', allowed: {', '.join(VARIANTS)}, or a file that ends in .toml"
                f"{checked.nearest(word, VARIANTS)}"
            )
    if not words:
        return Variants(REPAIRED if has_obstacles else OFF, MODIFIED if has_load else OFF)
    reflexes = [word for word in words if word in REFLEX_VARIANTS]
    if len(set(words)) < len(words) or len(reflexes) > 1 or (OFF in words and len(words) > 1):
        raise InputError(
            f"--variant: got {' '.join(words)}, allowed: off, or one for each stage: paper or repaired for landing, "
            "original, modified, repaired or two_speed for the payload reflex"
        )
    if len(words) == 3:
        raise InputError(
            f"--variant: got {' '.join(words)}, allowed: at most one word for each of the two stages"
        )
    otherwise = REPAIRED if REPAIRED in words else OFF
    return Variants(PAPER if PAPER in words else otherwise, reflexes[0] if reflexes else otherwise)

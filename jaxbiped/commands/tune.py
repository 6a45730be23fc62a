"""`jaxbiped tune`: tune a variant's few numbers by gradients, or only say how far the gradients can be trusted."""

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import polars as pl
from tyro.conf import arg

from jaxbiped import adapt, batch, files, planner, sim, tune
from jaxbiped.adapt import tunables
from jaxbiped.adapt.variants import stage_of
from jaxbiped.batch import Choice, Uniform
from jaxbiped.checked import nearest
from jaxbiped.commands import batches
from jaxbiped.commands.choices import (
    ALLOW_HELP,
    GAIT_NAMES,
    MODIFIED,
    REPAIRED,
    gait_name,
    load_variant,
    make_gait,
    variant_tables,
)
from jaxbiped.commands.common import (
    OVERWRITE_HELP,
    InputError,
    draw,
    load_robot,
    make_writable,
    plain,
    refusing,
    require_folder,
    require_free,
    say,
    whole,
    write,
)
from jaxbiped.robot import RobotParams
from jaxbiped.tune.descent import STATE

WHAT_HELP = "What to tune: a stage (payload, landing), or names such as payload.settling_time, landing.T_mod, gait.b_s."
BASES = {"payload": adapt.PayloadReflex.variants, "landing": adapt.Landing.variants}
LIGHTEST, HEAVIEST = 0.02, 0.2
"""Smallest and largest load, as shares of the robot's mass."""
HIGHEST = 0.04
"""Largest height of a pad [m]."""
STEPS = {"payload": 4, "landing": 6}
HORIZON = 10.0
"""Simulated time of the walks whose gradient is taken [s]."""
VARIANT_FILE = "tuned.toml"
FILES = (VARIANT_FILE, "loss.png", "values.png")
MAX_COUNT = 100_000
HELD_OUT_SEED = 1000
"""Distance of the seed of the held-out scenarios from that of the others."""
Tables = Mapping[str, Mapping[str, Any]]
"""Tables of the file of a variant."""
PAD_STEP = 2
"""Step under which the pads are."""


@dataclass(frozen=True)
class Tune:
    """Tune the few numbers of an adaptation by gradients over random scenarios; writes the file of a variant."""

    robot: str = "elkahlout"
    """Name of a preset (elkahlout, surena3) or path of a robot file (.toml)."""
    gait: Annotated[str | None, arg(metavar=GAIT_NAMES)] = None
    """Default: the gait of the robot's own paper."""
    what: Annotated[tuple[str, ...], arg(help=WHAT_HELP)] = ("payload",)
    variant: Annotated[str | None, arg(metavar="original|modified|paper|repaired|FILE")] = None
    """The variant to start from, by name or file (.toml). Default: modified for payloads, repaired for landing."""
    allow_infeasible: Annotated[bool, arg(help=ALLOW_HELP)] = False
    scenarios: int = 64
    """Random scenarios to tune on; as many others are held out."""
    batch: int = 16
    """Scenarios in a step."""
    steps: int = 40
    """Steps of the descent."""
    duration: float | None = None
    """How long every walk is simulated [s]. Default: 10 s for gradients, held-out walks as long as their verdict
    needs."""
    trust_only: bool = False
    """Only say how far the gradient at the start can be trusted; in float64, for float32 blurs finite differences."""
    x64: bool = False
    """Descend in float64: slower, and derivatives with more digits."""
    seed: int = 0
    """Of the scenarios and of the descent."""
    out: Path = Path("runs/tune")
    """Folder of the variant, the figures and the state; a descent that was stopped goes on."""
    overwrite: Annotated[bool, arg(help=OVERWRITE_HELP)] = False
    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Tune) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    check(command)
    with jax.enable_x64(command.x64 or command.trust_only):
        with batch.waiting("planning"):
            problem, held_out, start = set_up(command)
        return _trust(command, problem) if command.trust_only else _descend(command, problem, held_out, start)


def check(command: Tune) -> None:
    """Refuse what can be refused without any work: numbers, names, the folder.

    Raises:
        InputError: naming the argument, what was got and what is allowed.
        ImportError: if the package that descends is missing.
    """
    for name, least in (("scenarios", 2), ("batch", 2), ("steps", 1)):
        whole(f"--{name}", getattr(command, name), least, MAX_COUNT)
    whole("--seed", command.seed, 0, 2**31 - 1 - HELD_OUT_SEED)
    if command.duration is not None:
        batches.numbers("--duration", [command.duration], "s", 0.1, 3600.0)
    params = load_robot("--robot", command.robot)
    require_names(command.what, gait_name(command.gait, params))
    if command.variant is not None and not command.variant.endswith(".toml"):
        for stage in _stages(command):
            _require_base(command.variant, stage)
    if not command.trust_only:
        require_folder(command.out)
        require_free(command.out, FILES, (command.out / STATE).exists(), command.overwrite)
        if importlib.util.find_spec("optax") is None:
            raise ImportError("tuning needs optax: pip install 'jaxbiped[tune]'")


def require_names(names: tuple[str, ...], gait: str) -> None:
    """Refuse names that no robot, gait or stage has.

    Raises:
        InputError: with the nearest name.
    """
    known = [*BASES, *tunables.known()]
    if gait in planner.GAITS:
        known += [f"gait.{name}" for name in planner.GAITS[gait].quantities]
    if not names or len(set(names)) < len(names):
        raise InputError(f"--what: got {' '.join(names) or 'none'}, allowed: one or more names, each once")
    for name in names:
        if name not in known:
            raise InputError(f"--what: got '{name}', allowed: {', '.join(known)}{nearest(name, known)}")


def _stages(command: Tune) -> set[str]:
    return {name.split(".")[0] for name in command.what} & set(BASES) or {"payload"}


def _require_base(name: str, stage: str) -> None:
    if name not in BASES[stage]:
        raise InputError(
            f"--variant: got '{name}', allowed: {', '.join(BASES[stage])} for {stage}, or a file that ends in .toml"
            f"{nearest(name, BASES[stage])}"
        )


def set_up(command: Tune) -> tuple[tune.Problem, batch.Experiment, Tables]:
    """The problem, the scenarios held out, and the tables of the variant it starts from."""
    params = load_robot("--robot", command.robot)
    stages = _stages(command)
    steps = max(STEPS[s] for s in stages)
    gait = make_gait(params, gait_name(command.gait, params), steps, command.allow_infeasible)
    start, variant = _start(command, params, gait, stages)
    made = [
        batches.experiment(
            params,
            {command.variant or "tuned": variant},
            _scenarios(command, params, variant.gait, stages, command.seed + HELD_OUT_SEED * held),
            sim.own_options(params, variant.gait),
            duration=horizon if command.duration is None else command.duration,
            seed=command.seed,
        )
        for held, horizon in ((0, HORIZON), (1, None))
    ]
    try:
        return tune.Problem.of(made[0], command.what), made[1], start
    except ValueError as error:
        raise InputError(f"--what: {error}") from None


def _start(
    command: Tune, params: RobotParams, gait: planner.Gait, stages: set[str]
) -> tuple[Tables, adapt.Controller]:
    """The variant it starts from: its tables and the controller."""
    if command.variant and command.variant.endswith(".toml"):
        path = Path(command.variant)
        variant = load_variant("--variant", path, params, gait, command.allow_infeasible)
        return variant_tables("--variant", path), variant
    defaults = {"payload": MODIFIED, "landing": REPAIRED}
    base = {stage: command.variant or defaults[stage] for stage in stages}
    for stage, name in base.items():
        _require_base(name, stage)
    variant = adapt.Controller(gait, *(stage_of(stage, name, params, gait) for stage, name in base.items()))
    return {stage: {"base": name} for stage, name in base.items()}, variant


def _scenarios(
    command: Tune, params: RobotParams, gait: planner.Gait, stages: set[str], seed: int
) -> pl.DataFrame:
    ranges: dict[str, Any] = {}
    if "payload" in stages:
        start = float(gait.clock_start)
        last = float(gait.timing.first_liftoff) + 1.5 * float(gait.timing.T_c)
        mass = float(params.total_mass)
        ranges["load_kg"] = Uniform(LIGHTEST * mass, HEAVIEST * mass)
        ranges["load_time_s"] = Uniform(start + 0.1, last)
    if "landing" in stages:
        highest = min(HIGHEST, 0.8 * sim.swing_height(gait))
        heights = np.round(np.linspace(-highest, highest, 17), 4)
        ranges[batch.height_column(PAD_STEP)] = Choice(tuple(float(h) for h in heights if abs(h) > 1e-3))
    floor = sim.own_friction(params, gait)
    return batch.draw(command.scenarios, seed, friction=Uniform(0.75 * floor, 1.25 * floor), **ranges)


def _trust(command: Tune, problem: tune.Problem) -> dict[str, Any]:
    rows = np.arange(problem.experiment.table.height)
    with batch.waiting("compiling, and measuring gradients in four ways"):
        report = tune.trust_report(problem, problem.start, rows, seed=command.seed, timed=True)
    print("\n".join(report.lines()))
    return plain(report.record())


def _descend(
    command: Tune, problem: tune.Problem, held_out: batch.Experiment, start: Tables
) -> dict[str, Any]:
    settings = tune.Settings(steps=command.steps, scenarios=command.batch, seed=command.seed)
    made_by = f"jaxbiped tune --robot {command.robot} --what {' '.join(command.what)}"
    made_by += f" --variant {command.variant}" if command.variant else ""
    make_writable(command.out)
    try:
        tuned, files = descend(problem, held_out, settings, start, command.out, made_by, command.overwrite)
    except ValueError as error:
        raise InputError(f"--{error}") from None
    path = command.out / VARIANT_FILE
    print(
        f"{path} is a variant: jaxbiped {'payload' if 'payload' in start else 'obstacles'} --variant {path}"
    )
    values = {t.name: float(v) for t, v in zip(problem.tunables, tuned.values, strict=True)}
    return {
        "tuned": values,
        "before": tuned.before,
        "after": tuned.after,
        "variant": str(path),
        "files": files,
    }


def descend(
    problem: tune.Problem,
    held_out: batch.Experiment,
    settings: tune.Settings,
    start: Tables,
    out: Path,
    made_by: str,
    overwrite: bool = False,
) -> tuple[tune.Tuned, list[str]]:
    """Tune, or go on where it was stopped; the variant and its figures stand in `out`.

    Args:
        problem: what is tuned, on which scenarios.
        held_out: scenarios that no step sees.
        settings: how.
        start: tables of the variant it starts from, see `tune.variant_file`.
        out: folder.
        made_by: command, for the variant's file.
        overwrite: drop the state of another descent in the folder.
    """
    with batch.waiting("compiling, or a step under way", redraw=False):
        tuned = tune.tune(problem, held_out, out, settings, lambda line: print(line, flush=True), overwrite)
    _keep_before(out / VARIANT_FILE, text := tune.variant_file(tuned, start, made_by))
    write(out / VARIANT_FILE, text)
    files = draw(lambda _: _draw(tuned, problem.experiment.robot.name), out)
    print(
        f"held out: loss {tuned.before['loss']:.4f} -> {tuned.after['loss']:.4f}, success "
        f"{100 * tuned.before['success']:.1f} -> {100 * tuned.after['success']:.1f} %; {tuned.descent.finished}"
    )
    for t, old, new in zip(problem.tunables, problem.start, tuned.values, strict=True):
        print(f"{t.name:36s} {old:10.4f} -> {new:10.4f} {t.unit}")
    return tuned, files


def _draw(tuned: tune.Tuned, name: str) -> dict[str, Any]:
    from jaxbiped.report import descents

    history, ts = tuned.descent.history, tuned.problem.tunables
    names, ranges = [t.name for t in ts], [(t.low, t.high) for t in ts]
    return {
        "loss": descents.loss_curve(history, f"{name}: tuning {', '.join(names[:3])} ..."),
        "values": descents.value_curves(history, names, ranges, f"{name}: values while tuning"),
    }


def _keep_before(file: Path, text: str) -> None:
    """A variant that stands there and is another one, by more steps or by hand, is kept under another name."""
    if files.is_file(file) and file.read_text(encoding="utf-8", errors="replace") != text:
        with refusing(file, "a file that may be renamed"):
            say(f"'{file}' was another one: kept as '{files.set_aside(file, 'before').name}'")

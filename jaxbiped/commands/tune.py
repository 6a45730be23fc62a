"""`jaxbiped tune`: tune an arm's few numbers by gradients, or only say how far the gradients can be trusted."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
from tyro.conf import arg

from jaxbiped import adapt, batch, tune
from jaxbiped.batch import Choice, Uniform
from jaxbiped.commands import batches
from jaxbiped.commands.choices import (
    LANDINGS,
    MODIFIED,
    OFF,
    REFLEXES,
    REPAIRED,
    arm_tables,
    clock_start,
    landing_of,
    load_arm,
    make_gait,
    own_gait,
    reflex_of,
    simulation_options,
)
from jaxbiped.commands.common import InputError, figures_module, load_robot, make_writable, refusing

WHAT_HELP = "What to tune: a stage (payload, landing), or names such as payload.settling_time, landing.T_mod, gait.b_s."
BASES = {"payload": REFLEXES[1:], "landing": LANDINGS[1:]}
LIGHTEST, HEAVIEST = 0.02, 0.2
"""Of loads, as shares of the robot's mass."""
HIGHEST = 0.04
"""Of pads [m]."""
STEPS = {"payload": 4, "landing": 6}
HORIZON = 10.0
"""Of the walks whose gradient is taken [s]."""
ARM_FILE = "tuned.toml"
Tables = Mapping[str, Mapping[str, Any]]
"""Of the file of an arm."""
PAD_STEP = 2
"""Step under which the pads are."""


@dataclass(frozen=True)
class Tune:
    """Tune the few numbers of an adaptation by gradients over random scenarios; writes an arm that commands accept."""

    robot: str = "elkahlout"
    """Name of a preset (elkahlout, surena3) or path of a robot file (.toml)."""
    gait: Annotated[str | None, arg(metavar="polynomial|cosine")] = None
    """Default: the gait of the robot's own paper."""
    what: Annotated[tuple[str, ...], arg(help=WHAT_HELP)] = ("payload",)
    arm: Annotated[str | None, arg(metavar="original|modified|paper|repaired|FILE")] = None
    """The arm to start from: its name, or its file (.toml). Default: modified for payloads, repaired for landing."""
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
    """Folder of the arm, the figures and the state; a descent that was stopped goes on."""
    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Tune) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    figures_module()
    for name, least in (("scenarios", 2), ("batch", 2), ("steps", 1)):
        if getattr(command, name) < least:
            raise InputError(f"--{name}: got {getattr(command, name)}, allowed: >= {least}")
    with refusing(command.out, "a folder that can be made and written"):
        make_writable(command.out)
    with jax.enable_x64(command.x64 or command.trust_only):
        problem, held_out, start = set_up(command)
        return _trust(command, problem) if command.trust_only else _descend(command, problem, held_out, start)


def set_up(command: Tune) -> tuple[tune.Problem, batch.Experiment, Tables]:
    """The problem, the scenarios held out, and the tables of the arm it starts from."""
    params = load_robot("--robot", command.robot)
    stages = {name.split(".")[0] for name in command.what} & set(BASES) or {"payload"}
    gait = make_gait(params, command.gait or own_gait(params), max(STEPS[s] for s in stages))
    start, arm = _start(command, params, gait, stages)
    made = [
        batches.experiment(
            params,
            {command.arm or "tuned": arm},
            _scenarios(command, params, arm.gait, stages, command.seed + 1000 * held),
            simulation_options(params, arm.gait),
            duration=horizon if command.duration is None else command.duration,
            seed=command.seed,
        )
        for held, horizon in ((0, HORIZON), (1, None))
    ]
    try:
        return tune.Problem.of(made[0], command.what), made[1], start
    except ValueError as error:
        raise InputError(f"--what: {error}") from None


def _start(command: Tune, params: Any, gait: Any, stages: set[str]) -> tuple[Tables, adapt.Controller]:
    """The arm it starts from: its tables and the controller."""
    if command.arm and command.arm.endswith(".toml"):
        path = Path(command.arm)
        return arm_tables("--arm", path), load_arm("--arm", path, params, gait)
    defaults = {"payload": MODIFIED, "landing": REPAIRED}
    base = {stage: command.arm or defaults[stage] for stage in stages}
    for stage, name in base.items():
        if name not in BASES[stage]:
            raise InputError(
                f"--arm: got '{name}', allowed: {', '.join(BASES[stage])} for {stage}, or a file that ends in .toml"
            )
    arm = adapt.Controller(
        gait,
        landing=landing_of(base.get("landing", OFF)),
        payload=reflex_of(base.get("payload", OFF), params, gait),
    )
    return {stage: {"base": name} for stage, name in base.items()}, arm


def _scenarios(command: Tune, params: Any, gait: Any, stages: set[str], seed: int) -> Any:
    ranges: dict[str, Any] = {}
    if "payload" in stages:
        start = clock_start(gait)
        last = float(gait.timing.first_liftoff) + 1.5 * float(gait.timing.T_c)
        mass = float(params.total_mass)
        ranges["load_kg"] = Uniform(LIGHTEST * mass, HEAVIEST * mass)
        ranges["load_time_s"] = Uniform(start + 0.1, last)
    if "landing" in stages:
        heights = np.round(np.linspace(-HIGHEST, HIGHEST, 17), 4)
        ranges[batch.height_column(PAD_STEP)] = Choice(tuple(float(h) for h in heights if abs(h) > 1e-3))
    return batch.draw(command.scenarios, seed, friction=Uniform(0.6, 1.0), **ranges)


def _trust(command: Tune, problem: tune.Problem) -> dict[str, Any]:
    rows = np.arange(problem.experiment.table.height)
    report = tune.trust_report(problem, problem.start, rows, seed=command.seed, timed=True)
    print("\n".join(report.lines()))
    return {k: _plain(v) for k, v in report.record().items()}


def _descend(
    command: Tune, problem: tune.Problem, held_out: batch.Experiment, start: Tables
) -> dict[str, Any]:
    settings = tune.Settings(steps=command.steps, scenarios=command.batch, seed=command.seed)
    made_by = f"jaxbiped tune --robot {command.robot} --what {' '.join(command.what)}"
    made_by += f" --arm {command.arm}" if command.arm else ""
    try:
        tuned, files = descend(problem, held_out, settings, start, command.out, made_by)
    except ValueError as error:
        raise InputError(f"--{error}") from None
    path = command.out / ARM_FILE
    print(f"{path} is an arm: jaxbiped {'payload' if 'payload' in start else 'obstacles'} --arm {path}")
    values = {t.name: float(v) for t, v in zip(problem.tunables, tuned.values, strict=True)}
    return {"tuned": values, "before": tuned.before, "after": tuned.after, "arm": str(path), "files": files}


def descend(
    problem: tune.Problem,
    held_out: batch.Experiment,
    settings: tune.Settings,
    start: Tables,
    out: Path,
    made_by: str,
) -> tuple[tune.Tuned, list[str]]:
    """Tune, or go on where it was stopped; the arm and its figures stand in `out`.

    Args:
        problem: what is tuned, on which scenarios.
        held_out: scenarios that no step sees.
        settings: how.
        start: tables of the arm it starts from, see `tune.arm_file`.
        out: folder.
        made_by: command, for the arm's file.
    """
    tuned = tune.tune(problem, held_out, out, settings, lambda line: print(line, flush=True))
    (out / ARM_FILE).write_text(tune.arm_file(tuned, start, made_by), encoding="utf-8")
    files = batches.save(figures_module(), _draw(tuned, problem.experiment.robot.name), out)
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


def _plain(value: Any) -> Any:
    """For JSON, which has no NaN."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return [_plain(v) for v in value] if isinstance(value, list) else value

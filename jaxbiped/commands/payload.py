"""`jaxbiped payload`: loads by loading times, with every variant of the reflex; the thesis' tables in the small."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import polars as pl
from tyro.conf import arg

from jaxbiped import batch, sim
from jaxbiped.commands import batches
from jaxbiped.commands.choices import (
    ALLOW_HELP,
    GAIT_NAMES,
    gait_name,
    make_gait,
)
from jaxbiped.commands.common import InputError, draw, load_robot
from jaxbiped.sim.scenario import RANGES

FIGURES = ("payload_success.png", "payload_pitch.png")
LATEST = 60.0
"""Of loading times [s]."""
STEPS_AFTER = 4
"""Steps planned after the one of the last loading: the rest of it, the one after the recovery, and two whole ones."""
LOADS_HELP = "Masses of the load in kg. Example: 2.5 5"
TIMES_HELP = (
    "When it is put on, in s on the gait's own clock: the thesis' time, which begins T_ini after the start, "
    "for the cosine gait; since the start of the walk for the polynomial one."
)
VARIANT_HELP = (
    "Variants of the payload reflex: off, original, modified, repaired, or files of tuned variants (.toml)."
)


@dataclass(frozen=True)
class Payload:
    """Put loads on a walking robot that does not know of them: every load at every time, with every variant."""

    robot: str = "elkahlout"
    """Name of a preset (elkahlout, surena3) or path of a robot file (.toml)."""
    gait: Annotated[str | None, arg(metavar=GAIT_NAMES)] = None
    """Default: the gait of the robot's own paper."""
    variant: Annotated[tuple[str, ...], arg(help=VARIANT_HELP)] = ("off", "original", "modified")
    loads: Annotated[tuple[float, ...], arg(help=LOADS_HELP)] = (2.5, 5.0, 7.5, 10.0, 12.5, 15.0)
    times: Annotated[tuple[float, ...], arg(help=TIMES_HELP)] = (0.3, 0.6, 0.9, 1.2, 1.5, 1.8, 2.1, 2.4)
    friction: float | None = None
    """Of the floor. Default: 0.8; for elkahlout's cosine walk that of the thesis' experiments, which is slippery."""
    steps: int | None = None
    """Steps of the walk. Default: enough to complete two after the last recovery."""
    allow_infeasible: Annotated[bool, arg(help=ALLOW_HELP)] = False
    workers: Annotated[int | None, arg(help=batches.WORKERS_HELP)] = None
    scheduler: Annotated[str | None, arg(help=batches.SCHEDULER_HELP)] = None
    batch: Annotated[int | None, arg(help=batches.BATCH_HELP)] = None
    seed: int = 0
    """Of the sensors' noise."""
    out: Path = Path("runs/payload")
    """Folder of the table and the figures; what is finished in it is not walked again."""
    overwrite: Annotated[bool, arg(help=batches.OVERWRITE_HELP)] = False
    dry_run: Annotated[bool, arg(help=batches.DRY_RUN_HELP)] = False
    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Payload) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    out = command.out
    batches.check(command)
    with batch.waiting("planning"):
        experiment, start = set_up(command)
    if command.dry_run:
        return batches.dry_run(experiment, command, FIGURES)
    table = batches.walk(experiment, command, FIGURES)
    print("\n".join(_ticks(table, start)))
    print("\n".join([*batches.rates(table), *batches.again(table, out)]), flush=True)
    files = draw(lambda _: _draw(table, experiment.robot.name, start), out)
    print(f"table.parquet and {len(files)} figures in {out}")
    return {"cells": cells(table, start), "table": str(out / "table.parquet"), "files": files}


def set_up(command: Payload) -> tuple[batch.Experiment, float]:
    """The experiment, and when the clock of its times starts [s]."""
    params = load_robot("--robot", command.robot)
    loads = batches.numbers("--loads", command.loads, "kg", 0.0, float(params.total_mass))
    times = batches.numbers("--times", command.times, "s", 0.0, LATEST)
    name = gait_name(command.gait, params)
    gait = make_gait(params, name, 1, allow_infeasible=True)  # only its clock is read
    since_liftoff = max(times) + float(gait.clock_start) - float(gait.timing.first_liftoff)
    last = max(0, math.floor(since_liftoff / float(gait.timing.T_c)))
    steps = last + 1 + STEPS_AFTER if command.steps is None else command.steps
    gait = make_gait(params, name, steps, command.allow_infeasible)
    start = float(gait.clock_start)
    if max(times) + start > float(gait.duration):
        raise InputError(
            f"--times: got {max(times):g} s, allowed: up to {float(gait.duration) - start:.4g} s with {steps} steps"
        )
    variants = batches.variants(command.variant, "payload", params, gait, command.allow_infeasible)
    options: sim.Options = sim.own_options(params, gait)
    friction = sim.own_friction(params, gait) if command.friction is None else command.friction
    (friction,) = batches.numbers(
        "--friction", (friction,), "", RANGES["friction"].low, RANGES["friction"].high
    )
    scenarios = batch.grid(load_kg=loads, load_time_s=[start + time for time in times], friction=[friction])
    made = batches.experiment(params, variants, scenarios, options, seed=command.seed, batch=command.batch)
    return made, start


def cells(table: pl.DataFrame, start: float) -> list[dict[str, Any]]:
    """One object for every walk; times on the gait's own clock."""
    return [
        {
            "variant": row["variant"],
            "load_kg": row["load_kg"],
            "time_s": round(row["load_time_s"] - start, 6),
            "success": row["success"],
            "status": row["status"],
            "trigger_s": None if row["trigger_s"] is None else round(row["trigger_s"] - start, 4),
            "peak_pitch_deg": batches.number_or_none(row["peak_pitch_deg"]),
        }
        for row in table.iter_rows(named=True)
    ]


def _ticks(table: pl.DataFrame, start: float) -> list[str]:
    from jaxbiped.report import tables

    by_variant = table.partition_by("variant", maintain_order=True)
    return [tables.tick_table(walks, start) for walks in by_variant if (walks["load_kg"] > 0.0).any()]


def _draw(table: pl.DataFrame, name: str, start: float) -> dict[str, Any]:
    from jaxbiped.report import grids

    what = f"{name}: loads put on while it walks"
    both = {"x": "load_kg", "y": "load_time_s", "offset_s": start}
    return {
        "payload_success": grids.heat_map(table, title=what, **both),
        "payload_pitch": grids.heat_map(table, title=what, value="peak_pitch_deg", **both),
    }

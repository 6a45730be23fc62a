"""`jaxbiped payload`: loads by loading times, with every variant of the reflex; the thesis' tables in the small."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import polars as pl
from tyro.conf import arg

from jaxbiped import batch
from jaxbiped.batch.recipes import LOADS, TIMES
from jaxbiped.commands import batches
from jaxbiped.commands.choices import ALLOW_HELP, GAIT_NAMES
from jaxbiped.commands.common import draw

FIGURES = ("payload_success.png", "payload_pitch.png")
LOADS_HELP = "Masses of the load in kg. Example: 2.5 5"
TIMES_HELP = (
    "When it is put on, in s on the gait's own clock: the thesis' time, which begins T_ini after the start, "
    "for the cosine gait; since the start of the walk for the polynomial one."
)
VARIANT_HELP = (
    "Variants of the reflex: off, original, modified, repaired, two_speed, or files of tuned ones (.toml)."
)


@dataclass(frozen=True)
class Payload:
    """Put loads on a walking robot that does not know of them: every load at every time, with every variant."""

    robot: str = "elkahlout"
    """Name of a preset (elkahlout, surena3) or path of a robot file (.toml)."""
    gait: Annotated[str | None, arg(metavar=GAIT_NAMES)] = None
    """Default: the gait of the robot's own paper."""
    variant: Annotated[tuple[str, ...], arg(help=VARIANT_HELP)] = ("off", "original", "modified")
    loads: Annotated[tuple[float, ...], arg(help=LOADS_HELP)] = LOADS
    times: Annotated[tuple[float, ...], arg(help=TIMES_HELP)] = TIMES
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
    files = draw(lambda _: _figures(table, experiment, start), out)
    print(f"table.parquet and {len(files)} figures in {out}")
    return {"cells": cells(table, start), "table": str(out / "table.parquet"), "files": files}


def set_up(command: Payload) -> tuple[batch.Experiment, float]:
    """The experiment, and when the clock of its times starts [s]."""
    with batches.naming_arguments():
        experiment = batch.recipes.payload(
            command.robot,
            command.gait,
            command.variant,
            command.loads,
            command.times,
            command.friction,
            command.steps,
            command.allow_infeasible,
            command.seed,
            command.batch,
        )
    return experiment, float(next(iter(experiment.variants.values())).gait.clock_start)


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


def _figures(table: pl.DataFrame, experiment: batch.Experiment, start: float) -> dict[str, Any]:
    from jaxbiped.report import pages

    return pages.payload(table, experiment.robot.name, start)

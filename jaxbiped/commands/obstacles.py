"""`jaxbiped obstacles`: obstacles and holes of every height under one step, with every variant of the landing."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import polars as pl
from tyro.conf import arg

from jaxbiped import batch
from jaxbiped.batch.recipes import HEIGHTS
from jaxbiped.commands import batches
from jaxbiped.commands.choices import ALLOW_HELP, GAIT_NAMES, LANDINGS
from jaxbiped.commands.common import draw

FIGURES = ("obstacles.png",)
HEIGHTS_HELP = "Heights of the pad in m, negative for a hole. Example: 0.02 -0.02"
VARIANT_HELP = "Variants of the landing adaptation: off, paper, repaired, or files of tuned variants (.toml)."


@dataclass(frozen=True)
class Obstacles:
    """Walk over a pad or a hole that the robot does not know of, of every height, with every variant."""

    robot: str = "surena3"
    """Name of a preset (elkahlout, surena3) or path of a robot file (.toml)."""
    gait: Annotated[str | None, arg(metavar=GAIT_NAMES)] = None
    """Default: the gait of the robot's own paper."""
    variant: Annotated[tuple[str, ...], arg(help=VARIANT_HELP)] = LANDINGS
    heights: Annotated[tuple[float, ...], arg(help=HEIGHTS_HELP)] = HEIGHTS
    step: tuple[int, ...] = (4,)
    """Steps under whose footholds the pads are, 0 for the first; each has a pad of the same height."""
    steps: int = 8
    """Steps of the walk."""
    allow_infeasible: Annotated[bool, arg(help=ALLOW_HELP)] = False
    workers: Annotated[int | None, arg(help=batches.WORKERS_HELP)] = None
    scheduler: Annotated[str | None, arg(help=batches.SCHEDULER_HELP)] = None
    batch: Annotated[int | None, arg(help=batches.BATCH_HELP)] = None
    seed: int = 0
    """Of the sensors' noise."""
    out: Path = Path("runs/obstacles")
    """Folder of the table and the figures; what is finished in it is not walked again."""
    overwrite: Annotated[bool, arg(help=batches.OVERWRITE_HELP)] = False
    dry_run: Annotated[bool, arg(help=batches.DRY_RUN_HELP)] = False
    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Obstacles) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    out = command.out
    batches.check(command)
    with batch.waiting("planning"):
        experiment = set_up(command)
    if command.dry_run:
        return batches.dry_run(experiment, command, FIGURES)
    table = batches.walk(experiment, command, FIGURES)
    print("\n".join(_lines(table, command.step[0])))
    print("\n".join([*batches.rates(table), *batches.again(table, out)]), flush=True)
    files = draw(lambda _: _draw(table, experiment.robot.name, command.step[0]), out)
    print(f"table.parquet and {len(files)} figures in {out}")
    return {"cells": cells(table, command.step[0]), "table": str(out / "table.parquet"), "files": files}


def set_up(command: Obstacles) -> batch.Experiment:
    """The experiment."""
    with batches.naming_arguments():
        return batch.recipes.obstacles(
            command.robot,
            command.gait,
            command.variant,
            command.heights,
            command.step,
            command.steps,
            command.allow_infeasible,
            command.seed,
            command.batch,
        )


def cells(table: pl.DataFrame, step: int) -> list[dict[str, Any]]:
    """One object for every walk."""
    return [
        {
            "variant": row["variant"],
            "height_m": row[batch.height_column(step)],
            "success": row["success"],
            "status": row["status"],
            "end_time_s": round(row["end_time_s"], 4),
            "peak_foot_force_N": batches.number_or_none(peak_force(row), 1),
            "peak_roll_deg": batches.number_or_none(row["peak_roll_deg"]),
            "peak_pitch_deg": batches.number_or_none(row["peak_pitch_deg"]),
        }
        for row in table.iter_rows(named=True)
    ]


def peak_force(row: dict[str, Any]) -> float:
    """Largest vertical force on either foot [N]."""
    return max(row["peak_force_left_N"], row["peak_force_right_N"])


def _lines(table: pl.DataFrame, step: int) -> list[str]:
    by_variant = {walks["variant"][0]: walks for walks in table.partition_by("variant", maintain_order=True)}
    lines = [f"{'height':>8}  " + "".join(f"{variant:<18}" for variant in by_variant)]
    for i, height in enumerate(next(iter(by_variant.values()))[batch.height_column(step)]):
        rows = [walks.row(i, named=True) for walks in by_variant.values()]
        words = [
            f"{peak_force(r):,.0f} N" if r["success"] else f"{r['status']} {r['end_time_s']:.1f} s"
            for r in rows
        ]
        lines.append(f"{100 * height:>+5g} cm  " + "".join(f"{word:<18}" for word in words))
    return lines


def _draw(table: pl.DataFrame, name: str, step: int) -> dict[str, Any]:
    from jaxbiped.report import pages

    return pages.obstacles(table, name, step)

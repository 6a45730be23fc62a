"""`jaxbiped replay`: one row of a results table again, with its trace, figures and, if asked for, a moving picture."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from jaxbiped import batch, files, sim
from jaxbiped.batch import part
from jaxbiped.batch.columns import outcomes as columns_of
from jaxbiped.batch.experiment import Chunk
from jaxbiped.commands import walk
from jaxbiped.commands.common import (
    OVERWRITE_HELP,
    InputError,
    figures_or_word,
    refusing,
    require_folder,
    say,
    whole,
)
from jaxbiped.commands.walk_input import Setup, of_row
from jaxbiped.sim.compile import backend
from jaxbiped.sim.options import C

TOLERANCE = {"_s": 0.05, "_deg": 0.5, "_N": 60.0, "_Ns": 3.0, "_m": 5e-3}
"""Largest difference of a number of one walk from its table's, where the walk was one of many [of the unit].

Float32 rounds differently in batches of other sizes, and walking amplifies that."""


@dataclass(frozen=True)
class Replay:
    """Walk one row of a results table again, tell, draw, and say if it does not agree with the table."""

    table: Annotated[Positional[Path], arg(metavar="TABLE")]
    """Folder that a batch was run in, or the table.parquet in it."""
    row: Annotated[Positional[int], arg(metavar="ROW")]
    """Number of the row."""
    out: Path | None = None
    """Folder of walk.json and the figures. Default: replay-ROW in the table's folder."""
    video: bool = False
    """Draw a moving picture too (walk.gif)."""
    overwrite: Annotated[bool, arg(help=OVERWRITE_HELP)] = False
    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Replay) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    number = whole("row", command.row, 0, 10**9)
    folder = command.table.parent if files.is_file(command.table) else command.table
    out = command.out or folder / f"replay-{number}"
    require_folder(out)
    try:
        experiment, table = batch.open_table(command.table, say)
    except batch.StoreError as error:
        raise InputError(str(error)) from None
    found = table.filter(table["row"] == number)
    if found.height != 1:
        raise InputError(f"row: got {command.row}, allowed: 0 to {experiment.rows - 1}, finished ones")
    row = found.row(0, named=True)
    setup = of_row(experiment, row)
    walk.claim(setup, out, command.overwrite)
    one = walk.simulate(setup)
    result = walk.tell(setup, one, out)
    drawn = outcome(one, setup)
    is_in_c = experiment.simulation.backend == C and backend.serves(experiment.simulation)
    now = in_c(experiment, row, list(drawn)) if is_in_c else drawn
    different = differences(row, now)
    for name, (before, after) in different.items():
        print(f"differs from the table: {name} was {before}, is {after}")
    print(f"row {command.row}: {'does not agree' if different else 'agrees'} with the table")
    elsewhere = differences(now, drawn)
    if elsewhere:
        print(
            f"(the walk drawn is XLA's, which rounds otherwise than C; they differ in {', '.join(elsewhere)})"
        )
    if command.video and one.trace is not None and figures_or_word() is not None:
        from jaxbiped.report import movie

        with refusing(out, "a place that can be written, with room for the movie; the numbers are kept"):
            file = movie.save(experiment.robot, one.trace, out / walk.MOVIE, setup.scenario.terrain)
        result["files"].append(str(file))
    print(f"{walk.NUMBERS} and {len(result['files'])} figures in {out}")
    return {"row": command.row, "agrees": not different, "differences": different, **result}


def outcome(one: sim.Walk, setup: Setup) -> dict[str, Any]:
    """The row of a results table for this walk."""
    said = part.outcome_of(one, setup.controller, setup.scenario)
    columns = {name: np.asarray(value)[None] for name, value in said.items()}
    return part.outcome_frame(columns, columns_of([setup.controller])).row(0, named=True)


def in_c(experiment: batch.Experiment, row: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """Columns of a row walked again by the machine code of its batch, whose lanes do not depend on each other."""
    scenario = row["scenario"]
    chunk = Chunk(0, row["variant"], scenario, scenario + 1, 0)
    again = part.walk_chunk(experiment, chunk).row(0, named=True)
    return {name: again[name] for name in names}


def differences(then: dict[str, Any], now: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Columns that differ by more than TOLERANCE; of a walk that ended in a fall, only how and when."""
    names = ["status", "success", "finished", "reflexes", "trigger_s", "end_time_s"]
    if then["status"] in ("ok", "unfinished"):
        names = list(now)
    return {name: (then[name], now[name]) for name in names if not _close(name, then[name], now[name])}


def _close(name: str, then: object, now: object) -> bool:
    if not isinstance(then, float) or not isinstance(now, float):
        return then == now
    allowed = TOLERANCE[f"_{name.rpartition('_')[2]}"]
    return (
        abs(then - now) <= max(allowed, 0.02 * abs(then))
        or then == now
        or (math.isnan(then) and math.isnan(now))
    )

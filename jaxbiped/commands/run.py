"""`jaxbiped run`: an experiment from a TOML file, see `batch.experiment_file`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import polars as pl
from tyro.conf import Positional, arg

from jaxbiped import batch
from jaxbiped.batch import summary
from jaxbiped.checked import Refusal
from jaxbiped.commands import batches
from jaxbiped.commands.common import InputError, figures_module, figures_or_word, refusing


@dataclass(frozen=True)
class Run:
    """Run an experiment from a file: a robot, a gait, variants of adaptation, and the scenarios all of them meet."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The experiment (.toml), see docs/batch.md."""
    out: Path
    """Folder of the table and the figures; what is finished in it is not simulated again."""
    workers: Annotated[int | None, arg(help=batches.WORKERS_HELP)] = None
    scheduler: Annotated[str | None, arg(help=batches.SCHEDULER_HELP)] = None
    overwrite: Annotated[bool, arg(help=batches.OVERWRITE_HELP)] = False
    dry_run: Annotated[bool, arg(help=batches.DRY_RUN_HELP)] = False
    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Run) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    batches.check_place(command)
    with batch.waiting("planning"):
        experiment = _read(command.file)
    files = _files(experiment)
    if command.dry_run:
        return batches.dry_run(experiment, command, files)
    table = batches.walk(experiment, command, files)
    print("\n".join([*batches.rates(table), *batches.again(table, command.out)]), flush=True)
    drawn = _draw(experiment, table, command.out)
    print(f"table.parquet and {len(drawn)} of {len(files)} pages and figures in {command.out}")
    return {
        "variants": summary.cells(table).to_dicts(),
        "table": str(command.out / "table.parquet"),
        "files": drawn,
    }


def _read(file: Path) -> batch.Experiment:
    try:
        return batch.read_experiment(file)
    except Refusal as error:
        raise InputError(str(error)) from None


def _files(experiment: batch.Experiment) -> list[str]:
    """Names of the files that will be drawn; none without the packages that draw."""
    if figures_module() is None:
        return []
    from jaxbiped.report import pages

    return [file for name in experiment.pages for file in pages.FILES[name]]


def _draw(experiment: batch.Experiment, table: pl.DataFrame, out: Path) -> list[str]:
    if figures_or_word() is None:
        return []
    from jaxbiped.report import pages

    with refusing(out, "a place that can be written, with room for the figures; the numbers are kept"):
        return pages.write(experiment, table, out)

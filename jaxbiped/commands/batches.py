"""Shared parts of the commands that walk batches: their arguments, their run, their tables and pages."""

import contextlib
import math
import shlex
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import polars as pl

from jaxbiped import batch
from jaxbiped.batch import columns, progress, recipes, store, summary
from jaxbiped.batch.experiment import MAX_BATCH
from jaxbiped.batch.run import MAX_WORKERS
from jaxbiped.checked import Refusal
from jaxbiped.commands.common import InputError, make_writable, require_folder, require_free, say, whole
from jaxbiped.planner.constraints import OR_ALLOW

WORKERS_HELP = "Processes; 1 walks in this one. Default: one for each core, or for each GPU."
SCHEDULER_HELP = "Address of a Dask scheduler (tcp://host:port) whose workers are to walk instead."
BATCH_HELP = "Walks simulated at once; other sizes round differently. Default: up to 128."
OVERWRITE_HELP = (
    "Drop what another experiment left in the folder. Without it nothing is ever replaced or deleted; what this very "
    "experiment left is kept in any case."
)
DRY_RUN_HELP = "Only say what would be done: walks, chunks, memory of a worker, time. Touches nothing."


class WorkersLost(RuntimeError):
    """The workers are gone; what they finished is kept."""


@runtime_checkable
class Place(Protocol):
    """Arguments that say where and how a batch is run."""

    @property
    def out(self) -> Path: ...  # noqa: D102
    @property
    def workers(self) -> int | None: ...  # noqa: D102
    @property
    def scheduler(self) -> str | None: ...  # noqa: D102
    @property
    def overwrite(self) -> bool: ...  # noqa: D102


@runtime_checkable
class Command(Place, Protocol):
    """Arguments of a command that runs a batch of its own."""

    @property
    def batch(self) -> int | None: ...  # noqa: D102
    @property
    def seed(self) -> int: ...  # noqa: D102


def check(command: Command) -> None:
    """Refuse what can be refused without any work: numbers, addresses, the folder.

    Raises:
        InputError: naming the argument, what was got and what is allowed.
    """
    if command.batch is not None:
        whole("--batch", command.batch, 1, MAX_BATCH)
    whole("--seed", command.seed, 0, 2**31 - 1)
    check_place(command)


def check_place(command: Place) -> None:
    """Refuse workers that cannot be, and a folder that cannot be written, without any work; as `check`."""
    if command.workers is not None:
        whole("--workers", command.workers, 1, MAX_WORKERS)
    if command.scheduler is not None:
        try:
            batch.require_address(command.scheduler)
        except ValueError as error:
            raise InputError(_as_argument(str(error))) from None
    require_folder(command.out)


def numbers(argument: str, values: Iterable[float], unit: str, low: float, high: float) -> list[float]:
    """Values of an argument, each once, each within its range."""
    try:
        return recipes.numbers(argument, values, unit, low, high)
    except Refusal as error:
        raise InputError(str(error)) from None


def walk(experiment: batch.Experiment, command: Place, figures: Iterable[str] = ()) -> pl.DataFrame:
    """Run an experiment for a command: with progress, and with refusals that name the arguments.

    Args:
        experiment: what to simulate.
        command: where and how.
        figures: names of the files that will be drawn into the folder, which must not be somebody else's.
    """
    claim(experiment, command, figures)
    make_writable(command.out)
    try:
        return batch.run(
            experiment,
            command.out,
            command.workers,
            command.scheduler,
            command.overwrite,
            batch.show(),
            say,
        )
    except (batch.StoreError, ValueError) as error:
        raise InputError(_as_argument(str(error))) from None
    except batch.WorkersError as error:
        raise WorkersLost(
            f"{error}; what was finished is kept in '{command.out}', run the same command again"
        ) from None


def claim(experiment: batch.Experiment, command: Place, figures: Iterable[str] = ()) -> None:
    """Refuse a folder that holds something else; nothing is touched."""
    there = store.Store(command.out, experiment, command.overwrite)
    try:
        there.require_usable()
    except batch.StoreError as error:
        raise InputError(_as_argument(str(error))) from None
    require_free(command.out, figures, there.ours, command.overwrite)


def experiment(*given: Any, **named: Any) -> batch.Experiment:  # noqa: ANN401
    """Make an experiment, or refuse in the words of the command line."""
    with naming_arguments():
        return batch.Experiment(*given, **named)


@contextlib.contextmanager
def naming_arguments() -> Iterator[None]:
    """Turn a refusal of the batch room into one in the words of the command line."""
    try:
        yield
    except ValueError as error:
        raise InputError(_as_argument(str(error))) from None


def dry_run(experiment: batch.Experiment, command: Place, figures: Iterable[str] = ()) -> dict[str, Any]:
    """Say what a run would do, or refuse what it would refuse; touches nothing."""
    claim(experiment, command, figures)
    try:
        plan = batch.plan(experiment, command.out, command.workers, command.overwrite)
    except ValueError as error:
        raise InputError(_as_argument(str(error))) from None
    print(
        f"{plan.walks} walks: {plan.scenarios} scenarios with each of {plan.variants} variants, "
        f"{plan.simulated_s:,.0f} s of walking\n{plan.chunks} chunks of {plan.chunk_rows} walks, "
        f"{plan.chunks_done} done already; "
        f"{plan.workers} {'worker' if plan.workers == 1 else 'workers'} of about "
        f"{plan.memory_per_worker_MiB:,.0f} MiB; about {progress.duration(plan.wall_time_s)}"
        + "".join(f"\ndamaged, to be set aside and made again: {file}" for file in plan.damaged)
    )
    return {"plan": asdict(plan)}


def rates(table: pl.DataFrame) -> list[str]:
    """Success of every variant in words, with its 95 % interval, and against the first variant."""
    lines, names = [], summary.variants(table)
    late = table.filter(pl.col("success") & pl.col("status").is_in(columns.FAILED))
    for row in summary.cells(table).iter_rows(named=True):
        fell = late.filter(pl.col("variant") == row["variant"]).height
        lines.append(
            f"{row['variant']}: {row['successes']} of {row['n']} succeed ({row['rate']:.1%}, 95 % interval "
            f"{row['low']:.1%} to {row['high']:.1%})"
            + (f"; {fell} of them {'falls' if fell == 1 else 'fall'} after that" if fell else "")
        )
    for name in names[1:]:
        one = summary.paired(table, name, names[0])
        lines.append(
            f"{name} against {names[0]}: {one.only_first} more, {one.only_second} fewer of the same {one.n} scenarios"
        )
    return lines


def again(table: pl.DataFrame, out: Path) -> list[str]:
    """Words on how to see the first walk that failed, if any did."""
    failed = table.filter(~pl.col("success") | pl.col("status").is_in(columns.FAILED))
    if failed.is_empty():
        return []
    rows = ", ".join(map(str, failed["row"].head(8))) + (", ..." if failed.height > 8 else "")
    return [
        f"{failed.height} {'walk fails' if failed.height == 1 else 'walks fail'} (rows {rows}); to see one: "
        f"jaxbiped replay {shlex.quote(str(out))} {failed['row'][0]}"
    ]


def number_or_none(value: float | None, digits: int = 4) -> float | None:
    """A rounded number for JSON; None for what is not finite."""
    return None if value is None or not math.isfinite(value) else round(value, digits)


_ARGUMENTS = (
    *("out", "workers", "batch", "seed", "scheduler", "robot", "gait", "steps", "step"),
    *("loads", "times", "heights", "friction"),
)
_RENAMED = {**{name: f"--{name}" for name in _ARGUMENTS}, "variants": "--variant"}
"""Names of the batch room and its recipes, and the arguments that stand for them."""


def _as_argument(text: str) -> str:
    """A refusal of the batch room in the words of the command line."""
    name, colon, rest = text.replace(OR_ALLOW, "; or say --allow-infeasible").partition(":")
    names = name.split(", ")
    known = all(part in _RENAMED for part in names)
    return f"{', '.join(_RENAMED[part] for part in names)}{colon}{rest}" if known else f"{name}{colon}{rest}"

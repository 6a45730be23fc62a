"""What the commands that walk batches share: their arguments, their run, their tables and pages."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import polars as pl

from jaxbiped import adapt, batch, robot
from jaxbiped.batch import summary
from jaxbiped.commands.choices import landing_of, load_arm, reflex_of
from jaxbiped.commands.common import InputError

WORKERS_HELP = "Processes; 1 walks in this one. Default: one for each core, or for each GPU."
SCHEDULER_HELP = "Address of a Dask scheduler (tcp://host:port) whose workers are to walk instead."
BATCH_HELP = "Walks simulated at once; other sizes round differently. Default: up to 128."
OVERWRITE_HELP = "Drop what another experiment left in the folder."
DRY_RUN_HELP = "Only say what would be done: walks, chunks, memory of a worker, time."


class WorkersLost(RuntimeError):
    """The workers are gone; what they finished is kept."""


def numbers(argument: str, values: Iterable[float], unit: str, low: float, high: float) -> list[float]:
    """Values of an argument, each once, each within its range."""
    found = list(values)
    if not found:
        raise InputError(f"{argument}: got no value, allowed: one or more from {low:g} to {high:g} {unit}")
    for value in found:
        if not (math.isfinite(value) and low <= value <= high):
            raise InputError(f"{argument}: got {value:g} {unit}, allowed: {low:g} to {high:g} {unit}")
    if len(set(found)) < len(found):
        raise InputError(f"{argument}: got a value twice, allowed: each once")
    return found


def landing_arms(
    names: Iterable[str], allowed: tuple[str, ...], params: robot.RobotParams, gait: Any
) -> dict:
    """Controllers with landing adaptation by the names of their arms, or by TOML files."""
    return _arms(names, allowed, params, gait, lambda n: adapt.Controller(gait, landing=landing_of(n)))


def reflex_arms(names: Iterable[str], allowed: tuple[str, ...], params: robot.RobotParams, gait: Any) -> dict:
    """Controllers with a payload reflex by the names of their arms, or by TOML files."""
    return _arms(
        names, allowed, params, gait, lambda n: adapt.Controller(gait, payload=reflex_of(n, params, gait))
    )


def _arms(names: Iterable[str], allowed: tuple[str, ...], params: Any, gait: Any, make: Any) -> dict:
    found: dict[str, adapt.Controller] = {}
    for name in names:
        if name in found:
            raise InputError(f"--arm: got '{name}' twice, allowed: each once")
        if name.endswith(".toml"):
            found[name] = load_arm("--arm", Path(name), params, gait)
        elif name in allowed:
            found[name] = make(name)
        else:
            raise InputError(
                f"--arm: got '{name}', allowed: {', '.join(allowed)}, or a file that ends in .toml"
            )
    if not found:
        raise InputError(f"--arm: got none, allowed: {', '.join(allowed)}, or a file that ends in .toml")
    return found


def walk(
    experiment: batch.Experiment, out: Path, workers: int | None, scheduler: str | None, overwrite: bool
) -> pl.DataFrame:
    """Run an experiment for a command: with progress, and with refusals that name the arguments."""
    try:
        return batch.run(experiment, out, workers, scheduler, overwrite, batch.show())
    except (batch.StoreError, ValueError) as error:
        raise InputError(_as_argument(str(error))) from None
    except batch.WorkersError as error:
        raise WorkersLost(
            f"{error}; what was finished is kept in '{out}', run the same command again"
        ) from None


def experiment(*given: Any, **named: Any) -> batch.Experiment:
    """An experiment, or a refusal."""
    try:
        return batch.Experiment(*given, **named)
    except ValueError as error:
        raise InputError(_as_argument(str(error))) from None


def dry_run(one: batch.Experiment, out: Path, workers: int | None) -> dict[str, Any]:
    """Say what a run would do."""
    try:
        plan = batch.plan(one, out, workers)
    except ValueError as error:
        raise InputError(_as_argument(str(error))) from None
    print(
        f"{plan.walks} walks: {plan.scenarios} scenarios with each of {plan.arms} arms, {plan.simulated_s:,.0f} s "
        f"of walking\n{plan.chunks} chunks of {plan.lanes} walks, {plan.chunks_done} done already; "
        f"{plan.workers} workers of about {plan.memory_per_worker_MiB:,.0f} MiB; "
        f"about {plan.wall_time_s / 60.0:.1f} min"
    )
    return {"plan": asdict(plan)}


def rates(table: pl.DataFrame) -> list[str]:
    """Success of every arm in words, with its 95 % interval, and against the first arm."""
    lines, names = [], summary.arms(table)
    for row in summary.cells(table).iter_rows(named=True):
        lines.append(
            f"{row['arm']}: {row['successes']} of {row['n']} succeed ({row['rate']:.1%}, 95 % interval "
            f"{row['low']:.1%} to {row['high']:.1%})"
        )
    for name in names[1:]:
        one = summary.paired(table, name, names[0])
        lines.append(
            f"{name} against {names[0]}: {one.only_first} more, {one.only_second} fewer of the same {one.n} scenarios"
        )
    return lines


def number_or_none(value: float | None, digits: int = 4) -> float | None:
    """For JSON, which has no NaN."""
    return None if value is None or not math.isfinite(value) else round(value, digits)


def save(figures: ModuleType, drawn: Mapping[str, Any], out: Path) -> list[str]:
    """Save figures as PNG files; returns their names."""
    return [str(figures.save(figure, out / f"{name}.png")) for name, figure in drawn.items()]


def _as_argument(text: str) -> str:
    """A refusal of the batch room in the words of the command line."""
    name, colon, rest = text.partition(":")
    known = {"out", "workers", "batch", "seed", "scheduler"}
    return f"--{name}{colon}{rest}" if name in known else text

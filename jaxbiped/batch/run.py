"""Run an experiment into a folder: what is there is kept, what is missing is walked."""

import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from jaxbiped.batch import workers as crew
from jaxbiped.batch.experiment import Experiment
from jaxbiped.batch.store import Store

TICKS_PER_SECOND = 6e4
"""Physics ticks of a walk in a second on one core, roughly; for estimates."""
COMPILE_SECONDS = 60.0
"""To compile the walks of one arm, roughly; a quarter from the cache."""
BASE_MIB, LANE_KIB = 2000.0, 40.0
"""Memory of a worker while it compiles, without its walks, and of one walk, roughly."""
BAR = 24
"""Characters of the bar of progress."""


@dataclass(frozen=True)
class Progress:
    """How far a run has got."""

    done: int
    """Walks finished, those found in the folder among them."""
    total: int
    failed: int
    """Walks that were no success, of those finished."""
    rate: float
    """Walks a second in this run."""
    seconds_left: float


@dataclass(frozen=True)
class Plan:
    """What a run is going to do, see `--dry-run`."""

    scenarios: int
    arms: int
    walks: int
    chunks: int
    chunks_done: int
    lanes: int
    """Walks in a chunk."""
    workers: int
    simulated_s: float
    """Of all walks together [s]."""
    memory_per_worker_MiB: float
    """Estimate."""
    wall_time_s: float
    """Estimate for what is left, without a cache of compiled functions."""


def run(
    experiment: Experiment,
    out: str | Path,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> pl.DataFrame:
    """Walk an experiment and return its table, which stands in the folder too.

    The table is the same, bit for bit on one kind of machine, whether it was made in one go, after any number of
    interruptions, or by any number of workers.

    Args:
        experiment: what to walk.
        out: folder; finished chunks in it are not walked again.
        workers: processes; 1 walks in this one, without Dask; None: one for each core, or for each GPU.
        scheduler: address of a Dask scheduler whose workers are to walk, instead of processes of this machine.
        overwrite: drop what another experiment left in the folder.
        progress: called after every chunk.

    Raises:
        StoreError: if the folder cannot be used.
        WorkersError: if the workers are lost; finished chunks are kept.
    """
    crew.keep_compiled_kernels()
    workers = _workers(workers)
    store = Store(Path(out), experiment, overwrite)
    missing = store.missing()
    count = _Count(experiment, store, progress or (lambda _: None))
    if missing:
        if workers == 1 and scheduler is None:
            crew.use_threads()
            done = crew.in_this_process(experiment, missing)
        else:
            done = crew.on_dask(experiment, missing, min(workers, len(missing)), scheduler)
        with closing(done):
            for chunk, rows in done:
                store.write(chunk, rows)
                count.add(rows)
    return store.finish()


def plan(experiment: Experiment, out: str | Path | None = None, workers: int | None = None) -> Plan:
    """What `run` would do, without walking; of a folder only what is finished counts."""
    workers = _workers(workers)
    done = 0
    if out is not None and (Path(out) / "experiment.json").exists():
        done = len(experiment.chunks) - len(Store(Path(out), experiment).missing())
    left = [chunk for chunk in experiment.chunks][done:]
    ticks = sum(
        experiment.lanes * experiment.durations[chunk.arm] / experiment.simulation.dt for chunk in left
    )
    compiled = len({chunk.arm for chunk in left})
    return Plan(
        scenarios=experiment.table.height,
        arms=len(experiment.arms),
        walks=experiment.rows,
        chunks=len(experiment.chunks),
        chunks_done=done,
        lanes=experiment.lanes,
        workers=workers,
        simulated_s=experiment.ticks * experiment.simulation.dt,
        memory_per_worker_MiB=BASE_MIB + experiment.lanes * LANE_KIB / 1024.0,
        wall_time_s=(ticks / TICKS_PER_SECOND + compiled * COMPILE_SECONDS) / workers if left else 0.0,
    )


def show(stream: Any = None) -> Callable[[Progress], None]:
    """Progress as one line that is written over again; nothing where the stream is no terminal."""
    stream = stream or sys.stderr
    if not stream.isatty():
        return lambda _: None

    def line(p: Progress) -> None:
        filled = round(BAR * p.done / max(p.total, 1))
        end = "\n" if p.done == p.total else ""
        stream.write(
            f"\r[{'#' * filled}{'.' * (BAR - filled)}] {p.done} of {p.total} walks, {p.failed} failed, "
            f"{p.rate:.1f} a second, {p.seconds_left:.0f} s left   {end}"
        )
        stream.flush()

    return line


class _Count:
    """Counts finished walks and tells."""

    def __init__(self, experiment: Experiment, store: Store, tell: Callable[[Progress], None]):
        self.total, self.tell, self.began, self.walked = experiment.rows, tell, time.perf_counter(), 0
        parts = [store.part(chunk) for chunk in experiment.chunks if store.part(chunk).exists()]
        found = [pl.read_parquet(part, columns=["success"]) for part in parts]
        self.done = sum(part.height for part in found)
        self.failed = sum(int((~part["success"]).sum()) for part in found)
        self._tell()

    def add(self, rows: pl.DataFrame) -> None:
        self.walked += rows.height
        self.done += rows.height
        self.failed += int((~rows["success"]).sum())
        self._tell()

    def _tell(self) -> None:
        rate = self.walked / max(time.perf_counter() - self.began, 1e-9)
        left = (self.total - self.done) / rate if rate else float("inf")
        self.tell(Progress(self.done, self.total, self.failed, rate, left))


def _workers(given: int | None) -> int:
    if given is None:
        return len(crew.gpus()) or crew.cores()
    if not 1 <= given <= 4096:
        raise ValueError(f"workers: got {given}, allowed: 1 to 4096")
    return given

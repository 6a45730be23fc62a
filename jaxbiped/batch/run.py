"""Run an experiment: what is missing in its folder is simulated, by as many processes as are asked for."""

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from jaxbiped import runtime
from jaxbiped.batch import workers as crew
from jaxbiped.batch.experiment import Chunk, Experiment
from jaxbiped.batch.progress import Progress
from jaxbiped.batch.store import Found, Store, StoreError, Tell, failures, to_stderr
from jaxbiped.checked import whole

TICKS_PER_SECOND = 6e4
"""Physics ticks of a walk in a second on one core, roughly; for estimates."""
COMPILE_SECONDS = 60.0
"""Time to compile the walks of one variant, roughly; a quarter of it from the cache [s]."""
BASE_MIB, LANE_KIB = 2000.0, 40.0
"""Memory of a worker while it compiles, without its walks, and of one walk, roughly."""
MAX_WORKERS = 4096


@dataclass(frozen=True)
class Plan:
    """Plan of a run, see `--dry-run`."""

    scenarios: int
    variants: int
    walks: int
    chunks: int
    chunks_done: int
    damaged: tuple[str, ...]
    """Files in the folder that are damaged and will be set aside, and why."""
    lanes: int
    """Walks at once."""
    chunk_rows: int
    """Walks in a chunk."""
    workers: int
    simulated_s: float
    """Simulated time of all walks together [s]."""
    memory_per_worker_MiB: float
    """Estimate of the memory of a worker [MiB]."""
    wall_time_s: float
    """Estimate of the time for what is left, without a cache of compiled functions [s]."""


def run(
    experiment: Experiment,
    out: str | Path,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: Callable[[Progress], None] | None = None,
    tell: Tell = to_stderr,
) -> pl.DataFrame:
    """Simulate an experiment and return its table, which stands in the folder too.

    The table is the same, bit for bit on one kind of machine, whether it was made in one go, after any number of
    interruptions, or by any number of workers.

    Args:
        experiment: what to simulate.
        out: folder; finished chunks in it are not simulated again.
        workers: processes; 1 simulates in this one, without Dask; None: one for each core, or for each GPU. Never more
            than there are chunks left.
        scheduler: address of a Dask scheduler whose workers are to be used, instead of processes of this machine.
        overwrite: drop what another experiment left in the folder; what this one left is kept.
        progress: called after every chunk and within it, as of `show`.
        tell: is told of every damaged file that is set aside.

    Raises:
        StoreError: if the folder cannot be used.
        WorkersError: if the workers are lost; finished chunks are kept.
    """
    crew.require_main_guard()
    out = _folder(out)
    runtime.keep_compiled_kernels()
    given = _workers(workers)
    if scheduler is not None:
        crew.require_address(scheduler)
    store = Store(out, experiment, overwrite, tell)
    found = store.open()
    missing = [chunk for chunk in experiment.chunks if chunk.number not in found.failed]
    with _counting(experiment, found, progress) as count:
        if missing:
            processes = min(given or _for_this_machine(), len(missing))
            if processes == 1 and scheduler is None:
                runtime.use_threads()
                done = crew.in_this_process(experiment, missing, count.within)
            else:
                done = crew.on_dask(experiment, missing, processes, scheduler, count.within)
            with closing(done):
                for chunk, rows in done:
                    store.write(chunk, rows)
                    count.add(chunk, rows)
    return store.finish()


def plan(
    experiment: Experiment, out: str | Path | None = None, workers: int | None = None, overwrite: bool = False
) -> Plan:
    """Plan what `run` would do, without simulating and without touching anything on the disk.

    Raises:
        StoreError: if `run` would refuse the folder.
    """
    given = _workers(workers)
    found = Found({}, {}) if out is None else Store(_folder(out), experiment, overwrite).inspect()
    left = [chunk for chunk in experiment.chunks if chunk.number not in found.failed]
    ticks = sum(
        max(experiment.lanes, chunk.stop - chunk.start)
        * experiment.durations[chunk.variant]
        / experiment.simulation.dt
        for chunk in left
    )
    compiled = len({chunk.variant for chunk in left})
    processes = min(given or _for_this_machine(), max(1, len(left)))
    return Plan(
        scenarios=experiment.table.height,
        variants=len(experiment.variants),
        walks=experiment.rows,
        chunks=len(experiment.chunks),
        chunks_done=len(found.failed),
        damaged=tuple(f"{file} ({why})" for file, why in found.damaged.items()),
        lanes=experiment.lanes,
        chunk_rows=experiment.chunk_rows,
        workers=processes,
        simulated_s=experiment.ticks * experiment.simulation.dt,
        memory_per_worker_MiB=BASE_MIB + experiment.lanes * LANE_KIB / 1024.0,
        wall_time_s=(ticks / TICKS_PER_SECOND + compiled * COMPILE_SECONDS) / processes if left else 0.0,
    )


class _Count:
    """Counts finished walks and tells."""

    def __init__(self, experiment: Experiment, found: Found, tell: Callable[[Progress], None]):
        sizes = {chunk.number: chunk.stop - chunk.start for chunk in experiment.chunks}
        self.total, self.tell, self.began = experiment.rows, tell, time.perf_counter()
        self.done, self.failed = sum(sizes[n] for n in found.failed), sum(found.failed.values())
        self.chunks, self.walked, self.first = 0, 0, (0, 0.0)
        self.under_way: dict[int, float] = {}
        self.measured = 0.0  # when the last chunk was finished: rates are those of whole chunks
        self._tell()

    def within(self, chunk: Chunk, fraction: float) -> None:
        """Take note of how much of a chunk is done."""
        self.under_way[chunk.number] = fraction * (chunk.stop - chunk.start)
        self._tell()

    def add(self, chunk: Chunk, rows: pl.DataFrame) -> None:
        self.under_way.pop(chunk.number, None)
        self.chunks, self.walked = self.chunks + 1, self.walked + rows.height
        self.done, self.failed = self.done + rows.height, self.failed + failures(rows)
        self.measured = time.perf_counter() - self.began
        if self.chunks == 1:
            self.first = (self.walked, self.measured)
        self._tell()

    def _tell(self) -> None:
        """Tell the progress; the first chunk, which was compiled too, counts only while there is no other."""
        seconds, (walked, took) = time.perf_counter() - self.began, self.first
        if self.walked > walked > 0:
            rate = (self.walked - walked) / max(self.measured - took, 1e-9)
        else:
            rate = self.walked / max(self.measured, 1e-9) if self.walked else None
        within = sum(self.under_way.values(), 0.0)
        left = None if rate is None else max(0.0, self.total - self.done - within) / rate
        self.tell(Progress(self.done, self.total, self.failed, seconds, rate, left, within))


@contextmanager
def _counting(
    experiment: Experiment, found: Found, progress: Callable[[Progress], None] | None
) -> Iterator[_Count]:
    """A count that tells `progress`, which is closed at the end if it can be."""
    try:
        yield _Count(experiment, found, progress or (lambda _: None))
    finally:
        getattr(progress, "close", lambda: None)()


def _folder(out: str | Path) -> Path:
    if not str(out):
        raise StoreError("out: got an empty name, allowed: a folder that can be made and written")
    return Path(out)


def _workers(given: int | None) -> int | None:
    return None if given is None else whole("workers", given, 1, MAX_WORKERS)


def _for_this_machine() -> int:
    return len(runtime.gpus()) or runtime.cores()

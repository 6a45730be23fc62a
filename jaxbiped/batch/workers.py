"""Who walks the chunks: this process, or Dask workers, one single-threaded process for each core or GPU."""

import contextlib
import logging
import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import jax
import polars as pl

from jaxbiped.batch.experiment import Chunk, Experiment
from jaxbiped.batch.part import walk_chunk

ONE_THREAD = {
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "POLARS_MAX_THREADS": "1",
}
"""Environment of a process that is to use one core; XLA reads its flags when it is first used."""
DEATHS = 10
"""How many workers may die over one chunk before it is given up."""
Done = Generator[tuple[Chunk, pl.DataFrame], None, None]


class WorkersError(RuntimeError):
    """Workers that cannot be had or are lost; what they have finished is kept."""


def use_one_thread() -> None:
    """Keep this process to one core, unless XLA is already running or its flags are set."""
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)


def in_this_process(experiment: Experiment, chunks: list[Chunk]) -> Done:
    """Walk chunk after chunk here."""
    for chunk in chunks:
        yield chunk, walk_chunk(experiment, chunk)


def on_dask(experiment: Experiment, chunks: list[Chunk], workers: int, scheduler: str | None) -> Done:
    """Walk on Dask workers, as they finish: `workers` processes of this machine, or those of a scheduler's address.

    The first chunk of every arm goes ahead of the others of its arm: the worker that gets it compiles, and the others
    find what it compiled in JAX's compilation cache.

    Raises:
        WorkersError: if the workers cannot be reached, or die over and over.
    """
    import distributed
    from distributed.client import FutureCancelledError

    waiting: dict[str, list[Chunk]] = {}
    for chunk in chunks:
        waiting.setdefault(chunk.arm, []).append(chunk)
    try:
        with _client(workers, scheduler) as client:
            shared = client.scatter(experiment, broadcast=True, hash=False)

            def submit(chunk: Chunk) -> Any:
                return client.submit(
                    _walk, shared, chunk, _cache(), pure=False, key=f"chunk-{chunk.number:05d}"
                )

            running = {submit(each[0]): each[0] for each in waiting.values()}
            done = distributed.as_completed(list(running), loop=client.loop)
            for future in done:
                rows, chunk = future.result(), running.pop(future)
                for more in waiting.pop(chunk.arm, [])[1:]:
                    new = submit(more)
                    running[new] = more
                    done.add(new)
                future.release()
                yield chunk, rows
    except (distributed.KilledWorker, FutureCancelledError) as error:
        raise WorkersError(f"workers: {' '.join(str(error).split())[:200]}") from error
    except (OSError, TimeoutError) as error:
        raise WorkersError(f"workers: the scheduler cannot be reached or was lost ({error})") from error


@contextlib.contextmanager
def _client(workers: int, scheduler: str | None) -> Generator[Any, None, None]:
    """A connection to a scheduler; a local one is started and stopped if no address is given."""
    import distributed
    from dask import config

    settings = {
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.nanny.pre-spawn-environ": {
            **config.get("distributed.nanny.pre-spawn-environ"),
            **ONE_THREAD,
        },
        "distributed.comm.timeouts.connect": "10s",
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.terminate": False,
    }
    with config.set(settings):
        if scheduler is not None:
            with distributed.Client(scheduler, timeout="10s", set_as_default=False) as client:
                yield client
            return
        with (
            distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=":0",
                silence_logs=logging.CRITICAL,
                host="127.0.0.1",
            ) as cluster,
            distributed.Client(cluster, set_as_default=False) as client,
        ):
            yield client


def _cache() -> str | None:
    """Where this process keeps what it compiles; workers are to keep it there too."""
    return jax.config.values["jax_compilation_cache_dir"]


def _walk(experiment: Experiment, chunk: Chunk, cache: str | None) -> pl.DataFrame:
    """On a worker."""
    if cache is not None and (Path(cache).exists() or os.access(Path(cache).parent, os.W_OK)):
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    return walk_chunk(experiment, chunk)

"""Who walks the chunks: this process, or Dask workers, one single-threaded process for each core or GPU."""

import contextlib
import ctypes
import importlib.util
import logging
import multiprocessing
import os
import queue
import re
import resource
import sys
from collections.abc import Callable, Generator
from functools import partial
from typing import Any

import jax
import polars as pl

from jaxbiped import runtime
from jaxbiped.batch.experiment import Chunk, Experiment
from jaxbiped.batch.part import walk_chunk
from jaxbiped.batch.store import code

ROOM_MIB = 1200.0
"""Of memory, over which a worker forgets what it has compiled for another kind of variant before it compiles again."""
DEATHS = 10
"""How many workers may die over one chunk before it is given up; of a scheduler elsewhere its own setting counts."""
WORKER_SCRIPT = """
import os, signal

signal.signal(signal.SIGINT, signal.SIG_IGN)

def dask_setup(worker):
    gpus = {gpus!r}
    if gpus:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[int(worker.name) % len(gpus)]
"""
"""Of the workers of this process: a Ctrl-C reaches them too, but it is this process that says what is to be done; and
each has a GPU of its own, if there are any."""
PATIENCE_S = 60.0
"""How long nothing may be heard before the workers are counted, and how long there may be none of them then [s]."""
CONNECT_S = 10
"""How long a scheduler may take to answer [s]."""
ADDRESS = re.compile(r"(tcp|tls|ws|wss)://([\w.-]+|\[[0-9a-fA-F:.]+\]):([0-9]{1,5})")
"""Of a scheduler."""
WORKER_NAME = "Dask Worker process"
"""How distributed begins the name of a worker's process."""
UNGUARDED = 79
"""Exit status of a worker that ran its parent's script."""
Done = Generator[tuple[Chunk, pl.DataFrame], None, None]
Within = Callable[[Chunk, float], None]
"""Is told which fraction of a chunk is done."""


class WorkersError(RuntimeError):
    """Workers that cannot be had or are lost; what they have finished is kept."""


def require_main_guard() -> None:
    """End this process, if it is a worker that runs its parent's script instead of waiting for work.

    Workers are started as copies of the script that runs, without its `if __name__ == "__main__":`. Where a script has
    none, every worker would start workers of its own.
    """
    process = multiprocessing.current_process()
    if getattr(process, "_inheriting", False) and process.name.startswith(WORKER_NAME):
        os._exit(UNGUARDED)


def require_address(scheduler: str) -> None:
    """Refuse what is no address of a scheduler.

    Raises:
        ValueError: naming what was got and what is allowed.
    """
    match = ADDRESS.fullmatch(scheduler)
    if not match or not 1 <= int(match[3]) <= 65535:
        raise ValueError(
            f"scheduler: got '{scheduler}', allowed: an address like tcp://HOST:PORT, port 1 to 65535"
        )


def in_this_process(experiment: Experiment, chunks: list[Chunk], told: Within) -> Done:
    """Walk chunk after chunk here."""
    for chunk in chunks:
        yield chunk, walk_chunk(experiment, chunk, partial(told, chunk))


def on_dask(
    experiment: Experiment, chunks: list[Chunk], workers: int, scheduler: str | None, told: Within
) -> Done:
    """Walk on Dask workers, as they finish: `workers` processes of this machine, or those of a scheduler's address.

    The first chunk of every variant goes ahead of its others: the worker that gets it compiles, and the others
    find what it compiled in JAX's compilation cache.

    Raises:
        WorkersError: if the workers cannot be reached, run other code, or die over and over.
    """
    if importlib.util.find_spec("distributed") is None:
        raise WorkersError(
            "workers: got no package 'distributed', allowed: 1 worker, or pip install 'jaxbiped[cluster]'"
        )
    waiting: dict[str, list[Chunk]] = {}
    for chunk in chunks:
        waiting.setdefault(chunk.variant, []).append(chunk)
    with _client(workers, scheduler) as client:
        crew = _Crew(client, experiment, told)
        for first, *_ in waiting.values():
            crew.submit(first)
        while crew.running:
            chunk, rows = crew.next()
            for more in waiting.pop(chunk.variant, [])[1:]:
                crew.submit(more)
            yield chunk, rows


class _Crew:
    """Chunks that are with the workers of a scheduler."""

    def __init__(self, client: Any, experiment: Experiment, told: Within):  # noqa: ANN401
        self.client, self.told = client, told
        self.running: dict[int, tuple[Chunk, Any]] = {}
        # A task, not data that is on workers only: whoever is left gets it again.
        self.experiment = client.submit(lambda: experiment, pure=False)
        # Number of a chunk, and which fraction of it is done; None: it is finished.
        self.heard: queue.SimpleQueue[tuple[int, float | None]] = queue.SimpleQueue()
        client.subscribe_topic(self.experiment.key, lambda event: self.heard.put(event[1]))  # after the time

    def submit(self, chunk: Chunk) -> None:
        """Give a chunk to whoever is free."""
        cache = jax.config.values["jax_compilation_cache_dir"]
        given = (self.experiment, chunk, cache, code(), self.experiment.key)
        future = self.client.submit(_walk, *given, pure=False)
        self.running[chunk.number] = chunk, future
        future.add_done_callback(lambda _: self.heard.put((chunk.number, None)))

    def next(self) -> tuple[Chunk, pl.DataFrame]:
        """Wait for a chunk that is finished, and for its rows; tell meanwhile how far the others are."""
        from distributed import KilledWorker

        number, fraction = self._hear()
        while fraction is not None:
            if number in self.running:
                self.told(self.running[number][0], fraction)
            number, fraction = self._hear()
        chunk, future = self.running.pop(number)
        try:
            return chunk, future.result()
        except KilledWorker as error:
            raise WorkersError(
                f"workers: got {error.allowed_failures + 1} that died over chunk {number} of variant "
                f"'{chunk.variant}', allowed: {error.allowed_failures}"
            ) from error

    def _hear(self) -> tuple[int, float | None]:
        while True:
            with contextlib.suppress(queue.Empty):
                return self.heard.get(timeout=PATIENCE_S)
            try:
                self.client.wait_for_workers(1, PATIENCE_S)
            except TimeoutError:
                raise WorkersError(
                    f"workers: got none in {PATIENCE_S:g} s, allowed: at least one; start some with "
                    f"'dask worker {self.client.scheduler.address} --nthreads 1'"
                ) from None


@contextlib.contextmanager
def _client(workers: int, scheduler: str | None) -> Generator[Any, None, None]:
    """A connection to a scheduler; a local one is started and stopped if no address is given."""
    from dask import config
    from distributed import Client
    from distributed.client import FutureCancelledError
    from distributed.utils import silence_logging_cmgr

    settings = {
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.admin.large-graph-warning-threshold": "1 TB",
        "distributed.worker.preload": [WORKER_SCRIPT.format(gpus=runtime.gpus())],
    }
    for name, value in runtime.ONE_THREAD.items():
        settings[f"distributed.nanny.pre-spawn-environ.{name}"] = value
    # Every loss is logged, which is told once, as an error, or made good without a word.
    try:
        # Every loss is logged, which is told once, as an error, or made good without a word.
        with config.set(settings), silence_logging_cmgr(logging.CRITICAL), contextlib.ExitStack() as stack:
            if scheduler is not None:
                _greet(scheduler)
            where = scheduler or stack.enter_context(_cluster(workers))
            yield stack.enter_context(Client(where, set_as_default=False))
    except (OSError, FutureCancelledError) as error:
        which, why = f"'{scheduler}'" if scheduler else "of this machine", " ".join(str(error).split())
        raise WorkersError(
            f"workers: the scheduler {which} cannot be reached or was lost ({why[:200]})"
        ) from error


def _cluster(workers: int) -> Any:  # noqa: ANN401
    """A scheduler and workers on this machine."""
    from distributed import LocalCluster

    try:
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=None,
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        )
    except RuntimeError:
        scout = multiprocessing.get_context("spawn").Process(target=int, name=WORKER_NAME)
        scout.start()
        scout.join()
        if scout.exitcode != UNGUARDED:
            raise
        raise WorkersError(
            "workers: got a script that starts itself in every worker, allowed: 1 worker, or a script that runs "
            "what it does under `if __name__ == '__main__':`"
        ) from None


def _greet(scheduler: str) -> None:
    """Exchange greetings with a scheduler: a client would wait for ever for one that listens but never answers.

    Raises:
        OSError: if it does not answer, or an address of TLS is given, and no certificates in Dask's configuration.
    """
    from distributed.comm.core import connect
    from distributed.security import Security
    from distributed.utils import LoopRunner

    async def greet() -> None:
        keys = Security().get_connection_args("client")
        (await connect(scheduler, timeout=CONNECT_S, **keys)).abort()

    try:
        LoopRunner().run_sync(greet, callback_timeout=CONNECT_S + 1.0)
    except (TimeoutError, TypeError) as error:
        raise OSError(str(error) or f"nothing that speaks Dask answered in {CONNECT_S} s") from None


def _walk(
    experiment: Experiment, chunk: Chunk, cache: str | None, expected: dict[str, str], topic: str
) -> pl.DataFrame:
    """Walk a chunk on a worker, which says under a topic how far it is."""
    from distributed import get_worker

    different = [name for name, version in code().items() if version != expected[name]]
    if different:
        raise WorkersError(
            f"workers: got one with another {', '.join(different)}, allowed: the code and packages of this process"
        )
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    _make_room(experiment, chunk)
    log = get_worker().log_event
    return walk_chunk(experiment, chunk, lambda done: log(topic, (chunk.number, done)))


_kinds: set[Any] = set()
"""Kinds of variants that this worker holds compiled functions for."""


def _make_room(experiment: Experiment, chunk: Chunk) -> None:
    """Forget what is compiled for other kinds of variants, if it takes much memory; JAX's compilation cache has it."""
    kind = (jax.tree.structure(experiment.variants[chunk.variant]), experiment.lanes)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        2**20 if sys.platform == "darwin" else 2**10
    )
    if kind not in _kinds and peak_mib > ROOM_MIB:
        _kinds.clear()
        jax.clear_caches()
        with contextlib.suppress(AttributeError):  # glibc only
            ctypes.CDLL(None).malloc_trim(0)
    _kinds.add(kind)

"""Who walks the chunks: this process, or Dask workers, one single-threaded process for each core or GPU."""

import asyncio
import contextlib
import ctypes
import gc
import logging
import multiprocessing
import os
import queue
import re
import resource
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
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
"""How long a scheduler may be without any worker before the run is given up."""
POLL_S = 1.0
"""How long nothing may finish before the workers are counted."""
CONNECT_S = 10
"""How long a scheduler may take to answer."""
ADDRESS = re.compile(r"(tcp|tls|ws|wss)://([\w.-]+|\[[0-9a-fA-F:.]+\]):([0-9]{1,5})")
"""Of a scheduler."""
UNGUARDED = "JAXBIPED_UNGUARDED"
"""Environment of the workers: the file to be made by one that runs its parent's script."""
Done = Generator[tuple[Chunk, pl.DataFrame], None, None]
Within = Callable[[Chunk, float], None]
"""Is told which fraction of a chunk is done."""


class WorkersError(RuntimeError):
    """Workers that cannot be had or are lost; what they have finished is kept."""


def require_main_guard() -> None:
    """End this process, if it is a worker that runs its parent's script instead of waiting for work.

    Workers are started as copies of the script that runs, without its `if __name__ == "__main__":`. Where a script has
    none, every worker would start workers of its own. It leaves word of that, and the parent says so in one line.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False) and UNGUARDED in os.environ:
        with contextlib.suppress(OSError):
            Path(os.environ[UNGUARDED]).touch()
        os._exit(1)


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
        ValueError: if the address is none.
        WorkersError: if the workers cannot be reached, run other code, or die over and over.
    """
    if scheduler is not None:
        require_address(scheduler)
    waiting: dict[str, list[Chunk]] = {}
    for chunk in chunks:
        waiting.setdefault(chunk.variant, []).append(chunk)
    with _loss_as_error(scheduler), _client(workers, scheduler) as client:
        crew = _Crew(client, experiment, told)
        for first, *_ in waiting.values():
            crew.submit(first)
        while crew.running:
            chunk, rows = crew.next()
            for more in waiting.pop(chunk.variant, [])[1:]:
                crew.submit(more)
            yield chunk, rows


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


class _Crew:
    """Chunks that are with the workers of a scheduler.

    Nothing is on a worker only: the scheduler holds the experiment too, and whoever is left gets it again.
    """

    def __init__(self, client: Any, experiment: Experiment, told: Within):  # noqa: ANN401
        self.client, self.run = client, uuid.uuid4().hex  # of this run: others may use the same scheduler
        self.told, self.heard = told, queue.SimpleQueue()  # of finished chunks, and of how far the others are
        client.subscribe_topic(self.run, self.heard.put)
        self.running: dict[Any, Chunk] = {}
        self.code = code()
        self.experiment = client.submit(_itself, experiment, pure=False, key=f"experiment-{self.run}")

    def submit(self, chunk: Chunk) -> None:
        """Give a chunk to whoever is free."""
        key = f"chunk-{self.run}-{chunk.number:05d}"
        given = (self.experiment, chunk, _cache(), self.code, self.run)
        future = self.client.submit(_walk, *given, pure=False, key=key)
        self.running[future] = chunk
        future.add_done_callback(self.heard.put)

    def next(self) -> tuple[Chunk, pl.DataFrame]:
        """Wait for a chunk that is finished, and for its rows."""
        future = self._next_future()
        rows, chunk = future.result(), self.running.pop(future)
        future.release()
        return chunk, rows

    def _next_future(self) -> Any:  # noqa: ANN401
        last_seen = time.monotonic()
        while True:
            with contextlib.suppress(queue.Empty):
                heard = self.heard.get(timeout=POLL_S)
                if not isinstance(heard, tuple):
                    return heard
                number, fraction = heard[1]  # after the time
                for chunk in self.running.values():
                    if chunk.number == number:
                        self.told(chunk, fraction)
                last_seen = time.monotonic()
                continue
            if self.client.scheduler_info()["workers"]:
                last_seen = time.monotonic()
            elif time.monotonic() - last_seen > PATIENCE_S:
                raise WorkersError(
                    f"workers: got none in {PATIENCE_S:g} s, allowed: at least one; start some with "
                    f"'dask worker {self.client.scheduler.address} --nthreads 1'"
                )


@contextlib.contextmanager
def _loss_as_error(scheduler: str | None) -> Generator[None, None, None]:
    """What distributed raises where workers or the scheduler are lost is a WorkersError."""
    distributed = _distributed()
    from distributed.client import FutureCancelledError

    try:
        yield
    except distributed.KilledWorker as error:
        raise WorkersError(f"workers: {' '.join(str(error).split())[:200]}") from error
    except (OSError, TimeoutError, FutureCancelledError) as error:
        which = f"'{scheduler}'" if scheduler else "of this machine"
        why = " ".join(str(error).split())[:200]
        raise WorkersError(f"workers: the scheduler {which} cannot be reached or was lost ({why})") from error


def _distributed() -> Any:  # noqa: ANN401
    try:
        import distributed
    except ImportError:
        raise WorkersError(
            "workers: got no package 'distributed', allowed: 1 worker, or pip install 'jaxbiped[cluster]'"
        ) from None
    return distributed


@contextlib.contextmanager
def _client(workers: int, scheduler: str | None) -> Generator[Any, None, None]:
    """A connection to a scheduler; a local one is started and stopped if no address is given."""
    distributed = _distributed()
    from dask import config

    settings = {
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.nanny.pre-spawn-environ": {
            **config.get("distributed.nanny.pre-spawn-environ"),
            **runtime.ONE_THREAD,
        },
        "distributed.admin.large-graph-warning-threshold": "1 TB",
        "distributed.comm.timeouts.connect": f"{CONNECT_S}s",
        "distributed.worker.preload": [WORKER_SCRIPT.format(gpus=runtime.gpus())],
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.terminate": False,
    }
    with config.set(settings), _silence(), _main_guard():
        if scheduler is not None:
            _greet(scheduler)
            with distributed.Client(scheduler, timeout=f"{CONNECT_S}s", set_as_default=False) as client:
                yield client
            return
        with (
            distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
                host="127.0.0.1",
            ) as cluster,
            distributed.Client(cluster, set_as_default=False) as client,
        ):
            yield client


@contextlib.contextmanager
def _main_guard() -> Generator[None, None, None]:
    """Say in one line that a script has no `if __name__ == "__main__":`, instead of all that comes of it."""
    with tempfile.TemporaryDirectory(prefix="jaxbiped-") as folder:
        word = Path(folder) / "unguarded"
        before = os.environ.get(UNGUARDED)
        os.environ[UNGUARDED] = str(word)  # workers inherit it
        try:
            yield
        except Exception:
            if not word.exists():
                raise
            raise WorkersError(
                "workers: got a script that starts itself in every worker, allowed: 1 worker, or a script that runs "
                "what it does under `if __name__ == '__main__':`"
            ) from None
        finally:
            os.environ.pop(UNGUARDED, None)
            if before is not None:
                os.environ[UNGUARDED] = before


def _greet(scheduler: str) -> None:
    """Exchange greetings with a scheduler: a client would wait for ever for one that listens but never answers.

    Raises:
        OSError: if it does not answer; TimeoutError is one.
        ValueError: if an address of TLS is given, and no certificates in Dask's configuration.
    """
    from distributed.comm.core import connect
    from distributed.security import Security

    async def greet() -> None:
        keys = Security().get_connection_args("client")
        (await connect(scheduler, timeout=CONNECT_S, **keys)).abort()

    async def in_time() -> None:
        try:
            await asyncio.wait_for(greet(), CONNECT_S + 1.0)
        except TimeoutError:
            raise TimeoutError(f"nothing that speaks Dask answered in {CONNECT_S} s") from None

    with ThreadPoolExecutor(1) as elsewhere:  # where no event loop runs, as one does in a notebook
        try:
            elsewhere.submit(asyncio.run, in_time()).result()
        except TypeError as error:
            raise ValueError(
                f"scheduler: got '{scheduler}' ({' '.join(str(error).split())[:120]}), allowed: tcp://HOST:PORT, or "
                "certificates under distributed.comm.tls in Dask's configuration"
            ) from None


@contextlib.contextmanager
def _silence() -> Generator[None, None, None]:
    """Distributed logs every loss, which is told once, as an error, or made good without a word."""
    known = [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]
    before = {logging.getLogger(name): logging.getLogger(name).level for name in {*known, "asyncio"}}
    for logger in before:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in before.items():
            logger.setLevel(level)


def _cache() -> str | None:
    """Where this process keeps what it compiles; workers are to keep it there too."""
    return jax.config.values["jax_compilation_cache_dir"]


def _itself(experiment: Experiment) -> Experiment:
    """On a worker, which keeps it for all chunks."""
    return experiment


def _walk(
    experiment: Experiment, chunk: Chunk, cache: str | None, expected: dict[str, str], topic: str
) -> pl.DataFrame:
    """On a worker, which says under a topic how far it is."""
    different = [name for name, version in code().items() if version != expected[name]]
    if different:
        raise WorkersError(
            f"workers: got one with another {', '.join(different)}, allowed: the code and packages of this process"
        )
    if cache is not None and (Path(cache).exists() or os.access(Path(cache).parent, os.W_OK)):
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    _make_room(experiment, chunk)
    worker = _distributed().get_worker()
    return walk_chunk(experiment, chunk, lambda done: worker.log_event(topic, (chunk.number, done)))


_kinds: set[Any] = set()
"""Kinds of variants that this worker holds compiled functions for."""


def _make_room(experiment: Experiment, chunk: Chunk) -> None:
    """Forget what is compiled for other kinds of variants, if it takes much memory; JAX's compilation cache has it."""
    kind = (jax.tree.structure(experiment.variants[chunk.variant]), experiment.lanes)
    if kind not in _kinds and peak_mib() > ROOM_MIB:
        _kinds.clear()
        jax.clear_caches()
        gc.collect()
        with contextlib.suppress(AttributeError):  # glibc only
            ctypes.CDLL(None).malloc_trim(0)
    _kinds.add(kind)


def peak_mib() -> float:
    """Most memory this process has used [MiB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)

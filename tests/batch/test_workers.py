"""Workers that walk nothing: who goes ahead, who is told what, who dies, and who cannot be had."""

import ctypes
import io
import logging
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import polars as pl
import psutil
import pytest

pytest.importorskip("distributed")

import at_work
from distributed import LocalCluster, default_client

from jaxbiped import adapt, batch, planner, robot, runtime
from jaxbiped.batch import workers
from jaxbiped.batch.experiment import Chunk

SCENARIOS = 16


@pytest.fixture(scope="module")
def one() -> batch.Experiment:
    """Four chunks of each of two variants."""
    return experiment(np.linspace(0.4, 0.9, SCENARIOS))


def experiment(friction: np.ndarray) -> batch.Experiment:
    params = robot.load("surena3")
    controller = adapt.Controller(planner.PolynomialGait.preset(params, 2))
    table = pl.DataFrame({"friction": friction})
    return batch.Experiment(params, {"a": controller, "b": controller}, table, duration=0.02, batch=4)


def row(chunk: Chunk) -> pl.DataFrame:
    return pl.DataFrame({"number": [chunk.number]})


def nobody(*_: Any) -> None:
    pass


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Two workers that are threads of this process: what is patched here counts for them too."""
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address="127.0.0.1:0"
    ) as made:
        yield made


def test_first_chunk_of_every_variant_goes_ahead(one, cluster, monkeypatch):
    log = []

    def walk(one, chunk, told):
        log.append(("begin", chunk.number))
        time.sleep(0.3 if chunk.number in (0, 4) else 0.0)
        log.append(("end", chunk.number))
        return row(chunk)

    monkeypatch.setattr(workers, "walk_chunk", walk)
    done = list(workers.on_dask(one, one.chunks, 2, cluster.scheduler_address, nobody))
    assert {chunk.number for chunk, _ in done} == set(range(8)) and len(done) == 8
    assert all(rows.equals(row(chunk)) for chunk, rows in done)
    for first in (0, 4):
        ahead = log.index(("end", first))
        assert all(log.index(("begin", first + i)) > ahead for i in (1, 2, 3))


def test_progress_within_chunks_arrives_in_this_thread_and_late_words_are_not_told(one, cluster, monkeypatch):
    heard, threads = [], set()

    def walk(one, chunk, told):
        told(0.5)
        if chunk.number == 0:
            threading.Timer(0.2, told, (0.9,)).start()
        if chunk.number == 4:
            time.sleep(0.6)
        return row(chunk)

    def told(chunk, fraction):
        heard.append((chunk.number, fraction))
        threads.add(threading.current_thread())

    monkeypatch.setattr(workers, "walk_chunk", walk)
    list(workers.on_dask(one, one.chunks, 2, cluster.scheduler_address, told))
    assert sorted(heard) == [(number, 0.5) for number in range(8)]
    assert threads == {threading.current_thread()}


def test_large_experiments_come_without_a_warning(cluster, monkeypatch):
    monkeypatch.setattr(workers, "walk_chunk", lambda one, chunk, told: row(chunk))
    large = experiment(
        np.random.default_rng(0).uniform(0.4, 0.9, 200_000)
    )  # over 10 MB distributed speaks up
    next(workers.on_dask(large, large.chunks[:1], 2, cluster.scheduler_address, nobody))


def test_workers_of_other_code_are_refused_in_one_line(one, cluster, monkeypatch):
    monkeypatch.setattr(workers, "code", lambda: {"jax": threading.current_thread().name, "numpy": "2"})
    with pytest.raises(batch.WorkersError, match=r"^workers: got one with another jax, allowed: the code"):
        next(workers.on_dask(one, one.chunks, 2, cluster.scheduler_address, nobody))


def slow_walk(one, chunk, told):
    told(0.5)
    time.sleep(0.5)
    return row(chunk)


def test_scheduler_that_is_lost_is_a_clear_error_and_nothing_else_is_said(one, cluster, monkeypatch):
    log = logging.StreamHandler(io.StringIO())
    logging.getLogger("distributed").addHandler(log)
    monkeypatch.setattr(workers, "CONNECT_S", 1)
    monkeypatch.setattr(workers, "walk_chunk", slow_walk)
    address = cluster.scheduler_address
    with pytest.raises(batch.WorkersError, match=f"scheduler '{address}' cannot be reached or was lost"):
        next(workers.on_dask(one, one.chunks, 2, address, lambda *_: cluster.close()))
    logging.getLogger("distributed").removeHandler(log)
    assert log.stream.getvalue() == ""


def test_scheduler_with_tls_but_no_certificates_is_a_clear_error(one):
    with pytest.raises(batch.WorkersError, match=r"'tls://127.0.0.1:1' cannot be reached.*TLS configuration"):
        next(workers.on_dask(one, one.chunks, 2, "tls://127.0.0.1:1", nobody))


def test_without_distributed_one_line_says_what_to_install(one, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(batch.WorkersError, match=r"got no package 'distributed', allowed: 1 worker, or pip"):
        next(workers.on_dask(one, one.chunks, 2, None, nobody))


def test_a_worker_that_dies_is_replaced_and_its_chunk_walked_again(one, monkeypatch, tmp_path, capfd):
    """Workers are processes of one thread that hear no Ctrl-C, keep what they compile where this process does, and
    leave it to this one to speak of errors."""
    monkeypatch.setattr(workers, "_walk", at_work.die_once)
    monkeypatch.setattr(
        "distributed.deploy.local.CPU_COUNT", 8
    )  # threads of one worker, if nobody says how many
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "7")  # workers inherit it
    before, done, heard = jax.config.values["jax_compilation_cache_dir"], [], []
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    try:
        with pytest.raises(ZeroDivisionError, match="seven"):
            for _, rows in workers.on_dask(one, one.chunks[4:], 1, None, lambda *told: heard.append(told)):
                done.append(rows.row(0))
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    assert (tmp_path / "died").exists()
    assert sorted(done) == [(number, 1, str(tmp_path), 0.5, True) for number in (4, 5, 6)]
    assert sorted((chunk.number, fraction) for chunk, fraction in heard) == [(i, 0.5) for i in (4, 5, 6)]
    assert capfd.readouterr().err == ""


def test_a_chunk_over_which_workers_die_is_given_up(one, monkeypatch, capfd):
    monkeypatch.setattr(workers, "DEATHS", 0)
    monkeypatch.setattr(workers, "_walk", at_work.die)
    with pytest.raises(
        batch.WorkersError, match=r"^workers: got 1 that died over chunk 0 of variant 'a', all"
    ):
        next(workers.on_dask(one, one.chunks[:1], 1, None, nobody))
    assert capfd.readouterr().err == ""


def test_every_worker_has_one_thread_a_gpu_of_its_own_and_no_limit_of_memory(monkeypatch):
    """Nobody else can see the cluster: it listens to this machine only, and is nobody's default."""
    monkeypatch.setattr(runtime, "gpus", lambda: ["3", "5"])
    monkeypatch.delenv("NPROC", raising=False)
    with workers._client(2, None) as client:
        client.wait_for_workers(2)
        seen = client.run(os.getenv, "CUDA_VISIBLE_DEVICES").values()
        threads = client.run(os.getenv, "NPROC").values()
        trims = client.run(os.getenv, "MALLOC_TRIM_THRESHOLD_").values()
        known = client.scheduler_info()
        doors = {
            at.laddr for at in psutil.Process().net_connections("tcp") if at.status == psutil.CONN_LISTEN
        }
        with pytest.raises(ValueError, match="No clients found"):
            default_client()
    assert sorted(seen) == ["3", "5"]
    assert set(threads) == {"1"} and set(trims) == {"65536"}  # what distributed sets stays
    assert [one["memory_limit"] for one in known["workers"].values()] == [0, 0]
    assert {ip for ip, _ in doors} == {"127.0.0.1"} and 8787 not in {port for _, port in doors}


def test_workers_that_cannot_be_started_for_another_reason_say_theirs(monkeypatch):
    def fail(**_):
        raise RuntimeError("no more processes")

    monkeypatch.setattr("distributed.LocalCluster", fail)
    with pytest.raises(RuntimeError, match="no more processes"):
        workers._cluster(2)


@pytest.mark.parametrize(
    ("name", "inheriting", "ends"),
    [
        ("Dask Worker process (from Nanny)", True, True),
        ("SpawnPoolWorker-1", True, False),
        ("Dask", False, False),
    ],
)
def test_only_a_worker_that_runs_the_script_of_its_parent_is_ended(monkeypatch, name, inheriting, ends):
    ended = []
    monkeypatch.setattr(
        multiprocessing, "current_process", lambda: SimpleNamespace(name=name, _inheriting=inheriting)
    )
    monkeypatch.setattr(os, "_exit", ended.append)
    workers.require_main_guard()
    assert ended == [workers.UNGUARDED] * ends


def forget(one: batch.Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "ROOM_MIB", 0.0)
    monkeypatch.setattr(workers, "_kinds", set())
    monkeypatch.setattr(jax, "clear_caches", nobody)
    workers._make_room(one, one.chunks[0])


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="only glibc keeps what is freed")
def test_memory_of_what_is_forgotten_goes_back_to_the_system(one, monkeypatch):
    """What is freed between things that stay is kept by glibc otherwise."""
    libc, kib, count = ctypes.CDLL(None), 64, 3000
    libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    blocks = [libc.malloc(kib * 1024) for _ in range(count)]
    for block in blocks:
        ctypes.memset(block, 1, kib * 1024)
    stay = blocks[::50]
    for block in set(blocks) - set(stay):
        libc.free(block)
    before = psutil.Process().memory_info().rss
    forget(one, monkeypatch)
    assert psutil.Process().memory_info().rss < before - 0.5 * count * kib * 1024
    for block in stay:
        libc.free(block)


def test_other_c_libraries_give_it_back_themselves(one, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda _: object())
    forget(one, monkeypatch)

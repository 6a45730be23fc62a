"""What every test shares: compiled kernels are kept between runs, and float64 is there for those who ask."""

import os
from collections.abc import Iterator
from pathlib import Path

from jaxbiped import runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import jax
import pytest
from made_up import walk_chunk


def _keep_compiled_kernels() -> None:
    """Point JAX, here and in child processes, at a compilation cache that outlives the run."""
    folder = os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(runtime.cache_folder()))
    seconds = os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", float(seconds))


_keep_compiled_kernels()

LONGEST = (
    "sim/compile/test_backend.py",
    "sim/test_walks.py",
    "tune/test_value_and_grad.py",
    "tune/test_walks_in_c.py",
    "test_cli_batch.py",
    "sim/test_stability.py",
    "sim/test_c_mujoco.py",
    "sim/test_thesis.py",
    "sim/test_controller_c.py",
    "sim/test_laws.py",
    "tune/test_kernels.py",
    "adapt/test_payload.py",
    "sim/test_sensors.py",
    "test_cli_walk.py",
    "adapt/test_event_instants.py",
    "sim/test_simulation.py",
    "batch/test_run.py",
)
"""Files that take longest, which go first: with the last of them at the end one process would wait for the other."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first; within a file nothing changes."""
    here = Path(__file__).parent
    order = {str(here / name): place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(str(item.path), len(order)))


MOST_MAPS = 20_000
"""Memory maps of a process at which compiled functions are dropped; Linux allows 65,530 (vm.max_map_count)."""


@pytest.fixture(autouse=True, scope="module")
def _few_compiled_functions() -> Iterator[None]:
    """Every compiled function holds memory maps, and a process that has too many of them crashes."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > MOST_MAPS:
        jax.clear_caches()


@pytest.fixture(autouse=True)
def _without_words_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiling takes long or short: what is said meanwhile is left to the tests of `batch.progress`."""
    monkeypatch.setattr("jaxbiped.batch.progress.FIRST_S", 1e9)


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Chunks are made up instead of simulated in this process; the numbers of those that were."""
    numbers: list[int] = []

    def walk(one, chunk, told=None):
        numbers.append(chunk.number)
        return walk_chunk(one, chunk)

    monkeypatch.setattr("jaxbiped.batch.workers.walk_chunk", walk)
    return numbers


@pytest.fixture
def x64() -> Iterator[None]:
    """The test computes in float64; every other test in JAX's default, float32."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def compilations() -> Iterator[list[str]]:
    """Grows by one name with every program that XLA is given, from its cache or not."""
    names: list[str] = []

    def listener(event: str, *_, **more) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(str(more.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listener)
    yield names
    jax.monitoring.unregister_event_duration_listener(listener)

"""How walks are compiled: with options where XLA knows them, without where it does not, once."""

import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import runtime


class Turns(eqx.Module):
    """Something to compile: numbers, and a choice."""

    rotations: jax.Array
    times: int = eqx.field(static=True)


@pytest.fixture
def turns():
    """Rotations in a batch: the small products that the options are about."""
    random = np.random.default_rng(0)
    return Turns(jnp.asarray(np.linalg.qr(random.standard_normal((64, 3, 3)))[0], jnp.float32), 3)


@pytest.fixture
def counted():
    """A function to compile, and how often it was traced."""
    traced = []

    def turned(turns, vector):
        traced.append(None)
        for _ in range(turns.times):
            vector = jnp.einsum("nij,nj->ni", turns.rotations, vector)
        return {"vector": vector, "length": jnp.sqrt(jnp.sum(vector**2, axis=-1))}

    return turned, traced


@pytest.fixture
def asked_again():
    """XLA is asked again what it knows, before and after."""
    runtime.options.cache_clear()
    yield
    runtime.options.cache_clear()


def test_the_result_is_that_of_the_function_and_it_is_compiled_once(turns, counted):
    function, traced = counted
    compiled, vector = runtime.jit(function), jnp.arange(192.0).reshape(64, 3)
    assert not traced
    for scale in (1.0, -2.0):
        got = compiled(turns, scale * vector)
        far = np.asarray(scale * vector, float)
        want = np.linalg.matrix_power(np.asarray(turns.rotations, float), 3) @ far[..., None]
        np.testing.assert_allclose(got["vector"], want[..., 0], rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(got["length"], np.linalg.norm(want[..., 0], axis=1), rtol=1e-5)
    assert len(traced) == 1
    compiled(Turns(turns.rotations, 2), vector)
    assert len(traced) == 2


def test_names_and_words_stay(counted):
    function, _ = counted
    assert runtime.jit(function).__name__ == function.__name__


def test_this_xla_knows_the_options(asked_again):
    """An upgrade that forgets them would cost a tenth of the speed without a word."""
    assert runtime.options() == runtime.OPTIONS


def test_options_that_xla_does_not_know_are_left_out(turns, counted, asked_again, monkeypatch):
    monkeypatch.setattr(runtime, "OPTIONS", {"xla_cpu_no_such_option": ""})
    assert runtime.options() == {}
    got = runtime.jit(counted[0])(turns, jnp.ones((64, 3)))
    np.testing.assert_allclose(got["length"], np.sqrt(3.0), rtol=1e-5)


def test_inside_another_compiled_function_it_is_inlined(turns, counted):
    """XLA's options may be given to the outermost function only."""
    inner, vector = runtime.jit(counted[0]), jnp.arange(192.0).reshape(64, 3)
    alone = inner(turns, vector)["length"]
    np.testing.assert_allclose(runtime.jit(lambda v: inner(turns, v)["length"])(vector), alone, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda v: inner(turns, v)["length"])(vector), alone, rtol=1e-6)
    many = jax.vmap(lambda v: inner(turns, v)["length"])(jnp.stack([vector, 2.0 * vector]))
    np.testing.assert_allclose(many, [alone, 2.0 * alone], rtol=1e-6)


@pytest.mark.parametrize(("dtype", "rows"), [("float32", 32_769), ("float64", 16_385)])
def test_sums_of_products_are_right(x64, dtype, rows):
    """The reproducer of jax-ml/jax issue 39103: jaxlib 0.10.2 is off by 0.8 % without the options."""
    squares = runtime.jit(lambda x: jax.vmap(lambda row: jnp.sum((jnp.eye(3, dtype=x.dtype) @ row) ** 2))(x))
    x = np.zeros((rows, 3), dtype)
    x[:, 0] = np.arange(rows)
    np.testing.assert_allclose(squares(x), x[:, 0].astype(float) ** 2, rtol=1e-6)


def test_every_function_of_the_package_is_compiled_with_the_options():
    """Only `runtime` names JAX's or Equinox's own jit; `doctor` compares the two."""
    package = Path(runtime.__file__).parent
    others = [file for file in package.rglob("*.py") if file.name not in ("runtime.py", "doctor.py")]
    found = [
        f"{file.name}: {name}"
        for file in others
        for name in ("jax.jit", "filter_jit")
        if name in file.read_text()
    ]
    assert len(others) > 50 and found == []


IMPORTS = """
import sys
import jaxbiped, jaxbiped.cli
import jaxbiped.report.grids, jaxbiped.report.movie, jaxbiped.report.overview
from jax._src import xla_bridge
print(xla_bridge.backends_are_initialized())
"""


def test_importing_the_package_starts_no_back_end():
    """Thread limits that are set afterwards still count, and no GPU's memory is taken."""
    said = subprocess.run([sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "False"


COMMAND = """
import sys
from pathlib import Path
from jaxbiped import cli
code = cli.main(["export", "--robot", "elkahlout", "--out", sys.argv[1]])
import jax.numpy as jnp
(jnp.ones((64, 64)) @ jnp.ones((64, 64))).block_until_ready()
names = [path.read_text() for path in Path("/proc/self/task").glob("*/comm")]
print(code, sum("Eigen" in name for name in names))
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are counted in /proc")
@pytest.mark.parametrize("given", [{}, {"NPROC": "1"}, {"NPROC": "3"}])
def test_a_command_computes_with_as_many_threads_as_it_was_told(tmp_path, given):
    own = {k: v for k, v in os.environ.items() if k not in runtime.ONE_THREAD}
    command = [sys.executable, "-c", COMMAND, str(tmp_path / "robot.xml")]
    said = subprocess.run(
        command, env={**own, **given, "JAX_PLATFORMS": "cpu"}, capture_output=True, text=True, check=True
    )
    assert said.stdout.splitlines()[-1] == f"0 {given.get('NPROC', 1)}"


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are counted in /proc")
def test_a_process_of_one_thread_computes_with_one():
    computes = """
import jax.numpy as jnp
from pathlib import Path
(jnp.ones((64, 64)) @ jnp.ones((64, 64))).block_until_ready()
names = [path.read_text() for path in Path("/proc/self/task").glob("*/comm")]
print(sum("Eigen" in name for name in names))
"""
    own = {k: v for k, v in os.environ.items() if k not in runtime.ONE_THREAD}
    environment = {**own, **runtime.ONE_THREAD, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", computes]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "1"


@pytest.mark.parametrize(
    ("nproc", "expected"), [("1", 1), ("2", min(2, runtime.cores())), ("", runtime.cores())]
)
def test_as_many_functions_run_at_once_as_xla_has_threads(monkeypatch, nproc, expected):
    monkeypatch.setenv("NPROC", nproc)
    assert runtime.threads() == expected
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert runtime.threads() == 1


def test_compiled_kernels_are_kept_where_the_system_keeps_caches(monkeypatch, tmp_path):
    assert runtime.cache_folder().parts[-2:] in {("jaxbiped", "jax"), ("Cache", "jax")}
    if sys.platform == "linux":
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert runtime.cache_folder() == tmp_path / "jaxbiped" / "jax"
        monkeypatch.setenv("XDG_CACHE_HOME", "")
        assert runtime.cache_folder() == Path.home() / ".cache" / "jaxbiped" / "jax"

"""C of small functions against JAX and NumPy."""

import shutil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from scalars import run_c
from test_rules import AT, X, all_of_them, drawn

from jaxbiped.sim.compile import build

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
RANDOM = np.random.default_rng(3)


def test_all_rules_together_in_double(x64: None):
    """One program of all cases, so that the compiler runs once."""
    function, args, want = all_of_them()
    for got, expected in zip(run_c(function, args, single=False), want, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)


RANGES = {
    "sin": (np.sin, -300.0, 300.0), "cos": (np.cos, -300.0, 300.0), "arcsin": (np.arcsin, -1.0, 1.0),
    "arccos": (np.arccos, -1.0, 1.0), "arctan": (np.arctan, -30.0, 30.0), "sqrt": (np.sqrt, 0.0, 9.0),
    "exp": (np.exp, -20.0, 20.0), "log": (np.log, 1e-6, 9.0), "tanh": (np.tanh, -3.0, 3.0),
    "floor": (np.floor, -9.0, 9.0),
}  # fmt: skip


def test_functions_in_single_precision_are_as_good_as_libm():
    columns = [RANDOM.uniform(low, high, 20_000).astype(np.float32) for _, low, high in RANGES.values()]
    y, x = RANDOM.normal(size=(2, 20_000)).astype(np.float32)

    def function(y: Any, x: Any, *columns: Any) -> list[Any]:
        return [lax.atan2(y, x), *(getattr(jnp, name)(c) for name, c in zip(RANGES, columns, strict=True))]

    got = run_c(function, (y, x, *columns), single=True)
    want = [np.arctan2(y.astype(float), x)]
    want += [f(c.astype(float)) for (f, _, _), c in zip(RANGES.values(), columns, strict=True)]
    for name, a, b in zip(["atan2", *RANGES], got, want, strict=True):
        least = (
            1.0 if name in ("sin", "cos", "arcsin", "arccos") else 1e-30
        )  # beside a zero, the argument's rounding
        ulp = np.spacing(np.maximum(np.abs(b), least).astype(np.float32))
        assert np.max(np.abs(a - b) / ulp) < 3.0, name


def test_random_numbers_are_those_of_jax():
    seed, tick = RANDOM.integers(-(2**31), 2**31, (2, 50)).astype(np.int32)
    want = jax.vmap(lambda *given: drawn(*given)[1:])(seed, tick)
    for a, b in zip(run_c(lambda *given: drawn(*given)[1:], (seed, tick), single=True), want, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-7)


def test_special_numbers():
    x = np.array([np.nan, np.inf, -np.inf, -0.0, 0.0, 1.0, -1.0, 3e9], np.float32)
    y = np.array([1.0, np.nan, 1.0, 0.0, -0.0, np.nan, 0.0, 0.0], np.float32)

    def function(x: Any, y: Any) -> list[Any]:
        return [
            jnp.maximum(x, y),
            jnp.minimum(x, y),
            jnp.isfinite(x),
            jnp.abs(x),
            x.astype(int),
            x < y,
            x != y,
        ]

    for got, want in zip(run_c(function, (x, y), single=True), jax.vmap(function)(x, y), strict=True):
        if want.dtype != jnp.int32:
            np.testing.assert_array_equal(got, want)
    whole = run_c(lambda x: x.astype(int), (x,), single=True)[0]
    assert whole.tolist()[:1] == [0] and whole.tolist()[3:7] == [0, 0, 1, -1]


def test_loops_and_tables_in_single_precision():
    table = jnp.asarray(np.linspace(0.0, 1.0, 12, dtype=np.float32))

    def function(x: Any, k: Any) -> Any:
        def body(carry: Any, _: None) -> Any:
            a, b = carry
            return (b, a * 0.5 + table[k] * x), a

        (a, b), rows = lax.scan(body, (x, 2 * x), None, length=5)
        return a, b, rows[-1]

    args = (X.astype(np.float32), AT)
    for got, want in zip(run_c(function, args, True, rolled=1), jax.vmap(function)(*args), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)


def test_without_a_compiler_it_says_so(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(
        ValueError, match="backend: 'c' needs a C compiler, and there is no 'no-such-compiler'"
    ):
        build.load("int x;")

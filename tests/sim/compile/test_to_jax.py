"""Scalars given back to XLA, as vectors of lanes: small functions against JAX itself."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from scalars import run_lanes
from test_rules import AT, X, all_of_them, drawn

from jaxbiped.sim.compile.interpret import UnknownPrimitiveError
from jaxbiped.sim.compile.to_jax import operation

RANDOM = np.random.default_rng(4)


def test_all_rules_together_in_double(x64: None):
    """One program of all cases, so that XLA runs once."""
    function, args, want = all_of_them()
    got = run_lanes(function, args)
    assert len(got) == len(want) > 50
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_random_numbers_are_those_of_jax():
    seed, tick = RANDOM.integers(-(2**31), 2**31, (2, 50)).astype(np.int32)
    want = jax.vmap(lambda *given: drawn(*given)[1:])(seed, tick)
    for a, b in zip(run_lanes(lambda *given: drawn(*given)[1:], (seed, tick)), want, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-7)


def test_loops_and_tables():
    """A loop that stays one, with what it carries, what it looks up and the last of what it leaves behind."""
    table = jnp.asarray(np.linspace(0.0, 1.0, 12, dtype=np.float32))

    def function(x: Any, k: Any) -> Any:
        def body(carry: Any, _: None) -> Any:
            a, b = carry
            return (b, a * 0.5 + table[k] * x), a

        (a, b), rows = lax.scan(body, (x, 2 * x), None, length=5)
        return a, b, rows[-1]

    args = (X.astype(np.float32), AT)
    for got, want in zip(run_lanes(function, args, rolled=1), jax.vmap(function)(*args), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)


def test_an_operation_that_it_does_not_have_is_named():
    with pytest.raises(UnknownPrimitiveError, match="no JAX operation for 'erf'"):
        operation("erf", np.dtype(np.float32), [jnp.zeros(3)])

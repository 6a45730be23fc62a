"""Plain C of small functions against JAX; whole controllers are compared in `sim/test_controller_c.py`."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scalars import run_plain_c
from test_rules import all_of_them, drawn

from jaxbiped.sim.compile import build
from jaxbiped.sim.compile.interpret import UnknownPrimitiveError

pytestmark = pytest.mark.skipif(build.compiler() is None, reason="no C compiler")


def test_all_rules_together_in_double(x64: None, tmp_path: Path):
    function, args, want = all_of_them()
    got = run_plain_c(function, args, tmp_path)
    assert len(got) == len(want) > 50
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_special_numbers(tmp_path: Path):
    x = np.array([np.nan, np.inf, -np.inf, -0.0, 0.0, 1.0, -1.0, 3e9], np.float32)
    y = np.array([1.0, np.nan, 1.0, 0.0, -0.0, np.nan, 0.0, 0.0], np.float32)

    def function(x: Any, y: Any) -> list[Any]:
        comparing = [x < y, x <= y, x == y, x != y, jnp.isfinite(x)]
        return [jnp.maximum(x, y), jnp.minimum(x, y), jnp.sign(x), jnp.abs(x), x * 0.5, *comparing]

    for got, want in zip(run_plain_c(function, (x, y), tmp_path), jax.vmap(function)(x, y), strict=True):
        np.testing.assert_array_equal(got, want)
    whole = run_plain_c(lambda x: x.astype(int), (x,), tmp_path)[0]
    assert whole.tolist() == [0, 2147483520, -2147483648, 0, 0, 1, -1, 2147483520]


def test_random_numbers_are_refused(tmp_path: Path):
    """A controller has none; their words without a sign would need C of their own."""
    seeds = np.arange(3, dtype=np.int32)
    with pytest.raises(UnknownPrimitiveError, match="of whole numbers, in plain C"):
        run_plain_c(lambda *given: drawn(*given)[1:], (seeds, seeds), tmp_path)

"""Every primitive rule against JAX: the graph of a small function, computed by NumPy in float64."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from scalars import program_of, run_graph

from jaxbiped.sim.compile.interpret import UnknownPrimitiveError

RANDOM = np.random.default_rng(7)
X, Y = RANDOM.normal(size=(5, 3, 4)), RANDOM.normal(size=(5, 3, 4))
UNIT = RANDOM.uniform(-1.0, 1.0, (5, 6))
N, K = RANDOM.integers(-9, 9, (5, 6)).astype(np.int32), RANDOM.integers(1, 5, (5, 6)).astype(np.int32)
B, C = RANDOM.random((5, 6)) < 0.5, RANDOM.random((5, 6)) < 0.5
AT, TO = RANDOM.integers(-3, 6, 5).astype(np.int32), RANDOM.integers(-3, 6, (5, 2)).astype(np.int32)
KNOWN = np.array([2, 0, 2])

CASES: dict[str, tuple[Callable[..., Any], tuple[np.ndarray, ...]]] = {
    **{f.__name__: (f, (X, Y)) for f in (lax.add, lax.sub, lax.mul, lax.div, lax.max, lax.min, lax.atan2)},
    **{f.__name__: (f, (X, Y)) for f in (lax.lt, lax.le, lax.gt, lax.ge, lax.eq, lax.ne, lax.rem)},
    **{f.__name__: (f, (X,)) for f in (lax.neg, lax.abs, lax.sign, lax.floor, lax.ceil, lax.exp, lax.tanh)},
    **{f.__name__: (f, (X,)) for f in (lax.sin, lax.cos, lax.tan, lax.atan, lax.square, lax.is_finite)},
    **{f"abs_{f.__name__}": (lambda x, f=f: f(jnp.abs(x)), (X,)) for f in (lax.sqrt, lax.rsqrt, lax.log)},
    **{f.__name__: (f, (UNIT,)) for f in (lax.asin, lax.acos)},
    **{f"whole_{f.__name__}": (f, (N, K)) for f in (lax.div, lax.rem, lax.max, lax.add, lax.bitwise_and)},
    **{f"truth_{f.__name__}": (f, (B, C)) for f in (lax.bitwise_and, lax.bitwise_or, lax.bitwise_xor, lax.eq)},
    "not": (lax.bitwise_not, (B,)),
    "round": (lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN), (X,)),
    "pow": (lambda x, y: jnp.abs(x) ** y, (X, Y)),
    "integer_pow": (lambda x: (x**5, x**-3, x**0, x**2), (X,)),
    "clamp": (lambda x: jnp.clip(x, -0.5, 0.5), (X,)),
    "select_n": (jnp.where, (B, N, K)),
    "select_n_of_three": (lambda k, x: lax.select_n(k % 3, x, 2 * x, 3 * x), (K, UNIT)),
    "convert": (lambda x, b: (x.astype(int), x.astype(bool), b.astype(float), b.astype(int)), (UNIT * 5, B)),
    "broadcast": (lambda x: jnp.broadcast_to(x[:, None], (3, 2, 4)) + 1.0, (X,)),
    "transpose": (lambda x: x.T, (X,)),
    "reshape": (lambda x: x.reshape(2, 6), (X,)),
    "slice": (lambda x: x[::-1, 1:3], (X,)),
    "concatenate": (lambda x, y: jnp.concatenate([x, jnp.ones((1, 4)), y]), (X, Y)),
    "stack": (lambda x, y: jnp.stack([x, y], axis=1), (X, Y)),
    "tile": (lambda x: jnp.tile(x, (2, 1)), (X,)),
    "split": (lambda x: jnp.split(x, 2, axis=1), (X,)),
    "pad": (lambda x: lax.pad(x, 0.5, [(1, 0, 1), (0, -1, 0)]), (X,)),
    "iota": (lambda x: x * jnp.arange(4), (X,)),
    **{f.__name__: (lambda x, f=f: (f(x), f(x, axis=1)), (X,)) for f in (jnp.sum, jnp.prod, jnp.max, jnp.min)},
    **{f.__name__: (f, (B,)) for f in (jnp.all, jnp.any)},
    **{f.__name__: (lambda x, f=f: f(x, axis=1), (X,)) for f in (jnp.argmax, jnp.argmin, jnp.cumsum, jnp.sort)},
    "cumsum_reverse": (lambda x: lax.cumsum(x, axis=0, reverse=True), (X,)),
    "dot_general": (lambda x, y: jnp.einsum("ij,kj->ik", x, y), (X, Y)),
    "dot_general_batched": (lambda x, y: jnp.einsum("ijk,ikl->ijl", x.reshape(2, 3, 2), y.reshape(2, 2, 3)), (X, Y)),
    "gather_known": (lambda x: x[KNOWN][:, KNOWN], (X,)),
    "gather_one": (lambda x, k: x[jnp.clip(k, 0, 2)], (X, AT)),
    "gather_beyond": (lambda x, k: x[k], (X, AT)),
    "gather_two": (lambda x, k: x[k[0], k[1]], (X, TO)),
    "gather_rows": (lambda x, k: x[:, k], (X, TO)),
    "gather_batched": (lambda x, k: jax.vmap(lambda r, i: r[i])(x[:2], k), (X, TO)),
    "dynamic_slice": (lambda x, k: lax.dynamic_slice(x, (k, jnp.int32(1)), (2, 2)), (X, AT)),
    "dynamic_update_slice": (lambda x, k: lax.dynamic_update_slice(x, jnp.ones((2, 2)), (k, jnp.int32(1))), (X, AT)),
    "scatter": (lambda x, y: x.at[KNOWN[:2], 1].set(y[:2, 0]), (X, Y)),
    "scatter_add_twice": (lambda x, y: x.at[KNOWN].add(y), (X, Y)),
    "scatter_mul": (lambda x, y: x.at[1:].multiply(y[1:]), (X, Y)),
    "scatter_somewhere": (lambda x, k: (x.at[k[0], k[1]].set(9.0), x.at[k[0]].add(1.0)), (X, TO)),
    "searchsorted": (lambda x: jnp.searchsorted(jnp.arange(4.0) - 2, x.reshape(-1)), (X,)),
    "table": (lambda x, k: jnp.asarray(np.linspace(0.0, 1.0, 4))[k] * x, (X, AT)),
    "jit": (lambda x: jax.jit(lambda y: y + 1.0)(x), (X,)),
    "custom_jvp": (jax.nn.relu, (X,)),
    "cond": (lambda x, k: lax.cond(k > 0, lambda y: y * 2, lambda y: y - 1, x), (X, AT)),
    "switch": (lambda x, k: lax.switch(k, [jnp.sin, jnp.cos, jnp.negative], x), (X, AT)),
    "scan": (lambda x: lax.scan(lambda c, r: (c + r, c * r), jnp.zeros(4), x), (X,)),
    "scan_reverse": (lambda x: lax.scan(lambda c, r: (c + r, c * r), jnp.zeros(4), x, reverse=True), (X,)),
    "fori_loop": (lambda x: lax.fori_loop(0, 4, lambda i, y: y * 0.5 + i, x), (X,)),
    "log1p": (lambda x: jnp.log1p(jnp.abs(x)), (X,)),
    "jvp": (lambda x, y: jax.jvp(lambda z: jnp.sin(z) / (2.0 + z**2), (x,), (y,)), (X, Y)),
}  # fmt: skip


def all_of_them() -> tuple[Callable[..., list[Any]], tuple[np.ndarray, ...], list[Any]]:
    """One function of all cases, so that a compiler runs once; its arguments, and what JAX makes of them."""
    kept = [case for case in CASES.values() if case[1][0].dtype.kind in "fbi"]
    args = tuple(arg for _, own in kept for arg in own)

    def function(*given: Any) -> list[Any]:
        left = list(given)
        return [one(*[left.pop(0) for _ in own]) for one, own in kept]

    return function, args, jax.tree.leaves(jax.vmap(function)(*args))


@pytest.mark.parametrize("name", CASES)
def test_rule_does_what_jax_does(name: str, x64: None):
    function, args = CASES[name]
    want = jax.tree.leaves(jax.vmap(function)(*args))
    for got, expected in zip(run_graph(function, args), want, strict=True):
        assert got.dtype == expected.dtype
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("rows", [False, True])
def test_a_long_loop_stays_one(rows: bool, x64: None):
    def function(x: Any) -> Any:
        def body(carry: Any, _: None) -> Any:
            a, b, n = carry
            return (b, a * 0.5 + jnp.sin(b) * x, n + 1), (a + n)

        end, left = lax.scan(body, (x, 2 * x, 0), None, length=4)
        return (*end, left[-1]) if rows else end

    program = program_of(function, (X,), rolled=1)
    assert len(program.graph.loops) == 1
    want = jax.tree.leaves(jax.vmap(function)(X))
    for got, expected in zip(run_graph(function, (X,), rolled=1), want, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12)


def test_rows_of_a_loop_other_than_the_last_are_refused(x64: None):
    def function(x: Any) -> Any:
        return lax.scan(lambda c, _: (c * x, c), x, None, length=4)[1][1]

    with pytest.raises(UnknownPrimitiveError, match="other than the last"):
        program_of(function, (X,), rolled=1)


def test_an_unknown_primitive_is_an_error_with_its_name(x64: None):
    with pytest.raises(UnknownPrimitiveError, match="'erf'"):
        program_of(lax.erf, (X,))
    with pytest.raises(UnknownPrimitiveError, match="random numbers of 64 bits"):
        program_of(lambda x: x + jax.random.normal(jax.random.key(jnp.int32(0)), x.shape), (X,))
    with pytest.raises(UnknownPrimitiveError, match="not threefry's"):
        program_of(lambda x: x + jax.random.uniform(jax.random.key(0, impl="rbg"), x.shape), (X,))


def drawn(seed: Any, tick: Any) -> Any:
    """As sensors draw their noise."""
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), tick), 3)
    return (
        jax.random.bits(keys[0], (4,)),
        jax.random.normal(keys[1], (20, 3)),
        jax.random.normal(keys[2], (2,)),
    )


def test_random_numbers_are_those_of_jax():
    seed, tick = RANDOM.integers(-(2**31), 2**31, (2, 50)).astype(np.int32)
    bits, *numbers = jax.vmap(drawn)(seed, tick)
    got_bits, *got = run_graph(drawn, (seed, tick))
    np.testing.assert_array_equal(got_bits, bits)
    for a, b in zip(got, numbers, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-7)
    assert np.abs(got[0]).max() > 3.0 and abs(got[0].mean()) < 0.1

"""Polynomials against SciPy and NumPy, which solve the same conditions in other bases."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import Legendre
from scipy.interpolate import BPoly, CubicSpline

from jaxbiped.planner.polynomial import (
    Term,
    between,
    boundary_polynomial,
    coupled_polynomials,
    quintic,
    shift,
    solve,
    spline_slopes,
)

DEGREES = range(3, 10)
CASES = 40
PATTERNS = {
    "swing height (khadiv Eq. 2)": ((0, 1, 2, 0, 0, 1, 2), (0, 0, 0, 1, 2, 2, 2)),
    "through four points": ((0, 0, 0, 0), (0, 1, 2, 3)),
    "mixed orders, unsorted": ((2, 0, 1, 0, 1, 2), (1, 2, 0, 1, 2, 0)),
}
"""Derivative orders of the conditions, and which of up to four random times each stands at."""


def _hermite(degree: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Orders of the conditions at the first and at the last time: half each, one more at the first."""
    at_start = (degree + 2) // 2
    return tuple(range(at_start)), tuple(range(degree + 1 - at_start))


def _random_spans(rng: np.random.Generator, cases: int) -> tuple[np.ndarray, np.ndarray]:
    start = rng.uniform(-5.0, 20.0, cases)
    return start, start + rng.uniform(0.2, 3.0, cases)


def _random_hermite(degree: int, seed: int):
    """Times, values and probes of random problems, and SciPy's value, velocity, acceleration there."""
    rng = np.random.default_rng(seed)
    first, last = _hermite(degree)
    start, end = _random_spans(rng, CASES)
    times = np.concatenate(
        [np.repeat(start[:, None], len(first), 1), np.repeat(end[:, None], len(last), 1)], 1
    )
    values = rng.normal(size=(CASES, degree + 1)) / (end - start)[:, None] ** np.array(first + last)
    probes = start[:, None] + (end - start)[:, None] * np.linspace(0.0, 1.0, 17)
    expected = np.empty((CASES, 3, 17))
    for i in range(CASES):
        derivatives = [values[i, : len(first)], values[i, len(first) :]]
        oracle = BPoly.from_derivatives([start[i], end[i]], derivatives)
        expected[i] = [oracle(probes[i], order) for order in (0, 1, 2)]
    return times, values, probes, expected


def _evaluate(orders: tuple[int, ...]):
    @jax.jit
    @jax.vmap
    def evaluate(times, values, probes):
        polynomial = boundary_polynomial(list(times), orders, list(values))
        met = [polynomial.derivative(t, order) for t, order in zip(times, orders, strict=True)]
        by_order = [jax.vmap(lambda t, o=order: polynomial.derivative(t, o))(probes) for order in (0, 1, 2)]
        return jnp.stack(by_order), jnp.stack(met), jax.vmap(polynomial)(probes)

    return evaluate


def _relative(got, expected, axis=-1):
    """Largest difference, relative to the largest expected number of the same curve."""
    return np.max(np.abs(np.asarray(got, float) - expected) / np.abs(expected).max(axis, keepdims=True))


@pytest.mark.parametrize("degree", DEGREES)
def test_boundary_polynomial_is_scipys(degree, x64):
    times, values, probes, expected = _random_hermite(degree, seed=degree)
    orders = sum(_hermite(degree), ())
    got, met, called = _evaluate(orders)(jnp.asarray(times), jnp.asarray(values), jnp.asarray(probes))
    assert _relative(got, expected) < 1e-11
    assert np.allclose(met, values, rtol=0.0, atol=1e-9 * np.abs(values).max())
    assert np.array_equal(called, got[:, 0])


@pytest.mark.parametrize(("degree", "tolerance"), [(3, 1e-6), (5, 5e-6), (6, 5e-6), (9, 5e-5)])
def test_boundary_polynomial_in_float32(degree, tolerance):
    """At times up to 20 s, where float32 resolves 2e-6 s; relative to the curve's largest value."""
    times, values, probes, _ = _random_hermite(degree, seed=degree)
    times, values, probes = (np.asarray(a, np.float32) for a in (times, values, probes))
    first, _ = _hermite(degree)
    expected = np.empty(probes.shape)
    for i in range(CASES):  # SciPy gets the rounded problem: only our own arithmetic is measured
        derivatives = [values[i, : len(first)].astype(float), values[i, len(first) :].astype(float)]
        expected[i] = BPoly.from_derivatives(times[i, [0, -1]].astype(float), derivatives)(probes[i])
    orders = sum(_hermite(degree), ())
    got, _, _ = _evaluate(orders)(jnp.asarray(times), jnp.asarray(values), jnp.asarray(probes))
    assert got.dtype == jnp.float32
    assert _relative(got[:, 0], expected) < tolerance


@pytest.mark.parametrize("pattern", PATTERNS)
def test_boundary_polynomial_with_conditions_in_between(pattern, x64):
    orders, places = PATTERNS[pattern]
    rng = np.random.default_rng(7)
    start, end = _random_spans(rng, CASES)
    inner = start[:, None] + (end - start)[:, None] * np.array([0.0, 0.45, 1.0, 0.7])
    times = inner[:, list(places)]
    values = rng.normal(size=times.shape) / (end - start)[:, None] ** np.array(orders)
    probes = start[:, None] + (end - start)[:, None] * np.linspace(0.0, 1.0, 17)
    got, met, _ = _evaluate(orders)(jnp.asarray(times), jnp.asarray(values), jnp.asarray(probes))
    expected = np.empty(got.shape)
    for i in range(CASES):
        basis = [Legendre.basis(k, domain=[start[i], end[i]]) for k in range(len(orders))]
        matrix = [[b.deriv(o)(t) for b in basis] for t, o in zip(times[i], orders, strict=True)]
        oracle = Legendre(np.linalg.solve(matrix, values[i]), domain=[start[i], end[i]])
        expected[i] = [oracle.deriv(order)(probes[i]) for order in (0, 1, 2)]
    assert _relative(got, expected) < 1e-10
    assert np.allclose(met, values, rtol=0.0, atol=1e-9 * np.abs(values).max())


def test_boundary_polynomial_derivatives_are_those_of_finite_differences(x64):
    """With respect to every time and every value, forward and reverse."""
    orders = (0, 1, 2, 0, 0, 1, 2)
    times = jnp.array([3.0, 3.0, 3.0, 3.4, 4.1, 4.1, 4.1])
    values = jnp.array([0.1, -0.3, 0.2, 0.5, 0.0, 0.4, -0.6])

    def curve(both):
        polynomial = boundary_polynomial(list(both[:7]), orders, list(both[7:]))
        probes = (3.1, 3.6, 4.0)
        return jnp.stack([polynomial.derivative(t, order) for t in probes for order in (0, 1, 2)])

    point = jnp.concatenate([times, values])
    steps = 1e-5 * jnp.eye(14)
    many = jax.jit(jax.vmap(curve))
    differences = np.asarray((many(point + steps) - many(point - steps)) / 2e-5).T
    forward, reverse = jax.jit(jax.jacfwd(curve))(point), jax.jit(jax.jacrev(curve))(point)
    scale = np.abs(differences).max(axis=0)
    assert np.all(scale > 0.03)  # every time and every value matters
    assert np.abs((forward - differences) / scale).max() < 1e-6
    assert np.abs((reverse - differences) / scale).max() < 1e-6


@pytest.mark.parametrize(
    ("times", "orders", "values"),
    [
        ([0.0, 1.0], (0, 0, 1), [0.0, 1.0, 2.0]),
        ([0.0, 0.0, 1.0], (0, 1, 0), [0.0, 1.0]),
        ([0.0, 0.0, 1.0], (0, 3, 0), [0.0, 1.0, 2.0]),
        ([0.0, 0.0, 1.0], (0, -1, 0), [0.0, 1.0, 2.0]),
    ],
)
def test_boundary_polynomial_refuses_wrong_conditions(times, orders, values):
    with pytest.raises(ValueError, match=r"got .*, allowed: "):
        boundary_polynomial(times, orders, values)


def test_coupled_polynomials_are_a_clamped_spline(x64):
    """Two cubics with continuous slope and curvature are SciPy's clamped spline through three points."""
    knots, points, ends = (2.0, 2.7, 4.0), (0.3, -0.2, 0.5), (0.4, -0.1)
    pieces = coupled_polynomials(
        [(knots[0], knots[1]), (knots[1], knots[2])],
        (3, 3),
        [
            ([Term(0, knots[0])], points[0]),
            ([Term(0, knots[1])], points[1]),
            ([Term(1, knots[1])], points[1]),
            ([Term(1, knots[2])], points[2]),
            ([Term(0, knots[0], 1)], ends[0]),
            ([Term(1, knots[2], 1, -2.0)], -2.0 * ends[1]),
            ([Term(0, knots[1], 1), Term(1, knots[1], 1, -1.0)], 0.0),
            ([Term(0, knots[1], 2), Term(1, knots[1], 2, -1.0)], 0.0),
        ],
    )
    clamped: Any = ((1, ends[0]), (1, ends[1]))
    spline = CubicSpline(knots, points, bc_type=clamped)
    for piece, (a, b) in zip(pieces, itertools.pairwise(knots), strict=True):
        for t in np.linspace(a, b, 5):
            for order in (0, 1, 2):
                assert np.isclose(piece.derivative(t, order), spline(t, order), rtol=0.0, atol=1e-12)


def test_coupled_polynomials_refuse_a_wrong_number_of_conditions():
    with pytest.raises(ValueError, match="conditions: got 1, allowed: 4, one a coefficient"):
        coupled_polynomials([(0.0, 1.0)], (3,), [([Term(0, 0.0)], 1.0)])


def side_by_side(pieces, breaks, used=None):
    """A piecewise polynomial; with `used` only so many of the inner pieces are."""
    inner = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pieces[1:-1])
    return between(pieces[0], inner, pieces[-1], breaks, len(pieces) - 2 if used is None else used)


def test_piecewise_polynomial_holds_its_ends_and_switches_at_the_breaks(x64):
    rng = np.random.default_rng(3)
    breaks = np.array([1.0, 1.8, 2.1, 3.5])
    nodes = rng.normal(size=(4, 3))
    nodes[0, 1:] = nodes[-1, 1:] = 0.0
    pieces = [quintic(breaks[i], breaks[i + 1], list(nodes[i]), list(nodes[i + 1])) for i in range(3)]
    cubic = boundary_polynomial([3.5, 3.5, 5.0, 5.0], (0, 1, 0, 1), [nodes[-1, 0], 0.0, 0.2, 0.0])
    curve = jax.jit(jax.vmap(side_by_side([*pieces, cubic], jnp.asarray([*breaks, 5.0]))))
    times = np.linspace(1.0, 3.5, 101)
    oracle = BPoly.from_derivatives(breaks, nodes)
    assert np.allclose(curve(jnp.asarray(times)), oracle(times), rtol=0.0, atol=1e-12)
    assert np.allclose(curve(jnp.array([-7.0, 0.99, 1.0])), nodes[0, 0], rtol=0.0, atol=1e-12)
    assert np.allclose(curve(jnp.array([5.0, 5.01, 60.0])), 0.2, rtol=0.0, atol=1e-12)


def test_piecewise_polynomial_belongs_to_the_right_piece_at_a_break(x64):
    def constant(value):
        return boundary_polynomial([0.0, 1.0], (0, 0), [value, value])

    times = (0.0, 1.0 - 1e-12, 1.0, 2.0 - 1e-12, 2.0, 3.0, 4.0)
    for others in (0, 2):  # pieces that there is room for, and that are not used
        pieces = [constant(1.0), constant(2.0), *[constant(9.0)] * others, constant(3.0)]
        steps = side_by_side(pieces, jnp.array([0.0, 1.0, 2.0, *[3.0] * (others + 1)]), used=1)
        at = [float(steps(jnp.asarray(t))) for t in times]
        assert np.allclose(at, [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 3.0], atol=1e-12)


@pytest.mark.parametrize("count", [2, 3, 17])
def test_spline_slopes_are_scipys(count, x64):
    rng = np.random.default_rng(count)
    knots = 4.0 + np.cumsum(rng.uniform(0.3, 1.5, count))
    values = rng.normal(size=count)
    slopes = spline_slopes(jnp.asarray(knots), jnp.asarray(values), 0.3, -0.7)
    clamped: Any = ((1, 0.3), (1, -0.7))
    oracle = CubicSpline(knots, values, bc_type=clamped)
    assert np.allclose(slopes, oracle(knots, 1), rtol=0.0, atol=1e-12)
    more, further = np.append(knots, knots[-1] + [1.0, 2.0, 3.0]), np.append(values, [7.0, 8.0, 9.0])
    roomy = spline_slopes(jnp.asarray(more), jnp.asarray(further), 0.3, -0.7, jnp.asarray(count))
    assert np.allclose(roomy[:count], slopes, rtol=0.0, atol=1e-12)


def test_shift_mirrors_raises_and_delays(x64):
    polynomial = quintic(1.0, 2.0, (0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    moved = shift(polynomial, 7.0, 3.0, -1.0)
    for t in (1.0, 1.4, 2.0):
        assert np.isclose(moved(t + 3.0), 7.0 - polynomial(t), rtol=0.0, atol=1e-13)
        assert np.isclose(moved.derivative(t + 3.0, 2), -polynomial.derivative(t, 2), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("n", [1, 4, 9, 48])
def test_solve_is_numpys(n, x64):
    """With zeros on the diagonal, so that rows must be exchanged."""
    rng = np.random.default_rng(n)
    matrices, right = rng.normal(size=(CASES, n, n)), rng.normal(size=(CASES, n))
    matrices[:, range(n - 1), range(n - 1)] = 0.0
    got = jax.jit(jax.vmap(solve))(jnp.asarray(matrices), jnp.asarray(right))
    residual = np.einsum("cij,cj->ci", matrices, got) - right
    assert np.abs(residual).max() < 1e-10
    for i in range(CASES):
        condition = np.linalg.cond(matrices[i])
        assert np.allclose(
            got[i], np.linalg.solve(matrices[i], right[i]), rtol=1e-13 * condition, atol=1e-14 * condition
        )

"""Polynomials from boundary conditions, and piecewise polynomials of time.

Conditions may stand at any times and on any derivative; coefficients are differentiable in times and values.
Time is scaled to [-1, 1] over the conditions before the linear system is solved, which keeps it well
conditioned in float32.
"""

from collections.abc import Sequence
from math import factorial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbiped import checked

Scalar = Float[Array, ""] | float


def as_scalar(value: Scalar) -> Float[Array, ""]:
    """A number as an array of JAX's default float type; the converter of parameter fields."""
    if isinstance(value, bool | np.bool_ | str):
        raise checked.Refusal(f"parameter: got {checked.shown(value)}, allowed: one number")
    with np.errstate(over="ignore"):  # becomes infinite, and is refused where its name is known
        return jnp.asarray(value, jnp.result_type(float))


class Polynomial(eqx.Module):
    """A polynomial of time about `centre`, in the scaled time s = (t - centre) / scale; or many, by a leading axis."""

    coefficients: Float[Array, "*many n"]
    """Coefficients of s**0, s**1, ..."""
    centre: Float[Array, "*many"]
    """Time at which the scaled time is 0 [s]."""
    scale: Float[Array, "*many"]
    """Time in a unit of the scaled time [s]."""

    def __call__(self, t: Scalar) -> Float[Array, ""]:
        """Value at time t [s]."""
        return _horner(self.coefficients, (t - self.centre) / self.scale)

    def derivative(self, t: Scalar, order: int = 1) -> Float[Array, ""]:
        """Derivative of the given order at time t [s]."""
        c = self.coefficients
        for _ in range(order):
            c = c[1:] * jnp.arange(1, c.shape[0], dtype=c.dtype)
        return _horner(c, (t - self.centre) / self.scale) / self.scale**order


def boundary_polynomial(
    times: Sequence[Scalar], orders: Sequence[int], values: Sequence[Scalar]
) -> Polynomial:
    """The polynomial of degree n - 1 with n conditions: derivative `orders[i]` at `times[i]` is `values[i]`.

    Args:
        times: n times [s], at least two of them different.
        orders: n derivative orders, 0 for the value.
        values: n values, in units of the quantity per second**order.

    Raises:
        ValueError: if the three differ in length, or an order cannot be a condition on degree n - 1.
    """
    n = len(values)
    if not len(times) == len(orders) == n:
        raise ValueError(
            f"conditions: got {len(times)} times, {len(orders)} orders, {n} values, allowed: as many of each"
        )
    if any(order < 0 or order >= n for order in orders):
        raise ValueError(f"orders: got {tuple(orders)}, allowed: 0 to {n - 1} with {n} conditions")
    t = jnp.stack([jnp.asarray(time, jnp.result_type(float)) for time in times])
    y = jnp.stack([jnp.asarray(value, t.dtype) for value in values])
    centre, scale = 0.5 * (t.max() + t.min()), 0.5 * (t.max() - t.min())
    rows = [_row((t[i] - centre) / scale, order, n) for i, order in enumerate(orders)]
    scaled = y * scale ** jnp.asarray(orders, t.dtype)
    return Polynomial(solve(jnp.stack(rows), scaled), centre, scale)


def solve(matrix: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solve a small linear system by Gauss-Jordan elimination with row pivoting.

    Not `jnp.linalg.solve`: several batched LAPACK calls in one program can block each other for ever on a CPU
    with few cores (jaxlib 0.10), and each of them takes long to compile.
    """
    n = right.shape[0]

    def eliminate(state, column):
        rows, free = state
        pivot = jnp.argmax(jnp.where(free, jnp.abs(rows[:, column]), -1.0))
        row = rows[pivot] / rows[pivot, column]
        rows = (rows - rows[:, column, None] * row).at[pivot].set(row)
        return (rows, free.at[pivot].set(False)), pivot

    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    (rows, _), pivots = jax.lax.scan(eliminate, (rows, jnp.ones(n, bool)), jnp.arange(n))
    return rows[pivots, n]


def _row(s: Float[Array, ""], order: int, n: int) -> Float[Array, " n"]:
    """The derivative of (1, s, s**2, ...) of the given order."""
    entries = [
        factorial(k) // factorial(k - order) * s ** (k - order) if k >= order else jnp.zeros_like(s)
        for k in range(n)
    ]
    return jnp.stack([jnp.asarray(entry, s.dtype) for entry in entries])


def quintic(start: Scalar, end: Scalar, at_start: Sequence[Scalar], at_end: Sequence[Scalar]) -> Polynomial:
    """Quintic from (position, velocity, acceleration) at time `start` to those at time `end`."""
    return boundary_polynomial([start] * 3 + [end] * 3, (0, 1, 2) * 2, [*at_start, *at_end])


class Term(NamedTuple):
    """One summand of a condition: `factor` times derivative `order` of piece number `piece` at `time` [s]."""

    piece: int
    time: Scalar
    order: int = 0
    factor: float = 1.0


def coupled_polynomials(
    spans: Sequence[tuple[Scalar, Scalar]],
    degrees: Sequence[int],
    conditions: Sequence[tuple[Sequence[Term], Scalar]],
) -> list[Polynomial]:
    """Several polynomials from linear conditions that may couple them (continuity, periodicity).

    Args:
        spans: first and last time of every piece [s], used for scaling only.
        degrees: degree of every piece.
        conditions: as many as there are coefficients; each says that its terms sum up to its value.

    Raises:
        ValueError: if the conditions do not number the coefficients.
    """
    sizes = [degree + 1 for degree in degrees]
    if len(conditions) != sum(sizes):
        raise ValueError(f"conditions: got {len(conditions)}, allowed: {sum(sizes)}, one a coefficient")
    centres = [0.5 * jnp.asarray(a + b, jnp.result_type(float)) for a, b in spans]
    scales = [0.5 * jnp.asarray(b - a, jnp.result_type(float)) for a, b in spans]
    offsets = [sum(sizes[:piece]) for piece in range(len(sizes))]
    matrix = jnp.zeros((sum(sizes), sum(sizes)), jnp.result_type(float))
    right = jnp.stack([jnp.asarray(value, matrix.dtype) for _, value in conditions])
    for i, (terms, _) in enumerate(conditions):
        for piece, time, order, factor in terms:
            row = _row((time - centres[piece]) / scales[piece], order, sizes[piece]) / scales[piece] ** order
            matrix = matrix.at[i, offsets[piece] : offsets[piece] + sizes[piece]].add(factor * row)
    solution = solve(matrix, right)
    split = jnp.split(solution, offsets[1:])
    return [Polynomial(c, centre, scale) for c, centre, scale in zip(split, centres, scales, strict=True)]


def _horner(coefficients: Float[Array, " n"], s: Scalar) -> Float[Array, ""]:
    value = coefficients[-1]
    for c in coefficients[-2::-1]:
        value = value * s + c
    return jnp.asarray(value)


class PiecewisePolynomial(eqx.Module):
    """Polynomials side by side; before the first and after the last the end value is held."""

    coefficients: Float[Array, "pieces n"]
    """Coefficients of the powers of the scaled time of each piece."""
    centre: Float[Array, "pieces"]
    """Time at which the scaled time of each piece is 0 [s]."""
    scale: Float[Array, "pieces"]
    """Time in a unit of the scaled time of each piece [s]."""
    breaks: Float[Array, "pieces+1"]
    """Times at which the pieces start and the last one ends, increasing [s]."""

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """Value at time t [s]."""
        t = jnp.clip(t, self.breaks[0], self.breaks[-1])
        piece = jnp.sum(t >= self.breaks[1:-1])
        return _horner(self.coefficients[piece], (t - self.centre[piece]) / self.scale[piece])


def taken(polynomials: Polynomial, which: int | slice | Int[Array, ""] | None) -> Polynomial:
    """One or some of the polynomials of a record with a leading axis; None adds that axis."""
    return jax.tree.map(lambda leaf: leaf[which], polynomials)


def alternating(first: Polynomial, second: Polynomial) -> Polynomial:
    """Polynomials of two records with leading axes, one of this and one of that in turn."""
    n = max(first.coefficients.shape[1], second.coefficients.shape[1])
    pair = _padded(first, n), _padded(second, n)
    return jax.tree.map(lambda a, b: jnp.stack([a, b], axis=1).reshape(-1, *a.shape[1:]), *pair)


def between(
    start: Polynomial,
    inner: Polynomial,
    stop: Polynomial,
    breaks: Float[Array, " m"],
    used: int | Int[Array, ""],
) -> PiecewisePolynomial:
    """Put polynomials side by side: one from rest, the `used` first of some, one to rest, which holds from there on.

    Args:
        start: the first piece.
        inner: pieces between them, with a leading axis.
        stop: the last piece.
        breaks: piece i holds from breaks[i] to breaks[i + 1] [s]; all after the last one used are the end.
        used: how many of the inner pieces are used.
    """
    n = max(piece.coefficients.shape[-1] for piece in (start, inner, stop))
    first, last = (taken(_padded(piece, n), None) for piece in (start, stop))
    pieces = jax.tree.map(lambda a, b, c: jnp.concatenate([a, b, c]), first, _padded(inner, n), last)
    number = jnp.arange(len(breaks) - 1)

    def ended(all_pieces: Array, end: Array) -> Array:
        goes_on = (number <= used).reshape(-1, *[1] * (all_pieces.ndim - 1))
        return jnp.where(goes_on, all_pieces, end)

    pieces = jax.tree.map(ended, pieces, last)
    return PiecewisePolynomial(pieces.coefficients, pieces.centre, pieces.scale, breaks)


def _padded(polynomial: Polynomial, n: int) -> Polynomial:
    """The same with n coefficients."""
    c = polynomial.coefficients
    padded = jnp.pad(c, [*[(0, 0)] * (c.ndim - 1), (0, n - c.shape[-1])])
    return Polynomial(padded, polynomial.centre, polynomial.scale)


def spline_slopes(
    knots: Float[Array, " m"],
    values: Float[Array, " m"],
    first: Scalar,
    last: Scalar,
    used: int | Int[Array, ""] | None = None,
) -> Float[Array, " m"]:
    """Slopes at the knots of the cubic spline (C2) through `values` with given first and last slope.

    With `used` it goes through so many knots; the slopes at all further ones are the last one.
    """
    h = jnp.diff(knots)
    secant = jnp.diff(values) / h
    m = len(knots)
    number, ahead, behind = jnp.arange(m), jnp.pad(1 / h, (0, 1)), jnp.pad(1 / h, (1, 0))
    inner = (number > 0) & (number < (m if used is None else used) - 1)
    tilt = 3.0 * jnp.pad(secant / h, (0, 1)) + 3.0 * jnp.pad(secant / h, (1, 0))
    diagonal = jnp.where(inner, 2.0 * (ahead + behind), 1.0)
    right = jnp.where(inner, tilt, jnp.where(number == 0, first, last))
    matrix = jnp.diag(diagonal)
    matrix = matrix + jnp.diag(jnp.where(inner, ahead, 0.0)[:-1], 1)
    matrix = matrix + jnp.diag(jnp.where(inner, behind, 0.0)[1:], -1)
    return solve(matrix, right)


def shift(polynomial: Polynomial, offset: Scalar, delay: Scalar, sign: Scalar = 1.0) -> Polynomial:
    """Return the curve mirrored by `sign`, raised by `offset` and `delay` seconds later."""
    coefficients = (polynomial.coefficients * sign).at[0].add(offset)
    return Polynomial(coefficients, polynomial.centre + delay, polynomial.scale)

"""Quintics by which adaptation gets from one motion to another."""

import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""]


def smooth(u: Scalar) -> Scalar:
    """Go from 0 at u <= 0 to 1 at u >= 1, with zero first and second derivatives at both ends (khadiv Eq. 16)."""
    u = jnp.clip(u, 0.0, 1.0)
    return u * u * u * (10.0 + u * (6.0 * u - 15.0))


def quintic_to_rest(t: Scalar, T: Array, v: Array, a: Array, way: Array) -> Array:
    """Go from (0, v, a) at t = 0 to (way, 0, 0) at T, and stay there (khadiv Eqs. 6 and 7)."""
    r = jnp.minimum(t / T, 1.0)  # not clipped at 0: there the velocity must be v, not half of it
    r2 = r * r
    r3 = r2 * r
    from_velocity = r + r3 * (-6.0 + r * (8.0 - 3.0 * r))
    from_acceleration = 0.5 * r2 + r3 * (-1.5 + r * (1.5 - 0.5 * r))
    return v * T * from_velocity + a * T * T * from_acceleration + way * r3 * (10.0 + r * (6.0 * r - 15.0))


def longest_time_to_rest(velocity: Scalar, acceleration: Scalar, way: Scalar) -> Scalar:
    """T*: the longest time [s] in which `quintic_to_rest` goes by -`way` < 0 without going any lower on the way.

    With v the downward speed and a the acceleration, that is so as long as a T^2 - 8 v T + 20 way >= 0; infinite where
    it holds for every T, or nothing moves down.
    """
    v = jnp.maximum(-velocity, 0.0)
    inside = 64.0 * v * v - 80.0 * acceleration * way
    safe = jnp.where(inside > 0.0, inside, 1.0)
    limit = 40.0 * way / (8.0 * v + jnp.sqrt(safe))
    return jnp.where((inside > 0.0) & (v > 0.0), limit, jnp.inf)

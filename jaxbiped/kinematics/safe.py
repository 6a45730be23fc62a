"""The functions whose derivative is infinite or undefined somewhere, guarded in one place and in the same words.

Each takes the singular point out of the differentiated branch (the argument itself is replaced before the function
sees it), so that values and derivatives are finite everywhere, forward and reverse.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def norm(vector: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Length of a vector over its last axis; at zero the value and the derivative are 0."""
    square = jnp.sum(vector * vector, axis=-1)
    at_zero = square == 0.0
    return jnp.where(at_zero, 0.0, jnp.sqrt(jnp.where(at_zero, 1.0, square)))


def sqrt(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Square root of max(x, 0); for x <= 0 the value and the derivative are 0."""
    clipped = x <= 0.0
    return jnp.where(clipped, 0.0, jnp.sqrt(jnp.where(clipped, 1.0, x)))


def atan2(y: Float[Array, "*batch"], x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Angle of the point (x, y); at the origin the value and the derivative are 0.

    The origin is all that lies within 1e-18 of it, where the squares in the derivative underflow in float32.
    """
    at_origin = (jnp.abs(x) < 1e-18) & (jnp.abs(y) < 1e-18)
    return jnp.where(at_origin, 0.0, jnp.arctan2(y, jnp.where(at_origin, 1.0, x)))

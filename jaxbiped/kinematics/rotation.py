"""Rotations about the frame axes. `rot_a_b` turns coordinates in frame b into coordinates in frame a."""

import jax.numpy as jnp
from jaxtyping import Array, Float

Rotation = Float[Array, "3 3"]


def about_x(angle: Float[Array, ""]) -> Rotation:
    """Rotation by `angle` [rad] about x."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3)


def about_y(angle: Float[Array, ""]) -> Rotation:
    """Rotation by `angle` [rad] about y."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)


def about_z(angle: Float[Array, ""]) -> Rotation:
    """Rotation by `angle` [rad] about z."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)


def unskew(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Vector w of the skew part of a matrix; of `dR/dt @ R.T` it is the angular velocity [rad/s]."""
    skew = 0.5 * (matrix - jnp.swapaxes(matrix, -1, -2))
    return jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)

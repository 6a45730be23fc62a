"""Readings of the robot's sensors: all that a controller ever learns of the world."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Sensed(eqx.Module):
    """One reading of every sensor."""

    time: Float[Array, ""]
    """Time since the start of the walk [s]."""
    switch: Bool[Array, "2 4"]
    """Contact switches at the sole corners, closed or open."""
    switch_time: Float[Array, "2 4"]
    """Time at which each switch last closed, interpolated inside the tick [s]; infinite if it never has."""
    corner_force: Float[Array, "2 4"]
    """Vertical force at each sole corner [N]."""
    ankle_wrench: Float[Array, "2 6"]
    """Force [N] and moment [N m] of the ground on each foot about the ankle center, foot axes."""
    angle: Float[Array, "2 6"]
    """Joint angles [rad]."""
    speed: Float[Array, "2 6"]
    """Joint speeds [rad/s]."""
    roll_pitch: Float[Array, "2"]
    """Roll and pitch of the trunk [rad]."""
    rate: Float[Array, "3"]
    """Angular velocity of the trunk, trunk axes [rad/s]."""
    zmp_world: Float[Array, "2"]
    """Center of the vertical ground forces, world axes [m]."""
    zmp_body: Float[Array, "2"]
    """Center of the vertical ground forces relative to the pelvis, heading axes [m]."""

    @classmethod
    def nothing(cls, time: Float[Array, ""], **felt: Array) -> "Sensed":
        """Reading of the clock only: switches open for ever, all else zero, except for what is given."""

        def zeros(*shape: int) -> Array:
            return jnp.zeros(shape, time.dtype)

        blind = {
            "switch": zeros(2, 4) > 0.0,
            "switch_time": zeros(2, 4) + jnp.inf,
            "corner_force": zeros(2, 4),
            "ankle_wrench": zeros(2, 6),
            "angle": zeros(2, 6),
            "speed": zeros(2, 6),
            "roll_pitch": zeros(2),
            "rate": zeros(3),
            "zmp_world": zeros(2),
            "zmp_body": zeros(2),
        }
        return cls(time, **{**blind, **felt})

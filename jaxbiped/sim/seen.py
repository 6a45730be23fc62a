"""State that a physics tick saw at its start: all that sensors, statistics and traces learn of the physics."""

import equinox as eqx
from jaxtyping import Array, Float


class Seen(eqx.Module):
    """Places, orientations and forces at one instant, from any engine; with leading axes, at many instants."""

    p_world_trunk: Float[Array, "*n 3"]
    """Pelvis frame origin [m]."""
    rot_world_trunk: Float[Array, "*n 3 3"]
    """Orientation of the trunk."""
    p_world_foot: Float[Array, "*n 2 3"]
    """Ankle centers [m]."""
    rot_world_foot: Float[Array, "*n 2 3 3"]
    """Orientation of the feet."""
    p_world_corner: Float[Array, "*n 2 4 3"]
    """Sole corners [m]."""
    gap: Float[Array, "*n 2 4"]
    """Height of every sole corner over the ground under it [m]."""
    force: Float[Array, "*n 2 4 3"]
    """Ground force at every sole corner, world axes [N]."""
    torque: Float[Array, "*n 2 6"]
    """Torques of the servos [N m]."""

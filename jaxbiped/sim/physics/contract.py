"""Inputs and outputs of every physics engine."""

from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, Float, Int

from jaxbiped.sim.plant import Plant
from jaxbiped.sim.seen import Seen
from jaxbiped.sim.servo import Reference


class Physics(eqx.Module):
    """State of the physics that is carried from tick to tick."""

    tick: Int[Array, "*n"]
    """Number of physics ticks done."""
    qpos: Float[Array, "*n nq"]
    """MuJoCo's coordinates."""
    qvel: Float[Array, "*n nv"]
    """MuJoCo's velocities."""
    integral: Float[Array, "*n 2 6"]
    """Integral of the servos' position errors [rad s]."""
    pressed: Float[Array, "*n 2 4"]
    """Normal force at every sole corner in the last tick, on which the compliant ground's friction depends [N]."""


Advance = Callable[[Plant, float, Reference, Physics], tuple[Physics, Seen]]
"""Physics tick: (plant, duration [s], servo reference, physics) -> (physics after it, `Seen` at its start)."""

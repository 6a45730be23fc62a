"""What every engine takes and returns."""

from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, Float, Int

from jaxbiped.sim.plant import Plant
from jaxbiped.sim.seen import Seen
from jaxbiped.sim.servo import Reference


class Physics(eqx.Module):
    """What the physics carries from tick to tick."""

    tick: Int[Array, "*n"]
    """Physics ticks done."""
    qpos: Float[Array, "*n nq"]
    """MuJoCo's coordinates."""
    qvel: Float[Array, "*n nv"]
    """MuJoCo's velocities."""
    integral: Float[Array, "*n 2 6"]
    """Integral of the servos' position errors [rad s]."""
    pressed: Float[Array, "*n 2 4"]
    """Normal force at every sole corner in the last tick, which the compliant ground's friction goes by [N]."""


Advance = Callable[[Plant, float, Reference, Physics], tuple[Physics, Seen]]
"""A physics tick of so long [s] under a reference of the servos: the physics after it, and what it saw at its start."""

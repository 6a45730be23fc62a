"""Torque feed-forward: the plan's inverse dynamics, tabulated once per walk.

It removes the sag of the servos under load, which landing adaptation would otherwise mistake for an obstacle.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped import runtime
from jaxbiped.planner.feasibility import instant
from jaxbiped.robot import RobotParams

_TOGETHER = 128
"""Rows computed at once."""


class FeedForward(eqx.Module):
    """Joint torques over the time of the plan."""

    torque: Float[Array, "n 2 6"]
    """[N m]"""
    interval: float = eqx.field(static=True)
    """Between two rows [s]."""

    def at(self, plan_time: Float[Array, ""]) -> Float[Array, "2 6"]:
        """Torques at a time of the plan [s], interpolated linearly."""
        place = jnp.clip(plan_time / self.interval, 0.0, self.torque.shape[0] - 1.0)
        row = jnp.minimum(place.astype(jnp.int32), self.torque.shape[0] - 2)
        share = place - row
        return self.torque[row] * (1.0 - share) + self.torque[row + 1] * share


def none() -> FeedForward:
    """No feed-forward."""
    return FeedForward(jnp.zeros((2, 2, 6)), 1.0)


@runtime.jit
def plan(robot: RobotParams, gait: Any, duration: float, interval: float = 0.005) -> FeedForward:
    """Tabulate the plan's joint torques; the feet share the ground wrench by the ZMP."""
    rows = _TOGETHER * (
        int(duration / interval + 2) // _TOGETHER + 1
    )  # whole batches: a last, shorter one compiles anew
    times = jnp.arange(rows) * interval
    torque = jax.lax.map(lambda t: instant(robot, gait, t).torque, times, batch_size=_TOGETHER)
    return FeedForward(torque, interval)

"""Torque feed-forward: the plan's inverse dynamics, tabulated once per walk.

It removes the sag of the servos under load, which landing adaptation would otherwise mistake for an obstacle.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped import runtime
from jaxbiped.planner import Plan, at, feasibility, is_concrete
from jaxbiped.planner.feasibility import Frozen, instant
from jaxbiped.robot import RobotParams

_TOGETHER = 128
"""Rows computed at once."""
_LONGER = 1.3
"""Factor by which a tuned gait may last longer."""


class FeedForward(eqx.Module):
    """Joint torques over the time of the plan."""

    torque: Float[Array, "n 2 6"]
    """Torques of the joints [N m]."""
    interval: float = eqx.field(static=True)
    """Time between two rows [s]."""

    def at(self, plan_time: Float[Array, ""]) -> Float[Array, "2 6"]:
        """Torques at a time of the plan [s], interpolated linearly."""
        place = jnp.clip(plan_time / self.interval, 0.0, self.torque.shape[0] - 1.0)
        row = jnp.minimum(place.astype(jnp.int32), self.torque.shape[0] - 2)
        share = place - row
        return self.torque[row] * (1.0 - share) + self.torque[row + 1] * share


def none() -> FeedForward:
    """Return an empty table: no feed-forward."""
    return FeedForward(jnp.zeros((2, 2, 6)), 1.0)


def rows(gait: Plan, interval: float = 0.005) -> int:
    """Rows of a table for a gait, also if it is tuned and lasts longer; as many for every gait with its room."""
    timing = gait.timing
    longest = float(gait.duration) + (timing.room - int(timing.n_steps)) * float(timing.T_c)
    return _TOGETHER * (int(_LONGER * longest / interval + 2) // _TOGETHER + 1)


def plan(robot: RobotParams, gait: Plan, rows: int, interval: float = 0.005) -> FeedForward:
    """Tabulate the plan's joint torques; the feet share the ground wrench by the ZMP."""
    times = jnp.arange(rows) * interval
    if is_concrete(robot, gait):
        return FeedForward(feasibility(robot, gait, times).torque, interval)
    return FeedForward(_torques(robot, gait, times), interval)


@runtime.jit
def _torques(robot: RobotParams, gait: Plan, times: Float[Array, " n"]) -> Float[Array, "n 2 6"]:
    return jax.lax.map(
        lambda t: instant(robot, Frozen(at(gait, t)), jnp.zeros_like(t)).torque, times, batch_size=_TOGETHER
    )

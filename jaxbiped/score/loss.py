"""Losses: the cost of a walk, smooth in the numbers of its controller, for tuning by gradients.

A loss integrates rates over a walk and makes one number of the integrals and of the walk's last state. Rates have to be
continuous in time: a rate that jumps at an event gives a derivative that misses the shift of the event. Nor may they
look at single forces: a touchdown lasts a tick or two, and a power of what a sample meets of it goes up and down as the
touch moves through a tick. The low-passed forces, which keep the impulse, do not. After a failure only the lean goes
on, at its greatest, so that a later fall costs less; the rest is masked. What a walk can cost is bounded: derivatives
of walks that fall grow beyond any use, and would drown those of all others in a mean.
"""

import math
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxbiped import sim
from jaxbiped.kinematics import GRAVITY
from jaxbiped.robot import RobotParams
from jaxbiped.sim.statistics import FALL_TILT

Scalar = Float[Array, ""]


@runtime_checkable
class Loss(Protocol):
    """Interface of a loss; anyone can write one."""

    def rate(self, robot: RobotParams, sample: sim.Sample, upright: Bool[Array, ""]) -> Float[Array, " m"]:
        """Rates to be integrated over the walk [1/s], from one sample and whether the robot has not failed so far."""
        ...

    def total(self, integral: Float[Array, " m"], walk: sim.Walk, duration: Scalar) -> Scalar:
        """The loss of a walk that was simulated for `duration` [s]; traced, for one program for all."""
        ...


class WalkLoss(eqx.Module):
    """Tilt, lean, touchdown force and impulse, slip, ZMP margin and delay, each over what is usual, with its weight."""

    tilt: float = 1.0
    """Weight of the mean squared roll and pitch over (2 deg)2."""
    lean: float = 5.0
    """Weight of the mean squared tilt beyond 10 deg, in units of 10 deg; pulls back walks about to fall."""
    force: float = 1.0
    """Weight of the low-passed touchdown force beyond the robot's weight, as a fourth mean over 10 ms."""
    impulse: float = 5.0
    """Weight of the integral of that force [s]."""
    slip: float = 0.1
    """Weight of the slips of both feet [cm]."""
    margin: float = 1.0
    """Weight of the mean squared shortfall of the centers of pressure from 20 mm inside the soles."""
    delay: float = 0.05
    """Weight of the time for which the plan stood still [s]."""
    bound: float = 5.0
    """Largest cost of a walk, see `bounded`."""

    def rate(self, robot: RobotParams, sample: sim.Sample, upright: Bool[Array, ""]) -> Float[Array, " m"]:
        """Rates to be integrated over the walk, see `Loss.rate`."""
        tilt = sample.roll_pitch_yaw[:2]
        over = jnp.clip(jnp.max(jnp.abs(tilt)), 0.0, FALL_TILT) - _LEAN
        weight = robot.total_mass * GRAVITY
        assert sample.filtered_corner_force is not None
        excess = jnp.maximum(sample.filtered_corner_force.sum(axis=1) / weight - 1.0, 0.0)
        share, inside = _pressure_margin(robot, sample.filtered_corner_force)
        short = jnp.maximum(1.0 - inside / _MARGIN, 0.0)
        masked = jnp.stack(
            [
                jnp.sum((tilt / _TILT) ** 2),
                jnp.sum(excess**4) / _TOUCH,
                jnp.sum(excess),
                jnp.sum(share * short**2),
            ]
        )
        lean = jnp.where(upright, jnp.maximum(over, 0.0), FALL_TILT - _LEAN)
        return jnp.concatenate([jnp.where(upright, masked, 0.0), (lean[None] / _LEAN) ** 2])

    def total(self, integral: Float[Array, " m"], walk: sim.Walk, duration: Scalar) -> Scalar:
        """The loss of a walk, see `Loss.total`."""
        tilt, force, impulse, margin, lean = integral
        cost = (
            self.tilt * tilt / duration
            + self.lean * lean / duration
            + self.force * (force + 1e-6) ** 0.25
            + self.impulse * impulse
            + self.slip * 100.0 * jnp.sum(walk.statistics.peak_slip)
            + self.margin * margin / duration
            + self.delay * _delay(walk)
        )
        return bounded(cost, self.bound)


def bounded(cost: Scalar, bound: float) -> Scalar:
    """Bound a cost smoothly: half the bound where it equals that, nearly itself where it is small."""
    return cost / (1.0 + cost / bound)


_TILT, _LEAN = math.radians(2.0), math.radians(10.0)
_TOUCH = 0.01
"""Time over which the excess of the touchdown force is averaged [s]."""
_MARGIN = 0.02
"""Distance from the edge of a sole below which the center of pressure costs something [m]."""


def _pressure_margin(
    robot: RobotParams, corner_force: Float[Array, "2 4"]
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Share of the weight on each foot, and how far its center of pressure is inside its sole [m]; no jumps.

    A corner that is drawn down, as by an edge it rubs along, counts for nothing.
    """
    corner_force = jnp.maximum(corner_force, 0.0)
    total = corner_force.sum(axis=1)
    share = total / (robot.total_mass * GRAVITY)
    centre = jnp.einsum("fc,fci->fi", corner_force, robot.p_sole_corner[..., :2])
    centre = centre / jnp.maximum(total, 1.0)[:, None]
    low, high = robot.p_sole_corner[..., :2].min(axis=1), robot.p_sole_corner[..., :2].max(axis=1)
    return share, jnp.min(jnp.minimum(centre - low, high - centre), axis=1)


def _delay(walk: sim.Walk) -> Scalar:
    """Time for which the plan stood still [s]."""
    controller = walk.controller
    if controller is None:
        return jnp.zeros_like(walk.statistics.end_time)
    return jnp.maximum(controller.time - controller.plan_time, 0.0)

"""Newton and Euler on every link of a prescribed motion: ground wrench, and the joint torques that it takes.

A motion is a function of time; velocities and accelerations come from differentiating it twice (forward mode), so the
full multibody model enters: all 13 links with their inertias, not a point mass.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.kinematics.body import BodyPose, com_of_links
from jaxbiped.kinematics.rotation import unskew
from jaxbiped.robot import RobotParams, on_device

GRAVITY = 9.81
"""Gravitational acceleration [m/s2]."""

Motion = Callable[[Float[Array, ""]], tuple[BodyPose, Float[Array, "2 6"]]]
"""Function of time [s]: the places of the links and the joint angles [rad]."""


class Wrench(eqx.Module):
    """A force and its moment about the world's origin."""

    force: Float[Array, "*batch 3"]
    """Force [N]."""
    moment: Float[Array, "*batch 3"]
    """Moment about the world's origin [N m]."""

    def __add__(self, other: "Wrench") -> "Wrench":
        """Sum of two wrenches."""
        return Wrench(self.force + other.force, self.moment + other.moment)

    def __sub__(self, other: "Wrench") -> "Wrench":
        """Difference of two wrenches."""
        return Wrench(self.force - other.force, self.moment - other.moment)


class MotionState(eqx.Module):
    """A motion at one instant, and the wrench every link needs to follow it."""

    body: BodyPose
    """Places and orientations of the links."""
    angle: Float[Array, "*batch 2 6"]
    """Joint angles [rad]."""
    speed: Float[Array, "*batch 2 6"]
    """Joint speeds [rad/s]."""
    acceleration: Float[Array, "*batch 2 6"]
    """Joint accelerations [rad/s2]."""
    link_wrench: Wrench
    """(..., 13) Rate of change of every link's momentum, less its weight [N, N m]."""

    @property
    def ground_wrench(self) -> Wrench:
        """Total wrench that the ground must give."""
        return Wrench(self.link_wrench.force.sum(-2), self.link_wrench.moment.sum(-2))


def evaluate(robot: RobotParams, motion: Motion, time: Float[Array, ""]) -> MotionState:
    """Differentiate a motion twice at `time` [s] and sum up Newton and Euler for every link."""
    robot = on_device(robot)

    def momenta(t: Float[Array, ""]):
        (body, angle), (body_rate, speed) = jax.jvp(motion, (t,), (jnp.ones_like(t),))
        c, c_rate = jax.jvp(lambda b: com_of_links(robot, b), (body,), (body_rate,))
        rotation = body.rot_world_link
        omega = unskew(body_rate.rot_world_link @ jnp.swapaxes(rotation, -1, -2))
        inertia = rotation @ robot.links.inertia @ jnp.swapaxes(rotation, -1, -2)
        linear = robot.links.mass[:, None] * c_rate
        angular = jnp.einsum("nij,nj->ni", inertia, omega)
        return (linear, angular, speed), (body, angle, c)

    (_, _, speed), (force, moment, acceleration), (body, angle, c) = jax.jvp(
        momenta, (time,), (jnp.ones_like(time),), has_aux=True
    )
    force = force.at[:, 2].add(robot.links.mass * GRAVITY)
    return MotionState(
        body=body,
        angle=angle,
        speed=speed,
        acceleration=acceleration,
        link_wrench=Wrench(force, moment + jnp.cross(c, force)),
    )


def joint_torques(robot: RobotParams, state: MotionState, foot_wrench: Wrench) -> Float[Array, "2 6"]:
    """Joint torques [N m] of a motion whose feet receive `foot_wrench` (2,) from the ground.

    The torque of a joint is the part along its axis of everything the links beyond it need and the ground does not
    give, about a point on the axis, plus armature times joint acceleration.
    """
    legs = Wrench(
        *(leaf[1:].reshape(2, 6, 3) for leaf in (state.link_wrench.force, state.link_wrench.moment))
    )
    beyond = Wrench(*(jnp.cumsum(leaf[:, ::-1], axis=1)[:, ::-1] for leaf in (legs.force, legs.moment)))
    needed = beyond - Wrench(foot_wrench.force[:, None], foot_wrench.moment[:, None])
    about_joint = needed.moment - jnp.cross(state.body.p_world_joint, needed.force)
    torque = jnp.sum(state.body.axis_world_joint * about_joint, axis=-1)
    return torque + on_device(robot).servo.armature * state.acceleration

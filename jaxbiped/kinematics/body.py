"""The whole robot: poses of the 13 links, and the two legs' joint angles at once."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxbiped.kinematics import leg
from jaxbiped.robot import JOINT_AXES, LEFT, RIGHT, RobotParams, on_device


class BodyPose(eqx.Module):
    """Places and orientations of all links and soles in the world."""

    p_world_link: Float[Array, "*batch link 3"]
    """Origins of the link frames [m]."""
    rot_world_link: Float[Array, "*batch link 3 3"]
    """Orientation of the link frames."""
    p_world_sole: Float[Array, "*batch 2 3"]
    """Origins of the sole frames [m]."""

    @property
    def p_world_joint(self) -> Float[Array, "*batch 2 6 3"]:
        """A point on every joint axis [m]: the origin of the link it moves."""
        points = self.p_world_link[..., 1:, :]
        return points.reshape(*points.shape[:-2], 2, 6, 3)

    @property
    def axis_world_joint(self) -> Float[Array, "*batch 2 6 3"]:
        """Unit vector along every joint axis."""
        columns = ["xyz".index(axis) for axis in JOINT_AXES] * 2
        axes = [self.rot_world_link[..., 1 + link, :, column] for link, column in enumerate(columns)]
        return jnp.stack(axes, axis=-2).reshape(*axes[0].shape[:-1], 2, 6, 3)


def pose(
    robot: RobotParams,
    p_world_pelvis: Float[Array, "3"],
    rot_world_pelvis: Float[Array, "3 3"],
    angle: Float[Array, "2 6"],
) -> BodyPose:
    """Forward kinematics of the whole robot from the pelvis pose and the joint angles [rad]."""
    legs = [leg.forward(robot, side, angle[side]) for side in (LEFT, RIGHT)]
    points = jnp.concatenate([jnp.zeros((1, 3), angle.dtype), *(one.p_pelvis_link for one in legs)])
    rotations = jnp.concatenate([jnp.eye(3, dtype=angle.dtype)[None], *(one.rot_pelvis_link for one in legs)])
    soles = jnp.stack([one.p_pelvis_sole for one in legs])
    return BodyPose(
        p_world_link=p_world_pelvis + points @ rot_world_pelvis.T,
        rot_world_link=rot_world_pelvis @ rotations,
        p_world_sole=p_world_pelvis + soles @ rot_world_pelvis.T,
    )


def com_of_links(robot: RobotParams, body: BodyPose) -> Float[Array, "link 3"]:
    """Center of mass of every link in the world [m]."""
    return body.p_world_link + jnp.einsum("nij,nj->ni", body.rot_world_link, on_device(robot).links.com)


def com(robot: RobotParams, body: BodyPose) -> Float[Array, "3"]:
    """Center of mass of the robot in the world [m]."""
    robot = on_device(robot)
    return robot.links.mass @ com_of_links(robot, body) / robot.total_mass


def joint_angles(
    robot: RobotParams,
    p_pelvis_sole: Float[Array, "2 3"],
    rot_pelvis_sole: Float[Array, "2 3 3"] | None = None,
) -> tuple[Float[Array, "2 6"], Int[Array, "2"]]:
    """Inverse kinematics of both legs; soles parallel to the pelvis unless a rotation is given.

    Returns:
        Angles (2, 6) [rad] and the status (2,) of `leg.inverse`.
    """
    rotation: Float[Array, "2 3 3"] = jnp.broadcast_to(jnp.eye(3, dtype=p_pelvis_sole.dtype), (2, 3, 3))
    if rot_pelvis_sole is not None:
        rotation = rot_pelvis_sole
    found = jax.vmap(leg.inverse, (None, 0, 0, 0))(robot, jnp.arange(2), p_pelvis_sole, rotation)
    return found.angle, found.status

"""One leg: forward kinematics, and the closed-form inverse of Park et al. (2012) by the reversed chain.

Joints from the hip down: yaw z, roll x, pitch y (meeting in the hip center), knee y, ankle pitch y, ankle roll x
(meeting in the ankle center). `hip` is the frame of the pelvis moved to the hip center, `sole` the sole frame.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.kinematics import safe
from jaxbiped.kinematics.rotation import about_x, about_y, about_z
from jaxbiped.robot import JOINT_AXES, RobotParams, on_device

OK, OUT_OF_REACH, AT_JOINT_LIMIT = 0, 1, 2
STATUS_TEXT = ("ok", "out of reach", "at a joint limit")
STRAIGHT_KNEE = 0.01
"""Smallest knee bend the inverse gives [rad]. A knee at 0 has an infinite derivative; 0.01 rad costs 9 micrometers
of reach on a leg of 2 x 0.36 m."""

_ABOUT = {"x": about_x, "y": about_y, "z": about_z}


class LegPose(eqx.Module):
    """Places and orientations of the six link frames of a leg and of its sole, in the pelvis frame."""

    p_pelvis_link: Float[Array, "*batch 6 3"]
    """Origins of the link frames [m]."""
    rot_pelvis_link: Float[Array, "*batch 6 3 3"]
    """Orientation of the link frames; the last one is the sole's too."""
    p_pelvis_sole: Float[Array, "*batch 3"]
    """Origin of the sole frame [m]."""

    @property
    def rot_pelvis_sole(self) -> Float[Array, "*batch 3 3"]:
        """Orientation of the sole."""
        return self.rot_pelvis_link[..., -1, :, :]


class LegAngles(eqx.Module):
    """Result of the inverse kinematics."""

    angle: Float[Array, "*batch 6"]
    """Joint angles, hip yaw to ankle roll [rad]."""
    status: Int[Array, "*batch"]
    """OK, OUT_OF_REACH or AT_JOINT_LIMIT; the first that applies, in the order out of reach, joint limit."""


def forward(robot: RobotParams, side: int | Int[Array, ""], angle: Float[Array, "6"]) -> LegPose:
    """Forward kinematics of the leg on `side` (0 left, 1 right) at joint angles (6,) [rad]."""
    robot = on_device(robot)
    hip = robot.p_pelvis_hip[side]
    rotations = []
    rotation = jnp.eye(3, dtype=angle.dtype)
    for joint, axis in enumerate(JOINT_AXES):
        rotation = rotation @ _ABOUT[axis](angle[joint])
        rotations.append(rotation)
    knee = hip - robot.thigh_length * rotations[2][:, 2]
    ankle = knee - robot.shank_length * rotations[3][:, 2]
    return LegPose(
        p_pelvis_link=jnp.stack([hip, hip, hip, knee, ankle, ankle]),
        rot_pelvis_link=jnp.stack(rotations),
        p_pelvis_sole=ankle - robot.ankle_height * rotation[:, 2],
    )


def inverse(
    robot: RobotParams,
    side: int | Int[Array, ""],
    p_pelvis_sole: Float[Array, "3"],
    rot_pelvis_sole: Float[Array, "3 3"],
) -> LegAngles:
    """Closed-form inverse kinematics for any sole position (3,) [m] and rotation (3, 3).

    Reversed chain (Park et al. 2012): seen from the sole, the hip center depends on the knee and the two ankle joints
    alone, which follow from it; the three hip joints follow from the rotation that is left. A target beyond reach is
    moved along the line from hip to ankle to the nearest reachable one; angles beyond the joint ranges are clipped to
    them. Never NaN; derivatives are finite everywhere.
    """
    robot = on_device(robot)
    r = _hip_in_sole_frame(robot, side, p_pelvis_sole, rot_pelvis_sole)
    knee, reachable = _knee(robot, side, safe.norm(r))
    pitch, roll = _ankle(robot, side, r, knee)
    hip = _hip(rot_pelvis_sole @ about_x(-roll) @ about_y(-knee - pitch))
    angle = jnp.concatenate([hip, jnp.stack([knee, pitch, roll])])
    lower, upper = robot.joint_range[side, :, 0], robot.joint_range[side, :, 1]
    within = jnp.all((angle >= lower) & (angle <= upper))
    status = jnp.where(reachable, jnp.where(within, OK, AT_JOINT_LIMIT), OUT_OF_REACH)
    return LegAngles(angle=jnp.clip(angle, lower, upper), status=status)


def reach(robot: RobotParams, side: int | Int[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Smallest and largest distance between hip center and ankle center [m], from the knee's range."""
    robot = on_device(robot)
    bend = robot.joint_range[side, 3]
    return _hip_to_ankle(robot, bend[1]), _hip_to_ankle(robot, jnp.maximum(bend[0], STRAIGHT_KNEE))


def _hip_to_ankle(robot: RobotParams, knee: Float[Array, ""]) -> Float[Array, ""]:
    a, b = robot.thigh_length, robot.shank_length
    return jnp.sqrt(a * a + b * b + 2.0 * a * b * jnp.cos(knee))


def _hip_in_sole_frame(
    robot: RobotParams,
    side: int | Int[Array, ""],
    p_pelvis_sole: Float[Array, "3"],
    rot_pelvis_sole: Float[Array, "3 3"],
) -> Float[Array, "3"]:
    """Hip center seen from the ankle center, sole axes [m]."""
    from_sole = rot_pelvis_sole.T @ (robot.p_pelvis_hip[side] - p_pelvis_sole)
    return from_sole.at[2].add(-robot.ankle_height)


def _knee(
    robot: RobotParams, side: int | Int[Array, ""], distance: Float[Array, ""]
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Knee angle for a distance between hip and ankle, and whether that distance can be reached.

    The law of cosines by the half angle: tan(knee / 2) loses no digits near the straight knee.
    """
    shortest, longest = reach(robot, side)
    slack = 1e-6 * longest
    reachable = (distance >= shortest - slack) & (distance <= longest + slack)
    d = jnp.clip(distance, shortest, longest)
    a, b = robot.thigh_length, robot.shank_length
    bent = safe.sqrt((a + b - d) * (a + b + d))
    stretched = safe.sqrt((d - a + b) * (d + a - b))
    return 2.0 * safe.atan2(bent, stretched), reachable


def _ankle(
    robot: RobotParams, side: int | Int[Array, ""], r: Float[Array, "3"], knee: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Ankle pitch and roll that point the leg at the hip, `r` = hip from ankle in the sole frame [m].

    Two pairs do, half a turn of roll apart: the leg leans over the front or the back of the foot, or it goes round past
    the horizontal, as in a deep squat. The pair that leaves the ankle's joint ranges by less is the one.
    """
    a, b = robot.thigh_length, robot.shank_length
    shank, thigh = b + a * jnp.cos(knee), a * jnp.sin(knee)
    height = safe.norm(r[1:])

    def pitch(height: Float[Array, ""]) -> Float[Array, ""]:
        return safe.atan2(-thigh * height - shank * r[0], shank * height - thigh * r[0])

    roll = safe.atan2(r[1], r[2])
    turned = jnp.where(roll > 0.0, roll - jnp.pi, roll + jnp.pi)
    pairs = jnp.stack([jnp.stack([pitch(height), roll]), jnp.stack([pitch(-height), turned])])
    lower, upper = robot.joint_range[side, 4:, 0], robot.joint_range[side, 4:, 1]
    excess = jnp.sum(jnp.abs(pairs - jnp.clip(pairs, lower, upper)), axis=1)
    ankle = jnp.where(excess[0] <= excess[1], pairs[0], pairs[1])
    return ankle[0], ankle[1]


def _hip(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Yaw, roll and pitch of `rotation` = Rz(yaw) Rx(roll) Ry(pitch), |roll| <= 90 degrees; at 90 the yaw is 0."""
    yaw = safe.atan2(-rotation[0, 1], rotation[1, 1])
    roll = safe.atan2(rotation[2, 1], safe.norm(rotation[:2, 1]))
    roll_and_pitch = about_z(-yaw) @ rotation
    pitch = safe.atan2(roll_and_pitch[0, 2], roll_and_pitch[0, 0])
    return jnp.stack([yaw, roll, pitch])

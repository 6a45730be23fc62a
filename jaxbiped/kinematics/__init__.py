"""Kinematics: leg forward and closed-form inverse kinematics, link poses, and the dynamics of prescribed motions."""

from jaxbiped.kinematics import body, dynamics, leg, rotation, safe
from jaxbiped.kinematics.body import BodyPose, joint_angles, pose
from jaxbiped.kinematics.dynamics import GRAVITY, Motion, MotionState, Wrench
from jaxbiped.kinematics.leg import AT_JOINT_LIMIT, OK, OUT_OF_REACH, STATUS_TEXT, LegAngles, LegPose

__all__ = [
    "AT_JOINT_LIMIT",
    "GRAVITY",
    "OK",
    "OUT_OF_REACH",
    "STATUS_TEXT",
    "BodyPose",
    "LegAngles",
    "LegPose",
    "Motion",
    "MotionState",
    "Wrench",
    "body",
    "dynamics",
    "joint_angles",
    "leg",
    "pose",
    "rotation",
    "safe",
]

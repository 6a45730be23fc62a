"""Robots: the record of a biped and the files it comes from."""

from jaxbiped.robot.fields import Number, RobotFileError
from jaxbiped.robot.load import load, numbers, presets
from jaxbiped.robot.params import (
    JOINT_AXES,
    JOINT_NAMES,
    KNEE,
    LEFT,
    LEG_LINK_NAMES,
    LINK_NAMES,
    RIGHT,
    SIDE_NAMES,
    Links,
    RobotParams,
    Servo,
)

__all__ = [
    "JOINT_AXES",
    "JOINT_NAMES",
    "KNEE",
    "LEFT",
    "LEG_LINK_NAMES",
    "LINK_NAMES",
    "RIGHT",
    "SIDE_NAMES",
    "Links",
    "Number",
    "RobotFileError",
    "RobotParams",
    "Servo",
    "load",
    "numbers",
    "presets",
]

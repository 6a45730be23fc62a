"""Robots: the record of a biped and the files it comes from."""

from jaxbiped.robot.defaults import Defaults
from jaxbiped.robot.fields import Number, RobotFileError, Setting, read_number
from jaxbiped.robot.load import defaults, load, numbers, presets
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
    nameless,
    on_device,
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
    "Defaults",
    "Links",
    "Number",
    "RobotFileError",
    "RobotParams",
    "Servo",
    "Setting",
    "defaults",
    "load",
    "nameless",
    "numbers",
    "on_device",
    "presets",
    "read_number",
]

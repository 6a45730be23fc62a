"""The record of a biped: two 6-DoF legs whose three hip axes meet in one point, under a rigid trunk.

Every frame is aligned with the pelvis (x forward, y left, z up) when all joint angles are zero. Leading axes:
`2` is (left, right), `6` the joints of a leg from hip to foot, `13` the links (trunk, then the left leg's six
and the right leg's six).

Robots are kept on the host, in NumPy and in float64, as their files say. Where one enters JAX it is converted to JAX's
default float: by `jit`, which does so with all that it is given, and by `on_device` where something is computed with a
robot outside of `jit`, or one is kept. What is meant for the inside of `jit` alone expects a robot that is converted.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

LEFT, RIGHT = 0, 1
SIDE_NAMES = ("left", "right")
JOINT_NAMES = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")
JOINT_AXES = "zxyyyx"
LEG_LINK_NAMES = ("hip_yaw", "hip_roll", "thigh", "shank", "ankle", "foot")
LINK_NAMES = ("trunk", *(f"{side}_{link}" for side in SIDE_NAMES for link in LEG_LINK_NAMES))
KNEE = JOINT_NAMES.index("knee")
HostOrDevice = Any
"""An array of a robot: NumPy's on the host, JAX's on the device."""


class Links(eqx.Module):
    """Mass properties of the 13 links, each in its own link frame.

    The trunk's frame is the pelvis frame; hip_yaw, hip_roll and thigh have their origin in the hip center, the
    shank in the knee, ankle and foot in the ankle center.
    """

    mass: Float[HostOrDevice, "*batch link"]
    """Mass [kg]."""
    com: Float[HostOrDevice, "*batch link 3"]
    """Center of mass in the link frame [m]."""
    inertia: Float[HostOrDevice, "*batch link 3 3"]
    """Inertia about the center of mass, link axes [kg m2]."""


class Servo(eqx.Module):
    """The position servo of every joint and what its actuator can do."""

    kp: Float[HostOrDevice, "*batch 2 6"]
    """Position gain [N m/rad]."""
    kv: Float[HostOrDevice, "*batch 2 6"]
    """Velocity gain [N m s/rad]."""
    ki: Float[HostOrDevice, "*batch 2 6"]
    """Integral gain [N m/(rad s)]."""
    armature: Float[HostOrDevice, "*batch 2 6"]
    """Rotor inertia seen at the joint [kg m2]."""
    torque_limit: Float[HostOrDevice, "*batch 2 6"]
    """Largest joint torque, either sign [N m]."""
    speed_limit: Float[HostOrDevice, "*batch 2 6"]
    """Largest joint speed, either sign [rad/s]."""


class RobotParams(eqx.Module):
    """Everything that does not change while the robot walks. SI units; build one with `robot.load`."""

    name: str = eqx.field(static=True)
    """Name, as in the file it came from."""
    p_pelvis_hip: Float[HostOrDevice, "*batch 2 3"]
    """Hip center (where the three hip axes meet) in the pelvis frame [m]."""
    thigh_length: Float[HostOrDevice, "*batch"]
    """Hip center to knee axis [m]."""
    shank_length: Float[HostOrDevice, "*batch"]
    """Knee axis to ankle center [m]."""
    ankle_height: Float[HostOrDevice, "*batch"]
    """Ankle center above the sole [m]; the sole frame's origin lies right below the ankle center."""
    p_sole_corner: Float[HostOrDevice, "*batch 2 4 3"]
    """Sole corners in the sole frame [m]: toe left, toe right, heel left, heel right."""
    links: Links
    """Mass properties."""
    servo: Servo
    """Joint servos and actuator limits."""
    joint_range: Float[HostOrDevice, "*batch 2 6 2"]
    """Smallest and largest joint angle [rad]."""
    height: Float[HostOrDevice, "*batch"]
    """Standing height, top of the head over the sole [m]; drawn, never used in the dynamics."""
    walks_like: str = eqx.field(static=True, default="")
    """Name of the preset whose gaits and simulation options fit this robot; empty if none is known to."""

    @property
    def preset_name(self) -> str:
        """Name under which presets of gaits and options are looked up: `walks_like`, or the robot's own name."""
        return self.walks_like or self.name

    @property
    def total_mass(self) -> Float[HostOrDevice, "*batch"]:
        """Mass of the whole robot [kg]."""
        return self.links.mass.sum(-1)


def nameless(robot: RobotParams) -> RobotParams:
    """The same robot by a name that all share: names are compiled in, and robots of a kind are to share programs."""
    return dataclasses.replace(robot, name="any", walks_like="")


def on_device(robot: RobotParams) -> RobotParams:
    """The robot in JAX's default float: float32, or float64 under `jax_enable_x64`. What is JAX's already stays."""
    number = jnp.result_type(float)
    return jax.tree.map(lambda x: x if isinstance(x, jax.Array) else jnp.asarray(x, number), robot)

"""What the kinematics are compared with: C MuJoCo, and a leg in NumPy and SciPy, no code shared."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from jaxbiped import robot

LOPSIDED = str(Path(__file__).parents[1] / "robot" / "lopsided.toml")
PRESETS = ["surena3", "elkahlout"]
ROBOTS = [*PRESETS, LOPSIDED]
SIDES = [robot.LEFT, robot.RIGHT]
MIRROR = np.diag([1.0, -1.0, 1.0])
MIRRORED_JOINT = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, -1.0])
"""What a mirrored leg's joint angles are multiplied by: yaw and the rolls turn the other way."""
BENT = 0.0101
"""A knee just more bent than the inverse kinematics' straightest."""


def load(name: str) -> robot.RobotParams:
    """A robot under a name that all share: the name is static, so they share compiled kernels too."""
    return dataclasses.replace(robot.load(name), name="any", walks_like="")


def random_angles(params: robot.RobotParams, n: int, seed: int = 0) -> np.ndarray:
    """Joint angles (n, 2, 6) within the joint ranges, the knee never quite straight [rad]."""
    lower, upper = np.moveaxis(np.array(params.joint_range, float), -1, 0)
    lower[:, robot.KNEE] = np.maximum(lower[:, robot.KNEE], BENT)
    return np.random.default_rng(seed).uniform(lower, upper, (n, 2, 6))


def random_rotations(n: int, seed: int = 0) -> np.ndarray:
    """Rotation matrices (n, 3, 3), uniform over all rotations."""
    return Rotation.random(n, rng=np.random.default_rng(seed)).as_matrix()


def leg_forward(params: robot.RobotParams, side: int, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sole position and rotation in the pelvis frame, by SciPy's rotations (z x y, then y, y, x)."""
    hip = Rotation.from_euler("ZXY", angle[:3])
    knee = hip * Rotation.from_rotvec([0.0, angle[3], 0.0])
    sole = knee * Rotation.from_rotvec([0.0, angle[4], 0.0]) * Rotation.from_rotvec([angle[5], 0.0, 0.0])
    down = np.array([0.0, 0.0, -1.0])
    position = np.array(params.p_pelvis_hip[side], float) + hip.apply(float(params.thigh_length) * down)
    position += knee.apply(float(params.shank_length) * down) + sole.apply(float(params.ankle_height) * down)
    return position, sole.as_matrix()


def hip_to_ankle(
    params: robot.RobotParams, side: int, p_sole: np.ndarray, rot_sole: np.ndarray
) -> np.ndarray:
    """Vectors from hip centre to ankle centre (..., 3), pelvis axes [m]."""
    return (
        p_sole + float(params.ankle_height) * rot_sole[..., :, 2] - np.array(params.p_pelvis_hip[side], float)
    )


def reach(params: robot.RobotParams, side: int) -> tuple[float, float]:
    """Smallest and largest distance from hip to ankle, by the triangle hip, knee, ankle [m]."""
    shank = float(params.shank_length) * np.array([1.0, 0.0])
    distances = []
    for bend in (
        float(params.joint_range[side, robot.KNEE, 1]),
        max(0.01, float(params.joint_range[side, robot.KNEE, 0])),
    ):
        thigh = float(params.thigh_length) * np.array([np.cos(bend), np.sin(bend)])
        distances.append(float(np.linalg.norm(shank + thigh)))
    return distances[0], distances[1]


def rotation_error(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Largest entry of the difference of rotation matrices; small ones are at most the angle [rad]."""
    return np.abs(np.asarray(one) - np.asarray(other)).max(axis=(-1, -2))


def put(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    p_pelvis: np.ndarray,
    rot_pelvis: np.ndarray,
    angle: np.ndarray,
):
    """Set C MuJoCo's configuration and let it compute where everything is."""
    x, y, z, w = Rotation.from_matrix(rot_pelvis).as_quat()
    data.qpos[:] = np.concatenate([p_pelvis, [w, x, y, z], angle.ravel()])
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)

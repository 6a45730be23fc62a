"""RobotParams -> MuJoCo model. The planner, the inverse kinematics and the simulator read the same record.

Degrees of freedom: the trunk's free joint, then the left leg's six hinges and the right leg's six, hip to foot.
"""

from pathlib import Path

import mujoco
import numpy as np

from jaxbiped import files
from jaxbiped.kinematics import GRAVITY
from jaxbiped.robot import JOINT_AXES, JOINT_NAMES, LEG_LINK_NAMES, SIDE_NAMES, RobotParams

CORNER_NAMES = ("toe_left", "toe_right", "heel_left", "heel_right")
CORNER_RADIUS = 0.005
"""Radius of the spheres that stand for the sole corners in MuJoCo's own contacts [m]; they touch at the sole."""
_UNIT = {axis: np.eye(3)[i] for i, axis in enumerate("xyz")}


def build_spec(robot: RobotParams, timestep: float = 5e-4) -> mujoco.MjSpec:
    """Describe the robot on a floor, standing straight, for MuJoCo.

    Position servos with the robot's gains and torque limits are in; velocity limits have no MuJoCo counterpart.

    Args:
        robot: one robot, without a batch axis.
        timestep: [s].
    """
    spec = mujoco.MjSpec()
    spec.modelname = robot.name
    spec.compiler.degree = False
    spec.option.timestep = timestep
    spec.option.gravity = [0.0, 0.0, -GRAVITY]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.worldbody.add_light(pos=[0.0, -2.0, 3.0], dir=[0.0, 0.5, -1.0])
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 0.1],
        rgba=[0.85, 0.87, 0.9, 1.0],
        contype=1,
        conaffinity=2,
    )
    trunk = spec.worldbody.add_body(name="trunk", pos=[0.0, 0.0, standing_height(robot)])
    trunk.add_freejoint(name="root")
    _set_inertial(trunk, robot, 0)
    _draw_trunk(trunk, robot)
    for side, side_name in enumerate(SIDE_NAMES):
        _add_leg(trunk, robot, side, side_name)
    for side, side_name in enumerate(SIDE_NAMES):
        for joint, joint_name in enumerate(JOINT_NAMES):
            _add_servo(spec, robot, side, joint, f"{side_name}_{joint_name}")
    return spec


def build_model(robot: RobotParams, timestep: float = 5e-4) -> mujoco.MjModel:
    """Compile `build_spec`."""
    return build_spec(robot, timestep).compile()


def write_mjcf(robot: RobotParams, path: str | Path) -> Path:
    """Write the robot as an MJCF file that stock MuJoCo loads."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    return files.write(path, mjcf(robot))


def mjcf(robot: RobotParams) -> str:
    """Return the text of the MJCF file of a robot."""
    spec = build_spec(robot)
    spec.compile()
    return spec.to_xml()


def standing_height(robot: RobotParams) -> float:
    """Height of the pelvis frame over the soles with straight legs [m]."""
    leg = float(robot.thigh_length + robot.shank_length + robot.ankle_height)
    return leg - float(robot.p_pelvis_hip[0, 2])


def _set_inertial(body: mujoco.MjsBody, robot: RobotParams, link: int) -> None:
    inertia = np.asarray(robot.links.inertia[link], float)
    body.mass = float(robot.links.mass[link])
    body.ipos = np.asarray(robot.links.com[link], float)
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.explicitinertial = True


def _add_leg(trunk: mujoco.MjsBody, robot: RobotParams, side: int, side_name: str) -> None:
    offsets = [
        np.asarray(robot.p_pelvis_hip[side], float),
        np.zeros(3),
        np.zeros(3),
        [0.0, 0.0, -float(robot.thigh_length)],
        [0.0, 0.0, -float(robot.shank_length)],
        np.zeros(3),
    ]
    body = trunk
    for joint, (link_name, joint_name) in enumerate(zip(LEG_LINK_NAMES, JOINT_NAMES, strict=True)):
        body = body.add_body(name=f"{side_name}_{link_name}", pos=offsets[joint])
        _set_inertial(body, robot, 1 + 6 * side + joint)
        body.add_joint(
            name=f"{side_name}_{joint_name}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=_UNIT[JOINT_AXES[joint]],
            range=np.asarray(robot.joint_range[side, joint], float).tolist(),
            armature=float(robot.servo.armature[side, joint]),
        )
        _draw_leg_link(body, robot, link_name)
    _add_sole(body, robot, side, side_name)


def _add_sole(foot: mujoco.MjsBody, robot: RobotParams, side: int, side_name: str) -> None:
    below_ankle = np.array([0.0, 0.0, -float(robot.ankle_height)])
    foot.add_site(name=f"{side_name}_sole", pos=below_ankle.tolist())
    corners = np.asarray(robot.p_sole_corner[side], float)
    for corner_name, corner in zip(CORNER_NAMES, corners, strict=True):
        name = f"{side_name}_{corner_name}"
        foot.add_site(name=name, pos=(corner + below_ankle).tolist())
        foot.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[CORNER_RADIUS, 0.0, 0.0],
            pos=(corner + below_ankle + [0.0, 0.0, CORNER_RADIUS]).tolist(),
            rgba=[0.8, 0.2, 0.2, 1.0],
            contype=2,
            conaffinity=1,
            mass=0.0,
        )
    size = (corners.max(0) - corners.min(0)) / 2.0
    size[2] = 0.25 * float(robot.ankle_height)
    middle = corners.mean(0) + below_ankle + [0.0, 0.0, size[2] + CORNER_RADIUS]
    _draw(foot, mujoco.mjtGeom.mjGEOM_BOX, size, middle)


def _add_servo(spec: mujoco.MjSpec, robot: RobotParams, side: int, joint: int, name: str) -> None:
    servo = robot.servo
    kp, kv = float(servo.kp[side, joint]), float(servo.kv[side, joint])
    limit = float(servo.torque_limit[side, joint])
    actuator = spec.add_actuator(
        name=name,
        target=name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        forcerange=[-limit, limit],
        forcelimited=True,
    )
    actuator.set_to_position(kp=kp, kv=kv)


def _draw(body: mujoco.MjsBody, kind: mujoco.mjtGeom, size: np.ndarray, pos: np.ndarray) -> None:
    """Add a massless geom that touches nothing."""
    body.add_geom(
        type=kind,
        size=size.tolist(),
        pos=pos.tolist(),
        rgba=[0.55, 0.6, 0.68, 1.0],
        contype=0,
        conaffinity=0,
        mass=0.0,
        group=1,
    )


def _draw_leg_link(body: mujoco.MjsBody, robot: RobotParams, link_name: str) -> None:
    lengths = {"thigh": float(robot.thigh_length), "shank": float(robot.shank_length)}
    if link_name in lengths:
        half = 0.5 * lengths[link_name]
        _draw(body, mujoco.mjtGeom.mjGEOM_CAPSULE, np.array([0.04, half, 0.0]), np.array([0.0, 0.0, -half]))


def _draw_trunk(trunk: mujoco.MjsBody, robot: RobotParams) -> None:
    half_width = 0.8 * float(robot.p_pelvis_hip[0, 1])
    top = float(robot.height) - standing_height(robot)
    _draw(
        trunk,
        mujoco.mjtGeom.mjGEOM_BOX,
        np.array([0.08, half_width, 0.38 * top]),
        np.array([0.0, 0.0, 0.40 * top]),
    )
    _draw(trunk, mujoco.mjtGeom.mjGEOM_SPHERE, np.array([0.1 * top, 0, 0]), np.array([0.0, 0.0, 0.9 * top]))

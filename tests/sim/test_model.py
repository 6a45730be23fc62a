"""The MuJoCo model has the numbers of the robot's record, in memory and as a file that stock MuJoCo loads."""

from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import pytest

from jaxbiped import robot
from jaxbiped.sim import build_model, write_mjcf
from jaxbiped.sim.model import CORNER_NAMES, standing_height

LOPSIDED = str(Path(__file__).parents[1] / "robot" / "lopsided.toml")
JOINTS = [f"{side}_{joint}" for side in robot.SIDE_NAMES for joint in robot.JOINT_NAMES]


@pytest.fixture(scope="module", params=["surena3", "elkahlout", LOPSIDED], ids=lambda name: Path(name).stem)
def params(request):
    return robot.load(request.param)


@pytest.fixture(scope="module")
def memory(params):
    return build_model(params)


@pytest.fixture(scope="module")
def file(params, tmp_path_factory):
    return write_mjcf(params, tmp_path_factory.mktemp("models") / "new folder" / "robot.xml")


@pytest.fixture(scope="module", params=["memory", "file"])
def model(request, memory, file):
    """The compiled model, and the tolerance its numbers meet: a file has six digits or so."""
    if request.param == "memory":
        return memory, 1e-12
    return mujoco.MjModel.from_xml_path(str(file)), 1e-5


def test_links_are_named_and_nested_hip_to_foot(model):
    compiled, _ = model
    names = [compiled.body(i).name for i in range(1, compiled.nbody)]
    assert tuple(names) == robot.LINK_NAMES
    for side in robot.SIDE_NAMES:
        chain = ["trunk", *(f"{side}_{link}" for link in robot.LEG_LINK_NAMES)]
        for parent, child in pairwise(chain):
            assert compiled.body(compiled.body(child).parentid[0]).name == parent


def test_masses_and_centres_of_mass(params, model):
    compiled, rtol = model
    np.testing.assert_allclose(compiled.body_mass[1:], params.links.mass, rtol=rtol)
    np.testing.assert_allclose(compiled.body_ipos[1:], params.links.com, rtol=rtol, atol=rtol * 0.1)
    assert compiled.body_mass.sum() == pytest.approx(np.asarray(params.links.mass).sum(), rel=rtol)


def test_masses_are_those_of_the_robot_file_to_the_last_digit(params, memory, file):
    """Also in the MJCF file, which has six digits: no mass of these robots has more."""
    name = params.name if params.name in robot.presets() else LOPSIDED
    given = {number.field: float(number.value) for number in robot.numbers(name) if number.unit == "kg"}
    leg = [given[f"leg.{link}.mass"] for link in robot.LEG_LINK_NAMES]
    trunk = sum(mass for field, mass in given.items() if field.startswith("trunk."))
    for model in (memory, mujoco.MjModel.from_xml_path(str(file))):
        np.testing.assert_allclose(model.body_mass[1:], [trunk, *leg, *leg], rtol=1e-12, atol=0.0)


def test_inertias_turned_back_from_principal_axes(params, model):
    compiled, rtol = model
    for link, name in enumerate(robot.LINK_NAMES):
        body = compiled.body(name)
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, body.iquat)
        turn = turn.reshape(3, 3)
        wanted = np.asarray(params.links.inertia[link])
        np.testing.assert_allclose(
            turn @ np.diag(body.inertia) @ turn.T, wanted, rtol=0, atol=max(rtol, 1e-9) * np.abs(wanted).max()
        )


def test_degrees_of_freedom_are_the_free_trunk_then_left_then_right_leg(model):
    compiled, _ = model
    assert (compiled.nq, compiled.nv, compiled.nu) == (19, 18, 12)
    assert compiled.joint(0).type == mujoco.mjtJoint.mjJNT_FREE
    assert [compiled.joint(1 + i).name for i in range(12)] == JOINTS
    assert [compiled.jnt_dofadr[1 + i] for i in range(12)] == list(range(6, 18))


def test_joints_turn_about_their_axes_through_their_link_s_origin(model):
    compiled, _ = model
    for i, axis in enumerate(robot.JOINT_AXES * 2):
        joint = compiled.joint(1 + i)
        np.testing.assert_array_equal(joint.axis, np.eye(3)["xyz".index(axis)])
        np.testing.assert_array_equal(joint.pos, np.zeros(3))


def test_joint_ranges(params, model):
    compiled, rtol = model
    np.testing.assert_allclose(compiled.jnt_range[1:], params.joint_range.reshape(12, 2), rtol=rtol)
    assert compiled.jnt_limited[1:].all()


def test_right_leg_has_the_mirrored_range_of_an_uneven_joint():
    compiled = build_model(robot.load(LOPSIDED))
    ranges = {name: compiled.joint(name).range for name in JOINTS}
    np.testing.assert_allclose(ranges["left_hip_yaw"], [-0.5, 0.9], rtol=1e-12)
    np.testing.assert_allclose(ranges["right_hip_yaw"], [-0.9, 0.5], rtol=1e-12)
    np.testing.assert_allclose(ranges["left_ankle_roll"], [-0.4, 0.6], rtol=1e-12)
    np.testing.assert_allclose(ranges["right_ankle_roll"], [-0.6, 0.4], rtol=1e-12)
    np.testing.assert_allclose(ranges["right_hip_pitch"], ranges["left_hip_pitch"])


def test_armature_and_nothing_that_resists(params, model):
    compiled, rtol = model
    np.testing.assert_allclose(compiled.dof_armature[6:], params.servo.armature.ravel(), rtol=rtol)
    for resistance in (
        compiled.dof_armature[:6],
        compiled.dof_damping,
        compiled.dof_frictionloss,
        compiled.jnt_stiffness,
    ):
        assert not resistance.any()


def test_servos_pull_as_the_record_says(params, model):
    """Measured, not read: the force at an angle, a speed and a target, and at a far target the limit."""
    compiled, rtol = model
    data = mujoco.MjData(compiled)
    rng = np.random.default_rng(0)
    assert [compiled.actuator(i).name for i in range(12)] == JOINTS
    kp, kv, limit = (
        np.asarray(gain).ravel() for gain in (params.servo.kp, params.servo.kv, params.servo.torque_limit)
    )
    angle, speed, target = rng.normal(size=(3, 12)) * [[0.1], [1e-3], [1e-4]]
    data.qpos[7:], data.qvel[6:], data.ctrl[:] = angle, speed, angle + target
    mujoco.mj_forward(compiled, data)
    wanted = kp * target - kv * speed
    assert (np.abs(wanted) < limit).all()
    np.testing.assert_allclose(
        data.qfrc_actuator[6:], wanted, rtol=0, atol=rtol * np.abs(wanted).max() + 1e-9
    )
    for sign in (1.0, -1.0):
        data.ctrl[:] = angle + sign * 10.0
        mujoco.mj_forward(compiled, data)
        np.testing.assert_allclose(data.qfrc_actuator[6:], sign * limit, rtol=rtol)


def test_sole_and_corner_sites_are_where_the_record_says(params, model):
    compiled, rtol = model
    for side, side_name in enumerate(robot.SIDE_NAMES):
        below = np.array([0.0, 0.0, -float(params.ankle_height)])
        foot = compiled.body(f"{side_name}_foot").id
        places = {f"{side_name}_sole": below}
        for name, corner in zip(CORNER_NAMES, np.asarray(params.p_sole_corner[side]), strict=True):
            places[f"{side_name}_{name}"] = corner + below
        for name, place in places.items():
            assert compiled.site(name).bodyid == foot
            np.testing.assert_allclose(compiled.site(name).pos, place, rtol=0, atol=rtol)


def test_corners_are_named_as_they_lie(model):
    compiled, _ = model
    for side in robot.SIDE_NAMES:
        at = {name: compiled.site(f"{side}_{name}").pos for name in CORNER_NAMES}
        assert at["toe_left"][0] == at["toe_right"][0] > at["heel_left"][0] == at["heel_right"][0]
        assert at["toe_left"][1] == at["heel_left"][1] > at["toe_right"][1] == at["heel_right"][1]


def test_robot_is_built_standing_straight_on_the_floor(params, model):
    compiled, rtol = model
    data = mujoco.MjData(compiled)
    mujoco.mj_kinematics(compiled, data)
    assert data.qpos[2] == pytest.approx(standing_height(params), rel=rtol)
    np.testing.assert_allclose(data.site_xpos[:, 2], 0.0, atol=1e-5 if rtol > 1e-9 else 1e-12)


def test_only_sole_corners_and_floor_touch(model):
    compiled, _ = model
    for i in range(compiled.ngeom):
        for j in range(i):
            one, other = compiled.geom(j), compiled.geom(i)
            touches = (one.contype & other.conaffinity) | (other.contype & one.conaffinity)
            is_corner = other.type == mujoco.mjtGeom.mjGEOM_SPHERE and other.name.endswith(CORNER_NAMES)
            assert bool(touches) == (one.name == "floor" and is_corner)


def test_gravity_and_time_step(params):
    np.testing.assert_array_equal(build_model(params).opt.gravity, [0.0, 0.0, -9.81])
    assert build_model(params).opt.timestep == 5e-4
    assert build_model(params, timestep=1e-3).opt.timestep == 1e-3


def test_stands_when_stepped_and_the_floor_carries_its_weight(params, model):
    compiled, _ = model
    data = mujoco.MjData(compiled)
    while data.time < 0.25:
        mujoco.mj_step(compiled, data)
    assert np.isfinite(data.qpos).all() and not data.warning.number.any()
    assert data.ncon >= 4
    weight = 9.81 * np.asarray(params.links.mass).sum()
    force = np.zeros(6)
    total = 0.0
    for contact in range(data.ncon):
        mujoco.mj_contactForce(compiled, data, contact, force)
        total += force[0]
    assert total == pytest.approx(weight, rel=0.1)
    assert data.qpos[2] == pytest.approx(standing_height(params), abs=0.02)


def test_file_says_what_memory_has(file, memory):
    """Every number of the two compiled models that moves the robot."""
    loaded = mujoco.MjModel.from_xml_path(str(file))
    for name in (
        "body_pos", "body_quat", "dof_armature", "actuator_gainprm", "actuator_biasprm",
        "actuator_forcerange",
        "geom_size", "geom_pos", "geom_friction", "geom_solref", "geom_solimp", "jnt_range", "qpos0",
    ):  # fmt: skip
        one, other = getattr(memory, name), getattr(loaded, name)
        np.testing.assert_allclose(other, one, rtol=1e-5, atol=1e-7, err_msg=name)
    for name in ("timestep", "integrator", "cone"):
        assert getattr(loaded.opt, name) == getattr(memory.opt, name)
    np.testing.assert_array_equal(loaded.opt.gravity, memory.opt.gravity)


def test_write_mjcf_gives_back_where_it_wrote(file):
    assert file.is_file() and file.name == "robot.xml"
    assert file.read_text().startswith("<mujoco")

"""Forward kinematics of a leg and of the whole robot against C MuJoCo on the generated model."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from oracle import (
    MIRROR,
    MIRRORED_JOINT,
    ROBOTS,
    SIDES,
    leg_forward,
    load,
    put,
    random_angles,
    random_rotations,
)

from jaxbiped import kinematics, robot
from jaxbiped.kinematics import body, leg
from jaxbiped.sim.model import CORNER_NAMES, build_model

N = 10_000
forward = jax.jit(jax.vmap(leg.forward, (None, None, 0)), static_argnums=1)
whole = jax.jit(jax.vmap(kinematics.pose, (None, 0, 0, 0)))


@pytest.fixture(scope="module", params=ROBOTS, ids=lambda name: name.split("/")[-1])
def case(request):
    """A robot's name, joint angles (N, 2, 6), and C MuJoCo's link and sole poses, pelvis at the origin."""
    with jax.enable_x64(True):
        params = load(request.param)
        angles = random_angles(params, N)
        model = build_model(params)
    data = mujoco.MjData(model)
    soles = [model.site(f"{side}_sole").id for side in robot.SIDE_NAMES]
    position, rotation, sole = np.empty((N, 2, 6, 3)), np.empty((N, 2, 6, 3, 3)), np.empty((N, 2, 3))
    data.qpos[:7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    for i, angle in enumerate(angles):
        data.qpos[7:] = angle.ravel()
        mujoco.mj_kinematics(model, data)
        position[i] = data.xpos[2:].reshape(2, 6, 3)
        rotation[i] = data.xmat[2:].reshape(2, 6, 3, 3)
        sole[i] = data.site_xpos[soles]
    return request.param, angles, position, rotation, sole


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(("dtype", "metres", "radians"), [("float64", 1e-12, 1e-12), ("float32", 1e-6, 2e-6)])
def test_leg_poses_are_those_of_mujoco(case, side, dtype, metres, radians):
    name, angles, position, rotation, sole = case
    with jax.enable_x64(dtype == "float64"):
        got = forward(load(name), side, jnp.asarray(angles[:, side]))
        assert got.p_pelvis_sole.dtype == dtype
        np.testing.assert_allclose(got.p_pelvis_link, position[:, side], rtol=0, atol=metres)
        np.testing.assert_allclose(got.p_pelvis_sole, sole[:, side], rtol=0, atol=metres)
        np.testing.assert_allclose(got.rot_pelvis_link, rotation[:, side], rtol=0, atol=radians)
        np.testing.assert_array_equal(got.rot_pelvis_sole, got.rot_pelvis_link[:, -1])


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("name", ROBOTS, ids=lambda name: name.split("/")[-1])
def test_leg_poses_are_those_of_scipy(x64, name, side):
    params = load(name)
    angles = random_angles(params, 50)[:, side]
    got = forward(params, side, jnp.asarray(angles))
    for i, angle in enumerate(angles):
        position, rotation = leg_forward(params, side, angle)
        np.testing.assert_allclose(got.p_pelvis_sole[i], position, atol=1e-14)
        np.testing.assert_allclose(got.rot_pelvis_sole[i], rotation, atol=1e-14)


@pytest.mark.parametrize("side", SIDES)
def test_leg_at_zero_hangs_straight_down(x64, side):
    params = load("surena3")
    got = forward(params, side, jnp.zeros((1, 6)))
    np.testing.assert_allclose(
        got.p_pelvis_sole[0], [0.0, 0.115 * (1 - 2 * side), -0.360 - 0.360 - 0.098], atol=1e-15
    )
    np.testing.assert_array_equal(got.rot_pelvis_link[0], np.broadcast_to(np.eye(3), (6, 3, 3)))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    ("joint", "moves"),
    [
        ("hip_yaw", "toe to the left"),
        ("hip_roll", "foot to the left"),
        ("hip_pitch", "foot back"),
        ("knee", "foot back"),
        ("ankle_pitch", "toe down"),
        ("ankle_roll", "left edge up"),
    ],
)
def test_positive_angle(x64, side, joint, moves):
    params = load("surena3")
    angles = np.zeros((2, 6))
    angles[1, robot.JOINT_NAMES.index(joint)] = 0.1
    got = forward(params, side, jnp.asarray(angles))
    shift = got.p_pelvis_sole[1] - got.p_pelvis_sole[0]
    toe, left_edge = got.rot_pelvis_sole[1, :, 0], got.rot_pelvis_sole[1, :, 1]
    amount = {
        "toe to the left": toe[1],
        "foot to the left": shift[1],
        "foot back": -shift[0],
        "toe down": -toe[2],
        "left edge up": left_edge[2],
    }[moves]
    assert amount > 0.03


@pytest.mark.parametrize("name", ROBOTS, ids=lambda name: name.split("/")[-1])
def test_mirrored_legs_have_mirrored_poses(x64, name):
    params = load(name)
    angles = random_angles(params, 500)[:, 0]
    left = forward(params, robot.LEFT, jnp.asarray(angles))
    right = forward(params, robot.RIGHT, jnp.asarray(angles * MIRRORED_JOINT))
    np.testing.assert_allclose(left.p_pelvis_link @ MIRROR, right.p_pelvis_link, atol=1e-14)
    np.testing.assert_allclose(left.p_pelvis_sole @ MIRROR, right.p_pelvis_sole, atol=1e-14)
    np.testing.assert_allclose(MIRROR @ left.rot_pelvis_link @ MIRROR, right.rot_pelvis_link, atol=1e-14)


@pytest.mark.parametrize("name", ROBOTS, ids=lambda name: name.split("/")[-1])
def test_whole_robot_is_that_of_mujoco(x64, name):
    params, n = load(name), 300
    model = build_model(params)
    data = mujoco.MjData(model)
    pelvis = np.random.default_rng(1).normal(size=(n, 3))
    rotation, angles = random_rotations(n), random_angles(params, n)
    got = whole(params, *map(jnp.asarray, (pelvis, rotation, angles)))
    com = jax.vmap(body.com, (None, 0))(params, got)
    com_of_links = jax.vmap(body.com_of_links, (None, 0))(params, got)
    anchors, axes = got.p_world_joint, got.axis_world_joint
    sites = [model.site(f"{side}_sole").id for side in robot.SIDE_NAMES]
    corners = [[model.site(f"{side}_{name}").id for name in CORNER_NAMES] for side in robot.SIDE_NAMES]
    for i in range(n):
        put(model, data, pelvis[i], rotation[i], angles[i])
        np.testing.assert_allclose(got.p_world_link[i], data.xpos[1:], atol=1e-12)
        np.testing.assert_allclose(got.rot_world_link[i].reshape(-1, 9), data.xmat[1:], atol=1e-12)
        np.testing.assert_allclose(got.p_world_sole[i], data.site_xpos[sites], atol=1e-12)
        np.testing.assert_allclose(anchors[i].reshape(-1, 3), data.xanchor[1:], atol=1e-12)
        np.testing.assert_allclose(axes[i].reshape(-1, 3), data.xaxis[1:], atol=1e-12)
        np.testing.assert_allclose(com[i], data.subtree_com[1], atol=1e-12)
        np.testing.assert_allclose(com_of_links[i], data.xipos[1:], atol=1e-12)
        for side in SIDES:
            foot = got.rot_world_link[i, 6 * (side + 1)]
            p_world_corner = got.p_world_sole[i, side] + params.p_sole_corner[side] @ foot.T
            np.testing.assert_allclose(p_world_corner, data.site_xpos[corners[side]], atol=1e-12)


def test_mirrored_robot_has_the_mirrored_centre_of_mass(x64):
    params, n = load("surena3"), 100
    pelvis, rotation = np.random.default_rng(1).normal(size=(n, 3)), random_rotations(n)
    angles = random_angles(params, n)
    mirrored = pelvis @ MIRROR, MIRROR @ rotation @ MIRROR, angles[:, ::-1] * MIRRORED_JOINT
    com, mirrored_com = (
        jax.vmap(body.com, (None, 0))(params, whole(params, *map(jnp.asarray, motion)))
        for motion in ((pelvis, rotation, angles), mirrored)
    )
    np.testing.assert_allclose(com @ MIRROR, mirrored_com, atol=1e-13)

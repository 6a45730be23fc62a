"""Ground wrench and joint torques of moving robots against C MuJoCo's inverse and forward dynamics."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from oracle import ROBOTS, SIDES, load, random_angles
from scipy.spatial.transform import Rotation

from jaxbiped import kinematics, robot
from jaxbiped.kinematics import dynamics
from jaxbiped.kinematics.rotation import about_x, about_y, about_z
from jaxbiped.sim.model import build_model

WAVES = 3
COORDINATES = 3 + 3 + 12  # pelvis position, its yaw, pitch and roll, joints
TIMES = np.linspace(0.1, 2.0, 12)
IGNORED = (
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    | mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_LIMIT
    | mujoco.mjtDisableBit.mjDSBL_ACTUATION
)


def random_waves(params, seed):
    """Middle, amplitude, frequency and phase of the sines of a hard motion."""
    rng = np.random.default_rng(seed)
    low, high = random_angles(params, 2, seed).reshape(2, 12)
    middle = np.concatenate([rng.normal(size=6), 0.5 * (low + high)])
    size = np.concatenate([np.full(3, 0.3), np.full(3, 0.5), 0.3 * (high - low)])
    amplitude = size[:, None] * rng.uniform(0.2, 0.6, (COORDINATES, WAVES))
    return (
        middle,
        amplitude,
        rng.uniform(1.0, 6.0, (COORDINATES, WAVES)),
        rng.uniform(0, 6.3, (COORDINATES, WAVES)),
    )


def waves_at(waves, time):
    """Coordinates and their first and second derivatives, NumPy."""
    middle, amplitude, frequency, phase = waves
    angle = frequency * time + phase
    return (
        middle + np.sum(amplitude * np.sin(angle), axis=1),
        np.sum(amplitude * frequency * np.cos(angle), axis=1),
        -np.sum(amplitude * frequency**2 * np.sin(angle), axis=1),
    )


def evaluate(params, waves, time):
    """The package's answer; the pelvis turns by yaw, then pitch, then roll."""
    middle, amplitude, frequency, phase = waves

    def motion(t):
        x = middle + jnp.sum(amplitude * jnp.sin(frequency * t + phase), axis=1)
        rotation = about_z(x[3]) @ about_y(x[4]) @ about_x(x[5])
        angle = x[6:].reshape(2, 6)
        return kinematics.pose(params, x[:3], rotation, angle), angle

    return dynamics.evaluate(params, motion, time)


def torques(params, state, force, moment):
    return dynamics.joint_torques(params, state, dynamics.Wrench(force, moment))


states = jax.jit(jax.vmap(evaluate, (None, None, 0)))
torques_of = jax.jit(jax.vmap(torques, (None, 0, 0, 0)))


def turning(x, v, a):
    """Rotation, and angular velocity and acceleration in body axes, from yaw, pitch, roll and their rates."""
    (_, pitch, roll), (dyaw, dpitch, droll), (ddyaw, ddpitch, ddroll) = x[3:6], v[3:6], a[3:6]
    sp, cp, sr, cr = np.sin(pitch), np.cos(pitch), np.sin(roll), np.cos(roll)
    omega = [droll - dyaw * sp, dpitch * cr + dyaw * cp * sr, -dpitch * sr + dyaw * cp * cr]
    alpha = [
        ddroll - ddyaw * sp - dyaw * cp * dpitch,
        ddpitch * cr - dpitch * sr * droll + ddyaw * cp * sr + dyaw * (-sp * dpitch * sr + cp * cr * droll),
        -ddpitch * sr - dpitch * cr * droll + ddyaw * cp * cr + dyaw * (-sp * dpitch * cr - cp * sr * droll),
    ]
    return Rotation.from_euler("ZYX", x[3:6]), omega, alpha


def put(data, waves, time):
    """Give C MuJoCo the motion: world position and velocity of the pelvis, its turning in its own axes."""
    x, v, a = waves_at(waves, time)
    rotation, omega, alpha = turning(x, v, a)
    data.qpos[:] = np.concatenate([x[:3], rotation.as_quat()[[3, 0, 1, 2]], x[6:]])
    data.qvel[:] = np.concatenate([v[:3], omega, v[6:]])
    data.qacc[:] = np.concatenate([a[:3], alpha, a[6:]])


def mujoco_of(params):
    model = build_model(params)
    model.opt.disableflags |= IGNORED
    return model, mujoco.MjData(model)


def assert_close(got, wanted, relative):
    """Equal to a part of the largest of the wanted numbers."""
    assert np.abs(wanted).max() > 0.0
    np.testing.assert_allclose(got, wanted, rtol=0, atol=relative * np.abs(wanted).max())


def test_the_motion_given_to_mujoco_is_the_derivative_of_itself(x64):
    """Check the checker: positions follow from velocities, and velocities from accelerations."""
    params = load(ROBOTS[0])
    model, data = mujoco_of(params)
    waves, step = random_waves(params, 0), 1e-5
    late, early = [], []
    for states_then, time in ((late, 1.0 + step), (early, 1.0 - step)):
        put(data, waves, time)
        states_then += [data.qpos.copy(), data.qvel.copy()]
    put(data, waves, 1.0)
    rate = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, rate, 2 * step, early[0], late[0])
    np.testing.assert_allclose(rate, data.qvel, atol=1e-7)
    np.testing.assert_allclose((late[1] - early[1]) / (2 * step), data.qacc, atol=1e-6)


@pytest.mark.parametrize("name", ROBOTS, ids=lambda name: name.split("/")[-1])
@pytest.mark.parametrize(("dtype", "relative"), [("float64", 1e-11), ("float32", 1e-4)])
def test_ground_wrench_and_joint_torques_are_those_of_mj_inverse(dtype, relative, name):
    with jax.enable_x64(True):
        params = load(name)
        waves = random_waves(params, 1)
        model, data = mujoco_of(params)
    with jax.enable_x64(dtype == "float64"):
        params = load(name)
        state = states(params, tuple(map(jnp.asarray, waves)), jnp.asarray(TIMES))
        free = torques_of(params, state, jnp.zeros((len(TIMES), 2, 3)), jnp.zeros((len(TIMES), 2, 3)))
        assert free.dtype == dtype
        state, wrench, free = jax.tree.map(np.asarray, (state, state.ground_wrench, free))
    for i, time in enumerate(TIMES):
        put(data, waves, time)
        mujoco.mj_inverse(model, data)
        rotation = data.xmat[1].reshape(3, 3)
        force = data.qfrc_inverse[:3]
        moment = rotation @ data.qfrc_inverse[3:6] + np.cross(data.qpos[:3], force)
        assert_close(wrench.force[i], force, relative)
        assert_close(wrench.moment[i], moment, relative)
        assert_close(free[i].ravel(), data.qfrc_inverse[6:], relative)
        assert_close(state.angle[i].ravel(), data.qpos[7:], relative)
        assert_close(state.speed[i].ravel(), data.qvel[6:], relative)
        assert_close(state.acceleration[i].ravel(), data.qacc[6:], relative)


@pytest.mark.parametrize("name", ROBOTS, ids=lambda name: name.split("/")[-1])
def test_with_these_torques_and_foot_wrenches_mujoco_moves_as_prescribed(x64, name):
    """Forward dynamics, nothing holding the pelvis: only if wrenches and torques are right does it follow."""
    params = load(name)
    waves = random_waves(params, 2)
    model, data = mujoco_of(params)
    state = states(params, tuple(map(jnp.asarray, waves)), jnp.asarray(TIMES))
    rng = np.random.default_rng(3)
    extra_force, extra_moment = rng.normal(scale=200, size=(2, len(TIMES), 3))
    share = rng.uniform(0.0, 1.0, len(TIMES))[:, None]
    ground = state.ground_wrench
    force = np.stack([share * ground.force + extra_force, (1 - share) * ground.force - extra_force], axis=1)
    moment = np.stack(
        [share * ground.moment + extra_moment, (1 - share) * ground.moment - extra_moment], axis=1
    )
    torque = torques_of(params, state, jnp.asarray(force), jnp.asarray(moment))
    feet = [model.body(f"{side}_foot").id for side in robot.SIDE_NAMES]
    for i, time in enumerate(TIMES):
        put(data, waves, time)
        wanted = data.qacc.copy()
        mujoco.mj_kinematics(model, data)
        for side in SIDES:
            about_com = moment[i, side] - np.cross(data.xipos[feet[side]], force[i, side])
            data.xfrc_applied[feet[side]] = np.concatenate([force[i, side], about_com])
        data.qfrc_applied[6:] = torque[i].ravel()
        mujoco.mj_forward(model, data)
        assert_close(data.qacc, wanted, 1e-8)


def test_standing_still_the_ground_carries_the_weight_under_the_centre_of_mass(x64):
    params = load("elkahlout")
    still = tuple(jnp.asarray(part) for part in (np.zeros(COORDINATES), *np.zeros((3, COORDINATES, 1))))
    state = states(params, still, jnp.zeros(1))
    wrench = state.ground_wrench
    np.testing.assert_allclose(wrench.force[0], [0.0, 0.0, 80.0 * 9.81], atol=1e-9)  # figure 3.3: about 785 N
    centre = jax.vmap(kinematics.body.com, (None, 0))(params, state.body)[0]
    np.testing.assert_allclose(wrench.moment[0], np.cross(centre, wrench.force[0]), atol=1e-9)


def test_wrenches_add_and_subtract():
    one = dynamics.Wrench(jnp.array([1.0, 2.0, 3.0]), jnp.array([4.0, 5.0, 6.0]))
    other = dynamics.Wrench(jnp.array([10.0, 20.0, 30.0]), jnp.array([40.0, 50.0, 60.0]))
    np.testing.assert_array_equal((one + other).force, [11.0, 22.0, 33.0])
    np.testing.assert_array_equal((one + other).moment, [44.0, 55.0, 66.0])
    np.testing.assert_array_equal((one - other).force, [-9.0, -18.0, -27.0])
    np.testing.assert_array_equal((one - other).moment, [-36.0, -45.0, -54.0])


def test_one_compilation_serves_all_masses_lengths_and_motions(x64):
    params = load("surena3")
    runs = []

    @jax.jit
    def ground_force(params, waves, time):
        runs.append("traced")
        return evaluate(params, waves, time).ground_wrench.force

    results = set()
    for factor in (1.0, 1.2):
        other = jax.tree.map(lambda leaf: leaf * factor, params)  # noqa: B023
        for seed in (0, 1):
            result = ground_force(
                other, tuple(map(jnp.asarray, random_waves(params, seed))), jnp.asarray(0.5)
            )
            results.add(tuple(np.asarray(result)))
    assert runs == ["traced"]
    assert len(results) == 4

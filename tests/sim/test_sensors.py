"""Sensors against plain Python: switches and their faults, delay, noise, tilt, centre of pressure, ankle wrenches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_mujoco import as_arrays, flat, load, motions, random_states
from scipy.spatial.transform import Rotation

from jaxbiped.sim import mjx_adapter, sensors
from jaxbiped.sim.ground import Contact
from jaxbiped.sim.sensors import Delay, SwitchState

CORNERS = (2, 4)
DT = 1e-3


def faults(**values):
    names = list(values)
    record = flat().sensors
    new = [jnp.asarray(values[n], getattr(record, n).dtype) for n in names]
    return eqx.tree_at(lambda f: [getattr(f, n) for n in names], record, new)


def falling(faulty, start, speed, ticks=80):
    """Switch states while every corner sinks at its own constant speed."""
    state = sensors.init_switches(jnp.asarray(start), faulty)
    states = [state]
    for tick in range(1, ticks + 1):
        time = tick * DT
        state = sensors.read_switches(state, jnp.asarray(start - speed * time), jnp.asarray(time), DT, faulty)
        states.append(state)
    return states


def test_closing_time_is_interpolated_inside_the_tick(x64):
    rng = np.random.default_rng(0)
    start, speed, delta_z = (
        rng.uniform(0.02, 0.04, CORNERS),
        rng.uniform(0.5, 2.0, CORNERS),
        rng.uniform(0.0, 0.015, CORNERS),
    )
    states = falling(faults(delta_z=delta_z), start, speed)
    crossing = (start - delta_z) / speed
    assert np.all(np.abs(crossing / DT - np.round(crossing / DT)) > 1e-6)
    np.testing.assert_allclose(states[-1].time, crossing, rtol=1e-9)
    for tick, state in enumerate(states):
        np.testing.assert_array_equal(state.closed, tick * DT >= crossing)
        assert np.all(np.isinf(np.asarray(state.time)) | np.asarray(state.closed))


def test_switches_closed_at_the_start_have_been_closed_since_then(x64):
    state = sensors.init_switches(
        jnp.array([[0.0, 0.02, 0.005, 0.011]] * 2), faults(delta_z=np.full(CORNERS, 0.01))
    )
    np.testing.assert_array_equal(state.closed, [[True, False, True, False]] * 2)
    np.testing.assert_array_equal(state.time, [[0.0, np.inf, 0.0, np.inf]] * 2)


def test_a_switch_opens_and_closes_again_with_a_new_time(x64):
    faulty = faults(delta_z=np.full(CORNERS, 0.01))
    state = sensors.init_switches(jnp.zeros(CORNERS), faulty)
    gaps, seen = [0.008, 0.02, 0.03, 0.02, 0.005, 0.002], []
    for tick, gap in enumerate(gaps, start=1):
        state = sensors.read_switches(state, jnp.full(CORNERS, gap), jnp.asarray(tick * DT), DT, faulty)
        seen.append((bool(state.closed[0, 0]), float(state.time[0, 0])))
    assert [closed for closed, _ in seen] == [True, False, False, False, True, True]
    assert [time for _, time in seen][:4] == [0.0] * 4
    assert seen[4][1] == seen[5][1] == pytest.approx(4 * DT + DT * (0.02 - 0.01) / 0.015)


def test_a_stuck_switch_never_closes(x64):
    stuck = np.zeros(CORNERS)
    stuck[0, 1] = stuck[1, 2] = 1.0
    last = falling(
        faults(delta_z=np.full(CORNERS, 0.01), stuck_open=stuck), np.full(CORNERS, 0.02), np.ones(CORNERS)
    )[-1]
    np.testing.assert_array_equal(last.closed, stuck == 0.0)
    np.testing.assert_array_equal(np.isinf(np.asarray(last.time)), stuck == 1.0)


def test_bouncing_switch(x64):
    """Closed for the first millisecond, open for the second, and so on, until the bouncing is over."""
    start = 0.1237
    state = SwitchState(jnp.ones(CORNERS, bool), jnp.zeros(CORNERS), jnp.full(CORNERS, start))
    for bounce in (0.0, 0.0035, 0.01):
        for k in range(100):
            since = 0.00013 + k * 0.00021
            closed = since >= bounce or int(since * 1000) in range(0, 100, 2)
            got = sensors.bouncing(state, jnp.asarray(start + since), faults(bounce=bounce))
            assert np.all(np.asarray(got) == closed), (bounce, since)
    opened = SwitchState(jnp.zeros(CORNERS, bool), state.gap, state.time)
    assert not sensors.bouncing(opened, jnp.asarray(start), faults(bounce=0.01)).any()


@pytest.fixture
def standing(x64):
    """A random state of the robot with made-up corner forces: body, contact and all readings."""
    params = load("surena3")
    qpos, qvel = random_states(params, 1, seed=1)
    bodies = motions(mjx_adapter.base_model(params), *as_arrays(qpos, qvel))
    body = jax.tree.map(lambda leaf: leaf[0], bodies)
    rng = np.random.default_rng(2)
    force = rng.normal(scale=50.0, size=(2, 4, 3))
    force[..., 2] = rng.uniform(20.0, 200.0, CORNERS)
    point = rng.normal(size=(2, 4, 3))
    zeros = jnp.zeros(CORNERS)
    nowhere = jnp.zeros((2, 4, 3))
    touch = Contact(zeros, zeros, nowhere, jnp.asarray(point), nowhere, jnp.asarray(force), zeros, zeros)
    state = sensors.init_switches(zeros, faults())
    zmp, time = jnp.array([0.3, -0.2]), jnp.asarray(1.5)
    q, v = as_arrays(qpos[0], qvel[0])
    sensed = sensors.sense(body, touch, q, v, state, zmp, time, faults())
    return qpos[0], qvel[0], body, touch, sensed


def test_ankle_wrench_is_that_of_the_ground_about_the_ankle_in_foot_axes(standing):
    _, _, body, touch, sensed = standing
    for foot in range(2):
        rotation = np.asarray(body.rot_world_foot[foot])
        force, moment = np.zeros(3), np.zeros(3)
        for corner in range(4):
            f = np.asarray(touch.force[foot, corner])
            force += f
            moment += np.cross(np.asarray(touch.p_world_corner[foot, corner] - body.p_world_foot[foot]), f)
        np.testing.assert_allclose(sensed.ankle_wrench[foot, :3], rotation.T @ force)
        np.testing.assert_allclose(sensed.ankle_wrench[foot, 3:], rotation.T @ moment)


def test_the_other_readings(standing):
    qpos, qvel, body, touch, sensed = standing
    yaw, pitch, roll = Rotation.from_quat(qpos[[4, 5, 6, 3]]).as_euler("ZYX")
    np.testing.assert_allclose(sensed.roll_pitch, [roll, pitch])
    np.testing.assert_array_equal(sensed.corner_force, touch.force[..., 2])
    np.testing.assert_array_equal(sensed.angle, qpos[7:].reshape(2, 6))
    np.testing.assert_array_equal(sensed.speed, qvel[6:].reshape(2, 6))
    np.testing.assert_array_equal(sensed.rate, qvel[3:6])
    np.testing.assert_array_equal(sensed.zmp_world, [0.3, -0.2])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    back = np.asarray(body.p_world_trunk[:2]) + turn @ np.asarray(sensed.zmp_body)
    np.testing.assert_allclose(back, [0.3, -0.2])


def test_roll_pitch_yaw(x64):
    rotations = Rotation.from_quat(np.random.default_rng(3).normal(size=(200, 4)))
    got = jax.vmap(sensors.roll_pitch_yaw)(jnp.asarray(rotations.as_matrix()))
    np.testing.assert_allclose(got, rotations.as_euler("ZYX")[:, ::-1], atol=1e-9)


def test_centre_of_pressure(standing):
    _, _, _, touch, _ = standing
    otherwise = jnp.array([9.0, 9.0])
    weight, point = np.asarray(touch.force[..., 2]), np.asarray(touch.p_world_corner)
    wanted = (weight[..., None] * point[..., :2]).sum((0, 1)) / weight.sum()
    np.testing.assert_allclose(sensors.centre_of_pressure(touch, otherwise), wanted)
    unloaded = eqx.tree_at(lambda c: c.force, touch, touch.force * 0.0)
    np.testing.assert_array_equal(sensors.centre_of_pressure(unloaded, otherwise), otherwise)
    slope = jax.jacfwd(
        lambda f: sensors.centre_of_pressure(eqx.tree_at(lambda c: c.force, touch, f), otherwise)
    )
    assert np.all(np.isfinite(np.asarray(slope(touch.force * 0.0))))


@pytest.mark.parametrize("late", [0, 1, 3])
def test_delay_is_a_list_of_old_readings(standing, late):
    *_, sensed = standing
    room, tick = 3, 2e-3
    delay, readings = Delay.filled(sensed, room), [sensed] * (room + 1)
    for k in range(1, 8):
        new = jax.tree.map(lambda leaf, k=k: leaf + k if leaf.dtype != bool else leaf ^ (k % 2 == 1), sensed)
        readings.append(new)
        delay, got = delay.push(new, jnp.asarray(late * tick), tick)
        wanted = eqx.tree_at(lambda s: s.time, readings[-1 - late], new.time)
        jax.tree.map(np.testing.assert_array_equal, got, wanted)


def test_noise(standing):
    *_, sensed = standing
    ticks = jnp.arange(4000)

    def noisy(seed):
        faulty = faults(force_noise=3.0, angle_noise=0.02, seed=seed)
        return jax.vmap(lambda tick: sensors.add_noise(sensed, faulty, tick))(ticks)

    first = noisy(7)
    for field, size in (("corner_force", 3.0), ("angle", 0.02), ("roll_pitch", 0.02)):
        error = np.asarray(getattr(first, field) - getattr(sensed, field)).reshape(4000, -1) / size
        many = error.size**0.5
        assert abs(error.mean()) < 4.0 / many and error.std() == pytest.approx(1.0, abs=3.0 / many)
        between = np.corrcoef(error.T) - np.eye(error.shape[1])
        assert np.abs(between).max() < 0.1  # every reading has its own
        assert abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 0.1
        again, other = getattr(noisy(7), field), getattr(noisy(8), field)
        np.testing.assert_array_equal(getattr(first, field), again)
        assert not np.any(np.asarray(other) == np.asarray(again))
    for field in ("time", "switch", "ankle_wrench", "speed", "rate", "zmp_world", "zmp_body"):
        np.testing.assert_array_equal(getattr(first, field)[5], getattr(sensed, field))
    silent = sensors.add_noise(sensed, faults(), jnp.asarray(3))
    jax.tree.map(np.testing.assert_array_equal, silent, sensed)

"""Sensors against plain Python: switches and their faults, delay, noise, tilt, centre of pressure, ankle wrenches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_mujoco import as_arrays, flat, load, motions, random_states
from scipy.spatial.transform import Rotation

from jaxbiped import robot
from jaxbiped.adapt import PayloadReflex, PayloadStage, Signals
from jaxbiped.adapt.reflex.planned import SHIFT
from jaxbiped.planner import CosineGait, at
from jaxbiped.robot import SIDE_NAMES
from jaxbiped.sim import build_model, ground, mjx_adapter, sensors
from jaxbiped.sim.model import CORNER_NAMES
from jaxbiped.sim.physics.compliant import seen
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
    touch = ground.contact(params, flat().ground, flat().terrain, body)
    touch = eqx.tree_at(lambda c: (c.p_world_corner, c.force), touch, as_arrays(point, force))
    saw = seen(body, touch, jnp.zeros((2, 6)))
    state = sensors.init_switches(zeros, faults())
    zmp, time = jnp.array([0.3, -0.2]), jnp.asarray(1.5)
    q, v = as_arrays(qpos[0], qvel[0])
    sensed = sensors.sense(saw, q, v, state, zmp, time, faults())
    return qpos[0], qvel[0], saw, sensed


def test_ankle_wrench_is_that_of_the_ground_about_the_ankle_in_foot_axes(standing):
    _, _, saw, sensed = standing
    for foot in range(2):
        rotation = np.asarray(saw.rot_world_foot[foot])
        force, moment = np.zeros(3), np.zeros(3)
        for corner in range(4):
            f = np.asarray(saw.force[foot, corner])
            force += f
            moment += np.cross(np.asarray(saw.p_world_corner[foot, corner] - saw.p_world_foot[foot]), f)
        np.testing.assert_allclose(sensed.ankle_wrench[foot, :3], rotation.T @ force)
        np.testing.assert_allclose(sensed.ankle_wrench[foot, 3:], rotation.T @ moment)


def test_the_other_readings(standing):
    qpos, qvel, saw, sensed = standing
    yaw, pitch, roll = Rotation.from_quat(qpos[[4, 5, 6, 3]]).as_euler("ZYX")
    np.testing.assert_allclose(sensed.roll_pitch, [roll, pitch])
    np.testing.assert_array_equal(sensed.corner_force, saw.force[..., 2])
    np.testing.assert_array_equal(sensed.angle, qpos[7:].reshape(2, 6))
    np.testing.assert_array_equal(sensed.speed, qvel[6:].reshape(2, 6))
    np.testing.assert_array_equal(sensed.rate, qvel[3:6])
    np.testing.assert_array_equal(sensed.zmp_world, [0.3, -0.2])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    back = np.asarray(saw.p_world_trunk[:2]) + turn @ np.asarray(sensed.zmp_body)
    np.testing.assert_allclose(back, [0.3, -0.2])


def test_roll_pitch_yaw(x64):
    rotations = Rotation.from_quat(np.random.default_rng(3).normal(size=(200, 4)))
    got = jax.vmap(sensors.roll_pitch_yaw)(jnp.asarray(rotations.as_matrix()))
    np.testing.assert_allclose(got, rotations.as_euler("ZYX")[:, ::-1], atol=1e-9)


def test_centre_of_pressure(standing):
    _, _, saw, _ = standing
    otherwise = jnp.array([9.0, 9.0])
    weight, point = np.asarray(saw.force[..., 2]), np.asarray(saw.p_world_corner)
    wanted = (weight[..., None] * point[..., :2]).sum((0, 1)) / weight.sum()
    np.testing.assert_allclose(sensors.centre_of_pressure(saw, otherwise), wanted)
    unloaded = eqx.tree_at(lambda s: s.force, saw, saw.force * 0.0)
    np.testing.assert_array_equal(sensors.centre_of_pressure(unloaded, otherwise), otherwise)
    slope = jax.jacfwd(
        lambda f: sensors.centre_of_pressure(eqx.tree_at(lambda s: s.force, saw, f), otherwise)
    )
    assert np.all(np.isfinite(np.asarray(slope(saw.force * 0.0))))


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


@pytest.fixture
def on_both_feet(x64):
    """A robot in a random state, whose soles' corners carry made-up vertical forces: robot, contact and readings."""
    params = load("surena3")
    qpos, qvel = random_states(params, 1, seed=1)
    turn = Rotation.from_euler("ZYX", [0.4, 0.12, -0.08]).as_quat()
    qpos[0, 3:7] = turn[[3, 0, 1, 2]]
    qpos[0, 7:] *= 0.3
    bodies = motions(mjx_adapter.base_model(params), *as_arrays(qpos, qvel))
    body = jax.tree.map(lambda leaf: leaf[0], bodies)
    touch = ground.contact(params, flat().ground, flat().terrain, body)
    force = np.zeros((2, 4, 3))
    force[..., 2] = np.random.default_rng(2).uniform(40.0, 160.0, CORNERS)
    touch = eqx.tree_at(lambda c: c.force, touch, jnp.asarray(force))
    saw = seen(body, touch, jnp.zeros((2, 6)))
    zmp = sensors.centre_of_pressure(saw, jnp.zeros(2))
    q, v = as_arrays(qpos[0], qvel[0])
    state = sensors.init_switches(jnp.zeros(CORNERS), faults())
    sensed = sensors.sense(saw, q, v, state, zmp, jnp.asarray(1.5), faults())
    return params, body, touch, sensed


EVERY, CONTROL_DT = 4, 2e-3


def noisy(on_both_feet, faulty, ticks):
    """Readings at these physics ticks."""
    params, _, touch, sensed = on_both_feet
    one = lambda tick: sensors.add_noise(  # noqa: E731
        params, sensed, touch.p_world_corner, faulty, tick, EVERY, CONTROL_DT
    )
    return jax.jit(jax.vmap(one))(jnp.asarray(ticks, jnp.int32))


def test_noise_of_what_is_measured(on_both_feet):
    *_, sensed = on_both_feet
    ticks = EVERY * np.arange(4000)

    def readings(seed):
        return noisy(on_both_feet, faults(force_noise=3.0, angle_noise=0.02, seed=seed), ticks)

    first, same, of_another = readings(7), readings(7), readings(8)
    for field, size in (("corner_force", 3.0), ("angle", 0.02), ("roll_pitch", 0.02)):
        error = np.asarray(getattr(first, field) - getattr(sensed, field)).reshape(4000, -1) / size
        many = error.size**0.5
        assert abs(error.mean()) < 4.0 / many and error.std() == pytest.approx(1.0, abs=3.0 / many)
        between = np.corrcoef(error.T) - np.eye(error.shape[1])
        assert np.abs(between).max() < 0.1  # every reading has its own
        assert abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 0.1
    for field in ("corner_force", "angle", "roll_pitch", "zmp_world", "zmp_body", "ankle_wrench", "speed"):
        again, other = getattr(same, field), getattr(of_another, field)
        np.testing.assert_array_equal(getattr(first, field), again)
        assert not np.any(np.asarray(other) == np.asarray(again))
    for field in ("time", "switch", "switch_time", "rate"):
        np.testing.assert_array_equal(getattr(first, field)[5], getattr(sensed, field))


def test_without_noise_every_reading_is_bit_for_bit_what_it_was(on_both_feet):
    *_, sensed = on_both_feet
    silent = noisy(on_both_feet, faults(seed=3), [3, 8])
    jax.tree.map(lambda got, was: np.testing.assert_array_equal(got[1], was), silent, sensed)
    only_forces = noisy(on_both_feet, faults(force_noise=3.0), [8])
    for field in ("angle", "speed", "roll_pitch"):
        np.testing.assert_array_equal(getattr(only_forces, field)[0], getattr(sensed, field))
    only_angles = noisy(on_both_feet, faults(angle_noise=0.01), [8])
    for field in ("corner_force", "ankle_wrench", "zmp_world"):
        np.testing.assert_array_equal(getattr(only_angles, field)[0], getattr(sensed, field))
    assert not np.any(np.asarray(only_angles.zmp_body[0] == sensed.zmp_body))


def test_zmp_and_wrench_are_those_of_the_noisy_forces(on_both_feet):
    """Each reading, computed again in NumPy from the noisy forces at the corners."""
    _, body, touch, _ = on_both_feet
    got = noisy(on_both_feet, faults(force_noise=20.0), EVERY * np.arange(20))
    corner, ankle = np.asarray(touch.p_world_corner), np.asarray(body.p_world_foot)
    yaw = Rotation.from_matrix(np.asarray(body.rot_world_trunk)).as_euler("ZYX")[0]
    heading = Rotation.from_euler("Z", yaw).as_matrix()[:2, :2]
    for i in range(20):
        force = np.asarray(got.corner_force[i])
        zmp = (force[..., None] * corner[..., :2]).sum((0, 1)) / force.sum()
        np.testing.assert_allclose(got.zmp_world[i], zmp, rtol=1e-9)
        seen = heading.T @ (zmp - np.asarray(body.p_world_trunk[:2]))
        np.testing.assert_allclose(got.zmp_body[i], seen, rtol=1e-9)
        vector = force[..., None] * [0.0, 0.0, 1.0]
        for foot in range(2):
            turn = np.asarray(body.rot_world_foot[foot]).T
            moment = np.cross(corner[foot] - ankle[foot], vector[foot]).sum(0)
            np.testing.assert_allclose(got.ankle_wrench[i, foot, :3], turn @ vector[foot].sum(0), rtol=1e-9)
            np.testing.assert_allclose(got.ankle_wrench[i, foot, 3:], turn @ moment, rtol=1e-9, atol=1e-9)


def test_zmp_seen_from_the_pelvis_is_where_noisy_joints_and_attitude_put_the_feet(on_both_feet):
    """Forward kinematics of C MuJoCo at the noisy angles, forces at the corners of its soles."""
    params, *_ = on_both_feet
    model = build_model(params)
    data = mujoco.MjData(model)
    sites = [f"{side}_{corner}" for side in SIDE_NAMES for corner in CORNER_NAMES]
    got = noisy(on_both_feet, faults(force_noise=10.0, angle_noise=0.03), EVERY * np.arange(20))
    for i in range(20):
        roll, pitch = np.asarray(got.roll_pitch[i])
        data.qpos[:3] = 0.0
        data.qpos[3:7] = Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_quat()[[3, 0, 1, 2]]
        data.qpos[7:] = np.asarray(got.angle[i]).reshape(12)
        mujoco.mj_kinematics(model, data)
        corner = np.array([data.site(name).xpos[:2] for name in sites])
        force = np.asarray(got.corner_force[i]).reshape(8)
        np.testing.assert_allclose(got.zmp_body[i], force @ corner / force.sum(), rtol=0.0, atol=2e-6)


def test_statistics_of_the_noisy_zmp_are_those_of_a_monte_carlo(on_both_feet):
    _, _, touch, sensed = on_both_feet
    got = noisy(on_both_feet, faults(force_noise=15.0, seed=2), EVERY * np.arange(20_000))
    rng = np.random.default_rng(0)
    force = np.asarray(sensed.corner_force).reshape(8) + 15.0 * rng.normal(size=(20_000, 8))
    corner = np.asarray(touch.p_world_corner)[..., :2].reshape(8, 2)
    zmp = force @ corner / force.sum(axis=1, keepdims=True)
    ours = np.asarray(got.zmp_world)
    spread = zmp.std(axis=0)
    assert np.all(spread > 1e-3)
    np.testing.assert_allclose(ours.std(axis=0), spread, rtol=0.03)
    np.testing.assert_allclose(ours.mean(axis=0), zmp.mean(axis=0), atol=4.0 * spread.max() / 20_000**0.5)
    np.testing.assert_allclose(np.cov(ours.T), np.cov(zmp.T), atol=0.05 * spread.max() ** 2)


def test_noisy_speeds_are_differences_of_the_noisy_angles(on_both_feet):
    *_, sensed = on_both_feet
    got = noisy(on_both_feet, faults(angle_noise=0.01), EVERY * np.arange(1, 50))
    angle = np.asarray(got.angle)
    change = (angle[1:] - angle[:-1]) / CONTROL_DT
    np.testing.assert_allclose(got.speed[1:], np.asarray(sensed.speed) + change, atol=1e-9)


def test_a_robot_in_the_air_keeps_its_last_zmp_whatever_the_noise(on_both_feet):
    params, body, touch, sensed = on_both_feet
    unloaded = eqx.tree_at(lambda s: s.corner_force, sensed, jnp.zeros(CORNERS))
    got = noisy((params, body, touch, unloaded), faults(force_noise=30.0, angle_noise=0.01), [8, 12, 16])
    np.testing.assert_array_equal(got.zmp_world, np.broadcast_to(sensed.zmp_world, (3, 2)))
    np.testing.assert_array_equal(got.zmp_body, np.broadcast_to(sensed.zmp_body, (3, 2)))


def test_a_reflex_shifts_by_the_noisy_zmp_it_reads(on_both_feet):
    """The shift of x_ref is the low-passed noisy ZMP over that of balance; NumPy filters the same readings."""
    params, _, touch, sensed = on_both_feet
    gait = CosineGait.preset(robot.load("surena3"), 6)
    reflex = PayloadReflex.modified(params, gait)
    stage = PayloadStage.plan(reflex, gait)
    faulty, n, loaded = faults(force_noise=40.0, angle_noise=0.02, seed=5), 2600, 100
    weight = float(sensed.corner_force.sum())

    def heavier(factor):
        return eqx.tree_at(lambda s: s.corner_force, sensed, factor * sensed.corner_force)

    def reading(i, with_noise):
        now = jax.tree.map(lambda a, b: jnp.where(i > loaded, b, a), sensed, heavier(1.0 + 300.0 / weight))
        now = eqx.tree_at(lambda s: s.time, now, (i + 1) * CONTROL_DT)
        noisy = sensors.add_noise(params, now, touch.p_world_corner, faulty, EVERY * i, EVERY, CONTROL_DT)
        return jax.tree.map(lambda a, b: jnp.where(with_noise, b, a), now, noisy)

    def walk(with_noise):
        def tick(state, i):
            seen = reading(i, with_noise)
            state, *_ = stage.step(state, gait, at(gait, seen.time), seen, Signals.none())
            return state, (seen.zmp_body[0], state.mode)

        return jax.lax.scan(tick, stage.init(), jnp.arange(n))

    (with_noise, (zmp, mode)), (without, _) = (jax.jit(walk)(jnp.asarray(w)) for w in (True, False))
    zmp, share = np.asarray(zmp), 1.0 - np.exp(-CONTROL_DT / float(reflex.zmp_time_constant))
    filtered = [zmp[0]]
    for value in zmp[1:]:
        filtered.append(filtered[-1] + share * (value - filtered[-1]))
    read = int(np.argmax(np.asarray(mode) == SHIFT))
    assert np.asarray(mode)[read] == SHIFT
    wanted = np.asarray(filtered)[[read - 1, read]] - float(reflex.zmp_balanced)
    assert min(wanted) - 1e-12 <= float(with_noise.x_shift_new) <= max(wanted) + 1e-12
    assert abs(float(with_noise.x_shift_new - without.x_shift_new)) > 1e-5

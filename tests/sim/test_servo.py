"""Servo torques against NumPy, and their implicit damping against C MuJoCo's implicitfast integrator."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_mujoco import PRESETS, as_arrays, flat, load, oracle

from jaxbiped.robot import Servo
from jaxbiped.sim import mjx_adapter, plant, servo
from jaxbiped.sim.physics.compliant import advance
from jaxbiped.sim.physics.contract import Physics
from jaxbiped.sim.servo import Reference

SHAPE = (2, 6)
DT, TICKS = 5e-4, 50


def random_servo(rng):
    return Servo(
        *as_arrays(
            *(
                rng.uniform(low, high, SHAPE)
                for low, high in (
                    (100.0, 500.0),
                    (1.0, 20.0),
                    (10.0, 50.0),
                    (0.1, 0.5),
                    (20.0, 60.0),
                    (2.0, 6.0),
                )
            )
        )
    )


def test_torque_formula(x64):
    rng = np.random.default_rng(0)
    limited = faded = 0
    for _ in range(20):
        one = random_servo(rng)
        angle, speed, integral = (
            rng.normal(scale=0.1, size=SHAPE),
            rng.normal(scale=3.0, size=SHAPE),
            rng.normal(scale=0.1, size=SHAPE),
        )
        wanted_angle, wanted_speed, extra = (
            rng.normal(scale=0.1, size=SHAPE),
            rng.normal(scale=4.0, size=SHAPE),
            rng.normal(scale=5.0, size=SHAPE),
        )
        reference = Reference(*as_arrays(wanted_angle, wanted_speed, extra))
        torque, damping = servo.torque(one, reference, *as_arrays(angle, speed, integral))
        for joint in np.ndindex(SHAPE):
            kp, kv, ki, _, most, fastest = (
                float(g[joint])
                for g in (one.kp, one.kv, one.ki, one.armature, one.torque_limit, one.speed_limit)
            )
            v = min(max(wanted_speed[joint], -fastest), fastest)
            free = (
                kp * (wanted_angle[joint] - angle[joint])
                + kv * (v - speed[joint])
                + ki * integral[joint]
                + extra[joint]
            )
            asked = 1.0 + abs(free / most) ** 16
            held = free / asked ** (1.0 / 16.0)
            too_fast = abs(speed[joint]) / fastest
            if held * speed[joint] > 0 and too_fast > 1.0:
                held *= max(0.0, 1.0 - (too_fast - 1.0) / 0.1)
                faded += 1
            limited += abs(free) > most
            assert float(torque[joint]) == pytest.approx(held, rel=1e-9, abs=1e-9)
            assert float(damping[joint]) == pytest.approx(kv * asked ** (-17.0 / 16.0), rel=1e-9)
    assert limited > 20 and faded > 5


def test_a_joint_beyond_its_speed_limit_is_braked_but_not_driven(x64):
    one = random_servo(np.random.default_rng(1))
    fast = 1.2 * one.speed_limit
    for direction in (1.0, -1.0):
        ahead = Reference(*as_arrays(np.full(SHAPE, 1.0), np.zeros(SHAPE), np.zeros(SHAPE)))
        driven, _ = servo.torque(one, ahead, jnp.zeros(SHAPE), fast, jnp.zeros(SHAPE))
        braked, _ = servo.torque(one, ahead, jnp.full(SHAPE, 2.0), direction * fast, jnp.zeros(SHAPE))
        np.testing.assert_array_equal(driven, 0.0)
        np.testing.assert_allclose(braked, -one.torque_limit if direction > 0 else 0.0, rtol=1e-3)


def test_torque_is_continuous_where_the_motor_fades(x64):
    one = random_servo(np.random.default_rng(2))
    for share in (1.0, 1.1):
        near = [
            servo.torque(
                one,
                Reference(jnp.full(SHAPE, 5.0), jnp.zeros(SHAPE), jnp.zeros(SHAPE)),
                jnp.zeros(SHAPE),
                (share + side * 1e-9) * one.speed_limit,
                jnp.zeros(SHAPE),
            )[0]
            for side in (-1.0, 1.0)
        ]
        np.testing.assert_allclose(near[0], near[1], atol=1e-5)


def test_reference_runs_on_at_constant_speed(x64):
    angle, speed, extra = as_arrays(*np.random.default_rng(3).normal(size=(3, *SHAPE)))
    later = Reference(angle, speed, extra).later(0.25)
    np.testing.assert_allclose(later.angle, angle + 0.25 * speed)
    np.testing.assert_array_equal(later.speed, speed)
    np.testing.assert_array_equal(later.feed_forward, extra)


@eqx.filter_jit
def fly(world, start, reference):
    """Configurations of a robot in the air whose servos hold a posture, tick by tick."""

    def tick(state, _):
        state, _ = advance(world, DT, reference, state)
        return state, (state.qpos, state.qvel)

    return jax.lax.scan(tick, start, None, length=TICKS)[1]


def airborne(params, stiffer, limited, seed):
    """Our plant and C MuJoCo's model, high up, upright, moving a little."""
    strong = jnp.full(SHAPE, 250.0 if limited else 1e6)
    params = eqx.tree_at(
        lambda p: (p.servo.kv, p.servo.torque_limit, p.servo.speed_limit),
        params,
        (params.servo.kv * stiffer, strong, jnp.full(SHAPE, 1e3)),  # MuJoCo knows no speed limit
    )
    ours = mjx_adapter.base_model(params)
    world = plant.make_plant(params, ours, flat())
    rng = np.random.default_rng(seed)
    qpos = np.concatenate([[0.0, 0.0, 10.0, 1.0, 0.0, 0.0, 0.0], rng.uniform(0.1, 0.4, 12)])
    qvel = rng.normal(scale=0.3, size=18)
    start, no_error, unloaded = jnp.zeros((), jnp.int32), jnp.zeros(SHAPE), jnp.zeros((2, 4))
    state = Physics(start, jnp.asarray(qpos), jnp.asarray(qvel), no_error, unloaded)
    return world, state, oracle(params, actuated=True, timestep=DT)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize(
    ("stiffer", "step"), [(1.0, 0.002), (100.0, 0.002), (1.0, 0.3)], ids=["preset", "huge kv", "saturated"]
)
def test_implicit_damping_is_implicitfast(x64, name, stiffer, step):
    """To rounding; where torques are limited to a hundredth, since MuJoCo's limit has a corner and ours is round."""
    limited = step > 0.1
    world, state, model = airborne(load(name), stiffer, limited, seed=4)
    place, speed = (1e-3, 0.03) if limited else (1e-9, 3e-6)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    wanted = np.asarray(state.qpos[7:]) + step * np.random.default_rng(5).choice([-1.0, 1.0], 12)
    reference = Reference(*as_arrays(wanted.reshape(SHAPE), np.zeros(SHAPE), np.zeros(SHAPE)))
    qpos, qvel = map(np.asarray, fly(world, state, reference))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state.qpos, state.qvel, wanted
    saturated = 0
    for tick in range(TICKS):
        mujoco.mj_step(model, data)
        saturated += int((np.abs(data.actuator_force) >= model.actuator_forcerange[:, 1]).any())
        np.testing.assert_allclose(qpos[tick], data.qpos, rtol=0, atol=place)
        np.testing.assert_allclose(qvel[tick], data.qvel, rtol=0, atol=speed * np.abs(data.qvel).max())
    assert (saturated > 5) == limited
    if stiffer > 1.0:  # speeds die away, they do not alternate
        assert np.abs(qvel[-1, 6:]).max() < 0.5 * np.abs(np.asarray(state.qvel[6:])).max()

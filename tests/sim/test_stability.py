"""The longest physics tick that is allowed, against the tick itself; joints at the ends of their ranges."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_mujoco import load, oracle
from closed_loop import setup

from jaxbiped import batch
from jaxbiped.adapt import Controller
from jaxbiped.robot import RobotParams, Servo
from jaxbiped.sim import (
    Options,
    Scenario,
    ground,
    mjx_adapter,
    plant,
    rollout,
    stability,
)
from jaxbiped.sim.options import LINEAR
from jaxbiped.sim.physics.compliant import advance
from jaxbiped.sim.physics.contract import Physics
from jaxbiped.sim.servo import Reference

SINKAGE = 1.2e-4
FLAT = Scenario.flat(1)


def weak(name: str, share: float) -> RobotParams:
    """A robot whose servos are hardly damped."""
    params = load(name)
    return eqx.tree_at(lambda r: r.servo.kv, params, params.servo.kv * share)


def servo_of(kp: float, kv: float) -> Servo:
    """The same firm servo at all joints, without limits."""
    gains = (kp, kv, 0.0, 0.2, 1e5, 1e3)
    return Servo(*(jnp.full((2, 6), gain) for gain in gains))


def hanging(params: RobotParams, angle: Any) -> tuple[plant.Plant, Physics]:
    """A robot in the air, at rest, with these joint angles."""
    world = plant.make_plant(params, mjx_adapter.base_model(params), FLAT)
    qpos = jnp.concatenate([jnp.array([0.0, 0.0, 10.0, 1.0, 0.0, 0.0, 0.0]), jnp.reshape(angle, -1)])
    still, unloaded = jnp.zeros((2, 6)), jnp.zeros((2, 4))
    return world, Physics(jnp.zeros((), jnp.int32), qpos, jnp.zeros(18), still, unloaded)


@eqx.filter_jit
def fall(world: plant.Plant, state: Physics, angle: Any, dt: float, ticks: int, ahead: float = 0.0) -> Any:
    """Joint angles of a robot that falls while its servos are told an angle, tick by tick."""
    reference = Reference(angle, jnp.zeros((2, 6)), jnp.zeros((2, 6)))

    def tick(state: Physics, _: None) -> Any:
        state, _seen = advance(world, dt, reference, state, ahead)
        return state, state.qpos[7:].reshape(2, 6)

    return jax.lax.scan(tick, state, None, length=ticks)[1]


@pytest.mark.parametrize("name", ["surena3", "elkahlout"])
def test_presets_may_tick_at_half_one_and_two_milliseconds(name):
    for gain in (1.0, 1.2):
        assert stability.largest_stable_dt(load(name), SINKAGE, gain) > 2.5e-3
    for sinkage in (1e-4, 1e-3):
        stability.require_stable_dt(load(name), 2e-3, sinkage)


def test_longest_tick_is_where_the_tick_itself_becomes_unstable(x64):
    """A knee moved by a thousandth of a radian comes to rest below it, and is flung away above it."""
    params = weak("elkahlout", 0.01)
    longest = stability.largest_stable_dt(params, SINKAGE)
    assert 1e-3 < longest < stability.LONGEST_DT
    middle = jnp.mean(params.joint_range, axis=-1)
    world, state = hanging(params, middle.at[0, 3].add(1e-3))
    for dt, stable in ((0.9 * longest, True), (1.1 * longest, False)):
        away = np.abs(np.asarray(fall(world, state, middle, dt, 150)) - np.asarray(middle)).max(axis=(1, 2))
        assert np.all(away[100:] < 2e-3) == stable, (dt, away[::20])  # what is flung far enough is NaN


def test_with_implicit_stiffness_a_long_tick_is_stable(x64):
    """The same knee comes to rest where it was flung away."""
    params = weak("elkahlout", 0.01)
    dt = 1.5 * stability.largest_stable_dt(params, SINKAGE)
    assert stability.largest_stable_dt(params, SINKAGE, implicit=LINEAR) > 1.1 * dt
    middle = jnp.mean(params.joint_range, axis=-1)
    world, state = hanging(params, middle.at[0, 3].add(1e-3))
    away = np.abs(np.asarray(fall(world, state, middle, dt, 150, dt)) - np.asarray(middle)).max(axis=(1, 2))
    assert np.all(away[100:] < 2e-3)
    stability.require_stable_dt(params, dt, SINKAGE, implicit=LINEAR)


def test_implicit_stiffness_is_the_same_servo(x64):
    """Both rules come together as the tick is halved, by half each time: they differ by a term of first order."""
    params = load("surena3")
    middle = jnp.mean(params.joint_range, axis=-1)
    world, state = hanging(params, middle + 0.02)
    apart = []
    for dt in (1e-3, 5e-4, 2.5e-4):
        ticks = round(0.1 / dt)
        ends = [np.asarray(fall(world, state, middle, dt, ticks, ahead))[-1] for ahead in (0.0, dt)]
        apart.append(np.abs(ends[0] - ends[1]).max())
    assert 1e-5 < apart[0] < 2e-3
    np.testing.assert_allclose(np.divide(apart[1:], apart[:-1]), 0.5, atol=0.1)


def test_a_tick_that_is_unstable_is_refused_with_the_longest_that_is_not():
    one = setup("elkahlout")
    params = eqx.tree_at(lambda r: r.servo.kv, one.params, one.params.servo.kv * 0.01)
    longest = stability.largest_stable_dt(params, SINKAGE)
    options = Options(dt=1.5 * longest, control_every=1)
    message = rf"dt: got {1.5 * longest:g} s, allowed: <= {0.99 * longest:.2g} s, where the servos of robot 'elkahlout'"
    with pytest.raises(ValueError, match=message):
        rollout(params, Controller(one.gait), FLAT, 1.0, options)
    with pytest.raises(ValueError, match=message):
        batch.Experiment(params, {"off": Controller(one.gait)}, batch.grid(friction=[0.8]), options)
    stability.require_stable_dt(params, 0.9 * longest, SINKAGE)
    with pytest.raises(ValueError, match="dt: got"):  # stiffer servos want a shorter one
        stability.require_stable_dt(params, 0.9 * longest, SINKAGE, gain_scale=2.0)


@pytest.mark.parametrize("name", ["surena3", "elkahlout"])
def test_a_joint_gives_way_at_the_end_of_its_range_as_in_c_mujoco(x64, name):
    """Told to go 0.3 rad beyond, servo and spring share that out, ten to one; C MuJoCo's limit holds it there too."""
    params = load(name)
    heavy = params.links.inertia.at[0].multiply(1e4)  # a trunk that does not turn
    params = eqx.tree_at(lambda r: (r.servo, r.links.inertia), params, (servo_of(4000.0, 60.0), heavy))
    upper, lower = params.joint_range[..., 1], params.joint_range[..., 0]
    dt = 5e-4
    for end, way in ((upper, 1.0), (lower, -1.0)):
        start, wanted = end - 0.1 * way, end + 0.3 * way
        world, state = hanging(params, start)
        ours = np.asarray(fall(world, state, wanted, dt, 1000))
        beyond = way * (ours - np.asarray(end))
        assert np.all(beyond[-1] > 0.005) and np.all(beyond.max(axis=0) < 0.06), beyond.max(axis=0)
        np.testing.assert_allclose(beyond[-1], 0.3 / 11.0, rtol=0.25)

        model = oracle(params, actuated=True, timestep=dt)
        model.opt.disableflags = 0
        model.geom_contype[:], model.geom_conaffinity[:] = 0, 0
        data = mujoco.MjData(model)
        data.qpos[:], data.ctrl[:] = np.asarray(state.qpos), np.asarray(wanted).reshape(-1)
        for _ in range(1000):
            mujoco.mj_step(model, data)
        theirs = way * (data.qpos[7:].reshape(2, 6) - np.asarray(end))
        assert np.all(theirs > 0.0) and np.all(theirs < 0.1), theirs


def test_a_stop_is_differentiable(x64):
    """Through a joint that runs into its end: forward mode against central differences."""
    params = load("surena3")
    start = params.joint_range[..., 1] - 0.02
    world, state = hanging(params, start)

    def last(by: Any) -> Any:
        return fall(world, state, start + 0.04 + by, 5e-4, 200)[-1]

    at, width = jnp.zeros(()), 1e-5
    _, slope = jax.jvp(last, (at,), (jnp.ones(()),))
    central = (last(at + width) - last(at - width)) / (2.0 * width)
    np.testing.assert_allclose(slope, central, rtol=1e-3, atol=1e-5)
    assert np.all(np.abs(np.asarray(slope)) < 0.5)  # the spring holds most of it


def test_a_spring_with_one_side_pushes_only_inward(x64):
    gap = jnp.asarray(np.linspace(-0.1, 0.1, 41))
    for rate in (-3.0, 0.0, 3.0):
        speed = jnp.full_like(gap, rate)
        force, damping = ground.one_sided_spring(gap, speed, jnp.asarray(100.0), 2.0, 1e-3)
        assert np.all(np.asarray(force) >= 0.0) and np.all(np.asarray(damping) >= 0.0)
        np.testing.assert_array_equal(np.asarray(force)[np.asarray(gap) + 1e-3 * rate > 0.0], 0.0)


def test_what_is_implicit_is_one_of_two_and_of_our_own_ground_only():
    with pytest.raises(ValueError, match="implicit: got 'all', allowed: damping, linear"):
        Options(implicit="all")
    message = "implicit: got 'linear', allowed with contact 'c_mujoco': damping"
    with pytest.raises(ValueError, match=message):
        Options(implicit=LINEAR, contact="c_mujoco")

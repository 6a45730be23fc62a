"""What a tick is differentiated by: inverse dynamics against C MuJoCo, derivatives against finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_mujoco import PRESETS, as_arrays, load, motions, random_states, with_cube
from numpy.testing import assert_allclose

from jaxbiped import robot
from jaxbiped.sim import Scenario, ground, mjx_adapter, plant

STATES = 20
LOAD = 8.0
"""[kg]"""
STEP = 1e-6


@pytest.fixture(params=PRESETS)
def loaded(request, x64):
    """A robot that carries a load, as a plant, and random states of it."""
    params = load(request.param)
    world = plant.make_plant(
        robot.nameless(params), mjx_adapter.base_model(params), Scenario.flat(1).with_payload(LOAD, 0.0)
    )
    return params, world, as_arrays(*random_states(params, STATES, seed=5))


def model_of(world):
    return mjx_adapter.with_masses(world.model, *world.after)


def relative(got, wanted):
    wanted = np.asarray(wanted)
    return np.max(np.abs(np.asarray(got) - wanted)) / np.max(np.abs(wanted))


@jax.jit
def needed(world, qpos, qvel, qacc):
    """Generalized forces of many motions, rotors included."""

    def one(q, v, a):
        model = model_of(world)
        body = mjx_adapter.motion(model, q, v)
        return mjx_adapter.inverse_dynamics(body, v, a, model.opt.gravity) + model.dof_armature * a

    return jax.vmap(one)(qpos, qvel, qacc)


def test_inverse_dynamics_is_that_of_c_mujoco(loaded):
    params, world, (qpos, qvel) = loaded
    place, size = np.asarray(world.scenario.payload.place), float(world.scenario.payload.size)
    model = with_cube(params, LOAD, place, size)
    data = mujoco.MjData(model)
    qacc = np.random.default_rng(0).normal(size=(STATES, 18))
    got = needed(world, qpos, qvel, jnp.asarray(qacc))
    for i in range(STATES):
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos[i], qvel[i], qacc[i]
        mujoco.mj_inverse(model, data)
        assert relative(got[i], data.qfrc_inverse) < 1e-9


@jax.jit
def motions_along(world, qpos, qvel, d_qpos, d_qvel):
    """Derivatives of many motions."""

    def one(q, v, dq, dv):
        return jax.jvp(lambda *s: mjx_adapter.motion(model_of(world), *s), (q, v), (dq, dv))[1]

    return jax.vmap(one)(qpos, qvel, d_qpos, d_qvel)


def test_every_derivative_of_a_motion_is_that_of_finite_differences(loaded):
    """Also of quaternions that are not of unit length, which MuJoCo normalises."""
    _, world, (qpos, qvel) = loaded
    qpos = qpos.at[:, 3:7].multiply(jnp.linspace(0.8, 1.2, STATES)[:, None])
    rng = np.random.default_rng(1)
    d_qpos, d_qvel = jnp.asarray(rng.normal(size=qpos.shape)), jnp.asarray(rng.normal(size=qvel.shape))
    got = motions_along(world, qpos, qvel, d_qpos, d_qvel)
    ahead, behind = (motions(model_of(world), qpos + s * d_qpos, qvel + s * d_qvel) for s in (STEP, -STEP))
    for name in got.__dataclass_fields__:
        a, b = getattr(ahead, name), getattr(behind, name)
        wanted = (a - b) / (2.0 * STEP)
        assert np.max(np.abs(wanted)) > 0.0, name
        assert relative(getattr(got, name), wanted) < 1e-8, name


@eqx.filter_jit
def motion_by_mass(world, state, mass, rate):
    """A motion under another load, and its derivative."""

    def motion(mass):
        scenario = eqx.tree_at(lambda s: s.payload.mass, world.scenario, mass)
        one = plant.make_plant(world.robot, world.model, scenario)
        return mjx_adapter.motion(model_of(one), *state)

    return jax.jvp(motion, (mass,), (rate,))


def test_a_motion_is_differentiated_by_the_masses_too(loaded):
    _, world, (qpos, qvel) = loaded
    (_, got), (ahead, _), (behind, _) = (
        motion_by_mass(world, (qpos[0], qvel[0]), jnp.asarray(LOAD + by), jnp.ones(()))
        for by in (0.0, 1e-3, -1e-3)
    )
    for name in ("centre", "dof_axes", "link_inertia", "mass_matrix", "bias"):
        wanted = (getattr(ahead, name) - getattr(behind, name)) / 2e-3
        assert relative(getattr(got, name), wanted) < 1e-8, name


def forces(world, qpos, qvel, torque):
    """Of one tick with the feet in the ground."""
    model = model_of(world)
    body = mjx_adapter.motion(model, qpos, qvel)
    touch = ground.contact(world.robot, world.scenario.ground, world.scenario.terrain, body, None, 5e-4)
    damping, push = jnp.full((2, 6), 200.0), jnp.arange(18.0)
    return plant.Forces(body, touch, torque, damping, push, qvel, model.opt.gravity, model.dof_armature, 5e-4)


@jax.jit
def accelerate(world, qpos, qvel, torque):
    """Accelerations, and what is left of the forces."""

    def one(*state):
        given = forces(world, *state)
        qacc = plant.acceleration(given)
        return qacc, plant.balance(given, qacc)

    return jax.vmap(one)(qpos, qvel, torque)


@jax.jit
def accelerate_along(world, state, way):
    """Derivatives of the accelerations along a way (qpos, qvel, torque)."""

    def one(state, way):
        return jax.jvp(lambda *s: plant.acceleration(forces(world, *s)), state, way)

    return jax.vmap(one)(state, way)


@pytest.fixture
def standing(loaded):
    """States with the soles a little in the ground, not all corners equally."""
    params, world, (qpos, qvel) = loaded
    qpos = qpos.at[:, 3:].set(jnp.array([1.0, 0, 0, 0, *np.asarray(params.joint_range.mean(-1)).reshape(-1)]))
    qpos = qpos.at[:, 7:].add(0.02 * np.random.default_rng(2).normal(size=(STATES, 12)))

    def lowest(q):
        body = mjx_adapter.motion(model_of(world), q, jnp.zeros(18))
        touch = ground.contact(world.robot, world.scenario.ground, world.scenario.terrain, body)
        return jnp.sort(touch.gap.reshape(-1))

    gaps = jax.jit(jax.vmap(lowest))(qpos)
    qpos = qpos.at[:, 2].add(-0.5 * (gaps[:, 3] + gaps[:, 4]))  # four corners in, four out
    return world, qpos, 0.05 * qvel


def test_the_right_acceleration_leaves_no_force(standing):
    world, qpos, qvel = standing
    torque = jnp.asarray(np.random.default_rng(3).normal(size=(STATES, 2, 6)) * 20.0)
    qacc, left = accelerate(world, qpos, qvel, torque)
    assert np.max(np.abs(qacc)) > 10.0
    assert np.max(np.abs(left)) < 1e-8


def test_acceleration_is_differentiated_through_inverse_dynamics(standing):
    world, qpos, qvel = standing
    rng = np.random.default_rng(4)
    state = (qpos, qvel, jnp.asarray(rng.normal(size=(STATES, 2, 6)) * 20.0))
    way = tuple(jnp.asarray(1e-3 * rng.normal(size=x.shape)) for x in state)
    value, got = accelerate_along(world, state, way)
    assert_allclose(value, accelerate(world, *state)[0], rtol=1e-9)
    ahead, behind = (
        accelerate(world, *(x + s * d for x, d in zip(state, way, strict=True)))[0] for s in (1e-4, -1e-4)
    )
    wanted = (ahead - behind) / 2e-4
    for i in range(STATES):
        assert relative(got[i], wanted[i]) < 1e-5


@eqx.filter_jit
def gap(world, state):
    """Largest difference of the two modes, and largest derivative, by each part of a state."""
    forward, backward = (
        mode(lambda *s: plant.acceleration(forces(world, *s)), argnums=(0, 1, 2))(*state)
        for mode in (jax.jacfwd, jax.jacrev)
    )
    return [(jnp.max(jnp.abs(a - b)), jnp.max(jnp.abs(a))) for a, b in zip(forward, backward, strict=True)]


def test_reverse_mode_is_the_transpose(standing):
    world, qpos, qvel = standing
    for difference, size in gap(world, (qpos[0], qvel[0], jnp.ones((2, 6)))):
        assert difference < 1e-9 * size

"""The dynamics in JAX are those of C MuJoCo: equations of motion, forces at points, integration, payloads."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_mujoco import (
    NV,
    PRESETS,
    applied_force,
    as_arrays,
    flat,
    forward,
    load,
    load64,
    mass_matrix,
    motion_at,
    motions,
    oracle,
    random_states,
    with_cube,
)

from jaxbiped import robot
from jaxbiped.sim import ground, mjx_adapter, plant
from jaxbiped.sim.model import CORNER_NAMES
from jaxbiped.sim.scenario import NEVER

STATES = 1000
FEET = {"left": 7, "right": 13}


@pytest.fixture(scope="module", params=PRESETS)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def accelerations(name):
    """qacc (1000, 18) of C MuJoCo under random joint-space forces, and what led to it."""
    params = load64(name)
    model = oracle(params)
    qpos, qvel = random_states(params, STATES)
    force = np.random.default_rng(1).normal(scale=50.0, size=(STATES, NV))
    qacc = np.stack([forward(model, *state).qacc for state in zip(qpos, qvel, force, strict=True)])
    return qpos, qvel, force, qacc


@jax.jit
def solve_all(model, qpos, qvel, force):
    def one(q, v, f):
        body = mjx_adapter.motion(model, q, v)
        return mjx_adapter.solve(mjx_adapter.blocks(body.mass_matrix), f - body.bias)

    return jax.vmap(one)(qpos, qvel, force)


def worst_error(name, accelerations):
    """Largest |qacc - C's qacc| of a state over the largest |qacc| of that state."""
    qpos, qvel, force, wanted = accelerations
    model = mjx_adapter.base_model(load(name))
    got = np.asarray(solve_all(model, *as_arrays(qpos, qvel, force)), float)
    assert got.shape == (STATES, NV)
    return np.max(np.abs(got - wanted).max(axis=1) / np.abs(wanted).max(axis=1))


def test_accelerations_of_1000_states_in_float64(x64, name, accelerations):
    assert worst_error(name, accelerations) < 1e-9


def test_accelerations_of_1000_states_in_float32(name, accelerations):
    assert worst_error(name, accelerations) < 1e-4


@pytest.fixture
def moving(x64, name):
    """Twenty random states: the robot, C MuJoCo's data and ours."""
    params = load(name)
    model, ours = oracle(params), mjx_adapter.base_model(params)
    qpos, qvel = random_states(params, 20, seed=2)
    bodies = motions(ours, *as_arrays(qpos, qvel))
    cases = [
        (forward(model, qpos[i], qvel[i]), jax.tree.map(lambda leaf, i=i: leaf[i], bodies)) for i in range(20)
    ]
    return params, model, ours, cases


def close(got, wanted, rtol=1e-10):
    np.testing.assert_allclose(got, wanted, rtol=0, atol=rtol * max(1.0, np.abs(wanted).max()))


def test_mass_matrix_and_poses(moving):
    _, model, _, cases = moving
    for data, body in cases:
        close(body.mass_matrix, mass_matrix(model, data), 1e-9)  # an empty payload of 1e-9 kg m2 is in ours
        close(body.p_world_trunk, data.body("trunk").xpos)
        close(body.rot_world_trunk, data.body("trunk").xmat.reshape(3, 3))
        close(body.centre, data.subtree_com[1])
        for side, foot in enumerate(FEET.values()):
            close(body.p_world_foot[side], data.xpos[foot])
            close(body.rot_world_foot[side], data.xmat[foot].reshape(3, 3))


def test_wrench_on_feet_and_trunk_in_joint_space(moving):
    _, model, _, cases = moving
    rng = np.random.default_rng(3)
    for data, body in cases:
        force, moment, push, twist = (rng.normal(size=shape) for shape in ((2, 3), (2, 3), (3,), (3,)))
        centre = np.asarray(body.centre)
        wanted = sum(
            applied_force(model, data, foot, centre, force[side], moment[side])
            for side, foot in enumerate(FEET.values())
        )
        close(mjx_adapter.generalized_force(body, jnp.asarray(moment), jnp.asarray(force)), wanted)
        wanted = applied_force(model, data, mjx_adapter.TRUNK, centre, push, twist)
        close(mjx_adapter.trunk_force(body, jnp.asarray(twist), jnp.asarray(push)), wanted)


def test_corners_move_as_the_sites_do(moving):
    params, model, _, cases = moving
    scene = flat()
    for data, body in cases[:5]:
        touch = ground.contact(params, scene.ground, scene.terrain, body)
        for side, side_name in enumerate(robot.SIDE_NAMES):
            for corner, corner_name in enumerate(CORNER_NAMES):
                site = data.site(f"{side_name}_{corner_name}")
                spatial = np.zeros(6)
                mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site.id, spatial, 0)
                close(touch.p_world_corner[side, corner], site.xpos)
                close(touch.v_world_corner[side, corner], spatial[3:])
                assert float(touch.gap[side, corner]) == pytest.approx(site.xpos[2], abs=1e-12)


@pytest.fixture
def pressed(moving):
    """The same states with the pelvis at 0.1 m, so that corners are deep in a soft ground."""
    params, model, ours, cases = moving
    scene = eqx.tree_at(lambda s: (s.ground.sinkage, s.ground.damping), flat(), as_arrays(0.1, 0.2))
    for data, _ in cases:
        data.qpos[2] = 0.1
        mujoco.mj_forward(model, data)
    bodies = motions(
        ours, *as_arrays(*(np.stack([getattr(d, k) for d, _ in cases]) for k in ("qpos", "qvel")))
    )
    touches = jax.vmap(lambda body: ground.contact(params, scene.ground, scene.terrain, body))(bodies)
    found = [
        (data, *jax.tree.map(lambda leaf, i=i: leaf[i], (bodies, touches)))
        for i, (data, _) in enumerate(cases[:8])
    ]
    assert sum(bool((touch.force[..., 2] > 0).any()) for *_, touch in found) >= 4
    return model, found


def test_ground_force_in_joint_space(pressed):
    model, found = pressed
    for data, body, touch in found:
        wanted = sum(
            applied_force(model, data, foot, touch.p_world_corner[side, corner], touch.force[side, corner])
            for side, foot in enumerate(FEET.values())
            for corner in range(4)
        )
        close(plant.contact_force(body, touch), wanted)


def test_damping_of_the_ground_in_joint_space(pressed):
    """By the Jacobian of every corner; over an edge too, where the normal is not upright."""
    model, found = pressed
    rng = np.random.default_rng(5)
    for data, body, touch in found:
        slope = rng.normal(loc=(0.0, 0.0, 2.0), size=(2, 4, 3))
        touch = eqx.tree_at(
            lambda t: (t.gradient, t.normal_damping),
            touch,
            as_arrays(slope, rng.uniform(0.0, 1e3, (2, 4))),
        )
        wanted = np.zeros((NV, NV))
        for side, foot in enumerate(FEET.values()):
            for corner in range(4):
                jacobian = np.zeros((3, NV))
                point = np.asarray(touch.p_world_corner[side, corner], float)
                mujoco.mj_jac(model, data, jacobian, None, point, foot)
                normal = slope[side, corner] / np.linalg.norm(slope[side, corner])
                across = float(touch.drag[side, corner]) * (np.eye(3) - np.outer(normal, normal))
                along = float(touch.normal_damping[side, corner]) * np.outer(
                    slope[side, corner], slope[side, corner]
                )
                wanted += jacobian.T @ (across + along) @ jacobian
        found, expected = ground.damping_matrix(body, touch), mjx_adapter.blocks(jnp.asarray(wanted))
        for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            close(ours, theirs)


def test_push_acts_on_the_centre_of_mass_of_the_trunk_for_its_share_of_the_tick(moving):
    params, model, ours, cases = moving
    world = plant.make_plant(params, ours, flat().with_push((30.0, -20.0, 10.0), 1.0, 0.1))
    data, body = cases[0]
    wanted = applied_force(model, data, 1, data.xipos[1], (30.0, -20.0, 10.0))
    dt = 1e-3
    for time, share in ((0.5, 0.0), (0.9996, 0.6), (1.05, 1.0), (1.0998, 0.2), (1.2, 0.0)):
        close(plant.push_force(world, body, jnp.asarray(time), dt), share * wanted, 1e-9)


at_rest = eqx.filter_jit(plant.motion_at_rest)


@eqx.filter_jit
def integrate_all(model, qpos, qvel, dt):
    return jax.vmap(lambda q, v: mjx_adapter.integrate(model, q, v, dt))(qpos, qvel)


def test_integration_of_positions(moving):
    params, model, ours, _ = moving
    qpos, qvel = random_states(params, 50, seed=4, speed=5.0)
    for dt in (5e-4, 0.1):
        got = integrate_all(ours, *as_arrays(qpos, qvel), dt=dt)
        for i in range(50):
            wanted = qpos[i].copy()
            mujoco.mj_integratePos(model, wanted, qvel[i], dt)
            close(got[i], wanted, 1e-12)


LOAD = {"mass": 12.0, "place": (0.21, 0.03, 0.25), "size": 0.3}


def loaded_plant(params, ours, payload_model, time=1.0, end=NEVER):
    scene = eqx.tree_at(
        lambda s: s.payload.place, flat().with_payload(LOAD["mass"], time, end), as_arrays(LOAD["place"])[0]
    )
    scene = eqx.tree_at(lambda s: s.payload.size, scene, as_arrays(LOAD["size"])[0])
    return plant.make_plant(params, ours, scene, payload_model)


def test_exact_payload_is_a_welded_cube(moving):
    params, bare, ours, cases = moving
    model = with_cube(params, **LOAD)
    world = loaded_plant(params, ours, plant.EXACT)
    for data, _ in cases[:5]:
        state = as_arrays(data.qpos, data.qvel)
        wanted = forward(model, data.qpos, data.qvel)
        body = motion_at(world, *state, time=jnp.asarray(2.0), dt=1e-3)
        close(body.mass_matrix, mass_matrix(model, wanted))
        close(body.bias, wanted.qfrc_bias)
        before = motion_at(world, *state, time=jnp.asarray(0.5), dt=1e-3)
        close(before.mass_matrix, mass_matrix(bare, data), 1e-9)
        close(before.bias, data.qfrc_bias, 1e-9)


def test_payload_attached_inside_a_tick_counts_for_the_rest_of_it(moving):
    """A tick that the load is there for a quarter of sees a quarter of its mass, in its place."""
    params, _, ours, cases = moving
    data, _ = cases[0]
    world = loaded_plant(params, ours, plant.EXACT, time=1.00075)
    body = motion_at(world, *as_arrays(data.qpos, data.qvel), time=jnp.asarray(1.0), dt=1e-3)
    quarter = with_cube(params, LOAD["mass"] / 4, LOAD["place"], LOAD["size"])
    wanted = forward(quarter, data.qpos, data.qvel)
    close(body.mass_matrix, mass_matrix(quarter, wanted), 1e-9)
    close(body.bias, wanted.qfrc_bias, 1e-9)


@pytest.mark.parametrize("model", plant.PAYLOAD_MODELS)
def test_load_counts_for_its_share_of_every_tick(moving, model):
    """Put on at 1.00075 s and taken off at 1.01025 s, in ticks of 1 ms; the other one within one tick."""
    params, _, ours, cases = moving
    data, _ = cases[0]
    state = as_arrays(data.qpos, data.qvel)
    world = loaded_plant(params, ours, model, 1.00075, 1.01025)
    always, never = loaded_plant(params, ours, model, 0.0), loaded_plant(params, ours, model, 5.0)
    brief = loaded_plant(params, ours, model, 1.0002, 1.0007)
    late = {"time": jnp.asarray(2.0), "dt": 1e-3}
    trunk = [float(motion_at(one, *state, **late).link_inertia[0, -1]) for one in (never, always)]
    for one, time, share in (
        (world, 0.9, 0.0),
        (world, 1.0, 0.25),
        (world, 1.001, 1.0),
        (world, 1.009, 1.0),
        (world, 1.01, 0.25),
        (world, 1.011, 0.0),
        (world, 30.0, 0.0),
        (brief, 1.0, 0.5),
        (brief, 1.001, 0.0),
    ):
        body = motion_at(one, *state, time=jnp.asarray(time), dt=1e-3)
        got = float(body.link_inertia[0, -1])
        assert got == pytest.approx(trunk[0] + share * (trunk[1] - trunk[0]), abs=1e-9), time
    assert trunk[1] - trunk[0] == pytest.approx(LOAD["mass"])


def test_the_robot_settles_with_a_load_at_0_and_without_one_that_comes_later(moving):
    params, _, ours, cases = moving
    qpos = as_arrays(cases[0][0].qpos)[0]
    model = with_cube(params, **LOAD)
    wanted = forward(model, cases[0][0].qpos, np.zeros(18))
    body = at_rest(loaded_plant(params, ours, plant.EXACT, 0.0, 1.0), qpos)
    close(body.mass_matrix, mass_matrix(model, wanted))
    close(body.bias, wanted.qfrc_bias)
    bare = at_rest(loaded_plant(params, ours, plant.EXACT, 5.0), qpos)
    for time in (1e-6, 1e-4):  # within the first tick of any kind
        soon = at_rest(loaded_plant(params, ours, plant.EXACT, time), qpos)
        np.testing.assert_array_equal(soon.mass_matrix, bare.mass_matrix)


def test_thesis_payload_is_equations_3_8_to_3_10(moving):
    """Mass and inertia grow by the same factor, the centre of mass moves; no parallel-axis term."""
    params, _, ours, cases = moving
    world = loaded_plant(params, ours, plant.THESIS)
    model = oracle(params)
    m, c = model.body_mass[1], model.body_ipos[1].copy()
    model.body_mass[1] = m + LOAD["mass"]
    model.body_ipos[1] = (m * c + LOAD["mass"] * np.array(LOAD["place"])) / (m + LOAD["mass"])
    model.body_inertia[1] *= (m + LOAD["mass"]) / m
    for data, _ in cases[:5]:
        wanted = forward(model, data.qpos, data.qvel)
        body = motion_at(world, *as_arrays(data.qpos, data.qvel), time=jnp.asarray(2.0), dt=1e-3)
        close(body.mass_matrix, mass_matrix(model, wanted), 1e-9)
        close(body.bias, wanted.qfrc_bias, 1e-9)


def pitch_inertia(masses, params):
    """Of trunk and load about their common centre of mass [kg m2], by hand; nothing in a leg."""
    mass, com, inertia = (np.asarray(part, float) for part in masses)
    total, bodies = 0.0, (mjx_adapter.TRUNK, mjx_adapter.PAYLOAD)
    centre = sum(mass[b] * com[b] for b in bodies) / sum(mass[b] for b in bodies)
    for b in bodies:
        x, _, z = com[b] - centre
        total += inertia[b, 1] + mass[b] * (x * x + z * z)
    return total


def test_what_the_missing_parallel_axis_term_is_worth(x64, record_property):
    """10 kg on the thesis' own robot: its equations leave out 19 % of the pitch inertia of trunk and load."""
    params = load("elkahlout")
    ours = mjx_adapter.base_model(params)
    scene = flat().with_payload(10.0, 1.0)
    exact, thesis = (
        pitch_inertia(plant.make_plant(params, ours, scene, kind).after, params)
        for kind in (plant.EXACT, plant.THESIS)
    )
    record_property("pitch_inertia_exact", float(exact))
    record_property("pitch_inertia_thesis", float(thesis))
    print(f"pitch inertia of trunk and 10 kg: exact {exact:.4f}, thesis {thesis:.4f} kg m2")
    m, m_load = 50.0, 10.0
    apart = 0.25**2 * m * m_load / (m + m_load)  # load 0.2 m ahead, trunk CoM 0.05 m behind, same height
    assert exact == pytest.approx(50.0 * (0.2**2 + 0.5**2) / 12 + 10.0 * 0.2**2 / 6 + apart, rel=1e-6)
    assert thesis == pytest.approx(60.0 * (0.2**2 + 0.5**2) / 12, rel=1e-6)
    assert 1.0 - thesis / exact == pytest.approx(0.1926, abs=1e-3)


def test_model_errors_scale_links_and_move_the_trunk(moving):
    params, _, ours, cases = moving
    scale, offset = np.random.default_rng(5).uniform(0.8, 1.2, 13), np.array([0.01, -0.02, 0.03])
    scene = eqx.tree_at(
        lambda s: (s.errors.mass_scale, s.errors.trunk_com_offset), flat(), as_arrays(scale, offset)
    )
    world = plant.make_plant(params, ours, scene)
    model = oracle(params)
    model.body_mass[1:] *= scale
    model.body_inertia[1:] *= scale[:, None]
    model.body_ipos[1] += offset
    data, _ = cases[0]
    wanted = forward(model, data.qpos, data.qvel)
    body = motion_at(world, *as_arrays(data.qpos, data.qvel), time=jnp.asarray(0.0), dt=1e-3)
    close(body.mass_matrix, mass_matrix(model, wanted), 1e-9)
    close(body.bias, wanted.qfrc_bias, 1e-9)
    np.testing.assert_allclose(world.servo.kp, params.servo.kp)

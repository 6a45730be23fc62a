"""C MuJoCo with its own contacts agrees with the compliant ground, and shows the scenario it is given."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from closed_loop import STANDS_FOR, setup
from scipy.integrate import cumulative_trapezoid

from jaxbiped.adapt import Controller
from jaxbiped.kinematics import joint_angles
from jaxbiped.robot.layout import BIPED
from jaxbiped.sim import Options, Scenario, ground, lockstep, prepare
from jaxbiped.sim.mjx_adapter import TRUNK
from jaxbiped.sim.model import build_spec
from jaxbiped.sim.options import C_MUJOCO
from jaxbiped.sim.physics import c_world
from jaxbiped.sim.physics.c_world import BOX, SPHERES, STIFF, build_world, level_boxes
from jaxbiped.sim.statistics import FELL, OK

FLAT = Scenario.flat()


STEPS = 5


@functools.cache
class Case:
    """A robot and its gait."""

    def __init__(self, name: str):
        one = setup(name, n_steps=STEPS)
        self.params, self.gait, self.weight = one.params, one.gait, one.weight
        self.options = Options(
            feed_forward=name == "surena3",
            control_every=one.options.control_every,
            trace_every=5,
            contact=C_MUJOCO,
        )
        self.controller = Controller(one.gait)
        self.duration = float(one.gait.duration) + STANDS_FOR

    def walk(
        self,
        scenario: Scenario = FLAT,
        duration: float | None = None,
        contact: str = SPHERES,
        **options: Any,
    ):
        """Walk in C MuJoCo."""
        simulation = prepare(self.params, self.controller, dataclasses.replace(self.options, **options))
        one = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], scenario)
        walks = lockstep.run(simulation, one, duration or self.duration, contact=contact)
        return jax.tree.map(lambda leaf: leaf[0], walks)


@pytest.fixture(scope="module", params=["elkahlout", pytest.param("surena3", marks=pytest.mark.slow)])
def case(request):
    return Case(request.param)


@pytest.fixture(scope="module")
def flat(case):
    return case.walk()


def test_stands_still_at_first_with_its_weight_on_the_ground_at_the_stated_sinkage(case, flat):
    early = np.asarray(flat.trace.time) < 0.1
    np.testing.assert_allclose(
        np.asarray(flat.trace.foot_force)[early].sum(axis=1),
        np.broadcast_to([0.0, 0.0, case.weight], (early.sum(), 3)),
        rtol=0.01,
        atol=0.02 * case.weight,  # sideways, the pelvis has begun to move
    )  # fmt: skip
    sunk = -np.asarray(flat.trace.p_world_sole)[early][:, :, 2].mean()
    assert sunk == pytest.approx(float(FLAT.ground.sinkage), rel=0.1)


def test_stiffer_ground_is_sunk_into_less(case):
    stiff = eqx.tree_at(lambda s: s.ground.sinkage, FLAT, jnp.array(1.5e-4))
    sunk = -np.asarray(case.walk(stiff, duration=0.1).trace.p_world_sole)[-1, :, 2].mean()
    assert sunk == pytest.approx(1.5e-4, rel=0.1)


def test_walks_upright_and_stops(case, flat):
    stats = flat.statistics
    assert int(stats.status) == OK
    assert float(stats.end_time) == pytest.approx(case.duration, abs=1e-3)
    assert (np.rad2deg(stats.peak_roll_pitch) < 3.0).all()
    planned = np.asarray(case.gait.task(case.gait.duration).pelvis)
    np.testing.assert_allclose(flat.trace.p_world_trunk[-1, :2], planned[:2], atol=0.02)
    assert float(stats.out_of_reach_time) == 0.0
    assert flat.trace.targets.time.shape == flat.trace.time.shape


def forces_at_an_edge(contact: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str], np.ndarray]:
    """A robot on the edge of a box, where normals lean: forces at the corners and where these are; then of every
    contact its force on the foot, the foot's geom and its place, all as MuJoCo has them."""
    case = Case("elkahlout")
    scenario = FLAT.with_rectangle((-0.2, -0.3), (0.131, 0.0), 0.002)
    model = build_world(case.params, scenario, 5e-4, contact)
    data, force = mujoco.MjData(model), np.zeros(6)
    data.qvel[0] = 0.3
    for _ in range(100):
        mujoco.mj_step(model, data)
    sole, turn = data.site_xpos[[0, 5]], data.xmat.reshape(-1, 3, 3)[BIPED.feet]
    found = c_world.corner_forces(case.params, contact, data.sensordata[None], sole[None], turn[None])[0]
    geoms, forces = [], []
    for i in range(data.ncon):
        pair = data.contact[i]
        mujoco.mj_contactForce(model, data, i, force)
        one, other = (model.geom(int(g)).name for g in (pair.geom1, pair.geom2))
        second = other.startswith(("left", "right"))
        geoms.append(other if second else one)
        forces.append((1.0 if second else -1.0) * pair.frame.reshape(3, 3).T @ force[:3])
    assert len(geoms) > 0
    return found, data.site_xpos[[1, 2, 3, 4, 6, 7, 8, 9]], np.array(forces), geoms, data.contact.pos


@pytest.mark.parametrize("contact", [SPHERES, STIFF])
def test_forces_of_the_sensors_are_those_of_the_contacts(contact):
    found, _, forces, geoms, _ = forces_at_an_edge(contact)
    wanted = {name: np.zeros(3) for name in c_world.CORNERS}
    for name, force in zip(geoms, forces, strict=True):
        wanted[name] += force
    np.testing.assert_allclose(found, list(wanted.values()), atol=1e-9)


def test_forces_of_a_box_have_the_sum_and_the_centre_of_the_contacts():
    found, corner, forces, geoms, place = forces_at_an_edge(BOX)
    for foot, side in enumerate(("left", "right")):
        mine, own = [g == f"{side}_box" for g in geoms], slice(4 * foot, 4 * foot + 4)
        assert any(mine)
        np.testing.assert_allclose(found[own].sum(axis=0), forces[mine].sum(axis=0), atol=1e-9)
        np.testing.assert_allclose(
            found[own, 2] @ corner[own, :2], forces[mine, 2] @ place[mine, :2], rtol=1e-3, atol=1e-2
        )


def test_it_is_an_engine_of_the_simulation():
    """`run` walks there by an option; a pure tick there is none."""
    case = Case("elkahlout")
    simulation = prepare(case.params, case.controller, case.options)
    walk, same = simulation.run(FLAT, 0.1), case.walk(duration=0.1)
    for a, b in zip(jax.tree.leaves(walk), jax.tree.leaves(same), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(
        ValueError, match="contact: got 'c_mujoco', which has no pure tick; allowed: compliant, mjx"
    ):
        simulation.walk(FLAT, 1)


@pytest.mark.parametrize("name", ["elkahlout", pytest.param("surena3", marks=pytest.mark.slow)])
def test_a_pad_that_nobody_sees_is_fatal(name):
    case = Case(name)
    pad = FLAT.with_obstacle(case.params, case.gait, step=3, height=0.03 if name == "surena3" else 0.02)
    walk = case.walk(pad)
    assert int(walk.statistics.status) == FELL
    landing = float(case.gait.timing.touchdown(3))
    assert landing - 0.6 < float(walk.statistics.end_time) < case.duration
    assert walk.trace is not None
    assert walk.trace.time[-1] <= walk.statistics.end_time


@pytest.mark.parametrize("model", ["exact", "thesis"])
def test_load_weighs_from_its_time_on(case, model):
    walk = case.walk(FLAT.with_payload(2.0, 0.1), duration=0.4, payload_model=model)
    time = np.asarray(walk.trace.time)
    force = np.asarray(walk.trace.foot_force)[..., 2].sum(axis=1)
    assert force[time < 0.1].mean() == pytest.approx(case.weight, abs=0.01 * case.weight)
    assert force[time > 0.3].mean() == pytest.approx(case.weight + 2.0 * 9.81, abs=0.01 * case.weight)


@pytest.mark.parametrize("model", ["exact", "thesis"])
def test_load_that_is_carried_from_the_start_weighs_until_it_is_taken_off(case, model):
    walk = case.walk(FLAT.with_payload(2.0, 0.0, 0.1), duration=0.4, payload_model=model)
    time = np.asarray(walk.trace.time)
    force = np.asarray(walk.trace.foot_force)[..., 2].sum(axis=1)
    loaded = case.weight + 2.0 * 9.81
    np.testing.assert_allclose(force[time < 0.1], loaded, rtol=0.01)  # settled with it: nothing drops
    assert force[time > 0.3].mean() == pytest.approx(case.weight, abs=0.01 * case.weight)


def test_a_load_that_is_taken_off_leaves_the_model_as_it_was():
    model = build_world(Case("elkahlout").params, FLAT, 5e-4)
    before, data = c_world.without_load(model), mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bare = data.qfrc_bias.copy()
    c_world.attach(model, FLAT.with_payload(7.0, 0.0).payload, "exact")
    mujoco.mj_forward(model, data)
    assert not np.allclose(data.qfrc_bias, bare)
    c_world.detach(model, before)
    mujoco.mj_forward(model, data)
    np.testing.assert_array_equal(data.qfrc_bias, bare)


def test_attached_cube_is_a_welded_cube():
    """Against a model compiled with the cube in it."""
    case = Case("elkahlout")
    load = FLAT.with_payload(7.0, 0.0).payload
    model = build_world(case.params, FLAT, 5e-4)
    c_world.attach(model, load, "exact")
    spec = build_spec(case.params, 5e-4)
    trunk = spec.body("trunk")
    assert trunk is not None
    cube = trunk.add_body(pos=np.asarray(load.place, float).tolist())
    cube.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[float(load.size) / 2] * 3, mass=7.0)
    welded = spec.compile()
    rng = np.random.default_rng(0)
    qpos, qvel = (
        np.concatenate([[0.0, 0.0, 2.0, 0.8, 0.6, 0.0, 0.0], rng.normal(size=12)]),
        rng.normal(size=18),
    )
    inertia, bias, centre = [], [], []
    for one in (model, welded):
        data = mujoco.MjData(one)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(one, data)
        full = np.zeros((18, 18))
        mujoco.mj_fullM(one, data, full)
        inertia.append(full)
        bias.append(data.qfrc_bias.copy())
        centre.append(data.subtree_com[TRUNK].copy())
    np.testing.assert_allclose(inertia[0], inertia[1], atol=1e-5)
    np.testing.assert_allclose(bias[0], bias[1], atol=1e-3)
    np.testing.assert_allclose(centre[0], centre[1], atol=1e-6)


def test_servos_integrate_their_error():
    """A load held with the error e without an integral is held by kp e + ki int e with one."""
    case, rate = Case("elkahlout"), 4.0

    def knees(ki: float) -> tuple[np.ndarray, np.ndarray]:
        robot = eqx.tree_at(lambda r: r.servo.ki, case.params, ki * np.asarray(case.params.servo.kp))
        trace = prepare(robot, case.controller, case.options).run(FLAT, 0.5).trace
        assert trace is not None
        asked = jax.tree.map(jnp.asarray, trace.targets.position)
        wanted, _ = jax.vmap(lambda p: joint_angles(case.params, p.sole - p.pelvis))(asked)
        error = wanted - jax.vmap(BIPED.leg_angles)(jnp.asarray(trace.qpos))
        return np.asarray(trace.time), np.asarray(error[:, :, 3])

    (_, alone), (time, error) = knees(0.0), knees(rate)
    assert np.abs(alone).min() > 5e-4 and np.abs(error[-1]).max() < 3e-4
    held = error + rate * cumulative_trapezoid(error, time, axis=0, initial=0.0)
    np.testing.assert_allclose(held, alone, rtol=0.15)


def test_push_pushes(case):
    walk = case.walk(FLAT.with_push((40.0, 0.0, 0.0), 0.1, 0.2), duration=0.3)
    force = np.asarray(walk.trace.foot_force).sum(axis=1)
    pushed = np.asarray(walk.trace.time) > 0.2
    assert force[pushed, 0].mean() == pytest.approx(-40.0, rel=0.3)
    assert abs(force[np.asarray(walk.trace.time) < 0.1, 0]).max() < 4.0


TERRAINS = {
    "flat": FLAT,
    "pad": FLAT.with_rectangle((0.1, -0.2), (0.4, 0.1), 0.03),
    "overlap": FLAT.with_rectangle((0.1, -0.2), (0.4, 0.1), 0.03).with_rectangle((0.3, 0.0), (0.6, 0.3), 0.02),
    "hole": FLAT.with_rectangle((0.1, -0.2), (0.4, 0.1), -0.03),
    "pad in a hole": FLAT.with_rectangle((0.0, -0.4), (0.6, 0.4), -0.05).with_rectangle((0.2, -0.1), (0.4, 0.2), 0.08),
    "many": FLAT.with_rectangle((0.0, -0.4), (0.6, 0.4), -0.05).with_rectangle((0.5, -0.1), (0.9, 0.2), 0.04)
    .with_rectangle((-0.5, -0.5), (0.2, 0.0), 0.02).with_rectangle((-0.3, -0.2), (0.7, 0.3), -0.01),
}  # fmt: skip


@pytest.mark.parametrize("name", TERRAINS)
def test_rays_hit_the_ground_where_the_terrain_says(name):
    scenario, params = TERRAINS[name], Case("surena3").params
    model = build_world(params, scenario, 5e-4)
    data = mujoco.MjData(model)
    data.qpos[2] = 50.0
    mujoco.mj_kinematics(model, data)
    rng = np.random.default_rng(0)
    point = rng.uniform(-0.6, 1.0, size=(300, 2))
    t = scenario.terrain
    edges = np.concatenate([np.asarray(t.lower), np.asarray(t.upper)])
    point = point[(np.abs(point[:, None] - edges) > ground.EDGE_WIDTH).all(axis=(1, 2))]
    hit = np.zeros(1, np.int32)
    down = np.array([0.0, 0.0, -1.0])
    found = [
        1.0 - mujoco.mj_ray(model, data, np.array([x, y, 1.0]), down, None, True, -1, hit, None)
        for x, y in point
    ]
    np.testing.assert_allclose(found, ground.height(t, jnp.asarray(point)), atol=1e-6)
    np.testing.assert_allclose(c_world.heights(t, point), ground.height(t, jnp.asarray(point)), atol=1e-6)


def test_one_box_for_a_pad_and_four_around_a_hole():
    assert len(level_boxes(TERRAINS["pad"].terrain)[1]) == 1
    base, boxes = level_boxes(TERRAINS["hole"].terrain)
    assert base == pytest.approx(-0.03)
    assert len(boxes) == 4 and all(top == 0.0 for _, _, top in boxes)


CONTACTS = [SPHERES, BOX, STIFF]


def test_unknown_contact_is_refused():
    with pytest.raises(ValueError, match="contact: got 'sphere', allowed: spheres, box, stiff; did you mean"):
        Case("elkahlout").walk(contact="sphere")


@pytest.mark.parametrize("contact", CONTACTS)
def test_stands_on_every_contact_at_its_height_with_its_weight(contact):
    case = Case("elkahlout")
    stands, usual = (case.walk(duration=0.1, contact=one).trace for one in (contact, SPHERES))
    assert stands is not None and usual is not None
    np.testing.assert_allclose(stands.foot_force[..., 2].sum(axis=1), case.weight, rtol=0.01)
    np.testing.assert_allclose(stands.corner_force.sum(axis=-1), stands.foot_force[..., 2], rtol=1e-5)
    np.testing.assert_allclose(stands.zmp_world, usual.zmp_world, atol=2e-3)
    wanted = float(FLAT.ground.sinkage) * (0.25 if contact == STIFF else 1.0)
    assert -np.asarray(stands.p_world_sole)[..., 2].mean() == pytest.approx(wanted, rel=0.1)


@pytest.mark.parametrize("contact", CONTACTS)
def test_an_edge_under_the_soles_carries(contact):
    """Ground 1 mm higher from under the soles on: corners stand on it with the toes, a plate lies on its edge."""
    case, edge, height = Case("surena3"), 0.02, 0.001
    scenario = FLAT.with_rectangle((edge, -0.5), (1.0, 0.5), height)
    model = build_world(case.params, scenario, 5e-4, contact)
    data = mujoco.MjData(model)
    data.qpos[2] += height
    for _ in range(800):
        mujoco.mj_step(model, data)
    sole, turn = data.site_xpos[[0, 5]], data.xmat.reshape(-1, 3, 3)[BIPED.feet]
    force = c_world.corner_forces(case.params, contact, data.sensordata[None], sole[None], turn[None])[0]
    assert force[:, 2].sum() == pytest.approx(case.weight, rel=0.05)  # the trunk rocks
    assert force[[0, 1, 4, 5], 2].sum() > 0.05 * case.weight
    toe, heel = data.site_xpos[1], data.site_xpos[3]
    place = edge if contact == BOX else toe[0]
    carried = heel[2] + (toe - heel)[2] * (place - heel[0]) / (toe - heel)[0]
    assert carried == pytest.approx(height, abs=3e-4)

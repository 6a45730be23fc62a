"""The plan's ZMP, torques and margins against C MuJoCo's inverse dynamics of the same motion."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import polynomial_walks
import pytest
from polynomial_walks import KNOWN, LONG_WALKS, NOT_OPTIMISED, SAMPLES, WALKS

from jaxbiped import robot
from jaxbiped.kinematics import Wrench, dynamics
from jaxbiped.planner import (
    SINGLE_SUPPORT,
    CosineGait,
    Feasibility,
    PolynomialGait,
    Targets,
    at,
    feasibility,
    sample_times,
)
from jaxbiped.planner.feasibility import Frozen, instant, motion_of, share_between_feet, zmp_of
from jaxbiped.robot import LEFT, RIGHT
from jaxbiped.sim.model import build_model

STEP = 2e-5
"""Of the finite differences [s]."""
MARGIN = 0.07
"""Least ZMP margin of the surena3 walks [m]; the middle of a foot has 0.08."""
TABLE = {"A": (123, 75), "B": (119, 70), "C": (120, 76), "D": (115, 72), "E": (116, 75)}
"""Single-support ZMP margins of gaits A to E in x and y, as a prototype with a model of its own had them [mm]."""


@functools.partial(jax.jit, compiler_options=NOT_OPTIMISED)
@functools.partial(jax.vmap, in_axes=(None, 0))
def _judge(biped, targets) -> Feasibility:
    return instant(biped, Frozen(targets), jnp.zeros(()))


def judge(biped, targets) -> Feasibility:
    """Feasibility of any (n,) targets of any robot, in blocks of one size: compiled once, whatever the gait."""
    biped = dataclasses.replace(biped, name="any", walks_like="")  # static, so that it would compile anew
    targets = jax.tree.map(np.asarray, targets)
    count = len(targets.phase.step)
    blocks = []
    for start in range(0, count, SAMPLES):
        rows = np.minimum(np.arange(start, start + SAMPLES), count - 1)
        block = jax.tree.map(lambda leaf: jnp.asarray(leaf[rows]), targets)  # noqa: B023
        blocks.append(_judge(biped, block))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:count], *blocks)


@functools.cache
def _walk(name: str):
    """A preset's 8-step walk: robot, gait, and times in float64."""
    biped = robot.load(name)
    if name == "surena3":
        row = KNOWN.index("preset")
        gait = jax.tree.map(lambda leaf: leaf[row], polynomial_walks.planned(8, LEFT))
    else:
        gait = CosineGait.preset(biped, 8)
    return biped, gait, sample_times(gait, 150)


def _clear(gait, times) -> np.ndarray:
    """Which times are away from those at which an acceleration bends or jumps."""
    t = gait.timing
    liftoff = np.array([float(t.liftoff(k)) for k in range(int(t.n_steps))])
    T_s, T_c = float(t.T_s), float(t.T_c)
    ends = [0.0, float(gait.params.T_ini), float(gait.duration - gait.params.T_end), float(gait.duration)]
    middle = np.append(liftoff[0] - T_c + T_s, liftoff + T_s) + 0.5 * (T_c - T_s)
    changes = np.concatenate([ends, liftoff, liftoff + T_s, liftoff + 0.5 * T_s, middle])
    return np.abs(np.asarray(times)[:, None] - changes).min(axis=1) > 2 * STEP


@dataclasses.dataclass
class Inverse:
    """What C MuJoCo says of a motion, at each time."""

    sole: np.ndarray
    zmp: np.ndarray
    centroidal_zmp: np.ndarray
    ground_force: np.ndarray
    com: np.ndarray
    torque: np.ndarray
    root_residual: np.ndarray


@functools.cache
def _walk_and_inverse(name: str) -> tuple[Feasibility, Inverse]:
    """Feasibility of a preset's walk and the same from mj_inverse, away from knots."""
    biped, gait, times = _walk(name)
    times = np.asarray(times)[_clear(gait, times)]
    now = jnp.asarray(np.concatenate([times - STEP, times, times + STEP]))
    n = len(times)
    targets = jax.tree.map(np.asarray, jax.jit(jax.vmap(at, in_axes=(None, 0)))(gait, now))
    judged = judge(biped, targets)
    angle, speed = judged.angle.reshape(-1, 12), judged.speed.reshape(-1, 12)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (3 * n, 1))
    qpos = np.concatenate([targets.position.pelvis, upright, angle], axis=1)
    qvel = np.concatenate([targets.velocity.pelvis, np.zeros((3 * n, 3)), speed], axis=1)
    before, middle, after = slice(0, n), slice(n, 2 * n), slice(2 * n, None)
    qacc = (qvel[after] - qvel[before]) / (2 * STEP)
    assert np.abs((angle[after] - angle[before]) / (2 * STEP) - speed[middle]).max() < 1e-7
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf[middle]), targets)
    _, feet = _ground_wrenches(dataclasses.replace(biped, name="any", walks_like=""), state)
    now_only = jax.tree.map(lambda leaf: leaf[middle], judged)
    return now_only, _inverse(build_model(biped), qpos, qvel, qacc, jax.tree.map(np.asarray, feet))


@functools.partial(jax.jit, compiler_options=NOT_OPTIMISED)
@functools.partial(jax.vmap, in_axes=(None, 0))
def _ground_wrenches(biped, targets) -> tuple[Wrench, Wrench]:
    """In total, and on each foot."""
    motion = motion_of(biped, Frozen(targets).task)
    total = dynamics.evaluate(biped, motion, jnp.zeros(())).ground_wrench
    return total, share_between_feet(biped, targets.position, targets.phase, total)


def _inverse(model, qpos, qvel, qacc, feet) -> Inverse:
    """`qpos`, `qvel` at n times before, n now and n after; `qacc` now; `feet` the wrenches on the feet now."""
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data, n, mass, gravity = mujoco.MjData(model), len(qacc), model.body_subtreemass[1], 9.81
    sides = ("left", "right")
    sites = [model.site(f"{side}_sole").id for side in sides]
    foot = [model.body(f"{side}_foot").id for side in sides]

    def momenta(i):
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        return data.subtree_com[1].copy(), data.subtree_linvel[1].copy(), data.subtree_angmom[1].copy()

    out = {field.name: [] for field in dataclasses.fields(Inverse)}
    for i in range(n):
        (_, v0, l0), (_, v1, l1) = momenta(i), momenta(i + 2 * n)
        com, _, _ = momenta(i + n)
        force = mass * ((v1 - v0) / (2 * STEP) + [0.0, 0.0, gravity])
        moment = np.cross(com, force) + (l1 - l0) / (2 * STEP)
        out["centroidal_zmp"].append([-moment[1] / force[2], moment[0] / force[2]])
        out["com"].append(com)
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos[i + n], qvel[i + n], qacc[i]
        mujoco.mj_inverse(model, data)
        trunk = data.xmat[1].reshape(3, 3)  # a free joint's torque is in the axes of its body
        force = data.qfrc_inverse[:3].copy()
        moment = trunk @ data.qfrc_inverse[3:6] + np.cross(data.xpos[1], force)
        out["zmp"].append([-moment[1] / force[2], moment[0] / force[2]])
        out["ground_force"].append(force)
        out["sole"].append(data.site_xpos[sites].copy())
        from_ground = np.zeros(model.nv)
        for side in (LEFT, RIGHT):  # a moment about the world's origin is one about the point (0, 0, 0)
            mujoco.mj_applyFT(
                model, data, feet.force[i, side], feet.moment[i, side], np.zeros(3), foot[side], from_ground
            )
        rest = data.qfrc_inverse - from_ground
        out["torque"].append(rest[6:].reshape(2, 6))
        out["root_residual"].append(rest[:6])
    return Inverse(**{name: np.array(rows) for name, rows in out.items()})


@pytest.fixture(params=["surena3", "elkahlout"])
def walk(request, x64):
    """Name of the preset, what we say of its walk, what C MuJoCo says."""
    return (request.param, *_walk_and_inverse(request.param))


def test_the_two_have_the_same_motion(walk):
    name, judged, inverse = walk
    _, gait, times = _walk(name)
    times = times[_clear(gait, times)]
    sole = jax.jit(jax.vmap(lambda t: gait.task(t).sole))(times)
    assert np.abs(inverse.sole - sole).max() < 1e-12
    assert np.abs(inverse.com - judged.com).max() < 1e-12
    assert np.all(judged.ik_status == 0)


def test_zmp_is_that_of_mujocos_inverse_dynamics(walk):
    _, judged, inverse = walk
    assert np.abs(judged.zmp - inverse.zmp).max() < 1e-8
    assert np.abs(judged.ground_force - inverse.ground_force).max() < 1e-5


def test_zmp_is_that_of_the_momenta(walk):
    """Centroidal: acceleration of the centre of mass and rate of the angular momentum."""
    _, judged, inverse = walk
    assert np.abs(judged.zmp - inverse.centroidal_zmp).max() < 1e-7


def test_zmp_needs_the_whole_body(walk):
    """The tests above could not pass with a point mass: that one is 24 and 4 mm off."""
    _, judged, _ = walk
    force, com = judged.ground_force, judged.com
    point_mass = com[:, :2] - com[:, 2:] * force[:, :2] / force[:, 2:]
    assert np.abs(judged.zmp - point_mass).max() > 3e-3


def test_torques_are_those_of_mujocos_inverse_dynamics(walk):
    """With the feet's wrenches from `share_between_feet` as external forces; they leave nothing to the trunk."""
    _, judged, inverse = walk
    assert np.abs(judged.torque).max() > 50.0
    assert np.abs(judged.torque - inverse.torque).max() < 1e-5
    assert np.abs(inverse.root_residual).max() < 1e-5


def test_feet_share_the_ground_wrench(x64):
    """The parts add up, no foot pulls, and in single support the swing foot has nothing."""
    biped, gait, times = _walk("surena3")
    targets = jax.jit(jax.vmap(at, in_axes=(None, 0)))(gait, times)
    total, feet = _ground_wrenches(dataclasses.replace(biped, name="any", walks_like=""), targets)
    assert np.allclose(feet.force.sum(axis=1), total.force, rtol=0.0, atol=1e-9)
    assert np.allclose(feet.moment.sum(axis=1), total.moment, rtol=0.0, atol=1e-9)
    assert feet.force[..., 2].min() >= 0.0
    single = np.asarray(targets.phase.support == SINGLE_SUPPORT)
    swing = np.asarray(targets.phase.swing)
    assert np.all(np.asarray(feet.force)[single, swing[single]] == 0.0)
    assert np.all(np.asarray(feet.moment)[single, swing[single]] == 0.0)
    both = np.asarray(feet.force)[~single, :, 2]
    assert both.min(axis=1).max() > 100.0  # and in double support the load does pass from one to the other


def test_zmp_has_no_horizontal_moment_at_any_height(x64):
    force, moment = jnp.array([30.0, -20.0, 700.0]), jnp.array([-60.0, 90.0, 5.0])
    for height in (0.0, 0.2):
        point = jnp.append(zmp_of(Wrench(force, moment), height), height)
        about_point = moment - np.cross(point, force)
        assert np.allclose(about_point[:2], 0.0, atol=1e-12)


def test_feasibility_of_a_walk_is_that_of_its_instants(x64):
    """The public function, in both number formats, against the `judge` that the tests on this page use."""
    biped, gait, times = _walk("surena3")
    expected = judge(biped, jax.jit(jax.vmap(at, in_axes=(None, 0)))(gait, times))
    with jax.enable_x64(False):
        single = PolynomialGait.preset(robot.load("surena3"), 8)
        got = feasibility(robot.load("surena3"), single, jnp.asarray(times, jnp.float32))
    assert np.abs(got.zmp - expected.zmp).max() < 2e-5
    assert np.abs(got.zmp_margin - expected.zmp_margin).max() < 2e-5
    assert np.abs(got.torque - expected.torque).max() < 0.05
    assert np.abs(got.knee - expected.knee).max() < 1e-4
    assert np.abs(got.friction - expected.friction).max() < 1e-5
    assert np.array_equal(got.support_upper > got.support_lower, np.ones((len(times), 2), bool))


# Margins of whole walks


@functools.cache
def _surena3_walks(n_steps: int, first_swing: int) -> tuple[Targets, Feasibility]:
    """All known gaits: (gait, time)."""
    targets = polynomial_walks.targets((np.arange(SAMPLES) + 0.5) / SAMPLES, n_steps, first_swing)
    known = jax.tree.map(lambda leaf: leaf[: len(KNOWN)], targets)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), known)
    judged = judge(robot.load("surena3"), flat)
    return jax.tree.map(lambda leaf: leaf.reshape(len(KNOWN), SAMPLES, *leaf.shape[1:]), (flat, judged))


@pytest.mark.parametrize(("n_steps", "first_swing"), [*WALKS, *LONG_WALKS])
def test_surena3_walks_are_feasible_from_rest_to_rest(n_steps, first_swing, x64):
    """Gaits A to E and the preset, at 400 times from rest to rest."""
    _, walks = _surena3_walks(n_steps, first_swing)
    for name, least, friction in [*((name, 0.065, 0.11) for name in TABLE), ("preset", MARGIN, 0.1)]:
        row = KNOWN.index(name)
        judged = jax.tree.map(lambda leaf: leaf[row], walks)  # noqa: B023
        assert judged.zmp_margin.min() > least, name
        assert judged.friction.max() < friction, name
        assert judged.torque_share.max() < 0.5, name
        assert judged.speed_share.max() < 0.7, name
        assert judged.knee.min() > 0.2, name
        assert np.all(judged.ik_status == 0), name


@pytest.mark.parametrize("name", list(TABLE))
def test_margins_of_gaits_a_to_e_are_those_of_the_prototype(name, x64):
    """Within 2 mm, though the trunk and the feet are other boxes than the prototype's."""
    targets, walks = _surena3_walks(8, LEFT)
    row = KNOWN.index(name)
    judged, phase = (jax.tree.map(lambda leaf: leaf[row], tree) for tree in (walks, targets.phase))
    inside = np.minimum(judged.zmp - judged.support_lower, judged.support_upper - judged.zmp)
    steady_single = (phase.support == SINGLE_SUPPORT) & (phase.step >= 2) & (phase.step < 6)
    got = inside[steady_single].min(axis=0)
    assert np.abs(1e3 * np.array(got) - TABLE[name]).max() < 2.0


def test_default_elkahlout_walk_tips_over_the_toes_at_the_end_of_single_support_and_nowhere_else(x64):
    """By what the sole_toe that Table 4.1 was calibrated with is too short for this plan."""
    biped, gait, _ = _walk("elkahlout")
    targets = jax.jit(jax.vmap(at, in_axes=(None, 0)))(gait, sample_times(gait, 1200))
    judged, phase = judge(biped, targets), targets.phase
    outside = judged.zmp_margin < 0.0
    beyond_toes = judged.zmp[:, 0] - judged.support_upper[:, 0]
    assert np.allclose(beyond_toes[outside], -judged.zmp_margin[outside], atol=1e-12)
    stance = np.take_along_axis(np.asarray(targets.position.sole)[..., 0], 1 - phase.swing[:, None], 1)[:, 0]
    ahead = (judged.zmp[:, 0] - stance)[phase.support == SINGLE_SUPPORT].max()
    toe = float(biped.p_sole_corner[..., 0].max())
    assert float(beyond_toes.max()) == pytest.approx(float(ahead) - toe, abs=1e-9)
    assert 0.0 < beyond_toes.max() < 0.05
    assert np.all(phase.support[outside] == SINGLE_SUPPORT)
    assert np.all(phase.time_since_liftoff[outside] > 0.6 * phase.T_s[outside])
    assert 0.05 < outside.mean() < 0.25
    assert judged.friction.max() < 0.1
    assert judged.torque_share.max() < 0.5
    assert judged.speed_share.max() < 0.5
    assert judged.knee.min() > 0.5
    assert np.all(judged.ik_status == 0)

"""Laws of the simulated world: weight, rest, free flight, friction, ground force, mirror, smaller ticks, failure."""

import dataclasses
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_mujoco import as_arrays, flat, load64, motions, oracle, random_states
from closed_loop import lane, run, setup, stack
from conftest import CARRIED, LEAN

from jaxbiped import robot
from jaxbiped.adapt import Controller
from jaxbiped.planner import PolynomialGait, TaskSpace, at
from jaxbiped.sim import Scenario, ground, mjx_adapter, prepare, segments, statistics
from jaxbiped.sim.model import CORNER_NAMES


def c_states(params: robot.RobotParams, qpos: np.ndarray) -> list[mujoco.MjData]:
    """C MuJoCo's kinematics of every row."""
    model, found = oracle(params), []
    for row in np.asarray(qpos, float):
        data = mujoco.MjData(model)
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        found.append(data)
    return found


# Standing still


def test_standing_forces_add_up_to_the_weight(walks):
    force = walks.trace("stand").foot_force.sum(axis=1)
    np.testing.assert_allclose(force[:, 2], walks.one.weight, rtol=1e-3)
    assert np.abs(force[:, :2]).max() < 1e-3 * walks.one.weight


def test_a_load_at_0_is_own_weight_until_it_is_taken_off(walks):
    """The robot stands at rest with it from the very start; without it, it settles to its own weight again."""
    mass, _, end = CARRIED
    trace, still = walks.trace("carry"), walks.trace("stand")
    force = trace.foot_force[..., 2].sum(axis=1)
    before = trace.time < end - 1e-6
    np.testing.assert_allclose(force[before], walks.one.weight + mass * 9.81, rtol=1e-3)
    np.testing.assert_allclose(
        trace.qpos[before], np.broadcast_to(trace.qpos[0], trace.qpos[before].shape), atol=1e-4
    )
    assert trace.qpos[0, 5] > still.qpos[0, 5] + 2e-5  # it leans forward under the load
    np.testing.assert_allclose(force[trace.time > end + 2.0], walks.one.weight, rtol=2e-3)
    assert walks.statistics("carry").status == statistics.OK


def test_standing_zmp_is_under_the_centre_of_mass(walks):
    trace = walks.trace("stand")
    com = np.array([data.subtree_com[0, :2] for data in c_states(walks.one.params, trace.qpos)])
    np.testing.assert_allclose(trace.zmp_world, com, atol=1e-3)


def test_standing_robot_sinks_in_as_stated(walks):
    """Its corners are as deep as the scenario says, in the mean."""
    for data in c_states(walks.one.params, walks.trace("stand").qpos[::50]):
        height = [data.site(f"{s}_{c}").xpos[2] for s, c in itertools.product(robot.SIDE_NAMES, CORNER_NAMES)]
        assert np.mean(height) == pytest.approx(-1.2e-4, rel=0.01)
        assert np.max(height) < 0.0


def test_standing_robot_does_not_move_from_the_very_start(walks):
    """No initial drop: in 10 s nothing is ever faster than 2e-4 m/s or rad/s (float32 settles by 1e-6)."""
    trace = walks.trace("stand")
    speed = np.diff(trace.qpos, axis=0) / np.diff(trace.time)[:, None]
    assert np.abs(speed).max() < 2e-4
    assert np.ptp(trace.p_world_trunk[:, 2]) < 5e-6
    assert walks.statistics("stand").status == statistics.OK


def test_pushed_robot_hardly_creeps(walks):
    """Under 40 N it would slide less than 0.5 mm in 10 s, at most as regularized friction does, and then it stops.

    That is slip_speed x r / sqrt(1 - r^2), r = F / (mu weight), of which float32 leaves no more than the size.
    """
    trace, scene = walks.trace("stand and bear"), flat()
    push = np.hypot(*LEAN[:2])
    assert push > 40.0
    share = push / (0.8 * walks.one.weight)
    speed = float(scene.ground.slip_speed) * share / np.sqrt(1.0 - share**2)
    middle = trace.p_world_sole.mean(axis=1)[:, :2]
    times = trace.time
    moved = middle[np.searchsorted(times, 6.0)] - middle[np.searchsorted(times, 2.0)]
    assert np.linalg.norm(moved) < 2.0 * 4.0 * speed + 1e-5
    assert np.linalg.norm(moved) * 10.0 / 4.0 < 5e-4
    print(f"{walks.one.params.name}: creeps {1e3 * np.linalg.norm(moved) / 4.0:.5f} mm/s under {push:.1f} N")
    rest = middle[np.searchsorted(times, 8.0) :]
    assert np.ptp(rest, axis=0).max() < 1e-4


# Free flight


@jax.jit
def fly(model, qpos, qvel, dt, ticks):
    def tick(_, state):
        q, v = state
        body = mjx_adapter.motion(model, q, v)
        v = v + dt * mjx_adapter.solve(mjx_adapter.blocks(body.mass_matrix), -body.bias)
        return mjx_adapter.integrate(model, q, dt * v, 1.0), v  # dt is traced: one compilation

    return jax.lax.fori_loop(0, ticks, tick, (qpos, qvel))


def invariants(
    model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, time: float
) -> dict[str, np.ndarray]:
    """Energy, linear momentum without gravity's share, and angular momentum about the centre of mass."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    mujoco.mj_subtreeVel(model, data)
    mass = model.body_subtreemass[0]
    return {
        "energy": data.energy.sum(),
        "momentum": mass * (data.subtree_linvel[0] + [0.0, 0.0, 9.81 * time]),
        "spin": data.subtree_angmom[0].copy(),
        "place": data.subtree_com[0] + [0.0, 0.0, 0.5 * 9.81 * time**2],
    }


FLIGHT = 0.4


@pytest.mark.parametrize("name", ["surena3", "elkahlout"])
def test_free_flight_keeps_energy_and_momentum(x64, name):
    """Without ground and servos the drift of semi-implicit Euler is small and halves with the tick."""
    params = load64(name)
    model, ours = oracle(params), mjx_adapter.base_model(params)
    qpos, qvel = random_states(params, 1, seed=6, speed=1.0)
    start = invariants(model, qpos[0], qvel[0], 0.0)
    drift = {key: [] for key in start}
    for ticks in (400, 800, 1600):
        q, v = fly(ours, jnp.asarray(qpos[0]), jnp.asarray(qvel[0]), FLIGHT / ticks, ticks)
        end = invariants(model, np.asarray(q), np.asarray(v), FLIGHT)
        end["place"] -= FLIGHT * start["momentum"] / model.body_subtreemass[0]
        for key in start:
            drift[key].append(end[key] - start[key])
    size = {
        "energy": abs(start["energy"]),
        "momentum": np.linalg.norm(start["momentum"]),
        "spin": np.linalg.norm(start["spin"]),
        "place": 1.0,
    }
    for key, errors in drift.items():
        norms = [float(np.linalg.norm(e) / size[key]) for e in errors]
        print(f"{name}: {key} drifts by {norms} at ticks of 1, 0.5, 0.25 ms")
        assert norms[0] < 0.02
        assert norms[2] < 1e-9 or all(1.7 < a / b < 2.3 for a, b in itertools.pairwise(norms))


# The ground


def touching(params: robot.RobotParams, depths: Any, speeds: Any, scene: Scenario) -> ground.Contact:
    """Contacts of a robot whose level soles are at these depths, moving as a whole at these velocities."""
    n = len(depths)
    straight = float(
        params.thigh_length + params.shank_length + params.ankle_height - params.p_pelvis_hip[0, 2]
    )
    qpos = np.zeros((n, 19))
    qpos[:, 2], qpos[:, 3] = straight - np.asarray(depths), 1.0
    qvel = np.zeros((n, 18))
    qvel[:, :3] = speeds
    bodies = motions(mjx_adapter.base_model(params), *as_arrays(qpos, qvel))
    return jax.vmap(lambda body: ground.contact(params, scene.ground, scene.terrain, body))(bodies)


def test_normal_force_is_the_spring_s_with_damping_that_levels_off(x64):
    params, scene = load64("surena3"), flat()
    sinkage, damping = float(scene.ground.sinkage), float(scene.ground.damping)
    depths = np.array([-1e-2, -1e-9, 0.0, 1e-9, 1e-4, sinkage, 2e-3] + [1e-3] * 4 + [3e-4] * 9)
    speeds = np.zeros((20, 3))
    speeds[7:11, 2] = [-1.0, -0.1, 0.002, 0.3]
    got = np.asarray(touching(params, depths, speeds, scene).force[..., 2])
    k = float(params.total_mass) * 9.81 / (8 * sinkage)
    rate = damping * speeds[:, 2]  # at 1 m/s 300 by Hunt and Crossley, here less than 3
    wanted = k * np.maximum(depths, 0.0) * np.maximum(0.0, 1.0 - 3.0 * rate / np.hypot(3.0, rate))
    np.testing.assert_allclose(got, np.broadcast_to(wanted[:, None, None], got.shape), atol=1e-6)
    assert got[5].sum() == pytest.approx(
        float(params.total_mass) * 9.81
    )  # at the stated sinkage it bears the weight
    assert np.all(got[3] < 1e-2) and np.all(got[10] == 0.0)  # continuous at touchdown; never pulls


def test_friction_is_regularised_coulomb(x64):
    params, scene = load64("elkahlout"), flat()
    speeds = np.zeros((20, 3))
    speeds[:, 0] = np.concatenate([[0.0, float(scene.ground.slip_speed)], np.geomspace(1e-5, 10.0, 18)])
    speeds[:, 1] = 0.5 * speeds[:, 0]
    speeds[1, 1] = 0.0
    touch = touching(params, np.full(20, 3e-4), speeds, scene)
    force = np.asarray(touch.force)
    sideways, normal = np.linalg.norm(force[..., :2], axis=-1), force[..., 2]
    assert np.all(sideways <= 0.8 * normal)
    np.testing.assert_allclose(sideways[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(sideways[1], 0.8 * normal[1] / np.sqrt(2.0))
    np.testing.assert_allclose(sideways[-1], 0.8 * normal[-1], rtol=1e-4)
    assert np.all(np.einsum("ncdi,ni->ncd", force[1:, ..., :2], speeds[1:, :2]) < 0.0)
    np.testing.assert_allclose(touch.drag[..., None] * speeds[:, None, None, :2], -force[..., :2], atol=1e-12)


def test_derivative_of_the_ground_force_is_finite_at_touchdown(x64):
    params, scene = load64("surena3"), flat()
    body = jax.tree.map(
        lambda leaf: leaf[0],
        motions(mjx_adapter.base_model(params), *as_arrays(np.eye(20, 19, k=3)[:20], np.zeros((20, 18)))),
    )

    def force(lift):
        moved = eqx.tree_at(
            lambda b: b.p_world_foot, body, body.p_world_foot.at[:, 2].set(params.ankle_height + lift)
        )
        return ground.contact(params, scene.ground, scene.terrain, moved).force

    for lift in (0.0, -1.2e-4, 1e-3):
        value, slope = jax.jvp(force, (jnp.asarray(lift),), (jnp.asarray(1.0),))
        assert np.all(np.isfinite(value)) and np.all(np.isfinite(slope))
    stiffness = float(ground.stiffness(params, scene.ground))
    np.testing.assert_allclose(
        jax.jvp(force, (jnp.asarray(-1.2e-4),), (jnp.asarray(1.0),))[1][..., 2], -stiffness
    )


def smooth(share: float) -> float:
    share = min(max(share, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


def test_terrain_height(x64):
    """Plateau, hole, edge, their sum where they overlap, and nothing elsewhere."""
    scene = (
        flat().with_rectangle((0.0, -0.1), (0.4, 0.1), 0.03).with_rectangle((0.2, -0.3), (0.6, 0.05), -0.01)
    )
    points = np.array(
        list(itertools.product(np.arange(-0.1013, 0.7, 0.0137), np.arange(-0.4001, 0.3, 0.0211)))
    )
    edge = np.array(
        [[0.0, 0.0], [0.001, 0.0], [-0.001, 0.0], [0.4, -0.1], [0.1, 0.1], [0.5, 0.05], [0.0021, 0.0]]
    )
    points = np.concatenate([points, edge])

    def wanted(x, y):
        total = 0.0
        for (x0, y0), (x1, y1), h in (((0.0, -0.1), (0.4, 0.1), 0.03), ((0.2, -0.3), (0.6, 0.05), -0.01)):
            across = [smooth(min(p - a, b - p) / 0.004 + 0.5) for p, a, b in ((x, x0, x1), (y, y0, y1))]
            total += h * across[0] * across[1]
        return total

    got = np.asarray(ground.height(scene.terrain, jnp.asarray(points)))
    np.testing.assert_allclose(got, [wanted(*p) for p in points], atol=1e-15)
    simple = {
        (0.1, 0.0): 0.03,
        (0.3, 0.0): 0.02,
        (0.5, -0.2): -0.01,
        (0.7, 0.0): 0.0,
        (0.1, -0.2): 0.0,
        (0.0, 0.0): 0.015,
    }
    for point, height in simple.items():
        assert float(ground.height(scene.terrain, jnp.array(point))) == pytest.approx(height, abs=1e-15)
    assert set(np.round(got, 3)) >= {0.03, 0.02, -0.01, 0.0}


def test_terrain_is_differentiable_in_height_and_edges(x64):
    scene = flat().with_rectangle((0.0, -0.1), (0.4, 0.1), 0.03)
    points = jnp.asarray(np.array([[0.0005, 0.02], [0.3992, -0.0998], [0.2, 0.1003], [0.1, 0.0]]))

    def heights(terrain):
        return ground.height(terrain, points)

    def moved(field, index, by):
        return eqx.tree_at(
            lambda t: getattr(t, field), scene.terrain, getattr(scene.terrain, field).at[index].add(by)
        )

    for field, index in (
        ("height", (0,)),
        ("lower", (0, 0)),
        ("lower", (0, 1)),
        ("upper", (0, 0)),
        ("upper", (0, 1)),
    ):
        _, slope = jax.jvp(
            lambda by, f=field, i=index: heights(moved(f, i, by)), (jnp.asarray(0.0),), (jnp.asarray(1.0),)
        )
        central = (heights(moved(field, index, 1e-7)) - heights(moved(field, index, -1e-7))) / 2e-7
        np.testing.assert_allclose(slope, central, rtol=1e-5, atol=1e-7)
        assert np.abs(np.asarray(slope)).max() > 0.1


# Failures


def test_topple_is_a_fall_and_the_lane_freezes(walks):
    stats, trace = walks.statistics("topple"), walks.trace("topple")
    assert stats.status == statistics.FELL
    assert 3.0 < stats.end_time < 5.0
    after = trace.qpos[np.searchsorted(trace.time, stats.end_time) :]
    assert len(after) > 100 and np.all(after == after[-1])
    before = trace.qpos[(trace.time > 2.0) & (trace.time < stats.end_time - 0.02)]
    assert np.all(np.any(np.diff(before, axis=0) != 0.0, axis=1))
    assert np.rad2deg(stats.peak_roll_pitch[0]) == pytest.approx(45.0, abs=0.5)


def test_a_lane_that_is_not_a_number_fails_alone(walks):
    """The lane ends at its first tick; the others are bit for bit what they are beside a healthy neighbour."""
    one, stats = walks.one, walks.statistics("no gain")
    assert stats.status in (statistics.NONFINITE, statistics.FELL) and stats.end_time <= 2 * one.options.dt
    if one.params.name != "surena3":
        return
    healthy = run(one, [(one.gait, Scenario.flat().with_friction(0.8 - 0.05 * i)) for i in range(4)])
    jax.tree.map(np.testing.assert_array_equal, lane(healthy, 0), lane(walks.batch, 0))


# Mirror and smaller ticks, in float64


class Mirrored(eqx.Module):
    """A gait, or its mirror image: left is right."""

    gait: PolynomialGait
    mirrored: jax.Array

    @property
    def duration(self) -> Any:
        return self.gait.duration

    @property
    def timing(self) -> Any:
        return self.gait.timing

    def task(self, t: Any) -> TaskSpace:
        task, flip = self.gait.task(t), jnp.array([1.0, -1.0, 1.0])
        other = TaskSpace(task.sole[::-1] * flip, task.pelvis * flip)
        return jax.tree.map(lambda a, b: jnp.where(self.mirrored, b, a), task, other)

    def phase(self, t: Any) -> Any:
        phase = self.gait.phase(t)
        return eqx.tree_at(lambda p: p.swing, phase, jnp.where(self.mirrored, 1 - phase.swing, phase.swing))


class Player(Controller):
    """A controller of any gait."""

    gait: Any

    def __init__(self, gait: Any):
        self.gait, self.stages = gait, ()


def test_mirrored_scenario_gives_the_mirrored_walk(x64):
    """Through the first step, onto an obstacle, pushed and with a load on one side."""
    one = setup("surena3")
    scene = flat().with_obstacle(one.params, one.gait, 0, 0.004).with_push((10.0, 30.0, 0.0), 1.0, 0.4)
    scene = scene.with_payload(3.0, 1.6)
    scene = eqx.tree_at(lambda s: s.payload.place, scene, jnp.array([0.1, 0.08, 0.2]))
    flip = jnp.array([1.0, -1.0])
    there, back = scene.terrain.lower, scene.terrain.upper
    other = eqx.tree_at(
        lambda s: (s.terrain.lower, s.terrain.upper, s.push.force, s.payload.place),
        scene,
        (
            there.at[:, 1].set(-back[:, 1]),
            back.at[:, 1].set(-there[:, 1]),
            scene.push.force.at[:2].multiply(flip),
            scene.payload.place.at[:2].multiply(flip),
        ),
    )
    gaits = [Mirrored(one.gait, jnp.array(mirrored)) for mirrored in (False, True)]
    right_first = PolynomialGait.preset(one.params, one.gait.n_steps, robot.RIGHT)
    for time in (1.0, 2.2, 2.9, 4.0):
        planned, image = at(right_first, time), at(gaits[1], time)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), planned, image)
    simulation = prepare(one.params, Player(one.gait), dataclasses.replace(one.options, feed_forward=True))
    # without the check of what is underfoot at the start
    a, b = (
        lane(segments.run(simulation.led_by(Player(g)), stack([s]), 3.0), 0)
        for g, s in zip(gaits, (scene, other), strict=True)
    )
    assert a.trace is not None and b.trace is not None
    signs = np.array([1, -1, 1, 1, -1, 1, -1] + [-1, -1, 1, 1, 1, -1] * 2)
    swapped = np.concatenate([np.arange(7), np.arange(13, 19), np.arange(7, 13)])
    assert np.abs(a.trace.qpos - b.trace.qpos).max() > 0.01
    np.testing.assert_allclose(b.trace.qpos[:, swapped] * signs, a.trace.qpos, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        b.trace.foot_force[:, ::-1] * [1, -1, 1], a.trace.foot_force, rtol=0, atol=1e-3
    )
    np.testing.assert_array_equal(b.trace.switch[:, ::-1][..., [1, 0, 3, 2]], a.trace.switch)
    np.testing.assert_allclose(b.statistics.peak_foot_force[::-1], a.statistics.peak_foot_force, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["surena3", "elkahlout"])
def test_halving_the_tick_halves_the_change_of_a_walk(x64, name):
    ends = []
    for dt in (1e-3, 5e-4, 2.5e-4):
        every = round(2e-3 / dt)
        one = setup(name, dt=dt, control_every=every, trace_every=0)
        options = dataclasses.replace(one.options, feed_forward=True)
        stats = prepare(one.params, Player(one.gait), options).run(flat(), 5.0).statistics
        assert int(stats.status) == statistics.OK
        ends.append(np.concatenate([stats.p_world_trunk, stats.peak_roll_pitch]))
    first, second = np.abs(ends[0] - ends[1]), np.abs(ends[1] - ends[2])
    print(f"{name}: x, y, z [mm], roll, pitch [deg] by halving 1 ms and 0.5 ms")
    unit = np.array([1e3, 1e3, 1e3, *np.rad2deg([1.0, 1.0])])
    print(first * unit, second * unit)
    for part in (slice(0, 3), slice(3, 5)):
        ratio = np.linalg.norm(first[part]) / np.linalg.norm(second[part])
        assert 1.3 < ratio < 3.0, ratio
    assert np.linalg.norm(second[:3]) < 5e-4 and np.rad2deg(np.linalg.norm(second[3:])) < 0.1

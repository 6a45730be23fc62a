"""Both robots walk from rest to rest; one compilation serves every scenario, gait and robot of a kind."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from closed_loop import N_STEPS, changed, setup

from jaxbiped.adapt import Controller
from jaxbiped.planner import (
    SINGLE_SUPPORT,
    PolynomialGait,
    TaskSpace,
    support,
)
from jaxbiped.sim import Scenario, rollout, statistics

EARLY = 0.2
"""How long before the planned touchdown the swing foot may already bear load [s]."""


def margins(params: Any, trace: Any) -> np.ndarray:
    """How far the measured ZMP is inside the polygon of the feet that should be loaded, where these are [m]."""

    def one(phase, sole, zmp):
        return support.margin(support.corners(params, TaskSpace(sole, sole[0])), support.loaded(phase), zmp)

    return np.asarray(jax.jit(jax.vmap(one))(trace.targets.phase, trace.p_world_sole, trace.zmp_world))


def judge(one: Any, stats: Any, trace: Any, early: bool) -> None:
    """The walk went well; with `early`, but for feet that touch down early the ZMP is in the support polygon."""
    tilt = np.rad2deg(stats.peak_roll_pitch)
    force = stats.peak_foot_force / one.weight
    end = np.asarray(one.gait.task(one.gait.duration).pelvis)
    inside = margins(one.params, trace)
    phase = trace.targets.phase
    left = float(one.gait.timing.T_s) - phase.time_in_phase
    excepted = (phase.support == SINGLE_SUPPORT) & (left < EARLY) & early
    print(
        f"{one.params.name}, {one.gait.n_steps} steps: roll, pitch {tilt} deg, slip {1e3 * stats.peak_slip} mm, "
        f"foot force {force} weights, ends {1e3 * (stats.p_world_trunk - end)} mm from the plan, "
        f"ZMP margin {1e3 * inside[~excepted].min():.1f} mm ({1e3 * inside.min():.1f} mm at early touchdowns)"
    )
    assert stats.status == statistics.OK
    assert stats.end_time == pytest.approx(one.duration, abs=0.02)
    assert np.all(tilt < 3.0)
    assert np.all(stats.peak_slip < 5e-3)
    assert np.all(force < 1.5) and np.all(force > 0.9)
    assert stats.out_of_reach_time == 0.0
    np.testing.assert_allclose(stats.p_world_trunk, end, atol=0.04)
    last = trace.qpos[trace.time > one.duration - 0.1]
    assert np.abs(np.diff(last, axis=0)).max() / 0.01 < 0.01
    np.testing.assert_allclose(trace.foot_force[-1, :, 2], 0.5 * one.weight, rtol=0.2)
    assert np.all(trace.switch[-1])
    assert inside[~excepted].min() > -2e-3
    assert np.mean(excepted) < 0.25


def test_walk_with_feed_forward(walks):
    """A foot that comes down a few milliseconds early bears at once: the ground is hard."""
    judge(walks.one, walks.statistics("walk"), walks.trace("walk"), True)


def test_walk_without_feed_forward(walks):
    judge(walks.one, walks.statistics("without feed-forward"), walks.trace("without feed-forward"), True)


def test_feet_swing_as_planned(walks):
    """Each foot leaves the ground in its own single supports and stands in the other's."""
    trace = walks.trace("walk")
    phase = trace.targets.phase
    middle = (phase.support == SINGLE_SUPPORT) & (
        np.abs(phase.time_in_phase / walks.one.gait.timing.T_s - 0.5) < 0.25
    )
    assert len(set(phase.step[middle])) == N_STEPS
    swing = phase.swing[middle][:, None] == np.arange(2)
    load = trace.foot_force[middle, :, 2]
    assert np.all(load[swing] == 0.0)
    np.testing.assert_allclose(load[~swing], walks.one.weight, rtol=0.1)
    planned = trace.targets.position.sole
    np.testing.assert_allclose(trace.p_world_sole, planned, atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "n_steps", "with_torque"),
    [("surena3", 24, True), ("elkahlout", 12, True), ("elkahlout", 12, False)],
)
def test_long_walk(name, n_steps, with_torque):
    one = setup(name, n_steps, feed_forward=with_torque)
    walk = rollout(one.params, Controller(one.gait), Scenario.flat(), one.duration, one.options)
    stats, trace = jax.tree.map(np.asarray, (walk.statistics, walk.trace))
    judge(one, stats, trace, name == "elkahlout")


# One compilation

COMPILED: list[str] = []


def _listen(event: str, duration_secs: float, **_: Any) -> None:
    if event == "/jax/core/compile/backend_compile_duration":
        COMPILED.append(event)


def variants(one: Any) -> list[tuple[Any, Any, Scenario]]:
    """Other scenarios, gait parameters and masses."""
    flat, gait, params = Scenario.flat(), one.gait, one.params
    polynomial = PolynomialGait.preset_params("surena3")
    slower = PolynomialGait.make(params, changed(polynomial, D_s=0.24, y_m=-0.02), gait.n_steps)
    heavier = eqx.tree_at(lambda p: p.links.mass, params, params.links.mass * 1.05)
    return [
        (params, gait, flat.with_payload(2.0, 2.0)),
        (params, gait, flat.with_obstacle(params, gait, 1, 0.003)),
        (params, gait, flat.with_friction(0.5).with_push((5.0, 0.0, 0.0), 1.0, 0.1)),
        (params, slower, flat),
        (heavier, gait, flat),
    ]


def test_nothing_recompiles_and_a_batch_is_its_single_walks(walks):
    """The public roll-out, one scenario at a time."""
    if walks.one.params.name != "surena3":
        pytest.skip("one robot will do: the shapes are the same")
    one = walks.one
    jax.monitoring.register_event_duration_secs_listener(_listen)
    cases = variants(one)
    COMPILED.clear()
    single = rollout(one.params, Controller(one.gait), Scenario.flat(), one.duration, one.options)
    stats, trace = jax.tree.map(np.asarray, (single.statistics, single.trace))
    assert COMPILED, "the first walk compiles, so the listener listens"
    COMPILED.clear()
    ends = [
        np.asarray(rollout(r, Controller(g), s, one.duration, one.options).statistics.p_world_trunk)
        for r, g, s in cases
    ]
    assert not COMPILED
    ends.append(stats.p_world_trunk)
    assert len({end.tobytes() for end in ends}) == len(ends)  # and every one of them is another walk
    batched = walks.statistics("walk")
    np.testing.assert_allclose(trace.qpos, walks.trace("walk").qpos, atol=1e-4)
    np.testing.assert_allclose(stats.p_world_trunk, batched.p_world_trunk, atol=1e-4)
    np.testing.assert_allclose(stats.peak_foot_force, batched.peak_foot_force, rtol=5e-3)


def test_robot_carried_off_the_ground_is_airborne(walks):
    """It neither tilts nor sinks, and its plan stands: only that nothing bears it tells."""
    stats, trace = walks.statistics("carried off"), walks.trace("carried off")
    assert statistics.STATUS_TEXT[int(stats.status)] == "airborne"
    left = trace.time[np.flatnonzero(trace.foot_force[:, :, 2].sum(axis=1) > statistics.TOUCHING)[-1]]
    assert stats.end_time == pytest.approx(left + statistics.AIRBORNE_TIME, abs=0.02)
    assert stats.support_time == pytest.approx(left, abs=0.02)
    assert stats.p_world_trunk[2] > 2.0 and np.rad2deg(stats.peak_roll_pitch).max() < 45.0


def test_robot_that_leaves_the_ground_for_a_moment_is_not(walks):
    stats, trace = walks.statistics("hop"), walks.trace("hop")
    in_the_air = trace.foot_force[:, :, 2].sum(axis=1) <= statistics.TOUCHING
    assert 0.05 < 0.01 * in_the_air.sum() < statistics.AIRBORNE_TIME
    assert statistics.STATUS_TEXT[int(stats.status)] != "airborne"

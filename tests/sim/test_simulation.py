"""One Simulation: what is compiled, and that starting and ticking by hand is a walk."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import robot
from jaxbiped.adapt import Controller, Landing
from jaxbiped.planner import PolynomialGait
from jaxbiped.sim import Options, Scenario, Simulation, prepare

COARSE = Options(dt=2e-3, control_every=2)


@pytest.fixture(scope="module")
def surena() -> Simulation:
    params = robot.load("surena3")
    gait = PolynomialGait.preset(params, 2)
    return prepare(params, Controller(gait, Landing.repaired()), COARSE)


def test_one_program_for_every_duration_and_robot_of_a_kind(surena, compilations):
    """Durations, masses, soles and gait are numbers, as are up to 8 steps, rectangles up to 4 and lanes up to 4."""
    params = surena.robot
    scenarios = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), Scenario.flat(1))
    jax.block_until_ready(surena.run_many(scenarios, 0.1))
    first = len(compilations)
    for duration in (0.3, 1.3, 0.02):
        walks = jax.block_until_ready(surena.run_many(scenarios, duration))
        np.testing.assert_allclose(walks.statistics.end_time, duration, rtol=1e-5)
    assert len(compilations) == first
    other = eqx.tree_at(
        lambda r: (r.links.mass, r.p_sole_corner),
        params,
        (1.1 * params.links.mass, 0.9 * params.p_sole_corner),
    )
    heavier = prepare(other, surena.controller, COARSE)
    before = len(compilations)
    force = heavier.run_many(scenarios, 0.3).statistics.peak_foot_force
    assert len(compilations) == before
    assert np.all(force > 1.05 * surena.run_many(scenarios, 0.3).statistics.peak_foot_force)
    three = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), Scenario.flat(3))
    longer = prepare(
        dataclasses.replace(params, name="mine"),
        Controller(PolynomialGait.preset(params, 5, robot.RIGHT), Landing.repaired()),
        dataclasses.replace(COARSE, backend="xla"),
    )
    before = len(compilations)
    walks = longer.run_many(three, 0.3)
    assert walks.statistics.status.shape == (3,)
    assert not {"jit(_begin)", "jit(_segment)"} & {*compilations[before:]}
    five = jax.tree.map(lambda leaf: jnp.stack([leaf] * 5), Scenario.flat(1))
    surena.run_many(five, 0.1)
    assert "jit(_segment)" in compilations[before:]  # the listener listens


def test_one_program_for_every_duration_with_a_trace(surena, compilations):
    """Rows are made in segments, and cut off where the walk ends."""
    traced = prepare(surena.robot, surena.controller, dataclasses.replace(COARSE, trace_every=5))
    long = traced.run(Scenario.flat(1), 0.9).trace
    first = len(compilations)
    assert long is not None and len(long.time) == 45
    np.testing.assert_allclose(long.time, 0.02 * np.arange(1, 46), rtol=1e-5)
    for duration, rows in ((0.3, 15), (1.3, 65), (0.5, 25)):
        walk = jax.block_until_ready(traced.run(Scenario.flat(1), duration))
        assert len(walk.trace.time) == rows
        np.testing.assert_allclose(walk.statistics.end_time, duration, rtol=1e-5)
        np.testing.assert_array_equal(walk.trace.qpos[:15], long.qpos[:15])
    assert len(compilations) <= first + 4  # cutting the first lane out, for every length of trace


def test_lanes_that_have_finished_take_the_next_scenario(surena):
    """Seven walks in two lanes, some of which fall, are those of seven lanes."""
    pushed = [
        Scenario.flat(1).with_push((0.0, force, 0.0), 0.1, 0.2) for force in (0, 3e3, 20, 3e3, 40, 60, 0)
    ]
    scenarios = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pushed)
    heard: list[float] = []
    many = surena.run_many(scenarios, 1.4)
    few = surena.run_many(scenarios, 1.4, heard.append, lanes=2)
    status = np.asarray(few.statistics.status)
    assert (status != 0).tolist() == [False, True, False, True, False, False, False]
    for a, b in zip(jax.tree.leaves(few), jax.tree.leaves(many), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=1e-4)
    assert heard == sorted(heard) and heard[-1] == 1.0


def test_no_segment_is_begun_when_all_have_fallen(surena):
    """Ten minutes of a robot that lies on the ground."""
    scenarios = jax.tree.map(
        lambda leaf: jnp.stack([leaf] * 2), Scenario.flat(1).with_push((0.0, 4e3, 0.0), 0.01, 0.2)
    )
    heard: list[float] = []
    walks = surena.run_many(scenarios, 600.0, heard.append)
    assert np.all(np.asarray(walks.statistics.end_time) < 2.0) and len(heard) <= 4 and heard[-1] == 1.0


def test_ticks_by_hand_are_a_walk(surena):
    """`start` and `tick`, compiled alone, give the states that `walk` goes through."""
    scenario = Scenario.flat(1).with_push((60.0, 0.0, 0.0), 0.05, 0.1)
    tick = eqx.filter_jit(lambda state: surena.tick(state))
    state = eqx.filter_jit(surena.start)(scenario)
    assert float(state.time) == 0.0
    for i in range(100):
        state, sample = tick(state)
        assert float(sample.time) == pytest.approx((i + 1) * COARSE.control_dt, rel=1e-6)
    walk = surena.run(scenario, 100 * COARSE.control_dt)
    ours, theirs = state.record.statistics, walk.statistics
    assert float(ours.peak_roll_pitch[1]) > 1e-4
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=1e-4)


def test_a_robot_that_has_failed_stays_as_it_was(surena):
    """Time stands still for it at the end of the tick in which it failed."""
    scenario = Scenario.flat(1).with_push((0.0, 4000.0, 0.0), 0.01, 0.2)
    state = eqx.filter_jit(surena.start)(scenario)
    step = eqx.filter_jit(lambda state: surena.tick(state))
    while int(state.record.statistics.status) == 0 and float(state.time) < 2.0:
        state, _ = step(state)
    assert int(state.record.statistics.status) != 0
    end = float(state.record.statistics.end_time)
    assert float(state.time) - COARSE.control_dt < end <= float(state.time) + 1e-6
    later, sample = step(state)
    assert float(sample.time) == float(state.time)
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(later), strict=True):
        np.testing.assert_array_equal(a, b)

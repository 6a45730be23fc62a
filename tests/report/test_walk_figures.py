"""The curves of simulated walks are the trace's own numbers; a lane that froze is drawn up to its fall."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import planner, report, robot, sim

N = 400


@pytest.fixture(scope="module")
def plan():
    surena = robot.load("surena3")
    gait = planner.PolynomialGait.preset(surena, 3)
    time = planner.sample_times(gait, N)
    targets = jax.jit(jax.vmap(lambda t: planner.at(gait, t)))(time)
    return targets, planner.feasibility(surena, gait, time)


def trace_of(targets, seed, frozen_from=N):
    """A trace with random readings; from row `frozen_from` on, time stands still."""
    rng = np.random.default_rng(seed)
    row = np.minimum(np.arange(N), frozen_from)
    return sim.Sample(
        time=targets.time[row],
        p_world_trunk=targets.position.pelvis,
        roll_pitch_yaw=jnp.asarray(rng.normal(0, 0.1, (N, 3)), jnp.float32),
        p_world_sole=targets.position.sole,
        foot_force=jnp.asarray(rng.uniform(0, 900, (N, 2, 3)), jnp.float32),
        corner_force=jnp.asarray(rng.uniform(0, 200, (N, 2, 4)), jnp.float32),
        zmp_world=jnp.asarray(rng.normal(0, 0.1, (N, 2)), jnp.float32),
        switch=jnp.asarray(rng.random((N, 2, 4)) < 0.2),
        torque=jnp.zeros((N, 2, 6)),
        qpos=jnp.zeros((N, 19)),
        targets=targets,
        filtered_corner_force=jnp.asarray(rng.uniform(0, 200, (N, 2, 4)), jnp.float32),
    )


def curve(axes, label):
    (line,) = [line for line in axes.get_lines() if line.get_label() == label]
    return np.asarray(line.get_xdata()), np.asarray(line.get_ydata())


def test_tilt_and_forces_are_the_traces(plan):
    targets, _ = plan
    stands, falls = trace_of(targets, 0), trace_of(targets, 1, frozen_from=150)
    figure = report.tilt_and_forces({"stands": stands, "falls": falls}, "two walks")
    roll, pitch, left, right = figure.axes
    np.testing.assert_allclose(curve(roll, "stands")[1], np.degrees(stands.roll_pitch_yaw[:, 0]))
    np.testing.assert_allclose(curve(pitch, "stands")[1], np.degrees(stands.roll_pitch_yaw[:, 1]))
    np.testing.assert_allclose(curve(left, "stands")[1], stands.foot_force[:, 0, 2])
    np.testing.assert_allclose(curve(right, "stands")[1], stands.foot_force[:, 1, 2])
    time, drawn = curve(roll, "falls")
    assert len(drawn) == 151
    assert time[-1] == pytest.approx(float(targets.time[150]))


def test_tilt_and_forces_stop_where_told(plan):
    targets, _ = plan
    figure = report.tilt_and_forces({"one": trace_of(targets, 0)}, "one walk", until=3.0)
    assert curve(figure.axes[0], "one")[0].max() <= 3.0


def test_measured_zmp_is_drawn_over_the_plan(plan):
    targets, feasibility = plan
    trace = trace_of(targets, 2)
    figure = report.measured_zmp(trace, feasibility, "ZMP")
    for axis, axes in enumerate(figure.axes):
        np.testing.assert_allclose(curve(axes, "measured ZMP")[1], trace.zmp_world[:, axis])
        np.testing.assert_allclose(curve(axes, "planned ZMP")[1], feasibility.zmp[:, axis])


def test_modifications_are_commands_less_plan(plan):
    targets, _ = plan
    trace = trace_of(targets, 3)
    sole, pelvis = (lambda task: task.sole), (lambda task: task.pelvis)
    nominal = eqx.tree_at(sole, targets.position, targets.position.sole - 0.01)
    nominal = eqx.tree_at(pelvis, nominal, targets.position.pelvis + 0.02)
    feet_x, feet_z, pelvis_z = report.modifications(trace, nominal, "added").axes
    for axes in (feet_x, feet_z):
        for side in robot.SIDE_NAMES:
            np.testing.assert_allclose(curve(axes, f"{side} foot")[1], 10.0, rtol=1e-3)
    np.testing.assert_allclose(curve(pelvis_z, "pelvis")[1], -20.0, rtol=1e-3)

"""Figures of walks with a payload show the trace's own numbers, and the filters are those of the payload stage."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import planner, report, robot, score, sim
from jaxbiped.adapt import PayloadReflex
from jaxbiped.planner import PLANNED_STEP, RECOVERY_STEP, REFLEX_STEP

N, DT = 900, 0.01
TRIGGERED, SETTLED, ON = 2.5, 5.0, 7.0
RECOVERY = score.Recovery(TRIGGERED, TRIGGERED + 0.1, SETTLED, 5.5, 6.2, 6.6, 0.02)
FELL = score.Recovery(TRIGGERED, None, None, None, None, None, None)
EVENTS = report.payload_events(2.4, [RECOVERY])


@pytest.fixture(scope="module")
def params() -> PayloadReflex:
    given: Any = {"threshold": 25.0, "force_time_constant": 0.09975, "zmp_time_constant": 0.99975}
    return PayloadReflex(zmp_balanced=jnp.asarray(-0.035), **given)


@pytest.fixture(scope="module")
def elkahlout() -> robot.RobotParams:
    return robot.load("elkahlout")


@pytest.fixture(scope="module")
def gait(elkahlout) -> planner.CosineGait:
    return planner.CosineGait.preset(elkahlout, 3)


@pytest.fixture(scope="module")
def trace(gait) -> sim.Sample:
    """Random readings; kinds of step as if a reflex had come at TRIGGERED and the walk gone on at ON."""
    rng, time = np.random.default_rng(0), (np.arange(N) + 1.0) * DT
    targets = jax.jit(jax.vmap(lambda t: planner.at(gait, t)))(jnp.asarray(time, jnp.float32))
    kind = np.select(
        [time < TRIGGERED, time < SETTLED, time < ON], [PLANNED_STEP, REFLEX_STEP, RECOVERY_STEP], 0
    )
    targets = eqx.tree_at(lambda t: t.phase.kind, targets, jnp.asarray(kind, jnp.int32))
    return sim.Sample(
        time=targets.time,
        p_world_trunk=targets.position.pelvis,
        roll_pitch_yaw=jnp.asarray(rng.normal(0, 0.1, (N, 3)), jnp.float32),
        p_world_sole=targets.position.sole + 0.001,
        foot_force=jnp.asarray(rng.uniform(350, 450, (N, 2, 3)), jnp.float32),
        corner_force=jnp.asarray(rng.uniform(80, 120, (N, 2, 4)), jnp.float32),
        zmp_world=targets.position.pelvis[:, :2] + jnp.asarray(rng.normal(-0.03, 0.01, (N, 2)), jnp.float32),
        switch=jnp.asarray(rng.random((N, 2, 4)) < 0.2),
        torque=jnp.zeros((N, 2, 6)),
        qpos=jnp.zeros((N, 19)),
        targets=targets,
        filtered_corner_force=jnp.asarray(rng.uniform(80, 120, (N, 2, 4)), jnp.float32),
    )


def curve(axes: Any, label: str) -> np.ndarray:
    (line,) = [line for line in axes.get_lines() if line.get_label() == label]
    return np.asarray(line.get_ydata())


def marked(axes: Any) -> list[float]:
    """Where vertical lines stand."""
    return sorted(
        x[0] for x in (line.get_xdata() for line in axes.get_lines()) if len(x) == 2 and x[0] == x[1]
    )


# Readings


def test_filters_are_the_stages_own(trace, params):
    felt = report.felt(trace, params)
    force = np.asarray(trace.foot_force)[..., 2].sum(axis=1)
    np.testing.assert_allclose(felt.force, force, rtol=1e-6)
    low = [force[0]]
    for dt, value in zip(np.diff(np.asarray(trace.time, float)), force[1:], strict=True):
        low.append(low[-1] + (1.0 - np.exp(-dt / 0.09975)) * (value - low[-1]))
    np.testing.assert_allclose(felt.low_passed, low, rtol=1e-5)
    assert felt.zmp_low_passed.std() < 0.3 * felt.zmp.std()


def test_zmp_is_seen_from_the_pelvis_along_its_heading(trace, params):
    yaw = np.asarray(trace.roll_pitch_yaw)[:, 2]
    away = np.asarray(trace.zmp_world) - np.asarray(trace.p_world_trunk)[:, :2]
    along = np.einsum("ni,ni->n", away, np.stack([np.cos(yaw), np.sin(yaw)], axis=1))
    np.testing.assert_allclose(report.felt(trace, params).zmp, along, rtol=1e-4, atol=1e-6)


def test_weight_is_read_anew_when_the_robot_has_settled(trace, params):
    felt = report.felt(trace, params)
    time = np.asarray(trace.time)
    read = int(np.searchsorted(time, SETTLED - 1e-6))
    np.testing.assert_array_equal(felt.weight[:read], felt.low_passed[0])
    np.testing.assert_array_equal(felt.weight[read:], felt.low_passed[read])


def test_commanded_zmp_of_the_plan_is_the_plans(elkahlout, gait, trace):
    time = trace.time[::50]
    few = jax.tree.map(lambda leaf: leaf[::50], trace)
    wanted = planner.feasibility(elkahlout, gait, time)
    np.testing.assert_allclose(report.commanded(elkahlout, few).zmp, wanted.zmp, atol=2e-4)


def test_nominal_is_the_plan_where_it_is_walked(trace):
    plan = trace.targets.position
    kind, time = np.asarray(trace.targets.phase.kind), np.asarray(trace.time)
    alone = report.nominal(plan, trace)
    np.testing.assert_array_equal(np.isnan(alone.pelvis[:, 0]), kind != PLANNED_STEP)
    np.testing.assert_allclose(alone.sole[kind == 0], np.asarray(plan.sole)[kind == 0], atol=1e-6)

    moved: Any = report.nominal(plan, trace, world_shift=0.3, x_shift=0.02)
    before, after = time < TRIGGERED - DT, time > ON
    np.testing.assert_allclose(moved.sole[before], np.asarray(plan.sole)[before], atol=1e-6)
    np.testing.assert_allclose(
        (moved.sole - plan.sole)[after], np.full((after.sum(), 2, 3), [0.3, 0, 0]), atol=1e-6
    )
    np.testing.assert_allclose((moved.pelvis - plan.pelvis)[after], [[0.28, 0, 0]] * after.sum(), atol=1e-6)


def test_thin_leaves_out_the_frozen_tail(trace):
    frozen = eqx.tree_at(lambda s: s.time, trace, jnp.minimum(trace.time, trace.time[300]))
    thin = report.thin(frozen, 10)
    np.testing.assert_array_equal(thin.time, np.asarray(trace.time)[:301:10])
    assert thin.targets.position.sole.shape == (31, 2, 3)


# Figures


def test_events_are_in_time_and_by_kind():
    load, trigger, stages = EVENTS.values()
    assert (load, trigger) == ([2.4], [TRIGGERED])
    assert stages == [SETTLED, 5.5, 6.2, 6.6]
    assert list(report.payload_events(None, [FELL]).values()) == [[], [TRIGGERED], []]
    assert list(report.payload_events(2.4, [], 5.0).values()) == [[2.4, 5.0], [], []]


def test_references_are_the_commands_in_the_body_frame(trace):
    figure = report.references(trace, EVENTS, "references")
    position = trace.targets.position
    for axis, axes in enumerate(figure.axes):
        for side, name in enumerate(robot.SIDE_NAMES):
            expected = position.sole[:, side, axis] - position.pelvis[:, axis]
            np.testing.assert_allclose(curve(axes, f"{name} foot"), expected, atol=1e-6)
        assert marked(axes) == sorted(t for times in EVENTS.values() for t in times)


def test_pitch_is_the_traces(trace):
    (axes,) = report.pitch(trace, EVENTS, "pitch").axes
    np.testing.assert_allclose(curve(axes, "trunk pitch"), np.degrees(trace.roll_pitch_yaw[:, 1]), rtol=1e-6)


def test_force_figure_shows_the_filter_over_its_band(trace, params):
    felt = report.felt(trace, params)
    whole, close = report.force_and_trigger(trace, felt, params, EVENTS, "force").axes
    for axes in (whole, close):
        np.testing.assert_array_equal(curve(axes, "low-passed"), felt.low_passed)
        np.testing.assert_array_equal(curve(axes, "sum of the vertical foot forces"), felt.force)
        (band,) = [c for c in axes.collections if c.get_label() == "weight ± 25 N"]
        heights = np.asarray(band.get_paths()[0].vertices)[:, 1]
        assert heights.min() == pytest.approx(felt.weight.min() - 25.0)
        assert heights.max() == pytest.approx(felt.weight.max() + 25.0)
    assert close.get_xlim()[0] < 2.4 < TRIGGERED < close.get_xlim()[1] < 4.0
    assert whole.get_xlim()[1] > 8.9


def test_force_figure_without_a_load(trace, params):
    felt = report.felt(trace, params)
    assert report.force_and_trigger(trace, felt, params, report.payload_events(None, []), "force").axes


def test_settling_zmp_marks_what_was_read(trace, params):
    felt = report.felt(trace, params)
    (axes,) = report.settling_zmp(trace, felt, params, RECOVERY, "ZMP").axes
    (read,) = [line for line in axes.get_lines() if str(line.get_label()).startswith("read")]
    expected = 1e3 * float(np.interp(SETTLED, np.asarray(trace.time), felt.zmp_low_passed))
    assert np.asarray(read.get_xdata())[0] == SETTLED
    assert np.asarray(read.get_ydata())[0] == pytest.approx(expected)
    assert curve(axes, "balanced, -35.0 mm")[0] == pytest.approx(-35.0)
    assert TRIGGERED in marked(axes)


def test_settling_zmp_of_a_walk_that_fell_has_nothing_read(trace, params):
    (axes,) = report.settling_zmp(trace, report.felt(trace, params), params, FELL, "ZMP").axes
    assert not [line for line in axes.get_lines() if str(line.get_label()).startswith("read")]


def test_close_ups_show_what_was_reached(trace):
    axes = np.array(report.reflex_close_ups(trace, RECOVERY, "close").axes).reshape(3, 3)
    for column, (start, end) in zip(axes.T, ((TRIGGERED, 2.6), (SETTLED, 5.5), (5.5, 6.2)), strict=True):
        margin = 0.25 * (end - start)
        assert column[0].get_xlim() == pytest.approx((start - margin, end + margin))
        assert all(len(curve(panel, "left foot")) > 2 for panel in column)
    fallen = np.array(report.reflex_close_ups(trace, FELL, "close").axes).reshape(3, 3)
    assert [column[1].texts[0].get_text() for column in fallen.T] == ["not reached"] * 3


def test_measured_lines_are_the_robots(trace):
    measured = report.measured_task(trace)
    phase, commands = trace.targets.phase, trace.targets.position
    for axis, axes in enumerate(report.feet(trace.time, commands, phase, "feet", measured).axes):
        drawn = [curve(axes, label) for label in ("measured", "_measured")]
        np.testing.assert_array_equal(np.stack(drawn, axis=1), trace.p_world_sole[..., axis])
    for axis, axes in enumerate(report.pelvis(trace.time, commands, phase, "pelvis", measured).axes):
        np.testing.assert_array_equal(curve(axes, "measured"), trace.p_world_trunk[:, axis])


def test_touches_are_marked_where_they_are(trace):
    found = score.touches(trace)
    forward, up, _ = report.modifications(trace, trace.targets.position, "added").axes
    dots = [line for line in up.get_lines() if line.get_marker() == "o"]
    times = np.sort(np.concatenate([line.get_xdata() for line in dots]))
    np.testing.assert_allclose(times, sorted(touch.time for touch in found), atol=1e-6)
    assert len(found) > 0 and "touch" in [line.get_label() for line in forward.get_lines()]


def test_a_legend_wider_than_the_figure_takes_two_rows(trace, params):
    figure = report.settling_zmp(trace, report.felt(trace, params), params, RECOVERY, "ZMP")
    figure.draw_without_rendering()
    legend: Any = figure.axes[0].get_legend()
    assert legend.get_window_extent().x0 > 0.0

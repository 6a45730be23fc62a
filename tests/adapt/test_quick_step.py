"""The reflex of two speeds: where the feet go, how fast the body follows, beside quintics of NumPy's."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import robot
from jaxbiped.adapt import PayloadReflex, PayloadStage
from jaxbiped.adapt.reflex import quick_step
from jaxbiped.adapt.reflex.modes import mode_ends
from jaxbiped.adapt.reflex.planned import HOLD, RECOVER, REFLEX
from jaxbiped.planner import DOUBLE_SUPPORT, SINGLE_SUPPORT, CosineGait
from jaxbiped.robot import LEFT, RIGHT

NUMBERS = {"threshold": 50.0, "zmp_balanced": -0.04, "x_stand": 0.0}
"""What would be read off the plan."""


@cache
def stage():
    biped = robot.load("elkahlout")
    gait = CosineGait.preset(biped, 3)
    return PayloadStage.plan(PayloadReflex.two_speed(biped, gait, **NUMBERS), gait)


def reflex(way=(0.1, -0.05), velocity=(0.0, 0.0), support=SINGLE_SUPPORT):
    """The state at the start of a reflex of the left foot: ways of the body on the right one, and its speed there."""
    start = np.zeros((3, 2, 3))
    start[0] = stage().stance[1]
    start[0, LEFT] = start[0, RIGHT] + [-0.05, 0.22, 0.02]
    start[1, :, :2] = velocity
    start[1, LEFT] += [0.3, 0.0, -0.1]
    end = start[0].copy()
    end[:, :2] += way
    end[LEFT] = end[RIGHT] + [0.15, 0.22, 0.0]
    return replace(
        stage().init(),
        mode=jnp.asarray(REFLEX),
        support=jnp.asarray(support),
        swing=jnp.asarray(LEFT),
        start=jnp.asarray(start, jnp.float32),
        end=jnp.asarray(end, jnp.float32),
        trigger_time=jnp.asarray(1.0, jnp.float32),
    )


@pytest.mark.parametrize(
    ("now", "aloft", "expected"),
    [(-0.15, True, 0.1), (0.0, True, 0.25), (0.15, True, 0.3), (0.4, True, 0.4), (0.15, False, 0.15)],
)
def test_the_swing_foot_goes_ahead_but_not_too_far(now, aloft, expected):
    assert float(quick_step.distance(stage(), jnp.asarray(now), jnp.asarray(aloft))) == pytest.approx(
        expected
    )


@pytest.mark.parametrize(
    ("way", "support", "expected"),
    [(0.2, SINGLE_SUPPORT, 0.03), (0.04, SINGLE_SUPPORT, 0.0075), (0.2, DOUBLE_SUPPORT, 0.0)],
)
def test_the_swing_foot_is_lifted_as_in_the_plan(way, support, expected):
    """Half-way, above the quintic's own height; the plan lifts it by 3 cm on a stride of 16."""
    state = reflex(support=support)
    begun = state.start[0, LEFT] - state.start[0, RIGHT]
    end = state.end.at[LEFT, 0].set(state.end[RIGHT, 0] + begun[0] + way)
    state = replace(state, start=state.start.at[1:].set(0.0), end=end)
    half_way = quick_step.over_ground(stage(), state, 0.5 * stage().params.reflex_time)
    assert float(half_way[2] - 0.5 * begun[2]) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("swing", "aloft", "behind"), [(LEFT, True, 0.03), (RIGHT, True, 0.03), (RIGHT, False, 0.0)]
)
def test_the_body_ends_between_the_feet(swing, aloft, behind):
    """Feet forward of the body are a body behind them."""
    x = quick_step.ends(stage(), jnp.asarray(0.2), jnp.asarray(swing), jnp.asarray(-0.09), jnp.asarray(aloft))
    assert np.mean(x) == pytest.approx(-0.09 + behind, abs=1e-6)
    assert float(x[swing] - x[1 - swing]) == pytest.approx(0.2, abs=1e-6)


def test_the_swing_foot_goes_over_the_ground_whatever_the_body_does():
    since = jnp.linspace(0.0, 0.4, 41)
    paths = []
    for way, velocity in (((0.1, -0.05), (0.0, 0.0)), ((-0.02, 0.1), (-0.2, 0.1))):
        state = reflex(way, velocity)
        soles = jax.vmap(quick_step.soles, (None, None, 0))(stage(), state, since)
        paths.append(np.asarray(soles[:, LEFT] - soles[:, RIGHT]))
        np.testing.assert_allclose(soles[0], state.start[0], atol=1e-6)
        np.testing.assert_allclose(soles[-1, LEFT] - soles[-1, RIGHT], [0.15, 0.22, 0.0], atol=1e-6)
    np.testing.assert_allclose(*paths, atol=1e-6)
    path = paths[0]
    assert path[:, 2].max() > 0.02, "it was there at the start, and is lifted on its way"
    down = float(stage().params.reflex_time)
    np.testing.assert_allclose(path[np.asarray(since) >= down], path[-1:].repeat(15 + 1, 0), atol=1e-6)


@pytest.mark.parametrize(
    ("way", "speed"), [(0.11, 0.0), (-0.11, 0.0), (0.11, -0.1), (-0.05, 0.15), (0.08, 0.05)]
)
def test_the_body_goes_sideways_by_about_its_greatest_acceleration(way, speed):
    """As far as the quintic has it: at rest to the last digit, else no more than two thirds beyond it."""
    state = reflex((0.0, way), (0.0, speed))
    T = float(quick_step.body_times(stage(), state)[1])
    p = stage().params
    assert float(p.reflex_time) <= T <= float(p.body_time)

    rows = [[T**n, n * T ** (n - 1), n * (n - 1) * T ** (n - 2)] for n in (3, 4, 5)]
    high = np.linalg.solve(np.transpose(rows), [way - speed * T, -speed, 0.0])
    quintic = np.polynomial.Polynomial([0.0, speed, 0.0, *high])
    greatest = np.abs(quintic.deriv(2)(np.linspace(0.0, T, 1000))).max()
    limit = float(p.body_acceleration)
    if speed == 0.0:
        assert greatest == pytest.approx(limit, rel=0.01)
    elif float(p.body_time) > T:
        assert 0.6 * limit < greatest < 1.67 * limit


def test_forward_the_body_takes_its_time():
    p = stage().params
    for way in (0.01, 0.1):
        assert float(quick_step.body_times(stage(), reflex((way, 0.1)))[0]) == pytest.approx(
            float(p.body_time)
        )


def test_derivatives_are_finite_where_the_body_is_already_in_the_middle():
    state = reflex((0.0, 0.0))

    def time(way):
        return quick_step.body_times(stage(), replace(state, end=state.end.at[RIGHT, 1].add(way)))[1]

    assert np.isfinite(jax.grad(time)(0.0))


@pytest.mark.parametrize(("given", "expected"), [(None, 2.0), (0.5, 0.5)])
def test_standing_still_after_the_step_is_half_of_settling_unless_given(given, expected):
    """In the machine, and in the longest delay that a walk is given time for."""
    biped = robot.load("elkahlout")
    gait = CosineGait.preset(biped, 3)
    planned = PayloadStage.plan(PayloadReflex.two_speed(biped, gait, hold_time=given, **NUMBERS), gait)
    assert float(planned.params.hold) == expected
    ends = mode_ends(planned, reflex(), gait.timing)
    assert float(ends[HOLD] - ends[RECOVER]) == pytest.approx(expected)
    assert planned.longest_delay(gait, 1) - stage().longest_delay(gait, 1) == pytest.approx(expected - 2.0)

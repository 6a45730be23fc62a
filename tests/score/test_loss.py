"""The loss of a walk: its rates against NumPy, continuous, masked after a fall, larger the worse the walk."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import planner, robot
from jaxbiped.score import WalkLoss
from jaxbiped.score.loss import bounded
from jaxbiped.sim import Sample

ROBOT = robot.load("surena3")
TARGETS = planner.at(planner.PolynomialGait.preset(ROBOT, 1), 0.0)
WEIGHT = float(ROBOT.total_mass) * 9.81
TILT, FORCE, IMPULSE, MARGIN, LEAN = range(5)


def sample(roll=0.0, pitch=0.0, corners=None):
    """One row of a trace; corners (2, 4) are vertical forces in shares of the weight."""
    corners = np.full((2, 4), 0.125) if corners is None else np.asarray(corners, float)
    force = jnp.asarray(corners * WEIGHT)
    return Sample(
        time=jnp.zeros(()),
        p_world_trunk=jnp.zeros(3),
        roll_pitch_yaw=jnp.array([roll, pitch, 0.0]),
        p_world_sole=jnp.zeros((2, 3)),
        foot_force=jnp.zeros((2, 3)).at[:, 2].set(force.sum(axis=1)),
        corner_force=force,
        zmp_world=jnp.zeros(2),
        switch=jnp.ones((2, 4), bool),
        torque=jnp.zeros((2, 6)),
        qpos=jnp.zeros(19),
        targets=TARGETS,
        filtered_corner_force=force,
    )


def rate(upright=True, **given):
    return np.asarray(WalkLoss().rate(ROBOT, sample(**given), jnp.asarray(upright)), float)


def test_standing_still_costs_nothing():
    np.testing.assert_allclose(rate(), 0.0, atol=1e-9)


def test_tilt_costs_its_square_over_two_degrees():
    got = rate(roll=np.deg2rad(1.0), pitch=np.deg2rad(-3.0))
    assert got[TILT] == pytest.approx((1.0 + 9.0) / 4.0, rel=1e-5)
    assert got[LEAN] == 0.0


@pytest.mark.parametrize("degrees", [10.0, 12.0, 20.0, 44.0])
def test_lean_counts_from_ten_degrees(degrees):
    assert rate(pitch=-np.deg2rad(degrees))[LEAN] == pytest.approx(((degrees - 10.0) / 10.0) ** 2, abs=1e-5)


def test_lean_of_a_fall_goes_on_at_what_it_was():
    """Continuous at the fall, at whatever tilt the robot stays lying."""
    last = rate(pitch=np.deg2rad(45.0))[LEAN]
    for degrees in (3.0, 45.0, 80.0):
        fallen = rate(upright=False, pitch=np.deg2rad(degrees))
        assert fallen[LEAN] == pytest.approx(last, rel=1e-5)
        np.testing.assert_array_equal(fallen[:LEAN], 0.0)


def test_force_over_the_weight_costs():
    corners = np.zeros((2, 4))
    corners[1] = 0.5  # twice the weight on the right foot
    got = rate(corners=corners)
    assert got[IMPULSE] == pytest.approx(1.0, rel=1e-5)
    assert got[FORCE] == pytest.approx(1.0 / 0.01, rel=1e-5)


def test_pressure_near_an_edge_costs_by_the_share_of_the_weight():
    corner = np.asarray(ROBOT.p_sole_corner)[0]
    front = corner[:, 0] == corner[:, 0].max()
    share = np.zeros((2, 4))
    share[0, front] = 0.4  # all of the left foot's force on its toes, 80 % of the weight
    share[1] = 0.05
    assert rate(corners=share)[MARGIN] == pytest.approx(0.8, rel=1e-4)


def test_margin_does_not_jump_when_a_foot_is_unloaded():
    shares = np.linspace(0.0, 1e-3, 11)
    corners = np.zeros((11, 2, 4))
    corners[:, 0] = 0.25
    corners[:, 1, 0] = shares  # one corner of the other foot: its centre of pressure is on the corner
    got = np.array([rate(corners=c)[MARGIN] for c in corners])
    assert got[0] == 0.0
    assert np.max(np.abs(np.diff(got))) < 2e-4


def test_what_a_walk_costs_is_bounded_and_its_slope_fades():
    cost = jnp.asarray([0.0, 1e-3, 1.0, 5.0, 50.0, 1e6])
    value, slope = jax.vmap(jax.value_and_grad(lambda c: bounded(c, 5.0)))(cost)
    assert np.all(np.diff(value) > 0.0) and value[-1] < 5.0
    assert value[3] == pytest.approx(2.5)
    np.testing.assert_allclose(value[:2], cost[:2], rtol=1e-3)
    np.testing.assert_allclose(slope, (1.0 + cost / 5.0) ** -2, rtol=1e-5, atol=1e-9)


def test_rates_have_derivatives_where_nothing_is_loaded():
    def total(x):
        corners = jnp.zeros((2, 4)) + 0.0 * x
        tilted = {"filtered_corner_force": corners, "roll_pitch_yaw": jnp.array([0.1, 0.0, 0.0]) * x}
        one = dataclasses.replace(sample(roll=0.0), **tilted)
        return WalkLoss().rate(ROBOT, one, jnp.asarray(True)).sum()

    assert np.isfinite(jax.grad(total)(1.0))
    assert jax.grad(total)(1.0) > 0.0


def test_corners_that_are_drawn_down_cost_no_margin():
    """As by the edge of a hole: forces that cancel have no centre of pressure far outside the sole."""
    down = np.full((2, 4), 0.125)
    down[0] = [0.3, -0.29, 0.0, 0.0]
    assert rate(corners=down)[MARGIN] < 1.0

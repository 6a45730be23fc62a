"""MJX with MuJoCo's own contacts is C MuJoCo with the same contacts."""

import dataclasses

import numpy as np
import pytest
from closed_loop import setup

from jaxbiped.adapt import Controller
from jaxbiped.sim import Options, Scenario, rollout
from jaxbiped.sim.physics.mjx_contacts import check_terrain


def test_holes_and_overlapping_rectangles_are_refused():
    flat = Scenario.flat()
    check_terrain(flat.terrain)
    check_terrain(flat.with_rectangle((0.0, 0.0), (0.1, 0.1), 0.03).terrain)
    with pytest.raises(ValueError, match=r"hole of -0\.03 m"):
        check_terrain(flat.with_rectangle((0.0, 0.0), (0.1, 0.1), -0.03).terrain)
    overlap = flat.with_rectangle((0.0, 0.0), (0.2, 0.2), 0.03).with_rectangle((0.1, 0.1), (0.3, 0.3), 0.02)
    with pytest.raises(ValueError, match="overlap"):
        check_terrain(overlap.terrain)


def test_unknown_contact_is_refused():
    with pytest.raises(ValueError, match="contact: got 'none', allowed: compliant, mjx, c_mujoco"):
        Options(contact="none")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["surena3", "elkahlout"])
def test_second_step_onto_a_pad_is_that_of_c_mujoco(name):
    """Also a load and no feed-forward, so that much differs from the plan."""
    one = setup(name)
    options = dataclasses.replace(one.options, contact="mjx")
    scenario = Scenario.flat(rectangles=1).with_obstacle(one.params, one.gait, step=1, height=0.005)
    scenario = scenario.with_payload(1.0, 1.0)
    duration = float(one.gait.timing.touchdown(1)) + 0.1
    controller = Controller(one.gait)
    ours = rollout(one.params, controller, scenario, duration, options)
    theirs = rollout(
        one.params, controller, scenario, duration, dataclasses.replace(options, contact="c_mujoco")
    )
    assert int(ours.statistics.status) == int(theirs.statistics.status) == 0
    assert ours.trace is not None and theirs.trace is not None
    np.testing.assert_allclose(ours.trace.qpos, theirs.trace.qpos, atol=2e-3)
    for field in ("peak_roll_pitch", "peak_foot_force", "peak_slip"):
        one_of, other = getattr(ours.statistics, field), getattr(theirs.statistics, field)
        np.testing.assert_allclose(one_of, other, rtol=0.1, atol=1e-3, err_msg=field)

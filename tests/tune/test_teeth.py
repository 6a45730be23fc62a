"""A loss over three control ticks of what every tunable moves: how jumps are counted, and how many there are."""

import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxbiped.adapt.tunables import Tunable
from jaxbiped.tune.teeth import Teeth, scan

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "sweeps"))
import teeth as sweep

SHARES = np.arange(49) / 16.0


def of(losses: np.ndarray) -> Teeth:
    return Teeth(Tunable("payload.a", 0.0, 1.0, "s", "", "a"), 1e-3 * SHARES, losses, 0.0)


def test_a_smooth_loss_has_no_jumps():
    one = of(3.0 - 2.0 * SHARES + 0.1 * SHARES**2)
    assert one.jumps == 0
    np.testing.assert_allclose([one.inside, one.over], -1700.0, rtol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_teeth_are_counted(count):
    """Every tooth falls by 1 a tick and jumps up by 1.2: what rises is the trend."""
    teeth = np.minimum(np.floor(SHARES + 0.3), count)
    one = of(1.2 * teeth - SHARES)
    assert one.jumps == count
    assert one.inside == pytest.approx(-1000.0)
    if count == 3:
        assert one.over == pytest.approx(200.0, abs=100.0)


def test_a_loss_that_does_not_depend_on_it_has_no_jumps():
    rounding = 1e-16 * np.random.default_rng(1).standard_normal(49)
    assert of(2.0 + rounding).jumps == 0
    assert of(np.full(49, 2.0)).inside == 0.0


ALLOWED: dict[tuple[str, str], int] = {}
"""Jumps that are left, by case and tunable; where none is named, none."""
LITERAL = ("original", "modified")
"""Variants whose velocity step is larger than the servos can follow: what they make of a part of it is no part of what
they make of the whole, so that forward mode has the slope of a tooth."""
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in sweep.problems()]


@pytest.mark.parametrize("name", SLOW)
def test_losses_do_not_jump_over_three_ticks(name):
    """Of every tunable of every named variant, in short walks around one event; the numbers are printed."""
    make, row = sweep.problems()[name]
    with jax.enable_x64(True):
        problem = make()
        found = scan(problem, problem.start, row)
    for one in found:
        allowed = ALLOWED.get((name, one.tunable.name), 0)
        print(
            f"{name}, {one.tunable.name}: forward {one.forward:.5g}, inside a tooth {one.inside:.5g}, over three ticks "
            f"{one.over:.5g}, {one.jumps} jumps"
        )
        assert one.jumps <= allowed, one.tunable.name

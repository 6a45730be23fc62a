"""Forward mode through whole closed-loop walks, events and all, against central differences of several widths."""

from functools import partial

import jax
import numpy as np
import pytest
from problems import landing, payload

from jaxbiped import robot
from jaxbiped.tune import central, forward

FRICTION = robot.defaults("elkahlout").simulation("cosine")["friction"]
MADE = {"surena3": landing, "elkahlout": partial(payload, friction=FRICTION)}
STEPS = (1e-3, 1e-4, 1e-5)
"""Of central differences, as shares of each tunable."""
NOT_MET = {("elkahlout", 16.0): "2.27 % at 1e-4: reflex_time, whose thousandth is a fifth of a tick"}
AT_LEAST = 20
"""Walks that survive."""


def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Relative differences; nan where both are zero, so that nothing is compared."""
    size = np.maximum(np.abs(one), np.abs(other))
    return np.where(size > 0.0, np.abs(one - other) / np.where(size > 0.0, size, 1.0), np.nan)


def said(what: str, gaps: np.ndarray) -> str:
    return f"{what}: median {100 * np.nanmedian(gaps):.3g} %, 90th percentile {100 * np.nanpercentile(gaps, 90):.3g} %"


@pytest.mark.slow
@pytest.mark.parametrize("duration", [8.0, 16.0])
@pytest.mark.parametrize("name", MADE)
def test_forward_mode_is_that_of_central_differences(name, duration):
    """The narrower the differences, the nearer.

    A walk jumps a little wherever a touch moves on to another control tick: wide differences see these jumps, which a
    derivative does not, and narrow ones hardly meet them. All that are out by a tenth are printed.
    """
    with jax.enable_x64(True):
        problem = MADE[name](24, duration)
        at, rows = problem.start, np.arange(24)
        slope = forward(problem, at, rows)
        ok = slope.status == 0
        assert ok.sum() >= AT_LEAST, f"{ok.sum()} of 24 walks survive"
        found = {}
        for step in STEPS:
            twin = central(problem, at, rows, 2.0 * step * np.abs(at)).by_scenario
            found[step] = gaps = apart(slope.by_scenario, twin)[ok]
            print(said(f"{name}, {duration:g} s, {ok.sum()} of 24 walks survive, step {step:g}", gaps))
            for i, j in zip(*np.nonzero(gaps > 0.1), strict=True):
                row = np.flatnonzero(ok)[i]
                print(
                    f"  {problem.tunables[j].name}, row {row}: forward {slope.by_scenario[row, j]:.5g}, central "
                    f"{twin[row, j]:.5g}"
                )
    medians = [np.nanmedian(found[step]) for step in STEPS]
    assert medians[0] > medians[1] > medians[2]
    assert medians[2] < 0.02 and np.nanpercentile(found[STEPS[2]], 90) < 0.1
    if medians[1] >= 0.02 and (name, duration) in NOT_MET:
        pytest.xfail(NOT_MET[name, duration])
    assert medians[1] < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", MADE)
def test_forward_mode_in_float32_is_that_in_float64(name):
    """Differences say nothing in float32, whose rounding they divide by their width."""
    slopes = []
    for double in (False, True):
        with jax.enable_x64(double):
            problem = MADE[name](24, 8.0)
            slopes.append(forward(problem, problem.start, np.arange(24)))
    ok = np.all([slope.status == 0 for slope in slopes], axis=0)
    assert ok.sum() >= AT_LEAST
    gaps = apart(*(slope.by_scenario for slope in slopes))[ok]
    print(said(f"{name}, 8 s, {ok.sum()} of 24 walks survive, float32 against float64", gaps))
    for j, t in enumerate(problem.tunables):
        print(f"  {t.name}: {100 * np.nanmedian(gaps[:, j]):.3g} % (median)")
    assert np.nanmedian(gaps) < 0.1

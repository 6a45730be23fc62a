"""Forward mode through whole closed-loop walks, events and all, against central differences of several widths."""

import jax
import numpy as np
import pytest
from problems import landing, payload

from jaxbiped.tune import central, forward

MADE = {"surena3": landing, "elkahlout": payload}
STEPS = (1e-3, 1e-4, 1e-5)
"""Of central differences, as shares of each tunable."""
AT_LEAST = 20
"""Walks that survive."""


def compare(name: str, duration: float, n: int, steps: tuple[float, ...] = STEPS) -> dict[float, np.ndarray]:
    """Relative differences of the walks that survive (walks, tunables) for each width; printed in full."""
    problem = MADE[name](n, duration)
    at, rows = problem.start, np.arange(n)
    slope = forward(problem, at, rows)
    ok = slope.status == 0
    assert ok.sum() >= AT_LEAST, f"{ok.sum()} of {n} walks survive"
    found = {}
    for step in steps:
        twin = central(problem, at, rows, 2.0 * step * np.abs(at)).by_scenario
        size = np.maximum(np.abs(slope.by_scenario), np.abs(twin))
        gap = np.abs(slope.by_scenario - twin) / np.where(size > 0.0, size, 1.0)
        found[step] = np.where(size > 0.0, gap, np.nan)[ok]
        print(
            f"{name}, {duration:g} s, {ok.sum()} of {n} walks survive, step {step:g}: median "
            f"{100 * np.nanmedian(found[step]):.3g} %, 90th percentile {100 * np.nanpercentile(found[step], 90):.3g} %"
        )
        for i, j in zip(*np.nonzero(found[step] > 0.1), strict=True):
            row = np.flatnonzero(ok)[i]
            print(
                f"  {problem.tunables[j].name}, row {row}: forward {slope.by_scenario[row, j]:.5g}, central "
                f"{twin[row, j]:.5g}"
            )
    return found


@pytest.mark.slow
@pytest.mark.parametrize("duration", [8.0, 16.0])
@pytest.mark.parametrize("name", MADE)
def test_forward_mode_is_that_of_central_differences(name, duration):
    with jax.enable_x64(True):
        for gaps in compare(name, duration, 24).values():
            assert np.nanmedian(gaps) < 0.02
            assert np.nanpercentile(gaps, 90) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", MADE)
def test_forward_mode_in_float32(name):
    """Float32 rounds the loss: only wide differences say anything, and those bend."""
    gaps = compare(name, 8.0, 24, (1e-2, 1e-3))
    assert np.nanmedian(gaps[1e-2]) < 0.1

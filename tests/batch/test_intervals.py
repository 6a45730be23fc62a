"""Intervals of means hold the mean as often as they say, for few values too."""

import math
from statistics import NormalDist

import numpy as np
import pytest
from scipy import stats

from jaxbiped.batch import intervals

T_TABLE = {2: 12.706, 3: 4.303, 4: 3.182, 8: 2.365, 13: 2.179, 19: 2.101}
"""Student's t of a two-sided 95 % interval by the number of values, as every printed table has it."""


@pytest.mark.parametrize("n", T_TABLE)
def test_few_values_have_the_interval_of_the_printed_table(n):
    values = np.random.default_rng(n).normal(3.0, 2.0, n)
    half = T_TABLE[n] * math.sqrt(sum((values - values.mean()) ** 2) / (n - 1) / n)
    expected = (values.mean() - half, values.mean() + half)
    assert intervals.of_mean(values) == pytest.approx(expected, abs=1e-3 * half)


def bca(values: np.ndarray, wide: float, seed: int) -> tuple[float, float]:
    """Efron's ends at so many standard deviations, by his formulas: 40,000 resamples of their own."""
    n, normal, rng = len(values), NormalDist(), np.random.default_rng(seed)
    means = np.sort([values[rng.integers(0, n, n)].mean() for _ in range(40_000)])
    bias = normal.inv_cdf(float(np.mean(means < values.mean())))
    off = values - values.mean()
    acceleration = (off**3).sum() / (6.0 * (off**2).sum() ** 1.5)
    moved = [bias + (bias + z) / (1.0 - acceleration * (bias + z)) for z in (-wide, wide)]
    low, high = (float(means[int(normal.cdf(z) * len(means))]) for z in moved)
    return low, high


@pytest.mark.parametrize(("n", "t"), [(20, 2.0930), (60, 2.0010)])
def test_many_values_have_efrons_interval_widened_as_hesterberg_says(n, t):
    values = np.random.default_rng(n).exponential(size=n)
    expected = bca(values, math.sqrt(n / (n - 1)) * t, seed=1)
    assert intervals.of_mean(values) == pytest.approx(expected, abs=0.03 * (expected[1] - expected[0]))


@pytest.mark.parametrize(
    ("law", "n", "least"),
    [
        (stats.norm(3.0, 2.0), 4, 0.93),
        (stats.norm(3.0, 2.0), 8, 0.93),
        (stats.norm(3.0, 2.0), 20, 0.93),
        (stats.norm(3.0, 2.0), 40, 0.93),
        (stats.expon(), 4, 0.86),
        (stats.expon(), 8, 0.88),
        (stats.expon(), 20, 0.91),
        (stats.expon(), 40, 0.915),
    ],
    ids=lambda value: value.dist.name if hasattr(value, "dist") else None,
)
def test_coverage(law, n, least, monkeypatch):
    """Of 800 samples; percentiles of the bootstrap cover 77, 89 and 93 % for 4, 8 and 20 normal values."""
    monkeypatch.setattr(intervals, "RESAMPLES", 2000)
    samples = law.rvs(size=(800, n), random_state=np.random.default_rng(n))
    held = [low <= law.mean() <= high for low, high in map(intervals.of_mean, samples)]
    assert least <= np.mean(held) <= 0.975


def test_skewed_values_have_a_skewed_interval():
    values = np.random.default_rng(1).exponential(size=50)
    low, high = intervals.of_mean(values)
    assert high - values.mean() > 1.1 * (values.mean() - low)
    turned = intervals.of_mean(-values)
    assert turned == pytest.approx((-high, -low), abs=0.02)


def test_an_interval_does_not_depend_on_the_unit_and_is_the_same_again():
    for n in (5, 30):
        values = np.random.default_rng(n).normal(size=n)
        low, high = intervals.of_mean(values)
        assert intervals.of_mean(values) == (low, high)
        assert intervals.of_mean(10.0 + 1e3 * values) == pytest.approx((10.0 + 1e3 * low, 10.0 + 1e3 * high))


def test_one_value_says_nothing_and_equal_ones_all():
    assert intervals.of_mean(np.array([2.5])) == (-math.inf, math.inf)
    for n in (3, 30):
        assert intervals.of_mean(np.full(n, 2.5)) == (2.5, 2.5)

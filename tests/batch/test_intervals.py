"""Intervals of means hold the mean as often as they say, for few values too; Student's t is SciPy's."""

import math

import numpy as np
import pytest
from scipy import stats

from jaxbiped.batch import intervals


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.99])
@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 8, 19, 60, 601])
def test_student_t_is_scipys(freedom, confidence):
    expected = stats.t.ppf(0.5 + 0.5 * confidence, freedom)
    assert intervals.student_t(freedom, confidence) == pytest.approx(expected, rel=1e-9)


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

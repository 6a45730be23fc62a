"""Intervals of means, for few values too."""

import math
from statistics import NormalDist

import numpy as np

CONFIDENCE = 0.95
"""Of every interval of a table of walks."""
RESAMPLES = 10_000
"""Of the bootstrap."""
FEW = 20
"""Values below which the bootstrap says too little: its resamples do not spread as far as the mean does."""


def of_mean(values: np.ndarray, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Interval of the mean that independent values (n,) are drawn with; endless for one value.

    Below FEW values Student's t, which holds for normal ones. From FEW on the bootstrap, bias-corrected and accelerated
    (BCa; B. Efron, JASA 82 (1987) 171-185), which follows skewed ones, at levels widened to those of Student's t
    (T. C. Hesterberg, The American Statistician 69 (2015) 371-386, section 3.2): percentiles of resampled means alone
    are too narrow by the factor sqrt((n - 1) / n), and by the normal's tails for t's.

    Args:
        values: independent draws.
        confidence: how often such an interval holds the mean.
    """
    n, mean, spread = len(values), float(np.mean(values)), float(np.ptp(values))
    if n == 1:
        return -math.inf, math.inf
    if spread == 0.0:
        return mean, mean
    wide = student_t(n - 1, confidence)
    if n < FEW:
        half = wide * float(np.std(values, ddof=1)) / math.sqrt(n)
        return mean - half, mean + half
    drawn = np.random.default_rng(0).integers(0, n, (RESAMPLES, n))
    means, off = values[drawn].mean(axis=1), values - mean
    acceleration = float((off**3).sum() / (6.0 * (off**2).sum() ** 1.5))
    below = (np.sum(means < mean) + 0.5 * np.sum(means == mean) + 0.5) / (RESAMPLES + 1.0)
    normal, wider = NormalDist(), math.sqrt(n / (n - 1)) * wide
    bias = normal.inv_cdf(float(below))

    def end(z: float) -> float:
        moved = bias + (bias + z) / (1.0 - acceleration * (bias + z))
        return float(np.quantile(means, normal.cdf(moved)))

    return end(-wider), end(wider)


def student_t(freedom: int, confidence: float) -> float:
    """Half-width within which Student's t with so many degrees of freedom stays with this probability.

    By bisection of its distribution function (M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions, 26.7.3
    and 26.7.4).
    """
    low, high = 0.0, 1.0
    while _within(high, freedom) < confidence:
        high *= 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _within(middle, freedom) < confidence else (low, middle)
    return high


def _within(t: float, freedom: int) -> float:
    """Probability that Student's t is not further from 0 than `t`."""
    angle = math.atan(t / math.sqrt(freedom))
    square, odd = math.cos(angle) ** 2, freedom % 2
    total, term = 0.0, math.cos(angle) if odd else 1.0
    for k in range(1 + odd, freedom, 2):
        total += term
        term *= k / (k + 1.0) * square
    return 2.0 / math.pi * (angle + math.sin(angle) * total) if odd else math.sin(angle) * total

"""Intervals of means, for few values too."""

import math

import numpy as np
import scipy
from jaxtyping import Float

CONFIDENCE = 0.95
"""Confidence of every interval of a table of walks."""
RESAMPLES = 10_000
"""Resamples of the bootstrap."""
BATCH = 1_000
"""Resamples of the bootstrap that are in memory at once."""
FEW = 20
"""Values below which the bootstrap says too little: its resamples do not spread as far as the mean does."""


def of_mean(values: Float[np.ndarray, " n"], confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Interval of the mean that independent values are drawn with; endless for one value.

    Below FEW values Student's t, which holds for normal ones. From FEW on the bootstrap, bias-corrected and accelerated
    (BCa; B. Efron, JASA 82 (1987) 171-185), which follows skewed ones, at levels widened to those of Student's t
    (T. C. Hesterberg, The American Statistician 69 (2015) 371-386, section 3.2): percentiles of resampled means alone
    are too narrow by the factor sqrt((n - 1) / n), and by the normal's tails for t's.

    Args:
        values: independent draws.
        confidence: how often such an interval holds the mean.
    """
    n, mean = len(values), float(np.mean(values))
    if n == 1:
        return -math.inf, math.inf
    if np.ptp(values) == 0.0:
        return mean, mean
    if n < FEW:
        low, high = scipy.stats.t.interval(confidence, n - 1, loc=mean, scale=scipy.stats.sem(values))
        return float(low), float(high)
    wide = math.sqrt(n / (n - 1)) * scipy.stats.t.ppf(0.5 + 0.5 * confidence, n - 1)
    found = scipy.stats.bootstrap(
        (values,),
        np.mean,
        method="BCa",
        n_resamples=RESAMPLES,
        batch=BATCH,
        confidence_level=1.0 - 2.0 * scipy.stats.norm.sf(wide),
        rng=np.random.default_rng(0),
    )
    low, high = found.confidence_interval
    return float(low), float(high)

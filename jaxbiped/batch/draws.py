"""Scenario tables: full grids, and random draws with a seed."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
import polars as pl


@dataclass(frozen=True)
class Uniform:
    """Anything from `low` to `high`, equally likely."""

    low: float | int
    high: float | int

    def __post_init__(self) -> None:
        """Refuse an empty or endless range."""
        if not (np.isfinite(self.low) and np.isfinite(self.high) and self.low <= self.high):
            raise ValueError(f"uniform: got {self.low:g} to {self.high:g}, allowed: low <= high, finite")

    def at(self, share: np.ndarray) -> np.ndarray:
        """Quantiles."""
        return self.low + share * (self.high - self.low)


@dataclass(frozen=True)
class Normal:
    """Normally distributed, cut off at three standard deviations."""

    mean: float | int
    deviation: float | int

    def __post_init__(self) -> None:
        """Refuse what is no distribution."""
        if not (np.isfinite(self.mean) and 0.0 < self.deviation < np.inf):
            raise ValueError(
                f"normal: got mean {self.mean:g}, deviation {self.deviation:g}, allowed: finite, deviation > 0"
            )

    def at(self, share: np.ndarray) -> np.ndarray:
        """Quantiles."""
        cut = NormalDist().cdf(-3.0)
        quantile = np.vectorize(NormalDist(self.mean, self.deviation).inv_cdf, otypes=[float])
        return quantile(cut + share * (1.0 - 2.0 * cut))


@dataclass(frozen=True)
class Choice:
    """One of a few values, equally likely."""

    values: tuple[float | int, ...]

    def __post_init__(self) -> None:
        """Refuse an empty choice."""
        if not self.values:
            raise ValueError("choice: got no values, allowed: at least one")

    def at(self, share: np.ndarray) -> np.ndarray:
        """Quantiles."""
        index = np.minimum((share * len(self.values)).astype(int), len(self.values) - 1)
        return np.asarray(self.values, float)[index]


Distribution = Uniform | Normal | Choice


def grid(**values: float | int | Sequence[float | int]) -> pl.DataFrame:
    """Every combination of the given values; the first column varies slowest.

    Raises:
        ValueError: if a column has no values.
    """
    columns = {name: list(np.atleast_1d(np.asarray(v, float))) for name, v in values.items()}
    for name, column in columns.items():
        if not column:
            raise ValueError(f"{name}: got no values, allowed: at least one")
    rows = list(itertools.product(*columns.values()))
    return pl.DataFrame(rows, schema=dict.fromkeys(columns, pl.Float64), orient="row")


def draw(
    n: int, seed: int, *, latin_hypercube: bool = True, **columns: float | int | Distribution
) -> pl.DataFrame:
    """`n` random scenarios.

    Args:
        n: number of rows.
        seed: the same seed gives the same table.
        latin_hypercube: every column covers its range evenly, one row in each n-th of it; else independent draws.
        columns: a distribution, or one number for all rows.

    Raises:
        ValueError: for a bad number of rows or seed.
    """
    if not 1 <= n <= 10_000_000:
        raise ValueError(f"n: got {n}, allowed: 1 to 10000000")
    if not 0 <= seed < 2**31:
        raise ValueError(f"seed: got {seed}, allowed: 0 to {2**31 - 1}")
    shares = _latin if latin_hypercube else _independent
    drawn: dict[str, Any] = {}
    for index, (name, one) in enumerate(columns.items()):
        rng = np.random.default_rng([seed, index])
        known = isinstance(one, Uniform | Normal | Choice)
        drawn[name] = one.at(shares(rng, n)) if known else np.full(n, float(one))
    return pl.DataFrame(drawn)


def _latin(rng: np.random.Generator, n: int) -> np.ndarray:
    return (rng.permutation(n) + rng.random(n)) / n


def _independent(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.random(n)

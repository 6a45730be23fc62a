"""Scenario tables: full grids, and random draws with a seed."""

import hashlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import polars as pl
import scipy
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbiped.checked import Quantity, Refusal, shown, whole

MAX_ROWS = 10_000_000
CUT = 3.0
"""Standard deviations at which `Normal` is cut off."""

_finite = Quantity().check
Column = Float[np.ndarray, " n"]


@runtime_checkable
class Distribution(Protocol):
    """Distribution of a column: `Uniform`, `Normal`, `Choice`, or any frozen one of `scipy.stats`."""

    def ppf(self, q: Column, /) -> ArrayLike:
        """Quantiles at probabilities from 0 to 1."""
        ...


@dataclass(frozen=True)
class Uniform:
    """Anything from `low` to `high`, equally likely."""

    low: float | int
    high: float | int

    def __post_init__(self) -> None:
        """Refuse an empty or endless range."""
        low, high = _finite("uniform: low", self.low), _finite("uniform: high", self.high)
        if not (low <= high and math.isfinite(high - low)):
            raise ValueError(f"uniform: got {low:g} to {high:g}, allowed: low <= high, a finite range")

    def ppf(self, q: Column) -> Column:
        """Quantiles."""
        return self.low + q * (self.high - self.low)


@dataclass(frozen=True)
class Normal:
    """Normally distributed, cut off at CUT standard deviations."""

    mean: float | int
    deviation: float | int

    def __post_init__(self) -> None:
        """Check that the distribution is valid."""
        _finite("normal: mean", self.mean)
        if not _finite("normal: deviation", self.deviation) > 0.0:
            raise ValueError(f"normal: deviation: got {self.deviation:g}, allowed: > 0")

    def ppf(self, q: Column) -> Column:
        """Quantiles."""
        return scipy.stats.truncnorm.ppf(q, -CUT, CUT, self.mean, self.deviation)


@dataclass(frozen=True)
class Choice:
    """One of a few values, equally likely."""

    values: tuple[float | int, ...]

    def __post_init__(self) -> None:
        """Refuse an empty choice, and values that are no finite numbers."""
        if not isinstance(self.values, Sequence | np.ndarray) or isinstance(self.values, str | bytes):
            raise ValueError(f"choice: got {self.values!r}, allowed: a list of finite numbers")
        if not len(self.values):
            raise ValueError("choice: got no values, allowed: at least one finite number")
        for value in self.values:
            _finite("choice", value)

    def ppf(self, q: Column) -> Column:
        """Quantiles."""
        index = np.minimum((q * len(self.values)).astype(int), len(self.values) - 1)
        return np.asarray(self.values, float)[index]


def grid(**values: float | int | np.number | np.ndarray | Sequence[float | int]) -> pl.DataFrame:
    """Every combination of the given values; the first column varies slowest.

    Raises:
        ValueError: if a column has no values, or one that is no finite number.
    """
    columns = {name: [_finite(name, value) for value in _listed(given)] for name, given in values.items()}
    for name, column in columns.items():
        if not column:
            raise ValueError(f"{name}: got no values, allowed: at least one")
    count = math.prod(map(len, columns.values()))
    if count > MAX_ROWS:
        raise ValueError(f"grid: got {count} combinations, allowed: at most {MAX_ROWS}")
    rows = list(itertools.product(*columns.values()))
    return pl.DataFrame(rows, schema=dict.fromkeys(columns, pl.Float64), orient="row")


def draw(
    n: int | np.integer,
    seed: int | np.integer,
    *,
    latin_hypercube: bool = True,
    **columns: float | int | np.number | Distribution,
) -> pl.DataFrame:
    """`n` random scenarios.

    Every column is drawn by the seed and its own name: another column more or less changes none of the others.

    Args:
        n: number of rows.
        seed: the same seed gives the same table.
        latin_hypercube: every column covers its range evenly, one row in each n-th of it; else independent draws.
        columns: a distribution (`Uniform`, `Normal`, `Choice`, or a frozen one of `scipy.stats`), or one number for all
            rows.

    Raises:
        ValueError: for a bad number of rows, seed or value, and for a distribution that gives one.
    """
    n, seed = whole("n", n, 1, MAX_ROWS), whole("seed", seed, 0, 2**31 - 1)
    probabilities = _latin if latin_hypercube else _independent
    return pl.DataFrame(
        {
            name: _drawn(name, given, probabilities(_random(seed, name), n))
            if isinstance(given, Distribution)
            else np.full(n, _finite(name, given))
            for name, given in columns.items()
        }
    )


def _drawn(name: str, distribution: Distribution, probabilities: Column) -> Column:
    """Quantiles of a distribution, all of them finite."""
    try:
        values = np.asarray(distribution.ppf(probabilities), float)
    except TypeError:  # a class, or a family of scipy.stats that was given no parameters
        raise Refusal(
            f"{name}: got {shown(distribution)}, allowed: a number, or a distribution with its parameters, such as "
            "Uniform(0.4, 1.0) or scipy.stats.gamma(2.0)"
        ) from None
    return Quantity(shapes=(probabilities.shape,)).check(name, values)


def _listed(given: object) -> list[object]:
    return list(given) if isinstance(given, Sequence | np.ndarray | pl.Series) and np.ndim(given) else [given]


def _random(seed: int, name: str) -> np.random.Generator:
    words = np.frombuffer(hashlib.sha256(name.encode()).digest()[:16], np.uint32)
    return np.random.default_rng([seed, *words.tolist()])


def _latin(rng: np.random.Generator, n: int) -> Column:
    return (rng.permutation(n) + rng.random(n)) / n


def _independent(rng: np.random.Generator, n: int) -> Column:
    return rng.random(n)

"""Summaries of a table of walks: success rates, one variant against another, limits, and which input decides.

A table has one row per walk: `variant` and `scenario` (every variant meets the same scenarios), inputs, outcome.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
import scipy

from jaxbiped.batch import intervals
from jaxbiped.batch.inputs import NEVER, declared
from jaxbiped.batch.intervals import CONFIDENCE

BINS = 8
"""Most parts an input is cut into to see whether it decides."""
UP, DOWN = "up", "down"
"""Ways a limit is looked for."""


@dataclass(frozen=True)
class Paired:
    """Two variants in the same scenarios."""

    variant: str
    against: str
    n: int
    """Scenarios that both variants met; the counts below add up to it."""
    both: int
    only_first: int
    """Scenarios in which only `variant` succeeds."""
    only_second: int
    """Scenarios in which only `against` succeeds."""
    neither: int
    difference: float
    """Success rate of `variant` less that of `against`, from -1 to 1."""
    low: float
    high: float
    """Ends of the 95 % interval of the difference: Newcombe (1998), method 10, for paired proportions."""
    p_value: float
    """McNemar's exact test, two-sided: how likely so lopsided discordant scenarios are if the variants are alike."""
    unpaired: int
    """Scenarios left out because only one of the variants met them."""


@dataclass(frozen=True)
class PairedMeans:
    """A quantity of two variants in the same scenarios, where both succeed."""

    variant: str
    against: str
    what: str
    n: int
    """Scenarios in which both succeed."""
    mean: float
    """Mean of `variant`."""
    mean_against: float
    difference: float
    """Mean of `variant` less that of `against`."""
    low: float
    high: float
    """Ends of the 95 % interval of the difference: Student's t for few scenarios, else BCa, see `intervals.of_mean`."""


@functools.cache  # SciPy takes 0.3 ms, mostly for a p-value; a table has few different counts, however many cells
def wilson(successes: int, n: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Wilson's interval of a success rate, without continuity correction; (0, 1) of nothing.

    Args:
        successes: how many of n succeeded.
        n: how many there were.
        confidence: how often such an interval holds the true rate.
    """
    if not 0 <= successes <= n:
        raise ValueError(f"{successes} successes of {n}")
    if n == 0:
        return 0.0, 1.0
    ends = scipy.stats.binomtest(successes, n).proportion_ci(confidence, method="wilson")
    return float(ends.low), float(ends.high)


def variants(table: pl.DataFrame) -> list[str]:
    """Names of the variants, in the order in which they first occur."""
    return table["variant"].unique(maintain_order=True).to_list()


def inputs(table: pl.DataFrame) -> list[str]:
    """Columns of the quantities a walk was given, in the table's order: declared inputs only."""
    known = declared(table.columns)
    return [name for name in table.columns if name in known]


def without_never(table: pl.DataFrame, names: Sequence[str]) -> pl.DataFrame:
    """Put null for the times in these columns at which nothing ever happens, such as the load of a walk without one."""
    times = [name for name in names if name.endswith("_s") and table.schema[name].is_numeric()]
    return table.with_columns(pl.when(pl.col(name) < NEVER).then(pl.col(name)).alias(name) for name in times)


def cells(table: pl.DataFrame, by: Sequence[str] = ()) -> pl.DataFrame:
    """Count the successes of every variant at every value of the named inputs.

    Args:
        table: one row per walk.
        by: inputs that together make a cell; none for the variants as a whole.

    Returns:
        Columns variant, the inputs, n, successes, rate, low, high (Wilson's 95 % interval): the variants in the
        table's order, values rising.
    """
    counts = table.group_by("variant", *by).agg(
        n=pl.len().cast(pl.Int64), successes=pl.col("success").sum().cast(pl.Int64)
    )
    place = {variant: i for i, variant in enumerate(variants(table))}
    order = pl.col("variant").replace_strict(place, return_dtype=pl.Int64)
    counts = counts.sort(order, *by)
    ends = [wilson(s, n) for s, n in counts.select("successes", "n").iter_rows()]
    return counts.with_columns(
        (pl.col("successes") / pl.col("n")).alias("rate"),
        pl.Series("low", [low for low, _ in ends], pl.Float64),
        pl.Series("high", [high for _, high in ends], pl.Float64),
    )


def paired(table: pl.DataFrame, variant: str, against: str) -> Paired:
    """Compare two variants over the scenarios that both met.

    Args:
        table: one row per walk; a scenario at most once per variant.
        variant: the first variant.
        against: the second variant.
    """
    first, second = (_by_scenario(table, name) for name in (variant, against))
    joined = first.join(second, on="scenario", how="inner", suffix="_against")
    n = joined.height
    if n == 0:
        raise ValueError(f"variants {variant!r} and {against!r} have no scenario in common")
    a, b = joined["success"], joined["success_against"]
    counts = [int(both.sum()) for both in (a & b, a & ~b, ~a & b, ~a & ~b)]
    low, high = newcombe(*counts)
    return Paired(
        variant,
        against,
        n,
        *counts,
        difference=(counts[1] - counts[2]) / n,
        low=low,
        high=high,
        p_value=mcnemar(counts[1], counts[2]),
        unpaired=first.height + second.height - 2 * n,
    )


def paired_means(table: pl.DataFrame, variant: str, against: str, what: pl.Expr) -> PairedMeans:
    """Compare a quantity of two variants over the scenarios in which both succeed.

    Args:
        table: one row per walk; a scenario at most once per variant.
        variant: the first variant.
        against: the second variant.
        what: a quantity of a walk, as an expression with a name.
    """
    values = table.with_columns(what)
    name = what.meta.output_name()
    first, second = (
        _by_scenario(values, which, name).filter("success").drop("success") for which in (variant, against)
    )
    joined = first.join(second, on="scenario", how="inner", suffix="_against").sort("scenario")
    pairs = joined.select(name, f"{name}_against").to_numpy().astype(float)
    if not len(pairs):
        raise ValueError(f"variants {variant!r} and {against!r} have no scenario in which both succeed")
    gap = pairs[:, 0] - pairs[:, 1]
    low, high = intervals.of_mean(gap)
    mean, other = (float(mean) for mean in pairs.mean(axis=0))
    return PairedMeans(variant, against, name, len(gap), mean, other, float(gap.mean()), low, high)


def newcombe(both: int, only_first: int, only_second: int, neither: int) -> tuple[float, float]:
    """95 % interval of the difference between two paired success rates.

    R. G. Newcombe, Statistics in Medicine 17 (1998) 2635-2650, method 10: Wilson's intervals of the two rates put
    together by their correlation, which is corrected for continuity. It holds where a Wald interval does not: few
    scenarios, rates of 0 and 1.

    Args:
        both: pairs in which both succeed.
        only_first: pairs in which only the first succeeds.
        only_second: pairs in which only the second succeeds.
        neither: pairs in which both fail.
    """
    n = both + only_first + only_second + neither
    wins = (both + only_first, both + only_second)
    (low1, high1), (low2, high2) = (wilson(win, n) for win in wins)
    rate1, rate2 = (win / n for win in wins)
    phi = _correlation(both, only_first, only_second, neither)
    down = _hypotenuse(rate1 - low1, high2 - rate2, phi)
    up = _hypotenuse(high1 - rate1, rate2 - low2, phi)
    return rate1 - rate2 - down, rate1 - rate2 + up


def mcnemar(only_first: int, only_second: int) -> float:
    """McNemar's exact p, two-sided, of so many discordant pairs; 1 of none."""
    n = only_first + only_second
    return float(scipy.stats.binomtest(only_first, n).pvalue) if n else 1.0


def frontier(
    table: pl.DataFrame,
    what: str = "load_kg",
    by: str | None = "load_time_s",
    levels: Sequence[float] = (0.95, 0.5),
    signed: bool = False,
) -> pl.DataFrame:
    """Find how far up an input can go before a variant's success rate first falls below a level.

    The walk up ends at the first value that falls short: a larger one that does well again does not count. Rates are
    counted from few walks. How far that may be out is told by Wilson's 95 % interval of the rate at every value: the
    limit is sure to reach up to `low`, up to which the lower ends do not fall short, and is sure not to reach `high`,
    the first value at which the upper end does.

    Args:
        table: one row per walk; `what` takes few values, each met by several walks.
        what: the input whose limit is looked for.
        by: the input over which limits are listed; None for one limit per variant.
        levels: success rates to stay at or above.
        signed: `what` runs both ways from 0 (heights): go up from 0 and down from 0 instead of up from the smallest.

    Returns:
        Columns variant, `by`, direction ("up" or "down"), level, `what` (null if the first value falls short already),
        low (null if not even the first value is sure), high (null if no value tested is surely too much) and beyond:
        whether every value tested holds, so that the true limit may lie further out.
    """
    groups = ["variant"] if by is None else ["variant", by]
    known = without_never(table, [what, *groups[1:]]).drop_nulls([what, *groups])
    rows = [
        (*key, direction, level, *_limit(ladder, level))
        for key, cell in cells(known, [*groups[1:], what]).group_by(groups, maintain_order=True)
        for direction, ladder in _ladders(cell.select(what, "rate", "low", "high"), signed)
        for level in levels
    ]
    value = table.schema[what]
    schema = {name: table.schema[name] for name in groups}
    schema |= {"direction": pl.String(), "level": pl.Float64()}
    schema |= {what: value, "low": value, "high": value, "beyond": pl.Boolean()}
    return pl.DataFrame(rows, schema=schema, orient="row")


def causes(table: pl.DataFrame, names: Sequence[str] | None = None) -> pl.DataFrame:
    """Say which inputs decide over success: their mutual information with it, the most telling first in every variant.

    An input is cut at its quantiles into BINS parts at most, or into its own values where it has no more; missing
    values, and times at which nothing ever happens, are a part of their own. Information is corrected for the number
    of walks (Miller and Madow), so that an input without influence is near 0, and never below. Inputs are looked at
    one by one: one that decides only together with another may not show.

    Args:
        table: one row per walk.
        names: inputs to look at; all that vary within a variant by default.

    Returns:
        Columns variant, input, information_bits, share (of the uncertainty about success, 0 to 1), bins, rate_lowest,
        rate_highest (success rates in the lowest and in the highest bin), lowest_to and highest_from (where these
        bins end and begin, in the input's own unit).
    """
    looked_at = inputs(table) if names is None else list(names)
    table = without_never(table, looked_at)
    rows = []
    for variant in variants(table):
        walks = table.filter(pl.col("variant") == variant)
        varying = [name for name in looked_at if walks[name].drop_nulls().n_unique() > 1]
        found = [{"variant": variant, "input": name, **_cause(walks, name)} for name in varying]
        rows += sorted(found, key=lambda row: -row["information_bits"])
    return pl.DataFrame(rows, schema=_CAUSES)


_CAUSES = {
    "variant": pl.String(),
    "input": pl.String(),
    "information_bits": pl.Float64(),
    "share": pl.Float64(),
    "bins": pl.Int64(),
    "rate_lowest": pl.Float64(),
    "rate_highest": pl.Float64(),
    "lowest_to": pl.Float64(),
    "highest_from": pl.Float64(),
}


def information(codes: np.ndarray, success: np.ndarray) -> float:
    """Mutual information of two discrete variables with Miller and Madow's correction, at least 0 [bit].

    Args:
        codes: (n,) which bin each walk is in.
        success: (n,) whether it succeeded.
    """
    joint = 2 * codes + success
    (bins, m_bins), (outcome, m_outcome), (together, m_joint) = (_entropy(x) for x in (codes, success, joint))
    bias = (m_bins + m_outcome - m_joint - 1) / (2.0 * len(codes) * math.log(2.0))
    return max(0.0, bins + outcome - together + bias)


def _by_scenario(table: pl.DataFrame, variant: str, *more: str) -> pl.DataFrame:
    walks = table.filter(pl.col("variant") == variant).select("scenario", "success", *more)
    if walks.is_empty():
        raise ValueError(f"no variant {variant!r}; there are {', '.join(variants(table))}")
    if walks["scenario"].n_unique() < walks.height:
        raise ValueError(f"variant {variant!r} meets a scenario more than once")
    return walks


def _correlation(both: int, only_first: int, only_second: int, neither: int) -> float:
    """Newcombe's phi, the correlation of the two successes, drawn towards 0 where it is positive."""
    n = both + only_first + only_second + neither
    product = both * neither - only_first * only_second
    if product > 0:
        product = max(product - 0.5 * n, 0.0)
    margins = (both + only_first, only_second + neither, both + only_second, only_first + neither)
    return product / math.sqrt(math.prod(margins)) if all(margins) else 0.0


def _hypotenuse(one: float, other: float, phi: float) -> float:
    return math.sqrt(max(0.0, one**2 - 2.0 * phi * one * other + other**2))


Rung = tuple[float | int, float, float, float]
"""A value, its success rate, and the ends of the rate's interval."""


def _ladders(cell: pl.DataFrame, signed: bool) -> Iterator[tuple[str, list[Rung]]]:
    """Values and their rates on the way out, for every way there is."""
    rungs: list[Rung] = sorted(cell.iter_rows())
    if not signed:
        yield UP, rungs
        return
    below = [rung for rung in reversed(rungs) if rung[0] <= 0]
    above = [rung for rung in rungs if rung[0] >= 0]
    if above and (above[-1][0] > 0 or len(below) == 1):
        yield UP, above
    if below and below[-1][0] < 0:
        yield DOWN, below


def _limit(
    ladder: Sequence[Rung], level: float
) -> tuple[float | int | None, float | int | None, float | int | None, bool]:
    """The limit, up to where it is sure to reach, from where on it is sure not to, and whether every value holds."""
    values = [value for value, *_ in ladder]
    held, sure, possible = (
        next((i for i, rung in enumerate(ladder) if rung[k] < level), len(ladder)) for k in (1, 2, 3)
    )
    last, lowest = ([None, *values][n] for n in (held, sure))
    return last, lowest, [*values, None][possible], held == len(ladder)


def _cause(walks: pl.DataFrame, name: str) -> dict[str, Any]:
    """Information of one input about success in one variant."""
    values = walks[name].cast(pl.Float64).fill_null(math.nan).to_numpy()
    success = walks["success"].to_numpy().astype(int)
    codes = _bins(values)
    known = ~np.isnan(values)
    lowest, highest = (known & (codes == end) for end in (codes[known].min(), codes[known].max()))
    told, uncertain = information(codes, success), _entropy(success)[0]
    return {
        "information_bits": told,
        "share": min(1.0, told / uncertain) if uncertain > 0.0 else 0.0,
        "bins": len(np.unique(codes)),
        "rate_lowest": float(success[lowest].mean()),
        "rate_highest": float(success[highest].mean()),
        "lowest_to": float(values[lowest].max()),
        "highest_from": float(values[highest].min()),
    }


def _bins(values: np.ndarray) -> np.ndarray:
    """Number of the bin of each value, rising with it; missing ones have a bin of their own."""
    known = values[~np.isnan(values)]
    edges = np.unique(known)[:-1]
    if len(edges) >= BINS:
        parts = np.arange(1, BINS) / BINS
        edges = np.unique(np.quantile(known, parts, method="inverted_cdf"))
    codes = np.searchsorted(edges, values, side="left")
    return np.where(np.isnan(values), len(edges) + 1, codes)


def _entropy(codes: np.ndarray) -> tuple[float, int]:
    """Entropy of the counted values [bit], and the number of different ones."""
    counts = np.unique(codes, return_counts=True)[1]
    share = counts / counts.sum()
    return float(-(share * np.log2(share)).sum()), len(counts)

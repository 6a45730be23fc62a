"""What the sweeps that tune share: trying variants, paired comparisons in words, sensitivity figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import jaxbiped as jb
from jaxbiped.batch import summary
from jaxbiped.report import descents
from jaxbiped.tune import Problem


def try_variants(
    what: str,
    experiment: jb.batch.Experiment,
    out: Path,
    workers: int | None,
    pairs: Sequence[tuple[str, str]],
    means: Sequence[pl.Expr],
) -> pl.DataFrame:
    """Walk variants in scenarios they were not tuned on, and print what is gained."""
    table = jb.batch.run(experiment, out, workers, overwrite=True, progress=jb.batch.show())
    print_compared(what, table, pairs, means)
    return table


def print_compared(
    what: str, table: pl.DataFrame, pairs: Sequence[tuple[str, str]], means: Sequence[pl.Expr]
) -> None:
    """Successes of every variant; for every pair what the first gains on the second, with 95 % intervals."""
    print(f"\n{what}")
    for variant, n, successes in summary.cells(table).select("variant", "n", "successes").iter_rows():
        print(f"  {variant:18s} {successes} of {n} succeed")
    for variant, against in pairs:
        one = summary.paired(table, variant, against)
        print(
            f"  {variant} less {against}: {one.difference:+.1%} ({one.low:+.1%} to {one.high:+.1%}), "
            f"{one.only_first} succeed only with {variant}, {one.only_second} only with {against}, "
            f"p = {one.p_value:.2g}"
        )
        if not one.both:
            continue
        for quantity in means:
            m = summary.paired_means(table, variant, against, quantity)
            print(
                f"    {m.what}: {m.mean_against:.4g} -> {m.mean:.4g}, {m.difference:+.3g} "
                f"({m.low:+.3g} to {m.high:+.3g}) over {m.n}"
            )


def sensitivity(problem: Problem, x: np.ndarray, label: str, title: str, file: Path) -> None:
    """Draw the derivative of every walk's loss by every tunable, over x, beside its finite-difference secant.

    Secants are a thousandth of each range wide: what a person would see who turned the knob a little.
    """
    rows, width = np.arange(len(x)), np.array([t.high - t.low for t in problem.tunables])
    slope = jb.tune.forward(problem, problem.start, rows)
    secant = jb.tune.central(problem, problem.start, rows, 1e-3 * width)
    names = [t.name for t in problem.tunables]
    figure = descents.sensitivity(
        x, slope.by_scenario * width, secant.by_scenario * width, names, label, title
    )
    figure.savefig(file, dpi=110)
    print(f"\n{title}: {file}")
    for i, name in enumerate(names):
        a, b = slope.by_scenario[:, i] * width[i], secant.by_scenario[:, i] * width[i]
        moved = np.maximum(np.abs(a), np.abs(b)) > 0.0
        gap: Any = np.abs(a - b)[moved] / np.maximum(np.abs(a), np.abs(b))[moved]
        apart = f"{np.median(gap):.1%} apart (median)" if moved.any() else "no walk depends on it"
        print(f"  {name:34s} mean |derivative| {np.mean(np.abs(a)):8.3f} per range, secants {apart}")

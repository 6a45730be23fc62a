"""What differs between the tables of two runs of the same scenarios: verdicts cell by cell, and every column.

python sweeps/compare.py runs/before runs/after
"""

import argparse
from pathlib import Path

import polars as pl

import jaxbiped as jb

KEYS = ("variant", "scenario")
VERDICT = ("status", "success", "finished")


def compare(before: pl.DataFrame, after: pl.DataFrame) -> list[str]:
    """A line for every column of both tables that differs, and one for every walk whose verdict does.

    Raises:
        ValueError: if they are not of the same walks.
    """
    both = before.join(after, on=KEYS, suffix="_after")
    if not both.height == before.height == after.height:
        raise ValueError(f"tables: got {before.height} and {after.height} walks, {both.height} of both")
    columns = [name for name in before.columns if name in after.columns and name not in KEYS]
    lines = [line for name in columns if (line := _column(name, both[name], both[f"{name}_after"]))]
    changed = both.filter(pl.any_horizontal(pl.col(n).ne_missing(pl.col(f"{n}_after")) for n in VERDICT))
    for row in changed.iter_rows(named=True):
        lines.append(
            f"{row['variant']} {row['scenario']}: "
            + ", ".join(f"{n} {row[n]} -> {row[f'{n}_after']}" for n in VERDICT)
        )
    return [f"{both.height} walks, {changed.height} with another verdict", *lines]


def _column(name: str, before: pl.Series, after: pl.Series) -> str:
    """By how much a column differs; empty if it does not."""
    changed = before.ne_missing(after)
    if not changed.any():
        return ""
    said = f"{name}: {changed.sum()} differ"
    if not before.dtype.is_numeric():
        return said
    off = (before.cast(float) - after.cast(float)).abs()
    missing = (before.is_null() != after.is_null()).sum()
    return f"{said}, by {off.max() or 0.0:.3g} at most" + (
        f", {missing} missing in one only" if missing else ""
    )


def main() -> None:
    """Read both folders and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    given = parser.parse_args()
    tables = [jb.batch.open_table(folder)[1] for folder in (given.before, given.after)]
    print("\n".join(compare(*tables)))


if __name__ == "__main__":
    main()

"""The thesis' tables as text, as printed and beside ours; needs no matplotlib.

Every function takes a table with one row per walk (`jaxbiped.batch`). The thesis counts time from the middle of a
double support: its time is ours less T_ini, which functions take as `offset_s`.
"""

import math
from collections.abc import Sequence
from importlib import resources
from typing import NamedTuple

import polars as pl

from jaxbiped.batch import NEVER, summary

THESIS_TABLES = {
    1: "Table 4.1, no reflex (the calibration)",
    2: "Table 4.2, original reflex (the grip was chosen on it)",
    3: "Table 4.3, modified reflex (the grip was chosen on it)",
}
"""Titles of elkahlout's tables with their use here: the robot was fitted to the first, the others test it."""
TICK, CROSS, NOT_RUN, DIFFERS = "✓", "✗", "·", "*"
"""Marks in tables of text."""
Cell = tuple[int, int]
"""A time and a load, in whole ms and g."""
_WIDTH = 6
"""Width of a column of text, in letters."""


class Agreement(NamedTuple):
    """Agreement of the cells of a printed table with ours."""

    agree: int
    compared: int
    """Cells that are both printed and walked."""
    by_load: pl.DataFrame
    """Agreement for every load: columns load_kg, agree, compared."""


def thesis_table(number: int) -> pl.DataFrame:
    """Read a table of elkahlout as printed: 1 without reflex, 2 with the original reflex, 3 with the modified one.

    Toe and heel were calibrated on Table 4.1, the grip of the floor on 4.2 and 4.3. Table 4.2 lists 3.2 s twice and
    lacks 3.1 s and 4.1 s, as here.

    Args:
        number: 1, 2 or 3.

    Returns:
        Columns load_kg, time_s (the thesis' own), success; row by row.
    """
    if number not in THESIS_TABLES:
        raise ValueError(f"elkahlout has no table 4.{number} of successes; there are 4.1, 4.2 and 4.3")
    file = resources.files("jaxbiped.report") / "data" / f"elkahlout_table_4_{number}.csv"
    wide = pl.read_csv(file.read_bytes(), infer_schema_length=None).with_row_index("line")
    tall = wide.unpivot(index=["line", "time_s"], variable_name="load_kg", value_name="success")
    tall = tall.with_columns(pl.col("load_kg").cast(pl.Float64), pl.col("success") == 1)
    return tall.sort("line", "load_kg").select("load_kg", "time_s", "success")


def tick_table(walks: pl.DataFrame, offset_s: float) -> str:
    """Write the walks of one variant as the thesis does: a row per time, a column per load, a tick for a success.

    A cell with several walks that do not all end alike shows the share that succeeded; one that was not run, a dot.

    Args:
        walks: the rows of one variant; those without a load are left out.
        offset_s: what the thesis' time is earlier than ours, T_ini [s].
    """
    ours = our_cells(walks, offset_s)
    times, loads = (sorted({key[i] for key in ours}) for i in range(2))
    lines = [_line("load [kg]", [_milli_text(load) for load in loads]), "time [s]"]
    lines += [
        _line(_milli_text(time), [_our_mark(ours.get((time, load))) for load in loads]) for time in times
    ]
    return _text([_title(walks), *lines])


def beside_thesis(walks: pl.DataFrame, number: int, offset_s: float) -> str:
    """Write the walks of one variant and a table of the thesis side by side, differing cells marked with a star.

    Table 4.1 is what the robot was calibrated with; the grip of its floor was chosen on 4.2 and 4.3. Times
    and loads that were run are shown, and it is said how many cells of the thesis were not; a time printed twice has
    two rows. Where no cell was both printed and run, one line says so.

    Args:
        walks: the rows of one variant; those without a load are left out.
        number: of the thesis' table: 1, 2 or 3.
        offset_s: what the thesis' time is earlier than ours, T_ini [s].
    """
    ours, printed = our_cells(walks, offset_s), thesis_table(number)
    agree, compared, _ = agreement(walks, number, offset_s)
    if not compared:
        return f"{_title(walks)}: no cell of {THESIS_TABLES[number]}, was run"
    times, loads = (sorted({key[i] for key in ours}) for i in range(2))
    said = [row for row in _printed_rows(printed) if row[0] in times]
    rows = said + [(time, {}) for time in set(times) - {time for time, _ in said}]
    head = _line("load [kg]", [_milli_text(load) for load in loads])
    cells = len(printed_cells(printed))
    missing = f"; {cells - compared} of the thesis' {cells} cells were not run" if cells > compared else ""
    lines = [
        f"{_title(walks)}, beside {THESIS_TABLES[number]}: {agree} of {compared} cells agree{missing}",
        f"{'':10}{'ours':^{_WIDTH * len(loads)}} |{'thesis':^{_WIDTH * len(loads)}}",
        f"{head} |{head[10:]}",
        "time [s]",
    ]
    for time, row in sorted(rows, key=lambda row: row[0]):
        here = [_compared_mark(ours.get((time, load)), row.get(load)) for load in loads]
        there = [_printed_mark(row.get(load)) for load in loads]
        lines.append(f"{_line(_milli_text(time), here)} |{_line('', there)[10:]}")
    return _text(lines)


def agreement(walks: pl.DataFrame, number: int, offset_s: float) -> Agreement:
    """Count the cells of a printed table that come out the same here.

    Toe and heel were calibrated on Table 4.1, the grip of the floor on 4.2 and 4.3. Times and loads are the same
    if they are to the nearest ms and g. A cell printed twice counts once. With several walks in a cell, ours succeeds
    if more than half of them do.

    Args:
        walks: the rows of one variant; those without a load are left out.
        number: of the thesis' table: 1, 2 or 3.
        offset_s: what the thesis' time is earlier than ours, T_ini [s].
    """
    ours, printed = our_cells(walks, offset_s), printed_cells(thesis_table(number))
    same = [
        (load, succeeds(ours[key]) == said)
        for key, said in printed.items()
        if key in ours
        for load in key[1:]
    ]
    loads = sorted({load for load, _ in same})
    by_load = [
        (1e-3 * load, sum(s for one, s in same if one == load), sum(one == load for one, _ in same))
        for load in loads
    ]
    schema = {"load_kg": pl.Float64(), "agree": pl.Int64(), "compared": pl.Int64()}
    return Agreement(sum(s for _, s in same), len(same), pl.DataFrame(by_load, schema=schema, orient="row"))


def milli(value: float) -> int:
    """Round a value to whole thousandths."""
    return round(1e3 * value)


def _milli_text(value: int) -> str:
    text = f"{1e-3 * value:.3f}".rstrip("0")
    return f"{text}0" if text.endswith(".") else text


def our_cells(walks: pl.DataFrame, offset_s: float) -> dict[Cell, tuple[int, int]]:
    """Successes and walks at each time and load."""
    _one_variant(walks)
    found: dict[Cell, tuple[int, int]] = {}
    known = walks.filter((pl.col("load_kg") > 0.0) & (pl.col("load_time_s") < NEVER))
    for time, load, success in known.select("load_time_s", "load_kg", "success").iter_rows():
        if math.isfinite(time):
            key = (milli(time - offset_s), milli(load))
            won, n = found.get(key, (0, 0))
            found[key] = (won + success, n + 1)
    return found


def _one_variant(walks: pl.DataFrame) -> str:
    names = summary.variants(walks)
    if len(names) != 1:
        raise ValueError(f"the walks of one variant are needed, not of {len(names)}: {', '.join(names)}")
    return names[0]


def _title(walks: pl.DataFrame) -> str:
    return f"variant {_one_variant(walks)}"


def _printed_rows(printed: pl.DataFrame) -> list[tuple[int, dict[int, bool]]]:
    """Rows of a printed table in their order: a time, and success by load."""
    rows: list[tuple[int, dict[int, bool]]] = []
    for load, time, success in printed.select("load_kg", "time_s", "success").iter_rows():
        key = (milli(time), milli(load))
        if not rows or rows[-1][0] != key[0] or key[1] in rows[-1][1]:
            rows.append((key[0], {}))
        rows[-1][1][key[1]] = success
    return rows


def printed_cells(printed: pl.DataFrame) -> dict[Cell, bool]:
    """Tell whether each cell of a printed table is a success."""
    return {(time, load): success for time, row in _printed_rows(printed) for load, success in row.items()}


def succeeds(cell: tuple[int, int]) -> bool:
    """Tell whether more than half of the walks of a cell succeed."""
    won, n = cell
    return 2 * won > n


def _our_mark(cell: tuple[int, int] | None) -> str:
    if cell is None:
        return NOT_RUN
    won, n = cell
    if won in (0, n):
        return TICK if won else CROSS
    return f"{100 * won / n:.0f}%"


def _printed_mark(success: bool | None) -> str:
    return NOT_RUN if success is None else TICK if success else CROSS


def _compared_mark(cell: tuple[int, int] | None, printed: bool | None) -> str:
    differs = cell is not None and printed is not None and succeeds(cell) != printed
    return _our_mark(cell) + (DIFFERS if differs else "")


def _text(lines: Sequence[str]) -> str:
    return "\n".join(line.rstrip() for line in lines)


def _line(head: str, marks: Sequence[str]) -> str:
    """One row of text; a star hangs over to the right, so that ticks stay in line."""
    fields = [
        f"{mark.removesuffix(DIFFERS):>{_WIDTH - 1}}{DIFFERS if DIFFERS in mark else ' '}" for mark in marks
    ]
    return f"{head:>9} " + "".join(fields)

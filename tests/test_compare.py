"""sweeps/compare.py says what differs between two tables, and nothing else."""

import sys
from pathlib import Path

import polars as pl
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "sweeps"))

import compare


def table(**changed) -> pl.DataFrame:
    columns = {
        "variant": ["off", "off", "modified"],
        "scenario": [0, 1, 0],
        "status": ["ok", "fell", "ok"],
        "success": [True, False, True],
        "finished": [True, False, True],
        "trigger_s": [None, None, 2.4],
        "peak_roll_deg": [1.0, 45.0, 2.0],
    }
    return pl.DataFrame({**columns, **changed})


def test_equal_tables_differ_in_nothing():
    assert compare.compare(table(), table().reverse()) == ["3 walks, 0 with another verdict"]


def test_what_differs_is_said_column_by_column_and_verdict_by_verdict():
    after = table(
        status=["ok", "ok", "ok"],
        success=[True, True, True],
        trigger_s=[None, None, None],
        peak_roll_deg=[1.0, 45.5, 2.25],
    )
    assert compare.compare(table(), after) == [
        "3 walks, 1 with another verdict",
        "status: 1 differ",
        "success: 1 differ",
        "trigger_s: 1 differ, by 0 at most, 1 missing in one only",
        "peak_roll_deg: 2 differ, by 0.5 at most",
        "off 1: status fell -> ok, success False -> True, finished False -> False",
    ]


def test_tables_of_other_walks_are_refused():
    with pytest.raises(ValueError, match=r"got 3 and 2 walks, 2 of both"):
        compare.compare(table(), table().head(2))

"""The notebook runs from its first cell to its last, on a small size."""

import json
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "tune.ipynb"
SMALL = {
    "SCENARIOS, STEPS, BATCH, DURATION": "4, 2, 3, 6.0",
    "LOADS, TIMES": "(5.0, 15.0), np.array([1.2])",
    "OUT": "Path('out')",
    "NAMES": "['payload.reflex_time', 'payload.x_left_left_swings']",
}
"""What stands left of an equals sign, and its small value."""


def cells() -> list[str]:
    found = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == "code"]


def test_sizes_are_set_in_the_first_cell():
    first, *others = cells()
    for name in SMALL:
        assert f"\n{name} = " in first
        assert not any(f"\n{name} = " in f"\n{cell}" for cell in others)


@pytest.mark.slow
def test_every_cell_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    first, *others = cells()
    names: dict[str, Any] = {}
    exec(first, names)
    exec("\n".join(f"{name} = {value}" for name, value in SMALL.items()), names)
    for cell in others:
        exec(cell, names)
    out = capsys.readouterr().out
    assert "forward" in out and "variant tuned" in out
    assert names["table"].height == 4 and len(names["tuned"].values) == 2

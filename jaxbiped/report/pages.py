"""Figures and pages of the results of an experiment, by the names of the pages."""

from pathlib import Path

import polars as pl

from jaxbiped.batch import Experiment, height_column, records, steps_of
from jaxbiped.report import figures, grids, overview, page

FILES = {
    "overview": ("report.html",),
    "payload": ("payload_success.png", "payload_pitch.png"),
    "obstacles": ("obstacles.png",),
}
"""Files of every page."""


def payload(table: pl.DataFrame, name: str, start: float) -> dict[str, figures.Figure]:
    """Success and pitch of every load at every time, on the gait's own clock.

    Args:
        table: rows of the results.
        name: of the robot.
        start: when that clock starts [s].
    """
    what = f"{name}: loads put on while it walks"
    both = {"x": "load_kg", "y": "load_time_s", "offset_s": start}
    return {
        "payload_success": grids.heat_map(table, title=what, **both),
        "payload_pitch": grids.heat_map(table, title=what, value="peak_pitch_deg", **both),
    }


def obstacles(table: pl.DataFrame, name: str, step: int) -> dict[str, figures.Figure]:
    """Success and foot force of every variant at every height under a step."""
    what = f"{name} over an unknown pad under step {step}"
    return {"obstacles": grids.cells_figure(table, height_column(step), what)}


def write(experiment: Experiment, table: pl.DataFrame, folder: Path) -> list[str]:
    """Draw the pages that an experiment asks for; returns the names of the files.

    Raises:
        OSError: if one cannot be written.
    """
    return [file for name in experiment.pages for file in _WRITE[name](experiment, table, folder)]


def _overview(experiment: Experiment, table: pl.DataFrame, folder: Path) -> list[str]:
    title = f"{experiment.robot.name}: {table.height} walks"
    sections = overview.sections(experiment, table, folder=folder)
    return [
        str(page.write_page(folder / "report.html", title, sections, records.digest(experiment.resolved)))
    ]


def _payload(experiment: Experiment, table: pl.DataFrame, folder: Path) -> list[str]:
    start = overview.clock_start(experiment)
    return _save(payload(table, experiment.robot.name, start), folder)


def _obstacles(experiment: Experiment, table: pl.DataFrame, folder: Path) -> list[str]:
    """Draw obstacles by the height under the first step that has a column; nothing if none has."""
    steps = steps_of(table.columns)
    return _save(obstacles(table, experiment.robot.name, steps[0]), folder) if steps else []


_WRITE = {"overview": _overview, "payload": _payload, "obstacles": _obstacles}


def _save(drawn: dict[str, figures.Figure], folder: Path) -> list[str]:
    return [str(figures.save(figure, folder / f"{name}.png")) for name, figure in drawn.items()]

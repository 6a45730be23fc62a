"""A results table as one page: what was walked, how much succeeds, where it breaks, and what explains it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import polars as pl

from jaxbiped.batch import Experiment, steps_of, summary
from jaxbiped.planner import CosineGait
from jaxbiped.report import grids
from jaxbiped.report.page import Picture, Section

THESIS = {"off": 1, "original": 2, "modified": 3}
"""Which of the thesis' tables 4.1, 4.2, 4.3 an arm of the payload reflex answers to."""
FEW = 64
"""Values of an input that make a grid; more are a random draw."""
LISTED = 40
"""Failures that are listed."""
SHOWN = ("row", "arm", "status", "end_time_s", "peak_roll_deg", "peak_pitch_deg", "zmp_margin_m")


def sections(experiment: Experiment, table: pl.DataFrame, about: str = "") -> list[Section]:
    """All that can be said of a table, as sections of a page.

    Args:
        experiment: what was walked.
        table: its rows so far.
        about: put before every heading, where a page has several tables.
    """
    start, varied = clock_start(experiment), varying(table)
    found = [_what(experiment, table, varied), _success(table)]
    if grid_of_loads(table, varied):
        found.append(_loads(experiment, table, start))
    found += [
        _heights(table, name)
        for name in varied
        if name.endswith("_height_m") and table[name].n_unique() <= FEW
    ]
    if len(varied) > 2:
        found.append(_causes(table))
    if not table["success"].all():
        found.append(_failures(table, varied))
    return [replace(section, heading=f"{about}{section.heading}") for section in found]


def clock_start(experiment: Experiment) -> float:
    """When the clock of loading times starts, since the start of the walk [s]: T_ini for the cosine gait."""
    gait = next(iter(experiment.arms.values())).gait
    return float(gait.params.T_ini) if isinstance(gait, CosineGait) else 0.0


def varying(table: pl.DataFrame) -> list[str]:
    """Inputs with more than one value."""
    return [name for name in summary.inputs(table) if table[name].n_unique() > 1]


def grid_of_loads(table: pl.DataFrame, varied: list[str]) -> bool:
    """Whether loads and loading times make a grid."""
    both = {"load_kg", "load_time_s"}
    return both <= set(varied) and all(table[name].n_unique() <= FEW for name in both)


def is_thesis_experiment(experiment: Experiment) -> bool:
    """Whether the walks are the thesis' own: its robot and its gait."""
    gait = next(iter(experiment.arms.values())).gait
    return experiment.robot.name == "elkahlout" and isinstance(gait, CosineGait)


def agreements(experiment: Experiment, table: pl.DataFrame) -> dict[str, grids.Agreement]:
    """Of every arm that answers to a table of the thesis: in how many cells both say the same."""
    if not is_thesis_experiment(experiment):
        return {}
    start = clock_start(experiment)
    return {
        arm: grids.agreement(table.filter(pl.col("arm") == arm), number, start)
        for arm, number in THESIS.items()
        if arm in experiment.arms
    }


def agreement_in_words(arm: str, one: grids.Agreement) -> str:
    """One line; the first table is what the robot's assumed numbers were calibrated on."""
    kind = "calibration" if THESIS[arm] == 1 else "prediction"
    loads = ", ".join(f"{load:g} kg {agree} of {n}" for load, agree, n in one.by_load.iter_rows())
    return (
        f"Table 4.{THESIS[arm]} ({kind}), arm {arm}: {one.agree} of {one.compared} cells as printed ({loads})"
    )


def _what(experiment: Experiment, table: pl.DataFrame, varied: list[str]) -> Section:
    gait = next(iter(experiment.arms.values())).gait
    pads = [step for step in steps_of(table.columns) if (table[f"step_{step}_height_m"] != 0.0).any()]
    lines = [
        f"{experiment.robot.name}, {float(experiment.robot.total_mass):.1f} kg, {type(gait).__name__}, "
        f"{gait.timing.n_steps} steps in {float(gait.duration):.1f} s.",
        f"{table.height} of {experiment.rows} walks: {experiment.table.height} scenarios with each of "
        f"{len(experiment.arms)} arms ({', '.join(experiment.arms)}); every arm meets the same scenarios.",
        f"Varied: {', '.join(grids.shown(name).label for name in varied) or 'nothing'}."
        + (f" Pads under steps {', '.join(map(str, pads))}." if pads else ""),
    ]
    return Section("What was walked", tuple(lines))


def _success(table: pl.DataFrame) -> Section:
    names, against = summary.arms(table), []
    for name in names[1:]:
        one = summary.paired(table, name, names[0])
        against.append(
            f"{name} against {names[0]}, on the same {one.n} scenarios: {one.only_first} succeed only with {name}, "
            f"{one.only_second} only with {names[0]}; difference {one.difference:+.1%} "
            f"(95 % interval {one.low:+.1%} to {one.high:+.1%})."
        )
    words = ("Success by the rule of the paper, with 95 % Wilson intervals.", *against)
    return Section("Success", words, (summary.cells(table),))


def _loads(experiment: Experiment, table: pl.DataFrame, start: float) -> Section:
    thesis = is_thesis_experiment(experiment)
    marks: Mapping[str, Any] | None = None
    words, texts = ["Load by time of loading."], []
    for walks in table.partition_by("arm", maintain_order=True):
        arm = walks["arm"][0]
        if thesis and arm in THESIS:
            texts.append(grids.beside_thesis(walks, THESIS[arm], start))
        else:
            texts.append(grids.tick_table(walks, start))
    if thesis:
        marks = {arm: grids.thesis_table(n) for arm, n in THESIS.items() if arm in experiment.arms}
        words += [agreement_in_words(arm, one) for arm, one in agreements(experiment, table).items()]
        words.append("Cells that differ from the printed table are outlined.")
    axes = {"x": "load_kg", "y": "load_time_s", "offset_s": start}
    limits = summary.frontier(table)
    pictures = (
        Picture(grids.heat_map(table, title="Success", marks=marks, **axes), "Success of every cell."),
        Picture(
            grids.heat_map(table, title="Trunk pitch", value="peak_pitch_deg", **axes), "Largest trunk pitch."
        ),
        Picture(
            grids.frontier_figure(limits, "Largest load that is survived", offset_s=start),
            "Success frontier: up to which load at least 95 % and 50 % of the walks succeed.",
        ),
    )
    return Section("Loads", tuple(words), tuple(texts), pictures)


def _heights(table: pl.DataFrame, name: str) -> Section:
    one = grids.cells_figure(table, name, "Success and peak foot force")
    return Section(
        f"Heights: {grids.shown(name).label}", (), (), (Picture(one, "Success with Wilson intervals."),)
    )


def _causes(table: pl.DataFrame) -> Section:
    found = summary.causes(table)
    words = (
        "Which input explains failures most: the mutual information between success and each input alone, corrected "
        "for the number of walks.",
    )
    picture = Picture(grids.causes_figure(found, "What explains failures"), "In bits; 0 explains nothing.")
    return Section("Causes", words, (found.head(LISTED),), (picture,))


def _failures(table: pl.DataFrame, varied: list[str]) -> Section:
    failed = table.filter(~pl.col("success"))
    shown = [*SHOWN, *(name for name in varied if name not in SHOWN)]
    words = f"{failed.height} walks are no success; `jaxbiped replay FOLDER ROW` walks one again."
    return Section("Walks that fail", (words,), (failed.select(shown).head(LISTED),))

"""A results table as one page: what was walked, how much succeeds, where it breaks, and what explains it."""

import functools
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import polars as pl

from jaxbiped import robot
from jaxbiped.batch import NEVER, Experiment, steps_of, summary
from jaxbiped.report import grids, quantities, tables
from jaxbiped.report.page import Picture, Section

THESIS_ROBOT = "elkahlout"
"""Preset of the robot of the thesis' printed tables."""
THESIS = {"off": 1, "original": 2, "modified": 3}
"""Number of the thesis' table 4.1, 4.2 or 4.3 that a variant of the payload reflex answers to."""
FEW = 64
"""Most values of an input that make a grid; more are a random draw."""
LISTED = 40
"""Most failures, limits or inputs that are listed."""
SHOWN = (
    *("row", "variant", "status", "success", "end_time_s"),
    *("peak_roll_deg", "peak_pitch_deg", "zmp_margin_m"),
)
WENT_WRONG = {
    "fell": "fell",
    "airborne": "was airborne",
    "nonfinite": "came to numbers that are not finite",
}
"""Words for the status of a walk that broke down."""
COMMAND = "run it again"
"""Column of the commands that run a listed walk again."""


def sections(
    experiment: Experiment, table: pl.DataFrame, about: str = "", folder: Path | None = None
) -> list[Section]:
    """All that can be said of a table, as sections of a page.

    Args:
        experiment: what was walked.
        table: its rows so far.
        about: put before every heading, where a page has several tables.
        folder: where the table is, for the commands that run a walk again; the word FOLDER if it is not given.
    """
    start, varied = clock_start(experiment), varying(table)
    found = [_what(experiment, table, varied), _success(experiment, table)]
    if grid_of_loads(table, varied):
        found.append(_loads(experiment, table, start))
    found += [
        _heights(table, name)
        for name in varied
        if name.endswith("_height_m") and table[name].n_unique() <= FEW
    ]
    if len(varied) > 2:
        found.append(_causes(table))
    if failing(table).height:
        found.append(_failures(table, varied, folder))
    return [replace(section, heading=f"{about}{section.heading}") for section in found]


def clock_start(experiment: Experiment) -> float:
    """Return when the clock of loading times starts, since the start of the walk [s]."""
    return float(next(iter(experiment.variants.values())).gait.clock_start)


def varying(table: pl.DataFrame) -> list[str]:
    """Inputs with more than one value."""
    return [name for name in summary.inputs(table) if table[name].n_unique() > 1]


def grid_of_loads(table: pl.DataFrame, varied: list[str]) -> bool:
    """Tell whether loads and loading times make a grid: few of both, one of which varies unless nothing does."""
    both = ("load_kg", "load_time_s")
    if not set(both) <= set(table.columns) or (varied and not set(both) & set(varied)):
        return False
    loaded = table.filter((pl.col("load_kg") > 0.0) & (pl.col("load_time_s") < NEVER))
    return loaded.height > 0 and all(loaded[name].n_unique() <= FEW for name in both)


def failing(table: pl.DataFrame) -> pl.DataFrame:
    """Walks that are no success by the rule, or broke down at any time, be it after their success."""
    return table.filter(~pl.col("success") | pl.col("status").is_in(list(WENT_WRONG)))


def is_thesis_experiment(experiment: Experiment) -> bool:
    """Tell whether the walks are the thesis' own, by the robot's numbers, whatever its name, and the kind of gait."""
    ours, thesis = _numbers(experiment.robot), _numbers_of_the_thesis()
    same = len(ours) == len(thesis) and all(map(np.array_equal, ours, thesis))
    own = robot.defaults(THESIS_ROBOT).gait
    return same and all(variant.gait.name == own for variant in experiment.variants.values())


def _numbers(params: robot.RobotParams) -> list[np.ndarray]:
    """Every number of a robot; in single precision, in which all of them can be given."""
    return [np.asarray(leaf, np.float32) for leaf in jax.tree.leaves(eqx.filter(params, eqx.is_array_like))]


@functools.cache
def _numbers_of_the_thesis() -> list[np.ndarray]:
    return _numbers(robot.load(THESIS_ROBOT))


def agreements(experiment: Experiment, table: pl.DataFrame) -> dict[str, tables.Agreement]:
    """Agreement with the thesis of every variant that answers to one of its tables and has a walk."""
    if not is_thesis_experiment(experiment):
        return {}
    start, walked = clock_start(experiment), summary.variants(table)
    return {
        variant: tables.agreement(table.filter(pl.col("variant") == variant), number, start)
        for variant, number in THESIS.items()
        if variant in walked
    }


def agreement_in_words(variant: str, one: tables.Agreement) -> str:
    """An agreement as one line; the robot's assumed numbers were calibrated on the first table."""
    kind = "calibration" if THESIS[variant] == 1 else "grip chosen on it"
    which = f"Table 4.{THESIS[variant]} ({kind}), variant {variant}"
    if not one.compared:
        return f"{which}: no cell of it was run"
    loads = ", ".join(
        f"{quantities.with_unit(load, 'load_kg')} {agree} of {n}"
        for load, agree, n in one.by_load.iter_rows()
    )
    return f"{which}: {one.agree} of {one.compared} cells as printed ({loads})"


def _what(experiment: Experiment, table: pl.DataFrame, varied: list[str]) -> Section:
    gait, options = next(iter(experiment.variants.values())).gait, experiment.simulation
    pads = [step for step in steps_of(table.columns) if (table[f"step_{step}_height_m"] != 0.0).any()]
    lines = [
        f"{experiment.robot.name}, {float(experiment.robot.total_mass):.1f} kg, {type(gait).__name__}, "
        f"{int(gait.timing.n_steps)} steps in {float(gait.duration):.1f} s.",
        f"{table.height} of {experiment.rows} walks: {experiment.table.height} scenarios with each of "
        f"{len(experiment.variants)} variants ({', '.join(experiment.variants)}), all meet the same scenarios.",
        f"Varied: {', '.join(grids.shown(name).label for name in varied) or 'nothing'}."
        + (f" Pads under steps {', '.join(map(str, pads))}." if pads else ""),
        f"Physics ticks of {1e3 * options.dt:g} ms on the {options.contact} ground, by the {options.backend} backend.",
    ]
    return Section("What was walked", tuple(lines))


def _success(experiment: Experiment, table: pl.DataFrame) -> Section:
    names, against = summary.variants(table), []
    for name in names[1:]:
        if not _in_common(table, name, names[0]):
            against.append(f"{name} and {names[0]} have no scenario in common so far.")
            continue
        one = summary.paired(table, name, names[0])
        against.append(
            f"{name} against {names[0]}, on the same {one.n} scenarios: {one.only_first} succeed only with {name}, "
            f"{one.only_second} only with {names[0]}; difference {one.difference:+.1%} "
            f"(95 % interval {one.low:+.1%} to {one.high:+.1%})."
        )
    missing = [name for name in experiment.variants if name not in names]
    unfinished = [f"No walk of {', '.join(missing)} has finished so far."] if missing else []
    words = ("Success by the rule of the paper, with 95 % Wilson intervals.", *unfinished, *against)
    rates = (summary.cells(table),) if names else ()
    return Section("Success", (*words, *_afterwards(table)), rates)


def _in_common(table: pl.DataFrame, variant: str, against: str) -> bool:
    first, second = (
        table.filter(pl.col("variant") == name)["scenario"].to_list() for name in (variant, against)
    )
    return not set(first).isdisjoint(second)


def _afterwards(table: pl.DataFrame) -> list[str]:
    """Lines on walks that met the rule and broke down later, one for each way of breaking down."""
    lines = []
    for status, words in WENT_WRONG.items():
        later = table.filter(pl.col("success") & (pl.col("status") == status))
        by_variant = (
            f"{variant} {n}"
            for variant, n in later.group_by("variant", maintain_order=True).len().iter_rows()
        )
        if later.height:
            lines.append(
                f"{_walks(later.height)} succeeded by the rule and {words} afterwards: {', '.join(by_variant)}."
            )
    return lines


def _walks(n: int) -> str:
    return f"{n} walk" if n == 1 else f"{n} walks"


def _loads(experiment: Experiment, table: pl.DataFrame, start: float) -> Section:
    agreed = agreements(experiment, table)
    marks: Mapping[str, pl.DataFrame] | None = None
    words, texts = ["Load by time of loading."], []
    for walks in table.partition_by("variant", maintain_order=True):
        variant = walks["variant"][0]
        if variant in agreed and agreed[variant].compared:
            texts.append(tables.beside_thesis(walks, THESIS[variant], start))
        else:
            texts.append(tables.tick_table(walks, start))
    words += [f"{agreement_in_words(variant, one)}." for variant, one in agreed.items()]
    if any(one.compared for one in agreed.values()):
        marks = {variant: tables.thesis_table(THESIS[variant]) for variant in agreed}
        words.append("Cells that differ from the printed table are outlined.")
    offset = start or None  # a gait whose clock starts with the walk has no clock of its own
    axes = {"x": "load_kg", "y": "load_time_s", "offset_s": offset}
    limits = summary.frontier(table)
    pictures = (
        Picture(grids.heat_map(table, title="Success", marks=marks, **axes), "Success of every cell."),
        Picture(
            grids.heat_map(table, title="Trunk pitch", value="peak_pitch_deg", **axes), "Largest trunk pitch."
        ),
        Picture(
            grids.frontier_figure(limits, "Largest load that is survived", offset_s=offset),
            "Success frontier: up to which load at least 95 % and 50 % of the walks succeed.",
        ),
    )
    said, listed = _limits(limits, "load_kg")
    return Section("Loads", (*words, *said), (*texts, *listed), pictures)


def _limits(limits: pl.DataFrame, what: str) -> tuple[list[str], list[pl.DataFrame]]:
    """Limits of `summary.frontier` with their intervals, in words and as a table; nothing where nothing is sure."""
    told = limits.filter(pl.col("low").is_not_null() | pl.col("high").is_not_null())
    if told.is_empty():
        return ["Too few walks at each value to say how sure the limits are."], []
    listed = told.head(LISTED)
    words = [
        "Limits: the largest value up to which the success rate stays at the level. By Wilson's 95 % intervals of the "
        "rates it is sure to reach the one below “sure”, and sure not to reach the one below “too much”; a dash: none "
        "of those tested."
    ]
    if told.height > listed.height:
        words.append(_first(listed.height, told.height, "limits"))
    names = {what: "limit", "low": "sure", "high": "too much"}
    columns = [
        pl.Series(name, [quantities.with_unit(v, what) for v in listed[column]], pl.String)
        for column, name in names.items()
    ]
    return words, [listed.drop(*names, "beyond").with_columns(columns)]


def _heights(table: pl.DataFrame, name: str) -> Section:
    one = grids.cells_figure(table, name, "Success and peak foot force")
    words, limits = _limits(summary.frontier(table, name, None, signed=True), name)
    picture = Picture(one, "Success with Wilson intervals.")
    return Section(f"Heights: {grids.shown(name).label}", tuple(words), tuple(limits), (picture,))


def _causes(table: pl.DataFrame) -> Section:
    found = summary.causes(table)
    words = (
        "Which input explains failures most: the mutual information between success and each input alone, corrected "
        "for the number of walks.",
    )
    picture = Picture(grids.causes_figure(found, "What explains failures"), "In bits; 0 explains nothing.")
    listed = found.head(LISTED)
    ends = [
        pl.Series(
            end, [quantities.with_unit(v, name) for v, name in zip(listed[end], listed["input"], strict=True)]
        )
        for end in ("lowest_to", "highest_from")
    ]
    more = (_first(listed.height, found.height, "inputs"),) if found.height > listed.height else ()
    return Section("Causes", (*words, *more), (listed.with_columns(ends),), (picture,))


def _failures(table: pl.DataFrame, varied: Sequence[str], folder: Path | None) -> Section:
    failed = failing(table)
    lost = int((~failed["success"]).sum())
    words = [f"{lost} of {_walks(table.height)} {'is' if lost == 1 else 'are'} no success by the rule."]
    words += _afterwards(table)
    listed = failed.head(LISTED)
    if failed.height > listed.height:
        words.append(_first(listed.height, failed.height, "walks"))
    shown = [name for name in (*SHOWN, *varied) if name in table.columns]
    commands = pl.Series(COMMAND, [replay_command(folder, row) for row in listed["row"]], pl.String)
    rows = listed.select(list(dict.fromkeys(shown))).with_columns(commands)
    return Section("Walks that fail", tuple(words), (rows,))


def replay_command(folder: Path | None, row: int) -> str:
    """The command that runs one row of a table again.

    Args:
        folder: where the table is; None for the word FOLDER.
        row: its number.
    """
    place = "FOLDER" if folder is None else str(folder)
    # A name that begins with a dash would be read as an option.
    place = f"./{place}" if place.startswith("-") else place
    return f"jaxbiped replay {shlex.quote(place)} {row}"


def _first(listed: int, n: int, what: str) -> str:
    return f"The first {listed} of {n} {what} are listed."

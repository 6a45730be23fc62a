"""What the page of a table says: which walks fail and how to run them again, what the thesis has to do with it."""

import dataclasses
import functools
import math
import shlex
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest

from jaxbiped import batch, planner, robot
from jaxbiped.adapt import Controller
from jaxbiped.report import overview, page, tables

VARIANTS = ("off", "original", "modified")
T_INI = float(np.float32(1.2))


@functools.cache
def cosine() -> planner.CosineGait:
    return planner.CosineGait.preset(robot.load("elkahlout"), 3)


@functools.cache
def polynomial() -> planner.PolynomialGait:
    return planner.PolynomialGait.preset(robot.load("surena3"), 3)


def experiment(
    scenarios: pl.DataFrame, variants: tuple[str, ...] = VARIANTS, params: Any = None, gait: Any = None
) -> batch.Experiment:
    params, gait = params or robot.load("elkahlout"), gait or cosine()
    return batch.Experiment(params, {variant: Controller(gait) for variant in variants}, scenarios)


def loads(*masses: float, times: tuple[float, ...]) -> pl.DataFrame:
    return batch.grid(load_kg=list(masses), load_time_s=[T_INI + time for time in times])


def results(one: batch.Experiment, **changes: Any) -> pl.DataFrame:
    """A table as if every walk had succeeded; a change is a value for all rows or a list with one for each."""
    scenarios = one.table.with_row_index("scenario").with_columns(pl.col("scenario").cast(pl.Int64))
    table = pl.concat(
        [scenarios.with_columns(variant=pl.lit(variant)) for variant in one.variants]
    ).with_row_index("row")
    outcome: dict[str, Any] = {
        **{"status": "ok", "success": True, "finished": True, "end_time_s": 9.0, "reflexes": 0},
        **{"trigger_s": None, "peak_roll_deg": 1.0, "peak_pitch_deg": 2.0, "zmp_margin_m": -6.035e-08},
        **{"peak_force_left_N": 900.0, "peak_force_right_N": 800.0},
        **changes,
    }
    columns = [
        pl.Series(name, value if isinstance(value, list) else [value] * table.height)
        for name, value in outcome.items()
    ]
    first = table.select(pl.col("row").cast(pl.Int64), "variant", pl.exclude("row", "variant"))
    return first.with_columns(columns)


def section(sections: list[page.Section], heading: str) -> page.Section:
    (found,) = [one for one in sections if one.heading == heading]
    return found


def headings(sections: list[page.Section]) -> list[str]:
    return [one.heading for one in sections]


def words(one: page.Section) -> str:
    return " ".join(one.paragraphs)


def frame(one: page.Section) -> pl.DataFrame:
    (table,) = one.tables
    assert isinstance(table, pl.DataFrame)
    return table


# Walks that fail

STATUSES = ["ok", "fell", "airborne", "nonfinite", "unfinished", "fell", "ok"]
SUCCESSES = [True, True, True, True, False, False, False]


@pytest.fixture(scope="module")
def mixed() -> tuple[batch.Experiment, pl.DataFrame]:
    """Seven walks of one variant: every status there is, as a success and not."""
    one = experiment(pl.DataFrame({"friction": [0.1 * i for i in range(2, 9)]}), ("modified",))
    return one, results(one, status=STATUSES, success=SUCCESSES)


def test_every_walk_that_is_no_success_or_broke_down_is_listed(mixed):
    failures = section(overview.sections(*mixed), "Walks that fail")
    rows = frame(failures)
    assert rows["row"].to_list() == [1, 2, 3, 4, 5, 6]
    assert rows["status"].to_list() == STATUSES[1:] and rows["success"].to_list() == SUCCESSES[1:]
    assert "friction" in rows.columns
    assert "3 of 7 walks are no success by the rule" in words(failures)


def test_walks_that_fell_after_their_success_are_counted_where_success_is(mixed):
    sections = overview.sections(*mixed)
    for heading in ("Success", "Walks that fail"):
        said = words(section(sections, heading))
        assert "1 walk succeeded by the rule and fell afterwards: modified 1." in said
        assert "1 walk succeeded by the rule and was airborne afterwards: modified 1." in said
        assert "1 walk succeeded by the rule and came to numbers that are not finite afterwards" in said


def test_walks_that_fell_afterwards_are_counted_by_variant():
    one = experiment(pl.DataFrame({"friction": [0.4, 0.8]}))
    sections = overview.sections(one, results(one, status=["fell", "fell", "ok", "ok", "fell", "ok"]))
    said = "3 walks succeeded by the rule and fell afterwards: off 2, modified 1."
    assert said in words(section(sections, "Success"))
    assert "0 of 6 walks are no success" in words(section(sections, "Walks that fail"))


def test_where_all_is_well_nothing_is_said_of_failures():
    one = experiment(pl.DataFrame({"friction": [0.4, 0.8]}))
    sections = overview.sections(one, results(one))
    assert headings(sections) == ["What was walked", "Success"]
    said = "Physics ticks of 0.5 ms on the compliant ground, by the xla backend."
    assert said in words(section(sections, "What was walked"))
    assert "afterwards" not in words(section(sections, "Success"))


@pytest.mark.parametrize("folder", ["runs/payload", "runs/a b; rm -rf 'x' $HOME", "-odd", "/abs/ü"])
def test_every_listed_walk_has_the_command_that_runs_it_again(mixed, folder):
    rows = frame(section(overview.sections(*mixed, folder=Path(folder)), "Walks that fail"))
    for row, command in rows.select("row", overview.COMMAND).iter_rows():
        program, verb, place, number = shlex.split(command)
        assert (program, verb, number) == ("jaxbiped", "replay", str(row))
        assert Path(place) == Path(folder) and not place.startswith("-")


def test_without_a_folder_the_command_says_folder(mixed):
    rows = frame(section(overview.sections(*mixed), "Walks that fail"))
    assert rows[overview.COMMAND].to_list() == [f"jaxbiped replay FOLDER {i}" for i in range(1, 7)]


@pytest.mark.parametrize(("more", "said"), [(0, False), (5, True)])
def test_it_is_said_when_more_walks_fail_than_are_listed(more, said):
    n = overview.LISTED + more
    one = experiment(pl.DataFrame({"friction": np.linspace(0.2, 0.9, n)}), ("off",))
    failures = section(overview.sections(one, results(one, status="fell", success=False)), "Walks that fail")
    assert frame(failures).height == overview.LISTED
    assert (f"The first {overview.LISTED} of {n} walks are listed." in words(failures)) is said


def test_headings_say_what_they_are_about(mixed):
    assert all(h.startswith("Payload: ") for h in headings(overview.sections(*mixed, about="Payload: ")))


# The thesis


def test_the_thesis_robot_is_known_by_its_numbers():
    scenarios, preset = pl.DataFrame({"friction": [0.4]}), robot.load("elkahlout")
    assert overview.is_thesis_experiment(experiment(scenarios))
    assert overview.is_thesis_experiment(
        experiment(scenarios, params=dataclasses.replace(preset, name="my_robot"))
    )
    heavier = eqx.tree_at(lambda p: p.links.mass, preset, 1.001 * preset.links.mass)
    assert heavier.name == "elkahlout"
    assert not overview.is_thesis_experiment(experiment(scenarios, params=heavier))
    assert not overview.is_thesis_experiment(experiment(scenarios, params=robot.load("surena3")))
    assert not overview.is_thesis_experiment(experiment(scenarios, gait=polynomial()))


def test_numbers_of_another_precision_are_the_same_numbers(x64):
    preset = robot.load("elkahlout")
    for kind in (jnp.float32, jnp.float64):
        params = jax.tree.map(lambda leaf, kind=kind: jnp.asarray(leaf, kind), preset)
        assert np.array_equal(overview._numbers(params)[1], overview._numbers_of_the_thesis()[1])
        assert all(map(np.array_equal, overview._numbers(params), overview._numbers_of_the_thesis()))


def test_only_rows_and_loads_that_were_run_stand_beside_the_thesis():
    one = experiment(loads(5.0, 15.0, times=(0.3, 1.2)))
    (part, *_) = [s for s in overview.sections(one, results(one)) if s.heading == "Loads"]
    assert len(part.tables) == 3
    for text in part.tables:
        assert isinstance(text, str)
        lines = text.splitlines()
        assert lines[2].split() == ["load", "[kg]", "5.0", "15.0", "|", "5.0", "15.0"]
        assert [line.split()[0] for line in lines[4:]] == ["0.3", "1.2"]
        assert "cells were not run" in lines[0]
    assert "outlined" in words(part)


def test_where_nothing_compares_one_line_says_so():
    one = experiment(loads(3.0, 4.0, times=(0.35, 1.25)))
    table = results(one)
    part = section(overview.sections(one, table), "Loads")
    assert "Table 4.1 (calibration), variant off: no cell of it was run." in part.paragraphs
    assert "outlined" not in words(part) and "0 of 0" not in words(part)
    assert all(isinstance(text, str) and "|" not in text and "0.35" in text for text in part.tables)
    agreed = overview.agreements(one, table)["modified"]
    assert agreed.compared == 0
    assert overview.agreement_in_words("modified", agreed).endswith("no cell of it was run")


def test_limits_stand_beside_how_sure_they_are():
    """Twelve walks at each load: 12, 12, 6 and 0 succeed; rates of 76, 25 and 0 % at least, 75 and 24 % at most."""
    table = pl.concat([loads(2.0, 4.0, 6.0, 8.0, times=(0.3,))] * 12)
    one = experiment(table, ("off",))
    kg = one.table["load_kg"].to_numpy()
    success = [bool(load < 6.0 or (load == 6.0 and i < 24)) for i, load in enumerate(kg)]
    part = section(overview.sections(one, results(one, success=success)), "Loads")
    (limits,) = [each for each in part.tables if isinstance(each, pl.DataFrame)]
    assert limits.select("level", "limit", "sure", "too much").rows() == [
        (0.95, "4 kg", "–", "6 kg"),
        (0.5, "6 kg", "4 kg", "8 kg"),
    ]
    assert "Wilson" in words(part) and page.page("Loads", [part])
    part = section(overview.sections(one, results(one)), "Loads")  # all succeed: nothing is too much
    (limits,) = [each for each in part.tables if isinstance(each, pl.DataFrame)]
    assert limits.select("level", "limit", "sure", "too much").rows() == [(0.5, "8 kg", "8 kg", "–")]


def test_limits_of_single_walks_are_not_said_to_be_sure():
    one = experiment(loads(2.0, 4.0, times=(0.3, 0.4)), ("off",))
    part = section(overview.sections(one, results(one)), "Loads")
    assert "Too few walks at each value" in words(part)
    assert all(isinstance(text, str) for text in part.tables)


def test_another_robot_has_nothing_to_do_with_the_thesis():
    preset = robot.load("elkahlout")
    other = eqx.tree_at(lambda p: p.height, preset, preset.height + 0.1)
    one = experiment(loads(5.0, 15.0, times=(0.3, 1.2)), params=other)
    part = section(overview.sections(one, results(one)), "Loads")
    assert "thesis" not in " ".join([*part.paragraphs, *map(str, part.tables)])
    assert overview.agreements(one, results(one)) == {}


def test_the_clock_is_the_thesis_only_where_a_gait_has_one():
    for gait, params, clocked in ((cosine(), None, True), (polynomial(), robot.load("surena3"), False)):
        one = experiment(loads(5.0, 15.0, times=(0.3, 1.2)), ("off",), params, gait)
        part = section(overview.sections(one, results(one)), "Loads")
        figure: Any = part.figures[0].figure
        assert ("clock" in figure.axes[0].get_ylabel()) is clocked


# Tables of all kinds


KINDS = (
    *("one load", "one time", "one cell", "one row", "no row", "nothing varied", "a variant without a walk"),
    *("variants without a scenario in common", "no walk of a variant finished", "no numbers", "infinite"),
    *("pads without numbers", "pads", "drawn", "loads that never come"),
)


@functools.cache
def odd_tables() -> dict[str, tuple[batch.Experiment, pl.DataFrame]]:
    grid = experiment(loads(2.5, 5.0, times=(0.3, 1.2)))
    single_load = experiment(loads(5.0, times=(0.3, 1.2, 2.0)))
    single_time = experiment(loads(2.5, 5.0, 15.0, times=(0.3,)))
    cell = experiment(loads(5.0, times=(0.3,)), ("off",))
    nothing = experiment(pl.DataFrame({"friction": [0.8]}))
    rng = np.random.default_rng(0)
    drawn = experiment(
        pl.DataFrame(
            {
                "load_kg": rng.uniform(1.0, 9.0, 80),
                "load_time_s": rng.uniform(1.0, 5.0, 80),
                "friction": rng.uniform(0.2, 0.9, 80),
            }
        ),
        ("a",),
    )
    heights = {"step_1_height_m": [-0.02, 0.03], "friction": [0.4, 0.8], "com_x_m": [0.0, 0.01]}
    pads = experiment(pl.DataFrame(heights), ("off", "landing"), robot.load("surena3"), polynomial())
    unloaded = experiment(pl.DataFrame({"load_kg": [0.0, 5.0], "load_time_s": [batch.NEVER, batch.NEVER]}))
    broken = {"success": False, "status": "nonfinite", "finished": False}
    empty = {f"peak_{one}": math.nan for one in ("pitch_deg", "roll_deg", "force_left_N", "force_right_N")}
    some = results(grid, success=[i % 3 == 0 for i in range(12)])
    return {
        "one load": (single_load, results(single_load)),
        "one time": (single_time, results(single_time, success=False, status="fell")),
        "one cell": (cell, results(cell)),
        "one row": (nothing, results(nothing).head(1)),
        "no row": (grid, results(grid).head(0)),
        "nothing varied": (nothing, results(nothing)),
        "a variant without a walk": (grid, some.filter(pl.col("variant") != "original")),
        "variants without a scenario in common": (
            grid,
            some.filter((pl.col("variant") == "off") == (pl.col("scenario") < 2)),
        ),
        "no walk of a variant finished": (
            grid,
            results(grid, finished=False, success=[i >= 4 for i in range(12)], status="unfinished"),
        ),
        "no numbers": (grid, results(grid, **broken, **empty, zmp_margin_m=math.nan, end_time_s=math.nan)),
        "infinite": (grid, results(grid, **broken, peak_pitch_deg=math.inf, zmp_margin_m=-math.inf)),
        "pads without numbers": (pads, results(pads, **broken, **empty)),
        "pads": (pads, results(pads)),
        "drawn": (drawn, results(drawn, success=[i % 2 == 0 for i in range(80)])),
        "loads that never come": (unloaded, results(unloaded)),
    }


@pytest.mark.parametrize("kind", KINDS)
def test_a_page_can_be_made_of_any_table(kind, tmp_path: Path):
    assert set(odd_tables()) == set(KINDS)
    one, table = odd_tables()[kind]
    sections = overview.sections(one, table, folder=tmp_path)
    assert headings(sections)[:2] == ["What was walked", "Success"]
    file = page.write_page(tmp_path / "report.html", kind, sections)
    said = file.read_text(encoding="utf-8")
    for cell in said.split("<td")[1:]:
        text = cell.partition(">")[2].partition("<")[0]
        assert text not in ("nan", "inf", "-inf", "None", "-0", "-0.0000") and "e-" not in text


def test_one_load_or_one_time_makes_a_grid_and_other_inputs_do_not():
    tables = odd_tables()
    for kind, wanted in {"one load": True, "one time": True, "one cell": True, "drawn": False}.items():
        _, table = tables[kind]
        assert overview.grid_of_loads(table, overview.varying(table)) is wanted, kind
    for kind in ("nothing varied", "pads", "loads that never come", "no row"):
        assert "Loads" not in headings(overview.sections(*tables[kind])), kind
    fixed = experiment(
        pl.DataFrame({"load_kg": [5.0, 5.0], "load_time_s": [2.0, 2.0], "friction": [0.4, 0.8]})
    )
    assert "Loads" not in headings(overview.sections(fixed, results(fixed)))


def test_what_has_not_finished_is_said():
    one, table = odd_tables()["a variant without a walk"]
    assert (
        "No walk of original has finished so far."
        in section(overview.sections(one, table), "Success").paragraphs
    )
    assert set(overview.agreements(one, table)) == {"off", "modified"}
    apart = section(overview.sections(*odd_tables()["variants without a scenario in common"]), "Success")
    assert "modified and off have no scenario in common so far." in apart.paragraphs


def test_causes_are_told_in_units():
    one, table = odd_tables()["pads"]
    causes = frame(section(overview.sections(one, table), "Causes"))
    ends = {row["input"]: (row["lowest_to"], row["highest_from"]) for row in causes.iter_rows(named=True)}
    assert ends["step_1_height_m"] == ("-20 mm", "30 mm")
    assert ends["friction"] == ("0.4", "0.8")


def test_thesis_tables_are_those_of_the_variants():
    assert set(overview.THESIS.values()) == set(tables.THESIS_TABLES)

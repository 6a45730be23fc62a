"""The thesis' tables as printed, ours beside them, and figures whose cells, curves and bars are the table's numbers."""

import itertools
import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import polars as pl
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from jaxbiped.batch import NEVER, summary
from jaxbiped.report import figures, grids, tables

T_INI = float(np.float32(1.2))
VARIANTS = {"none": 1, "original": 2, "modified": 3}
LOADS = (2.5, 5.0, 7.5, 10.0, 12.5, 15.0)
FLIPPED = {("original", 1.0, 5.0), ("original", 3.1, 5.0), ("modified", 0.1, 15.0)}
"""Cells that come out otherwise than printed; one of them was not printed."""


def as_printed(variant: str) -> dict[tuple[float, float], bool]:
    return {(t, load): s for load, t, s in tables.thesis_table(VARIANTS[variant]).iter_rows()}


def walk(variant: str, time: float, load: float, success: bool, **more) -> dict:
    at = float(np.float32(time + T_INI))  # as a simulation in single precision tells it
    return {
        "variant": variant,
        "load_time_s": at,
        "load_kg": load,
        "success": success,
        "peak_pitch_deg": load + time,
        **more,
    }


@pytest.fixture(scope="module")
def table() -> pl.DataFrame:
    """Every variant as in the thesis, but for the flipped cells; what is not printed succeeds; and an unloaded walk."""
    rows = []
    for variant in VARIANTS:
        printed = as_printed(variant)
        for i in range(48 * 6):
            time, load = round(0.1 * (i // 6 + 1), 1), LOADS[i % 6]
            said = printed.get((time, load), True)
            rows.append(walk(variant, time, load, said != ((variant, time, load) in FLIPPED), scenario=i))
        rows.append(walk(variant, 0.0, 0.0, True, scenario=288) | {"load_time_s": 1e6})
    return pl.DataFrame(rows).sample(fraction=1.0, shuffle=True, seed=2).sort("variant", descending=True)


def only(table: pl.DataFrame, variant: str) -> pl.DataFrame:
    return table.filter(pl.col("variant") == variant)


def mesh(figure: Figure, variant: str) -> np.ndarray:
    (axes,) = [axes for axes in figure.axes if axes.get_title("left") == variant]
    (drawn,) = [c for c in axes.collections if isinstance(c, QuadMesh)]
    return np.ma.filled(np.ma.asarray(drawn.get_array(), dtype=float), np.nan)


def outlined(figure: Figure, variant: str) -> set[tuple[int, int]]:
    (axes,) = [axes for axes in figure.axes if axes.get_title("left") == variant]
    corners = [patch.get_xy() for patch in axes.patches if isinstance(patch, Rectangle)]
    return {(math.floor(x), math.floor(y)) for x, y in corners}


def test_thesis_tables_are_as_printed():
    sizes = {number: tables.thesis_table(number) for number in tables.THESIS_TABLES}
    assert [(t.height, t["success"].sum()) for t in sizes.values()] == [(288, 48), (282, 268), (288, 284)]
    for table in sizes.values():
        assert table.schema == {"load_kg": pl.Float64, "time_s": pl.Float64, "success": pl.Boolean}
        assert tuple(table["load_kg"].unique().sort()) == LOADS
    assert sizes[1].filter("success")["load_kg"].unique().to_list() == [2.5]
    times = sizes[2].filter(pl.col("load_kg") == 5.0)["time_s"].to_list()
    assert times.count(3.2) == 2 and 3.1 not in times and 4.1 not in times and times == sorted(times)
    assert as_printed("original")[1.6, 12.5] and not as_printed("original")[1.6, 15.0]
    with pytest.raises(ValueError, match=r"4\.4"):
        tables.thesis_table(4)


def test_tick_table_is_the_thesis_form(table):
    lines = tables.tick_table(only(table, "none"), T_INI).splitlines()
    assert lines[0] == "variant none"
    assert lines[1].split() == ["load", "[kg]", "2.5", "5.0", "7.5", "10.0", "12.5", "15.0"]
    assert len(lines) == 3 + 48
    for k, line in enumerate(lines[3:], 1):
        assert line.split() == [f"{0.1 * k:.1f}", tables.TICK, *5 * [tables.CROSS]]


def test_tick_table_shows_shares_and_gaps():
    rows = [walk("a", 0.1, 5.0, i < 3) for i in range(4)] + [walk("a", 0.25, 10.0, True)]
    lines = tables.tick_table(pl.DataFrame(rows), T_INI).splitlines()
    assert lines[3].split() == ["0.1", "75%", tables.NOT_RUN]
    assert lines[4].split() == ["0.25", tables.NOT_RUN, tables.TICK]
    assert lines[3].index("75%") + 2 == lines[1].index("5.0") + 2 == lines[4].index(tables.NOT_RUN)


def test_tables_of_text_are_of_one_variant(table):
    for write in (
        tables.tick_table,
        lambda t, o: tables.beside_thesis(t, 2, o),
        lambda t, o: tables.agreement(t, 2, o),
    ):
        with pytest.raises(ValueError, match="one variant"):
            write(table, T_INI)


def test_beside_thesis_marks_what_differs(table):
    lines = tables.beside_thesis(only(table, "original"), 2, T_INI).splitlines()
    assert "Table 4.2" in lines[0] and "the grip was chosen on it" in lines[0] and "275 of 276" in lines[0]
    rows = [line for line in lines[4:] if line]
    assert len(rows) == 49  # 48 times of ours, one of which was printed twice
    starred = [line for line in rows if tables.DIFFERS in line]
    assert len(starred) == 1 and starred[0].split()[0] == "1.0"
    assert starred[0].split()[2] == tables.CROSS + tables.DIFFERS
    alone = next(line for line in rows if line.split()[0] == "3.1")
    assert alone.split("|")[0].split()[2] == tables.CROSS
    assert alone.split("|")[1].split() == 6 * [tables.NOT_RUN]
    assert sum(line.split()[0] == "3.2" for line in rows) == 2
    assert len({line.index("|") for line in rows}) == 1
    assert "calibration" in tables.beside_thesis(only(table, "none"), 1, T_INI).splitlines()[0]
    assert "not run" not in lines[0]


def test_beside_thesis_shows_what_was_run_and_counts_what_was_not():
    """Two times and two loads, one of each not in the thesis, and a load that never comes."""
    rows = [walk("a", time, load, load < 4.0) for time in (0.3, 0.35) for load in (3.0, 5.0)]
    rows.append(walk("a", 0.0, 7.5, True) | {"load_time_s": NEVER})
    lines = tables.beside_thesis(pl.DataFrame(rows), 2, T_INI).splitlines()
    assert "1 cells agree" in lines[0] and "275 of the thesis' 276 cells were not run" in lines[0]
    assert lines[2].split() == ["load", "[kg]", "3.0", "5.0", "|", "3.0", "5.0"]
    assert [line.split() for line in lines[4:]] == [
        ["0.3", tables.TICK, tables.CROSS + said_of_5_kg(), "|", tables.NOT_RUN, printed_of_5_kg()],
        ["0.35", tables.TICK, tables.CROSS, "|", tables.NOT_RUN, tables.NOT_RUN],
    ]


def printed_of_5_kg() -> str:
    return tables.TICK if as_printed("original")[0.3, 5.0] else tables.CROSS


def said_of_5_kg() -> str:
    return tables.DIFFERS if as_printed("original")[0.3, 5.0] else ""


def test_beside_thesis_says_in_one_line_that_nothing_compares():
    said = tables.beside_thesis(pl.DataFrame([walk("a", 0.35, 5.0, True)]), 3, T_INI)
    assert said == "variant a: no cell of Table 4.3, modified reflex (the grip was chosen on it), was run"


def test_a_load_that_never_comes_is_not_in_the_tables():
    rows = [walk("a", 0.1, 5.0, True), walk("a", 0.0, 5.0, False) | {"load_time_s": NEVER}]
    assert len(tables.tick_table(pl.DataFrame(rows), T_INI).splitlines()) == 4


def test_agreement_counts_by_load(table):
    same = tables.agreement(only(table, "none"), 1, T_INI)
    assert same[:2] == (288, 288)
    assert same.by_load["agree"].to_list() == 6 * [48]
    other = tables.agreement(only(table, "original"), 2, T_INI)
    assert other[:2] == (275, 276)
    assert other.by_load.rows() == [(load, 45 if load == 5.0 else 46, 46) for load in LOADS]
    nothing = tables.agreement(only(table, "none"), 1, T_INI + 0.05)
    assert nothing[:2] == (0, 0) and nothing.by_load.is_empty()
    # every cell of the calibration against the prediction: what succeeds there falls here
    crossed = tables.agreement(only(table, "none"), 3, T_INI)
    assert crossed[:2] == (48 + 4, 288)


def test_agreement_goes_by_the_majority():
    def agrees(wins: int) -> int:
        return tables.agreement(
            pl.DataFrame([walk("a", 0.1, 2.5, i < wins) for i in range(4)]), 1, T_INI
        ).agree

    assert [agrees(wins) for wins in range(5)] == [0, 0, 0, 1, 1]


@pytest.mark.parametrize("turned", [False, True])
def test_heat_map_shows_every_cell_and_outlines_what_differs(table, turned):
    marks = {
        variant: tables.thesis_table(number) for variant, number in VARIANTS.items() if variant != "modified"
    }
    sides = ("load_kg", "load_time_s") if turned else ("load_time_s", "load_kg")
    loaded = table.filter(pl.col("load_kg") > 0)
    figure = grids.heat_map(loaded, *sides, "Payloads", marks, offset_s=T_INI)
    for variant in VARIANTS:
        cells = mesh(figure, variant).T if turned else mesh(figure, variant)
        assert cells.shape == (6, 48)
        for row in only(loaded, variant).iter_rows(named=True):
            time = round(10 * (row["load_time_s"] - T_INI)) - 1
            assert cells[LOADS.index(row["load_kg"]), time] == row["success"]
    assert outlined(figure, "none") == set()
    assert outlined(figure, "original") == {(1, 9) if turned else (9, 1)}
    assert outlined(figure, "modified") == set()  # has no table to differ from
    labels = [axes.get_xlabel() + axes.get_ylabel() for axes in figure.axes]
    assert any("thesis' clock [s]" in label for label in labels)
    assert any("load [kg]" in label for label in labels)


def test_heat_map_takes_one_table_for_all_variants(table):
    loaded = table.filter(pl.col("load_kg") > 0)
    figure = grids.heat_map(loaded, "load_time_s", "load_kg", "", tables.thesis_table(3), offset_s=T_INI)
    assert outlined(figure, "modified") == {(0, 5)}
    assert len(outlined(figure, "none")) == 284 - 48


def test_heat_map_needs_the_thesis_axes_for_marks(table):
    printed = tables.thesis_table(1)
    for x, y, offset in (("load_time_s", "peak_pitch_deg", T_INI), ("load_time_s", "load_kg", None)):
        with pytest.raises(ValueError, match="marks need"):
            grids.heat_map(table, x, y, "", printed, offset_s=offset)
    with pytest.raises(ValueError, match="none"):
        grids.heat_map(table.head(0), "load_time_s", "load_kg", "")


def test_heat_map_of_a_column_is_its_mean_and_leaves_gaps_gray():
    rows = [
        walk("a", 0.1, 5.0, True) | {"peak_pitch_deg": 2.0},
        walk("a", 0.1, 5.0, True) | {"peak_pitch_deg": 5.0},
        walk("a", 0.1, 5.0, False) | {"peak_pitch_deg": math.nan},
        walk("a", 0.2, 5.0, False) | {"peak_pitch_deg": math.inf},
        walk("a", 0.2, 10.0, True) | {"peak_pitch_deg": 1.0},
    ]
    figure = grids.heat_map(pl.DataFrame(rows), "load_time_s", "load_kg", "", value="peak_pitch_deg")
    np.testing.assert_array_equal(mesh(figure, "a"), [[3.5, math.nan], [math.nan, 1.0]])
    assert figure.axes[-1].get_ylabel() == "mean peak pitch [deg]"
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["not run, or no number"]


def test_heat_map_cuts_what_was_drawn_at_random():
    rng, n = np.random.default_rng(0), 3_000
    load = rng.uniform(0.0, 16.0, n)
    columns = {
        "variant": ["a"] * n,
        "load_kg": load,
        "friction": rng.choice([0.4, 0.8], n),
        "success": load < 7.0,
    }
    figure = grids.heat_map(pl.DataFrame(columns), "load_kg", "friction", "")
    cells = mesh(figure, "a")
    assert cells.shape == (2, grids.PARTS)
    np.testing.assert_allclose(cells, np.tile(np.arange(16) < 7, (2, 1)), atol=0.1)


@pytest.fixture(scope="module")
def obstacles() -> pl.DataFrame:
    rng, rows = np.random.default_rng(1), []
    for variant, most in (("none", 0.01), ("landing", 0.03)):
        for height in (-0.02, -0.01, 0.0, 0.01, 0.02, 0.04):
            for friction in (0.4, 0.8):
                for _ in range(10):
                    force = 800.0 + 4e4 * abs(height) + rng.normal(0, 20)
                    row = {
                        "variant": variant,
                        "step_2_height_m": height,
                        "friction": friction,
                        "success": abs(height) <= most,
                    }
                    rows.append(row | {"peak_force_left_N": force, "peak_force_right_N": force - 50.0})
    return pl.DataFrame(rows).with_columns(scenario=pl.int_range(pl.len()))


def points(axes, color: str) -> list[tuple[float, float]]:
    lines = [line for line in axes.get_lines() if to_hex(line.get_color()) == to_hex(color)]
    return [(x, y) for line in lines for x, y in zip(line.get_xdata(), line.get_ydata(), strict=True)]


def test_cells_figure_shows_rates_and_the_larger_force(obstacles):
    figure = grids.cells_figure(obstacles, "step_2_height_m", "Obstacles")
    above, below = figure.axes
    assert below.get_xlabel() == "height under foothold 2 [mm]"
    rates = summary.cells(obstacles, ["step_2_height_m"])
    for variant, color in (("none", figures.BLUE), ("landing", figures.ORANGE)):
        wanted = rates.filter(pl.col("variant") == variant)
        drawn = points(above, color)[:6]
        np.testing.assert_array_equal([x for x, _ in drawn], 1e3 * wanted["step_2_height_m"].to_numpy())
        np.testing.assert_allclose([y for _, y in drawn], wanted["rate"])
        left = (
            only(obstacles, variant).group_by("step_2_height_m", maintain_order=True).agg("peak_force_left_N")
        )
        means = left["peak_force_left_N"].list.mean()
        np.testing.assert_allclose([y for _, y in points(below, color)[:6]], means)
        bars = [segment[:, 1] for c in below.collections for segment in c.get_segments()]  # pyright: ignore
        assert any(np.allclose(bar, (min(left.item(0, 1)), max(left.item(0, 1)))) for bar in bars)


def look(axes, variant: int) -> list[tuple[float, float, str]]:
    """Width, size of the markers and their filling of the lines of a variant."""
    color = (figures.BLUE, figures.ORANGE, figures.GREEN)[variant]
    lines = [one for one in axes.get_lines() if to_hex(one.get_color()) == to_hex(color)]
    lines = [one for one in lines if one.get_marker() != "_"]  # but the ends of error bars
    return [(one.get_linewidth(), one.get_markersize(), one.get_markerfacecolor()) for one in lines]


def test_variants_that_coincide_are_told_apart(obstacles):
    """They stand on each other, each narrower and smaller than the one under it, and none is filled."""
    one = only(obstacles, "none")
    alike = pl.concat([one.with_columns(variant=pl.lit(variant)) for variant in ("a", "b", "c")])
    limits = summary.frontier(alike, "step_2_height_m", "friction", signed=True)
    drawn = grids.cells_figure(alike, "step_2_height_m", "Alike").axes
    drawn += grids.frontier_figure(limits, "Alike", "step_2_height_m", "friction").axes
    for axes in drawn:
        looks = [look(axes, variant) for variant in range(3)]
        for below, above in itertools.pairwise(looks):
            assert all(w > v + 0.5 and s > t + 1.0 for (w, s, _), (v, t, _) in zip(below, above, strict=True))
        assert {fill for of_variant in looks for *_, fill in of_variant} == {"none"}
        orders = [
            [line.get_zorder() for line in axes.get_lines() if to_hex(line.get_color()) == to_hex(c)]
            for c in (figures.BLUE, figures.ORANGE, figures.GREEN)
        ]
        assert max(orders[0]) < min(orders[1]) and max(orders[1]) < min(orders[2])
        np.testing.assert_array_equal(points(axes, figures.BLUE), points(axes, figures.GREEN))


def test_twelve_variants_have_twelve_looks_that_are_not_too_wide():
    looks = [grids._variant_style(i, 12) for i in range(12)]
    assert len({(one["color"], one["ls"]) for one in looks}) == 12
    assert max(one["lw"] for one in looks) < 10.0 and max(one["ms"] for one in looks) < 21.0


def test_points_of_a_cut_input_stand_at_the_means_of_their_values():
    rng, n = np.random.default_rng(0), 500
    load = rng.uniform(0.0, 16.0, n) ** 2 / 16.0
    force = {name: np.full(n, 900.0) for name in grids.FEET}
    table = pl.DataFrame({"variant": ["a"] * n, "load_kg": load, "success": load < 7.0, **force})
    above, below = grids.cells_figure(table, "load_kg", "Cut").axes
    part = np.minimum((load - load.min()) / (load.max() - load.min()) * grids.PARTS, grids.PARTS - 1).astype(
        int
    )
    means = [load[part == i].mean() for i in range(grids.PARTS)]
    np.testing.assert_allclose([x for x, _ in points(above, figures.BLUE)[: grids.PARTS]], means)
    assert below.get_xlabel() == f"load [kg], in {grids.PARTS} parts"


def test_frontier_figure_shows_limits_and_what_lies_beyond(obstacles):
    limits = summary.frontier(obstacles, "step_2_height_m", "friction", (0.95,), signed=True)
    figure = grids.frontier_figure(limits, "Heights", "step_2_height_m", "friction")
    (axes,) = figure.axes
    assert axes.get_xlabel() == "friction [-]" and "95 %" in axes.get_title("left")
    assert {y for _, y in points(axes, figures.BLUE)} == {10.0, -10.0}
    assert {y for _, y in points(axes, figures.ORANGE)} == {20.0, -20.0}
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert said == ["none", "landing", "held at every value tested"]


def test_frontier_figure_marks_variants_that_fail_at_once(table):
    limits = summary.frontier(table.filter(pl.col("load_kg") >= 5.0), levels=(0.95, 0.5))
    figure = grids.frontier_figure(limits, "Loads", offset_s=T_INI)
    assert len(figure.axes) == 2
    assert figure.axes[-1].get_xlabel() == "time of the load, thesis' clock [s]"
    crosses = [
        line
        for line in figure.axes[0].get_lines()
        if line.get_marker() == "x" and np.size(line.get_xdata()) == 48
    ]
    assert len(crosses) == 1  # the variant without reflex, at every time
    np.testing.assert_allclose(np.asarray(crosses[0].get_xdata()), 0.1 * np.arange(1, 49), atol=1e-6)
    # They have no value: they stand at the panel's edge, under all that has one.
    axes, pixels = figure.axes[0], crosses[0].get_transform().transform(crosses[0].get_xydata())
    assert axes.transData.inverted().transform(pixels)[:, 1].max() < 0.0


def test_limits_stand_at_their_values(table):
    loaded = table.filter(pl.col("load_kg") > 0.0)
    limits = summary.frontier(loaded, levels=(0.95,))
    (axes,) = grids.frontier_figure(limits, "Loads", offset_s=T_INI).axes
    for variant, color in zip(
        summary.variants(limits), (figures.BLUE, figures.ORANGE, figures.GREEN), strict=True
    ):
        wanted = limits.filter(variant=variant).sort("load_time_s").drop_nulls("load_kg")
        drawn = points(axes, color)[: limits.filter(variant=variant).height]
        np.testing.assert_allclose(
            [x for x, y in drawn if np.isfinite(y)], wanted["load_time_s"] - T_INI, atol=1e-6
        )
        np.testing.assert_array_equal([y for _, y in drawn if np.isfinite(y)], wanted["load_kg"])


def test_bars_of_limits_are_their_intervals():
    """30 walks at each load: what is sure, and what is too much; an open end runs to the panel's edge."""
    wins = {1.0: {2.0: 30, 4.0: 30, 6.0: 16, 8.0: 2}, 2.0: {2.0: 30, 4.0: 15, 6.0: 15, 8.0: 15}}
    rows = [
        {"variant": "a", "load_time_s": t, "load_kg": load, "success": i < n}
        for t, cell in wins.items()
        for load, n in cell.items()
        for i in range(30)
    ]
    limits = summary.frontier(pl.DataFrame(rows), levels=(0.5,))
    (axes,) = grids.frontier_figure(limits, "Loads").axes
    (found,) = axes.collections
    bars: Any = found
    top = axes.get_ylim()[1]
    ends = [np.asarray(line)[:, 1].tolist() for line in bars.get_segments()]
    assert ends == [[4.0, 8.0], [2.0, pytest.approx(top)]]
    assert [np.asarray(line)[0, 0] for line in bars.get_segments()] == [1.0, 2.0]


def test_ticks_of_a_map_are_plain_numbers():
    rows = [
        {"variant": "a", "push_x_N": push, "com_y_m": shift, "success": True}
        for push in (-1500.0, 0.0, 12500.0)
        for shift in (-1e-12, 0.0125)
    ]
    (axes, _) = grids.heat_map(pl.DataFrame(rows), "push_x_N", "com_y_m", "").axes
    assert [text.get_text() for text in axes.get_xticklabels()] == ["-1500", "0", "12500"]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["0", "12.5"]


def test_a_map_without_walks_says_so():
    never = pl.DataFrame([walk("a", 0.0, 5.0, True) | {"load_time_s": NEVER}])
    with pytest.raises(ValueError, match="both load_time_s and load_kg"):
        grids.heat_map(never, "load_time_s", "load_kg", "")


def test_causes_figure_has_a_bar_for_every_input(obstacles):
    found = summary.causes(obstacles)
    figure = grids.causes_figure(found, "Causes")
    assert [axes.get_title("left") for axes in figure.axes] == ["none", "landing"]
    for axes, variant in zip(figure.axes, ("none", "landing"), strict=True):
        rows = only(found, variant)
        assert [label.get_text() for label in axes.get_yticklabels()] == [
            "height under foothold 2",
            "friction",
        ]
        widths = [patch.get_width() for patch in axes.patches if isinstance(patch, Rectangle)]
        np.testing.assert_allclose(widths, rows["information_bits"])
        lowest, highest = rows.row(0, named=True)["rate_lowest"], rows.row(0, named=True)["rate_highest"]
        assert axes.texts[0].get_text().strip() == f"{100 * lowest:.0f} % → {100 * highest:.0f} %"


@pytest.mark.parametrize(
    ("column", "label", "factor"),
    [
        ("load_kg", "load [kg]", 1.0),
        ("load_time_s", "time of the load [s]", 1.0),
        ("step_12_height_m", "height under foothold 12 [mm]", 1e3),
        ("com_y_m", "trunk's COM to the left [mm]", 1e3),
        ("push_x_N", "push forward [N]", 1.0),
        ("push_time_s", "push time [s]", 1.0),
        ("damping_s_per_m", "damping of the ground [s/m]", 1.0),
        ("slip_speed_m_per_s", "slip speed [m/s]", 1.0),
        ("angle_noise_rad", "angle noise [deg]", 180.0 / math.pi),
        ("touchdown_impulse_left_Ns", "touchdown impulse left [N s]", 1.0),
        ("leg_mass_scale", "leg mass, factor [-]", 1.0),
        ("friction", "friction [-]", 1.0),
        ("missed", "missed [-]", 1.0),
        ("x_m", "forward, x [m]", 1.0),
        ("slip_left_m", "slip left [mm]", 1e3),
    ],
)
def test_columns_are_labeled_in_words_and_units(column, label, factor):
    assert grids.shown(column) == (label, pytest.approx(factor))


def test_nothing_is_cut_and_nothing_warns(table, obstacles):
    limits = summary.frontier(obstacles, "step_2_height_m", "friction", signed=True)
    draw: list[Callable[[], Figure]] = [
        lambda: grids.heat_map(
            table, "load_time_s", "load_kg", "Wide", tables.thesis_table(2), offset_s=T_INI
        ),
        lambda: grids.heat_map(table, "load_kg", "load_time_s", "Tall", value="peak_pitch_deg"),
        lambda: grids.heat_map(obstacles, "step_2_height_m", "friction", "Small"),
        lambda: grids.frontier_figure(limits, "Heights", "step_2_height_m", "friction"),
        lambda: grids.causes_figure(summary.causes(obstacles), "Causes"),
        lambda: grids.causes_figure(summary.causes(obstacles.head(0)), "No causes"),
        lambda: grids.cells_figure(obstacles, "step_2_height_m", "Obstacles"),
        lambda: grids.cells_figure(
            obstacles.with_columns(pl.lit(math.nan).alias(name) for name in grids.FEET),
            "step_2_height_m",
            "NaN",
        ),
        lambda: grids.heat_map(table.head(1), "load_kg", "load_time_s", "One", value="peak_pitch_deg"),
        lambda: grids.frontier_figure(summary.frontier(table.filter(pl.col("load_kg") < 1.0)), "No limits"),
        lambda: grids.cells_figure(obstacles.filter(step_2_height_m=0.0), "step_2_height_m", "One height"),
    ]
    for one in draw:
        with warnings.catch_warnings(action="error"):
            figure = one()
            figure.draw_without_rendering()
        assert figure.get_suptitle()
        for axes in figure.axes:
            box = axes.get_tightbbox()
            assert box is not None
            assert figure.bbox.x0 - 1 <= box.x0 and box.x1 <= figure.bbox.x1 + 1, figure.get_suptitle()
            assert figure.bbox.y0 - 1 <= box.y0 and box.y1 <= figure.bbox.y1 + 1, figure.get_suptitle()

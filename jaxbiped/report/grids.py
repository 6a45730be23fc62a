"""Tables of walks as a person sees them: maps of success, limits, causes.

Every function takes a table with one row per walk (`jaxbiped.batch`) or what `batch.summary` makes of it. Figures are
matplotlib Figures. The thesis counts time from the middle of a double support: its time is ours less T_ini, which
functions take as `offset_s`.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from jaxbiped.batch import summary
from jaxbiped.report import tables
from jaxbiped.report.figures import BLUE, DPI, GREEN, INK, LEGEND_WIDTH, ORANGE, PURPLE, dress
from jaxbiped.report.quantities import short, shown

FEET = ("peak_force_left_N", "peak_force_right_N")
"""Columns of the largest vertical force on each foot."""
MOST_VALUES, PARTS = 64, 16
"""An input with more values than the first is cut into so many equal parts before it is drawn."""
MOST_CAUSES = 10
"""Inputs shown per variant."""
_VARIANT_COLORS = (BLUE, ORANGE, GREEN, PURPLE, INK, "#E69F00")
_VARIANT_MARKERS = "osDvXP"
_VARIANT_DASHES = ("-", "--", ":", "-.")
_LINE_WIDTH, _MARKER_SIZE = 1.2, 4.5
"""Line width and marker size of the variant in front [pt]."""
_WIDER, _LARGER = 1.3, 3.5
"""Extra line width and marker size of every variant over those of the next one in front of it [pt]."""
_MOST_WIDER, _MOST_LARGER = 6.5, 16.0
"""Largest extra line width and marker size of the variant behind all others over the one in front [pt]."""
_NOT_RUN_FILL = "#d9dce1"
_SUCCESS = LinearSegmentedColormap.from_list("success", [ORANGE, "#f1eee8", BLUE])
_AT_THE_EDGE = 0.03
"""Where crosses stand, as a part of a panel's height."""
_MOST_ROWS_NUMBERED = 16
_TICK_STEPS = (1, 2, 4, 5, 10, 20, 50)
_LETTERS_PER_INCH = 13.0
"""Letters of tick labels that just fit into an inch."""


def heat_map(
    table: pl.DataFrame,
    x: str,
    y: str,
    title: str,
    marks: pl.DataFrame | Mapping[str, pl.DataFrame] | None = None,
    value: str | None = None,
    offset_s: float | None = None,
) -> Figure:
    """Draw the success rate, or the mean of a column, over two inputs: a panel per variant, a cell per pair of values.

    Cells are equally large whatever the steps between values; an input of more than MOST_VALUES values is cut into
    PARTS equal parts. Cells that were not run, or where the column has no finite value, are gray.

    Args:
        table: one row per walk.
        x: input along the horizontal axis.
        y: input along the vertical axis.
        title: heading of the figure.
        marks: a table of the thesis, or one for every variant that has one: cells that differ from it are outlined. The
            axes must be load_kg and load_time_s.
        value: column to draw instead of the success rate, such as peak_pitch_deg.
        offset_s: show load_time_s less this, on the thesis' clock [s]; needed for marks.
    """
    if table.is_empty():
        raise ValueError("a map needs walks; there are none")
    if marks is not None and ({x, y} != {"load_kg", "load_time_s"} or offset_s is None):
        raise ValueError("marks need load_kg and load_time_s as axes, and offset_s")
    table = summary.without_never(table, [x, y]).drop_nulls([x, y])
    if table.is_empty():
        raise ValueError(f"a map needs walks with both {x} and {y}; there are none")
    table = _on_thesis_clock(table, offset_s)
    x_label, y_label = (_clocked(name, offset_s) + _said_parted(table[name]) for name in (x, y))
    table = table.with_columns(_parted(table[x]), _parted(table[y]))
    by_variant = {variant: table.filter(pl.col("variant") == variant) for variant in summary.variants(table)}
    sides = _Sides(x, y, *(table[name].unique().sort().to_list() for name in (x, y)))
    figure, panels, width = _map_panels(len(by_variant), sides, title)
    values = {variant: _map_values(walks, sides, value) for variant, walks in by_variant.items()}
    look = _map_colors(values.values(), value)
    for (variant, walks), axes in zip(by_variant.items(), panels, strict=True):
        axes.pcolormesh(values[variant], edgecolor="white", lw=0.4, **look)
        _dress_map(axes, variant, sides, width)
        printed = marks.get(variant) if isinstance(marks, Mapping) else marks
        if printed is not None:
            _outline(axes, walks, printed, sides)
    _label_map(panels, x_label, y_label)
    _map_legend(figure, values.values(), marks is not None)
    _color_bar(figure, panels, "success rate [-]" if value is None else f"mean {shown(value).label}")
    return figure


def frontier_figure(
    limits: pl.DataFrame,
    title: str,
    what: str = "load_kg",
    by: str = "load_time_s",
    offset_s: float | None = None,
) -> Figure:
    """Draw how far up an input can go (`summary.frontier`) over another: a panel per level, a curve per variant.

    Every point stands at its own values; of curves that coincide, the ones behind are wider and have larger markers.
    Where there is no limit, since the first value falls short already, a cross stands at the panel's lower edge. Bars
    are the limits' intervals; an end that is open runs to the panel's edge, and where both are, there is no bar.

    Args:
        limits: of `summary.frontier` with the same `what` and `by`.
        title: heading of the figure.
        what: the input whose limit was looked for.
        by: the input over which limits are listed.
        offset_s: show load_time_s less this, on the thesis' clock [s].
    """
    limits = _on_thesis_clock(limits, offset_s)
    levels, names = limits["level"].unique(maintain_order=True).to_list(), summary.variants(limits)
    figure, panels = _stack(len(levels), title, 1.2 + 2.6 * len(levels))
    quantity = shown(what)
    for level, axes in zip(levels, panels, strict=True):
        for i, variant in enumerate(names):
            for way in limits["direction"].unique(maintain_order=True):
                line = limits.filter(variant=variant, level=level, direction=way).sort(by)
                _draw_limit(axes, line, what, by, _variant_style(i, len(names)))
        heading = f"success rate of {100 * level:.3g} % and more; bars: 95 % interval of the limit"
        axes.set_title(heading, fontsize=10, color=INK, loc="left")
        axes.set_ylabel(f"limit:\n{quantity.label}")
        low, high = axes.get_ylim()
        low, room = min(low, 0.0), 0.06 * (high - min(low, 0.0))
        axes.set_ylim(low - 2.0 * room, high + room)
        for i, variant in enumerate(names):
            _draw_limit_bars(
                axes, limits.filter(variant=variant, level=level), what, by, _variant_style(i, len(names))
            )
    if len(panels):
        panels[-1].set_xlabel(_clocked(by, offset_s))
    handles = [_variant_handle(variant, i, len(names)) for i, variant in enumerate(names)]
    if limits["beyond"].any():
        handles.append(_handle("^", "held at every value tested"))
    if limits[what].null_count():
        handles.append(_handle("x", "no limit: fails at the first value"))
    if handles:
        _legend_below(figure, handles)
    return figure


def causes_figure(found: pl.DataFrame, title: str) -> Figure:
    """Draw how much each input tells about success (`summary.causes`): a panel per variant, a bar per input.

    Beside a bar stand the success rates in the input's lowest and highest bin.

    Args:
        found: of `summary.causes`.
        title: heading of the figure.
    """
    names = summary.variants(found)
    kept = {variant: found.filter(pl.col("variant") == variant).head(MOST_CAUSES) for variant in names}
    heights = [0.9 + 0.27 * rows.height for rows in kept.values()]
    figure = _figure(title, (9.0, 0.8 + sum(heights)))
    panels = (
        figure.subplots(len(names), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        if names
        else []
    )
    most = max(found["information_bits"], default=0.0)
    for i, (variant, axes) in enumerate(zip(names, panels, strict=True)):
        _draw_causes(axes, kept[variant], _VARIANT_COLORS[i % len(_VARIANT_COLORS)])
        axes.set_title(variant, fontsize=10, color=INK, loc="left")
        axes.set_xlim(0.0, 1.3 * max(most, 1e-3))
    if len(panels):
        panels[-1].set_xlabel(
            "information about success [bit]; beside: success rate in the lowest → the highest part"
        )
    return figure


def cells_figure(table: pl.DataFrame, x: str, title: str, forces: Sequence[str] = FEET) -> Figure:
    """Draw success and foot force over one input: rates with Wilson's 95 % bars above, the larger foot's force below.

    The force is the mean over the walks at each value; its bars reach from the smallest to the largest. Every point
    stands at its own value; of variants that coincide, the ones behind are wider and have larger markers.

    Args:
        table: one row per walk.
        x: the input, such as step_2_height_m; one of more than MOST_VALUES values is cut into PARTS equal parts, and
            a part's point stands at the mean of its values.
        title: heading of the figure.
        forces: columns of which each walk's largest is drawn below [N].
    """
    table = summary.without_never(table, [x]).drop_nulls(x)
    largest = pl.max_horizontal(*forces)
    quantity, names, parted = shown(x), summary.variants(table), _said_parted(table[x])
    if parted:
        table = table.with_columns(pl.col(x).mean().over(_parted(table[x])))
    table = table.with_columns(largest=pl.when(largest.is_finite()).then(largest))
    rates = summary.cells(table, [x])
    force = table.group_by("variant", x).agg(
        mean=pl.col("largest").mean(), low=pl.col("largest").min(), high=pl.col("largest").max()
    )
    figure, panels = _stack(2, title, 6.4)
    for i, variant in enumerate(names):
        for axes, cells, middle in ((panels[0], rates, "rate"), (panels[1], force, "mean")):
            one = cells.filter(pl.col("variant") == variant).drop_nulls(middle).sort(x)
            _draw_bars(axes, quantity.factor * one[x].to_numpy(), one, middle, _variant_style(i, len(names)))
    panels[0].set_ylim(-0.07, 1.07)
    panels[0].set_ylabel("success rate [-]")
    panels[1].set_ylim(bottom=0.0)
    panels[1].set_ylabel("peak foot force [N]")
    panels[1].set_xlabel(quantity.label + parted)
    if names:
        _legend_below(figure, [_variant_handle(variant, i, len(names)) for i, variant in enumerate(names)])
    figure.align_ylabels(panels)
    return figure


# ---- what the figures share


def _figure(title: str, size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, dpi=DPI, layout="constrained", facecolor="white")
    figure.suptitle(title, fontsize=12, color=INK)
    return figure


def _stack(rows: int, title: str, height: float) -> tuple[Figure, Sequence[Axes]]:
    """Panels over one another that share the horizontal axis."""
    figure = _figure(title, (9.0, height))
    panels = list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]) if rows else []
    for axes in panels:
        dress(axes)
    return figure, panels


def _handle(marker: str, label: str) -> Line2D:
    fill = "none" if marker == "^" else INK
    return Line2D([], [], color=INK, ls="", marker=marker, markerfacecolor=fill, label=label)


def _variant_style(i: int, n: int) -> dict[str, Any]:
    """Style of the i-th of n variants: narrower than the one before it, so that both can be seen."""
    behind, steps = n - 1 - i, max(1, n - 1)
    return {
        "color": _VARIANT_COLORS[i % len(_VARIANT_COLORS)],
        "marker": _VARIANT_MARKERS[i % len(_VARIANT_MARKERS)],
        "ls": _VARIANT_DASHES[i // len(_VARIANT_COLORS) % len(_VARIANT_DASHES)],
        "lw": _LINE_WIDTH + behind * min(_WIDER, _MOST_WIDER / steps),
        "ms": _MARKER_SIZE + behind * min(_LARGER, _MOST_LARGER / steps),
        "mfc": "none",
        "zorder": 2.0 + i / n,
    }


def _variant_handle(variant: str, i: int, n: int) -> Line2D:
    return Line2D([], [], label=variant, **_variant_style(i, n))


def _legend_below(figure: Figure, handles: Sequence[Artist]) -> None:
    width = sum(len(str(handle.get_label())) + 8 for handle in handles)
    figure.legend(
        handles=list(handles),
        loc="outside lower center",
        ncols=len(handles) if width <= LEGEND_WIDTH else -(-len(handles) // 2),
        frameon=False,
        fontsize=9,
        labelcolor=INK,
    )


def _parted(values: pl.Series) -> pl.Series:
    """The values, or the middles of the parts they are in where there are too many of them."""
    if values.n_unique() <= MOST_VALUES:
        return values
    known = values.to_numpy()
    edges = np.linspace(known.min(), known.max(), PARTS + 1)
    part = np.clip(np.searchsorted(edges, known, side="right") - 1, 0, PARTS - 1)
    return pl.Series(values.name, 0.5 * (edges[part] + edges[part + 1]))


def _said_parted(values: pl.Series) -> str:
    """Words that a label adds where values were put together to parts."""
    return f", in {PARTS} parts" if values.n_unique() > MOST_VALUES else ""


def _on_thesis_clock(table: pl.DataFrame, offset_s: float | None) -> pl.DataFrame:
    if offset_s is None or "load_time_s" not in table.columns:
        return table
    return table.with_columns((pl.col("load_time_s") - offset_s).round(6))


def _clocked(column: str, offset_s: float | None) -> str:
    if column == "load_time_s" and offset_s is not None:
        return "time of the load, thesis' clock [s]"
    return shown(column).label


# ---- maps


class _Sides(NamedTuple):
    """Columns along the two sides of a map, and their values in order."""

    x: str
    y: str
    across: Sequence[float | int]
    up: Sequence[float | int]


def _map_panels(n: int, sides: _Sides, title: str) -> tuple[Figure, Sequence[Axes], float]:
    """Wide maps over one another, others side by side; and about how wide each is [inch]."""
    columns, rows = len(sides.across), len(sides.up)
    wide = columns >= 2 * rows
    if wide:
        size = (10.0, 1.4 + n * min(4.0, max(1.5, 0.6 + 0.2 * rows)))
    else:
        size = (
            max(6.0, 1.6 + n * min(4.0, max(2.0, 0.32 * columns))),
            min(11.0, max(4.6, 1.6 + 0.2 * rows)),
        )
    figure = _figure(title, size)
    grid = figure.subplots(*((n, 1) if wide else (1, n)), sharex=True, sharey=True, squeeze=False)
    return figure, list(grid.ravel()), (size[0] - 1.6) / (1 if wide else n)


def _map_values(walks: pl.DataFrame, sides: _Sides, value: str | None) -> np.ndarray:
    """(rows, columns) of a variant's map, NaN where there is nothing to show."""
    factor = 1.0 if value is None else shown(value).factor
    column = pl.col("success" if value is None else value).cast(pl.Float64)
    cells = walks.group_by(sides.x, sides.y).agg(column.filter(column.is_finite()).mean().alias("_value"))
    columns, rows = ({v: i for i, v in enumerate(values)} for values in (sides.across, sides.up))
    drawn = np.full((len(rows), len(columns)), np.nan)
    for one, other, mean in cells.select(sides.x, sides.y, "_value").iter_rows():
        drawn[rows[other], columns[one]] = math.nan if mean is None else factor * mean
    return drawn


def _map_colors(values: Iterable[np.ndarray], value: str | None) -> dict[str, Any]:
    if value is None:
        return {"cmap": _SUCCESS, "vmin": 0.0, "vmax": 1.0}
    known = np.concatenate([v[np.isfinite(v)] for v in values])
    low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
    if low == high:
        low, high = low - 0.5, high + 0.5
    return {"cmap": "viridis", "vmin": low, "vmax": high}


def _color_bar(figure: Figure, panels: Sequence[Axes], label: str) -> None:
    bar = figure.colorbar(panels[0].collections[0], ax=list(panels), fraction=0.03, pad=0.02, aspect=30)
    bar.set_label(label, color=INK)
    bar.ax.tick_params(colors=INK, labelsize=9)
    bar.ax.spines[:].set_visible(False)


def _dress_map(axes: Axes, variant: str, sides: _Sides, width: float) -> None:
    """Ticks and frame of a panel of this width [inch]."""
    axes.set_facecolor(_NOT_RUN_FILL)
    axes.set_title(variant, fontsize=10, color=INK, loc="left")
    columns, rows = _tick_texts(sides.across, sides.x), _tick_texts(sides.up, sides.y)
    axes.set_xticks(
        *_ticks(columns, lambda texts: sum(len(t) + 1.5 for t in texts) <= _LETTERS_PER_INCH * width)
    )
    axes.set_yticks(*_ticks(rows, lambda texts: len(texts) <= _MOST_ROWS_NUMBERED))
    axes.tick_params(colors=INK, labelsize=9, length=0)
    axes.spines[:].set_visible(False)


def _tick_texts(values: Sequence[float | int], column: str) -> list[str]:
    return [short(value, column) for value in values]


def _ticks(texts: Sequence[str], fits: Callable[[Sequence[str]], bool]) -> tuple[list[float], list[str]]:
    """Places and texts of every so-manieth value: of those with the shortest numbers, which are the round ones."""
    for step in _TICK_STEPS:
        starts = range(min(step, len(texts)))
        start = min(starts, key=lambda i: (sum(map(len, texts[i::step])) / len(texts[i::step]), -i))
        if fits(texts[start::step]):
            return [i + 0.5 for i in range(start, len(texts), step)], list(texts[start::step])
    return [0.5], list(texts[:1])


def _outline(axes: Axes, walks: pl.DataFrame, printed: pl.DataFrame, sides: _Sides) -> None:
    """Frame the cells that differ from a printed table; the walks are on the thesis' clock."""
    said, ours = tables.printed_cells(printed), tables.our_cells(walks, 0.0)
    for i, one in enumerate(sides.across):
        for j, other in enumerate(sides.up):
            time, load = (one, other) if sides.x == "load_time_s" else (other, one)
            key = (tables.milli(time), tables.milli(load))
            if key in said and key in ours and said[key] != tables.succeeds(ours[key]):
                axes.add_patch(Rectangle((i + 0.08, j + 0.08), 0.84, 0.84, fill=False, edgecolor=INK, lw=1.8))


def _label_map(panels: Sequence[Axes], x_label: str, y_label: str) -> None:
    for axes in panels:
        place = axes.get_subplotspec()
        if place is not None and place.is_last_row():
            axes.set_xlabel(x_label, color=INK)
        if place is not None and place.is_first_col():
            axes.set_ylabel(y_label, color=INK)


def _map_legend(figure: Figure, values: Iterable[np.ndarray], marked: bool) -> None:
    handles = []
    if marked:
        handles.append(Patch(facecolor="none", edgecolor=INK, lw=1.8, label="differs from the thesis' table"))
    if any(np.isnan(v).any() for v in values):
        handles.append(Patch(facecolor=_NOT_RUN_FILL, label="not run, or no number"))
    if handles:
        _legend_below(figure, handles)


# ---- curves and bars


def _draw_limit(axes: Axes, line: pl.DataFrame, what: str, by: str, style: Mapping[str, Any]) -> None:
    """Draw one variant's limit in one direction."""
    places = shown(by).factor * line[by].cast(pl.Float64).to_numpy()
    limit = shown(what).factor * line[what].cast(pl.Float64).fill_null(math.nan).to_numpy()
    beyond, nothing = line["beyond"].to_numpy(), np.isnan(limit)
    points = {**style, "ls": ""}
    axes.plot(places, limit, **{**style, "marker": ""})
    axes.plot(places[~beyond], limit[~beyond], **points)
    axes.plot(places[beyond & ~nothing], limit[beyond & ~nothing], **{**points, "marker": "^"})
    edge = np.full(nothing.sum(), _AT_THE_EDGE)
    axes.plot(places[nothing], edge, transform=axes.get_xaxis_transform(), **{**points, "marker": "x"})


def _draw_limit_bars(axes: Axes, line: pl.DataFrame, what: str, by: str, style: Mapping[str, Any]) -> None:
    """Draw bars from where a limit is sure to reach to where it is sure not to."""
    line = line.filter(pl.col("low").is_not_null() | pl.col("high").is_not_null())
    bottom, top = axes.get_ylim()
    downward = (line["direction"] == summary.DOWN).to_numpy()
    ends = [
        shown(what).factor * line[end].cast(pl.Float64).fill_null(math.nan).to_numpy()
        for end in ("low", "high")
    ]
    open_ends = np.where(downward, top, bottom), np.where(downward, bottom, top)
    low, high = (np.where(np.isnan(end), edge, end) for end, edge in zip(ends, open_ends, strict=True))
    places = shown(by).factor * line[by].cast(pl.Float64).to_numpy()
    axes.vlines(places, low, high, color=style["color"], lw=0.6 * style["lw"], alpha=0.4, zorder=1)


def _draw_causes(axes: Axes, rows: pl.DataFrame, color: str) -> None:
    dress(axes)
    places = np.arange(rows.height)[::-1]
    axes.barh(places, rows["information_bits"].to_numpy(), height=0.62, color=color)
    axes.set_yticks(places, [re.sub(r" \[.*", "", shown(name).label) for name in rows["input"]])
    axes.grid(False, axis="y")
    for place, row in zip(places, rows.iter_rows(named=True), strict=True):
        text = f"  {100 * row['rate_lowest']:.0f} % → {100 * row['rate_highest']:.0f} %"
        axes.text(row["information_bits"], place, text, va="center", fontsize=8.5, color=INK)


def _draw_bars(
    axes: Axes, places: np.ndarray, cells: pl.DataFrame, middle: str, style: Mapping[str, Any]
) -> None:
    heart = cells[middle].to_numpy()
    reach = np.maximum(0.0, [heart - cells["low"].to_numpy(), cells["high"].to_numpy() - heart])
    axes.errorbar(places, heart, reach, elinewidth=style["lw"], capsize=0.6 * style["ms"], **style)

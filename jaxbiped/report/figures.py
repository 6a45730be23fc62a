"""Figures of a planned walk: feet, pelvis, ZMP in its support, and what the walk asks of the robot.

Every function takes what a planner gives, sampled over time (a leading axis), and returns a matplotlib
Figure. No pyplot: nothing global is touched.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Array

from jaxbiped import files
from jaxbiped.planner import SINGLE_SUPPORT, Feasibility, Phase, TaskSpace
from jaxbiped.report.quantities import rounded
from jaxbiped.robot import SIDE_NAMES

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError as error:
    raise ImportError("figures need matplotlib: pip install 'jaxbiped[viz]'") from error

Values = np.ndarray | Array
"""Numbers over the samples of a walk, on the host or on a device."""
DPI = 120
BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
"""Colors of Okabe and Ito (2008), which the color-blind can tell apart."""
EVENT_COLORS = (PURPLE, GREEN, "#333333")
"""Colors of marked times, kind by kind."""
SIDE_COLORS = (BLUE, ORANGE)
SIDE_DASHES = ("-", (0, (5, 1.6)))
INK, FAINT = "#333333", "#8a8a8a"
SINGLE_SUPPORT_SHADE = "#e9edf2"
SUPPORT_FILL = "#cfe8df"
MEASURED = "measured"
LEGEND_WIDTH = 122
"""Widest row of a legend, in letters; a handle counts as eight."""
SHADE_LABEL = "single support (white: double)"
_HALF_A_SAMPLE = 5e-3
"""Half the width of a sample around a time that has no neighbor [s]."""
_AXIS_WORDS = ("forward, x", "lateral (left), y", "up, z")


def feet(
    time: Values, task: TaskSpace, phase: Phase, title: str = "Feet", measured: TaskSpace | None = None
) -> Figure:
    """Draw both soles' x, y and z in the world over time (khadiv Fig. 6).

    Args:
        time: (n,) [s].
        task: soles in the world with a leading axis n [m].
        phase: phases with a leading axis n.
        title: heading of the figure.
        measured: where the soles really were, to be drawn over the plan or the commands.
    """
    figure, panels = _panels(3, title, phase.support, time)
    draw_feet(panels, time, np.asarray(task.sole))
    if measured is not None:
        for axis, axes in enumerate(panels):
            for side in range(2):
                label = MEASURED if side == 0 else f"_{MEASURED}"
                _draw_measured(axes, time, np.asarray(measured.sole)[:, side, axis], label)
    return _finish(figure, panels)


def feet_in_body(
    time: Values,
    task: TaskSpace,
    phase: Phase,
    title: str = "Feet in the body frame",
    events: Mapping[str, Sequence[float]] | None = None,
) -> Figure:
    """Draw both soles' x, y and z relative to the pelvis over time (elkahlout Figs. 3.2, 3.9 and 4.3).

    Args:
        time: (n,), usually one cycle [s].
        task: soles and pelvis in the world with a leading axis n [m].
        phase: phases with a leading axis n.
        title: heading of the figure.
        events: times to mark [s] by what happened then.
    """
    figure, panels = _panels(3, title, phase.support, time)
    draw_feet(panels, time, np.asarray(task.sole) - np.asarray(task.pelvis)[:, None])
    mark_events(panels, events or {})
    return _finish(figure, panels)


def pelvis(
    time: Values, task: TaskSpace, phase: Phase, title: str = "Pelvis", measured: TaskSpace | None = None
) -> Figure:
    """Draw the pelvis' x, y and z in the world over time (khadiv Fig. 7).

    Args:
        time: (n,) [s].
        task: pelvis in the world with a leading axis n [m].
        phase: phases with a leading axis n.
        title: heading of the figure.
        measured: where the pelvis really was, to be drawn over the plan or the commands.
    """
    figure, panels = _panels(3, title, phase.support, time)
    for axis, axes in enumerate(panels):
        axes.plot(time, np.asarray(task.pelvis)[:, axis], color=BLUE, label="pelvis")
        if measured is not None:
            _draw_measured(axes, time, np.asarray(measured.pelvis)[:, axis], MEASURED)
        axes.set_ylabel(f"{_AXIS_WORDS[axis]} [m]")
    return _finish(figure, panels)


def zmp(report: Feasibility, phase: Phase, axis: int, title: str = "ZMP") -> Figure:
    """Draw the ZMP, the center of mass and the edges of the support along one axis (khadiv Figs. 8 and 9).

    Args:
        report: what a gait takes, with a leading axis n.
        phase: phases with a leading axis n.
        axis: 0 forward, 1 lateral.
        title: heading of the figure.
    """
    time = np.asarray(report.time)
    lower, upper = np.asarray(report.support_lower)[:, axis], np.asarray(report.support_upper)[:, axis]
    figure, panels = _panels(1, title, phase.support, time, height=4.6)
    axes = panels[0]
    axes.fill_between(time, lower, upper, step="mid", color=SUPPORT_FILL, alpha=0.75, lw=0, zorder=1)
    for edge, label in ((lower, "_lower edge"), (upper, "edges of the support")):
        axes.plot(time, edge, color=GREEN, lw=1.2, drawstyle="steps-mid", label=label)
    axes.plot(time, np.asarray(report.com)[:, axis], color=FAINT, lw=1.2, ls=":", label="center of mass")
    axes.plot(time, np.asarray(report.zmp)[:, axis], color=INK, label="ZMP")
    axes.set_ylabel(f"{_AXIS_WORDS[axis]} [m]")
    return _finish(figure, panels)


def feasibility_page(report: Feasibility, phase: Phase, title: str = "Feasibility") -> Figure:
    """Draw what a walk asks of the robot: ZMP margin, friction, torque and speed shares, bend of the knees.

    Args:
        report: what a gait takes, with a leading axis n.
        phase: phases with a leading axis n.
        title: heading of the figure.
    """
    time = np.asarray(report.time)
    figure, panels = _panels(5, title, phase.support, time, height=9.6)
    margin, friction, torque, speed, knee = panels
    _draw_worst(
        margin, time, 1e3 * np.asarray(report.zmp_margin), "ZMP margin\n[mm]", np.nanmin, "smallest", 1
    )
    _draw_worst(friction, time, np.asarray(report.friction), "friction needed\n[-]", np.nanmax, "largest", 3)
    percent = ((torque, report.torque_share, "torque"), (speed, report.speed_share, "speed"))
    for axes, share, word in percent:
        _draw_worst(
            axes, time, 1e2 * np.asarray(share), f"joint {word}\n[% of limit]", np.nanmax, "largest", 1
        )
    bend = np.degrees(np.asarray(report.knee))
    for side, name in enumerate(SIDE_NAMES):
        knee.plot(time, bend[:, side], color=SIDE_COLORS[side], ls=SIDE_DASHES[side], label=f"{name} knee")
    knee.set_ylabel("knee bend\n[deg]")
    knee.set_ylim(_from_zero(bend))
    return _finish(figure, panels)


def panels_over_time(
    rows: int, title: str, support: Values, time: Values, height: float, share_time: bool = True
) -> tuple[Sequence[Axes], Callable[[], Figure]]:
    """Panels over one another with a common time axis, single support shaded, and a call that finishes the figure.

    Args:
        rows: number of panels.
        title: heading of the figure.
        support: (n,) SINGLE_SUPPORT or DOUBLE_SUPPORT.
        time: (n,) [s].
        height: of the figure [inch].
        share_time: whether all panels show the same time.
    """
    figure, panels = _panels(rows, title, support, time, height, share_time)
    return panels, lambda: _finish(figure, panels)


def mark_events(panels: Sequence[Axes], events: Mapping[str, Sequence[float]]) -> None:
    """Mark times [s] by vertical lines, a style for each kind; the legend stands over the last panel."""
    styles = zip(EVENT_COLORS, ("--", "-", ":"), strict=True)
    for (label, times), (color, dashes) in zip(events.items(), styles, strict=False):
        for axes in panels:
            for i, time in enumerate(times):
                shown = label if i == 0 and axes is panels[-1] else f"_{label}"
                axes.axvline(time, color=color, ls=dashes, lw=1.1, label=shown, zorder=1.5)


def dress(axes: Axes) -> None:
    """Grid, frame and ticks of every panel."""
    axes.grid(True, color="#c9ced6", lw=0.5, alpha=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(colors=INK, labelsize=9)


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure as a PNG, whole or not at all, and return its path.

    Raises:
        OSError: with the name of the file, when it cannot be written.
    """
    return files.write(path, png(figure))


def png(figure: Figure) -> bytes:
    """A figure as the content of a PNG file."""
    content = io.BytesIO()
    figure.savefig(content, dpi=DPI, format="png")
    return content.getvalue()


def _panels(
    rows: int, title: str, support: Values, time: Values, height: float = 7.2, share_time: bool = True
) -> tuple[Figure, Sequence[Axes]]:
    """Panels over one another with a common time axis, single support shaded."""
    figure = Figure(figsize=(9.0, height), dpi=DPI, layout="constrained", facecolor="white")
    grid = figure.subplots(rows, 1, sharex=share_time, squeeze=False)
    panels = list(grid[:, 0])
    figure.suptitle(title, fontsize=12, color=INK)
    edges = _sample_edges(np.asarray(time))
    for axes in panels:
        dress(axes)
        _shade_single_support(axes, edges, np.asarray(support))
    panels[-1].set_xlabel("time [s]")
    for axes in panels:
        axes.set_xlim(float(edges[0]), float(edges[-1]))
    return figure, panels


def _sample_edges(time: np.ndarray) -> np.ndarray:
    """The n + 1 borders between n samples, the outer ones half a sample beyond the first and the last."""
    if len(time) < 2:
        return np.concatenate([time - _HALF_A_SAMPLE, time[-1:] + _HALF_A_SAMPLE])
    middles = 0.5 * (time[1:] + time[:-1])
    return np.concatenate([[1.5 * time[0] - 0.5 * time[1]], middles, [1.5 * time[-1] - 0.5 * time[-2]]])


def _shade_single_support(axes: Axes, edges: np.ndarray, support: np.ndarray) -> None:
    """A band for every stretch of single support."""
    single = np.concatenate([[False], support == SINGLE_SUPPORT, [False]])
    starts, ends = (edges[np.flatnonzero(np.diff(single.astype(int)) == sign)] for sign in (1, -1))
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        label = SHADE_LABEL if i == 0 else None
        axes.axvspan(start, end, color=SINGLE_SUPPORT_SHADE, lw=0, zorder=0, label=label)


def draw_feet(panels: Sequence[Axes], time: Values, sole: np.ndarray) -> None:
    """Draw x, y and z of both soles (n, 2, 3), a panel each [m]."""
    for axis, axes in enumerate(panels):
        for side, name in enumerate(SIDE_NAMES):
            axes.plot(
                time,
                sole[:, side, axis],
                color=SIDE_COLORS[side],
                ls=SIDE_DASHES[side],
                label=f"{name} foot",
            )
        axes.set_ylabel(f"{_AXIS_WORDS[axis]} [m]")


def _draw_measured(axes: Axes, time: Values, values: np.ndarray, label: str) -> None:
    axes.plot(time, values, color=INK, lw=0.8, label=label)


def _draw_worst(
    axes: Axes,
    time: np.ndarray,
    values: np.ndarray,
    label: str,
    worst: Callable[[np.ndarray], float],
    word: str,
    decimals: int,
) -> None:
    """A curve and a line at its worst value."""
    axes.plot(time, values, color=INK, label="_nolegend_")
    axes.set_ylabel(label)
    axes.set_ylim(_from_zero(values))
    if np.isfinite(values).any():
        extreme = float(worst(np.where(np.isfinite(values), values, np.nan)))
        said = f"{word} {rounded(extreme, decimals, strip=True)}"
        axes.axhline(extreme, color=ORANGE, lw=1.0, ls="--", label=said)


def _from_zero(values: np.ndarray) -> tuple[float, float]:
    """Ends of an axis that shows zero and all values."""
    known = np.append(values[np.isfinite(values)], 0.0)
    low, high = 1.08 * float(known.min()), 1.08 * float(known.max())
    return (low, high) if low < high else (-1.0, 1.0)


def _finish(figure: Figure, panels: Sequence[Axes]) -> Figure:
    """One row of legend over every panel that has something new to say; and labels in line."""
    said: set[str] = set()
    for axes in panels:
        entries = [(h, label) for h, label in zip(*axes.get_legend_handles_labels(), strict=True)]
        entries = [entry for entry in entries if entry[1] not in said]
        said |= {label for _, label in entries}
        if entries:
            handles, labels = zip(*entries, strict=True)
            _legend_above(axes, handles, labels)
    figure.align_ylabels(panels)
    return figure


def _legend_above(axes: Axes, handles: Sequence, labels: Sequence[str]) -> None:
    """One row, or two where one would be wider than the figure."""
    width = sum(len(label) + 8 for label in labels)
    axes.legend(
        handles,
        labels,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=len(labels) if width <= LEGEND_WIDTH else -(-len(labels) // 2),
        frameon=False,
        fontsize=9,
        labelcolor=INK,
        borderaxespad=0.1,
        handlelength=2.4,
    )

"""Figures of a walk with a payload: what was felt, what the reflex commanded, how the trunk pitched."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from jaxbiped.adapt import PayloadReflex
from jaxbiped.report.figures import (
    BLUE,
    DPI,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    SUPPORT_FILL,
    draw_feet,
    dress,
    feet_in_body,
    mark_events,
    panels_over_time,
)
from jaxbiped.report.quantities import rounded
from jaxbiped.report.traces import Felt
from jaxbiped.score import Recovery
from jaxbiped.sim import Sample

CLOSE = 0.25
"""Time shown before a load and after its trigger, from close by [s]."""
LOAD, TRIGGER, STAGES = "load", "trigger", "settled, shifted, recovered, walks on"
"""Events of a walk with a payload, in the order of their styles."""


def payload_events(
    load_time: float | None, recoveries: Sequence[Recovery], load_end: float | None = None
) -> dict[str, list[float]]:
    """Times to mark in a figure [s]: the load put on and taken off, reflexes and their stages."""
    stages = [t for r in recoveries for t in (r.settled, r.shifted, r.recovered, r.resumed) if t is not None]
    return {
        LOAD: [time for time in (load_time, load_end) if time is not None],
        TRIGGER: [r.triggered for r in recoveries],
        STAGES: stages,
    }


def references(trace: Sample, events: dict[str, list[float]], title: str) -> Figure:
    """Draw the commanded feet in the body frame over the whole walk (elkahlout Figs. 3.9 and 4.3).

    Args:
        trace: `sim.Sample` with a leading axis.
        events: times to mark [s].
        title: heading of the figure.
    """
    return feet_in_body(trace.time, trace.targets.position, trace.targets.phase, title, events)


def pitch(trace: Sample, events: dict[str, list[float]], title: str) -> Figure:
    """Draw the trunk's pitch, the thesis' angle beta (elkahlout Figs. 4.2 and 4.4).

    Args:
        trace: `sim.Sample` with a leading axis.
        events: times to mark [s].
        title: heading of the figure.
    """
    panels, finish = panels_over_time(1, title, np.asarray(trace.targets.phase.support), trace.time, 4.0)
    panels[0].plot(
        trace.time, np.degrees(np.asarray(trace.roll_pitch_yaw)[:, 1]), color=INK, label="trunk pitch"
    )
    panels[0].set_ylabel("trunk pitch, beta [deg]")
    mark_events(panels, events)
    return finish()


def force_and_trigger(
    trace: Sample, felt: Felt, params: PayloadReflex, events: dict[str, list[float]], title: str
) -> Figure:
    """Draw the summed foot force, its low-pass and the band that triggers the reflex (elkahlout Fig. 3.3).

    Args:
        trace: `sim.Sample` with a leading axis.
        felt: the filtered readings at the trace's times.
        params: of the payload stage.
        events: times to mark [s].
        title: heading of the figure.
    """
    time, threshold = np.asarray(trace.time), float(params.threshold)
    support = np.asarray(trace.targets.phase.support)
    panels, finish = panels_over_time(2, title, support, time, 6.8, share_time=False)
    low, high = felt.weight - threshold, felt.weight + threshold
    band = f"weight ± {rounded(threshold, 1, strip=True)} N"
    for axes in panels:
        axes.fill_between(time, low, high, color=SUPPORT_FILL, lw=0, label=band, zorder=1)
        axes.plot(time, felt.force, color=FAINT, lw=0.6, label="sum of the vertical foot forces", zorder=1.2)
        axes.plot(time, felt.low_passed, color=BLUE, lw=1.4, label="low-passed")
        axes.set_ylabel("vertical force [N]")
    mark_events(panels, events)
    far = float(np.abs(felt.low_passed - felt.weight).max())
    panels[0].set_ylim(low.min() - 1.5 * max(far, threshold), high.max() + 1.5 * max(far, threshold))
    moments = events[LOAD] + events[TRIGGER][:1]
    if moments:
        panels[1].set_xlim(min(moments) - CLOSE, max(moments) + CLOSE)
    panels[1].set_ylim(low[0] - 4.0 * threshold, high[0] + 8.0 * threshold)
    return finish()


def settling_zmp(trace: Sample, felt: Felt, params: PayloadReflex, recovery: Recovery, title: str) -> Figure:
    """Draw the ZMP in the body frame while the robot settles, and its low-pass (elkahlout Fig. 4.12).

    Args:
        trace: `sim.Sample` with a leading axis.
        felt: the filtered readings at the trace's times.
        params: of the payload stage.
        recovery: the reflex to show.
        title: heading of the figure.
    """
    time = np.asarray(trace.time)
    end = time[-1] if recovery.settled is None else recovery.settled
    rows = (time >= recovery.triggered - 0.5) & (time <= end + 0.2)
    support = np.asarray(trace.targets.phase.support)[rows]
    panels, finish = panels_over_time(1, title, support, time[rows], 4.4)
    axes, balanced = panels[0], 1e3 * float(params.zmp_balanced)
    axes.plot(time[rows], 1e3 * felt.zmp[rows], color=FAINT, lw=0.7, label="ZMP")
    axes.plot(time[rows], 1e3 * felt.zmp_low_passed[rows], color=BLUE, label="low-passed")
    axes.axhline(balanced, color=GREEN, lw=1.2, ls="-.", label=f"balanced, {rounded(balanced, 1)} mm")
    if recovery.settled is not None:
        read = 1e3 * float(np.interp(recovery.settled, time, felt.zmp_low_passed))
        axes.plot(
            recovery.settled, read, "o", color=ORANGE, ms=6, label=f"read, {rounded(read, 1)} mm", zorder=4
        )
    axes.set_ylabel("ZMP forward of the pelvis [mm]")
    mark_events(panels, {LOAD: [], TRIGGER: [recovery.triggered]})
    return finish()


def reflex_close_ups(trace: Sample, recovery: Recovery, title: str) -> Figure:
    """Draw reflex, shift of x_ref and recovery of the step size from close by (elkahlout Figs. 3.5, 3.7, 3.8).

    Args:
        trace: `sim.Sample` with a leading axis; what it did not get to is left empty.
        recovery: the reflex to show.
        title: heading of the figure.
    """
    spans = {
        "reflex": (recovery.triggered, recovery.reflex_end),
        "shift of x_ref": (recovery.settled, recovery.shifted),
        "recovery of the step size": (recovery.shifted, recovery.recovered),
    }
    position, time = trace.targets.position, np.asarray(trace.time)
    in_body = np.asarray(position.sole) - np.asarray(position.pelvis)[:, None]
    figure = Figure(figsize=(11.0, 7.2), dpi=DPI, layout="constrained", facecolor="white")
    figure.suptitle(title, fontsize=12, color=INK)
    grid = figure.subplots(3, len(spans), sharex="col", squeeze=False)
    for column, (what, (start, end)) in zip(grid.T, spans.items(), strict=True):
        column[0].set_title(what, fontsize=10, color=INK)
        for axes in column:
            dress(axes)
        column[-1].set_xlabel("time [s]")
        if start is None or end is None:
            column[-1].set_xticks([])
            for axes in column:
                axes.set_yticks([])
            column[1].text(0.5, 0.5, "not reached", ha="center", transform=column[1].transAxes, color=FAINT)
            continue
        margin = 0.25 * (end - start)
        rows = (time >= start - margin) & (time <= end + margin)
        draw_feet(list(column), time[rows], in_body[rows])
        for axes in column:
            axes.axvspan(start, end, color=SUPPORT_FILL, alpha=0.6, lw=0, zorder=0)
            axes.set_xlim(start - margin, end + margin)
    for axes, label in zip(grid[:, 0], ("forward, x [m]", "lateral (left), y [m]", "up, z [m]"), strict=True):
        axes.set_ylabel(label)
    for axes in grid[:, 1:].ravel():
        axes.set_ylabel("")
    figure.align_ylabels(grid[:, 0])
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=9, labelcolor=INK
    )
    return figure

"""Figures of simulated walks, laid over each other: trunk tilt, foot forces, measured ZMP, what adaptation did."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from jaxbiped.planner import Feasibility, TaskSpace
from jaxbiped.report.figures import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    SIDE_COLORS,
    SIDE_DASHES,
    mark_events,
    panels_over_time,
)
from jaxbiped.report.traces import Commanded
from jaxbiped.robot import SIDE_NAMES
from jaxbiped.score import touches, walked_rows
from jaxbiped.sim import Sample

TOUCH_LABEL = "touch"
LEAST_SHOWN = 1.0
"""Modifications smaller than this do not fill a panel [mm]."""
LINE_COLORS = (BLUE, ORANGE, GREEN, PURPLE, INK)


def tilt_and_forces(
    walks: Mapping[str, Sample],
    title: str,
    until: float | None = None,
    events: Mapping[str, Sequence[float]] | None = None,
) -> Figure:
    """Draw trunk roll and pitch and both feet's vertical force of several walks (khadiv Figs. 12 and 13).

    Args:
        walks: traces (`sim.Sample` with a leading axis) by the name to show; the first one's phases are shaded.
        title: heading of the figure.
        until: last time to draw [s].
        events: times to mark [s] by what happened then.
    """
    first = next(iter(walks.values()))
    shown = _shown(first, until)
    panels, finish = panels_over_time(
        4, title, np.asarray(first.targets.phase.support)[shown], np.asarray(first.time)[shown], 8.4
    )
    for color, (name, trace) in zip(LINE_COLORS, walks.items(), strict=False):
        rows = _shown(trace, until) & _walking(trace)
        time = np.asarray(trace.time)[rows]
        tilt, force = np.degrees(np.asarray(trace.roll_pitch_yaw)), np.asarray(trace.foot_force)[..., 2]
        for axes, values in zip(panels, (tilt[:, 0], tilt[:, 1], force[:, 0], force[:, 1]), strict=True):
            axes.plot(time, values[rows], color=color, lw=1.2, label=name)
    for axes, label in zip(panels, ("trunk roll [deg]", "trunk pitch [deg]"), strict=False):
        axes.set_ylabel(label)
    for axes, side in zip(panels[2:], SIDE_NAMES, strict=True):
        axes.set_ylabel(f"{side} foot\nvertical force [N]")
    mark_events(panels, events or {})
    return finish()


def measured_zmp(trace: Sample, plan: Feasibility | Commanded, title: str) -> Figure:
    """Draw the measured center of pressure over the plan's ZMP and support, forward and lateral.

    Args:
        trace: `sim.Sample` with a leading axis.
        plan: `planner.Feasibility`, or `Commanded`, at the trace's times.
        title: heading of the figure.
    """
    time = np.asarray(trace.time)
    panels, finish = panels_over_time(2, title, np.asarray(trace.targets.phase.support), time, 6.0)
    for axis, axes in enumerate(panels):
        for edge, label in (
            (plan.support_lower, "_lower"),
            (plan.support_upper, "edges of the planned support"),
        ):
            axes.plot(
                time, np.asarray(edge)[:, axis], color=GREEN, lw=1.0, drawstyle="steps-mid", label=label
            )
        axes.plot(time, np.asarray(plan.zmp)[:, axis], color=FAINT, lw=1.4, ls=":", label="planned ZMP")
        axes.plot(time, np.asarray(trace.zmp_world)[:, axis], color=INK, lw=1.0, label="measured ZMP")
        axes.set_ylabel(("forward, x [m]", "lateral (left), y [m]")[axis])
    return finish()


def modifications(trace: Sample, nominal: TaskSpace, title: str) -> Figure:
    """Draw what adaptation added to the plan (khadiv Fig. 11): feet forward and up, pelvis up; dots are touches.

    Args:
        trace: `sim.Sample` with a leading axis.
        nominal: the plan's `TaskSpace` at the trace's times.
        title: heading of the figure.
    """
    time = np.asarray(trace.time)
    panels, finish = panels_over_time(3, title, np.asarray(trace.targets.phase.support), time, 6.6)
    added = 1e3 * (np.asarray(trace.targets.position.sole) - np.asarray(nominal.sole))
    for side, name in enumerate(SIDE_NAMES):
        for axes, axis in zip(panels[:2], (0, 2), strict=True):
            style = {"color": SIDE_COLORS[side], "ls": SIDE_DASHES[side]}
            axes.plot(time, added[:, side, axis], label=f"{name} foot", **style)
            rows = [touch.row for touch in touches(trace) if touch.foot == name]
            label = TOUCH_LABEL if side == 0 and axis == 0 else f"_{TOUCH_LABEL}"
            axes.plot(
                time[rows],
                added[rows, side, axis],
                "o",
                ms=4.5,
                mec="white",
                mew=0.6,
                color=SIDE_COLORS[side],
                label=label,
                zorder=3,
            )
    pelvis = 1e3 * (np.asarray(trace.targets.position.pelvis) - np.asarray(nominal.pelvis))
    panels[2].plot(time, pelvis[:, 2], color=INK, label="pelvis")
    for axes, label in zip(panels, ("feet forward\n[mm]", "feet up\n[mm]", "pelvis up\n[mm]"), strict=True):
        axes.set_ylabel(label)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, -LEAST_SHOWN), max(high, LEAST_SHOWN))
    return finish()


def _shown(trace: Sample, until: float | None) -> np.ndarray:
    time = np.asarray(trace.time)
    return time <= (np.inf if until is None else until)


def _walking(trace: Sample) -> np.ndarray:
    """Rows before a lane froze: time stands still in a fallen one."""
    time = np.asarray(trace.time)
    return np.arange(len(time)) < walked_rows(time)

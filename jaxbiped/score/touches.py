"""When the feet touched the ground, read off a trace: step, foot, early or late, and what adaptation made of it."""

import itertools
from dataclasses import dataclass

import numpy as np

from jaxbiped.planner import PLANNED_STEP, REFLEX_STEP
from jaxbiped.robot import SIDE_NAMES
from jaxbiped.sim import Sample

KIND_TEXT = ("planned", "reflex", "recovery")


@dataclass(frozen=True)
class Touch:
    """The first switch of a swing foot that closes in a step."""

    step: int
    """Number of the plan's step, 0 for the first."""
    foot: str
    """left or right."""
    kind: str
    """Kind of the step: planned, reflex or recovery."""
    time: float
    """Time of the touch [s]."""
    row: int
    """Row of the trace with the touch."""
    end_row: int
    """Last row of this step in the trace."""
    late: float
    """Time since the planned end of single support, negative before it (advance landing) [s]."""


def touches(trace: Sample) -> list[Touch]:
    """Every touch in a trace, in order; to the next sample.

    As the landing stage does, it looks from half a single support (in a reflex: from its beginning) to the end of the
    step for a foot that has been off the ground in this step.

    Args:
        trace: samples with a leading axis; a frozen tail, where time stands still, is left out.
    """
    phase = trace.targets.phase
    time, step, kind, swing = (np.asarray(a) for a in (trace.time, phase.step, phase.kind, phase.swing))
    tau, T_s = np.asarray(phase.time_since_liftoff), np.asarray(phase.T_s)
    closed = np.any(np.asarray(trace.switch), axis=-1)[np.arange(len(time)), swing]
    n = walked_rows(time)
    found: list[Touch] = []
    for start, stop in step_rows(step[:n], kind[:n]):
        rows = np.arange(start, stop)
        aloft = np.logical_or.accumulate(~closed[rows] & (tau[rows] >= 0.0) & (tau[rows] <= T_s[rows]))
        watching = tau[rows] >= np.where(kind[rows] == REFLEX_STEP, 0.0, 0.5 * T_s[rows])
        hits = rows[aloft & watching & closed[rows]]
        if hits.size:
            found.append(_touch(int(hits[0]), stop - 1, step, kind, swing, time, tau - T_s))
    return found


def walked_rows(time: np.ndarray) -> int:
    """Rows of a trace up to its end or the fall: time stands still in a fallen robot's."""
    still = np.flatnonzero(np.diff(time) <= 0.0)
    return int(still[0]) + 1 if still.size else len(time)


def step_rows(step: np.ndarray, kind: np.ndarray) -> list[tuple[int, int]]:
    """First and one past the last row of every step; a reflex or a recovery is one, whatever the plan would do."""
    step = np.where(kind == PLANNED_STEP, step, -1)
    borders = np.flatnonzero((np.diff(step) != 0) | (np.diff(kind) != 0)) + 1
    edges = [0, *borders.tolist(), len(step)]
    return list(itertools.pairwise(edges))


def _touch(
    row: int,
    end_row: int,
    step: np.ndarray,
    kind: np.ndarray,
    swing: np.ndarray,
    time: np.ndarray,
    late: np.ndarray,
) -> Touch:
    return Touch(
        step=int(step[row]),
        foot=SIDE_NAMES[int(swing[row])],
        kind=KIND_TEXT[int(kind[row]) - PLANNED_STEP],
        time=float(time[row]),
        row=row,
        end_row=end_row,
        late=float(late[row]),
    )

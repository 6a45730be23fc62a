"""When the reflexes of a walk happened and what came of them, read off a trace."""

from dataclasses import dataclass

import numpy as np

from jaxbiped.adapt import PayloadReflex
from jaxbiped.planner import RECOVERY_STEP, REFLEX_STEP
from jaxbiped.score.touches import step_rows, walked_rows
from jaxbiped.sim import Sample


@dataclass(frozen=True)
class Recovery:
    """One reflex and what follows it; None for what the walk did not get to. All times in s."""

    triggered: float
    """The low-passed force left its band: the reflex begins."""
    reflex_end: float | None
    """Both feet stand, the robot settles."""
    settled: float | None
    """The ZMP is read, x_ref begins to shift."""
    shifted: float | None
    """x_ref has shifted, the step size begins to recover."""
    recovered: float | None
    """The step size has recovered."""
    resumed: float | None
    """The plan goes on."""
    x_shift: float | None
    """Shift of x_ref: forward with the feet in the body frame, so the body goes backward [m]."""


def recoveries(trace: Sample, params: PayloadReflex) -> list[Recovery]:
    """Every reflex in a trace, in order.

    Args:
        trace: samples with a leading axis.
        params: of the payload stage that was on.
    """
    phase = trace.targets.phase
    time, step, kind = (np.asarray(a, float) for a in (trace.time, phase.step, phase.kind))
    rows = walked_rows(time)
    spans = step_rows(step[:rows], kind[:rows])
    reflexes = [i for i, (start, _) in enumerate(spans) if kind[start] == REFLEX_STEP]
    starts = [float(time[spans[i][0]]) for i in reflexes]
    ends = [*starts, float(time[rows - 1])][1:]
    return [_one(trace, params, spans, i, end) for i, end in zip(reflexes, ends, strict=True)]


def _one(trace: Sample, params: PayloadReflex, spans: list[tuple[int, int]], i: int, end: float) -> Recovery:
    """The reflex of span i, followed up to `end`, when it is over or the next one begins."""
    phase, time = trace.targets.phase, np.asarray(trace.time, float)
    start = spans[i][0]
    triggered = float(time[start]) - float(phase.time_since_liftoff[start])
    reflex_end = triggered + float(params.reflex_time)
    settled = reflex_end + float(params.settling_time)
    shifted = settled + float(params.shift_time)
    recovered = np.inf
    after = spans[i + 1][0] if i + 1 < len(spans) else start
    if int(phase.kind[after]) == RECOVERY_STEP:
        before_liftoff = -float(phase.begin[after]) - float(params.shift_time)
        recovered = shifted + float(phase.T_s[after]) + 2.0 * before_liftoff
    resumed = recovered + float(params.hold)
    times = (reflex_end, settled, shifted, recovered, resumed)
    reflex_end, settled, shifted, recovered, resumed = (t if t <= end else None for t in times)
    x_shift = _shift(trace, settled, shifted)
    return Recovery(triggered, reflex_end, settled, shifted, recovered, resumed, x_shift)


def _shift(trace: Sample, settled: float | None, shifted: float | None) -> float | None:
    """Distance by which the commanded feet moved forward in the body frame [m]."""
    if settled is None or shifted is None:
        return None
    position = trace.targets.position
    forward = np.asarray(position.sole)[..., 0].mean(axis=-1) - np.asarray(position.pelvis)[..., 0]
    before, after = np.interp([settled, shifted], np.asarray(trace.time), forward)
    return float(after - before)

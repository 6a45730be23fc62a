"""A loss over a few control ticks of an event: its slope inside a tick, over all of them, and where it jumps.

Where an event takes effect at the next tick instead of at its instant, a loss is a sawtooth with a tooth a tick:
forward mode and narrow differences both give the slope inside a tooth, and neither gives that of the whole.
"""

from dataclasses import dataclass

import numpy as np

from jaxbiped.adapt.tunables import Tunable
from jaxbiped.tune import gradient
from jaxbiped.tune.gradient import Problem

JUMP = 10.0
"""A step between neighbors that is so many times the median one is a jump."""


@dataclass(frozen=True)
class Teeth:
    """One walk's loss over a few ticks of what one tunable moves."""

    tunable: Tunable
    at: np.ndarray
    """Values of the tunable, at equal distances (m,)."""
    losses: np.ndarray
    """Losses at these values (m,)."""
    forward: float
    """Slope by forward mode, in the middle."""

    @property
    def inside(self) -> float:
        """Slope inside a tooth: the median one between neighbors."""
        return float(np.median(np.diff(self.losses) / np.diff(self.at)))

    @property
    def over(self) -> float:
        """Slope over all ticks: of the straight line through all losses."""
        return float(np.polyfit(self.at - self.at.mean(), self.losses, 1)[0])

    @property
    def jumps(self) -> int:
        """Steps between neighbors that differ from the median one by more than JUMP times the median size of a step."""
        steps = np.diff(self.losses)
        noise = 1e-11 * np.max(np.abs(self.losses))
        off = np.abs(steps - np.median(steps))
        return int(np.sum(off > JUMP * np.median(np.abs(steps)) + noise))


def scan(problem: Problem, at: np.ndarray, row: int, ticks: int = 3, parts: int = 16) -> list[Teeth]:
    """Walk one scenario at points over `ticks` control ticks of what each tunable moves.

    Args:
        problem: whose loss.
        at: values of the tunables in the middle (k,).
        row: of the experiment's scenarios.
        ticks: control ticks, see `gradient.tick_widths`.
        parts: points in a tick.
    """
    found = gradient.forward(problem, at, np.array([row]))
    shares = np.arange(ticks * parts + 1) / parts - 0.5 * ticks
    width, k = gradient.tick_widths(problem, found), len(at)
    points = at + shares[None, :, None] * np.diag(width)[:, None]
    losses = gradient.losses_at(problem, points.reshape(-1, k), row).reshape(k, -1)
    return [
        Teeth(t, points[j, :, j], losses[j], float(found.by_scenario[0, j]))
        for j, t in enumerate(problem.tunables)
    ]

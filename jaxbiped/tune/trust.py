"""Trust in a gradient: forward mode beside its twins, the growth of its tangents, and what went wrong.

Forward mode is exact for the simulator as it is written, tick for tick. Where an event moves on by ticks the loss is a
sawtooth: forward mode and near central differences agree on the slope of a tooth, wide ones have the trend. And the
tangents of a walk that is about to fall grow beyond any use, which smoothing shows.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxbiped.tune import gradient
from jaxbiped.tune.gradient import Gradient, Problem

CLIP = 5.0
"""A scenario whose derivative is longer than so many times the median one is clipped to that."""
SAME = 0.1
"""Two slopes are the same if they differ by no more than this share of the larger one."""
TREND, TOOTH, NOISE = "trend", "tooth", "noise"
"""Kinds of a slope by forward mode."""
FORWARD, WIDE, MIXED = "forward", "wide", "mixed"
"""Gradients that a tunable can be descended by."""


@dataclass(frozen=True)
class Trust:
    """Forward mode, central differences and smoothing at one point."""

    problem: Problem
    forward: Gradient
    central: Gradient
    """Near central differences, over far less than a control tick of any event."""
    wide: Gradient
    """Central differences over several control ticks, see `gradient.wide_widths`."""
    smoothed: Gradient
    cost_per_tangent: float | None = None
    """Cost of a tangent beyond the walk itself, as a share of a walk; None if not measured."""

    @property
    def width(self) -> np.ndarray:
        """Ranges of the tunables (k,)."""
        return np.array([t.high - t.low for t in self.forward.tunables])

    @property
    def growth(self) -> np.ndarray:
        """Norm of the tangents of trunk and soles over `forward.growth_time`, per range, mean over scenarios (t,)."""
        return np.linalg.norm(self.forward.growth * self.width, axis=-1).mean(axis=0)

    @property
    def relative(self) -> np.ndarray:
        """|forward - central| over the larger of both (n, k); nan where both are zero, so that nothing was compared."""
        a, b = self.forward.by_scenario, self.central.by_scenario
        size = np.maximum(np.abs(a), np.abs(b))
        return np.where(size > 0.0, np.abs(a - b) / np.where(size > 0.0, size, 1.0), np.nan)

    @property
    def median_rel(self) -> float:
        """Median of `relative` over walks that did not fall."""
        kept = self.relative[self.forward.status == 0]
        return float(np.nanmedian(kept)) if np.isfinite(kept).any() else float("nan")

    @property
    def p90_rel(self) -> float:
        """90th percentile of `relative` over walks that did not fall."""
        kept = self.relative[self.forward.status == 0]
        return float(np.nanpercentile(kept, 90)) if np.isfinite(kept).any() else float("nan")

    def cosine(self, twin: Gradient) -> float:
        """Cosine between forward mode and a twin, per range of the tunables."""
        a, b = self.clipped_gradient * self.width, _clipped(twin, self.width) * self.width
        size = np.linalg.norm(a) * np.linalg.norm(b)
        return float(a @ b / size) if size > 0.0 else 1.0

    def sign_agreement(self, twin: Gradient) -> float:
        """Share of the tunables, weighted by their derivative, by which both fall or both rise."""
        a, b = self.clipped_gradient * self.width, _clipped(twin, self.width) * self.width
        weight = np.abs(a) + np.abs(b)
        return (
            float(np.sum(weight * (np.sign(a) == np.sign(b))) / weight.sum()) if weight.sum() > 0.0 else 1.0
        )

    @property
    def clipped_gradient(self) -> np.ndarray:
        """Forward mode, with the derivatives of single scenarios clipped."""
        return _clipped(self.forward, self.width)

    @property
    def share_clipped(self) -> float:
        """Share of the scenarios whose derivatives are clipped."""
        return float(np.mean(_scales(self.forward, self.width) < 1.0))

    @property
    def share_fallen(self) -> float:
        """Share of the scenarios in which the robot falls."""
        return float(np.mean(self.forward.status != 0))

    @property
    def slope(self) -> list[str]:
        """Kind of forward mode's slope by each tunable (k,).

        TREND: that of wide differences too. TOOTH: that of near differences, but the walks agree that wide ones have
        another. NOISE: it is neither, or the walks disagree too much to tell.
        """
        near, wide = (self._same(twin) for twin in (self.central, self.wide))
        apart = _parts(self.forward, self.width) - _parts(self.wide, self.width)
        clear = np.abs(apart.mean(axis=0)) > 2.0 * apart.std(axis=0) / np.sqrt(len(apart))
        return np.where(wide, TREND, np.where(near & clear, TOOTH, NOISE)).tolist()

    def _same(self, twin: Gradient) -> np.ndarray:
        """Tell whether forward mode and a twin have the same mean slope by each tunable (k,), or next to none."""
        a, b = self.clipped_gradient * self.width, _clipped(twin, self.width) * self.width
        size = np.maximum(np.abs(a), np.abs(b))
        return np.abs(a - b) <= np.maximum(SAME * size, 1e-3 * np.max(size))

    @property
    def trusted(self) -> np.ndarray:
        """Tunables by which forward mode has the trend, is more than noise and agrees with smoothing (k,).

        It is longer than its standard error over the scenarios, varies at most twice as much as smoothing, and is
        within three standard errors of it.
        """
        a, b = self.clipped_gradient, _clipped(self.smoothed, self.width)
        va, vb = _variance(self.forward, self.width), _variance(self.smoothed, self.width)
        error = np.sqrt(va + vb)
        largest = np.max(np.abs(b * self.width))
        small = np.maximum(np.abs(a), np.abs(b)) * self.width <= 1e-3 * largest
        agree = (np.abs(a - b) <= 3.0 * error) & (va <= 2.0 * vb)
        return ((agree & (a**2 > va)) | small) & (np.array(self.slope) == TREND)

    @property
    def descended(self) -> list[str]:
        """Return what each tunable is descended by (k,): FORWARD if trusted, else WIDE for a TOOTH, else MIXED."""
        teeth = np.array(self.slope) == TOOTH
        return np.where(self.trusted, FORWARD, np.where(teeth, WIDE, MIXED)).tolist()

    @property
    def mixture(self) -> np.ndarray:
        """The slope to descend (k,), see `descended`."""
        return mix(self.descended, self.forward, self.smoothed, self.wide)

    def lines(self) -> list[str]:
        """Lines of the report, for a person."""
        kept, n = int(np.sum(self.forward.status == 0)), len(self.forward.losses)
        twins = ("forward", "central", "wide", "smoothed")
        head = f"{'tunable':34s}" + "".join(f" {name:>11s}" for name in twins)
        slopes = np.stack([_clipped(getattr(self, name), self.width) * self.width for name in twins], axis=1)
        rows = [
            f"{t.name:34s}" + "".join(f" {s:11.4g}" for s in each) + f"   {kind:5s}   {by}"
            for t, each, kind, by in zip(
                self.forward.tunables, slopes, self.slope, self.descended, strict=True
            )
        ]
        growth = ", ".join(
            f"{g:.3g} at {t:.1f} s" for t, g in zip(self.forward.growth_time, self.growth, strict=True)
        )
        return [
            f"{head}   per range; slope, descended by",
            *rows,
            f"cosine with central differences {self.cosine(self.central):.4f}, with smoothing "
            f"{self.cosine(self.smoothed):.4f}; signs agree for {100 * self.sign_agreement(self.central):.0f} and "
            f"{100 * self.sign_agreement(self.smoothed):.0f} %",
            f"forward mode and central differences of single walks differ by {100 * self.median_rel:.2f} % (median), "
            f"{100 * self.p90_rel:.2f} % (90th percentile) over {kept} of {n} walks that did not fall",
            f"norm of the tangents: {growth}",
            f"{100 * self.share_fallen:.0f} % of the walks fall, {100 * self.share_clipped:.0f} % are clipped",
            *(
                []
                if self.cost_per_tangent is None
                else [f"a tangent costs {self.cost_per_tangent:.2f} walks"]
            ),
        ]

    def record(self) -> dict[str, Any]:
        """The report as plain numbers."""
        return {
            "tunables": [t.name for t in self.forward.tunables],
            "at": self.forward.at.tolist(),
            "loss": self.forward.value,
            "forward": self.clipped_gradient.tolist(),
            "central": _clipped(self.central, self.width).tolist(),
            "wide": _clipped(self.wide, self.width).tolist(),
            "smoothed": _clipped(self.smoothed, self.width).tolist(),
            "slope": self.slope,
            "trusted": self.trusted.tolist(),
            "descended": self.descended,
            "mixture": self.mixture.tolist(),
            "cosine": self.cosine(self.central),
            "cosine_smoothed": self.cosine(self.smoothed),
            "sign_agreement": self.sign_agreement(self.central),
            "sign_agreement_smoothed": self.sign_agreement(self.smoothed),
            "median_rel": self.median_rel,
            "p90_rel": self.p90_rel,
            "growth_time_s": self.forward.growth_time.tolist(),
            "growth": self.growth.tolist(),
            "share_fallen": self.share_fallen,
            "share_clipped": self.share_clipped,
            "cost_per_tangent": self.cost_per_tangent,
        }


def report(
    problem: Problem,
    at: np.ndarray,
    rows: np.ndarray,
    widths: gradient.Numbers | None = None,
    sigma: float = 0.02,
    pairs: int = 4,
    seed: int = 0,
    timed: bool = False,
) -> Trust:
    """Forward mode and its twins at a point.

    Args:
        problem: whose loss.
        at: values of the tunables (k,).
        rows: of the experiment's scenarios.
        widths: of the near central differences (k,), see `gradient.default_widths`.
        sigma: of the smoothing, as a share of each range.
        pairs: of the smoothing, for each scenario.
        seed: of the smoothing.
        timed: also measure what a tangent costs, which takes another gradient.
    """
    forward = gradient.forward(problem, at, rows)
    return Trust(
        problem,
        forward,
        gradient.central(problem, at, rows, widths),
        gradient.central(problem, at, rows, gradient.wide_widths(problem, forward)),
        gradient.smoothed(problem, at, rows, sigma, pairs, seed),
        _cost_per_tangent(problem, at, rows) if timed else None,
    )


def _cost_per_tangent(problem: Problem, at: np.ndarray, rows: np.ndarray) -> float:
    """Time of the gradient less that of the walks, over tangents and walks; both are compiled already."""
    walks = _seconds(lambda: gradient.outcomes(problem, at, rows))
    return (_seconds(lambda: gradient.forward(problem, at, rows)) - walks) / (len(at) * walks)


def _seconds(function: Callable[[], object]) -> float:
    began = time.perf_counter()
    function()
    return time.perf_counter() - began


def mix(by: Sequence[str], forward: Gradient, smoothed: Gradient, wide: Gradient) -> np.ndarray:
    """The slope to descend (k,).

    Args:
        by: for each tunable FORWARD, WIDE, or MIXED: forward mode and smoothing, weighted by their inverse variances.
        forward: forward mode.
        smoothed: smoothing.
        wide: wide central differences.
    """
    width = np.array([t.high - t.low for t in forward.tunables])
    a, b = _clipped(forward, width), _clipped(smoothed, width)
    va, vb = _variance(forward, width), _variance(smoothed, width)
    total = va + vb
    share = np.where(total > 0.0, vb / np.where(total > 0.0, total, 1.0), 0.5)
    slopes = {FORWARD: a, WIDE: _clipped(wide, width), MIXED: share * a + (1.0 - share) * b}
    return np.select([np.array(by) == name for name in slopes], list(slopes.values()))


def _scales(found: Gradient, width: np.ndarray) -> np.ndarray:
    """Factor on the derivatives of every scenario (n,): 1, less where it is clipped, 0 where it is not finite."""
    size = np.linalg.norm(np.where(found.finite[:, None], found.by_scenario, 0.0) * width, axis=1)
    moved = size[size > 0.0]
    limit = CLIP * np.median(moved) if moved.size else 1.0
    return np.where(found.finite, np.minimum(1.0, limit / np.maximum(size, 1e-30)), 0.0)


def _parts(found: Gradient, width: np.ndarray) -> np.ndarray:
    return np.where(found.finite[:, None], found.by_scenario, 0.0) * _scales(found, width)[:, None]


def _clipped(found: Gradient, width: np.ndarray) -> np.ndarray:
    return _parts(found, width).mean(axis=0)


def _variance(found: Gradient, width: np.ndarray) -> np.ndarray:
    """Variance of the mean over scenarios (k,)."""
    parts = _parts(found, width)
    return parts.var(axis=0, ddof=1) / len(parts) if len(parts) > 1 else np.full(parts.shape[1], np.inf)

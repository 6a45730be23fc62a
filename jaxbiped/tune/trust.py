"""How far a gradient can be trusted: forward mode beside its twins, the growth of its tangents, and what went wrong.

Forward mode is exact for the simulator as it is written, tick for tick, but not where a walk jumps; and the tangents of
a walk that is about to fall grow beyond any use. Central differences show the first, smoothing the second.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxbiped.tune import gradient
from jaxbiped.tune.gradient import Gradient, Problem

CLIP = 5.0
"""A scenario whose derivative is longer than so many times the median one is clipped to that."""


@dataclass(frozen=True)
class Trust:
    """Forward mode, central differences and smoothing at one point."""

    problem: Problem
    forward: Gradient
    central: Gradient
    smoothed: Gradient
    cost_per_tangent: float | None = None
    """Of the gradient beyond the walk itself, as a share of a walk; None if not measured."""

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
        """90th percentile of the same."""
        kept = self.relative[self.forward.status == 0]
        return float(np.nanpercentile(kept, 90)) if np.isfinite(kept).any() else float("nan")

    def cosine(self, twin: Gradient) -> float:
        """Between forward mode and a twin, per range of the tunables."""
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
        """Of the scenarios."""
        return float(np.mean(_scales(self.forward, self.width) < 1.0))

    @property
    def share_fallen(self) -> float:
        """Of the scenarios."""
        return float(np.mean(self.forward.status != 0))

    @property
    def trusted(self) -> np.ndarray:
        """Tunables by which forward mode is more than noise and agrees with smoothing (k,).

        It is longer than its standard error over the scenarios, varies at most twice as much as smoothing, and is
        within three standard errors of it.
        """
        a, b = self.clipped_gradient, _clipped(self.smoothed, self.width)
        va, vb = _variance(self.forward, self.width), _variance(self.smoothed, self.width)
        error = np.sqrt(va + vb)
        largest = np.max(np.abs(b * self.width))
        small = np.maximum(np.abs(a), np.abs(b)) * self.width <= 1e-3 * largest
        agree = (np.abs(a - b) <= 3.0 * error) & (va <= 2.0 * vb)
        return (agree & (a**2 > va)) | small

    @property
    def mixture(self) -> np.ndarray:
        """What to descend: forward mode where it is trusted, elsewhere both by their inverse variances (k,)."""
        return mix(self.forward, self.smoothed, self.trusted)

    def lines(self) -> list[str]:
        """The report, to read."""
        kept, n = int(np.sum(self.forward.status == 0)), len(self.forward.losses)
        head = (
            f"{'tunable':34s} {'forward':>11s} {'central':>11s} {'smoothed':>11s}   per range; descended by"
        )
        rows = [
            f"{t.name:34s} {f:11.4g} {c:11.4g} {s:11.4g}   {'forward' if ok else 'MIXED'}"
            for t, f, c, s, ok in zip(
                self.forward.tunables,
                self.clipped_gradient * self.width,
                _clipped(self.central, self.width) * self.width,
                _clipped(self.smoothed, self.width) * self.width,
                self.trusted,
                strict=True,
            )
        ]
        growth = ", ".join(
            f"{g:.3g} at {t:.1f} s" for t, g in zip(self.forward.growth_time, self.growth, strict=True)
        )
        return [
            head,
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
            "smoothed": _clipped(self.smoothed, self.width).tolist(),
            "trusted": self.trusted.tolist(),
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
    widths: Any = None,
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
        widths: of the central differences (k,), see `gradient.default_widths`.
        sigma: of the smoothing, as a share of each range.
        pairs: of the smoothing, for each scenario.
        seed: of the smoothing.
        timed: also measure what a tangent costs, which takes another gradient.
    """
    return Trust(
        problem,
        gradient.forward(problem, at, rows),
        gradient.central(problem, at, rows, widths),
        gradient.smoothed(problem, at, rows, sigma, pairs, seed),
        _cost_per_tangent(problem, at, rows) if timed else None,
    )


def _cost_per_tangent(problem: Problem, at: np.ndarray, rows: np.ndarray) -> float:
    """Time of the gradient less that of the walks, over tangents and walks; both are compiled already."""
    walks = _seconds(lambda: gradient.outcomes(problem, at, rows))
    return (_seconds(lambda: gradient.forward(problem, at, rows)) - walks) / (len(at) * walks)


def _seconds(function: Callable[[], Any]) -> float:
    began = time.perf_counter()
    function()
    return time.perf_counter() - began


def mix(forward: Gradient, other: Gradient, trusted: np.ndarray) -> np.ndarray:
    """Forward mode where it is trusted, elsewhere the mean of both, weighted by their inverse variances (k,)."""
    width = np.array([t.high - t.low for t in forward.tunables])
    a, b = _clipped(forward, width), _clipped(other, width)
    va, vb = _variance(forward, width), _variance(other, width)
    total = va + vb
    share = np.where(total > 0.0, vb / np.where(total > 0.0, total, 1.0), 0.5)
    return np.where(trusted, a, share * a + (1.0 - share) * b)


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
    """Of the mean over scenarios (k,)."""
    parts = _parts(found, width)
    return parts.var(axis=0, ddof=1) / len(parts) if len(parts) > 1 else np.full(parts.shape[1], np.inf)

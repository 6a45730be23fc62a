"""Tuning: descend a loss over scenarios inside the tunables' bounds, stop by scenarios that were held out.

Adam in the logarithm of a tunable's way up over its way down, where there are no bounds. Every step takes a few
scenarios of the experiment; at intervals a trust report says which gradient to descend until the next one, and the
held-out scenarios say whether it was worth it. All that is known stands in one file after every step.
"""

import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxbiped import batch, files
from jaxbiped.batch import records, store
from jaxbiped.checked import Quantity, whole
from jaxbiped.score import Loss
from jaxbiped.tune import gradient, trust
from jaxbiped.tune.gradient import Problem

EDGE = 1e-3
"""Least distance of a start from a bound, as a share of the range."""
STATE = "tune.json"


@dataclass(frozen=True)
class Settings:
    """Settings of a descent."""

    steps: int = 40
    scenarios: int = 16
    """Scenarios in a step."""
    rate: float = 0.15
    """Largest change of the unconstrained variables in a step."""
    trust_every: int = 20
    """Steps between trust reports."""
    held_out_every: int = 5
    """Steps between looks at the held-out scenarios."""
    patience: int = 4
    """Looks without a smaller held-out loss before it stops."""
    sigma: float = 0.03
    """Width of the smoothing, as a share of each range."""
    pairs: int = 2
    """Pairs of points of the smoothing for each scenario."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        for name in ("steps", "scenarios", "trust_every", "held_out_every", "patience", "pairs"):
            whole(name, getattr(self, name), 1, 1_000_000)
        whole("seed", self.seed, 0, 2**31 - 1)
        for name in ("rate", "sigma"):
            Quantity(low=0.0, high=1.0, above=True).check(name, getattr(self, name))


@dataclass
class Descent:
    """State of a descent."""

    step: int = 0
    z: list[float] = field(default_factory=list)
    """Unconstrained values."""
    first: list[float] = field(default_factory=list)
    """First moments of Adam."""
    second: list[float] = field(default_factory=list)
    """Second moments of Adam."""
    by: list[str] = field(default_factory=list)
    """Gradient by which each tunable is descended, as in the last trust report."""
    widths: list[float] = field(default_factory=list)
    """Widths of the wide central differences, as in the last trust report."""
    best: dict[str, Any] = field(default_factory=dict)
    """Values with the smallest held-out loss, and what it was."""
    history: list[dict[str, Any]] = field(default_factory=list)
    """One object for every step."""
    reports: list[dict[str, Any]] = field(default_factory=list)
    """Trust reports, with their step."""
    finished: str = ""
    """Reason why the descent ended; empty while it goes on."""


@dataclass(frozen=True)
class Tuned:
    """Result of a descent."""

    problem: Problem
    settings: Settings
    values: np.ndarray
    """Values of the tunables with the smallest held-out loss (k,)."""
    before: dict[str, float]
    """Held-out loss and success at the start."""
    after: dict[str, float]
    """Held-out loss and success at `values`."""
    descent: Descent


def tune(
    problem: Problem,
    held_out: batch.Experiment,
    out: Path,
    settings: Settings | None = None,
    tell: Callable[[str], None] = lambda line: None,
    overwrite: bool = False,
) -> Tuned:
    """Tune a variant; goes on where it was stopped.

    Args:
        problem: what is tuned, on which scenarios.
        held_out: the same variants in scenarios that no step sees.
        out: folder of the state.
        settings: how.
        tell: is given a line of progress after every step.
        overwrite: drop the state of another descent in the folder; that of this one is gone on with.

    Raises:
        ValueError: if the folder holds the state of another descent.
    """
    settings = settings or Settings()
    judge = Problem(held_out, problem.tunables, problem.loss, problem.variant)
    state = _load(out, problem, judge, settings, overwrite)
    while not state.finished:
        _advance(state, problem, judge, settings, tell)
        _save(out, state, problem, judge, settings)
    first = next(h for h in state.history if "held_out_loss" in h)
    before, after = ({k: float(h[f"held_out_{k}"]) for k in ("loss", "success")} for h in (first, state.best))
    return Tuned(problem, settings, np.asarray(state.best["at"]), before, after, state)


def _advance(
    state: Descent, problem: Problem, judge: Problem, settings: Settings, tell: Callable[[str], None]
) -> None:
    """One step: look at the held-out scenarios, report on trust, descend."""
    at = to_values(problem, np.asarray(state.z))
    entry: dict[str, Any] = {"step": state.step, "at": at.tolist()}
    if state.step % settings.held_out_every == 0 or state.step >= settings.steps:
        entry |= held_out_score(judge, at)
        if not state.best or entry["held_out_loss"] < state.best["held_out_loss"]:
            state.best = dict(entry)
        looks = [h["step"] for h in [*state.history, entry] if "held_out_loss" in h]
        if sum(step > state.best["step"] for step in looks) >= settings.patience:
            state.finished = f"no smaller held-out loss in {settings.patience} looks"
    if state.step >= settings.steps:
        state.finished = state.finished or f"{settings.steps} steps"
    if not state.finished:
        entry |= _descend(state, problem, settings, at)
    state.history.append(entry)
    state.step += 1
    tell(_line(entry))


def _descend(state: Descent, problem: Problem, settings: Settings, at: np.ndarray) -> dict[str, Any]:
    rng = np.random.default_rng([settings.seed, state.step])
    n = problem.experiment.table.height
    rows = rng.choice(n, min(settings.scenarios, n), replace=False)
    if state.step % settings.trust_every == 0:
        report = trust.report(problem, at, rows, sigma=settings.sigma, pairs=settings.pairs, seed=state.step)
        state.by = report.descended
        state.widths = gradient.wide_widths(problem, report.forward).tolist()
        state.reports.append({"step": state.step, **report.record()})
        forward, slope = report.forward, report.mixture
    else:
        forward = smoothed = wide = gradient.forward(problem, at, rows)
        if trust.MIXED in state.by:
            smoothed = gradient.smoothed(problem, at, rows, settings.sigma, settings.pairs, state.step)
        if trust.WIDE in state.by:
            wide = gradient.central(problem, at, rows, state.widths)
        slope = trust.mix(state.by, forward, smoothed, wide)
    slope = slope * _range_slope(problem, np.asarray(state.z))
    _adam(state, slope, settings.rate)
    fell = float(np.mean(forward.status != 0))
    return {"loss": forward.value, "gradient_norm": float(np.linalg.norm(slope)), "share_fallen": fell}


def _adam(state: Descent, slope: np.ndarray, rate: float) -> None:
    """One step of Adam, its state kept as plain numbers."""
    try:
        import optax
    except ImportError as error:
        raise ImportError("tuning needs optax: pip install 'jaxbiped[tune]'") from error
    method = optax.scale_by_adam()
    adam = optax.ScaleByAdamState(
        jnp.asarray(state.step), jnp.asarray(state.first), jnp.asarray(state.second)
    )
    way, adam = method.update(jnp.asarray(slope), adam)
    assert isinstance(adam, optax.ScaleByAdamState)
    state.z = (np.asarray(state.z) - rate * np.asarray(way)).tolist()
    state.first, state.second = np.asarray(adam.mu).tolist(), np.asarray(adam.nu).tolist()


def held_out_score(judge: Problem, at: np.ndarray) -> dict[str, float]:
    """Mean loss, of the walks that have one, and share of successes of all scenarios of a problem."""
    losses, success = gradient.outcomes(judge, at, np.arange(judge.experiment.table.height))
    return {"held_out_loss": float(np.nanmean(losses)), "held_out_success": float(np.mean(success))}


def to_values(problem: Problem, z: np.ndarray) -> np.ndarray:
    """Values of the tunables within their bounds."""
    low, high = _bounds(problem)
    return low + (high - low) / (1.0 + np.exp(-z))


def to_unconstrained(problem: Problem, at: np.ndarray) -> np.ndarray:
    """Undo `to_values`; values on a bound are moved a little into the range."""
    low, high = _bounds(problem)
    share = np.clip((at - low) / (high - low), EDGE, 1.0 - EDGE)
    return np.log(share / (1.0 - share))


def _bounds(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    return np.array([t.low for t in problem.tunables]), np.array([t.high for t in problem.tunables])


def _range_slope(problem: Problem, z: np.ndarray) -> np.ndarray:
    low, high = _bounds(problem)
    share = 1.0 / (1.0 + np.exp(-z))
    return (high - low) * share * (1.0 - share)


def _line(entry: dict[str, Any]) -> str:
    parts = [f"step {entry['step']:3d}"]
    if "loss" in entry:
        parts.append(f"loss {entry['loss']:.4f}, gradient {entry['gradient_norm']:.3g}")
        parts.append(f"{100 * entry['share_fallen']:.0f} % fall")
    if "held_out_loss" in entry:
        parts.append(
            f"held out: loss {entry['held_out_loss']:.4f}, success {100 * entry['held_out_success']:.1f} %"
        )
    return "   ".join(parts)


def _key(problem: Problem, judge: Problem, settings: Settings) -> str:
    """Hash of all that decides a descent."""
    what = {
        "experiments": [p.experiment.resolved for p in (problem, judge)],
        "tunables": [asdict(t) for t in problem.tunables],
        "loss": _name(problem.loss),
        "variant": problem.variant,
        "settings": {**asdict(settings), "steps": 0},  # more steps go on with the same descent
        "code": store.code(),
    }
    return records.digest(what)


def _name(loss: Loss) -> str:
    """Name of a loss: its class, and its fields if it shows them."""
    shown = "" if type(loss).__repr__ is object.__repr__ else repr(loss)
    return f"{type(loss).__module__}.{type(loss).__qualname__} {shown}"


def require_same(out: Path, problem: Problem, held_out: batch.Experiment, settings: Settings) -> None:
    """Refuse a folder with the state of another descent, or one that cannot be read; nothing is changed.

    Raises:
        ValueError: naming the folder.
    """
    judge, path = Problem(held_out, problem.tunables, problem.loss, problem.variant), out / STATE
    if os.path.lexists(path) and _read(path, problem, judge, settings) is None:
        raise ValueError(
            f"out: got '{out}' with the state of another descent, or one that was changed, in {STATE}, "
            "allowed: another folder, or overwrite it"
        )


def _read(path: Path, problem: Problem, judge: Problem, settings: Settings) -> Descent | None:
    """The state in a file; None if it is of another descent or damaged."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        key, digest = kept.pop("key"), kept.pop("sha256")
        same = key == _key(problem, judge, settings) and digest == records.digest(kept)
        return Descent(**kept) if same else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _load(out: Path, problem: Problem, judge: Problem, settings: Settings, overwrite: bool) -> Descent:
    if not overwrite:
        require_same(out, problem, judge.experiment, settings)
    state = _read(out / STATE, problem, judge, settings)
    if state is None:
        z, k = to_unconstrained(problem, problem.start), len(problem.tunables)
        return Descent(z=z.tolist(), first=[0.0] * k, second=[0.0] * k, by=[trust.FORWARD] * k)
    if state.finished.endswith("steps") and state.step <= settings.steps:
        state.finished, state.step = "", state.step - 1
        state.history.pop()
    return state


def _save(out: Path, state: Descent, problem: Problem, judge: Problem, settings: Settings) -> None:
    out.mkdir(parents=True, exist_ok=True)
    kept = json.loads(json.dumps(asdict(state)))
    # The digest is of the state as it stands in the file, so that one that was changed is not gone on with.
    said = {"key": _key(problem, judge, settings), "sha256": records.digest(kept), **kept}
    files.write(out / STATE, json.dumps(said, indent=1))

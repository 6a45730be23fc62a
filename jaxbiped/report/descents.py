"""Figures of tuning: losses and values over the steps of a descent, derivatives beside finite differences."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxbiped.report.figures import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, Figure

COLORS = (BLUE, ORANGE, GREEN, PURPLE, INK, FAINT)


def loss_curve(history: Sequence[Mapping[str, Any]], title: str) -> Figure:
    """Loss and norm of the gradient of every step, and the held-out loss and success where they were looked at.

    Args:
        history: of a descent, one mapping for every step.
        title: heading.
    """
    figure = Figure(figsize=(8.0, 5.5), layout="constrained")
    losses, success = figure.subplots(2, 1, sharex=True)
    tuned, looked = ([h for h in history if name in h] for name in ("loss", "held_out_loss"))
    losses.plot(*_curve(tuned, "loss"), color=FAINT, lw=1.0, label="loss of the step's scenarios")
    losses.plot(*_curve(looked, "held_out_loss"), "o-", color=BLUE, label="held-out loss")
    losses.set_ylabel("loss")
    slope = losses.twinx()
    slope.semilogy(*_curve(tuned, "gradient_norm"), ":", color=ORANGE, lw=1.2)
    slope.set_ylabel("norm of the gradient (dotted)", color=ORANGE)
    x, y = _curve(looked, "held_out_success")
    success.plot(x, 100.0 * np.asarray(y), "o-", color=GREEN)
    success.set_ylabel("held-out success [%]")
    success.set_ylim(-3.0, 103.0)
    success.set_xlabel("step")
    losses.legend(loc="upper right", frameon=False)
    figure.suptitle(title)
    return figure


def value_curves(
    history: Sequence[Mapping[str, Any]],
    names: Sequence[str],
    ranges: Sequence[tuple[float, float]],
    title: str,
) -> Figure:
    """Every tunable over the steps, as a share of its range.

    Args:
        history: of a descent.
        names: of the tunables (k).
        ranges: lowest and highest values (k, 2).
        title: heading.
    """
    low, high = np.asarray(ranges, float).T
    at = np.array([h["at"] for h in history])
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.subplots()
    for i, name in enumerate(names):
        dashes = ("-", "--", ":")[i // len(COLORS) % 3]
        color = COLORS[i % len(COLORS)]
        axes.plot(
            [h["step"] for h in history],
            (at[:, i] - low[i]) / (high - low)[i],
            dashes,
            color=color,
            label=name,
        )
    axes.set_ylim(-0.02, 1.02)
    axes.set_xlabel("step")
    axes.set_ylabel("place in its range")
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    figure.suptitle(title)
    return figure


def sensitivity(
    x: np.ndarray,
    derivatives: np.ndarray,
    secants: np.ndarray,
    names: Sequence[str],
    label: str,
    title: str,
) -> Figure:
    """Derivatives of the loss of single walks over loading time or height, over the finite-difference secants.

    Args:
        x: loading time or height of every walk (n,).
        derivatives: by forward mode, per range of the tunable (n, k).
        secants: by central differences, likewise.
        names: of the tunables (k).
        label: of x, with its unit.
        title: heading.
    """
    order = np.argsort(np.asarray(x))
    x, derivatives, secants = (np.asarray(a)[order] for a in (x, derivatives, secants))
    columns = 2 if len(names) > 3 else 1
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(5.0 * columns + 1.0, 1.7 * rows + 1.0), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False).T.reshape(-1)
    for i, (panel, name) in enumerate(zip(panels, names, strict=False)):
        panel.axhline(0.0, color=FAINT, lw=0.6)
        panel.plot(x, secants[:, i], "o", mfc="none", color=ORANGE, ms=5, label="secant")
        panel.plot(x, derivatives[:, i], "x", color=BLUE, ms=4, label="derivative")
        known = np.abs(secants[np.isfinite(secants[:, i]), i])
        reach = np.percentile(known, 95) if known.size else 0.0
        outside = 0
        if reach > 0.0:
            panel.set_ylim(-2.0 * reach, 2.0 * reach)
            outside = sum(
                int((np.abs(values[:, i]) > 2.0 * reach).sum()) for values in (secants, derivatives)
            )
        beyond = f" ({outside} beyond the panel)" if outside else ""
        panel.set_title(f"{name}{beyond}", fontsize=9, loc="left")
    for panel in panels[len(names) :]:
        panel.remove()
    panels[0].legend(frameon=False, fontsize=8)
    figure.supxlabel(label)
    figure.supylabel("derivative of the loss, per range of the tunable")
    figure.suptitle(title)
    return figure


def _curve(entries: Sequence[Mapping[str, Any]], name: str) -> tuple[list[int], list[float]]:
    return [h["step"] for h in entries], [h[name] for h in entries]

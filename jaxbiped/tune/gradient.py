"""Value and gradient of a loss over many scenarios by a controller's tunables: forward mode, and its twins.

Forward mode carries the tangents along with the walk: memory does not grow with the horizon, and the walk itself is
computed once for all of them. The twins share nothing with it but the simulator: central differences over the same
scenarios and seeds, and antithetic Gaussian smoothing, which also sees what happens at some distance.
"""

import dataclasses
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxbiped import batch, runtime, sim
from jaxbiped.adapt import Controller, tunables
from jaxbiped.adapt.tunables import Tunable
from jaxbiped.score import Loss, WalkLoss
from jaxbiped.sim.compile import backend
from jaxbiped.sim.options import AUTO, MJX, XLA, C
from jaxbiped.tune.walks import Setting, walk_slopes, walk_values
from jaxbiped.tune.walks_in_c import WalksInC

Numbers = np.ndarray | Array | Sequence[float | int]
"""Values as a caller may give them."""
R = TypeVar("R")

LANES = 64
"""Most walks in one call; as many calls are made at once as XLA has threads."""
WIDE_TICKS = 5
"""Control ticks over which wide central differences let an event move, at least."""
WIDE_SHARE, WIDEST_SHARE = 2e-3, 1e-2
"""Least width of wide differences, and the most for what moves a reflex's start, as shares of a range."""


@dataclass(frozen=True)
class Gradient:
    """Losses of walks and their derivatives."""

    tunables: tuple[Tunable, ...]
    at: np.ndarray
    """Values of the tunables (k,)."""
    losses: np.ndarray
    """Loss of every scenario (n,)."""
    by_scenario: np.ndarray
    """Derivatives of the losses (n, k), per unit of the tunable."""
    status: np.ndarray
    """Number in `sim.STATUS_TEXT` of every walk (n,)."""
    success: np.ndarray
    """Whether each walk succeeded by the papers' rules (n,)."""
    seconds: float
    """Wall time, compiling included."""
    growth_time: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Times of `growth` since the start of the walk [s] (about SAMPLES,); none but with forward mode."""
    growth: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0)))
    """Norms of the tangents of trunk and soles then [m and rad per unit of the tunable] (n, times, k)."""
    trigger_slope: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """Derivatives of the start of the last reflex [s per unit of the tunable], 0 without one; only with forward mode
    (n, k)."""

    @property
    def value(self) -> float:
        """Mean loss of the walks that have one."""
        return float(np.nanmean(self.losses))

    @property
    def gradient(self) -> np.ndarray:
        """Gradient of the mean loss (k,); derivatives that are not finite are left out."""
        return np.nan_to_num(np.nanmean(np.where(self.finite[:, None], self.by_scenario, np.nan), axis=0))

    @property
    def finite(self) -> np.ndarray:
        """Tell which scenarios have finite derivatives (n,)."""
        return np.all(np.isfinite(self.by_scenario), axis=1)


@dataclass(frozen=True)
class Problem:
    """A variant of an experiment, its tunables, and the loss that is asked for."""

    experiment: batch.Experiment
    tunables: tuple[Tunable, ...]
    loss: Loss
    variant: str
    compiled: set[object] = field(default_factory=set, repr=False, compare=False)
    """Functions that have been called, and for how many walks."""

    @classmethod
    def of(
        cls,
        experiment: batch.Experiment,
        names: Sequence[str],
        loss: Loss | None = None,
        variant: str | None = None,
    ) -> "Problem":
        """Check what is asked for.

        Raises:
            ValueError: naming what was got and what is allowed.
        """
        variant = next(iter(experiment.variants)) if variant is None else variant
        if variant not in experiment.variants:
            raise ValueError(f"variant: got '{variant}', allowed: {', '.join(experiment.variants)}")
        found = tunables.find(names, experiment.variants[variant])
        return cls(experiment, tuple(found), WalkLoss() if loss is None else loss, variant)

    @property
    def controller(self) -> Controller:
        """Controller of the variant."""
        return self.experiment.variants[self.variant]

    @property
    def start(self) -> np.ndarray:
        """Values of the tunables in the variant."""
        return np.asarray(tunables.values(self.controller, self.tunables), float)

    @property
    def duration(self) -> float:
        """Simulated time of every walk [s]."""
        return self.experiment.durations[self.variant]

    @cached_property
    def in_c(self) -> WalksInC:
        """Walks of the setting in machine code."""
        return WalksInC(self.setting)

    def walked_in_c(self, points: np.ndarray, walk: Callable[[], R]) -> R | None:
        """Walk at such values (n, k) in machine code, which `auto` takes wherever it can; None where XLA has to walk.

        A gradient's program takes XLA as long to compile as it takes the C compiler, so that little work is no reason
        for XLA, as it is for plain walks.
        """
        wanted, options = self.experiment.options.backend, self.setting.simulation.options
        can = wanted == C or (wanted == AUTO and backend.serves(options))
        if not can or not self.in_c.serves(points):
            return None
        try:
            return walk()
        except backend.NotServedError as error:
            if wanted == C:
                raise
            self.in_c.can = False
            warnings.warn(f"{error}; it is walked by XLA", stacklevel=2)
            return None

    @cached_property
    def setting(self) -> Setting:
        """Everything that the compiled functions need."""
        one = jax.tree.map(lambda leaf: leaf[0], self.scenarios(np.zeros(1, int)))
        robot, options = self.experiment.robot, dataclasses.replace(self.experiment.simulation, backend=XLA)
        simulation = sim.prepare(robot, self.controller, options, sim.rectangles_of(one))
        ticks = simulation.ticks(self.duration)
        return Setting(simulation, self.loss, self.tunables, jnp.asarray(self.duration), jnp.asarray(ticks))

    def scenarios(self, rows: np.ndarray) -> sim.Scenario:
        """Scenarios of these rows, as a leading axis."""
        found = batch.scenarios_of(self.experiment.table[rows.tolist()], self.experiment.pads)
        return found if self.experiment.options.contact == MJX else sim.with_room(found)


def value_and_grad(
    experiment: batch.Experiment,
    names: Sequence[str],
    at: Numbers | None = None,
    loss: Loss | None = None,
    variant: str | None = None,
    rows: Numbers | None = None,
) -> Gradient:
    """Losses and derivatives by forward mode.

    Args:
        experiment: robot, variants and scenarios; float64 where JAX is set to it.
        names: of the tunables, see `adapt.tunables`.
        at: their values (k,); those of the variant if not given.
        loss: of one walk; `WalkLoss` if not given.
        variant: name; the first one if not given.
        rows: of the experiment's scenarios; all if not given.
    """
    problem = Problem.of(experiment, names, loss, variant)
    return forward(problem, _point(problem, at), _rows(problem, rows))


def forward(problem: Problem, at: np.ndarray, rows: np.ndarray) -> Gradient:
    """Forward mode at a point."""
    began, n, point = time.perf_counter(), len(rows), jnp.asarray(at)
    walked = problem.walked_in_c(
        np.broadcast_to(at, (n, len(at))),
        lambda: problem.in_c.walk_slopes(np.asarray(point), problem.scenarios(rows)),
    )
    if walked is None:
        calls = [(point, problem.scenarios(piece)) for piece in _pieces(rows)]
        parts = _side_by_side(problem, walk_slopes, calls)
        walked = jax.tree.map(lambda *few: np.concatenate(few)[:n], *parts)
    losses, slopes, trigger, growth, became = walked
    made = _gradient(problem, at, losses, slopes, became, began)
    return dataclasses.replace(made, growth_time=became["time"][0], growth=growth, trigger_slope=trigger)


def central(problem: Problem, at: np.ndarray, rows: np.ndarray, widths: Numbers | None = None) -> Gradient:
    """Central differences over the same scenarios; half of their `widths` (k,) to each side, see `default_widths`."""
    began, n, k = time.perf_counter(), len(rows), len(problem.tunables)
    width = 0.5 * (default_widths(problem) if widths is None else np.asarray(widths, float))
    points = np.concatenate([at[None], at + np.diag(width), at - np.diag(width)])
    value, became = _walked(problem, rows, np.broadcast_to(points[:, None], (2 * k + 1, n, k)))
    slope = (value[1 : k + 1] - value[k + 1 :]) / (2.0 * width)[:, None]
    return _gradient(problem, at, value[0], slope.T, became, began)


def default_widths(problem: Problem) -> np.ndarray:
    """Widths of central differences (k,): 2e-5 of each range in float64, 2e-3 in noisier float32."""
    share = 2e-5 if jnp.result_type(float) == jnp.float64 else 2e-3
    return share * _ranges(problem)


def tick_widths(problem: Problem, found: Gradient) -> np.ndarray:
    """Change of each tunable that moves its event by one control tick (k,).

    A time moves its event one to one. What moves the start of a reflex does so by its derivative: the median one of the
    walks that `found` has it of. For the others, and at most, a share of the range.
    """
    tick, ranges = problem.experiment.simulation.control_dt, _ranges(problem)
    widths = WIDE_SHARE / WIDE_TICKS * ranges
    for j, t in enumerate(problem.tunables):
        rates = np.abs(found.trigger_slope[:, j])
        rates = rates[np.isfinite(rates) & (rates > 0.0)]
        if t.unit == "s":
            widths[j] = tick
        elif rates.size:
            widths[j] = min(tick / np.median(rates), WIDEST_SHARE / WIDE_TICKS * ranges[j])
    return widths


def wide_widths(problem: Problem, found: Gradient) -> np.ndarray:
    """Widths of wide central differences (k,): at least WIDE_TICKS ticks of what each tunable moves."""
    return np.maximum(WIDE_TICKS * tick_widths(problem, found), WIDE_SHARE * _ranges(problem))


def losses_at(problem: Problem, points: np.ndarray, row: int) -> np.ndarray:
    """Losses (m,) of one scenario at many points (m, k)."""
    return _walked(problem, np.full(len(points), row), points[None])[0][0]


def _ranges(problem: Problem) -> np.ndarray:
    return np.array([t.high - t.low for t in problem.tunables])


def smoothed(
    problem: Problem, at: np.ndarray, rows: np.ndarray, sigma: float = 0.02, pairs: int = 4, seed: int = 0
) -> Gradient:
    """Antithetic Gaussian smoothing; `sigma` is a share of each tunable's range, every scenario has its own pairs."""
    began, k, width = time.perf_counter(), len(problem.tunables), _ranges(problem)
    way = np.random.default_rng(seed).standard_normal((pairs, len(rows), k))
    moved = sigma * width * way
    value, became = _walked(problem, rows, np.concatenate([0.0 * moved[:1] + at, at + moved, at - moved]))
    difference = (value[1 : pairs + 1] - value[pairs + 1 :]) / (2.0 * sigma)
    slope = np.mean(difference[..., None] * way, axis=0) / width
    return _gradient(problem, at, value[0], slope, became, began)


def outcomes(problem: Problem, at: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Losses and successes (n,), without derivatives."""
    value, became = _walked(problem, rows, np.broadcast_to(at, (1, len(rows), len(at))))
    return value[0], became["success"]


def _walked(problem: Problem, rows: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Losses (m, n) of n scenarios at m points each (m, n, k), and what became of the walks at the first ones."""
    m, n, k = at.shape
    points = np.asarray(jnp.asarray(at.reshape(m * n, k)))  # as JAX rounds them
    in_c = problem.walked_in_c(
        points, lambda: problem.in_c.walk_values(points, problem.scenarios(np.tile(rows, m)))
    )
    if in_c is not None:
        values, became = in_c
        return values.reshape(m, n), {name: of_all[:n] for name, of_all in became.items()}
    pieces = _pieces(np.arange(n))
    scenarios = [problem.scenarios(rows[piece]) for piece in pieces]
    calls = [
        (jnp.asarray(each[piece]), own) for each in at for piece, own in zip(pieces, scenarios, strict=True)
    ]
    walked = _side_by_side(problem, walk_values, calls)
    losses = np.stack([loss for loss, _ in walked]).reshape(m, -1)[:, :n]
    first = [became for _, became in walked[: len(pieces)]]
    return losses, jax.tree.map(lambda *parts: np.concatenate(parts)[:n], *first)


def _side_by_side(
    problem: Problem,
    function: Callable[[Setting, Array, sim.Scenario], R],
    calls: list[tuple[Array, sim.Scenario]],
) -> list[R]:
    """Results of a compiled function for many arguments of the same shapes, one thread for each of XLA's.

    The first call of all goes ahead: it compiles, which every thread would do for itself.
    """
    double = jnp.result_type(float) == jnp.float64  # a setting of this thread only

    def one(call: tuple[Array, sim.Scenario]) -> R:
        with jax.enable_x64(double):
            return jax.block_until_ready(function(problem.setting, *call))

    made = (function, calls[0][0].shape, calls[0][1].payload.mass.shape)
    ahead = 0 if made in problem.compiled else 1
    found = [one(call) for call in calls[:ahead]]
    problem.compiled.add(made)
    with ThreadPoolExecutor(runtime.threads()) as pool:
        return found + list(pool.map(one, calls[ahead:]))


def _gradient(
    problem: Problem,
    at: np.ndarray,
    losses: np.ndarray,
    slopes: np.ndarray,
    became: dict[str, np.ndarray],
    began: float,
) -> Gradient:
    took = time.perf_counter() - began
    at = np.asarray(at, float)
    return Gradient(problem.tunables, at, losses, slopes, became["status"], became["success"], took)


def _pieces(rows: np.ndarray) -> np.ndarray:
    """Rows in pieces of one size, one for every thread and LANES at most; the last row fills up the last piece."""
    room = min(LANES, -(-len(rows) // runtime.threads()))
    return np.concatenate([rows, np.full(-len(rows) % room, rows[-1])]).reshape(-1, room)


def _point(problem: Problem, at: Numbers | None) -> np.ndarray:
    if at is None:
        return problem.start
    at = np.asarray(at, float)
    if at.shape != (len(problem.tunables),) or not np.all(np.isfinite(at)):
        raise ValueError(f"at: got {at.tolist()}, allowed: {len(problem.tunables)} finite numbers")
    return at


def _rows(problem: Problem, rows: Numbers | None) -> np.ndarray:
    n = problem.experiment.table.height
    rows = np.arange(n) if rows is None else np.asarray(rows, int)
    if rows.ndim != 1 or not len(rows) or rows.min() < 0 or rows.max() >= n:
        raise ValueError(f"rows: got {rows.tolist()}, allowed: numbers from 0 to {n - 1}")
    return rows

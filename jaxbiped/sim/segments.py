"""Whole walks by segments of a fixed number of control ticks, driven from the host.

One compiled program serves every duration, traced or not, in as many lanes as there are: it goes on by a segment, and a
walk whose time is over, or whose robot has failed, stays as it is until the segment ends. Then it makes way for the
next scenario, and when all have finished, no further segment is begun.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from jaxbiped import runtime
from jaxbiped.planner import at
from jaxbiped.sim.compile import backend
from jaxbiped.sim.compile.trace import shared_leaves
from jaxbiped.sim.options import XLA
from jaxbiped.sim.scenario import Scenario
from jaxbiped.sim.tick import PureSimulation, Sample, State, Walk, sampled

Told = Callable[[float], None]
"""Function that is told which fraction of something is done."""
Further = Callable[[State], tuple[State, Any]]
"""Function from states to those a segment later, and which walks have stopped."""
SEGMENT = 0.5
"""Length of a segment [s]."""
STARTING, COMPILING, WALKING = "getting the start ready", "getting the walk ready", "walking"
"""Said of a run while it goes on. Getting ready is tracing and compiling, or finding in the cache what was compiled."""
MAX_ROWS = 25
"""Rows of a trace in a segment, where a trace is asked for."""


def run(
    simulation: PureSimulation,
    scenarios: Scenario,
    duration: float,
    told: Told | None = None,
    lanes: int | None = None,
) -> Walk:
    """Walk all scenarios for `duration` [s]; see `Simulation.run_many`, which checks them."""
    ticks = simulation.ticks(duration)
    told = told or (lambda _: None)
    runtime.now(STARTING)
    try:
        return _run(simulation, scenarios, ticks, told, lanes)
    finally:
        runtime.now("")


def _run(simulation: PureSimulation, scenarios: Scenario, ticks: int, told: Told, lanes: int | None) -> Walk:
    n = len(scenarios.ground.sinkage)
    chosen = backend.chosen(simulation.options, n * ticks * simulation.options.control_every)
    if simulation.options.trace_every:
        return _traced(simulation, scenarios, ticks, told, chosen)
    lanes = n if lanes is None else min(lanes, n)
    further: Further = partial(_segment, simulation)
    if chosen != XLA:
        further = backend.segments(simulation, ticks_of_segment(simulation))
    if lanes == n:
        return _at_once(simulation, scenarios, ticks, told, further)
    return _in_turn(simulation, scenarios, ticks, told, further, lanes)


def _at_once(
    simulation: PureSimulation, scenarios: Scenario, ticks: int, told: Told, further: Further
) -> Walk:
    """Walk all scenarios at once, each in its own lane."""
    states, walked = _begin(simulation, scenarios, _count(ticks)), 0
    stopped = ticks <= 0
    runtime.now(COMPILING)
    while not stopped:
        states, stops = further(states)
        runtime.now(WALKING)
        walked += ticks_of_segment(simulation)
        stopped = bool(np.all(stops))
        told(1.0 if stopped else walked / ticks)
    return _walk(states)


def _in_turn(
    simulation: PureSimulation, scenarios: Scenario, ticks: int, told: Told, further: Further, lanes: int
) -> Walk:
    """Walk in fewer lanes than scenarios: a lane that has finished takes the next one."""
    n = len(scenarios.ground.sinkage)
    holds, waiting = np.arange(lanes), lanes
    walks: list[Walk | None] = [None] * n
    states = _begin(simulation, _take(scenarios, holds), _count(ticks))
    runtime.now(COMPILING)
    while any(walk is None for walk in walks):
        states, stops = further(states)
        runtime.now(WALKING)
        done = np.flatnonzero(np.asarray(stops) & (holds < n))
        if not done.size:
            continue
        finished = jax.tree.map(np.asarray, _walk(states))
        for lane in done:
            walks[holds[lane]] = jax.tree.map(lambda leaf, lane=lane: leaf[lane], finished)
        holds[done] = np.minimum(np.arange(waiting, waiting + done.size), n)
        waiting += done.size
        fresh = np.zeros(lanes, bool)
        fresh[done] = True
        coming = _take(scenarios, np.minimum(holds, n - 1))
        states = _renewed(simulation, states, jnp.asarray(fresh), coming, _count(ticks))
        told(sum(walk is not None for walk in walks) / n)
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *walks)


RowsLater = Callable[[State], tuple[State, Sample | None]]
"""Function from states to those MAX_ROWS rows of a trace later, and the rows."""


def _traced(simulation: PureSimulation, scenarios: Scenario, ticks: int, told: Told, chosen: str) -> Walk:
    """Walk all scenarios, each in its own lane, and trace them; the last rows of a trace may stand still."""
    rows = ticks // simulation.options.trace_every
    states = _begin(simulation, scenarios, _count(rows * simulation.options.trace_every))
    parts: list[Sample] = []
    runtime.now(COMPILING)
    rows_later: RowsLater = partial(_rows_by_xla, simulation)
    if chosen != XLA:
        rows_later = _rows_in_c(simulation, states)
    for start in range(0, max(rows, 1), MAX_ROWS):
        states, part = rows_later(states)
        parts.append(jax.tree.map(np.asarray, part))
        told(min(1.0, (start + MAX_ROWS) / max(rows, 1)))
    trace = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1)[:, :rows], *parts)  # on the host
    return _walk(states, trace)


class Tracing(eqx.Module):
    """A walk that has come so far, and what was seen in its last tick."""

    state: State
    sample: Sample


def traced_tick(simulation: PureSimulation, tracing: Tracing) -> tuple[Tracing, Bool[Array, ""]]:
    """Advance a walk by a control tick, and keep what is seen; pure."""
    return Tracing(*simulation.tick(tracing.state)), jnp.zeros((), bool)


def _rows_in_c(simulation: PureSimulation, states: State) -> RowsLater:
    """The same as `_rows_by_xla`, in machine code or of scalars, for walks that begin so."""
    n, every = len(states.left), simulation.options.trace_every
    blank = Sample.blank(at(simulation.controller.gait, jnp.zeros((), states.time.dtype)))
    samples = jax.tree.map(lambda leaf: np.zeros((n, *leaf.shape), leaf.dtype), blank)
    kind = backend.kind_of(simulation.options)
    machine = backend.machine_of(
        simulation, Tracing(backend.endless(states), samples), traced_tick, kind=kind
    )
    leaves = shared_leaves(simulation)

    def further(states: State) -> tuple[State, Sample]:
        tracing, rows = Tracing(states, samples), []
        for _row in range(MAX_ROWS):
            tracing = machine.advance(leaves, tracing, every, runtime.threads())
            rows.append(tracing.sample)
        return tracing.state, jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *rows)

    return further


def _walk(states: State, trace: Sample | None = None) -> Walk:
    return Walk(states.record.statistics, trace, states.controller)


def ticks_of_segment(simulation: PureSimulation) -> int:
    """Control ticks of a segment."""
    return max(1, round(SEGMENT / simulation.options.control_dt))


def _count(ticks: int) -> Int[Array, ""]:
    return jnp.asarray(ticks, jnp.int32)


def _take(scenarios: Scenario, rows: np.ndarray) -> Scenario:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[rows], scenarios)


@runtime.jit
def _begin(simulation: PureSimulation, scenarios: Scenario, ticks: Int[Array, ""]) -> State:
    return jax.vmap(lambda scenario: simulation.start(scenario, ticks))(scenarios)


@runtime.jit
def _segment(simulation: PureSimulation, states: State) -> tuple[State, Bool[Array, " n"]]:
    """Return the states a segment later, and which walks have stopped."""

    def further(state: State) -> tuple[State, Bool[Array, ""]]:
        state = jax.lax.fori_loop(0, ticks_of_segment(simulation), lambda _, s: simulation.tick(s)[0], state)
        return state, state.stopped

    return jax.vmap(further)(states)


@runtime.jit
def _rows_by_xla(simulation: PureSimulation, states: State) -> tuple[State, Sample | None]:
    """The states MAX_ROWS rows later, and the rows."""
    ticks = MAX_ROWS * simulation.options.trace_every
    return jax.vmap(lambda state: sampled(simulation.tick, state, ticks, MAX_ROWS))(states)


@runtime.jit
def _renewed(
    simulation: PureSimulation,
    states: State,
    fresh: Bool[Array, " lanes"],
    scenarios: Scenario,
    ticks: Int[Array, ""],
) -> State:
    """The states with new walks begun in some lanes."""

    def begun(old: Array, new: Array) -> Array:
        return jnp.where(jnp.reshape(fresh, (-1, *[1] * (old.ndim - 1))), new, old)

    new = jax.vmap(lambda scenario: simulation.start(scenario, ticks))(scenarios)
    return jax.tree.map(begun, states, new)

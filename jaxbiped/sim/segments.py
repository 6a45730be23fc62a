"""Whole walks by segments of a fixed number of control ticks, driven from the host.

One compiled program serves every duration, traced or not, in as many lanes as there are: it goes on by a segment, and a
walk whose time is over, or whose robot has failed, stays as it is until the segment ends. Then it makes way for the
next scenario, and when all have finished, no further segment is begun.

XLA compiles for a number of lanes: few numbers are used, the last scenario fills what is left over. What does not
matter to a walk, as names, is left out, so that robots and variants of a kind share programs.
"""

import dataclasses
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
from jaxbiped.robot import nameless
from jaxbiped.sim.compile import backend
from jaxbiped.sim.compile.trace import shared_leaves
from jaxbiped.sim.options import COMPLIANT, XLA, Options
from jaxbiped.sim.scenario import Scenario, with_room
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
FEW_LANES = (4, 16, 32)
"""Numbers of lanes that XLA compiles for; beyond the last one, its multiples."""
BLOCK, LARGE_BLOCK = 16, 1024
"""Walks that are begun at once, and if there are many."""


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
    every, simulation = simulation.options.trace_every, _bare(simulation)
    if simulation.options.contact == COMPLIANT:
        scenarios = with_room(scenarios)
    if every:
        return _traced(simulation, scenarios, ticks, every, told, chosen)
    lanes = n if lanes is None else min(lanes, n)
    if chosen == XLA:
        lanes, simulation = rounded(lanes), _for_xla(simulation)
        further: Further = partial(_segment, simulation)
    else:
        further = backend.segments(simulation, ticks_of_segment(simulation))
    if lanes >= n:
        return _at_once(simulation, scenarios, ticks, told, further, lanes)
    return _in_turn(simulation, scenarios, ticks, told, further, lanes)


def _bare(simulation: PureSimulation) -> PureSimulation:
    """The same simulation without what would be compiled in and does not matter to a tick: names, and the trace."""
    options = dataclasses.replace(simulation.options, trace_every=0)
    return dataclasses.replace(simulation, robot=nameless(simulation.robot), options=options)


def _for_xla(simulation: PureSimulation) -> PureSimulation:
    """The same simulation, whoever chose XLA."""
    return dataclasses.replace(simulation, options=dataclasses.replace(simulation.options, backend=XLA))


def rounded(lanes: int) -> int:
    """Number of lanes that XLA walks so many scenarios in, see FEW_LANES."""
    return next((few for few in FEW_LANES if lanes <= few), lanes + -lanes % FEW_LANES[-1])


def begun(simulation: PureSimulation, scenarios: Scenario, ticks: int) -> State:
    """The walks' states at their start, with so many control ticks ahead.

    One program begins any number of walks, whatever the stages, engine, backend and (without noise) length of a tick:
    what depends on them is put in afterwards.
    """
    n, options = len(scenarios.ground.sinkage), simulation.options
    plain = Options(payload_model=options.payload_model, delay_room=options.delay_room)
    if options.noise:  # the last reading but one was a tick ago
        timed = {"dt": options.dt, "control_every": options.control_every, "noise": True}
        plain = dataclasses.replace(plain, **timed)
    one = dataclasses.replace(simulation, robot=nameless(simulation.robot), options=plain)
    if simulation.controller.stages:
        one = eqx.tree_at(lambda s: s.controller.stages, one, ())
    block = BLOCK if n <= LARGE_BLOCK else LARGE_BLOCK
    states = runtime.in_blocks(partial(_begin, one, ticks=_count(ticks)), block, scenarios)
    own = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (n, *leaf.shape)), simulation.controller.init())
    time = np.full_like(states.next_time, options.control_dt)
    states = eqx.tree_at(lambda s: (s.controller, s.next_time), states, (own, time))
    return jax.tree.map(jnp.asarray, states)  # JAX compiles for NumPy's arrays anew


def _at_once(
    simulation: PureSimulation, scenarios: Scenario, ticks: int, told: Told, further: Further, lanes: int
) -> Walk:
    """Walk all scenarios at once, each in its own lane; the last one also in those that are left over."""
    n = len(scenarios.ground.sinkage)
    states = begun(simulation, _take(scenarios, np.minimum(np.arange(lanes), n - 1)), ticks)
    walked, stopped = 0, ticks <= 0
    runtime.now(COMPILING)
    while not stopped:
        states, stops = further(states)
        runtime.now(WALKING)
        walked += ticks_of_segment(simulation)
        stopped = bool(np.all(stops))
        told(1.0 if stopped else walked / ticks)
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[:n]), _walk(states))


def _in_turn(
    simulation: PureSimulation, scenarios: Scenario, ticks: int, told: Told, further: Further, lanes: int
) -> Walk:
    """Walk in fewer lanes than scenarios: a lane that has finished takes the next one."""
    n = len(scenarios.ground.sinkage)
    holds, waiting = np.arange(lanes), lanes
    walks: list[Walk | None] = [None] * n
    states = begun(simulation, _take(scenarios, holds), ticks)
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
        if len(coming := done[holds[done] < n]):
            new = begun(simulation, _take(scenarios, holds[coming]), ticks)
            states = jax.tree.map(partial(_put, coming), states, new)
        told(sum(walk is not None for walk in walks) / n)
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *walks)


def _put(lanes: np.ndarray, old: Array | np.ndarray, new: Array) -> Array:
    """The same numbers, with new ones in some lanes."""
    both = np.array(old)
    both[lanes] = new
    return jnp.asarray(both)


RowsLater = Callable[[State], tuple[State, Sample | None]]
"""Function from states to those MAX_ROWS rows of a trace later, and the rows."""


def _traced(
    simulation: PureSimulation, scenarios: Scenario, ticks: int, every: int, told: Told, chosen: str
) -> Walk:
    """Walk all scenarios, each in its own lane, and trace them; the last rows of a trace may stand still."""
    rows = ticks // every
    states = begun(simulation, scenarios, rows * every)
    parts: list[Sample] = []
    runtime.now(COMPILING)
    rows_later: RowsLater = partial(_rows_by_xla, _for_xla(simulation), every=_count(every))
    if chosen != XLA:
        rows_later = _rows_in_c(simulation, states, every)
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


def _rows_in_c(simulation: PureSimulation, states: State, every: int) -> RowsLater:
    """The same as `_rows_by_xla`, in machine code or of scalars, for walks that begin so."""
    n = len(states.left)
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
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], scenarios)


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
def _rows_by_xla(
    simulation: PureSimulation, states: State, every: Int[Array, ""]
) -> tuple[State, Sample | None]:
    """The states MAX_ROWS rows later, one row `every` so many control ticks, and the rows."""
    return jax.vmap(lambda state: sampled(simulation.tick, state, MAX_ROWS * every, MAX_ROWS))(states)

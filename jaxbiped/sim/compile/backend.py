"""Whole segments of batched walks in machine code: `Options(backend="c")`.

The pure tick stays the only source. It is traced and compiled at the first use in a process, and compared there with
what XLA makes of it; afterwards segments run in C.
"""

from collections.abc import Hashable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Bool

from jaxbiped import runtime
from jaxbiped.sim.compile.interpret import UnknownPrimitiveError
from jaxbiped.sim.compile.machine import Machine
from jaxbiped.sim.compile.trace import is_part, program_of, shared_leaves, trace
from jaxbiped.sim.options import XLA
from jaxbiped.sim.tick import ENDLESS, PureSimulation, State

MOVING, COMPARED, TICKS = 50, 16, 3
"""Control ticks to a moving state, lanes and control ticks from there, in which machine code is compared with XLA's."""
ROUNDING = {4: 2e-3, 8: 1e-8}
"""By bytes of a number, the largest difference after them by the largest magnitude of a variable, or by 1."""
ODD_LANES = 1 / 8
"""Share of lanes that may differ by more, since a threshold was passed on one side only."""

_machines: dict[Hashable, Machine] = {}


def segment(simulation: PureSimulation, states: State, ticks: int) -> tuple[State, Bool[np.ndarray, " n"]]:
    """States with a leading axis so many control ticks later, and which walks have stopped.

    Raises:
        ValueError: where there is no C compiler, and where the machine code does not do what XLA's does.
    """
    states = machine_of(simulation, states).advance(shared_leaves(simulation), states, ticks)
    return states, np.asarray(jax.vmap(lambda state: state.stopped)(states))


def machine_of(simulation: PureSimulation, states: State) -> Machine:
    """The machine code of a simulation, made, and compared, at its first use."""
    key = _key(simulation, states)
    if key not in _machines:
        _machines[key] = _made(simulation, states)
    return _machines[key]


def _made(simulation: PureSimulation, states: State) -> Machine:
    """Traced, compiled and compared."""
    states = jax.tree.map(np.asarray, states)
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), states)
    closed = trace(simulation, one)
    try:
        program = program_of(closed, simulation, one)
        machine = Machine(program, single=states.time.dtype == np.float32)
    except UnknownPrimitiveError as error:
        raise ValueError(f"backend: 'c' cannot do this walk: {error}; allowed: {XLA}") from error
    compare(machine, closed, simulation, states)
    return machine


def compare(machine: Machine, closed: Any, simulation: PureSimulation, states: State) -> None:
    """Refuse machine code that does not do what XLA's does, from a moving state on.

    Raises:
        ValueError: with the name of the variable that differs most.
    """
    leaves = shared_leaves(simulation)
    few = np.arange(COMPARED) % len(states.time)
    states = jax.tree.map(lambda leaf: leaf[few], states)
    states = eqx.tree_at(lambda s: s.left, states, np.full(COMPARED, ENDLESS, np.int32))
    before = machine.advance(leaves, states, MOVING)
    ours, theirs = before, before
    tick = _by_xla(closed, leaves)
    for _ in range(TICKS):
        ours, theirs = machine.advance(leaves, ours, 1), tick(theirs)
    name, odd = worst(ours, theirs)
    if odd > ODD_LANES:
        raise ValueError(f"backend: 'c' differs from XLA in {name} in {odd:.0%} of lanes; allowed: {XLA}")


def worst(ours: State, theirs: State) -> tuple[str, float]:
    """The variable in which most lanes differ by more than rounding, and their share."""
    pairs = zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(theirs), strict=True)
    shares = [
        (float(np.mean(_odd(np.asarray(a), np.asarray(b)))), jax.tree_util.keystr(p)[1:])
        for (p, a), b in pairs
    ]
    share, name = max(shares)
    return name, share


def _odd(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Which lanes differ."""
    a, b = a.reshape(len(a), -1), b.reshape(len(b), -1)
    if a.dtype.kind != "f":
        return np.asarray((a != b).any(axis=1))
    finite = np.isfinite(b)
    size = max(1.0, np.abs(b[finite]).max(initial=0.0))
    close = np.isclose(a, b, rtol=0.0, atol=ROUNDING[a.dtype.itemsize] * size, equal_nan=True)
    return np.logical_not(np.all(close, axis=1))


def _by_xla(closed: Any, leaves: list[np.ndarray]) -> Any:
    """The traced tick, compiled by XLA for all lanes, as a function of states; compiled fast rather than well."""

    def tick(states: State) -> State:
        each, tree = jax.tree.flatten(states)
        outs = jax.vmap(lambda *lane: jaxpr_as_fun(closed)(*leaves, *lane))(*each)
        return jax.tree.unflatten(tree, outs[:-1])

    return runtime.jit_arrays(tick, xla_backend_optimization_level=0)


def _key(simulation: PureSimulation, states: State) -> Hashable:
    """All that machine code depends on."""
    arrays, rest = eqx.partition(simulation, eqx.is_array)
    shared = shared_leaves(simulation)
    parts = tuple((leaf.shape, leaf.dtype.char, *_part(leaf)) for leaf in shared)
    like = tuple((leaf.shape[1:], np.dtype(leaf.dtype).char) for leaf in jax.tree.leaves(states))
    fixed, tree = jax.tree.flatten(rest)
    known = tuple(x.tobytes() if isinstance(x, np.ndarray) else x for x in fixed)
    return parts, like, known, tree, jax.tree.structure(arrays), jax.tree.structure(states)


def _part(leaf: np.ndarray) -> tuple[bytes, bytes]:
    part = is_part(leaf)
    return part.tobytes(), leaf[part].tobytes()

"""A tick as a program of scalars: by what all lanes share (a simulation), and by the state of one lane."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool

from jaxbiped.sim.compile.arrays import Values, filled
from jaxbiped.sim.compile.graph import Graph, Scalar
from jaxbiped.sim.compile.interpret import ROLLED, scalarise
from jaxbiped.sim.compile.program import Program, Word
from jaxbiped.sim.tick import PureSimulation, State

TABLE = 1024
"""Elements from which on an array is a table, in which even zeros are given."""


Step = Callable[[Any, Any], tuple[Any, Bool[Array, ""]]]
"""A pure function of a module: from what all lanes share and the state of one of them to the state after a tick, and
whether no further tick changes it."""


def tick(simulation: PureSimulation, state: State) -> tuple[State, Bool[Array, ""]]:
    """Advance a walk by a control tick: the step of all walks that nothing else is asked of."""
    new = simulation.tick(state)[0]
    return new, new.stopped


def trace(shared: Any, state: Any, step: Step = tick) -> Any:
    """Jaxpr of a step: of the arrays of what is shared and a state, to the state and whether it stops.

    Args:
        shared: by all lanes, as the simulation.
        state: of one lane, or its shapes.
        step: what is traced.
    """
    arrays, rest = eqx.partition(shared, eqx.is_array)
    return jax.make_jaxpr(lambda arrays, state: step(eqx.combine(arrays, rest), state))(arrays, state)


def program_of(
    closed: Any,
    shared: Any,
    state: Any,
    rolled: int = ROLLED,
    known: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Program:
    """The program of a traced step.

    Args:
        closed: the traced step.
        shared: by all lanes.
        state: of one lane, or its shapes.
        rolled: equations of a loop body from which on it stays a loop.
        known: tells which numbers of a shared array are part of the program, others being given; `is_part` if not
            given.
    """
    graph, leaves = Graph(), shared_leaves(shared)
    first = len(leaves)
    inputs = [_given(graph, leaf, values, known or is_part) for leaf, values in enumerate(leaves)]
    words: list[Word] = []
    for leaf, like in enumerate(jax.tree.leaves(state), first):
        mine = [Word(leaf, i, like.dtype) for i in range(int(np.prod(like.shape, dtype=int)))]
        words += mine
        nodes = (graph.input(*word.place, word.dtype) for word in mine)
        inputs.append(filled(nodes, like.shape, like.dtype))
    outs = scalarise(closed, inputs, graph, rolled)
    after: list[Scalar] = [scalar for out in outs[:-1] for scalar in out.reshape(-1)]
    return Program(graph, words, after, outs[-1].reshape(-1)[0])


def shared_leaves(shared: Any) -> list[np.ndarray]:
    """Arrays of what is shared."""
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(shared, eqx.is_array))]


def is_part(values: np.ndarray) -> np.ndarray:
    """Tell which numbers of a shared array are part of the program."""
    if values.dtype.kind != "f":
        return np.ones(values.shape, bool)
    return np.asarray(np.isin(values, (0.0, 1.0, -1.0)) & (values.size < TABLE))


def _given(graph: Graph, leaf: int, values: np.ndarray, known: Callable[[np.ndarray], np.ndarray]) -> Values:
    flat, part = values.reshape(-1), known(values).reshape(-1)
    scalars = (flat[i] if part[i] else graph.input(leaf, i, values.dtype) for i in range(flat.size))
    return filled(scalars, values.shape, values.dtype)

"""The tick of a simulation as a program of scalars."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxbiped.sim.compile.arrays import Values, filled
from jaxbiped.sim.compile.graph import Graph, Scalar
from jaxbiped.sim.compile.interpret import ROLLED, scalarise
from jaxbiped.sim.compile.program import Program, Word
from jaxbiped.sim.tick import PureSimulation, State

TABLE = 1024
"""Elements from which on an array is a table, in which even zeros are given."""


def trace(simulation: PureSimulation, state: State) -> Any:
    """Jaxpr of a control tick of one lane: of the simulation's arrays and a state, to the state and whether it stops.

    Args:
        simulation: what walks.
        state: of one lane, or its shapes.
    """
    arrays, rest = eqx.partition(simulation, eqx.is_array)

    def tick(arrays: PureSimulation, state: State) -> tuple[State, Any]:
        new = eqx.combine(arrays, rest).tick(state)[0]
        return new, new.stopped

    return jax.make_jaxpr(tick)(arrays, state)


def program_of(closed: Any, simulation: PureSimulation, state: State, rolled: int = ROLLED) -> Program:
    """The program of a traced tick. Numbers of the simulation that are 0, 1 or -1 are part of it, others are given."""
    graph, shared = Graph(), shared_leaves(simulation)
    first = len(shared)
    inputs = [_given(graph, leaf, values) for leaf, values in enumerate(shared)]
    words: list[Word] = []
    for leaf, like in enumerate(jax.tree.leaves(state), first):
        mine = [Word(leaf, i, like.dtype) for i in range(int(np.prod(like.shape, dtype=int)))]
        words += mine
        nodes = (graph.input(*word.place, word.dtype) for word in mine)
        inputs.append(filled(nodes, like.shape, like.dtype))
    outs = scalarise(closed, inputs, graph, rolled)
    after: list[Scalar] = [scalar for out in outs[:-1] for scalar in out.reshape(-1)]
    return Program(graph, words, after, outs[-1].reshape(-1)[0])


def shared_leaves(simulation: PureSimulation) -> list[np.ndarray]:
    """Arrays of a simulation."""
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(simulation, eqx.is_array))]


def is_part(values: np.ndarray) -> np.ndarray:
    """Tell which numbers of a shared array are part of the program."""
    if values.dtype.kind != "f":
        return np.ones(values.shape, bool)
    return np.asarray(np.isin(values, (0.0, 1.0, -1.0)) & (values.size < TABLE))


def _given(graph: Graph, leaf: int, values: np.ndarray) -> Values:
    flat, part = values.reshape(-1), is_part(values).reshape(-1)
    scalars = (flat[i] if part[i] else graph.input(leaf, i, values.dtype) for i in range(flat.size))
    return filled(scalars, values.shape, values.dtype)

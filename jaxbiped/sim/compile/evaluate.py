"""A graph computed by NumPy on arrays of lanes: what is the same for all lanes, and a check of machine code."""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxbiped.sim.compile.graph import AFTER, CARRY, INPUT, TAKE, Node, Scalar, compute
from jaxbiped.sim.compile.program import Program

Given = Callable[[int], Any]
"""All elements of a leaf, flat."""
Values = dict[int, Any]


def evaluate(nodes: list[Node], values: Values, given: Given) -> None:
    """Compute nodes in order; those that are already among the values stay."""
    for node in nodes:
        if node.number in values or node.op in (CARRY, AFTER):
            continue
        if node.op == INPUT:
            leaf, element = node.param
            values[node.number] = given(leaf)[element]
        elif node.op == TAKE:
            leaf, first, step, _ = node.param
            values[node.number] = given(leaf)[first + step * value_of(node.args[0], values)]
        else:
            values[node.number] = compute(node.op, node.dtype, (value_of(arg, values) for arg in node.args))


def value_of(scalar: Scalar, values: Values) -> Any:
    """Return the value of a node, or the number itself."""
    return values[scalar.number] if isinstance(scalar, Node) else scalar


def one_tick(program: Program, words: list[np.ndarray], given: Given) -> list[np.ndarray]:
    """The words of all lanes after a tick, from the words before it and what is shared."""
    graph, lanes = program.graph, words[0].shape
    place = {word.place: value for word, value in zip(program.words, words, strict=True)}
    values = {n.number: place[n.param] for n in program.order if n.op == INPUT and n.param in place}
    evaluate(_of_phase(program, 0), values, given)
    for loop in graph.loops:
        carried = [value_of(scalar, values) for scalar in loop.start]
        body, inside = _of_phase(program, 2 * loop.number + 1), dict(values)
        for _ in range(loop.length):
            inside = dict(values)
            for i, value in enumerate(carried):
                inside[graph.make(CARRY, (), loop.dtypes[i], (loop.number, i)).number] = value
            evaluate(body, inside, given)
            carried = [_if_there(scalar, inside) for scalar in loop.next]
        left = [*carried, *(_if_there(scalar, inside) for scalar in loop.rows)]
        for node in program.order:
            if node.op == AFTER and node.param[0] == loop.number:
                values[node.number] = left[node.param[1]]
        evaluate(_of_phase(program, 2 * loop.number + 2), values, given)
    return [
        np.broadcast_to(value_of(s, values), lanes).astype(w.dtype)
        for s, w in zip(program.after, program.words, strict=True)
    ]


def _if_there(scalar: Scalar, values: Values) -> Any:
    """None for what nothing needs."""
    return values.get(scalar.number) if isinstance(scalar, Node) else scalar


def _of_phase(program: Program, phase: int) -> list[Node]:
    return [node for node in program.order if program.phase[node.number] == phase]

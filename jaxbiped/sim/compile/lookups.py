"""Primitives that look elements up: at known places, by a choice among a few, or from a table by its index."""

from typing import Any

import numpy as np
from jax import lax

from jaxbiped.sim.compile.arrays import Values, filled, is_known, joined, objects, picked
from jaxbiped.sim.compile.graph import INPUT, TAKE, Graph, Node, Scalar
from jaxbiped.sim.compile.interpret import Equation, Interpreter, UnknownPrimitiveError, out_type, rule
from jaxbiped.sim.compile.moves import ordered, starts_of, windows

MOST_CHOICES = 24
"""Choices up to which a look-up is a tree of selections."""


def choose(graph: Graph, dtype: np.dtype, index: Scalar, choices: list[Scalar]) -> Scalar:
    """One of some scalars by an index, which counts as within them."""
    if not isinstance(index, Node):
        return choices[int(np.clip(index, 0, len(choices) - 1))]
    if all(choice is choices[0] for choice in choices):
        return choices[0]
    if len(choices) > MOST_CHOICES:
        return _taken(graph, dtype, index, choices)
    return _tree(graph, dtype, index, choices, 0)


def _tree(graph: Graph, dtype: np.dtype, index: Node, choices: list[Scalar], first: int) -> Scalar:
    """Choose by halves; `first` is the number of the first choice."""
    if len(choices) == 1:
        return choices[0]
    half = len(choices) // 2
    below = graph.op("lt", bool, index, index.dtype.type(first + half))
    high = _tree(graph, dtype, index, choices[half:], first + half)
    return graph.op("select", dtype, below, high, _tree(graph, dtype, index, choices[:half], first))


def _taken(graph: Graph, dtype: np.dtype, index: Node, choices: list[Scalar]) -> Scalar:
    """Look up in a table: elements of one given array, at equal distances."""
    places = [choice.param for choice in choices if isinstance(choice, Node) and choice.op == INPUT]
    if len(places) < len(choices) or len({leaf for leaf, _ in places}) > 1:
        raise UnknownPrimitiveError(f"look-up among {len(choices)} computed numbers")
    leaf, first = places[0]
    step = places[1][1] - first
    if any(place != first + k * step for k, (_, place) in enumerate(places)):
        raise UnknownPrimitiveError("look-up in a table at unequal distances")
    kind, top = index.dtype, len(choices) - 1
    row = graph.op("min", kind, graph.op("max", kind, index, kind.type(0)), kind.type(top))
    return graph.make(TAKE, (row,), dtype, (leaf, first, step, top + 1))


@rule("dynamic_slice")
def _dynamic_slice(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    x, *starts = ins
    tops = [n - size for n, size in zip(x.shape, eqn.params["slice_sizes"], strict=True)]
    columns = [objects(start).reshape(-1)[0] for start in starts]

    def positions(values: list[int]) -> np.ndarray:
        return windows(x.shape, np.array(values, int), eqn.params["slice_sizes"], dropped=False)

    rows = [columns] * eqn.outvars[0].aval.size
    return [_looked_up(of, eqn, x, rows, tops, positions)]


@rule("gather")
def _gather(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    x, indices = ins
    dropped = eqn.params["mode"] == lax.GatherScatterMode.FILL_OR_DROP
    if is_known(indices):
        known = _positions(eqn, x.shape, indices, dropped)
        if known.min(initial=0) < 0:
            raise UnknownPrimitiveError("'gather' outside of its operand")
        return [picked(joined([x]), known, out_type(eqn))]
    if dropped:
        raise UnknownPrimitiveError("'gather' that fills up, at places that are not known")
    numbers, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    tops = [x.shape[axis] - sizes[axis] for axis in numbers.start_index_map]
    each_row = objects(indices).reshape(-1, len(tops))

    def positions(values: list[int]) -> np.ndarray:
        at = np.broadcast_to(np.asarray(values, eqn.invars[1].aval.dtype), indices.shape)
        return _positions(eqn, x.shape, at, dropped=False)

    rows = [list(each_row[row]) for row in _rows_of(eqn).reshape(-1)]
    return [_looked_up(of, eqn, x, rows, tops, positions)]


def _positions(eqn: Equation, shape: tuple[int, ...], indices: Values, dropped: bool) -> np.ndarray:
    """Positions in the operand of a gather's output, by known indices."""
    numbers, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    batch = zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True)
    starts = starts_of(indices, len(shape), list(map(int, numbers.start_index_map)), list(batch))
    single = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    kept = [size for axis, size in enumerate(sizes) if axis not in single]
    places = windows(shape, starts, sizes, dropped).reshape((*starts.shape[:-1], *kept))
    return ordered(places, list(map(int, numbers.offset_dims)))


def _rows_of(eqn: Equation) -> np.ndarray:
    """Number, for every element of a gather's output, the row of indices that it is looked up by."""
    shape = eqn.outvars[0].aval.shape
    batch = [axis for axis in range(len(shape)) if axis not in eqn.params["dimension_numbers"].offset_dims]
    sizes = [shape[axis] for axis in batch]
    rows = np.arange(int(np.prod(sizes, dtype=int))).reshape(sizes)
    for axis in range(len(shape)):
        if axis not in batch:
            rows = np.expand_dims(rows, axis)
    return np.broadcast_to(rows, shape)


def _looked_up(
    of: Interpreter, eqn: Equation, x: Values, rows: list[list[Scalar]], tops: list[int], positions: Any
) -> Values:
    """Elements by rows of indices, since a position is a linear function of every index that is within bounds."""
    origin = positions([0] * len(tops)).reshape(-1)
    steps = [np.zeros_like(origin)] * len(tops)
    for axis, top in enumerate(tops):
        if top > 0:
            steps[axis] = positions([int(k == axis) for k in range(len(tops))]).reshape(-1) - origin
    flat, dtype = joined([x]), out_type(eqn)

    def one(element: int) -> Scalar:
        row = rows[element]
        free = [axis for axis, index in enumerate(row) if isinstance(index, Node) and tops[axis] > 0]
        fixed = [0 if isinstance(i, Node) else int(np.clip(i, 0, t)) for i, t in zip(row, tops, strict=True)]
        base = int(origin[element]) + sum(int(v * s[element]) for v, s in zip(fixed, steps, strict=True))
        return _among(of.graph, dtype, flat, base, [(row[a], tops[a], int(steps[a][element])) for a in free])

    shape = eqn.outvars[0].aval.shape
    return filled(map(one, range(origin.size)), shape, dtype)


def _among(
    graph: Graph, dtype: np.dtype, flat: Values, base: int, free: list[tuple[Node, int, int]]
) -> Scalar:
    """The element at a position that grows with some indices."""
    if not free:
        return flat[base]
    (index, top, step), *others = free
    if others and np.prod([t + 1 for _, t, _ in free]) > MOST_CHOICES**2:
        raise UnknownPrimitiveError("look-up in a table by several indices")
    choices = [_among(graph, dtype, flat, base + k * step, others) for k in range(top + 1)]
    return choose(graph, dtype, index, choices)

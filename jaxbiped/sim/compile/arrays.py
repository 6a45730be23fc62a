"""Arrays of scalars: numbers where every one is known, else objects that are nodes or NumPy scalars."""

from collections.abc import Iterable

import numpy as np

from jaxbiped.sim.compile.graph import Graph, Key, Node, Scalar

Values = np.ndarray
"""Of a number type where all is known, else of objects."""


def is_known(x: Values) -> bool:
    """Tell whether every element is a number."""
    return x.dtype != object


def objects(x: Values) -> Values:
    """The same as objects."""
    if x.dtype == object:
        return x
    out = np.empty(x.shape, object)
    flat = out.reshape(-1)
    for i, value in enumerate(x.reshape(-1)):
        flat[i] = value
    return out


def tidy(x: Values, dtype: np.dtype) -> Values:
    """The same as numbers, where every element is one."""
    if x.dtype != object or any(isinstance(element, Node | Key) for element in x.flat):
        return x
    return np.array(list(x.flat), dtype).reshape(x.shape)


def filled(scalars: Iterable[Scalar], shape: tuple[int, ...], dtype: np.dtype) -> Values:
    """An array of given scalars."""
    out = np.empty(shape, object)
    flat = out.reshape(-1)
    for i, value in enumerate(scalars):
        flat[i] = value
    return tidy(out, dtype)


def picked(flat: Values, positions: np.ndarray, dtype: np.dtype) -> Values:
    """Elements of a flat array at given positions."""
    return filled((flat[p] for p in positions.reshape(-1)), positions.shape, dtype)


def joined(arrays: Iterable[Values]) -> Values:
    """All elements of arrays, one after the other."""
    return np.concatenate([objects(x).reshape(-1) for x in arrays])


def each(graph: Graph, name: str, dtype: np.dtype, *arrays: Values) -> Values:
    """An operation on every element."""
    shape = np.broadcast_shapes(*(x.shape for x in arrays))
    flats = [np.broadcast_to(objects(x), shape).reshape(-1) for x in arrays]
    return filled((graph.op(name, dtype, *args) for args in zip(*flats, strict=True)), shape, dtype)


def fold_pairs(graph: Graph, name: str, dtype: np.dtype, scalars: list[Scalar]) -> Scalar:
    """Many scalars into one, by pairs, so that as many as possible can be computed at once."""
    while len(scalars) > 1:
        pairs = zip(scalars[::2], scalars[1::2], strict=False)
        rest = scalars[-1:] if len(scalars) % 2 else []
        scalars = [graph.op(name, dtype, a, b) for a, b in pairs] + rest
    return scalars[0]

"""Primitives that only move elements about, to places that are known: computed on numbers of positions."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbiped.sim.compile.arrays import Values, each, fold_pairs, is_known, joined, objects, picked, tidy
from jaxbiped.sim.compile.graph import Node, Scalar
from jaxbiped.sim.compile.interpret import Equation, Interpreter, UnknownPrimitiveError, out_type, rule

MOST = 64
"""Places among which a scatter may choose."""


def bind(eqn: Equation, arrays: list[np.ndarray], **params: Any) -> list[np.ndarray]:
    """A primitive on known arrays, run by JAX."""
    with jax.ensure_compile_time_eval():
        out = eqn.primitive.bind(*map(jnp.asarray, arrays), **{**eqn.params, **params})
        return [np.asarray(o) for o in (out if eqn.primitive.multiple_results else [out])]


def numbered(arrays: list[Values]) -> list[np.ndarray]:
    """Positions of all elements of arrays, one array after the other."""
    ends = np.cumsum([0, *(x.size for x in arrays)])
    return [
        np.arange(a, a + x.size, dtype=np.int32).reshape(x.shape) for a, x in zip(ends, arrays, strict=False)
    ]


@rule("iota")
def _made(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    shape, axis = eqn.outvars[0].aval.shape, eqn.params["dimension"]
    along = np.arange(shape[axis], dtype=out_type(eqn)).reshape(
        [-1 if i == axis else 1 for i in range(len(shape))]
    )
    return [np.broadcast_to(along, shape)]


@rule("reshape", "squeeze", "expand_dims")
def _reshape(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    return [ins[0].reshape(eqn.outvars[0].aval.shape)]


@rule("broadcast_in_dim")
def _broadcast(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    x, shape = ins[0], eqn.outvars[0].aval.shape
    between = [1] * len(shape)
    for axis, size in zip(eqn.params["broadcast_dimensions"], x.shape, strict=True):
        between[axis] = size
    return [np.broadcast_to(x.reshape(between), shape)]


@rule("transpose")
def _transpose(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    return [np.transpose(ins[0], eqn.params["permutation"])]


@rule("slice")
def _slice(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    p = eqn.params
    strides = p["strides"] or [1] * len(p["start_indices"])
    parts = zip(p["start_indices"], p["limit_indices"], strides, strict=True)
    return [tidy(ins[0][tuple(slice(*part) for part in parts)], out_type(eqn))]


@rule("rev")
def _rev(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    return [np.flip(ins[0], eqn.params["dimensions"])]


@rule("concatenate")
def _concatenate(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    return [np.concatenate(ins if all(map(is_known, ins)) else [*map(objects, ins)], eqn.params["dimension"])]


@rule("split")
def _split(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    ends, axis = np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"]
    return [tidy(part, out_type(eqn)) for part in np.split(ins[0], ends, axis)]


@rule("stack", "tile", "pad")
def moved(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    """Elements of all operands at positions that JAX tells."""
    if all(map(is_known, ins)):
        return bind(eqn, ins)
    flat = joined(ins)
    outs = bind(eqn, numbered(ins))
    return [picked(flat, out, out_type(eqn, i)) for i, out in enumerate(outs)]


def windows(shape: tuple[int, ...], starts: np.ndarray, sizes: Sequence[int], dropped: bool) -> np.ndarray:
    """Positions in an array of windows that begin at `starts`, (*batch, ndim), as (*batch, *sizes).

    A window that would reach out of the array is moved into it, or, if `dropped`, has -1 everywhere.
    """
    tops = np.array(shape, int) - np.array(sizes, int)
    inside = np.all((starts >= 0) & (starts <= tops), axis=-1)
    starts = np.clip(starts, 0, tops)
    within = np.moveaxis(np.indices(sizes, int), 0, -1)
    places = starts[(..., *[None] * len(sizes), slice(None))] + within
    strides = np.array([math.prod(shape[axis + 1 :]) for axis in range(len(shape))], int)
    flat = places @ strides
    return np.where(inside[(..., *[None] * len(sizes))], flat, -1) if dropped else flat


def starts_of(
    indices: Values, rank: int, axes: Sequence[int], batch: Sequence[tuple[int, int]]
) -> np.ndarray:
    """Say where windows begin, (*batch, rank), by indices (*batch, k) along `axes` of the array.

    Args:
        indices: known.
        rank: of the array.
        axes: that the indices are of.
        batch: pairs of an axis of the array and the axis of the indices that runs along it.
    """
    starts = np.zeros((*indices.shape[:-1], rank), int)
    for k, axis in enumerate(axes):
        starts[..., axis] = indices[..., k]
    for axis, other in batch:
        along = [-1 if i == other else 1 for i in range(indices.ndim - 1)]
        starts[..., axis] = np.arange(indices.shape[other]).reshape(along)
    return starts


@rule("scatter", "scatter-add", "scatter_add", "scatter-mul", "scatter_mul")
def _scatter(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    """Updates put at, added to or multiplied with elements; at known places, or at one of a few."""
    x, indices, updates = ins
    dtype, flat = out_type(eqn), objects(updates).reshape(-1)
    name = {"scatter": ""}.get(eqn.primitive.name, eqn.primitive.name[-3:])
    out = objects(x).copy()
    at = out.reshape(-1)
    for known, here in _candidates(of, eqn, x.shape, indices):
        for update, place in _places(eqn, x.shape, known, updates.shape):
            new = of.graph.op(name, dtype, at[place], flat[update]) if name else flat[update]
            at[place] = of.graph.op("select", dtype, here, at[place], new)
    return [tidy(out, dtype)]


def _candidates(
    of: Interpreter, eqn: Equation, shape: tuple[int, ...], indices: Values
) -> Iterator[tuple[Values, Scalar]]:
    """The indices that there may be, and whether it is these; an index outside of the operand is none of them."""
    if is_known(indices):
        yield indices, np.True_
        return
    p, kind = eqn.params, eqn.invars[1].aval.dtype
    axes = p["dimension_numbers"].scatter_dims_to_operand_dims
    ranges = [
        range(shape[axis]) if isinstance(i, Node) else [i]
        for axis, i in zip(axes, indices.flat, strict=False)
    ]
    if (
        indices.size > len(axes)
        or p["mode"] == lax.GatherScatterMode.CLIP
        or math.prod(map(len, ranges)) > MOST
    ):
        raise UnknownPrimitiveError(f"{eqn.primitive.name!r} at places that are not known")
    for values in itertools.product(*ranges):
        pairs = [(i, v) for i, v in zip(indices.flat, values, strict=True) if isinstance(i, Node)]
        tests = [of.graph.op("eq", bool, i, kind.type(v)) for i, v in pairs]
        yield (
            np.array(values, kind).reshape(indices.shape),
            fold_pairs(of.graph, "and", np.dtype(bool), tests),
        )


def _places(
    eqn: Equation, shape: tuple[int, ...], indices: Values, updates: tuple[int, ...]
) -> list[tuple[int, int]]:
    """Say where every update goes, as (update, place); nowhere if its window reaches out of the operand."""
    numbers = eqn.params["dimension_numbers"]
    batch = zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True)
    axes = list(map(int, numbers.scatter_dims_to_operand_dims))
    starts = starts_of(np.asarray(indices), len(shape), axes, list(batch))
    single = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
    inside = iter(updates[axis] for axis in numbers.update_window_dims)
    sizes = [1 if axis in single else next(inside) for axis in range(len(shape))]
    dropped = eqn.params["mode"] != lax.GatherScatterMode.CLIP
    places = windows(shape, starts, sizes, dropped)
    # the windows' own axes go to where the updates have them
    places = places.reshape((*starts.shape[:-1], *(updates[axis] for axis in numbers.update_window_dims)))
    places = ordered(places, list(map(int, numbers.update_window_dims))).reshape(-1)
    return [(update, int(place)) for update, place in enumerate(places) if place >= 0]


def ordered(windows: np.ndarray, to: Sequence[int]) -> np.ndarray:
    """The same with the last axes, those of the windows, moved to given places."""
    return np.moveaxis(windows, range(windows.ndim - len(to), windows.ndim), to)


@rule("dynamic_update_slice")
def _update(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    """A part overwritten; where it begins may depend on a node along one axis."""
    x, part, *starts = ins
    dtype, choices = out_type(eqn), [range(n - m + 1) for n, m in zip(x.shape, part.shape, strict=True)]
    unknown = [axis for axis, start in enumerate(starts) if not is_known(start)]
    if len(unknown) > 1:
        raise UnknownPrimitiveError("'dynamic_update_slice' with several starts that are not known")
    fixed = [int(np.clip(s, 0, c[-1])) if is_known(s) else 0 for s, c in zip(starts, choices, strict=True)]
    out = objects(x).copy()
    for value in choices[unknown[0]] if unknown else [0]:
        at = [value if axis in unknown else start for axis, start in enumerate(fixed)]
        window = tuple(slice(a, a + m) for a, m in zip(at, part.shape, strict=True))
        new = objects(part)
        if unknown:
            here = _clipped_to(of, eqn, starts[unknown[0]], unknown[0], value, choices[unknown[0]])
            new = objects(each(of.graph, "select", dtype, here, out[window], new))
        out[window] = new
    return [tidy(out, dtype)]


def _clipped_to(
    of: Interpreter, eqn: Equation, start: Values, axis: int, value: int, choices: range
) -> Values:
    """Tell whether a start, clipped to the choices there are, is so much."""
    dtype = eqn.invars[2 + axis].aval.dtype
    name = "eq" if 0 < value < choices[-1] else "le" if value == 0 else "ge"
    if len(choices) == 1:
        return np.ones((), bool)
    return each(of.graph, name, np.dtype(bool), start, np.asarray(value, dtype))

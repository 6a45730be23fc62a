"""Primitives that make one element out of many."""

import numpy as np

from jaxbiped.sim.compile.arrays import Values, each, filled, fold_pairs, is_known, objects, tidy
from jaxbiped.sim.compile.graph import Node, Scalar
from jaxbiped.sim.compile.interpret import Equation, Interpreter, UnknownPrimitiveError, out_type, rule
from jaxbiped.sim.compile.moves import bind

REDUCED = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
}
NOTHING = {"add": 0.0, "mul": 1.0, "max": -np.inf, "min": np.inf, "and": True, "or": False}
"""What comes of no element."""
RUNNING = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}


@rule(*REDUCED)
def _reduce(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    axes, x = eqn.params["axes"], objects(ins[0])
    name, dtype, shape = REDUCED[eqn.primitive.name], out_type(eqn), eqn.outvars[0].aval.shape
    kept = [axis for axis in range(x.ndim) if axis not in axes]
    rows = np.transpose(x, [*kept, *axes]).reshape(int(np.prod(shape, dtype=int)), -1)
    if rows.shape[-1] == 0:
        return [np.full(shape, NOTHING[name], dtype)]
    return [filled((fold_pairs(of.graph, name, dtype, list(row)) for row in rows), shape, dtype)]


@rule("argmax", "argmin")
def _arg(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    """The first of the largest, or of the smallest."""
    (axis,), dtype, kind = eqn.params["axes"], out_type(eqn), eqn.invars[0].aval.dtype
    rows = np.moveaxis(objects(ins[0]), axis, 0)
    best, where = rows[0:1], np.zeros(rows[0:1].shape, dtype)
    for k in range(1, len(rows)):
        row = rows[k : k + 1]
        better = each(of.graph, "gt" if eqn.primitive.name == "argmax" else "lt", np.dtype(bool), row, best)
        best = each(of.graph, "select", kind, better, best, row)
        where = each(of.graph, "select", dtype, better, where, np.asarray(k, dtype))
    return [where.reshape(eqn.outvars[0].aval.shape)]


@rule(*RUNNING)
def _running(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    axis, dtype = eqn.params["axis"], out_type(eqn)
    x = np.moveaxis(objects(ins[0]), axis, 0)
    x = x[::-1] if eqn.params["reverse"] else x
    rows = [x[0:1]]
    for k in range(1, len(x)):
        rows.append(objects(each(of.graph, RUNNING[eqn.primitive.name], dtype, rows[-1], x[k : k + 1])))
    out = np.concatenate(rows)
    return [tidy(np.moveaxis(out[::-1] if eqn.params["reverse"] else out, 0, axis), dtype)]


@rule("dot_general")
def _dot(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    (summed, batched), dtype = eqn.params["dimension_numbers"], out_type(eqn)
    if any(var.aval.dtype != dtype for var in eqn.invars):
        raise UnknownPrimitiveError("'dot_general' of other types than its result's")
    a, b = (_stacked(x, s, t) for x, s, t in zip(ins, summed, batched, strict=True))
    rows = (_product(of, dtype, x, y) for i in range(len(a)) for x in a[i] for y in b[i])
    return [filled(rows, eqn.outvars[0].aval.shape, dtype)]


def _stacked(x: Values, summed: tuple[int, ...], batched: tuple[int, ...]) -> Values:
    """Arrange an operand on three axes: those that both operands share, its own, and those that are summed over."""
    own = [axis for axis in range(x.ndim) if axis not in summed and axis not in batched]
    sizes = [int(np.prod([x.shape[axis] for axis in axes], dtype=int)) for axes in (batched, own, summed)]
    return np.transpose(objects(x), [*batched, *own, *summed]).reshape(sizes)


def _product(of: Interpreter, dtype: np.dtype, x: Values, y: Values) -> Scalar:
    """The inner product of two rows."""
    terms = [of.graph.op("mul", dtype, a, b) for a, b in zip(x, y, strict=True)]
    terms = [term for term in terms if isinstance(term, Node) or term != 0]
    return fold_pairs(of.graph, "add", dtype, terms or [dtype.type(0)])


@rule("sort")
def _sort(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    """Sort one operand by exchanging neighbors that are in the wrong order; for a few elements."""
    if all(map(is_known, ins)):
        return bind(eqn, ins)
    if len(ins) != 1:
        raise UnknownPrimitiveError("'sort' of several operands")
    dtype, axis = out_type(eqn), eqn.params["dimension"]
    rows = np.moveaxis(objects(ins[0]), axis, -1)
    shape, n = rows.shape, rows.shape[-1]
    rows = [list(row) for row in rows.reshape(-1, n)]
    for row in rows:
        for last in range(n - 1, 0, -1):
            for i in range(last):
                a, b = row[i], row[i + 1]
                row[i], row[i + 1] = of.graph.op("min", dtype, a, b), of.graph.op("max", dtype, a, b)
    sorted_rows = filled((element for row in rows for element in row), shape, dtype)
    return [np.moveaxis(sorted_rows, -1, axis)]

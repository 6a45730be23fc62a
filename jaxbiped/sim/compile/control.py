"""Primitives that hold jaxprs of their own: calls, conditions and loops."""

from typing import Any

import numpy as np

from jaxbiped.sim.compile.arrays import Values, filled, is_known, objects, tidy
from jaxbiped.sim.compile.graph import AFTER, CARRY, LOST, Loop
from jaxbiped.sim.compile.interpret import (
    MOST_UNROLLED,
    Equation,
    Interpreter,
    UnknownPrimitiveError,
    out_type,
    rule,
)
from jaxbiped.sim.compile.lookups import choose


@rule("jit", "pjit", "closed_call", "core_call", "remat", "checkpoint", "custom_jvp_call", "custom_vjp_call")
def _call(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    p = eqn.params
    (inner,) = (p[name] for name in ("jaxpr", "call_jaxpr", "fun_jaxpr") if name in p)
    return of.closed(inner, ins)


@rule("cond")
def _cond(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    index, *args = ins
    branches = eqn.params["branches"]
    if is_known(index):
        return of.closed(branches[int(np.clip(index, 0, len(branches) - 1))], args)
    node = objects(index).reshape(-1)[0]
    node = of.graph.op("convert", np.int32, node) if node.dtype.kind == "b" else node
    cases = [of.closed(branch, args) for branch in branches]

    def chosen(i: int) -> Values:
        elements = zip(*(objects(case[i]).reshape(-1) for case in cases), strict=True)
        dtype, shape = out_type(eqn, i), eqn.outvars[i].aval.shape
        return filled((choose(of.graph, dtype, node, list(few)) for few in elements), shape, dtype)

    return [chosen(i) for i in range(len(eqn.outvars))]


@rule("scan")
def _scan(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    p = eqn.params
    n, first = p["num_consts"], p["num_consts"] + p["num_carry"]
    consts, carry, rows = ins[:n], ins[n:first], ins[first:]
    if _is_rolled(of, eqn, rows):
        return _rolled(of, eqn, consts, carry)
    if p["length"] > MOST_UNROLLED:
        raise UnknownPrimitiveError(f"'scan' of {p['length']}")
    left: dict[int, list[Values]] = {}
    order = range(p["length"])
    for k in reversed(order) if p["reverse"] else order:
        row = [
            tidy(x[k : k + 1].reshape(x.shape[1:]), var.aval.dtype)
            for x, var in zip(rows, eqn.invars[first:], strict=True)
        ]
        outs = of.closed(p["jaxpr"], [*consts, *carry, *row])
        carry, left[k] = outs[: len(carry)], outs[len(carry) :]
    stacks = [
        _stack(eqn, len(carry) + i, [left[k][i] for k in order]) for i in range(len(eqn.outvars) - len(carry))
    ]
    return [*carry, *stacks]


def _stack(eqn: Equation, i: int, parts: list[Values]) -> Values:
    if not parts:
        return np.zeros(eqn.outvars[i].aval.shape, out_type(eqn, i))
    return tidy(np.stack([objects(part) for part in parts]), out_type(eqn, i))


def _is_rolled(of: Interpreter, eqn: Equation, rows: list[Values]) -> bool:
    """Tell whether a loop stays one: the outermost, long bodies that are given nothing by rows."""
    inner = eqn.params["jaxpr"].jaxpr
    return not of.inside and not rows and eqn.params["length"] > 1 and len(inner.eqns) >= of.rolled


def _rolled(of: Interpreter, eqn: Equation, consts: list[Values], carry: list[Values]) -> list[Values]:
    """The body once, on nodes for what is carried; of what it stacks only the last row is kept."""
    graph, length = of.graph, eqn.params["length"]
    variables = eqn.params["jaxpr"].jaxpr.invars[len(consts) :]
    start = [scalar for x in carry for scalar in objects(x).reshape(-1)]
    dtypes = [var.aval.dtype for var in variables for _ in range(var.aval.size)]
    loop = Loop(len(graph.loops), length, start, dtypes)
    graph.loops.append(loop)
    nodes = iter([graph.make(CARRY, (), dtype, (loop.number, i)) for i, dtype in enumerate(dtypes)])
    inside = [
        filled((next(nodes) for _ in range(v.aval.size)), v.aval.shape, v.aval.dtype) for v in variables
    ]
    of.inside = True
    outs = of.closed(eqn.params["jaxpr"], [*consts, *inside])
    of.inside = False
    flat = [scalar for x in outs for scalar in objects(x).reshape(-1)]
    loop.next, loop.rows = flat[: len(start)], flat[len(start) :]
    kinds = [
        v.aval.dtype
        for v, x in zip(eqn.params["jaxpr"].jaxpr.outvars, outs, strict=True)
        for _ in range(x.size)
    ]
    after = iter([graph.make(AFTER, (), dtype, (loop.number, i)) for i, dtype in enumerate(kinds)])
    return [_left(of, eqn, i, after, len(carry)) for i in range(len(eqn.outvars))]


def _left(of: Interpreter, eqn: Equation, i: int, after: Any, carried: int) -> Values:
    """An output of a loop: what it carried, or a stack whose last row alone is known."""
    shape, dtype = eqn.outvars[i].aval.shape, out_type(eqn, i)
    if i < carried:
        return filled((next(after) for _ in range(int(np.prod(shape, dtype=int)))), shape, dtype)
    size = int(np.prod(shape[1:], dtype=int))
    last = -1 if not eqn.params["reverse"] else 0
    out = np.empty((shape[0], size), object)
    lost = of.graph.make(LOST, (), dtype)
    for k in range(shape[0]):
        for element in range(size):
            out[k, element] = lost
    for element in range(size):
        out[last, element] = next(after)
    return out.reshape(shape)

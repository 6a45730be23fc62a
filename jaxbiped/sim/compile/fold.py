"""Rules by which scalar operations are simplified: short ones, exact but for the sign of zeros and for 0 times NaN."""

from collections.abc import Callable

import numpy as np

from jaxbiped.sim.compile.graph import FOLDS, Fold, Graph, Node, Scalar


def _of(*names: str) -> Callable[[Fold], Fold]:
    """Make a function the rule of some operations."""

    def register(rule: Fold) -> Fold:
        FOLDS.update(dict.fromkeys(names, rule))
        return rule

    return register


def _is(x: Scalar, value: int) -> bool:
    """Tell whether a scalar is known to be so much."""
    return not isinstance(x, Node) and bool(x == value)


def _negated(x: Scalar) -> Scalar | None:
    """Return what a scalar is the negative of."""
    return x.args[0] if isinstance(x, Node) and x.op == "neg" and x.dtype.kind == "f" else None


@_of("add")
def _add(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    for a, b in (args, args[::-1]):
        if _is(a, 0):
            return b
        if (positive := _negated(b)) is not None:
            return graph.op("sub", dtype, a, positive)
    return None


@_of("sub")
def _sub(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    a, b = args
    if _is(b, 0):
        return a
    if _is(a, 0):
        return graph.op("neg", dtype, b)
    if (positive := _negated(b)) is not None:
        return graph.op("add", dtype, a, positive)
    return None


@_of("neg")
def _neg(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    (a,) = args
    if a.op == "neg":
        return a.args[0]
    if a.op == "sub" and dtype.kind == "f":
        return graph.op("sub", dtype, a.args[1], a.args[0])
    return None


@_of("mul")
def _mul(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    for a, b in (args, args[::-1]):
        if _is(a, 0):
            return dtype.type(0)
        if _is(a, 1):
            return b
        if _is(a, -1):
            return graph.op("neg", dtype, b)
        if (positive := _negated(b)) is not None:
            if not isinstance(a, Node):
                return graph.op("mul", dtype, -a, positive)
            return graph.op("neg", dtype, graph.op("mul", dtype, a, positive))
    return None


@_of("div")
def _div(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    a, b = args
    if _is(a, 0):
        return dtype.type(0)
    if _is(b, 1):
        return a
    if dtype.kind == "f" and not isinstance(b, Node) and abs(np.frexp(b)[0]) == 0.5:
        return graph.op("mul", dtype, a, dtype.type(1) / b)
    return None


@_of("and")
def _and(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    for a, b in (args, args[::-1]):
        if dtype.kind == "b" and not isinstance(a, Node):
            return b if a else np.False_
    return args[0] if args[0] is args[1] else None


@_of("or")
def _or(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    for a, b in (args, args[::-1]):
        if dtype.kind == "b" and not isinstance(a, Node):
            return np.True_ if a else b
    return args[0] if args[0] is args[1] else None


@_of("max")
def _largest(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    return _bounded(dtype, args, "min")


@_of("min")
def _smallest(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    return _bounded(dtype, args, "max")


def _bounded(dtype: np.dtype, args: tuple[Scalar, ...], end: str) -> Scalar | None:
    """The same scalar twice, or one beside the end of its type's range."""
    if args[0] is args[1]:
        return args[0]
    for a, b in (args, args[::-1]):
        if dtype.kind in "iu" and _is(a, getattr(np.iinfo(dtype), end)):
            return b
    return None


@_of("not")
def _not(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    return args[0].args[0] if args[0].op == "not" else None


@_of("convert")
def _convert(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    return args[0] if args[0].dtype == dtype else None


@_of("eq")
def _eq(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    return np.True_ if args[0] is args[1] and args[0].dtype.kind in "biu" else None


@_of("ne")
def _ne(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    a, b = args
    if a is b and a.dtype.kind in "biu":
        return np.False_
    for x, y in (args, args[::-1]):  # a truth against a known one
        if x.dtype.kind == "b" and not isinstance(y, Node):
            return graph.op("not", bool, x) if y else x
    return None


@_of("lt", "gt")
def _strict(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    return np.False_ if args[0] is args[1] else None


@_of("select")
def _select(graph: Graph, dtype: np.dtype, args: tuple[Scalar, ...]) -> Scalar | None:
    which, no, yes = args
    if not isinstance(which, Node):
        return yes if which else no
    if no is yes or _equal(no, yes):
        return yes
    if which.op == "not":
        return graph.op("select", dtype, which.args[0], yes, no)
    return _select_truth(graph, which, no, yes) if dtype.kind == "b" else None


def _select_truth(graph: Graph, which: Node, no: Scalar, yes: Scalar) -> Scalar | None:
    """A choice between truths of which one is known is an `and` or an `or`."""
    if not isinstance(yes, Node):
        return graph.op("or" if yes else "and", bool, which if yes else graph.op("not", bool, which), no)
    if not isinstance(no, Node):
        return graph.op("or" if no else "and", bool, graph.op("not", bool, which) if no else which, yes)
    return None


def _equal(a: Scalar, b: Scalar) -> bool:
    """Tell whether two scalars are known and the same, bit by bit."""
    return not isinstance(a, Node) and not isinstance(b, Node) and a.tobytes() == b.tobytes()

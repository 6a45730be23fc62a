"""A program printed as plain C99: one lane, no vectors, no dependency but libm.

Every node of the graph becomes a constant of a function's body; which words it reads and writes, and under which
names, is up to the caller.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from jaxbiped.sim.compile.graph import AFTER, CARRY, INPUT, TAKE, Node, Scalar
from jaxbiped.sim.compile.interpret import UnknownPrimitiveError
from jaxbiped.sim.compile.program import Program

INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==",
         "ne": "!="}  # fmt: skip
BITS = {"and": "&", "or": "|", "xor": "^"}
LIBM = {"sqrt": "sqrt", "exp": "exp", "log": "log", "log1p": "log1p", "tanh": "tanh", "pow": "pow", "sin": "sin",
        "cos": "cos", "tan": "tan", "asin": "asin", "acos": "acos", "atan": "atan", "atan2": "atan2", "rem": "fmod",
        "floor": "floor", "ceil": "ceil", "round": "rint", "abs": "fabs"}  # fmt: skip
HELPERS = """\
static real larger(real x, real y) { return x > y || isnan(x) ? x : y; }
static real smaller(real x, real y) { return x < y || isnan(x) ? x : y; }
static real sign(real x) { return x > 0 ? (real)1 : x < 0 ? (real)-1 : x; }
static int whole(real x) {
  return isnan(x) ? 0 : x >= (real)2147483520.0 ? 2147483520 : x <= (real)-2147483648.0 ? -2147483647 - 1 : (int)x;
}"""
"""Functions of numbers that libm does not have, as JAX defines them; one a line, but for the last."""
_HELPED = {"max": "larger", "min": "smaller", "sign": "sign"}


def type_of(dtype: np.dtype) -> str:
    """The C type of a number: truths are whole numbers, 0 or 1."""
    if dtype.kind == "f":
        return "real"
    return "long long" if dtype.itemsize == 8 else "int"


def literal(value: Any) -> str:
    """A number as C has it; floats to the last bit."""
    if value.dtype.kind != "f":
        is_least = value.dtype.kind == "i" and value == np.iinfo(value.dtype).min  # C has no such literal
        return f"({int(value) + 1} - 1)" if is_least else str(int(value))
    if np.isnan(value):
        return "(real)NAN"
    if np.isinf(value):
        return f"(real){'-' if value < 0 else ''}INFINITY"
    return f"(real){float(value)!r}"


class Body:
    """Prints the nodes of a program without loops.

    Args:
        program: what is printed.
        word: the C expression of an element of a leaf that is given.
        table: the C expression of a leaf that is looked up in, as an array.
    """

    def __init__(self, program: Program, word: Callable[[int, int], str], table: Callable[[int], str]):
        if program.graph.loops:
            raise UnknownPrimitiveError("a loop, in plain C")
        self.program, self.word, self.table = program, word, table
        self.single = all(n.dtype != np.float64 for n in program.order)
        self.helpers: set[str] = set()
        """Those of HELPERS that were used so far."""

    def lines(self) -> Iterator[str]:
        """A constant for every node, in order."""
        for node in self.program.order:
            yield f"  const {type_of(node.dtype)} v{node.number} = {self._value(node)};"

    def operand(self, scalar: Scalar) -> str:
        """A node's name, or the number itself."""
        return f"v{scalar.number}" if isinstance(scalar, Node) else literal(scalar)

    def _value(self, node: Node) -> str:
        assert node.op not in (CARRY, AFTER)
        if node.op == INPUT:
            return self.word(*node.param)
        args = [self.operand(arg) for arg in node.args]
        if node.op == TAKE:
            leaf, first, step, _ = node.param
            return f"{self.table(leaf)}[{first} + {step} * {args[0]}]"
        if node.op == "select":
            return f"{args[0]} ? {args[2]} : {args[1]}"
        if node.op in INFIX:
            return f"{args[0]} {INFIX[node.op]} {args[1]}"
        if node.op == "convert":
            return self._converted(node, args[0])
        if node.op == "is_finite":
            return f"isfinite({args[0]}) ? 1 : 0"
        if node.op == "neg":
            return f"-{args[0]}"
        kind = node.args[0].dtype.kind
        return self._real(node.op, args) if kind == "f" else self._whole(node.op, kind, args)

    def _real(self, op: str, args: list[str]) -> str:
        if op in _HELPED:
            self.helpers.add(_HELPED[op])
            return f"{_HELPED[op]}({', '.join(args)})"
        if op not in LIBM:
            raise UnknownPrimitiveError(f"{op!r}, in plain C")
        return f"{LIBM[op]}{'f' if self.single else ''}({', '.join(args)})"

    def _whole(self, op: str, kind: str, args: list[str]) -> str:
        if op in BITS:
            return f"{args[0]} {BITS[op]} {args[1]}"
        if op == "not":
            return f"!{args[0]}" if kind == "b" else f"~{args[0]}"
        if op in ("max", "min") and kind in "ib":
            return f"{args[0]} {'>' if op == 'max' else '<'} {args[1]} ? {args[0]} : {args[1]}"
        if op == "rem" and kind == "i":
            return f"{args[0]} % {args[1]}"
        raise UnknownPrimitiveError(f"{op!r} of whole numbers, in plain C")

    def _converted(self, node: Node, text: str) -> str:
        before, after = node.args[0].dtype.kind, node.dtype.kind
        if before == "f" and after in "iu":
            self.helpers.add("whole")
            return f"whole({text})"
        if after == "b":
            return f"{text} != 0"
        return f"(real){text}" if after == "f" else text

    def helping(self) -> str:
        """Definitions of the helpers that were used."""
        found = [f"static {rest}" for rest in HELPERS.split("static ")[1:]]
        return "".join(text for text in found if text.split("(")[0].split()[-1] in self.helpers)

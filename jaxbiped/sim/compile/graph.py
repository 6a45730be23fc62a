"""A graph of scalar operations: equal ones are one node, known ones are folded, and nothing else is changed.

A scalar is a `Node` or, where it is known, a NumPy scalar. Infinite numbers and NaN are left out of account where a
factor is exactly zero: x * 0 is 0 whatever x is.
"""

from collections.abc import Callable, Hashable, Iterable
from typing import Any

import numpy as np

Scalar = Any
"""A `Node`, or a NumPy scalar where the number is known."""

INPUT, TAKE, CARRY, AFTER, LOST = "input", "take", "carry", "after", "lost"
"""Operations that are not arithmetic: a word that is given; an element of a given table; what a loop carries into its
body; what it leaves behind; what it computed but did not keep."""
COMMUTING = frozenset({"add", "mul", "max", "min", "and", "or", "xor", "eq", "ne"})


class Node:
    """One scalar operation."""

    __slots__ = ("args", "dtype", "number", "op", "param")

    def __init__(self, op: str, args: tuple[Scalar, ...], dtype: np.dtype, param: Any, number: int):
        self.op, self.args, self.dtype, self.param, self.number = op, args, dtype, param, number

    def __repr__(self) -> str:
        """Write a node for error messages."""
        return f"%{self.number}:{self.op}"

    @property
    def needs(self) -> list["Node"]:
        """The nodes it is computed from."""
        return [arg for arg in self.args if isinstance(arg, Node)]


class Key:
    """A key of random numbers: two words."""

    __slots__ = ("first", "second")

    def __init__(self, first: Scalar, second: Scalar):
        self.first, self.second = first, second


class Loop:
    """A loop that stays one: a body that is computed `length` times within a tick."""

    def __init__(self, number: int, length: int, start: list[Scalar], dtypes: list[np.dtype]):
        self.number, self.length, self.start, self.dtypes = number, length, start, dtypes
        self.next: list[Scalar] = []
        """What is carried on from one run of the body to the next."""
        self.rows: list[Scalar] = []
        """What the last run of the body leaves behind beside it."""


Fold = Callable[["Graph", np.dtype, tuple[Scalar, ...]], Scalar | None]
FOLDS: dict[str, Fold] = {}
"""By operation, what it simplifies to; None for nothing. Filled by `fold`."""


class Graph:
    """Nodes in the order in which they were made, every one after those that it needs."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.loops: list[Loop] = []
        self._made: dict[Hashable, Node] = {}

    def make(self, op: str, args: Iterable[Scalar], dtype: Any, param: Any = None) -> Node:
        """The node of an operation as it is, not simplified."""
        dtype, args = np.dtype(dtype), tuple(args)
        if op in COMMUTING:
            args = tuple(sorted(args, key=lambda arg: arg.number if isinstance(arg, Node) else -1))
        key = (op, tuple(map(_name, args)), dtype.char, param)
        node = self._made.get(key)
        if node is None:
            node = self._made[key] = Node(op, args, dtype, param, len(self.nodes))
            self.nodes.append(node)
        return node

    def input(self, leaf: Hashable, element: int, dtype: Any) -> Node:
        """A word that is given: an element of an array."""
        return self.make(INPUT, (), dtype, (leaf, element))

    def op(self, name: str, dtype: Any, *args: Scalar) -> Scalar:
        """An operation, computed at once where everything is known, and simplified where it can be."""
        dtype = np.dtype(dtype)
        if not any(isinstance(arg, Node) for arg in args):
            return compute(name, dtype, args)
        simpler = FOLDS[name](self, dtype, args) if name in FOLDS else None
        return self.make(name, args, dtype) if simpler is None else simpler


def _name(arg: Scalar) -> Hashable:
    return arg.number if isinstance(arg, Node) else (arg.dtype.char, arg.tobytes())


def _divide(dtype: np.dtype, a: Any, b: Any) -> Any:
    if dtype.kind == "f":
        return np.true_divide(a, b)
    safe = np.where(b == 0, 1, b)
    return np.sign(a) * np.sign(safe) * (np.abs(a) // np.abs(safe))  # towards zero, as XLA and C do


def _logical(bits: Callable[..., Any], words: Callable[..., Any]) -> Callable[..., Any]:
    return lambda dtype, *args: (words if dtype.kind == "b" else bits)(*args)


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda dtype, *args: function(*args)


def _convert(dtype: np.dtype, x: Any) -> Any:
    x = np.asarray(x)
    if dtype.kind not in "iu" or x.dtype.kind != "f":
        return x.astype(dtype)
    limits = np.iinfo(dtype)
    whole = np.clip(np.trunc(np.nan_to_num(x.astype(np.float64), nan=0.0)), limits.min, limits.max)
    return whole.astype(dtype)


COMPUTE: dict[str, Callable[..., Any]] = {
    name: _plain(function)
    for name, function in {
        "add": np.add, "sub": np.subtract, "mul": np.multiply, "max": np.maximum, "min": np.minimum,
        "neg": np.negative, "abs": np.abs, "sign": np.sign, "floor": np.floor, "ceil": np.ceil, "round": np.round,
        "sqrt": np.sqrt, "exp": np.exp, "log": np.log, "log1p": np.log1p, "tanh": np.tanh, "pow": np.power,
        "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan,
        "atan2": np.arctan2, "rem": np.fmod, "is_finite": np.isfinite,
        "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
        "eq": np.equal, "ne": np.not_equal, "select": lambda which, no, yes: np.where(which, yes, no),
    }.items()
}  # fmt: skip
"""Every arithmetic operation, in NumPy: `f(dtype of the result, *args)`; on scalars or on arrays of lanes."""
COMPUTE |= {
    "div": _divide,
    "convert": _convert,
    "shl": _plain(np.left_shift),
    "shr": _plain(np.right_shift),
    "bits": lambda dtype, x: np.asarray(x).view(dtype),
    "and": _logical(np.bitwise_and, np.logical_and),
    "or": _logical(np.bitwise_or, np.logical_or),
    "xor": _logical(np.bitwise_xor, np.logical_xor),
    "not": _logical(np.bitwise_not, np.logical_not),
}


def compute(name: str, dtype: np.dtype, args: Iterable[Any]) -> Any:
    """An operation on numbers, or on arrays of them."""
    with np.errstate(all="ignore"):
        return np.asarray(COMPUTE[name](dtype, *args)).astype(dtype)[()]

"""Machine code of a program, called on states: their words in rows, one column a lane."""

import ctypes
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jaxbiped.sim.compile import build
from jaxbiped.sim.compile.evaluate import evaluate
from jaxbiped.sim.compile.graph import Node
from jaxbiped.sim.compile.program import Level, Program
from jaxbiped.sim.compile.to_c import print_c

BYTES = 64
"""Of a vector."""


@dataclass(frozen=True)
class Code:
    """A program as C text, and how to compute what the text is given beside states."""

    text: str
    single: bool
    """Whether numbers have single precision."""
    tables: list[int]
    """Leaves of the simulation that are looked up in."""
    nodes: list[Node]
    """All that is the same for all lanes, in order."""
    shared: list[Node]
    """Those of them that the text is given, in its order."""

    @classmethod
    def of(cls, program: Program, single: bool = True) -> "Code":
        """Print a program."""
        printed = print_c(program, single, width_of(single))
        return cls(printed.text, single, printed.tables, program.at(Level.SHARED), printed.shared)


def width_of(single: bool) -> int:
    """Lanes of a block."""
    return BYTES // (4 if single else 8)


class Machine:
    """A program as machine code."""

    def __init__(self, code: Code):
        self.code, self.width = code, width_of(code.single)
        self.word = np.dtype(np.int32 if code.single else np.int64)
        self.real = np.dtype(np.float32 if code.single else np.float64)
        self.call = build.load(code.text).walk
        self.call.restype = None
        self._last: tuple[list[np.ndarray], np.ndarray] | None = None

    def advance(self, leaves: list[np.ndarray], states: Any, ticks: int, threads: int = 1) -> Any:
        """The states of all lanes, with a leading axis, so many ticks later.

        Args:
            leaves: of the simulation.
            states: before.
            ticks: how many.
            threads: how many share the lanes; a lane's numbers do not depend on it.
        """
        each, tree = jax.tree.flatten(states)
        each = [np.asarray(leaf) for leaf in each]
        blocks = -(-len(each[0]) // self.width)
        room, threads = blocks * self.width, min(threads, blocks)
        words, shared = self.packed(each, room), self._shared(leaves)
        tables = [np.ascontiguousarray(leaves[i], self.real) for i in self.code.tables]
        pointers = (ctypes.c_void_p * max(1, len(tables)))(*(table.ctypes.data for table in tables))
        ends = [i * blocks // threads * self.width for i in range(threads + 1)]

        def some(first: int, last: int) -> None:
            size = ctypes.c_long
            self.call(size(room), size(first), size(last), size(ticks), _at(words), _at(shared), pointers)

        if threads == 1:
            some(0, room)
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(some, ends[:-1], ends[1:]))
        return jax.tree.unflatten(tree, self.unpacked(words, each))

    def packed(self, each: list[np.ndarray], room: int) -> np.ndarray:
        """Words (rows, room); spare lanes do as the last one does."""
        rows = []
        for leaf in each:
            flat = leaf.reshape(len(leaf), -1).T
            flat = (
                flat.astype(self.real).view(self.word) if leaf.dtype.kind == "f" else flat.astype(self.word)
            )
            rows.append(np.pad(flat, ((0, 0), (0, room - len(leaf))), mode="edge"))
        return np.ascontiguousarray(np.concatenate(rows))

    def unpacked(self, words: np.ndarray, like: list[np.ndarray]) -> list[np.ndarray]:
        """Leaves of states."""
        out, row = [], 0
        for leaf in like:
            size = leaf[0].size
            mine = words[row : row + size, : len(leaf)]
            mine = mine.view(self.real) if leaf.dtype.kind == "f" else mine
            out.append(np.ascontiguousarray(mine.T).reshape(leaf.shape).astype(leaf.dtype))
            row += size
        return out

    def _shared(self, leaves: list[np.ndarray]) -> np.ndarray:
        """Return what is the same for all lanes, as words; kept until the simulation has other numbers."""
        last = self._last
        if last is not None and all(
            a is b or np.array_equal(a, b) for a, b in zip(last[0], leaves, strict=True)
        ):
            return last[1]
        values: dict[int, Any] = {}
        evaluate(self.code.nodes, values, lambda leaf: leaves[leaf].reshape(-1))
        out = np.zeros(max(1, len(self.code.shared)), self.word)
        for i, node in enumerate(self.code.shared):
            out[i] = self._as_word(node, values[node.number])
        self._last = leaves, out
        return out

    def _as_word(self, node: Node, value: Any) -> Any:
        if node.dtype.kind == "f":
            return np.asarray(value, self.real).view(self.word)
        return -int(value) if node.dtype == bool else value


def _at(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)

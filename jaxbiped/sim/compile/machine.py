"""Machine code of a program, called on states: their words in rows, one column a lane."""

import ctypes
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


class Machine:
    """A program as machine code."""

    def __init__(self, program: Program, single: bool = True):
        self.single = single
        self.word = np.dtype(np.int32 if single else np.int64)
        self.real = np.dtype(np.float32 if single else np.float64)
        self.width = BYTES // self.word.itemsize
        printed = print_c(program, single, self.width)
        self.text, self.tables, self.shared = printed.text, printed.tables, printed.shared
        self.needed: list[Node] = program.at(Level.SHARED)
        self.call = build.load(self.text).walk
        self.call.restype = None

    def advance(self, leaves: list[np.ndarray], states: Any, ticks: int) -> Any:
        """The states of all lanes, with a leading axis, so many ticks later.

        Args:
            leaves: of the simulation.
            states: before.
            ticks: how many.
        """
        each, tree = jax.tree.flatten(states)
        each = [np.asarray(leaf) for leaf in each]
        lanes = len(each[0])
        room = -(-lanes // self.width) * self.width
        words = self.packed(each, room)
        tables = [np.ascontiguousarray(leaves[i], self.real) for i in self.tables]
        pointers = (ctypes.c_void_p * max(1, len(tables)))(*(table.ctypes.data for table in tables))
        shared, size = self._shared(leaves), ctypes.c_long
        self.call(size(room), size(0), size(room), size(ticks), _at(words), _at(shared), pointers)
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
        """What is the same for all lanes, as words."""
        values: dict[int, Any] = {}
        evaluate(self.needed, values, lambda leaf: leaves[leaf].reshape(-1))
        out = np.zeros(max(1, len(self.shared)), self.word)
        for i, node in enumerate(self.shared):
            value = values[node.number]
            real = node.dtype.kind == "f"
            out[i] = (
                np.asarray(value, self.real).view(self.word)
                if real
                else -int(value)
                if node.dtype == bool
                else value
            )
        return out


def _at(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)

"""A program as JAX operations on vectors, one element a lane: for devices that have many lanes at once.

XLA is given the same scalar operations that are printed as C, without the small arrays that the tick is written with.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxbiped import runtime
from jaxbiped.sim.compile.evaluate import evaluate, value_of
from jaxbiped.sim.compile.graph import AFTER, CARRY, INPUT, TAKE, Loop, Node, Scalar
from jaxbiped.sim.compile.interpret import UnknownPrimitiveError
from jaxbiped.sim.compile.program import Level, Program

Vectors = dict[int, Any]
"""By the numbers of nodes, their values."""

ON_CPU: dict[str, str | int] = {"xla_backend_optimization_level": 0, "xla_disable_hlo_passes": "fusion"}
"""How a CPU compiles it, where it is of use to check it only: XLA's fusion would take longer than anybody waits."""
_SAME: dict[str, Callable[..., Any]] = {
    "add": jnp.add, "sub": jnp.subtract, "mul": jnp.multiply, "div": lax.div, "max": jnp.maximum, "min": jnp.minimum,
    "neg": jnp.negative, "abs": jnp.abs, "sign": jnp.sign, "floor": jnp.floor, "ceil": jnp.ceil, "round": jnp.round,
    "sqrt": jnp.sqrt, "exp": jnp.exp, "log": jnp.log, "log1p": jnp.log1p, "tanh": jnp.tanh, "pow": jnp.power,
    "sin": jnp.sin, "cos": jnp.cos, "tan": jnp.tan, "asin": jnp.arcsin, "acos": jnp.arccos, "atan": jnp.arctan,
    "atan2": jnp.arctan2, "rem": lax.rem, "is_finite": jnp.isfinite, "lt": jnp.less, "le": jnp.less_equal,
    "gt": jnp.greater, "ge": jnp.greater_equal, "eq": jnp.equal, "ne": jnp.not_equal, "and": jnp.bitwise_and,
    "or": jnp.bitwise_or, "xor": jnp.bitwise_xor, "not": jnp.bitwise_not, "shl": jnp.left_shift,
    "select": lambda which, no, yes: jnp.where(which, yes, no),
}  # fmt: skip
"""Operations of the graph in JAX; `shr` of words without a sign, `bits` and `convert` need the type of the result."""


def operation(name: str, dtype: np.dtype, args: list[Any]) -> Any:
    """One operation on vectors."""
    if name == "convert":
        return jnp.asarray(args[0]).astype(dtype)
    if name == "bits":
        return lax.bitcast_convert_type(args[0], dtype)
    if name == "shr":
        return lax.shift_right_logical(*jnp.broadcast_arrays(*args))
    if name not in _SAME:
        raise UnknownPrimitiveError(f"no JAX operation for {name!r}")
    if name in ("div", "rem"):
        args = list(jnp.broadcast_arrays(*args))
    return _SAME[name](*args)


class Lanes:
    """A program on vectors of lanes, called on states as `machine.Machine` is."""

    def __init__(self, program: Program):
        self.program = program
        self.shared: dict[str, list[Node]] = {}
        """What is the same for all lanes, by type."""
        for node in program.kept(Level.SHARED):
            self.shared.setdefault(node.dtype.char, []).append(node)
        self.tables = sorted({node.param[0] for node in program.order if node.op == TAKE})
        hasty = ON_CPU if jax.default_backend() == "cpu" else {}
        self._kernel: Any = runtime.jit_arrays(self._advance, **hasty)

    def advance(self, leaves: list[np.ndarray], states: Any, ticks: int, threads: int = 1) -> Any:
        """The states of all lanes, with a leading axis, so many ticks later; XLA chooses the threads."""
        each, tree = jax.tree.flatten(states)
        values: Vectors = {}
        evaluate(self.program.at(Level.SHARED), values, lambda leaf: leaves[leaf].reshape(-1))
        shared = {
            kind: np.array([values[node.number] for node in nodes], kind)
            for kind, nodes in self.shared.items()
        }
        tables = [leaves[leaf].reshape(-1) for leaf in self.tables]
        return jax.tree.unflatten(tree, self._kernel(shared, tables, each, ticks))

    def _advance(
        self, shared: dict[str, Array], tables: list[Array], each: list[Array], ticks: Array
    ) -> list[Array]:
        program, lanes = self.program, each[0].shape[0]
        known: Vectors = {
            node.number: shared[kind][i]
            for kind, nodes in self.shared.items()
            for i, node in enumerate(nodes)
        }
        given = dict(zip(self.tables, tables, strict=True))
        flat = [leaf.reshape(lanes, -1) for leaf in each]
        first = min(word.leaf for word in program.words)
        words = [flat[word.leaf - first][:, word.element] for word in program.words]
        place = {word.place: value for word, value in zip(program.words, words, strict=True)}
        _compute(program.at(Level.LANE), known, given, place)
        changing = program.changing

        def tick(_: Array, moving: list[Array]) -> list[Array]:
            inside = {program.words[i].place: value for i, value in zip(changing, moving, strict=True)}
            now = self._tick(known, given, place | inside)
            return [
                _full(program.after[i], now, lanes, old.dtype)
                for i, old in zip(changing, moving, strict=True)
            ]

        moved = lax.fori_loop(0, ticks, tick, [words[i] for i in changing])
        for i, value in zip(changing, moved, strict=True):
            words[i] = value
        out, at = [], 0
        for leaf in each:
            size = leaf[0].size
            out.append(jnp.stack(words[at : at + size], axis=1).reshape(leaf.shape) if size else leaf)
            at += size
        return out

    def _tick(self, known: Vectors, given: dict[int, Array], place: dict[Any, Array]) -> Vectors:
        """All nodes of a tick."""
        program, now = self.program, dict(known)
        _compute(program.at(Level.TICK, 0), now, given, place)
        for loop in program.graph.loops:
            now |= self._loop(loop, now, given, place)
            _compute(program.at(Level.TICK, 2 * loop.number + 2), now, given, place)
        return now

    def _loop(self, loop: Loop, now: Vectors, given: dict[int, Array], place: dict[Any, Array]) -> Vectors:
        """Return what a loop leaves behind."""
        program, first_row = self.program, len(loop.start)
        lanes = len(next(iter(place.values())))
        carried = [n for n in program.order if n.op == CARRY and n.param[0] == loop.number]
        left = [n for n in program.order if n.op == AFTER and n.param[0] == loop.number]
        rows = [n for n in left if n.param[1] >= first_row]
        body = program.at(Level.TICK, 2 * loop.number + 1)

        def once(_: Array, before: tuple[list[Array], list[Array]]) -> tuple[list[Array], list[Array]]:
            inside = now | {node.number: value for node, value in zip(carried, before[0], strict=True)}
            _compute(body, inside, given, place)
            new = [_full(loop.next[n.param[1]], inside, lanes, n.dtype) for n in carried]
            return new, [_full(loop.rows[n.param[1] - first_row], inside, lanes, n.dtype) for n in rows]

        begin = [_full(loop.start[n.param[1]], now, lanes, n.dtype) for n in carried]
        ended = lax.fori_loop(0, loop.length, once, (begin, [jnp.zeros(lanes, n.dtype) for n in rows]))
        after = {
            n.param[1]: value for n, value in zip([*carried, *rows], [*ended[0], *ended[1]], strict=True)
        }
        return {n.number: after[n.param[1]] for n in left}


def _full(scalar: Scalar, values: Vectors, lanes: int, dtype: np.dtype) -> Array:
    """A value for every lane."""
    return jnp.broadcast_to(value_of(scalar, values), (lanes,)).astype(dtype)


def _compute(nodes: list[Node], values: Vectors, given: dict[int, Array], place: dict[Any, Array]) -> None:
    """Compute nodes in order, as `evaluate.evaluate` does."""
    for node in nodes:
        if node.op in (CARRY, AFTER) or node.number in values:
            continue
        if node.op == INPUT:
            values[node.number] = place[node.param]
        elif node.op == TAKE:
            leaf, first, step, _ = node.param
            values[node.number] = given[leaf][first + step * value_of(node.args[0], values)]
        else:
            args = [value_of(arg, values) for arg in node.args]
            values[node.number] = operation(node.op, node.dtype, args)

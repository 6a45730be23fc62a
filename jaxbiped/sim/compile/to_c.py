"""A program printed as C with vector extensions: a vector holds one word of a block of lanes.

    void walk(long lanes, long first, long last, long ticks, WORD *state, const WORD *shared, const REAL *const *tables)

advances the lanes from `first` to `last`, block by block, by so many ticks or until no lane of the block changes any
more. `state` holds a row of `lanes` for every word, `shared` what is the same for all of them. Words without a sign
count as words with one, since they are places in arrays.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from jaxbiped.sim.compile.graph import AFTER, CARRY, INPUT, TAKE, Node, Scalar
from jaxbiped.sim.compile.interpret import UnknownPrimitiveError
from jaxbiped.sim.compile.program import Level, Program

INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|", "xor": "^",
         "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}  # fmt: skip
WHOLE = {"max": "imax", "min": "imin", "sign": "isign", "abs": "iabs"}
"""Functions of words that are not real."""
UNSIGNED = {"add": "+", "shl": "<<", "shr": ">>"}
"""Of words without a sign."""
PREFIX = {"neg": "-", "not": "~"}


@dataclass(frozen=True)
class Printed:
    """C text, and what belongs to it."""

    text: str
    shared: list[Node]
    """What is the same for all lanes, in the order of the argument."""
    tables: list[int]
    """Leaves that are looked up in."""


def print_c(program: Program, single: bool = True, width: int = 16) -> Printed:
    """The text, in single or double precision."""
    return _Printer(program, single, width).printed()


class _Printer:
    """Prints one program."""

    def __init__(self, program: Program, single: bool, width: int):
        self.program, self.single, self.width = program, single, width
        self.shared = program.kept(Level.SHARED)
        self.held = program.kept(Level.LANE)
        self.changing = program.changing
        self.tables: list[int] = []
        self.name = {node.number: f"v{node.number}" for node in program.order}
        self.name |= {node.number: _cast(node, f"S[{i}]") for i, node in enumerate(self.shared)}
        self.inside = {program.words[i].place: k for k, i in enumerate(self.changing)}
        self.row = {word.place: i for i, word in enumerate(program.words)}

    def printed(self) -> Printed:
        """All of it."""
        hold, tick = list(self._hold()), list(self._tick())
        text = "\n".join([self._head(), *hold, *tick, self._walk(), ""])
        return Printed(text, self.shared, self.tables)

    def _head(self) -> str:
        real, word = ("float", "int") if self.single else ("double", "long long")
        sizes = f"#define W {self.width}\n#define REAL {real}\n#define WORD {word}\n#define SINGLE {int(self.single)}\n"
        return sizes + resources.files(__package__ or "").joinpath("vectors.c").read_text(encoding="utf-8")

    def _hold(self) -> Iterator[str]:
        """The function that computes what a walk does not change, of one block."""
        yield "static void hold(const WORD *state, long lanes, F *H, const WORD *S, const REAL *const *T) {"
        for node in self.program.at(Level.LANE):
            value = self._row(node) if node.op == INPUT else self._value(node)
            yield f"  const {_type(node)} {self.name[node.number]} = {value};"
        for i, node in enumerate(self.held):
            yield f"  H[{i}] = (F){self.name[node.number]};"
        yield "}"
        self.name |= {node.number: f"(({_type(node)})H[{i}])" for i, node in enumerate(self.held)}

    def _row(self, node: Node) -> str:
        """A word of the state, of the lanes of a block."""
        return _loaded(node, f"(F)*(const FU *)(state + {self.row[node.param]} * lanes)")

    def _tick(self) -> Iterator[str]:
        """The function of a tick of one block, which says whether all its lanes have stopped."""
        yield "static int tick(F *X, const F *H, const WORD *S, const REAL *const *T) {"
        yield from self._phase(0)
        for loop in self.program.graph.loops:
            yield from self._loop(loop.number)
            yield from self._phase(2 * loop.number + 2)
        yield f"  const M stopped = {self._operand(self.program.stopped)};"
        for k, i in enumerate(self.changing):
            yield f"  X[{k}] = {_stored(self.program.after[i], self._operand(self.program.after[i]))};"
        yield "  WORD all = -1;\n  EACH all &= stopped[i];\n  return all != 0;\n}"

    def _phase(self, phase: int) -> Iterator[str]:
        """Everything between two loops."""
        for node in self.program.at(Level.TICK, phase):
            if node.op not in (CARRY, AFTER):
                value = (
                    _loaded(node, f"X[{self.inside[node.param]}]") if node.op == INPUT else self._value(node)
                )
                yield f"  const {_type(node)} {self.name[node.number]} = {value};"

    def _loop(self, number: int) -> Iterator[str]:
        """A loop, its body in braces."""
        loop, program = self.program.graph.loops[number], self.program
        carried = {n.param[1]: n for n in program.order if n.op == CARRY and n.param[0] == number}
        left = {n.param[1]: n for n in program.order if n.op == AFTER and n.param[0] == number}
        for i, node in carried.items():
            yield f"  {_type(node)} {self.name[node.number]} = {self._operand(loop.start[i])};"
        rows = {i: node for i, node in left.items() if i >= len(loop.start)}
        for node in rows.values():
            yield f"  {_type(node)} {self.name[node.number]} = {{0}};"
        yield f'  for (int k = 0; k < {loop.length}; k++) {{\n  __asm__ volatile("" ::: "memory");'
        yield from self._phase(2 * number + 1)
        for i, node in rows.items():
            yield f"  {self.name[node.number]} = {self._operand(loop.rows[i - len(loop.start)])};"
        for i, node in carried.items():
            yield f"  const {_type(node)} next{i} = {self._operand(loop.next[i])};"
        for i, node in carried.items():
            yield f"  {self.name[node.number]} = next{i};"
        yield "  }"
        for i, node in left.items():
            if i in carried:
                self.name[node.number] = self.name[carried[i].number]

    def _walk(self) -> str:
        """The function that is called."""
        load = "\n".join(
            f"    X[{k}] = *(const FU *)(at + {i} * lanes);" for k, i in enumerate(self.changing)
        )
        store = "\n".join(f"    *(FU *)(at + {i} * lanes) = X[{k}];" for k, i in enumerate(self.changing))
        sizes = len(self.changing) or 1, len(self.held) or 1
        return f"""#ifdef __cplusplus
extern "C"
#endif
void walk(long lanes, long first, long last, long ticks, WORD *state, const WORD *S, const REAL *const *T) {{
  F X[{sizes[0]}], H[{sizes[1]}];
  for (long block = first; block < last; block += W) {{
    WORD *at = state + block;
    hold(at, lanes, H, S, T);
{load}
    for (long t = 0; t < ticks && !tick(X, H, S, T); t++);
{store}
  }}
}}"""

    def _operand(self, scalar: Scalar) -> str:
        if isinstance(scalar, Node):
            return self.name[scalar.number]
        return _number(scalar)

    def _value(self, node: Node) -> str:
        """An operation."""
        if node.op == TAKE:
            return self._take(node)
        args = [self._operand(arg) for arg in node.args]
        if node.dtype == np.uint32 and node.op in UNSIGNED:
            return f"(M)((U)({args[0]}) {UNSIGNED[node.op]} (U)({args[1]}))"
        if node.op in INFIX:
            return f"{args[0]} {INFIX[node.op]} {args[1]}"
        if node.op in PREFIX:
            return f"{PREFIX[node.op]}{args[0]}"
        return self._called(node, args)

    def _called(self, node: Node, args: list[str]) -> str:
        """An operation that C has no sign for."""
        if node.op == "select":
            return f"SELECT({', '.join(args)})"
        if node.op == "convert":
            return _converted(node, args[0])
        if node.op == "is_finite":
            return f"is_finite({args[0]})"
        if node.op == "bits":
            if not self.single:
                raise UnknownPrimitiveError("32 bits as a number in double precision")
            return f"(F)({args[0]})"
        if node.args[0].dtype.kind == "f":
            return f"v{node.op}({', '.join(args)})"
        if node.op == "rem":
            return f"{args[0]} % {args[1]}"
        return f"{WHOLE[node.op]}({', '.join(args)})"

    def _take(self, node: Node) -> str:
        """A look-up."""
        leaf, first, step, _ = node.param
        if any(leaf == word.leaf for word in self.program.words) or node.dtype.kind != "f":
            raise UnknownPrimitiveError("look-up in a long table that every lane has for itself")
        if leaf not in self.tables:
            self.tables.append(leaf)
        return f"take(T[{self.tables.index(leaf)}] + {first}, {self._operand(node.args[0])}, {step})"


def _type(node: Node) -> str:
    return "F" if node.dtype.kind == "f" else "M"


def _cast(node: Node, word: str) -> str:
    """A shared word as a vector."""
    return f"VF(((const REAL *)S)[{word[2:-1]}])" if node.dtype.kind == "f" else f"VM({word})"


def _loaded(node: Node, vector: str) -> str:
    """A word of the state, in which a truth is a one."""
    return (
        vector
        if node.dtype.kind == "f"
        else f"-(M)({vector})"
        if node.dtype.kind == "b"
        else f"(M)({vector})"
    )


def _stored(scalar: Scalar, text: str) -> str:
    return f"(F)(-({text}))" if scalar.dtype.kind == "b" else f"(F)({text})"


def _number(value: Any) -> str:
    if value.dtype.kind == "b":
        return f"VM({-int(value)})"
    if value.dtype.kind in "iu":
        return f"VM({int(value)})"
    if value.dtype.kind != "f":
        raise UnknownPrimitiveError(f"numbers of type {value.dtype}")
    if np.isnan(value):
        return "VF(NAN)"
    if np.isinf(value):
        return f"VF({'-' if np.signbit(value) else ''}INFINITY)"
    return f"VF({float(value)!r})"


def _converted(node: Node, text: str) -> str:
    """Convert from one type to another."""
    kinds = (node.args[0].dtype.kind + node.dtype.kind).replace("u", "i")
    texts = {"bf": f"TO_F(-{text})", "if": f"TO_F({text})", "fi": f"to_int({text})", "bi": f"-{text}",
             "ib": f"({text} != 0)", "ii": text, "ff": text}  # fmt: skip
    if kinds not in texts:
        raise UnknownPrimitiveError(f"from {node.args[0].dtype} to {node.dtype}")
    return texts[kinds]

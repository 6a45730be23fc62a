"""A graph as a program: what of it is needed, what changes how often, and in which order it is computed."""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from jaxbiped.sim.compile.graph import AFTER, CARRY, INPUT, LOST, Graph, Node, Scalar
from jaxbiped.sim.compile.interpret import UnknownPrimitiveError


class Level(IntEnum):
    """Levels of how often a node changes."""

    SHARED = 0
    """It is the same for all lanes."""
    LANE = 1
    """It is the same in every tick of a walk."""
    TICK = 2


@dataclass(frozen=True)
class Word:
    """A number that a lane carries from tick to tick."""

    leaf: int
    element: int
    dtype: np.dtype

    @property
    def place(self) -> tuple[int, int]:
        """Parameter of its node."""
        return self.leaf, self.element


@dataclass(frozen=True)
class Program:
    """A tick of one lane, as scalars."""

    graph: Graph
    words: list[Word]
    """What a lane carries on."""
    after: list[Scalar]
    """The words after a tick."""
    stopped: Scalar
    """Whether no tick changes this lane any more."""
    level: dict[int, Level] = field(init=False)
    phase: dict[int, int] = field(init=False)
    """0 for what comes before all loops of a tick, 2 k + 1 for what is in the k-th one, 2 k + 2 for what follows it."""
    order: list[Node] = field(init=False)
    """All nodes that are needed, each after those it needs but for what a loop carries."""

    def __post_init__(self) -> None:
        """Sort the nodes."""
        order = list(_in_order(self.graph, [*self.after, self.stopped]))
        fixed = {word.place for i, word in enumerate(self.words) if self._is_fixed(i, word)}
        carried = {word.place for word in self.words}
        level: dict[int, Level] = {}
        phase: dict[int, int] = {}
        for node in sorted(order, key=lambda node: node.number):
            level[node.number] = _level(node, level, carried, fixed)
            phase[node.number] = _phase(node, phase)
        for name, value in (("level", level), ("phase", phase), ("order", order)):
            object.__setattr__(self, name, value)

    def at(self, level: Level, phase: int = 0) -> list[Node]:
        """Nodes of a level and phase, in order."""
        return [n for n in self.order if self.level[n.number] == level and self.phase[n.number] == phase]

    @property
    def changing(self) -> list[int]:
        """Numbers of the words that a tick may change."""
        return [i for i, word in enumerate(self.words) if not self._is_fixed(i, word)]

    def _is_fixed(self, i: int, word: Word) -> bool:
        new = self.after[i]
        return isinstance(new, Node) and new.op == INPUT and new.param == word.place

    def kept(self, level: Level) -> list[Node]:
        """Nodes of a level that later levels need."""
        users = [n for n in self.order if self.level[n.number] > level]
        wanted = {a.number: a for user in users for a in needs(self.graph, user)}
        wanted |= {s.number: s for s in [*self.after, self.stopped] if isinstance(s, Node)}
        return [n for n in self.order if n.number in wanted and self.level[n.number] == level]


def needs(graph: Graph, node: Node) -> list[Node]:
    """Return what a node needs, loops included."""
    found: list[Scalar] = list(node.args)
    if node.op in (CARRY, AFTER):
        number, i = node.param
        loop = graph.loops[number]
        carried = i < len(loop.start)
        found += [loop.start[i], loop.next[i]] if carried else [loop.rows[i - len(loop.start)]]
        if node.op == AFTER and carried:
            found.append(graph.make(CARRY, (), node.dtype, node.param))
    return [scalar for scalar in found if isinstance(scalar, Node)]


def _in_order(graph: Graph, outputs: Iterable[Scalar]) -> Iterator[Node]:
    """Return what outputs need, each node just before it is needed first, so that few values wait."""
    seen: set[int] = set()
    waiting = deque(output for output in outputs if isinstance(output, Node))
    while waiting:
        stack = [(waiting.popleft(), False)]
        while stack:
            node, ready = stack.pop()
            if ready:
                yield node
            elif node.number not in seen:
                seen.add(node.number)
                if node.op == LOST:
                    raise UnknownPrimitiveError("a row of a loop other than the last")
                if node.op == CARRY:  # what it needs may need it
                    waiting.extend(needs(graph, node))
                stack.append((node, True))
                stack.extend((arg, False) for arg in reversed(needs(graph, node)) if node.op != CARRY)


def _level(node: Node, level: dict[int, Level], carried: set, fixed: set) -> Level:
    if node.op in (CARRY, AFTER):
        return Level.TICK
    if node.op == INPUT:
        if node.param not in carried:
            return Level.SHARED
        return Level.LANE if node.param in fixed else Level.TICK
    return max((level[arg.number] for arg in node.needs), default=Level.SHARED)


def _phase(node: Node, phase: dict[int, int]) -> int:
    if node.op == CARRY:
        return 2 * node.param[0] + 1
    if node.op == AFTER:
        return 2 * node.param[0] + 2
    return max((phase[arg.number] for arg in node.needs), default=0)

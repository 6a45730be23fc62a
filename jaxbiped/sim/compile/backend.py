"""Whole segments of batched walks in machine code: `Options(backend="c")`, or as scalars for XLA: `"scalar"`.

The pure tick stays the only source. At the first use of a robot and controller it is traced, compiled and compared with
what XLA makes of it; later processes find it on disk (`kept`) and compare it with what XLA made of it then.
"""

import contextlib
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Bool

from jaxbiped import runtime
from jaxbiped.sim.compile import build, kept
from jaxbiped.sim.compile.interpret import UnknownPrimitiveError
from jaxbiped.sim.compile.machine import Code, Machine
from jaxbiped.sim.compile.program import Program
from jaxbiped.sim.compile.to_jax import Lanes
from jaxbiped.sim.compile.trace import Step, is_part, program_of, shared_leaves, tick, trace
from jaxbiped.sim.options import AUTO, SCALAR, XLA, C, Options, why_not
from jaxbiped.sim.tick import ENDLESS, PureSimulation, State

MOVING, COMPARED, TICKS = 50, 16, 3
"""Control ticks to a moving state, lanes and control ticks from there, in which machine code is compared with XLA's."""
ROUNDING = {4: 2e-3, 8: 1e-8}
"""By bytes of a number, the largest difference after them by the largest magnitude of a variable, or by 1."""
ODD_LANES = 1 / 8
"""Share of lanes that may differ by more, since a threshold was passed on one side only."""

ENOUGH = 1_500_000
"""Physics ticks from which on `auto` chooses C: with fewer XLA, which is compiled faster, is ready sooner."""


class NotServedError(ValueError):
    """Machine code cannot do a walk: a primitive without a rule, or a use of one."""


_machines: dict[tuple[Hashable, str], Machine | Lanes] = {}


def serves(options: Options) -> bool:
    """Tell whether walks with such options can be in C here: see `Options.backend`, and there is a compiler."""
    return why_not(options) is None and jax.default_backend() == "cpu" and build.compiler() is not None


def chosen(options: Options, ticks: int) -> str:
    """The backend of so many physics ticks of one program, those of all its walks together."""
    if options.backend != AUTO:
        return options.backend
    return C if ticks >= ENOUGH and serves(options) else XLA


def kind_of(options: Options) -> str:
    """Name what a program is made into where XLA is not given the tick as it is written: `c` or `scalar`."""
    return SCALAR if options.backend == SCALAR else C


def segments(
    simulation: PureSimulation, ticks: int
) -> Callable[[State], tuple[State, Bool[np.ndarray, " n"]]]:
    """Function from states with a leading axis to those so many control ticks later, and which walks have stopped.

    Its first call raises:
        ValueError: where there is no C compiler, and where the machine code does not do what XLA's does.
    """
    leaves, made, kind = shared_leaves(simulation), [], kind_of(simulation.options)

    def further(states: State) -> tuple[State, Bool[np.ndarray, " n"]]:
        if not made:
            made.append(machine_of(simulation, endless(states), kind=kind))
        states = made[0].advance(leaves, states, ticks, runtime.threads())
        return states, np.asarray(jax.vmap(lambda state: state.stopped)(states))

    return further


def endless(states: State) -> State:
    """The same walks, with no end: to compare from."""
    return eqx.tree_at(lambda s: s.left, states, np.full(np.shape(states.left), ENDLESS, np.int32))


def machine_of(
    shared: Any,
    states: Any,
    step: Step = tick,
    rounding: Mapping[int, float] = ROUNDING,
    kind: str = C,
) -> Machine | Lanes:
    """The machine code of a step, made, and compared with XLA's, at its first use.

    Args:
        shared: by all lanes, as the simulation.
        states: which are moving some ticks later, to compare from.
        step: what a lane does in a tick.
        rounding: by which its variables may differ from XLA's, as `ROUNDING`.
        kind: `c` or `scalar`.
    """
    key = _key(shared, states, step)
    if (key, kind) not in _machines:
        made: Machine | Lanes
        if kind == SCALAR:
            made = _made_of_scalars(shared, states, step, rounding)
        else:
            made = _made(shared, states, step, key[:2], rounding)
        _machines[key, kind] = made
    return _machines[key, kind]


def _made(shared: Any, states: Any, step: Step, parts: Hashable, rounding: Mapping[int, float]) -> Machine:
    """Make machine code from what is kept, compared with the example there; else trace, compile and compare."""
    name = kept.name_of(shared, step, parts)
    found = kept.recall(name)
    if found is not None:
        machine = Machine(found.code)
        tree = jax.tree.structure(states)
        before, after = (jax.tree.unflatten(tree, each) for each in found.example[1:])
        _require_same(machine.advance(found.example.leaves, before, TICKS), after, rounding)
        return machine
    states = jax.tree.map(np.asarray, states)
    reals = {leaf.dtype for leaf in jax.tree.leaves(states) if leaf.dtype.kind == "f"}
    with _served(C):
        closed, program = _traced(shared, states, step)
        code = Code.of(program, single=np.dtype(np.float64) not in reals)
    runtime.now("compiling the walk as C")
    machine = Machine(code)
    runtime.now("comparing C with XLA")
    kept.keep(name, kept.Kept(code, compare(machine, closed, shared, states, rounding)))
    return machine


def _made_of_scalars(shared: Any, states: Any, step: Step, rounding: Mapping[int, float]) -> Lanes:
    """Give XLA the scalars, and compare; XLA's own cache keeps what it compiles."""
    states = jax.tree.map(np.asarray, states)
    with _served(SCALAR):
        closed, program = _traced(shared, states, step)
        machine = Lanes(program)
        runtime.now("compiling the walk's scalars, and comparing them with XLA")
        compare(machine, closed, shared, states, rounding)
    return machine


def _traced(shared: Any, states: Any, step: Step) -> tuple[Any, Program]:
    """A traced step, and its program."""
    runtime.now("tracing the walk")
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), states)
    closed = trace(shared, one, step)
    return closed, program_of(closed, shared, one)


@contextlib.contextmanager
def _served(kind: str) -> Iterator[None]:
    """Name the backend that there is no rule for."""
    try:
        yield
    except UnknownPrimitiveError as error:
        raise NotServedError(f"backend: {kind!r} cannot do this walk: {error}; allowed: {XLA}") from error


def compare(
    machine: Machine | Lanes,
    closed: Any,
    shared: Any,
    states: Any,
    rounding: Mapping[int, float] = ROUNDING,
) -> kept.Example:
    """Refuse machine code that does not do what XLA's does, from a moving state on; what XLA's does.

    Raises:
        ValueError: with the name of the variable that differs most.
    """
    leaves, each = shared_leaves(shared), jax.tree.leaves(states)
    few = np.arange(COMPARED) % len(each[0])
    before = after = machine.advance(leaves, jax.tree.map(lambda leaf: leaf[few], states), MOVING)
    further = _by_xla(closed, leaves)
    for _ in range(TICKS):
        after = further(after)
    _require_same(machine.advance(leaves, before, TICKS), after, rounding)
    return kept.Example(
        leaves, jax.tree.leaves(before), [np.asarray(leaf) for leaf in jax.tree.leaves(after)]
    )


def _require_same(ours: Any, theirs: Any, rounding: Mapping[int, float]) -> None:
    """Refuse what differs in more lanes than a threshold explains."""
    name, odd = worst(ours, theirs, rounding)
    if odd > ODD_LANES:
        raise ValueError(f"backend: 'c' differs from XLA in {name} in {odd:.0%} of lanes; allowed: {XLA}")


def worst(ours: Any, theirs: Any, rounding: Mapping[int, float] = ROUNDING) -> tuple[str, float]:
    """The variable in which most lanes differ by more than rounding, and their share."""
    pairs = zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(theirs), strict=True)
    shares = [
        (float(np.mean(_odd(np.asarray(a), np.asarray(b), rounding))), jax.tree_util.keystr(p)[1:])
        for (p, a), b in pairs
    ]
    share, name = max(shares)
    return name, share


def _odd(a: np.ndarray, b: np.ndarray, rounding: Mapping[int, float]) -> np.ndarray:
    """Tell which lanes differ."""
    a, b = a.reshape(len(a), -1), b.reshape(len(b), -1)
    if a.dtype.kind != "f":
        return np.asarray((a != b).any(axis=1))
    finite = np.isfinite(b)
    size = max(1.0, np.abs(b[finite]).max(initial=0.0))
    close = np.isclose(a, b, rtol=0.0, atol=rounding[a.dtype.itemsize] * size, equal_nan=True)
    return np.logical_not(np.all(close, axis=1))


def _by_xla(closed: Any, leaves: list[np.ndarray]) -> Any:
    """The traced step, compiled by XLA for all lanes, as a function of states; compiled fast rather than well."""

    def further(states: Any) -> Any:
        each, tree = jax.tree.flatten(states)
        outs = jax.vmap(lambda *lane: jaxpr_as_fun(closed)(*leaves, *lane))(*each)
        return jax.tree.unflatten(tree, outs[:-1])

    return runtime.jit_arrays(further, xla_backend_optimization_level=0)


def _key(shared: Any, states: Any, step: Step) -> tuple[Hashable, ...]:
    """All that machine code depends on."""
    arrays, rest = eqx.partition(shared, eqx.is_array)
    parts = tuple((leaf.shape, leaf.dtype.char, *_part(leaf)) for leaf in shared_leaves(shared))
    like = tuple((np.shape(leaf)[1:], np.dtype(leaf.dtype).char) for leaf in jax.tree.leaves(states))
    fixed, tree = jax.tree.flatten(rest)
    known = tuple(x.tobytes() if isinstance(x, np.ndarray) else x for x in fixed)
    return parts, like, known, step, tree, jax.tree.structure(arrays), jax.tree.structure(states)


def _part(leaf: np.ndarray) -> tuple[bytes, bytes]:
    part = is_part(leaf)
    return part.tobytes(), leaf[part].tobytes()

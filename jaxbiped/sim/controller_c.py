"""A controller as C99, for one robot: sensors in, joint references out; the same tick as in the simulator.

What is printed is the traced `Controller.step` and the inverse kinematics of its targets, see `compile`: every number
of the robot, the gait and the stages is written into the text.
"""

import ast
import inspect
import re
import textwrap
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from jaxbiped.adapt import Controller, ControllerState, Sensed
from jaxbiped.robot import JOINT_NAMES
from jaxbiped.sim.compile.program import Program
from jaxbiped.sim.compile.to_plain_c import Body, literal, type_of
from jaxbiped.sim.compile.trace import program_of, shared_leaves, trace
from jaxbiped.sim.model import CORNER_NAMES
from jaxbiped.sim.servo import Reference
from jaxbiped.sim.tick import PureSimulation, servo_reference

LONG = 24
"""Numbers of an array from which on it may be looked up in, and is a table of its own."""

# fmt: off
WORDS_OF_C = frozenset((
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern", "float",
    "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed", "sizeof",
    "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while",
))
# fmt: on


class CFiles(NamedTuple):
    """A controller in C."""

    name: str
    """Stem of the files' names, and first word of all that they define."""
    header: str
    source: str


class Tick(eqx.Module):
    """Record of all that goes into a control tick and comes out of it."""

    state: ControllerState
    sensors: Sensed
    reference: Reference
    status: Int[Array, "2"]


def step(simulation: PureSimulation, tick: Tick) -> tuple[Tick, Bool[Array, ""]]:
    """One control tick; pure."""
    state, targets = simulation.controller.step(tick.state, tick.sensors)
    reference, status = servo_reference(simulation.robot, targets, simulation.torque)
    read = Sensed.nothing(jnp.zeros_like(tick.sensors.time))  # none of them is needed again
    return Tick(state, read, reference, status), jnp.zeros((), bool)


def controller_c(simulation: PureSimulation, name: str) -> CFiles:
    """Print the controller of a simulation, in the precision that JAX computes with.

    Args:
        simulation: of which robot, controller, feed-forward torques and control tick count.
        name: stem of the files' names, and first word of all that they define.

    Raises:
        ValueError: for a name that is none in C.
        NotImplementedError: for a stage that does what cannot be printed.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ValueError(f"name: got {name!r}, allowed: small letters, digits and _, a letter first")
    first = _first(simulation.controller)
    program = program_of(trace(simulation, first, step), simulation, first, known=_is_written)
    return _Printer(name, program, simulation, first).files()


def _first(controller: Controller) -> Tick:
    """The tick before the first one."""
    zeros = jnp.zeros((2, 6), jnp.result_type(float))
    sensors = Sensed.nothing(jnp.zeros((), zeros.dtype))
    tick = Tick(controller.init(), sensors, Reference(zeros, zeros, zeros), jnp.zeros(2, jnp.int32))
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), tick)


def _is_written(values: np.ndarray) -> np.ndarray:
    """Tell which numbers stand where they are used; those of long arrays stand in tables."""
    return np.full(values.shape, values.dtype.kind != "f" or values.size < LONG)


class _Printer:
    """Prints one controller."""

    def __init__(self, name: str, program: Program, simulation: PureSimulation, first: Tick):
        self.name, self.program, self.control_dt = name, program, simulation.options.control_dt
        self.leaves = shared_leaves(simulation)
        self.paths = [
            (jax.tree_util.keystr(path, simple=True, separator="."), leaf)
            for path, leaf in jax.tree_util.tree_leaves_with_path(first)
        ]
        self.tables: set[int] = set()
        self.body = Body(program, self._word, self._table)

    def files(self) -> CFiles:
        """Both files."""
        lines = list(self.body.lines())
        last = [
            f"  {self._place(word.leaf, word.element, is_out=True)} = {self.body.operand(new)};"
            for word, new in zip(self.program.words, self.program.after, strict=True)
            if not self._path(word.leaf)[0].startswith("sensors.")
        ]
        source = "\n".join(
            [f'#include "{self.name}.h"', "#include <math.h>", "", f"typedef {self.name}_real real;", ""]
            + [self._table_text(leaf) for leaf in sorted(self.tables)]
            + [self.body.helping()]
            + [f"void {self.name}_start({self.name}_state *state) {{", *self._start(), "}", ""]
            + [f"{self._signature()} {{", *lines, *last, "}", ""]
        )
        return CFiles(self.name, self._header(), source)

    def _signature(self) -> str:
        n = self.name
        return f"void {n}_step({n}_state *state, const {n}_sensors *sensors, {n}_reference *reference)"

    def _path(self, leaf: int) -> tuple[str, Any]:
        return self.paths[leaf - len(self.leaves)]

    def _word(self, leaf: int, element: int) -> str:
        """The expression of a number that is given."""
        if leaf >= len(self.leaves):
            return self._place(leaf, element)
        return f"{self._table(leaf)}[{element}]"

    def _place(self, leaf: int, element: int, is_out: bool = False) -> str:
        """The member of a struct that holds a word; new references are written, old ones are not read."""
        path, like = self._path(leaf)
        struct, _, member = path.partition(".")
        if struct in ("reference", "status"):
            assert is_out
            struct, member = "reference", member or "status"
        at = "".join(f"[{i}]" for i in np.unravel_index(element, like.shape)) if like.shape else ""
        return f"{struct}->{_member(member)}{at}"

    def _table(self, leaf: int) -> str:
        self.tables.add(leaf)
        return f"table{leaf}"

    def _table_text(self, leaf: int) -> str:
        flat = self.leaves[leaf].reshape(-1)
        text = textwrap.fill(", ".join(literal(x).removeprefix("(real)") for x in flat), 116)
        return f"static const real table{leaf}[{flat.size}] = {{\n{text}\n}};\n"

    def _start(self) -> list[str]:
        """The state before the first tick."""
        lines = []
        for word in self.program.words:
            path, like = self._path(word.leaf)
            if path.startswith("state."):
                value = literal(np.asarray(like).reshape(-1)[word.element])
                lines.append(f"  {self._place(word.leaf, word.element)} = {value};")
        return lines

    def _members(self, struct: str, texts: dict[str, str], unused: str = "") -> str:
        """The members of a struct, with comments."""
        read = {node.param[0] for node in self.program.order if node.op == "input"}
        lines = []
        for number, (path, like) in enumerate(self.paths, len(self.leaves)):
            first, _, member = path.partition(".")
            if first == "status" and struct == "reference":
                first, member = struct, first
            if first != struct:
                continue
            text = texts.get(member, "")
            text += unused if unused and number not in read else ""
            size = "".join(f"[{n}]" for n in like.shape)
            kind = type_of(np.dtype(like.dtype)).replace("real", f"{self.name}_real")
            lines.append(f"  {kind} {_member(member)}{size};" + (f" /* {text.strip()} */" if text else ""))
        return "\n".join(lines)

    def _header(self) -> str:
        n, guard = self.name, f"{self.name.upper()}_H"
        sensors = self._members("sensors", said_of(Sensed), " Not read by this controller.")
        status = {"status": "0 where a leg reaches its target, else what the inverse kinematics had to cut."}
        reference = self._members("reference", {**said_of(Reference), **status})
        real = "float" if self.body.single else "double"
        return f"""\
/* A walking controller: planner, adaptation and inverse kinematics, for one robot and one walk.

   {n}_start once, then {n}_step every {n.upper()}_CONTROL_DT seconds, with what the sensors say.
   Feet, legs: 0 left, 1 right. Sole corners: {", ".join(CORNER_NAMES)}.
   Joints of a leg: {", ".join(JOINT_NAMES)}. Truths are 0 or 1. */
#ifndef {guard}
#define {guard}

#define {n.upper()}_CONTROL_DT {self.control_dt!r}
typedef {real} {n}_real;

typedef struct {{
{sensors}
}} {n}_sensors;

typedef struct {{
{reference}
}} {n}_reference;

/* Carried from tick to tick; nobody else's to write. */
typedef struct {{
{self._members("state", {})}
}} {n}_state;

void {n}_start({n}_state *state);
{self._signature()};

#endif
"""


def _member(path: str) -> str:
    """Name of a member; words of C get a _ at their end."""
    name = path.replace(".", "_")
    return f"{name}_" if name in WORDS_OF_C else name


def said_of(module: type) -> dict[str, str]:
    """Return what a module's source says of its fields."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(module))).body[0]
    assert isinstance(tree, ast.ClassDef)
    said = {}
    for field, text in zip(tree.body, tree.body[1:], strict=False):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
        ):
            said[field.target.id] = " ".join(str(text.value.value).split())
    return said

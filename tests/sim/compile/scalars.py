"""Small functions as programs: a lane for every row of their arguments."""

import ctypes
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxbiped.sim.compile import build
from jaxbiped.sim.compile.arrays import filled
from jaxbiped.sim.compile.evaluate import one_tick
from jaxbiped.sim.compile.graph import Graph
from jaxbiped.sim.compile.interpret import ROLLED, scalarise
from jaxbiped.sim.compile.machine import Code, Machine
from jaxbiped.sim.compile.program import Program, Word
from jaxbiped.sim.compile.to_jax import Lanes
from jaxbiped.sim.compile.to_plain_c import Body, type_of


def program_of(function: Callable[..., Any], args: tuple[np.ndarray, ...], rolled: int = ROLLED) -> Program:
    """The program whose words are the elements of the arguments, then those of what comes of them."""
    graph, inputs = Graph(), []
    words: list[Word] = []
    for leaf, arg in enumerate(args):
        mine = [Word(leaf, i, arg.dtype) for i in range(arg[0].size)]
        words += mine
        inputs.append(
            filled((graph.input(w.leaf, w.element, w.dtype) for w in mine), arg.shape[1:], arg.dtype)
        )
    closed = jax.make_jaxpr(function)(*(arg[0] for arg in args))
    outs = scalarise(closed, inputs, graph, rolled)
    after = [graph.input(word.leaf, word.element, word.dtype) for word in words]
    for leaf, out in enumerate(outs, len(args)):
        dtype = closed.out_avals[leaf - len(args)].dtype
        words += [Word(leaf, i, dtype) for i in range(out.size)]
        after += list(np.asarray(out).reshape(-1))
    return Program(graph, words, after, np.False_)


def run_graph(
    function: Callable[..., Any], args: tuple[np.ndarray, ...], rolled: int = ROLLED
) -> list[np.ndarray]:
    """What comes of the arguments, by NumPy."""
    program, lanes = program_of(function, args, rolled), len(args[0])
    given = [row for arg in args for row in arg.reshape(lanes, -1).T]
    spare = [np.zeros(lanes, word.dtype) for word in program.words[len(given) :]]
    rows = one_tick(program, [*given, *spare], lambda leaf: np.zeros(0))
    return _shaped(function, args, rows[len(given) :])


def run_c(
    function: Callable[..., Any], args: tuple[np.ndarray, ...], single: bool, rolled: int = ROLLED
) -> list[np.ndarray]:
    """What comes of the arguments, by machine code."""
    program, lanes = program_of(function, args, rolled), len(args[0])
    given = [row for arg in args for row in arg.reshape(lanes, -1).T]
    spare = [np.zeros(lanes, word.dtype) for word in program.words[len(given) :]]
    rows = Machine(Code.of(program, single)).advance([], [*given, *spare], 1)
    return _shaped(function, args, rows[len(given) :])


def run_lanes(
    function: Callable[..., Any], args: tuple[np.ndarray, ...], rolled: int = ROLLED
) -> list[np.ndarray]:
    """What comes of the arguments, by XLA from the scalars."""
    program = program_of(function, args, rolled)
    outs = jax.tree.leaves(jax.eval_shape(jax.vmap(function), *args))
    spare = [np.zeros(out.shape, out.dtype) for out in outs]
    states = Lanes(program).advance([], [*args, *spare], 1)
    return [np.asarray(leaf).reshape(out.shape) for leaf, out in zip(states[len(args) :], outs, strict=True)]


def _shaped(function: Any, args: tuple[np.ndarray, ...], rows: list[np.ndarray]) -> list[np.ndarray]:
    shapes = jax.tree.leaves(jax.eval_shape(jax.vmap(function), *args))
    out, at = [], 0
    for shape in shapes:
        size = int(np.prod(shape.shape[1:], dtype=int))
        out.append(
            np.stack(rows[at : at + size], axis=-1).reshape(shape.shape) if size else np.zeros(shape.shape)
        )
        at += size
    return out


def run_plain_c(function: Callable[..., Any], args: tuple[np.ndarray, ...], folder: Path) -> list[np.ndarray]:
    """What comes of the arguments, by plain C of one lane, compiled in a folder."""
    program = program_of(function, args)
    row = {word.place: i for i, word in enumerate(program.words)}
    kind = {word.place: type_of(word.dtype) for word in program.words}
    body = Body(program, lambda *place: f"({kind[place]})in[{row[place]}]", lambda leaf: f"table{leaf}")
    lines = list(body.lines())
    outs = [f"  out[{i}] = {body.operand(new)};" for i, new in enumerate(program.after)]
    head = ["#include <math.h>", f"typedef {'float' if body.single else 'double'} real;", body.helping()]
    text = [*head, "void run(const double *in, double *out) {", *lines, *outs, "}", ""]
    number = len(
        list(folder.iterdir())
    )  # another name each time: a library that is loaded must not be replaced
    source, made = folder / f"run{number}.c", folder / f"run{number}.so"
    source.write_text("\n".join(text))
    command = [
        build.compiler(),
        "-std=c99",
        "-Wall",
        "-Werror",
        "-shared",
        "-fPIC",
        source,
        "-o",
        made,
        "-lm",
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    run = ctypes.CDLL(str(made)).run
    lanes = np.concatenate([arg.reshape(len(arg), -1) for arg in args], axis=1).astype(np.float64)
    lanes = np.pad(lanes, ((0, 0), (0, len(program.words) - lanes.shape[1])))
    after = np.zeros_like(lanes)
    for before, new in zip(lanes, after, strict=True):
        run(before.ctypes, new.ctypes)
    return _shaped(function, args, list(after.T)[sum(arg[0].size for arg in args) :])

"""Programs kept on disk, with an example of what XLA makes of them: tracing and printing take longer than compiling.

A name covers all that a program depends on: the sources of this package, versions, the parts of the simulation that
are no numbers, and the numbers that are written into the text. What has a class from elsewhere (a stage of one's own)
is not kept, since its source is not known.
"""

import contextlib
import hashlib
import pickle
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxbiped import files
from jaxbiped.sim.compile import build
from jaxbiped.sim.compile.graph import Node, Scalar
from jaxbiped.sim.compile.machine import Code

OURS = ("jaxbiped", "mujoco", "equinox", "jax", "jaxlib", "builtins", "collections")
"""Packages whose classes the name covers."""
VERSIONS = ("jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx", "equinox")
SETTINGS = ("jax_threefry_partitionable", "jax_numpy_dtype_promotion", "jax_default_matmul_precision")
"""JAX's, which decide what is traced."""


class Example(NamedTuple):
    """An example of what XLA made of some lanes."""

    leaves: list[np.ndarray]
    """Of what all lanes share."""
    before: list[np.ndarray]
    """Leaves of the states."""
    after: list[np.ndarray]
    """The same some ticks later."""


class Kept(NamedTuple):
    """A program and its example."""

    code: Code
    example: Example


def name_of(shared: Any, step: Any, parts: Any) -> str | None:
    """Name of a step's program; None if not everything it depends on can be named.

    Args:
        shared: by all lanes, as the simulation.
        step: what a lane does in a tick.
        parts: shapes and numbers that the program is for.
    """
    _, rest = eqx.partition(shared, eqx.is_array)
    said: list[Any] = [(step.__module__, step.__qualname__)]
    is_ours = step.__module__.split(".")[0] in OURS
    if not is_ours or not _describe(jax.tree.structure(rest), said):
        return None
    said += jax.tree.leaves(rest)
    if not all(isinstance(leaf, bool | int | float | str) for leaf in jax.tree.leaves(rest)):
        return None
    versions = [metadata.version(package) for package in VERSIONS]
    settings = [jax.config.values[name] for name in SETTINGS]
    try:
        known = pickle.dumps((versions, settings, files.source_hash(), said, parts), protocol=4)
    except Exception:  # whatever an object of somebody's makes of being pickled
        return None
    return hashlib.sha256(known).hexdigest()[:32]


def _describe(tree: Any, said: list[Any]) -> bool:
    """Collect what a tree's nodes are; whether all of them are of known packages."""
    node = tree.node_data()
    if node is None:
        said.append("leaf" if tree.num_leaves else "none")
        return True
    kind, fixed = node
    said.append((kind.__module__, kind.__qualname__, fixed))
    return kind.__module__.split(".")[0] in OURS and all(
        [_describe(child, said) for child in tree.children()]
    )


def recall(name: str | None) -> Kept | None:
    """Return what was kept under a name."""
    if name is None:
        return None
    try:
        tables, text, single, rows, shared, example = pickle.loads(_file(name).read_bytes())
        made = _nodes(rows)
        code = Code(text, single, tables, list(made.values()), [made[number] for number in shared])
        return Kept(code, Example(*example))
    except Exception:  # not there, or cut off, or not ours: it is made anew
        return None


def keep(name: str | None, kept: Kept) -> None:
    """Keep a program; a folder that cannot be written costs time, nothing else."""
    if name is None:
        return
    code = kept.code
    rows = [(n.number, n.op, [_reference(a) for a in n.args], n.dtype, n.param) for n in code.nodes]
    shared = [node.number for node in code.shared]
    content = pickle.dumps((code.tables, code.text, code.single, rows, shared, tuple(kept.example)))
    with contextlib.suppress(OSError):
        build.folder().mkdir(parents=True, exist_ok=True)
        files.write(_file(name), content)


def _file(name: str) -> Path:
    return build.folder() / f"{name}.program"


def _reference(scalar: Scalar) -> tuple[bool, Any]:
    """Replace a node by its number: whether it is one, and the number or the scalar itself."""
    return (True, scalar.number) if isinstance(scalar, Node) else (False, scalar)


def _nodes(rows: list[tuple[Any, ...]]) -> dict[int, Node]:
    """Nodes by their numbers."""
    made: dict[int, Node] = {}
    for number, op, args, dtype, param in rows:
        scalars = tuple(made[value] if is_node else value for is_node, value in args)
        made[number] = Node(op, scalars, dtype, param, number)
    return made

"""From a function of one lane, as a jaxpr, to a graph of scalars: one short rule for every primitive.

Rules live in `elementwise`, `moves`, `lookups`, `sums`, `noise` and `control`; an unknown primitive is an error with
its name.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from jaxbiped.sim.compile.arrays import Values
from jaxbiped.sim.compile.graph import Graph

MOST_UNROLLED = 64
"""Runs of a loop body that may be written out one after the other."""
ROLLED = 200
"""Equations of a loop body from which on it stays a loop, if the loop is not inside another."""


class UnknownPrimitiveError(NotImplementedError):
    """There is no rule for a primitive, or not for this use of it."""


@runtime_checkable
class Equation(Protocol):
    """Interface of an equation of a jaxpr, as rules read it."""

    primitive: Any
    params: dict[str, Any]
    invars: list[Any]
    outvars: list[Any]


Rule = Callable[["Interpreter", Equation, list[Values]], list[Values]]
"""From an equation and the values of its inputs to those of its outputs."""
RULES: dict[str, Rule] = {}


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Make a function the rule of some primitives."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, function))
        return function

    return register


class Interpreter:
    """Evaluates jaxprs on arrays of scalars."""

    def __init__(self, graph: Graph, rolled: int = ROLLED):
        self.graph, self.rolled = graph, rolled
        self.inside = False
        """Whether a loop body is being evaluated."""

    def run(self, jaxpr: Any, consts: list[Any], args: list[Values]) -> list[Values]:
        """Outputs of a jaxpr."""
        values: dict[Any, Values] = {}

        def read(var: Any) -> Values:
            aval: Any = var.aval
            return np.asarray(var.val, aval.dtype) if isinstance(var, core.Literal) else values[var]

        values.update(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
        values.update(zip(jaxpr.invars, args, strict=True))
        for eqn in jaxpr.eqns:
            outs = self._equation(eqn, [read(var) for var in eqn.invars])
            for var, out in zip(eqn.outvars, outs, strict=True):
                if out.shape != var.aval.shape:
                    raise AssertionError(f"{eqn.primitive.name}: shape {out.shape}, not {var.aval.shape}")
                values[var] = out
        return [read(var) for var in jaxpr.outvars]

    def closed(self, jaxpr: Any, args: list[Values]) -> list[Values]:
        """Outputs of a jaxpr that may hold its constants."""
        if isinstance(jaxpr, core.ClosedJaxpr):
            return self.run(jaxpr.jaxpr, jaxpr.consts, args)
        return self.run(jaxpr, [], args)

    def _equation(self, eqn: Equation, ins: list[Values]) -> list[Values]:
        name = eqn.primitive.name
        if name not in RULES:
            raise UnknownPrimitiveError(f"no rule for the primitive {name!r}")
        return RULES[name](self, eqn, ins)


def out_type(eqn: Equation, i: int = 0) -> np.dtype:
    """Number type of an output."""
    dtype = eqn.outvars[i].aval.dtype
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return np.dtype(object)
    if not isinstance(dtype, np.dtype) or dtype == jax.dtypes.float0:
        raise UnknownPrimitiveError(f"{eqn.primitive.name!r} of type {dtype}")
    return dtype


def scalarise(closed: Any, args: list[Values], graph: Graph, rolled: int = ROLLED) -> list[Values]:
    """Outputs of a closed jaxpr on arrays of scalars, as new nodes of a graph."""
    # The rules register themselves when they are imported.
    from jaxbiped.sim.compile import control, elementwise, fold, lookups, moves, noise, sums

    assert all((control, elementwise, fold, lookups, moves, noise, sums))
    return Interpreter(graph, rolled).closed(closed, args)

"""Primitives that treat every element alike."""

import numpy as np

from jaxbiped.sim.compile.arrays import Values, each
from jaxbiped.sim.compile.interpret import Equation, Interpreter, UnknownPrimitiveError, out_type, rule

SAME = (
    "add", "sub", "mul", "div", "max", "min", "neg", "abs", "sign", "floor", "ceil", "sqrt", "exp", "log",
    "log1p", "tanh", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "rem", "is_finite", "pow",
    "lt", "le", "gt", "ge", "eq",
    "ne", "and", "or", "xor", "not",
)  # fmt: skip
"""Primitives that are one scalar operation of the same name."""


@rule(*SAME, "add_any")
def _same(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    return [each(of.graph, eqn.primitive.name.removesuffix("_any"), out_type(eqn), *ins)]


@rule("lt_to", "le_to")
def _in_total_order(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    """Compare in the usual order: the other one differs for NaN and for zeros with a sign only."""
    return [each(of.graph, eqn.primitive.name[:2], out_type(eqn), *ins)]


@rule("convert_element_type")
def _convert(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    if eqn.invars[0].aval.dtype.kind == "f" and out_type(eqn).kind == "b":
        return [each(of.graph, "ne", np.dtype(bool), ins[0], np.zeros((), eqn.invars[0].aval.dtype))]
    return [each(of.graph, "convert", out_type(eqn), *ins)]


@rule("copy", "copy_p", "device_put", "stop_gradient", "optimization_barrier", "pvary")
def _nothing(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    return list(ins)


@rule("square")
def _square(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    return [each(of.graph, "mul", out_type(eqn), ins[0], ins[0])]


@rule("rsqrt")
def _rsqrt(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    dtype = out_type(eqn)
    return [each(of.graph, "div", dtype, np.ones((), dtype), each(of.graph, "sqrt", dtype, *ins))]


@rule("round")
def _round(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    if int(eqn.params["rounding_method"]) != 1:
        raise UnknownPrimitiveError("'round' away from zero")
    return [each(of.graph, "round", out_type(eqn), *ins)]


@rule("integer_pow")
def _integer_pow(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    dtype, power = out_type(eqn), eqn.params["y"]
    x = ins[0]
    out = np.ones(x.shape, dtype)
    for bit in f"{abs(power):b}":  # the square of what is there, times x
        out = each(of.graph, "mul", dtype, out, out)
        out = each(of.graph, "mul", dtype, out, x) if bit == "1" else out
    return [out if power >= 0 else each(of.graph, "div", dtype, np.ones((), dtype), out)]


@rule("clamp")
def _clamp(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    low, x, high = ins
    return [each(of.graph, "min", out_type(eqn), each(of.graph, "max", out_type(eqn), x, low), high)]


@rule("select_n")
def _select(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    which, *cases = ins
    dtype, kind = out_type(eqn), eqn.invars[0].aval.dtype
    if kind.kind == "b":
        return [each(of.graph, "select", dtype, which, *cases)]
    out = cases[-1]
    for k in reversed(range(len(cases) - 1)):
        here = each(of.graph, "eq", np.dtype(bool), which, kind.type(k)[None].reshape(()))
        out = each(of.graph, "select", dtype, here, out, cases[k])
    return [out]

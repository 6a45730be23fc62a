"""Random numbers as JAX draws them: threefry, 32 bits at a time, of a key that counts as one scalar."""

import itertools
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from jaxbiped.sim.compile.arrays import Values, each, filled, objects
from jaxbiped.sim.compile.graph import Graph, Key, Scalar
from jaxbiped.sim.compile.interpret import Equation, Interpreter, UnknownPrimitiveError, out_type, rule

BITS = np.dtype(np.uint32)
ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = np.uint32(0x1BD11BDA)
# After M. Giles, "Approximating the erfinv function"; the constant first.
NEAR = (1.50140941, 0.246640727, -0.00417768164, -0.00125372503, 0.000218580870,
        -4.39150654e-06, -3.5233877e-06, 3.43273939e-07, 2.81022636e-08)  # fmt: skip
FAR = (2.83297682, 1.00167406, 0.00943887047, -0.0076224613, 0.00573950773,
       -0.00367342844, 0.00134934322, 0.000100950558, -0.000200214257)  # fmt: skip


def threefry(graph: Graph, key: Key, first: Scalar, second: Scalar) -> Key:
    """Scramble two words with a key (Salmon et al. 2011, 20 rounds)."""

    def op(name: str, a: Scalar, b: Scalar) -> Scalar:
        return graph.op(name, BITS, a, b)

    words = key.first, key.second, op("xor", op("xor", key.first, key.second), PARITY)
    a, b = op("add", first, key.first), op("add", second, key.second)
    for i in range(5):
        for turn in ROTATIONS[i % 2]:
            a = op("add", a, b)
            b = op("or", op("shl", b, np.uint32(turn)), op("shr", b, np.uint32(32 - turn)))
            b = op("xor", a, b)
        a = op("add", a, words[(i + 1) % 3])
        b = op("add", op("add", b, words[(i + 2) % 3]), np.uint32(i + 1))
    return Key(a, b)


def counted(graph: Graph, keys: Values, shape: tuple[int, ...]) -> Iterator[Key]:
    """Yield of every key as many scrambled counts as there are places in a shape."""
    if not jax.config.values["jax_threefry_partitionable"]:
        raise UnknownPrimitiveError("random numbers that are not 'jax_threefry_partitionable'")
    counts = range(int(np.prod(shape, dtype=int)))
    for key, count in itertools.product(keys.reshape(-1), counts):
        yield threefry(graph, key, np.uint32(0), np.uint32(count))


@rule("random_seed")
def _seed(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    if eqn.params["impl"].name != "threefry2x32" or eqn.invars[0].aval.dtype.itemsize > 4:
        raise UnknownPrimitiveError("a key that is not threefry's, or of a seed of more than 32 bits")
    seeds = objects(each(of.graph, "convert", BITS, ins[0]))
    return [filled((Key(np.uint32(0), seed) for seed in seeds.flat), ins[0].shape, np.dtype(object))]


@rule("random_fold_in")
def _fold_in(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    keys, data = (np.broadcast_to(objects(x), eqn.outvars[0].aval.shape) for x in ins)
    pairs = zip(keys.flat, data.flat, strict=True)
    new = (threefry(of.graph, key, np.uint32(0), word) for key, word in pairs)
    return [filled(new, keys.shape, np.dtype(object))]


@rule("random_split")
def _split(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    new = counted(of.graph, ins[0], eqn.params["shape"])
    return [filled(new, eqn.outvars[0].aval.shape, np.dtype(object))]


@rule("random_bits")
def _bits(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    if eqn.params["bit_width"] != 32:
        raise UnknownPrimitiveError(f"random numbers of {eqn.params['bit_width']} bits")
    words = counted(of.graph, ins[0], eqn.params["shape"])
    new = (of.graph.op("xor", BITS, word.first, word.second) for word in words)
    return [filled(new, eqn.outvars[0].aval.shape, BITS)]


@rule("bitcast_convert_type")
def _as_bits(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    kinds = eqn.invars[0].aval.dtype, out_type(eqn)
    if kinds != (BITS, np.dtype(np.float32)):
        raise UnknownPrimitiveError(f"{eqn.primitive.name!r} from {kinds[0]} to {kinds[1]}")
    return [each(of.graph, "bits", kinds[1], ins[0])]


@rule("shift_left", "shift_right_logical")
def _shift(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    if out_type(eqn) != BITS:
        raise UnknownPrimitiveError(f"{eqn.primitive.name!r} of {out_type(eqn)}")
    return [each(of.graph, "shl" if eqn.primitive.name == "shift_left" else "shr", BITS, *ins)]


@rule("erf_inv")
def _erf_inv(of: Interpreter, eqn: Equation, ins: list[Values]) -> list[Values]:
    """Compute the inverse error function in single precision, as XLA does."""
    dtype, x = out_type(eqn), ins[0]
    if dtype != np.float32:
        raise UnknownPrimitiveError(f"'erf_inv' of {dtype}")

    def op(name: str, *args: Any) -> Values:
        return each(
            of.graph, name, dtype, *(a if isinstance(a, np.ndarray) else np.asarray(a, dtype) for a in args)
        )

    def polynomial(coefficients: tuple[float, ...], at: Values) -> Values:
        value = op("mul", at, 0.0)
        for coefficient in reversed(coefficients):
            value = op("add", op("mul", value, at), coefficient)
        return value

    w = op("neg", op("log1p", op("neg", op("mul", x, x))))
    near = each(of.graph, "lt", np.dtype(bool), w, np.asarray(5.0, dtype))
    factor = op(
        "select",
        near,
        polynomial(FAR, op("sub", op("sqrt", w), 3.0)),
        polynomial(NEAR, op("sub", w, 2.5)),
    )
    edge = each(of.graph, "eq", np.dtype(bool), op("abs", x), np.asarray(1.0, dtype))
    return [op("mul", x, op("select", edge, factor, np.asarray(np.inf, dtype)))]

"""How whole walks are compiled."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

P = ParamSpec("P")
R = TypeVar("R")

OPTIONS: dict[str, Any] = {"xla_cpu_experimental_ynn_fusion_type": ""}
"""On a CPU XLA gives sums and products of a few numbers to a library (YNN), whose calls cost more than the arithmetic
does: with none given to it a tick takes a tenth less (`benchmarks/tick_profile.py`). Other devices take no notice."""


def jit_walks(function: Callable[P, R]) -> Callable[P, R]:
    """`eqx.filter_jit` for functions that walk: with `OPTIONS`, where this version of XLA knows them."""

    @functools.cache
    def jitted() -> Callable[P, R]:  # at the first call, since asking XLA starts its devices
        made: Any = eqx.filter_jit  # its annotations leave out what it passes on to jax.jit
        return made(function, compiler_options=options())

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return jitted()(*args, **kwargs)

    return call


@functools.cache
def options() -> dict[str, Any]:
    """`OPTIONS`, or none where XLA refuses them."""
    try:
        jax.jit(jnp.negative, compiler_options=OPTIONS).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return OPTIONS

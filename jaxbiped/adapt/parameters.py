"""Parameters of a stage, each declared once: its unit, its bounds and what it is; switches too."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax.numpy as jnp

from jaxbiped.checked import Flag, Quantity, refuse_unknown

Declared = Mapping[str, Quantity | Flag]


def reader(declared: Declared) -> Callable[[str], Callable[[Any], Any]]:
    """Give for every parameter's name what its field is converted by: checked, then an array of JAX's float type.

    A switch stays a truth value; None and values that are traced are not judged.
    """

    def named(name: str) -> Callable[[Any], Any]:
        parameter = declared[name]

        def read(given: Any) -> Any:
            value = parameter.check(name, given)
            if value is None or isinstance(parameter, Flag):
                return value
            return jnp.asarray(value, jnp.result_type(float))

        return read

    return named


def switches(declared: Declared) -> list[str]:
    """Names of the parameters that are true or false."""
    return [name for name, parameter in declared.items() if isinstance(parameter, Flag)]


def require_names(record: str, given: Iterable[str], declared: Declared) -> None:
    """Raise a TypeError that names the nearest parameter, if a record has none of this name."""
    refuse_unknown(f"{record}: parameter ", given, declared, TypeError)

"""Parameters of a stage, each declared once, in its record: unit, bounds, default, text, range of tuning."""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.checked import Flag, Quantity, refuse_unknown

Declared = Mapping[str, Quantity | Flag]


@dataclass(frozen=True)
class Tune:
    """The range in which a parameter is tuned, within its bounds."""

    low: float
    high: float
    note: str = ""
    """The paper's own value of the parameter."""
    entries: Mapping[str, tuple[int, ...]] | None = None
    """Names of single entries and their places, if the parameter is a table."""
    only_with: str = ""
    """The switch without which the parameter does nothing; empty if there is none."""


def number(
    name: str, declared: Quantity, default: object = dataclasses.MISSING, *, tune: Tune | None = None
) -> Any:  # noqa: ANN401
    """Declare a parameter that is a number or a table of numbers: checked, then an array of JAX's float type.

    None, where it is allowed, and values that are traced are not judged.

    Args:
        name: of the field.
        declared: its unit, its bounds, and what it is.
        default: the parameter is required if none is given.
        tune: how it may be tuned; None if it cannot be.
    """

    def read(given: object) -> Float[Array, "..."] | None:
        value = declared.check(name, given)
        return None if value is None else jnp.asarray(value, jnp.result_type(float))

    return eqx.field(converter=read, metadata={"declared": declared, "tune": tune}, **_default(default))


def switch(name: str, default: bool, text: str) -> Any:  # noqa: ANN401
    """Declare a parameter that is true or false; it decides what is compiled."""
    declared = Flag(text)

    def read(given: object) -> bool:
        return declared.check(name, given)

    return eqx.field(converter=read, static=True, metadata={"declared": declared}, default=default)


@cache
def declared(record: type) -> Declared:
    """Everything that a record declares, by the parameter's name."""
    return {f.name: f.metadata["declared"] for f in dataclasses.fields(record) if "declared" in f.metadata}


@cache
def tuned(record: type) -> Mapping[str, Tune]:
    """Ranges of the parameters that may be tuned, by name."""
    found = {f.name: f.metadata.get("tune") for f in dataclasses.fields(record)}
    return {name: tune for name, tune in found.items() if tune is not None}


def switches(record: type) -> list[str]:
    """Names of the parameters that are true or false."""
    return [name for name, parameter in declared(record).items() if isinstance(parameter, Flag)]


def require_names(record: type, given: Iterable[str]) -> None:
    """Raise a TypeError that names the nearest parameter, if a record has none of this name."""
    refuse_unknown(f"{record.__name__}: parameter ", given, declared(record), TypeError)


def _default(default: object) -> dict[str, Any]:
    return {} if default is dataclasses.MISSING else {"default": default}

"""Refusing gait parameters that cannot be walked, when their values are known (not while being traced)."""

from collections.abc import Mapping
from operator import attrgetter

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbiped import checked
from jaxbiped.checked import Quantity
from jaxbiped.robot import LEFT, RIGHT

MOST_STEPS = 10_000
"""Longest walk that is planned [steps]."""


class GaitError(checked.Refusal):
    """Gait parameters that cannot be walked: says which, what was got and what is allowed."""


def is_concrete(*trees: object) -> bool:
    """Tell whether every leaf has a known value: false under jit, vmap or differentiation."""
    return checked.is_known(trees)


def require_within(record: eqx.Module, quantities: Mapping[str, Quantity]) -> None:
    """Raise a GaitError unless every parameter of a record, by its dotted name, is a number within its bounds."""
    for name, quantity in quantities.items():
        quantity.check(name, attrgetter(name)(record), GaitError)


def require(
    name: str,
    value: Float[Array, ""] | float,
    allowed: str,
    *conditions: Bool[Array, ""] | bool,
    unit: str = "s",
) -> None:
    """Raise a GaitError unless the value is finite and all conditions hold."""
    if not (np.isfinite(value) and all(conditions)):
        raise GaitError(f"{name}: got {float(value):g} {unit}, allowed: {allowed}")


def require_steps(n_steps: object, first_swing: object) -> tuple[int, int]:
    """Return the number of steps and the first foot as int, or raise a GaitError; NumPy's whole numbers will do."""
    n_steps = checked.whole("n_steps", n_steps, 1, MOST_STEPS, GaitError)
    try:
        return n_steps, checked.whole("first_swing", first_swing, LEFT, RIGHT, GaitError)
    except GaitError:
        got = checked.shown(first_swing)
        raise GaitError(f"first_swing: got {got}, allowed: {LEFT} (left) or {RIGHT} (right)") from None

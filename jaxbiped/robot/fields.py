"""Reading one number of a robot file: `{ value = ..., unit = "...", stated | assumed = "..." }`."""

from dataclasses import dataclass
from typing import Any

import numpy as np


class RobotFileError(ValueError):
    """A robot file that cannot be used: says which field, what was got and what is allowed."""


@dataclass(frozen=True)
class Number:
    """A number of a robot file with its unit and where it comes from."""

    field: str
    value: np.ndarray
    unit: str
    kind: str
    """`stated` (a paper says it) or `assumed` (we chose it)."""
    source: str


@dataclass(frozen=True)
class Rule:
    """What a field must look like: unit, shapes, and the closed or open range of every entry."""

    unit: str
    shapes: tuple[tuple[int, ...], ...] = ((),)
    above: float = -np.inf
    """Exclusive lower bound."""
    at_least: float = -np.inf
    at_most: float = np.inf

    @property
    def allowed(self) -> str:
        """The range in words."""
        bounds = [(">", self.above), (">=", self.at_least), ("<=", self.at_most)]
        words = [f"{sign} {bound:g}" for sign, bound in bounds if np.isfinite(bound)]
        return " and ".join(words) or "any finite number"


def read_number(field: str, entry: Any, rule: Rule) -> Number:
    """Check one entry of the file against its rule.

    Raises:
        RobotFileError: naming the field, what was got and what is allowed.
    """
    if not isinstance(entry, dict):
        raise RobotFileError(
            f'{field}: got {entry!r}, wanted {{ value = ..., unit = "{rule.unit}", stated|assumed = "..." }}'
        )
    kinds = [kind for kind in ("stated", "assumed") if kind in entry]
    if unknown := set(entry) - {"value", "unit", "stated", "assumed"}:
        raise RobotFileError(
            f"{field}: unknown key {sorted(unknown)[0]!r}, allowed: value, unit, stated, assumed"
        )
    if "value" not in entry:
        raise RobotFileError(f"{field}: 'value' is missing")
    if entry.get("unit") != rule.unit:
        raise RobotFileError(f"{field}: got unit {entry.get('unit')!r}, allowed: {rule.unit!r}")
    if len(kinds) != 1 or not isinstance(entry[kinds[0]], str) or not entry[kinds[0]].strip():
        raise RobotFileError(
            f"{field}: needs either 'stated' (where) or 'assumed' (why), one of them, as text"
        )
    return Number(field, _checked_value(field, entry["value"], rule), rule.unit, kinds[0], entry[kinds[0]])


def _checked_value(field: str, given: Any, rule: Rule) -> np.ndarray:
    flat = given if isinstance(given, list) else [given]
    if not all(isinstance(x, int | float) and not isinstance(x, bool) for x in flat):
        raise RobotFileError(f"{field}: got {given!r}, wanted numbers [{rule.unit}]")
    value = np.asarray(given, float)
    if value.shape not in rule.shapes:
        sizes = " or ".join("one number" if shape == () else f"{shape[0]} numbers" for shape in rule.shapes)
        raise RobotFileError(f"{field}: got {given!r}, wanted {sizes} [{rule.unit}]")
    inside = np.isfinite(value) & (value > rule.above) & (value >= rule.at_least) & (value <= rule.at_most)
    if not inside.all():
        worst = value if value.shape == () else value[~inside][0]
        raise RobotFileError(f"{field}: got {worst:g} {rule.unit}, allowed: {rule.allowed} {rule.unit}")
    return value

"""Reading one number of a robot file: `{ value = ..., unit = "...", stated | assumed = "..." }`."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxbiped import checked
from jaxbiped.checked import Quantity, shown


class RobotFileError(checked.Refusal):
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


def read_number(field: str, entry: Any, rule: Quantity) -> Number:
    """Check one entry of the file against its declaration.

    Raises:
        RobotFileError: naming the field, what was got and what is allowed.
    """
    if not isinstance(entry, dict):
        raise RobotFileError(
            f'{field}: got {shown(entry)}, allowed: {{ value = ..., unit = "{rule.unit}", stated|assumed = "..." }}'
        )
    checked.refuse_unknown(f"{field}.", entry, ("value", "unit", "stated", "assumed"), RobotFileError)
    if "value" not in entry:
        raise RobotFileError(f"{field}: 'value' is missing, allowed: {rule.size}, {rule.allowed}")
    if entry.get("unit") != rule.unit:
        raise RobotFileError(f"{field}: got unit {shown(entry.get('unit'))}, allowed: {rule.unit!r}")
    kinds = [kind for kind in ("stated", "assumed") if kind in entry]
    if len(kinds) != 1 or not isinstance(entry[kinds[0]], str) or not entry[kinds[0]].strip():
        raise RobotFileError(
            f"{field}: needs either 'stated' (where) or 'assumed' (why), one of them, as text"
        )
    value = rule.check(field, entry["value"], RobotFileError)
    return Number(field, np.asarray(value, float), rule.unit, kinds[0], entry[kinds[0]])

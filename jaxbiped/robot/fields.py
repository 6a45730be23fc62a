"""Reading one entry of a robot file, or of a preset: `{ value = ..., unit = "...", stated | assumed = "..." }`."""

from collections.abc import Callable
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


@dataclass(frozen=True)
class Setting:
    """A choice of a robot file, not of its body, and where it comes from."""

    field: str
    value: Any
    """A text, a truth value or a number without unit."""
    kind: str
    """`stated` (a paper says it) or `assumed` (we chose it)."""
    source: str


def read_number(
    field: str,
    entry: Any,  # noqa: ANN401
    rule: Quantity,
    error: type[checked.Refusal] = RobotFileError,
) -> Number:
    """Check one number of a file against its declaration.

    Args:
        field: its dotted name.
        entry: what the file has there.
        rule: its declaration.
        error: what to raise, naming the field, what was got and what is allowed.
    """
    form = f'{{ value = ..., unit = "{rule.unit}", stated|assumed = "..." }}'
    _require_form(field, entry, ("value", "unit"), form, f"{rule.size}, {rule.allowed}", error)
    if entry.get("unit") != rule.unit:
        raise error(f"{field}: got unit {shown(entry.get('unit'))}, allowed: {rule.unit!r}")
    kind, source = _origin(field, entry, error)
    value = rule.check(field, entry["value"], error)
    return Number(field, np.asarray(value, float), rule.unit, kind, source)


def read_setting(
    field: str,
    entry: Any,  # noqa: ANN401
    check: Callable[[str, object, type[checked.Refusal]], object],
) -> Setting:
    """Check one choice of a robot file.

    Args:
        field: its dotted name.
        entry: what the file has there.
        check: returns a value that is allowed, and refuses another one by name.

    Raises:
        RobotFileError: naming the field, what was got and what is allowed.
    """
    form = '{ value = ..., stated|assumed = "..." }'
    _require_form(field, entry, ("value",), form, form, RobotFileError)
    kind, source = _origin(field, entry, RobotFileError)
    return Setting(field, check(field, entry["value"], RobotFileError), kind, source)


def _require_form(
    field: str, entry: object, keys: tuple[str, ...], form: str, allowed: str, error: type[checked.Refusal]
) -> None:
    """Refuse an entry that is no table with a value, or has what no entry has."""
    if not isinstance(entry, dict):
        raise error(f"{field}: got {shown(entry)}, allowed: {form}")
    checked.refuse_unknown(f"{field}.", entry, (*keys, "stated", "assumed"), error)
    if "value" not in entry:
        raise error(f"{field}: 'value' is missing, allowed: {allowed}")


def _origin(field: str, entry: dict[str, Any], error: type[checked.Refusal]) -> tuple[str, str]:
    """Return whether an entry is `stated` or `assumed`, and the text that says where or why."""
    kinds = [kind for kind in ("stated", "assumed") if kind in entry]
    if len(kinds) != 1 or not isinstance(entry[kinds[0]], str) or not entry[kinds[0]].strip():
        raise error(f"{field}: needs either 'stated' (where) or 'assumed' (why), one of them, as text")
    return kinds[0], entry[kinds[0]]

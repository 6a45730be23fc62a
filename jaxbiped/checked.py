"""Input from files and callers, checked before anything is computed.

A refusal is one line: what was given, what is allowed, in which unit, and the nearest name where a name is unknown.
Numbers are judged as float32, in which walks are computed: 1e39 is infinite there and 1e-60 is 0.
"""

import datetime
import difflib
import math
import operator
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources.abc import Traversable
from numbers import Real
from pathlib import Path
from typing import Any, SupportsIndex

import jax
import numpy as np
from jax.core import Tracer

MAX_BYTES = 1 << 20
"""Largest file that is read."""
MAX_DEPTH = 16
"""Deepest nesting of arrays, tables and dotted keys in a file."""
_LONGEST = 80
"""Characters of a value that a refusal shows."""
_DEGREE = math.pi / 180.0
_OTHER_UNITS = {
    "m": (("mm", 1e-3), ("cm", 1e-2)),
    "s": (("ms", 1e-3),),
    "rad": (("deg", _DEGREE),),
    "kg": (("g", 1e-3),),
    "m/s": (("mm/s", 1e-3), ("cm/s", 1e-2)),
    "m/s2": (("mm/s2", 1e-3), ("cm/s2", 1e-2)),
    "rad/s": (("deg/s", _DEGREE), ("rpm", 6.0 * _DEGREE)),
    "N m": (("N mm", 1e-3), ("N cm", 1e-2)),
    "kg m2": (("kg cm2", 1e-4), ("kg mm2", 1e-6), ("g mm2", 1e-9)),
    "": (("%", 1e-2),),
}
"""Other units in which a number may have been meant, and the size of one of each."""
_TOKENS = re.compile(
    r'"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5})?'  # what is in strings and comments is not nesting
    r"|'''(?:[^']|'(?!''))*+(?:'{3,5})?"
    r'|"(?:[^"\\\n]|\\.)*+"?'
    r"|'[^'\n]*+'?"
    r"|\#[^\n]*+"
    r"|[][{}.=,\n]",
    re.DOTALL,
)


class Refusal(ValueError):
    """Input that cannot be used: one line with what was given and what is allowed."""

    def __init__(self, message: str):
        super().__init__(one_line(message))


def one_line(text: str) -> str:
    """Write a text on one line, with line breaks and other unprintable characters as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def shown(value: object) -> str:
    """Show a value in a refusal: what it is, if it is no number, and as much of it as fits."""
    match value:
        case None:
            return "nothing"
        case dict():
            return "a table"
        case bool() | np.bool_():
            return f"the truth value {str(bool(value)).lower()}"
        case int() if value.bit_length() > 200:
            return f"a whole number of about {int(value.bit_length() * math.log10(2.0)) + 1} digits"
        case float() | np.floating():
            return f"{float(value):g}"
        case str():
            return f"the text {_cut(repr(value[:_LONGEST]))}"
        case list() | tuple():
            items = [shown(item).removeprefix("the text ") for item in value[:12]]
            return _cut(f"[{', '.join([*items, '...'] if len(value) > 12 else items)}]")
        case datetime.date() | datetime.time():
            return f"the date or time {value}"
        case np.ndarray() | jax.Array() if is_known(value):
            return shown(np.asarray(value).tolist())
    return _cut(repr(value))


def _cut(text: str) -> str:
    text = one_line(text)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def nearest(name: str, known: Iterable[str]) -> str:
    """Return `; did you mean '...'?` if a known name is like this one, else nothing."""
    found = difflib.get_close_matches(name[:_LONGEST], list(known), 1)
    return f"; did you mean '{found[0]}'?" if found else ""


def register_as(what: str, made: type[Any], known: dict[str, Any]) -> None:
    """Add a class to those known by their `name`; the same class of a module that was loaded again takes its place.

    Raises:
        ValueError: if another class has that name.
    """
    there = known.get(made.name, made)
    if (there.__module__, there.__qualname__) != (made.__module__, made.__qualname__):
        raise ValueError(f"{what}: got the name '{made.name}', allowed: another than {', '.join(known)}")
    known[made.name] = made


def refuse_unknown(
    where: str, names: Iterable[str], known: Iterable[str], error: type[Exception] = Refusal
) -> None:
    """Refuse names that are not known, with the nearest one that is.

    Args:
        where: what to put before the name, such as `payload.`.
        names: what was given.
        known: what is allowed.
        error: what to raise.
    """
    known = list(known)
    for name in names:
        if name not in known:
            text = f"{where}{name[:_LONGEST]}: unknown, allowed: {', '.join(known)}{nearest(name, known)}"
            raise error(one_line(text))


def is_known(value: object) -> bool:
    """Tell whether a value is known: not while JAX traces it."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value))


@dataclass(frozen=True)
class Quantity:
    """A declared number, or table of numbers: its unit, bounds and shape, and what it is."""

    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    """Whether `low` itself is refused."""
    shapes: tuple[tuple[int, ...], ...] = ((),)
    optional: bool = False
    """Whether it may be None."""
    endless: bool = False
    """Whether it may be infinite."""
    text: str = ""

    @property
    def allowed(self) -> str:
        """The range in words, with the unit."""
        least = [f"{'>' if self.above else '>='} {self.low:g}"] if math.isfinite(self.low) else []
        most = [f"<= {self.high:g}"] if math.isfinite(self.high) else []
        words = self._with_unit(" and ".join(least + most) or "any finite number")
        return f"{words} or infinite" if self.endless else words

    @property
    def size(self) -> str:
        """The number of numbers in words, with the unit in brackets."""
        names = [f"{' x '.join(map(str, shape))} numbers" if shape else "one number" for shape in self.shapes]
        return " or ".join(names) + (f" [{self.unit}]" if self.unit else "")

    def check(self, name: str, given: object, error: type[Refusal] = Refusal) -> Any:  # noqa: ANN401
        """Return what was given as float or float64 array; traced values and an allowed None as they are.

        Args:
            name: what to call it in a refusal.
            given: a number or nested lists of them, NumPy's and JAX's too.
            error: what to raise where it is no number, of another shape, or out of range in float32.
        """
        if given is None and self.optional:
            return None
        if not is_known(given):
            if isinstance(given, Tracer) and given.shape not in self.shapes:
                raise error(f"{name}: got shape {given.shape}, allowed: {self.size}")
            return given
        value = self._numbers(name, given, error)
        if value is None or value.shape not in self.shapes:
            raise error(f"{name}: got {shown(given)}, allowed: {self.size}")
        inside = self.contains(value)
        if not inside.all():
            place = tuple(np.argwhere(~inside)[0])
            where = f" in place {', '.join(str(i + 1) for i in place)}" if place else ""
            bad = float(value[place])
            got = self._with_unit(f"{bad:g}") + where + _in_float32(bad)
            raise error(f"{name}: got {got}, allowed: {self.allowed}{self._hint(bad)}")
        return value if value.shape else float(value)

    def contains(self, value: float | int | np.ndarray | Sequence[float | int]) -> np.ndarray:
        """Tell of every number whether it lies in the range, in float32 too."""
        value = np.asarray(value, np.float64)
        with np.errstate(all="ignore"):
            single, low, high = value.astype(np.float32), np.float32(self.low), np.float32(self.high)
        vanishes = (np.abs(single) < np.finfo(np.float32).tiny) & (value != 0.0)
        inside = ((single > low) if self.above else (single >= low)) & (single <= high)
        inside &= np.isfinite(single) & ~vanishes
        return np.asarray(inside | (value == np.inf) if self.endless else inside)

    def _numbers(self, name: str, given: object, error: type[Refusal]) -> np.ndarray | None:
        """The given numbers as an array; None if they form no table."""
        if isinstance(given, list | tuple):
            parts = [self._numbers(name, item, error) for item in given]
            arrays = [part for part in parts if part is not None]
            whole = len(arrays) == len(parts) and len({part.shape for part in arrays}) == 1
            return np.stack(arrays) if whole and arrays[0].ndim < 4 else None
        if isinstance(given, np.ndarray | jax.Array):
            if np.asarray(given).dtype.kind in "iuf":
                return np.asarray(given, np.float64)
            given = np.asarray(given).tolist()
        if not isinstance(given, Real) or isinstance(given, bool):
            raise error(f"{name}: got {shown(given)}, allowed: {self.size}, {self.allowed}")
        try:
            return np.asarray(float(given))
        except OverflowError:
            raise error(f"{name}: got {shown(given)}, allowed: {self.allowed}") from None

    def _with_unit(self, text: str) -> str:
        return f"{text} {self.unit}".rstrip()

    def _hint(self, number: float) -> str:
        """Words on the other units in which the number would have been in range; empty for none."""
        if number == 0.0 or not math.isfinite(number):
            return ""
        others = [(unit, number * factor) for unit, factor in _OTHER_UNITS.get(self.unit, ())]
        fits = [
            f"{number:g} {unit} is {self._with_unit(f'{x:.4g}')}" for unit, x in others if self.contains(x)
        ]
        return f"; {' or '.join(fits)}" if fits else ""


def _in_float32(number: float) -> str:
    with np.errstate(all="ignore"):
        single = abs(float(np.float32(number)))
    if math.isinf(single) and math.isfinite(number):
        return " (infinite in float32)"
    return " (0 in float32)" if single < np.finfo(np.float32).tiny and number != 0.0 else ""


@dataclass(frozen=True)
class Flag:
    """A declared switch: true or false, and what it does if it is true."""

    text: str = ""
    allowed = "true or false"

    def check(self, name: str, given: object, error: type[Refusal] = Refusal) -> bool:
        """Return the truth value that was given, or raise `error`."""
        if not isinstance(given, bool | np.bool_):
            raise error(f"{name}: got {shown(given)}, allowed: {self.allowed}")
        return bool(given)


@dataclass(frozen=True)
class Word:
    """A declared word: one of a few, and what it chooses."""

    words: tuple[str, ...]
    text: str = ""

    @property
    def allowed(self) -> str:
        """The words in a row."""
        return ", ".join(self.words)

    def check(self, name: str, given: object, error: type[Refusal] = Refusal) -> str:
        """Return the word that was given, or raise `error` with the nearest one."""
        if not isinstance(given, str):
            raise error(f"{name}: got {shown(given)}, allowed: {self.allowed}")
        if given not in self.words:
            raise error(
                f"{name}: got {_cut(repr(given))}, allowed: {self.allowed}{nearest(given, self.words)}"
            )
        return given


Field = Quantity | Flag | Word


def whole(name: str, given: object, low: int, high: int, error: type[Refusal] = Refusal) -> int:
    """Return a whole number as int: Python's, NumPy's or JAX's, but no truth value and no float.

    Args:
        name: what to call it in a refusal.
        given: the number.
        low: smallest one allowed.
        high: largest one allowed.
        error: what to raise for anything else.
    """
    try:
        usable = isinstance(given, SupportsIndex)
        number = operator.index(given) if usable and not isinstance(given, bool | np.bool_) else None
    except TypeError:
        number = None
    if number is None or not low <= number <= high:
        got = f"the float {float(given)!r}" if isinstance(given, float | np.floating) else shown(given)
        raise error(f"{name}: got {got}, allowed: a whole number >= {low} and <= {high}")
    return number


def read_table(
    name: str,
    table: object,
    fields: Mapping[str, Field],
    required: Iterable[str] = (),
    error: type[Refusal] = Refusal,
) -> dict[str, Any]:
    """Check a table of a file by its declared fields; returns plain values, tables of numbers as nested lists.

    Args:
        name: of the table.
        table: what the file has there.
        fields: what it may hold.
        required: names that it must hold.
        error: what to raise for an unknown or missing name, or a value that is not allowed.
    """
    if not isinstance(table, dict):
        raise error(f"{name}: got {shown(table)}, allowed: a table [{name}]")
    refuse_unknown(f"{name}.", table, fields, error)
    for key in required:
        if key not in table:
            raise error(f"{name}.{key}: missing, allowed: {fields[key].allowed}")
    read = {key: fields[key].check(f"{name}.{key}", given, error) for key, given in table.items()}
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in read.items()}


def read_toml(file: Path | Traversable, error: type[Refusal] = Refusal) -> dict[str, Any]:
    """Read a TOML file in UTF-8, with or without a byte-order mark.

    Args:
        file: to be read, at most MAX_BYTES long and nested MAX_DEPTH deep.
        error: what to raise, with the file's name and, where known, the line.
    """
    try:
        if not file.is_file():
            raise error(f"{file.name}: got no file, allowed: a TOML file")
        with file.open("rb") as stream:
            return parse_toml(file.name, stream.read(MAX_BYTES + 1), error)
    except OSError as problem:
        raise error(f"{file.name}: cannot be read ({problem.strerror}), allowed: a TOML file") from None


def parse_toml(name: str, content: bytes, error: type[Refusal] = Refusal) -> dict[str, Any]:
    """Parse the content of a TOML file; `name` is that of the file, the rest is as in `read_toml`."""
    if len(content) > MAX_BYTES:
        raise error(f"{name}: got more than {MAX_BYTES} bytes, allowed: at most {MAX_BYTES}")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        line = content[: problem.start].count(b"\n") + 1
        raise error(f"{name}: got no UTF-8 (at line {line}), allowed: a TOML file in UTF-8") from None
    _refuse_depth(name, text, error)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as problem:
        raise error(f"{name}: got no TOML: {problem}") from None
    except Exception as problem:  # what else tomllib lets pass, such as whole numbers that int() refuses
        number = re.search(r"[0-9_]{4300}", text)
        where = f" (at line {text.count(chr(10), 0, number.start()) + 1})" if number else ""
        raise error(f"{name}: got what cannot be read: {problem}{where}, allowed: a TOML file") from None


def _refuse_depth(name: str, text: str, error: type[Refusal]) -> None:
    """Refuse what is nested deeper than a recursive parser, or one that copies dotted keys, can bear."""
    brackets = dots = 0
    for token in _TOKENS.finditer(text):
        match token[0]:
            case "[" | "{":
                brackets, dots = brackets + 1, 0
            case "]" | "}":
                brackets, dots = max(brackets - 1, 0), 0
            case ".":
                dots += 1
            case "=" | "," | "\n":
                dots = 0
        if brackets > MAX_DEPTH or dots >= MAX_DEPTH:
            line = text.count("\n", 0, token.start()) + 1
            raise error(f"{name}: got a deeper nesting (at line {line}), allowed: {MAX_DEPTH} levels")

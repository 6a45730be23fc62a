"""Columns of a table of walks as a person sees them: their words and units, and values that are rounded."""

import math
import re
from typing import NamedTuple

from jaxbiped.batch import NEVER

NOTHING = "–"
"""Shown for a missing value, and for what is not a number."""
NEVER_SHOWN = "never"
"""Shown for a time after every walk."""
MOST_SHOWN = 1e9
"""Magnitude from which a number is only said to be larger."""
_WORDS = {
    "load_time_s": "time of the load",
    "load_end_s": "end of the load",
    "sinkage_m": "sinkage of the ground",
    "damping_s_per_m": "damping of the ground",
    "delta_z_m": "gap of the switches",
    "bounce_s": "bounce of the switches",
    "delay_s": "delay of the readings",
    "gain_scale": "servo gains, factor",
    "reach_margin_m": "margin of reach",
    "zmp_margin_m": "ZMP margin",
}
_SHIFTED = {"load": "load", "com": "trunk's COM", "push": "push"}
_WAYS = {"x": "forward", "y": "to the left", "z": "upward"}
_UNITS = {
    **{"m_per_s": "m/s", "s_per_m": "s/m", "deg": "deg", "rad": "deg", "kg": "kg", "Ns": "N s", "N": "N"},
    **{"s": "s", "m": "mm", "bits": "bit", "scale": "-"},
}
"""Units shown in figures, by the unit at the end of a column's name."""
_DECIMALS = {
    **{"m_per_s": 4, "s_per_m": 2, "deg": 2, "rad": 4, "kg": 3, "Ns": 1, "N": 0, "s": 3, "m": 4},
    **{"bits": 3, "scale": 3},
}
"""Decimals of a value in the unit at the end of its column's name: 0.1 mm, 0.01 degrees, 1 ms, 1 g, 1 N."""
_DECIMALS_OF_COLUMNS = {"sinkage_m": 5, "force_noise_N": 1}
"""Decimals of inputs that are small by nature."""
_DECIMALS_OF_RATIOS = 3


class Shown(NamedTuple):
    """Label and unit of a column as a person sees them."""

    label: str
    """Words and unit."""
    factor: float
    """Factor from the column's unit to the one shown."""


def shown(column: str) -> Shown:
    """Say how a column of a table of walks is labeled: words and a unit, meters as mm and radians as degrees."""
    unit = unit_of(column)
    if column in ("x_m", "y_m"):
        return Shown(f"{_WAYS[column[0]]}, {column[0]} [m]", 1.0)
    factor = {"m": 1e3, "rad": math.degrees(1.0)}.get(unit, 1.0)
    return Shown(f"{_words(column, unit)} [{_UNITS.get(unit, '-')}]", factor)


def unit_of(column: str) -> str:
    """The unit at the end of a column's name; empty for a ratio or a count."""
    return next((unit for unit in _UNITS if column.endswith(f"_{unit}")), "")


def text(value: object, column: str = "") -> str:
    """A value of a table, in the unit of its column and to a resolution that suits it.

    Ratios have three decimals. What is missing or not a number is a dash; infinity is a word.

    Args:
        value: of any kind.
        column: name, which ends in the unit.
    """
    if value is None:
        return NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, float):
        return str(value)
    if unit_of(column) == "s" and NEVER <= value < math.inf:
        return NEVER_SHOWN
    return rounded(value, _decimals(column))


def short(value: float | int | None, column: str) -> str:
    """A value as figures show it, in the unit of `shown` and without zeros at its end."""
    factor = shown(column).factor
    if value is None or (unit_of(column) == "s" and NEVER <= value < math.inf):
        return text(None if value is None else float(value), column)
    return rounded(factor * value, max(0, _decimals(column) - math.floor(math.log10(factor))), strip=True)


def rounded(value: float, decimals: int, strip: bool = False) -> str:
    """A number to so many decimals, without powers of ten and without a minus before nothing but zeros.

    Args:
        value: if it is no finite number, words or a dash are returned.
        decimals: after the point.
        strip: leave out zeros at the end.
    """
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "infinite" if value > 0.0 else "minus infinite"
    if abs(value) >= MOST_SHOWN:
        return f"over {MOST_SHOWN:.0f}" if value > 0.0 else f"under -{MOST_SHOWN:.0f}"
    said = f"{value:.{decimals}f}"
    if strip and "." in said:
        said = said.rstrip("0").rstrip(".")
    return said if said.strip("-0.") else said.removeprefix("-")


def with_unit(value: float | int | None, column: str) -> str:
    """A value as figures show it, with its unit where it has one."""
    said, unit = short(value, column), shown(column).label.rpartition(" [")[2].removesuffix("]")
    number = any(letter.isdigit() for letter in said)
    return f"{said} {unit}" if number and unit != "-" else said


def _decimals(column: str) -> int:
    return _DECIMALS_OF_COLUMNS.get(column, _DECIMALS.get(unit_of(column), _DECIMALS_OF_RATIOS))


def _words(column: str, unit: str) -> str:
    if column in _WORDS:
        return _WORDS[column]
    step, way = re.fullmatch(r"step_(\d+)_height_m", column), re.fullmatch(r"([a-z]+)_([xyz])_\w+", column)
    if step:
        return f"height under foothold {step[1]}"
    if way and way[1] in _SHIFTED:
        return f"{_SHIFTED[way[1]]} {_WAYS[way[2]]}"
    words = (column.removesuffix(f"_{unit}") if unit else column).replace("_", " ")
    return f"{words}, factor" if unit == "scale" else words

"""Presets of gaits: parameters that fit a robot, from the files `presets/GAIT/ROBOT.toml`, with unit and source.

`python sweeps/plan_presets.py` optimizes them all again and says what every preset takes of its robot.
"""

import dataclasses
import functools
from collections.abc import Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Any, Protocol, TypeVar, runtime_checkable

import equinox as eqx

from jaxbiped import checked
from jaxbiped.checked import Quantity
from jaxbiped.planner.checks import GaitError
from jaxbiped.robot import Number, RobotParams, read_number

Record = TypeVar("Record", bound=eqx.Module)


@runtime_checkable
class Kind(Protocol):
    """Class of gaits, as far as a preset has to know it."""

    @property
    def __name__(self) -> str:
        """Name of the class."""
        ...

    @property
    def name(self) -> str:
        """Name of the gait, and of the folder of its presets."""
        ...

    @property
    def quantities(self) -> Mapping[str, Quantity]:
        """Allowed values of the parameters, by their dotted names."""
        ...

    @property
    def parameters(self) -> type[eqx.Module]:
        """The record of the parameters."""
        ...


@dataclasses.dataclass(frozen=True)
class Preset:
    """Content of the file of a preset."""

    numbers: Mapping[str, Number]
    """The parameters by their dotted names, with unit and source."""
    infeasible: str
    """Reason why it breaks a constraint although it is a preset; empty if it is not known to."""

    def parameters(self, record: type[Record]) -> Record:
        """The parameters as the record of their gait."""
        return record_of(record, {name: float(number.value) for name, number in self.numbers.items()})


def robots(gait: Kind) -> tuple[str, ...]:
    """Names of the robots that have a preset of a gait."""
    folder = _folder(gait)
    files = folder.iterdir() if folder.is_dir() else ()
    return tuple(sorted(file.name.removesuffix(".toml") for file in files))


def preset(gait: Kind, robot: str | RobotParams) -> Preset:
    """The preset of a gait for a preset robot, by its name, or for one that walks like it.

    Raises:
        GaitError: if there is none.
    """
    name, known = _name(robot), robots(gait)
    if name not in known:
        make = f"{gait.__name__}.make(robot, {gait.parameters.__name__}(...), n_steps)"
        raise GaitError(f"preset gait: {no_preset(name, known)}, or use {make}")
    return _read(gait, name)


def no_preset(name: str, known: tuple[str, ...]) -> str:
    """Say that a robot has no preset, which robots have one, and how to walk like one of them."""
    like = " or ".join(repr(robot) for robot in known)
    otherwise = f"; otherwise add walks_like = {like} to the robot's file" if known else ""
    return f"got robot {name!r}, allowed: {', '.join(known) or 'none'}{otherwise}"


def known_infeasible(gait: Kind, robot: str | RobotParams) -> str:
    """Say why the preset of a robot breaks a constraint although it is one; empty if it is not known to.

    Args:
        gait: the class of the gait.
        robot: the robot that walks, or its name.
    """
    name = _name(robot)
    return _read(gait, name).infeasible if name in robots(gait) else ""


def _name(robot: str | RobotParams) -> str:
    return robot if isinstance(robot, str) else robot.preset_name


def _folder(gait: Kind) -> Traversable:
    return resources.files("jaxbiped.planner") / "presets" / gait.name


@functools.cache
def _read(gait: Kind, name: str) -> Preset:
    file = _folder(gait) / f"{name}.toml"
    document = checked.read_toml(file, GaitError)
    checked.refuse_unknown("", document, ("infeasible", "parameters"), GaitError)
    given = _flat(document.get("parameters", {}))
    checked.refuse_unknown("parameters.", given, gait.quantities, GaitError)
    for key in gait.quantities:
        if key not in given:
            raise GaitError(
                f"{file.name}: parameters.{key}: missing, allowed: {gait.quantities[key].allowed}"
            )
    numbers = {
        key: read_number(f"parameters.{key}", given[key], rule, GaitError)
        for key, rule in gait.quantities.items()
    }
    return Preset(numbers, document.get("infeasible", ""))


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The entries of a table and of the tables in it, by dotted names."""
    found: dict[str, Any] = {}
    for key, entry in table.items():
        is_table = isinstance(entry, dict) and "value" not in entry
        found |= _flat(entry, f"{prefix}{key}.") if is_table else {f"{prefix}{key}": entry}
    return found


def record_of(record: type[Record], values: Mapping[str, float], prefix: str = "") -> Record:
    """A record of numbers, and of records of numbers, by their dotted names."""
    made = {}
    for field in dataclasses.fields(record):
        name, kind = f"{prefix}{field.name}", field.type
        if isinstance(kind, type) and issubclass(kind, eqx.Module):
            made[field.name] = record_of(kind, values, f"{name}.")
        else:
            made[field.name] = values[name]
    return record(**made)

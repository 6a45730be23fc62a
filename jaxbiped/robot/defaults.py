"""Choices of a robot's own paper beyond its body: which gait it walks, and what each gait is simulated with.

Tables of a robot file, each entry with its source, kept apart from `RobotParams`, which is what is compiled:

    [walking]
    gait = { value = "cosine", stated = "..." }

    [simulation.cosine]
    friction = { value = 0.09, assumed = "..." }
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from jaxbiped import checked
from jaxbiped.checked import Flag, Quantity, Refusal, Word, shown
from jaxbiped.robot.fields import RobotFileError, Setting, read_setting

MAX_TICKS = 1000
"""Largest number of physics ticks in a control tick."""


def _gait(name: str, given: object, error: type[Refusal]) -> str:
    """The name of a gait, which the planner knows."""
    if not isinstance(given, str) or not given.isidentifier():
        raise error(f"{name}: got {shown(given)}, allowed: the name of a gait")
    return given


def _ticks(name: str, given: object, error: type[Refusal]) -> int:
    return checked.whole(name, given, 1, MAX_TICKS, error)


_SIMULATION: dict[str, Callable[[str, object, type[Refusal]], object]] = {
    "control_every": _ticks,
    "feed_forward": Flag().check,
    "payload_model": Word(("exact", "thesis")).check,
    "friction": Quantity("", 0.01, 5.0).check,
}
"""Allowed entries of [simulation.GAIT]: options of a simulation, and the friction of the floor."""
TABLES = ("walking", "simulation")


@dataclass(frozen=True)
class Defaults:
    """Choices beside a robot's body in its file."""

    settings: Mapping[str, Setting] = field(default_factory=dict)
    """Entries by their dotted names, such as `walking.gait` and `simulation.cosine.friction`."""

    @property
    def gait(self) -> str:
        """Name of the gait of the robot's own paper; empty if none is known."""
        setting = self.settings.get("walking.gait")
        return "" if setting is None else setting.value

    def simulation(self, gait: str) -> dict[str, Any]:
        """Options and friction with which a gait is simulated where nobody says otherwise."""
        prefix = f"simulation.{gait}."
        return {
            name.removeprefix(prefix): setting.value
            for name, setting in self.settings.items()
            if name.startswith(prefix)
        }


def read(document: Mapping[str, object]) -> Defaults:
    """Read the tables of a robot file.

    Raises:
        RobotFileError: naming the field, what was got and what is allowed.
    """
    walking = _table("walking", document.get("walking", {}))
    checked.refuse_unknown("walking.", walking, ("gait",), RobotFileError)
    found = [read_setting(f"walking.{key}", entry, _gait) for key, entry in walking.items()]
    for gait, given in _table("simulation", document.get("simulation", {})).items():
        where = f"simulation.{_gait('simulation', gait, RobotFileError)}"
        checked.refuse_unknown(f"{where}.", _table(where, given), _SIMULATION, RobotFileError)
        found += [read_setting(f"{where}.{key}", entry, _SIMULATION[key]) for key, entry in given.items()]
    return Defaults({setting.field: setting for setting in found})


def require_same(given: Defaults, preset: Defaults, walks_like: str) -> None:
    """Refuse what a robot file says otherwise than the preset it walks like, which is what counts.

    In the file of a robot that walks like no preset, these tables do not count.

    Raises:
        RobotFileError: naming the field, what was got and what is allowed.
    """
    for name, setting in given.settings.items() if walks_like else ():
        known = preset.settings.get(name)
        if known is None or known.value != setting.value:
            allowed = "none" if known is None else f"{shown(known.value)}, or none"
            raise RobotFileError(
                f"{name}: got {shown(setting.value)}, allowed: {allowed}, as in {walks_like}, which it walks like"
            )


def _table(name: str, table: object) -> dict[str, Any]:
    if not isinstance(table, dict):
        raise RobotFileError(f"{name}: got {shown(table)}, allowed: a table [{name}]")
    return table

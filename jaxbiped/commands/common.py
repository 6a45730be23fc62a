"""Shared parts of the commands: refusals, robots, output folders, figures, targets over time."""

import contextlib
import importlib.util
import json
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from jaxbiped import checked, files, robot, sim

OVERWRITE_HELP = (
    "Replace what something else left in the folder; without it nothing is ever replaced or deleted."
)


class InputError(ValueError):
    """Input that cannot be used: one line with the argument, what was got and what is allowed."""


def figures_module() -> ModuleType | None:
    """The figures, imported only when a command draws; None without the packages of the extra `viz`."""
    if any(importlib.util.find_spec(name) is None for name in ("matplotlib", "jinja2")):
        return None
    from jaxbiped import report

    return report


def figures_or_word() -> ModuleType | None:
    """The figures; without the extra `viz` none, and a word on how to get them."""
    figures = figures_module()
    if figures is None:
        say("no figures were drawn: pip install 'jaxbiped[viz]'")
    return figures


def say(line: str) -> None:
    """Say something beside the results, on standard error."""
    print(f"jaxbiped: {line}", file=sys.stderr, flush=True)


def load_robot(argument: str, name_or_path: str) -> robot.RobotParams:
    """A preset or a robot file; `argument` is what to name in a refusal."""
    try:
        return robot.load(name_or_path)
    except robot.RobotFileError as error:
        raise InputError(f"{argument}: {str(error).removeprefix('robot: ')}") from None
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(
            f"{argument}: got '{name_or_path}' ({error}), allowed: a TOML file in UTF-8"
        ) from None


def whole(argument: str, given: object, low: int, high: int) -> int:
    """A whole number of an argument, within its range."""
    try:
        return checked.whole(argument, given, low, high)
    except checked.Refusal as error:
        raise InputError(str(error)) from None


@contextlib.contextmanager
def refusing(out: Path, allowed: str) -> Iterator[None]:
    """Turn an error of the file system into one about --out."""
    try:
        yield
    except OSError as error:
        place = error.filename or out
        raise InputError(f"--out: got '{place}' ({error.strerror or error}), allowed: {allowed}") from None


def require_folder(out: Path, given: Path | None = None) -> None:
    """Refuse what cannot become a folder to write into; nothing is touched.

    Args:
        out: the folder.
        given: the file in it that --out names, if it names a file.
    """
    if why := files.why_not_writable(out):
        what = "a folder" if given is None else "a file in a folder"
        raise InputError(f"--out: got '{given or out}' ({why}), allowed: {what} that can be made and written")


def require_free(out: Path, names: Iterable[str], ours: bool, overwrite: bool) -> None:
    """Refuse a folder in which files of something else would be replaced.

    Args:
        out: the folder.
        names: of the files that would be written.
        ours: whether the folder says that it holds the very same thing.
        overwrite: whether they may be replaced.
    """
    there = [] if ours or overwrite else [name for name in names if os.path.lexists(out / name)]
    if there:
        raise InputError(
            f"--out: got '{out}', which holds {there[0]} of something else, allowed: another folder, or --overwrite"
        )


def key_in(file: Path) -> str | None:
    """The key of what a JSON file says it is of; None if there is none."""
    try:
        return json.loads(file.read_text(encoding="utf-8")).get("key")
    except (OSError, ValueError, AttributeError, RecursionError):
        return None


def make_writable(folder: Path) -> None:
    """Make the folder if it is missing, and try to write into it before any work is done."""
    with refusing(folder, "a folder that can be made and written"):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()


def write(file: Path, content: bytes | str) -> Path:
    """Write a file as a whole, or refuse in the words of the command line."""
    with refusing(file, "a place that can be written, with room for the file"):
        return files.write(file, content)


def plain(value: object) -> Any:  # noqa: ANN401
    """A value for JSON, with None in place of NaN and of what is infinite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


def save(figures: ModuleType, drawn: Mapping[str, Any], out: Path) -> list[str]:
    """Save figures as PNG files; returns their names."""
    with refusing(out, "a place that can be written, with room for the figures; the numbers are kept"):
        return [str(figures.save(figure, out / f"{name}.png")) for name, figure in drawn.items()]


def draw(make: Callable[[ModuleType], Mapping[str, Any]], out: Path) -> list[str]:
    """Draw and save figures where they can be drawn; returns the names of the files."""
    figures = figures_or_word()
    return [] if figures is None else save(figures, make(figures), out)


def outcome(walk: sim.Walk) -> dict[str, Any]:
    """The numbers of a simulated walk."""
    s = walk.statistics
    return {
        "status": sim.STATUS_TEXT[int(s.status)],
        "end_time_s": round(float(s.end_time), 4),
        "peak_roll_deg": float(np.degrees(s.peak_roll_pitch[0])),
        "peak_pitch_deg": float(np.degrees(s.peak_roll_pitch[1])),
        "peak_foot_force_N": float(np.max(s.peak_foot_force)),
        "peak_slip_m": float(np.max(s.peak_slip)),
    }


def outcome_in_words(o: dict[str, Any]) -> str:
    """The numbers of `outcome` as a line to read."""
    return (
        f"{o['status']} at {o['end_time_s']:.2f} s, trunk roll up to {o['peak_roll_deg']:.1f} and pitch"
        f" {o['peak_pitch_deg']:.1f} deg, foot force up to {o['peak_foot_force_N']:.0f} N,"
        f" slip {1e3 * o['peak_slip_m']:.0f} mm"
    )

"""`jaxbiped export`: a robot for stock MuJoCo."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxbiped import files, sim
from jaxbiped.commands.common import InputError, load_robot, make_writable, require_folder, write


@dataclass(frozen=True)
class Export:
    """Write a robot as an MJCF file that stock MuJoCo loads."""

    robot: str
    """Name of a preset (elkahlout, surena3) or path of a robot file (.toml)."""
    out: Path
    """The file to write (.xml)."""
    overwrite: bool = False
    """Replace a file of that name; without it nothing is ever replaced."""
    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Export) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    params, out = load_robot("--robot", command.robot), command.out
    if out.suffix != ".xml":
        raise InputError(f"--out: got '{out}', allowed: a file name that ends in .xml")
    require_folder(out.parent, out)
    text = sim.mjcf(params)
    if os.path.lexists(out) and not (command.overwrite and files.is_file(out)) and not _holds(out, text):
        raise InputError(f"--out: got '{out}', which is there already, allowed: another file, or --overwrite")
    make_writable(out.parent)
    write(out, text)
    mass = round(float(params.total_mass), 3)
    print(f"{params.name}, {mass:g} kg, written to {out}")
    return {"robot": params.name, "mass_kg": mass, "file": str(out)}


def _holds(file: Path, text: str) -> bool:
    """Tell whether a file holds this very text already."""
    try:
        return files.is_file(file) and file.read_bytes() == text.encode()
    except OSError:
        return False

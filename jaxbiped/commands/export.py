"""`jaxbiped export`: a robot for stock MuJoCo, or its controller in C."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import UseAppendAction, arg

from jaxbiped import batch, files, robot, sim
from jaxbiped.commands.choices import ALLOW_HELP, GAIT_NAMES, gait_name, make_gait
from jaxbiped.commands.common import InputError, load_robot, make_writable, require_folder, write
from jaxbiped.commands.walk_input import VARIANTS, controller_of
from jaxbiped.sim.controller_c import controller_c

STEPS = 8
"""Steps of the walk of a controller, where none are given."""
VARIANT_HELP = (
    "With --c: which adaptation is on, as in `jaxbiped walk`: one word for each stage, or the file of a variant "
    "(.toml). Default: repaired."
)


@dataclass(frozen=True)
class Export:
    """Write a robot as an MJCF file that stock MuJoCo loads, or its controller for one walk as C99."""

    robot: str
    """Name of a preset (elkahlout, surena3) or path of a robot file (.toml)."""
    out: Path
    """The file to write (.xml); with --c the folder of ROBOT_controller.c and .h."""
    c: bool = False
    """Write the controller (planner, adaptation, inverse kinematics) as C99 that needs nothing but libm."""
    gait: Annotated[
        str | None, arg(metavar=GAIT_NAMES, help="With --c. Default: the gait of the robot's own paper.")
    ] = None
    steps: int | None = None
    """With --c: number of steps; 8 by default."""
    variant: Annotated[
        tuple[tuple[str, ...], ...],
        UseAppendAction,
        arg(metavar="|".join(VARIANTS) + " ...", help=VARIANT_HELP),
    ] = ()
    allow_infeasible: Annotated[bool, arg(help=f"With --c: {ALLOW_HELP}")] = False
    overwrite: bool = False
    """Replace files of these names; without it nothing is ever replaced."""
    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Export) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    params = load_robot("--robot", command.robot)
    if command.c:
        return _controller(command, params)
    given = {
        "--gait": command.gait is not None,
        "--steps": command.steps is not None,
        "--variant": bool(command.variant),
        "--allow-infeasible": command.allow_infeasible,
    }
    for name, is_given in given.items():
        if is_given:
            raise InputError(f"{name}: got a value, allowed: only with --c, for a robot has none")
    out = command.out
    if out.suffix != ".xml":
        raise InputError(f"--out: got '{out}', allowed: a file name that ends in .xml")
    require_folder(out.parent, out)
    _write({out: sim.mjcf(params)}, command.overwrite)
    mass = round(float(params.total_mass), 3)
    print(f"{params.name}, {mass:g} kg, written to {out}")
    return {"robot": params.name, "mass_kg": mass, "file": str(out)}


def _controller(command: Export, params: robot.RobotParams) -> dict[str, Any]:
    out, allow = command.out, command.allow_infeasible
    require_folder(out)
    with batch.waiting("planning"):
        steps = STEPS if command.steps is None else command.steps
        gait = make_gait(params, gait_name(command.gait, params), steps, allow)
        words = [word for some in command.variant for word in some]
        controller = controller_of(words, params, gait, allow)
    options = sim.own_options(params, gait)
    with batch.waiting("tracing and printing the controller"):
        name = re.sub(r"[^a-z0-9_]", "_", params.name.lower())
        name = name if name[0].isalpha() else f"robot_{name}"
        made = controller_c(sim.prepare(params, controller, options), f"{name}_controller")
    texts = {out / f"{made.name}.c": made.source, out / f"{made.name}.h": made.header}
    _write(texts, command.overwrite)
    stages = [stage.name for stage in controller.stages]
    what = f"{controller.gait.name} gait, {' and '.join(stages) or 'no stage'}"
    files_text = " and ".join(map(str, texts))
    print(f"{params.name}, {what}, a tick every {1e3 * options.control_dt:g} ms, written to {files_text}")
    return {
        "robot": params.name,
        "gait": controller.gait.name,
        "stages": stages,
        "control_dt_s": options.control_dt,
        "files": [str(file) for file in texts],
    }


def _write(texts: dict[Path, str], overwrite: bool) -> None:
    """Write files; refuse all of them if one is there that holds something else."""
    for out, text in texts.items():
        if os.path.lexists(out) and not (overwrite and files.is_file(out)) and not _holds(out, text):
            raise InputError(
                f"--out: got '{out}', which is there already, allowed: another place, or --overwrite"
            )
    for out, text in texts.items():
        make_writable(out.parent)
        write(out, text)


def _holds(file: Path, text: str) -> bool:
    """Tell whether a file holds this very text already."""
    try:
        return files.is_file(file) and file.read_bytes() == text.encode()
    except OSError:
        return False

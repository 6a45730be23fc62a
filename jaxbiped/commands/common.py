"""What the commands share: refusals, robots, writable folders, targets over time."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxbiped import planner, robot, sim


class InputError(ValueError):
    """Input that cannot be used: one line with the argument, what was got and what is allowed."""


def figures_module() -> ModuleType:
    """The figures, imported only when a command draws: matplotlib is an extra."""
    from jaxbiped import report

    return report


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


@contextlib.contextmanager
def refusing(out: Path, allowed: str) -> Iterator[None]:
    """Turn an error of the file system into one about --out."""
    try:
        yield
    except OSError as error:
        raise InputError(f"--out: got '{out}' ({error.strerror}), allowed: {allowed}") from None


def make_writable(folder: Path) -> None:
    """Make the folder if it is missing, and try to write into it before any work is done."""
    folder.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()


@eqx.filter_jit
def targets_at(gait: Any, times: Any) -> planner.Targets:
    """Targets of a gait at many times [s], as a leading axis."""
    return jax.vmap(lambda t: planner.at(gait, t))(times)


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
    """The same as a line to read."""
    return (
        f"{o['status']} at {o['end_time_s']:.2f} s, trunk roll up to {o['peak_roll_deg']:.1f} and pitch"
        f" {o['peak_pitch_deg']:.1f} deg, foot force up to {o['peak_foot_force_N']:.0f} N,"
        f" slip {1e3 * o['peak_slip_m']:.0f} mm"
    )

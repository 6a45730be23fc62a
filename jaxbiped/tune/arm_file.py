"""A tuned arm as a TOML file that every command accepts, with where it came from."""

from collections.abc import Mapping
from importlib import metadata

from jaxbiped.adapt import tunables
from jaxbiped.tune.descent import Tuned


def arm_file(tuned: Tuned, base: Mapping[str, str], made_by: str) -> str:
    """Text of the file.

    Args:
        tuned: the outcome of a descent.
        base: name of the arm it started from, by stage (`landing`, `payload`).
        made_by: command that made it.
    """
    problem, settings = tuned.problem, tuned.settings
    tables = tunables.as_tables(problem.controller, problem.tunables, tuned.values.tolist())
    lines = [f"# Tuned by: {made_by}", ""]
    for stage in dict.fromkeys([*base, *tables]):
        lines.append(f"[{stage}]")
        lines += [f"base = '{base[stage]}'"] if stage in base else []
        lines += [f"{name} = {value}" for name, value in tables.get(stage, {}).items()]
        lines.append("")
    origin = {
        "jaxbiped": metadata.version("jaxbiped"),
        "robot": problem.experiment.robot.name,
        "gait": type(problem.controller.gait).__name__,
        "scenarios": problem.experiment.table.height,
        "seed": settings.seed,
        "steps": tuned.descent.best["step"],
        "held_out_loss_before": tuned.before["loss"],
        "held_out_loss": tuned.after["loss"],
        "held_out_success_before": tuned.before["success"],
        "held_out_success": tuned.after["success"],
    }
    lines.append("[origin]")
    lines += [f"{k} = {v!r}" for k, v in origin.items()]
    return "\n".join(lines) + "\n"

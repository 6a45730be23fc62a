"""A tuned variant as a TOML file that every command accepts, with where it came from."""

from collections.abc import Mapping
from importlib import metadata
from typing import Any

import tomli_w

from jaxbiped.adapt import tunables
from jaxbiped.tune.descent import Tuned


def variant_file(tuned: Tuned, start: Mapping[str, Mapping[str, Any]], made_by: str) -> str:
    """Text of the file: the tables of the variant it started from, with the tuned values in them.

    Args:
        tuned: the outcome of a descent.
        start: tables of the variant it started from: `base`, a variant's name, and parameters, by stage (`landing`,
            `payload`); parameters of the gait.
        made_by: command that made it.
    """
    problem, settings = tuned.problem, tuned.settings
    found = problem.tunables
    new = tunables.as_tables(problem.experiment.robot, problem.controller, found, tuned.values.tolist())
    tables = {name: {**start.get(name, {}), **new.get(name, {})} for name in dict.fromkeys([*start, *new])}
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
    return f"# Tuned by: {made_by}\n\n{tomli_w.dumps({**tables, 'origin': origin})}"

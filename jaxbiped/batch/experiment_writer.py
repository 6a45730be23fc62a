"""An experiment as the TOML file that `experiment_file` reads, with every value in it."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import tomli_w

from jaxbiped import files, robot
from jaxbiped.adapt import variants
from jaxbiped.batch import defaults, inputs
from jaxbiped.batch.draws import grid
from jaxbiped.batch.experiment import RULES, Experiment
from jaxbiped.batch.experiment_file import INCOMPLETE
from jaxbiped.checked import Refusal
from jaxbiped.planner import GAITS, Gait
from jaxbiped.robot import SIDE_NAMES

SCENARIOS = "scenarios.parquet"
MAX_LISTED = 100
"""Rows of scenarios, or values of a column in a grid, that are written into the file itself."""
_HEADER = "# An experiment as it was resolved, see `jaxbiped run`."


def write(path: str | Path, experiment: Experiment) -> Path:
    """Write the file of an experiment; scenarios that make no grid, and are many, into `scenarios.parquet` beside it.

    An experiment that no file can say (a stage that is not registered, a gait or robot of no known kind) is written as
    far as it can be; the file names what is missing under `incomplete`, and is refused where it is read.

    Raises:
        OSError: if it cannot be written.
    """
    path = Path(path)
    content = text(experiment)
    if f'table = "{SCENARIOS}"' in content:
        experiment.table.write_parquet(path.with_name(SCENARIOS))
    return files.write(path, content)


def text(experiment: Experiment, header: str = _HEADER) -> str:
    """The text of the file; scenarios that make no grid, and are many, are said to be in `scenarios.parquet`."""
    lacking: list[str] = []
    tables = {
        "robot": _robot(experiment, lacking),
        "gait": _gait(experiment, lacking),
        "variants": _variants(experiment, lacking),
        "scenarios": _scenarios(experiment),
        "simulation": _simulation(experiment),
        "score": {"rule": RULES.words[0]},
        "report": {"pages": list(experiment.pages)},
    }
    incomplete = {INCOMPLETE: lacking} if lacking else {}
    return f"{header}\n\n{tomli_w.dumps({**incomplete, **tables})}"


def _robot(experiment: Experiment, lacking: list[str]) -> str:
    """Name of the preset, or path of the file, that the robot is."""
    params = experiment.robot
    for given in (params.name, experiment.robot_file):
        try:
            if given and variants.same(robot.on_device(robot.load(given)), params):
                return given
        except robot.RobotFileError:
            continue
    lacking.append(f"robot: '{params.name}' is no preset, and not what a robot file says")
    return params.name


def _gait(experiment: Experiment, lacking: list[str]) -> dict[str, Any]:
    """The first variant's gait; it was accepted when the experiment was made, so that it may break a constraint."""
    gait = _first_gait(experiment)
    kind = defaults.kind_of(gait)
    try:
        if kind is None:
            raise Refusal(f"a {type(gait).__name__} is none of {', '.join(GAITS)}")
        numbers = variants.gait_numbers(gait)
        again = defaults.plan(
            experiment.robot,
            kind,
            int(gait.n_steps),
            numbers,
            first_swing=int(gait.first_swing),
            allow_infeasible=True,
        )
        if not variants.same(again, gait):
            raise Refusal("it is not what its parameters say")
    except ValueError as error:
        lacking.append(f"gait: {error}")
        return {}
    return {
        "kind": kind,
        "steps": int(gait.n_steps),
        "first_swing": SIDE_NAMES[int(gait.first_swing)],
        "allow_infeasible": True,
        "parameters": variants.nested(numbers),
    }


def _variants(experiment: Experiment, lacking: list[str]) -> dict[str, Any]:
    """The tables of every variant, with all parameters of its stages."""
    found: dict[str, Any] = {}
    for name, controller in experiment.variants.items():
        try:
            tables = variants.tables_of(controller, experiment.robot, _first_gait(experiment), name)
        except ValueError as error:
            lacking.append(f"variants.{name}: {error}")
            tables = {}
        found[name] = {
            key: variants.nested(table) if key == variants.GAIT else table for key, table in tables.items()
        }
    return found


def _first_gait(experiment: Experiment) -> Gait:
    return next(iter(experiment.variants.values())).gait


def _scenarios(experiment: Experiment) -> dict[str, Any]:
    """A grid if the scenarios are one, else their rows, else the file they stand in."""
    table = experiment.table
    if table.equals(_own_seeds(experiment)):
        table = table.drop(inputs.SEED)
    columns = {name: _column(table[name]) for name in table.columns}
    if inputs.SEED not in columns and (crossed := _as_grid(table)) is not None:
        return {
            "grid": {**{name: value for name, value in columns.items() if name not in crossed}, **crossed}
        }
    if table.height > MAX_LISTED:
        return {"table": SCENARIOS}
    name = next((name for name, column in columns.items() if isinstance(column, list)), table.columns[0])
    return {"rows": {**columns, name: table[name].to_list()}}


def _own_seeds(experiment: Experiment) -> pl.DataFrame:
    """The scenarios with the seeds that are drawn where a table gives none."""
    return inputs.complete(experiment.table.drop(inputs.SEED), int(experiment.seed))


def _column(values: pl.Series) -> float | int | list[float | int]:
    """One number if all are the same, else all of them."""
    return values[0] if values.n_unique() == 1 else values.to_list()


def _as_grid(table: pl.DataFrame) -> dict[str, list[float]] | None:
    """The columns that vary, the slowest first, if the table has every combination of few values, in order."""
    varied = [name for name in table.columns if table[name].n_unique() > 1]
    first_change = {name: int(np.argmax(table[name].to_numpy() != table[name][0])) for name in varied}
    slowest = sorted(varied, key=lambda name: -first_change[name])
    values = {name: table[name].unique(maintain_order=True).to_list() for name in slowest}
    if max(map(len, values.values()), default=0) > MAX_LISTED:
        return None
    if math.prod(map(len, values.values())) != table.height:
        return None
    return values if not values or grid(**values).equals(table.select(slowest)) else None


def _simulation(experiment: Experiment) -> dict[str, Any]:
    """Options, durations, seed and how many walk at once."""
    options, durations = experiment.simulation, experiment.durations
    same = len(set(durations.values())) == 1
    return {
        "dt": options.dt,
        "implicit": options.implicit,
        "control_every": options.control_every,
        "feed_forward": options.feed_forward,
        "payload_model": options.payload_model,
        "contact": options.contact,
        "backend": options.backend,
        "noise": options.noise,
        "delay_room": options.delay_room,
        "seed": experiment.seed,
        "batch": experiment.lanes,
        "duration": next(iter(durations.values())) if same else durations,
    }

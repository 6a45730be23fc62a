"""An experiment as a TOML file: read here, written by `experiment_writer`.

    robot = "elkahlout"                 # a preset, or the path of a robot file

    [gait]                              # default: the preset of the robot's own paper, 8 steps
    kind = "cosine"                     # or polynomial
    steps = 7
    parameters = { b_s = 0.08 }         # instead of the preset's; or file = "tuned.toml", whose [gait] is taken
    allow_infeasible = true             # the plan may break a constraint

    [variants.off]                      # a variant without tables walks open loop
    [variants.modified.payload]         # tables as in the file of a variant, see `adapt.variants`
    base = "modified"
    [variants.tuned]
    file = "tuned.toml"

    [scenarios.grid]                    # or rows, draw, table = "scenarios.parquet"; columns as in `inputs.INPUTS`
    load_kg = [2.5, 5.0]
    load_time_s = { from = 1.3, to = 6.0, step = 0.1 }
    friction = 0.09

    [simulation]                        # any of dt, control_every, ..., duration, seed, batch
    [score]
    rule = "papers"
    [report]
    pages = ["payload"]

Paths are relative to the folder of the file. Everything is checked before a gait is planned.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from jaxbiped import checked
from jaxbiped.adapt import Controller, variants
from jaxbiped.batch import defaults, inputs
from jaxbiped.batch.draws import MAX_ROWS, Choice, Distribution, Normal, Uniform, draw, grid
from jaxbiped.batch.experiment import MAX_BATCH, PAGES, RULES, Experiment
from jaxbiped.checked import Field, Flag, Quantity, Refusal, Word
from jaxbiped.planner import GAITS, Gait
from jaxbiped.planner.constraints import OR_ALLOW
from jaxbiped.robot import SIDE_NAMES, RobotParams
from jaxbiped.sim import Options, own_options
from jaxbiped.sim.options import BACKENDS, CONTACTS, DURATION, IMPLICIT, MAX_TICKS
from jaxbiped.sim.plant import PAYLOAD_MODELS

TABLES = ("robot", "gait", "variants", "scenarios", "simulation", "score", "report")
INCOMPLETE = "incomplete"
"""Key of a file that does not say all of its experiment, see `experiment_writer`."""
KINDS = ("grid", "rows", "draw", "table")
"""Ways in which scenarios can be given."""
CLOCKS = Word(
    ("walk", "gait"), "since when times are counted: the start of the walk, or of the gait's own clock"
)
TIMES = ("load_time_s", "load_end_s", "push_time_s")
"""Columns of times, which are counted on the clock that the file names."""
OPTIONS: dict[str, Field] = {
    "dt": Quantity("s", 1e-5, 0.01),
    "implicit": Word(IMPLICIT),
    "feed_forward": Flag("add the plan's inverse dynamics to the servos' torque"),
    "payload_model": Word(PAYLOAD_MODELS),
    "contact": Word(CONTACTS),
    "backend": Word(BACKENDS),
    "noise": Flag("add the scenario's sensor noise"),
}
WHOLE = {
    "control_every": (1, MAX_TICKS),
    "delay_room": (0, MAX_TICKS),
    "seed": (0, 2**31 - 1),
    "batch": (1, MAX_BATCH),
}
"""Whole numbers of [simulation], smallest and largest."""
_PAIR = Quantity(shapes=((2,),))
_DISTRIBUTIONS = ("uniform", "normal", "choice")
Table = dict[str, Any]
Make = Callable[[], pl.DataFrame]


def read(path: str | Path) -> Experiment:
    """Read an experiment from a TOML file.

    Raises:
        Refusal: naming the file, the key, what was got and what is allowed.
    """
    path = Path(path)
    data = checked.read_toml(path)
    try:
        return _read(data, path.parent)
    except ValueError as error:
        words = str(error).replace(OR_ALLOW, f"{OR_ALLOW.replace('=True', ' = true')} in [gait]")
        raise Refusal(f"{path.name}: {words}") from None


def _read(data: Table, folder: Path) -> Experiment:
    """First everything that can be judged without a plan, then the gait, scenarios and controllers."""
    if INCOMPLETE in data:
        raise Refusal(
            f"{INCOMPLETE}: got {checked.shown(data[INCOMPLETE])}, allowed: a file that says everything"
        )
    checked.refuse_unknown("", data, TABLES)
    robot_name = _text("robot", data.get("robot"), "the name of a preset, or the path of a robot file")
    robot, file = defaults.load_robot(_robot_path(robot_name, folder))
    plan = _gait(_table("gait", data.get("gait", {})), robot, folder)
    tables = _variants(data.get("variants", {}), folder)
    clock, frame = _scenarios(_table("scenarios", data.get("scenarios")), folder)
    simulation = _simulation(_table("simulation", data.get("simulation", {})), tables)
    checked.read_table("score", data.get("score", {}), {"rule": RULES})
    pages = _pages(_table("report", data.get("report", {})))
    scenarios = frame()
    inputs.complete(scenarios, seed=0)
    gait = plan()
    return Experiment(
        robot,
        {name: _controller(name, table, robot, gait) for name, table in tables.items()},
        scenarios if clock == "walk" else _on_walk_clock(scenarios, float(gait.clock_start)),
        _options(own_options(robot, gait), simulation),
        **{key: simulation[key] for key in ("duration", "seed", "batch") if key in simulation},
        robot_file=file,
        pages=pages,
    )


# Robot, gait, variants -------------------------------------------------------------------------------------------


def _robot_path(name: str, folder: Path) -> str:
    return str(folder / name) if name.endswith(".toml") else name


def _gait(table: Table, robot: RobotParams, folder: Path) -> Callable[[], Gait]:
    """A function that plans the gait."""
    checked.refuse_unknown(
        "gait.", table, ("kind", "steps", "first_swing", "file", "parameters", "allow_infeasible")
    )
    kind = table["kind"] if "kind" in table else defaults.own_kind(robot)
    kind = Word(tuple(GAITS)).check("gait.kind", kind)
    steps = checked.whole("gait.steps", table.get("steps", 8), 1, defaults.MAX_STEPS)
    first = Word(SIDE_NAMES).check("gait.first_swing", table.get("first_swing", SIDE_NAMES[0]))
    allow = variants.ALLOW.check("gait.allow_infeasible", table.get("allow_infeasible", False))
    if "file" in table and "parameters" in table:
        raise Refusal("gait: got file and parameters, allowed: one of them")
    given = table.get("parameters", {})
    if "file" in table:
        given = dict(_gait_file(_path("gait.file", table["file"], folder)))
        allow = given.pop(variants.ALLOW_KEY, False) or allow
    quantities = GAITS[kind].quantities
    given = variants.flat(_table("gait.parameters", given))
    numbers = checked.read_table("gait.parameters", given, quantities)

    def plan() -> Gait:
        return defaults.plan(
            robot, kind, steps, numbers, first_swing=SIDE_NAMES.index(first), allow_infeasible=allow
        )

    return plan


def _gait_file(path: Path) -> Table:
    """The table [gait] of the file of a variant."""
    tables = variants.read_tables(path)
    if variants.GAIT not in tables:
        raise Refusal(f"gait.file: got '{path}' without a table [gait], allowed: a file that has one")
    return tables[variants.GAIT]


def _variants(given: object, folder: Path) -> dict[str, variants.Tables]:
    """Checked tables of every variant, by its name."""
    every = _table("variants", given)
    if not every:
        raise Refusal("variants: got none, allowed: one or more tables [variants.NAME]")
    return {name: _variant(f"variants.{name[:80]}", table, folder) for name, table in every.items()}


def _variant(where: str, given: object, folder: Path) -> variants.Tables:
    table = _table(where, given)
    if "file" not in table:
        return variants.check_tables(table, f"{where}.")
    if len(table) > 1:
        others = ", ".join(key for key in table if key != "file")
        raise Refusal(f"{where}: got {others} beside a file, allowed: the file alone, or tables")
    path = _path(f"{where}.file", table["file"], folder)
    try:
        return variants.read_tables(path)
    except Refusal as error:
        raise Refusal(f"{where}.file: {error}") from None


def _controller(name: str, tables: variants.Tables, robot: RobotParams, gait: Gait) -> Controller:
    try:
        return variants.controller(tables, robot, gait)
    except Refusal as error:
        raise Refusal(f"variants.{name}: {error}") from None


# Scenarios -------------------------------------------------------------------------------------------------------


def _scenarios(table: Table, folder: Path) -> tuple[str, Make]:
    """The clock that times are counted on, and a function that makes the table."""
    checked.refuse_unknown("scenarios.", table, ("clock", *KINDS))
    given = [kind for kind in KINDS if kind in table]
    if len(given) != 1:
        raise Refusal(f"scenarios: got {' and '.join(given) or 'none'}, allowed: one of {', '.join(KINDS)}")
    kind, where = given[0], f"scenarios.{given[0]}"
    clock = CLOCKS.check("scenarios.clock", table.get("clock", "walk"))
    if kind == "table":
        return clock, lambda: _parquet(where, _path(where, table["table"], folder))
    return clock, {"grid": _grid, "rows": _rows, "draw": _draw}[kind](where, _table(where, table[kind]))


def _grid(where: str, table: Table) -> Make:
    columns = {name: _values(f"{where}.{name[:80]}", name, given) for name, given in table.items()}
    if not columns:
        raise Refusal(f"{where}: got no column, allowed: one or more, such as friction = 0.8")
    return lambda: grid(**columns)


def _rows(where: str, table: Table) -> Make:
    columns = {name: _values(f"{where}.{name[:80]}", name, given) for name, given in table.items()}
    lengths = {name: len(values) for name, values in columns.items() if isinstance(table[name], list | dict)}
    n = max(lengths.values(), default=1)
    for name, length in lengths.items():
        if length != n:
            raise Refusal(
                f"{where}.{name}: got {length} values, allowed: {n}, as of the longest column, or a number"
            )
    if not columns:
        raise Refusal(f"{where}: got no column, allowed: one or more, such as friction = 0.8")
    return lambda: pl.DataFrame({name: values * (n // len(values)) for name, values in columns.items()})


def _draw(where: str, table: Table) -> Make:
    for key in ("n", "seed"):
        if key not in table:
            raise Refusal(f"{where}.{key}: missing, allowed: a whole number")
    n = checked.whole(f"{where}.n", table["n"], 1, MAX_ROWS)
    seed = checked.whole(f"{where}.seed", table["seed"], 0, 2**31 - 1)
    latin = Flag().check(f"{where}.latin_hypercube", table.get("latin_hypercube", True))
    columns = {
        name: _drawn(f"{where}.{name[:80]}", name, given)
        for name, given in table.items()
        if name not in ("n", "seed", "latin_hypercube")
    }
    if not columns:
        raise Refusal(
            f"{where}: got no column, allowed: one or more, such as friction = {{ uniform = [0.4, 1.0] }}"
        )
    return lambda: draw(n, seed, latin_hypercube=latin, **columns)


def _values(where: str, name: str, given: object) -> list[float | int]:
    """The values of a column: a list, one number, or a range with both ends."""
    if name == inputs.SEED:
        return [checked.whole(where, value, 0, 2**31 - 1) for value in _listed(given)]
    allowed = _quantity(where, name)
    if isinstance(given, dict):
        given = _from_to(where, given, allowed)
    values = [allowed.check(where, value) for value in _listed(given)]
    if not values:
        raise Refusal(f"{where}: got no values, allowed: one or more")
    return values


def _from_to(where: str, table: Table, quantity: Quantity) -> list[float]:
    """Return the values from one to another, both included, in steps; rounded to 12 digits, so that 0.1 x 3 is 0.3."""
    step = Quantity(quantity.unit, 0.0, above=True)
    fields: dict[str, Field] = {"from": quantity, "to": quantity, "step": step}
    read = checked.read_table(where, table, fields, fields)
    first, last = read["from"], read["to"]
    count = (last - first) / read["step"]
    if not -1e-9 <= count <= MAX_ROWS:
        raise Refusal(
            f"{where}: got from {first:g} to {last:g} by {read['step']:g}, allowed: from <= to, not too many"
        )
    return [float(f"{first + i * read['step']:.12g}") for i in range(int(count + 1e-9) + 1)]


def _drawn(where: str, name: str, given: object) -> Distribution | float:
    """Distribution of a column, or its one number."""
    allowed = _quantity(where, name)
    if not isinstance(given, dict):
        return allowed.check(where, given)
    checked.refuse_unknown(f"{where}.", given, _DISTRIBUTIONS)
    if len(given) != 1:
        raise Refusal(
            f"{where}: got {', '.join(given) or 'none'}, allowed: one of {', '.join(_DISTRIBUTIONS)}"
        )
    ((kind, numbers),) = given.items()
    where = f"{where}.{kind}"
    if kind == "choice":
        return Choice(tuple(allowed.check(where, value) for value in _list(where, numbers)))
    first, second = _PAIR.check(where, numbers).tolist()
    first = allowed.check(where, first)
    try:
        return Uniform(first, allowed.check(where, second)) if kind == "uniform" else Normal(first, second)
    except ValueError as error:
        raise Refusal(f"{where}: {error}") from None


def _quantity(where: str, name: str) -> Quantity:
    """Range of the numbers of a column."""
    known = inputs.declared([name])
    if name not in known:
        raise Refusal(f"{where}: unknown, allowed: {inputs.COLUMNS}{inputs.nearest_column(name)}")
    return known[name].range


def _parquet(where: str, path: Path) -> pl.DataFrame:
    try:
        return pl.read_parquet(path)
    except (pl.exceptions.PolarsError, OSError, ValueError) as error:
        why = " ".join(str(error).split())[:80]
        raise Refusal(f"{where}: got '{path}' ({why}), allowed: a Parquet file") from None


def _on_walk_clock(table: pl.DataFrame, start: float) -> pl.DataFrame:
    """A table whose times are counted from the start of the walk, not from that of the gait's own clock [s]."""
    times = [pl.col(name) for name in TIMES if name in table.columns]
    return table.with_columns(
        pl.when(time < inputs.NEVER).then(time + start).otherwise(time) for time in times
    )


# Simulation and report -------------------------------------------------------------------------------------------


def _simulation(table: Table, tables: Mapping[str, object]) -> Table:
    """The checked values of [simulation], those that are given."""
    checked.refuse_unknown("simulation.", table, (*OPTIONS, *WHOLE, "duration"))
    read = {
        key: field.check(f"simulation.{key}", table[key]) for key, field in OPTIONS.items() if key in table
    }
    for key, (low, high) in WHOLE.items():
        if key in table:
            read[key] = checked.whole(f"simulation.{key}", table[key], low, high)
    if isinstance(table.get("duration"), dict):
        fields = dict.fromkeys(tables, DURATION)
        read["duration"] = checked.read_table("simulation.duration", table["duration"], fields, fields)
    elif "duration" in table:
        read["duration"] = DURATION.check("simulation.duration", table["duration"])
    return read


def _options(given: Options, simulation: Table) -> Options:
    """Options with those of them that the file gives."""
    own = (*OPTIONS, "control_every", "delay_room")
    return replace(given, **{key: simulation[key] for key in own if key in simulation})


def _pages(table: Table) -> tuple[str, ...]:
    checked.refuse_unknown("report.", table, ("pages",))
    given = _list("report.pages", table.get("pages", ["overview"]))
    return tuple(PAGES.check("report.pages", page) for page in given)


# Of any table ----------------------------------------------------------------------------------------------------


def _table(name: str, given: object) -> Table:
    if not isinstance(given, dict):
        got = "nothing" if given is None else checked.shown(given)
        raise Refusal(f"{name}: got {got}, allowed: a table [{name}]")
    return given


def _text(name: str, given: object, allowed: str) -> str:
    if not isinstance(given, str) or not given:
        got = "nothing" if given is None else checked.shown(given)
        raise Refusal(f"{name}: got {got}, allowed: {allowed}")
    return given


def _path(name: str, given: object, folder: Path) -> Path:
    return folder / _text(name, given, "the path of a file")


def _list(name: str, given: object) -> list[object]:
    if not isinstance(given, list):
        raise Refusal(f"{name}: got {checked.shown(given)}, allowed: a list")
    return given


def _listed(given: object) -> list[object]:
    return given if isinstance(given, list) else [given]

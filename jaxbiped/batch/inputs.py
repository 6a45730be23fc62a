"""Inputs of a scenario table: one column for each number of a scenario, its unit in its name.

A table is a polars frame with one row for each scenario; a column that is not given has its default everywhere.
Of some columns there are many, and a table has those it is given: `step_K_height_m`, the height of a pad under the
foothold of step K; `switch_SIDE_CORNER_stuck` and `switch_SIDE_CORNER_gap_m` of the switch at one corner of a sole.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from jaxbiped.checked import Quantity, nearest
from jaxbiped.robot import SIDE_NAMES
from jaxbiped.sim import Scenario
from jaxbiped.sim.model import CORNER_NAMES
from jaxbiped.sim.scenario import (
    NEVER,
    RANGES,
    Ground,
    ModelErrors,
    Payload,
    Push,
    SensorFaults,
    Terrain,
)


@dataclass(frozen=True)
class Input:
    """One number of a scenario."""

    range: Quantity
    """Unit and bounds."""
    default: float
    what: str


_DEFAULTS = {
    "load_kg": (0.0, "payload; 0 for none"),
    "load_time_s": (
        NEVER,
        "when it is attached, since the start of the walk; 0: carried from the start, as own weight",
    ),
    "load_end_s": (NEVER, "when it is taken off"),
    "load_x_m": (0.2, "its centre forward of the pelvis"),
    "load_y_m": (0.0, "its centre to the left of the pelvis"),
    "load_z_m": (0.25, "its centre above the pelvis"),
    "load_size_m": (0.2, "edge of its cube"),
    "friction": (0.8, "Coulomb coefficient of the ground"),
    "sinkage_m": (1.2e-4, "how deep the standing robot sinks in: compliance of the ground"),
    "damping_s_per_m": (300.0, "damping of the ground"),
    "slip_speed_m_per_s": (1e-4, "sliding speed at which friction reaches 71 % of Coulomb's"),
    "trunk_mass_scale": (1.0, "factor on the mass and inertia of the trunk"),
    "leg_mass_scale": (1.0, "factor on the masses and inertias of the legs"),
    "com_x_m": (0.0, "shift of the trunk's centre of mass forward"),
    "com_y_m": (0.0, "shift of the trunk's centre of mass to the left"),
    "com_z_m": (0.0, "shift of the trunk's centre of mass upward"),
    "gain_scale": (1.0, "factor on the gains of all servos"),
    "delta_z_m": (0.01, "gap at which the contact switches close"),
    "bounce_s": (0.0, "for how long a closing switch bounces"),
    "delay_s": (0.0, "how late every reading arrives"),
    "force_noise_N": (0.0, "standard deviation of every corner force; ZMP and ankle wrenches follow"),
    "angle_noise_rad": (
        0.0,
        "standard deviation of joint angles, roll and pitch; joint speeds and the ZMP seen from the pelvis follow",
    ),
    "push_x_N": (0.0, "push on the trunk, forward"),
    "push_y_N": (0.0, "push on the trunk, to the left"),
    "push_z_N": (0.0, "push on the trunk, upward"),
    "push_time_s": (NEVER, "when the push begins"),
    "push_length_s": (0.0, "how long it lasts"),
}
"""Default and meaning of every column."""
INPUTS = {name: Input(RANGES[name], default, what) for name, (default, what) in _DEFAULTS.items()}
"""Inputs by the names of their columns."""
SEED = "seed"
"""Column of the sensors' noise; whole numbers."""
HEIGHT = Input(RANGES["height_m"], 0.0, "height of a pad under the foothold of a step, negative for a hole")
STUCK = Input(Quantity("", 0.0, 1.0), 0.0, "1 for a contact switch that never closes, else 0")
GAP = Input(RANGES["delta_z_m"], 0.01, "gap at which one contact switch closes, instead of delta_z_m")
_HEIGHT_NAME = re.compile(r"step_(0|[1-9]\d*)_height_m")
_SWITCHES = {(i, j): f"switch_{a}_{b}" for i, a in enumerate(SIDE_NAMES) for j, b in enumerate(CORNER_NAMES)}
"""First part of the names of the columns of the switch at a side and corner."""
_SWITCH_COLUMNS = {
    **{f"{name}_stuck": STUCK for name in _SWITCHES.values()},
    **{f"{name}_gap_m": GAP for name in _SWITCHES.values()},
}
COLUMNS = f"{', '.join([*INPUTS, SEED])}, step_K_height_m, switch_SIDE_CORNER_stuck, switch_SIDE_CORNER_gap_m"
"""All columns, in words."""


def height_column(step: int) -> str:
    """Name of the column with the height under the foothold of a step, 0 for the first."""
    return f"step_{step}_height_m"


def steps_of(columns: Sequence[str]) -> list[int]:
    """The steps whose footholds have a column, in order."""
    found = [_HEIGHT_NAME.fullmatch(name) for name in columns]
    return sorted(int(match[1]) for match in found if match)


def declared(columns: Sequence[str]) -> dict[str, Input]:
    """Inputs of a table with these columns, by the names of the columns; all but the seed."""
    heights = {height_column(step): HEIGHT for step in steps_of(columns)}
    switches = {name: one for name, one in _SWITCH_COLUMNS.items() if name in columns}
    return {**INPUTS, **heights, **switches}


def nearest_column(name: str) -> str:
    """Return `; did you mean '...'?` if a column is like this name, else nothing."""
    return nearest(name, [*INPUTS, SEED, *_SWITCH_COLUMNS])


def complete(scenarios: pl.DataFrame, seed: int) -> pl.DataFrame:
    """Check a scenario table and add every column it leaves out, in one order.

    Args:
        scenarios: one row for each scenario.
        seed: of the sensors' noise, where the table has no column `seed`: every scenario draws its own from it.

    Raises:
        ValueError: naming the column, what was got and what is allowed.
    """
    if scenarios.height == 0:
        raise ValueError("scenarios: got none, allowed: at least one row")
    known = declared(scenarios.columns)
    for name in scenarios.columns:
        if name not in known and name != SEED:
            raise ValueError(f"scenarios: got column '{name}', allowed: {COLUMNS}{nearest_column(name)}")
    columns = [
        _column(scenarios, name, one) if name in scenarios.columns else pl.lit(one.default).alias(name)
        for name, one in known.items()
    ]
    table = scenarios.select(*columns, _seeds(scenarios, seed))
    _require_ends_after(table)
    return table


def changes_of_weight(table: pl.DataFrame) -> int:
    """Most sudden changes of weight in a walk; a load carried from the start is put on unnoticed."""
    is_loaded = pl.col("load_kg") > 0.0
    on, off = (
        is_loaded & (pl.col(name) > 0.0) & (pl.col(name) < NEVER) for name in ("load_time_s", "load_end_s")
    )
    return int(table.select(on.cast(int) + off.cast(int)).to_series().max())  # type: ignore[arg-type]


def _require_ends_after(table: pl.DataFrame) -> None:
    """Refuse loads that are taken off before they are put on."""
    time, end = (table[name].to_numpy() for name in ("load_time_s", "load_end_s"))
    wrong = np.flatnonzero((table["load_kg"].to_numpy() > 0.0) & (end <= time) & (end < NEVER))
    if len(wrong):
        row = int(wrong[0])
        raise ValueError(
            f"load_end_s, row {row}: got {end[row]:g} s, allowed: > load_time_s, {time[row]:g} s"
        )


def _column(scenarios: pl.DataFrame, name: str, one: Input) -> pl.Series:
    given = scenarios[name]
    if not given.dtype.is_numeric():
        raise ValueError(f"{name}: got {given.dtype}, allowed: numbers [{one.range.unit or '-'}]")
    values = given.cast(pl.Float64)
    array = values.to_numpy()
    outside = np.flatnonzero(~one.range.contains(array))
    if len(outside):
        row = int(outside[0])
        if given[row] is None:
            raise ValueError(f"{name}: got nothing in row {row}, allowed: {one.range.allowed}")
        one.range.check(f"{name}, row {row}", float(array[row]))
    if one is STUCK and not np.isin(array, (0.0, 1.0)).all():
        row = int(np.flatnonzero(~np.isin(array, (0.0, 1.0)))[0])
        raise ValueError(f"{name}, row {row}: got {array[row]:g}, allowed: 0 or 1")
    return values


def _seeds(scenarios: pl.DataFrame, seed: int) -> pl.Series:
    if SEED in scenarios.columns:
        given = scenarios[SEED]
        whole = given.dtype.is_integer() and given.null_count() == 0
        if not whole or not given.is_between(0, 2**31 - 1).all():
            raise ValueError(f"{SEED}: got {given.dtype}, allowed: whole numbers from 0 to {2**31 - 1}")
        return given.cast(pl.Int64)
    drawn = np.random.default_rng(seed).integers(0, 2**31 - 1, scenarios.height)
    return pl.Series(SEED, drawn, pl.Int64)


def require_apart(table: pl.DataFrame, places: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Refuse pads that overlap: their heights would add up to something nobody asked for.

    Raises:
        ValueError: naming the two steps.
    """
    steps = steps_of(table.columns)
    for i, a in enumerate(steps):
        for j, b in enumerate(steps[:i]):
            both = table.filter((pl.col(height_column(a)) != 0.0) & (pl.col(height_column(b)) != 0.0))
            touching = np.all(places[i][0] < places[j][1]) and np.all(places[j][0] < places[i][1])
            if touching and both.height:
                raise ValueError(
                    f"scenarios: got pads under steps {b} and {a} that overlap in this gait, allowed: pads apart"
                )


def scenarios_of(table: pl.DataFrame, places: list[tuple[np.ndarray, np.ndarray]]) -> Scenario:
    """A batch of scenarios, one for each row of a complete table, with pads at `places`."""
    n = table.height
    value = {name: table[name].to_numpy() for name in INPUTS}

    def vector(*names: str) -> np.ndarray:
        return np.stack([value[name] for name in names], axis=1)

    def everywhere(name: str, *shape: int) -> np.ndarray:
        return np.broadcast_to(value[name].reshape(n, *(1 for _ in shape)), (n, *shape))

    stuck, gap = np.zeros((n, 2, 4)), everywhere("delta_z_m", 2, 4).copy()
    for place, name in _SWITCHES.items():
        for ending, array in (("stuck", stuck), ("gap_m", gap)):
            if f"{name}_{ending}" in table.columns:
                array[:, *place] = table[f"{name}_{ending}"].to_numpy()

    return Scenario(
        terrain=_terrain(table, places),
        payload=Payload(
            mass=value["load_kg"],
            time=value["load_time_s"],
            place=vector("load_x_m", "load_y_m", "load_z_m"),
            size=value["load_size_m"],
            end=value["load_end_s"],
        ),
        push=Push(
            force=vector("push_x_N", "push_y_N", "push_z_N"),
            start=value["push_time_s"],
            length=value["push_length_s"],
        ),
        ground=Ground(
            sinkage=value["sinkage_m"],
            damping=value["damping_s_per_m"],
            friction=value["friction"],
            slip_speed=value["slip_speed_m_per_s"],
        ),
        errors=ModelErrors(
            mass_scale=vector("trunk_mass_scale", *["leg_mass_scale"] * 12),
            trunk_com_offset=vector("com_x_m", "com_y_m", "com_z_m"),
            gain_scale=everywhere("gain_scale", 2, 6),
        ),
        sensors=SensorFaults(
            delta_z=gap,
            stuck_open=stuck,
            bounce=value["bounce_s"],
            delay=value["delay_s"],
            force_noise=value["force_noise_N"],
            angle_noise=value["angle_noise_rad"],
            seed=table[SEED].to_numpy(),
        ),
    )


def terrain_extremes(table: pl.DataFrame, places: list[tuple[np.ndarray, np.ndarray]]) -> Terrain:
    """Two scenarios in which every obstacle is as high, and as low, as it is anywhere in the table."""
    heights = [height_column(step) for step in steps_of(table.columns)]
    return _terrain(pl.concat([table.select(heights).max(), table.select(heights).min()]), places)


def _terrain(table: pl.DataFrame, places: list[tuple[np.ndarray, np.ndarray]]) -> Terrain:
    n, steps = table.height, steps_of(table.columns)
    if not steps:
        return Terrain(np.zeros((n, 1, 2)), np.zeros((n, 1, 2)), np.zeros((n, 1)))
    lower, upper = (np.stack([place[i] for place in places]) for i in (0, 1))
    heights = np.stack([table[height_column(step)].to_numpy() for step in steps], axis=1)
    everywhere = [np.broadcast_to(corner, (n, *corner.shape)) for corner in (lower, upper)]
    return Terrain(everywhere[0], everywhere[1], heights)

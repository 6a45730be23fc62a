"""elkahlout's sole and its floor's grip against the thesis' tables: the whole family over grip.

Nothing in the thesis says how long a sole is or how much a floor grips. For every friction this looks for the longest
toe with which Table 4.1 is as printed, 2.5 kg carried at all times and 5 kg never, and then walks with it the cells of
Tables 4.2 and 4.3 about which robots differ. So the toe is chosen from Table 4.1 alone, and Tables 4.2 and 4.3 choose
one number, the grip; where their failures lie remains a prediction.

    python sweeps/calibrate_elkahlout.py --out runs/calibration
    python sweeps/calibrate_elkahlout.py --frictions 0.09 --heels -0.036 -0.042 -0.052 -0.062 -0.075 --out runs/heels
"""

import argparse
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jaxbiped.runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import polars as pl

import jaxbiped as jb
from jaxbiped.adapt import Controller, PayloadReflex
from jaxbiped.report import tables
from jaxbiped.score import judge, watch_time
from jaxbiped.sim.options import AUTO, BACKENDS

STEPS = 7
FRICTIONS = (0.06, 0.075, 0.09, 0.105, 0.12, 0.15, 0.2, 0.3, 0.5, 0.8)
TOES = (0.114, 0.15)
"""Shortest and longest toe that is tried [m]."""
FINE = 0.0005
"""Step between toes [m]."""
CARRIED, DROPPED = 2.5, 5.0
"""Largest load of Table 4.1 that is carried, and smallest that is not [kg]."""
OFF_TIMES = (0.2, 0.5, 0.8, 1.1, 1.4, 1.7, 2.0, 2.3, 2.6, 3.2, 3.9, 4.5)
"""Of loads without a reflex [s]."""
LOADS = (7.5, 12.5, 15.0)
"""With a reflex [kg]."""
TIMES = (0.3, 0.6, 0.9, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 2.1, 2.6, 3.2, 3.7, 3.8, 3.9, 4.1)
"""With a reflex [s]."""
TABLE = {"original": 2, "modified": 3}
Columns = dict[str, np.ndarray]


class Walker:
    """A variant of the reflex: compiled once, for any sole and any floor."""

    def __init__(self, name: str, dt: float, backend: str) -> None:
        """Get it ready for physics ticks of dt [s]."""
        robot = jb.robot.load("elkahlout")
        self.name, self.gait = name, jb.planner.CosineGait.preset(robot, STEPS)
        reflex = None if name == "off" else getattr(PayloadReflex, name)(robot, self.gait)
        controller = Controller(self.gait, reflex)
        self.simulation = jb.sim.prepare(
            robot, controller, replace(jb.sim.own_options(robot, self.gait), dt=dt, backend=backend)
        )
        self.duration = watch_time(controller, 1)

    def run(
        self, corners: np.ndarray, friction: float, loads: Sequence[float], times: Sequence[float]
    ) -> Columns:
        """Every load at every time: with success, peak roll and pitch [deg]."""
        began, cells = time.monotonic(), np.array(list(itertools.product(loads, times)))
        worlds = jax.vmap(self._world, (None, 0, 0))(friction, *map(jnp.asarray, cells.T))
        own = eqx.tree_at(lambda s: s.robot.p_sole_corner, self.simulation, jnp.asarray(corners))
        walks = own.run_many(worlds, self.duration)
        success = jax.vmap(lambda walk, world: judge(walk, self.gait, world).success)(walks, worlds)
        tilt = np.rad2deg(np.asarray(walks.statistics.peak_roll_pitch))
        print(f"    {self.name}: {len(cells)} walks, {time.monotonic() - began:.0f} s", flush=True)
        columns = {"load": cells[:, 0], "time": cells[:, 1], "success": np.asarray(success)}
        return columns | {"roll": tilt[:, 0], "pitch": tilt[:, 1]}

    def _world(self, friction: Any, load: Any, at: Any) -> jb.sim.Scenario:
        return eqx.tree_at(
            lambda s: (s.ground.friction, s.payload.mass, s.payload.time),
            jb.sim.Scenario.flat(1),
            (jnp.asarray(friction), load, at + self.gait.clock_start),
        )


def sole(toe: float, heel: float, half_width: float) -> np.ndarray:
    """Corners of both soles (2, 4, 3) [m]."""
    one = [[x, y, 0.0] for x in (toe, heel) for y in (half_width, -half_width)]
    return np.array([one, one])


class Toes(NamedTuple):
    """With which toes Table 4.1 is as printed, by halving: a longer toe carries more."""

    shortest: float
    """With which 2.5 kg is carried at all times [m]."""
    longest: float
    """With which 5 kg falls at all times [m]; shorter than `shortest` where no toe does both."""
    right: int
    """Cells of Table 4.1 that are as printed with the longest one, of 2 len(OFF_TIMES)."""


def toes_as_printed(walker: Walker, half_width: float, friction: float, heel: float) -> Toes:
    """Look for the toes of one floor."""

    @cache
    def right(number: int, load: float) -> int:
        corners = sole(toe_of(number), heel, half_width)
        return int(np.sum(walker.run(corners, friction, (load,), OFF_TIMES)["success"] == (load <= CARRIED)))

    def all_right(load: float) -> Callable[[int], bool]:
        return lambda number: right(number, load) == len(OFF_TIMES)

    carried, dropped = all_right(CARRIED), all_right(DROPPED)
    most = round((TOES[1] - TOES[0]) / FINE)
    shortest = first(carried, most + 1)
    longest = first(lambda number: not dropped(number), most + 1) - 1
    walked = max(longest, 0)
    return Toes(toe_of(shortest), toe_of(longest), right(walked, CARRIED) + right(walked, DROPPED))


def toe_of(number: int) -> float:
    """The toe of a number [m]."""
    return round(TOES[0] + FINE * number, 5)


def first(holds: Callable[[int], bool], end: int) -> int:
    """The first number below the end from which on something holds; the end if it never does."""
    low, high = 0, end
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle + 1, high)
    return low


def as_printed(walks: Columns, number: int) -> tuple[int, int]:
    """Walks whose verdict is that of a table of the thesis, and how many of them are printed there."""
    printed = tables.printed_cells(tables.thesis_table(number))
    cells = [
        (tables.milli(at), tables.milli(load)) for at, load in zip(walks["time"], walks["load"], strict=True)
    ]
    known = [
        (printed[cell], bool(ok)) for cell, ok in zip(cells, walks["success"], strict=True) if cell in printed
    ]
    return sum(a == b for a, b in known), len(known)


def family(
    frictions: Sequence[float], heels: Sequence[float], half_width: float, walker: Callable[[str], Walker]
) -> pl.DataFrame:
    """One row for each friction and heel."""
    off, variants = walker("off"), [walker(name) for name in TABLE]
    rows = []
    for friction, heel in itertools.product(frictions, heels):
        toes = toes_as_printed(off, half_width, friction, heel)
        row: dict[str, Any] = {"friction": friction, "heel_m": heel} | toes._asdict()
        for variant in variants:
            walks = variant.run(sole(toes.longest, heel, half_width), friction, LOADS, TIMES)
            agree, printed = as_printed(walks, TABLE[variant.name])
            probe = (walks["load"] == 15.0) & (walks["time"] == 1.2)
            row |= {
                f"{variant.name}_succeed": int(walks["success"].sum()),
                f"{variant.name}_as_printed": agree,
                f"{variant.name}_printed": printed,
                f"{variant.name}_roll_deg": round(float(np.median(walks["roll"])), 1),
                f"{variant.name}_pitch_15kg_1.2s_deg": round(float(walks["pitch"][probe][0]), 2),
            }
        print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
        rows.append(row)
    return pl.DataFrame(rows)


def draw(table: pl.DataFrame) -> Any:
    """The family over grip, of the first heel."""
    table = table.filter(pl.col("heel_m") == table["heel_m"][0])
    figure, axes = plt.subplots(3, 1, figsize=(7.0, 8.0), sharex=True, layout="constrained")
    for variant, color in zip(TABLE, ("C0", "C1"), strict=True):
        share = table[f"{variant}_as_printed"] / table[f"{variant}_printed"]
        axes[0].plot(
            table["friction"], 100 * share, "o-", color=color, label=f"{variant}, Table 4.{TABLE[variant]}"
        )
        axes[1].plot(table["friction"], table[f"{variant}_roll_deg"], "o-", color=color, label=variant)
    axes[0].set(ylabel="cells as printed [%]", ylim=(0, 102))
    axes[1].set(ylabel="median peak roll [deg]", ylim=(0, None))
    axes[2].fill_between(
        table["friction"],
        1e3 * table["shortest"],
        1e3 * table["longest"],
        where=table["shortest"] <= table["longest"],
        alpha=0.4,
    )
    axes[2].plot(table["friction"], 1e3 * table["longest"], "ko-", label="longest, the one that walks above")
    axes[2].set(ylabel="toes with which Table 4.1\nis as printed [mm]", xlabel="friction of the floor")
    for ax in axes:
        ax.legend(fontsize=8)
        ax.grid(alpha=0.3)
    axes[0].set_title("The thesis' reflex needs a floor that is slippery sideways", fontsize=10)
    return figure


def main() -> None:
    """Walk the family, write it, draw it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frictions", type=float, nargs="+", default=list(FRICTIONS))
    parser.add_argument("--heels", type=float, nargs="+", default=[-0.052], help="[m]")
    parser.add_argument("--half-width", type=float, default=0.065, help="of a sole [m]")
    parser.add_argument("--dt", type=float, default=1e-3, help="physics tick [s]; the tables have 5e-4")
    parser.add_argument("--backend", choices=BACKENDS, default=AUTO, help="c is several times faster")
    parser.add_argument("--out", type=Path, default=Path("runs/calibration"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    walker = partial(Walker, dt=arguments.dt, backend=arguments.backend)
    table = family(arguments.frictions, arguments.heels, arguments.half_width, walker)
    table.write_csv(arguments.out / "family.csv")
    if table.height > 1:
        draw(table).savefig(arguments.out / "family.png", dpi=110)
    with pl.Config(tbl_rows=-1, tbl_cols=-1, tbl_width_chars=200):
        print(table)


if __name__ == "__main__":
    main()

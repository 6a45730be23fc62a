"""The payload reflexes on floors of every grip: the thesis' grid and heavier loads, other robots, false starts.

The numbers of `two_speed` were chosen by hand, on the times up to 2.8 s of the grid, on floors of 0.8 and 0.12. Not
chosen on: later times, the other floors, other robots at times between the grid's, and walks without a load, in which
no reflex may start.

    python sweeps/payload_floors.py --out runs/payload_floors
"""

import argparse
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import tuned

import jaxbiped as jb
from jaxbiped.adapt import Controller, PayloadReflex
from jaxbiped.adapt.reflex import standing_zmp
from jaxbiped.batch import Normal, Uniform, summary
from jaxbiped.report import grids
from jaxbiped.sim.options import C_MUJOCO

BEST = "two_speed"
VARIANTS = ("modified", "repaired", BEST)
FLOORS = (0.09, 0.1, 0.12, 0.2, 0.3, 0.5, 0.8, 1.0)
"""Friction."""
LOADS = (2.5, 5.0, 7.5, 10.0, 12.5, 15.0, 17.5, 20.0, 22.5, 25.0)
"""The thesis' up to 15, and heavier ones [kg]."""
TIMES = tuple(round(0.1 * i, 1) for i in range(1, 49))
"""The thesis' time [s]."""
STEPS = 7
MEANS = (pl.col("peak_pitch_deg"), pl.col("peak_roll_deg"))
MAPS = {"success": None, "peak_pitch": "peak_pitch_deg", "peak_roll": "peak_roll_deg"}
DRAWN_FLOORS = (0.12, 0.8)
BANDS = ((0.0, 10.0), (10.0, 15.0), (15.0, 20.0), (20.0, 25.0))
"""Of loads [kg]."""


def others(n: int, seed: int, **more: Any) -> pl.DataFrame:
    """Robots and floors further off."""
    return jb.batch.draw(
        n,
        seed,
        friction=Uniform(0.1, 1.0),
        trunk_mass_scale=Uniform(0.95, 1.05),
        leg_mass_scale=Uniform(0.95, 1.05),
        com_x_m=Normal(0.0, 0.002),
        com_y_m=Normal(0.0, 0.002),
        gain_scale=Uniform(0.8, 1.25),
        delay_s=Uniform(0.0, 0.002),
        force_noise_N=Uniform(0.0, 2.0),
        **more,
    )


def by_floor(table: pl.DataFrame, variants: Iterable[str] = VARIANTS) -> str:
    """Successes on every floor: of the thesis' loads, of heavier ones, of 20 kg."""
    light = pl.col("load_kg") <= 15.0
    parts = {"up to 15 kg": light, "17.5 to 25 kg": ~light, "20 kg": pl.col("load_kg") == 20.0}
    lines = ["friction | " + " | ".join(f"{v}: {', '.join(parts)}" for v in variants)]
    for floor, walks in table.group_by("friction", maintain_order=True):
        cells = []
        for variant in variants:
            mine = walks.filter(pl.col("variant") == variant)
            rows = [mine.filter(part)["success"] for part in parts.values()]
            cells.append(", ".join(f"{row.sum()} of {row.len()}" for row in rows))
        lines.append(f"{floor[0]:g} | " + " | ".join(cells))
    return "\n".join(lines)


def felt(table: pl.DataFrame) -> str:
    """By load, how many walks of the best variant start a reflex, and how long after the load."""
    lines = []
    for load, walks in table.filter(pl.col("variant") == BEST).group_by("load_kg", maintain_order=True):
        after = (walks["trigger_s"] - walks["load_time_s"]).drop_nulls().to_numpy()
        least, middle, most = np.quantile(after, (0.0, 0.5, 1.0))
        lines.append(
            f"  {load[0]:g} kg: {len(after)} of {walks.height} start a reflex, "
            f"{least:.3f} to {most:.3f} s after the load, median {middle:.3f}"
        )
    return "\n".join(lines)


def without(robot: Any, gait: Any) -> dict[str, Controller]:
    """The best variant without one of its parts each, and the others with its lean."""
    less: dict[str, dict[str, Any]] = {
        "whole": {},
        "no step": {"quick_step": 0.0},
        "no longer than the plan's": {"longest_step": float(2.0 * gait.params.b_s)},
        "body not behind": {"behind": 0.0},
        "body in 0.3 s": {"body_time": 0.3},
        "no lean": {"zmp_balanced": standing_zmp(robot, gait)},
    }
    made = {name: PayloadReflex.named(BEST, robot, gait, **numbers) for name, numbers in less.items()}
    lean = {"zmp_balanced": made["whole"].zmp_balanced}
    leaning = {f"{v}, leaning": PayloadReflex.named(v, robot, gait, **lean) for v in VARIANTS if v != BEST}
    return {name: Controller(gait, params) for name, params in {**made, **leaning}.items()}


def compare_with_c(table: pl.DataFrame, one: jb.batch.Experiment, n: int, out: Path) -> None:
    """Walk random cells of the best variant in C MuJoCo with its own contacts, and count equal verdicts."""
    ours = table.filter(pl.col("variant") == BEST).sample(min(n, table.height), seed=1).sort("row")
    cells = ours.select(one.table.columns)
    options = replace(one.options, contact=C_MUJOCO)
    again = jb.batch.Experiment(one.robot, {BEST: one.variants[BEST]}, cells, options)
    theirs = jb.batch.run(again, out, 1, overwrite=True, progress=jb.batch.show())
    equal = (ours["success"] == theirs["success"]).to_numpy()
    low, high = summary.wilson(int(equal.sum()), len(equal))
    print(
        f"\nC MuJoCo with its own contacts, {len(equal)} random cells of {BEST}: {equal.sum()} verdicts equal "
        f"({equal.mean():.1%}, {low:.1%} to {high:.1%}); {ours['success'].sum()} succeed here, "
        f"{theirs['success'].sum()} there"
    )
    for low, high in BANDS:
        band = ours["load_kg"].is_between(low, high, closed="right").to_numpy()
        print(f"  {low:g} to {high:g} kg: {equal[band].sum()} of {band.sum()}")
    for i in (~equal).nonzero()[0]:
        load, clock, friction = (cells[name][int(i)] for name in ("load_kg", "load_time_s", "friction"))
        here, there = ours["status"][int(i)], theirs["status"][int(i)]
        since = theirs["end_time_s"][int(i)] - (theirs["trigger_s"][int(i)] or np.nan)
        print(
            f"  {load:g} kg at {clock:.1f} s, friction {friction:g}: {here} here, {there} there, "
            f"{since:.1f} s after the last of {theirs['reflexes'][int(i)]} reflexes"
        )


def main() -> None:
    """Walk, print, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/payload_floors"))
    parser.add_argument("--floors", type=float, nargs="+", default=FLOORS, help="frictions")
    parser.add_argument("--n", type=int, default=512, help="other robots and floors")
    parser.add_argument("--unloaded", type=int, default=1000, help="walks without a load")
    parser.add_argument("--c", type=int, default=100, help="cells in C MuJoCo")
    parser.add_argument("--workers", type=int)
    arguments = parser.parse_args()
    robot = jb.robot.load("elkahlout")
    gait = jb.planner.CosineGait.preset(robot, STEPS)
    variants = {name: Controller(gait, getattr(PayloadReflex, name)(robot, gait)) for name in VARIANTS}
    start, options = float(gait.clock_start), jb.sim.own_options(robot, gait)
    pairs = [(BEST, other) for other in VARIANTS if other != BEST]

    def tried(what: str, scenarios: pl.DataFrame, name: str) -> pl.DataFrame:
        one = jb.batch.Experiment(robot, variants, scenarios, options)
        return tuned.try_variants(what, one, arguments.out / name, arguments.workers, pairs, MEANS)

    times = [start + t for t in TIMES]
    grid = jb.batch.grid(friction=arguments.floors, load_kg=LOADS, load_time_s=times)
    table = tried("the thesis' grid and heavier loads, on every floor", grid, "grid")
    everywhere = jb.batch.Experiment(robot, variants, grid, options)
    print(by_floor(table))
    print(felt(table))
    for floor in set(DRAWN_FLOORS) & set(arguments.floors):
        for name, value in MAPS.items():
            figure = grids.heat_map(
                table.filter(pl.col("friction") == floor),
                "load_kg",
                "load_time_s",
                f"elkahlout, friction {floor:g}: {name.replace('_', ' ')}",
                value=value,
                offset_s=start,
            )
            figure.savefig(arguments.out / f"{name}_{floor:g}.png", dpi=110)
    parts = without(robot, gait)
    grid = jb.batch.grid(friction=DRAWN_FLOORS, load_kg=LOADS, load_time_s=times[: len(times) // 2])
    one = jb.batch.Experiment(robot, parts, grid, options)
    lesser = jb.batch.run(
        one, arguments.out / "without", arguments.workers, overwrite=True, progress=jb.batch.show()
    )
    print(f"\nwithout one part each, at the first half of the times\n{by_floor(lesser, parts)}")
    compare_with_c(table, everywhere, arguments.c, arguments.out / "c")
    between = others(
        arguments.n, 4321, load_kg=Uniform(2.0, 25.0), load_time_s=Uniform(start + 0.1, start + 4.8)
    )
    table = tried("other robots and floors, at times between the grid's", between, "others")
    for low, high in BANDS:
        walks = table.filter(pl.col("load_kg").is_between(low, high, closed="right"))
        counts = walks.group_by("variant", maintain_order=True).agg(pl.col("success").sum(), n=pl.len())
        print(
            f"  {low:g} to {high:g} kg: "
            + ", ".join(f"{v} {good} of {n}" for v, good, n in counts.iter_rows())
        )
    table = tried("no load", others(arguments.unloaded, 5678), "unloaded")
    for variant in VARIANTS:
        walks = table.filter(pl.col("variant") == variant)
        print(
            f"  {variant}: {walks.filter(pl.col('reflexes') > 0).height} false starts in {walks.height} walks"
        )


if __name__ == "__main__":
    main()

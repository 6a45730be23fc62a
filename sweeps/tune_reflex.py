"""Tune elkahlout's payload reflex, and say what that buys under loads, times, masses and frictions not tuned on.

Tuned on random loads, times, frictions and trunk masses, in two rounds: the reflex by walks that end while the robot
stands and settles, for most falls come then; after that the shift of x_ref by whole walks. Tried on the thesis' grid,
on heavier loads, and on robots and grounds further off.

    python sweeps/tune_reflex.py --out runs/tune_reflex
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import tuned

import jaxbiped as jb
from jaxbiped.adapt import Controller, PayloadReflex
from jaxbiped.batch import Uniform
from jaxbiped.commands.choices import load_variant, variant_tables
from jaxbiped.commands.tune import VARIANT_FILE, descend
from jaxbiped.report import grids
from jaxbiped.tune import Problem, Settings

STARTS = ("modified", "repaired")
TUNE_STEPS, TRY_STEPS = 4, 7
"""Steps of the walks that are tuned on, and of those of the thesis' grid."""
REFLEX = (
    *(
        f"payload.x_{foot}_{phase}"
        for phase in ("left_swings", "right_swings", "both_stand")
        for foot in ("left", "right")
    ),
    "payload.reflex_time",
)
SHIFT = ("payload.x_ref_gain", "payload.zmp_balanced")


class Round(NamedTuple):
    """One descent; the next one starts where it ended."""

    names: tuple[str, ...]
    """What is tuned."""
    horizon: float
    """Of the walks whose gradient is taken [s]."""
    held_out: float | None
    """Of the walks that say which values are best [s]; None: until their verdict."""
    scenarios: int
    rate: float
    sigma: float
    """Of the smoothing, as a share of each range."""
    steps: int


ROUNDS = (Round(REFLEX, 9.5, 9.5, 128, 0.15, 0.03, 25), Round(SHIFT, 21.0, None, 96, 0.03, 0.01, 8))
"""Within 9.5 s most falls happen, and no robot walks on yet, so none of these walks has a verdict: success 0 %. In the
second round millimeters decide: the plan's ZMP is 1.6 mm inside the sole."""
TIMES = tuple(round(0.1 * i, 1) for i in range(1, 49))
"""The thesis' time [s]."""
GRIDS = {"the thesis' grid": (2.5, 5.0, 7.5, 10.0, 12.5, 15.0), "heavier": (17.5, 20.0, 22.5, 25.0)}
"""[kg]"""
MEANS = (pl.col("peak_pitch_deg"), pl.col("peak_roll_deg"), pl.col("end_time_s"))


def controllers(robot: Any, names: Sequence[str], steps: int) -> dict[str, Controller]:
    """The variants it starts from."""
    gait = jb.planner.CosineGait.preset(robot, steps)
    return {name: Controller(gait, getattr(PayloadReflex, name)(robot, gait)) for name in names}


def to_tune_on(
    robot: Any, variant: Controller, n: int, seed: int, duration: float | None = None
) -> jb.batch.Experiment:
    """Loads up to a fifth of the robot, at any time of its first step and a half."""
    gait = variant.gait
    last = float(gait.timing.first_liftoff) + 1.5 * float(gait.timing.T_c)
    scenarios = jb.batch.draw(
        n,
        seed,
        load_kg=Uniform(1.0, 18.0),
        load_time_s=Uniform(float(gait.clock_start) + 0.05, last),
        friction=Uniform(0.6, 1.0),
        trunk_mass_scale=Uniform(0.96, 1.04),
    )
    options = jb.sim.own_options(robot, gait)
    return jb.batch.Experiment(robot, {"variant": variant}, scenarios, options, duration=duration)


def to_try_on(start: float) -> dict[str, pl.DataFrame]:
    """By name, scenarios that no descent sees."""
    found = {
        name: jb.batch.grid(load_kg=loads, load_time_s=[start + t for t in TIMES])
        for name, loads in GRIDS.items()
    }
    found["other robots and grounds"] = jb.batch.draw(
        192,
        777,
        load_kg=Uniform(2.0, 25.0),
        load_time_s=Uniform(start + 0.1, start + 4.8),
        friction=Uniform(0.4, 1.2),
        trunk_mass_scale=Uniform(0.92, 1.08),
        leg_mass_scale=Uniform(0.92, 1.08),
        com_x_m=Uniform(-0.01, 0.01),
        gain_scale=Uniform(0.8, 1.25),
        delay_s=Uniform(0.0, 0.004),
    )
    return found


def tune_from(name: str, robot: Any, start: Controller, arguments: argparse.Namespace) -> Path:
    """Both rounds; the file of the variant."""
    tables: Any = {"payload": {"base": name}}
    variant, file = start, Path()
    for number, one in enumerate(ROUNDS):
        print(
            f"{name}, round {number + 1}: {len(one.names)} tunables by walks of {one.horizon:g} s", flush=True
        )
        problem = Problem.of(to_tune_on(robot, variant, one.scenarios, 1 + number, one.horizon), one.names)
        held_out = to_tune_on(robot, variant, arguments.held_out, 1001 + number, one.held_out)
        steps = arguments.steps or one.steps
        settings = Settings(
            steps=steps, scenarios=arguments.batch, rate=one.rate, sigma=one.sigma, patience=10
        )
        out = arguments.out / f"{name}_{number + 1}"
        descend(problem, held_out, settings, tables, out, "python sweeps/tune_reflex.py")
        file = out / VARIANT_FILE
        tables, variant = variant_tables("--start", file), load_variant("--start", file, robot, start.gait)
    return file


def main() -> None:
    """Tune from every start, try every variant."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/tune_reflex"))
    parser.add_argument(
        "--start", nargs="+", choices=STARTS, default=STARTS[:1], help="variants to start from"
    )
    parser.add_argument("--held-out", type=int, default=64, help="scenarios that say when to stop")
    parser.add_argument("--batch", type=int, default=24, help="scenarios in a step")
    parser.add_argument("--steps", type=int, help="of each round, instead of its own number")
    parser.add_argument("--workers", type=int)
    arguments = parser.parse_args()
    robot = jb.robot.load("elkahlout")
    short, variants = (controllers(robot, arguments.start, steps) for steps in (TUNE_STEPS, TRY_STEPS))
    for name in arguments.start:
        file = tune_from(name, robot, short[name], arguments)
        variants[f"tuned_{name}"] = load_variant("--start", file, robot, variants[name].gait)
    pairs = [(f"tuned_{name}", name) for name in arguments.start]
    gait = variants[arguments.start[0]].gait
    start, options = float(gait.clock_start), jb.sim.own_options(robot, gait)
    for number, (what, scenarios) in enumerate(to_try_on(start).items()):
        one = jb.batch.Experiment(robot, variants, scenarios, options)
        out = arguments.out / f"tried_{number}"
        table = tuned.try_variants(what, one, out, arguments.workers, pairs, MEANS)
        if what in GRIDS:
            figure = grids.heat_map(
                table, "load_kg", "load_time_s", f"elkahlout, {what}: success", offset_s=start
            )
            figure.savefig(arguments.out / f"success_{number}.png", dpi=110)
            print(summary_by_load(table))
    for name in arguments.start:
        grid = jb.batch.grid(load_kg=10.0, load_time_s=[start + t for t in TIMES])
        one = jb.batch.Experiment(robot, {name: variants[name]}, grid, options, duration=ROUNDS[0].horizon)
        title, file = f"elkahlout, variant {name}, 10 kg", arguments.out / f"sensitivity_{name}.png"
        tuned.sensitivity(
            Problem.of(one, REFLEX), np.array(TIMES), "the thesis' time of the load [s]", title, file
        )


def summary_by_load(table: pl.DataFrame) -> str:
    """Successes by load, one line for each variant."""
    counts = table.group_by("variant", "load_kg", maintain_order=True).agg(
        pl.col("success").sum(), n=pl.len()
    )
    lines = []
    for walks in counts.partition_by("variant", maintain_order=True):
        by = ", ".join(f"{load:g} kg {good}/{n}" for _, load, good, n in walks.sort("load_kg").iter_rows())
        lines.append(f"  {walks['variant'][0]:18s} {by}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()

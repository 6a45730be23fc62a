"""4,096 random scenarios with pads, loads, friction, soft ground, pushes, sensor faults and model errors at once.

Both variants walk the same scenarios: 2,048 by default, so 4,096 walks. A Latin hypercube over all inputs.

    python sweeps/random_world.py --robot surena3 --out runs/random_world
"""

import argparse
import resource
import time
from pathlib import Path
from typing import Any

import polars as pl

import jaxbiped as jb
from jaxbiped.adapt import Controller, Landing, PayloadReflex
from jaxbiped.batch import Choice, Normal, Uniform, height_column, summary
from jaxbiped.report import overview, page

STEPS = {"surena3": 10, "elkahlout": 4}
PADS = {"surena3": (2, 5, 7), "elkahlout": (1,)}
"""Steps that may have a pad."""
HEIGHTS = {"surena3": (-0.03, -0.015, 0.0, 0.0, 0.015, 0.03), "elkahlout": (-0.005, 0.0, 0.0, 0.005)}
"""[m]"""
LOADS = {"surena3": 10.0, "elkahlout": 15.0}
"""Heaviest load [kg]."""


def experiment(name: str, n: int, seed: int, duration: float | None) -> jb.batch.Experiment:
    """One robot, without and with both stages of adaptation."""
    robot = jb.robot.load(name)
    gait = jb.planner.own_gait(robot, STEPS[name])
    walk = float(gait.duration)
    pads: dict[str, Any] = {height_column(step): Choice(HEIGHTS[name]) for step in PADS[name]}
    scenarios = jb.batch.draw(
        n,
        seed,
        **pads,
        load_kg=Uniform(0.0, LOADS[name]),
        load_time_s=Uniform(0.1 * walk, 0.7 * walk),
        friction=Uniform(0.3, 1.0),
        sinkage_m=Uniform(1e-4, 4e-4),
        trunk_mass_scale=Normal(1.0, 0.02),
        leg_mass_scale=Normal(1.0, 0.02),
        com_x_m=Normal(0.0, 0.004),
        com_y_m=Normal(0.0, 0.004),
        gain_scale=Uniform(0.8, 1.2),
        delta_z_m=Uniform(0.008, 0.012),
        force_noise_N=Uniform(0.0, 2.0),
        delay_s=Uniform(0.0, 0.004),
        push_y_N=Normal(0.0, 20.0),
        push_time_s=Uniform(0.1 * walk, 0.9 * walk),
        push_length_s=0.1,
    )
    reflex = PayloadReflex.repaired(robot, gait)
    variants = {
        "off": Controller(gait),
        "repaired": Controller(gait, Landing.repaired(), reflex),
    }
    return jb.batch.Experiment(robot, variants, scenarios, jb.sim.Options(), duration=duration, seed=seed)


def main() -> None:
    """Walk, print what fails and why."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", choices=list(STEPS), default="surena3")
    parser.add_argument("--n", type=int, default=2048, help="scenarios; each is walked with two variants")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--duration", type=float, help="of every walk [s]; default: as long as the longest recovery needs"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/random_world"))
    parser.add_argument("--workers", type=int)
    parser.add_argument("--overwrite", action="store_true")
    arguments = parser.parse_args()
    one = experiment(arguments.robot, arguments.n, arguments.seed, arguments.duration)
    began = time.perf_counter()
    table = jb.batch.run(one, arguments.out, arguments.workers, None, arguments.overwrite, jb.batch.show())
    took = time.perf_counter() - began
    with pl.Config(tbl_rows=-1, tbl_cols=-1, tbl_width_chars=140):
        print(summary.cells(table))
        print(table.group_by("variant", "status").len().sort("variant", "status"))
        print(summary.causes(table).group_by("variant", maintain_order=True).head(6))
    page.write_page(
        arguments.out / "report.html",
        f"{arguments.robot} in a random world",
        overview.sections(one, table, folder=arguments.out),
    )
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
    print(
        f"{table.height} walks, {one.ticks:,} physics ticks in {took:.0f} s: {one.ticks / took:,.0f} a second"
    )
    print(f"largest peak memory of a worker {peak:,.0f} MiB")


if __name__ == "__main__":
    main()

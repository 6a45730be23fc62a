"""surena3 over obstacles and holes from -5 to +5 cm, single and as in khadiv's experiment, by off, paper, repaired.

A single pad lies under step 4. khadiv's experiment has three obstacles in one walk, under steps 2, 4 and 6: here of
every height at once, and of 3, 2 and 4 cm. Figures 10 to 13 of the paper are drawn for --replay rows.

    python sweeps/obstacles.py --out runs/obstacle_sweep
"""

import argparse
import time
from pathlib import Path

import polars as pl

import jaxbiped as jb
from jaxbiped.adapt import Controller, Landing
from jaxbiped.batch import height_column
from jaxbiped.commands import replay
from jaxbiped.report import grids, overview, page

STEPS, SINGLE, SEVERAL = 8, 4, (2, 4, 6)
"""Of the walk; the one with the single pad; those of khadiv's experiment."""
HEIGHTS = tuple(round(0.005 * i, 3) for i in range(-10, 11))
"""[m]"""
KHADIV = (0.03, 0.02, 0.04)
"""Heights of khadiv's three obstacles [m]; assumed, the paper's figures do not say."""


def scenarios() -> pl.DataFrame:
    """Single pads, then three of the same height, then khadiv's."""
    names = [height_column(step) for step in SEVERAL]
    single = pl.DataFrame({height_column(SINGLE): HEIGHTS})
    several = pl.DataFrame({name: [h for h in HEIGHTS if h] for name in names})
    khadiv = pl.DataFrame(dict(zip(names, ([h] for h in KHADIV), strict=True)))
    return pl.concat([single, several, khadiv], how="diagonal").fill_null(0.0).select(names)


def experiment() -> jb.batch.Experiment:
    """All of them with every variant."""
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, STEPS)
    variants = {
        "off": Controller(gait),
        "paper": Controller(gait, Landing.paper()),
        "repaired": Controller(gait, Landing.repaired()),
    }
    return jb.batch.Experiment(robot, variants, scenarios())


def main() -> None:
    """Walk, print, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/obstacle_sweep"))
    parser.add_argument("--workers", type=int)
    parser.add_argument("--overwrite", action="store_true")
    parser.add_argument(
        "--replay", type=int, nargs="*", help="rows to walk again; default: khadiv's, repaired"
    )
    arguments = parser.parse_args()
    one, began = experiment(), time.perf_counter()
    table = jb.batch.run(one, arguments.out, arguments.workers, None, arguments.overwrite, jb.batch.show())
    took = time.perf_counter() - began
    singles, force = len(HEIGHTS), pl.max_horizontal("peak_force_left_N", "peak_force_right_N")
    shown = table.with_columns(peak_force_N=force.round(0)).select(
        "variant",
        *(height_column(step) for step in SEVERAL),
        "status",
        "end_time_s",
        "peak_force_N",
        "peak_roll_deg",
    )
    with pl.Config(tbl_rows=-1, tbl_cols=-1, tbl_width_chars=120):
        print(shown)
    for name, rows in {
        "single": pl.col("scenario") < singles,
        "three": pl.col("scenario") >= singles,
    }.items():
        figure = grids.cells_figure(
            table.filter(rows), height_column(SINGLE), f"surena3: {name} pads, by height under step {SINGLE}"
        )
        figure.savefig(arguments.out / f"{name}.png", dpi=110)
    page.write_page(
        arguments.out / "report.html",
        "surena3 over unknown pads",
        overview.sections(one, table, folder=arguments.out),
    )
    print(f"{table.height} walks in {took:.0f} s")
    last = one.rows - 1  # khadiv's, with the last variant
    for row in [last] if arguments.replay is None else arguments.replay:
        replay.run(replay.Replay(arguments.out, row, arguments.out / f"row_{row}"))


if __name__ == "__main__":
    main()

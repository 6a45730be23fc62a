"""surena3 over obstacles and holes from -5 to +5 cm, single and as in khadiv's experiment, by off, paper, repaired.

The walks are said in `obstacles.toml`: single obstacles under step 4, and three in one walk. Figures 10 to 13 of the
paper are drawn for --replay rows.

    python sweeps/obstacles.py --out runs/obstacle_sweep
"""

import argparse
import time
from pathlib import Path

import polars as pl

import jaxbiped as jb
from jaxbiped.batch import height_column
from jaxbiped.commands import replay
from jaxbiped.report import grids, overview, page

EXPERIMENT = Path(__file__).with_suffix(".toml")
SEVERAL, MIDDLE = (2, 4, 6), 4
"""Steps with an obstacle; the one that has the single ones."""


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
    one, began = jb.batch.read_experiment(EXPERIMENT), time.perf_counter()
    table = jb.batch.run(one, arguments.out, arguments.workers, None, arguments.overwrite, jb.batch.show())
    took = time.perf_counter() - began
    force = pl.max_horizontal("peak_force_left_N", "peak_force_right_N")
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
    several = pl.col(height_column(SEVERAL[0])) != 0.0
    for name, rows in {
        "single": ~several,
        "three": several,
    }.items():
        figure = grids.cells_figure(
            table.filter(rows), height_column(MIDDLE), f"surena3: {name} pads, by height under step {MIDDLE}"
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

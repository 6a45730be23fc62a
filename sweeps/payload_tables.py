"""The thesis' Tables 4.1, 4.2, 4.3 in full: 48 loading times x 6 loads, without reflex, original and modified reflex.

The walks are said in `payload_tables.toml`. On Table 4.1 elkahlout's toe and heel were calibrated, on 4.2 and 4.3 the
floor's grip, one number; where the failures of the last two lie is a prediction.

    python sweeps/payload_tables.py --out runs/payload_tables
"""

import argparse
import time
from pathlib import Path

import polars as pl

import jaxbiped as jb
from jaxbiped.report import grids, overview, page, tables

EXPERIMENT = Path(__file__).with_suffix(".toml")


def write_csv(walks: pl.DataFrame, start: float, file: Path) -> None:
    """One variant as the thesis prints it: a row for each time, a column for each load, 1 for a success."""
    clocked = walks.with_columns(
        time_s=(pl.col("load_time_s") - start).round(3), success=pl.col("success").cast(int)
    )
    clocked.pivot("load_kg", index="time_s", values="success").sort("time_s").write_csv(file)


def main() -> None:
    """Walk, print beside the thesis' tables, count, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/payload_tables"))
    parser.add_argument("--workers", type=int)
    parser.add_argument("--overwrite", action="store_true")
    arguments = parser.parse_args()
    one, began = jb.batch.read_experiment(EXPERIMENT), time.perf_counter()
    table = jb.batch.run(one, arguments.out, arguments.workers, None, arguments.overwrite, jb.batch.show())
    took, start = time.perf_counter() - began, overview.clock_start(one)
    for variant, number in overview.THESIS.items():
        walks = table.filter(pl.col("variant") == variant)
        print(tables.beside_thesis(walks, number, start))
        write_csv(walks, start, arguments.out / f"table_4_{number}.csv")
    for variant, agreed in overview.agreements(one, table).items():
        print(overview.agreement_in_words(variant, agreed))
    marks = {variant: tables.thesis_table(number) for variant, number in overview.THESIS.items()}
    for name, value in (("success", None), ("pitch", "peak_pitch_deg")):
        figure = grids.heat_map(
            table, "load_kg", "load_time_s", f"elkahlout: {name}", marks, value, offset_s=start
        )
        figure.savefig(arguments.out / f"{name}.png", dpi=110)
    page.write_page(
        arguments.out / "report.html",
        "The thesis' tables 4.1 to 4.3",
        overview.sections(one, table, folder=arguments.out),
    )
    ticks = one.ticks
    print(f"{table.height} walks, {ticks:,} physics ticks in {took:.0f} s: {ticks / took:,.0f} a second")


if __name__ == "__main__":
    main()

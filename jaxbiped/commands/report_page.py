"""`jaxbiped report`: one self-contained page of a results table."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from jaxbiped import batch
from jaxbiped.batch import summary
from jaxbiped.commands import batches
from jaxbiped.commands.common import InputError, figures_module, refusing


@dataclass(frozen=True)
class Report:
    """Make one HTML page, with tables and figures in it, of a folder that a batch was run in."""

    table: Annotated[Positional[Path], arg(metavar="TABLE")]
    """Folder that a batch was run in, or the table.parquet in it; may be unfinished."""
    out: Path | None = None
    """The page (.html). Default: report.html in the folder."""
    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Report) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    figures_module()
    from jaxbiped.report import overview, page

    try:
        experiment, table = batch.open_table(command.table)
    except batch.StoreError as error:
        raise InputError(str(error)) from None
    folder = command.table.parent if command.table.is_file() else command.table
    out = command.out or folder / "report.html"
    if out.suffix != ".html":
        raise InputError(f"--out: got '{out}', allowed: a file name that ends in .html")
    sections = overview.sections(experiment, table)
    with refusing(out, "a file that can be written"):
        page.write_page(out, f"{experiment.robot.name}: {table.height} walks", sections)
    print("\n".join(batches.rates(table)))
    agreed = overview.agreements(experiment, table)
    print(
        "\n".join(overview.agreement_in_words(arm, one) for arm, one in agreed.items()),
        end="\n" if agreed else "",
    )
    print(f"page in {out}")
    return {
        "page": str(out),
        "arms": summary.cells(table).to_dicts(),
        "agreement": {arm: [one.agree, one.compared] for arm, one in agreed.items()},
    }

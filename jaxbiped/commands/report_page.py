"""`jaxbiped report`: one self-contained page of a results table."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from jaxbiped import batch, files
from jaxbiped.batch import records, summary
from jaxbiped.commands import batches
from jaxbiped.commands.common import (
    OVERWRITE_HELP,
    InputError,
    figures_module,
    make_writable,
    refusing,
    require_folder,
    say,
)


@dataclass(frozen=True)
class Report:
    """Make one HTML page, with tables and figures in it, of a folder that a batch was run in."""

    table: Annotated[Positional[Path], arg(metavar="TABLE")]
    """Folder that a batch was run in, or the table.parquet in it; may be unfinished."""
    out: Path | None = None
    """The page (.html). Default: report.html in the folder."""
    overwrite: Annotated[bool, arg(help=OVERWRITE_HELP)] = False
    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Report) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    try:
        experiment, table = batch.open_table(command.table, say)
    except batch.StoreError as error:
        raise InputError(str(error)) from None
    folder = command.table.parent if files.is_file(command.table) else command.table
    out = command.out or folder / "report.html"
    if out.suffix != ".html":
        raise InputError(f"--out: got '{out}', allowed: a file name that ends in .html")
    require_folder(out.parent, out)
    key = records.digest(experiment.resolved)
    if os.path.lexists(out) and not command.overwrite and not is_of(out, key):
        raise InputError(
            f"--out: got '{out}', which is there already and no page of this table, allowed: another file, or "
            "--overwrite"
        )
    print("\n".join([*batches.rates(table), *batches.again(table, folder)]), flush=True)
    if figures_module() is None:
        raise ImportError("a page needs matplotlib and jinja2: pip install 'jaxbiped[viz]'")
    from jaxbiped.report import overview, page

    make_writable(out.parent)
    sections = overview.sections(experiment, table, folder=folder)
    with refusing(out, "a file that can be written"):
        page.write_page(out, f"{experiment.robot.name}: {table.height} walks", sections, key)
    agreed = overview.agreements(experiment, table)
    print(
        "\n".join(overview.agreement_in_words(variant, one) for variant, one in agreed.items()),
        end="\n" if agreed else "",
    )
    print(f"page in {out}")
    return {
        "page": str(out),
        "variants": summary.cells(table).to_dicts(),
        "agreement": {variant: [one.agree, one.compared] for variant, one in agreed.items()},
    }


def is_of(file: Path, key: str) -> bool:
    """Tell whether a file says that it is a page of the experiment with this key."""
    try:
        with file.open("rb") as page:
            return key.encode() in page.read(4096)
    except OSError:
        return False

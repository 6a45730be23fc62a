"""One HTML file with words, tables and figures: opens anywhere, loads nothing, runs no script."""

import base64
import functools
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
from matplotlib.figure import Figure

from jaxbiped import files
from jaxbiped.report.figures import png
from jaxbiped.report.quantities import text as shown_text

try:
    import jinja2
except ImportError as error:
    raise ImportError("a page needs jinja2: pip install 'jaxbiped[viz]'") from error

MOST_ROWS = 500
"""Rows of a table that are shown; a line says how many there are."""


@dataclass(frozen=True)
class Picture:
    """A figure and what it shows."""

    figure: Figure | Path
    """A figure, or a PNG file of one."""
    caption: str
    """Caption, also read out where the figure cannot be seen."""


@dataclass(frozen=True)
class Section:
    """A part of a page: its words first, then its figures, then its tables. All text is plain, no HTML."""

    heading: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[pl.DataFrame | str] = ()
    """Frames, or text whose spaces and line ends are kept."""
    figures: Sequence[Picture] = ()


def write_page(path: str | Path, title: str, sections: Sequence[Section], key: str = "") -> Path:
    """Write one self-contained HTML file and return its path; a file that is there already is replaced as a whole.

    Args:
        path: of the file; its folder must exist.
        title: heading of the page.
        sections: from top to bottom.
        key: says what the page is of, to whom reads the file's head; not shown.

    Raises:
        OSError: with the name of the file, when it cannot be written.
    """
    return files.write(path, page(title, sections, key))


def page(title: str, sections: Sequence[Section], key: str = "") -> str:
    """Text of a self-contained HTML file.

    Args:
        title: heading of the page.
        sections: from top to bottom.
        key: says what the page is of, to whom reads the file's head; not shown.
    """
    return _template().render(title=title, sections=sections, key=key)


@functools.cache
def _template() -> jinja2.Template:
    """Read `templates/page.html.j2`, where the HTML and the style of every page stand."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxbiped.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"picture": _picture, "table": _table}
    return environment.get_template("page.html.j2")


def _picture(picture: Picture) -> dict[str, Any]:
    """A picture as the template takes it."""
    content = _png(picture.figure)
    width, height = struct.unpack(">II", content[16:24])  # where every PNG file has its size
    data = base64.b64encode(content).decode("ascii")
    return {"data": data, "width": width, "height": height, "caption": picture.caption}


def _png(figure: Figure | Path) -> bytes:
    return figure.read_bytes() if isinstance(figure, Path) else png(figure)


def _table(table: pl.DataFrame | str) -> dict[str, Any] | str:
    """A table as the template takes it: text as it is, a frame as the words of its cells."""
    if isinstance(table, str):
        return table
    names = table.columns
    return {
        "columns": [{"name": name, "number": table.schema[name].is_numeric()} for name in names],
        "rows": [
            [shown_text(value, name) for value, name in zip(row, names, strict=True)]
            for row in table.head(MOST_ROWS).iter_rows()
        ],
        "height": table.height,
    }

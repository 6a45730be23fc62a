"""One HTML file with words, tables and figures: opens anywhere, loads nothing, runs no script."""

import base64
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import polars as pl
from matplotlib.figure import Figure

from jaxbiped import files
from jaxbiped.report.figures import png
from jaxbiped.report.quantities import text as shown_text

MOST_ROWS = 500
"""Rows of a table that are shown; a line says how many there are."""


@dataclass(frozen=True)
class Picture:
    """A figure and what it shows."""

    figure: Figure | Path
    """A figure, or a PNG file of one."""
    caption: str
    """Also read out where the figure cannot be seen."""


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
    body = [_section(i, section) for i, section in enumerate(sections, 1)]
    parts = [
        _HEAD.format(key=escape(key), title=escape(title), style=_STYLE),
        _contents(sections),
        *body,
        "</main>",
        "</body>",
        "</html>",
    ]
    return "\n".join(part for part in parts if part) + "\n"


_HEAD = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="key" content="{key}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>
{style}
</style>
</head>
<body>
<main>
<h1>{title}</h1>"""

_STYLE = """\
:root { --ink: #24282e; --faint: #626a75; --paper: #fff; --band: #f3f5f8; --line: #d4d9e0; --link: #0060a0; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e7eb; --faint: #9ba4b0; --paper: #16191d; --band: #20252b; --line: #3a414a; --link: #6db6e8; }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.55 system-ui, sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 1.2rem 1rem 4rem; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0.4rem 0 1rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 0.6rem; padding-top: 0.8rem; border-top: 1px solid var(--line); }
p { max-width: 46rem; margin: 0.6rem 0; }
h1, h2, p, figcaption { overflow-wrap: anywhere; }
a { color: var(--link); }
nav ol { margin: 0; padding-left: 1.4rem; }
figure { margin: 1.2rem 0; }
img { display: block; max-width: 100%; height: auto; background: #ffffff; border-radius: 4px; }
figcaption, .note { color: var(--faint); font-size: 0.88rem; margin-top: 0.4rem; max-width: 46rem; }
.wide { overflow-x: auto; margin: 1rem 0; border: 1px solid var(--line); border-radius: 4px; }
pre { margin: 0; padding: 0.7rem 0.9rem; font: 0.8rem/1.35 ui-monospace, Menlo, Consolas, monospace; }
table { border-collapse: collapse; font-size: 0.86rem; font-variant-numeric: tabular-nums; min-width: 100%; }
th, td { padding: 0.3rem 0.7rem; text-align: left; white-space: nowrap; }
th { background: var(--band); border-bottom: 1px solid var(--line); font-weight: 600; }
tbody tr:nth-child(even) { background: var(--band); }
.number { text-align: right; }
@media print {
  :root { --ink: #000000; --faint: #444444; --paper: #ffffff; --band: #f3f3f3; --line: #bbbbbb; --link: #000000; }
  body { font-size: 10.5pt; }
  main { max-width: none; padding: 0; }
  nav { display: none; }
  h2 { break-after: avoid; }
  figure, tr { break-inside: avoid; }
  img { max-height: 23cm; }
  .wide { overflow: visible; border: 0; }
  pre { font-size: 7.5pt; white-space: pre-wrap; }
  table { font-size: 8pt; }
  thead { display: table-header-group; }
}"""


def _contents(sections: Sequence[Section]) -> str:
    """Links to the sections, where there are several."""
    if len(sections) < 2:
        return ""
    items = "\n".join(f'<li><a href="#s{i}">{escape(s.heading)}</a></li>' for i, s in enumerate(sections, 1))
    return f'<nav aria-label="Contents">\n<ol>\n{items}\n</ol>\n</nav>'


def _section(number: int, section: Section) -> str:
    parts = [
        f'<section id="s{number}">',
        f"<h2>{escape(section.heading)}</h2>",
        *(f"<p>{escape(text)}</p>" for text in section.paragraphs),
        *(_picture(picture) for picture in section.figures),
        *(_text(table) if isinstance(table, str) else _table(table) for table in section.tables),
        "</section>",
    ]
    return "\n".join(parts)


def _picture(picture: Picture) -> str:
    content, caption = _png(picture.figure), escape(picture.caption)
    data = base64.b64encode(content).decode("ascii")
    width, height = struct.unpack(">II", content[16:24])  # where every PNG file has its size
    image = f'<img src="data:image/png;base64,{data}" width="{width}" height="{height}" alt="{caption}">'
    return f"<figure>\n{image}\n<figcaption>{caption}</figcaption>\n</figure>"


def _png(figure: Figure | Path) -> bytes:
    return figure.read_bytes() if isinstance(figure, Path) else png(figure)


def _text(text: str) -> str:
    return f'<div class="wide" tabindex="0"><pre>{escape(text)}</pre></div>'


def _table(table: pl.DataFrame) -> str:
    numeric = [dtype.is_numeric() for dtype in table.dtypes]
    head = "".join(
        _cell("th", name, number, ' scope="col"') for name, number in zip(table.columns, numeric, strict=True)
    )
    rows = [
        "<tr>"
        + "".join(
            _cell("td", shown_text(value, name), number)
            for value, name, number in zip(row, table.columns, numeric, strict=True)
        )
        + "</tr>"
        for row in table.head(MOST_ROWS).iter_rows()
    ]
    lines = "\n".join(
        ["<table>", f"<thead><tr>{head}</tr></thead>", "<tbody>", *rows, "</tbody>", "</table>"]
    )
    more = (
        f'\n<p class="note">The first {MOST_ROWS} of {table.height} rows.</p>'
        if table.height > MOST_ROWS
        else ""
    )
    return f'<div class="wide" tabindex="0">\n{lines}\n</div>{more}'


def _cell(tag: str, text: str, number: bool, more: str = "") -> str:
    kind = ' class="number"' if number else ""
    return f"<{tag}{more}{kind}>{escape(text)}</{tag}>"

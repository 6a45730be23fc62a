"""A page is one whole HTML file: balanced, self-contained, and what is written on it stays text."""

import base64
import errno
import math
import os
from html.parser import HTMLParser
from pathlib import Path

import polars as pl
import pytest
from matplotlib.figure import Figure

from jaxbiped.report import page, quantities

VOID = {"meta", "img", "br", "hr", "link"}
HOSTILE = "<script>alert(\"1\")</script> & 'quoted' <img src=x onerror=alert(1)>"


class Reader(HTMLParser):
    """Keeps tags, attributes and text; refuses what is not balanced."""

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[tuple[str, str]] = []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, (tag, self.open)
        self.open.pop()

    def handle_data(self, data):
        self.text.append((self.open[-1] if self.open else "", data))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]

    def said_in(self, tag: str) -> list[str]:
        return [text for inside, text in self.text if inside == tag and text.strip()]


def read(text: str) -> Reader:
    reader = Reader()
    reader.feed(text)
    reader.close()
    assert reader.open == []
    return reader


def figure() -> Figure:
    drawn = Figure(figsize=(2.0, 1.0))
    drawn.subplots().plot([0.0, 1.0])
    return drawn


TABLE = pl.DataFrame(
    {"variant": [HOSTILE, None], "rate": [0.123456789, None], "n": [1234567, 2], "success": [True, False]}
)
SECTIONS = [
    page.Section("One", ["First words.", "Second words."], [TABLE], [page.Picture(figure(), "A line")]),
    page.Section(HOSTILE, [HOSTILE], [f"  {HOSTILE}\n  kept   apart"], [page.Picture(figure(), HOSTILE)]),
]


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("page") / "report.html"
    assert page.write_page(path, f"Title {HOSTILE}", SECTIONS) == path
    return path.read_text(encoding="utf-8")


def test_page_is_balanced_and_has_a_head(written):
    reader = read(written)
    assert written.startswith("<!DOCTYPE html>\n")
    for tag in ("html", "head", "title", "body", "main", "h1"):
        assert len(reader.all(tag)) == 1, tag
    assert reader.all("html")[0]["lang"] == "en"
    metas = reader.all("meta")
    assert {"charset": "utf-8"} in metas
    assert any(m.get("name") == "viewport" for m in metas)
    style = "".join(reader.said_in("style"))
    assert "prefers-color-scheme: dark" in style and "@media print" in style


def test_nothing_is_loaded_and_nothing_runs(written):
    reader = read(written)
    images = [image["src"] or "" for image in reader.all("img")]
    assert len(images) == 2
    for source in images:
        kind, _, data = source.partition(",")
        assert kind == "data:image/png;base64"
        assert base64.b64decode(data, validate=True)[:8] == b"\x89PNG\r\n\x1a\n"
    assert {tag for tag, _ in reader.tags}.isdisjoint({"script", "link", "iframe", "object", "base"})
    for _, attributes in reader.tags:
        assert not any(name.startswith("on") for name in attributes)
        assert (attributes.get("href") or "#").startswith("#")
    style = "".join(reader.said_in("style"))
    assert "url(" not in style and "@import" not in style
    assert "http://" not in written and "https://" not in written


def test_hostile_text_stays_text_wherever_it_stands(written):
    reader = read(written)
    assert "<script" not in written
    assert reader.said_in("h1") == [f"Title {HOSTILE}"] == reader.said_in("title")
    for tag in ("h2", "p", "td", "figcaption", "a"):
        assert HOSTILE in reader.said_in(tag), tag
    assert reader.all("img")[1]["alt"] == HOSTILE


def test_tables_show_every_value_and_text_keeps_its_spaces(written):
    reader = read(written)
    assert reader.said_in("th") == ["variant", "rate", "n", "success"]
    assert reader.said_in("td") == [
        HOSTILE,
        "0.123",
        "1234567",
        "yes",
        quantities.NOTHING,
        quantities.NOTHING,
        "2",
        "no",
    ]
    assert [cell.get("class") for cell in reader.all("td")[:4]] == [None, "number", "number", None]
    assert reader.said_in("pre") == [f"  {HOSTILE}\n  kept   apart"]


def test_words_of_the_template_language_are_words():
    words = "{{ 7 * 6 }} {% if %} {# no #}"
    section = page.Section(
        words, [words], [words, pl.DataFrame({words: [words]})], [page.Picture(figure(), words)]
    )
    reader = read(page.page(words, [section, section], key=words))
    for tag in ("title", "h1", "h2", "a", "p", "pre", "th", "td", "figcaption"):
        assert set(reader.said_in(tag)) == {words}, tag
    assert {"name": "key", "content": words} in reader.all("meta")


def test_contents_lead_to_the_sections(written):
    reader = read(written)
    there = [section["id"] for section in reader.all("section")]
    assert [link["href"] for link in reader.all("a")] == [f"#{name}" for name in there]
    assert len(set(there)) == 2
    assert read(page.page("One section", SECTIONS[:1])).all("nav") == []


def test_long_tables_are_cut_and_say_so():
    rows = page.MOST_ROWS + 7
    reader = read(page.page("Long", [page.Section("Rows", tables=[pl.DataFrame({"i": range(rows)})])]))
    assert len(reader.all("td")) == page.MOST_ROWS
    assert any(f"{page.MOST_ROWS} of {rows}" in text for text in reader.said_in("p"))


def test_a_page_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path):
    path = tmp_path / "report.html"
    page.write_page(path, "Old", [])
    page.write_page(path, "New", [])
    assert read(path.read_text(encoding="utf-8")).said_in("h1") == ["New"]

    class Broken(Figure):
        def savefig(self, *_, **__):
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        page.write_page(path, "Broken", [page.Section("x", figures=[page.Picture(Broken(), "x")])])
    assert read(path.read_text(encoding="utf-8")).said_in("h1") == ["New"]
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


def test_numbers_are_shown_as_their_columns_ask():
    rows = {
        "zmp_margin_m": [-6.035e-08, math.nan, None],
        "peak_pitch_deg": [3.14159, math.inf, -math.inf],
        "load_time_s": [1.5, 1e6, None],
        "n": [1, 2, None],
    }
    reader = read(page.page("Numbers", [page.Section("Rows", tables=[pl.DataFrame(rows)])]))
    assert reader.said_in("td") == [
        *("0.0000", "3.14", "1.500", "1"),
        *("–", "infinite", "never", "2"),
        *("–", "minus infinite", "–", "–"),
    ]


def test_an_interrupted_write_leaves_the_old_page(tmp_path: Path, monkeypatch):
    path = tmp_path / "report.html"
    page.write_page(path, "Old", [])

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("jaxbiped.files.os.fsync", full)
    with pytest.raises(OSError, match=r"report\.html"):
        page.write_page(path, "New", [])
    monkeypatch.undo()
    assert read(path.read_text(encoding="utf-8")).said_in("h1") == ["Old"]
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


def test_a_page_may_be_read_by_whom_the_umask_lets(tmp_path: Path):
    before = os.umask(0o022)
    try:
        path = page.write_page(tmp_path / "report.html", "Page", [])
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o644


def test_the_head_says_what_a_page_is_of(tmp_path: Path):
    path = page.write_page(tmp_path / "report.html", "Page " + 5000 * "x", SECTIONS, key='a"key')
    assert {"name": "key", "content": 'a"key'} in read(path.read_text(encoding="utf-8")).all("meta")
    assert b"a&#34;key" in path.read_bytes()[:400]


def test_a_page_in_a_folder_that_is_not_there_is_named(tmp_path: Path):
    with pytest.raises(OSError, match=r"missing.*report\.html"):
        page.write_page(tmp_path / "missing" / "report.html", "Page", [])

"""What a person is told while something takes long: never nothing, never "inf s left"."""

import io
import json
import time

import pytest

from jaxbiped import batch, runtime
from jaxbiped.batch import progress


class Stream(io.StringIO):
    """Takes notes; a terminal or not."""

    def __init__(self, terminal: bool):
        super().__init__()
        self.terminal = terminal

    def isatty(self) -> bool:
        return self.terminal


@pytest.fixture
def fast(monkeypatch):
    """A second is a hundredth of one."""
    for name in ("FIRST_S", "EVERY_S", "REDRAWN_S"):
        monkeypatch.setattr(progress, name, 0.01)


def said(stream: Stream) -> str:
    return stream.getvalue()


def wait_for(stream: Stream, words: str) -> None:
    until = time.monotonic() + 5.0
    while words not in said(stream):
        assert time.monotonic() < until, said(stream)
        time.sleep(0.005)


@pytest.mark.parametrize("terminal", [True, False])
def test_compiling_is_not_silent(fast, terminal):
    stream = Stream(terminal)
    show = batch.show(stream)
    show(batch.Progress(0, 40, 0, 0.0, None, None))
    wait_for(stream, "0 of 40 walks, compiling and simulating the first chunk for 0 s")
    show(batch.Progress(8, 40, 3, 60.0, 0.5, 64.0))
    wait_for(stream, "8 of 40 walks, 3 failed, 0.5 a second, about 1 min 4 s left")
    show(batch.Progress(40, 40, 5, 100.0, 0.5, 0.0))
    assert "inf" not in said(stream) and "nan" not in said(stream)
    assert said(stream).rstrip().endswith("40 of 40 walks, 5 failed, 0.5 a second")
    length = len(said(stream))
    time.sleep(0.05)
    assert len(said(stream)) == length  # its thread has ended


def test_on_a_terminal_there_is_one_line(fast):
    stream = Stream(True)
    show = batch.show(stream)
    show(batch.Progress(0, 40, 0, 0.0, None, None))
    wait_for(stream, "for 0 s")
    show.close()
    assert said(stream).count("\n") == 1 and said(stream).startswith("\r")


def test_short_runs_are_silent_where_there_is_no_terminal():
    stream = Stream(False)
    show = batch.show(stream)
    show(batch.Progress(0, 2, 0, 0.0, None, None))
    show(batch.Progress(2, 2, 0, 1.0, 2.0, 0.0))
    assert said(stream) == ""


def test_nothing_to_do_says_nothing():
    stream = Stream(True)
    show = batch.show(stream)
    show(batch.Progress(2, 2, 0, 0.0, None, None))
    show.close()
    assert said(stream) == ""


@pytest.mark.parametrize("terminal", [True, False])
def test_waiting_says_what_for(fast, terminal):
    stream = Stream(terminal)
    with batch.waiting("compiling 17 s of walking", stream):
        wait_for(stream, "compiling 17 s of walking: 0 s")
    if terminal:
        assert said(stream).endswith("\r") and "\n" not in said(stream)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache folder of its own."""
    monkeypatch.setattr(runtime, "cache_folder", lambda: tmp_path / "cache" / "jax")
    return tmp_path / "cache"


def test_waiting_says_how_long_it_took_the_last_time(fast, folder, monkeypatch):
    monkeypatch.setattr(progress, "SHORT_S", 0.01)
    with batch.waiting("planning", Stream(False)):
        time.sleep(0.02)
    times = json.loads((folder / "times.json").read_text())
    assert set(times) == {"planning"} and 0.0 <= times["planning"] < 5.0
    (folder / "times.json").write_text('{"planning": 83.0}')
    stream = Stream(False)
    with batch.waiting("planning", stream):
        wait_for(stream, "planning: 0 s (the last time 1 min 23 s)")


@pytest.mark.parametrize("content", ["", "[1]", '{"planning": "long"}', '{"planning": null}', "\0"])
def test_times_that_cannot_be_read_are_none(fast, folder, content):
    folder.mkdir()
    (folder / "times.json").write_text(content)
    stream = Stream(False)
    with batch.waiting("planning", stream):
        wait_for(stream, "planning: 0 s\n")


def test_what_ends_at_once_or_in_an_error_is_not_remembered(fast, folder, monkeypatch):
    with batch.waiting("planning", Stream(False)):
        pass
    monkeypatch.setattr(progress, "SHORT_S", 0.0)
    with pytest.raises(ValueError, match="bad"), batch.waiting("planning", Stream(False)):
        raise ValueError("bad")
    assert not (folder / "times.json").exists()


def test_waiting_says_what_goes_on_and_how_much_is_done(fast, folder):
    stream = Stream(False)
    with batch.waiting("walking 17 s", stream) as told:
        runtime.now("compiling the walk as C")
        wait_for(stream, "walking 17 s: 0 s; compiling the walk as C")
        runtime.now("")
        told(0.25)
        wait_for(stream, "walking 17 s: 0 s, 25 % done")


def test_waiting_ends_with_an_error_too(fast):
    stream = Stream(False)
    with pytest.raises(ValueError, match="bad"), batch.waiting("compiling", stream):
        raise ValueError("bad")
    length = len(said(stream))
    time.sleep(0.05)
    assert len(said(stream)) == length


def test_a_stream_that_nobody_reads_stops_nothing(fast):
    stream = Stream(False)
    stream.close()
    with batch.waiting("compiling", stream):
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.0, "0 s"), (59.4, "59 s"), (61.0, "1 min 1 s"), (7500.0, "2 h 5 min")]
)
def test_durations_are_to_read(seconds, words):
    assert progress.duration(seconds) == words

"""Progress of a run, told now and then, so that nothing long is silent, not even while XLA compiles."""

import contextlib
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import TextIOBase
from pathlib import Path
from typing import TextIO

from jaxbiped import files, runtime

Stream = TextIO | TextIOBase
"""A text file, or what stands in for one."""
BAR = 24
"""Characters of the bar of progress."""
FIRST_S, EVERY_S = 1.5, 30.0
"""Time to the first line where there is no terminal, and between two lines from then on [s]."""
SHORT_S, MOST_KEPT = 3.0, 200
"""What took less than so long [s] is not worth remembering, nor are more things than so many."""
REDRAWN_S = 1.0
"""Time between two writings of the line of a terminal [s]."""


@dataclass(frozen=True)
class Progress:
    """Progress of a run."""

    done: int
    """Walks finished, those found in the folder among them."""
    total: int
    failed: int
    """Walks that were no success, or fell after it, of those finished."""
    seconds: float
    """Time since the run began [s]."""
    rate: float | None
    """Walks a second in this run; None until a chunk is finished."""
    seconds_left: float | None
    """Estimate of the time that is left [s]; None until a chunk is finished."""
    under_way: float = 0.0
    """Work done on the chunks that are being walked, in whole walks."""


def show(stream: Stream | None = None) -> "Shown":
    """Say the progress of a run: on a terminal one line that is written over again, elsewhere a line now and then."""
    return Shown(stream or sys.stderr)


class Shown:
    """A display to be called with a `Progress` after every chunk and within it; `close` ends it."""

    def __init__(self, stream: Stream):
        self._last: Progress | None = None
        self._at = time.monotonic()
        self._pulse = _Pulse(stream, self._words)

    def __call__(self, progress: Progress) -> None:
        """Take note of how far the run has got."""
        if progress.done == progress.total and self._last is None:
            return  # nothing was left to do
        self._last, self._at = progress, time.monotonic()
        self._pulse.start()
        if progress.done == progress.total:
            self.close()

    def close(self) -> None:
        """Say where it stopped, if anything was said."""
        self._pulse.close()

    def _words(self) -> str:
        p = self._last
        assert p is not None
        passed = time.monotonic() - self._at
        filled = round(BAR * (p.done + p.under_way) / max(p.total, 1))
        bar = f"[{'#' * filled}{'.' * (BAR - filled)}] {p.done} of {p.total} walks"
        if p.rate is None or p.seconds_left is None:
            of_first = f", {p.under_way:.0f} walks' worth done" if p.under_way else _phase()
            return f"{bar}, compiling and simulating the first chunk for {duration(p.seconds + passed)}{of_first}"
        left = f", about {duration(max(0.0, p.seconds_left - passed))} left" if p.done < p.total else ""
        return f"{bar}, {p.failed} failed, {p.rate:.3g} a second{left}"


@contextmanager
def waiting(
    what: str, stream: Stream | None = None, redraw: bool = True
) -> Iterator[Callable[[float], None]]:
    """Say now and then that something is still going on, for how long, and how long it took the last time.

    Gives a function that may be told which fraction of it is done.

    Args:
        what: that goes on, such as "compiling and simulating 17 s of walking".
        stream: where to; standard error by default.
        redraw: on a terminal one line that is written over again; else lines, among which others may be written.
    """
    began, before, done = time.monotonic(), _times().get(what), [0.0]

    def words() -> str:
        passed = time.monotonic() - began
        if done[0] > 0.0:
            return f"{what}: {duration(passed)}, {100.0 * done[0]:.0f} % done"
        last = f" (the last time {duration(before)})" if before else ""
        return f"{what}: {duration(passed)}{last}{_phase()}"

    def told(fraction: float) -> None:
        done[0] = fraction

    pulse = _Pulse(stream or sys.stderr, words, keep=False, redraw=redraw)
    pulse.start()
    try:
        yield told
        _remember(what, time.monotonic() - began)
    finally:
        pulse.close()


def _phase() -> str:
    return f"; {runtime.under_way()}" if runtime.under_way() else ""


def _times_file() -> Path:
    return runtime.cache_folder().parent / "times.json"


def _times() -> dict[str, float]:
    """Read how long things took the last time [s]; nothing where it cannot be read."""
    try:
        said = json.loads(_times_file().read_text(encoding="utf-8"))
        return {str(what): float(seconds) for what, seconds in said.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _remember(what: str, seconds: float) -> None:
    """Remember how long something took; a folder that cannot be written is no harm."""
    if seconds < SHORT_S:
        return
    times = {name: time for name, time in _times().items() if name != what}
    latest = [*times.items(), (what, round(seconds, 1))][-MOST_KEPT:]
    with contextlib.suppress(OSError):
        _times_file().parent.mkdir(parents=True, exist_ok=True)
        files.write(_times_file(), json.dumps(dict(latest), indent=0))


def duration(seconds: float) -> str:
    """A time to read: 42 s, 3 min 20 s, 2 h 5 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


class _Pulse:
    """Writes words to a stream now and then, in a thread of its own."""

    def __init__(self, stream: Stream, words: Callable[[], str], keep: bool = True, redraw: bool = True):
        self.stream, self.words, self.keep = stream, words, keep
        self.terminal = redraw and bool(getattr(stream, "isatty", lambda: False)())
        self.ended, self.width = threading.Event(), 0
        self.thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin, once."""
        if self.thread is None and not self.ended.is_set():
            self.thread = threading.Thread(target=self._run, daemon=True)
            self.thread.start()

    def close(self) -> None:
        """End it; on a terminal the last line stays, if it is to be kept."""
        if self.thread is None or self.ended.is_set():
            self.ended.set()
            return
        self.ended.set()
        self.thread.join()
        if self.terminal and self.keep:
            self._write(end="\n")
        elif self.terminal:
            self._put("\r" + " " * self.width + "\r")
        elif self.width:
            self._write(end="\n")

    def _run(self) -> None:
        wait = REDRAWN_S if self.terminal else FIRST_S
        while not self.ended.wait(wait):
            wait = REDRAWN_S if self.terminal else EVERY_S
            self._write(end="" if self.terminal else "\n")

    def _write(self, end: str) -> None:
        text = self.words()
        self._put(f"\r{text.ljust(self.width)}{end}" if self.terminal else f"{text}{end}")
        self.width = len(text)

    def _put(self, text: str) -> None:
        try:
            self.stream.write(text)
            self.stream.flush()
        except (OSError, ValueError):  # nobody reads any more
            self.ended.set()

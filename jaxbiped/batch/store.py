"""A folder that holds an experiment and what has been simulated of it, and survives anything.

    experiment.json     the resolved experiment, its key, versions, device
    experiment.toml     the same as a file for a person, see `experiment_file`; nothing here is read from it
    scenarios.parquet   the scenarios, with every input
    parts/KEY-NUMBER.parquet    one for every finished chunk
    table.parquet       all rows, once every chunk is there

Every file is written under a temporary name and renamed, so that what bears its name is whole. The key is a hash of
the resolved experiment and of the code. A part says whose it is (key, chunk, rows) and carries a checksum of all its
bytes: it counts only if all of that is right. What is damaged is set aside under another name, never deleted, and made
again.
"""

import hashlib
import io
import json
import os
import platform
import re
import sys
import tempfile
from collections.abc import Callable, Collection
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
import polars as pl

from jaxbiped import files
from jaxbiped.batch import experiment_writer, records
from jaxbiped.batch.columns import FAILED, IDENTITY, OUTCOMES
from jaxbiped.batch.experiment import Chunk, Experiment, table_hash
from jaxbiped.files import source_hash
from jaxbiped.score import STATUS_TEXT

EXPERIMENT, SCENARIOS, TABLE, PARTS = "experiment.json", experiment_writer.SCENARIOS, "table.parquet", "parts"
RESOLVED, RESOLVED_MARK = "experiment.toml", "# Resolved experiment "
"""The experiment as a file for a person, and how such a file of a batch begins."""
PACKAGES = ("jaxbiped", "jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx", "equinox", "polars")
FORMAT = 3
"""Format of the folder."""
CALLED: dict[int | None, str] = {None: "arm", 2: "arm", FORMAT: "variant"}
"""Word for a variant in every format.

Version 0.1 wrote no format: its parts carry no checksum, and are judged by their rows alone."""
SEAL = "jaxbiped"
"""Entry of a Parquet file's own metadata that says whose it is."""
_NO_SUM = "0" * 64
_SUM = re.compile(rb'\\?"sha256\\?": \\?"([0-9a-f]{64})\\?"')
_PART = re.compile(r"[0-9a-f]{16}-\d{5,}\.parquet")
Tell = Callable[[str], None]


class StoreError(ValueError):
    """A folder that cannot be used, or a file that cannot be written."""


class DamagedError(ValueError):
    """A file that is not what it should be: says why."""


@dataclass(frozen=True)
class Found:
    """Contents of the folder of an experiment."""

    failed: dict[int, int]
    """Walks that failed in every chunk whose part is there and right, by the chunk's number."""
    damaged: dict[Path, str]
    """Files that are not what they should be, and why."""


def to_stderr(line: str) -> None:
    """Say something to a person."""
    print(f"jaxbiped: {line}", file=sys.stderr, flush=True)


class Store:
    """The folder of one experiment; nothing on the disk is touched before `open`."""

    def __init__(self, folder: Path, experiment: Experiment, overwrite: bool = False, tell: Tell = to_stderr):
        self.folder, self.experiment, self.overwrite, self.tell = folder, experiment, overwrite, tell
        self.description = {"experiment": experiment.resolved, "code": code()}
        self.key = records.digest(self.description)

    def require_usable(self) -> None:
        """Look whether the folder can be used, without looking at its parts; nothing is changed.

        Raises:
            StoreError: if it cannot be written, or holds another experiment and `overwrite` does not allow it.
        """
        if why := files.why_not_writable(self.folder / PARTS):
            raise StoreError(
                f"out: got '{self.folder}' ({why}), allowed: a folder that can be made and written"
            )
        if not self.overwrite and self._holds_another():
            self._refuse_another()

    def inspect(self) -> Found:
        """Look at what is there, every part included, and change nothing.

        Raises:
            StoreError: as `require_usable`.
        """
        self.require_usable()
        if self._holds_another():
            return Found({}, {})
        damaged: dict[Path, str] = {}
        if (self.folder / EXPERIMENT).exists() and (why := self._description_damage()):
            damaged[self.folder / EXPERIMENT] = why
        if os.path.lexists(self.folder / SCENARIOS) and (why := self._scenarios_damage()):
            damaged[self.folder / SCENARIOS] = why
        failed = {}
        for chunk in self.experiment.chunks:
            part = self.part(chunk)
            if os.path.lexists(part):
                try:
                    failed[chunk.number] = failures(self.read(chunk))
                except DamagedError as error:
                    damaged[part] = str(error)
        return Found(failed, damaged)

    def open(self) -> Found:
        """Make the folder if it is missing, and set aside what is damaged in it.

        Raises:
            StoreError: as `inspect`, and if the folder cannot be written.
        """
        found = self.inspect()
        try:
            if self._holds_another():
                self._clear()
            (self.folder / PARTS).mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=self.folder / PARTS).close()
            for file, why in found.damaged.items():
                self._set_aside(file, why)
        except OSError as error:
            raise _refusal(self.folder, error) from error
        self._describe()
        return found

    def _describe(self) -> None:
        """Write the files that describe the folder, where they are missing."""
        if not (self.folder / SCENARIOS).exists():
            write_frame(self.folder / SCENARIOS, self.experiment.table)
        if not (self.folder / EXPERIMENT).exists():
            said = {
                "format": FORMAT,
                **self.description,
                "key": self.key,
                "seed": self.experiment.seed,
                "machine": _machine(),
            }
            _write(self.folder / EXPERIMENT, json.dumps(said, indent=1))
        if not os.path.lexists(self.folder / RESOLVED):
            header = f"{RESOLVED_MARK}{self.key[:16]}: jaxbiped run {RESOLVED} --out FOLDER runs it again."
            _write(self.folder / RESOLVED, experiment_writer.text(self.experiment, header))

    def part(self, chunk: Chunk) -> Path:
        """File of a chunk."""
        return part_file(self.folder, self.key, chunk)

    def read(self, chunk: Chunk) -> pl.DataFrame:
        """Rows of a finished chunk.

        Raises:
            DamagedError: if the file is not this chunk's, or not as it was written.
        """
        return read_part(
            self.part(chunk), self.key, self.experiment.table, chunk, outcomes=self.experiment.outcomes
        )

    def write(self, chunk: Chunk, rows: pl.DataFrame) -> None:
        """Keep the rows of a finished chunk.

        Raises:
            StoreError: if they cannot be written; finished parts stay as they are.
        """
        _write(self.part(chunk), sealed(rows, {"key": self.key, **_identity(chunk)}))

    def finish(self) -> pl.DataFrame:
        """Put all parts together in `table.parquet`; returns the table.

        Raises:
            StoreError: if a part was damaged since it was written, or the table cannot be written.
        """
        try:
            rows = pl.concat([self.read(chunk) for chunk in self.experiment.chunks]).sort("row")
        except DamagedError as error:
            raise StoreError(f"out: {error}; run the same command again") from error
        file, content = self.folder / TABLE, _parquet(rows)
        if os.path.lexists(file) and not _holds(file, content):
            self._set_aside(file, "it is not what its parts say")
        if not file.exists():
            _write(file, content)
        self._describe()  # if somebody took it away meanwhile
        return rows

    @property
    def ours(self) -> bool:
        """Tell whether the folder says, by its description or by its parts, that it holds this experiment."""
        described = self._description() is not None and not self._holds_another()
        return described or self._has_own_parts()

    def _has_own_parts(self) -> bool:
        return any(self.folder.glob(f"{PARTS}/{self.key[:16]}-*.parquet"))

    def _description(self) -> dict[str, Any] | None:
        """The folder's own description; None if it has none that can be read."""
        try:
            there = json.loads((self.folder / EXPERIMENT).read_text(encoding="utf-8"))
            return {name: there[name] for name in self.description}
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def _description_damage(self) -> str:
        if self._description() is None:
            return "it cannot be read"
        there = json.loads((self.folder / EXPERIMENT).read_text(encoding="utf-8"))
        changed = [
            name for name, value in (("key", self.key), ("format", FORMAT)) if there.get(name) != value
        ]
        return f"its {changed[0]} was changed" if changed else ""

    def _holds_another(self) -> bool:
        there = self._description()
        if there is not None:
            return there != json.loads(json.dumps(self.description))
        return self._foreign() is not None

    def _foreign(self) -> str | None:
        """A file that is not of this experiment, in a folder that does not say what it holds."""
        if self._has_own_parts():
            return None  # its parts say whose it is
        for name in (EXPERIMENT, TABLE):
            if (self.folder / name).exists():
                return name
        if any(self.folder.glob(f"{PARTS}/*")):
            return PARTS
        return SCENARIOS if (self.folder / SCENARIOS).exists() and self._scenarios_damage() else None

    def _scenarios_damage(self) -> str:
        try:
            _require_scenarios(self.folder / SCENARIOS, self.experiment.resolved["scenarios"]["sha256"])
        except DamagedError as error:
            return str(error)
        return ""

    def _refuse_another(self) -> None:
        there = self._description()
        if there is None:
            held = self._foreign()
            what = f"with '{held}' of something else"
            if held == EXPERIMENT:
                what = f"with an {EXPERIMENT} that cannot be read"
            raise StoreError(
                f"out: got '{self.folder}' {what}, allowed: a folder of this experiment, one that is empty or new, "
                "or overwrite it"
            )
        different = list(records.differences(there, json.loads(json.dumps(self.description))))
        more = f" and {len(different) - 3} more" if len(different) > 3 else ""
        raise StoreError(
            f"out: got '{self.folder}', which holds another experiment ({'; '.join(different[:3])}{more}), "
            "allowed: another folder, or overwrite it"
        )

    def _set_aside(self, file: Path, why: str) -> None:
        if os.path.lexists(file):
            self.tell(f"'{file}' is damaged ({why}): set aside as '{files.set_aside(file).name}', made again")

    def _clear(self) -> None:
        """Delete what a batch wrote, and nothing else.

        What depends on a file goes before it, so that a kill in between leaves nothing without its description.
        """
        (self.folder / TABLE).unlink(missing_ok=True)
        for part in (self.folder / PARTS).glob("*.parquet"):
            if _PART.fullmatch(part.name):
                part.unlink(missing_ok=True)
        if _begins_with(self.folder / RESOLVED, RESOLVED_MARK):
            (self.folder / RESOLVED).unlink()
        for name in (SCENARIOS, EXPERIMENT):
            (self.folder / name).unlink(missing_ok=True)


def open_table(path: str | Path, tell: Tell = to_stderr) -> tuple[Experiment, pl.DataFrame]:
    """The experiment and the rows, finished so far, of a folder or its `table.parquet`; nothing on the disk is changed.

    The rows have the inputs that were written; one that a version had not yet has its default in the experiment.

    Args:
        path: folder that a batch was run in, or the table in it.
        tell: is told of every part that is damaged, and therefore left out.

    Raises:
        StoreError: if there is none, or it cannot be read.
    """
    path = Path(path)
    folder = path.parent if path.name == TABLE else path
    try:
        described = json.loads((folder / EXPERIMENT).read_text(encoding="utf-8"))
        key, version = described["key"], described.get("format")
        if type(version) not in (int, type(None)) or version not in CALLED:
            raise ValueError(f"its format is {version!r}, this version reads 2 and {FORMAT}")
        if key != records.digest({name: described[name] for name in ("experiment", "code")}):
            raise DamagedError(f"{EXPERIMENT} was changed: its key is not that of what it says")
        scenarios = _require_scenarios(folder / SCENARIOS, described["experiment"]["scenarios"]["sha256"])
        experiment = Experiment.from_resolved(described["experiment"], scenarios)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        why = " ".join(str(error).split())[:160]
        raise StoreError(f"table: got '{path}' ({why}), allowed: a folder that a batch was run in") from None
    rows, written = [], experiment.table.select(scenarios.columns)
    for chunk in experiment.chunks:
        part = part_file(folder, key, chunk)
        if os.path.lexists(part):
            try:
                rows.append(
                    read_part(
                        part,
                        None if version is None else key,
                        written,
                        chunk,
                        CALLED[version],
                        experiment.outcomes,
                    )
                )
            except DamagedError as error:
                tell(f"'{part}' is damaged ({error}): left out; running the same command again makes it anew")
    if not rows:
        raise StoreError(f"table: got '{path}' without a finished chunk, allowed: a folder with some rows")
    return experiment, pl.concat(rows).sort("row")


def failures(rows: pl.DataFrame) -> int:
    """Number of walks that were no success, or ended in a fall after it."""
    return rows.filter(~pl.col("success") | pl.col("status").is_in(FAILED)).height


def part_file(folder: Path, key: str, chunk: Chunk) -> Path:
    """File of a chunk of the experiment with this key."""
    return folder / PARTS / f"{key[:16]}-{chunk.number:05d}.parquet"


def read_part(
    path: Path,
    key: str | None,
    scenarios: pl.DataFrame,
    chunk: Chunk,
    called: str = CALLED[FORMAT],
    outcomes: Collection[str] = tuple(OUTCOMES),
) -> pl.DataFrame:
    """Rows of a chunk, if the file is that chunk's and as it was written.

    Args:
        path: of the file.
        key: of the experiment; None for a part of version 0.1, which says neither whose it is nor its checksum.
        scenarios: of the experiment whose part it is, with every input that was written.
        chunk: which part.
        called: what the part calls a variant.
        outcomes: columns it may have besides.

    Raises:
        DamagedError: if it is not: says why.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DamagedError(error.strerror or str(error)) from None
    if key is not None or _SUM.search(content[-(1 << 16) :]):
        _require_sum(content)
    frame = _frame(content)
    if called in frame.columns:
        frame = frame.rename({called: CALLED[FORMAT]})
    if key is not None:
        _require_seal(content, {"key": key, **_identity(chunk, called)})
    inputs = scenarios[chunk.start : chunk.stop]
    expected = {
        "row": np.arange(chunk.stop - chunk.start) + chunk.first_row + chunk.start,
        "variant": [chunk.variant] * inputs.height,
        "scenario": np.arange(chunk.start, chunk.stop),
    }
    for name, values in {**expected, **{name: inputs[name] for name in inputs.columns}}.items():
        if name not in frame.columns or not frame[name].equals(pl.Series(name, values), check_dtypes=True):
            raise DamagedError(f"its column '{name}' is not that of chunk {chunk.number}")
    _require_outcome(frame, {*IDENTITY, *inputs.columns, *outcomes})
    return frame


def _require_outcome(frame: pl.DataFrame, allowed: Collection[str]) -> None:
    for name, dtype in (("success", pl.Boolean), ("status", pl.String)):
        if frame.schema.get(name) != dtype or frame[name].null_count():
            raise DamagedError(f"its column '{name}' is missing, or not all of it is there")
    if odd := set(frame["status"]) - set(STATUS_TEXT):
        raise DamagedError(f"it has the status '{odd.pop()}'")
    if odd := set(frame.columns) - {*allowed}:
        raise DamagedError(f"it has the column '{odd.pop()}'")


def sealed(frame: pl.DataFrame, identity: dict[str, Any]) -> bytes:
    """A Parquet file that says whose it is and carries a SHA-256 of all its bytes, with zeros in its own place."""
    content = _parquet(frame, {SEAL: json.dumps({**identity, "sha256": _NO_SUM})})
    digest = hashlib.sha256(content).hexdigest()
    return content.replace(_NO_SUM.encode(), digest.encode())


def _require_sum(content: bytes) -> None:
    found = {match[1] for match in _SUM.finditer(content[-(1 << 16) :])}
    if len(found) != 1:
        raise DamagedError("it carries no checksum" if not found else "it carries two checksums")
    digest = found.pop()
    if hashlib.sha256(content.replace(digest, _NO_SUM.encode())).hexdigest().encode() != digest:
        raise DamagedError("its checksum is wrong")


def _require_seal(content: bytes, identity: dict[str, Any]) -> None:
    try:
        said = dict(json.loads(pl.read_parquet_metadata(io.BytesIO(content))[SEAL]))
    except (KeyError, ValueError, TypeError) as error:
        raise DamagedError("it does not say whose it is") from error
    for name, value in identity.items():
        if said.get(name) != value:
            raise DamagedError(f"it is of another {'experiment' if name == 'key' else name}")


def _identity(chunk: Chunk, called: str = CALLED[FORMAT]) -> dict[str, Any]:
    first = chunk.first_row + chunk.start
    return {
        "chunk": chunk.number,
        called: chunk.variant,
        "rows": [first, first + chunk.stop - chunk.start],
    }


def _require_scenarios(path: Path, sha256: str) -> pl.DataFrame:
    """The scenarios in a file, if they are those of the experiment."""
    try:
        table = _frame(path.read_bytes())
    except (OSError, DamagedError) as error:
        raise DamagedError(f"{path.name}: {error}") from None
    if any(not dtype.is_numeric() for dtype in table.dtypes) or table_hash(table) != sha256:
        raise DamagedError(f"{path.name} is not the one the experiment was begun with")
    return table


def _frame(content: bytes) -> pl.DataFrame:
    try:
        return pl.read_parquet(io.BytesIO(content))
    except (pl.exceptions.PolarsError, OSError, ValueError) as error:
        raise DamagedError(f"no Parquet file: {' '.join(str(error).split())[:80]}") from None
    except BaseException as error:  # polars panics over some broken files; a panic is no Exception
        if type(error).__name__ != "PanicException":
            raise
        raise DamagedError("no Parquet file that can be read") from None


def _holds(file: Path, content: bytes) -> bool:
    try:
        return file.read_bytes() == content
    except OSError:
        return False


def _begins_with(file: Path, mark: str) -> bool:
    try:
        with file.open("rb") as stream:
            return stream.read(len(mark)) == mark.encode()
    except OSError:
        return False


def _parquet(frame: pl.DataFrame, said: dict[str, str] | None = None) -> bytes:
    buffer = io.BytesIO()
    frame.rechunk().write_parquet(buffer, metadata=said or {})
    return buffer.getvalue()


def write_frame(path: Path, frame: pl.DataFrame) -> None:
    """Write a Parquet file as a whole.

    Raises:
        StoreError: if it cannot be written; an older file of that name stays.
    """
    _write(path, _parquet(frame))


def _write(path: Path, content: bytes | str) -> None:
    try:
        files.write(path, content)
    except OSError as error:
        raise _refusal(path, error) from error


def code() -> dict[str, str]:
    """Code that the rows depend on: versions of packages, and a hash of this one's source."""
    return {**_versions(), "source_sha256": source_hash()}


def _versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in PACKAGES}


def _machine() -> dict[str, str]:
    device = jax.devices()[0]
    return {
        "device": f"{device.platform} {device.device_kind}",
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }


def _refusal(path: Path, error: OSError) -> StoreError:
    return StoreError(f"out: got '{path}' ({error.strerror or error}), allowed: a place that can be written")

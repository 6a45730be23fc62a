"""A folder that holds an experiment and what has been walked of it, and survives anything.

    experiment.json     the resolved experiment, its key, versions, device
    scenarios.parquet   the scenarios, with every input
    parts/KEY-NUMBER.parquet    one for every finished chunk
    table.parquet       all rows, once every chunk is there

Every file is written under a temporary name and renamed, so that what bears its name is whole. The key is a hash of
the resolved experiment and of the code: finished parts count only for the experiment they were made by.
"""

import contextlib
import hashlib
import io
import json
import os
import platform
import shutil
import tempfile
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import polars as pl

from jaxbiped.batch import records
from jaxbiped.batch.experiment import Chunk, Experiment

EXPERIMENT, SCENARIOS, TABLE, PARTS = "experiment.json", "scenarios.parquet", "table.parquet", "parts"
PACKAGES = ("jaxbiped", "jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx", "equinox", "polars")

PARQUET_END = b"PAR1"


class StoreError(ValueError):
    """A folder that cannot be used, or a file that cannot be written."""


class Store:
    """The folder of one experiment."""

    def __init__(self, folder: Path, experiment: Experiment, overwrite: bool = False):
        """Open or make the folder.

        Raises:
            StoreError: if the folder holds another experiment, or cannot be written.
        """
        self.folder, self.experiment = folder, experiment
        self.description = {"experiment": experiment.resolved, "code": code()}
        self.key = _key(self.description)
        try:
            if overwrite and (folder / EXPERIMENT).exists():
                self._clear()
            folder.mkdir(parents=True, exist_ok=True)
            (folder / PARTS).mkdir(exist_ok=True)
            tempfile.TemporaryFile(dir=folder / PARTS).close()
        except OSError as error:
            raise _refusal(folder, error) from error
        if (folder / EXPERIMENT).exists():
            self._require_same()
        else:
            self._begin()
        if not _is_whole(folder / SCENARIOS):
            write_frame(folder / SCENARIOS, experiment.table)

    def part(self, chunk: Chunk) -> Path:
        """File of a chunk."""
        return self.folder / PARTS / f"{self.key[:16]}-{chunk.number:05d}.parquet"

    def missing(self) -> list[Chunk]:
        """Chunks that are still to be walked; what is left of a part that something else broke is dropped."""
        missing = [chunk for chunk in self.experiment.chunks if not _is_whole(self.part(chunk))]
        for chunk in missing:
            self.part(chunk).unlink(missing_ok=True)
        return missing

    def write(self, chunk: Chunk, rows: pl.DataFrame) -> None:
        """Keep the rows of a finished chunk.

        Raises:
            StoreError: if they cannot be written; finished parts stay as they are.
        """
        write_frame(self.part(chunk), rows)

    def finish(self) -> pl.DataFrame:
        """Put all parts together in `table.parquet`; returns the table."""
        table = pl.concat([pl.read_parquet(self.part(chunk)) for chunk in self.experiment.chunks])
        write_frame(self.folder / TABLE, table.sort("row"))
        return pl.read_parquet(self.folder / TABLE)

    def _begin(self) -> None:
        write_frame(self.folder / SCENARIOS, self.experiment.table)
        described = {**self.description, "key": self.key, "seed": self.experiment.seed, "machine": _machine()}
        write_bytes(self.folder / EXPERIMENT, json.dumps(described, indent=1).encode())

    def _require_same(self) -> None:
        try:
            there = json.loads((self.folder / EXPERIMENT).read_text(encoding="utf-8"))
            old = {name: there[name] for name in self.description}
        except (ValueError, KeyError, TypeError):
            raise StoreError(
                f"out: got '{self.folder}' with an {EXPERIMENT} that cannot be read, allowed: a folder of this "
                "experiment or an empty one; or overwrite it"
            ) from None
        new = json.loads(json.dumps(self.description))
        different = list(records.differences(old, new))
        if different:
            more = f" and {len(different) - 3} more" if len(different) > 3 else ""
            raise StoreError(
                f"out: got '{self.folder}', which holds another experiment ({'; '.join(different[:3])}{more}), "
                "allowed: another folder, or overwrite it"
            )

    def _clear(self) -> None:
        """What depends on a file goes before it, so that a kill in between leaves nothing without its description."""
        (self.folder / TABLE).unlink(missing_ok=True)
        shutil.rmtree(self.folder / PARTS, ignore_errors=True)
        for name in (EXPERIMENT, SCENARIOS):
            (self.folder / name).unlink(missing_ok=True)


def open_table(path: Path) -> tuple[Experiment, pl.DataFrame]:
    """The experiment and the rows, finished so far, of a folder or its `table.parquet`.

    Raises:
        StoreError: if there is none, or it cannot be read.
    """
    folder = path.parent if path.name == TABLE else path
    try:
        described = json.loads((folder / EXPERIMENT).read_text(encoding="utf-8"))
        scenarios = pl.read_parquet(folder / SCENARIOS)
        experiment = Experiment.from_resolved(described["experiment"], scenarios)
        parts = sorted((folder / PARTS).glob(f"{described['key'][:16]}-*.parquet"))
        rows = [pl.read_parquet(part) for part in parts]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, pl.exceptions.PolarsError) as error:
        raise StoreError(
            f"table: got '{path}' ({' '.join(str(error).split())[:120]}), allowed: a folder that a batch was run in"
        ) from None
    if not rows:
        raise StoreError(f"table: got '{path}' without a finished chunk, allowed: a folder with some rows")
    return experiment, pl.concat(rows).sort("row")


def write_frame(path: Path, frame: pl.DataFrame) -> None:
    """Write a Parquet file under a temporary name and rename it."""
    buffer = io.BytesIO()
    frame.rechunk().write_parquet(buffer)
    write_bytes(path, buffer.getvalue())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file under a temporary name and rename it.

    Raises:
        StoreError: if it cannot be written; an older file of that name stays.
    """
    name = None
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            name = file.name
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, path)
        _keep_name(path)
    except OSError as error:
        if name is not None:
            Path(name).unlink(missing_ok=True)
        raise _refusal(path, error) from error


def code() -> dict[str, str]:
    """What the rows depend on besides the experiment: versions of packages, and a hash of this one's source."""
    return {**_versions(), "source_sha256": source_hash()}


@cache
def source_hash() -> str:
    """Of all Python and data files of the package, as they were when first asked."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*")):
        if file.suffix in {".py", ".toml"}:
            digest.update(str(file.relative_to(root)).encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _is_whole(path: Path) -> bool:
    """Whether a Parquet file is there and ends as one: a disk that was lost or filled by others may have cut it."""
    try:
        with path.open("rb") as file:
            file.seek(-len(PARQUET_END), os.SEEK_END)
            return file.read() == PARQUET_END
    except OSError:
        return False


def _keep_name(path: Path) -> None:
    """Have the disk keep the new name of a file, where it can be asked to."""
    with contextlib.suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _key(description: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


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

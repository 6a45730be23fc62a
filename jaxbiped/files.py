"""Files that are whole or not there: written under another name, then renamed; with permissions by the umask."""

import contextlib
import hashlib
import itertools
import os
import uuid
from functools import cache
from pathlib import Path


def write(path: str | Path, content: bytes | str) -> Path:
    """Write a file as a whole; an older file of that name stays if this one cannot be written.

    Args:
        path: of the file; its folder must exist.
        content: text is written in UTF-8.

    Raises:
        OSError: with the name of the file, when the disk is full or the folder cannot be written.
    """
    path = Path(path)
    data = content.encode("utf-8") if isinstance(content, str) else content
    unfinished = path.with_name(f".{path.name[:180]}.{uuid.uuid4().hex[:12]}.part")
    try:
        # Created without tempfile, which would make it readable to its owner only, whatever the umask.
        with os.fdopen(os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    _keep_name(path)
    return path


def set_aside(path: Path, why: str = "damaged") -> Path:
    """Rename a file to the first free of NAME.damaged, NAME.damaged-2, ... (or another word), and return its new name.

    Raises:
        OSError: if it cannot be renamed.
    """
    names = itertools.chain([f"{path.name}.{why}"], (f"{path.name}.{why}-{n}" for n in itertools.count(2)))
    place = next(place for place in map(path.with_name, names) if not os.path.lexists(place))
    os.rename(path, place)
    return place


def why_not_writable(folder: Path) -> str | None:
    """Say why a folder cannot be made or written into, without trying; None if nothing speaks against it."""
    try:
        for place in (folder.absolute(), *folder.absolute().parents):
            try:
                os.lstat(place)
            except (FileNotFoundError, NotADirectoryError):
                continue
            if not place.is_dir():
                return f"'{place}' is a file"
            return None if os.access(place, os.W_OK | os.X_OK) else f"'{place}' may not be written"
    except (OSError, ValueError) as error:  # a name that is too long, a folder that may not be entered
        return getattr(error, "strerror", None) or str(error)
    return f"'{folder}' has no parent folder"


def is_file(path: Path) -> bool:
    """Tell whether the path is a file; False for a name that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _keep_name(path: Path) -> None:
    """Have the disk keep the new name of a file, where it can be asked to."""
    with contextlib.suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


@cache
def source_hash() -> str:
    """SHA-256 of all source and data files of the package, as they were when first asked."""
    root = Path(__file__).parent
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*")):
        if file.suffix in {".py", ".toml", ".c"}:
            digest.update(str(file.relative_to(root)).encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()

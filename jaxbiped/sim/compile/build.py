"""C text to functions that can be called: compiled once by the system's compiler, and kept."""

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

from jaxbiped import runtime

FLAGS = ("-O2", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-w")
LANGUAGES = ("c++", "c")
"""In C++ a choice between vectors is an operator, which compilers translate better."""


class NoCompilerError(ValueError):
    """There is no C compiler, or it cannot compile this."""


def folder() -> Path:
    """The folder where machine code is kept between runs."""
    return runtime.cache_folder().parent / "c"


def processor() -> str:
    """Describe the processor that machine code is for."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    said = [line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))]
    return platform.machine() + "\n".join(sorted(set(said)))


def key(text: str) -> str:
    """Name machine code by all that it depends on."""
    return hashlib.sha256("\0".join([text, *FLAGS, processor(), _compiler()]).encode()).hexdigest()[:32]


def load(text: str) -> ctypes.CDLL:
    """The library of a text, compiled unless it was before.

    Raises:
        NoCompilerError: there is no C compiler, or it refuses the text.
    """
    file = folder() / f"{key(text)}.so"
    if not file.exists():
        _compile(text, file)
    return ctypes.CDLL(str(file))


def compiler() -> str | None:
    """The system's C compiler, the one that the environment names in CC or `cc`; None if there is none."""
    return shutil.which(_wanted())


def _wanted() -> str:
    return os.environ.get("CC", "cc")


def _compiler() -> str:
    found = compiler()
    if found is None:
        raise NoCompilerError(
            f"backend: 'c' needs a C compiler, and there is no {_wanted()!r} here; allowed: xla"
        )
    return found


def _compile(text: str, file: Path) -> None:
    """Compile into a file that is there whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    said = ""
    with tempfile.TemporaryDirectory(dir=file.parent) as scratch:
        source, made = Path(scratch) / "walk.c", Path(scratch) / "walk.so"
        source.write_text(text, encoding="utf-8")
        for language in LANGUAGES:
            command = [
                _compiler(),
                "-x",
                language,
                *FLAGS,
                "-shared",
                "-fPIC",
                "-o",
                str(made),
                str(source),
                "-lm",
            ]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode == 0:
                os.replace(made, file)
                return
            said = (done.stderr.strip().splitlines() or ["no message"])[0]
    raise NoCompilerError(f"backend: the C compiler refuses the text: {said}; allowed: xla")

"""What every benchmark shares: one core, a header that says on what, and timing that waits for the output."""

import gc
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("jaxbiped", "jax", "jaxlib", "numpy", "mujoco", "mink", "daqp", "scipy")


def use_one_core() -> int | None:
    """Keep this process, XLA's thread pools and BLAS on one core; call it before JAX or NumPy is imported.

    Returns:
        The core, or None where a process cannot be bound to one (macOS).
    """
    flags = "--xla_cpu_multi_thread_eigen=false"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # as the package does where it is imported before JAX
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    if not hasattr(os, "sched_setaffinity"):
        return None
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return core


def header(core: int | None) -> dict[str, Any]:
    """Hardware, versions and commit."""
    return {
        "cpu": _cpu(),
        "cores_used": 1,
        "bound_to_core": core is not None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "commit": _commit(),
    }


def median_seconds(call: Callable[[], Any], repeats: int, least: float = 0.02) -> float:
    """Median CPU time of one call [s]; `call` must wait for its own output.

    All threads of the process count, and they share one core: on an idle machine this is the wall-clock time, on a
    busy one it leaves out what other processes took.

    Args:
        call: what to time; it has been warmed up before.
        repeats: how many times to measure.
        least: shortest measurement [s]; shorter calls are repeated within one.
    """
    began = time.process_time()
    call()
    loops = max(1, round(least / max(time.process_time() - began, 1e-7)))
    measured = []
    gc.disable()
    for _ in range(repeats):
        began = time.process_time()
        for _ in range(loops):
            call()
        measured.append((time.process_time() - began) / loops)
    gc.enable()
    return statistics.median(measured)


def table(title: str, columns: list[str], rows: list[list[str]]) -> str:
    """A plain text table, first column left, the others right."""
    widths = [max(len(row[i]) for row in [columns, *rows]) for i in range(len(columns))]

    def line(row: list[str]) -> str:
        first, *others = [
            cell.ljust(w) if i == 0 else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        return "  ".join([first, *others]).rstrip()

    return "\n".join([title, line(columns), "-" * len(line(columns)), *map(line, rows), ""])


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        if names:
            return names[0]
    return platform.processor() or platform.machine()


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _commit() -> str:
    def git(*args: str) -> str:
        return subprocess.run(
            ["git", *args], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        return git("rev-parse", "--short", "HEAD") + ("-dirty" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"

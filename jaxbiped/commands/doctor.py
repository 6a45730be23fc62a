"""`jaxbiped doctor`: versions, device, and a short self-test; says what is wrong and how to mend it."""

import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxbiped import kinematics, planner, robot, runtime
from jaxbiped.sim.compile import build

PACKAGES = ("jaxbiped", "jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx", "equinox", "polars", "tyro")
PLAIN_JIT = jax.jit
"""Compiler of a user's own functions."""
EXTRAS = {"matplotlib": "viz", "jinja2": "viz", "distributed": "cluster"}
"""Packages of the extras, and which extra brings them."""


@dataclass(frozen=True)
class Doctor:
    """Look at this installation: versions, device, cache, a short self-test; say how to mend what is wrong."""

    json: bool = False
    """Print one JSON object as the last line."""


def run(command: Doctor) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    versions = {name: metadata.version(name) for name in PACKAGES}
    cores = runtime.cores()
    print(f"python {platform.python_version()} on {platform.system()} {platform.machine()}, {cores} cores")
    print(", ".join(f"{name} {version}" for name, version in versions.items()))
    found = [check() for check in CHECKS]
    for name, ok, words in found:
        print(f"{'ok  ' if ok else 'BAD '} {name}: {words}")
    wrong = [name for name, ok, _ in found if not ok]
    print("all well" if not wrong else f"to be mended: {', '.join(wrong)}")
    checks = [{"name": name, "ok": ok, "says": words} for name, ok, words in found]
    return {"ok": not wrong, "versions": versions, "checks": checks}


Finding = tuple[str, bool, str]


def _device() -> Finding:
    devices = jax.devices()
    kinds = ", ".join(f"{d.platform} {d.device_kind}" for d in devices)
    if devices[0].platform == "cpu" and util.find_spec("jax_cuda12_plugin") is not None:
        return (
            "device",
            False,
            f"{kinds}; the CUDA plugin is installed but sees no GPU: is the driver loaded?",
        )
    return "device", True, kinds


def _extras() -> Finding:
    missing = {name: extra for name, extra in EXTRAS.items() if util.find_spec(name) is None}
    if not missing:
        return "extras", True, "figures, pages and Dask workers are there"
    words = ", ".join(
        f"{name} is missing: pip install 'jaxbiped[{extra}]'" for name, extra in missing.items()
    )
    return "extras", False, words


def _cache() -> Finding:
    folder = jax.config.values["jax_compilation_cache_dir"]
    if folder is None:
        return "compilation cache", False, "off; set JAX_COMPILATION_CACHE_DIR, or every run compiles anew"
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return (
            "compilation cache",
            False,
            f"{folder}: {error.strerror}; set JAX_COMPILATION_CACHE_DIR to another",
        )
    return "compilation cache", True, str(folder)


def _compiler() -> Finding:
    found = build.compiler()
    if found is None:
        return (
            "C compiler",
            True,
            "none: large batches are compiled by XLA and walk more than ten times slower",
        )
    return "C compiler", True, f"{found}, for large batches"


def _memory_maps() -> Finding:
    limit = Path("/proc/sys/vm/max_map_count")
    if not limit.exists():
        return "memory maps", True, "no limit known on this system"
    allowed = int(limit.read_text())
    ok = allowed >= 65530
    return "memory maps", ok, f"{allowed} allowed" + ("" if ok else "; sysctl -w vm.max_map_count=65530")


def _self_test() -> Finding:
    """Forward kinematics undoes inverse kinematics on a sampled plan."""
    began = time.perf_counter()
    params = robot.load("elkahlout")
    gait = planner.CosineGait.preset(params, 2)

    @runtime.jit
    def error(times: Array) -> Array:
        def one(t: Array) -> Array:
            task = planner.at(gait, t).position
            asked = task.sole - task.pelvis
            angles, _ = kinematics.joint_angles(params, asked)
            back = jnp.stack([kinematics.leg.forward(params, i, angles[i]).p_pelvis_sole for i in (0, 1)])
            return jnp.max(jnp.abs(back - asked))

        return jnp.max(jax.vmap(one)(times))

    worst = float(error(jnp.linspace(0.0, float(gait.duration), 200)))
    took = time.perf_counter() - began
    ok = bool(np.isfinite(worst)) and worst < 1e-5
    words = f"inverse and forward kinematics agree within {1e6 * worst:.2f} um, {took:.1f} s"
    return "self-test", ok, words if ok else f"{words}; reinstall jax and jaxlib of the same version"


def _arithmetic() -> Finding:
    """A sum of products that jaxlib 0.10.2, 0.11.0 and 0.11.1 compute wrongly on a CPU (jax-ml/jax issue 39103)."""

    def squares(x: np.ndarray | Array) -> Array:
        return jax.vmap(lambda row: jnp.sum((jnp.eye(3, dtype=x.dtype) @ row) ** 2))(x)

    with jax.default_device(jax.devices("cpu")[0]):
        x = np.zeros((32_769, 3), np.float32)
        x[:, 0] = np.arange(len(x))
        wanted = x[:, 0] ** 2
        theirs, ours = (np.asarray(compiled(squares)(x)) for compiled in (PLAIN_JIT, runtime.jit))
    wrong = [float(np.max(np.abs(got - wanted) / np.maximum(wanted, 1.0))) for got in (theirs, ours)]
    cure = "pip install 'jax!=0.10.2,!=0.11.0,!=0.11.1'"
    if wrong[1] > 1e-5:
        return "arithmetic", False, f"sums of products are wrong by {wrong[1]:.1%} on the CPU: {cure}"
    if wrong[0] > 1e-5:
        return (
            "arithmetic",
            False,
            f"jax.jit computes sums of products wrong by {wrong[0]:.1%} on the CPU, this package's functions "
            f"are compiled around it: {cure}",
        )
    return "arithmetic", True, "sums of products on the CPU are right"


CHECKS: tuple[Callable[[], Finding], ...] = (
    _device,
    _extras,
    _cache,
    _compiler,
    _memory_maps,
    _arithmetic,
    _self_test,
)

"""Settings of JAX before it starts: threads, devices, compilation cache; and the compiler of all functions.

Nothing in the package starts a JAX back end when it is imported: what is set here, or in the environment, still counts.
"""

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

# XLA reads it when JAX is imported. It keeps to itself that it compiles slowly, and that kernels it finds in the cache
# were compiled for "another" machine, which is this one; errors still come as exceptions. Set it to 0 to see all.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import platformdirs
from jax.core import Tracer
from jaxtyping import PyTree

P = ParamSpec("P")
R = TypeVar("R")
OnHost = Any
"""A tree of NumPy arrays."""

OPTIONS: dict[str, str] = {"xla_cpu_experimental_ynn_fusion_type": ""}
"""On a CPU XLA may give sums and products of a few numbers to a library (YNN), which computes some of them wrongly in
jaxlib 0.10.2, 0.11.0 and 0.11.1 (jax-ml/jax issue 39103), and whose calls cost more than the arithmetic does: with
none given to it a tick takes some percent less (`benchmarks/tick_profile.py`). Other devices take no notice."""

ONE_THREAD = {
    "NPROC": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false --xla_cpu_parallel_codegen_split_count=1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "POLARS_MAX_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
    "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    "TF_CPP_MIN_LOG_LEVEL": "3",
}
"""Environment of a process that is to use one core (XLA makes as many threads as NPROC says), less memory to compile,
and no more of a GPU's than it needs; XLA reads it when it is first used."""


def jit(function: Callable[P, R]) -> Callable[P, R]:
    """`eqx.filter_jit` with `OPTIONS`, where this version of XLA knows them: for every function of the package.

    Inside another compiled function it is `eqx.filter_jit`, since the outermost one's options count.
    """

    @functools.cache
    def jitted(outermost: bool) -> Callable[P, R]:  # at the first call, since asking XLA starts its devices
        made: Any = eqx.filter_jit  # its annotations leave out what it passes on to jax.jit
        return made(function, compiler_options=options() if outermost else {})

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return jitted(not _is_tracing())(*args, **kwargs)

    return call


def jit_arrays(function: Callable[..., R], **more: str | int) -> Callable[..., R]:
    """Compile a function of arrays alone with `OPTIONS` and `more`: what `jit` asks at every call is not asked."""
    made: Any = jax.jit(function, compiler_options={**options(), **more})
    return made


def in_blocks(function: Callable[..., PyTree], block: int, *arguments: PyTree) -> OnHost:
    """A compiled function of arguments with a leading axis, called with `block` of them at a time; on the host.

    The last one fills the last block, so that one program serves any number.
    """
    arguments = jax.tree.map(np.asarray, arguments)
    n = len(jax.tree.leaves(arguments)[0])
    rows = np.minimum(np.arange(n + -n % block), n - 1).reshape(-1, block)
    parts = [function(*jax.tree.map(lambda leaf, few=few: leaf[few], arguments)) for few in rows]
    return jax.tree.map(lambda *few: np.concatenate(few)[:n], *parts)


@functools.cache
def options() -> dict[str, str]:
    """`OPTIONS`, or none where XLA refuses them."""
    with jax.ensure_compile_time_eval():
        try:
            jax.jit(jnp.negative, compiler_options=OPTIONS).lower(0.0).compile()
        except jax.errors.JaxRuntimeError:
            return {}
    return OPTIONS


def _is_tracing() -> bool:
    """Tell whether the caller runs inside a function that JAX is tracing, where even a constant is a tracer."""
    return isinstance(jnp.zeros(()), Tracer)


def use_threads(count: int = 1) -> None:
    """Keep XLA in this process to so many threads, unless it is already running or the environment says otherwise."""
    for name, value in {**ONE_THREAD, "NPROC": str(count)}.items():
        os.environ.setdefault(name, value)


def threads() -> int:
    """Number of compiled functions that can run at once here: one on each of XLA's threads, one on a GPU."""
    if jax.default_backend() != "cpu":
        return 1
    given = os.environ.get("NPROC", "")
    return min(cores(), int(given)) if given.isdecimal() and int(given) else cores()


_under_way = [""]


def now(what: str) -> None:
    """Note what goes on in this process, for whoever is asked what takes so long; "" for nothing in particular."""
    _under_way[0] = what


def under_way() -> str:
    """Say in a few words what goes on in this process."""
    return _under_way[0]


def cache_folder() -> Path:
    """The folder where compiled kernels are kept between runs, as the system has it: on Linux ~/.cache/jaxbiped/jax."""
    return platformdirs.user_cache_path("jaxbiped", appauthor=False) / "jax"


def keep_compiled_kernels() -> None:
    """Let JAX keep compiled kernels between runs; JAX_COMPILATION_CACHE_DIR, if set, says where."""
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def gpus() -> list[str]:
    """Numbers of the GPUs of this machine, as CUDA_VISIBLE_DEVICES has them."""
    found = [device for device in jax.local_devices() if device.platform != "cpu"]
    allowed = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    return [allowed[i] if len(allowed) == len(found) else str(i) for i in range(len(found))]


def cores() -> int:
    """Number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

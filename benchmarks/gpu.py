"""Batched walks on an accelerator: `python benchmarks/gpu.py [--quick]`, one JSON line a row.

`surena3` with landing and payload reflex, `elkahlout` with the reflex, batches of 1,024 to 262,144, by XLA from the
tick as it is written and from its scalars (`Options.backend`); a gradient by four tunables; and how far walks here are
from the same walks on this machine's CPU. Rows are told as they are measured, so that what a limit of time leaves out
is the end. Without an accelerator it runs on the CPU, where scalars take XLA long to compile: then only the tick as it
is written.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import jaxbiped.runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import jax
import jax.numpy as jnp
import numpy as np

import jaxbiped as jb
from jaxbiped.adapt import Controller, Landing, PayloadReflex
from jaxbiped.batch import Uniform
from jaxbiped.sim import Scenario, Simulation, own_options, prepare, segments
from jaxbiped.sim.compile import backend as scalars
from jaxbiped.sim.options import SCALAR, XLA
from jaxbiped.tune import Problem
from jaxbiped.tune.walks import walk_slopes

BATCHES = (1024, 8192, 65_536, 262_144)
TUNED = (
    "payload.x_left_left_swings",
    "payload.x_right_left_swings",
    "payload.reflex_time",
    "payload.settling_time",
)
COMPARED_S = 0.3
"""Length of the walks that are compared with a CPU's [s]: up to the first touchdown, which amplifies rounding."""


def main() -> None:
    """Measure row by row."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny sizes: does it run at all?")
    parser.add_argument("--robot", choices=jb.robot.presets(), nargs="+", default=["elkahlout", "surena3"])
    parser.add_argument("--batch", type=int, nargs="+", help=f"default: {', '.join(map(str, BATCHES))}")
    given = parser.parse_args()
    batches = given.batch or ((8,) if given.quick else BATCHES)
    on_cpu = jax.default_backend() == "cpu"
    say(row="device", device=str(jax.devices()[0]), jax=jax.__version__)
    for name in given.robot[:1] if given.quick else given.robot:
        for backend in (XLA,) if on_cpu else (SCALAR, XLA):
            for row in throughput(name, backend, batches):
                say(row="throughput", robot=name, backend=backend, **row)
            if not on_cpu:
                say(row="agreement", robot=name, backend=backend, **agreement(name, backend))
    say(row="gradient", **gradient(8 if given.quick else 2048, 0.02 if given.quick else 0.5))


def say(**row: Any) -> None:
    """Print a row."""
    print(json.dumps(row), flush=True)


def simulation(name: str, backend: str) -> Simulation:
    """A robot and its stages, in the options of its own paper."""
    robot = jb.robot.load(name)
    gait = jb.planner.own_gait(robot, 6)
    stages = [PayloadReflex.repaired(robot, gait), *([Landing.repaired()] if name == "surena3" else [])]
    return prepare(robot, Controller(gait, *stages), replace(own_options(robot, gait), backend=backend))


def scenarios(n: int) -> Scenario:
    """Loads at different times on flat ground."""
    random = np.random.default_rng(0)
    flat = Scenario.flat(2)
    mass, when = random.uniform(0.0, 10.0, n), random.uniform(0.2, 3.0, n)
    real = jnp.result_type(float)
    return jax.vmap(flat.with_payload)(jnp.asarray(mass, real), jnp.asarray(when, real))


def timed(call: Callable[[], Any], repeats: int = 3) -> tuple[float, float]:
    """Of the first call, compiling included, and the best of some thereafter [s]."""
    times = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return times[0], min(times[1:])


def throughput(name: str, backend: str, batches: tuple[int, ...]) -> Iterator[dict[str, Any]]:
    """Physics ticks a second of one segment, by the number of lanes."""
    one = simulation(name, backend)
    ticks = segments.ticks_of_segment(one) * one.options.control_every
    for n in batches:
        states = segments.begun(one, scenarios(n), 10**6)
        further: Callable[[Any], Any] = lambda s: segments._segment(one, s)  # noqa: E731
        if backend == SCALAR:
            further = scalars.segments(one, segments.ticks_of_segment(one))
        first, best = timed(lambda f=further, s=states: f(s))
        yield {"batch": n, "ticks_per_s": n * ticks / best, "segment_s": best, "first_s": first}


def agreement(name: str, backend: str, n: int = 64) -> dict[str, Any]:
    """Largest differences of a short walk here and on the CPU."""
    here = simulation(name, backend).run_many(scenarios(n), COMPARED_S).statistics
    with jax.default_device(jax.devices("cpu")[0]):
        there = simulation(name, XLA).run_many(scenarios(n), COMPARED_S).statistics
    found = {}
    for path, a in jax.tree_util.tree_leaves_with_path(here):
        b = dict(jax.tree_util.tree_leaves_with_path(there))[path]
        found[jax.tree_util.keystr(path)[1:]] = float(
            np.max(np.abs(np.asarray(a, float) - np.asarray(b, float)))
        )
    return {"lanes": n, "seconds": COMPARED_S, "largest_differences": found}


def gradient(n: int, duration: float) -> dict[str, Any]:
    """What a gradient by four tunables of the thesis' reflex costs, by XLA."""
    robot = jb.robot.load("elkahlout")
    gait = jb.planner.own_gait(robot, 6)
    variant = Controller(gait, PayloadReflex.modified(robot, gait))
    table = jb.batch.draw(n, 1, load_kg=Uniform(2.0, 12.0), load_time_s=Uniform(1.5, 3.0))
    one = jb.batch.Experiment(
        robot, {"modified": variant}, table, own_options(robot, gait), duration=duration
    )
    problem = Problem.of(one, TUNED)
    start, batch = jnp.asarray(problem.start, jnp.result_type(float)), problem.scenarios(np.arange(n))
    first, best = timed(lambda: walk_slopes(problem.setting, start, batch), repeats=1)
    ticks = n * duration / one.simulation.dt
    return {
        "walks": n,
        "tunables": len(TUNED),
        "seconds": best,
        "first_s": first,
        "ticks_per_s": ticks / best,
    }


if __name__ == "__main__":
    main()

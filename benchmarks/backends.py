"""Ticks per second and core of the C backend against XLA: `python benchmarks/backends.py [--robot NAME] [--lanes N]`.

Both advance the same batch of flat walks by the same segments, in one run, on one core with one thread. Times are those
that the process had the core.
"""

import argparse
import time
from typing import Any

import common

CORE = common.use_one_core()  # before JAX is imported

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

from jaxbiped import planner, robot, sim  # noqa: E402
from jaxbiped.adapt import Controller  # noqa: E402
from jaxbiped.sim import segments  # noqa: E402
from jaxbiped.sim.compile import backend, trace  # noqa: E402
from jaxbiped.sim.compile.machine import Code, Machine  # noqa: E402


def main() -> None:
    """Measure and print a table for every robot."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robot", choices=robot.presets(), nargs="*", default=["elkahlout", "surena3"])
    parser.add_argument("--lanes", type=int, nargs="*", default=[64, 256, 1024])
    options = parser.parse_args()
    for name in options.robot:
        print(measure(name, options.lanes), flush=True)


def measure(name: str, lanes: list[int]) -> str:
    """A table of one robot."""
    params = robot.load(name)
    gait = planner.own_gait(params, 8)
    simulation = sim.prepare(params, Controller(gait), sim.own_options(params, gait))
    ticks = segments.ticks_of_segment(simulation) * simulation.options.control_every
    machine, times = prepared(simulation)
    rows, leaves = [], trace.shared_leaves(simulation)
    for n in lanes:
        states = begun(simulation, n)
        c = rate(
            lambda s=states: machine.advance(leaves, s, segments.ticks_of_segment(simulation)), n * ticks
        )
        began = time.process_time()
        jax.block_until_ready(segments._segment(simulation, states))
        first = time.process_time() - began
        xla = rate(lambda s=states: jax.block_until_ready(segments._segment(simulation, s)), n * ticks)
        rows.append([str(n), f"{c:,.0f}", f"{xla:,.0f}", f"{c / xla:.1f}", f"{first:.1f}"])
    title = f"{name}, {1e3 * simulation.options.dt:g} ms, controller every {simulation.options.control_every}; {times}"
    return common.table(title, ["lanes", "c", "xla", "ratio", "first xla segment [s]"], rows)


def begun(simulation: sim.Simulation, n: int) -> Any:
    """States at the start of walks."""
    scenarios = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), sim.Scenario.flat())
    return segments.begun(simulation, scenarios, 10**6)


def prepared(simulation: sim.Simulation) -> tuple[Machine, str]:
    """Machine code, and what it took, step by step; the compiler's part is from its cache where it was used before."""
    states, times = begun(simulation, 16), {}

    def step(name: str, call: Any) -> Any:
        began = time.perf_counter()
        out = call()
        times[name] = time.perf_counter() - began
        return out

    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), states)
    closed = step("trace", lambda: trace.trace(simulation, one))
    program = step("scalars", lambda: trace.program_of(closed, simulation, one))
    machine = step("C", lambda: Machine(Code.of(program)))
    step("compared", lambda: backend.compare(machine, closed, simulation, states))
    return machine, ", ".join(f"{name} {seconds:.1f} s" for name, seconds in times.items())


def rate(call: Any, ticks: int, repeats: int = 3) -> float:
    """The best of a few [ticks/s]."""
    seconds = []
    for _ in range(repeats):
        began = time.process_time()
        call()
        seconds.append(time.process_time() - began)
    return ticks / min(seconds)


if __name__ == "__main__":
    main()

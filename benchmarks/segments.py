"""What it costs to run walks in segments from the host, beside one compiled loop over the whole walk, in one run.

python benchmarks/segments.py
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import jaxbiped.runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import jax
import jax.numpy as jnp

import jaxbiped as jb
from jaxbiped import runtime

ROBOT, STEPS = "elkahlout", 7


def seconds(call: Callable[[], Any], repeats: int) -> list[float]:
    """CPU times of a call [s], the first of which compiles and is left out."""
    jax.block_until_ready(call())
    found = []
    for _ in range(repeats):
        began = time.process_time()
        jax.block_until_ready(call())
        found.append(time.process_time() - began)
    return found


def main() -> None:
    """Time both ways, turn about."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--lanes", type=int, default=64)
    parser.add_argument("--duration", type=float, default=3.0, help="of every walk [s]")
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    runtime.use_threads()
    runtime.keep_compiled_kernels()
    robot = jb.robot.load(ROBOT)
    gait = jb.planner.own_gait(robot, STEPS)
    controller = jb.adapt.Controller(gait, jb.adapt.PayloadReflex.named("modified", robot, gait))
    simulation = jb.sim.prepare(robot, controller, jb.sim.own_options(robot, gait))
    one = jb.sim.Scenario.flat(1).with_friction(jb.sim.own_friction(robot, gait)).with_payload(2.5, 1.5)
    scenarios = jax.tree.map(lambda leaf: jnp.stack([leaf] * given.lanes), one)
    ticks = jnp.asarray(simulation.ticks(given.duration))
    loop = runtime.jit(
        lambda simulation, scenarios, ticks: jax.vmap(lambda s: simulation.walk(s, ticks))(scenarios)
    )
    ways = {
        "segments": lambda: simulation.run_many(scenarios, given.duration),
        "one loop": lambda: loop(simulation, scenarios, ticks),
    }
    rates = {
        name: given.lanes
        * given.duration
        / simulation.options.dt
        / statistics.median(seconds(call, given.repeats))
        for name, call in ways.items()
    }
    for name, rate in rates.items():
        print(f"{name}: {rate:,.0f} physics ticks a CPU second")
    print(f"segments over one loop: {rates['segments'] / rates['one loop']:.3f}")


if __name__ == "__main__":
    main()

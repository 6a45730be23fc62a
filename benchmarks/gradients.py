"""What a gradient costs, as a multiple of the walks it is of: `python benchmarks/gradients.py [--json]`.

elkahlout under loads with the modified reflex, one core, float32. Forward mode by 4 and by 8 tunables against the walks
alone and against central differences (two walks a tangent), by XLA and in C, all in one run; compiling is told apart.
"""

import argparse
import json
import time
from functools import partial
from typing import Any

import common

CORE = common.use_one_core()  # before JAX is imported

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxbiped as jb  # noqa: E402
from jaxbiped.tune import Problem  # noqa: E402
from jaxbiped.tune.walks import walk_slopes, walk_values  # noqa: E402

NAMES = (
    "payload.x_left_left_swings",
    "payload.x_right_left_swings",
    "payload.reflex_time",
    "payload.settling_time",
    "payload.x_left_right_swings",
    "payload.x_right_right_swings",
    "payload.x_ref_gain",
    "payload.zmp_balanced",
)
REPEATS = 5


def problem(count: int, lanes: int, duration: float) -> Problem:
    """The first `count` tunables, and a load at any time of the first step."""
    robot = jb.robot.load("elkahlout")
    gait = jb.planner.CosineGait.preset(robot, 6)
    variant = jb.adapt.Controller(gait, jb.adapt.PayloadReflex.modified(robot, gait))
    options = jb.sim.own_options(robot, gait)
    scenarios = jb.batch.draw(
        lanes, 1, load_kg=jb.batch.Uniform(2.0, 12.0), load_time_s=jb.batch.Uniform(1.5, 3.0)
    )
    one = jb.batch.Experiment(robot, {"modified": variant}, scenarios, options, duration=duration)
    return Problem.of(one, NAMES[:count])


def seconds(function: Any, *arguments: Any) -> tuple[float, float]:
    """Of the first call, compiling included, and the median of one call thereafter."""
    began = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    first = time.perf_counter() - began
    return first, common.median_seconds(lambda: jax.block_until_ready(function(*arguments)), REPEATS, 0.05)


def measure(count: int, lanes: int, duration: float) -> dict[str, dict[str, float]]:
    """Times of walks, of central differences and of the gradient by `count` tunables, for each backend."""
    one = problem(count, lanes, duration)
    start, scenarios = one.start.astype(np.float32), one.scenarios(np.arange(lanes))
    points = np.broadcast_to(start, (lanes, count))
    functions: dict[str, tuple[Any, Any]] = {
        "c": (one.in_c.walk_values, one.in_c.walk_slopes),
        "xla": (partial(walk_values, one.setting), partial(walk_slopes, one.setting)),
    }
    found = {}
    for backend, (values, slopes) in functions.items():
        first_walks, walks = seconds(values, jnp.asarray(points), scenarios)
        first_gradient, gradient = seconds(slopes, jnp.asarray(start), scenarios)
        found[backend] = {
            "walks_s": walks,
            "gradient_s": gradient,
            "gradient_over_walks": gradient / walks,
            "cost_per_tangent": (gradient - walks) / (count * walks),
            "central_differences_over_gradient": (2 * count + 1) * walks / gradient,
            "ticks_per_s": lanes * duration / one.experiment.simulation.dt / walks,
            "first_walks_s": first_walks,
            "first_gradient_s": first_gradient,
        }
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--lanes", type=int, default=64)
    parser.add_argument("--duration", type=float, default=1.0, help="of every walk [s]")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    options = parser.parse_args()
    result = {}
    for count in (4, 8):
        result[str(count)] = measure(count, options.lanes, options.duration)
        print(f"{count} tunables, {options.lanes} walks")
        in_c, in_xla = result[str(count)]["c"], result[str(count)]["xla"]
        print(f"  {'':36s}{'C':>12s}{'XLA':>12s}")
        for name, value in in_c.items():
            print(f"  {name:36s}{value:12,.3f}{in_xla[name]:12,.3f}")
        print(
            f"  gradient by XLA over that in C: {in_xla['gradient_s'] / in_c['gradient_s']:.1f}", flush=True
        )
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()

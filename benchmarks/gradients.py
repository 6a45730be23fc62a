"""What a gradient costs, as a multiple of the walks it is of: `python benchmarks/gradients.py [--json]`.

elkahlout under loads with the modified reflex, one core, float32. Forward mode by 4 and by 8 tunables against the walks
alone and against central differences (two walks a tangent), all in one run; compiling is left out.
"""

import argparse
import json
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


def seconds(function: Any, *arguments: Any) -> float:
    """Median of one call, compiled before."""
    return common.median_seconds(lambda: jax.block_until_ready(function(*arguments)), REPEATS, 0.05)


def measure(count: int, lanes: int, duration: float) -> dict[str, float]:
    """Times of walks, of central differences and of the gradient by `count` tunables."""
    one = problem(count, lanes, duration)
    at, scenarios, setting = jnp.asarray(one.start), one.scenarios(np.arange(lanes)), one.setting
    walks = seconds(walk_values, setting, jnp.broadcast_to(at, (lanes, count)), scenarios)
    slopes = seconds(walk_slopes, setting, at, scenarios)
    return {
        "gradient_over_walks": slopes / walks,
        "cost_per_tangent": (slopes - walks) / (count * walks),
        "central_differences_over_gradient": (2 * count + 1) * walks / slopes,
        "ticks_per_s": lanes * duration / one.experiment.simulation.dt / walks,
    }


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
        for name, value in result[str(count)].items():
            print(f"  {name:36s}{value:12,.2f}", flush=True)
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()

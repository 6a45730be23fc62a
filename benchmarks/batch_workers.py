"""Closed-loop rate of the batch tester with one and with two workers: `python benchmarks/batch_workers.py [--json]`.

surena3 with landing adaptation over random pads, chunks of 128 walks. What compiles is left out: the clock starts when
half of the chunks are done. Memory is the peak of any worker, compiling included.
"""

import argparse
import json
import resource
import time
from typing import Any

import jaxbiped as jb
from jaxbiped.batch import Uniform, workers

CHUNKS, LANES = 12, 128


def experiment(duration: float) -> jb.batch.Experiment:
    """Walks of equal length; what happens in them does not matter for the rate."""
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, 8)
    variants = {"repaired": jb.adapt.Controller(gait, jb.adapt.Landing.repaired())}
    scenarios = jb.batch.draw(
        CHUNKS * LANES, 1, step_2_height_m=Uniform(-0.03, 0.03), friction=Uniform(0.5, 1.0)
    )
    return jb.batch.Experiment(robot, variants, scenarios, duration=duration, batch=LANES)


def rate(one: jb.batch.Experiment, n: int) -> float:
    """Physics ticks a second with `n` Dask workers, over the second half of the chunks."""
    ends: list[float] = []
    for _ in workers.on_dask(one, one.chunks, n, None, lambda *_: None):
        ends.append(time.perf_counter())
    ticks = LANES * round(one.durations["repaired"] / one.simulation.dt)
    half = len(ends) // 2
    return (len(ends) - half) * ticks / (ends[-1] - ends[half - 1])


def main() -> None:
    """Measure, one worker and two, and compare."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--duration", type=float, default=3.0, help="of every walk [s]")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    arguments = parser.parse_args()
    jb.runtime.keep_compiled_kernels()
    jb.runtime.use_threads()
    one = experiment(arguments.duration)
    result: dict[str, Any] = {f"ticks_per_s_{n}_workers": rate(one, n) for n in (1, 2)}
    result["two_over_one"] = result["ticks_per_s_2_workers"] / result["ticks_per_s_1_workers"]
    result["peak_worker_MiB"] = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
    for name, value in result.items():
        print(f"{name:24s}{value:12,.2f}")
    if arguments.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()

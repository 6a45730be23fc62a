"""Sudden payloads on surena3 with landing and reflex both repaired, at any time of a step.

python sweeps/payload_walks.py
"""

import argparse

import jaxbiped.runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import jax
import jax.numpy as jnp
import numpy as np

import jaxbiped as jb
from jaxbiped.adapt import Controller, Landing, PayloadReflex
from jaxbiped.score import judge

STEPS = 8
LOADS, TIMES = (8.0, 15.0), tuple(4.5 + 0.15 * i for i in range(12))
"""[kg], and [s] since the start: a whole step."""
LONGEST_RECOVERY = 12.0
"""From a reflex until the robot walks on [s]."""


def main() -> None:
    """Walk all at once and print one line a walk."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, STEPS)
    controller = Controller(gait, Landing.repaired(), PayloadReflex.repaired(robot, gait))
    cases = [(load, time) for load in LOADS for time in TIMES]
    scenarios = [jb.sim.Scenario.flat(1).with_payload(load, time) for load, time in cases]
    batch = jax.tree.map(lambda *leaf: jnp.stack(leaf), *scenarios)
    duration = float(gait.duration) + LONGEST_RECOVERY
    walks = jb.sim.prepare(robot, controller).run_many(batch, duration)
    judged = jb.runtime.jit(jax.vmap(lambda walk, scenario: judge(walk, gait, scenario)))(walks, batch)
    assert walks.controller is not None and "payload" in walks.controller.stages
    s, reflex, success = jax.tree.map(
        np.asarray, (walks.statistics, walks.controller.stages["payload"], judged.success)
    )
    for i, (load, time) in enumerate(cases):
        roll, pitch = np.degrees(s.peak_roll_pitch[i])
        print(
            f"{load:4.1f} kg at {time:.2f} s  {'success' if success[i] else 'failure'}  "
            f"{jb.sim.STATUS_TEXT[s.status[i]]:5s} {s.end_time[i]:5.1f} s  roll {roll:4.1f}  pitch {pitch:4.1f} deg  "
            f"{s.peak_foot_force[i].max():5.0f} N  {reflex.reflexes[i]} reflexes, the last at "
            f"{reflex.trigger_time[i]:.3f} s",
            flush=True,
        )
    print(f"{int(success.sum())} of {len(cases)} succeed")


if __name__ == "__main__":
    main()

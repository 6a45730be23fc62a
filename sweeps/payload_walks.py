"""Sudden payloads on both robots: elkahlout with every arm of the reflex, surena3 with landing and reflex repaired.

python sweeps/payload_walks.py --c
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxbiped as jb
from jaxbiped.adapt import Controller, Landing, PayloadReflex
from jaxbiped.score import judge

STEPS = 8
ELKAHLOUT = jb.sim.Options(feed_forward=False, control_every=1, payload_model="thesis")
ELKAHLOUT_LOADS, ELKAHLOUT_TIMES = (2.5, 5.0, 10.0, 15.0), (0.3, 0.6, 1.2, 1.5, 1.9, 2.4)
"""[kg], and the thesis' time [s]: early and late in single support, in its middle, and in double support."""
SURENA3 = jb.sim.Options()
SURENA3_LOADS, SURENA3_TIMES = (8.0, 15.0), tuple(4.5 + 0.15 * i for i in range(12))
"""[kg], and [s] since the start: a whole step."""
LONGEST_RECOVERY = 12.0
"""From a reflex until the robot walks on, whatever the arm [s]."""


def walks(robot: Any, controller: Any, scenarios: list[Any], duration: float, options: Any) -> Any:
    """All scenarios at once: walks and verdicts with a leading axis."""
    batch = jax.tree.map(lambda *leaf: jnp.stack(leaf), *scenarios)
    done = jb.sim.prepare(robot, controller, options).run_many(batch, duration)
    judged = jb.runtime.jit(jax.vmap(lambda walk, scenario: judge(walk, controller.gait, scenario)))
    return jax.tree.map(np.asarray, (done, judged(done, batch)))


def print_row(what: str, walk: Any, success: Any, i: int) -> None:
    """One walk, one line."""
    s = walk.statistics
    roll, pitch = np.degrees(s.peak_roll_pitch[i])
    payload = walk.controller.payload
    reflex = (
        ""
        if payload is None
        else f"{payload.reflexes[i]} reflexes, the last at {payload.trigger_time[i]:.3f} s"
    )
    print(
        f"{what}  {'success' if success[i] else 'failure'}  {jb.sim.STATUS_TEXT[s.status[i]]:5s} {s.end_time[i]:5.1f} s"
        f"  roll {roll:4.1f}  pitch {pitch:4.1f} deg  {s.peak_foot_force[i].max():5.0f} N  {reflex}",
        flush=True,
    )


def elkahlout(in_c: bool) -> None:
    """The thesis' experiment; with `in_c` 15 kg at 1.2 s in C MuJoCo too."""
    robot = jb.robot.load("elkahlout")
    gait = jb.planner.CosineGait.preset(robot, STEPS)
    start, duration = float(gait.params.T_ini), float(gait.duration) + LONGEST_RECOVERY
    cases = [(load, time) for load in ELKAHLOUT_LOADS for time in ELKAHLOUT_TIMES]
    scenarios = [jb.sim.Scenario.flat(1).with_payload(load, time + start) for load, time in cases]
    arms = {
        "off": None,
        "original": PayloadReflex.original(robot, gait),
        "modified": PayloadReflex.modified(robot, gait),
    }
    for name, payload in arms.items():
        controller = Controller(gait, payload=payload)
        walk, verdict = walks(robot, controller, scenarios, duration, ELKAHLOUT)
        for i, (load, time) in enumerate(cases):
            print_row(f"elkahlout {name:8s} {load:4.1f} kg at {time:.1f} s", walk, verdict.success, i)
        print(f"elkahlout {name}: {int(verdict.success.sum())} of {len(cases)} succeed")
        if in_c:
            scenario = scenarios[cases.index((15.0, 1.2))]
            twin = jb.sim.replay_c(robot, controller, scenario, duration, ELKAHLOUT)
            success = np.asarray(judge(twin, gait, scenario).success)[None]
            row = jax.tree.map(lambda leaf: np.asarray(leaf)[None], twin)
            print_row(f"elkahlout {name:8s} 15.0 kg at 1.2 s in C MuJoCo", row, success, 0)


def surena3() -> None:
    """A load at any time of a step, landing and reflex both on."""
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, STEPS)
    controller = Controller(gait, landing=Landing.repaired(), payload=PayloadReflex.repaired(robot, gait))
    cases = [(load, time) for load in SURENA3_LOADS for time in SURENA3_TIMES]
    scenarios = [jb.sim.Scenario.flat(1).with_payload(load, time) for load, time in cases]
    walk, verdict = walks(robot, controller, scenarios, float(gait.duration) + LONGEST_RECOVERY, SURENA3)
    for i, (load, time) in enumerate(cases):
        print_row(f"surena3 repaired {load:4.1f} kg at {time:.2f} s", walk, verdict.success, i)
    print(f"surena3 repaired: {int(verdict.success.sum())} of {len(cases)} succeed")


def main() -> None:
    """Walk and print one line a walk."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--c", action="store_true", help="walk 15 kg at 1.2 s in C MuJoCo too, a minute an arm"
    )
    in_c = parser.parse_args().c
    elkahlout(in_c)
    surena3()


if __name__ == "__main__":
    main()

"""surena3 over one unknown pad or hole of -5 to +5 cm: no adaptation, the paper's landing, the repaired one.

python sweeps/single_pads.py
"""

import argparse
from typing import Any

import jaxbiped.runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import jax
import jax.numpy as jnp
import numpy as np

import jaxbiped as jb

HEIGHTS = (0.0, 0.01, 0.02, 0.03, 0.04, 0.05, -0.01, -0.02, -0.03, -0.04, -0.05)
STEPS, PADDED = 10, 4
VARIANTS = {"none": None, "paper": jb.adapt.Landing.paper(), "repaired": jb.adapt.Landing.repaired()}


def scenarios(robot: jb.robot.RobotParams, gait: Any) -> jb.sim.Scenario:
    """One pad each, with a leading axis."""
    flat = jb.sim.Scenario.flat(rectangles=1)
    each = [flat.with_obstacle(robot, gait, PADDED, height) for height in HEIGHTS]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def main() -> None:
    """Walk and print one line a walk."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, STEPS)
    batch, duration = scenarios(robot, gait), float(gait.duration) + 0.5
    print("variant       height  status     end   roll  pitch  force [N]  slip [mm]")
    for name, landing in VARIANTS.items():
        simulation = jb.sim.prepare(robot, jb.adapt.Controller(gait, landing))
        stats = jax.tree.map(np.asarray, simulation.run_many(batch, duration).statistics)
        for i, height in enumerate(HEIGHTS):
            roll, pitch = np.degrees(stats.peak_roll_pitch[i])
            print(
                f"{name:9s} {100 * height:+4.0f} cm  {jb.sim.STATUS_TEXT[stats.status[i]]:9s}"
                f" {stats.end_time[i]:5.1f}  {roll:5.2f}  {pitch:5.2f}  {stats.peak_foot_force[i].max():9.0f}"
                f"  {1e3 * stats.peak_slip[i].max():9.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()

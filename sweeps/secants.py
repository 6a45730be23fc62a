"""Forward-mode derivatives of single walks beside central differences of many widths, in float64.

The widths tell a derivative that is wrong from one that is right but of no use: where the loss jumps between control
ticks, narrow differences agree with it and wide ones scatter.

    python sweeps/secants.py
"""

import jax
import numpy as np

import jaxbiped as jb
from jaxbiped.tune import Problem, central, forward

NAMES = ("landing.T_mod", "landing.descent_speed", "gait.H_max")
HEIGHTS = (0.02, -0.02)
"""Of the pad under the second step [m]."""
WIDTHS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
"""Of the differences, in the unit of each tunable."""


def main() -> None:
    """Walk, print."""
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, 4)
    arm = jb.adapt.Controller(gait, landing=jb.adapt.Landing.repaired())
    scenarios = jb.batch.grid(step_1_height_m=HEIGHTS)
    problem = Problem.of(jb.batch.Experiment(robot, {"repaired": arm}, scenarios, duration=5.8), NAMES)
    rows = np.arange(len(HEIGHTS))
    columns = [forward(problem, problem.start, rows).by_scenario]
    columns += [
        central(problem, problem.start, rows, np.full(len(NAMES), width)).by_scenario for width in WIDTHS
    ]
    head = "".join(f"{f'{width:g}':>11s}" for width in WIDTHS)
    print(f"{'tunable':24s}{'pad':>8s}{'forward':>11s}{head}")
    for j, t in enumerate(problem.tunables):
        for i, height in enumerate(HEIGHTS):
            values = "".join(f"{column[i, j]:11.4g}" for column in columns)
            print(f"{t.name:24s}{100 * height:5.0f} cm{values}")


if __name__ == "__main__":
    with jax.enable_x64(True):
        main()

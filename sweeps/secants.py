"""Forward-mode derivatives of walks beside central differences of many widths, in float64.

The widths tell a derivative that is wrong from one that is right but of no use: where an event moves on by ticks,
narrow differences agree with it and wide ones have another trend. Without arguments, over whole walks of random
scenarios: median and 90th percentile of |forward - central| over the larger one, of every walk that does not fall and
every tunable, for half widths as shares of each range; once more of those that matter, whose whole range would change
the loss by more than MATTERS of it: next to nothing has no trend. With `--single`, the numbers of two walks.

    python sweeps/secants.py
    python sweeps/secants.py --scenarios 4 --durations 8 --variants landing
    python sweeps/secants.py --single
"""

import argparse
from typing import Any

import jaxbiped.runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import jax
import numpy as np

import jaxbiped as jb
from jaxbiped.adapt import Controller, Landing, PayloadReflex
from jaxbiped.batch import Choice, Uniform
from jaxbiped.tune import Problem, central, forward

SINGLE = ("landing.T_mod", "landing.descent_speed", "gait.H_max")
HEIGHTS = (0.02, -0.02)
"""Of the pad under the second step [m]."""
WIDTHS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
"""Of the differences, in the unit of each tunable."""
SHARES = (1e-2, 1e-3, 1e-4, 1e-5)
"""Half widths, of each range."""
MATTERS = 0.02
"""Share of a walk's loss."""
VARIANTS = ("landing", "modified", "repaired")
"""surena3's repaired landing; elkahlout's reflexes."""
LANDING = ("landing.T_mod", "landing.descent_speed", "landing.delta_x_scale", "landing.release_share")
REFLEX = (
    "payload.x_left_left_swings",
    "payload.x_right_right_swings",
    "payload.reflex_time",
    "payload.threshold",
    "payload.x_ref_gain",
)


def problem(variant: str, n: int, duration: float) -> Problem:
    """A robot with a variant in random scenarios: pads and holes, or loads."""
    if variant == "landing":
        robot = jb.robot.load("surena3")
        controller = Controller(jb.planner.PolynomialGait.preset(robot, 6), Landing.repaired())
        heights = tuple(float(h) for h in np.linspace(-0.04, 0.04, 33) if abs(h) > 0.004)
        scenarios = jb.batch.draw(n, 1, step_1_height_m=Choice(heights), friction=Uniform(0.6, 1.0))
        return Problem.of(
            jb.batch.Experiment(robot, {variant: controller}, scenarios, duration=duration), LANDING
        )
    robot = jb.robot.load("elkahlout")
    gait = jb.planner.CosineGait.preset(robot, 6)
    controller = Controller(gait, getattr(PayloadReflex, variant)(robot, gait))
    options, grip = jb.sim.own_options(robot, gait), jb.sim.own_friction(robot, gait)
    scenarios = jb.batch.draw(n, 1, load_kg=Uniform(3.0, 8.0), load_time_s=Uniform(1.5, 3.5), friction=grip)
    experiment = jb.batch.Experiment(robot, {variant: controller}, scenarios, options, duration=duration)
    return Problem.of(experiment, REFLEX)


def whole_walks(variant: str, n: int, duration: float) -> None:
    """Walk, print a line for each width, and the median of each tunable."""
    one, rows = problem(variant, n, duration), np.arange(n)
    ranges = np.array([t.high - t.low for t in one.tunables])
    slope = forward(one, one.start, rows)
    stands = slope.status == 0
    print(f"{variant}, {duration:g} s, {stands.sum()} of {n} walks do not fall")
    for share in SHARES:
        twin = central(one, one.start, rows, 2.0 * share * ranges).by_scenario
        size = np.maximum(np.abs(slope.by_scenario), np.abs(twin))
        gap: Any = np.where(
            size > 0.0, np.abs(slope.by_scenario - twin) / np.where(size > 0.0, size, 1.0), np.nan
        )
        matters = size * ranges > MATTERS * slope.losses[:, None]
        gap, which = 100.0 * gap[stands], np.where(matters, 100.0 * gap, np.nan)[stands]
        each = ", ".join(
            f"{t.name.split('.')[1]} {np.nanmedian(gap[:, j]):.3g}"
            for j, t in enumerate(one.tunables)
            if np.isfinite(gap[:, j]).any()
        )
        print(
            f"  half width {share:g}: median {np.nanmedian(gap):.3g} %, 90th percentile "
            f"{np.nanpercentile(gap, 90):.3g} % (medians: {each}); of {int(np.isfinite(which).sum())} that matter: "
            f"{np.nanmedian(which):.3g} %, {np.nanpercentile(which, 90):.3g} %",
            flush=True,
        )


def single() -> None:
    """Two walks, every number."""
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, 4)
    variant = Controller(gait, Landing.repaired())
    scenarios = jb.batch.grid(step_1_height_m=HEIGHTS)
    one = Problem.of(jb.batch.Experiment(robot, {"repaired": variant}, scenarios, duration=5.8), SINGLE)
    rows = np.arange(len(HEIGHTS))
    columns = [forward(one, one.start, rows).by_scenario]
    columns += [central(one, one.start, rows, np.full(len(SINGLE), width)).by_scenario for width in WIDTHS]
    head = "".join(f"{f'{width:g}':>11s}" for width in WIDTHS)
    print(f"{'tunable':24s}{'pad':>8s}{'forward':>11s}{head}")
    for j, t in enumerate(one.tunables):
        for i, height in enumerate(HEIGHTS):
            values = "".join(f"{column[i, j]:11.4g}" for column in columns)
            print(f"{t.name:24s}{100 * height:5.0f} cm{values}")


def main() -> None:
    """Walk, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--single", action="store_true", help="two walks and every number")
    parser.add_argument("--scenarios", type=int, default=20)
    parser.add_argument("--durations", type=float, nargs="*", default=(8.0, 16.0), help="[s]")
    parser.add_argument("--variants", nargs="*", choices=VARIANTS, default=VARIANTS)
    arguments = parser.parse_args()
    if arguments.single:
        single()
        return
    for variant in arguments.variants:
        for duration in arguments.durations:
            whole_walks(variant, arguments.scenarios, duration)


if __name__ == "__main__":
    with jax.enable_x64(True):
        main()

"""Tune surena3's landing, and say what that buys over heights, masses and frictions not tuned on.

Tuned on pads and holes under step 2, starting from khadiv's own landing and from the repaired one. Tried on pads and
holes under other steps, and on robots, grounds and switches further off.

    python sweeps/tune_landing.py --out runs/tune_landing
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import tuned

import jaxbiped as jb
from jaxbiped.adapt import Controller, Landing, tunables
from jaxbiped.batch import Choice, Uniform, height_column
from jaxbiped.commands.tune import descend
from jaxbiped.tune import Problem, Settings

STARTS = ("paper", "repaired")
LOSS = jb.score.WalkLoss(bound=50.0)
"""A fall costs ten soft walks: bounded as tightly as for payloads, a few falls would buy softer landings."""
STEPS, TUNED_STEP, TRIED_STEPS = 6, 2, (1, 3)
HEIGHTS = tuple(round(0.0025 * i, 4) for i in range(-20, 21) if i)
"""[m]"""
MEANS = (
    pl.max_horizontal("touchdown_force_left_N", "touchdown_force_right_N").alias("peak touchdown force [N]"),
    pl.max_horizontal("touchdown_impulse_left_Ns", "touchdown_impulse_right_Ns").alias(
        "peak touchdown impulse [Ns]"
    ),
    pl.max_horizontal("peak_force_left_N", "peak_force_right_N").alias("peak foot force [N]"),
    pl.max_horizontal("peak_roll_deg", "peak_pitch_deg").alias("peak tilt [deg]"),
)


def to_tune_on(robot: Any, variant: Controller, n: int, seed: int) -> jb.batch.Experiment:
    """One pad or hole of up to 5.1 cm, at heights that are not tried later; robots and grounds less far off."""
    heights: dict[str, Any] = {
        height_column(TUNED_STEP): Choice(tuple(0.00125 + 0.0025 * i for i in range(-21, 21)))
    }
    scenarios = jb.batch.draw(
        n,
        seed,
        friction=Uniform(0.6, 1.0),
        trunk_mass_scale=Uniform(0.96, 1.04),
        gain_scale=Uniform(0.9, 1.1),
        delta_z_m=Uniform(0.008, 0.012),
        **heights,
    )
    return jb.batch.Experiment(robot, {"variant": variant}, scenarios)


def to_try_on() -> dict[str, pl.DataFrame]:
    """By name, scenarios that no descent sees."""
    first, second = (height_column(step) for step in TRIED_STEPS)
    single = pl.DataFrame({second: HEIGHTS})
    both = pl.DataFrame({first: HEIGHTS, second: [-h for h in HEIGHTS]})
    heights = tuple(float(h) for h in np.linspace(-0.05, 0.05, 101) if h)
    pads: dict[str, Any] = {name: Choice(heights) for name in (first, second)}
    drawn = jb.batch.draw(
        256,
        777,
        friction=Uniform(0.4, 1.2),
        trunk_mass_scale=Uniform(0.92, 1.08),
        leg_mass_scale=Uniform(0.92, 1.08),
        com_x_m=Uniform(-0.01, 0.01),
        gain_scale=Uniform(0.8, 1.25),
        sinkage_m=Uniform(2e-4, 1e-3),
        delta_z_m=Uniform(0.006, 0.014),
        delay_s=Uniform(0.0, 0.004),
        bounce_s=Uniform(0.0, 0.01),
        **pads,
    )
    return {
        "a pad or hole under step 3": single,
        "a pad under step 1, a hole as deep under step 3, and the reverse": both,
        "other robots, grounds and switches, two pads": drawn,
    }


def main() -> None:
    """Tune from every start, try every variant."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/tune_landing"))
    parser.add_argument("--start", nargs="*", choices=STARTS, default=STARTS, help="variants to start from")
    parser.add_argument("--scenarios", type=int, default=96, help="to tune on; as many are held out")
    parser.add_argument("--batch", type=int, default=24, help="scenarios in a step")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--workers", type=int)
    arguments = parser.parse_args()
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, STEPS)
    variants = {name: Controller(gait, getattr(Landing, name)()) for name in STARTS}
    settings = Settings(steps=arguments.steps, scenarios=arguments.batch, rate=0.1)
    for name in arguments.start:
        on, held_out = (to_tune_on(robot, variants[name], arguments.scenarios, seed) for seed in (1, 1001))
        problem, out = Problem.of(on, ["landing"], LOSS), arguments.out / f"tuned_{name}"
        found, _ = descend(
            problem, held_out, settings, {"landing": {"base": name}}, out, "python sweeps/tune_landing.py"
        )
        variants[out.name] = tunables.apply(robot, variants[name], problem.tunables, found.values)
    pairs = [(f"tuned_{name}", name) for name in arguments.start]
    if len(pairs) == len(STARTS):
        pairs.append(("tuned_repaired", "paper"))
    for number, (what, scenarios) in enumerate(to_try_on().items()):
        one = jb.batch.Experiment(robot, variants, scenarios)
        out = arguments.out / f"tried_{number}"
        tuned.try_variants(what, one, out, arguments.workers, pairs, MEANS)
    for name in arguments.start:
        scenarios = pl.DataFrame({height_column(TUNED_STEP): HEIGHTS})
        problem = Problem.of(jb.batch.Experiment(robot, {name: variants[name]}, scenarios), ["landing"])
        title, file = f"surena3, variant {name}, pad under step 2", arguments.out / f"sensitivity_{name}.png"
        tuned.sensitivity(problem, 100.0 * np.array(HEIGHTS), "height [cm]", title, file)


if __name__ == "__main__":
    main()

"""How a loss goes over three control ticks of what every tunable of every variant moves, and where it jumps.

Short walks around one event: elkahlout under 6 kg from its first swing until after the shift of x_ref, surena3 onto a
pad and into a hole, until the height is released. Beside forward mode's slope that inside a tooth, and that over three
ticks, which is the trend; and the jumps between neighbors a sixteenth of a tick apart.

    python sweeps/teeth.py
    python sweeps/teeth.py modified repaired
"""

import argparse
from collections.abc import Callable
from typing import Any

import jaxbiped.runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import jax

import jaxbiped as jb
from jaxbiped.adapt import Controller, Landing, PayloadReflex
from jaxbiped.tune import Problem, teeth

PAYLOADS: dict[str, dict[str, Any]] = {
    "original": {},
    "modified": {},
    "modified, smooth ramp": {"smooth_ramp": True},
    "repaired": {},
}
LANDINGS: dict[str, dict[str, Any]] = {
    "paper": {},
    "paper, interpolated": {"interpolate": True},
    "repaired": {},
}
SHORT = {"settling_time": 0.8, "shift_time": 0.3}
"""Of the payload variants [s]: what is read and shifted afterwards is to be seen within the walk."""
LOAD, LOAD_TIME = 6.0, 2.4
"""[kg], [s]: in the midst of the first swing."""
PAD = 0.03
"""[m]"""


def payload(variant: str, names: Any = ("payload",)) -> Problem:
    """The robot elkahlout with a payload variant and one load."""
    robot = jb.robot.load("elkahlout")
    gait = jb.planner.CosineGait.preset(robot, 4)
    base = variant.split(",")[0]
    numbers = {**SHORT, **({"body_time": 1.0} if base == "repaired" else {}), **PAYLOADS[variant]}
    reflex = getattr(PayloadReflex, base)(robot, gait, **numbers)
    experiment = jb.batch.Experiment(
        robot,
        {variant: Controller(gait, reflex)},
        jb.batch.grid(load_kg=(LOAD,), load_time_s=(LOAD_TIME,)),
        jb.sim.own_options(robot, gait),
        duration=4.2 if base != "repaired" else 5.0,
    )
    return Problem.of(experiment, names)


def landing(variant: str, names: Any = ("landing",)) -> Problem:
    """surena3 with a landing variant, onto a pad and into a hole under its second step, until the next one lands."""
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, 4)
    controller = Controller(gait, getattr(Landing, variant.split(",")[0])(**LANDINGS[variant]))
    scenarios = jb.batch.grid(step_1_height_m=(PAD, -PAD))
    duration = float(gait.timing.touchdown(2)) + 0.2
    experiment = jb.batch.Experiment(robot, {variant: controller}, scenarios, duration=duration)
    return Problem.of(experiment, names)


def problems() -> dict[str, tuple[Callable[[], Problem], int]]:
    """By name: how to make a problem, and the row of its scenario."""
    loads = {f"elkahlout, {variant}": (lambda variant=variant: payload(variant), 0) for variant in PAYLOADS}
    pads = {
        f"surena3, {variant}, {where}": (lambda variant=variant: landing(variant), row)
        for variant in LANDINGS
        for row, where in enumerate(("pad", "hole"))
    }
    return loads | pads


def main() -> None:
    """Walk, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("only", nargs="*", help="parts of the names of the cases to walk; all if not given")
    only = parser.parse_args().only
    print(f"{'':30s}{'forward':>12s}{'in a tooth':>12s}{'three ticks':>12s}{'jumps':>7s}   per unit")
    for name, (make, row) in problems().items():
        if only and not any(part in name for part in only):
            continue
        print(name)
        problem = make()
        for one in teeth.scan(problem, problem.start, row):
            t = one.tunable
            numbers = f"{one.forward:12.4g}{one.inside:12.4g}{one.over:12.4g}{one.jumps:7d}"
            print(f"  {t.name:28s}{numbers}   {t.unit}", flush=True)


if __name__ == "__main__":
    with jax.enable_x64(True):
        main()

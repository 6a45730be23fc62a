"""Problems of tuning that several test files share."""

from typing import Any

import numpy as np

import jaxbiped as jb
from jaxbiped.adapt import Controller, Landing, PayloadReflex
from jaxbiped.batch import Choice, Uniform
from jaxbiped.tune import Problem

PAYLOAD = (
    "payload.x_left_left_swings",
    "payload.x_right_right_swings",
    "payload.reflex_time",
    "payload.x_ref_gain",
)
LANDING = ("landing.T_mod", "landing.descent_speed", "landing.delta_x_scale", "landing.release_share")


def payload(
    n: int,
    duration: float,
    names: Any = PAYLOAD,
    heaviest: float = 8.0,
    seed: int = 1,
    friction: float = 0.8,
) -> Problem:
    """elkahlout with the modified reflex and a load at any time of its first step."""
    robot = jb.robot.load("elkahlout")
    gait = jb.planner.CosineGait.preset(robot, 6)
    variant = Controller(gait, PayloadReflex.modified(robot, gait))
    loads: dict[str, Any] = {"load_kg": Uniform(3.0, heaviest), "load_time_s": Uniform(1.5, 3.5)}
    scenarios = jb.batch.draw(n, seed, **loads, friction=friction)
    options = jb.sim.own_options(robot, gait)
    return Problem.of(
        jb.batch.Experiment(robot, {"modified": variant}, scenarios, options, duration=duration), names
    )


def landing(n: int, duration: float, names: Any = LANDING, seed: int = 1) -> Problem:
    """surena3 with the repaired landing and a pad or a hole under its second step."""
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, 6)
    variant = Controller(gait, Landing.repaired())
    heights = tuple(float(h) for h in np.linspace(-0.04, 0.04, 33) if abs(h) > 0.004)
    scenarios = jb.batch.draw(n, seed, step_1_height_m=Choice(heights), friction=Uniform(0.6, 1.0))
    return Problem.of(jb.batch.Experiment(robot, {"repaired": variant}, scenarios, duration=duration), names)

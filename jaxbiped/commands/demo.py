"""`jaxbiped demo`: both papers' walks, planned, and one of them simulated over obstacles."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxbiped import adapt, kinematics, planner, robot, sim
from jaxbiped.commands.common import (
    figures_module,
    make_writable,
    outcome,
    outcome_in_words,
    refusing,
    targets_at,
)

N_STEPS = 8
"""Steps of the demonstration: four walking cycles, as in khadiv section 4."""
OBSTACLES = {2: 0.03, 4: 0.02, 6: 0.04}
"""Obstacles of the demonstration: step number and height [m]; the step after each is a retard landing."""
TRACE_DT = 0.01
"""Between two samples of a drawn trace [s]."""


@dataclass(frozen=True)
class Demo:
    """Plan both papers' walks, say how feasible they are, walk one over unknown obstacles, and draw it all."""

    out: Path = Path("runs/demo")
    """Folder of the figures; made if it is missing."""
    json: bool = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Plan:
    """A planned walk, sampled from rest to rest."""

    robot: robot.RobotParams
    gait: planner.Gait
    task: planner.TaskSpace
    phase: planner.Phase
    feasibility: planner.Feasibility


def run(command: Demo) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    figures, out = figures_module(), command.out
    with refusing(out, "a folder that can be made and written"):
        make_writable(out)
    surena, elkahlout = robot.load("surena3"), robot.load("elkahlout")
    walks = {
        "surena3": _plan(surena, planner.PolynomialGait.preset(surena, N_STEPS)),
        "elkahlout": _plan(elkahlout, planner.CosineGait.preset(elkahlout, N_STEPS)),
    }
    drawn = _draw_surena3(figures, walks["surena3"]) | _draw_elkahlout(figures, walks["elkahlout"])
    print("walking surena3 over three obstacles, with and without landing adaptation", flush=True)
    simulated = _walk_over_obstacles(surena, walks["surena3"].gait)
    drawn |= _draw_obstacles(figures, walks["surena3"].gait, simulated)
    files = [figures.save(figure, out / f"{name}.png") for name, figure in drawn.items()]
    summaries = {name: _summary(walk) for name, walk in walks.items()}
    outcomes = {name: outcome(walk) for name, walk in simulated.items()}
    for summary in summaries.values():
        print(_in_words(summary))
    print(
        f"surena3 in simulation over obstacles of {', '.join(f'{100 * h:g}' for h in OBSTACLES.values())} cm:"
    )
    for name, one in outcomes.items():
        print(f"  {name}: {outcome_in_words(one)}")
    print(f"{len(files)} figures in {out}")
    return {"walks": summaries, "obstacles": outcomes, "files": [str(file) for file in files]}


def _walk_over_obstacles(params: robot.RobotParams, gait: Any) -> dict[str, sim.Walk]:
    scenario = sim.Scenario.flat()
    for step, height in OBSTACLES.items():
        scenario = scenario.with_obstacle(params, gait, step, height)
    options = sim.Options()
    options = replace(options, trace_every=round(TRACE_DT / options.control_dt))
    controllers = {
        "landing adaptation": adapt.Controller(gait, landing=adapt.Landing.repaired()),
        "no adaptation": adapt.Controller(gait),
    }
    duration = float(gait.duration) + 0.5
    return {
        name: sim.rollout(params, controller, scenario, duration, options)
        for name, controller in controllers.items()
    }


def _draw_obstacles(figures: ModuleType, gait: Any, walks: dict[str, sim.Walk]) -> dict[str, Any]:
    heights = ", ".join(f"{100 * height:g}" for height in OBSTACLES.values())
    what = f"surena3 over unknown obstacles of {heights} cm"
    traces: dict[str, Any] = {name: walk.trace for name, walk in walks.items()}
    adapted = traces["landing adaptation"]
    return {
        "surena3_obstacles_tilt_and_forces": figures.tilt_and_forces(traces, f"Simulated: {what}"),
        "surena3_obstacles_modifications": figures.modifications(
            adapted, targets_at(gait, adapted.time).position, f"Added to the plan: {what}"
        ),
    }


def _plan(params: robot.RobotParams, gait: planner.Gait) -> Plan:
    times = planner.sample_times(gait)
    targets = targets_at(gait, times)
    report = planner.feasibility(params, gait, times)
    return Plan(params, gait, targets.position, targets.phase, report)


def _draw_surena3(figures: ModuleType, walk: Plan) -> dict[str, Any]:
    what = f"surena3, polynomial gait, {N_STEPS} steps"
    time = walk.feasibility.time
    return {
        "khadiv_fig6_feet": figures.feet(time, walk.task, walk.phase, f"Feet in the world: {what}"),
        "khadiv_fig7_pelvis": figures.pelvis(time, walk.task, walk.phase, f"Pelvis in the world: {what}"),
        "khadiv_fig8_zmp_x": figures.zmp(walk.feasibility, walk.phase, 0, f"Sagittal ZMP: {what}"),
        "khadiv_fig9_zmp_y": figures.zmp(walk.feasibility, walk.phase, 1, f"Lateral ZMP: {what}"),
        "surena3_feasibility": figures.feasibility_page(walk.feasibility, walk.phase, f"Feasibility: {what}"),
    }


def _draw_elkahlout(figures: ModuleType, walk: Plan) -> dict[str, Any]:
    what = f"elkahlout, cosine gait, {N_STEPS} steps"
    cycle_time, cycle = _cycle(walk.gait)
    return {
        "elkahlout_fig3_2_feet": figures.feet_in_body(
            cycle_time, cycle.position, cycle.phase, "Feet in the body frame: elkahlout, one cycle"
        ),
        "elkahlout_zmp_x": figures.zmp(walk.feasibility, walk.phase, 0, f"Sagittal ZMP: {what}"),
        "elkahlout_zmp_y": figures.zmp(walk.feasibility, walk.phase, 1, f"Lateral ZMP: {what}"),
        "elkahlout_feasibility": figures.feasibility_page(
            walk.feasibility, walk.phase, f"Feasibility: {what}"
        ),
    }


def _cycle(gait: Any, samples: int = 1000) -> tuple[np.ndarray, planner.Targets]:
    """One cycle of the cosine gait over the thesis' own time [s], which begins T_ini after the start."""
    time = np.linspace(0.0, 2.0 * float(gait.params.T_c), samples)
    return time, targets_at(gait, jnp.asarray(time) + gait.params.T_ini)


def _summary(walk: Plan) -> dict[str, Any]:
    def worst(reduce: Callable, values: Any) -> float:
        return float(reduce(np.asarray(values)))

    report = walk.feasibility
    return {
        "robot": walk.robot.name,
        "gait": type(walk.gait).__name__,
        "steps": N_STEPS,
        "duration_s": round(float(walk.gait.duration), 6),
        "zmp_margin_min_m": worst(np.min, report.zmp_margin),
        "friction_max": worst(np.max, report.friction),
        "torque_share_max": worst(np.max, report.torque_share),
        "speed_share_max": worst(np.max, report.speed_share),
        "knee_bend_min_rad": worst(np.min, report.knee),
        "in_reach": bool(np.all(np.asarray(report.ik_status) == kinematics.OK)),
    }


def _in_words(s: dict[str, Any]) -> str:
    return (
        f"{s['robot']}, {s['gait']}: {s['steps']} steps in {s['duration_s']:.1f} s\n"
        f"  smallest ZMP margin {1e3 * s['zmp_margin_min_m']:.1f} mm,"
        f" largest friction {s['friction_max']:.3f},"
        f" torque {s['torque_share_max']:.0%} and speed {s['speed_share_max']:.0%} of the limit,"
        f" smallest knee bend {np.degrees(s['knee_bend_min_rad']):.1f} deg"
    )

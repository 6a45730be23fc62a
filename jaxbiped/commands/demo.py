"""`jaxbiped demo`: the main job in the small, on both robots: plans, a grid of loads, a grid of obstacles, one page."""

import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
import polars as pl
from jaxtyping import Array
from tyro.conf import arg

from jaxbiped import adapt, batch, kinematics, planner, robot, sim
from jaxbiped.batch import records, store
from jaxbiped.batch.run import MAX_WORKERS
from jaxbiped.commands import batches, obstacles, payload, replay, walk
from jaxbiped.commands.common import (
    OVERWRITE_HELP,
    draw,
    figures_module,
    key_in,
    make_writable,
    outcome,
    outcome_in_words,
    plain,
    refusing,
    require_folder,
    require_free,
    whole,
    write,
)

NUMBERS, PAGE, RECOVERED = "demo.json", "demo.html", "recovery"
FIGURES = (
    "khadiv_fig6_feet",
    "khadiv_fig7_pelvis",
    "khadiv_fig8_zmp_x",
    "khadiv_fig9_zmp_y",
    "surena3_feasibility",
    "elkahlout_fig3_2_feet",
    "elkahlout_zmp_x",
    "elkahlout_zmp_y",
    "elkahlout_feasibility",
    "surena3_obstacles_tilt_and_forces",
    "surena3_obstacles_modifications",
)
N_STEPS = 8
"""Steps of the demonstration: four walking cycles, as in khadiv section 4."""
OBSTACLES = {2: 0.03, 4: 0.02, 6: 0.04}
"""Obstacles of the demonstration: step number and height [m]; the step after each is a retard landing."""
TRACE_DT = 0.01
"""Time between two samples of a drawn trace [s]."""


RECOVERY = {"variant": "modified", "load_kg": 15.0, "time_s": 1.2}
"""The walk under a load that is drawn."""


@dataclass(frozen=True)
class Demo:
    """Plan both papers' walks, test them under loads and over obstacles by the dozen, and put it all on one page."""

    out: Path = Path("runs/demo")
    """Folder of the page, the tables and the figures; made if it is missing."""
    workers: Annotated[int | None, arg(help=batches.WORKERS_HELP)] = None
    overwrite: Annotated[bool, arg(help=OVERWRITE_HELP)] = False
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
    out = command.out
    if command.workers is not None:
        whole("--workers", command.workers, 1, MAX_WORKERS)
    require_folder(out)
    with batch.waiting("planning"):
        key = _claim(command)
    robots = {name: robot.load(name) for name in ("surena3", "elkahlout")}
    walks = {name: plan_of(one, planner.own_gait(one, N_STEPS)) for name, one in robots.items()}
    summaries = {name: summary_of(walk) for name, walk in walks.items()}
    for summary in summaries.values():
        print(in_words(summary), flush=True)
    loads, pads = payload.run(_payload(command)), obstacles.run(_obstacles(command))
    print("simulating surena3 over three obstacles, with and without landing adaptation", flush=True)
    with batch.waiting("compiling and simulating two walks"):
        simulated = _walk_over_obstacles(robots["surena3"], walks["surena3"].gait)
    outcomes = {name: outcome(walk) for name, walk in simulated.items()}
    for name, one in outcomes.items():
        print(f"  {name}: {outcome_in_words(one)}", flush=True)
    recovery = _recovery(command)
    result = {
        "walks": summaries,
        "payload": loads["cells"],
        "obstacles": pads["cells"],
        "three_obstacles": outcomes,
        "recovery": {name: recovery[name] for name in ("success", "status", "peak_pitch_deg", "agrees")},
    }
    write(out / NUMBERS, json.dumps(plain({"key": key, **result}), indent=1))
    drawn = draw(lambda figures: _draw(figures, walks, simulated), out)
    files = [*drawn, *loads["files"], *pads["files"], *recovery["files"]]
    page = None if figures_module() is None else _page(out, recovery["files"])
    where = "" if page is None else f"; all of it on one page: {page}"
    print(f"{NUMBERS}, two tables and {len(files)} figures in {out}{where}")
    return {**result, "page": None if page is None else str(page), "files": files}


def _payload(command: Demo) -> payload.Payload:
    return payload.Payload(out=command.out / "payload", workers=command.workers, overwrite=command.overwrite)


def _obstacles(command: Demo) -> obstacles.Obstacles:
    return obstacles.Obstacles(
        out=command.out / "obstacles", workers=command.workers, overwrite=command.overwrite
    )


def _claim(command: Demo) -> str:
    """Refuse folders that hold something else, before anything is done; returns the key of this demonstration."""
    key = records.digest(store.code())
    names = (NUMBERS, PAGE, *(f"{name}.png" for name in FIGURES))
    names += tuple(f"{RECOVERED}/{name}" for name in walk.FILES)
    require_free(command.out, names, key_in(command.out / NUMBERS) == key, command.overwrite)
    loads, pads = _payload(command), _obstacles(command)
    batches.claim(payload.set_up(loads)[0], loads, payload.FIGURES)
    batches.claim(obstacles.set_up(pads), pads, obstacles.FIGURES)
    make_writable(command.out)
    if key_in(command.out / NUMBERS) != key:
        write(command.out / NUMBERS, json.dumps({"key": key}))
    return key


def _draw(figures: ModuleType, walks: Mapping[str, Plan], simulated: Mapping[str, Any]) -> dict[str, Any]:
    return {
        **_draw_surena3(figures, walks["surena3"]),
        **_draw_elkahlout(figures, walks["elkahlout"]),
        **_draw_obstacles(figures, walks["surena3"].gait, simulated),
    }


def _recovery(command: Demo) -> dict[str, Any]:
    """One row of the grid of loads again, with its figures."""
    out = command.out
    experiment, table = batch.open_table(out / "payload")
    start = float(next(iter(experiment.variants.values())).gait.clock_start)
    wanted = (
        (pl.col("variant") == RECOVERY["variant"])
        & (pl.col("load_kg") == RECOVERY["load_kg"])
        & ((pl.col("load_time_s") - start - RECOVERY["time_s"]).abs() < 1e-6)
    )
    row = int(table.filter(wanted)["row"][0])
    return replay.run(replay.Replay(out / "payload", row, out / RECOVERED, overwrite=command.overwrite))


def _page(out: Path, recovery: list[str]) -> Path:
    """Both tables, and the pictures of one walk over obstacles and of one recovery, in one file."""
    from jaxbiped.report import overview, page

    sections = []
    for name in ("payload", "obstacles"):
        sections += overview.sections(
            *batch.open_table(out / name), about=f"{name.capitalize()}: ", folder=out / name
        )
    heights = ", ".join(f"{100 * height:g}" for height in OBSTACLES.values())
    walked = sorted(str(file) for file in out.glob("surena3_obstacles_*.png"))
    sections += [
        _pictures(f"One walk of surena3 over {heights} cm", walked),
        _pictures("One walk of elkahlout: 15 kg at 1.2 s, modified reflex", recovery),
    ]
    with refusing(out, "a place that can be written, with room for the page"):
        return page.write_page(out / PAGE, "jaxbiped: walks under loads and over obstacles", sections)


def _pictures(heading: str, files: list[str]) -> Any:  # noqa: ANN401
    from jaxbiped.report.page import Picture, Section

    return Section(
        heading, figures=tuple(Picture(Path(file), Path(file).stem.replace("_", " ")) for file in files)
    )


def _walk_over_obstacles(params: robot.RobotParams, gait: planner.Gait) -> dict[str, sim.Walk]:
    scenario = sim.Scenario.flat()
    for step, height in OBSTACLES.items():
        scenario = scenario.with_obstacle(params, gait, step, height)
    options = sim.Options()
    options = replace(options, trace_every=round(TRACE_DT / options.control_dt))
    controllers = {
        "landing adaptation": adapt.Controller(gait, adapt.Landing.repaired()),
        "no adaptation": adapt.Controller(gait),
    }
    duration = float(gait.duration) + 0.5

    def walk(controller: adapt.Controller) -> sim.Walk:
        return sim.rollout(params, controller, scenario, duration, options)

    # Side by side, since most of the time goes into compiling, which takes one core each.
    with ThreadPoolExecutor(len(controllers)) as pool:
        return dict(zip(controllers, pool.map(walk, controllers.values()), strict=True))


def _draw_obstacles(figures: ModuleType, gait: planner.Gait, walks: Mapping[str, Any]) -> dict[str, Any]:
    heights = ", ".join(f"{100 * height:g}" for height in OBSTACLES.values())
    what = f"surena3 over unknown obstacles of {heights} cm"
    traces: dict[str, Any] = {name: walk.trace for name, walk in walks.items()}
    adapted = traces["landing adaptation"]
    return {
        "surena3_obstacles_tilt_and_forces": figures.tilt_and_forces(traces, f"Simulated: {what}"),
        "surena3_obstacles_modifications": figures.modifications(
            adapted, planner.targets_at(gait, adapted.time).position, f"Added to the plan: {what}"
        ),
    }


def plan_of(params: robot.RobotParams, gait: planner.Gait) -> Plan:
    """Sample a plan and what it takes."""
    times = planner.sample_times(gait)
    targets = planner.targets_at(gait, times)
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


def _cycle(gait: planner.Gait, samples: int = 1000) -> tuple[np.ndarray, planner.Targets]:
    """One cycle of the cosine gait over the thesis' own time [s], which begins T_ini after the start."""
    time = np.linspace(0.0, 2.0 * float(gait.params.T_c), samples)
    return time, planner.targets_at(gait, jnp.asarray(time) + gait.params.T_ini)


def summary_of(walk: Plan) -> dict[str, Any]:
    """Feasibility of a plan in numbers."""

    def worst(reduce: Callable[[np.ndarray], float], values: Array) -> float:
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


def in_words(s: dict[str, Any]) -> str:
    """The numbers of `summary_of` as text to read."""
    return (
        f"{s['robot']}, {s['gait']}: {s['steps']} steps in {s['duration_s']:.1f} s\n"
        f"  smallest ZMP margin {1e3 * s['zmp_margin_min_m']:.1f} mm,"
        f" largest friction {s['friction_max']:.3f},"
        f" torque {s['torque_share_max']:.0%} and speed {s['speed_share_max']:.0%} of the limit,"
        f" smallest knee bend {np.degrees(s['knee_bend_min_rad']):.1f} deg"
    )

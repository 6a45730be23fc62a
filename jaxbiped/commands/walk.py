"""`jaxbiped walk`: one walk of one robot, told in a few lines and drawn as the two papers draw it."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import jax
import numpy as np
from tyro.conf import UseAppendAction, arg

from jaxbiped import batch, planner, score, sim
from jaxbiped.adapt.landing import nominal_T_mod
from jaxbiped.batch import records, store
from jaxbiped.commands import walk_words
from jaxbiped.commands.choices import ALLOW_HELP, GAIT_NAMES, broken
from jaxbiped.commands.common import (
    OVERWRITE_HELP,
    InputError,
    draw,
    key_in,
    make_writable,
    outcome,
    plain,
    refusing,
    require_folder,
    require_free,
    write,
)
from jaxbiped.commands.walk_input import VARIANTS, Setup, set_up
from jaxbiped.report import traces

EXPERIMENT, NUMBERS, MOVIE = "experiment.toml", "walk.json", "walk.gif"
FIGURES = (
    "khadiv_fig6_feet",
    "khadiv_fig7_pelvis",
    "khadiv_fig8_9_zmp",
    "khadiv_fig12_13_forces_and_tilt",
    "khadiv_fig11_modifications",
    "elkahlout_fig4_3_references",
    "elkahlout_fig4_4_pitch",
    "elkahlout_fig3_3_force_and_trigger",
    "elkahlout_fig3_5_3_7_3_8_close_ups",
    "elkahlout_fig4_12_settling_zmp",
)
"""Names of all figures that a walk may have."""
FILES = (EXPERIMENT, NUMBERS, *(f"{name}.png" for name in FIGURES), MOVIE)
"""Names of all files that a walk may leave."""
DRAWN_EVERY = 5
"""Samples of the trace between two that are drawn, but for close-ups and filters."""

Words = tuple[tuple[str, ...], ...]
"""Values of an argument that may be given several times, each time with several values."""

GAIT_HELP = "Default: the gait of the robot's own paper."
OBSTACLE_HELP = (
    "Pads under footholds: number of the step, 0 for the first, and height in m, negative for a hole. "
    "Example: 3:0.03 4:-0.02"
)
PAYLOAD_HELP = (
    "One load put on the trunk: mass in kg, and time in s since the start of the walk; the time of the cosine gait's "
    "thesis begins T_ini later. Example: 15@2.4"
)
VARIANT_HELP = (
    "Which adaptation is on. Landing: paper (to the letter) or repaired. Payload reflex: original (settles 2 s), "
    "modified (settles 4 s) or repaired. 'repaired' is for every stage that no other word is for; a stage without a "
    "word is off. Or the file of a variant (.toml), alone. Default: landing repaired if there are obstacles, reflex "
    "modified if there is a payload."
)


@dataclass(frozen=True)
class Walk:
    """Simulate one walk, over obstacles and under a payload the robot does not know of; say what happened; draw it."""

    robot: str
    """Name of a preset (elkahlout, surena3) or path of a robot file (.toml)."""
    steps: int = 8
    """Number of steps."""
    gait: Annotated[str | None, arg(metavar=GAIT_NAMES, help=GAIT_HELP)] = None
    obstacle: Annotated[Words, UseAppendAction, arg(metavar="STEP:HEIGHT ...", help=OBSTACLE_HELP)] = ()
    payload: Annotated[Words, UseAppendAction, arg(metavar="MASS@TIME", help=PAYLOAD_HELP)] = ()
    variant: Annotated[
        Words, UseAppendAction, arg(metavar="|".join(VARIANTS) + " ...", help=VARIANT_HELP)
    ] = ()
    allow_infeasible: Annotated[bool, arg(help=ALLOW_HELP)] = False
    out: Path = Path("runs/walk")
    """Folder of experiment.toml, walk.json and the figures; made if it is missing."""
    overwrite: Annotated[bool, arg(help=OVERWRITE_HELP)] = False
    json: bool = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Told:
    """A simulated walk and what was read off it."""

    setup: Setup
    walk: sim.Walk
    verdict: score.Verdict
    nominal: planner.TaskSpace
    """The plan at the trace's times, not a number where a reflex is in its place."""
    touches: list[score.Touch]
    recoveries: list[score.Recovery]


def run(command: Walk) -> dict[str, Any]:
    """Carry out the command; returns what --json prints."""
    out, obstacles = command.out, _flat("--obstacle", command.obstacle)
    payload, variants = _flat("--payload", command.payload), _flat("--variant", command.variant)
    require_folder(out)
    with batch.waiting("planning"):
        allow = command.allow_infeasible
        setup = set_up(command.robot, command.steps, command.gait, obstacles, payload, variants, allow)
    claim(setup, out, command.overwrite)
    with refusing(out, "a place that can be written"):
        batch.write_experiment(out / EXPERIMENT, setup.experiment)
    result = tell(setup, simulate(setup), out)
    print(f"{EXPERIMENT}, {NUMBERS} and {len(result['files'])} figures in {out}")
    return result


def claim(setup: Setup, out: Path, overwrite: bool) -> None:
    """Make the folder; refuse it if files of another walk would be replaced, or drop them if that is allowed."""
    names, ours = FILES, key_in(out / NUMBERS) == key_of(setup)
    require_free(out, names, ours, overwrite)
    make_writable(out)
    for name in () if ours else names:
        with refusing(out / name, "files that may be deleted"):
            (out / name).unlink(missing_ok=True)


def key_of(setup: Setup) -> str:
    """Hash of all that decides a walk."""
    parts = (setup.robot, setup.controller, setup.scenario, setup.options)
    said = [*map(records.to_json, parts), setup.duration, store.code()]
    return records.digest(said)


def _flat(argument: str, given: Words) -> list[str]:
    if () in given:
        raise InputError(f"{argument}: got no value, allowed: one or more")
    return [word for words in given for word in words]


def tell(setup: Setup, walk: sim.Walk, out: Path) -> dict[str, Any]:
    """Print what happened in a walk, write its numbers and draw it into a folder; returns the numbers and the files."""
    told = _tell(setup, walk)
    result = _result(told)
    print("\n".join(walk_words.lines(result)), flush=True)
    write(out / NUMBERS, json.dumps(plain({"key": key_of(setup), **result}), indent=1))
    return {**result, "files": draw(lambda figures: _draw(figures, told), out)}


def simulate(setup: Setup) -> sim.Walk:
    """The walk of a setup, with its trace, on the host."""
    with batch.waiting(f"compiling and simulating {setup.duration:.0f} s of walking") as told:
        given = (setup.robot, setup.controller, setup.scenario, setup.duration, setup.options)
        walk = sim.rollout(*given, told)
        return jax.tree.map(np.asarray, walk)


def _tell(setup: Setup, walk: sim.Walk) -> Told:
    assert walk.trace is not None and walk.controller is not None
    trace, stage = walk.trace, setup.controller.stage("payload")
    state = None if stage is None else walk.controller.stages["payload"]
    shifts = (0.0, 0.0) if state is None else (float(state.world_shift), float(state.x_shift))
    plan = planner.targets_at(setup.gait, trace.targets.time).position
    return Told(
        setup=setup,
        walk=walk,
        verdict=score.judge(walk, setup.gait, setup.scenario),
        nominal=traces.nominal(plan, trace, *shifts),
        touches=score.touches(trace),
        recoveries=[] if stage is None else score.recoveries(trace, stage.params),
    )


def _result(told: Told) -> dict[str, Any]:
    """Everything that is printed, in SI units but where a name says otherwise."""
    setup, verdict = told.setup, told.verdict
    start = round(float(setup.gait.clock_start), 6) or None
    load = None
    if setup.load is not None:
        load = {
            "mass_kg": setup.load.mass,
            "time_s": setup.load.time,
            "end_s": setup.load.end,
            "thesis_time_s": _later(setup.load.time, start),
        }
    until = float(verdict.until)
    return {
        "robot": setup.robot.name,
        "gait": setup.gait_name,
        "steps": int(setup.gait.timing.n_steps),
        "planned_s": round(float(setup.gait.duration), 4),
        "constraints_broken": broken(setup.robot, setup.gait),
        "simulated_s": round(setup.duration, 4),
        "variant": asdict(setup.variants),
        "obstacles": [{"step": pad.step, "height_m": pad.height} for pad in setup.obstacles],
        "payload": load,
        "thesis_time_starts_s": start,
        **outcome(told.walk),
        "status": score.STATUS_TEXT[int(verdict.status)],
        "success": bool(verdict.success),
        "finished": bool(verdict.finished),
        "had_to_stand_until_s": round(until, 4) if np.isfinite(until) else None,
        "tilt_margin_deg": float(np.degrees(verdict.tilt_margin)),
        "out_of_reach_s": round(float(verdict.out_of_reach_time), 4),
        "steps_without_touch": _missed(told),
        "touches": [_touch(told, touch) for touch in told.touches],
        "reflexes": [
            {f"{name}_{unit}": _rounded(getattr(r, name)) for name, unit in _OF_REFLEX}
            for r in told.recoveries
        ],
    }


_OF_REFLEX = [
    *((name, "s") for name in ("triggered", "reflex_end", "settled", "shifted", "recovered", "resumed")),
    ("x_shift", "m"),
]


def _missed(told: Told) -> int:
    """Steps that ended without a touch, as far as landing adaptation watches for it."""
    landing = told.setup.controller.stage("landing")
    assert told.walk.controller is not None
    return 0 if landing is None else int(told.walk.controller.stages["landing"].missed)


def _later(time: float, start: float | None) -> float | None:
    return None if start is None else round(time - start, 6)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 5)


def _touch(told: Told, touch: score.Touch) -> dict[str, Any]:
    """A touch, and what adaptation had added to the swing foot's place by the end of the step."""
    assert told.walk.trace is not None
    foot = ("left", "right").index(touch.foot)
    commanded = np.asarray(told.walk.trace.targets.position.sole)[touch.end_row, foot]
    added = commanded - np.asarray(told.nominal.sole)[touch.end_row, foot]
    known = bool(np.all(np.isfinite(added)))
    gait, landing = told.setup.gait, told.setup.controller.stage("landing")
    lead = (
        nominal_T_mod(gait, told.setup.scenario.sensors.delta_z[0, 0]) if landing is None else landing.T_mod
    )
    planned = touch.kind == "planned"
    return {
        "step": touch.step,
        "foot": touch.foot,
        "kind": touch.kind,
        "time_s": round(touch.time, 4),
        "landing": ("advance" if touch.late < 0.0 else "retard") if planned else None,
        "after_T_s_s": round(touch.late, 4) if planned else None,
        "late_s": round(touch.late + float(lead), 4) if planned else None,
        "delta_x_m": round(float(added[0]), 5) if known else None,
        "delta_z_m": round(float(added[2]), 5) if known else None,
    }


def _draw(figures: ModuleType, told: Told) -> dict[str, Any]:
    setup = told.setup
    full = figures.thin(told.walk.trace, 1)
    trace, nominal = figures.thin(full, DRAWN_EVERY), _thin(told.nominal, len(full.time))
    what = walk_words.heading(setup.robot.name, setup.gait_name, int(setup.gait.timing.n_steps))
    time, phase, measured = trace.time, trace.targets.phase, figures.measured_task(trace)
    load = setup.load
    load_time, load_end = (None, None) if load is None else (load.time, load.end)
    events = figures.payload_events(load_time, told.recoveries, load_end)
    touched = {"touch": [touch.time for touch in told.touches]} if setup.load is None else events
    commands = trace.targets.position
    drawn = {
        "khadiv_fig6_feet": figures.feet(
            time, commands, phase, f"Feet, commanded and measured: {what}", measured
        ),
        "khadiv_fig7_pelvis": figures.pelvis(
            time, commands, phase, f"Pelvis, commanded and measured: {what}", measured
        ),
        "khadiv_fig8_9_zmp": figures.measured_zmp(
            trace, figures.commanded(setup.robot, trace), f"ZMP: {what}"
        ),
        "khadiv_fig12_13_forces_and_tilt": figures.tilt_and_forces(
            {"measured": trace}, f"Trunk and feet: {what}", events=touched
        ),
    }
    if setup.controller.stage("landing") is not None:
        drawn["khadiv_fig11_modifications"] = figures.modifications(
            trace, nominal, f"Added to the plan: {what}"
        )
    if setup.load is not None:
        drawn |= _draw_payload(figures, told, full, trace, events, f"{what}, {setup.load.mass:g} kg")
    return drawn


def _thin(nominal: planner.TaskSpace, rows: int) -> planner.TaskSpace:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:rows:DRAWN_EVERY], nominal)


def _draw_payload(
    figures: ModuleType,
    told: Told,
    full: sim.Sample,
    trace: sim.Sample,
    events: dict[str, list[float]],
    what: str,
) -> dict[str, Any]:
    """The thesis' figures; what the payload stage felt and did is left out where it was off or did nothing."""
    drawn = {
        "elkahlout_fig4_3_references": figures.references(trace, events, f"Feet in the body frame: {what}"),
        "elkahlout_fig4_4_pitch": figures.pitch(trace, events, f"Trunk pitch: {what}"),
    }
    stage = told.setup.controller.stage("payload")
    if stage is None:
        return drawn
    felt = figures.felt(full, stage.params)
    drawn["elkahlout_fig3_3_force_and_trigger"] = figures.force_and_trigger(
        full, felt, stage.params, events, f"Felt weight: {what}"
    )
    if told.recoveries:
        first = told.recoveries[0]
        drawn["elkahlout_fig3_5_3_7_3_8_close_ups"] = figures.reflex_close_ups(
            full, first, f"Feet in the body frame, from close by: {what}"
        )
        drawn["elkahlout_fig4_12_settling_zmp"] = figures.settling_zmp(
            full, felt, stage.params, first, f"ZMP while settling: {what}"
        )
    return drawn

"""The console command `jaxbiped`: every command says in a few lines what it did; bad input is exit code 2."""

import contextlib
import io
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxbiped import adapt, kinematics, planner, robot, sim

OK, FAILED, BAD_INPUT = 0, 1, 2
N_STEPS = 8
"""Steps of the demonstration: four walking cycles, as in khadiv section 4."""
OBSTACLES = {2: 0.03, 4: 0.02, 6: 0.04}
"""Obstacles of the demonstration: step number and height [m]; the step after each is a retard landing."""
TRACE_DT = 0.01
"""Between two samples of a drawn trace [s]."""


class InputError(ValueError):
    """Input that cannot be used: one line with the argument, what was got and what is allowed."""


@dataclass(frozen=True)
class Demo:
    """Plan both papers' walks, say how feasible they are, walk one over unknown obstacles, and draw it all."""

    out: Path = Path("runs/demo")
    """Folder of the figures; made if it is missing."""
    json: bool = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Export:
    """Write a robot as an MJCF file that stock MuJoCo loads."""

    robot: str
    """Name of a preset (elkahlout, surena3) or path of a robot file (.toml)."""
    out: Path
    """The file to write (.xml)."""
    json: bool = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Walk:
    """A planned walk, sampled from rest to rest."""

    robot: robot.RobotParams
    gait: planner.Gait
    task: planner.TaskSpace
    phase: planner.Phase
    feasibility: planner.Feasibility


def main(args: list[str] | None = None) -> int:
    """Run the console command; returns the exit code: 0 done, 1 something is missing, 2 bad input."""
    _keep_compiled_kernels()
    try:
        command = _parse(args)
        result = _demo(command) if isinstance(command, Demo) else _export(command)
    except InputError as error:
        return _complain(error, BAD_INPUT)
    except ImportError as error:
        return _complain(error, FAILED)
    except SystemExit as stop:  # --help
        return int(stop.code or OK)
    if command.json:
        print(json.dumps(result))
    return OK


def _complain(error: Exception, code: int) -> int:
    print("jaxbiped:", " ".join(str(error).split()), file=sys.stderr)
    return code


def _keep_compiled_kernels() -> None:
    """Let JAX keep compiled kernels between runs; JAX_COMPILATION_CACHE_DIR, if set, says where."""
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    default = Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
    folder = Path(os.environ.get("XDG_CACHE_HOME") or default) / "jaxbiped" / "jax"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def _parse(args: list[str] | None) -> Demo | Export:
    """Read the arguments; tyro's box of complaints becomes one line."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(Demo | Export, prog="jaxbiped", args=args, description=__doc__)  # type: ignore[arg-type]
    except SystemExit as stop:
        if stop.code in (OK, None):
            raise
        raise InputError(_one_line(complaint.getvalue())) from None


def _one_line(box: str) -> str:
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line).strip(" ─╭╮╰╯│") for line in box.splitlines()]
    return "; ".join(line for line in lines if line)


def _demo(command: Demo) -> dict[str, Any]:
    figures, out = _figures(), command.out
    with _refusing(out, "a folder that can be made and written"):
        _make_writable(out)
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
    outcomes = {name: _outcome(walk) for name, walk in simulated.items()}
    for summary in summaries.values():
        print(_in_words(summary))
    print(
        f"surena3 in simulation over obstacles of {', '.join(f'{100 * h:g}' for h in OBSTACLES.values())} cm:"
    )
    for name, outcome in outcomes.items():
        print(f"  {name}: {_outcome_in_words(outcome)}")
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
            adapted, _targets(gait, adapted.time).position, f"Added to the plan: {what}"
        ),
    }


def _outcome(walk: sim.Walk) -> dict[str, Any]:
    s = walk.statistics
    return {
        "status": sim.STATUS_TEXT[int(s.status)],
        "end_time_s": round(float(s.end_time), 4),
        "peak_roll_deg": float(np.degrees(s.peak_roll_pitch[0])),
        "peak_pitch_deg": float(np.degrees(s.peak_roll_pitch[1])),
        "peak_foot_force_N": float(np.max(s.peak_foot_force)),
        "peak_slip_m": float(np.max(s.peak_slip)),
    }


def _outcome_in_words(o: dict[str, Any]) -> str:
    return (
        f"{o['status']} at {o['end_time_s']:.2f} s, trunk roll up to {o['peak_roll_deg']:.1f} and pitch"
        f" {o['peak_pitch_deg']:.1f} deg, foot force up to {o['peak_foot_force_N']:.0f} N,"
        f" slip {1e3 * o['peak_slip_m']:.0f} mm"
    )


def _figures() -> ModuleType:
    """The figures, imported only when a command draws: matplotlib is an extra."""
    from jaxbiped import report

    return report


def _plan(params: robot.RobotParams, gait: planner.Gait) -> Walk:
    times = planner.sample_times(gait)
    targets = _targets(gait, times)
    report = planner.feasibility(params, gait, times)
    return Walk(params, gait, targets.position, targets.phase, report)


@eqx.filter_jit
def _targets(gait: Any, times: Any) -> planner.Targets:
    return jax.vmap(lambda t: planner.at(gait, t))(times)


def _draw_surena3(figures: ModuleType, walk: Walk) -> dict[str, Any]:
    what = f"surena3, polynomial gait, {N_STEPS} steps"
    time = walk.feasibility.time
    return {
        "khadiv_fig6_feet": figures.feet(time, walk.task, walk.phase, f"Feet in the world: {what}"),
        "khadiv_fig7_pelvis": figures.pelvis(time, walk.task, walk.phase, f"Pelvis in the world: {what}"),
        "khadiv_fig8_zmp_x": figures.zmp(walk.feasibility, walk.phase, 0, f"Sagittal ZMP: {what}"),
        "khadiv_fig9_zmp_y": figures.zmp(walk.feasibility, walk.phase, 1, f"Lateral ZMP: {what}"),
        "surena3_feasibility": figures.feasibility_page(walk.feasibility, walk.phase, f"Feasibility: {what}"),
    }


def _draw_elkahlout(figures: ModuleType, walk: Walk) -> dict[str, Any]:
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
    return time, _targets(gait, jnp.asarray(time) + gait.params.T_ini)


def _summary(walk: Walk) -> dict[str, Any]:
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


def _export(command: Export) -> dict[str, Any]:
    params, out = _load("--robot", command.robot), command.out
    if out.suffix != ".xml" or out.is_dir():
        raise InputError(f"--out: got '{out}', allowed: a file name that ends in .xml")
    with _refusing(out, "a file that can be written"):
        _make_writable(out.parent)
        sim.write_mjcf(params, out)
    mass = round(float(params.total_mass), 3)
    print(f"{params.name}, {mass:g} kg, written to {out}")
    return {"robot": params.name, "mass_kg": mass, "file": str(out)}


def _load(argument: str, name_or_path: str) -> robot.RobotParams:
    try:
        return robot.load(name_or_path)
    except robot.RobotFileError as error:
        raise InputError(f"{argument}: {str(error).removeprefix('robot: ')}") from None
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(
            f"{argument}: got '{name_or_path}' ({error}), allowed: a TOML file in UTF-8"
        ) from None


@contextlib.contextmanager
def _refusing(out: Path, allowed: str) -> Iterator[None]:
    """Turn an error of the file system into one about --out."""
    try:
        yield
    except OSError as error:
        raise InputError(f"--out: got '{out}' ({error.strerror}), allowed: {allowed}") from None


def _make_writable(folder: Path) -> None:
    """Make the folder if it is missing, and try to write into it before any work is done."""
    folder.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()


if __name__ == "__main__":
    sys.exit(main())

"""The standard flat walks on the compliant ground, in C MuJoCo and on MJX contacts, drawn over each other.

surena3 walks 24 steps with torque feed-forward, elkahlout 12 without, open loop, from rest to rest.

    python sweeps/three_simulators.py --out runs/three_simulators
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import jaxbiped as jb
from jaxbiped import report

TRACE_DT = 0.01
WALKS = {"surena3": 24, "elkahlout": 12}
"""Steps of each robot's own gait."""


def simulate(name: str, steps: int | None, mjx_seconds: float) -> tuple[dict[str, jb.sim.Walk], Any, Any]:
    """The walks by simulator, the robot and the gait; on MJX contacts the first `mjx_seconds` [s] only."""
    robot = jb.robot.load(name)
    gait = jb.planner.own_gait(robot, steps or WALKS[name])
    options = replace(jb.sim.own_options(robot, gait), payload_model="exact")  # nothing is carried
    options = replace(options, trace_every=round(TRACE_DT / options.control_dt))
    controller, flat = jb.adapt.Controller(gait), jb.sim.Scenario.flat(rectangles=1)
    duration = float(gait.duration) + 1.0
    walks = {
        "compliant ground": lambda: jb.sim.rollout(robot, controller, flat, duration, options),
        "C MuJoCo": lambda: jb.sim.rollout(
            robot, controller, flat, duration, replace(options, contact="c_mujoco")
        ),
    }
    if mjx_seconds > 0.0:
        walks["MJX contacts"] = lambda: jb.sim.rollout(
            robot, controller, flat, min(duration, mjx_seconds), replace(options, contact="mjx")
        )
    return {label: _timed(label, walk) for label, walk in walks.items()}, robot, gait


def _timed(label: str, walk: Any) -> jb.sim.Walk:
    start = time.perf_counter()
    result = walk()
    float(result.statistics.end_time)
    print(f"  {label}: {time.perf_counter() - start:.1f} s, compilation included", flush=True)
    return result


def row(walk: jb.sim.Walk) -> dict[str, Any]:
    """The numbers of one walk."""
    s = walk.statistics
    roll, pitch = np.degrees(np.asarray(s.peak_roll_pitch))
    return {
        "status": jb.sim.STATUS_TEXT[int(s.status)],
        "end_time_s": round(float(s.end_time), 3),
        "peak_roll_deg": round(float(roll), 3),
        "peak_pitch_deg": round(float(pitch), 3),
        "peak_foot_force_N": round(float(np.max(s.peak_foot_force)), 1),
        "peak_slip_mm": round(1e3 * float(np.max(s.peak_slip)), 2),
        "final_x_m": round(float(np.asarray(s.p_world_trunk)[0]), 4),
    }


def main() -> None:
    """Walk, draw, and print one line a walk."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/three_simulators"))
    parser.add_argument("--robot", choices=list(WALKS), nargs="+", default=list(WALKS))
    parser.add_argument("--steps", type=int, help="instead of the standard number")
    parser.add_argument("--mjx-seconds", type=float, default=1e9, help="how much to walk on MJX contacts [s]")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = {}
    for name in arguments.robot:
        print(name, flush=True)
        walks, robot, gait = simulate(name, arguments.steps, arguments.mjx_seconds)
        rows[name] = {label: row(walk) for label, walk in walks.items()}
        for label, numbers in rows[name].items():
            print(f"  {label}: {numbers}")
        traces: dict[str, Any] = {label: walk.trace for label, walk in walks.items()}
        what = f"{name}, flat, {gait.timing.n_steps} steps"
        own = traces["compliant ground"]
        figures = {
            "tilt_and_forces": report.tilt_and_forces(traces, what),
            "measured_zmp": report.measured_zmp(own, jb.planner.feasibility(robot, gait, own.time), what),
        }
        for kind, figure in figures.items():
            print("  ", report.save(figure, arguments.out / f"{name}_{kind}.png"))
    if arguments.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()

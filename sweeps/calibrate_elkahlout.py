"""elkahlout's assumed numbers against Table 4.1 of its thesis: robots drawn at random, or one robot at every cell.

Table 4.1, without reflex: 2.5 kg is carried at all 48 times, 5 kg and more never. What else a robot must do: carry
15 kg put on at 1.2 s with the original and with the modified reflex, and walk without a load and without a reflex.

python sweeps/calibrate_elkahlout.py --draws 192 --csv draws.csv --keep best
python sweeps/calibrate_elkahlout.py --robot best/robot_12.toml best/robot_7.toml --spread 0.1 --draws 96 --csv near.csv
python sweeps/calibrate_elkahlout.py --robot best/robot_12.toml --full
"""

import argparse
import csv
import dataclasses
import re
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterable
from importlib import resources
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxbiped as jb
from jaxbiped.adapt import Controller, PayloadReflex
from jaxbiped.score import judge
from jaxbiped.sim import feed_forward, mjx_adapter
from jaxbiped.sim.scenario import Ground

OPTIONS = jb.sim.Options(feed_forward=False, control_every=1, payload_model="thesis")
LOADS, TIMES = (2.5, 5.0, 7.5, 10.0, 12.5, 15.0), tuple(round(0.1 * i, 1) for i in range(1, 49))
"""Columns [kg] and rows [s] of Table 4.1."""
CARRIED = 2.5
"""The largest load of Table 4.1 that is carried [kg]."""
PROBES = tuple((load, at) for load in (2.5, 5.0) for at in (0.6, 1.2, 1.9, 2.4))
"""Cells of Table 4.1 by which a drawn robot is judged: (load [kg], time [s])."""
OFF, ORIGINAL, MODIFIED = "off", "original", "modified"
REFLEX_WALKS = ((15.0, 1.2, ORIGINAL), (15.0, 1.2, MODIFIED), (0.0, 1.2, MODIFIED))
"""Walks with a reflex: (load [kg], time [s], arm); the last one shows whether walking alone starts a reflex."""
LARGEST_PITCH = 8.0
"""The trunk may not pitch further in a reflex walk [deg]."""
LANES = 96
"""Walks in a batch."""


@dataclasses.dataclass(frozen=True)
class Lever:
    """An assumed number, or that of several joints at once, and the range it is drawn from."""

    field: str
    joints: tuple[int, ...] | None
    low: float
    high: float


_SAGITTAL, _HIP_ROLL, _ANKLE_PITCH, _ANKLE_ROLL = (0, 2, 3), (1,), (4,), (5,)
LEVERS = {
    "toe": Lever("geometry.sole_toe", None, 0.14, 0.155),
    "heel": Lever("geometry.sole_heel", None, -0.05, -0.08),
    "outer": Lever("geometry.sole_outer", None, 0.07, 0.09),
    "inner": Lever("geometry.sole_inner", None, -0.045, -0.09),
    "kp": Lever("servo.kp", _SAGITTAL, 5e3, 4e4),
    "kp_hip_roll": Lever("servo.kp", _HIP_ROLL, 1e4, 1e5),
    "kp_ankle_pitch": Lever("servo.kp", _ANKLE_PITCH, 1e4, 1e5),
    "kp_ankle_roll": Lever("servo.kp", _ANKLE_ROLL, 5e3, 6e4),
    "kv": Lever("servo.kv", _SAGITTAL, 1e2, 1e3),
    "kv_hip_roll": Lever("servo.kv", _HIP_ROLL, 3e2, 3e3),
    "kv_ankle_pitch": Lever("servo.kv", _ANKLE_PITCH, 1e2, 1e3),
    "kv_ankle_roll": Lever("servo.kv", _ANKLE_ROLL, 1e2, 2e3),
    "limit": Lever("servo.torque_limit", _SAGITTAL, 250.0, 600.0),
    "limit_hip_roll": Lever("servo.torque_limit", _HIP_ROLL, 115.0, 500.0),
    "limit_ankle_pitch": Lever("servo.torque_limit", _ANKLE_PITCH, 140.0, 450.0),
    "limit_ankle_roll": Lever("servo.torque_limit", _ANKLE_ROLL, 45.0, 150.0),
}
"""Numbers of the robot that are drawn, evenly in the logarithm of their magnitude."""
GROUND = {"sinkage": (1e-4, 2e-3), "damping": (3.0, 30.0), "friction": (0.5, 1.2)}
"""Numbers of the ground that are drawn with `--ground` [m], [s/m], []."""

Robot = tuple[str, dict[str, float]]
"""A robot's file, and the numbers of the ground it walks on."""


def preset_text() -> str:
    """The preset's file."""
    return (resources.files("jaxbiped.robot") / "presets" / "elkahlout.toml").read_text(encoding="utf-8")


def read_lever(text: str, lever: Lever) -> float:
    """The number now, of the first of its joints."""
    section, key = lever.field.rsplit(".", 1)
    value = tomllib.loads(text)[section][key]["value"]
    return value if lever.joints is None else value[lever.joints[0]]


def with_numbers(text: str, numbers: dict[str, float]) -> str:
    """The robot file with other numbers, and a foot's box as large as its sole."""
    document = tomllib.loads(text)
    values: dict[str, Any] = {}
    for name, number in numbers.items():
        lever = LEVERS[name]
        section, key = lever.field.rsplit(".", 1)
        if lever.joints is None:
            values[lever.field] = number
        else:
            old = values.get(lever.field, document[section][key]["value"])
            values[lever.field] = [number if j in lever.joints else v for j, v in enumerate(old)]
    edge = {key: values.get(f"geometry.{key}", entry["value"]) for key, entry in document["geometry"].items()}
    length, width = edge["sole_toe"] - edge["sole_heel"], edge["sole_outer"] - edge["sole_inner"]
    values["leg.foot.box"] = [round(length, 4), round(width, 4), document["leg"]["foot"]["box"]["value"][2]]
    return _replace(text, values)


def _replace(text: str, values: dict[str, Any]) -> str:
    section, lines = "", []
    for line in text.splitlines():
        if header := re.fullmatch(r"\[(.+)\]", line):
            section = header[1]
        field = f"{section}.{line.split(' = ', 1)[0]}"
        if field in values:
            line = re.sub(r"value = (\[.*?\]|[^,]+),", f"value = {values[field]},", line, count=1)
        lines.append(line)
    return "\n".join(lines) + "\n"


def load_text(text: str) -> Any:
    """The record of a robot file given as text."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.toml"
        path.write_text(text, encoding="utf-8")
        return jb.robot.load(path)


def draw(centres: list[str], ground: bool, spread: float | None, count: int, seed: int) -> list[Robot]:
    """Robots: a Latin hypercube over the whole ranges, or within exp(+-spread) of points between two centres.

    Of the soles a tenth of the spread. The ground is that of `Scenario.flat` unless it is drawn, over its whole range.
    """
    random = np.random.default_rng(seed)
    limits = {name: (lever.low, lever.high) for name, lever in LEVERS.items()} | (GROUND if ground else {})
    strata = np.stack([random.permutation(count) for _ in limits], axis=1)
    unit = (strata + random.random(strata.shape)) / count
    robots = []
    for row in unit:
        pair = [centres[i] for i in random.integers(len(centres), size=2)]
        numbers = {}
        for (name, (low, high)), u in zip(limits.items(), row, strict=True):
            number = low * (high / low) ** u
            if spread is not None and name in LEVERS:
                first, second = (read_lever(text, LEVERS[name]) for text in pair)
                wide = 0.1 * spread if LEVERS[name].joints is None else spread
                number = first * (second / first) ** random.random() * np.exp((2.0 * u - 1.0) * wide)
                number = np.clip(number, *sorted((low, high)))
            numbers[name] = float(f"{number:.4g}")
        of_ground = {name: numbers.pop(name) for name in GROUND if name in numbers}
        robots.append((with_numbers(pair[0], numbers), of_ground))
    return robots


def reflex(arm: str, robot: Any, gait: Any) -> PayloadReflex | None:
    """The payload stage's parameters."""
    if arm == OFF:
        return None
    return {ORIGINAL: PayloadReflex.original, MODIFIED: PayloadReflex.modified}[arm](robot, gait)


def make_walks(steps: int, duration: float, arm: str) -> Callable[..., Any]:
    """Compiled: robots x (load, time) to successes, roll and pitch [rad], reflexes and end times [s]."""
    gait = jb.planner.CosineGait.preset(jb.robot.load("elkahlout"), steps)
    flat = jb.sim.Scenario.flat(1)

    def one(robot: Any, model: Any, ground: Ground, load: Any, time: Any) -> Any:
        world = eqx.tree_at(
            lambda s: (s.ground, s.payload.mass, s.payload.time),
            flat,
            (ground, load, time + gait.params.T_ini),
        )
        controller = Controller(gait, payload=reflex(arm, robot, gait))
        walk = jb.sim.simulate(robot, model, controller, world, feed_forward.none(), duration, OPTIONS)
        reflexes = 0 if walk.controller.payload is None else walk.controller.payload.reflexes
        stats = walk.statistics
        return judge(walk, gait, world).success, stats.peak_roll_pitch, reflexes, stats.end_time

    over_cells = jax.vmap(one, in_axes=(None, None, None, 0, 0))
    return jb.runtime.jit(jax.vmap(over_cells, in_axes=(0, 0, 0, None, None)))


def ground_of(numbers: dict[str, float]) -> Ground:
    """The default ground but for these numbers."""
    return dataclasses.replace(jb.sim.Scenario.flat(1).ground, **numbers)


def stack(trees: Iterable[Any]) -> Any:
    """Records of one shape, with a leading axis."""
    return jax.tree.map(lambda *leaf: jnp.stack(leaf), *trees)


def _stack_models(models: list[Any]) -> Any:
    """`stack` for MJX models: what they do not hold as arrays is of shapes that touch nothing, the preset's will do."""
    shape = jax.tree.structure(mjx_adapter.base_model(jb.robot.load("elkahlout")))
    return jax.tree.unflatten(shape, map(jnp.stack, zip(*map(jax.tree.leaves, models), strict=True)))


def run(walks: Callable[..., Any], robots: list[Robot], cells: list[tuple[float, float]]) -> list[np.ndarray]:
    """All robots in all cells, batch by batch; the last batch is filled up, to be of one shape."""
    load, time_ = (jnp.asarray(column) for column in zip(*cells, strict=True))
    size = max(1, min(len(robots), LANES // len(cells)))
    parts = []
    for i in range(0, len(robots), size):
        batch = [robots[min(j, len(robots) - 1)] for j in range(i, i + size)]
        records = [load_text(text) for text, _ in batch]
        models = _stack_models([mjx_adapter.base_model(record) for record in records])
        grounds = stack(ground_of(numbers) for _, numbers in batch)
        parts.append([np.asarray(leaf) for leaf in walks(stack(records), models, grounds, load, time_)])
    return [np.concatenate(leaf)[: len(robots)] for leaf in zip(*parts, strict=True)]


def search(robots: list[Robot], keep: Path | None) -> list[dict[str, Any]]:
    """Judge every robot by REFLEX_WALKS, which few pass, and those that do by PROBES; one row each."""
    arms = {arm: make_walks(4, 17.0, arm) for arm in (ORIGINAL, MODIFIED)}
    off = make_walks(4, 9.0, OFF)
    rows: list[dict[str, Any]] = []
    for start in range(0, len(robots), LANES):
        some, began = robots[start : start + LANES], time.monotonic()
        here = [_numbers_row(start + i, robot) for i, robot in enumerate(some)]
        for arm, walks in arms.items():
            cells = [(load, at) for load, at, which in REFLEX_WALKS if which == arm]
            for row, *of_robot in zip(here, *run(walks, some, cells), strict=True):
                row |= _reflex_row(arm, cells, *of_robot)
        good = [i for i, row in enumerate(here) if all(value for key, value in row.items() if "_ok" in key)]
        if good:
            success = run(off, [some[i] for i in good], list(PROBES))[0]
            for i, cells_ok in zip(good, success, strict=True):
                right = int((cells_ok == (np.array(PROBES)[:, 0] <= CARRIED)).sum())
                here[i] |= {"right": right, "cells": "".join(str(int(ok)) for ok in cells_ok)}
                if keep is not None:
                    (keep / f"robot_{start + i}.toml").write_text(some[i][0], encoding="utf-8")
        for row in here:
            print("  ".join(f"{key} {value}" for key, value in row.items() if key not in LEVERS), flush=True)
        print(
            f"{start + len(some)} robots, {len(good)} of the last {len(some)} pass the reflex walks,", end=" "
        )
        print(f"{time.monotonic() - began:.0f} s", flush=True)
        rows += here
    return rows


def _numbers_row(number: int, robot: Robot) -> dict[str, Any]:
    text, ground = robot
    return {"robot": number, **ground, **{name: read_lever(text, lever) for name, lever in LEVERS.items()}}


def _reflex_row(
    arm: str,
    cells: list[tuple[float, float]],
    success: np.ndarray,
    tilt: np.ndarray,
    reflexes: np.ndarray,
    end: np.ndarray,
) -> dict[str, Any]:
    """Columns for the reflex walks of one robot with one arm."""
    row: dict[str, Any] = {}
    for i, (load, _) in enumerate(cells):
        what = f"{arm}_{load:.0f}kg" if load > 0.0 else "flat"
        roll, pitch = np.degrees(tilt[i])
        quiet = pitch < LARGEST_PITCH if load > 0.0 else reflexes[i] == 0
        row |= {f"{what}_ok": int(success[i] and quiet), f"{what}_reflexes": int(reflexes[i])}
        row |= {
            f"{what}_roll": f"{roll:.1f}",
            f"{what}_pitch": f"{pitch:.1f}",
            f"{what}_end": f"{end[i]:.1f}",
        }
    return row


def full(robot: Robot) -> None:
    """One robot in all 288 cells of Table 4.1, and its reflexes."""
    walks = make_walks(8, 11.5, OFF)
    right = 0
    for load in LOADS:
        success = run(walks, [robot], [(load, at) for at in TIMES])[0][0]
        agree = success == (load <= CARRIED)
        right += int(agree.sum())
        wrong = [at for at, ok in zip(TIMES, agree, strict=True) if not ok]
        print(f"off  {load:4.1f} kg  {agree.sum()} of {len(TIMES)} cells right, wrong at {wrong}", flush=True)
    print(f"off  {right} of {len(LOADS) * len(TIMES)} cells of Table 4.1 right")
    for arm in (ORIGINAL, MODIFIED):
        cells = [
            (15.0, 1.2),
            (0.0, 1.2),
            *((load, at) for load in (5.0, 10.0) for at in (0.3, 0.6, 1.9, 2.4)),
        ]
        result = run(make_walks(8, 22.0, arm), [robot], cells)
        for (load, at), success, tilt, reflexes, end in zip(cells, *(r[0] for r in result), strict=True):
            roll, pitch = np.degrees(tilt)
            print(
                f"{arm:8s}  {load:4.1f} kg at {at:.1f} s  {'success' if success else 'failure'}  {end:4.1f} s"
                f"  roll {roll:4.1f}  pitch {pitch:4.1f} deg  {reflexes} reflexes",
                flush=True,
            )


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """One line a robot."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    """Draw robots and judge them, or judge one."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--robot", type=Path, nargs="+", default=[], help="centres, .toml files; the preset if left out"
    )
    parser.add_argument("--full", action="store_true", help="judge the first robot at every cell")
    parser.add_argument("--draws", type=int, default=64, help="robots to draw")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--spread", type=float, help="draw within exp(+-spread) of points between two centres"
    )
    parser.add_argument("--ground", action="store_true", help="draw the ground too")
    parser.add_argument("--csv", type=Path, help="write one line a robot")
    parser.add_argument("--keep", type=Path, help="write the robots' files into this folder")
    for name in GROUND:
        parser.add_argument(f"--{name}", type=float, help="of the ground, with --full")
    args = parser.parse_args()
    texts = [path.read_text(encoding="utf-8") for path in args.robot] or [preset_text()]
    if args.full:
        full((texts[0], {name: getattr(args, name) for name in GROUND if getattr(args, name) is not None}))
        return
    if args.keep is not None:
        args.keep.mkdir(parents=True, exist_ok=True)
    rows = search(draw(texts, args.ground, args.spread, args.draws, args.seed), args.keep)
    if args.csv is not None:
        write_csv(args.csv, rows)


if __name__ == "__main__":
    main()

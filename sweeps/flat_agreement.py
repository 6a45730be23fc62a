"""Do the compliant ground and C MuJoCo agree on who walks? Randomised flat walks, open loop, the same in both.

Masses of the links, friction, gains of the servos and ground stiffness are each uniform within 20 % of nominal.

    python sweeps/flat_agreement.py --robot surena3 --n 256 --steps 4
"""

import argparse
import json
import multiprocessing
import sys
import time
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbiped import robot
from jaxbiped.adapt import Controller
from jaxbiped.planner import CosineGait, PolynomialGait
from jaxbiped.sim import Options, Scenario, prepare
from jaxbiped.sim.replay_c import open_loop_references, replay_c
from jaxbiped.sim.statistics import STATUS_TEXT

SPREAD = 0.2
CHUNK = 64
COLUMNS = ("status", "end_time", "peak_roll_pitch", "peak_foot_force", "peak_slip", "p_world_trunk")


def scenarios(n: int, seed: int) -> Scenario:
    """`n` flat scenarios with a leading axis."""
    rng = np.random.default_rng(seed)
    flat = Scenario.flat()

    def factors(*shape: int) -> np.ndarray:
        return rng.uniform(1.0 - SPREAD, 1.0 + SPREAD, (n, *shape))

    batch = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), flat)
    new = (
        factors(13),
        factors(2, 6),
        float(flat.ground.friction) * factors(),
        float(flat.ground.sinkage) / factors(),
    )
    return eqx.tree_at(
        lambda s: (s.errors.mass_scale, s.errors.gain_scale, s.ground.friction, s.ground.sinkage),
        batch,
        tuple(jnp.asarray(value, jnp.result_type(float)) for value in new),
    )


def walk(name: str, steps: int) -> tuple[robot.RobotParams, Controller, float, Options]:
    """The robot, its preset gait, the duration [s] with half a second of rest, and options."""
    params = robot.load(name)
    gait = (PolynomialGait if name == "surena3" else CosineGait).preset(params, n_steps=steps)
    duration = round(float(gait.duration) + 0.5, 3)
    return params, Controller(gait), duration, Options(feed_forward=name == "surena3")


def compliant(name: str, steps: int, batch: Scenario) -> dict[str, np.ndarray]:
    """Statistics on the compliant ground, in chunks of one shape."""
    params, controller, duration, options = walk(name, steps)
    simulation = prepare(params, controller, options)
    n = batch.payload.mass.shape[0]
    parts = []
    for start in range(0, n, CHUNK):
        rows = np.minimum(np.arange(start, start + CHUNK), n - 1)
        chunk = jax.tree.map(lambda leaf, rows=rows: leaf[rows], batch)
        parts.append(jax.tree.map(np.asarray, simulation.run_many(chunk, duration).statistics))
    return {column: np.concatenate([getattr(p, column) for p in parts])[:n] for column in COLUMNS}


def native(name: str, steps: int, batch: Scenario) -> dict[str, np.ndarray]:
    """Statistics in C MuJoCo, one after the other."""
    params, controller, duration, options = walk(name, steps)
    references = open_loop_references(params, controller, duration, options)
    rows = []
    for i in range(batch.payload.mass.shape[0]):
        scenario = jax.tree.map(lambda leaf, i=i: jnp.asarray(leaf[i]), batch)
        rows.append(replay_c(params, controller, scenario, duration, options, references).statistics)
    return {column: np.stack([np.asarray(getattr(row, column)) for row in rows]) for column in COLUMNS}


def native_in_processes(name: str, steps: int, batch: Scenario, processes: int) -> dict[str, np.ndarray]:
    """The same, shared out between processes."""
    shares = np.array_split(np.arange(batch.payload.mass.shape[0]), processes)
    parts = [jax.tree.map(lambda leaf, s=share: np.asarray(leaf)[s], batch) for share in shares]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        done = pool.map(partial(native, name, steps), parts)
    return {column: np.concatenate([d[column] for d in done]) for column in COLUMNS}


def tilt_deg(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Largest of roll and pitch in each walk [deg]."""
    return np.rad2deg(columns["peak_roll_pitch"].max(axis=1))


def describe(
    i: int, batch: Scenario, one: dict[str, np.ndarray], other: dict[str, np.ndarray]
) -> dict[str, Any]:
    """A walk on which the two disagree."""
    row = jax.tree.map(lambda leaf: np.asarray(leaf[i]), batch)
    return {
        "row": i,
        "friction": float(row.ground.friction),
        "sinkage": float(row.ground.sinkage),
        "mass_scale": row.errors.mass_scale.round(3).tolist(),
        "gain_scale": row.errors.gain_scale.round(3).tolist(),
        **{
            f"{tag}_{key}": value
            for tag, columns in (("compliant", one), ("native", other))
            for key, value in (
                ("status", STATUS_TEXT[int(columns["status"][i])]),
                ("end_time", float(columns["end_time"][i])),
                ("tilt_deg", float(tilt_deg(columns)[i])),
            )
        },
    }


def compare(name: str, n: int, steps: int, seed: int, processes: int) -> dict[str, Any]:
    """Run both and count."""
    batch = scenarios(n, seed)
    clock = time.perf_counter()
    one = compliant(name, steps, batch)
    middle = time.perf_counter()
    other = native_in_processes(name, steps, batch, processes)
    end = time.perf_counter()
    agree = (one["status"] == 0) == (other["status"] == 0)
    both = (one["status"] == 0) & (other["status"] == 0)
    apart = np.linalg.norm((one["p_world_trunk"] - other["p_world_trunk"])[:, :2], axis=1)[both]
    percent = [0, 5, 50, 95, 100]
    result = {
        "robot": name,
        "n": n,
        "steps": steps,
        "seed": seed,
        "agreement": float(agree.mean()),
        "ok_compliant": int((one["status"] == 0).sum()),
        "ok_native": int((other["status"] == 0).sum()),
        "seconds_compliant": middle - clock,
        "seconds_native": end - middle,
        "percentiles": percent,
        "end_places_apart_mm": np.percentile(1e3 * apart, percent).tolist() if both.any() else [],
        "disagreements": [describe(int(i), batch, one, other) for i in np.flatnonzero(~agree)],
    }
    for tag, columns in (("compliant", one), ("native", other)):
        for key, values in (
            ("tilt_deg", tilt_deg(columns)),
            ("foot_force", columns["peak_foot_force"].max(axis=1)),
            ("slip_mm", 1e3 * columns["peak_slip"].max(axis=1)),
        ):
            result[f"{key}_{tag}"] = np.percentile(values, percent).tolist()
    return result


def show(result: dict[str, Any]) -> None:
    """Print the result as a table."""
    print(f"{result['robot']}: {result['n']} walks of {result['steps']} steps, seed {result['seed']}")
    print(
        f"agreement {100 * result['agreement']:.1f} %; ok {result['ok_compliant']} on the compliant ground "
        f"({result['seconds_compliant']:.0f} s), {result['ok_native']} in C MuJoCo ({result['seconds_native']:.0f} s)"
    )
    print(f"{'percentile':>26}" + "".join(f"{p:>10}" for p in result["percentiles"]))
    for key in sorted(k for k in result if k.startswith(("tilt", "foot", "slip", "end"))):
        print(f"{key:>26}" + "".join(f"{v:>10.2f}" for v in result[key]))
    for row in result["disagreements"]:
        print(row)


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", default="surena3", choices=["surena3", "elkahlout"])
    parser.add_argument("--n", type=int, default=256, help="number of walks")
    parser.add_argument("--steps", type=int, default=4, help="steps in a walk")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2, help="that run C MuJoCo")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    args = parser.parse_args()
    if args.n < 1 or args.steps < 1:
        sys.exit(f"--n, --steps: got {args.n}, {args.steps}, allowed: >= 1")
    result = compare(args.robot, args.n, args.steps, args.seed, args.processes)
    show(result)
    if args.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()

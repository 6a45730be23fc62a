"""Time the kernels against their peers, on one core: `python benchmarks/kernels.py [--quick] [--json]`.

Inverse kinematics of one leg (closed form, jit and vmap) against mink (differential IK on MuJoCo, daqp) and
SciPy's least squares (MuJoCo's forward kinematics and its exact Jacobian), all on the same random reachable
targets and all checked by C MuJoCo's forward kinematics; gait evaluations; and how often JAX compiles while
parameters change.

The peers get a MuJoCo model of their own: the robot's spec without its free joint (the pelvis stands still in
the world's origin) and without its right leg, so that they solve for the same six angles. They start every
target from the same bent-knee posture and stop at TOLERANCE; their rate counts the targets they solve and the
time these took, a failure costs them nothing. Times are CPU times of this process, all threads.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import common

CORE = common.use_one_core()  # before JAX is imported

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import mink  # noqa: E402
import mujoco  # noqa: E402
import numpy as np  # noqa: E402
from scipy.optimize import least_squares  # noqa: E402

from jaxbiped import kinematics, planner, robot, sim  # noqa: E402
from jaxbiped.kinematics import leg  # noqa: E402

TOLERANCE = 1e-4
"""Where the iterative peers may stop, position [m] and rotation [rad]."""
MAX_ITERATIONS = 100
NEUTRAL = np.array([0.0, 0.0, -0.5, 1.0, -0.5, 0.0])
"""Posture the peers start from, hip yaw to ankle roll [rad]."""
SOLE = "left_sole"
PARAMETER_SETS = 20


class Targets(NamedTuple):
    """Poses of the left sole in the pelvis frame."""

    p: np.ndarray
    """(n, 3) [m]"""
    rot: np.ndarray
    """(n, 3, 3)"""


def reachable_targets(model: mujoco.MjModel, n: int, seed: int = 0) -> Targets:
    """Where random joint angles put the sole, 2 % of the range away from its ends."""
    lower, upper = np.asarray(model.jnt_range).T
    rest = 0.02 * (upper - lower)
    angles = np.random.default_rng(seed).uniform(lower + rest, upper - rest, (n, 6))
    poses = [sole_pose(model, angle) for angle in angles]
    return Targets(np.array([p for p, _ in poses]), np.array([rot for _, rot in poses]))


def main() -> None:
    """Run everything and print tables, or with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny sizes: does it run at all?")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    parser.add_argument("--robot", default="surena3", help="preset or robot file (default: surena3)")
    options = parser.parse_args()
    result = {"header": common.header(CORE), **measure(options.robot, options.quick)}
    print(in_words(result))
    if options.json:
        print(json.dumps(result))


def measure(robot_name: str, quick: bool) -> dict[str, Any]:
    """All numbers, by name."""
    batches = (64,) if quick else (1, 64, 1024, 4096, 16384)
    peer_targets, repeats = (8, 3) if quick else (500, 15)
    model = one_leg_model(robot_name)
    targets = reachable_targets(model, max(batches))
    ours = {
        name: our_ik(robot_name, model, targets, batches, repeats, name) for name in ("float32", "float64")
    }
    mink_ik = peer_ik(mink_solver(model), model, targets, peer_targets)
    scipy_ik = peer_ik(scipy_solver(model), model, targets, peer_targets)
    best = max(ours["float32"]["per_s"].values())
    return {
        "robot": robot_name,
        "tolerance": TOLERANCE,
        "ik_per_s": best,
        "mink_ik_per_s": mink_ik["per_s"],
        "scipy_ik_per_s": scipy_ik["per_s"],
        "ratio_to_mink": best / mink_ik["per_s"],
        "ratio_to_scipy": best / scipy_ik["per_s"],
        "ik": {**ours, "mink": mink_ik, "scipy": scipy_ik},
        "gait_per_s": gait_rates(batches, repeats),
        "compilations": compilations(targets, n_steps=2 if quick else 8),
    }


def one_leg_model(robot_name: str) -> mujoco.MjModel:
    """The robot's own MuJoCo model with its pelvis fixed in the world's origin and its left leg only."""
    spec: Any = sim.build_spec(robot.load(robot_name))
    spec.delete(spec.joint("root"))
    spec.delete(spec.body("right_hip_yaw"))
    spec.body("trunk").pos = np.zeros(3)
    return spec.compile()


def sole_pose(model: mujoco.MjModel, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where C MuJoCo's forward kinematics put the sole: position (3,) [m] and rotation (3, 3)."""
    data = mujoco.MjData(model)
    data.qpos[:] = angle
    mujoco.mj_kinematics(model, data)
    return data.site(SOLE).xpos.copy(), data.site(SOLE).xmat.reshape(3, 3).copy()


def accuracy(model: mujoco.MjModel, targets: Targets, angles: np.ndarray) -> dict[str, float]:
    """Largest errors of solutions (n, 6) for n targets, and by how much a joint range is left."""
    poses = [sole_pose(model, angle) for angle in angles]
    position = [np.linalg.norm(p - target) for (p, _), target in zip(poses, targets.p, strict=True)]
    rotation = [rotation_error(r, target) for (_, r), target in zip(poses, targets.rot, strict=True)]
    lower, upper = np.asarray(model.jnt_range).T
    beyond = np.maximum(angles - upper, lower - angles).max(initial=0.0)
    return {
        "position_max_m": float(max(position)),
        "rotation_max_rad": float(max(rotation)),
        "beyond_range_max_rad": float(beyond),
    }


def rotation_error(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two rotations [rad], exact for small ones."""
    return float(2.0 * np.arcsin(min(1.0, np.linalg.norm(a - b) / np.sqrt(8.0))))


def our_ik(
    robot_name: str,
    model: mujoco.MjModel,
    targets: Targets,
    batches: tuple[int, ...],
    repeats: int,
    dtype: str,
) -> dict[str, Any]:
    """Rate and accuracy of `kinematics.leg.inverse` in one precision."""
    with jax.enable_x64(dtype == "float64"):
        params = robot.on_device(robot.load(robot_name))
        solve = jax.jit(jax.vmap(lambda r, p, rot: leg.inverse(r, robot.LEFT, p, rot), in_axes=(None, 0, 0)))
        p, rot = jnp.asarray(targets.p, dtype), jnp.asarray(targets.rot, dtype)
        found = solve(params, p, rot)
        if not np.all(np.asarray(found.status) == kinematics.OK):
            raise RuntimeError("inverse kinematics refused a reachable target")
        rates = {str(n): rate(solve, params, p[:n], rot[:n], n=n, repeats=repeats) for n in batches}
        return {
            "per_s": rates,
            "solved": 1.0,
            "targets": len(p),
            **accuracy(model, targets, np.asarray(found.angle, float)),
        }


def rate(call: Callable, *args: Any, n: int, repeats: int) -> float:
    """Items per second of a jitted call over n items, waiting for its output."""
    jax.block_until_ready(call(*args))
    return n / common.median_seconds(lambda: jax.block_until_ready(call(*args)), repeats)


Solver = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, int, bool]]
"""Target position and rotation -> angles, iterations, whether within TOLERANCE."""


def peer_ik(solve: Solver, model: mujoco.MjModel, targets: Targets, n: int) -> dict[str, Any]:
    """Rate (of the targets solved, over the time these took) and accuracy of an iterative solver."""
    solve(targets.p[0], targets.rot[0])
    seconds: list[float] = []
    found, iterations, solved = [], [], []
    for p, rot in zip(targets.p[:n], targets.rot[:n], strict=True):
        began = time.process_time()
        angle, steps, ok = solve(p, rot)
        seconds.append(time.process_time() - began)
        found.append(angle)
        iterations.append(steps)
        solved.append(ok)
    good = np.array(solved)
    solved_targets = Targets(targets.p[:n][good], targets.rot[:n][good])
    return {
        "per_s": float(good.sum() / np.sum(np.array(seconds)[good])),
        "solved": float(good.mean()),
        "targets": len(good),
        "iterations_median": float(np.median(np.array(iterations)[good])),
        **accuracy(model, solved_targets, np.array(found)[good]),
    }


def mink_solver(model: mujoco.MjModel, lm_damping: float = 1e-3) -> Solver:
    """One solver as mink's examples have it: one FrameTask on the sole's site, the joint ranges, daqp."""
    configuration = mink.Configuration(model)
    task = mink.FrameTask(SOLE, "site", position_cost=1.0, orientation_cost=1.0, lm_damping=lm_damping)
    limits = [mink.ConfigurationLimit(model)]

    def solve(p: np.ndarray, rot: np.ndarray) -> tuple[np.ndarray, int, bool]:
        task.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(rot), p))
        configuration.update(NEUTRAL)
        for iteration in range(MAX_ITERATIONS):
            error = task.compute_error(configuration)
            if np.linalg.norm(error[:3]) <= TOLERANCE and np.linalg.norm(error[3:]) <= TOLERANCE:
                return configuration.q.copy(), iteration, True
            velocity = mink.solve_ik(configuration, [task], 1.0, "daqp", limits=limits)
            configuration.integrate_inplace(velocity, 1.0)
        return configuration.q.copy(), MAX_ITERATIONS, False

    return solve


def scipy_solver(model: mujoco.MjModel) -> Solver:
    """SciPy's bounded least squares on MuJoCo's forward kinematics and exact Jacobian."""
    data = mujoco.MjData(model)
    site = model.site(SOLE).id
    jac_p, jac_r = np.zeros((3, 6)), np.zeros((3, 6))
    lower, upper = np.asarray(model.jnt_range).T
    minimize: Any = least_squares  # its stubs know neither a callable jac nor ftol=None

    def forward(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        data.qpos[:] = angle
        mujoco.mj_kinematics(model, data)
        return data.site_xpos[site], data.site_xmat[site].reshape(3, 3)

    def jacobian(angle: np.ndarray, *_: Any) -> np.ndarray:
        rot = forward(angle)[1]
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, jac_p, jac_r, site)
        columns = np.cross(jac_r.T[:, None], rot.T[None]).reshape(6, 9).T
        return np.concatenate([jac_p, columns])

    def residual(angle: np.ndarray, p: np.ndarray, rot: np.ndarray) -> np.ndarray:
        at, turned = forward(angle)
        return np.concatenate([at - p, (turned - rot).T.reshape(-1)])

    def solve(p: np.ndarray, rot: np.ndarray) -> tuple[np.ndarray, int, bool]:
        found = minimize(
            residual,
            NEUTRAL,
            jacobian,
            (lower, upper),
            args=(p, rot),
            ftol=None,
            xtol=1e-10,
            gtol=1e-9,
            max_nfev=MAX_ITERATIONS,
        )
        at, turned = forward(found.x)
        ok = np.linalg.norm(at - p) <= TOLERANCE and rotation_error(turned, rot) <= TOLERANCE
        return found.x, int(found.nfev), bool(ok)

    return solve


def gait_rates(batches: tuple[int, ...], repeats: int) -> dict[str, dict[str, float]]:
    """Evaluations per second: targets of both gaits with two derivatives; the same with joint angles."""
    rates = {}
    for name, kind, params in nominal_gaits():
        gait = kind.preset(params)
        for what, kernel in (("targets", targets_at), ("targets and joint angles", angles_at)):
            call = jax.jit(jax.vmap(kernel, in_axes=(None, None, 0)))
            times = {n: jnp.linspace(0.0, gait.duration, n) for n in batches}
            rates[f"{name}: {what}"] = {
                str(n): rate(call, params, gait, times[n], n=n, repeats=repeats) for n in batches
            }
    return rates


def nominal_gaits() -> list[tuple[str, Any, robot.RobotParams]]:
    """Both papers' gaits with their robots."""
    robots = [robot.on_device(robot.load(name)) for name in ("surena3", "elkahlout")]
    names = [planner.own_gait_name(params) for params in robots]
    return [(f"{r.name}, {name}", planner.GAITS[name], r) for r, name in zip(robots, names, strict=True)]


def targets_at(_: robot.RobotParams, gait: Any, t: Any) -> planner.Targets:
    """Targets of a gait at one time."""
    return planner.at(gait, t)


def angles_at(params: robot.RobotParams, gait: Any, t: Any) -> Any:
    """Targets of a gait at one time, and the joint angles that meet them."""
    targets = planner.at(gait, t)
    return targets, kinematics.joint_angles(params, targets.position.sole - targets.position.pelvis)


def compilations(targets: Targets, n_steps: int) -> dict[str, int]:
    """How often each kernel is compiled while robot, gait and targets change PARAMETER_SETS times."""
    counts = {}
    scales = 1.0 + 0.001 * np.arange(PARAMETER_SETS)
    for name, kind, params in nominal_gaits():

        def plan_and_follow(r: Any, p: Any, t: Any, kind: Any = kind) -> Any:
            return angles_at(r, kind.make(r, p, n_steps), t)

        inputs = [scaled((params, kind.preset_params(params), jnp.ones(())), s) for s in scales]
        counts[f"{name}: plan, targets, joint angles"] = compile_count(jax.jit(plan_and_follow), inputs)
    params = robot.on_device(robot.load("surena3"))
    p, rot = targets.p.astype(np.float32), targets.rot.astype(np.float32)
    some = [i % len(p) for i in range(PARAMETER_SETS)]
    legs = [(scaled(params, s), p[i], rot[i]) for s, i in zip(scales, some, strict=True)]
    counts["inverse kinematics"] = compile_count(
        jax.jit(lambda r, p, rot: leg.inverse(r, robot.LEFT, p, rot)), legs
    )
    return counts


def scaled(tree: Any, factor: float) -> Any:
    """Every number of a record times `factor`."""
    return jax.tree.map(lambda x: np.asarray(x * factor), tree)


def compile_count(call: Callable, inputs: list[tuple]) -> int:
    """How often XLA compiles anything while `call` sees these inputs."""
    compiled: list[str] = []

    def listen(event: str, duration_secs: float, **kwargs: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    for args in inputs:
        jax.block_until_ready(call(*args))
    return len(compiled)


def in_words(result: dict[str, Any]) -> str:
    """Everything in tables."""
    head = result["header"]
    versions = ", ".join(f"{name} {version}" for name, version in head["versions"].items())
    lines = [
        f"{head['cpu']}, one core, {head['system']}, Python {head['python']}",
        versions,
        f"commit {head['commit']}",
        "",
    ]
    return "\n".join([*lines, ik_table(result), gait_table(result), compilation_table(result)])


def ik_table(result: dict[str, Any]) -> str:
    """Inverse kinematics against the peers."""
    rows = []
    for name in ("float32", "float64"):
        one = result["ik"][name]
        for n, per_s in one["per_s"].items():
            rows.append([f"jaxbiped, {name}, batch {n}", *ik_cells(result, per_s, one)])
    for name in ("mink", "scipy"):
        one = result["ik"][name]
        rows.append([f"{name}, one at a time", *ik_cells(result, one["per_s"], one)])
    columns = ["", "per second", "x mink", "x scipy", "solved", "position [m]", "rotation [rad]"]
    title = (
        f"Inverse kinematics of one leg ({result['robot']}); largest error by C MuJoCo's forward kinematics"
    )
    return common.table(title, columns, rows)


def ik_cells(result: dict[str, Any], per_s: float, one: dict[str, Any]) -> list[str]:
    """One row's numbers."""
    return [
        f"{per_s:,.0f}",
        f"{per_s / result['mink_ik_per_s']:,.2f}",
        f"{per_s / result['scipy_ik_per_s']:,.2f}",
        f"{one['solved']:.1%} of {one['targets']}",
        f"{one['position_max_m']:.1e}",
        f"{one['rotation_max_rad']:.1e}",
    ]


def gait_table(result: dict[str, Any]) -> str:
    """Gait evaluations by batch."""
    rates = result["gait_per_s"]
    batches = list(next(iter(rates.values())))
    rows = [[name, *(f"{by_batch[n]:,.0f}" for n in batches)] for name, by_batch in rates.items()]
    return common.table("Gait evaluations per second, float32", ["batch", *batches], rows)


def compilation_table(result: dict[str, Any]) -> str:
    """Compilations while parameters change."""
    rows = [[name, str(count)] for name, count in result["compilations"].items()]
    return common.table(
        f"Compilations while all parameters change {PARAMETER_SETS} times", ["", "count"], rows
    )


if __name__ == "__main__":
    main()

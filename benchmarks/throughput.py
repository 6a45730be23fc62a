"""Physics steps per second of a walk: `python benchmarks/throughput.py [--quick] [--json] [--robot NAME]`.

The closed loop (planner, inverse kinematics, servos, ground, sensors, statistics) of many scenarios, compiled by XLA
and as C, against the same robot and gait in C MuJoCo with native contacts (`mujoco.rollout`, controls computed
beforehand), in a Python loop of `mj_step` with the controller in NumPy, and in plain `mjx.step` with native contacts.
All in one run, each process on one core with one thread, 0.5 ms per step, JAX in float32.

On a machine with other work, `--clock cpu` counts the time this process had the core instead of the time that passed;
the rows with several processes always go by the time that passed.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import common

CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
if "THROUGHPUT_CORE" in os.environ:
    os.sched_setaffinity(0, {int(os.environ["THROUGHPUT_CORE"])})
CORE = common.use_one_core()  # before JAX is imported

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import mujoco  # noqa: E402
import mujoco.rollout  # noqa: E402
import numpy as np  # noqa: E402
from mujoco import mjx  # noqa: E402

from jaxbiped import planner, robot, runtime, sim  # noqa: E402
from jaxbiped.adapt import Controller  # noqa: E402
from jaxbiped.sim import segments  # noqa: E402
from jaxbiped.sim.compile import backend, build, trace  # noqa: E402

DT = 5e-4
N_STEPS = 8
EXPECTED = {"c_mujoco_per_core": 15.0, "python_loop": 150.0, "mjx_contacts_per_core": 5.0}
"""What the closed loop is expected to be worth, times each peer."""


class Size(NamedTuple):
    """How much is run."""

    batches: tuple[int, ...]
    c_batches: tuple[int, ...]
    mjx_batches: tuple[int, ...]
    ticks: int
    """Of a closed-loop roll-out."""
    c_seconds: float
    """Length of the C MuJoCo walk [s]."""
    mjx_ticks: int
    repeats: int
    worker_batch: int
    c_worker_batch: int
    clock: str = "wall"

    def median_seconds(self, call: Callable[[], Any], least: float = 0.02) -> float:
        """Median time of one call by the chosen clock [s]; see `common.median_seconds`."""
        if self.clock == "wall":
            return common.median_seconds(call, self.repeats, least)
        measured = []
        for _ in range(self.repeats):
            began, calls = time.process_time(), 0
            while calls == 0 or time.process_time() - began < least:
                call()
                calls += 1
            measured.append((time.process_time() - began) / calls)
        return statistics.median(measured)


FULL = Size((1, 16, 64, 256, 1024), (16, 64, 256, 1024, 4096), (1, 16, 64, 256), 400, 6.0, 20, 5, 64, 256)
QUICK = Size((16,), (32,), (4,), 40, 0.5, 4, 3, 16, 32)


def main() -> None:
    """Run everything and print a table, or with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny sizes: does it run at all?")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    parser.add_argument("--robot", choices=robot.presets(), default="elkahlout", help="preset")
    parser.add_argument("--worker", choices=list(WORKERS), help=argparse.SUPPRESS)
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="what is measured")
    parser.add_argument("--batch", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    size = (QUICK if options.quick else FULL)._replace(clock=options.clock)
    if options.worker:
        WORKERS[options.worker](options.robot, size, options.batch)
        return
    result = {"header": common.header(CORE), **measure(options.robot, size, options.quick)}
    print(in_words(result))
    if options.json:
        print(json.dumps(result))


def measure(name: str, size: Size, quick: bool) -> dict[str, Any]:
    """All numbers, by name."""
    ours = {str(n): note(f"closed loop, batch {n}", closed_loop(name, n, size)) for n in size.batches}
    peak, in_c = peak_memory(), {}
    if build.compiler() is not None:
        in_c = {str(n): note(f"in C, batch {n}", closed_loop_in_c(name, n, size)) for n in size.c_batches}
    c_steps = note("C MuJoCo", c_mujoco(name, size))
    loop = note("Python loop", python_loop(name, size))
    plain = {str(n): note(f"mjx.step, batch {n}", mjx_contacts(name, n, size)) for n in size.mjx_batches}
    with tempfile.TemporaryDirectory() as cache:
        batch = {"closed_loop": size.worker_batch, "c_mujoco": 1}
        if in_c:
            batch["closed_loop_in_c"] = size.c_worker_batch
        compiling = {
            kind: note(kind, compile_times(kind, name, batch[of], quick, cache))
            for kind, of in (("compile", "closed_loop"), ("compile_in_c", "closed_loop_in_c"))
            if of in batch
        }
        parallel = {
            kind: {str(n): workers(kind, name, n, lanes, quick, cache) for n in (1, 2) if n <= len(CORES)}
            for kind, lanes in batch.items()
        }
    by_backend = {"xla": best_of(ours)} | ({"c": best_of(in_c)} if in_c else {})
    best = max(by_backend, key=lambda backend: by_backend[backend]["steps_per_s"])
    result = {
        "robot": name,
        "dt": DT,
        "clock": size.clock,
        "control_every": control_every(name),
        "closed_loop_per_core": by_backend[best]["steps_per_s"],
        "robot_seconds_per_core": by_backend[best]["steps_per_s"] * DT,
        "backend": best,
        "by_backend": by_backend,
        "c_mujoco_per_core": c_steps["steps_per_s"],
        "python_loop": loop["steps_per_s"],
        "mjx_contacts_per_core": max(one["steps_per_s"] for one in plain.values()),
        "closed_loop": ours,
        "closed_loop_in_c": in_c,
        "c_mujoco": c_steps,
        "numpy_loop": loop,
        "mjx_contacts": plain,
        "workers": parallel,
        "compile": compiling["compile"],
        "compile_in_c": compiling.get("compile_in_c"),
        "bytes_per_scenario": bytes_per_scenario(ours),
        "peak_memory_bytes": peak,
        "core_gflops": core_gflops(size),
    }
    result["ratios"] = {peer: result["closed_loop_per_core"] / result[peer] for peer in EXPECTED}
    return result


def best_of(rates: dict[str, dict[str, float]]) -> dict[str, float]:
    """The fastest batch, and its rate."""
    best = max(rates, key=lambda n: rates[n]["steps_per_s"])
    return {"batch": int(best), "steps_per_s": rates[best]["steps_per_s"]}


def note(what: str, result: Any) -> Any:
    """Say on stderr how far the run is; returns `result`."""
    print(f"{what}: {result}", file=sys.stderr, flush=True)
    return result


class Setup(NamedTuple):
    """A robot and its preset walk."""

    params: robot.RobotParams
    gait: Any
    options: sim.Options
    simulation: sim.Simulation
    """All of them, ready to walk."""


def control_every(name: str) -> int:
    """Physics ticks in a control tick."""
    params = robot.load(name)
    return sim.own_options(params, planner.own_gait(params, 1)).control_every


def setup(name: str) -> Setup:
    """The robot and its gait."""
    params = robot.load(name)
    gait = planner.own_gait(params, N_STEPS)
    options = sim.Options(dt=DT, control_every=control_every(name))
    return Setup(params, gait, options, sim.prepare(params, Controller(gait), options))


def scenarios(n: int) -> sim.Scenario:
    """A batch of flat walks, each with other link masses and another friction coefficient."""
    random = np.random.default_rng(0)
    batch = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), sim.Scenario.flat())
    return eqx.tree_at(
        lambda s: (s.errors.mass_scale, s.ground.friction),
        batch,
        (
            jnp.asarray(random.uniform(0.95, 1.05, (n, 13)), jnp.float32),
            jnp.asarray(random.uniform(0.7, 0.9, n), jnp.float32),
        ),
    )


def compiled_loop(name: str, n: int, ticks: int) -> tuple[Any, Callable[[], Any], float]:
    """The closed loop for n scenarios: compiled, a call that waits for its output, and how long compiling took [s]."""
    one = setup(name)
    arrays, rest = eqx.partition(one.simulation, eqx.is_array)

    def run(arrays: Any, batch: Any, ticks: Any) -> Any:
        simulation: sim.Simulation = eqx.combine(arrays, rest)
        return jax.vmap(lambda scenario: simulation.walk(scenario, ticks).statistics)(batch)

    args = (arrays, scenarios(n), one.simulation.ticks(ticks * DT))
    began = time.perf_counter()
    compiled = jax.jit(run, compiler_options=runtime.options()).lower(*args).compile()
    seconds = time.perf_counter() - began
    return compiled, lambda: jax.block_until_ready(compiled(*args)), seconds


def closed_loop(name: str, n: int, size: Size) -> dict[str, float]:
    """Rate of the closed loop, and what its compiled form takes."""
    compiled, call, compile_s = compiled_loop(name, n, size.ticks)
    walks = call()
    memory = compiled.memory_analysis()
    seconds = size.median_seconds(call)
    return {
        "steps_per_s": n * size.ticks / seconds,
        "compile_s": compile_s,
        "bytes": memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes,
        "walks_upright": float(np.mean(np.asarray(walks.status) == 0)),
    }


def machine_code(name: str, n: int, ticks: int) -> tuple[Callable[[], Any], float]:
    """The closed loop of n scenarios in C: a call that walks so many ticks, and how long it took to be ready [s]."""
    one = setup(name).simulation
    states = segments.begun(one, scenarios(n), 10**6)
    began = time.perf_counter()
    machine, leaves = backend.machine_of(one, states), trace.shared_leaves(one)
    seconds = time.perf_counter() - began
    return lambda: machine.advance(leaves, states, one.ticks(ticks * DT)), seconds


def closed_loop_in_c(name: str, n: int, size: Size) -> dict[str, float]:
    """Rate of the closed loop in C, its states packed and unpacked."""
    call, compile_s = machine_code(name, n, size.ticks)
    upright = float(np.mean(call().record.statistics.status == 0))
    rate = n * size.ticks / size.median_seconds(call)
    return {"steps_per_s": rate, "compile_s": compile_s, "walks_upright": upright}


def bytes_per_scenario(ours: dict[str, dict[str, float]]) -> float | None:
    """Memory of the compiled loop, by the difference of the two largest batches."""
    if len(ours) < 2:
        return None
    (n, fewer), (m, more) = [(int(k), v["bytes"]) for k, v in list(ours.items())[-2:]]
    return (more - fewer) / (m - n)


def peak_memory() -> int:
    """Most memory this process has held so far [byte]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


class NumpyController:
    """Gait, inverse kinematics and servo reference in NumPy: the open-loop controller of the Python loop.

    Soles stay level, so that the hip does not yaw. The speed reference is a difference quotient.
    """

    def __init__(self, one: Setup) -> None:
        self.gait = jax.tree.map(lambda leaf: np.asarray(leaf, float), one.gait)
        self.cosine = one.gait.name == "cosine"
        self.timing = jax.tree.map(float, self.gait.timing)
        self.robot = jax.tree.map(lambda leaf: np.asarray(leaf, float), one.params)
        self.torque = np.asarray(one.simulation.torque.torque, float)
        self.interval = one.simulation.torque.interval
        self.bent = self.robot.thigh_length + self.robot.shank_length
        self.gain = self.robot.servo.kv / self.robot.servo.kp

    def control(self, t: float) -> np.ndarray:
        """Commands (12,) of the model's position servos: angle, and what makes them add speed and feed-forward."""
        angle, later = self.angles(*self.task(np.array([t, t + 1e-5])))
        place = min(t / self.interval, len(self.torque) - 2.0)
        row = int(place)
        torque = self.torque[row] + (place - row) * (self.torque[row + 1] - self.torque[row])
        return (angle + self.gain * (later - angle) / 1e-5 + torque / self.robot.servo.kp).reshape(-1)

    def task(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Soles (n, 2, 3) and pelvis (n, 3) at times (n,) [m]."""
        timing, gait, p = self.timing, self.gait, self.gait.params
        step = np.clip(np.floor((t - timing.first_liftoff) / timing.T_c), 0, timing.n_steps - 1)
        since = np.minimum(np.maximum(t - timing.first_liftoff - step * timing.T_c, 0.0), timing.T_s)
        pelvis, sole = np.empty((len(t), 3)), np.zeros((len(t), 2, 3))
        if self.cosine:
            turn, middle = np.pi * since / timing.T_s, (2.0 * step + 1.0) * p.b_s
            stance, forward = middle + p.x_ref, middle + p.x_ref - 2.0 * p.b_s * np.cos(turn)
            up, across = 0.5 * p.h_s * (1.0 - np.cos(2.0 * turn)), p.w_of
            pelvis[:, 0] = middle - p.b_s * np.cos(turn)
            pelvis[:, 1] = self.sway(t) - p.y_ref
            pelvis[:, 2] = p.h_b
        else:
            come_from = p.D_s * np.maximum(step - 1, 0)
            go_to = p.D_s * np.minimum(step + 1, timing.n_steps - 1)
            stance, forward = p.D_s * step, come_from + (go_to - come_from) * polynomial(gait.foot_x, since)
            up, across = polynomial(gait.foot_z, since), 0.5 * p.L_p
            for i, curve in enumerate((gait.pelvis_x, gait.pelvis_y, gait.pelvis_z)):
                pelvis[:, i] = piecewise(curve, t)
        swing = (timing.first_swing + step.astype(int)) % 2
        rows = np.arange(len(t))
        sole[rows, swing, 0], sole[rows, 1 - swing, 0] = forward, stance
        sole[rows, swing, 2] = up
        sole[:, 0, 1], sole[:, 1, 1] = across, -across
        return sole, pelvis

    def sway(self, t: np.ndarray) -> np.ndarray:
        """Lateral position of the cosine gait's pelvis [m]."""
        p, gait = self.gait.params, self.gait
        stop = p.T_ini + gait.n_steps * p.T_c
        side = -1.0 if gait.first_swing == robot.LEFT else 1.0
        walking = side * p.w * np.sin(np.pi * (t - p.T_ini) / p.T_c)
        starting = polynomial(gait.sway_in, np.minimum(t, p.T_ini))
        stopping = polynomial(gait.sway_out, np.clip(t, stop, stop + p.T_end))
        return np.where(t < p.T_ini, starting, np.where(t < stop, walking, stopping))

    def angles(self, sole: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
        """Joint angles (n, 2, 6) [rad] of level soles."""
        r = self.robot
        x, y, z = np.moveaxis(pelvis[:, None] + r.p_pelvis_hip - sole, -1, 0)
        z = z - r.ankle_height
        a, b = r.thigh_length, r.shank_length
        knee = np.arccos(np.clip((x * x + y * y + z * z - a * a - b * b) / (2.0 * a * b), -1.0, 1.0))
        shank, thigh, height = b + a * np.cos(knee), a * np.sin(knee), np.hypot(y, z)
        pitch = np.arctan2(-thigh * height - shank * x, shank * height - thigh * x)
        roll = np.arctan2(y, z)
        angle = np.stack([np.zeros_like(x), -roll, -knee - pitch, knee, pitch, roll], axis=-1)
        return np.clip(angle, r.joint_range[..., 0], r.joint_range[..., 1])


def polynomial(curve: Any, t: np.ndarray) -> np.ndarray:
    """Value of a polynomial at times [s]."""
    return np.polyval(curve.coefficients[::-1], (t - curve.centre) / curve.scale)


def piecewise(curve: Any, t: np.ndarray) -> np.ndarray:
    """Value of a piecewise polynomial at times [s]."""
    t = np.clip(t, curve.breaks[0], curve.breaks[-1])
    piece = np.searchsorted(curve.breaks[1:-1], t, side="right")
    s = (t - curve.centre[piece]) / curve.scale[piece]
    value = np.zeros_like(t)
    for k in range(curve.coefficients.shape[1] - 1, -1, -1):
        value = value * s + curve.coefficients[piece, k]
    return value


class Native(NamedTuple):
    """The robot in C MuJoCo, at the start of its walk."""

    model: mujoco.MjModel
    data: mujoco.MjData
    controller: NumpyController


def native(name: str, seconds: float) -> Native:
    """The robot's own MuJoCo model, standing on its contacts, and its controller."""
    one = setup(name)
    controller = NumpyController(one)
    model = sim.build_model(one.params, DT)
    data = mujoco.MjData(model)
    sole, pelvis = controller.task(np.zeros(1))
    data.qpos[:3] = pelvis[0]
    data.qpos[7:] = controller.angles(sole, pelvis).reshape(-1)
    mujoco.mj_forward(model, data)
    return Native(model, data, controller)


def controls(one: Native, ticks: int, every: int) -> np.ndarray:
    """Commands (ticks, 12) of a walk, computed beforehand."""
    return np.array([one.controller.control(i // every * every * DT) for i in range(ticks)])


def c_mujoco(name: str, size: Size) -> dict[str, float]:
    """Rate of `mujoco.rollout` with native contacts and the controls given."""
    one, call, ticks = c_rollout(name, size)
    seconds = size.median_seconds(call)
    fallen = trunk_height(call()[0][0, -1, 1:4]) < 0.6 * one.data.qpos[2]
    return {"steps_per_s": ticks / seconds, "upright": float(not fallen), "seconds_walked": ticks * DT}


def trunk_height(position: np.ndarray) -> float:
    """Of a position in the world [m]."""
    return float(position[2])


def c_rollout(name: str, size: Size) -> tuple[Native, Callable[[], Any], int]:
    """A C MuJoCo walk: the robot, a call that runs it, and its number of steps."""
    one, ticks = native(name, size.c_seconds), round(size.c_seconds / DT)
    control = controls(one, ticks, control_every(name))[None]
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros((1, mujoco.mj_stateSize(one.model, kind)))
    mujoco.mj_getState(one.model, one.data, start[0], kind)
    scratch = mujoco.MjData(one.model)
    runner: Any = mujoco.rollout.rollout
    return one, lambda: runner([one.model], scratch, start, control), ticks


def python_loop(name: str, size: Size) -> dict[str, float]:
    """Rate of a loop of controller and `mj_step`; half the length of the C walk at most."""
    one, every = native(name, size.c_seconds), control_every(name)
    start, ticks = one.data.qpos.copy(), round(0.5 * size.c_seconds / DT)

    def run() -> None:
        mujoco.mj_resetData(one.model, one.data)
        one.data.qpos[:] = start
        for i in range(ticks):
            if i % every == 0:
                one.data.ctrl[:] = one.controller.control(i * DT)
            mujoco.mj_step(one.model, one.data)

    run()
    seconds = size.median_seconds(run)
    return {
        "steps_per_s": ticks / seconds,
        "upright": float(one.data.qpos[2] > 0.6 * start[2]),
        "angle_error_rad": controller_error(name, one.controller),
    }


def controller_error(name: str, controller: NumpyController) -> float:
    """Largest difference between the angles of the NumPy controller and the project's own, over a walk [rad]."""
    from jaxbiped.kinematics import joint_angles

    one = setup(name)
    times = np.linspace(0.0, float(one.gait.duration), 200, dtype=np.float32)

    def angles(t: Any) -> Any:
        task = planner.at(one.gait, t).position
        return joint_angles(one.params, task.sole - task.pelvis)[0]

    ours = np.asarray(jax.jit(jax.vmap(angles))(jnp.asarray(times)))
    return float(np.abs(ours - controller.angles(*controller.task(times.astype(float)))).max())


def mjx_contacts(name: str, n: int, size: Size) -> dict[str, float]:
    """Rate of `mjx.step` with native contacts, on commands computed beforehand."""
    one = native(name, 1.0)
    model, ticks = mjx.put_model(one.model), size.mjx_ticks
    control = jnp.asarray(controls(one, ticks, control_every(name)), jnp.float32)
    height = jnp.asarray(one.data.qpos[2] - 1e-5 * np.arange(n), jnp.float32)

    def run(model: Any, height: Any, qpos: Any, control: Any) -> Any:
        def walk(z: Any) -> Any:
            data = mjx.make_data(model).replace(qpos=qpos.at[2].set(z))
            step = lambda d, u: (mjx.step(model, d.replace(ctrl=u)), None)  # noqa: E731
            return jax.lax.scan(step, data, control)[0].qpos

        return jax.vmap(walk)(height)

    args = (model, height, jnp.asarray(one.data.qpos, jnp.float32), control)
    began = time.perf_counter()
    compiled = jax.jit(run, compiler_options=runtime.options()).lower(*args).compile()
    compile_s = time.perf_counter() - began
    jax.block_until_ready(compiled(*args))
    seconds = size.median_seconds(lambda: jax.block_until_ready(compiled(*args)))
    return {"steps_per_s": n * ticks / seconds, "compile_s": compile_s}


def core_gflops(size: Size) -> float:
    """Rate of a 1024 x 1024 float32 matrix product on this core, the arithmetic limit to compare with [GFLOP/s]."""
    a = jnp.ones((1024, 1024), jnp.float32)
    product = jax.jit(jnp.dot)
    jax.block_until_ready(product(a, a))
    return 2e-9 * 1024**3 / size.median_seconds(lambda: jax.block_until_ready(product(a, a)))


def workers(kind: str, name: str, count: int, batch: int, quick: bool, cache: str) -> float:
    """Steps per second of `count` processes that run at the same time, each on a core of its own."""
    children = [spawn(kind, name, batch, quick, core, cache) for core in CORES[-count:]]
    for child in children:
        read_line(child)
    for child in children:
        assert child.stdin is not None
        child.stdin.write("go\n")
        child.stdin.flush()
    rates = [float(read_line(child)) for child in children]
    for child in children:
        child.wait()
    return sum(rates)


def compile_times(kind: str, name: str, batch: int, quick: bool, cache: str) -> dict[str, float]:
    """Seconds from the call to the compiled closed loop, tracing included; `cache` is empty at first, then full."""
    times = []
    for _ in range(2):
        child = spawn(kind, name, batch, quick, CORES[-1] if CORES else None, cache)
        times.append(float(read_line(child)))
        child.wait()
    return {"batch": batch, "cold_s": times[0], "from_cache_s": times[1]}


def spawn(
    kind: str, name: str, batch: int, quick: bool, core: int | None, cache: str
) -> subprocess.Popen[str]:
    """Start this program as a worker."""
    command = [sys.executable, str(Path(__file__)), "--worker", kind, "--robot", name, "--batch", str(batch)]
    env = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR")}
    if core is not None:
        env["THROUGHPUT_CORE"] = str(core)
    env |= {
        "XDG_CACHE_HOME": cache,
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return subprocess.Popen(
        [*command, *(["--quick"] if quick else [])],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=env,
    )


def read_line(child: subprocess.Popen[str]) -> str:
    """The next line a worker says that is meant for the parent."""
    assert child.stdout is not None
    for line in child.stdout:
        if line.startswith("worker: "):
            return line.removeprefix("worker: ").strip()
    raise RuntimeError(f"a worker ended with exit code {child.wait()}")


def say(value: Any) -> None:
    """Tell the parent."""
    print("worker:", value, flush=True)


def work_closed_loop(name: str, size: Size, batch: int) -> None:
    """Worker: the closed loop when told to go."""
    _, call, _ = compiled_loop(name, batch, size.ticks)
    work(call, batch * size.ticks, size.repeats)


def work_closed_loop_in_c(name: str, size: Size, batch: int) -> None:
    """Worker: the closed loop in C when told to go."""
    work(machine_code(name, batch, size.ticks)[0], batch * size.ticks, size.repeats)


def work_c_mujoco(name: str, size: Size, batch: int) -> None:
    """Worker: C MuJoCo when told to go."""
    _, call, ticks = c_rollout(name, size)
    work(call, ticks, 3 * size.repeats)


def work(call: Callable[[], Any], ticks: int, repeats: int) -> None:
    """Warm up, wait, measure, say the rate."""
    call()
    say("ready")
    sys.stdin.readline()
    say(ticks / common.median_seconds(call, repeats))


def work_compile(name: str, size: Size, batch: int) -> None:
    """Worker: only compile."""
    say(compiled_loop(name, batch, size.ticks)[2])


def work_compile_in_c(name: str, size: Size, batch: int) -> None:
    """Worker: only trace, print and compile, or find all that."""
    say(machine_code(name, batch, size.ticks)[1])


WORKERS = {
    "closed_loop": work_closed_loop,
    "closed_loop_in_c": work_closed_loop_in_c,
    "c_mujoco": work_c_mujoco,
    "compile": work_compile,
    "compile_in_c": work_compile_in_c,
}


def in_words(result: dict[str, Any]) -> str:
    """Everything in one table."""
    head = result["header"]
    versions = ", ".join(f"{name} {version}" for name, version in head["versions"].items())
    peers = {
        "C MuJoCo rollout, native contacts": "c_mujoco_per_core",
        "Python loop of mj_step, NumPy controller": "python_loop",
        "mjx.step, native contacts, best batch": "mjx_contacts_per_core",
    }
    rows = [
        [f"closed loop, batch {n}", f"{one['steps_per_s']:,.0f}", "", "", f"{one['compile_s']:.1f}"]
        for n, one in result["closed_loop"].items()
    ]
    rows += [
        [f"closed loop in C, batch {n}", f"{one['steps_per_s']:,.0f}", "", "", f"{one['compile_s']:.1f}"]
        for n, one in result["closed_loop_in_c"].items()
    ]
    rows += [
        [name, f"{result[key]:,.0f}", f"{result['ratios'][key]:.2f}", f"{EXPECTED[key]:g}", ""]
        for name, key in peers.items()
    ]
    rows += [
        [
            f"mjx.step, native contacts, batch {n}",
            f"{one['steps_per_s']:,.0f}",
            "",
            "",
            f"{one['compile_s']:.1f}",
        ]
        for n, one in result["mjx_contacts"].items()
    ]
    rows += [
        [f"{kind.replace('_', ' ')}, {n} process{'es' if n != '1' else ''}", f"{rate:,.0f}", "", "", ""]
        for kind, by_count in result["workers"].items()
        for n, rate in by_count.items()
    ]
    columns = ["", "steps/s", "closed loop is worth", "expected", "compile [s]"]
    title = (
        f"{result['robot']}, {1e3 * DT:g} ms, controller every {result['control_every']} steps, float32, "
        f"{result['clock']} time"
    )
    memory = result["bytes_per_scenario"]
    compiling = {"XLA": result["compile"], "C": result["compile_in_c"]}
    return "\n".join(
        [
            f"{head['cpu']}, one core per process, {head['system']}, Python {head['python']}",
            versions,
            f"commit {head['commit']}",
            "",
            common.table(title, columns, rows),
            *(
                f"{name} is ready in {one['cold_s']:.1f} s at batch {one['batch']}, "
                f"from the caches in {one['from_cache_s']:.1f} s"
                for name, one in compiling.items()
                if one is not None
            ),
            f"robot-seconds a second and core: {result['robot_seconds_per_core']:,.0f}",
            f"memory: {result['peak_memory_bytes'] / 2**20:.0f} MiB peak"
            + (f", {memory / 1024:.1f} KiB per scenario" if memory else ""),
            f"float32 matrix product on this core: {result['core_gflops']:.0f} GFLOP/s",
        ]
    )


if __name__ == "__main__":
    main()

"""Do the compliant ground and C MuJoCo agree on who walks? Random scenarios, closed loop, every variant of both robots.

Every scenario: 0 to 2 pads or holes under footholds, whole or with an edge at a random place under the sole; a load of
0 to 20 kg at a random time; friction 0.3 to 1.0; every link's mass within 10 %; a push of 20 to 150 N for 0.1 s; no
noise. C MuJoCo walks each with three models of the contact (`sim.physics.c_world`). What counts is the agreement where
the three agree with each other: where they do not, the contact itself decides, and nobody knows who is right.

    python sweeps/agreement.py --json runs/agreement.json

Beside it stands how often each model agrees with the other two and ours, where those agree: what a ground can reach.
Where ours is alone, all four walk NUDGES times more with every link's mass off by --nudge at random. If a verdict
changes, the scenario is on an edge and says nothing of the ground; the others must be explained.

C MuJoCo does not know our damping, slip speed and tick, and its contacts are as stiff as --native-sinkage says. Its
walks are kept in --cache, so that another ground of ours is compared in a fraction of the time; choose it on one half
of the scenarios and report the other:

    python sweeps/agreement.py --half first --sinkage 1e-4 --damping 30
"""

import argparse
import hashlib
import io
import json
import multiprocessing
import queue
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent import futures
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jaxbiped.runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxbiped
from jaxbiped import checked, files, planner, robot, runtime
from jaxbiped.adapt import Controller, variants
from jaxbiped.batch.summary import wilson
from jaxbiped.checked import Quantity, Refusal
from jaxbiped.commands import choices
from jaxbiped.sim import (
    STATUS_TEXT,
    Options,
    Scenario,
    Walk,
    own_options,
    prepare,
    require_clear_start,
    require_swing_clears,
    swing_height,
)
from jaxbiped.sim.lockstep import run as run_in_c
from jaxbiped.sim.options import C_MUJOCO
from jaxbiped.sim.physics.c_world import CONTACTS
from jaxbiped.sim.scenario import PAD_AROUND, PAD_BEHIND, RANGES, pad_under

OFF, PAPER, ORIGINAL, MODIFIED, REPAIRED = (
    choices.OFF,
    choices.PAPER,
    choices.ORIGINAL,
    choices.MODIFIED,
    choices.REPAIRED,
)
STAGES = {
    "off": (OFF, OFF),
    "landing-paper": (PAPER, OFF),
    "landing-repaired": (REPAIRED, OFF),
    "payload-original": (OFF, ORIGINAL),
    "payload-modified": (OFF, MODIFIED),
    "payload-repaired": (OFF, REPAIRED),
    "both-repaired": (REPAIRED, REPAIRED),
}
"""Landing and payload stage of a variant, by the names of their variants."""
LIBRARY, THESIS = "library", "thesis"
"""Options of a walk: the library's defaults, or those of the thesis' own walk."""
REFLEXES = ("off", "payload-original", "payload-modified", "payload-repaired")
VARIANTS: dict[str, dict[str, tuple[str, str]]] = {
    "surena3": {name: (name, LIBRARY) for name in STAGES},
    "elkahlout": {
        **{name: (name, LIBRARY) for name in REFLEXES},
        **{f"thesis-{name}": (name, THESIS) for name in REFLEXES},
    },
}
"""Stages and options of every variant of a robot."""
STEPS, DURATION = {"surena3": 6, "elkahlout": 4}, 14.0
"""Steps of the plan, and how long a walk is watched [s]."""
HIGHEST, CLEARED = 0.05, 0.9
"""Highest pad and deepest hole [m], and the share of the swing height that a pad may have."""
HEAVIEST = 20.0
"""Load [kg]."""
MASSES = 0.1
"""How far every link's mass may be off, as a share."""
NUDGES, NUDGE = 6, 1e-3
"""How often a scenario is walked again in which ours is alone, and how far masses are off then, as a share."""
PUSHES, PUSH_LENGTH = (20.0, 150.0), 0.1
"""Horizontal force [N], and its time [s]."""
WHOLE, FRONT, BACK, SIDE = "whole", "front", "back", "side"
EDGES = (WHOLE, WHOLE, WHOLE, FRONT, BACK, SIDE)
"""Which edge of a pad lies under the sole."""
OURS = "compliant"
COLUMNS = ("status", "end_time_s", "tilt_deg", "force_N", "slip_mm", "reflexes", "reflex_time_s")
EVERY = 5.0
"""How often the progress is told [s]."""
SOURCES = ("robot", "kinematics", "planner", "adapt", "sim")
"""Parts of the package that a walk in C MuJoCo depends on."""
Columns = dict[str, np.ndarray]
"""Of walks, by the names in COLUMNS."""
Told = Callable[[str, float], None]
"""What is told of the progress: what goes on, and the share of it that is done."""


# Scenarios -------------------------------------------------------------------------------------------------------


def drawn(params: robot.RobotParams, gait: Any, seed: Sequence[int]) -> Scenario:
    """One random scenario; one that starts on an obstacle, or whose obstacles overlap, is drawn anew."""
    rng = np.random.default_rng(seed)
    while True:
        try:
            scenario = with_pads(Scenario.flat(2), params, gait, rng)
            require_clear_start(params, gait, scenario.terrain)
            break
        except Refusal:
            continue
    angle, force = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*PUSHES)
    push = (force * np.cos(angle), force * np.sin(angle), 0.0)
    scenario = scenario.with_friction(rng.uniform(0.3, 1.0))
    scenario = scenario.with_payload(rng.uniform(0.0, HEAVIEST), rng.uniform(0.1, 0.7) * DURATION)
    scenario = scenario.with_push(push, rng.uniform(0.1, 0.9) * DURATION, PUSH_LENGTH)
    masses = jnp.asarray(rng.uniform(1.0 - MASSES, 1.0 + MASSES, 13), jnp.result_type(float))
    return eqx.tree_at(lambda s: s.errors.mass_scale, scenario, masses)


def with_pads(scenario: Scenario, params: robot.RobotParams, gait: Any, rng: np.random.Generator) -> Scenario:
    """Put 0 to 2 pads or holes under footholds of different steps.

    Raises:
        Refusal: if two of them overlap.
    """
    highest = min(HIGHEST, CLEARED * swing_height(gait))
    steps = rng.choice(int(gait.timing.n_steps), rng.integers(0, 3), replace=False)
    pads: list[tuple[np.ndarray, np.ndarray]] = []
    for step in steps.tolist():
        height = rng.uniform(-highest, highest)
        require_swing_clears(gait, {step: height})
        lower, upper = cut(*pad_under(params, gait, step), str(rng.choice(EDGES)), rng)
        if any((low < upper).all() and (lower < high).all() for low, high in pads):
            raise Refusal(f"step {step}: got an obstacle that overlaps another one, allowed: obstacles apart")
        pads.append((lower, upper))
        scenario = scenario.with_rectangle(lower, upper, height)
    return scenario


def cut(
    lower: np.ndarray, upper: np.ndarray, edge: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Move one edge of the pad under a foothold to a random place under the sole [m]."""
    lower, upper = lower.copy(), upper.copy()
    (heel, right), (toe, left) = lower + np.array([PAD_BEHIND, PAD_AROUND]), upper - PAD_AROUND
    if edge == FRONT:
        upper[0] = rng.uniform(heel, toe)
    elif edge == BACK:
        lower[0] = rng.uniform(heel, toe)
    elif edge == SIDE:
        (upper if rng.random() < 0.5 else lower)[1] = rng.uniform(right, left)
    return lower, upper


def described(scenario: Scenario) -> dict[str, Any]:
    """All that is random in a scenario."""
    s = jax.tree.map(np.asarray, scenario)
    used = (s.terrain.lower < s.terrain.upper).all(axis=1)
    terrain = zip(s.terrain.lower[used], s.terrain.upper[used], s.terrain.height[used], strict=True)
    return {
        "rectangles_m": [[*_plain(low), *_plain(high), _plain(height)] for low, high, height in terrain],
        "load_kg": _plain(s.payload.mass),
        "load_time_s": _plain(s.payload.time),
        "friction": _plain(s.ground.friction),
        "push_N": _plain(s.push.force[:2]),
        "push_time_s": _plain(s.push.start),
        "mass_scale": _plain(s.errors.mass_scale),
    }


def _plain(value: Any) -> Any:
    return np.asarray(value, float).round(4).tolist()


def of_half(n: int, half: str) -> list[int]:
    """Numbers of the scenarios: the even ones are the first half, the odd ones the second."""
    return list(range(n))[
        {"first": slice(0, None, 2), "second": slice(1, None, 2), "both": slice(None)}[half]
    ]


# Walks -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ground:
    """Ours; None for the library's own."""

    sinkage: float | None = None
    """[m]"""
    damping: float | None = None
    """[s/m]"""
    slip_speed: float | None = None
    """[m/s]"""
    dt: float | None = None
    """Physics tick [s]; a control tick stays as long as it is."""

    def under(self, batch: Scenario) -> Scenario:
        """The same scenarios on this ground."""
        for name in ("sinkage", "damping", "slip_speed"):
            value = getattr(self, name)
            if value is not None:
                old = getattr(batch.ground, name)
                batch = eqx.tree_at(lambda s, n=name: getattr(s.ground, n), batch, jnp.full_like(old, value))
        return batch

    def ticks(self, options: Options) -> Options:
        """Options with this tick.

        Raises:
            Refusal: if a control tick is no whole number of them.
        """
        if self.dt is None:
            return options
        every = round(options.control_dt / self.dt)
        if every < 1 or abs(every * self.dt - options.control_dt) > 1e-9:
            raise Refusal(
                f"--dt: got {self.dt:g} s, allowed: a whole share of the control tick of {options.control_dt:g} s"
            )
        return replace(options, dt=self.dt, control_every=every)


class Job(NamedTuple):
    """The walks of one variant."""

    robot: str
    variant: str
    numbers: list[int]
    """Of its scenarios."""
    seed: int
    ground: Ground
    native_sinkage: float
    """As stiff as which contacts in C MuJoCo are [m]."""
    cache: Path | None
    nudge: float = NUDGE
    """How far masses are off where ours is alone, as a share."""

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.robot} {self.variant}"


def set_up(name: str, variant: str) -> tuple[robot.RobotParams, Controller, Options]:
    """Robot, controller and options of a variant."""
    stages, options = VARIANTS[name][variant]
    landing, payload = STAGES[stages]
    params = robot.load(name)
    gait = planner.own_gait(params, STEPS[name])
    controller = Controller(
        gait,
        variants.stage_of("landing", landing, params, gait),
        variants.stage_of("payload", payload, params, gait),
    )
    return params, controller, own_options(params, gait) if options == THESIS else Options()


def scenarios(job: Job) -> list[Scenario]:
    """Those of a job; a scenario depends on seed, variant and its own number."""
    params, controller, _ = set_up(job.robot, job.variant)
    number = list(VARIANTS[job.robot]).index(job.variant)
    return [drawn(params, controller.gait, (job.seed, number, i)) for i in job.numbers]


class Found(NamedTuple):
    """The walks of a job, as columns by the name of the ground or contact."""

    walks: dict[str, Columns]
    nudged: dict[str, Columns]
    """Of the scenarios in which ours is alone, NUDGES of each one after the other."""


def walk(job: Job, told: Told) -> Found:
    """Walk all scenarios of a job on our ground and in C MuJoCo, and nudged those in which ours is alone."""
    each = scenarios(job)
    found = walk_these(job, each, told)
    alone = [
        one for i in compare(found)["alone"] for one in nudged(each[i], (job.seed, job.numbers[i]), job.nudge)
    ]
    none = {name: {column: values[:0] for column, values in table.items()} for name, table in found.items()}
    return Found(found, walk_these(job, alone, told) if alone else none)


def nudged(scenario: Scenario, seed: Sequence[int], nudge: float) -> list[Scenario]:
    """The same with the masses off by a nudge, up or down at random."""
    rng = np.random.default_rng(seed)
    own = scenario.errors.mass_scale
    scales = [jnp.asarray(own * rng.choice([1.0 - nudge, 1.0 + nudge], 13), own.dtype) for _ in range(NUDGES)]
    return [eqx.tree_at(lambda s: s.errors.mass_scale, scenario, scale) for scale in scales]


def walk_these(job: Job, each: Sequence[Scenario], told: Told) -> dict[str, Columns]:
    """Columns by the name of the ground or contact."""
    params, controller, options = set_up(job.robot, job.variant)
    told("compliant ground", 0.0)
    mine = job.ground.under(stacked(each))
    found = {OURS: ours(params, controller, mine, job.ground.ticks(options))}
    native = Ground(sinkage=job.native_sinkage).under(stacked(each))
    return found | natives(job, params, controller, native, options, told)


def stacked(each: Sequence[Any]) -> Any:
    """Records into one with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def ours(params: robot.RobotParams, controller: Controller, batch: Scenario, options: Options) -> Columns:
    """Walks on the compliant ground, all at once."""
    return columns(prepare(params, controller, options).run_many(batch, DURATION))


def columns(walks: Walk) -> Columns:
    """What is compared, of walks with a leading axis."""
    s = jax.tree.map(np.asarray, walks.statistics)
    signals = None if walks.controller is None else walks.controller.signals
    none = np.zeros(len(s.status))
    return {
        "status": s.status,
        "end_time_s": s.end_time,
        "tilt_deg": np.rad2deg(s.peak_roll_pitch.max(axis=1)),
        "force_N": s.peak_foot_force.max(axis=1),
        "slip_mm": 1e3 * s.peak_slip.max(axis=1),
        "reflexes": none if signals is None else np.asarray(signals.interruptions),
        "reflex_time_s": none if signals is None else np.asarray(signals.interrupted_time),
    }


def natives(
    job: Job, params: robot.RobotParams, controller: Controller, batch: Scenario, options: Options, told: Told
) -> dict[str, Columns]:
    """Walks in C MuJoCo with every model of the contact; those that are not in the cache, all in lockstep."""
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], batch) for i in range(len(batch.ground.sinkage))]
    walks = [(contact, scenario) for contact in CONTACTS for scenario in each]
    keys = [key_of(job, scenario, options, contact) for contact, scenario in walks]
    rows = [recall(job.cache, key) for key in keys]
    missing = [i for i, row in enumerate(rows) if row is None]
    last = 0.0

    def shown(share: float) -> None:
        nonlocal last
        if time.monotonic() > last + 1.0:
            last = time.monotonic()
            told(f"{len(missing)} in C MuJoCo", share)

    if missing:
        told("C MuJoCo", 0.0)
        contacts, left = zip(*(walks[i] for i in missing), strict=True)
        simulation = prepare(params, controller, replace(options, contact=C_MUJOCO))
        table = columns(run_in_c(simulation, stacked(left), DURATION, shown, contacts))
        for number, i in enumerate(missing):
            rows[i] = row = {name: value[number] for name, value in table.items()}
            keep(job.cache, keys[i], row)
    known = [row for row in rows if row is not None]
    table = {name: np.stack([row[name] for row in known]).reshape(len(CONTACTS), -1) for name in COLUMNS}
    return {contact: {name: table[name][i] for name in COLUMNS} for i, contact in enumerate(CONTACTS)}


# The cache of walks in C MuJoCo ----------------------------------------------------------------------------------


def key_of(job: Job, scenario: Scenario, options: Options, contact: str) -> str:
    """Names a walk in C MuJoCo: what walks where and how, by which versions and sources."""
    said = {
        "robot": job.robot,
        "variant": VARIANTS[job.robot][job.variant],
        "steps": STEPS[job.robot],
        "duration": DURATION,
        "options": repr(options),
        "contact": contact,
        "versions": {name: metadata.version(name) for name in ("mujoco", "numpy", "jax", "jaxlib")},
        "jaxbiped": jaxbiped.__version__,
        "sources": _sources(),
    }
    digest = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    for leaf in jax.tree.leaves(scenario):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()[:32]


@cache
def _sources() -> str:
    """Hash of the sources that a walk in C MuJoCo depends on."""
    package = Path(jaxbiped.__file__).parent
    digest = hashlib.sha256()
    for place in (package / name for name in SOURCES):
        for file in [place] if place.is_file() else sorted(p for p in place.rglob("*") if p.is_file()):
            if file.suffix in (".py", ".toml"):
                digest.update(file.read_bytes())
    return digest.hexdigest()


def recall(cache: Path | None, key: str) -> Columns | None:
    """A walk that was kept, one number a column."""
    path = None if cache is None else cache / f"{key}.npz"
    if path is None or not path.exists():
        return None
    with np.load(path) as kept:
        return {name: kept[name] for name in COLUMNS}


def keep(cache: Path | None, key: str, row: Mapping[str, Any]) -> None:
    """Keep a walk for `recall`."""
    if cache is not None:
        cache.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **row)
        files.write(cache / f"{key}.npz", content.getvalue())


# The comparison --------------------------------------------------------------------------------------------------


def survived(walks: Columns) -> np.ndarray:
    """Whether nothing happened to the robot all the time it was watched."""
    return walks["status"] == 0


def share(agree: np.ndarray) -> dict[str, Any]:
    """How many agree, with Wilson's interval."""
    k, n = int(agree.sum()), int(agree.size)
    return {"agree": k, "n": n, "interval": list(wilson(k, n))}


def compare(found: Mapping[str, Columns]) -> dict[str, Any]:
    """Our walks against those of all models of the contact, given by name; ours is called OURS.

    `decided` are the walks in which the models agree with each other, `alone` the numbers of those of them in which
    ours says otherwise.
    """
    mine, models = found[OURS], {name: walks for name, walks in found.items() if name != OURS}
    upright = survived(mine)
    votes = np.stack([survived(walks) for walks in models.values()])
    decided = (votes == votes[0]).all(axis=0)
    return {
        "n": int(upright.size),
        "survived": {name: int(survived(walks).sum()) for name, walks in found.items()},
        "each": {name: share(upright == survived(walks)) for name, walks in models.items()},
        "decided": share((upright == votes[0])[decided]),
        "undecided": int((~decided).sum()),
        "apart": {name: apart(mine, walks) for name, walks in models.items()},
        "alone": np.flatnonzero(decided & (upright != votes[0])).tolist(),
        "yardstick": {name: one_of_four(found, name) for name in models},
    }


def one_of_four(found: Mapping[str, Columns], name: str) -> dict[str, Any]:
    """How often a ground agrees with the three others where these agree with each other."""
    own = survived(found[name])
    votes = np.stack([survived(walks) for other, walks in found.items() if other != name])
    decided = (votes == votes[0]).all(axis=0)
    return share((own == votes[0])[decided])


def apart(one: Columns, other: Columns) -> dict[str, Any]:
    """How far two walks of a scenario are apart: medians and 90th percentiles of magnitudes, None of no walks."""
    both = survived(one) & survived(other)
    neither = ~survived(one) & ~survived(other)
    force = 100.0 * (one["force_N"] / other["force_N"] - 1.0)
    return {
        "both_walk": int(both.sum()),
        "both_fall": int(neither.sum()),
        "tilt_deg": _percentiles((one["tilt_deg"] - other["tilt_deg"])[both]),
        "force_percent": _percentiles(force[both]),
        "fall_time_s": _percentiles((one["end_time_s"] - other["end_time_s"])[neither]),
    }


def _percentiles(difference: np.ndarray) -> list[float] | None:
    return np.percentile(np.abs(difference), [50, 90]).tolist() if difference.size else None


def joined(parts: Sequence[Mapping[str, Columns]]) -> dict[str, Columns]:
    """The walks of several variants in one table."""
    return {
        ground: {name: np.concatenate([part[ground][name] for part in parts]) for name in COLUMNS}
        for ground in parts[0]
    }


def disagreement(job: Job, scenario: Scenario, found: Found, i: int, place: int) -> Any:
    """A walk on which ours is alone, with all that is needed to walk it again, and what a nudge makes of it."""
    number = job.numbers[i]
    nudges = slice(NUDGES * place, NUDGES * (place + 1))
    changed = {
        ground: int((survived(found.nudged[ground])[nudges] != survived(table)[i]).sum())
        for ground, table in found.walks.items()
    }
    walks = {
        ground: {
            name: STATUS_TEXT[int(table[name][i])] if name == "status" else round(float(table[name][i]), 3)
            for name in COLUMNS
        }
        for ground, table in found.walks.items()
    }
    named = {"variant": job.variant, "number": number, "scenario": described(scenario)}
    return {**named, "walks": walks, "changed_by_a_nudge": changed}


def report(jobs: Sequence[Job], results: Sequence[Found]) -> dict[str, Any]:
    """The comparison of every robot, as a whole and by variant."""
    said = {}
    for name in dict.fromkeys(job.robot for job in jobs):
        own = [(job, found) for job, found in zip(jobs, results, strict=True) if job.robot == name]
        alone = []
        for job, found in own:
            places = compare(found.walks)["alone"]
            each = scenarios(job) if places else []
            alone += [disagreement(job, each[i], found, i, place) for place, i in enumerate(places)]
        said[name] = {
            "all": compare(joined([found.walks for _, found in own])),
            "variants": {job.variant: compare(found.walks) for job, found in own},
            "alone": alone,
        }
    return said


def show(said: Mapping[str, Any]) -> None:
    """Print it."""
    for name, one in said.items():
        whole = one["all"]
        print(f"\n{name}: {whole['n']} walks of {DURATION:g} s; survived: {whole['survived']}")
        print(f"  verdicts agree where the models agree with each other: {_share(whole['decided'])}")
        on_edge = sum(any(row["changed_by_a_nudge"].values()) for row in one["alone"])
        print(f"  of {len(one['alone'])} in which ours is alone, {on_edge} are on an edge")
        print(f"  the models do not agree with each other in {whole['undecided']}")
        for contact, agree in whole["yardstick"].items():
            print(f"  yardstick: {contact} agrees with the three others where these agree: {_share(agree)}")
        for contact, agree in whole["each"].items():
            print(f"  {contact:8s} {_share(agree)}; {_apart(whole['apart'][contact])}")
        print("  by variant: agreement where the models agree, undecided, survived ours and in C MuJoCo")
        for variant, own in one["variants"].items():
            counts = "  ".join(f"{count:3d}" for count in own["survived"].values())
            print(f"    {variant:24s} {_share(own['decided']):32s} {own['undecided']:3d}    {counts}")
        for row in one["alone"]:
            print(f"  alone: {row['variant']} number {row['number']}: {json.dumps(row['scenario'])}")
            for ground, walks in row["walks"].items():
                changed = f"{row['changed_by_a_nudge'][ground]} of {NUDGES} change by a nudge"
                print(f"      {ground:10s} {walks}; {changed}")


def _share(agree: Mapping[str, Any]) -> str:
    k, n, (low, high) = agree["agree"], agree["n"], agree["interval"]
    rate = f"{100.0 * k / n:.1f} % " if n else ""
    return f"{k} of {n}, {rate}({100.0 * low:.0f} to {100.0 * high:.0f})"


def _apart(one: Mapping[str, Any]) -> str:
    def words(name: str) -> str:
        return "-" if one[name] is None else "{:.2f}, {:.2f}".format(*one[name])

    return (
        f"apart (median, 90 %) in {one['both_walk']} that walk: tilt {words('tilt_deg')} deg, peak force "
        f"{words('force_percent')} %; in {one['both_fall']} that fall: {words('fall_time_s')} s"
    )


# All jobs --------------------------------------------------------------------------------------------------------

_WORDS: Any = None
"""Where a worker process says how far it is."""


def _begin(words: Any) -> None:
    global _WORDS
    _WORDS = words
    runtime.keep_compiled_kernels()


def _work(number: int, job: Job) -> Found:
    return walk(job, lambda what, done: _WORDS.put((number, what, done)))


def walk_all(jobs: Sequence[Job], processes: int) -> list[Found]:
    """Walk every job, each in one of some processes, and say how far it is every few seconds."""
    context, began = multiprocessing.get_context("spawn"), time.monotonic()
    words: Any = context.Queue()
    at: dict[int, str] = {}
    with futures.ProcessPoolExecutor(processes, context, _begin, (words,)) as pool:
        waiting = [pool.submit(_work, number, job) for number, job in enumerate(jobs)]
        while not all(one.done() for one in waiting):
            _, left = futures.wait(waiting, timeout=EVERY, return_when=futures.FIRST_EXCEPTION)
            for one in waiting:
                if one.done() and one.exception() is not None:
                    pool.shutdown(cancel_futures=True)
                    one.result()
            _listen(words, at)
            now = [f"{jobs[i].name}: {at[i]}" for i in sorted(at) if not waiting[i].done()]
            seconds, done = time.monotonic() - began, len(jobs) - len(left)
            print(
                f"[{seconds:5.0f} s] {done} of {len(jobs)} variants; {'; '.join(now)}",
                file=sys.stderr,
                flush=True,
            )
        return [one.result() for one in waiting]


def _listen(words: Any, at: dict[int, str]) -> None:
    """Take in what the workers have said."""
    while True:
        try:
            number, what, done = words.get_nowait()
        except queue.Empty:
            return
        at[number] = f"{what} {100.0 * done:.0f} %" if done else f"{what} begins"


def main() -> None:
    """Parse the command line, walk and compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", choices=list(VARIANTS), nargs="+", default=list(VARIANTS))
    known = list(dict.fromkeys(name for own in VARIANTS.values() for name in own))
    parser.add_argument("--variant", choices=known, nargs="+", help="default: all of the robot")
    parser.add_argument("--n", type=int, default=30, help="scenarios of each variant")
    parser.add_argument("--half", choices=["first", "second", "both"], default="both")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sinkage", type=float, help="of our ground [m]")
    parser.add_argument("--damping", type=float, help="of our ground [s/m]")
    parser.add_argument("--slip-speed", type=float, help="of our ground [m/s]")
    parser.add_argument("--dt", type=float, help="our physics tick [s]")
    usual = float(Scenario.flat(0).ground.sinkage)
    parser.add_argument("--native-sinkage", type=float, default=usual, help="of C MuJoCo's contacts [m]")
    parser.add_argument(
        "--nudge", type=float, default=NUDGE, help="of masses where ours is alone, as a share"
    )
    parser.add_argument("--cache", type=Path, default=Path("runs/agreement"), help="of walks in C MuJoCo")
    parser.add_argument("--json", type=Path, help="file for all numbers")
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    try:
        jobs = jobs_of(given)
    except Refusal as error:
        sys.exit(str(error))
    results = walk_all(jobs, given.processes)
    said = report(jobs, results)
    show(said)
    if given.json is not None:
        asked = {"ground": asdict(jobs[0].ground), "native_sinkage": given.native_sinkage, "seed": given.seed}
        asked |= {"n": given.n, "half": given.half, "duration_s": DURATION}
        given.json.parent.mkdir(parents=True, exist_ok=True)
        files.write(given.json, json.dumps({**asked, "robots": said}, indent=1))


def jobs_of(given: argparse.Namespace) -> list[Job]:
    """One job for every variant that was asked for.

    Raises:
        Refusal: for a number out of range, or no variant left.
    """
    for name, low, high in (("n", 1, 100_000), ("processes", 1, 1000), ("seed", 0, 2**31)):
        checked.whole(f"--{name}", getattr(given, name), low, high)
    for name, column in (
        ("sinkage", "sinkage_m"),
        ("damping", "damping_s_per_m"),
        ("slip_speed", "slip_speed_m_per_s"),
        ("native_sinkage", "sinkage_m"),
    ):
        if getattr(given, name) is not None:
            RANGES[column].check(f"--{name.replace('_', '-')}", getattr(given, name))
    Quantity("", 0.0, MASSES, above=True).check("--nudge", given.nudge)
    ground = Ground(given.sinkage, given.damping, given.slip_speed, given.dt)
    numbers = of_half(given.n, given.half)
    jobs = []
    for name in given.robot:
        for variant, (_, options) in VARIANTS[name].items():
            if given.variant is None or variant in given.variant:
                ground.ticks(Options(control_every=1) if options == THESIS else Options())
                jobs.append(
                    Job(
                        name,
                        variant,
                        numbers,
                        given.seed,
                        ground,
                        given.native_sinkage,
                        given.cache,
                        given.nudge,
                    )
                )
    if not jobs or not numbers:
        raise Refusal(
            f"--variant, --n, --half: got no walk of {', '.join(given.robot)}, allowed: at least one"
        )
    return jobs


if __name__ == "__main__":
    main()

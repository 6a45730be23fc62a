"""The landing stage against the tick-by-tick transcription, on random histories of the contact switches.

No loop is closed: the switches say what the history has them say, whatever the stage commands. The transcription is
given the plan as the stage is, by its position, velocity and acceleration at the ticks; between ticks both follow
that parabola, so they differ by rounding only.
"""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from landing_transcription import ALL_REPAIRS, Commands, Numbers, Plan, Readings, Repairs, commands

from jaxbiped import planner, robot
from jaxbiped.adapt import Landing, Sensed, Signals
from jaxbiped.adapt.landing import LandingStage

N_STEPS = 6
TICKS = 2768
"""4 ms in the walk of surena3: from just before its first lift-off until a while after the last step."""
BATCH = 40
ATOL = {"position": 1e-10, "velocity": 1e-9, "acceleration": 1e-8}
"""[m], [m/s], [m/s2]"""
GAITS = {"surena3": planner.PolynomialGait, "elkahlout": planner.CosineGait}
EVENTS = (
    "advance",
    "at T_s/2",
    "at T_s",
    "at T_s",
    "at T_c",
    "retard",
    "late",
    "held from before T_s/2",
    "never",
)
VARIANTS = {"paper": (Landing.paper, Repairs()), "repaired": (Landing.repaired, ALL_REPAIRS)}


class Walk(eqx.Module):
    """A planned walk at its ticks."""

    gait: Any
    time: np.ndarray
    nominal: planner.Targets
    plan: Plan

    @property
    def dt(self) -> float:
        return float(self.time[1] - self.time[0])


def three_bodies(targets: planner.Targets) -> jax.Array:
    """Position, velocity and acceleration of left sole, right sole, pelvis, (3 orders, 3 bodies, 3)."""
    orders = (targets.position, targets.velocity, targets.acceleration)
    return jnp.stack([jnp.concatenate([order.sole, order.pelvis[None]]) for order in orders])


@cache
def planned(name: str) -> Walk:
    """The preset walk of a robot; call it in float64."""
    gait = GAITS[name].preset(robot.load(name), N_STEPS)
    timing = gait.timing
    first, T_c = float(timing.first_liftoff), float(timing.T_c)
    before = 10
    dt = (N_STEPS * T_c + 0.23) / (TICKS - before) if name == "elkahlout" else 0.004
    time = first + dt * (np.arange(TICKS) - before)
    nominal = jax.jit(jax.vmap(lambda t: planner.at(gait, t)))(jnp.asarray(time))
    phase = nominal.phase
    pose = np.asarray(jax.vmap(three_bodies)(nominal))
    step, swing, tau = (np.asarray(leaf) for leaf in (phase.step, phase.swing, phase.time_since_liftoff))
    return Walk(gait, time, nominal, Plan(time, step, swing, tau, pose, float(timing.T_s), T_c))


def intervals_of_a_foot(rng: np.random.Generator, walk: Walk, foot: int) -> list[list[tuple[float, float]]]:
    """When each switch of a foot is closed: (from, to) in the order of time."""
    timing, dt = walk.gait.timing, walk.dt
    T_s, T_c = walk.plan.T_s, walk.plan.T_c
    intervals: list[list[tuple[float, float]]] = [[] for _ in range(4)]
    standing: list[float | None] = [float(walk.time[0]) - 0.1] * 4
    for step in range((foot - timing.first_swing) % 2, N_STEPS, 2):
        liftoff = float(timing.liftoff(step))
        opening = liftoff + rng.uniform(-5 * dt, 0.2 * T_s, 4)
        for corner, since in enumerate(standing):
            if since is not None:
                intervals[corner].append((since, opening[corner]))
        free = opening.max() + 3 * dt

        if rng.random() < 0.5:  # closes and opens again in the first half of the swing
            begin, end = np.sort(rng.uniform(free, liftoff + 0.5 * T_s - dt, 2))
            free = end + 2 * dt
            for corner in rng.permutation(4)[: rng.integers(1, 5)]:
                intervals[corner].append((begin, rng.uniform(begin, end)))

        event = EVENTS[rng.integers(len(EVENTS))]
        half, planned_end, end = liftoff + 0.5 * T_s, liftoff + T_s, liftoff + T_c
        standing = [None] * 4
        if event == "never":
            continue
        edge = {"at T_s/2": half, "at T_s": planned_end, "at T_c": end}.get(event)
        if edge is None:
            closing = {
                "advance": rng.uniform(half, planned_end),
                "retard": rng.uniform(planned_end, end),
                "late": rng.uniform(end - 0.1, end),
                "held from before T_s/2": rng.uniform(min(free, half - dt), half),
            }[event]
        elif rng.random() < 0.5:  # on a tick: just there, or one before or after
            closing = float(walk.time[np.abs(walk.time - edge).argmin() + rng.integers(-1, 2)])
        else:
            closing = edge + rng.uniform(-1.5, 1.5) * dt
        corners = rng.permutation(4)[: rng.integers(1, 5)]  # the others are stuck open
        delays = [0.0, *rng.choice([0.0, 0.4 * dt, 2.3 * dt, 0.1], 3)]
        for corner, delay in zip(corners, delays, strict=False):
            begin = closing + delay
            if rng.random() < 0.5:  # bounces
                for _ in range(rng.integers(1, 7)):
                    shut, gap = rng.uniform(0.3, 6.0) * dt, rng.uniform(0.3, 4.0) * dt
                    intervals[corner].append((begin, begin + shut))
                    begin += shut + gap
            if event != "held from before T_s/2" and rng.random() < 0.15 and corner != corners[0]:
                continue
            standing[corner] = begin
    for corner, since in enumerate(standing):
        if since is not None:
            intervals[corner].append((since, np.inf))
    return intervals


def history(rng: np.random.Generator, walk: Walk) -> Readings:
    """Random readings of the switches over a walk; in every fourth one they come some ticks late."""
    delay = rng.integers(1, 4) if rng.random() < 0.25 else 0
    closed = np.zeros((TICKS, 2, 4), bool)
    closed_at = np.full((TICKS, 2, 4), np.inf)
    for foot in range(2):
        for corner, intervals in enumerate(intervals_of_a_foot(rng, walk, foot)):
            for begin, end in intervals:
                first, last = np.searchsorted(walk.time, (begin, end)) + delay
                closed[first:last, foot, corner] = True
                closed_at[first:, foot, corner] = begin
    return Readings(closed, closed_at)


def parameters(rng: np.random.Generator, default: bool, T_d: float) -> dict[str, float]:
    """Parameters of the landing: the defaults, or random ones."""
    if default:
        return {}
    given = {"T_mod": rng.uniform(0.05, 0.22)} if rng.random() < 0.3 else {}
    speed, acceleration = rng.uniform(0.1, 0.25), rng.uniform(1.0, 2.0)
    return {
        "delta_z": rng.uniform(0.005, 0.02),
        "delta_x_scale": rng.uniform(0.5, 1.5),
        "descent_speed": speed,
        "descent_acceleration": acceleration,
        "max_descent": speed * rng.uniform(speed / acceleration, 1.1 * T_d),
        "release_share": rng.uniform(0.6, 1.0),
        **given,
    }


@eqx.filter_jit
def stage_of(params: Landing, gait: Any) -> LandingStage:
    stage = LandingStage.plan(params, gait)
    return eqx.tree_at(lambda s: s.params.T_mod, stage, None, is_leaf=lambda leaf: leaf is None)


@eqx.filter_jit
def play(
    stages: LandingStage, gait: Any, nominal: planner.Targets, closed: jax.Array, closed_at: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """What the stages command at every tick of a batch of histories, and how many touches they missed."""

    def one(stage: LandingStage, closed: jax.Array, closed_at: jax.Array) -> tuple[jax.Array, jax.Array]:
        def tick(state: Any, row: Any) -> tuple[Any, jax.Array]:
            targets, closed, closed_at = row
            sensed = Sensed.nothing(targets.time, switch=closed, switch_time=closed_at)
            state, commanded, _ = stage.step(state, gait, targets, sensed, Signals.none())
            return state, three_bodies(commanded)

        state, rows = jax.lax.scan(tick, stage.init(), (nominal, closed, closed_at))
        return rows, state.missed

    return jax.vmap(one)(stages, closed, closed_at)


def times_and_ways(
    walk: Walk, delta_z: np.ndarray, T_mod: list[float | None]
) -> tuple[np.ndarray, np.ndarray]:
    """T_mod, where not given from z_f(T_s - T_mod) = delta_z; and delta_x, the way in the last T_mod, by step."""
    timing, T_s = walk.gait.timing, walk.plan.T_s
    task = jax.jit(jax.vmap(walk.gait.task))
    high, low = np.full(len(delta_z), 0.5 * T_s), np.full(len(delta_z), T_s)
    for _ in range(60):
        middle = 0.5 * (high + low)
        z = np.asarray(task(timing.liftoff(0) + middle).sole)[:, timing.first_swing, 2]
        high, low = np.where(z > delta_z, middle, high), np.where(z > delta_z, low, middle)
    times = np.array([T_s - t if given is None else given for t, given in zip(high, T_mod, strict=True)])
    ways = []
    for step in range(N_STEPS):
        end, foot = np.full(len(times), float(timing.touchdown(step))), (timing.first_swing + step) % 2
        ways.append(np.asarray(task(end).sole - task(end - times).sole)[:, foot, 0])
    return times, np.stack(ways, axis=1)


def play_batch(variant: str, walk: Walk, seed: int) -> tuple[np.ndarray, np.ndarray, list[Commands]]:
    """What the stage commands in random histories and how often it misses a touch; what it should command."""
    make, repairs = VARIANTS[variant]
    rng = np.random.default_rng(seed)
    readings = [history(rng, walk) for _ in range(BATCH)]
    chosen = [parameters(rng, i < BATCH // 2, walk.plan.T_c - walk.plan.T_s) for i in range(BATCH)]
    landings = [make(**{name: jnp.asarray(value) for name, value in one.items()}) for one in chosen]
    stages = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(stage_of(p, walk.gait) for p in landings))
    closed, closed_at = (jnp.asarray(np.stack(leaves)) for leaves in zip(*readings, strict=True))
    ours, missed = jax.tree.map(np.asarray, play(stages, walk.gait, walk.nominal, closed, closed_at))
    delta_z = np.array([float(p.delta_z) for p in landings])
    times, ways = times_and_ways(walk, delta_z, [one.get("T_mod") for one in chosen])
    theirs = []
    for p, reading, T_mod, way in zip(landings, readings, times, ways, strict=True):
        numbers = Numbers(
            float(p.delta_z),
            float(T_mod),
            float(p.delta_x_scale) * way,
            float(p.descent_speed),
            float(p.descent_acceleration),
            float(p.max_descent),
            float(p.release_share),
        )
        theirs.append(commands(walk.plan, reading, numbers, repairs))
    return ours, missed, theirs


def require_every_case(plan: Plan, batch: list[Commands]) -> None:
    """Touches of every kind are in the batch, and at every edge of the window."""
    T_s, T_c, dt = plan.T_s, plan.T_c, 1.001 * float(plan.time[1] - plan.time[0])
    touches = np.array([touch for one in batch for touch in one.touch.values()])
    edges = (0.0, 0.5 * T_s + dt, T_s - dt, T_s + 1e-12, T_s + dt, T_c - 2.0 * dt, np.inf)
    names = ("at T_s / 2", "between", "at T_s, before", "at T_s, after", "later", "at T_c", "never")
    counts = [*np.histogram(touches, edges)[0].tolist(), N_STEPS * len(batch) - len(touches)]
    found = dict(zip(names, counts, strict=True))
    assert min(found.values()) >= 2, found


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("name", "seed"), [*(("surena3", seed) for seed in range(5)), ("elkahlout", 5)])
def test_commands_are_those_of_the_transcription(x64, variant, name, seed):
    """At every tick of 200 walks of surena3 and 40 of elkahlout: soles and pelvis, their rates and accelerations."""
    walk = planned(name)
    ours, missed, batch = play_batch(variant, walk, seed)
    require_every_case(walk.plan, batch)
    for i, theirs in enumerate(batch):
        for order, (what, atol) in enumerate(ATOL.items()):
            ticks = ~theirs.kinks if order > 0 else slice(None)
            np.testing.assert_allclose(
                ours[i, ticks, order], theirs.pose[ticks, order], rtol=0, atol=atol, err_msg=f"{i} {what}"
            )
        assert missed[i] == sum(step not in theirs.touch for step in range(N_STEPS - 1))

"""Events take effect from their instants, wherever in a tick: what is commanded is a continuous function of them."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import planner, robot
from jaxbiped.adapt import Landing, LandingStage, PayloadReflex, PayloadStage, Sensed, Signals
from jaxbiped.adapt.reflex.planned import REFLEX, WALK

DT = 0.002
"""Control tick [s]."""
TICKS, PARTS = 3, 32
"""Control ticks over which an instant is moved, and how finely."""
SHARES = np.arange(TICKS * PARTS + 1) / PARTS
STEP = DT / PARTS
NOT_OPTIMISED = {"xla_backend_optimization_level": 0}
"""How to compile what runs once: faster to compile, slower to run."""


def most(commanded: np.ndarray) -> tuple[float, float]:
    """Greatest change between neighbouring instants (leading axis), and what an even change would be."""
    return np.abs(np.diff(commanded, axis=0)).max(), np.abs(commanded[-1] - commanded[0]).max() / len(SHARES)


# ---------------------------------------------------------------- touches


@partial(jax.jit, compiler_options=NOT_OPTIMISED)
def set_down(stage: LandingStage, gait: Any, time: jax.Array, instants: jax.Array, age: Any) -> jax.Array:
    """Commanded left sole, right sole, pelvis at every tick (instants, ticks, 3, 3), for a touch at each instant."""

    def walk(instant: jax.Array) -> jax.Array:
        def tick(state: Any, t: jax.Array) -> Any:
            nominal = planner.at(gait, t)
            swing = (jnp.arange(2) == nominal.phase.swing)[:, None]
            closed = swing & (t - DT / age >= instant) & (jnp.arange(4) < 2)
            when = jnp.where(closed, instant, jnp.inf)
            sensed = Sensed.nothing(t, switch=closed, switch_time=when)
            state, targets, _ = stage.step(state, gait, nominal, sensed, Signals.none())
            return state, jnp.concatenate([targets.position.sole, targets.position.pelvis[None]])

        return jax.lax.scan(tick, stage.init(), time)[1]

    return jax.vmap(walk)(instants)


@pytest.mark.parametrize("age", [1, 4])
@pytest.mark.parametrize(
    ("variant", "offset"),
    [("paper", -0.05), ("repaired", -0.05), ("repaired", -0.0021), ("repaired", 0.06)],
    ids=["paper, advance", "repaired, advance", "repaired, just before T_s", "repaired, retard"],
)
def test_a_touch_acts_from_its_instant(x64, variant, offset, age):
    """Readings are a physics tick old, one or a quarter of a control tick; the touch happens anywhere in three ticks.

    What comes of it differs from one instant to the next as the way of the foot does, not by what it goes in a tick.
    The paper's landing does so where it is told to interpolate.
    """
    gait = planner.PolynomialGait.preset(robot.load("surena3"), 3)
    stage = LandingStage.plan(getattr(Landing, variant)(interpolate=True), gait)
    touchdown = float(gait.timing.touchdown(1))
    time = touchdown - 0.6 + DT * np.arange(420)
    instants = time[np.searchsorted(time, touchdown + offset)] + DT * (SHARES - TICKS)
    commanded = np.asarray(set_down(stage, gait, jnp.asarray(time), jnp.asarray(instants), age))
    jump, even = most(commanded[:, :, :, [0, 2]])
    assert even > 1e-7
    assert jump < 2.0 * even


# ---------------------------------------------------------------- loads

LOAD_TICK = 40
"""The first tick that feels a load."""
SERVO = 80.0
"""Of a critically damped servo [rad/s]."""
WEIGHT, LOAD = 785.0, 60.0
LITERAL = {"settling_time": 0.3, "reflex_time": 0.1, "shift_time": 0.1}
VARIANTS = {
    "original": ("original", LITERAL),
    "modified": ("modified", LITERAL),
    "modified, smooth ramp": ("modified", {**LITERAL, "smooth_ramp": True}),
    "repaired": ("repaired", {"settling_time": 0.3, "shift_time": 0.1, "body_time": 0.6}),
}


def followed(params: PayloadReflex, gait: Any, time: jax.Array) -> Any:
    """Feet in the body frame where servos that are told a pose and a speed a tick have them, as commanded, and events.

    The force rises at LOAD_TICK; the ZMP is 1 cm off. Shapes (ticks, 2, 3) twice, (ticks, 2).
    """
    stage = PayloadStage.plan(params, gait)

    def tick(carry: Any, row: Any) -> Any:
        state, place, speed = carry
        t, force = row
        zmp = jnp.stack([params.zmp_balanced + 0.01, 0.0])
        sensed = Sensed.nothing(t, corner_force=jnp.full((2, 4), force / 8.0), zmp_body=zmp)
        state, targets, _ = stage.step(state, gait, planner.at(gait, t), sensed, Signals.none())
        wanted, rate = (order.sole - order.pelvis for order in (targets.position, targets.velocity))

        def substep(carry: Any, i: jax.Array) -> Any:
            place, speed = carry
            pull = SERVO**2 * (wanted + i * DT / 8 * rate - place) + 2.0 * SERVO * (rate - speed)
            speed = speed + DT / 8 * pull
            return (place + DT / 8 * speed, speed), None

        (place, speed), _ = jax.lax.scan(substep, (place, speed), jnp.arange(8.0))
        events = jnp.stack([state.mode.astype(float), state.trigger_time])
        return (state, place, speed), (place, wanted, events)

    task = gait.task(time[0])
    start = task.sole - task.pelvis
    force = jnp.where(jnp.arange(len(time)) < LOAD_TICK, WEIGHT, WEIGHT + LOAD)
    return jax.lax.scan(tick, (stage.init(), start, jnp.zeros((2, 3))), (time, force))[1]


@partial(jax.jit, compiler_options=NOT_OPTIMISED)
def scanned(params: PayloadReflex, ways: PayloadReflex, gait: Any, time: jax.Array) -> Any:
    """What becomes of many walks, and its derivatives along their ways."""
    return jax.vmap(lambda p, way: jax.jvp(lambda q: followed(q, gait, time), (p,), (way,)))(params, ways)


def scan(variant: str, name: str) -> Any:
    """Walks whose event moves over three ticks, and their derivatives."""
    biped = robot.load("elkahlout")
    gait = planner.CosineGait.preset(biped, 2)
    base, numbers = VARIANTS[variant]
    params = getattr(PayloadReflex, base)(biped, gait, **numbers)
    ticks = 3300 if base == "repaired" else 900
    time = float(gait.timing.liftoff(0)) + 0.5 + DT * np.arange(ticks)
    if name == "threshold":  # what the low-passed force is at the instants
        part, whole = np.modf(20.0 + SHARES)
        now, then = (
            LOAD * -np.expm1(-(whole + k) * DT / float(params.force_time_constant)) for k in (1.0, 2.0)
        )
        points = (1.0 - part) * now + part * then
    else:
        points = float(getattr(params, name)) + DT * (SHARES - 0.4321 - TICKS / 2)

    def many(one: PayloadReflex, values: np.ndarray) -> PayloadReflex:
        one = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(values), *leaf.shape)), one)
        return eqx.tree_at(lambda p: getattr(p, name), one, jnp.asarray(values))

    ways = many(jax.tree.map(jnp.zeros_like, params), np.ones_like(points))
    return jax.tree.map(np.asarray, scanned(many(params, points), ways, gait, jnp.asarray(time)))


@pytest.mark.parametrize("name", ["threshold", "reflex_time", "settling_time"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_feet_are_a_smooth_function_of_when_a_reflex_starts_and_ends(x64, variant, name):
    """No jump where an event moves on to another tick, so that the feet's derivative is their slope over three ticks.

    By the start of the reflex (which the threshold moves), by its end, and by when the ZMP is read and the walk goes
    on. By the end of a literal reflex, a velocity step, the derivative itself steps a little at the ticks.
    """
    (place, wanted, events), (slope, _, rates) = scan(variant, name)
    mode, trigger = events[:, :, 0], events[:, -1, 1]
    assert np.all(mode[:, -1] == WALK) and np.all((mode == REFLEX).any(axis=1))
    instants, middle = DT * SHARES, len(place) // 2
    slope = slope[middle]
    if name == "threshold":
        instants, slope = trigger, slope / rates[middle, -1, 1]
        np.testing.assert_allclose(np.diff(instants), STEP, rtol=1e-6)
    jump, even = most(place)
    assert even > 1e-8
    speeds = np.abs(np.diff(wanted, axis=1)).max() / DT
    assert jump < 2.0 * speeds * STEP
    over = np.polyfit(instants - instants.mean(), place.reshape(len(place), -1), 1)[0].reshape(slope.shape)
    apart = np.sqrt(np.mean((slope - over) ** 2) / np.mean(over**2))
    print(f"{variant}, {name}: jump {jump:.3g} m, even {even:.3g} m, slopes {100.0 * apart:.2g} % apart")
    assert apart < (0.05 if name == "reflex_time" and variant in ("original", "modified") else 0.02)

"""Derivatives of what both adaptation stages do, through one event each in closed loop, against finite differences."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import firm

from jaxbiped import robot
from jaxbiped.adapt import Controller, Landing, PayloadReflex
from jaxbiped.planner import CosineGait, PolynomialGait
from jaxbiped.sim import Options, Scenario, prepare

STEPS = (1e-3, 1e-4, 1e-5)
"""Relative to the tunable."""
Case = tuple[Callable[[Any], Any], dict[str, float]]


def scores(biped: Any, gait: Any, scenario: Scenario, options: Options, seconds: float, make: Any) -> Any:
    """Tunables -> mean squared tilt [deg2], mean sole height and mean sole place in the body frame as commanded [m]."""
    simulation = prepare(biped, Controller(gait), options)

    def value(tuned: jax.Array) -> jax.Array:
        controller = make(gait, tuned)
        walk = simulation.led_by(controller).walk(scenario, simulation.ticks(seconds))
        assert walk.trace is not None
        tilt = jnp.rad2deg(walk.trace.roll_pitch_yaw[:, :2])
        asked = walk.trace.targets.position
        in_body = asked.sole - asked.pelvis[:, None]
        tilting = jnp.mean(jnp.sum(tilt**2, axis=1))
        return jnp.stack([tilting, in_body[:, :, 2].mean(), jnp.mean(in_body[:, :, 0] ** 2)])

    return value


def landing(height: float) -> Case:
    """surena3 over a pad or a hole under step 1, until the step after it is done."""
    biped = robot.load("surena3")
    gait = PolynomialGait.preset(biped, 4)
    scenario = Scenario.flat(1).with_obstacle(biped, gait, 1, height)

    def make(gait: Any, tuned: jax.Array) -> Controller:
        T_mod, speed = tuned
        return Controller(gait, Landing.repaired(T_mod=T_mod, descent_speed=speed))

    options = Options(trace_every=10)
    return scores(biped, gait, scenario, options, 7.5, make), {"T_mod": 0.07, "descent_speed": 0.2}


def reflex() -> Case:
    """elkahlout, 10 kg in the midst of its first step, until 2 s after the reflex."""
    biped = firm("elkahlout")
    gait = CosineGait.preset(biped, 4)
    scenario = Scenario.flat(1).with_payload(10.0, 2.4)
    base = PayloadReflex.modified(biped, gait)

    def make(gait: Any, tuned: jax.Array) -> Controller:
        offset, time = tuned
        table = jnp.stack([jnp.stack([-offset, offset]), jnp.stack([offset, -offset]), jnp.zeros(2)])
        payload = eqx.tree_at(lambda p: (p.x_reflex, p.reflex_time), base, (table, time))
        return Controller(gait, payload)

    options = Options(feed_forward=False, control_every=1, payload_model="thesis", trace_every=20)
    return scores(biped, gait, scenario, options, 4.5, make), {"x_reflex": 0.01, "reflex_time": 0.1}


def compare(case: Callable[[], Case]) -> None:
    """Forward mode against central differences within 2 %; at the largest step they may bend away, and are printed."""
    with jax.enable_x64(True):
        value, nominal = case()
        sizes = np.array(list(nominal.values()))
        units = np.eye(2)
        moved = [sign * h * sizes[i] * units[i] for h in STEPS for i in range(2) for sign in (1, -1)]
        points = np.concatenate([np.tile(sizes, (2, 1)), sizes + np.array(moved)])
        tangents = np.concatenate([units, np.tile(units[0], (len(moved), 1))])
        both = eqx.filter_jit(jax.vmap(lambda p, t: jax.jvp(value, (p,), (t,))))
        values, slopes = map(np.asarray, both(jnp.asarray(points), jnp.asarray(tangents)))
    slopes = slopes[:2]
    pairs = values[2:].reshape(len(STEPS), 2, 2, -1)
    central = (pairs[:, :, 0] - pairs[:, :, 1]) / (2 * np.array(STEPS)[:, None] * sizes)[..., None]
    for i, name in enumerate(nominal):
        for j, what in enumerate(("tilt", "height", "place")):
            print(
                f"d {what} / d {name}: {slopes[i, j]:.6g}, central", *(f"{c:.6g}" for c in central[:, i, j])
            )
    assert np.all(np.count_nonzero(slopes, axis=1) >= 2)
    np.testing.assert_allclose(
        central[1:], np.broadcast_to(slopes, (2, *slopes.shape)), rtol=0.02, atol=1e-12
    )


@pytest.mark.slow
def test_derivatives_through_an_advance_landing():
    compare(lambda: landing(0.03))


@pytest.mark.slow
def test_derivatives_through_a_retard_landing():
    compare(lambda: landing(-0.03))


@pytest.mark.slow
def test_derivatives_through_a_payload_reflex():
    compare(reflex)

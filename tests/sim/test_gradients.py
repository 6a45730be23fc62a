"""Forward-mode derivatives through a whole walk, planner and touchdowns included, are those of finite differences."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import changed, setup

from jaxbiped.adapt import Controller
from jaxbiped.planner import GAITS
from jaxbiped.sim import Scenario, prepare

TUNED = {"surena3": ("D_s", "y_m"), "elkahlout": ("b_s", "w")}
STEPS = (1e-3, 1e-4, 1e-5)
"""Relative to the parameter."""


def score(name: str, duration: float) -> Any:
    """Two gait parameters -> mean squared tilt [deg2] and mean forward place of the pelvis [m]."""
    one = setup(name)
    simulation, flat = prepare(one.params, Controller(one.gait), one.options), Scenario.flat()
    kind = GAITS[one.gait.name]
    nominal = kind.preset_params(name)

    def value(tuned: jax.Array) -> jax.Array:
        params = changed(nominal, **dict(zip(TUNED[name], tuned, strict=True)))
        controller = Controller(kind.make(one.params, params, one.gait.n_steps))
        walk = simulation.led_by(controller).walk(flat, simulation.ticks(duration))
        assert walk.trace is not None
        tilt = jnp.rad2deg(walk.trace.roll_pitch_yaw[:, :2])
        return jnp.stack([jnp.mean(jnp.sum(tilt**2, axis=1)), jnp.mean(walk.trace.p_world_trunk[:, 0])])

    return value, np.array([float(getattr(nominal, field)) for field in TUNED[name]])


def derivatives(name: str, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Forward mode (2 parameters, 2 scores), and central differences (3 steps, 2, 2); one compilation, one batch."""
    with jax.enable_x64(True):
        value, nominal = score(name, duration)
        units, sizes = np.eye(2), np.abs(nominal)
        moved = [sign * h * sizes[i] * units[i] for h in STEPS for i in range(2) for sign in (1, -1)]
        points = np.concatenate([np.tile(nominal, (2, 1)), nominal + np.array(moved)])
        tangents = np.concatenate([units, np.tile(units[0], (len(moved), 1))])
        both = eqx.filter_jit(jax.vmap(lambda p, t: jax.jvp(value, (p,), (t,))))
        values, slopes = map(np.asarray, both(jnp.asarray(points), jnp.asarray(tangents)))
    assert values.dtype == np.float64
    pairs = values[2:].reshape(len(STEPS), 2, 2, 2)
    widths = 2 * np.array(STEPS)[:, None] * sizes
    return slopes[:2], (pairs[:, :, 0] - pairs[:, :, 1]) / widths[..., None]


def compare(name: str, duration: float) -> None:
    forward, central = derivatives(name, duration)
    for i, field in enumerate(TUNED[name]):
        for j, what in enumerate(("tilt", "place")):
            differences = ", ".join(f"{c:.6g}" for c in central[:, i, j])
            print(f"{name}, {duration:g} s, d {what} / d {field}: {forward[i, j]:.6g}, central {differences}")
    assert np.all(np.abs(forward) > 1e-3 * np.abs(forward).max(axis=0))
    np.testing.assert_allclose(central, np.broadcast_to(forward, central.shape), rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("name", TUNED)
def test_derivative_through_a_walk_of_8_seconds(name):
    compare(name, 8.0)

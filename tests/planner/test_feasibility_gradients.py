"""The feasibility report's derivatives by the gait parameters, through `make`, against finite differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import surena3_gaits
from jax.flatten_util import ravel_pytree
from polynomial_walks import NOT_OPTIMISED

from jaxbiped import robot
from jaxbiped.planner import CosineGait, PolynomialGait, feasibility

STEP = 1e-6


def _smooth_report(biped, gait, times):
    """Soft minimum and mean of the margin [m], mean square torque and speed, largest friction, soft and hard."""
    f = feasibility(biped, gait, times)
    softest = -jax.nn.logsumexp(-300.0 * f.zmp_margin) / 300.0
    torque = jnp.mean((f.torque / 100.0) ** 2)
    return jnp.stack([softest, f.zmp_margin.mean(), torque, jnp.mean(f.speed**2), f.friction.max()])


def _compare(report, params):
    """Forward mode against central differences, for every parameter; the largest of each row sets the scale."""
    point, unravel = ravel_pytree(params)

    @functools.partial(jax.jit, compiler_options=NOT_OPTIMISED)
    @jax.vmap
    def with_derivative(vector, direction):  # one compilation for both sides of the comparison
        return jax.jvp(lambda v: report(unravel(v)), (vector,), (direction,))

    every = jnp.eye(len(point))
    _, exact = with_derivative(jnp.tile(point, (len(point), 1)), every)
    more, less = (with_derivative(point + step * every, every)[0] for step in (STEP, -STEP))
    exact, difference = np.asarray(exact).T, np.asarray((more - less) / (2 * STEP)).T
    assert np.all(np.isfinite(exact))
    scale = np.abs(difference).max(axis=1, keepdims=True)
    assert np.abs((exact - difference) / scale).max() < 1e-6
    return np.abs(exact) / scale


def test_polynomial_gait(x64):
    biped, params = robot.load("surena3"), surena3_gaits.params("C")
    duration = 1.5 + 4 * 1.2 + 3 * 0.6 + 1.5
    times = jnp.asarray((np.arange(31) + 0.43) / 31 * duration)  # none within 10 ms of a phase change

    def report(p):
        return _smooth_report(biped, PolynomialGait.make(biped, p, 4), times)

    share = _compare(report, params)
    assert np.all(share.max(axis=0) > 1e-4)  # each of the 23 parameters matters to something


def test_cosine_gait(x64):
    biped, params = robot.load("elkahlout"), CosineGait.preset_params("elkahlout")
    times = jnp.asarray((np.arange(17) + 0.43) / 17 * (1.2 + 2 * 2.4 + 1.2))

    def report(p):
        return _smooth_report(biped, CosineGait.make(biped, p, 2), times)

    share = _compare(report, params)
    assert np.all(share.max(axis=0) > 1e-4)

"""Polynomial walks that several tests look at: known gaits and random ones, planned once (float64)."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import surena3_gaits

from jaxbiped import robot
from jaxbiped.planner import PolynomialGait, PolynomialParams, StartStop, at
from jaxbiped.robot import LEFT, RIGHT

KNOWN = (*surena3_gaits.NAMES, "preset")
"""The first rows of the batch; random ones follow."""
RANDOM = 200
WALKS = [(n_steps, first_swing) for n_steps in (1, 2, 3, 8) for first_swing in (LEFT, RIGHT)]
LONG_WALKS = [(24, LEFT), (24, RIGHT)]
SAMPLES = 400
NOT_OPTIMISED = {"xla_backend_optimization_level": 0}
"""How to compile what runs once: faster to compile, slower to run."""


def _random_params(rng: np.random.Generator) -> PolynomialParams:
    near, far = rng.uniform(-0.1, 0.1, 8), rng.uniform(-0.05, 0.05, 2)
    T_d, z_min = rng.uniform(0.2, 1.2), rng.uniform(0.70, 0.74)
    return PolynomialParams(
        D_s=rng.uniform(0.0, 0.35),
        T_s=rng.uniform(0.5, 2.0),
        T_d=T_d,
        H_max=rng.uniform(0.02, 0.15),
        x_s=rng.uniform(-0.1, 0.1),
        x_e=rng.uniform(-0.1, 0.1),
        y_d=rng.uniform(-0.05, 0.1),
        y_m=rng.uniform(-0.05, 0.05),
        z_max=z_min + rng.uniform(0.0, 0.03),
        z_min=z_min,
        L_p=rng.uniform(0.2, 0.3),
        T_ini=0.5 * T_d + rng.uniform(0.0, 2.0),
        T_end=0.5 * T_d + rng.uniform(0.3, 2.0),
        start_stop=StartStop(*near, *far),
    )


@functools.cache
def batch() -> PolynomialParams:
    """Parameters of all gaits, stacked; float64."""
    rng = np.random.default_rng(0)
    every = [surena3_gaits.params(name) for name in surena3_gaits.NAMES] + [
        PolynomialGait.preset_params("surena3")
    ]
    every += [_random_params(rng) for _ in range(RANDOM)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *every)


@functools.cache
def _planned() -> dict[tuple[int, int], PolynomialGait]:
    walks = (*WALKS, *LONG_WALKS)

    @functools.partial(jax.jit, compiler_options=NOT_OPTIMISED)
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def plan(surena3, params):
        return [PolynomialGait.make(surena3, params, *walk) for walk in walks]

    return dict(zip(walks, plan(robot.load("surena3"), batch()), strict=True))


def planned(n_steps: int, first_swing: int) -> PolynomialGait:
    """The whole batch's gaits, stacked; float64."""
    return _planned()[n_steps, first_swing]


@jax.jit
@jax.vmap
def _targets(gait, times):
    return jax.vmap(lambda t: at(gait, t))(times)


def targets(times: np.ndarray, n_steps: int, first_swing: int) -> Any:
    """The gaits' `Targets` as NumPy arrays; `times` (n,) are shares of the walk or (batch, n) seconds, n <= SAMPLES."""
    if np.ndim(times) == 1:
        times = times * duration(n_steps)[:, None]
    count = times.shape[1]
    padded = np.pad(times, ((0, 0), (0, SAMPLES - count)), mode="edge")  # one shape, one compilation a walk
    got = _targets(planned(n_steps, first_swing), jnp.asarray(padded))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:, :count], got)


def duration(n_steps: int) -> np.ndarray:
    """Seconds from rest to rest, by the parameters."""
    p = batch()
    return np.asarray(p.T_ini + n_steps * p.T_s + (n_steps - 1) * p.T_d + p.T_end)


def one(i: int) -> PolynomialParams:
    """Parameters of one gait, as plain numbers."""
    return jax.tree.map(lambda leaf: float(leaf[i]), batch())

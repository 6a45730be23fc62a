"""Walks cut into pieces for several threads: the same numbers in the same order; no walk is simulated."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import payload

from jaxbiped.tune import central, forward, gradient, outcomes, smoothed

NAMES = ("payload.reflex_time", "payload.settling_time")


@pytest.fixture
def made_up(monkeypatch):
    """In place of the compiled functions: losses by load and tunables; who called, in which precision."""
    seen = []

    def values(_, at, scenarios):
        seen.append((threading.current_thread().name, jnp.result_type(float), len(at)))
        load = scenarios.payload.mass
        loss = load * jnp.sum(at**2, axis=1)
        return loss, {"status": (load > 5.0).astype(int), "success": load < 4.0}

    def slopes(_, at, scenarios):
        n = len(scenarios.payload.mass)
        loss, became = values(_, jnp.broadcast_to(at, (n, len(at))), scenarios)
        slope = 2.0 * scenarios.payload.mass[:, None] * at
        growth = jnp.broadcast_to(slope[:, None], (n, 8, len(at)))
        return loss, slope, jnp.zeros_like(slope), growth, {**became, "time": jnp.ones((n, 8))}

    monkeypatch.setattr(gradient.Problem, "walked_in_c", lambda *_: None)  # there, threads share the lanes
    monkeypatch.setattr(gradient, "walk_values", values)
    monkeypatch.setattr(gradient, "walk_slopes", slopes)
    return seen


@pytest.mark.parametrize("threads", [1, 2, 3, 16])
def test_however_walks_are_cut_they_come_back_in_order(monkeypatch, made_up, threads):
    monkeypatch.setattr(gradient.runtime, "threads", lambda: threads)
    with jax.enable_x64(True):
        problem = payload(11, 1.0, NAMES)
        rows = np.array([3, 0, 10, 7, 7, 1, 2])
        load, at = problem.experiment.table["load_kg"].to_numpy()[rows], problem.start
        slope = 2.0 * load[:, None] * at
        for found in (forward(problem, at, rows), central(problem, at, rows)):
            np.testing.assert_allclose(found.losses, load * np.sum(at**2))
            np.testing.assert_allclose(found.by_scenario, slope, rtol=1e-6)
            np.testing.assert_array_equal(found.status, load > 5.0)
        assert forward(problem, at, rows).growth.shape == (7, 8, 2)
        smooth = smoothed(problem, at, rows, sigma=0.01, pairs=400)
        np.testing.assert_allclose(smooth.by_scenario, slope, rtol=0.3, atol=0.3 * np.abs(slope).max())
        losses, success = outcomes(problem, at, rows)
        np.testing.assert_allclose(losses, load * np.sum(at**2))
        np.testing.assert_array_equal(success, load < 4.0)
    assert {size for _, _, size in made_up} == {-(-7 // threads)}
    assert {precision for _, precision, _ in made_up} == {jnp.dtype("float64")}


def test_only_the_first_call_goes_ahead(monkeypatch, made_up):
    """It compiles; afterwards all are made by the threads."""
    monkeypatch.setattr(gradient.runtime, "threads", lambda: 2)
    problem, me = payload(6, 1.0, NAMES), threading.current_thread().name
    for _ in range(2):
        forward(problem, problem.start, np.arange(6))
    callers = [name for name, _, _ in made_up]
    assert callers[0] == me and me not in callers[1:] and len(callers) == 4

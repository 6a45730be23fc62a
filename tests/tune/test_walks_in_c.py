"""Losses and their slopes in machine code: against XLA's, and against differences of the losses themselves."""

import dataclasses
import shutil
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from problems import LANDING, landing

import jaxbiped as jb
from jaxbiped.adapt import Controller, PayloadReflex
from jaxbiped.score import WalkLoss
from jaxbiped.sim.compile import backend, kept
from jaxbiped.tune import Problem, central, forward, gradient, outcomes, smoothed
from jaxbiped.tune.walks_in_c import _begun, value_step

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
ROWS = np.arange(5)
NAMES = (
    "payload.x_left_both_stand",
    "payload.x_right_both_stand",
    "payload.threshold",
    "payload.x_ref_gain",
    "gait.x_ref",
)


def payload(duration: float = 1.6) -> Problem:
    """Loads that start the modified reflex of elkahlout while it stands; the last one is none."""
    robot = jb.robot.load("elkahlout")
    gait = jb.planner.CosineGait.preset(robot, 4)
    reflex = PayloadReflex.modified(robot, gait, smooth_ramp=True, settling_time=0.5)
    table = pl.DataFrame({"load_kg": [9.0, 7.0, 6.0, 12.0, 0.0], "load_time_s": [0.2, 0.25, 0.3, 0.35, 0.4]})
    options = jb.sim.own_options(robot, gait)
    variants = {"smooth": Controller(gait, reflex)}
    return Problem.of(jb.batch.Experiment(robot, variants, table, options, duration=duration), NAMES)


def by(backend: str, problem: Problem) -> Problem:
    """The same problem on a backend."""
    options = dataclasses.replace(problem.experiment.options, backend=backend)
    experiment = dataclasses.replace(problem.experiment, options=options)
    return dataclasses.replace(problem, experiment=experiment, compiled=set())


def test_slopes_are_differences_of_the_losses():
    """Near central differences, which know nothing of tangents; a value of each tunable for every lane."""
    with jax.enable_x64(True):
        problem = by("c", payload())
        found = forward(problem, problem.start, ROWS)
        twin = central(problem, problem.start, ROWS)
        np.testing.assert_allclose(twin.losses, found.losses, rtol=1e-10)
        size = np.abs(twin.by_scenario).max(axis=0)
        assert np.all(size > 0.0)
        gap = np.abs(found.by_scenario - twin.by_scenario) / size
        assert np.median(gap) < 1e-4 and np.mean(gap < 1e-2) > 0.8, gap
        np.testing.assert_array_equal(found.by_scenario[4, :4], 0.0)  # no load, no reflex
        assert np.all(found.status == twin.status) and found.growth.shape == (5, 8, 5)
        np.testing.assert_allclose(found.growth_time, 1.6 * np.arange(1, 9) / 8, atol=1e-9)
        # the higher the threshold, the later a reflex
        assert np.all(found.trigger_slope[:4, 2] > 0.0) and found.trigger_slope[4, 2] == 0.0


def test_lanes_do_not_depend_on_each_other():
    """Every walk alone, in another order, at other values beside it."""
    with jax.enable_x64(True):
        problem = by("c", payload())
        losses, success = outcomes(problem, problem.start, ROWS)
        order = np.array([3, 1, 1, 4])
        again, success_again = outcomes(problem, problem.start, order)
        np.testing.assert_array_equal(again, losses[order])
        np.testing.assert_array_equal(success_again, success[order])
        np.testing.assert_array_equal(smoothed(problem, problem.start, ROWS, pairs=1).losses, losses)


def test_losses_are_those_of_walks_by_xla():
    with jax.enable_x64(True):
        in_c, in_xla = (
            outcomes(by(backend, payload(0.8)), payload().start, ROWS[:3]) for backend in ("c", "xla")
        )
    np.testing.assert_allclose(in_c[0], in_xla[0], rtol=1e-8)
    np.testing.assert_array_equal(in_c[1], in_xla[1])


class Foreign(eqx.Module):
    """A loss of one's own, of another module, with a number that decides what is traced."""

    squared: bool = True
    inner: Any = WalkLoss()

    def rate(self, robot, sample, upright):
        rate = self.inner.rate(robot, sample, upright)
        return rate**2 if self.squared else rate

    def total(self, integral, walk, duration):
        return self.inner.total(integral, walk, duration)


def test_a_loss_of_ones_own_is_not_taken_for_another():
    """Nor is one that differs by a number; what is not ours is not kept, since its source is not known."""

    def named(loss: Any) -> tuple[Any, str | None]:
        one = dataclasses.replace(payload(), loss=loss)
        walker = one.in_c._walker(one.in_c.places, None)
        states = _begun(walker, jnp.zeros((2, sum(map(len, one.in_c.places)))), one.scenarios(ROWS[:2]))
        key = backend._key(walker, states, value_step)
        return key, kept.name_of(walker, value_step, key[:2])

    (ours, name), (same, same_name), (other, other_name) = map(
        named, (WalkLoss(), WalkLoss(), WalkLoss(bound=4.0))
    )
    assert ours == same and name == same_name is not None
    assert ours != other and name != other_name is not None
    (plain, no_name), (squared, none_either) = map(named, (Foreign(False), Foreign(True)))
    assert plain != squared and no_name is None and none_either is None


def test_what_c_cannot_do_is_walked_by_xla_where_nobody_asked_for_c(monkeypatch: pytest.MonkeyPatch):
    """With a warning, once."""
    tried: list[str] = []

    def refused(*_: Any) -> Any:
        tried.append("c")
        raise backend.NotServedError("no rule")

    def by_xla(_: Any, at: Any, scenarios: Any) -> Any:
        n = len(scenarios.payload.mass)
        return jnp.full(n, 7.0), {"status": jnp.zeros(n, int), "success": jnp.ones(n, bool)}

    monkeypatch.setattr(gradient.WalksInC, "walk_values", refused)
    monkeypatch.setattr(gradient, "walk_values", by_xla)
    problem = payload()
    with pytest.warns(UserWarning, match="no rule; it is walked by XLA"):
        np.testing.assert_array_equal(outcomes(problem, problem.start, ROWS)[0], 7.0)
    outcomes(problem, problem.start, ROWS)
    assert tried == ["c"]
    with pytest.raises(backend.NotServedError):
        outcomes(by("c", payload()), problem.start, ROWS)


@pytest.mark.slow
@pytest.mark.parametrize("make", ["payload", "landing"])
def test_slopes_are_those_of_xla(make: str):
    """surena3 also by a number of its gait, which moves the table of its plan's torques."""
    with jax.enable_x64(True):
        problem = payload() if make == "payload" else landing(9, 3.0, (*LANDING, "gait.H_max"))
        rows = np.arange(problem.experiment.table.height)
        in_c, in_xla = (forward(one := by(b, problem), one.start, rows) for b in ("c", "xla"))
    np.testing.assert_allclose(in_c.losses, in_xla.losses, rtol=1e-8)
    for name in ("by_scenario", "trigger_slope", "growth"):
        got, want = getattr(in_c, name), getattr(in_xla, name)
        np.testing.assert_allclose(got, want, rtol=0.0, atol=1e-6 * np.abs(want).max(initial=1e-3))
    np.testing.assert_allclose(in_c.growth_time, in_xla.growth_time, atol=1e-12)

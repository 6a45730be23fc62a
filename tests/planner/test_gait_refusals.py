"""Gaits that cannot be walked are refused when they are made, in words that say which number is wrong."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import surena3_gaits

from jaxbiped import robot
from jaxbiped.planner import (
    CosineGait,
    CosineParams,
    GaitError,
    PolynomialGait,
    TaskSpace,
)
from jaxbiped.planner.constraints import require_reach
from jaxbiped.planner.targets import Timing, step_phase
from jaxbiped.robot import LEFT

NAN, INF = float("nan"), float("inf")

POLYNOMIAL = [
    ("T_s", -1.0, "got -1 s, allowed: > 0 and <= 60 s"),
    ("T_s", 0.0, "got 0 s, allowed: > 0 and <= 60 s"),
    ("T_s", NAN, "got nan s, allowed: > 0 and <= 60 s"),
    ("T_s", INF, "got inf s, allowed: > 0 and <= 60 s"),
    ("T_s", 1200.0, "got 1200 s, allowed: > 0 and <= 60 s; 1200 ms is 1.2 s"),
    ("T_d", -0.5, "got -0.5 s, allowed: > 0 and <= 60 s"),
    ("T_ini", 0.2, "got 0.2 s, allowed: >= T_d / 2 = 0.3 s"),
    ("T_end", 0.25, "got 0.25 s, allowed: >= T_d / 2 = 0.3 s"),
    ("T_end", 0.0, "got 0 s, allowed: > 0 and <= 600 s"),
    ("T_end", 1500.0, "got 1500 s, allowed: > 0 and <= 600 s; 1500 ms is 1.5 s"),
    ("D_s", -0.25, "got -0.25 m, allowed: >= 0 and <= 2 m"),
    ("D_s", 250.0, "got 250 m, allowed: >= 0 and <= 2 m; 250 mm is 0.25 m"),
    ("D_s", 1e300, "got inf m, allowed: >= 0 and <= 2 m"),
    ("H_max", 0.0, "got 0 m, allowed: > 0 and <= 1 m"),
    ("H_max", -0.05, "got -0.05 m, allowed: > 0 and <= 1 m"),
    ("H_max", 100.0, "got 100 m, allowed: > 0 and <= 1 m; 100 mm is 0.1 m or 100 cm is 1 m"),
    ("z_min", 0.0, "got 0 m, allowed: > 0 and <= 2 m"),
    ("z_min", 745.0, "got 745 m, allowed: > 0 and <= 2 m; 745 mm is 0.745 m"),
    ("z_max", 0.7, "got 0.7 m, allowed: >= z_min = 0.745 m"),
    ("L_p", 0.15, "got 0.15 m, allowed: > 0.16 m (the soles must not overlap)"),
    ("x_s", NAN, "got nan m, allowed: >= -1 and <= 1 m"),
    ("y_m", INF, "got inf m, allowed: >= -1 and <= 1 m"),
    (
        "y_m",
        -21.98,
        "got -21.98 m, allowed: >= -1 and <= 1 m; -21.98 mm is -0.02198 m or -21.98 cm is -0.2198 m",
    ),
]
BEYOND_REACH = [
    ("z_max", 0.84),
    ("D_s", 0.8),
    ("y_d", 0.6),
    ("H_max", 0.7),
]
COSINE = [
    ("t_ss", 0.0, "got 0 s, allowed: > 0 and <= 60 s"),
    ("t_ss", 1400.0, "got 1400 s, allowed: > 0 and <= 60 s; 1400 ms is 1.4 s"),
    ("t_ds", NAN, "got nan s, allowed: > 0 and <= 60 s"),
    ("T_ini", -1.0, "got -1 s, allowed: > 0 and <= 600 s"),
    ("T_end", 0.0, "got 0 s, allowed: > 0 and <= 600 s"),
    ("b_s", -0.08, "got -0.08 m, allowed: >= 0 and <= 1 m"),
    ("b_s", 80.0, "got 80 m, allowed: >= 0 and <= 1 m; 80 mm is 0.08 m or 80 cm is 0.8 m"),
    ("h_s", 0.0, "got 0 m, allowed: > 0 and <= 1 m"),
    ("h_b", -0.5, "got -0.5 m, allowed: > 0 and <= 2 m"),
    ("w_of", 0.05, "got 0.05 m, allowed: > 0.065 m (the soles must not overlap)"),
    ("w", NAN, "got nan m, allowed: >= -1 and <= 1 m"),
    ("w", INF, "got inf m, allowed: >= -1 and <= 1 m"),
]


@pytest.fixture(scope="module")
def surena3():
    return robot.load("surena3")


@pytest.fixture(scope="module")
def elkahlout():
    return robot.load("elkahlout")


def _cosine(**changes) -> CosineParams:
    return CosineParams(**{**vars(CosineGait.preset_params("elkahlout")), **changes})


@pytest.mark.parametrize(("name", "value", "words"), POLYNOMIAL)
def test_polynomial_parameters(surena3, name, value, words):
    with pytest.raises(GaitError, match=f"^{name}: {re.escape(words)}"):
        PolynomialGait.make(surena3, surena3_gaits.params("C", **{name: value}), 3)


def test_start_and_stop_parameters(surena3):
    params = surena3_gaits.params("C", v_first=NAN)
    with pytest.raises(GaitError, match=r"^start_stop\.v_first: got nan m/s, allowed: >= -5 and <= 5 m/s"):
        PolynomialGait.make(surena3, params, 3)
    params = surena3_gaits.params("C", x_e_last=INF)
    with pytest.raises(GaitError, match=r"^start_stop\.x_e_last: got inf m, allowed: >= -1 and <= 1 m"):
        PolynomialGait.make(surena3, params, 3)


@pytest.mark.parametrize(("name", "value"), BEYOND_REACH)
def test_a_foot_beyond_reach(surena3, name, value):
    """Says which foot, when and how; any of several parameters may be to blame."""
    words = r"^gait: got a (left|right) foot (out of reach|at a joint limit) at t = .* s of .* s on robot 'surena3'"
    with pytest.raises(
        GaitError, match=words + ", allowed: every foot position within reach and joint range"
    ):
        PolynomialGait.make(surena3, surena3_gaits.params("C", **{name: value}), 3)


class Stretch(eqx.Module):
    """Stands for 100 steps of 1.8 s, but for a tenth of a second in one of the last ones."""

    at: float
    duration: jax.Array
    timing: Timing

    def phase(self, t):
        return step_phase(self.timing, t)

    def task(self, t):
        pelvis = jnp.array([0.0, 0.0, 0.75]).at[2].add(jnp.where(jnp.abs(t - self.at) < 0.05, 0.1, 0.0))
        return TaskSpace(jnp.array([[0.0, 0.115, 0.0], [0.0, -0.115, 0.0]]), pelvis)


@pytest.mark.parametrize("at", [0.7, 100.0, 100.45, 178.6])
def test_a_foot_beyond_reach_for_a_moment_of_a_long_walk(surena3, at):
    timing = Timing(jnp.array(1.5), jnp.array(1.2), jnp.array(1.8), 100, LEFT, 104)
    with pytest.raises(GaitError, match="out of reach at t = "):
        require_reach(surena3, Stretch(at, jnp.array(180.0), timing))


@pytest.mark.parametrize(("name", "value", "words"), COSINE)
def test_cosine_parameters(elkahlout, name, value, words):
    with pytest.raises(GaitError, match=f"^{name}: {re.escape(words)}"):
        CosineGait.make(elkahlout, _cosine(**{name: value}), 3)


@pytest.mark.parametrize(("name", "value"), [("h_b", 0.62), ("b_s", 0.4), ("w", 0.6), ("h_s", 0.45)])
def test_a_foot_beyond_reach_of_the_cosine_gait(elkahlout, name, value):
    with pytest.raises(
        GaitError, match=r"^gait: got a (left|right) foot .* on robot 'elkahlout', allowed: every"
    ):
        CosineGait.make(elkahlout, _cosine(**{name: value}), 3)


@pytest.mark.parametrize("n_steps", [0, -2])
@pytest.mark.parametrize("preset", [(PolynomialGait, "surena3"), (CosineGait, "elkahlout")])
def test_number_of_steps(preset, n_steps):
    gait, name = preset
    with pytest.raises(GaitError, match=f"^n_steps: got {n_steps}, allowed: a whole number >= 1"):
        gait.preset(robot.load(name), n_steps)


@pytest.mark.parametrize("given", [True, np.bool_(True), 2.0, np.float32(2.0), "2", None, 10**400])
@pytest.mark.parametrize("preset", [(PolynomialGait, "surena3"), (CosineGait, "elkahlout")])
def test_what_is_no_number_of_steps(monkeypatch, preset, given):
    """As users meet it: without the tests' own checks of annotations."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    gait, name = preset
    biped = robot.load(name)
    with pytest.raises(GaitError, match=r"^n_steps: got .*, allowed: a whole number >= 1"):
        gait.preset(biped, given)
    with pytest.raises(GaitError, match=r"^first_swing: got .*, allowed: 0 \(left\) or 1 \(right\)"):
        gait.preset(biped, 2, given)


@pytest.mark.parametrize("preset", [(PolynomialGait, "surena3"), (CosineGait, "elkahlout")])
def test_whole_numbers_of_numpy_and_jax_will_do(preset):
    gait, name = preset
    biped = robot.load(name)
    wanted = gait.preset(biped, 2, 1)
    for steps, foot in (
        (np.int64(2), np.uint8(1)),
        (np.int32(2), np.int16(1)),
        (jnp.asarray(2), jnp.asarray(1)),
    ):
        given = gait.preset(biped, steps, foot)
        assert (int(given.n_steps), int(given.first_swing)) == (2, 1)
        assert jax.tree.structure(given) == jax.tree.structure(wanted)


@pytest.mark.parametrize("gait", [PolynomialGait, CosineGait])
def test_a_robot_that_walks_like_a_preset_has_its_gait(gait):
    preset = robot.load("surena3")
    renamed = dataclasses.replace(preset, name="mine")
    assert jax.tree.structure(gait.preset(renamed, 2)) == jax.tree.structure(gait.preset(preset, 2))
    unlike = dataclasses.replace(renamed, walks_like="")
    with pytest.raises(
        GaitError, match=r"got robot 'mine', allowed: .*add walks_like = '.*' or '.*' to the robot"
    ):
        gait.preset(unlike, 2)
    assert gait.preset(dataclasses.replace(preset, walks_like=""), 2).n_steps == 2  # by its own name


@pytest.mark.parametrize("preset", [(PolynomialGait, "surena3"), (CosineGait, "elkahlout")])
def test_first_swing(preset):
    gait, name = preset
    with pytest.raises(GaitError, match=r"^first_swing: got 2, allowed: 0 \(left\) or 1 \(right\)"):
        gait.preset(robot.load(name), 3, 2)


def test_presets_of_unknown_robots():
    with pytest.raises(
        GaitError,
        match=r"^preset gait: got robot 'atlas', allowed: elkahlout, surena3; otherwise add walks_like = ",
    ):
        PolynomialGait.preset_params("atlas")
    with pytest.raises(
        GaitError,
        match=r"^preset gait: got robot 'atlas', allowed: elkahlout, surena3; otherwise add walks_like = ",
    ):
        CosineGait.preset_params("atlas")


def test_what_is_traced_is_not_judged(surena3):
    """Under jit, vmap and differentiation values are not known; a plan is made of them all the same."""
    params = surena3_gaits.params("C", H_max=-0.05, z_max=2.0)

    def height(p):
        gait = PolynomialGait.make(surena3, p, 1, LEFT)
        return gait.task(gait.params.T_ini + 0.5 * gait.params.T_s).sole[LEFT, 2]

    assert jnp.isclose(jax.jit(height)(params), -0.05, atol=1e-6)
    gradient = eqx.filter_jit(jax.grad(height))(params)
    assert jnp.isclose(gradient.H_max, 1.0, atol=1e-5)

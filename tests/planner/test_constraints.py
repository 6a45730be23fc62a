"""A plan that breaks a constraint of khadiv section 2.2 is refused, in words that say which, when and by how much."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

from jaxbiped import robot
from jaxbiped.planner import (
    MIN_KNEE,
    CosineGait,
    GaitError,
    PolynomialGait,
    constraints,
    feasibility,
    known_infeasible,
    violations,
)
from jaxbiped.robot import JOINT_NAMES, KNEE, LEFT, RIGHT, SIDE_NAMES

STEPS, DENSE = 2, 3001
LONG = 20
"""More steps than are all judged."""
WORDS = re.compile(
    r"^gait: got (?P<got>.*) at t = (?P<time>[\d.]+) s of (?P<duration>[\d.]+) s on robot 'surena3', "
    r"allowed: (?P<allowed>.*); or say allow_infeasible=True$"
)


@pytest.fixture(scope="module")
def surena3():
    return robot.load("surena3")


def weaker(biped, limit: str, side: int, joint: str, value: float):
    """The robot with another limit of one joint."""
    new = np.array(getattr(biped.servo, limit))
    new[side, JOINT_NAMES.index(joint)] = value
    return eqx.tree_at(lambda b: getattr(b.servo, limit), biped, new)


def changed(**values):
    return dataclasses.replace(
        PolynomialGait.preset_params("surena3"), **{k: jnp.asarray(v) for k, v in values.items()}
    )


def refusal(biped, params, n_steps=STEPS, **arguments) -> re.Match[str]:
    with pytest.raises(GaitError) as caught:
        PolynomialGait.make(biped, params, n_steps, **arguments)
    said = WORDS.match(str(caught.value))
    assert said, str(caught.value)
    return said


def dense(biped, params):
    """The plan, let through, at many times from rest to rest."""
    gait = PolynomialGait.make(biped, params, STEPS, allow_infeasible=True)
    return feasibility(biped, gait, jnp.linspace(0.0, gait.duration, DENSE))


def number(text: str) -> float:
    found = re.search(r"-?\d+\.\d+", text)
    assert found, text
    return float(found[0])


def compare(said: re.Match[str], judged, worst: np.ndarray, tolerance: float) -> None:
    """The value is the worst of the dense samples, and at the time that is said the plan is that bad."""
    assert number(said["got"]) == pytest.approx(worst[np.argmax(worst)], abs=tolerance)
    at = np.abs(np.asarray(judged.time) - float(said["time"])).argmin()
    assert worst[at] == pytest.approx(worst.max(), abs=tolerance)
    assert float(said["duration"]) == pytest.approx(float(judged.time[-1]), abs=1e-3)


def test_zmp(surena3):
    params = changed(y_d=0.1)
    said, judged = refusal(surena3, params), dense(surena3, params)
    compare(said, judged, -np.asarray(judged.zmp_margin), 1e-3)
    assert said["got"].endswith(" m outside the support polygon")
    assert said["allowed"] == "inside it (margin >= 0 m)"
    assert number(said["got"]) > 0.03


def test_friction(surena3):
    said = refusal(surena3, changed(), friction=0.05)
    judged = dense(surena3, changed())
    compare(said, judged, np.asarray(judged.friction), 1e-3)
    assert said["got"].startswith("a needed friction of ") and said["allowed"] == "<= 0.05, the ground's"
    slow = changed(T_s=2.4, T_d=2.0, T_ini=3.0, T_end=3.0)
    assert dense(surena3, slow).friction.max() < 0.05
    assert PolynomialGait.make(surena3, slow, STEPS, friction=0.05).n_steps == STEPS


@pytest.mark.parametrize(("side", "joint"), [(LEFT, "knee"), (RIGHT, "hip_roll")])
def test_torque(surena3, side, joint):
    weak = weaker(surena3, "torque_limit", side, joint, 60.0)
    said, judged = refusal(weak, changed()), dense(weak, changed())
    torque = np.abs(np.asarray(judged.torque))[:, side, JOINT_NAMES.index(joint)]
    compare(said, judged, torque, 0.5)
    assert said["got"].startswith(f"a {SIDE_NAMES[side]} {joint.replace('_', ' ')} torque of ")
    assert said["got"].endswith(" N m") and said["allowed"] == "<= 60 N m"


def test_speed(surena3):
    slow = weaker(surena3, "speed_limit", RIGHT, "hip_pitch", 0.75)
    said, judged = refusal(slow, changed()), dense(slow, changed())
    speed = np.abs(np.asarray(judged.speed))[:, RIGHT, JOINT_NAMES.index("hip_pitch")]
    compare(said, judged, speed, 1e-2)
    assert said["got"].startswith("a right hip pitch speed of ") and said["allowed"] == "<= 0.75 rad/s"


def test_knee(surena3):
    params = changed(z_max=0.796)
    said, judged = refusal(surena3, params), dense(surena3, params)
    bend = np.asarray(judged.angle)[..., KNEE]
    side = int(np.unravel_index(bend.argmin(), bend.shape)[1])
    assert said["got"].startswith(f"a {SIDE_NAMES[side]} knee bent by ")
    assert number(said["got"]) == pytest.approx(bend.min(), abs=2e-2)  # close to 0 it changes fast
    at = np.abs(np.asarray(judged.time) - float(said["time"])).argmin()
    assert bend[at, side] == pytest.approx(bend.min(), abs=2e-2)
    assert number(said["allowed"]) == MIN_KNEE > bend.min() > 0.02


def test_every_broken_constraint_is_found_in_the_papers_order(surena3):
    weak = weaker(weaker(surena3, "torque_limit", LEFT, "knee", 60.0), "speed_limit", LEFT, "knee", 0.5)
    gait = PolynomialGait.make(weak, changed(y_d=0.1), STEPS, allow_infeasible=True)
    found = violations(weak, gait, friction=0.02)
    assert [v.constraint for v in found] == ["ZMP", "friction", "torque", "speed"]
    zmp, friction, torque, speed = found
    assert zmp.value < 0.0 == zmp.limit and friction.value > friction.limit == pytest.approx(0.02)
    assert torque.value > torque.limit == 60.0 and speed.value > speed.limit == 0.5
    assert violations(surena3, PolynomialGait.make(surena3, changed(), STEPS)) == []


def test_what_is_allowed_is_the_plan_that_was_refused(surena3):
    params = changed(y_d=0.1)
    refusal(surena3, params)
    allowed = PolynomialGait.make(surena3, params, STEPS, allow_infeasible=True)
    traced = jax.jit(lambda p: PolynomialGait.make(surena3, p, STEPS))(params)  # which is not judged
    assert jax.tree.structure(allowed) == jax.tree.structure(traced)
    for a, b in zip(jax.tree.leaves(allowed), jax.tree.leaves(traced), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_a_foot_beyond_reach_is_not_allowed(surena3):
    with pytest.raises(GaitError, match=r"^gait: got a (left|right) foot out of reach .* joint range$"):
        PolynomialGait.make(surena3, changed(z_max=0.84), STEPS, allow_infeasible=True)


@pytest.mark.parametrize(
    "change",
    [
        {"start_stop": {"x_rest_start": 0.16}},
        {"start_stop": {"x_e_last": 0.16}},
        {"x_e": 0.12, "x_s": 0.1},
    ],
    ids=["start", "stop", "middle"],
)
def test_of_a_long_walk_the_start_the_stop_and_the_steps_between_count(surena3, monkeypatch, change):
    """As if every step were judged; where the steps repeat, any of them may be the one that is named."""
    old = PolynomialGait.preset_params("surena3")
    ends = {k: jnp.asarray(v) for k, v in change.get("start_stop", {}).items()}
    params = changed(**{k: v for k, v in change.items() if k != "start_stop"})
    params = dataclasses.replace(params, start_stop=dataclasses.replace(old.start_stop, **ends))
    gait = PolynomialGait.make(surena3, params, LONG, allow_infeasible=True)
    (one,) = violations(surena3, gait)
    monkeypatch.setattr(constraints, "CHECKED_STEPS", LONG)
    (every,) = violations(surena3, gait)
    assert one.constraint == every.constraint == "ZMP"
    assert one.value == pytest.approx(every.value, abs=2e-4)
    share = one.time / float(gait.duration)
    assert share < 0.1 if "x_rest_start" in ends else share > 0.9 if ends else 0.1 < share < 0.9
    assert refusal(surena3, params, LONG)


@pytest.mark.parametrize("kind", [PolynomialGait, CosineGait])
@pytest.mark.parametrize("name", robot.presets())
@pytest.mark.parametrize(("n_steps", "first_swing"), [(1, RIGHT), (2, LEFT)])
def test_no_preset_breaks_a_constraint_but_the_one_that_says_so(name, kind, n_steps, first_swing):
    biped = robot.load(name)
    gait = kind.preset(biped, n_steps, first_swing)
    why = known_infeasible(kind, biped)
    assert [v.constraint for v in violations(biped, gait)] == (["ZMP"] if why else [])
    assert bool(why) == ((name, kind) == ("elkahlout", CosineGait))
    assert known_infeasible(kind, name) == why


def test_a_preset_that_says_so_is_refused_as_parameters_of_ones_own():
    elkahlout = robot.load("elkahlout")
    with pytest.raises(
        GaitError, match=r"ZMP .* m outside the support polygon at t = .* on robot 'elkahlout'"
    ):
        CosineGait.make(elkahlout, CosineGait.preset_params(elkahlout), STEPS)


def test_a_preset_that_does_not_fit_the_robot_any_more_is_refused(surena3):
    narrow = eqx.tree_at(
        lambda b: b.p_sole_corner, surena3, surena3.p_sole_corner * jnp.array([0.05, 1.0, 1.0])
    )
    with pytest.raises(GaitError, match="outside the support polygon"):
        PolynomialGait.preset(narrow, STEPS)
    assert PolynomialGait.preset(narrow, STEPS, allow_infeasible=True).n_steps == STEPS


@pytest.mark.parametrize(
    ("argument", "value", "words"),
    [
        ("friction", -0.5, r"got -0\.5, allowed: >= 0\.01 and <= 5"),
        ("friction", float("nan"), r"got nan, allowed: >= 0\.01"),
        ("friction", "0.8", r"got the text '0\.8', allowed: one number"),
        ("allow_infeasible", "yes", "got the text 'yes', allowed: true or false"),
        ("allow_infeasible", 1, "got 1, allowed: true or false"),
    ],
)
@pytest.mark.parametrize("kind", [PolynomialGait, CosineGait])
def test_bad_arguments(surena3, monkeypatch, kind, argument, value, words):
    """As users meet it: without the tests' own checks of annotations."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(GaitError, match=f"^{argument}: {words}"):
        kind.preset(surena3, STEPS, **{argument: value})

"""Scenarios are not believed either: ranges, units, obstacles that the swing foot clears, a level start."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

from jaxbiped import planner, robot
from jaxbiped.batch import INPUTS
from jaxbiped.sim import Scenario
from jaxbiped.sim.ground import EDGE_WIDTH, height
from jaxbiped.sim.scenario import (
    MAX_RECTANGLES,
    RANGES,
    Terrain,
    pad_under,
    require_clear_start,
    require_swing_clears,
    swing_height,
)

FLAT = Scenario.flat()
GAITS = {"polynomial": planner.PolynomialGait, "cosine": planner.CosineGait}
STEPS = 8
OVER_THE_START = {
    ("surena3", "polynomial"): [0],
    ("surena3", "cosine"): [0, 1],
    ("elkahlout", "polynomial"): [0],
    ("elkahlout", "cosine"): [],
}
"""Steps of the preset walks whose pads reach under a sole of the starting stance."""


@pytest.fixture(autouse=True)
def as_users_meet_it(monkeypatch):
    """Without the tests' own checks of annotations."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="module")
def walks() -> dict[tuple[str, str], tuple[Any, Any]]:
    return {
        (name, kind): (robot.load(name), gait.preset(robot.load(name), STEPS))
        for name in ("surena3", "elkahlout")
        for kind, gait in GAITS.items()
    }


def refusal(call, *args, **named) -> str:
    with pytest.raises(ValueError) as caught:
        call(*args, **named)
    assert str(caught.value).isprintable() and ", allowed: " in str(caught.value)
    return str(caught.value)


# ---------------------------------------------------------------- ranges

CALLS = {
    "payload mass": lambda v: FLAT.with_payload(v, 1.0),
    "payload time": lambda v: FLAT.with_payload(1.0, v),
    "payload end": lambda v: FLAT.with_payload(1.0, 0.0, v),
    "push force": lambda v: FLAT.with_push((0.0, v, 0.0), 1.0, 0.1),
    "push start": lambda v: FLAT.with_push((1.0, 0.0, 0.0), v, 0.1),
    "push length": lambda v: FLAT.with_push((1.0, 0.0, 0.0), 1.0, v),
    "friction": lambda v: FLAT.with_friction(v),
    "lower": lambda v: FLAT.with_rectangle((v, 0.0), (1.0, 1.0), 0.01),
    "upper": lambda v: FLAT.with_rectangle((0.0, 0.0), (v, 1.0), 0.01),
    "height": lambda v: FLAT.with_rectangle((0.0, 0.0), (1.0, 1.0), v),
}
NO_NUMBERS = [
    math.nan,
    math.inf,
    -math.inf,
    True,
    "1",
    None,
    1e300,
    1e39,
    1e-60,
    10**400,
    1e7,
    -1e7,
    [1.0],
    np.bool_(1),
]


@pytest.mark.parametrize("name", CALLS)
def test_what_is_no_plausible_number_is_refused(name):
    for value in NO_NUMBERS:
        message = refusal(CALLS[name], value)
        assert message.startswith(f"{name}: got "), message


@pytest.mark.parametrize("name", CALLS)
def test_numbers_of_every_kind_will_do(name):
    wanted = jax.tree.leaves(CALLS[name](0.125))
    for value in (np.float64(0.125), np.float32(0.125), jnp.asarray(0.125), np.array(0.125)):
        for got, leaf in zip(jax.tree.leaves(CALLS[name](value)), wanted, strict=True):
            np.testing.assert_array_equal(got, leaf)
    CALLS[name](0 if name in ("height", "lower") else 1)


@pytest.mark.parametrize(
    "name", ["payload mass", "payload time", "push force", "push length", "friction", "height"]
)
def test_traced_numbers_are_not_judged(name):
    leaves = jax.jit(lambda v: jax.tree.leaves(CALLS[name](v)))(-1e7)
    assert any(np.any(np.asarray(leaf) == -1e7) for leaf in leaves)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: FLAT.with_payload(15000.0, 1.0), "15000 g is 15 kg"),
        (lambda: FLAT.with_payload(1.0, 2.0, 2.0), "payload end: got 2 s, allowed: > 2 s, when it is put on"),
        (lambda: FLAT.with_payload(-1.0, 1.0), "got -1 kg, allowed: >= 0 and <= 200 kg"),
        (lambda: FLAT.with_push((1.0, 2.0), 1.0, 0.1), "3 numbers [N]"),
        (lambda: FLAT.with_push((0.0, 0.0, 9e3), 1.0, 0.1), "got 9000 N in place 3"),
        (lambda: FLAT.with_push((1.0, 0.0, 0.0), 1.0, 100.0), "100 ms is 0.1 s"),
        (lambda: FLAT.with_friction(0.0), "friction: got 0, allowed: >= 0.01 and <= 5"),
        (lambda: FLAT.with_friction(80.0), "80 % is 0.8"),
        (lambda: FLAT.with_rectangle((0.0, 0.0), (1.0, 1.0), 30.0), "30 mm is 0.03 m"),
        (lambda: FLAT.with_rectangle((0.0, 0.0, 0.0), (1.0, 1.0), 0.03), "2 numbers [m]"),
        (lambda: FLAT.with_rectangle((0.0, 1.0), (1.0, 0.0), 0.03), "lower [0, 1] and upper [1, 0] m"),
        (lambda: FLAT.with_rectangle((1.0, 0.0), (1.0, 1.0), 0.03), "lower < upper"),
    ],
)
def test_units_and_shapes(call, words):
    assert words in refusal(call)


def test_room_for_rectangles():
    for value in (True, 1.0, -1, MAX_RECTANGLES + 1, "8", None, math.nan):
        assert "rectangles: got " in refusal(Scenario.flat, value)
    assert Scenario.flat(np.int64(3)).terrain.height.shape == (3,) and Scenario.flat(
        0
    ).terrain.height.shape == (0,)
    full = Scenario.flat(1).with_rectangle((0.0, 0.0), (1.0, 1.0), 0.01)
    assert "one more than 1" in refusal(full.with_rectangle, (0.0, 0.0), (1.0, 1.0), 0.01)


def test_ranges_are_those_of_scenario_tables():
    assert set(RANGES) == {*INPUTS, "height_m"}
    for name, column in INPUTS.items():
        assert column.range == RANGES[name], name
        assert RANGES[name].contains(column.default), name


# ---------------------------------------------------------------- the swing foot clears


@pytest.mark.parametrize(
    ("key", "apex"),
    [(("surena3", "polynomial"), 0.1), (("surena3", "cosine"), 0.12), (("elkahlout", "cosine"), 0.03)],
)
def test_obstacles_are_lower_than_the_swing_foot_goes(walks, key, apex):
    biped, gait = walks[key]
    for step in range(STEPS):
        assert swing_height(gait, step) == pytest.approx(apex, rel=1e-5)
        require_swing_clears(gait, {step: 0.99 * apex})
        for above in (apex, 1.2 * apex):
            message = refusal(require_swing_clears, gait, {0: 0.0, step: above})
            assert message.startswith(
                f"step {step}: got an obstacle of {above:g} m, allowed: below {apex:g} m, the height"
            )
    assert "step 3: got an obstacle" in refusal(FLAT.with_obstacle, biped, gait, 3, apex)
    assert float(FLAT.with_obstacle(biped, gait, 3, 0.9 * apex).terrain.height[0]) == pytest.approx(
        0.9 * apex
    )
    require_swing_clears(gait, {2: -0.2, 3: jnp.asarray(0.01)})
    jax.jit(lambda h: FLAT.with_obstacle(biped, gait, 3, h).terrain.height)(1.0)


def test_steps_and_heights_that_there_are_not(walks):
    biped, gait = walks["surena3", "polynomial"]
    for step in (-1, STEPS, 1.0, True, "1"):
        for call in (lambda s: require_swing_clears(gait, {s: 0.01}), lambda s: pad_under(biped, gait, s)):
            assert "step: got " in refusal(call, step) and "<= 7" in refusal(call, step)
        assert "step: got " in refusal(FLAT.with_obstacle, biped, gait, step, 0.01)
    for value in (math.nan, True, "0.01", 30.0, -0.3, 1e39):
        assert "height: got " in refusal(FLAT.with_obstacle, biped, gait, 1, value)
        assert "height: got " in refusal(require_swing_clears, gait, {1: value})
    assert FLAT.with_obstacle(biped, gait, np.int64(1), 0.01).terrain.height[0] == pytest.approx(0.01)


# ---------------------------------------------------------------- a clear start


def under(walk: tuple[Any, Any], step: int, value: float) -> Terrain:
    lower, upper = pad_under(*walk, step)
    return FLAT.with_rectangle(lower, upper, value).terrain


@pytest.mark.parametrize("key", OVER_THE_START, ids="-".join)
def test_pads_that_reach_under_the_starting_feet(walks, key):
    biped, gait = walks[key]
    for step in range(STEPS):
        for value, what in ((0.02, "an obstacle of 0.02 m"), (-0.02, "a hole of -0.02 m")):
            if step in OVER_THE_START[key]:
                message = refusal(require_clear_start, biped, gait, under((biped, gait), step, value))
                side = robot.SIDE_NAMES[(gait.first_swing + step) % 2]
                assert f"start: got {what}" in message and f"under the {side} foot" in message
            else:
                require_clear_start(biped, gait, under((biped, gait), step, value))
        require_clear_start(biped, gait, under((biped, gait), step, 0.0))


@pytest.mark.parametrize("key", OVER_THE_START, ids="-".join)
def test_edges_of_the_starting_stance(walks, key):
    """What is refused is what reaches a sole, with the width of its edge: there the ground is not level."""
    biped, gait = walks[key]
    sole = np.asarray(planner.at(gait, 0.0).position.sole)
    for foot, side in enumerate(robot.SIDE_NAMES):
        corner = sole[foot] + np.asarray(biped.p_sole_corner[foot])
        low, high = corner[:, :2].min(axis=0), corner[:, :2].max(axis=0)
        for gap, refused in ((0.5 * EDGE_WIDTH + 1e-4, False), (0.5 * EDGE_WIDTH - 1e-4, True)):
            beside = [
                ((high[0] + gap, low[1]), (high[0] + 1.0, high[1])),
                ((low[0] - 1.0, low[1]), (low[0] - gap, high[1])),
            ]
            for lower, upper in beside:
                terrain = FLAT.with_rectangle(lower, upper, 0.05).terrain
                assert (
                    np.abs(np.asarray(height(terrain, jnp.asarray(corner[:, :2])))) > 0.0
                ).any() == refused
                if refused:
                    assert f"under the {side} foot" in refusal(require_clear_start, biped, gait, terrain)
                else:
                    require_clear_start(biped, gait, terrain)
        inside = FLAT.with_rectangle(0.5 * (low + high) - 0.01, 0.5 * (low + high) + 0.01, 0.02).terrain
        assert f"under the {side} foot" in refusal(require_clear_start, biped, gait, inside)


def test_batches_of_terrain(walks):
    biped, gait = walks["surena3", "polynomial"]
    walk = biped, gait
    clear, not_clear = (under(walk, step, 0.03) for step in (3, 0))
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), clear, clear, not_clear, clear)
    assert refusal(require_clear_start, biped, gait, batch).startswith(
        "scenario 2: start: got an obstacle of 0.03 m"
    )
    require_clear_start(biped, gait, jax.tree.map(lambda *leaves: np.stack(leaves), clear, clear))
    require_clear_start(biped, gait, Scenario.flat(0).terrain)
    jax.jit(lambda terrain: require_clear_start(biped, gait, terrain) or terrain.height)(not_clear)


def test_obstacles_do_not_lie_on_each_other(walks):
    """Their heights would add up."""
    params, gait = walks["surena3", "polynomial"]
    once = FLAT.with_obstacle(params, gait, 2, 0.02)
    with pytest.raises(
        ValueError, match="step 2: got an obstacle that overlaps another one, allowed: obstacles apart"
    ):
        once.with_obstacle(params, gait, 2, 0.02)
    assert once.with_obstacle(params, gait, 4, 0.02).terrain.height[1] == pytest.approx(0.02)

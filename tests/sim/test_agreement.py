"""What sweeps/agreement.py draws, counts and keeps; and that our ground agrees with C MuJoCo on who walks."""

import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

from jaxbiped.batch.summary import wilson
from jaxbiped.checked import Refusal
from jaxbiped.sim import Options, Scenario, prepare, require_clear_start, swing_height
from jaxbiped.sim.options import C_MUJOCO
from jaxbiped.sim.physics.c_world import CONTACTS
from jaxbiped.sim.scenario import PAD_AROUND, PAD_BEHIND

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "sweeps"))

import agreement
from agreement import COLUMNS, OURS, Columns, Ground, Job, compare


def job(robot: str, variant: str, numbers: list[int], cache: Path | None = None) -> Job:
    return Job(robot, variant, numbers, 0, Ground(), 3e-4, cache)


# The scenarios ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[("surena3", "both-repaired"), ("elkahlout", "thesis-off")])
def drawn(request) -> tuple[Any, Any, list[Scenario]]:
    name, variant = request.param
    params, controller, _ = agreement.set_up(name, variant)
    return params, controller.gait, agreement.scenarios(job(name, variant, list(range(60))))


def test_every_scenario_is_within_its_limits_and_starts_on_level_ground(drawn):
    params, gait, each = drawn
    highest = min(0.05, 0.9 * swing_height(gait))
    for s in each:
        require_clear_start(params, gait, s.terrain)
        assert np.abs(s.terrain.height).max() <= highest
        assert 0.3 <= s.ground.friction <= 1.0 and 0.0 <= s.payload.mass <= 20.0
        assert 0.0 < s.payload.time < agreement.DURATION and 0.0 < s.push.start < agreement.DURATION
        assert 20.0 <= np.linalg.norm(s.push.force) <= 150.001 and s.push.force[2] == 0.0
        assert s.push.length == pytest.approx(0.1)
        assert (np.abs(s.errors.mass_scale - 1.0) <= 0.1001).all()
        assert s.sensors.force_noise == s.sensors.angle_noise == s.sensors.delay == 0.0


def test_scenarios_reach_all_over_their_limits(drawn):
    _, gait, each = drawn
    batch = jax.tree.map(np.asarray, agreement.stacked(each))
    used = (batch.terrain.lower < batch.terrain.upper).all(axis=-1)
    assert set(used.sum(axis=1)) == {0, 1, 2}
    height = batch.terrain.height[used]
    highest = min(0.05, 0.9 * swing_height(gait))
    assert height.min() < -0.7 * highest and height.max() > 0.7 * highest
    sizes = (batch.terrain.upper - batch.terrain.lower)[used]
    for axis in (0, 1):
        whole = np.isclose(sizes[:, axis], sizes[:, axis].max(), atol=1e-5)
        assert 0.1 < (~whole).mean() < 0.6  # an edge under the sole
    assert batch.payload.mass.min() < 4.0 and batch.payload.mass.max() > 16.0
    for sign in (batch.push.force[:, :2] > 0.0).T:
        assert 0.25 < sign.mean() < 0.75
    assert batch.errors.mass_scale.std(axis=1).min() > 0.02  # each link its own


def test_a_scenario_depends_on_seed_variant_and_number_only():
    name, variant = "elkahlout", "payload-modified"
    one = agreement.scenarios(job(name, variant, [3]))[0]
    assert same(one, agreement.scenarios(job(name, variant, [1, 3]))[1])
    for other in (
        job(name, variant, [4]),
        job(name, "payload-repaired", [3]),
        job(name, variant, [3])._replace(seed=1),
    ):
        assert not same(one, agreement.scenarios(other)[0])


def same(one: Any, other: Any) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True))


@pytest.mark.parametrize("edge", ["whole", "front", "back", "side"])
def test_an_edge_is_moved_under_the_sole(edge):
    low, high = np.array([1.0, -0.2]), np.array([1.5, 0.1])
    heel, right = low + np.array([PAD_BEHIND, PAD_AROUND])
    toe, left = high - PAD_AROUND
    moved = set()
    for seed in range(40):
        lower, upper = agreement.cut(low, high, edge, np.random.default_rng(seed))
        changed = np.concatenate([lower != low, upper != high])
        assert changed.sum() == (edge != "whole")
        for i in np.flatnonzero(changed):
            moved.add(int(i))
            value, (least, most) = np.concatenate([lower, upper])[i], ((heel, toe), (right, left))[i % 2]
            assert least < value < most
    assert moved == {"whole": set(), "front": {2}, "back": {0}, "side": {1, 3}}[edge]


def test_halves_are_apart_and_together_all():
    first, second = agreement.of_half(7, "first"), agreement.of_half(7, "second")
    assert first == [0, 2, 4, 6] and second == [1, 3, 5]
    assert agreement.of_half(7, "both") == list(range(7))


def test_every_variant_can_be_made():
    for name, variants in agreement.VARIANTS.items():
        assert len(variants) * 30 >= 200
        for variant, (stages, options) in variants.items():
            _, controller, chosen = agreement.set_up(name, variant)
            landing, payload = agreement.STAGES[stages]
            assert (controller.stage("landing") is None) == (landing == "off")
            assert (controller.stage("payload") is None) == (payload == "off")
            assert (chosen.payload_model == "thesis") == (options == "thesis")


def test_ground_is_ours_to_choose():
    batch = agreement.stacked([Scenario.flat(), Scenario.flat()])
    under = Ground(sinkage=1e-4, damping=30.0).under(batch).ground
    np.testing.assert_allclose(under.sinkage, 1e-4)
    np.testing.assert_allclose(under.damping, 30.0)
    np.testing.assert_array_equal(under.slip_speed, batch.ground.slip_speed)
    finer = Ground(dt=2.5e-4).ticks(Options())
    assert finer.control_every == 8 and finer.control_dt == Options().control_dt
    with pytest.raises(Refusal, match=r"--dt: got 0\.0003 s, allowed: a whole share"):
        Ground(dt=3e-4).ticks(Options())


# The comparison --------------------------------------------------------------------------------------------------


def made_up(status: list[int], **columns: Any) -> Columns:
    usual = dict.fromkeys(COLUMNS, 1.0) | columns
    return {name: np.broadcast_to(np.asarray(usual[name], float), len(status)) for name in COLUMNS} | {
        "status": np.array(status)
    }


FOUND = {
    OURS: made_up([0, 0, 1, 1, 0, 0], tilt_deg=2.0, force_N=110.0, end_time_s=[9.0, 9.0, 5.0, 6.0, 9.0, 9.0]),
    "spheres": made_up([0, 1, 1, 0, 0, 3], tilt_deg=[1.0, 9.0, 9.0, 2.0, 5.0, 9.0], force_N=100.0, end_time_s=4.0),
    "box": made_up([0, 1, 1, 0, 1, 0], tilt_deg=2.0, force_N=110.0),
    "stiff": made_up([0, 2, 1, 0, 0, 0], tilt_deg=2.0, force_N=110.0),
}  # fmt: skip
"""Ours is alone in 1 and 3."""
NUDGED = {name: made_up([0] * 12) for name in FOUND} | {"box": made_up([0] * 4 + [1] * 3 + [0] * 5)}
NOBODY = {name: made_up([]) for name in FOUND}


def test_verdicts_are_counted_where_the_models_agree_and_elsewhere():
    said = compare(FOUND)
    assert said["survived"] == {OURS: 4, "spheres": 3, "box": 3, "stiff": 4}
    assert said["decided"] == {"agree": 2, "n": 4, "interval": list(wilson(2, 4))}
    assert said["undecided"] == 2
    assert said["alone"] == [1, 3]
    assert [said["each"][name]["agree"] for name in ("spheres", "box", "stiff")] == [3, 3, 4]
    others = [said["yardstick"][name] for name in ("spheres", "box", "stiff")]
    assert [(one["agree"], one["n"]) for one in others] == [(2, 3), (2, 3), (2, 2)]


def test_walks_apart_are_measured_where_both_walk_or_both_fall():
    said = compare(FOUND)["apart"]
    assert said["spheres"]["both_walk"] == 2 and said["spheres"]["both_fall"] == 1
    np.testing.assert_allclose(said["spheres"]["tilt_deg"], np.percentile([1.0, 3.0], [50, 90]))
    np.testing.assert_allclose(said["spheres"]["force_percent"], [10.0, 10.0])
    np.testing.assert_allclose(said["spheres"]["fall_time_s"], [1.0, 1.0])
    np.testing.assert_allclose(said["box"]["tilt_deg"], [0.0, 0.0])
    nobody = {name: made_up([1]) for name in FOUND}
    assert compare(nobody)["apart"]["box"]["tilt_deg"] is None


def test_report_tells_of_every_walk_on_which_ours_is_alone(capsys):
    one, other = job("elkahlout", "off", list(range(6))), job("elkahlout", "thesis-off", [1, 3, 5, 7, 9, 11])
    same = agreement.Found({name: FOUND["box"] for name in FOUND}, NOBODY)
    said = agreement.report([one, other], [agreement.Found(FOUND, NUDGED), same])
    robot = said["elkahlout"]
    assert robot["all"]["n"] == 12 and robot["all"]["decided"]["agree"] == 8
    assert robot["variants"]["thesis-off"]["decided"]["agree"] == 6
    assert [(row["variant"], row["number"]) for row in robot["alone"]] == [("off", 1), ("off", 3)]
    row = robot["alone"][0]
    assert row["scenario"] == agreement.described(agreement.scenarios(one)[1])
    assert row["walks"]["stiff"]["status"] == "nonfinite" and row["walks"][OURS]["end_time_s"] == 9.0
    assert row["changed_by_a_nudge"] == {OURS: 0, "spheres": 6, "box": 4, "stiff": 6}
    assert robot["alone"][1]["changed_by_a_nudge"] == {OURS: 6, "spheres": 0, "box": 1, "stiff": 0}
    agreement.show(said)
    text = capsys.readouterr().out
    assert "of 2 in which ours is alone, 2 are on an edge" in text
    assert "8 of 10, 80.0 % (49 to 94)" in text and "alone: off number 3" in text


def test_walks_are_kept_under_all_that_they_depend_on(tmp_path):
    one = job("elkahlout", "off", [0], tmp_path)
    scenario = agreement.scenarios(one)[0]
    key = agreement.key_of(one, scenario, Options(), "box")
    assert agreement.recall(tmp_path, key) is None
    agreement.keep(tmp_path, key, {name: row[1] for name, row in FOUND["box"].items()})
    kept = agreement.recall(tmp_path, key)
    assert kept is not None and {name: float(kept[name]) for name in COLUMNS} == {
        name: float(row[1]) for name, row in FOUND["box"].items()
    }
    assert agreement.key_of(one._replace(ground=Ground(damping=30.0)), scenario, Options(), "box") == key
    others = [
        agreement.key_of(one, scenario, Options(), "stiff"),
        agreement.key_of(one, scenario, Options(control_every=1), "box"),
        agreement.key_of(one, scenario.with_friction(0.5), Options(), "box"),
        agreement.key_of(one._replace(variant="payload-repaired"), scenario, Options(), "box"),
    ]
    assert len({key, *others}) == 5


# The walks -------------------------------------------------------------------------------------------------------


def test_walks_in_lockstep_are_those_of_each_alone():
    """One stands, one is pushed over, one loses the ground: none is disturbed by the others."""
    params, controller, _ = agreement.set_up("elkahlout", "off")
    flat = Scenario.flat(1)
    each = [flat, flat.with_push((0.0, 900.0, 0.0), 0.05, 0.2), flat.with_push((0.0, 0.0, 5000.0), 0.02, 2.0)]
    simulation = prepare(params, controller, Options(feed_forward=False, trace_every=10, contact=C_MUJOCO))
    together = simulation.run_many(agreement.stacked(each), 1.0)
    assert together.statistics.status.tolist() == [0, 1, 3]
    for i, scenario in enumerate(each):
        alone = simulation.run(scenario, 1.0)
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "variant"), [("surena3", "both-repaired"), ("elkahlout", "thesis-payload-modified")]
)
def test_our_ground_agrees_with_c_mujoco_where_its_models_of_the_contact_agree(robot, variant, tmp_path):
    found = agreement.walk(job(robot, variant, list(range(24)), tmp_path), lambda *_: None)
    said = compare(found.walks)
    decided = said["decided"]
    assert decided["n"] >= 15
    assert decided["agree"] >= 0.9 * decided["n"], said
    walks = 24 + agreement.NUDGES * len(said["alone"])
    assert all(len(found.nudged[name]["status"]) == walks - 24 for name in found.nudged)
    assert len(list(tmp_path.glob("*.npz"))) == walks * len(CONTACTS)


def test_a_nudge_moves_masses_only_and_by_a_thousandth():
    scenario = agreement.scenarios(job("elkahlout", "off", [2]))[0]
    each = agreement.nudged(scenario, (0, 2), agreement.NUDGE)
    assert (
        len(each) == agreement.NUDGES
        and len({one.errors.mass_scale.tobytes() for one in map(lane, each)}) > 1
    )
    for one in each:
        ratio = np.asarray(one.errors.mass_scale) / np.asarray(scenario.errors.mass_scale)
        np.testing.assert_allclose(np.abs(ratio - 1.0), agreement.NUDGE, rtol=1e-3)
        back = eqx.tree_at(lambda s: s.errors.mass_scale, one, scenario.errors.mass_scale)
        assert same(back, scenario)


def lane(scenario: Scenario) -> Any:
    return jax.tree.map(np.asarray, scenario)

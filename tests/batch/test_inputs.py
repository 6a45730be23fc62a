"""Every column of a scenario table reaches the scenario, and what cannot be walked is refused."""

import dataclasses

import jax
import numpy as np
import polars as pl
import pytest

from jaxbiped import adapt, planner, robot, sim
from jaxbiped.adapt import tunables
from jaxbiped.batch import (
    INPUTS,
    Choice,
    Experiment,
    Uniform,
    draw,
    grid,
    height_column,
    inputs,
    scenarios_of,
    summary,
)
from jaxbiped.sim.model import CORNER_NAMES
from jaxbiped.sim.options import XLA, C


@pytest.fixture(scope="module")
def surena():
    params = robot.load("surena3")
    return params, planner.PolynomialGait.preset(params, 6)


def one_row(**columns):
    table = inputs.complete(pl.DataFrame({name: [value] for name, value in columns.items()}), 0)
    return jax.tree.map(lambda leaf: np.asarray(leaf[0]), scenarios_of(table, []))


def test_defaults_are_the_flat_scenario():
    table = inputs.complete(pl.DataFrame({"friction": [0.8]}), 0)
    assert table.columns == [*INPUTS, "seed"]
    got, flat = one_row(friction=0.8, seed=0), sim.Scenario.flat(rectangles=1)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(flat), strict=True):
        np.testing.assert_array_equal(a, np.asarray(b))


WHERE = {
    "load_kg": lambda s: s.payload.mass,
    "load_time_s": lambda s: s.payload.time,
    "load_end_s": lambda s: s.payload.end,
    "load_x_m": lambda s: s.payload.place[0],
    "load_y_m": lambda s: s.payload.place[1],
    "load_z_m": lambda s: s.payload.place[2],
    "load_size_m": lambda s: s.payload.size,
    "friction": lambda s: s.ground.friction,
    "sinkage_m": lambda s: s.ground.sinkage,
    "damping_s_per_m": lambda s: s.ground.damping,
    "slip_speed_m_per_s": lambda s: s.ground.slip_speed,
    "trunk_mass_scale": lambda s: s.errors.mass_scale[0],
    "leg_mass_scale": lambda s: s.errors.mass_scale[1:],
    "com_x_m": lambda s: s.errors.trunk_com_offset[0],
    "com_y_m": lambda s: s.errors.trunk_com_offset[1],
    "com_z_m": lambda s: s.errors.trunk_com_offset[2],
    "gain_scale": lambda s: s.errors.gain_scale,
    "delta_z_m": lambda s: s.sensors.delta_z,
    "bounce_s": lambda s: s.sensors.bounce,
    "delay_s": lambda s: s.sensors.delay,
    "force_noise_N": lambda s: s.sensors.force_noise,
    "angle_noise_rad": lambda s: s.sensors.angle_noise,
    "push_x_N": lambda s: s.push.force[0],
    "push_y_N": lambda s: s.push.force[1],
    "push_z_N": lambda s: s.push.force[2],
    "push_time_s": lambda s: s.push.start,
    "push_length_s": lambda s: s.push.length,
}


@pytest.mark.parametrize("name", list(INPUTS))
def test_every_column_has_its_place_and_touches_nothing_else(name):
    one = INPUTS[name]
    value = one.range.low + 0.3 * (min(one.range.high, 100.0) - one.range.low)
    assert value != one.default
    got, before = one_row(**{name: value}, seed=0), one_row(friction=0.8, seed=0)
    np.testing.assert_allclose(WHERE[name](got), value, rtol=1e-6)
    changed = [
        not np.array_equal(a, b) for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(before), strict=True)
    ]
    assert sum(changed) == 1


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("corner", [0, 1, 2, 3])
def test_a_switch_may_be_stuck_and_have_a_gap_of_its_own(side, corner):
    name = f"switch_{robot.SIDE_NAMES[side]}_{CORNER_NAMES[corner]}"
    stuck, gap = np.zeros((2, 4)), np.full((2, 4), np.float32(0.02))
    stuck[side, corner] = 1.0
    got = one_row(**{f"{name}_stuck": 1, "delta_z_m": 0.02}).sensors
    np.testing.assert_array_equal(got.stuck_open, stuck)
    np.testing.assert_array_equal(got.delta_z, gap)
    gap[side, corner] = 0.003
    got = one_row(**{f"{name}_gap_m": 0.003, "delta_z_m": 0.02}).sensors
    np.testing.assert_array_equal(got.stuck_open, np.zeros((2, 4)))
    np.testing.assert_array_equal(got.delta_z, gap)


def test_columns_of_switches_are_drawn_kept_and_told_from_outcomes():
    drawn = draw(
        8, 3, switch_left_toe_left_stuck=Choice((0, 1)), switch_right_heel_left_gap_m=Uniform(0.0, 0.02)
    )
    table = inputs.complete(drawn, 0)
    assert table.columns == [*INPUTS, *drawn.columns, "seed"] == inputs.complete(table, 1).columns
    assert table.select(drawn.columns).equals(drawn)
    assert summary.inputs(table.with_columns(peak_roll_deg=0.1)) == [*INPUTS, *drawn.columns]
    batch = scenarios_of(table, [])
    np.testing.assert_array_equal(batch.sensors.stuck_open[:, 0, 0], drawn["switch_left_toe_left_stuck"])
    gaps = drawn["switch_right_heel_left_gap_m"].to_numpy().astype(np.float32)
    np.testing.assert_array_equal(batch.sensors.delta_z[:, 1, 2], gaps)


def test_how_often_the_weight_changes():
    for row, changes in (
        ({"load_kg": 0.0, "load_time_s": 2.0, "load_end_s": 3.0}, 0),
        ({"load_kg": 5.0}, 0),
        ({"load_kg": 5.0, "load_time_s": 0.0}, 0),
        ({"load_kg": 5.0, "load_time_s": 0.0, "load_end_s": 3.0}, 1),
        ({"load_kg": 5.0, "load_time_s": 2.0}, 1),
        ({"load_kg": 5.0, "load_time_s": 2.0, "load_end_s": 3.0}, 2),
    ):
        assert inputs.changes_of_weight(inputs.complete(pl.DataFrame([row]), 0)) == changes
    both = pl.DataFrame({"load_kg": [5.0, 5.0], "load_time_s": [2.0, 0.0]})
    assert inputs.changes_of_weight(inputs.complete(both, 0)) == 1


def test_pads_lie_where_with_obstacle_puts_them(surena):
    params, gait = surena
    table = pl.DataFrame({height_column(2): [0.03, 0.0], height_column(3): [0.0, -0.02]})
    one = Experiment(params, {"off": adapt.Controller(gait)}, table)
    got = scenarios_of(one.table, one.pads)
    for row, (step, height) in enumerate([(2, 0.03), (3, -0.02)]):
        wanted = sim.Scenario.flat().with_obstacle(params, gait, step, height).terrain
        terrain = jax.tree.map(lambda leaf, row=row: np.asarray(leaf[row]), got.terrain)
        used = np.flatnonzero(terrain.height)
        assert used.tolist() == [row]
        np.testing.assert_array_equal(terrain.lower[row], np.asarray(wanted.lower[0]))
        np.testing.assert_array_equal(terrain.upper[row], np.asarray(wanted.upper[0]))
        np.testing.assert_array_equal(terrain.height[row], np.asarray(wanted.height[0]))


def test_every_scenario_has_a_seed_of_its_own_and_keeps_it():
    table = grid(friction=np.linspace(0.5, 0.9, 50).tolist())
    a, b = inputs.complete(table, 1), inputs.complete(table, 1)
    assert a.equals(b) and a["seed"].n_unique() == 50
    assert not inputs.complete(table, 2)["seed"].equals(a["seed"])
    assert inputs.complete(a, 5)["seed"].equals(a["seed"])  # a given column stays


BAD_TABLES = [
    ({"load_kg": [-1.0]}, "load_kg, row 0: got -1 kg, allowed: >= 0 and <= 200 kg"),
    ({"load_kg": [float("nan")]}, "load_kg, row 0: got nan"),
    ({"load_kg": [1e9]}, "allowed: >= 0 and <= 200 kg"),
    ({"load_kg": ["five"]}, "allowed: numbers"),
    ({"load_time_s": [-0.1]}, "load_time_s"),
    (
        {"load_kg": [0.0, 1.0], "load_time_s": [2.0, 2.0], "load_end_s": [1.0, 1.5]},
        "load_end_s, row 1: got 1.5 s, allowed: > load_time_s, 2 s",
    ),
    (
        {"load_kg": [1.0], "load_time_s": [0.0], "load_end_s": [0.0]},
        "load_end_s, row 0: got 0 s, allowed: > ",
    ),
    (
        {"switch_left_toe_left_stuck": [0.0, 0.5]},
        "switch_left_toe_left_stuck, row 1: got 0.5, allowed: 0 or 1",
    ),
    (
        {"switch_left_toe_left_stuck": [2.0]},
        "switch_left_toe_left_stuck, row 0: got 2, allowed: >= 0 and <= 1",
    ),
    ({"switch_left_toe_left_gap_m": [-0.01]}, "switch_left_toe_left_gap_m, row 0: got -0.01 m"),
    ({"switch_left_toe_left_gap_m": [10.0]}, "10 mm is 0.01 m"),
    ({"switch_left_toe_stuck": [1.0]}, "did you mean 'switch_left_toe_left_stuck'"),
    ({"friction": [0.0]}, "friction, row 0: got 0"),
    ({"friction": [float("inf")]}, "friction, row 0: got inf"),
    ({"sinkage_m": [0.0]}, "sinkage_m"),
    ({"damping_s_per_m": [-1.0]}, "damping_s_per_m"),
    ({"trunk_mass_scale": [0.0]}, "trunk_mass_scale"),
    ({"leg_mass_scale": [3.0]}, "leg_mass_scale"),
    ({"com_x_m": [0.5]}, "com_x_m"),
    ({"gain_scale": [0.0]}, "gain_scale"),
    ({"delta_z_m": [-0.01]}, "delta_z_m"),
    ({"delay_s": [1.0]}, "delay_s"),
    ({"bounce_s": [-1e-3]}, "bounce_s"),
    ({"force_noise_N": [-1.0]}, "force_noise_N"),
    ({"angle_noise_rad": [1.0]}, "angle_noise_rad"),
    ({"push_length_s": [-1.0]}, "push_length_s"),
    ({"step_2_height_m": [0.5]}, "step_2_height_m"),
    ({"step_02_height_m": [0.01]}, "got column 'step_02_height_m'"),
    ({"weight": [3.0]}, "got column 'weight'"),
    ({"frictoin": [0.5]}, "did you mean 'friction'?"),
    ({"load_kg": ["5"]}, "load_kg: got String, allowed: numbers [kg]"),
    ({"load_kg": [True]}, "load_kg: got Boolean"),
    ({"load_kg": [1.0, None]}, "load_kg: got nothing in row 1"),
    ({"load_kg": [1.0, 2500.0]}, "2500 g is 2.5 kg"),
    ({"delta_z_m": [1e-60]}, "0 in float32"),
    ({"seed": [1.5]}, "seed"),
    ({"seed": [-1]}, "seed"),
    ({}, "scenarios: got none"),
    ({"friction": []}, "scenarios: got none"),
]


@pytest.mark.parametrize(("columns", "says"), BAD_TABLES)
def test_bad_tables_are_refused(columns, says):
    with pytest.raises(ValueError, match="allowed") as refusal:
        inputs.complete(pl.DataFrame(columns), 0)
    assert says in str(refusal.value)


BAD_EXPERIMENTS = [
    ({"variants": {}}, "variants: got none"),
    ({"duration": 0.0}, "duration"),
    ({"duration": float("nan")}, "duration"),
    ({"batch": 0}, "batch: got 0"),
    ({"seed": -1}, "seed: got -1"),
    ({"options": sim.Options(trace_every=1)}, "trace_every"),
    ({"scenarios": pl.DataFrame({"step_6_height_m": [0.01]})}, "step: got 6"),
]


@pytest.mark.parametrize(("changed", "says"), BAD_EXPERIMENTS)
def test_bad_experiments_are_refused(surena, changed, says):
    params, gait = surena
    given = {"robot": params, "variants": {"off": adapt.Controller(gait)}, "scenarios": grid(friction=0.8)}
    with pytest.raises(ValueError, match="allowed") as refusal:
        Experiment(**{**given, **changed})
    assert says in str(refusal.value)


def test_never_more_lanes_than_scenarios(surena):
    params, gait = surena
    table = grid(friction=np.linspace(0.5, 0.9, 33).tolist())
    one = Experiment(params, {"a": adapt.Controller(gait)}, table, batch=65536)
    assert one.lanes == 33 and len(one.chunks) == 1


def test_numpys_whole_numbers_are_whole_numbers(surena):
    params, gait = surena
    variants = {"a": adapt.Controller(gait)}
    one = Experiment(params, variants, grid(friction=0.8), batch=np.int64(4), seed=np.int32(3))
    assert type(one.batch) is int and type(one.seed) is int


def test_obstacle_as_high_as_the_swing_is_refused(surena):
    """A walk refuses it; a table does too."""
    params, gait = surena
    variants = {"off": adapt.Controller(gait)}
    assert Experiment(params, variants, grid(step_2_height_m=[0.0, 0.09])).rows == 2
    with pytest.raises(
        ValueError, match=r"step 2: got an obstacle of 0\.1 m, allowed: below 0\.1 m, the height the swing"
    ):
        Experiment(params, variants, grid(step_2_height_m=[0.0, 0.1]))
    low = tunables.other_gait(params, gait, {"H_max": 0.05})
    with pytest.raises(ValueError, match="variant 'low': step 2"):  # with its own gait
        Experiment(params, {**variants, "low": adapt.Controller(low)}, grid(step_2_height_m=[0.09]))


@pytest.mark.parametrize("height", [0.01, -0.01])
def test_obstacle_or_hole_under_a_foot_at_the_start_is_refused(surena, height):
    params, gait = surena
    variants = {"off": adapt.Controller(gait)}
    with pytest.raises(ValueError, match=r"start: got an? \w+ of -?0\.01 m .* under the left foot"):
        Experiment(params, variants, grid(step_0_height_m=[0.0, height]))
    assert Experiment(params, variants, grid(step_0_height_m=0.0)).rows == 1  # nothing lies there


def test_overlapping_pads_are_refused():
    params = robot.load("surena3")
    gait = planner.CosineGait.preset(params, 6)
    variants = {"off": adapt.Controller(gait)}
    apart = pl.DataFrame({"step_2_height_m": [0.01, 0.0], "step_4_height_m": [0.0, 0.01]})
    assert Experiment(params, variants, apart).rows == 2
    both = pl.DataFrame({"step_2_height_m": [0.01], "step_4_height_m": [0.01]})
    with pytest.raises(ValueError, match="steps 2 and 4 that overlap"):
        Experiment(params, variants, both)


def test_room_for_delay_and_noise_follows_from_the_scenarios(surena):
    params, gait = surena
    variants = {"off": adapt.Controller(gait)}
    assert not Experiment(params, variants, grid(friction=0.8)).simulation.noise
    noisy = Experiment(params, variants, grid(force_noise_N=[0.0, 5.0], delay_s=[0.0, 0.005]))
    assert noisy.simulation.noise and noisy.simulation.delay_room == 3  # 2 ms a control tick


@pytest.mark.parametrize(
    ("backend", "rows", "lanes"),
    [(XLA, rows, lanes) for rows, lanes in [(1, 1), (8, 8), (9, 9), (17, 17), (128, 128)]]
    + [(XLA, 129, 65), (XLA, 288, 96), (XLA, 4096, 128), (C, 129, 129), (C, 288, 144), (C, 4096, 256)],
)
def test_chunks_cover_every_row_once_and_waste_little(surena, backend, rows, lanes):
    params, gait = surena
    table = grid(friction=np.linspace(0.5, 0.9, rows).tolist())
    options = dataclasses.replace(sim.own_options(params, gait), backend=backend)
    one = Experiment(params, {"a": adapt.Controller(gait), "b": adapt.Controller(gait)}, table, options)
    assert one.lanes == lanes
    walked = [chunk.first_row + i for chunk in one.chunks for i in range(chunk.start, chunk.stop)]
    assert walked == list(range(2 * rows)) and one.rows == 2 * rows
    assert all(0 < chunk.stop - chunk.start <= one.chunk_rows for chunk in one.chunks)

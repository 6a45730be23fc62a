"""Whole walks of surena3 with loads that are carried and taken off, and with switches that close on the ground."""

import numpy as np
import polars as pl
import pytest

from jaxbiped import adapt, planner, robot
from jaxbiped.batch import Experiment, grid, part

N_STEPS = 6


@pytest.fixture(scope="module")
def surena():
    params = robot.load("surena3")
    return params, planner.PolynomialGait.preset(params, N_STEPS)


def walked(params, variants, scenarios) -> pl.DataFrame:
    one = Experiment(params, variants, scenarios)
    return pl.concat([part.walk_chunk(one, chunk) for chunk in one.chunks])


@pytest.fixture(scope="module")
def loads(surena) -> pl.DataFrame:
    """Rows: carried all the time; carried and taken off; put on, and taken off while the robot settles."""
    params, gait = surena
    reflex = adapt.PayloadReflex.repaired(params, gait)
    table = pl.DataFrame(
        {"load_kg": [8.0] * 3, "load_time_s": [0.0, 0.0, 2.5], "load_end_s": [1e6, 2.5, 4.5]}
    )
    return walked(params, {"repaired": adapt.Controller(gait, adapt.Landing(), reflex)}, table)


def test_a_load_carried_from_the_start_sets_off_no_reflex_and_is_judged_as_own_weight(surena, loads):
    row = loads.row(0, named=True)
    assert (row["reflexes"], row["status"]) == (0, "ok") and row["success"] and row["finished"]
    carried = (float(surena[0].total_mass) + 8.0) * 9.81
    assert row["peak_force_left_N"] > 0.95 * carried


def test_taking_a_load_off_sets_off_the_reflex(loads):
    row = loads.row(1, named=True)
    assert row["reflexes"] >= 1 and 2.5 < row["trigger_s"] < 4.0
    assert row["status"] == "ok" and row["success"]


def test_a_load_that_is_taken_off_while_the_robot_settles_is_recovered_from(loads):
    row = loads.row(2, named=True)
    assert row["reflexes"] >= 1 and row["trigger_s"] > 2.5
    assert row["status"] == "ok" and row["success"]


@pytest.mark.parametrize("name", ["repaired", pytest.param("paper", marks=pytest.mark.slow)])
def test_switches_that_close_on_the_ground_walk_as_those_of_1_mm(surena, name):
    """On pads of 0, +2 and -2 cm, switches and stage alike."""
    params, gait = surena
    make = {"repaired": adapt.Landing.repaired, "paper": adapt.Landing.paper}[name]
    rows = {}
    for delta_z in (0.0, 1e-3):
        variant = {name: adapt.Controller(gait, make(delta_z=delta_z))}
        table = walked(params, variant, grid(delta_z_m=delta_z, step_2_height_m=[0.0, 0.02, -0.02]))
        numbers = table.select(pl.col(pl.Float64).exclude("trigger_s")).to_numpy()
        assert np.isfinite(numbers).all()
        rows[delta_z] = table
    on_time, nearly = rows[0.0], rows[1e-3]
    assert on_time["success"].to_list() == nearly["success"].to_list()
    if name == "repaired":
        assert on_time["success"].all() and (on_time["missed"] == 0).all()
        np.testing.assert_allclose(on_time["x_m"], nearly["x_m"], atol=0.02)
        assert on_time["peak_roll_deg"].max() < nearly["peak_roll_deg"].max() + 1.0
    else:
        assert on_time["success"].all()

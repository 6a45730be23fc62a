"""Batches in machine code: chosen where there is much to walk, the same rows for any number of lanes."""

import dataclasses
import shutil

import numpy as np
import polars as pl
import pytest

from jaxbiped import batch, planner, robot, sim
from jaxbiped.adapt import Controller, PayloadReflex
from jaxbiped.batch import experiment_file, experiment_writer
from jaxbiped.commands import replay
from jaxbiped.sim.compile import backend
from jaxbiped.sim.options import AUTO, XLA, C

needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
ENOUGH = backend.ENOUGH


def experiment(
    n: int,
    backend: str,
    duration: float,
    lanes: int | None = None,
    contact: str = "compliant",
    **columns: float,
) -> batch.Experiment:
    """Loads with the modified reflex."""
    params = robot.load("elkahlout")
    gait = planner.CosineGait.preset(params, 4)
    controller = Controller(gait, PayloadReflex.modified(params, gait))
    loads = np.linspace(0.0, 12.0, n)
    level = {
        "step_1_height_m": 0.0,
        "step_2_height_m": 0.0,
    }  # room for two, as in tests/sim/compile: one program
    scenarios = pl.DataFrame({"load_kg": loads, "load_time_s": np.full(n, 0.6), **level, **columns})
    options = dataclasses.replace(sim.own_options(params, gait), backend=backend, contact=contact)
    return batch.Experiment(
        params, {"modified": controller}, scenarios, options, duration=duration, batch=lanes
    )


@needs_cc
def test_c_is_chosen_where_there_is_enough_to_walk_and_it_can(monkeypatch):
    many = int(ENOUGH / (10.0 / 5e-4))
    assert experiment(many, AUTO, 10.0).simulation.backend == C
    assert experiment(many - 1, AUTO, 10.0).simulation.backend == XLA
    one = experiment(many // 2 + 1, AUTO, 10.0)
    assert one.simulation.backend == XLA
    off = Controller(one.variants["modified"].gait)
    alike = dict.fromkeys(("modified", "the same"), one.variants["modified"])
    assert (
        dataclasses.replace(one, variants=alike).simulation.backend == C
    )  # its two variants share a program
    assert dataclasses.replace(one, variants={**one.variants, "off": off}).simulation.backend == XLA
    assert experiment(200, AUTO, 10.0).lanes == 200
    assert experiment(200, XLA, 10.0).lanes < 200  # no more than 128
    assert experiment(many, AUTO, 10.0, force_noise_N=5.0).simulation.backend == C
    assert experiment(many, AUTO, 10.0, contact="mjx").simulation.backend == XLA
    assert experiment(many, XLA, 10.0).simulation.backend == XLA
    assert experiment(4, C, 10.0).simulation.backend == C
    monkeypatch.setenv("CC", "/no/such/compiler")
    assert experiment(many, AUTO, 10.0).simulation.backend == XLA


@needs_cc
def test_the_backend_is_written_down_and_read_again(tmp_path):
    one = experiment(4, C, 1.0)
    assert one.resolved["options"]["backend"] == C
    again = batch.Experiment.from_resolved(one.resolved, one.table)
    assert again.resolved == one.resolved
    large = experiment(200, C, 10.0)  # of a version that had no backends yet
    options = {name: value for name, value in large.resolved["options"].items() if name != "backend"}
    older = batch.Experiment.from_resolved({**large.resolved, "options": options}, large.table)
    assert older.simulation.backend == XLA
    file = tmp_path / "experiment.toml"
    experiment_writer.write(file, one)
    assert experiment_file.read(file).simulation.backend == C


@needs_cc
def test_rows_are_those_of_xla_for_any_number_of_lanes_and_replayed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(replay, "TOLERANCE", dict.fromkeys(replay.TOLERANCE, 0.0))

    def walked(name: str, lanes: int | None) -> pl.DataFrame:
        return batch.run(experiment(18, name, 1.2, lanes), tmp_path / f"{name}-{lanes}", workers=1)

    in_xla, in_c, in_turn = walked(XLA, None), walked(C, None), walked(C, 5)
    assert in_c.equals(in_turn)
    replayed = replay.run(replay.Replay(tmp_path / f"{C}-None", 11))
    assert replayed["agrees"]  # to the bit, though what is drawn is XLA's
    said = capsys.readouterr().out
    assert "row 11: agrees with the table" in said
    assert in_c["status"].to_list() == in_xla["status"].to_list()
    assert in_xla["trigger_s"].drop_nulls().len() > 5
    for name in ("end_time_s", "peak_pitch_deg", "trigger_s", "x_m"):  # what touchdowns amplify least
        np.testing.assert_allclose(in_c[name], in_xla[name], rtol=0.02, atol=2e-3, err_msg=name)

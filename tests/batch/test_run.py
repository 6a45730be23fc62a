"""The results table: resumed, refused, never half written; what one row says of a real walk."""

import errno
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import made_up
import numpy as np
import polars as pl
import pytest

from jaxbiped import adapt, batch, planner, robot, score, sim
from jaxbiped.batch import part, store, summary, workers


@pytest.fixture(scope="module")
def surena():
    params = robot.load("surena3")
    return params, planner.PolynomialGait.preset(params, 2)


def experiment(surena, rows=20, **changed):
    params, gait = surena
    variants = {
        "off": adapt.Controller(gait),
        "repaired": adapt.Controller(gait, adapt.Landing.repaired()),
    }
    table = batch.grid(friction=np.linspace(0.4, 0.9, rows).tolist())
    given = {"robot": params, "variants": variants, "scenarios": table, "batch": 8, "duration": 0.02}
    return batch.Experiment(**{**given, **changed})


@pytest.fixture
def quick(monkeypatch):
    """Chunks made up instead of walked; the names of those made."""
    made = []

    def walk(one, chunk, told=None):
        made.append(chunk.number)
        rows = np.arange(chunk.start, chunk.stop)
        outcome = {
            "status": ["ok" if i % 3 else "fell" for i in rows],
            "success": rows % 3 != 0,
            "end_time_s": np.sin(rows),
        }
        inputs = one.table[chunk.start : chunk.stop]
        return pl.concat([part._identity(chunk), inputs, pl.DataFrame(outcome)], how="horizontal")

    monkeypatch.setattr(workers, "walk_chunk", walk)
    return made


def table_bytes(folder: Path) -> bytes:
    return (folder / store.TABLE).read_bytes()


def test_table_has_every_row_once_and_is_kept(surena, quick, tmp_path):
    one = experiment(surena)
    table = batch.run(one, tmp_path, workers=1)
    assert table["row"].to_list() == list(range(40))
    assert quick == list(range(6))
    assert batch.run(one, tmp_path, workers=1).equals(table) and quick == list(
        range(6)
    )  # nothing walked again
    assert pl.read_parquet(tmp_path / store.TABLE).equals(table)


def test_missing_parts_are_walked_again_and_the_table_is_the_same(surena, quick, tmp_path):
    one = experiment(surena)
    batch.run(one, tmp_path / "a", workers=1)
    for stop in range(6):
        folder, seen = tmp_path / f"b{stop}", []

        def interrupt(p, seen=seen, stop=stop):
            seen.append(p.done)
            if len(seen) == stop + 1:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            batch.run(one, folder, workers=1, progress=interrupt)
        assert not (folder / store.TABLE).exists()
        assert len(list((folder / store.PARTS).glob("*.parquet"))) == stop
        quick.clear()
        batch.run(one, folder, workers=1)
        assert quick == list(range(stop, 6))
        assert table_bytes(folder) == table_bytes(tmp_path / "a")


def test_a_part_left_half_written_does_not_count(surena, quick, tmp_path):
    one = experiment(surena)
    batch.run(one, tmp_path, workers=1)
    whole, parts = table_bytes(tmp_path), sorted((tmp_path / store.PARTS).glob("*.parquet"))
    parts[2].rename(parts[2].with_name(f".{parts[2].name}.x7d"))  # as a kill while it is written leaves it
    quick.clear()
    batch.run(one, tmp_path, workers=1)
    assert quick == [2] and table_bytes(tmp_path) == whole


def test_progress_moves_inside_a_chunk(surena, monkeypatch, tmp_path):
    """Half a chunk of eight is four walks' worth, which the time left knows of, and nothing once it is finished."""

    def walk(one, chunk, told):
        told(0.5)
        return made_up.walk_chunk(one, chunk)

    monkeypatch.setattr(workers, "walk_chunk", walk)
    seen: list[batch.Progress] = []
    batch.run(experiment(surena, rows=16), tmp_path, workers=1, progress=seen.append)
    assert [(p.done, p.under_way) for p in seen] == [
        (0, 0.0), (0, 4.0), (8, 0.0), (8, 4.0), (16, 0.0), (16, 4.0), (24, 0.0), (24, 4.0), (32, 0.0)
    ]  # fmt: skip
    left = [p.seconds_left for p in seen]
    pairs = zip(left[2::2], left[3::2], strict=False)
    assert left[0] is None and all((before or 0.0) > (within or 0.0) for before, within in pairs)


def test_lanes_of_large_experiments_take_several_scenarios(surena):
    """As many chunks as workers can share come first; a chunk never depends on the workers."""
    for rows, chunk_rows, chunks in ((20, 8, 3), (256, 8, 32), (512, 16, 32), (4000, 32, 125)):
        one = experiment(surena, rows=rows)
        assert (one.lanes, one.chunk_rows, len(one.chunks)) == (8, chunk_rows, 2 * chunks)
        assert [c.stop - c.start for c in one.chunks[:chunks]][:-1] == [chunk_rows] * (chunks - 1)


def test_chunks_of_a_folder_of_format_2_are_as_long_as_it_has_lanes(surena):
    """It did not say how long they are, and its parts are found by their numbers."""
    one = experiment(surena, rows=512)
    resolved = {name: value for name, value in one.resolved.items() if name != "chunk_rows"}
    again, old = (batch.Experiment.from_resolved(said, one.table) for said in (one.resolved, resolved))
    assert (one.chunk_rows, again.chunk_rows, old.chunk_rows) == (16, 16, 8)
    assert len(again.chunks) == len(one.chunks) and len(old.chunks) == 2 * len(one.chunks)


def test_progress_counts_walks_failures_and_what_was_there(surena, quick, tmp_path):
    one, seen = experiment(surena), []
    table = batch.run(one, tmp_path, workers=1, progress=seen.append)
    assert [p.done for p in seen] == [0, 8, 16, 20, 28, 36, 40] and {p.total for p in seen} == {40}
    assert seen[-1].failed == (~table["success"]).sum() and seen[-1].seconds_left == 0.0
    assert seen[0].rate is None and seen[0].seconds_left is None
    assert all(p.rate > 0.0 and math.isfinite(p.seconds_left) for p in seen[1:])
    next((tmp_path / store.PARTS).glob("*-00000.parquet")).unlink()
    again = []
    batch.run(one, tmp_path, workers=1, progress=again.append)
    assert [p.done for p in again] == [32, 40]


CHANGES = {
    "robot": lambda s: {"robot": robot.load("elkahlout")},
    "friction": lambda s: {"scenarios": batch.grid(friction=np.linspace(0.4, 0.91, 20).tolist())},
    "duration": lambda s: {"duration": 0.03},
    "batch": lambda s: {"batch": 4},
    "dt": lambda s: {"options": sim.Options(dt=1e-3)},
    "seed": lambda s: {"seed": 5},
    "variant": lambda s: {
        "variants": {
            "off": adapt.Controller(s[1]),
            "repaired": adapt.Controller(s[1], adapt.Landing.repaired(descent_speed=0.21)),
        }
    },
    "gait": lambda s: {"variants": {"off": adapt.Controller(planner.PolynomialGait.preset(s[0], 3))}},
}


@pytest.mark.parametrize("what", CHANGES)
def test_another_experiment_in_the_same_folder_is_refused_with_what_differs(surena, quick, tmp_path, what):
    batch.run(experiment(surena), tmp_path, workers=1)
    before = table_bytes(tmp_path)
    other = experiment(surena, **CHANGES[what](surena))
    with pytest.raises(batch.StoreError, match="another experiment") as refusal:
        batch.run(other, tmp_path, workers=1)
    assert "->" in str(refusal.value) and "allowed: another folder" in str(refusal.value)
    assert table_bytes(tmp_path) == before
    batch.run(other, tmp_path, workers=1, overwrite=True)
    batch.run(other, tmp_path, workers=1)


def test_other_code_is_another_experiment(surena, quick, tmp_path, monkeypatch):
    batch.run(experiment(surena), tmp_path, workers=1)
    monkeypatch.setattr(store, "source_hash", lambda: "0" * 64)
    with pytest.raises(batch.StoreError, match="source_sha256"):
        batch.run(experiment(surena), tmp_path, workers=1)


def test_full_disk_is_a_clear_error_and_finished_parts_stay(surena, quick, tmp_path, monkeypatch):
    real, calls = os.replace, []

    def full(a, b):
        calls.append(b)
        if len(calls) == 7:  # experiment twice, scenarios, three parts, then no more space
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(a, b)

    one = experiment(surena)
    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(batch.StoreError, match="No space left on device"):
        batch.run(one, tmp_path / "a", workers=1)
    monkeypatch.undo()
    parts = list((tmp_path / "a" / store.PARTS).iterdir())
    assert len(parts) == 3 and all(pl.read_parquet(part).height for part in parts)  # and no temporary file


@pytest.mark.parametrize("name", ["file", "file/below"])
def test_folder_that_cannot_be_made_is_refused(surena, quick, tmp_path, name):
    (tmp_path / "file").write_text("")
    with pytest.raises(batch.StoreError, match=r"file' is a file.*allowed: a folder that can be made"):
        batch.run(experiment(surena), tmp_path / name, workers=1)


def test_folder_without_results_is_no_table(surena, quick, tmp_path):
    with pytest.raises(batch.StoreError, match="table: got"):
        batch.open_table(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        batch.run(experiment(surena), tmp_path, workers=1, progress=interrupted)
    with pytest.raises(batch.StoreError, match="without a finished chunk"):
        batch.open_table(tmp_path)


def interrupted(_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("given", [0, -1, 5000])
def test_bad_number_of_workers_is_refused(surena, tmp_path, given):
    with pytest.raises(ValueError, match=f"workers: got {given}, allowed"):
        batch.run(experiment(surena), tmp_path, workers=given)
    assert not list(tmp_path.iterdir())


def test_plan_says_what_is_left(surena, quick, tmp_path):
    one = experiment(surena)
    plan = batch.plan(one, tmp_path, workers=2)
    assert (plan.walks, plan.chunks, plan.chunks_done, plan.lanes, plan.workers) == (40, 6, 0, 8, 2)
    assert plan.simulated_s == pytest.approx(40 * 0.02) and plan.wall_time_s > 0.0
    assert not (tmp_path / store.EXPERIMENT).exists()
    batch.run(one, tmp_path, workers=1)
    assert batch.plan(one, tmp_path).chunks_done == 6 and batch.plan(one, tmp_path).wall_time_s == 0.0


# Real walks ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walked(surena, tmp_path_factory):
    """Ten short walks: pushes from none to hard, one with gains that are not numbers."""
    params, gait = surena
    table = pl.DataFrame(
        {
            "push_y_N": [0.0, 50.0, 100.0, 150.0, 200.0, 250.0, 300.0, 1000.0, 2500.0],
            "push_time_s": [0.05] * 9,
        }
    )
    table = table.with_columns(push_length_s=pl.lit(0.3))
    folder = tmp_path_factory.mktemp("walked")
    one = batch.Experiment(params, {"off": adapt.Controller(gait)}, table, duration=0.6, batch=4)
    return one, batch.run(one, folder, workers=1), folder


def test_a_row_says_what_a_single_walk_says(walked):
    one, table, _ = walked
    for row in (0, 3):
        chosen = one.table[row]
        scenario = jax.tree.map(lambda leaf: leaf[0], batch.scenarios_of(chosen, []))
        walk = sim.rollout(one.robot, one.variants["off"], scenario, 0.6, one.simulation)
        verdict = score.judge(walk, one.variants["off"].gait, scenario)
        said = table.row(row, named=True)
        assert said["status"] == score.STATUS_TEXT[int(verdict.status)] and said["success"] == bool(
            verdict.success
        )
        s = walk.statistics
        assert said["end_time_s"] == pytest.approx(float(s.end_time), abs=1e-6)
        assert said["peak_roll_deg"] == pytest.approx(float(np.degrees(s.peak_roll_pitch[0])), abs=0.02)
        assert said["peak_force_left_N"] == pytest.approx(float(s.peak_foot_force[0]), rel=0.01)
        assert said["zmp_margin_m"] == pytest.approx(float(s.zmp_margin), abs=1e-3)
        assert said["reach_margin_m"] == pytest.approx(float(s.reach_margin), abs=1e-5)
        assert said["y_m"] == pytest.approx(float(s.p_world_trunk[1]), abs=1e-3)


def test_harder_pushes_tilt_more_and_fell_last(walked):
    _, table, _ = walked
    status = table["status"].to_list()
    assert status[0] == "unfinished" and status[-1] == "fell"
    assert status == sorted(status, reverse=True)  # unfinished ones first, then those that fell
    assert table.filter(status="unfinished")["peak_roll_deg"].is_sorted()
    assert table.filter(status="fell")["end_time_s"].is_sorted(descending=True)
    assert table["zmp_margin_m"][0] > 0.01 and table["zmp_margin_m"][-1] < 0.01


def test_experiment_comes_back_from_its_folder(walked):
    one, table, folder = walked
    again, rows = batch.open_table(folder)
    assert rows.equals(table) and again.resolved == one.resolved
    described = json.loads((folder / store.EXPERIMENT).read_text())
    assert {"experiment", "code", "key", "seed", "machine"} <= described.keys()


def test_a_lane_that_is_not_a_number_is_a_status_and_the_others_live(surena, tmp_path):
    params, gait = surena
    broken = eqx.tree_at(lambda r: r.servo.kp, params, params.servo.kp * math.inf)
    table = batch.grid(friction=[0.7, 0.8])
    rows = batch.run(
        batch.Experiment(broken, {"off": adapt.Controller(gait)}, table, duration=0.6, batch=4),
        tmp_path,
        workers=1,
    )
    assert rows["status"].to_list() == ["nonfinite"] * 2 and not rows["success"].any()
    assert summary.cells(rows)["successes"].to_list() == [0]


def test_two_dask_workers_give_the_same_table(walked, tmp_path):
    pytest.importorskip("distributed")
    one, _, folder = walked
    seen: list[batch.Progress] = []
    batch.run(one, tmp_path, workers=2, progress=seen.append)
    assert table_bytes(tmp_path) == table_bytes(folder)
    assert any(p.under_way > 0.0 for p in seen)  # workers say how far they are


UNGUARDED = """
import sys
import jaxbiped as jb

robot = jb.robot.load("elkahlout")
variants = {"off": jb.adapt.Controller(jb.planner.CosineGait.preset(robot, 2))}
one = jb.batch.Experiment(robot, variants, jb.batch.grid(friction=[0.5, 0.6]), duration=0.02, batch=1)
jb.batch.run(one, sys.argv[1], workers=2)
"""


def test_a_script_without_main_guard_is_told_so_in_one_line(tmp_path):
    pytest.importorskip("distributed")
    (tmp_path / "script.py").write_text(UNGUARDED)
    command = [sys.executable, str(tmp_path / "script.py"), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and done.stderr.count("Traceback") == 1, done.stderr
    last = done.stderr.splitlines()[-1]
    assert (
        "WorkersError: workers: got a script that starts itself" in last
        and "if __name__ == '__main__':" in last
    )


def test_a_worker_forgets_what_is_compiled_for_variants_of_another_kind(surena, monkeypatch):
    one = experiment(surena)
    monkeypatch.setattr(workers, "ROOM_MIB", 0.0)
    monkeypatch.setattr(workers, "_kinds", set())
    forgets = []
    monkeypatch.setattr(jax, "clear_caches", lambda: forgets.append(True))
    chunks = one.chunks
    for variant, forgotten in (("off", 1), ("off", 1), ("repaired", 2), ("repaired", 2), ("off", 3)):
        chunk = next(chunk for chunk in chunks if chunk.variant == variant)
        workers._make_room(one, chunk)
        assert len(forgets) == forgotten
    monkeypatch.setattr(workers, "ROOM_MIB", 1e9)
    workers._make_room(one, next(chunk for chunk in chunks if chunk.variant == "repaired"))
    assert len(forgets) == 3

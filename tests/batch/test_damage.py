"""Whatever happens to the files of a folder: said, set aside, made again; never believed, never deleted."""

import json
import random
import shutil
import stat
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from jaxbiped import adapt, batch, planner, robot
from jaxbiped.batch import store
from jaxbiped.sim import feed_forward

OLD = Path(__file__).with_name("folders_of_0_1")
OLDEST = ("elkahlout", "surena3")
"""Written before folders had a format; `payload` and `obstacles` are of format 2, written by commit a5252ff."""


@pytest.fixture(scope="module")
def surena():
    params = robot.load("surena3")
    return params, planner.PolynomialGait.preset(params, 2)


def experiment(surena, rows=20, **changed):
    params, gait = surena
    variants = {"off": adapt.Controller(gait), "other": adapt.Controller(gait)}
    table = batch.grid(friction=np.linspace(0.4, 0.9, rows).tolist())
    given = {"robot": params, "variants": variants, "scenarios": table, "batch": 8, "duration": 0.02}
    return batch.Experiment(**{**given, **changed})


class Folder:
    """A finished folder, what is said about it, and a copy of what was in it."""

    def __init__(self, path: Path, one: batch.Experiment, made: list[int]):
        self.path, self.one, self.made, self.said = path, one, made, []
        batch.run(one, path, workers=1)
        self.table = (path / store.TABLE).read_bytes()
        made.clear()

    def part(self, number: int) -> Path:
        return store.part_file(self.path, store.Store(self.path, self.one).key, self.one.chunks[number])

    def run(self) -> None:
        batch.run(self.one, self.path, workers=1, tell=self.said.append)

    def contents(self) -> dict[str, tuple[bytes, int]]:
        """Every file, with the time of its last change."""
        files = [file for file in self.path.rglob("*") if file.is_file()]
        return {str(file): (file.read_bytes(), file.stat().st_mtime_ns) for file in files}


@pytest.fixture
def folder(surena, made_up, tmp_path) -> Folder:
    return Folder(tmp_path / "run", experiment(surena), made_up)


def foreign(file: Path) -> None:
    pl.DataFrame({"a": [1, 2]}).write_parquet(file)


def same_rows_other_outcome(file: Path) -> None:
    """As an editor of tables saves it: the checksum is gone."""
    pl.read_parquet(file).with_columns(success=pl.lit(False)).write_parquet(file)


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-200])


def rotten(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0x10
    file.write_bytes(content)


def text(file: Path) -> None:
    file.write_text("hello")


def empty(file: Path) -> None:
    file.write_bytes(b"")


DAMAGE = [foreign, same_rows_other_outcome, cut, rotten, text, empty]


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_part_is_said_set_aside_and_made_again(folder, damage):
    bad = folder.part(2)
    damage(bad)
    wrong = bad.read_bytes()
    folder.run()
    assert folder.made == [2] and (folder.path / store.TABLE).read_bytes() == folder.table
    aside = bad.with_name(f"{bad.name}.damaged")
    assert aside.read_bytes() == wrong
    assert len(folder.said) == 1 and str(bad) in folder.said[0] and aside.name in folder.said[0]
    damage(bad)
    folder.run()  # a second time: both are kept
    assert bad.with_name(f"{bad.name}.damaged-2").exists() and aside.read_bytes() == wrong


@pytest.mark.parametrize("damage", DAMAGE)
def test_report_leaves_a_damaged_part_out_says_so_and_changes_nothing(folder, damage):
    damage(folder.part(2))
    before = folder.contents()
    _, rows = batch.open_table(folder.path, folder.said.append)
    assert sorted(set(range(40)) - set(rows["row"])) == list(range(16, 20))
    assert len(folder.said) == 1 and str(folder.part(2)) in folder.said[0]
    assert folder.contents() == before


def test_part_of_another_chunk_under_this_chunks_name_does_not_count(folder):
    shutil.copy(folder.part(0), folder.part(1))
    shutil.copy(folder.part(3), folder.part(4))
    folder.run()
    assert folder.made == [1, 4] and (folder.path / store.TABLE).read_bytes() == folder.table
    assert len(folder.said) == 2


def test_part_of_another_variant_or_experiment_does_not_count(folder, surena, tmp_path):
    """Of the same shape, with the same inputs, under the right name."""
    other = Folder(tmp_path / "other", experiment(surena, duration=0.03), folder.made)
    shutil.copy(other.part(0), folder.part(0))
    shutil.copy(folder.part(2), folder.part(5))  # the last chunk of each variant
    folder.run()
    assert folder.made == [0, 5] and (folder.path / store.TABLE).read_bytes() == folder.table
    assert "another experiment" in folder.said[0]


def test_any_flipped_bit_of_a_part_is_found(folder):
    dice, file = random.Random(5), folder.part(1)
    content = file.read_bytes()
    for _ in range(300):
        bad = bytearray(content)
        bad[dice.randrange(len(bad))] ^= 1 << dice.randrange(8)
        file.write_bytes(bad)
        with pytest.raises(store.DamagedError):
            store.Store(folder.path, folder.one).read(folder.one.chunks[1])
    file.write_bytes(content)
    store.Store(folder.path, folder.one).read(folder.one.chunks[1])


def test_scenarios_changed_by_hand_are_not_used(folder):
    file = folder.path / store.SCENARIOS
    pl.read_parquet(file).with_columns(friction=pl.lit(0.5)).write_parquet(file)
    with pytest.raises(
        batch.StoreError, match=r"scenarios\.parquet is not the one the experiment was begun with"
    ):
        batch.open_table(folder.path)
    folder.run()
    assert folder.made == [] and len(folder.said) == 1 and "scenarios.parquet" in folder.said[0]
    again, _ = batch.open_table(folder.path)
    assert again.resolved == folder.one.resolved
    assert file.with_name("scenarios.parquet.damaged").exists()


@pytest.mark.parametrize("damage", [cut, text, empty, foreign])
def test_broken_scenarios_are_made_again(folder, damage):
    damage(folder.path / store.SCENARIOS)
    with pytest.raises(batch.StoreError, match=r"scenarios\.parquet"):
        batch.open_table(folder.path)
    folder.run()
    assert folder.made == [] and batch.open_table(folder.path)[0].resolved == folder.one.resolved


@pytest.mark.parametrize("content", ["{", "[]", '{"experiment": 3}', "", "\0" * 20, "[" * 100_000])
def test_broken_description_is_made_again_where_the_parts_say_whose_they_are(folder, content):
    file = folder.path / store.EXPERIMENT
    described = json.loads(file.read_text())
    file.write_text(content)
    with pytest.raises(batch.StoreError, match="table: got"):
        batch.open_table(folder.path)
    folder.run()
    assert folder.made == [] and json.loads(file.read_text()) == described
    assert file.with_name("experiment.json.damaged").read_text() == content


@pytest.mark.parametrize("name", [store.EXPERIMENT, store.TABLE, store.SCENARIOS, f"{store.PARTS}/x.parquet"])
def test_folder_with_somebody_elses_files_is_refused_and_left_alone(surena, made_up, tmp_path, name):
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("mine")
    with pytest.raises(batch.StoreError, match="allowed: a folder of this experiment"):
        batch.run(experiment(surena), tmp_path, workers=1)
    assert file.read_text() == "mine" and [f for f in tmp_path.rglob("*") if f.is_file()] == [file]


def test_description_changed_by_hand_is_not_believed(folder):
    file = folder.path / store.EXPERIMENT
    described = json.loads(file.read_text())
    described["experiment"]["durations_s"]["off"] = 9.0
    file.write_text(json.dumps(described))
    with pytest.raises(batch.StoreError, match="was changed: its key"):
        batch.open_table(folder.path)
    with pytest.raises(batch.StoreError, match="another experiment"):
        folder.run()


BROKEN_KEYS = [{"key": "0" * 64}, {"key": None}, *({"format": f} for f in (1, 4, True, "new"))]


@pytest.mark.parametrize("changed", BROKEN_KEYS)
def test_description_whose_key_or_format_was_changed_is_made_again(folder, changed):
    file = folder.path / store.EXPERIMENT
    described = json.loads(file.read_text())
    file.write_text(json.dumps({**described, **changed}))
    with pytest.raises(batch.StoreError, match="table: got"):
        batch.open_table(folder.path)
    folder.run()
    assert folder.made == [] and json.loads(file.read_text()) == described and len(folder.said) == 1


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_table_is_set_aside_and_made_again(folder, damage):
    file = folder.path / store.TABLE
    damage(file)
    folder.run()
    assert folder.made == [] and file.read_bytes() == folder.table
    assert file.with_name("table.parquet.damaged").exists() and "table.parquet" in folder.said[0]


def test_plan_touches_nothing_and_names_what_is_damaged(folder, tmp_path):
    cut(folder.part(3))
    before = folder.contents()
    plan = batch.plan(folder.one, folder.path)
    assert plan.chunks_done == 5 and len(plan.damaged) == 1 and str(folder.part(3)) in plan.damaged[0]
    assert folder.contents() == before and folder.made == []
    batch.plan(folder.one, tmp_path / "new" / "deeper")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("below", ["", "deeper", "deeper/still"])
def test_plan_refuses_a_file_for_a_folder(surena, tmp_path, below):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(batch.StoreError, match="file' is a file"):
        batch.plan(experiment(surena), tmp_path / "file" / below)
    assert (tmp_path / "file").read_text() == "mine"


def test_plan_refuses_another_experiment(folder, surena):
    with pytest.raises(batch.StoreError, match="another experiment"):
        batch.plan(experiment(surena, duration=0.03), folder.path)
    assert batch.plan(experiment(surena, duration=0.03), folder.path, overwrite=True).chunks_done == 0


def test_overwriting_keeps_finished_parts_of_the_same_experiment(folder):
    batch.run(folder.one, folder.path, workers=1, overwrite=True)
    assert folder.made == []


def test_overwriting_deletes_what_a_batch_wrote_and_nothing_else(folder, surena):
    mine = [folder.path / "notes.txt", folder.path / store.PARTS / "notes.parquet"]
    for file in mine:
        file.write_text("mine")
    batch.run(experiment(surena, duration=0.03), folder.path, workers=1, overwrite=True)
    assert all(file.read_text() == "mine" for file in mine)
    assert len(folder.made) == 6 and not any(folder.part(i).exists() for i in range(6))


@pytest.mark.parametrize("umask", [0o022, 0o002, 0o077])
def test_the_umask_decides_over_permissions(surena, made_up, tmp_path, umask):
    import os

    before = os.umask(umask)
    try:
        batch.run(experiment(surena), tmp_path / "run", workers=1)
    finally:
        os.umask(before)
    files = [file for file in (tmp_path / "run").rglob("*") if file.is_file()]
    assert len(files) == 10
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o666 & ~umask}


@pytest.mark.parametrize("name", sorted(folder.name for folder in OLD.iterdir()))
def test_folders_of_version_0_1_still_open(name):
    said = []
    one, rows = batch.open_table(OLD / name, said.append)
    assert said == [] and rows.height == one.rows
    assert rows.equals(pl.read_parquet(OLD / name / store.TABLE).rename({"arm": "variant"}))
    if name in OLDEST:  # an input that came later, by default
        assert set(one.table.columns) - set(rows.columns) == {"load_end_s"}
        assert set(one.table["load_end_s"]) == {batch.NEVER}
    assert "jaxbiped." not in json.dumps(one.resolved)  # names of records, no places in the code
    for (
        controller
    ) in one.variants.values():  # walks, by a table of torques as long as that of such a plan today
        gait = controller.gait
        again = gait.replanned(one.robot, gait.params, allow_infeasible=True)
        assert gait.room == 8 and feed_forward.rows(gait) == feed_forward.rows(again)


def test_a_part_of_version_0_1_is_judged_by_its_rows(tmp_path):
    shutil.copytree(OLD / "elkahlout", tmp_path / "old")
    first, second = sorted((tmp_path / "old" / store.PARTS).iterdir())
    shutil.copy(first, second)
    said = []
    _, rows = batch.open_table(tmp_path / "old", said.append)
    assert rows["row"].to_list() == [0, 1] and len(said) == 1 and second.name in said[0]


def forge(folder: Folder, number: int, change) -> Path:
    """A part with a right checksum and other rows."""
    one, chunk = store.Store(folder.path, folder.one), folder.one.chunks[number]
    file = folder.part(number)
    rows = change(one.read(chunk))
    file.write_bytes(store.sealed(rows, {"key": one.key, **store._identity(chunk)}))
    return file


FORGERIES = {
    "null success": lambda rows: rows.with_columns(success=pl.lit(None, pl.Boolean)),
    "success as number": lambda rows: rows.with_columns(pl.col("success").cast(pl.Int64)),
    "unknown status": lambda rows: rows.with_columns(status=pl.lit("walked")),
    "no status": lambda rows: rows.drop("status"),
    "undeclared column": lambda rows: rows.with_columns(foot_temperature_K=pl.lit(300.0)),
    "inputs of another type": lambda rows: rows.with_columns(pl.col("load_kg").cast(pl.Float32)),
    "rows in another order": lambda rows: rows.reverse(),
    "rows missing": lambda rows: rows.head(3),
    "no rows": lambda rows: rows.clear(),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_part_is_not_believed_for_its_checksum_alone(folder, name):
    file = forge(folder, 1, FORGERIES[name])
    folder.run()
    assert folder.made == [1] and len(folder.said) == 1 and str(file) in folder.said[0]
    assert (folder.path / store.TABLE).read_bytes() == folder.table


@pytest.mark.parametrize("said", [{}, [], "x", None])
def test_a_part_that_does_not_say_whose_it_is(folder, said):
    rows = store.Store(folder.path, folder.one).read(folder.one.chunks[1])
    content = store._parquet(rows, {store.SEAL: json.dumps([said, {"sha256": store._NO_SUM}])})
    digest = store.hashlib.sha256(content).hexdigest()
    folder.part(1).write_bytes(content.replace(store._NO_SUM.encode(), digest.encode()))
    folder.run()
    assert folder.made == [1] and (folder.path / store.TABLE).read_bytes() == folder.table


@pytest.mark.parametrize("what", ["table", "part", "scenarios"])
@pytest.mark.parametrize("how", ["folder", "dangling link"])
def test_what_is_no_file_is_set_aside(folder, what, how):
    files = {
        "table": folder.path / store.TABLE,
        "part": folder.part(2),
        "scenarios": folder.path / store.SCENARIOS,
    }
    file = files[what]
    file.unlink()
    if how == "folder":
        (file / "mine").mkdir(parents=True)
    else:
        file.symlink_to("/nowhere/mine")
    folder.run()
    assert (folder.path / store.TABLE).read_bytes() == folder.table and len(folder.said) == 1
    aside = file.with_name(f"{file.name}.damaged")
    assert (aside / "mine").exists() if how == "folder" else aside.is_symlink()


def test_parts_that_are_a_file_are_refused_by_plan_and_run(surena, made_up, tmp_path):
    (tmp_path / store.PARTS).write_text("mine")
    for call in (batch.plan, batch.run):
        with pytest.raises(batch.StoreError, match="parts' is a file"):
            call(experiment(surena), tmp_path)
    assert (tmp_path / store.PARTS).read_text() == "mine" and made_up == []


def test_checksums_cannot_be_switched_off(folder):
    """A folder that says nothing of its format is of version 0.1; parts that carry a checksum are held to it."""
    file = folder.path / store.EXPERIMENT
    described = json.loads(file.read_text())
    del described["format"]
    file.write_text(json.dumps(described))
    rotten(folder.part(1))
    _, rows = batch.open_table(folder.path, folder.said.append)
    assert rows.height == 32 and len(folder.said) == 1


@pytest.mark.parametrize("name", ["", "a" * 300, "a\0b"])
def test_names_that_no_folder_can_have(surena, made_up, name):
    for call in (batch.plan, batch.run):
        with pytest.raises(batch.StoreError, match=r"out: got .* allowed: a folder"):
            call(experiment(surena), name)

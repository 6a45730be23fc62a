"""What commands leave on the disk: nothing is lost or replaced unasked, tables come before figures."""

import errno
import html.parser
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import polars as pl
import pytest

from jaxbiped import cli, planner, robot
from jaxbiped.commands import common, demo, tune, walk

PAYLOAD = ["payload", "--variant", "off", "--loads", "5", "10", "15", "--times", "0.3", "--workers", "1"]
OBSTACLES = [
    "obstacles",
    "--variant",
    "off",
    "--heights",
    "0.02",
    "0.05",
    "--step",
    "2",
    "--steps",
    "4",
    "--workers",
    "1",
]


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Every file below a folder, with the time of its last change; and every folder."""
    files = {str(f): (f.read_bytes(), f.stat().st_mtime_ns) for f in folder.rglob("*") if f.is_file()}
    return {**files, **{str(f): (b"", 0) for f in folder.rglob("*") if f.is_dir()}}


def refused(capsys, *args: str) -> str:
    assert cli.main([*args]) == cli.BAD_INPUT
    out, line = capsys.readouterr()
    assert out == "" and line.startswith("jaxbiped: ") and line.count("\n") == 1, line
    return line


@pytest.fixture
def finished(made_up, tmp_path, capsys) -> Path:
    """A folder with a finished table of loads, in runs/payload."""
    folder = tmp_path / "runs" / "payload"
    assert cli.main([*PAYLOAD, "--out", str(folder)]) == cli.OK
    capsys.readouterr()
    made_up.clear()
    return folder


# Nothing is replaced unasked ------------------------------------------------------------------------------------


def test_demo_into_a_folder_with_other_results_is_refused_before_anything_is_done(finished, capsys, made_up):
    before = contents(finished.parent)
    line = refused(capsys, "demo", "--out", str(finished.parent))
    assert str(finished) in line and "another experiment" in line and "overwrite it" in line
    assert contents(finished.parent) == before and made_up == []


def test_dry_run_touches_nothing_not_even_what_is_damaged(finished, capsys):
    part = next((finished / "parts").iterdir())
    part.write_bytes(part.read_bytes()[:-100])
    before = contents(finished)
    assert cli.main([*PAYLOAD, "--out", str(finished), "--dry-run"]) == cli.OK
    out, complained = capsys.readouterr()
    assert "0 done already" in out and str(part) in out and complained == ""
    assert contents(finished) == before


@pytest.mark.parametrize("args", [PAYLOAD, OBSTACLES])
def test_dry_run_looks_at_the_folder(tmp_path, capsys, args):
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        line = refused(capsys, *args, "--dry-run", "--out", str(out))
        assert f"'{out}'" in line and "is a file" in line and "allowed: a folder" in line
    assert cli.main([*args, "--dry-run", "--out", str(tmp_path / "new" / "deep")]) == cli.OK
    assert [f.name for f in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("name", ["payload_success.png", "payload_pitch.png"])
def test_somebody_elses_figure_is_not_replaced(tmp_path, capsys, made_up, name):
    (tmp_path / name).write_text("mine")
    line = refused(capsys, *PAYLOAD, "--out", str(tmp_path))
    assert name in line and "--overwrite" in line and (tmp_path / name).read_text() == "mine"
    assert made_up == [] and len(list(tmp_path.iterdir())) == 1
    assert cli.main([*PAYLOAD, "--out", str(tmp_path), "--overwrite"]) == cli.OK
    assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


def test_an_empty_folder_of_parts_does_not_make_a_figure_ours(tmp_path, capsys, made_up):
    (tmp_path / "parts").mkdir()
    (tmp_path / "payload_success.png").write_text("mine")
    assert "payload_success.png" in refused(capsys, *PAYLOAD, "--out", str(tmp_path)) and made_up == []


def test_same_command_again_goes_on_and_says_the_same(finished, capsys, made_up):
    table = (finished / "table.parquet").read_bytes()
    assert cli.main([*PAYLOAD, "--out", str(finished)]) == cli.OK
    assert made_up == [] and (finished / "table.parquet").read_bytes() == table


def test_export_replaces_no_other_file(tmp_path, capsys):
    out = tmp_path / "robot.xml"
    for _ in range(2):  # the same again is no harm
        assert cli.main(["export", "--robot", "surena3", "--out", str(out)]) == cli.OK
    capsys.readouterr()
    before = contents(tmp_path)
    line = refused(capsys, "export", "--robot", "elkahlout", "--out", str(out))
    assert "is there already" in line and "--overwrite" in line and contents(tmp_path) == before
    assert cli.main(["export", "--robot", "elkahlout", "--out", str(out), "--overwrite"]) == cli.OK
    assert 'model="elkahlout"' in out.read_text()


def test_report_replaces_its_own_page_and_no_other(finished, tmp_path, capsys):
    for _ in range(2):
        assert cli.main(["report", str(finished)]) == cli.OK
    capsys.readouterr()
    mine = tmp_path / "mine.html"
    mine.write_text("<p>mine</p>")
    line = refused(capsys, "report", str(finished), "--out", str(mine))
    assert "is there already" in line and mine.read_text() == "<p>mine</p>"
    assert cli.main(["report", str(finished), "--out", str(mine), "--overwrite"]) == cli.OK
    assert "<h2>Success</h2>" in mine.read_text()


def test_tune_replaces_no_other_variant(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tune, "set_up", None)  # would fail if it were called
    (tmp_path / "tuned.toml").write_text("mine")
    line = refused(capsys, "tune", "--out", str(tmp_path))
    assert "tuned.toml" in line and (tmp_path / "tuned.toml").read_text() == "mine"


def test_dry_run_refuses_what_the_run_refuses(tmp_path, capsys):
    (tmp_path / "payload_success.png").write_text("mine")
    assert "payload_success.png" in refused(capsys, *PAYLOAD, "--dry-run", "--out", str(tmp_path))


def test_lost_description_is_made_again_beside_its_figures(finished, capsys, made_up):
    (finished / "experiment.json").unlink()
    assert cli.main([*PAYLOAD, "--out", str(finished)]) == cli.OK
    assert made_up == [] and (finished / "experiment.json").exists()


@pytest.mark.parametrize("name", ["walk.json", "khadiv_fig6_feet.png", "walk.gif"])
def test_demo_claims_the_folder_of_its_recovery_too(tmp_path, capsys, made_up, name):
    (tmp_path / "recovery").mkdir()
    (tmp_path / "recovery" / name).write_text("mine")
    assert name in refused(capsys, "demo", "--out", str(tmp_path)) and made_up == []


def test_links_are_not_replaced_either(tmp_path, capsys):
    (tmp_path / "robot.xml").symlink_to(tmp_path / "nowhere.xml")
    line = refused(capsys, "export", "--robot", "surena3", "--out", str(tmp_path / "robot.xml"))
    assert "is there already" in line and (tmp_path / "robot.xml").is_symlink()


def test_an_variant_that_was_changed_by_hand_is_kept(tmp_path, capsys):
    file = tmp_path / "tuned.toml"
    file.write_text("mine")
    tune._keep_before(file, "other")
    assert (
        tmp_path / "tuned.toml.before"
    ).read_text() == "mine" and "tuned.toml.before" in capsys.readouterr().err
    file.write_text("other")
    tune._keep_before(file, "other")
    assert file.exists() and capsys.readouterr().err == ""


# Tables first -----------------------------------------------------------------------------------------------------


@pytest.fixture
def without_matplotlib(monkeypatch):
    real = common.importlib.util.find_spec
    monkeypatch.setattr(
        common.importlib.util, "find_spec", lambda name: None if name == "matplotlib" else real(name)
    )


@pytest.mark.parametrize(("args", "words"), [(PAYLOAD, "load [kg]"), (OBSTACLES, "+2 cm")])
def test_table_comes_without_matplotlib(tmp_path, capsys, made_up, without_matplotlib, args, words):
    assert cli.main([*args, "--out", str(tmp_path), "--json"]) == cli.OK
    out, complained = capsys.readouterr()
    assert complained == "jaxbiped: no figures were drawn: pip install 'jaxbiped[viz]'\n"
    assert words in out and pl.read_parquet(tmp_path / "table.parquet").height == len(
        json.loads(out.splitlines()[-1])["cells"]
    )
    assert not list(tmp_path.glob("*.png"))


def test_report_without_matplotlib_says_the_rates_and_what_is_missing(finished, capsys, without_matplotlib):
    assert cli.main(["report", str(finished)]) == cli.FAILED
    out, complained = capsys.readouterr()
    assert "off: 2 of 3 succeed" in out and "pip install 'jaxbiped[viz]'" in complained
    assert complained.count("\n") == 1 and not list(finished.glob("*.html"))


def test_tables_need_no_matplotlib_at_all():
    """Not even an import."""
    lines = ("import sys", "sys.modules['matplotlib'] = None", "import jaxbiped.cli")
    code = "\n".join([*lines, "from jaxbiped.report import nominal, tables"])
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_disk_that_fills_while_a_figure_is_saved_is_one_line_and_the_table_is_kept(
    finished, capsys, monkeypatch
):
    real = os.replace

    def full(a, b):
        if str(b).endswith(".png"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(a, b)

    monkeypatch.setattr(os, "replace", full)
    table = (finished / "table.parquet").read_bytes()
    assert cli.main([*PAYLOAD, "--out", str(finished)]) == cli.BAD_INPUT
    complained = capsys.readouterr().err
    assert complained.count("\n") == 1 and "No space left on device" in complained and ".png" in complained
    assert (finished / "table.parquet").read_bytes() == table and not list(finished.glob(".*.part"))


# Words ------------------------------------------------------------------------------------------------------------


def test_walks_that_fail_are_told_with_the_command_that_shows_one(made_up, tmp_path, capsys):
    folder = tmp_path / "my runs"
    assert cli.main([*PAYLOAD, "--out", str(folder)]) == cli.OK
    out = capsys.readouterr().out
    assert "2 walks fail (rows 1, 2)" in out and f"jaxbiped replay '{folder}' 1" in out
    assert "off: 2 of 3 succeed" in out and "1 of them falls after that" in out


def test_damage_is_told_set_aside_and_made_again(finished, capsys, made_up):
    part = next((finished / "parts").iterdir())
    part.write_bytes(b"hello")
    assert cli.main([*PAYLOAD, "--out", str(finished)]) == cli.OK
    complained = capsys.readouterr().err
    assert complained.count("\n") == 1 and str(part) in complained and ".damaged" in complained
    assert made_up == [0]


class Rows(html.parser.HTMLParser):
    """Text of every cell of a page."""

    def __init__(self):
        super().__init__()
        self.cells = []

    def handle_data(self, data):
        self.cells.append(data.strip())


def test_report_lists_walks_that_fell_after_their_success(finished, capsys):
    assert cli.main(["report", str(finished)]) == cli.OK
    page = Rows()
    page.feed((finished / "report.html").read_text(encoding="utf-8"))
    for row in (1, 2):
        assert f"jaxbiped replay {finished} {row}" in page.cells
    assert f"jaxbiped replay {finished} 0" not in page.cells


@pytest.mark.parametrize(
    ("batch", "workers", "lanes", "used"), [("65536", "1000", 33, 1), ("8", "1000", 8, 5), ("16", "2", 16, 2)]
)
def test_never_more_lanes_than_scenarios_nor_workers_than_chunks(
    capsys, tmp_path, batch, workers, lanes, used
):
    heights = [f"{0.001 * i:g}" for i in range(-16, 17)]
    args = [
        "obstacles",
        "--dry-run",
        "--variant",
        "off",
        "--batch",
        batch,
        "--workers",
        workers,
        "--heights",
        *heights,
    ]
    assert cli.main([*args, "--out", str(tmp_path / "x"), "--json"]) == cli.OK
    out = capsys.readouterr().out
    plan = json.loads(out.splitlines()[-1])["plan"]
    assert (plan["lanes"], plan["workers"]) == (lanes, used)
    assert f"{used} worker{'s' if used > 1 else ''} of" in out and " about 0.0 min" not in out


@pytest.mark.parametrize(
    ("what", "meant"),
    [
        ("payload.setling_time", "payload.settling_time"),
        ("landing.T_mood", "landing.T_mod"),
        ("gait.b_ss", "gait.b_s"),
        ("payloads", "payload"),
    ],
)
def test_misspelt_names_to_tune_are_refused_before_any_work(capsys, monkeypatch, tmp_path, what, meant):
    monkeypatch.setattr(tune, "set_up", None)  # would fail if it were called
    line = refused(capsys, "tune", "--what", what, "--out", str(tmp_path / "x"))
    assert f"'{what}'" in line and f"did you mean '{meant}'?" in line and not (tmp_path / "x").exists()


TUNE = [
    (("--scenarios", "1"), "--scenarios: got 1"),
    (("--steps", "0"), "--steps: got 0"),
    (("--duration", "inf"), "--duration: got inf s"),
    (("--duration", "-1"), "--duration: got -1 s"),
    (("--seed", "-1"), "--seed: got -1"),
    (("--variant", "modifed"), "did you mean 'modified'?"),
    (("--what", "payload", "payload"), "each once"),
]


@pytest.mark.parametrize(("args", "says"), TUNE)
def test_bad_tuning_is_refused_before_any_work(capsys, monkeypatch, tmp_path, args, says):
    monkeypatch.setattr(tune, "set_up", None)
    assert says in refused(capsys, "tune", *args, "--out", str(tmp_path / "x"))
    assert not (tmp_path / "x").exists()


def test_missing_optax_is_said_before_any_work(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(tune, "set_up", None)
    monkeypatch.setattr(tune.importlib.util, "find_spec", lambda name: None)
    assert cli.main(["tune", "--out", str(tmp_path / "x")]) == cli.FAILED
    assert capsys.readouterr().err == "jaxbiped: tuning needs optax: pip install 'jaxbiped[tune]'\n"


def test_version(capsys):
    assert cli.main(["--version"]) == cli.OK
    assert capsys.readouterr().out == "jaxbiped 0.1.0\n"


MEANT = [
    (("dmeo",), "did you mean 'demo'?"),
    (("WALK",), "did you mean 'walk'?"),
    (("payload", "--OUT", "x"), "did you mean '--out'?"),
    (("payload", "--dry-run", "--variant", "modifed"), "did you mean 'modified'?"),
    (("--versoin",), "did you mean '--version'?"),
    (("payload", "--workrs", "3"), "did you mean '--workers'?"),
    (("payload", "--dry_rum"), "did you mean '--dry-run'?"),
    (("walk", "--robot", "surena3", "--obstacel", "3:0.02"), "did you mean '--obstacle'?"),
    (("report", "x", "--ouput", "y"), "did you mean '--out'?"),
]


@pytest.mark.parametrize(("args", "says"), MEANT)
def test_the_nearest_name_is_offered(capsys, args, says):
    line = refused(capsys, *args)
    assert says in line and "allowed: " in line and ";;" not in line and not set("─│╭") & set(line)


WRONG = [
    (("payload", "--loads", "5", "--loads", "10"), "--loads: got it twice, allowed: once"),
    (("payload", "--out", ""), "payload: got an empty argument ('')"),
    (("payload", "--gait="), "payload: got an empty argument (--gait=)"),
    (("payload", "--dry-run", "--steps", "0"), "--steps: got 0, allowed: 1 to 200"),
    (("payload", "--dry-run", "--out", "a" * 300), "--out: got 'aaa"),
    (("replay", "a" * 300, "0"), "--out: got 'aaa"),
    (("report", "a" * 300), "table: got 'aaa"),
    (("export", "--robot", "surena3", "--out", "a" * 300 + ".xml"), "--out: got 'aaa"),
    (("demo", "--out"), "--out: got no value, allowed"),
    (("walk", "--robot", "surena3", "--steps", "two"), "--steps: got 'two', allowed: a whole number"),
    (("payload", "--loads", "five"), "--loads: got 'five', allowed: a number"),
    (("replay", "x", "one"), "ROW: got 'one', allowed: a whole number"),
    (("export", "--robot", "surena3"), "--out: missing, required by 'export'"),
    (("replay", "x"), "ROW: missing, required by 'replay'"),
    (("demo", "extra"), "demo: got 'extra' beyond its arguments"),
]


@pytest.mark.parametrize(("args", "says"), WRONG)
def test_complaints_say_what_was_got_and_what_is_allowed(capsys, args, says):
    assert refused(capsys, *args).startswith(f"jaxbiped: {says}")


def test_walk_claims_its_folder(tmp_path):
    """Its own numbers again are no harm; those of another walk, or a figure of somebody else, are."""
    (tmp_path / walk.NUMBERS).write_text(json.dumps({"key": "a"}))
    common.require_free(tmp_path, [walk.NUMBERS], common.key_in(tmp_path / walk.NUMBERS) == "a", False)
    with pytest.raises(common.InputError, match=r"holds walk\.json of something else"):
        common.require_free(tmp_path, [walk.NUMBERS], common.key_in(tmp_path / walk.NUMBERS) == "b", False)
    for broken in ("", "{", "[]", "[" * 100_000):
        (tmp_path / walk.NUMBERS).write_text(broken)
        assert common.key_in(tmp_path / walk.NUMBERS) is None


class Names(ModuleType):
    """Figures that are not drawn."""

    def __getattr__(self, name):
        return lambda *given, **named: name


def test_demo_claims_every_figure_it_draws():
    params = {name: robot.load(name) for name in robot.presets()}
    gaits = {
        "surena3": planner.PolynomialGait.preset(params["surena3"], demo.N_STEPS),
        "elkahlout": planner.CosineGait.preset(params["elkahlout"], demo.N_STEPS),
    }
    plans = {name: demo.plan_of(params[name], gait) for name, gait in gaits.items()}
    walked = SimpleNamespace(trace=SimpleNamespace(time=np.array([0.0, 1.0])))
    simulated = {"landing adaptation": walked, "no adaptation": walked}
    assert set(demo._draw(Names("names"), plans, simulated)) == set(demo.FIGURES)


def test_folder_below_a_broken_link_is_refused(tmp_path, capsys):
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    assert "link" in refused(capsys, *PAYLOAD, "--dry-run", "--out", str(tmp_path / "link"))


def test_finished_results_stay_usable_where_the_folder_is_copied(finished, tmp_path, capsys, made_up):
    shutil.copytree(finished, tmp_path / "copy")
    assert cli.main([*PAYLOAD, "--out", str(tmp_path / "copy")]) == cli.OK
    assert made_up == []


def console(*args: str, **how) -> subprocess.CompletedProcess:
    command = [Path(sys.executable).with_name("jaxbiped"), *args]
    return subprocess.run(command, stderr=subprocess.PIPE, text=True, **how)


def test_output_that_cannot_be_written_is_one_line(tmp_path):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    with open("/dev/full", "w") as full:
        done = console("export", "--robot", "surena3", "--out", str(tmp_path / "x.xml"), stdout=full)
    assert done.returncode == cli.FAILED and (tmp_path / "x.xml").exists()
    assert done.stderr == "jaxbiped: output: No space left on device\n"


def test_signs_that_a_terminal_does_not_know_stop_nothing(made_up, tmp_path, monkeypatch):
    import io

    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    assert cli.main([*PAYLOAD, "--out", str(tmp_path)]) == cli.OK
    out.flush()
    assert b"load [kg]" in out.buffer.getvalue() and b"?" in out.buffer.getvalue()

"""The console command, run in process: what it writes, what it says, and how it refuses."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from jaxbiped import cli, planner, robot, runtime
from jaxbiped.commands import demo


@pytest.mark.parametrize(
    ("name", "gait"), [("surena3", planner.PolynomialGait), ("elkahlout", planner.CosineGait)]
)
def test_demo_says_how_feasible_both_plans_are(name, gait):
    params = robot.load(name)
    walk = demo.summary_of(demo.plan_of(params, gait.preset(params, demo.N_STEPS)))
    assert walk["robot"] == name
    assert walk["in_reach"]
    assert walk["zmp_margin_min_m"] > (0.07 if name == "surena3" else -0.034)
    assert 0.0 < walk["friction_max"] < 0.3
    assert 0.0 < walk["torque_share_max"] < 1.0
    assert 0.0 < walk["speed_share_max"] < 1.0
    assert walk["knee_bend_min_rad"] > 0.2
    assert f"{1e3 * walk['zmp_margin_min_m']:.1f} mm" in demo.in_words(walk)


@pytest.mark.parametrize("name", robot.presets())
def test_export_writes_a_model_that_mujoco_loads(name, tmp_path, capsys):
    out = tmp_path / "models" / "robot.xml"
    assert cli.main(["export", "--robot", name, "--out", str(out), "--json"]) == cli.OK
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result == {
        "robot": name,
        "mass_kg": pytest.approx(float(robot.load(name).total_mass), abs=1e-3),
        "file": str(out),
    }
    model = mujoco.MjModel.from_xml_path(str(out))
    assert (model.nv, model.nu) == (18, 12)
    assert sum(model.body_mass) == pytest.approx(result["mass_kg"], abs=1e-3)


def test_export_takes_a_robot_file(tmp_path):
    preset = Path(robot.__file__).parent / "presets" / "surena3.toml"
    mine = tmp_path / "mine.toml"
    mine.write_text(preset.read_text(encoding="utf-8").replace('name = "surena3"', 'name = "mine"'))
    assert cli.main(["export", "--robot", str(mine), "--out", str(tmp_path / "mine.xml")]) == cli.OK
    assert "mine" in (tmp_path / "mine.xml").read_text(encoding="utf-8")


def refused(capsys, *args: str) -> str:
    """Run with bad input; returns the one line on stderr."""
    assert cli.main([*args]) == cli.BAD_INPUT
    said, complained = capsys.readouterr()
    assert said == ""
    assert complained.endswith("\n") and complained.count("\n") == 1, complained
    assert not set("╭╮╰╯│─") & set(complained)
    return complained


@pytest.fixture
def a_file(tmp_path) -> Path:
    file = tmp_path / "a_file"
    file.touch()
    return file


def test_unknown_robot_is_refused(capsys, tmp_path):
    line = refused(capsys, "export", "--robot", "surena4", "--out", str(tmp_path / "x.xml"))
    assert "--robot" in line and "'surena4'" in line and "elkahlout, surena3" in line and ".toml" in line
    assert not (tmp_path / "x.xml").exists()


def test_broken_robot_file_is_refused_with_the_field(capsys, tmp_path):
    preset = Path(robot.__file__).parent / "presets" / "surena3.toml"
    broken = tmp_path / "broken.toml"
    text = preset.read_text(encoding="utf-8")
    broken.write_text(text.replace("thigh_length = { value = 0.360", "thigh_length = { value = -0.360"))
    line = refused(capsys, "export", "--robot", str(broken), "--out", str(tmp_path / "x.xml"))
    assert (
        "--robot" in line
        and "geometry.thigh_length" in line
        and "got -0.36 m, allowed: >= 0.02 and <= 2 m" in line
    )


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"name = ", b""])
def test_robot_file_that_is_no_toml_is_refused(capsys, tmp_path, content):
    broken = tmp_path / "broken.toml"
    broken.write_bytes(content)
    line = refused(capsys, "export", "--robot", str(broken), "--out", str(tmp_path / "x.xml"))
    assert "--robot" in line and "broken.toml" in line


@pytest.mark.parametrize("below", ["", "folder", "folder/deeper"])
def test_demo_into_a_file_or_below_one_is_refused(capsys, a_file, below):
    out = a_file / below
    line = refused(capsys, "demo", "--out", str(out))
    assert "--out" in line and f"'{out}'" in line and "allowed: a folder" in line


def test_export_below_a_file_is_refused(capsys, a_file):
    out = a_file / "robot.xml"
    line = refused(capsys, "export", "--robot", "surena3", "--out", str(out))
    assert "--out" in line and f"'{out}'" in line and "allowed: a file" in line


@pytest.mark.parametrize("name", ["robot", "robot.txt", "folder.xml"])
def test_export_to_something_else_than_an_xml_file_is_refused(capsys, tmp_path, name):
    (tmp_path / "folder.xml").mkdir()
    line = refused(capsys, "export", "--robot", "surena3", "--out", str(tmp_path / name))
    assert "--out" in line and name in line and ".xml" in line


def test_folder_without_write_permission_is_refused(capsys, tmp_path):
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    if os.access(folder, os.W_OK):
        pytest.skip("this user may write anywhere")
    for out in (folder, folder / "deeper"):
        assert f"'{out}'" in refused(capsys, "demo", "--out", str(out))


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ((), ("demo", "walk", "export")),
        (("dance",), ("dance", "demo", "export", "walk")),
        (("demo", "--speed", "3"), ("--speed",)),
        (("demo", "--out"), ("--out",)),
        (("export", "--robot", "surena3"), ("--out", "required")),
        (("walk",), ("--robot", "required")),
        (("walk", "--robot", "surena3", "--steps", "two"), ("--steps", "two")),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(capsys, args, says):
    line = refused(capsys, *args)
    assert all(word in line for word in says), line


@pytest.mark.parametrize("args", [("--help",), ("demo", "--help"), ("walk", "--help"), ("export", "--help")])
def test_help_is_no_error(capsys, args):
    assert cli.main([*args]) == cli.OK
    said, complained = capsys.readouterr()
    assert "usage: jaxbiped" in said and complained == ""


def test_cache_stays_where_the_user_put_it():
    before = jax.config.values["jax_compilation_cache_dir"]
    assert before is not None
    runtime.keep_compiled_kernels()
    assert jax.config.values["jax_compilation_cache_dir"] == before


def test_installed_command_gives_the_exit_code():
    command = Path(sys.executable).with_name("jaxbiped")
    done = subprocess.run([command, "export", "--robot", "nobody", "--out", "x.xml"], capture_output=True)
    assert done.returncode == cli.BAD_INPUT and b"'nobody'" in done.stderr


def test_drawn_cycle_is_one_of_the_thesis():
    """It runs over the thesis' time, 0 to 2 (t_ss + t_ds), and closes in the body frame."""
    gait = planner.CosineGait.preset(robot.load("elkahlout"), demo.N_STEPS)
    time, targets = demo._cycle(gait)
    assert time[0] == 0.0 and time[-1] == pytest.approx(4.8)
    in_body = targets.position.sole - targets.position.pelvis[:, None]
    np.testing.assert_allclose(in_body[0], in_body[-1], atol=1e-6)
    np.testing.assert_allclose(in_body[0], [[-0.17, 0.11, -0.5], [-0.01, -0.11, -0.5]], atol=1e-6)

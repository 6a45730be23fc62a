"""`jaxbiped walk`: what it simulates, says and draws, and how it refuses."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxbiped import batch, cli, planner, robot, score, sim
from jaxbiped.adapt import tunables
from jaxbiped.commands import choices, obstacles, payload, tune, walk, walk_words
from jaxbiped.commands.common import InputError
from jaxbiped.commands.walk_input import Load, Obstacle, Setup, Variants, set_up

ANY_WALK = {"khadiv_fig6_feet", "khadiv_fig7_pelvis", "khadiv_fig8_9_zmp", "khadiv_fig12_13_forces_and_tilt"}
LANDING = {"khadiv_fig11_modifications"}
PAYLOAD = {"elkahlout_fig4_3_references", "elkahlout_fig4_4_pitch"}
REFLEX = {
    "elkahlout_fig3_3_force_and_trigger",
    "elkahlout_fig3_5_3_7_3_8_close_ups",
    "elkahlout_fig4_12_settling_zmp",
}


def made(
    robot: str = "elkahlout", steps: int = 6, gait: str | None = None, obstacles="", payload="", variants=""
) -> Setup:
    return set_up(robot, steps, gait, obstacles.split(), payload.split(), variants.split())


# Settings


def test_own_gait_and_settings_of_each_robot():
    thesis, surena, crossed = made(), made("surena3"), made(gait="polynomial")
    assert [one.gait_name for one in (thesis, surena, crossed)] == ["cosine", "polynomial", "polynomial"]
    assert thesis.options == sim.Options(
        control_every=1, feed_forward=False, payload_model="thesis", trace_every=4
    )
    assert surena.options == crossed.options == sim.Options(control_every=4, trace_every=1)
    assert made("surena3", gait="cosine").options == surena.options


@pytest.mark.parametrize(
    ("obstacles", "payload", "variants", "expected"),
    [
        ("", "", "", Variants("off", "off")),
        ("2:0.02", "", "", Variants("repaired", "off")),
        ("", "10@2.4", "", Variants("off", "modified")),
        ("2:0.02", "10@2.4", "", Variants("repaired", "modified")),
        ("2:0.02", "10@2.4", "off", Variants("off", "off")),
        ("2:0.02", "10@2.4", "paper", Variants("paper", "off")),
        ("", "", "repaired", Variants("repaired", "repaired")),
        ("", "10@2.4", "original", Variants("off", "original")),
        ("2:0.02", "10@2.4", "repaired original", Variants("repaired", "original")),
        ("2:0.02", "10@2.4", "paper repaired", Variants("paper", "repaired")),
        ("2:0.02", "10@2.4", "modified paper", Variants("paper", "modified")),
    ],
)
def test_variants(obstacles, payload, variants, expected):
    setup = made(obstacles=obstacles, payload=payload, variants=variants)
    assert setup.variants == expected
    landing, reflex = setup.controller.stage("landing"), setup.controller.stage("payload")
    assert (landing is None) == (expected.landing == "off")
    assert (reflex is None) == (expected.reflex == "off")
    if landing is not None:
        assert landing.params.smooth_descent == (expected.landing == "repaired")
    if reflex is not None:
        assert reflex.params.smooth_reflex == (expected.reflex == "repaired")
        assert float(reflex.params.settling_time) == (2.0 if expected.reflex == "original" else 4.0)


def test_the_file_of_an_variant_brings_its_own_gait(tmp_path):
    file = tmp_path / "tuned.toml"
    file.write_text(
        "[payload]\nbase = 'modified'\nreflex_time = 0.3\n[gait]\nb_s = 0.09\n"
        "allow_infeasible = true\n[origin]\nsteps = 3\n"
    )
    setup = made(payload="10@2.4", variants=str(file))
    assert setup.variants == Variants("off", str(file)) and setup.controller.stage("landing") is None
    reflex = setup.controller.stage("payload")
    assert reflex is not None and float(reflex.params.reflex_time) == pytest.approx(0.3)
    assert setup.gait is setup.controller.gait
    assert float(setup.gait.params.b_s) == pytest.approx(0.09) != float(made().gait.params.b_s)


def test_a_plan_that_breaks_a_constraint_is_told_with_the_reason_where_it_is_known():
    (words,) = choices.broken(made().robot, made().gait)
    assert re.match(
        r"got a ZMP 0\.\d+ m outside the support polygon at t = .* on robot 'elkahlout', allowed", words
    )
    assert "; known of this preset: these are the thesis' own numbers" in words
    other = tunables.other_gait(made().robot, made().gait, {"b_s": 0.09}, allow_infeasible=True)
    (words,) = choices.broken(made().robot, other)
    assert "outside the support polygon" in words and "known" not in words
    assert choices.broken(made("surena3").robot, made("surena3").gait) == []


def short_soled(folder: Path) -> str:
    """surena3 on soles too short for its gait."""
    preset = Path(robot.__file__).parent / "presets" / "surena3.toml"
    text = preset.read_text(encoding="utf-8")
    for name, value in (("toe", 0.1325), ("heel", -0.1325)):
        text = text.replace(
            f"sole_{name} = {{ value = {value}", f"sole_{name} = {{ value = {value / 10.0:.4f}"
        )
    file = folder / "short_soled.toml"
    file.write_text(text.replace('name = "surena3"', 'name = "short_soled"', 1), encoding="utf-8")
    return str(file)


@pytest.mark.parametrize("command", [walk, obstacles, payload, tune], ids=lambda c: c.__name__.split(".")[-1])
def test_a_preset_that_does_not_fit_the_robot_is_refused_unless_that_is_allowed(tmp_path, command):
    file = short_soled(tmp_path)

    def gait(allowed: bool) -> Any:
        if command is walk:
            return set_up(file, 2, None, [], [], [], allowed).gait
        given = {
            "robot": file,
            "allow_infeasible": allowed,
            "variant": "repaired" if command is tune else ("off",),
        }
        if command is obstacles:
            given |= {"steps": 2, "heights": (0.0,), "step": (1,)}
        if command is payload:
            given |= {"steps": 2, "loads": (1.0,), "times": (0.5,)}
        if command is tune:
            given |= {"what": ("landing.T_mod",), "scenarios": 2}
        one = getattr(command, command.__name__.split(".")[-1].capitalize())(**given)
        found = command.set_up(one)
        made: Any = (
            found.variants if command is obstacles else found[0].variants if command is payload else None
        )
        return found[0].controller.gait if made is None else made["off"].gait

    with pytest.raises(InputError, match=r"^--robot, --gait: gait: got a ZMP .*; or say --allow-infeasible$"):
        gait(False)
    assert type(gait(True)) is planner.PolynomialGait


def test_obstacles_and_payload_are_in_the_scenario():
    setup = made("surena3", obstacles="1:0.03 4:-0.02", payload="7.5@3")
    assert setup.obstacles == [Obstacle(1, 0.03), Obstacle(4, -0.02)]
    assert setup.load == Load(7.5, 3.0)
    np.testing.assert_allclose(setup.scenario.terrain.height[:3], [0.03, -0.02, 0.0])
    assert (float(setup.scenario.payload.mass), float(setup.scenario.payload.time)) == (7.5, 3.0)
    many = made("surena3", steps=20, obstacles=" ".join(f"{k}:0.01" for k in range(2, 19, 2)))
    assert np.count_nonzero(many.scenario.terrain.height) == 9


def test_simulated_time_is_long_enough_for_walk_and_recovery():
    assert made().duration == pytest.approx(16.8 + 0.5)
    assert made(payload="10@2.4", variants="off").duration == pytest.approx(16.8 + 0.5)
    original, modified = (made(payload="10@2.4", variants=variant) for variant in ("original", "modified"))
    assert modified.duration - original.duration == pytest.approx(3.0)
    longest = (
        0.1 + 4.0 + 0.5 + (1.4 + 1.2 * 1.4) + 2.0 + 0.5 * 1.0
    )  # reflex to going on, repaired, and its lag
    assert modified.duration > 16.8 + longest + 0.4


# Refusals

REFUSED = [
    (["--robot", "surena3", "--obstacle", "0:0.03"], ("--obstacle", "under the left foot", "level ground")),
    (["--robot", "surena3", "--obstacle", "0:-0.02"], ("--obstacle", "a hole", "under the left foot")),
    (["--robot", "surena4"], ("--robot", "'surena4'", "elkahlout, surena3")),
    (["--gait", "trot"], ("--gait", "'trot'", "cosine, polynomial")),
    (["--steps", "0"], ("--steps", "0", "1 to 200")),
    (["--steps", "-3"], ("--steps", "-3", "1 to 200")),
    (["--steps", "201"], ("--steps", "201", "1 to 200")),
    (["--steps", "2.5"], ("--steps", "2.5")),
    (["--obstacle", "3"], ("--obstacle", "'3'", "STEP:HEIGHT")),
    (["--obstacle", "3:0.02:1"], ("--obstacle", "'3:0.02:1'", "STEP:HEIGHT")),
    (["--obstacle", "x:0.02"], ("--obstacle", "'x:0.02'", "STEP:HEIGHT")),
    (["--obstacle", "1.5:0.02"], ("--obstacle", "'1.5:0.02'", "STEP:HEIGHT")),
    (["--obstacle", "3:high"], ("--obstacle", "'3:high'", "STEP:HEIGHT")),
    (["--obstacle", "3:nan"], ("--obstacle", "'3:nan'", "finite")),
    (["--obstacle", "3:-inf"], ("--obstacle", "'3:-inf'", "finite")),
    (["--obstacle", "8:0.02"], ("--obstacle", "step 8", "0 to 7")),
    (["--obstacle", "-1:0.02"], ("--obstacle", "-1")),
    (["--obstacle", "3:0.1"], ("--obstacle", "0.1 m", "below 0.1 m")),
    (["--obstacle", "3:-0.3"], ("--obstacle", "-0.3 m", "-0.2 m")),
    (["--obstacle", "3:0.02", "3:0.03"], ("--obstacle", "step 3 twice")),
    (["--obstacle", "3:0.02", "--obstacle", "3:0.03"], ("--obstacle", "step 3 twice")),
    (["--payload", "5"], ("--payload", "'5'", "MASS@TIME")),
    (["--payload", "5@2@3"], ("--payload", "'5@2@3'", "MASS@TIME")),
    (["--payload", "heavy@2"], ("--payload", "'heavy@2'", "MASS@TIME")),
    (["--payload", "5@"], ("--payload", "'5@'", "MASS@TIME")),
    (["--payload", "inf@2"], ("--payload", "'inf@2'", "finite")),
    (["--payload=-5@2"], ("--payload", "-5 kg", "> 0")),
    (["--payload", "0@2"], ("--payload", "0 kg", "> 0")),
    (["--payload", "100@2"], ("--payload", "100 kg", "82 kg")),
    (["--payload", "5@-1"], ("--payload", "-1 s", "0 to 16.8 s")),
    (["--payload", "5@17"], ("--payload", "17 s", "0 to 16.8 s")),
    (["--payload", "5@2", "10@3"], ("--payload", "2 (5@2, 10@3)", "one")),
    (["--payload", "5@2", "--payload", "10@3"], ("--payload", "2 (5@2, 10@3)", "one")),
    (["--variant", "best"], ("--variant", "'best'", "off, paper, repaired, original, modified, two_speed")),
    (["--variant", "nowhere.toml"], ("--variant", "nowhere.toml")),
    (["--variant", "off", "tuned.toml"], ("--variant", "off tuned.toml", "by itself")),
    (["--variant", "off", "paper"], ("--variant", "off paper", "one for each stage")),
    (["--variant", "original", "modified"], ("--variant", "original modified")),
    (["--variant", "paper", "paper"], ("--variant", "paper paper")),
    (["--variant", "paper", "original", "repaired"], ("--variant", "paper original repaired")),
    (["--variant"], ("--variant", "no value")),
    (["--obstacle"], ("--obstacle", "no value")),
    (["--payload"], ("--payload", "no value")),
]


@pytest.mark.parametrize(("args", "says"), REFUSED, ids=[" ".join(args) for args, _ in REFUSED])
def test_bad_input_is_refused_in_one_line(capsys, tmp_path, args, says):
    robot = [] if "--robot" in args else ["--robot", "surena3"]
    assert cli.main(["walk", *robot, "--out", str(tmp_path / "out"), *args]) == cli.BAD_INPUT
    said, complained = capsys.readouterr()
    assert said == ""
    assert complained.count("\n") == 1 and complained.startswith("jaxbiped: ")
    assert all(word in complained for word in says), complained
    assert not (tmp_path / "out").exists()


def test_pads_that_overlap_are_refused():
    """Two steps of a cosine gait are shorter than a pad is long."""
    with pytest.raises(InputError, match=r"--obstacle: got pads under steps 2 and 4 that overlap"):
        made("surena3", gait="cosine", obstacles="4:0.01 2:0.02")
    made(obstacles="1:0.01 2:0.02 5:-0.01")


def test_obstacle_as_high_as_the_swing_foot_is_refused():
    with pytest.raises(InputError, match=r"height 0\.03 m .* below 0\.03 m"):
        made(obstacles="2:0.03")


def test_a_renamed_copy_of_a_preset_walks_like_it(tmp_path):
    mine = renamed(tmp_path, "elkahlout", "my robot")
    copy, preset = made(str(mine)), made()
    assert (copy.robot.name, copy.gait_name, copy.options) == ("my robot", preset.gait_name, preset.options)
    assert not copy.options.feed_forward and copy.options.control_every == 1


def test_robot_without_a_preset_gait_is_refused(tmp_path):
    mine = renamed(tmp_path, "surena3", "mine")
    text = mine.read_text(encoding="utf-8")
    mine.write_text(text.replace('walks_like = "surena3"\n', ""))
    with pytest.raises(
        InputError, match="'mine', allowed: elkahlout, surena3; otherwise add walks_like = 'elkahlout'"
    ):
        made(str(mine))
    mine.write_text(text.replace('walks_like = "surena3"', 'walks_like = "surena"'))
    with pytest.raises(InputError, match=r"walks_like: got 'surena', .*; did you mean 'surena3'\?"):
        made(str(mine))


def renamed(folder: Path, preset: str, name: str) -> Path:
    """A copy of a preset's file with another name in it."""
    file = Path(walk.__file__).parents[1] / "robot" / "presets" / f"{preset}.toml"
    mine = folder / "mine.toml"
    mine.write_text(file.read_text(encoding="utf-8").replace(f'name = "{preset}"', f'name = "{name}"', 1))
    return mine


def test_out_below_a_file_is_refused(capsys, tmp_path):
    (tmp_path / "file").touch()
    out = tmp_path / "file" / "out"
    assert cli.main(["walk", "--robot", "surena3", "--out", str(out)]) == cli.BAD_INPUT
    assert f"--out: got '{out}'" in capsys.readouterr().err


# Words

REFLEX_TOLD = {
    "triggered_s": 2.43,
    "reflex_end_s": 2.53,
    "settled_s": 6.53,
    "shifted_s": 7.03,
    "recovered_s": None,
    "resumed_s": None,
    "x_shift_m": 0.0245,
}


def load_told(time, end=None):
    return {"payload": {"mass_kg": 10.0, "time_s": time, "end_s": end, "thesis_time_s": time - 1.2}}


TOLD = {
    "robot": "elkahlout",
    "gait": "cosine",
    "steps": 6,
    "planned_s": 16.8,
    "constraints_broken": [],
    "variant": {"landing": "off", "reflex": "modified"},
    "obstacles": [{"step": 2, "height_m": -0.02}],
    "payload": {"mass_kg": 10.0, "time_s": 2.4, "thesis_time_s": 1.2},
    "thesis_time_starts_s": 1.2,
    "status": "ok",
    "success": True,
    "end_time_s": 29.4,
    "peak_roll_deg": 1.0,
    "peak_pitch_deg": 2.0,
    "peak_foot_force_N": 900.0,
    "peak_slip_m": 0.003,
    "had_to_stand_until_s": 15.1,
    "tilt_margin_deg": 43.0,
    "out_of_reach_s": 0.0,
    "steps_without_touch": 0,
    "touches": [],
    "reflexes": [REFLEX_TOLD],
}


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({}, "success: two whole steps after load and recovery, at 15.10 s"),
        ({"payload": None}, "success: the walk is finished, at 15.10 s"),
        ({"success": False, "status": "fell"}, "failure: fell at 29.40 s, had to stand until 15.10 s"),
        (
            {"success": False, "status": "fell", "had_to_stand_until_s": None},
            "failure: fell at 29.40 s, before it walked on",
        ),
        ({"success": False, "status": "unfinished"}, "unfinished: still in reflex 1"),
        (
            {"success": False, "status": "unfinished", "reflexes": []},
            "unfinished: the walk had no two whole steps",
        ),
        ({"reflexes": []}, "no reflex: the load was not felt"),
        (
            {},
            "reflex 1 at 2.430 s (thesis 1.230 s): both feet down 2.530, settled 6.530, x_ref shifted 7.030;",
        ),
        ({}, "x_ref moved by +24.5 mm"),
        ({"constraints_broken": ["got a ZMP"]}, "the plan breaks a constraint: got a ZMP"),
        ({}, "-2 cm under step 2; 10 kg at 2.400 s (thesis 1.200 s)"),
        (load_told(2.4, 5.0), "10 kg at 2.400 s (thesis 1.200 s), taken off at 5.000 s (thesis 3.800 s)"),
        (load_told(0.0), "10 kg carried from the start; landing"),
        (load_told(0.0), "success: the walk is finished, at 15.10 s"),
        (load_told(0.0, 5.0), "10 kg carried from the start, taken off at 5.000 s"),
        ({**load_told(0.0, 5.0), "reflexes": []}, "no reflex: the load was not felt"),
        (load_told(0.0, 5.0), "success: two whole steps after load and recovery"),
        (
            {**load_told(0.0), "success": False, "status": "unfinished", "reflexes": []},
            "unfinished: the simulation ended before the walk",
        ),
        (
            {"steps_without_touch": 2, "out_of_reach_s": 0.5},
            "2 steps without a touch, targets out of reach for 0.50 s",
        ),
    ],
)
def test_words(changed, says):
    lines = walk_words.lines({**TOLD, **changed})
    assert any(says in line for line in lines), lines


# Walks


def walked(capsys, out: Path, *args: str) -> tuple[list[str], dict]:
    assert cli.main(["walk", *args, "--out", str(out), "--json"]) == cli.OK
    said, complained = capsys.readouterr()
    assert complained == ""
    *lines, last = said.splitlines()
    result = json.loads(last)
    numbers = out / walk.NUMBERS
    figures = {Path(file) for file in result["files"]}
    assert {*figures, numbers, out / walk.EXPERIMENT} == set(out.iterdir())
    one = batch.read_experiment(out / walk.EXPERIMENT)
    assert one.rows == 1 and one.durations == pytest.approx({next(iter(one.variants)): result["simulated_s"]})
    assert {file.stem for file in figures} <= set(walk.FIGURES)
    written = json.loads(numbers.read_text())
    assert written.pop("key") and written == {k: v for k, v in result.items() if k != "files"}
    for file in figures:
        assert file.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and file.stat().st_size > 10_000
    return lines, result


def names(result: dict) -> set[str]:
    return {Path(file).stem for file in result["files"]}


def test_surena3_over_an_obstacle(capsys, tmp_path):
    lines, result = walked(
        capsys, tmp_path / "a" / "b", "--robot", "surena3", "--steps", "3", "--obstacle", "1:0.02"
    )
    assert names(result) == ANY_WALK | LANDING
    assert (result["status"], result["success"], result["finished"]) == ("ok", True, True)
    assert result["variant"] == {"landing": "repaired", "reflex": "off"}
    assert result["obstacles"] == [{"step": 1, "height_m": 0.02}] and result["payload"] is None
    assert result["had_to_stand_until_s"] == pytest.approx(result["planned_s"])
    assert result["end_time_s"] == pytest.approx(result["planned_s"] + 0.5)
    assert 43.0 < result["tilt_margin_deg"] < 45.0
    first, on, off = result["touches"]
    assert [(t["step"], t["foot"], t["landing"]) for t in (first, on, off)] == [
        (0, "left", "advance"),
        (1, "right", "advance"),
        (2, "left", "retard"),
    ]
    assert abs(first["late_s"]) < 0.02 and -0.2 < on["late_s"] < -0.05 and off["late_s"] > 0.1
    assert on["delta_z_m"] == pytest.approx(0.02, abs=2e-3) and on["delta_x_m"] < -0.01
    assert off["delta_z_m"] == pytest.approx(-0.02, abs=3e-3)
    assert "success: the walk is finished" in "\n".join(lines)
    table = [line for line in lines if re.match(r" +\d  (left|right)", line)]
    assert len(table) == 3 and f"{1e3 * on['late_s']:+.0f}" in table[1]


def test_elkahlout_under_a_payload(capsys, tmp_path):
    lines, result = walked(
        capsys,
        tmp_path,
        "--robot",
        "elkahlout",
        "--steps",
        "3",
        "--payload",
        "10@0.5",
        "--variant",
        "modified",
    )
    assert names(result) == ANY_WALK | PAYLOAD | REFLEX
    assert result["payload"] == {
        "mass_kg": 10.0,
        "time_s": 0.5,
        "end_s": None,
        "thesis_time_s": pytest.approx(-0.7),
    }
    assert result["variant"] == {"landing": "off", "reflex": "modified"}
    reflex = result["reflexes"][0]
    assert 0.5 < reflex["triggered_s"] < 0.8
    assert reflex["settled_s"] == pytest.approx(reflex["triggered_s"] + 4.1, abs=1e-3)
    assert reflex["shifted_s"] < reflex["recovered_s"] < reflex["resumed_s"]
    assert 0.0 < reflex["x_shift_m"] < 0.05
    assert result["status"] in score.STATUS_TEXT
    assert any("reflex 1 at" in line and "thesis" in line for line in lines)


@pytest.mark.slow
def test_a_walk_without_adaptation_falls_over_an_obstacle(capsys, tmp_path):
    lines, result = walked(
        capsys, tmp_path, "--robot", "surena3", "--steps", "6", "--obstacle", "2:0.04", "--variant", "off"
    )
    assert names(result) == ANY_WALK
    assert (result["status"], result["success"]) == ("fell", False)
    assert result["end_time_s"] < result["had_to_stand_until_s"]
    assert any(line.startswith("failure: fell at") for line in lines)


@pytest.mark.slow
def test_obstacle_and_payload_at_once(capsys, tmp_path):
    _, result = walked(
        capsys,
        tmp_path,
        "--robot",
        "surena3",
        "--steps",
        "8",
        "--obstacle",
        "1:0.02",
        "--payload",
        "8@7",
        "--variant",
        "repaired",
    )
    assert names(result) == ANY_WALK | LANDING | PAYLOAD | REFLEX
    assert result["variant"] == {"landing": "repaired", "reflex": "repaired"}
    assert result["reflexes"] and result["touches"]

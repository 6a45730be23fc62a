"""`jaxbiped tune`: what it refuses, and the variant it writes."""

import json
from typing import Any

import numpy as np
import pytest

from jaxbiped import cli, tune
from jaxbiped.commands import tune as command_tune
from jaxbiped.commands.choices import load_variant
from jaxbiped.commands.common import InputError
from jaxbiped.tune.descent import Descent


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--robot", "atlas"), "--robot"),
        (("--what", "speed"), "--what"),
        (("--what", "gait.nothing"), "gait."),
        (("--variant", "paper"), "for payload"),
        (("--what", "landing", "--variant", "modified"), "for landing"),
        (("--variant", "nowhere.toml"), "nowhere.toml"),
        (("--scenarios", "1"), "--scenarios"),
        (("--batch", "0"), "--batch"),
        (("--steps", "0"), "--steps"),
        (("--duration", "-3"), "duration"),
    ],
)
def test_bad_input_is_refused_in_one_line(capsys, tmp_path, args, says):
    assert cli.main(["tune", "--out", str(tmp_path), *args]) == cli.BAD_INPUT
    out, line = capsys.readouterr()
    assert out == "" and line.startswith("jaxbiped: ") and line.count("\n") == 1
    assert says in line and "allowed" in line


def test_the_variant_that_is_written_is_read_again(tmp_path):
    """Tunables of a stage and of the gait; the robot of the command, another number of steps."""
    command = command_tune.Tune(robot="surena3", what=("landing", "gait.H_max"), scenarios=2, out=tmp_path)
    problem, held_out, start = command_tune.set_up(command)
    assert held_out.table.height == 2 and held_out.resolved != problem.experiment.resolved
    values = 0.5 * (problem.start + np.array([t.low + t.high for t in problem.tunables]) / 2.0)
    score = {"loss": 1.0, "success": 0.5}
    tuned = tune.Tuned(problem, tune.Settings(), values, score, score, Descent(best={"step": 3}))
    path = tmp_path / "tuned.toml"
    path.write_text(tune.variant_file(tuned, start, "jaxbiped tune"))
    variant: Any = load_variant("--variant", path, problem.experiment.robot, problem.controller.gait)
    np.testing.assert_allclose(
        [
            *(getattr(variant.stage("landing").params, t.field) for t in problem.tunables[:-1]),
            variant.gait.params.H_max,
        ],
        values,
        rtol=1e-6,
    )
    assert variant.stage("landing").params.no_undershoot and variant.stage("payload") is None


def test_tuning_goes_on_from_a_file(tmp_path):
    """What is not tuned any more keeps its value, switches and tables too."""
    text = "[payload]\nbase = 'modified'\nreflex_time = 0.3\nsmooth_resume = true\n"
    text += "x_reflex = [[0.02, 0.01], [0.0, 0.0], [0.0, 0.0]]\n"
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text(text)
    command = command_tune.Tune(what=("payload.settling_time", "gait.b_s"), scenarios=2, variant=str(first))
    problem, _, start = command_tune.set_up(command)
    before: Any = problem.controller
    assert before.stage("payload").params.reflex_time == pytest.approx(0.3)
    values, score = problem.start * 1.1, {"loss": 1.0, "success": 0.5}
    tuned = tune.Tuned(problem, tune.Settings(), values, score, score, Descent(best={"step": 3}))
    second.write_text(tune.variant_file(tuned, start, "jaxbiped tune"))
    variant: Any = load_variant("--variant", second, problem.experiment.robot, problem.controller.gait)
    params = variant.stage("payload").params
    assert params.settling_time == pytest.approx(4.4) and params.reflex_time == pytest.approx(0.3)
    assert variant.gait.params.b_s == pytest.approx(1.1 * float(before.gait.params.b_s))
    assert params.smooth_resume is True and not params.smooth_reflex
    np.testing.assert_allclose(params.x_reflex, [[0.02, 0.01], [0.0, 0.0], [0.0, 0.0]], rtol=1e-6)


@pytest.mark.parametrize(
    "text", ["[gait]\nstride = 1.0\n", "[gait]\nH_max = 'high'\n", "[gait]\nD_s = 3.0\n"]
)
def test_gaits_that_cannot_be_walked_are_refused(tmp_path, text):
    command = command_tune.Tune(robot="surena3", what=("landing",), scenarios=2)
    problem, _, _ = command_tune.set_up(command)
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"^--variant: .*allowed"):
        load_variant("--variant", path, problem.experiment.robot, problem.controller.gait)


@pytest.mark.slow
def test_trust_only_and_a_short_descent(capsys, tmp_path):
    args = [
        "tune",
        "--robot",
        "elkahlout",
        "--what",
        "payload.reflex_time",
        "payload.x_ref_gain",
        "--duration",
        "6",
    ]
    args += ["--scenarios", "8", "--out", str(tmp_path), "--json"]
    assert cli.main([*args, "--trust-only"]) == cli.OK
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert 0.0 <= report["median_rel"] < 1.0 and -1.0 <= report["cosine"] <= 1.0
    assert 0.0 < report["cost_per_tangent"] < 3.0
    assert cli.main([*args, "--steps", "3", "--batch", "4"]) == cli.OK
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (tmp_path / "tuned.toml").exists() and result["after"]["loss"] <= result["before"]["loss"]
    assert {"loss.png", "values.png"} <= {file.name for file in tmp_path.iterdir()}

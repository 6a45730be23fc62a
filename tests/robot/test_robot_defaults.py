"""What a robot file says beyond the body: its gait, and what that is simulated with."""

from pathlib import Path

import equinox as eqx
import jax
import pytest

from jaxbiped import planner, robot, sim
from jaxbiped.sim.plant import PAYLOAD_MODELS

PRESET = Path(robot.__file__).parent / "presets" / "elkahlout.toml"
LOPSIDED = (Path(__file__).parent / "lopsided.toml").read_text(encoding="utf-8")
THESIS = {"control_every": 1, "feed_forward": False, "payload_model": "thesis", "friction": 0.09}


def test_what_the_papers_say():
    assert robot.defaults("surena3").gait == "polynomial" and robot.defaults("elkahlout").gait == "cosine"
    assert robot.defaults("elkahlout").simulation("cosine") == THESIS
    assert robot.defaults("elkahlout").simulation("polynomial") == {}
    assert robot.defaults("surena3").simulation("polynomial") == {}
    assert type(robot.defaults("elkahlout").simulation("cosine")["control_every"]) is int


def test_every_setting_has_a_source():
    for name in robot.presets():
        for field, setting in robot.defaults(name).settings.items():
            assert setting.field == field and setting.kind in ("stated", "assumed")
            assert len(setting.source) > 8
            if setting.kind == "stated":
                assert setting.source.startswith(("khadiv", "elkahlout"))


def test_options_are_those_of_the_thesis_for_its_robot_and_gait_alone():
    elkahlout, surena = robot.load("elkahlout"), robot.load("surena3")
    cosine, polynomial = (g.preset(elkahlout, 1) for g in (planner.CosineGait, planner.PolynomialGait))
    thesis = sim.Options(control_every=1, feed_forward=False, payload_model="thesis")
    assert sim.own_options(elkahlout, cosine) == thesis and sim.own_friction(elkahlout, cosine) == 0.09
    for params, gait in ((elkahlout, polynomial), (surena, cosine), (surena, polynomial)):
        assert sim.own_options(params, gait) == sim.Options() and sim.own_friction(params, gait) == 0.8


def test_they_are_no_part_of_what_is_compiled():
    """Two robots that walk alike have one structure, whatever stands beside their bodies."""
    params = robot.load("elkahlout")
    leaves = jax.tree.leaves(eqx.filter(params, lambda leaf: not eqx.is_array(leaf)))
    assert leaves == [] and not any("default" in name for name in vars(params))


def test_payload_models_are_those_of_the_simulator():
    assert robot.load(PRESET).name == "elkahlout"
    assert PAYLOAD_MODELS == ("exact", "thesis")


def changed(tmp_path: Path, old: str, new: str) -> Path:
    text = PRESET.read_text(encoding="utf-8")
    assert old in text
    file = tmp_path / "mine.toml"
    file.write_text(
        text.replace(old, new).replace('name = "elkahlout"', 'name = "mine"', 1), encoding="utf-8"
    )
    return file


def test_a_renamed_copy_has_the_settings_of_its_preset(tmp_path):
    mine = robot.load(changed(tmp_path, "sole_toe", "sole_toe"))
    assert mine.name == "mine" and robot.defaults(mine) == robot.defaults("elkahlout")


def test_a_robot_that_walks_like_no_preset_has_none(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(LOPSIDED, encoding="utf-8")
    assert robot.defaults(robot.load(file)) == robot.Defaults()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('gait = { value = "cosine"', 'gait = { value = "polynomial"',
         r"walking\.gait: got the text 'polynomial', allowed: the text 'cosine', or none, as in elk"),
        ('gait = { value = "cosine"', "gait = { value = 3", r"walking\.gait: got 3, allowed: the name of a gait"),
        ("gait = {", "gate = {", r"walking\.gate: unknown, allowed: gait; did you mean 'gait'\?"),
        ("friction = { value = 0.09", "friction = { value = 0.5", r"cosine\.friction: got 0\.5, allowed: 0\.09, or"),
        ("friction = { value = 0.09", "friction = { value = -1.0", r"cosine\.friction: got -1, allowed: >= 0\.01"),
        ("friction = {", "fricton = {", r"simulation\.cosine\.fricton: unknown, .*did you mean 'friction'"),
        ("feed_forward = { value = false", "feed_forward = { value = 0", r"feed_forward: got 0, allowed: true or"),
        ('payload_model = { value = "thesis"', 'payload_model = { value = "theses"', "did you mean 'thesis'"),
        ("control_every = { value = 1,", "control_every = { value = 0,", "control_every: got 0, allowed: a whole"),
        ("control_every = { value = 1,", "control_every = { value = 1.5,", "control_every: got the float 1.5"),
        ("control_every = { value = 1, assumed", "control_every = { value = 1, stated = 'x', assumed",
         "control_every: needs either 'stated'"),
        ("control_every = { value = 1,", 'control_every = { value = 1, unit = "s",', "control_every.unit: unknown"),
        ("[simulation.cosine]", "[simulation.walk]", r"simulation\.walk\.control_every: got 1, allowed: none"),
        ("[walking]", "[[walking]]", r"walking: got \[a table\], allowed: a table \[walking\]"),
        ('walks_like = "elkahlout"', "", r"walking\.gait: got a setting, allowed: with walks_like, or none"),
    ],
)  # fmt: skip
def test_what_is_refused(tmp_path, old, new, words):
    with pytest.raises(robot.RobotFileError, match=rf"^mine\.toml: .*{words}"):
        robot.load(changed(tmp_path, old, new))

"""Gaits are found by name, a robot's own through its file, and a third one is a class and files of numbers."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import adapt, batch, planner, robot
from jaxbiped.adapt import tunables
from jaxbiped.batch import records
from jaxbiped.commands import choices
from jaxbiped.planner import GAITS, CosineGait, CosineParams, Gait, GaitError, PolynomialGait, presets


def test_gaits_by_name():
    assert {"cosine": CosineGait, "polynomial": PolynomialGait} == GAITS
    assert all(gait.name == name for name, gait in GAITS.items())


@pytest.mark.parametrize(("name", "kind"), [("surena3", PolynomialGait), ("elkahlout", CosineGait)])
def test_each_robot_walks_the_gait_of_its_paper(name, kind):
    params = robot.load(name)
    gait, wanted = planner.own_gait(params, 3, 1), kind.preset(params, 3, 1)
    assert type(gait) is kind and planner.own_gait_name(params) == kind.name
    assert jax.tree.structure(gait) == jax.tree.structure(wanted)
    jax.tree.map(np.testing.assert_array_equal, gait, wanted)
    renamed = dataclasses.replace(params, name="mine")
    assert type(planner.own_gait(renamed, 1)) is kind


def test_a_robot_that_walks_like_no_other_has_no_gait_of_its_own():
    stranger = dataclasses.replace(robot.load("surena3"), name="mine", walks_like="")
    with pytest.raises(
        GaitError, match=r"own gait: got robot 'mine', allowed: elkahlout, surena3; otherwise add walks_like"
    ):
        planner.own_gait(stranger)


def test_every_robot_and_gait_named_in_a_file_is_there():
    for name in robot.presets():
        assert robot.defaults(name).gait in GAITS
        fields = [field.split(".") for field in robot.defaults(name).settings]
        assert {gait for table, gait, *_ in fields if table == "simulation"} <= GAITS.keys()
    for gait in GAITS.values():
        assert set(presets.robots(gait)) <= set(robot.presets())


def test_clocks():
    """The thesis' time begins T_ini after the start; that of the other paper with the walk."""
    params = robot.load("elkahlout")
    cosine, polynomial = CosineGait.preset(params, 1), PolynomialGait.preset(params, 1)
    assert float(cosine.clock_start) == float(cosine.params.T_ini) == pytest.approx(1.2)
    assert float(polynomial.clock_start) == 0.0


@pytest.mark.parametrize("kind", [PolynomialGait, CosineGait])
@pytest.mark.parametrize("name", robot.presets())
def test_every_number_of_a_preset_has_unit_and_source(name, kind):
    numbers = presets.preset(kind, name).numbers
    assert numbers.keys() == kind.quantities.keys()
    for key, number in numbers.items():
        assert number.unit == kind.quantities[key].unit
        assert number.kind in ("stated", "assumed") and len(number.source) > 5
        if number.kind == "stated":
            assert number.source.startswith(("khadiv", "elkahlout"))


def test_the_thesis_states_its_gait_but_for_start_and_stop():
    numbers = presets.preset(CosineGait, "elkahlout").numbers
    assert {key for key, number in numbers.items() if number.kind == "assumed"} == {"T_ini", "T_end"}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('b_s = { value = 0.08, unit = "m"', 'b_s = { value = 80.0, unit = "m"', "parameters.b_s: got 80 m"),
        ('b_s = { value = 0.08, unit = "m"', 'b_s = { value = 0.08, unit = "mm"', "parameters.b_s: got unit"),
        ("b_s = ", "b_q = ", r"parameters\.b_q: unknown, .*did you mean 'b_s'"),
        ("infeasible = ", "unfeasible = ", "unfeasible: unknown, .*did you mean 'infeasible'"),
        ("[parameters]", "[parameters.start_stop]", "start_stop.t_ss: unknown"),
        ('b_s = { value = 0.08, unit = "m", stated = "elkahlout section 3.2" }', "", r"\.b_s: missing"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, monkeypatch, old, new, words):
    text = (presets._folder(CosineGait) / "elkahlout.toml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "elkahlout.toml").write_text(text.replace(old, new), encoding="utf-8")
    monkeypatch.setattr(presets, "_folder", lambda gait: tmp_path)
    with pytest.raises(GaitError, match=words):
        presets._read.__wrapped__(CosineGait, "elkahlout")


def test_parameters_of_another_gait_are_refused():
    params = robot.load("surena3")
    with pytest.raises(GaitError, match="params: got a CosineParams, allowed: PolynomialParams"):
        PolynomialGait.make(params, CosineGait.preset_params(params), 2)


@pytest.fixture
def shuffle(tmp_path, monkeypatch) -> Any:
    """A third gait: the cosine gait with half its sway, by another name and with a file of its own."""

    class Shuffle(CosineGait):
        name: ClassVar[str] = "shuffle"
        parameters: ClassVar[type[eqx.Module]] = CosineParams

        @classmethod
        def plan(cls, params, n_steps, first_swing, room):
            half = dataclasses.replace(params, w=0.5 * params.w)
            made = CosineGait.plan(half, n_steps, first_swing, room)
            return cls(**{field.name: getattr(made, field.name) for field in dataclasses.fields(made)})

    folder = presets._folder
    text = (folder(CosineGait) / "surena3.toml").read_text(encoding="utf-8")
    (tmp_path / "surena3.toml").write_text(text, encoding="utf-8")
    monkeypatch.setattr(presets, "_folder", lambda gait: tmp_path if gait is Shuffle else folder(gait))
    monkeypatch.setitem(GAITS, "shuffle", Shuffle)
    return Shuffle


def test_a_third_gait_is_one_class_and_one_file(shuffle):
    """Known to the command line, to controllers, tunables and folders of results without another line."""
    params = robot.load("surena3")
    gait = choices.make_gait(params, "shuffle", 3, allow_infeasible=True)
    assert isinstance(gait, Gait) and type(gait) is shuffle
    assert float(gait.params.w) == pytest.approx(0.5 * float(CosineGait.preset_params("surena3").w))
    controller = adapt.Controller(gait, adapt.Landing.repaired())
    assert "gait.b_s" in [t.name for t in tunables.find(["gait.b_s"], controller)]
    data = records.to_json(controller)
    assert data["gait"]["record"] == "shuffle_gait"
    back = records.from_json(data)
    assert jax.tree.structure(back) == jax.tree.structure(controller)
    assert batch.Experiment(params, {"off": controller}, batch.grid(friction=[0.8])).rows == 1
    with pytest.raises(
        GaitError, match=r"preset gait: got robot 'elkahlout', allowed: surena3; .*Shuffle\.make"
    ):
        shuffle.preset(robot.load("elkahlout"), 2)


def test_a_name_is_given_once():
    class Other(CosineGait):
        pass

    with pytest.raises(ValueError, match="got the name 'cosine', allowed: another than"):
        planner.register(Other)
    assert planner.register(CosineGait) is CosineGait


def test_a_plan_is_no_gait():
    """What only is a function of time is planned with, not walked by a controller."""

    class Still(eqx.Module):
        duration: jax.Array

        timing: None = None

        def task(self, t):
            return None

        def phase(self, t):
            return None

    still = Still(jnp.ones(()))
    assert isinstance(still, planner.Plan) and not isinstance(still, Gait)
    assert isinstance(CosineGait.preset(robot.load("elkahlout"), 1), Gait)

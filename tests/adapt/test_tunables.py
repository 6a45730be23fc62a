"""What can be tuned: names, bounds, and a controller with other values."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import robot
from jaxbiped.adapt import Controller, Landing, PayloadReflex, tunables
from jaxbiped.commands.choices import load_variant
from jaxbiped.planner import GaitError, PolynomialGait, StartStop, violations


@pytest.fixture(scope="module")
def made():
    biped = robot.load("surena3")
    gait = PolynomialGait.preset(biped, 4)
    given = {"threshold": 60.0, "zmp_balanced": -0.035, "two_speeds": True}
    return biped, Controller(gait, Landing.repaired(), PayloadReflex.modified(biped, gait, **given))


def moved(found, at):
    """Other values, inside the bounds."""
    low, high = np.array([t.low for t in found]), np.array([t.high for t in found])
    return jnp.asarray(np.where(at < 0.5 * (low + high), at + 0.2 * (high - at), at - 0.2 * (at - low)))


def test_defaults_lie_within_their_bounds(made):
    _, controller = made
    found = tunables.find(["landing", "payload"], controller)
    assert [t.name for t in found] == list(tunables.known())
    for t, value in zip(found, np.asarray(tunables.values(controller, found)), strict=True):
        assert t.low <= value <= t.high, t.name
        assert t.unit in ("m", "s", "m/s", "m/s2", "N", "")


def test_applied_values_are_those_of_the_controller_and_the_rest_stays(made):
    biped, controller = made
    found = tunables.find([*tunables.known(), "gait.x_s", "gait.T_s"], controller)
    new = moved(found, np.asarray(tunables.values(controller, found), float))
    other: Any = tunables.apply(biped, controller, found, new)
    np.testing.assert_allclose(tunables.values(other, found), new, rtol=1e-6)
    assert other.stage("payload").params.slow_threshold == controller.stage("payload").params.slow_threshold
    assert jax.tree.structure(other.gait) == jax.tree.structure(controller.gait)
    assert other.gait.timing.T_s == pytest.approx(float(new[-1]))
    # what a stage reads off the plan is read off the new one
    assert not np.allclose(
        other.stage("payload").resume_plan_time, controller.stage("payload").resume_plan_time
    )


def test_the_same_values_give_the_same_controller(made):
    biped, controller = made
    found = tunables.find(["payload"], controller)
    values = tunables.values(controller, found)
    for given in (values, np.asarray(values, float)):  # NumPy's too, as a descent returns them
        other = tunables.apply(biped, controller, found, given)
        for a, b in zip(jax.tree.leaves(other), jax.tree.leaves(controller), strict=True):
            np.testing.assert_array_equal(a, b)


def test_one_place_of_a_table_is_one_tunable(made):
    biped, controller = made
    for t in tunables.find(
        [name for name in tunables.known() if ".x_left" in name or ".x_right" in name], controller
    ):
        _, stages = tunables.with_values(biped, controller, [t], jnp.array([0.037]))
        reflex: Any = next(stage for stage in stages if stage.name == "payload")
        changed = np.asarray(reflex.x_reflex) != np.asarray(controller.stage("payload").params.x_reflex)
        assert changed.sum() == 1 and changed[t.index]


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["landing.h"], "landing.T_mod"),
        (["reflex"], "payload.reflex_time"),
        (["gait.x_z"], "gait.x_s"),
        (["gait"], "gait.x_s"),
        (["payload", "payload.threshold"], "each once"),
        ([], "at least one"),
    ],
)
def test_unknown_names_are_refused(made, names, says):
    with pytest.raises(ValueError, match=r"^tunables?: got .*, allowed: ") as refusal:
        tunables.find(names, made[1])
    assert says in str(refusal.value)


def test_a_stage_that_is_not_there_cannot_be_tuned(made):
    _, controller = made
    with pytest.raises(ValueError, match=r"got 'payload', allowed: landing\.T_mod"):
        tunables.find(["payload"], Controller(controller.gait, Landing.repaired()))


def test_what_only_matters_with_a_switch_is_tuned_with_it_only(made):
    _, controller = made
    quick = {f"payload.{name}" for name in ("quick_step", "longest_step", "body_acceleration", "behind")}
    assert quick < {t.name for t in tunables.find(["payload"], controller)}
    params = dataclasses.replace(controller.stage("payload").params, two_speeds=False)
    literal = Controller(controller.gait, params)
    assert not quick & {t.name for t in tunables.find(["payload"], literal)}
    with pytest.raises(ValueError, match=r"got 'payload\.quick_step', allowed: "):
        tunables.find(["payload.quick_step"], literal)


def test_tables_of_a_file(made):
    biped, controller = made
    found = tunables.find(
        ["payload.x_left_left_swings", "payload.settling_time", "landing.T_mod"], controller
    )
    tables = tunables.as_tables(biped, controller, found, [0.02, 3.0, 0.1])
    assert tables["landing"] == {"T_mod": 0.1} and tables["payload"]["settling_time"] == 3.0
    wanted = np.array(controller.stage("payload").params.x_reflex, float)
    wanted[0, 0] = 0.02
    np.testing.assert_allclose(tables["payload"]["x_reflex"], wanted)


def test_what_was_read_off_another_plan_is_written_down(made):
    biped, controller = made
    found = tunables.find(["gait.x_s"], controller)
    tables = tunables.as_tables(biped, controller, found, [0.05])
    assert tables["gait"] == {"x_s": 0.05}
    assert tables["payload"]["threshold"] == pytest.approx(
        float(controller.stage("payload").params.threshold)
    )


ENDS = [f"gait.start_stop.{name}" for name in StartStop.__dataclass_fields__]


def test_every_number_of_start_and_stop_can_be_tuned(made):
    """Each moves the pelvis at some time, and only it changes among the parameters."""
    biped, controller = made
    found = tunables.find(ENDS, controller)
    old = np.asarray(tunables.values(controller, found), float)
    np.testing.assert_array_equal(old, [float(v) for v in vars(controller.gait.params.start_stop).values()])
    assert [t.unit for t in found] == ["m"] * 8 + ["m/s"] * 2
    assert all(t.low < value < t.high and t.stage == "gait" for t, value in zip(found, old, strict=True))
    times = jnp.linspace(0.0, float(controller.gait.duration), 200)

    @jax.jit
    def pelvis(values):
        gait, _ = tunables.with_values(biped, controller, found, values)
        return jax.vmap(lambda t: gait.task(t).pelvis)(times), gait.params

    before, params = pelvis(jnp.asarray(old))
    for i, t in enumerate(found):
        after, other = pelvis(jnp.asarray(old).at[i].set(t.high))
        assert np.abs(after - before)[:, 0].max() > 1e-4 and np.all(after[:, 1:] == before[:, 1:]), t.name
        different = [
            float(a) != float(b) for a, b in zip(*map(jax.tree.leaves, (params, other)), strict=True)
        ]
        assert sum(different) == 1
        assert float(getattr(other.start_stop, t.field.split(".")[1])) == pytest.approx(t.high)


def test_start_and_stop_in_the_tables_of_a_file_and_back(made, tmp_path):
    biped, controller = made
    found = tunables.find(["gait.start_stop.x_rest_start", "gait.H_max"], controller)
    tables = tunables.as_tables(biped, controller, found, [-0.02, 0.09])
    assert tables["gait"] == {"start_stop.x_rest_start": -0.02, "H_max": 0.09}
    file = tmp_path / "tuned.toml"
    file.write_text("[gait]\n" + "".join(f"{name} = {value}\n" for name, value in tables["gait"].items()))
    gait: Any = load_variant("--variant", file, biped, controller.gait).gait
    assert float(gait.params.start_stop.x_rest_start) == pytest.approx(-0.02)
    assert float(gait.params.H_max) == pytest.approx(0.09)


def test_a_tuned_plan_that_breaks_a_constraint_is_let_through_and_says_so(made):
    """A descent may pass through such plans, and end at one."""
    biped, controller = made
    found = tunables.find(["gait.y_d"], controller)
    tuned = tunables.apply(biped, controller, found, jnp.array([0.1]))
    assert [v.constraint for v in violations(biped, tuned.gait)] == ["ZMP"]
    assert tunables.as_tables(biped, controller, found, [0.1])["gait"] == {
        "y_d": 0.1,
        "allow_infeasible": True,
    }
    with pytest.raises(GaitError, match="outside the support polygon"):
        tunables.other_gait(biped, controller.gait, {"y_d": 0.1})

"""Records go to JSON and back, bit for bit, and differences are named."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import adapt, planner, robot, sim
from jaxbiped.batch import records


def there_and_back(value):
    return records.from_json(json.loads(json.dumps(records.to_json(value), allow_nan=False)))


def every_record():
    for name in robot.presets():
        params = robot.on_device(robot.load(name))  # as in an experiment
        yield params
        for gait in (planner.PolynomialGait.preset(params, 3), planner.CosineGait.preset(params, 3)):
            yield adapt.Controller(gait)
            for landing in (adapt.Landing.paper(), adapt.Landing.repaired()):
                yield adapt.Controller(gait, landing)
    yield sim.Scenario.flat()
    yield sim.Options(control_every=3, noise=True)


def test_every_record_of_an_experiment_comes_back_bit_for_bit():
    for record in every_record():
        back = there_and_back(record)
        assert jax.tree.structure(back) == jax.tree.structure(record)  # static fields are in it
        for a, b in zip(jax.tree.leaves(record), jax.tree.leaves(back), strict=True):
            assert np.asarray(a).dtype == np.asarray(b).dtype
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def test_reflex_comes_back_and_still_steps():
    params = robot.load("elkahlout")
    gait = planner.CosineGait.preset(params, 3)
    controller = adapt.Controller(gait, adapt.PayloadReflex.modified(params, gait, threshold=40.0))
    back = there_and_back(controller)
    assert jax.tree.structure(back.init()) == jax.tree.structure(controller.init())


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32, np.int64, bool])
def test_arrays_of_every_kind(dtype, x64):
    array = np.array([[0.1, -3.0], [1e-30, 7.0]]).astype(dtype)
    back = there_and_back(jnp.asarray(array))
    assert back.dtype == array.dtype and np.asarray(back).tobytes() == array.tobytes()


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_what_json_does_not_know(value):
    np.testing.assert_equal(there_and_back({"a": value, "b": np.array([1.0, value])})["a"], value)
    np.testing.assert_equal(
        np.asarray(there_and_back(np.array([1.0, value]))), np.array([1.0, value], np.float32)
    )


def test_plain_values():
    value = {"a": [1, 2.5, "x", None, True], "b": (1, (2,))}
    assert there_and_back(value) == value


def test_strangers_are_refused():
    with pytest.raises(TypeError, match="object"):
        records.to_json(object())
    for name in ("os:system", "equinox:Module", "jaxbiped.batch.records:to_json"):
        with pytest.raises(ValueError, match="allowed: robot, links, servo"):
            records.from_json({"record": name})


def test_records_of_another_version_are_refused():
    data = records.to_json(sim.Scenario.flat().payload)
    for other in ({**data, "speed": 1.0}, {k: v for k, v in data.items() if k != "mass"}):
        with pytest.raises(
            ValueError, match=r"payload was written by another version: not in both are (speed|mass)"
        ):
            records.from_json(other)


def test_what_a_version_had_not_yet_it_has_by_default():
    landing = adapt.Landing.repaired(descent_speed=0.3)
    data = {k: v for k, v in records.to_json(landing).items() if k not in ("max_descent", "stays_down")}
    back = records.from_json(data)
    assert jax.tree.structure(back) == jax.tree.structure(landing)
    assert float(back.max_descent) == float(landing.max_descent) and back.max_descent.dtype == jnp.float32
    flat = sim.Scenario.flat()
    data = records.to_json(flat)
    del data["payload"]["end"]
    back = records.from_json(data)
    assert jax.tree.structure(back) == jax.tree.structure(flat)
    assert float(back.payload.end) == float(flat.payload.end) == 1e6


def test_names_of_records_are_no_places_in_the_code():
    """They stay when the code is moved; those of version 0.1 are still understood."""
    for record in every_record():
        assert "jaxbiped" not in json.dumps(records.to_json(record))
    assert len(records.RECORDS) == len(set(records.RECORDS.values()))
    data = records.to_json(robot.load("surena3").servo)
    old = {**data, "record": "jaxbiped.robot.params:Servo"}
    assert jax.tree.structure(records.from_json(old)) == jax.tree.structure(records.from_json(data))


def test_differences_name_the_place():
    params = robot.load("surena3")
    gait = planner.PolynomialGait.preset(params, 3)
    old, new = (
        records.to_json(adapt.Controller(gait, adapt.Landing.repaired(descent_speed=speed)))
        for speed in (0.2, 0.25)
    )
    found = list(records.differences(old, new))
    assert found and all("descent_speed" in line for line in found if "params" in line)
    assert any("0.25" in line for line in found)
    assert list(records.differences(old, old)) == []
    assert list(records.differences({"a": 1}, {"b": 1})) == ["a: there -> missing", "b: missing -> there"]

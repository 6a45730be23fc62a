"""The example of docs/tune.md runs, and its gradient is that of central differences."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import landing

from jaxbiped.tune import Problem, central, value_and_grad

DOCS = Path(__file__).parents[2] / "docs" / "tune.md"


def example() -> str:
    return DOCS.read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]


@pytest.fixture(scope="module")
def example_in_float64() -> Iterator[dict[str, Any]]:
    """A loss of one's own, walks of 5.8 s over a pad or into a hole under the second step."""
    names: dict[str, Any] = {}
    with jax.enable_x64(True):
        exec(example(), names)
    yield names


def test_the_example_of_the_docs_runs(example_in_float64):
    found, height = example_in_float64["found"], example_in_float64["scenarios"]["step_1_height_m"].to_numpy()
    assert found.by_scenario.dtype == np.float64 and np.all(found.status == 0) and found.value > 0.0
    T_mod, descent_speed = found.by_scenario.T
    # into a hole the foot descends; over a pad it is set down in T_mod
    assert np.all(T_mod[height > 0.0] != 0.0)
    np.testing.assert_array_equal(descent_speed[height > 0.0], 0.0)
    assert np.all(descent_speed[height < 0.0] != 0.0)


def test_one_program_for_every_duration(example_in_float64, compilations):
    """Nothing is compiled for another one; the last samples are at its end."""
    found, loss = example_in_float64["found"], example_in_float64["Gentle"]()
    names, values = [t.name for t in found.tunables], []
    for duration in (0.6, 0.4):
        with jax.enable_x64(True):
            shorter = dataclasses.replace(example_in_float64["experiment"], duration=duration)
            before = len(compilations)
            short = value_and_grad(shorter, names, loss=loss)
        # an eighth of a walk is a whole number of control ticks of 2 ms
        np.testing.assert_allclose(short.growth_time, duration * np.arange(1, 9) / 8, atol=8 * 0.002)
        values.append(short.value)
    assert len(compilations) == before
    assert len({*values, found.value}) == 3


@pytest.mark.slow
def test_the_gradient_of_the_example_is_that_of_central_differences(example_in_float64):
    found = example_in_float64["found"]
    with jax.enable_x64(True):
        names = [t.name for t in found.tunables]
        problem = Problem.of(example_in_float64["experiment"], names, example_in_float64["Gentle"]())
        twin = central(problem, found.at, np.arange(4))
    np.testing.assert_allclose(twin.losses, found.losses, rtol=1e-9)
    np.testing.assert_allclose(twin.by_scenario, found.by_scenario, rtol=1e-2, atol=1e-7)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"names": ["landing.h"]}, "tunable: got 'landing.h', allowed: landing.T_mod"),
        ({"names": ["landing.T_mod", "landing.T_mod"]}, "each once"),
        ({"names": []}, "at least one"),
        ({"variant": "paper"}, "variant: got 'paper', allowed: repaired"),
        ({"at": [0.1, 0.2]}, "at: got [0.1, 0.2], allowed: 1 finite numbers"),
        ({"at": [jnp.nan]}, "allowed: 1 finite numbers"),
        ({"rows": [7]}, "rows: got [7], allowed: numbers from 0 to 1"),
        ({"rows": []}, "allowed: numbers from 0 to 1"),
    ],
)
def test_what_cannot_be_meant_is_refused(given, says):
    experiment = landing(2, 1.0).experiment
    with pytest.raises(ValueError) as refusal:
        value_and_grad(experiment, **{"names": ["landing.T_mod"], **given})
    assert says in str(refusal.value)

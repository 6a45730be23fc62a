"""The example of docs/tune.md runs, and its gradient is that of central differences."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from problems import landing

from jaxbiped.tune import Problem, central, value_and_grad

DOCS = Path(__file__).parents[2] / "docs" / "tune.md"


def example() -> str:
    return DOCS.read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]


def test_the_example_of_the_docs_is_right(x64, capsys):
    """A loss of one's own, one tunable of the landing and one of the gait, walks of 4 s over a first step on a pad."""
    names: dict[str, Any] = {}
    exec(example(), names)
    found, loss = names["found"], names["Gentle"]()
    assert "T_mod" in capsys.readouterr().out
    assert np.all(found.status == 0)
    # exactly zero by T_mod over the pads: there T*, the longest time that does not undershoot, is shorter
    assert np.all(np.any(found.by_scenario != 0.0, axis=0))
    problem = Problem.of(names["experiment"], list(found.tunables), loss)
    twin = central(problem, found.at, np.arange(4))
    assert found.by_scenario.dtype == np.float64
    np.testing.assert_allclose(twin.losses, found.losses, rtol=1e-9)
    np.testing.assert_allclose(twin.by_scenario, found.by_scenario, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"names": ["landing.h"]}, "tunable: got 'landing.h', allowed: landing.T_mod"),
        ({"names": ["landing.T_mod", "landing.T_mod"]}, "each once"),
        ({"names": []}, "at least one"),
        ({"arm": "paper"}, "arm: got 'paper', allowed: repaired"),
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

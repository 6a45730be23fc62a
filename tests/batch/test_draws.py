"""Grids are full, draws follow their distributions, and a seed gives the same table."""

import math
import subprocess
import sys
from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy import stats

from jaxbiped.batch import Choice, Normal, Uniform, draw, grid


def test_grid_is_every_combination_in_order():
    table = grid(load_kg=[1.0, 2.0], load_time_s=[0.5, 1.5, 2.5], friction=0.7)
    assert table.height == 6 and table.n_unique() == 6
    assert table["load_kg"].to_list() == [1.0] * 3 + [2.0] * 3
    assert table["load_time_s"].to_list() == [0.5, 1.5, 2.5] * 2
    assert set(table["friction"]) == {0.7}


def test_grid_without_values_is_refused():
    with pytest.raises(ValueError, match="load_kg: got no values"):
        grid(load_kg=[])


def cut_normal(x: np.ndarray) -> np.ndarray:
    """Distribution function of mean 5 and deviation 0.5, cut off at three deviations."""
    phi = np.vectorize(lambda z: 0.5 * (1.0 + math.erf(z / math.sqrt(2.0))))
    return (phi((x - 5.0) / 0.5) - phi(-3.0)) / (phi(3.0) - phi(-3.0))


LAWS: dict[str, tuple[Any, Any]] = {
    "uniform": (Uniform(-1.0, 3.0), lambda x: (x + 1.0) / 4.0),
    "normal": (Normal(5.0, 0.5), cut_normal),
    "SciPy's exponential": (stats.expon(scale=2.0), lambda x: 1.0 - np.exp(-x / 2.0)),
    "SciPy's triangle": (stats.triang(0.0, 1.0, 2.0), lambda x: 1.0 - (3.0 - x) ** 2 / 4.0),
}
"""Distributions, and their distribution functions by hand."""


@pytest.mark.parametrize("latin", [True, False])
@pytest.mark.parametrize("name", LAWS)
def test_draws_follow_their_distribution(name, latin):
    distribution, law = LAWS[name]
    values = draw(4000, 3, latin_hypercube=latin, friction=distribution)["friction"].to_numpy()
    assert stats.kstest(values, law).pvalue > 1e-3
    if latin:
        assert sorted((4000 * law(values)).astype(int)) == list(range(4000))


def test_normal_is_cut_off_at_three_deviations():
    values = draw(100_000, 1, latin_hypercube=False, x=Normal(5.0, 0.5))["x"].to_numpy()
    assert 3.5 <= values.min() < 3.52 and 6.48 < values.max() <= 6.5


def test_discrete_distributions_of_scipy_are_drawn_too():
    values = draw(1000, 4, x=stats.binom(2, 0.5))["x"].to_list()
    assert [values.count(k) for k in (0.0, 1.0, 2.0)] == [250, 500, 250]


def test_one_value_may_be_all_a_range_has():
    assert draw(3, 0, x=Uniform(2.0, 2.0))["x"].to_list() == [2.0] * 3


def test_latin_hypercube_has_one_row_in_each_part():
    values = draw(500, 1, a=Uniform(0.0, 1.0), b=Uniform(0.0, 1.0))
    for name in ("a", "b"):
        assert sorted((values[name].to_numpy() * 500).astype(int).tolist()) == list(range(500))
    assert abs(np.corrcoef(values["a"], values["b"])[0, 1]) < 0.15


def test_choice_is_even():
    counts = draw(300, 2, step=Choice((1.0, 2.0, 5.0)))["step"].value_counts()
    assert set(counts["step"]) == {1.0, 2.0, 5.0} and set(counts["count"]) == {100}


def test_a_seed_gives_the_same_table_and_a_column_keeps_its_values():
    a, b = draw(50, 7, x=Uniform(0, 1)), draw(50, 7, x=Uniform(0, 1), y=Uniform(0, 1))
    assert a["x"].equals(b["x"]) and not b["x"].equals(b["y"])
    assert not draw(50, 8, x=Uniform(0, 1))["x"].equals(a["x"])
    assert draw(3, 0, friction=0.5)["friction"].to_list() == [0.5] * 3


@pytest.mark.parametrize("latin", [True, False])
def test_a_column_more_or_less_changes_no_other_wherever_it_stands(latin):
    columns = {"load_kg": Uniform(0, 25), "friction": Normal(0.7, 0.1), "load_time_s": Uniform(1, 6)}
    whole = draw(50, 7, latin_hypercube=latin, **columns)
    for name in columns:
        for order in (1, -1):
            fewer = {n: columns[n] for n in list(columns)[::order] if n != name}
            part = draw(50, 7, latin_hypercube=latin, push_x_N=Uniform(-1, 1), **fewer)
            assert all(part[n].equals(whole[n]) for n in fewer)


def test_whole_numbers_may_be_numpys():
    assert draw(np.int64(3), np.int32(1), x=Uniform(0, 1)).equals(draw(3, 1, x=Uniform(0, 1)))
    assert draw(2, 0, x=np.float32(0.5))["x"].to_list() == [0.5] * 2
    assert grid(x=np.array([1, 2])).equals(grid(x=[1.0, 2.0]))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Uniform(2.0, 1.0), "low <= high"),
        (lambda: Uniform(0.0, float("inf")), "finite"),
        (lambda: Uniform(0.0, float("nan")), "finite"),
        (lambda: Uniform(False, 1.0), "truth value"),
        (lambda: Normal(0.0, 0.0), "deviation: got 0, allowed: > 0"),
        (lambda: Normal(float("nan"), 1.0), "finite"),
        (lambda: Normal(0.0, float("inf")), "finite"),
        (lambda: Choice(()), "at least one"),
        (lambda: Choice((1.0, float("nan"))), "choice: got nan"),
        (lambda: Choice((1.0, float("inf"))), "choice: got inf"),
        (lambda: draw(0, 1, x=1.0), "n: got 0"),
        (lambda: draw(True, 1, x=1.0), "n: got the truth value"),
        (lambda: draw(5, -1, x=1.0), "seed: got -1"),
        (lambda: draw(5, 0, x=float("nan")), "x: got nan"),
        (lambda: draw(5, 0, x=stats.norm(0.0, -1.0)), "x: got nan in place 1, allowed: any finite number"),
        (lambda: draw(5, 0, x=stats.uniform(0.0, 1e39)), r"x: got .*infinite in float32"),
        (
            lambda: draw(5, 0, x=stats.gamma),
            "x: got .*gamma.*, allowed: a number, or a distribution with its",
        ),
        (lambda: grid(x=[1.0, float("nan")]), "x: got nan"),
        (lambda: grid(x=1e39), "infinite in float32"),
        (lambda: grid(x=range(10_000), y=range(10_000)), "grid: got 100000000 combinations"),
    ],
)
def test_bad_draws_are_refused(make, says):
    with pytest.raises(ValueError, match=says):
        make()


def test_grids_and_draws_are_tables():
    assert isinstance(grid(a=1.0), pl.DataFrame) and isinstance(draw(2, 0, a=1.0), pl.DataFrame)


CALLS = {
    "Uniform('0', 1.0)": "uniform: low: got the text '0'",
    "Choice('abc')": "choice: got 'abc'",
    "Choice((1.0, '2'))": "choice: got the text '2'",
    "draw(2.5, 1, x=1.0)": "n: got the float 2.5",
    "draw('3', 1, x=1.0)": "n: got the text '3'",
    "draw(5, 0, x='fast')": "x: got the text 'fast'",
    "draw(5, 0, x=None)": "x: got nothing",
    "grid(x=['1'])": "x: got the text '1'",
    "grid(x='12')": "x: got the text '12'",
}


def test_what_is_no_number_is_refused_in_one_line_where_no_type_is_checked():
    """Outside the tests nothing looks at annotations."""
    lines = ["from jaxbiped.batch import *"]
    for call in CALLS:
        lines += [
            "try:",
            f"    {call}",
            "except ValueError as error:",
            "    print(error)",
            "else:",
            "    print('taken')",
        ]
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=True
    )
    said = done.stdout.splitlines()
    assert len(said) == len(CALLS)
    for line, wanted in zip(said, CALLS.values(), strict=True):
        assert line.startswith(wanted) and "allowed" in line

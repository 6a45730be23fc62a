"""Grids are full, draws follow their distributions, and a seed gives the same table."""

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


@pytest.mark.parametrize("latin", [True, False])
@pytest.mark.parametrize(
    ("one", "law"),
    [
        (Uniform(-1.0, 3.0), stats.uniform(-1.0, 4.0)),
        (Normal(5.0, 0.5), stats.truncnorm(-3.0, 3.0, 5.0, 0.5)),
    ],
)
def test_draws_follow_their_distribution(one, law, latin):
    values = draw(4000, 3, latin_hypercube=latin, friction=one)["friction"].to_numpy()
    assert stats.kstest(values, law.cdf).pvalue > 1e-3


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


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Uniform(2.0, 1.0), "low <= high"),
        (lambda: Uniform(0.0, float("inf")), "finite"),
        (lambda: Normal(0.0, 0.0), "deviation > 0"),
        (lambda: Normal(float("nan"), 1.0), "finite"),
        (lambda: Choice(()), "at least one"),
        (lambda: draw(0, 1, x=1.0), "n: got 0"),
        (lambda: draw(5, -1, x=1.0), "seed: got -1"),
    ],
)
def test_bad_draws_are_refused(make, says):
    with pytest.raises(ValueError, match=says):
        make()


def test_grids_and_draws_are_tables():
    assert isinstance(grid(a=1.0), pl.DataFrame) and isinstance(draw(2, 0, a=1.0), pl.DataFrame)

"""Columns of the results table are declared, all of them, or they are an error."""

import numpy as np
import pytest

from jaxbiped.batch import INPUTS, columns, part


def outcome(**changed):
    whole = {name: np.zeros(2) for name in columns.OUTCOMES}
    whole |= {"status": np.zeros(2, int), "success": np.zeros(2, bool), **changed}
    return whole


def test_declared_columns_make_a_frame():
    assert part.outcome_frame(outcome()).columns == list(columns.OUTCOMES)


def test_an_undeclared_outcome_is_an_error_never_an_input():
    with pytest.raises(ValueError, match="undeclared foot_temperature_K"):
        part.outcome_frame(outcome(foot_temperature_K=np.zeros(2)))
    lacking = outcome()
    del lacking["zmp_margin_m"]
    with pytest.raises(ValueError, match="no zmp_margin_m"):
        part.outcome_frame(lacking)


def test_no_column_is_declared_twice():
    every = [*columns.IDENTITY, "seed", *INPUTS, *columns.OUTCOMES]
    assert len(every) == len(set(every))

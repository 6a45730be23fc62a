"""Figures of tuning show what they are given."""

import numpy as np
import pytest

from jaxbiped.report import descents

HISTORY = [
    {"step": 0, "at": [0.1, 2.0], "loss": 3.0, "gradient_norm": 2.0, "share_fallen": 0.0}
    | {"held_out_loss": 4.0, "held_out_success": 0.5},
    {"step": 1, "at": [0.2, 1.5], "loss": 2.0, "gradient_norm": 1.0, "share_fallen": 0.25},
    {"step": 2, "at": [0.3, 1.0], "held_out_loss": 1.0, "held_out_success": 0.75},
]
"""As `tune.descent` writes it: the last step is looked at, not made."""


def lines(axes):
    return [np.asarray(line.get_xydata()) for line in axes.get_lines()]


def test_loss_curve():
    losses, success, slope = descents.loss_curve(HISTORY, "a descent").get_axes()
    tuned, held_out = lines(losses)
    np.testing.assert_array_equal(tuned, [[0, 3.0], [1, 2.0]])
    np.testing.assert_array_equal(held_out, [[0, 4.0], [2, 1.0]])
    np.testing.assert_array_equal(lines(success)[0], [[0, 50.0], [2, 75.0]])
    np.testing.assert_array_equal(lines(slope)[0], [[0, 2.0], [1, 1.0]])
    assert "%" in success.get_ylabel()


def test_value_curves_are_shares_of_the_ranges():
    (axes,) = descents.value_curves(HISTORY, ("a", "b"), [(0.0, 0.5), (1.0, 3.0)], "values").get_axes()
    first, second = lines(axes)
    np.testing.assert_allclose(first, [[0, 0.2], [1, 0.4], [2, 0.6]])
    np.testing.assert_allclose(second, [[0, 0.5], [1, 0.25], [2, 0.0]])


@pytest.mark.parametrize("count", [1, 3, 5])
def test_sensitivity_has_a_panel_for_every_tunable(count):
    """Walks in any order are drawn in that of x."""
    x, slope = np.array([3.0, 1.0, 2.0]), np.arange(3.0 * count).reshape(3, count)
    names = [f"number {i}" for i in range(count)]
    figure = descents.sensitivity(x, slope, -slope, names, "height [cm]", "slopes")
    # They run down the columns.
    panels = sorted(figure.get_axes(), key=lambda panel: panel.get_title(loc="left"))
    assert [panel.get_title(loc="left") for panel in panels] == names
    for i, panel in enumerate(panels):
        _, secants, derivatives = lines(panel)
        np.testing.assert_array_equal(derivatives, np.column_stack([[1, 2, 3], slope[[1, 2, 0], i]]))
        np.testing.assert_array_equal(secants, np.column_stack([[1, 2, 3], -slope[[1, 2, 0], i]]))


def test_sensitivity_counts_what_is_beyond_its_panel():
    secants, derivatives = np.ones((20, 1)), np.ones((20, 1))
    derivatives[3] = 50.0
    (panel,) = descents.sensitivity(np.arange(20.0), derivatives, secants, ["a"], "x", "slopes").get_axes()
    assert panel.get_title(loc="left") == "a (1 beyond the panel)"
    assert panel.get_ylim() == (-2.0, 2.0)


def test_sensitivity_without_numbers_is_drawn():
    nothing = np.full((3, 2), np.nan)
    panels = descents.sensitivity(np.arange(3.0), nothing, nothing, ["a", "b"], "x", "slopes").get_axes()
    assert [panel.get_title(loc="left") for panel in panels] == ["a", "b"]

"""The descent and the trust report, on losses whose derivatives are known: no walk is simulated."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import pytest
from problems import payload

from jaxbiped.adapt.tunables import Tunable
from jaxbiped.tune import Gradient, Settings, Trust, descent, gradient, trust
from jaxbiped.tune.descent import to_unconstrained, to_values

NAMES = ("payload.reflex_time", "payload.settling_time", "payload.x_ref_gain")
GOAL = np.array([0.5, 2.5, 0.4])
"""Values of the tunables where the loss is smallest."""


@pytest.fixture(scope="module")
def problem():
    return payload(12, 1.0, NAMES)


@pytest.fixture
def bowl(monkeypatch, problem):
    """A loss that is a bowl around GOAL, a little different in every scenario."""
    width = np.array([t.high - t.low for t in problem.tunables])
    calls = {"forward": 0, "smoothed": 0, "central": 0, "lie": False, "tooth": 0.0}

    def losses(at, rows):
        return np.sum(((at - GOAL) / width) ** 2) * (1.0 + 0.1 * np.cos(rows))

    def made(p, at, rows, sign=1.0, noise=0.0):
        rng = np.random.default_rng(0)
        slope = 2.0 * (at - GOAL) / width**2 * (1.0 + 0.1 * np.cos(rows))[:, None]
        slope = sign * slope + noise * rng.standard_normal(slope.shape) / width
        n = len(rows)
        return Gradient(p.tunables, at, losses(at, rows), slope, np.zeros(n, int), np.ones(n, bool), 0.0)

    def forward(p, at, rows):
        calls["forward"] += 1
        found = made(p, at, rows, -1.0 if calls["lie"] else 1.0, 3.0 if calls["lie"] else 0.0)
        found = with_teeth(found)
        growth, still = np.ones((len(rows), 8, len(at))), np.zeros((len(rows), len(at)))
        return dataclasses.replace(found, growth_time=np.arange(1.0, 9.0), growth=growth, trigger_slope=still)

    def with_teeth(found):
        """Every tooth falls by the first tunable, whatever the bowl does."""
        tooth = np.array([calls["tooth"], 0.0, 0.0]) / width
        return dataclasses.replace(found, by_scenario=found.by_scenario - tooth)

    def central(p, at, rows, widths=None):
        calls["central"] += 1
        found = made(p, at, rows)
        return with_teeth(found) if widths is None else found

    def smoothed(p, at, rows, *_, **__):
        calls["smoothed"] += 1
        return made(p, at, rows, noise=1e-3)

    monkeypatch.setattr(gradient, "forward", forward)
    monkeypatch.setattr(gradient, "central", central)
    monkeypatch.setattr(gradient, "smoothed", smoothed)
    monkeypatch.setattr(
        gradient, "outcomes", lambda p, at, rows: (losses(at, rows), np.ones(len(rows), bool))
    )
    return calls


SETTINGS = Settings(steps=60, scenarios=4, rate=0.2, trust_every=20, held_out_every=5, patience=4)


def test_values_stay_within_their_bounds(problem):
    for z in np.linspace(-30.0, 30.0, 13):
        at = to_values(problem, np.full(3, z))
        for t, value in zip(problem.tunables, at, strict=True):
            assert t.low <= value <= t.high
    at = np.array([0.3, 2.0, 1.7])
    np.testing.assert_allclose(to_values(problem, to_unconstrained(problem, at)), at, rtol=1e-12)


def test_it_finds_the_bottom_of_a_bowl(bowl, problem, tmp_path):
    tuned = descent.tune(problem, problem.experiment, tmp_path, SETTINGS)
    np.testing.assert_allclose(tuned.values, GOAL, atol=0.03)
    assert tuned.after["loss"] < 1e-2 * tuned.before["loss"]
    assert bowl["smoothed"] == len(tuned.descent.reports)  # only for the reports: forward mode was trusted


def test_a_gradient_that_lies_is_not_followed(bowl, problem, tmp_path):
    bowl["lie"] = True
    tuned = descent.tune(problem, problem.experiment, tmp_path, SETTINGS)
    assert not any(tuned.descent.reports[0]["trusted"])
    np.testing.assert_allclose(tuned.values, GOAL, atol=0.1)


def test_the_trend_is_followed_where_teeth_fall_the_other_way(bowl, problem, tmp_path):
    """Forward mode and near differences agree on a slope that would drive the first tunable to its upper bound."""
    bowl["tooth"] = 4.0
    tuned = descent.tune(problem, problem.experiment, tmp_path, SETTINGS)
    first = tuned.descent.reports[0]
    assert first["slope"] == ["tooth", "trend", "trend"]
    assert first["descended"] == ["wide", "forward", "forward"]
    np.testing.assert_allclose(tuned.values, GOAL, atol=0.03)
    assert bowl["smoothed"] == len(tuned.descent.reports)
    steps = sum("loss" in one for one in tuned.descent.history)
    assert bowl["central"] == steps + len(tuned.descent.reports)  # near ones for the reports only


def test_it_stops_when_held_out_scenarios_get_no_better(bowl, problem, tmp_path):
    far = replace(SETTINGS, steps=400)
    tuned = descent.tune(problem, problem.experiment, tmp_path, far)
    assert tuned.descent.step < 400 and "no smaller held-out loss" in tuned.descent.finished


def test_stopped_and_resumed_is_made_in_one_go(bowl, problem, tmp_path):
    whole = descent.tune(problem, problem.experiment, tmp_path / "whole", replace(SETTINGS, steps=12))

    def stop(line):
        if line.startswith("step   6"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        descent.tune(problem, problem.experiment, tmp_path / "parts", replace(SETTINGS, steps=12), stop)
    parts = descent.tune(problem, problem.experiment, tmp_path / "parts", replace(SETTINGS, steps=12))
    assert json.dumps(parts.descent.history) == json.dumps(whole.descent.history)
    again = descent.tune(problem, problem.experiment, tmp_path / "parts", replace(SETTINGS, steps=12))
    assert again.descent == parts.descent


def test_more_steps_go_on(bowl, problem, tmp_path):
    whole = descent.tune(problem, problem.experiment, tmp_path / "whole", replace(SETTINGS, steps=20))
    descent.tune(problem, problem.experiment, tmp_path / "parts", replace(SETTINGS, steps=10))
    parts = descent.tune(problem, problem.experiment, tmp_path / "parts", replace(SETTINGS, steps=20))
    np.testing.assert_allclose(parts.descent.z, whole.descent.z, rtol=1e-6)


def test_fewer_steps_than_were_made_end_it(bowl, problem, tmp_path):
    def stop(line):
        if line.startswith("step   6"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        descent.tune(problem, problem.experiment, tmp_path, replace(SETTINGS, steps=12), stop)
    assert descent.tune(problem, problem.experiment, tmp_path, replace(SETTINGS, steps=4)).descent.step == 7


EDITS = {
    "better than it was": lambda kept: kept["best"].update(held_out_success=2.0),
    "values out of range": lambda kept: kept["best"].update(at=[9.0, 9.0, 9.0]),
    "no values": lambda kept: kept.update(best={}),
    "another step": lambda kept: kept.update(step=3),
    "no history": lambda kept: kept.update(history=[]),
    "another type": lambda kept: kept.update(z="x"),
    "no checksum": lambda kept: kept.pop("sha256"),
}


@pytest.mark.parametrize("name", EDITS)
def test_a_state_that_was_changed_is_not_gone_on_with(bowl, problem, tmp_path, name):
    settings, file = replace(SETTINGS, steps=6), tmp_path / descent.STATE
    descent.tune(problem, problem.experiment, tmp_path, settings)
    kept = json.loads(file.read_text())
    EDITS[name](kept)
    file.write_text(json.dumps(kept))
    before = file.read_bytes()
    with pytest.raises(ValueError, match="another descent, or one that was changed"):
        descent.tune(problem, problem.experiment, tmp_path, replace(settings, steps=9))
    assert file.read_bytes() == before
    descent.tune(problem, problem.experiment, tmp_path, settings, overwrite=True)


def test_a_descent_of_other_code_is_another_one(bowl, problem, tmp_path, monkeypatch):
    settings = replace(SETTINGS, steps=3)
    descent.tune(problem, problem.experiment, tmp_path, settings)
    monkeypatch.setattr("jaxbiped.batch.store.source_hash", lambda: "0" * 64)
    with pytest.raises(ValueError, match="another descent"):
        descent.tune(problem, problem.experiment, tmp_path, settings)


def test_the_folder_of_another_descent_is_refused(bowl, problem, tmp_path):
    descent.tune(problem, problem.experiment, tmp_path, replace(SETTINGS, steps=2))
    with pytest.raises(ValueError, match="another descent"):
        descent.tune(problem, problem.experiment, tmp_path, replace(SETTINGS, steps=2, rate=0.1))


@pytest.mark.parametrize(
    ("name", "value"), [("steps", 0), ("scenarios", 0), ("patience", 0), ("rate", 0.0), ("sigma", 2.0)]
)
def test_settings_that_cannot_be_meant_are_refused(name, value):
    with pytest.raises(ValueError, match=rf"^{name}: got .*, allowed: "):
        Settings(**{name: value})


def of(slopes, status=None):
    """A gradient of two tunables with ranges 1 and 2."""
    slopes = np.asarray(slopes, float)
    ts = (Tunable("payload.a", 0.0, 1.0, "s", "", "a"), Tunable("payload.b", -1.0, 1.0, "m", "", "b"))
    n = len(slopes)
    status = np.zeros(n, int) if status is None else np.asarray(status)
    growth = np.ones((n, 8, 2))
    return Gradient(ts, np.zeros(2), np.zeros(n), slopes, status, status == 0, 0.0, np.arange(8.0), growth)


def report(problem, forward, central, smoothed, wide=None):
    return Trust(problem, forward, central, forward if wide is None else wide, smoothed, 0.5)


def test_report_compares_what_can_be_compared(problem):
    forward = of([[1.0, 0.0], [2.0, 0.0], [5.0, 3.0]], [0, 0, 1])
    central = of([[1.1, 0.0], [2.0, 0.0], [9.0, 3.0]], [0, 0, 1])
    one = report(problem, forward, central, central)
    np.testing.assert_allclose(one.relative[:2, 0], [0.1 / 1.1, 0.0])
    assert np.isnan(one.relative[:2, 1]).all()  # nothing moved: nothing was compared
    assert one.median_rel == pytest.approx(0.05 / 1.1)
    assert one.share_fallen == pytest.approx(1 / 3)


def test_signs_and_cosine(problem):
    forward, against = of([[1.0, 1.0]] * 4), of([[1.0, -1.0]] * 4)
    one = report(problem, forward, forward, against)
    assert one.cosine(one.central) == pytest.approx(1.0) and one.sign_agreement(one.central) == 1.0
    assert one.cosine(against) == pytest.approx((1.0 - 4.0) / 5.0)  # per range: (1, 2) and (1, -2)
    assert one.sign_agreement(against) == pytest.approx(1.0 / 3.0)
    assert one.trusted.tolist() == [True, False]


@pytest.mark.parametrize(
    ("forward", "smoothed", "trusted"),
    [
        pytest.param((1.0, 1.0), (1.1, 1.0), True, id="one standard error apart"),
        pytest.param((0.11, 1.0), (0.1, 1.0), True, id="just longer than its own error"),
        pytest.param((0.09, 1.0), (0.1, 1.0), False, id="shorter than its own error"),
        pytest.param((1.0, 1.0), (1.6, 1.0), False, id="more than three standard errors apart"),
        pytest.param((1.0, 1.4), (1.0, 1.0), True, id="varies less than twice as much"),
        pytest.param((1.0, 1.5), (1.0, 1.0), False, id="varies more than twice as much"),
        pytest.param((1e-4, 1e-2), (-1e-4, 1e-2), True, id="of no consequence"),
    ],
)
def test_what_is_trusted(problem, forward, smoothed, trusted):
    """By mean and spread over 100 scenarios: a spread of 1 is a standard error of 0.1."""

    def spread(mean, size):
        sign = np.where(np.arange(100) % 2, 1.0, -1.0)
        return of(np.column_stack([mean + size * sign, np.ones(100)]))

    one = report(problem, spread(*forward), spread(*smoothed), spread(*smoothed))
    assert one.share_clipped == 0.0
    assert one.trusted.tolist() == [trusted, True]


def test_the_mixture_leans_to_the_one_with_less_variance(problem):
    rng = np.random.default_rng(1)
    forward = of(np.array([3.0, -3.0]) + 30.0 * rng.standard_normal((200, 2)))
    other = of(np.array([1.0, 1.0]) + 0.1 * rng.standard_normal((200, 2)))
    mixed = trust.mix([trust.MIXED] * 2, forward, other, forward)
    np.testing.assert_allclose(mixed, [1.0, 1.0], atol=0.1)
    both = trust.mix([trust.FORWARD, trust.WIDE], forward, forward, other)
    np.testing.assert_allclose(both, [forward.gradient[0], other.gradient[1]], atol=1.0)


SIGNS = np.where(np.arange(100) % 2, 1.0, -1.0)


@pytest.mark.parametrize(
    ("forward", "near", "wide", "slope"),
    [
        pytest.param(1.0, 1.0, 1.05, "trend", id="all the same"),
        pytest.param(1.0, 2.0, 1.05, "trend", id="near differences are noise"),
        pytest.param(1.0, 1.0, 0.5, "tooth", id="near ones agree, wide ones do not"),
        pytest.param(-1.0, -1.0, 0.5 + SIGNS, "tooth", id="wide ones vary, but not for that"),
        pytest.param(1.0, 1.0, 0.5 + 9.0 * SIGNS, "noise", id="wide ones vary too much to tell"),
        pytest.param(1.0, 2.0, 0.5, "noise", id="near ones do not agree either"),
        pytest.param(1e-5, 1e-5, -1e-5, "trend", id="of no consequence"),
    ],
)
def test_a_slope_is_a_trend_or_a_tooth(problem, forward, near, wide, slope):
    """By 100 scenarios; the other tunable is a trend."""
    one, two, three = (of(np.column_stack([np.zeros(100) + x, np.ones(100)])) for x in (forward, near, wide))
    found = report(problem, one, two, one, three)
    assert found.slope == [slope, "trend"]
    assert found.record()["slope"] == found.slope
    assert any(slope in line and "payload.a" in line for line in found.lines())
    assert found.trusted.tolist() == [slope == "trend", True]
    assert found.descended[0] == {"trend": "forward", "tooth": "wide", "noise": "mixed"}[slope]


def test_a_single_walk_says_what_it_is(problem):
    one = report(problem, of([[1.0, 1.0]]), of([[1.0, 1.0]]), of([[1.0, 1.0]]), of([[-1.0, 1.0]]))
    assert one.slope == ["tooth", "trend"]


def test_wide_differences_are_ticks_wide(problem):
    """A time moves its event; a threshold by as much as it moves the trigger; a gain by a share of its range."""
    names = ("payload.reflex_time", "payload.threshold", "payload.x_ref_gain")
    one = payload(2, 1.0, names)
    starts = np.array([[0.0, 2e-3, 0.0], [0.0, 0.0, 0.0], [0.0, 4e-3, 0.0], [np.nan, np.nan, np.nan]])
    found = dataclasses.replace(of(np.zeros((4, 2))), trigger_slope=starts)
    tick = one.experiment.simulation.control_dt
    np.testing.assert_allclose(gradient.tick_widths(one, found), [tick, tick / 3e-3, 4e-4 * 2.0])
    np.testing.assert_allclose(gradient.wide_widths(one, found), [5.0 * tick, 5.0 * tick / 3e-3, 2e-3 * 2.0])


def test_single_scenarios_are_clipped_and_those_without_a_derivative_left_out(problem):
    slopes = [[1.0, 0.0]] * 9 + [[1e9, 0.0], [np.nan, 0.0]]
    one = report(problem, of(slopes), of(slopes), of(slopes))
    assert one.share_clipped == pytest.approx(2 / 11)
    assert one.clipped_gradient[0] == pytest.approx((9.0 + trust.CLIP) / 11.0)
    assert np.isfinite(one.mixture).all()
    json.dumps(one.record())
    assert any("clipped" in line for line in one.lines())

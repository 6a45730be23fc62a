"""Verdicts by the papers' rules, on walks made by hand: elkahlout's 6 steps, lift-offs at 1.7 + 2.4 k s, 16.8 s."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import robot, score, sim
from jaxbiped.adapt import Controller, ControllerState, Landing, PayloadReflex, Signals
from jaxbiped.adapt.reflex.planned import REFLEX, SETTLE, WALK
from jaxbiped.planner import CosineGait
from jaxbiped.score.verdict import STANDS_FOR
from jaxbiped.sim.statistics import AIRBORNE, FELL, NONFINITE, OK

END = 16.8
UNFINISHED = score.UNFINISHED


@pytest.fixture(scope="module")
def gait() -> CosineGait:
    return CosineGait.preset(robot.load("elkahlout"), 6)


@pytest.fixture(scope="module")
def controller(gait) -> Controller:
    return Controller(gait, Landing(), PayloadReflex.modified(robot.load("elkahlout"), gait))


def walk(
    end: float, status: int = OK, controller: ControllerState | None = None, tilt: float = 0.1
) -> sim.Walk:
    statistics = sim.Statistics(
        status=jnp.array(status, jnp.int32),
        end_time=jnp.array(end),
        peak_roll_pitch=jnp.array([0.05, tilt]),
        peak_foot_force=jnp.zeros(2),
        peak_slip=jnp.zeros(2),
        peak_touchdown_force=jnp.zeros(2),
        peak_touchdown_impulse=jnp.zeros(2),
        zmp_margin=jnp.array(0.01),
        reach_margin=jnp.array(0.01),
        support_time=jnp.array(end),
        touch_time=jnp.zeros(2),
        touch_impulse=jnp.zeros(2),
        anchor=jnp.zeros((2, 2)),
        loaded=jnp.ones(2, bool),
        foot_force=jnp.zeros(2),
        p_world_foot=jnp.zeros((2, 2)),
        out_of_reach_time=jnp.array(0.25),
        p_world_trunk=jnp.zeros(3),
        pelvis_height=jnp.array(0.5),
    )
    return sim.Walk(statistics, None, controller)


def after_reflex(
    controller: Controller, time: float, mode: int = WALK, resumed: float = 9.855, next_step: int = 1
) -> ControllerState:
    """A controller that has had one reflex; the plan went on from half a double support before `next_step`."""
    state = controller.init()
    resume_plan = 1.2 + 2.4 * next_step
    signals = Signals(
        plan_time=jnp.array(resume_plan + time - resumed if mode == WALK else 2.0),
        walking=jnp.array(mode == WALK),
        disturbed=jnp.array(False),
        interruptions=jnp.array(1, jnp.int32),
        interrupted_time=jnp.array(2.0),
        resume_time=jnp.array(resumed),
        next_step=jnp.array(next_step, jnp.int32),
    )
    return ControllerState(jnp.array(time), state.stages, signals)


def flat(mass: float = 0.0, time: float = 1e6, end: float = 1e6) -> sim.Scenario:
    return sim.Scenario.flat(1).with_payload(mass, time, end)


def judged(walk: sim.Walk, gait: CosineGait, scenario: sim.Scenario) -> tuple[int, float]:
    """OK for a success, else the status; the status itself always says what the robot did."""
    verdict = score.judge(walk, gait, scenario)
    success, did = bool(verdict.success), int(walk.statistics.status)
    assert int(verdict.status) == (did if did != OK else OK if success else UNFINISHED)
    return OK if success else int(verdict.status), float(verdict.until)


@pytest.mark.parametrize("status", [FELL, NONFINITE, AIRBORNE])
def test_what_the_robot_did_after_its_success_stands_in_its_status(gait, status):
    """By elkahlout's rule the walk is a success after two whole steps, and the robot came to grief all the same."""
    verdict = score.judge(walk(16.0, status), gait, flat(2.5, 0.1))
    assert bool(verdict.success) and int(verdict.status) == status
    verdict = score.judge(walk(3.0, status), gait, flat(2.5, 0.1))
    assert not bool(verdict.success) and int(verdict.status) == status


@pytest.mark.parametrize(
    ("end", "status", "expected"),
    [
        (17.3, OK, OK),
        (END, OK, OK),
        (16.0, OK, UNFINISHED),
        (10.0, FELL, FELL),
        (16.7, FELL, FELL),
        (17.0, FELL, OK),
        (3.0, NONFINITE, NONFINITE),
    ],
)
@pytest.mark.parametrize(
    "scenario",
    [flat(), flat(0.0, 2.4), flat(0.0, 2.4, 5.0), flat(5.0, 20.0), flat(40.0, 0.0), flat(5.0, 0.0, 20.0)],
    ids=["flat", "0 kg", "0 kg taken off", "too late", "carried from the start", "taken off too late"],
)
def test_without_a_load_the_walk_must_be_finished(gait, end, status, expected, scenario):
    assert judged(walk(end, status), gait, scenario) == (expected, pytest.approx(END))
    verdict = score.judge(walk(end, status), gait, scenario)
    assert bool(verdict.finished) == bool(verdict.success)


@pytest.mark.parametrize(
    ("load", "until"),
    [
        (0.0005, 6.5),  # before the first step: steps 0 and 1 are whole
        (1.6, 6.5),
        (1.8, 8.9),  # in the single support of step 0
        (3.3, 8.9),  # in its double support
        (4.2, 11.3),
        (8.8, 13.7),
        (9.0, 16.1),
    ],
)
def test_without_a_reflex_two_whole_steps_after_the_step_of_the_loading(gait, load, until):
    scenario = flat(2.5, load)
    assert judged(walk(until - 0.1, FELL), gait, scenario) == (FELL, pytest.approx(until))
    assert judged(walk(until - 0.1), gait, scenario) == (UNFINISHED, pytest.approx(until))
    assert judged(walk(until + 0.1, FELL), gait, scenario) == (OK, pytest.approx(until))
    assert judged(walk(17.3), gait, scenario) == (OK, pytest.approx(until))


@pytest.mark.parametrize(
    ("load", "end", "until"),
    [
        (0.0, 0.0005, 6.5),
        (0.0, 1.8, 8.9),  # carried from the start: what counts is that it is taken off
        (1.8, 4.2, 11.3),
        (1.8, 8.8, 13.7),
        (1.8, 17.2, 8.9),  # not within the walk: the robot fell or stood by then
    ],
)
def test_taking_a_load_off_is_a_loading_and_the_last_one_counts(gait, load, end, until):
    scenario = flat(2.5, load, end)
    assert judged(walk(until - 0.1, FELL), gait, scenario) == (FELL, pytest.approx(until))
    assert judged(walk(until + 0.1, FELL), gait, scenario) == (OK, pytest.approx(until))
    assert judged(walk(17.1), gait, scenario) == (OK, pytest.approx(until))


def test_a_fall_before_the_load_is_taken_off_is_judged_by_when_it_was_put_on(gait):
    for end, expected in ((8.8, FELL), (9.0, OK)):
        assert judged(walk(end, FELL), gait, flat(2.5, 1.8, 10.0)) == (expected, pytest.approx(8.9))


def test_a_load_taken_off_after_a_reflex_is_judged_by_the_step_it_is_taken_off_in(gait, controller):
    """As the load at 12 s below; one taken off while the reflex lasts is part of what it recovers from."""
    one = walk(18.0, OK, after_reflex(controller, 18.0))
    assert judged(one, gait, flat(2.5, 2.4, 12.0)) == (OK, pytest.approx(11.3 + 6.255, abs=1e-5))
    until = 9.855 + 8.9 - 3.6
    assert judged(one, gait, flat(2.5, 2.4, 5.0)) == (OK, pytest.approx(until, abs=1e-5))


def test_watched_for_a_recovery_from_every_change_the_reflex_reacts_to(gait, controller):
    robot_, plan = robot.load("elkahlout"), END + STANDS_FOR
    again = Controller(gait, PayloadReflex.repaired(robot_, gait))
    for one, most in ((Controller(gait), 0), (controller, 1), (again, 2)):
        delay = one.longest_delay()
        for changes in (0, 1, 2):
            wanted = plan + min(changes, most) * delay
            assert score.watch_time(one, changes) == pytest.approx(wanted, abs=1e-5)


def test_a_load_too_late_for_two_whole_steps_is_unfinished_and_yet_finished(gait):
    verdict = score.judge(walk(17.3), gait, flat(2.5, 11.5))
    assert int(verdict.status) == UNFINISHED and bool(verdict.finished)
    assert np.isinf(verdict.until)
    assert judged(walk(13.0, FELL), gait, flat(2.5, 11.5))[0] == FELL


def test_after_a_reflex_two_whole_steps_from_where_the_walk_goes_on(gait, controller):
    """Resumed at 9.855 s with plan time 3.6 s; step 2 ends at plan time 8.9 s."""
    until = 9.855 + 8.9 - 3.6
    for end, status, expected in (
        (until - 0.1, FELL, FELL),
        (until - 0.1, OK, UNFINISHED),
        (until + 0.1, FELL, OK),
        (until + 5.0, OK, OK),
    ):
        one = walk(end, status, after_reflex(controller, end))
        assert judged(one, gait, flat(15.0, 2.4)) == (expected, pytest.approx(until, abs=1e-5))
    assert not score.judge(one, gait, flat(15.0, 2.4)).finished  # type: ignore[possibly-undefined]


@pytest.mark.parametrize(("mode", "status"), [(REFLEX, FELL), (SETTLE, FELL), (SETTLE, OK)])
def test_in_the_midst_of_a_reflex_nothing_is_won(gait, controller, mode, status):
    one = walk(30.0, status, after_reflex(controller, 30.0, mode))
    expected = FELL if status == FELL else UNFINISHED
    assert judged(one, gait, flat(15.0, 2.4)) == (expected, np.inf)


def test_a_reflex_near_the_end_leaves_too_few_steps(gait, controller):
    one = walk(40.0, OK, after_reflex(controller, 40.0, next_step=5))
    assert judged(one, gait, flat(15.0, 2.4))[0] == UNFINISHED


def test_a_load_after_an_idle_reflex_is_judged_by_the_step_it_came_in(gait, controller):
    """The plan is 6.255 s behind: a load at 12 s comes at plan time 5.745 s, in step 1; step 3 ends at 11.3 s."""
    one = walk(18.0, OK, after_reflex(controller, 18.0))
    assert judged(one, gait, flat(2.5, 12.0)) == (OK, pytest.approx(11.3 + 6.255, abs=1e-5))


def test_a_walk_put_off_by_an_idle_reflex_is_finished_later(gait, controller):
    for end, expected in ((END + 1.0, UNFINISHED), (END + 6.3, OK)):
        one = walk(end, OK, after_reflex(controller, end))
        assert judged(one, gait, flat()) == (expected, pytest.approx(END + 6.255, abs=1e-5))


def test_margins(gait, controller):
    state = after_reflex(controller, 20.0)
    verdict = score.judge(walk(20.0, OK, state, tilt=0.2), gait, flat())
    assert float(verdict.tilt_margin) == pytest.approx(np.deg2rad(45.0) - 0.2)
    assert float(verdict.out_of_reach_time) == 0.25


def test_a_walk_taken_to_numpy_is_judged_alike(gait, controller):
    one = walk(20.0, OK, after_reflex(controller, 20.0))
    as_numpy = jax.tree.map(np.asarray, one)
    assert judged(as_numpy, gait, flat(15.0, 2.4)) == judged(one, gait, flat(15.0, 2.4))


def test_many_at_once(gait, controller):
    cases = [(17.3, OK, 0.0, 1e6), (12.0, FELL, 15.0, 2.4), (16.0, OK, 15.0, 2.4), (18.0, OK, 2.5, 12.0)]
    walks = [walk(end, status, after_reflex(controller, end)) for end, status, *_ in cases]
    scenarios = [flat(mass, time) for *_, mass, time in cases]
    stack = lambda items: jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)  # noqa: E731
    batch = eqx.filter_jit(eqx.filter_vmap(lambda w, s: score.judge(w, gait, s)))(
        stack(walks), stack(scenarios)
    )
    single = stack([score.judge(w, gait, s) for w, s in zip(walks, scenarios, strict=True)])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), batch, single)
    assert [score.STATUS_TEXT[int(i)] for i in batch.status] == ["unfinished", "fell", "ok", "ok"]

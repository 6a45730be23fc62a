"""A controller without adaptation plays its gait, whatever it senses; with it, stages tell each other what happens."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import robot
from jaxbiped.adapt import Controller, Landing, PayloadReflex, Sensed
from jaxbiped.adapt.reflex.planned import WALK
from jaxbiped.planner import CosineGait, PolynomialGait, at


def reading(time, rng):
    shapes = {
        "corner_force": (2, 4),
        "ankle_wrench": (2, 6),
        "angle": (2, 6),
        "speed": (2, 6),
        "roll_pitch": (2,),
        "rate": (3,),
        "zmp_world": (2,),
        "zmp_body": (2,),
        "switch_time": (2, 4),
    }
    noise = {name: jnp.asarray(rng.normal(size=shape), jnp.float32) for name, shape in shapes.items()}
    return Sensed(time=jnp.asarray(time, jnp.float32), switch=jnp.asarray(rng.random((2, 4)) < 0.5), **noise)


@pytest.mark.parametrize(("name", "kind"), [("surena3", PolynomialGait), ("elkahlout", CosineGait)])
def test_open_loop_is_the_plan(name, kind):
    controller = Controller(kind.preset(robot.load(name), 4))
    step, planned = eqx.filter_jit(Controller.step), eqx.filter_jit(at)
    rng = np.random.default_rng(0)
    state = controller.init()
    assert float(state.plan_time) == 0.0
    end = float(controller.gait.duration)
    for time in np.linspace(0.0, end + 1.0, 40):
        state, targets = step(controller, state, reading(time, rng))
        wanted = planned(controller.gait, jnp.asarray(time, jnp.float32))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6), targets, wanted)
        assert float(state.plan_time) == float(targets.time) == pytest.approx(time, rel=1e-6)
    np.testing.assert_allclose(targets.velocity.pelvis, 0.0, atol=1e-5)


@pytest.fixture(scope="module")
def heard():
    """States of controllers with and without landing: the swing foot touches at 0.7 T_s, 200 N come 50 ms later."""
    biped = robot.load("surena3")
    gait = PolynomialGait.preset(biped, 4)
    touch = float(gait.timing.liftoff(0) + 0.7 * gait.timing.T_s)
    ticks = jnp.arange(1, int((touch + 1.0) / 0.004)) * 0.004

    def states(controller):
        def tick(state, t):
            closed = jnp.zeros((2, 4), bool).at[gait.timing.first_swing].set(t >= touch)
            force = jnp.full((2, 4), 100.0 + jnp.where(t >= touch + 0.05, 25.0, 0.0))
            when = jnp.where(closed, touch, jnp.inf)
            sensed = Sensed.nothing(t, corner_force=force, switch=closed, switch_time=when)
            state, targets = controller.step(state, sensed)
            return state, (state, targets.time)

        return jax.lax.scan(tick, controller.init(), ticks)[1]

    reflex = PayloadReflex.repaired(biped, gait)
    run = eqx.filter_jit(states)
    both, plan_time = jax.tree.map(np.asarray, run(Controller(gait, reflex, Landing.repaired())))
    alone, _ = jax.tree.map(np.asarray, run(Controller(gait, reflex)))
    return touch, both, plan_time, alone


def test_signals_are_what_the_stages_know(heard):
    _, both, plan_time, _ = heard
    signals, reflex = both.signals, both.stages["payload"]
    assert set(signals.walking) == {True, False} and set(signals.disturbed) == {True, False}
    np.testing.assert_array_equal(signals.walking, reflex.mode == WALK)
    np.testing.assert_array_equal(signals.interruptions, reflex.reflexes)
    np.testing.assert_array_equal(signals.interrupted_time, reflex.trigger_time)
    np.testing.assert_array_equal(signals.resume_time, reflex.resume_time)
    np.testing.assert_array_equal(signals.next_step, reflex.next_step)
    np.testing.assert_array_equal(signals.plan_time, plan_time)


def test_a_touch_makes_the_reflex_wait_for_the_slower_filter(heard):
    """Its threshold of 40 N is a fifth of the load: -ln(0.8) = 0.22 s of its time constant after it."""
    touch, both, _, alone = heard
    first = int(np.argmax(both.signals.disturbed))
    assert both.time[first] - 0.004 <= touch <= both.time[first]
    late, soon = (float(one.signals.interrupted_time[-1]) - touch - 0.05 for one in (both, alone))
    assert 0.0 < soon < 0.1 and late == pytest.approx(0.223, abs=0.02)

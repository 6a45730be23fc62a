"""A controller without adaptation plays its gait, whatever it senses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import robot
from jaxbiped.adapt import Controller, Sensed
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

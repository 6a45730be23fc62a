"""Landing and payload reflex in one controller: obstacles and a load in the same walk, without and with physics."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import planner, robot
from jaxbiped.adapt import Controller, Landing, PayloadReflex, Sensed
from jaxbiped.sim import Options, Scenario, prepare

DT = 0.004
STEPS = 6
DELTA_Z = 0.01


NOT_OPTIMISED = {"xla_backend_optimization_level": 0}
"""How to compile what runs once: faster to compile, slower to run."""
LOAD_TIMES = np.arange(3.4, 5.2, 0.2)
GROUNDS = ((0.0, 0.0), (0.02, 0.0), (-0.02, 0.0))


def play(controller: Controller, ground: Any, load_time: Any, ticks: int) -> Any:
    """Kinematics only: feet close their switches within DELTA_Z of the ground under them, left and right lane.

    Returns:
        Commanded soles and pelvis, the mode at every tick, and the last state.
    """

    stage = controller.stage("payload")
    assert stage is not None

    def tick(carry: Any, time: Any) -> Any:
        state, sole = carry
        closed = sole[:, 2] <= ground + DELTA_Z
        force = jnp.where(time > load_time, 1000.0, 800.0)
        sensed = Sensed.nothing(
            time,
            switch=jnp.broadcast_to(closed[:, None], (2, 4)),
            switch_time=jnp.full((2, 4), time),
            corner_force=jnp.full((2, 4), force / 8.0),
            zmp_body=jnp.stack([stage.params.zmp_balanced + 0.01, jnp.zeros(())]),
        )
        state, targets = controller.step(state, sensed)
        assert state.stages["payload"] is not None
        row = (targets.position.sole, targets.position.pelvis, state.stages["payload"].mode)
        return (state, targets.position.sole), row

    start = (controller.init(), controller.gait.task(jnp.zeros(())).sole)
    (state, _), rows = jax.lax.scan(tick, start, jnp.arange(ticks) * DT)
    return rows, state


@eqx.filter_jit
def play_all(controller: Controller, ground: Any, load_time: Any, ticks: int) -> Any:
    """Many walks at once."""
    return jax.vmap(lambda *case: play(controller, case[0], case[1], ticks))(ground, load_time)


@pytest.fixture(scope="module")
def both() -> Controller:
    biped = robot.load("surena3")
    gait = planner.PolynomialGait.preset(biped, STEPS)

    @partial(jax.jit, compiler_options=NOT_OPTIMISED)
    def make(biped: Any, gait: Any) -> Controller:
        return Controller(gait, Landing.repaired(), PayloadReflex.repaired(biped, gait))

    return make(biped, gait)


def ticks_of(controller: Controller) -> int:
    return int((float(controller.gait.duration) + 14.0) / DT)


@pytest.fixture(scope="module")
def walks(both) -> Any:
    """Every load on every ground, (grounds, load times): soles, pelvis, modes; and the number of reflexes."""
    grid = np.array([(*ground, time) for ground in GROUNDS for time in LOAD_TIMES], np.float32)
    rows, state = play_all(both, jnp.asarray(grid[:, :2]), jnp.asarray(grid[:, 2]), ticks_of(both))
    shape = (len(GROUNDS), len(LOAD_TIMES))
    return jax.tree.map(lambda leaf: np.asarray(leaf).reshape(*shape, *leaf.shape[1:]), (*rows, state))


@pytest.mark.parametrize("load", range(len(LOAD_TIMES)), ids=[f"{time:.1f}s" for time in LOAD_TIMES])
@pytest.mark.parametrize("ground", range(len(GROUNDS)))
def test_commands_stay_continuous_through_obstacle_and_load(walks, ground, load):
    sole, pelvis, mode, state = jax.tree.map(lambda leaf: leaf[ground, load], walks)
    assert state.stages["payload"].reflexes == 1
    assert mode[-1] == 0
    for path in (sole.reshape(-1, 6), pelvis):
        speed = np.abs(np.diff(path, axis=0)).max() / DT
        assert speed < 1.6, "a jump of a centimetre would be 2.5 m/s"
    assert np.all(np.isfinite(sole)) and np.all(np.isfinite(pelvis))


def test_a_load_on_flat_ground_leaves_landing_as_it_is(both, walks):
    """Landing on flat ground adds two millimetres at most to what the payload stage asks for, recovery included."""
    alone = eqx.tree_at(lambda c: c.stages, both, (both.stage("payload"),))
    load = int(np.abs(LOAD_TIMES - 4.2).argmin())
    sole, pelvis, *_ = jax.tree.map(lambda leaf: leaf[0, load], walks)
    ours = (jnp.zeros((1, 2)), jnp.asarray(LOAD_TIMES[load : load + 1], jnp.float32), ticks_of(both))
    (plain_sole, plain_pelvis, _), _ = jax.tree.map(lambda leaf: leaf[0], play_all(alone, *ours))
    np.testing.assert_allclose(sole[..., 1:], plain_sole[..., 1:], atol=2e-3)
    np.testing.assert_allclose(pelvis[..., 1:], plain_pelvis[..., 1:], atol=1.5e-3)


@pytest.mark.slow
def test_load_during_a_walk_over_obstacles():
    """surena3 in closed loop: a load before, on and after an obstacle, and an obstacle after the recovery."""
    biped = robot.load("surena3")
    gait = planner.PolynomialGait.preset(biped, 8)
    controller = Controller(gait, Landing.repaired(), PayloadReflex.repaired(biped, gait))
    options, duration = Options(), float(gait.duration) + 12.0
    flat = Scenario.flat(1)
    cases = [
        flat.with_payload(15.0, 3.6),
        flat.with_payload(8.0, 4.2),
        flat.with_obstacle(biped, gait, 1, 0.02).with_payload(8.0, 5.4),
        flat.with_obstacle(biped, gait, 1, 0.02).with_payload(8.0, 7.2),
        flat.with_obstacle(biped, gait, 1, -0.02).with_payload(8.0, 5.4),
        flat.with_obstacle(biped, gait, 1, -0.02).with_payload(8.0, 7.2),
    ]
    batch = jax.tree.map(lambda *leaf: jnp.stack(leaf), *cases)
    walk = jax.tree.map(np.asarray, prepare(biped, controller, options).run_many(batch, duration))
    np.testing.assert_array_equal(walk.statistics.status, 0)
    assert np.all(walk.controller.stages["payload"].reflexes >= 1)
    assert np.all(np.degrees(walk.statistics.peak_roll_pitch) < 8.0)

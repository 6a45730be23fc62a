"""Touches and reflexes are read off a trace as they were put into it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import robot, score, sim
from jaxbiped.adapt import Controller, PayloadReflex, Sensed
from jaxbiped.planner import CosineGait, at

N_STEPS = 4
DT = 2e-3
LOADED, WEIGHT, LOAD = 2.4, 784.8, 120.0
HOLD = 2.5
"""Standing still after the recovery step, not half of settling [s]."""


@pytest.fixture(scope="module")
def gait() -> CosineGait:
    return CosineGait.preset(robot.load("elkahlout"), N_STEPS)


def sample(targets: Any, time: Any, switch: Any) -> sim.Sample:
    """A trace of a robot that is where it should be."""
    n = len(time)
    return sim.Sample(
        time=jnp.asarray(time),
        p_world_trunk=targets.position.pelvis,
        roll_pitch_yaw=jnp.zeros((n, 3)),
        p_world_sole=targets.position.sole,
        foot_force=jnp.zeros((n, 2, 3)),
        corner_force=jnp.zeros((n, 2, 4)),
        zmp_world=jnp.zeros((n, 2)),
        switch=jnp.asarray(switch),
        torque=jnp.zeros((n, 2, 6)),
        qpos=jnp.zeros((n, 19)),
        targets=targets,
        filtered_corner_force=jnp.zeros((n, 2, 4)),
    )


@pytest.fixture(scope="module")
def planned(gait) -> sim.Sample:
    """The plan, over ground that closes all switches of a foot lower than 10 mm."""
    time = jnp.arange(round(float(gait.duration) / DT)) * DT
    targets = jax.jit(jax.vmap(lambda t: at(gait, t)))(time)
    low = np.asarray(targets.position.sole)[..., 2] < 0.01
    return sample(targets, time, np.repeat(low[..., None], 4, axis=-1))


# Touches


def test_every_step_of_the_plan_touches_when_its_foot_is_low(gait, planned):
    found = score.touches(planned)
    assert [(t.step, t.foot, t.kind) for t in found] == [
        (k, robot.SIDE_NAMES[k % 2], "planned") for k in range(N_STEPS)
    ]
    p = gait.params
    low = float(p.t_ss) * (1.0 - np.arccos(1.0 - 2.0 * 0.01 / float(p.h_s)) / (2.0 * np.pi))
    for touch in found:
        liftoff = float(gait.timing.liftoff(touch.step))
        assert touch.time == pytest.approx(liftoff + low, abs=1.1 * DT)
        assert touch.late == pytest.approx(low - float(p.t_ss), abs=1.1 * DT)
        assert float(planned.time[touch.row]) == touch.time
        last = touch.step == N_STEPS - 1
        end = float(gait.duration) if last else float(gait.timing.liftoff(touch.step + 1))
        assert float(planned.time[touch.end_row]) == pytest.approx(end, abs=1.1 * DT)


def test_obstacle_and_hole_show_as_early_and_late(gait, planned):
    touchdown = [float(gait.timing.touchdown(k)) for k in (1, 2)]
    time, switch = np.asarray(planned.time), np.array(planned.switch)
    switch[(time > touchdown[0] - 0.4) & (time < touchdown[0]), 1, 2] = True
    in_step = (time > touchdown[1] - 0.6) & (time < touchdown[1] + 0.3)
    switch[in_step, 0] = False
    found = score.touches(sample(planned.targets, time, switch))
    assert found[1].late == pytest.approx(-0.4, abs=1.1 * DT)
    assert found[2].late == pytest.approx(0.3, abs=1.1 * DT)


def test_what_closes_before_mid_swing_or_in_the_stance_foot_is_no_touch(gait, planned):
    time, switch = np.asarray(planned.time), np.array(planned.switch)
    liftoff = float(gait.timing.liftoff(1))
    switch[(time > liftoff + 0.4) & (time < liftoff + 0.5), 1] = True
    assert score.touches(sample(planned.targets, time, switch)) == score.touches(planned)
    switch[time < liftoff + 2.4, 1] = True  # never off the ground in step 1
    assert [t.step for t in score.touches(sample(planned.targets, time, switch))] == [0, 2, 3]


def test_nothing_is_read_after_a_fall(gait, planned):
    fall = int((float(gait.timing.liftoff(2)) + 0.1) / DT)
    time = np.minimum(np.asarray(planned.time), float(planned.time[fall]))
    assert score.walked_rows(time) == fall + 1
    assert [t.step for t in score.touches(sample(planned.targets, time, planned.switch))] == [0, 1]


# Reflexes


@pytest.fixture(scope="module")
def reflexive(gait) -> tuple[sim.Sample, Any, PayloadReflex]:
    """The payload stage under a load felt from LOADED on, without a robot: its trace and its last state."""
    params = PayloadReflex.modified(robot.load("elkahlout"), gait, hold_time=HOLD)
    controller = Controller(gait, params)

    def tick(state, time):
        force = (WEIGHT + jnp.where(time > LOADED, LOAD, 0.0)) / 8.0
        sensed = Sensed.nothing(
            time,
            corner_force=jnp.full((2, 4), force),
            zmp_body=jnp.stack([jnp.where(time > LOADED, -0.01, -0.035), 0.0]),
        )
        return controller.step(state, sensed)

    time = jnp.arange(1, round(20.0 / DT)) * DT
    state, targets = eqx.filter_jit(lambda: jax.lax.scan(tick, controller.init(), time))()
    return sample(targets, time, np.zeros((len(time), 2, 4), bool)), state.stages["payload"], params


def test_a_reflex_is_read_off_the_trace(reflexive):
    trace, state, params = reflexive
    (found,) = score.recoveries(trace, params)
    assert LOADED < found.triggered < LOADED + 0.1
    assert found.triggered == pytest.approx(float(state.trigger_time), abs=1e-5)
    lengths = [float(t) for t in (params.reflex_time, params.settling_time, params.shift_time)]
    expected = found.triggered + np.cumsum(lengths)
    assert [found.reflex_end, found.settled, found.shifted] == pytest.approx(list(expected))
    assert found.resumed == pytest.approx(float(state.resume_time), abs=1e-4)
    assert found.recovered == pytest.approx(float(state.resume_time) - HOLD, abs=1e-4)
    assert found.x_shift == pytest.approx(float(state.x_shift_new), abs=1e-4)
    assert found.x_shift is not None and found.x_shift > 0.01


@pytest.mark.parametrize(
    ("end", "reached"), [(4.0, 1), (6.8, 2), (7.2, 3), (8.5, 4), (12.0, 5)], ids=lambda value: str(value)
)
def test_what_the_walk_did_not_get_to_is_none(reflexive, end, reached):
    trace, _, params = reflexive
    whole = np.asarray(trace.time)
    time = np.minimum(whole, whole[int(end / DT)])
    (found,) = score.recoveries(sample(trace.targets, time, trace.switch), params)
    times = [found.reflex_end, found.settled, found.shifted, found.recovered, found.resumed]
    assert [t is not None for t in times] == [True] * reached + [False] * (5 - reached)
    assert (found.x_shift is not None) == (reached >= 3)


def test_a_walk_without_a_reflex_has_none(planned, reflexive):
    assert score.recoveries(planned, reflexive[2]) == []

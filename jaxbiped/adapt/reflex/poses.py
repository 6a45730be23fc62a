"""Poses of soles and pelvis outside WALK: reflex, shift of x_ref, recovery step (Eqs. 3.11-3.17, 3.21, 3.26-3.40)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.adapt.blends import longest_time_to_rest, quintic_to_rest, smooth
from jaxbiped.adapt.reflex import quick_step
from jaxbiped.adapt.reflex.modes import applied_shift, ramp, recovery_step
from jaxbiped.adapt.reflex.planned import RECOVER, PayloadState, PlannedReflex, RecoveryStep, stance_place
from jaxbiped.planner import DOUBLE_SUPPORT, TaskSpace, Timing
from jaxbiped.robot import LEFT, RIGHT

Scalar = Float[Array, ""]


def pose(stage: PlannedReflex, state: PayloadState, timing: Timing, time: Scalar) -> TaskSpace:
    """Soles and pelvis in the world outside WALK; the stance foot stands still."""
    since = time - state.trigger_time
    step = recovery_step(stage, state, timing)
    before = state.mode < RECOVER
    in_body = jnp.where(
        before,
        reflex_pose(stage, state, since, time),
        recovery_pose(stage, state, step, time),
    )
    stance = jnp.where(before, 1 - state.swing, 1 - step.swing)
    pelvis = stance_place(state, stance) - in_body[stance]
    return TaskSpace(pelvis + in_body, pelvis)


def reflex_pose(
    stage: PlannedReflex, state: PayloadState, since: Scalar, time: Scalar
) -> Float[Array, "2 3"]:
    """Soles in the body frame up to the end of SHIFT (Eqs. 3.11-3.17 and 3.21)."""
    p, start, way = stage.params, state.start[0], state.end - state.start[0]
    if p.two_speeds:
        soles = quick_step.soles(stage, state, since)
    elif p.smooth_reflex or p.smooth_ramp:
        T = jnp.stack([p.reflex_time, body_time(stage, state), p.reflex_time])
        soles = start + quintic_to_rest(since, T, state.start[1], state.start[2], way)
    else:
        fraction = ramp(state, state.trigger_time, p.reflex_time, time)
        soles = start + (motion_before(state, time) + fraction * way)
    return soles.at[:, 0].add(applied_shift(stage, state, time) - state.x_shift)


def motion_before(state: PayloadState, time: Scalar) -> Float[Array, "2 3"]:
    """Rest of the motion that a ramp ends which starts inside the tick to come [m]."""
    back = jnp.minimum(state.time - state.trigger_time, 0.0)
    share = state.share(-back)
    _, velocity, acceleration = state.start
    left = back * velocity + 0.5 * back * back * acceleration
    since = time - state.time
    return left + share * (since * (velocity + back * acceleration) + 0.5 * since * since * acceleration)


def body_time(stage: PlannedReflex, state: PayloadState) -> Scalar:
    """Time in which the body gets to the middle sideways [s].

    Not so long that it swings beyond it; the shorter, the nearer it is to the middle of two feet on the ground.
    """
    p, way = stage.params, (state.end - state.start[0])[LEFT, 1]
    if p.two_speeds:
        return quick_step.body_times(stage, state)[1]
    if not p.smooth_reflex:
        return p.reflex_time
    towards = jnp.where(way >= 0.0, -1.0, 1.0)
    velocity, acceleration = towards * state.start[1, LEFT, 1], towards * state.start[2, LEFT, 1]
    half_distance = 0.5 * (state.end[LEFT, 1] - state.end[RIGHT, 1])
    share = 0.5 + 0.5 * jnp.minimum(jnp.abs(way) / half_distance, 1.0)
    longest = jnp.where(state.support == DOUBLE_SUPPORT, share, 1.0) * p.body_time
    without_overshoot = longest_time_to_rest(velocity, acceleration, jnp.abs(way))
    return jnp.maximum(jnp.minimum(without_overshoot, longest), p.reflex_time)


def recovery_pose(
    stage: PlannedReflex, state: PayloadState, step: RecoveryStep, time: Scalar
) -> Float[Array, "2 3"]:
    """Soles in the body frame in RECOVER and HOLD (Eqs. 3.26-3.40)."""
    p = stage.params
    since = time - (state.trigger_time + p.reflex_time + p.settling_time + p.shift_time)
    aloft = jnp.clip((since - 0.5 * step.t_ds) / step.t_ss, 0.0, 1.0)
    wave = jnp.clip(since / (step.t_ss + step.t_ds), 0.0, 1.0)
    foot = 0.5 * (1.0 - jnp.cos(jnp.pi * aloft))
    way, swing = step.goal[:, 0] - state.end[:, 0], step.swing
    body = way[1 - swing] * foot
    if p.steady_recovery:
        begun = smooth(since / (0.5 * step.t_ds))
        ended = smooth((since - 0.5 * step.t_ds - step.t_ss) / (0.5 * step.t_ds))
        body = displacement_to_stand(stage, state, step) * (begun - ended) + way[1 - swing] * ended
    forward = jnp.full_like(way, body).at[swing].add((way[swing] - way[1 - swing]) * foot)
    aside = jnp.where(swing == LEFT, 1.0, -1.0) * 0.5 * step.sway * (1.0 - jnp.cos(2.0 * jnp.pi * wave))
    up = 0.5 * step.lift * (1.0 - jnp.cos(2.0 * jnp.pi * aloft))
    sole = state.end.at[:, 0].add(forward + state.x_shift_new - state.x_shift)
    return sole.at[:, 1].add(aside).at[swing, 2].add(up)


def displacement_to_stand(stage: PlannedReflex, state: PayloadState, step: RecoveryStep) -> Scalar:
    """Forward displacement of the stance foot in the body frame before the other one lifts off [m]."""
    if stage.params.x_stand is None:
        return jnp.zeros_like(step.f)
    from_here = stage.params.x_stand + state.x_shift - state.end[1 - step.swing, 0]
    return jnp.where(step.lift > 0.0, from_here, 0.0)

"""The trigger of a reflex: a jump of the low-passed foot force (Eqs. 3.7-3.17, 4.5, 4.6)."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.adapt.reflex import quick_step
from jaxbiped.adapt.reflex.modes import applied_shift
from jaxbiped.adapt.reflex.planned import (
    REFLEX,
    SHIFT,
    WALK,
    PayloadState,
    PlannedReflex,
    decided,
    foot_ahead,
    matching_step,
)
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.planner import RECOVERY_STEP, SINGLE_SUPPORT, Phase, Targets, Timing

Scalar = Float[Array, ""]
_NOTHING, _FAST, _SLOW = range(3)
"""Number of the low-pass that has felt a load."""


def low_passed(stage: PlannedReflex, state: PayloadState, sensed: Sensed) -> PayloadState:
    """Low-pass force and ZMP (Eqs. 3.7 and 3.18); the first reading is taken as it is."""
    p, first = stage.params, state.time < 0.0
    dt = sensed.time - state.time
    force, zmp = sensed.corner_force.sum(), sensed.zmp_body[0]

    def low_pass(old: Scalar, new: Scalar, time_constant: Scalar) -> Scalar:
        return jnp.where(first, new, old + (1.0 - jnp.exp(-dt / time_constant)) * (new - old))

    return replace(
        state,
        time=sensed.time,
        tick=jnp.where(first, 0.0, dt),
        force=low_pass(state.force, force, p.force_time_constant),
        slow_force=low_pass(state.slow_force, force, p.slow_time_constant),
        zmp=low_pass(state.zmp, zmp, p.zmp_time_constant),
        weight=jnp.where(first, force, state.weight),
    )


def watch(
    stage: PlannedReflex, state: PayloadState, before: PayloadState, disturbed: Bool[Array, ""]
) -> tuple[Bool[Array, ""], Scalar]:
    """Tell whether the force has left the band around the weight, and when the reflex to it starts.

    It is felt up to a tick after it has done so. A start that is felt at once by one tick and late by the next
    would jump by a tick where a little more load moves it on: so every one comes a tick after the crossing.
    """
    p, walking = stage.params, state.mode == WALK
    again = state.reflexes > 0
    calm = ~(again & (state.time - state.resume_time < p.rearm_time)) & ~disturbed
    fast, fast_time = crossing(stage, state, before.force, state.force, p.threshold, before.time)
    slow, slow_time = crossing(
        stage, state, before.slow_force, state.slow_force, p.slow_threshold, before.time
    )
    fast, slow = fast & walking & calm, slow & (walking | (state.mode >= SHIFT))
    if not p.starts_again:
        fast, slow = fast & ~again, slow & ~again
    felt = decided(jnp.where(fast, _FAST, jnp.where(slow, _SLOW, _NOTHING)))
    return felt != _NOTHING, jnp.where(felt == _FAST, fast_time, slow_time)


def crossing(
    stage: PlannedReflex, state: PayloadState, then: Scalar, now: Scalar, threshold: Scalar, time: Scalar
) -> tuple[Bool[Array, ""], Scalar]:
    """Tell whether a force that was `then` at `time` and is `now` is out of the band, and when it left it."""
    off_then, off = (jnp.abs(force - state.weight) - threshold for force in (then, now))
    crossed = (off_then < 0.0) & (off > 0.0)
    share = jnp.where(crossed, off_then / jnp.where(crossed, off_then - off, 1.0), 1.0)
    if not stage.params.interpolate:
        return off > 0.0, state.time
    return off > 0.0, jnp.where(time < 0.0, state.time, time + share * (state.time - time) + state.tick)


def trigger(
    stage: PlannedReflex, state: PayloadState, targets: Targets, timing: Timing, time: Scalar
) -> PayloadState:
    """Start a reflex at `time`, from the targets as they are then (their Taylor polynomial about the tick)."""
    p, back = stage.params, time - state.time
    orders = (targets.position, targets.velocity, targets.acceleration)
    sole, velocity, acceleration = (order.sole for order in orders)
    position, speed, change = (order.sole - order.pelvis for order in orders)
    start = jnp.stack([position + back * speed + 0.5 * back * back * change, speed + back * change, change])
    phase = targets.phase
    aloft = phase.support == SINGLE_SUPPORT
    applied = applied_shift(stage, state, time)
    row = jnp.where(aloft, phase.swing, 2)
    x = start[0, :, 0] + p.x_reflex[row]
    if p.two_speeds:
        ahead = quick_step.distance(stage, x[phase.swing] - x[1 - phase.swing], aloft)
        x = jnp.zeros_like(x).at[phase.swing].set(ahead)
    next_step = matching_step(upcoming_step(state, phase), foot_ahead(x), aloft, timing)
    if p.two_speeds:
        middle = stage.stance[next_step, :, 0].mean() + applied
        x = quick_step.ends(stage, ahead, phase.swing, middle, aloft)
    return replace(
        state,
        mode=jnp.full_like(state.mode, REFLEX),
        reflexes=state.reflexes + 1,
        trigger_time=time,
        trigger_plan_time=targets.time + back,
        support=phase.support,
        swing=phase.swing,
        start_sole=sole + back * velocity + 0.5 * back * back * acceleration,
        start=start,
        end=stage.stance[next_step].at[:, 0].set(x),
        next_step=next_step,
        x_shift=applied,
        x_shift_new=applied,
    )


def upcoming_step(state: PayloadState, phase: Phase) -> Int[Array, ""]:
    """Number of the plan's step that comes next."""
    walking = jnp.where(phase.time_since_liftoff < 0.0, phase.step, phase.step + 1)
    return jnp.where(phase.kind == RECOVERY_STEP, state.next_step, walking).astype(jnp.int32)

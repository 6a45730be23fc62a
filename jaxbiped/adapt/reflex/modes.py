"""The modes of the reflex: how long each lasts, what its end reads, and the recovery step (Eqs. 3.18-3.25, 3.35)."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.adapt.reflex.planned import (
    HOLD,
    RECOVER,
    SETTLE,
    SHIFT,
    WALK,
    PayloadState,
    PlannedReflex,
    RecoveryStep,
    decided,
    foot_ahead,
    stance_place,
)
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.planner import Timing
from jaxbiped.robot import LEFT, RIGHT

Scalar = Float[Array, ""]
_STEADY_SHARE = 2.4
"""Double support of a steady recovery step over its single support: time to get over the stance foot and back."""
_SMALLEST_WAY = 1e-4
"""Missing step length below which a steady recovery makes no step, but lets the feet give [m]: rounding, or what the
parabola about the tick of the trigger is out by."""


def mode_ends(stage: PlannedReflex, state: PayloadState, timing: Timing) -> Float[Array, "6"]:
    """Time at which each mode ends, by its number [s]."""
    p, step = stage.params, recovery_step(stage, state, timing)
    lengths = [
        state.trigger_time,
        p.reflex_time,
        p.settling_time,
        p.shift_time,
        step.t_ss + step.t_ds,
        p.hold,
    ]
    return jnp.cumsum(jnp.stack(lengths))


def advance(
    stage: PlannedReflex, state: PayloadState, before: PayloadState, timing: Timing, sensed: Sensed
) -> PayloadState:
    """Leave a mode whose time is over, or is in the tick to come: SETTLE and HOLD, after which there is a speed."""
    p = stage.params
    end = mode_ends(stage, state, timing)[state.mode]
    ahead = ((state.mode == SETTLE) | (state.mode == HOLD)) & p.interpolate
    over = state.time + jnp.where(ahead, state.tick, 0.0) >= end
    leaving = decided(jnp.where(over, state.mode, WALK))

    def stay(s: PayloadState) -> PayloadState:
        return s

    def to(mode: int) -> Callable[[PayloadState], PayloadState]:
        return lambda s: replace(s, mode=jnp.full_like(s.mode, mode))

    def settle(s: PayloadState) -> PayloadState:
        """The slower low-pass starts anew at the end of the reflex, free of what was before the load."""
        share = s.share(end - before.time) if p.interpolate else jnp.ones_like(end)
        then, total = before.force + share * (s.force - before.force), sensed.corner_force.sum()
        rest = (1.0 - share) * s.tick
        slow = then + (1.0 - jnp.exp(-rest / p.slow_time_constant)) * (total - then)
        return replace(s, mode=jnp.full_like(s.mode, SETTLE), slow_force=slow)

    def read(s: PayloadState) -> PayloadState:
        """Eqs. 3.19 and 3.20, and the weight that is normal from now on; as they were a tick before the end."""
        share = s.share(end - s.time) if p.interpolate else jnp.ones_like(end)
        zmp = before.zmp + share * (s.zmp - before.zmp)
        wanted = p.x_ref_gain * (zmp - p.zmp_balanced)
        weight = before.slow_force + share * (s.slow_force - before.slow_force)
        return replace(s, mode=jnp.full_like(s.mode, SHIFT), x_shift_new=wanted, weight=weight)

    def resume(s: PayloadState) -> PayloadState:
        stance = 1 - foot_ahead(s.end[:, 0])
        return replace(
            s,
            mode=jnp.full_like(s.mode, WALK),
            resume_time=end if p.interpolate else s.time,
            resume_plan_time=stage.resume_plan_time[s.next_step],
            world_shift=stance_place(s, stance)[0] - stage.foothold[s.next_step, stance],
            x_shift=s.x_shift_new,
        )

    leave = [stay, settle, read, to(RECOVER), to(HOLD), resume]
    return jax.lax.switch(leaving, leave, state)


def recovery_step(stage: PlannedReflex, state: PayloadState, timing: Timing) -> RecoveryStep:
    """Eqs. 3.22-3.25; Eq. 3.23 by the step length that is missing, its half in the symmetric stance."""
    T_s, T_d = timing.T_s, timing.T_c - timing.T_s
    goal = stage.stance[state.next_step].at[:, 0].add(state.x_shift)
    swing = foot_ahead(state.end[:, 0])
    missing = (goal[swing, 0] - state.end[swing, 0]) - (goal[1 - swing, 0] - state.end[1 - swing, 0])
    f = jnp.minimum(0.5 * jnp.abs(missing) / stage.stride, 0.999)
    if stage.params.steady_recovery:
        steps = jnp.where(jnp.abs(missing) > _SMALLEST_WAY, 1.0, 0.0)
        half_distance = 0.5 * (goal[LEFT, 1] - goal[RIGHT, 1])
        return RecoveryStep(
            swing, f, T_s, _STEADY_SHARE * T_s, steps * half_distance, steps * stage.lift, goal
        )
    t_ss = T_s * jnp.arccos(f) / jnp.pi
    return RecoveryStep(swing, f, t_ss, T_d / T_s * t_ss, stage.sway * f, stage.lift * f, goal)


def applied_shift(stage: PlannedReflex, state: PayloadState, time: Scalar) -> Scalar:
    """Shift of x_ref at `time` [m] (Eq. 3.21)."""
    p = stage.params
    begin = state.trigger_time + p.reflex_time + p.settling_time
    share = jnp.where(state.mode <= SETTLE, 0.0, ramp(state, begin, p.shift_time, time))
    share = jnp.where(state.mode == WALK, 1.0, share)
    return state.x_shift + share * (state.x_shift_new - state.x_shift)


def ramp(state: PayloadState, begin: Scalar, length: Scalar, time: Scalar) -> Scalar:
    """Rise from 0 at `begin` to 1 after `length`, in the tick to come.

    Servos are told a speed for a whole tick: where the ramp begins or ends inside it, its mean over the tick.
    """
    now, then = (jnp.clip((t - begin) / length, 0.0, 1.0) for t in (state.time, state.time + state.tick))
    return now + (time - state.time) * (then - now) / jnp.where(state.tick > 0.0, state.tick, 1.0)

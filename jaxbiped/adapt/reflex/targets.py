"""Targets of every mode: the plan, wherever the walk has got to, or a pose in its place."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.adapt.reflex.modes import mode_ends, recovery_step
from jaxbiped.adapt.reflex.planned import (
    HOLD,
    REFLEX,
    SETTLE,
    SHIFT,
    WALK,
    PayloadState,
    PlannedReflex,
)
from jaxbiped.adapt.reflex.poses import body_time, pose
from jaxbiped.planner import (
    DOUBLE_SUPPORT,
    RECOVERY_STEP,
    REFLEX_STEP,
    SINGLE_SUPPORT,
    Gait,
    Phase,
    Targets,
    TaskSpace,
    Timing,
    at,
)

Scalar = Float[Array, ""]


def plan_time(stage: PlannedReflex, state: PayloadState, timing: Timing, time: Scalar) -> Scalar:
    """Plan time at `time` [s] while the robot walks."""
    since = time - state.resume_time
    if not stage.params.smooth_resume:
        going = state.share(state.time + state.tick - state.resume_time)
        going = jnp.where(state.reflexes > 0, going, 1.0)
        begun = jnp.maximum(state.time - state.resume_time, 0.0)
        return state.resume_plan_time + begun + going * (time - state.time)
    since = jnp.where(since < 0.0, 0.0, since)  # jnp.maximum would have half its derivative at 0
    lead = 0.5 * (timing.T_c - timing.T_s)
    r = jnp.minimum(0.5 * since / lead, 1.0)
    slow = lead * r * r * r * (2.0 - r) + jnp.maximum(since - 2.0 * lead, 0.0)
    on_the_way = (state.next_step > 0) & (state.next_step < timing.n_steps) & (state.reflexes > 0)
    return state.resume_plan_time + jnp.where(on_the_way, slow, since)


def plan_targets(stage: PlannedReflex, state: PayloadState, gait: Gait, time: Scalar) -> Targets:
    """The plan, wherever the walk has got to; exactly the plan as long as nothing has happened."""
    one = jnp.ones_like(time)

    def in_plan(t: Scalar) -> Scalar:
        return plan_time(stage, state, gait.timing, t)

    def with_rate(t: Scalar) -> tuple[Scalar, Scalar]:
        return jax.jvp(in_plan, (t,), (one,))

    (now, rate), (_, change) = jax.jvp(with_rate, (time,), (one,))
    plan = at(gait, now)
    return Targets(
        position=in_world(plan.position, state),
        velocity=jax.tree.map(lambda v: v * rate, plan.velocity),
        acceleration=jax.tree.map(
            lambda a, v: a * rate * rate + v * change, plan.acceleration, plan.velocity
        ),
        phase=plan.phase,
        time=now,
    )


def in_world(task: TaskSpace, state: PayloadState) -> TaskSpace:
    """The plan's task space where the walk is, with the body behind the feet by the shift of x_ref."""
    pelvis = task.pelvis.at[0].add(state.world_shift - state.x_shift)
    return TaskSpace(task.sole.at[:, 0].add(state.world_shift), pelvis)


def targets_at(
    stage: PlannedReflex, state: PayloadState, plan: Targets, timing: Timing, time: Scalar
) -> Targets:
    """Targets at `time`: the plan, or the pose of the mode the reflex is in."""
    one = jnp.ones_like(time)

    def of_mode(t: Scalar) -> TaskSpace:
        return pose(stage, state, timing, t)

    def with_velocity(t: Scalar) -> tuple[TaskSpace, TaskSpace]:
        return jax.jvp(of_mode, (t,), (one,))

    (position, velocity), (_, acceleration) = jax.jvp(with_velocity, (time,), (one,))
    now = feed_forward_time(stage, state, timing, time)
    instead = Targets(position, velocity, acceleration, plan.phase, now)
    targets = jax.tree.map(lambda a, b: jnp.where(state.mode == WALK, a, b), plan, instead)
    return replace(targets, phase=phase_at(stage, state, plan, timing, time))


def feed_forward_time(stage: PlannedReflex, state: PayloadState, timing: Timing, time: Scalar) -> Scalar:
    """Plan time whose joint torques suit the pose outside WALK: both feet loaded, or the step of the same foot."""
    step, start = recovery_step(stage, state, timing), mode_ends(stage, state, timing)[SHIFT]
    before = stage.resume_plan_time[jnp.maximum(state.next_step - 1, 0)]
    after = stage.resume_plan_time[state.next_step]
    since = time - state.trigger_time
    down = jnp.clip(since / body_time(stage, state), 0.0, 1.0)
    liftoff = jnp.minimum(timing.liftoff(jnp.maximum(state.next_step - 1, 0)), after)
    touchdown = jnp.minimum(liftoff + timing.T_s, after)
    half = 0.5 * step.t_ds
    knots = start + jnp.stack([jnp.zeros_like(half), half, half + step.t_ss, step.t_ss + step.t_ds])
    recovering = jnp.interp(time, knots, jnp.stack([before, liftoff, touchdown, after]))
    return (1.0 - down) * (state.trigger_plan_time + jnp.minimum(since, 0.0)) + down * recovering


def phase_at(stage: PlannedReflex, state: PayloadState, plan: Targets, timing: Timing, time: Scalar) -> Phase:
    """Phase of the plan, of the reflex, or of the recovery step, which lasts until the plan's next lift-off."""
    p, step, ends = stage.params, recovery_step(stage, state, timing), mode_ends(stage, state, timing)
    since = time - state.trigger_time
    falling = (state.mode == REFLEX) & (state.support == SINGLE_SUPPORT)
    reflex = Phase(
        step=jnp.maximum(state.next_step - 1, 0),
        swing=state.swing,
        support=jnp.where(falling, SINGLE_SUPPORT, DOUBLE_SUPPORT),
        time_in_phase=jnp.where(state.mode == REFLEX, since, time - ends[REFLEX]),
        time_since_liftoff=since,
        T_s=p.reflex_time,
        T_c=p.reflex_time + p.settling_time,
        kind=jnp.full_like(state.mode, REFLEX_STEP),
        begin=jnp.zeros_like(since),
    )
    liftoff = ends[SHIFT] + 0.5 * step.t_ds
    tau = time - liftoff
    single = (tau >= 0.0) & (tau < step.t_ss) & (step.lift > 1e-6)
    standing = jnp.where(tau < 0.0, time - ends[SETTLE], tau - step.t_ss)
    recovery = Phase(
        step=jnp.maximum(state.next_step - 1, 0),
        swing=step.swing,
        support=jnp.where(single, SINGLE_SUPPORT, DOUBLE_SUPPORT),
        time_in_phase=jnp.where(single, tau, standing),
        time_since_liftoff=tau,
        T_s=step.t_ss,
        T_c=ends[HOLD] + resume_lead(stage, state, timing) - liftoff,
        kind=jnp.full_like(state.mode, RECOVERY_STEP),
        begin=ends[SETTLE] - liftoff,
    )
    last = state.next_step == timing.n_steps
    waiting = last | (plan.time < timing.liftoff(state.next_step))
    recovering = (state.mode >= SHIFT) | ((state.mode == WALK) & (state.reflexes > 0) & waiting)
    reflexive = (state.mode == REFLEX) | (state.mode == SETTLE)
    phase = jax.tree.map(lambda a, b: jnp.where(recovering, a, b), recovery, plan.phase)
    return jax.tree.map(lambda a, b: jnp.where(reflexive, a, b), reflex, phase)


def resume_lead(stage: PlannedReflex, state: PayloadState, timing: Timing) -> Scalar:
    """Time from the resumption of the walk to its next lift-off [s]."""
    lead = timing.liftoff(state.next_step) - stage.resume_plan_time[state.next_step]
    on_the_way = (state.next_step > 0) & (state.next_step < timing.n_steps)
    lead = jnp.where(on_the_way & stage.params.smooth_resume, 2.0 * lead, lead)
    return jnp.where(state.next_step == timing.n_steps, 1e3, lead)

"""Landing on ground of unknown height: advance and retard landing and release (khadiv section 3, Eqs. 6-16).

All offsets live in the plan's frame: what reaches the joints is (foot + its offset) - (pelvis + its offset). In a step,

    watch     from T_s / 2 to T_c, for a switch of the swing foot to close
    advance   it closes before T_s: the foot stops at the touch pose and sets down gently (z_mod, x_mod)
    retard    it has not closed at T_s: foot and pelvis descend until it does, then the foot sets down
    keep      until T_c
    release   over the next single support, when this foot is the stance foot: the robot rises or sinks onto the new
              height
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxbiped.adapt.landing.parameters import Landing
from jaxbiped.adapt.landing.poses import ground_height, longest_set_down, lowered, pose, taylor
from jaxbiped.adapt.landing.state import LandingState
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.adapt.stage import PlannedStage, Signals
from jaxbiped.planner import PLANNED_STEP, REFLEX_STEP, Gait, Phase, Targets, TaskSpace

Scalar = Float[Array, ""]
_BISECTIONS = 40
SMALLEST_T_MOD, SMALLEST_WAY = 5e-3, 1e-5
"""Time [s] in which a foot whose switches close on the ground is stopped, where there is no way to set it down; and the
way [m] that is taken for none."""


class LandingStage(PlannedStage):
    """The landing stage for one planned walk."""

    params: Landing
    """Parameters of the stage."""
    T_mod: Scalar
    """Nominal time to set the foot down [s]."""
    delta_x: Float[Array, "room"]
    """Sagittal distance that the plan's foot covers in its last T_mod, for every step [m]."""
    first_phase: Phase
    """Phase at the start of the walk."""

    @classmethod
    def plan(cls, params: Landing, gait: Gait) -> "LandingStage":
        """Read T_mod and delta_x off the plan."""
        T_mod = nominal_T_mod(gait, params.delta_z) if params.T_mod is None else params.T_mod
        steps = jnp.arange(gait.timing.room)
        delta_x = jax.vmap(lambda step: _last_way(gait, step, T_mod))(steps)
        return cls(params, T_mod, delta_x, gait.phase(jnp.zeros_like(T_mod)))

    def init(self) -> LandingState:
        """State before the first tick."""
        zero, no = jnp.zeros_like(self.T_mod), jnp.zeros((), bool)
        return LandingState(
            phase=self.first_phase,
            time=zero,
            aloft=no,
            touched=no,
            late=no,
            descended=zero,
            touch_tau=zero,
            touch=jnp.zeros((3, 2), zero.dtype),
            T_mod=self.T_mod,
            delta_x=zero,
            foot_offset=jnp.zeros((2, 2), zero.dtype),
            pelvis_offset=zero,
            missed=jnp.zeros((), jnp.int32),
        )

    def step(
        self, state: LandingState, gait: Gait, targets: Targets, sensed: Sensed, signals: Signals
    ) -> tuple[LandingState, Targets, Signals]:
        """One control tick: fit the targets to the ground."""
        phase, last = targets.phase, state.phase
        new_step = (phase.step != last.step) | (phase.kind != last.kind)
        state = jax.lax.cond(new_step, lambda s: self._next_step(s, targets, sensed.time), lambda s: s, state)
        state = replace(self._watch(state, targets, sensed), phase=phase, time=sensed.time)
        return state, self._command(state, targets), replace(signals, disturbed=state.disturbed())

    def outcome(self, state: LandingState) -> dict[str, Array]:
        """Count the steps that ended without a touch."""
        return {"missed": state.missed}

    def _next_step(self, state: LandingState, nominal: Targets, time: Scalar) -> LandingState:
        """Carry the offsets of the step that has ended over into the one that begins.

        A reflex may begin in the midst of a step: then a touch that is being followed is followed on.
        """
        phase, last = nominal.phase, state.phase
        elapsed = phase.time_since_liftoff - phase.begin
        tau = last.time_since_liftoff + (time - elapsed - state.time)
        plan = taylor(nominal, -elapsed)
        end = pose(self.params, state, last, plan, tau)
        interrupted = phase.kind == REFLEX_STEP
        follow = interrupted & state.touched
        below = jnp.where(follow, lowered(self.params, state, last, tau), 0.0)
        carried = {
            "phase": replace(phase, time_since_liftoff=phase.begin),
            "foot_offset": (end.sole - plan.sole)[:, jnp.array([0, 2])],
            "pelvis_offset": end.pelvis[2] - plan.pelvis[2] + below,
        }
        followed = replace(state, **carried, touch_tau=state.touch_tau - tau + phase.begin)
        missed = state.missed + (state.aloft & ~state.touched & ~interrupted).astype(jnp.int32)
        begun = replace(self.init(), **carried, missed=missed, aloft=interrupted & state.aloft)
        return jax.tree.map(lambda a, b: jnp.where(follow, a, b), followed, begun)

    def _watch(self, state: LandingState, nominal: Targets, sensed: Sensed) -> LandingState:
        """Look for the first switch of the swing foot to close, from T_s / 2 (in a reflex: at once) to T_c.

        A reading is older than the tick that gets it: the touch is taken at its own instant, however many ticks ago.
        """
        phase = nominal.phase
        tau, closed = phase.time_since_liftoff, sensed.switch[phase.swing]
        in_swing = (tau >= 0.0) & (tau <= phase.T_s)
        state = replace(state, aloft=state.aloft | (in_swing & ~jnp.any(closed)))
        start = jnp.where(phase.kind == REFLEX_STEP, 0.0, 0.5 * phase.T_s)
        watching = (tau >= start) & (tau <= phase.T_c) & state.aloft & ~state.touched
        touched = watching & jnp.any(closed)
        since = sensed.time - jnp.min(jnp.where(closed, sensed.switch_time[phase.swing], jnp.inf))
        inside = jnp.clip(tau - since, start, tau) if self.params.interpolate else tau
        landed = self._touch(state, nominal, jnp.where(touched, inside, tau))
        return jax.tree.map(lambda a, b: jnp.where(touched, a, b), landed, state)

    def _touch(self, state: LandingState, nominal: Targets, tau: Scalar) -> LandingState:
        """Remember the commanded foot at the touch, and decide how to set it down."""
        p, phase = self.params, nominal.phase

        def swing_foot(t: Scalar) -> Float[Array, "2"]:
            plan = taylor(nominal, t - phase.time_since_liftoff)
            foot = pose(p, state, phase, plan, t).sole[phase.swing, jnp.array([0, 2])]
            return foot.at[1].add(-ground_height(p, state, phase, t))

        def swing_velocity(t: Scalar) -> Float[Array, "2"]:
            return jax.jvp(swing_foot, (t,), (jnp.ones_like(t),))[1]

        position = swing_foot(tau)
        velocity, acceleration = jax.jvp(swing_velocity, (tau,), (jnp.ones_like(tau),))
        if not p.commanded_velocity:
            planned = (nominal.velocity, nominal.acceleration)
            velocity, acceleration = (leaf.sole[phase.swing, jnp.array([0, 2])] for leaf in planned)
            velocity = velocity + acceleration * (tau - phase.time_since_liftoff)
        late = tau > phase.T_s
        T_mod = self.T_mod
        if p.no_undershoot:
            longest = longest_set_down(velocity[1], acceleration[1], jnp.maximum(p.delta_z, SMALLEST_WAY))
            T_mod = jnp.minimum(T_mod, jnp.maximum(longest, SMALLEST_T_MOD))
        in_plan = phase.kind == PLANNED_STEP
        way = jnp.where(in_plan, self.delta_x[phase.step], 0.5 * velocity[0] * T_mod)
        return replace(
            state,
            touched=jnp.ones_like(state.touched),
            late=late,
            descended=lowered(p, state, phase, tau),
            touch_tau=tau,
            touch=jnp.stack([position, velocity, acceleration]),
            T_mod=T_mod,
            delta_x=jnp.where(late, 0.0, p.delta_x_scale * way),
        )

    def _command(self, state: LandingState, nominal: Targets) -> Targets:
        """The nominal targets with all offsets, and their derivatives."""
        phase = nominal.phase
        tau = phase.time_since_liftoff
        one = jnp.ones_like(tau)

        def adapted(t: Scalar) -> TaskSpace:
            return pose(self.params, state, phase, taylor(nominal, t - tau), t)

        def with_velocity(t: Scalar) -> tuple[TaskSpace, TaskSpace]:
            return jax.jvp(adapted, (t,), (one,))

        (position, velocity), (_, acceleration) = jax.jvp(with_velocity, (tau,), (one,))
        return Targets(position, velocity, acceleration, phase, nominal.time)


def nominal_T_mod(gait: Gait, delta_z: Scalar) -> Scalar:
    """Time the plan's swing foot needs from height `delta_z` [m] to the ground [s]: z(T_s - T_mod) = delta_z.

    At least SMALLEST_T_MOD: from height 0 no time is needed, and there its derivative is infinite.
    """
    timing = gait.timing
    start, swing = timing.liftoff(0), timing.first_swing

    def above(tau: Scalar) -> Scalar:
        return gait.task(start + tau).sole[swing, 2] - delta_z

    def halve(bracket: tuple[Scalar, Scalar], _: None) -> tuple[tuple[Scalar, Scalar], None]:
        high, low = bracket
        middle = 0.5 * (high + low)
        is_high = above(middle) > 0.0
        return (jnp.where(is_high, middle, high), jnp.where(is_high, low, middle)), None

    (tau, _), _ = jax.lax.scan(halve, (0.5 * timing.T_s, timing.T_s), None, length=_BISECTIONS)
    tau = jax.lax.stop_gradient(tau)
    value, slope = jax.jvp(above, (tau,), (jnp.ones_like(tau),))
    slope = jax.lax.stop_gradient(slope)
    falling = slope < -SMALLEST_WAY  # at rest on the ground it is not
    T_mod = timing.T_s - (tau - value / jnp.where(falling, slope, -1.0))
    return jnp.maximum(T_mod, SMALLEST_T_MOD)


def _last_way(gait: Gait, step: Int[Array, ""], T_mod: Scalar) -> Scalar:
    """delta_x: how far the swing foot of a step goes in the last T_mod before its planned touchdown [m]."""
    touchdown, swing = gait.timing.touchdown(step), (gait.timing.first_swing + step) % 2
    before, after = gait.task(touchdown - T_mod), gait.task(touchdown)
    return after.sole[swing, 0] - before.sole[swing, 0]


Landing.planned = LandingStage

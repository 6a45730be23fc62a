"""Payload reflex and adaptation (El-Kahlout's thesis, sections 3.3, 4.3, 4.4): stand still, lean right, walk on.

The load is felt as a jump of the low-passed sum of the vertical foot forces. Then

    REFLEX    both feet go to a symmetric stance, the swing foot down to the ground (Eqs. 3.11-3.17)
    SETTLE    the robot stands still; at the end the low-passed ZMP is read (Eq. 3.18)
    SHIFT     the body moves over the feet until the ZMP is where it balances, x_ref (Eqs. 3.19-3.21)
    RECOVER   one step of the foot ahead restores the step length (Eqs. 3.22-3.34)
    HOLD      the robot stands still for half the settling time (Eqs. 3.35-3.40)
    WALK      the plan goes on at the matching phase, with the new x_ref

A further change of weight from SHIFT on starts the machine again from wherever the robot is. What shakes the robot
is not taken for one: while it recovers, or a foot is being set down, a second, slower filter decides. Positions are
those of the soles in the body frame, as in the thesis; what is nominal (b_s, w_of, h_b, sway, lift, times) is read off
the plan, so any gait will do. In the world the stance foot stands still.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxbiped.adapt.reflex.modes import advance
from jaxbiped.adapt.reflex.parameters import PayloadReflex, resume_plan_times
from jaxbiped.adapt.reflex.planned import WALK, PayloadState, PlannedReflex
from jaxbiped.adapt.reflex.targets import plan_targets, targets_at
from jaxbiped.adapt.reflex.trigger import low_passed, trigger, watch
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.adapt.stage import Signals
from jaxbiped.planner import DOUBLE_SUPPORT, Gait, Targets


class PayloadStage(PlannedReflex):
    """The payload reflex for one planned walk."""

    @classmethod
    def plan(cls, params: PayloadReflex, gait: Gait) -> "PayloadStage":
        """Read the stances and the size of a step off the plan."""
        times = resume_plan_times(gait)
        task = jax.vmap(gait.task)(times)
        middle = gait.task(gait.timing.liftoff(0) + 0.5 * gait.timing.T_s)
        return cls(
            params=params,
            resume_plan_time=times,
            foothold=task.sole[:, :, 0],
            stance=task.sole - task.pelvis[:, None],
            stride=jnp.maximum(jnp.abs(task.sole[:, 0, 0] - task.sole[:, 1, 0]).max(), 1e-3),
            sway=jnp.abs(middle.pelvis[1] - middle.sole[:, 1].mean()),
            lift=middle.sole[:, 2].max(),
        )

    def init(self) -> PayloadState:
        """State before the first tick."""
        zero, count = jnp.zeros_like(self.sway), jnp.zeros((), jnp.int32)
        return PayloadState(
            mode=count + WALK,
            time=zero - 1.0,
            tick=zero,
            force=zero,
            slow_force=zero,
            zmp=zero,
            weight=zero,
            reflexes=count,
            trigger_time=zero,
            trigger_plan_time=zero,
            support=count + DOUBLE_SUPPORT,
            swing=count,
            start_sole=self.stance[0],
            start=jnp.zeros((3, 2, 3), zero.dtype).at[0].set(self.stance[0]),
            end=self.stance[0],
            next_step=count,
            x_shift=zero,
            x_shift_new=zero,
            resume_time=zero,
            resume_plan_time=zero,
            world_shift=zero,
        )

    def step(
        self, state: PayloadState, gait: Gait, targets: Targets, sensed: Sensed, signals: Signals
    ) -> tuple[PayloadState, Targets, Signals]:
        """One control tick: the plan, or what stands in its place; the targets so far are not used."""
        state, before = low_passed(self, state, sensed), state
        state = advance(self, state, before, gait.timing, sensed)
        plan = plan_targets(self, state, gait, sensed.time)
        targets = targets_at(self, state, plan, gait.timing, sensed.time)
        triggered, trigger_time = watch(self, state, before, signals.disturbed)
        reflex = trigger(self, state, targets, gait.timing, trigger_time)
        instead = targets_at(self, reflex, plan, gait.timing, sensed.time)
        state, targets = jax.tree.map(
            lambda a, b: jnp.where(triggered, a, b), (reflex, instead), (state, targets)
        )
        signals = replace(
            signals,
            walking=state.mode == WALK,
            interruptions=state.reflexes,
            interrupted_time=state.trigger_time,
            resume_time=state.resume_time,
            next_step=state.next_step,
        )
        return state, targets, signals

    def outcome(self, state: PayloadState) -> dict[str, Array]:
        """Give the number of reflexes and the start of the last one [s]."""
        begun = jnp.where(state.reflexes > 0, state.trigger_time, jnp.nan)
        return {"reflexes": state.reflexes, "trigger_s": begun}

    def longest_delay(self, gait: Gait, changes: int) -> float:
        """Longest delay: a reflex for every change of weight, each with the longest recovery step [s]."""
        p, timing = self.params, gait.timing
        recovery = 2.2 * float(timing.T_s) + float(timing.T_c)
        once = float(p.reflex_time + p.settling_time + p.shift_time + p.hold) + recovery
        return once * (changes if p.starts_again else min(changes, 1))


PayloadReflex.planned = PayloadStage

"""The payload reflex for one planned walk: what it reads off the plan, and what it remembers between two ticks."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.adapt.reflex.parameters import PayloadReflex
from jaxbiped.adapt.stage import PlannedStage
from jaxbiped.planner import Timing
from jaxbiped.robot import LEFT, RIGHT

Scalar = Float[Array, ""]
WALK, REFLEX, SETTLE, SHIFT, RECOVER, HOLD = range(6)
"""Modes of the payload reflex."""


class PayloadState(eqx.Module):
    """State of the payload reflex between two ticks. The body frame is the pelvis', heading along x."""

    mode: Int[Array, ""]
    """WALK, REFLEX, SETTLE, SHIFT, RECOVER or HOLD."""
    time: Scalar
    """Time of the last reading [s]; negative before the first."""
    tick: Scalar
    """Time between the last two readings [s], which the tick to come is taken to last too; 0 at the first reading."""
    force: Scalar
    """Low-passed sum of the vertical foot forces [N]."""
    slow_force: Scalar
    """Sum of the vertical foot forces after the slower low-pass [N]."""
    zmp: Scalar
    """Low-passed ZMP forward of the pelvis [m]."""
    weight: Scalar
    """Low-passed force that is taken for normal [N]."""
    reflexes: Int[Array, ""]
    """Number of reflexes so far."""
    trigger_time: Scalar
    """Time at which the last reflex started [s]: a control tick after the force had left the band."""
    trigger_plan_time: Scalar
    """Plan time at the start of the last reflex [s]."""
    support: Int[Array, ""]
    """Support phase at the tick that felt the load."""
    swing: Int[Array, ""]
    """The foot that swung at the tick that felt the load, or that swung last."""
    start_sole: Float[Array, "2 3"]
    """Soles in the world at the start of the last reflex [m]."""
    start: Float[Array, "3 2 3"]
    """Position, velocity, acceleration of the soles in the body frame at the start of the last reflex [m]."""
    end: Float[Array, "2 3"]
    """Soles in the body frame at the end of the reflex [m]."""
    next_step: Int[Array, ""]
    """Number of the plan's step with which the walk goes on; n_steps if there is none left."""
    x_shift: Scalar
    """Shift of x_ref at the last reflex [m]."""
    x_shift_new: Scalar
    """Shift of x_ref that is wanted [m]."""
    resume_time: Scalar
    """Time at which the walk went on [s]."""
    resume_plan_time: Scalar
    """Plan time at which the walk went on [s]."""
    world_shift: Scalar
    """Forward offset of the walk relative to the plan [m]."""

    def share(self, since: Scalar) -> Scalar:
        """Convert a time [s] to a share of a tick, within 0 and 1; 1 before the first tick."""
        ticking = self.tick > 0.0
        return jnp.where(ticking, jnp.clip(since / jnp.where(ticking, self.tick, 1.0), 0.0, 1.0), 1.0)


class RecoveryStep(eqx.Module):
    """The recovery step of a reflex."""

    swing: Int[Array, ""]
    """The foot ahead."""
    f: Scalar
    """Missing step length over twice the step length, Eq. 3.23."""
    t_ss: Scalar
    """Single support, Eq. 3.24 [s]."""
    t_ds: Scalar
    """Double support, Eq. 3.25 [s]."""
    sway: Scalar
    """Displacement of the body towards the stance foot [m]."""
    lift: Scalar
    """Height of the swing foot [m]."""
    goal: Float[Array, "2 3"]
    """Soles in the body frame at the end, but for the new shift of x_ref [m]."""


class PlannedReflex(PlannedStage):
    """The payload reflex for one planned walk, without its tick."""

    params: PayloadReflex
    """Parameters of the stage."""
    resume_plan_time: Float[Array, " n"]
    """Plan time from which the walk goes on with each step, and at rest after the last [s]."""
    foothold: Float[Array, "n 2"]
    """Forward place of the soles in the world at each `resume_plan_time` [m]."""
    stance: Float[Array, "n 2 3"]
    """Soles in the body frame at each `resume_plan_time` [m]."""
    stride: Scalar
    """Distance of the soles in double support, 2 b_s [m]."""
    sway: Scalar
    """Greatest lateral way of the body from the middle, w [m]."""
    lift: Scalar
    """Greatest height of the swing foot, h_s [m]."""


def decided(choice: Int[Array, ""]) -> Int[Array, ""]:
    """Return the same small number >= 0, computed once and read by everything that depends on it.

    XLA fuses a comparison into each of its uses and may contract products and sums differently there; half a record
    would go one way, half the other. A sort it neither fuses nor makes twice; lax.optimization_barrier is gone by then.
    """
    return jax.lax.sort(jnp.stack([choice, jnp.full_like(choice, jnp.iinfo(choice.dtype).max)]))[0]


def foot_ahead(x: Float[Array, "2"]) -> Int[Array, ""]:
    """The foot further ahead, the left one if there is none (the conditions on x_r_e <= x_l_e)."""
    return jnp.where(x[RIGHT] <= x[LEFT], LEFT, RIGHT)


def matching_step(
    upcoming: Int[Array, ""], ahead: Int[Array, ""], aloft: Bool[Array, ""], timing: Timing
) -> Int[Array, ""]:
    """The plan's step to go on with: the one at hand or the one before it, so that the foot behind swings."""
    behind_swings = (timing.first_swing + upcoming) % 2 != ahead
    finished = (upcoming == timing.n_steps) & ~aloft
    return jnp.where(behind_swings | finished | (upcoming == 0), upcoming, upcoming - 1)


def stance_place(state: PayloadState, foot: Int[Array, ""]) -> Float[Array, "3"]:
    """Place of a foot in the world since the end of the reflex; before it, this is so for the stance foot."""
    stance = 1 - state.swing
    return state.start_sole[stance] + state.end[foot] - state.end[stance]

"""Poses of a foot that lands and of the pelvis, in the plan's frame (khadiv Eqs. 6, 7, 12-16)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.adapt.blends import longest_time_to_rest, quintic_to_rest, smooth
from jaxbiped.adapt.landing.parameters import Landing
from jaxbiped.adapt.landing.state import LandingState
from jaxbiped.planner import REFLEX_STEP, Phase, Targets, TaskSpace

Scalar = Float[Array, ""]


def pose(p: Landing, state: LandingState, phase: Phase, plan: TaskSpace, tau: Scalar) -> TaskSpace:
    """Commanded task space at `tau` since the lift-off of the step of `phase`, where the plan has `plan`."""
    swing, stance = phase.swing, 1 - phase.swing
    kept = kept_share(p, phase, tau)
    offset = state.foot_offset
    x_mod, z_mod = set_down(p, state, tau)
    free = plan.sole[swing, jnp.array([0, 2])] + kept * offset[swing]
    below = lowered(p, state, phase, tau)
    swing_x = jnp.where(state.touched, state.touch[0, 0] + x_mod, free[0])
    landed = state.touch[0, 1] + z_mod + ground_height(p, state, phase, tau)
    swing_z = jnp.where(state.touched, landed, free[1] - below)
    stance_x = offset[stance, 0] * (1.0 if p.keep_x else kept)
    sole = plan.sole.at[swing, 0].set(swing_x).at[swing, 2].set(swing_z)
    sole = sole.at[stance, 0].add(stance_x).at[stance, 2].add(kept * offset[stance, 1])
    return TaskSpace(sole, plan.pelvis.at[2].add(kept * state.pelvis_offset - below))


def kept_share(p: Landing, phase: Phase, tau: Scalar) -> Scalar:
    """Fraction of the offsets that is still applied (Eq. 16); a reflex releases nothing."""
    kept = 1.0 - smooth(tau / (p.release_share * phase.T_s))
    return jnp.where(phase.kind == REFLEX_STEP, 1.0, kept)


def ground_height(p: Landing, state: LandingState, phase: Phase, tau: Scalar) -> Scalar:
    """Height in the plan from which a touched foot's is counted [m]: what the stance foot stands on."""
    if not p.stays_down:
        return jnp.zeros_like(tau)
    return kept_share(p, phase, tau) * state.foot_offset[1 - phase.swing, 1]


def set_down(p: Landing, state: LandingState, tau: Scalar) -> tuple[Scalar, Scalar]:
    """Return x_mod and z_mod (Eqs. 6 and 7)."""
    since = tau - state.touch_tau
    x_mod, z_mod = (
        quintic_to_rest(since, state.T_mod, state.touch[1, i], state.touch[2, i], way)
        for i, way in ((0, state.delta_x), (1, -p.delta_z))
    )
    return x_mod, z_mod


def lowered(p: Landing, state: LandingState, phase: Phase, tau: Scalar) -> Scalar:
    """Descent of the pelvis in a retard landing [m] (Eqs. 14 and 15)."""
    _, z_mod = set_down(p, state, tau)
    down = descent(p, tau - phase.T_s, phase.T_c - phase.T_s)
    after = jnp.where(state.late, state.descended - (z_mod if p.pelvis_follows else 0.0), 0.0)
    return jnp.where(state.touched, after, jnp.where(state.aloft, down, 0.0))


def taylor(nominal: Targets, dt: Scalar) -> TaskSpace:
    """The targets `dt` [s] later, or earlier, by their derivatives."""
    return jax.tree.map(
        lambda p, v, a: p + v * dt + 0.5 * a * dt * dt,
        nominal.position,
        nominal.velocity,
        nominal.acceleration,
    )


def descent(p: Landing, t: Scalar, T_d: Scalar) -> Scalar:
    """Descent of foot and pelvis `t` seconds after T_s [m] (khadiv Eqs. 12 and 14).

    Smooth: speeds up, goes on at descent_speed, and slows down so as to stand still at max_descent or at T_c,
    whichever comes first; where that is too near for descent_speed, it turns back half-way.
    """
    t = jnp.clip(t, 0.0, T_d)
    if not p.smooth_descent:
        return p.descent_speed * t
    slope = p.descent_acceleration
    fastest = jnp.minimum(jnp.sqrt(slope * p.max_descent), 0.5 * slope * T_d)
    speed = jnp.minimum(p.descent_speed, fastest)
    ramp = speed / slope
    stop = jnp.clip(p.max_descent / speed + ramp, 2.0 * ramp, T_d)
    t = jnp.minimum(t, stop)
    up, left = jnp.minimum(t, ramp), jnp.maximum(t - (stop - ramp), 0.0)
    return 0.5 * slope * up * up + speed * (t - up) - 0.5 * slope * left * left


def longest_set_down(velocity: Scalar, acceleration: Scalar, way: Scalar) -> Scalar:
    """T* [s] also of a foot that does not go down: a T^2 + 8 v T + 20 way >= 0, with v >= 0 limited for a < 0 only."""
    rising = (velocity >= 0.0) & (acceleration < -1e-6)  # next to none: minutes, and no finite derivative
    v, a = jnp.where(rising, velocity, 0.0), jnp.where(rising, acceleration, -1.0)
    limit = (4.0 * v + jnp.sqrt(16.0 * v * v - 20.0 * a * way)) / -a
    return jnp.where(rising, limit, longest_time_to_rest(velocity, acceleration, way))

"""The reflex of two speeds: a quick step of the swing foot, under a body that follows at its own speed.

Not in the thesis, whose reflex moves feet and body at one speed. On a floor with grip feet that are pulled under the
body stay where they are, and the robot tips over them; and a body that is stopped in a tenth of a second goes on over
the toes. So here the swing foot goes ahead of the stance foot while it is set down, whatever the body does, and the
body moves to the middle of the feet as slowly as it may.
"""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.adapt.blends import quintic_to_rest
from jaxbiped.adapt.reflex.planned import REFLEX, PayloadState, PlannedReflex
from jaxbiped.planner import SINGLE_SUPPORT

Scalar = Float[Array, ""]
_OF_WAY, _OF_SPEED = 10.0 / 3.0**0.5, 3.94
"""Greatest acceleration of a quintic from rest over a way, in ways over the time squared; of one that only stops, in
speeds over the time."""
_TOUCH = 40.0
"""Vertical force on the swing foot that tells that it stands [N]."""


def distance(stage: PlannedReflex, now: Scalar, aloft: Bool[Array, ""]) -> Scalar:
    """Return how far the swing foot is to be ahead of the stance foot [m], from how far it is now."""
    p = stage.params
    ahead = jnp.minimum(now + p.quick_step, jnp.maximum(p.longest_step, now))
    return jnp.where(aloft, ahead, now)


def lift(stage: PlannedReflex, way: Scalar, aloft: Bool[Array, ""]) -> Scalar:
    """Return how high the swing foot is lifted on a way forward [m]: as in the plan, if that is as long as a stride."""
    return jnp.where(aloft, stage.lift * jnp.clip(way / stage.stride, 0.0, 1.0), 0.0)


def ends(
    stage: PlannedReflex, ahead: Scalar, swing: Int[Array, ""], middle: Scalar, aloft: Bool[Array, ""]
) -> Float[Array, "2"]:
    """Forward places of the soles in the body frame at the end [m], from the middle of the plan's stance there."""
    middle = middle + jnp.where(aloft, stage.params.behind, 0.0)
    return jnp.full(2, middle - 0.5 * ahead).at[swing].set(middle + 0.5 * ahead)


def soles(stage: PlannedReflex, state: PayloadState, since: Scalar) -> Float[Array, "2 3"]:
    """Soles in the body frame, so long after the reflex began [m]."""
    stance = 1 - state.swing
    place, velocity, acceleration = state.start[:, stance]
    way = state.end[stance] - place
    place = place + quintic_to_rest(since, body_times(stage, state), velocity, acceleration, way)
    return jnp.stack([place, place]).at[state.swing].add(over_ground(stage, state, since))


def over_ground(stage: PlannedReflex, state: PayloadState, since: Scalar) -> Float[Array, "3"]:
    """Place of the swing foot relative to the stance foot [m]: lifted on its way, which a touch ends."""
    p, stance = stage.params, 1 - state.swing
    place, velocity, acceleration = state.start[:, state.swing] - state.start[:, stance]
    end = state.end[state.swing] - state.end[stance]
    moved = place + quintic_to_rest(since, p.reflex_time, velocity, acceleration, end - place)
    share = jnp.clip(since / p.reflex_time, 0.0, 1.0)
    lift = 0.5 * state.lift * (1.0 - jnp.cos(2.0 * jnp.pi * share))
    stands = (since >= state.touch) & (jnp.arange(3) < 2)
    return jnp.where(stands, end, moved.at[2].add(lift))


def touched(stage: PlannedReflex, state: PayloadState, corner_force: Float[Array, "2 4"]) -> PayloadState:
    """Keep a swing foot where it touches in the second half of its way; on a floor with grip it would trip."""
    since = state.time - state.trigger_time
    way_down = (since > 0.5 * stage.params.reflex_time) & (
        since < jnp.minimum(stage.params.reflex_time, state.touch)
    )
    aloft = (state.mode == REFLEX) & (state.support == SINGLE_SUPPORT) & way_down
    touch = aloft & (corner_force[state.swing].sum() > _TOUCH)
    here = state.end[1 - state.swing] + over_ground(stage, state, since)
    end = state.end.at[state.swing, :2].set(here[:2])
    return replace(state, end=jnp.where(touch, end, state.end), touch=jnp.where(touch, since, state.touch))


def body_times(stage: PlannedReflex, state: PayloadState) -> Float[Array, "3"]:
    """Times in which the body gets to its place forward, sideways and up [s].

    Sideways it is taken off its stance foot, as fast as the greatest acceleration allows, roughly; forward it is not.
    """
    p, stance = stage.params, 1 - state.swing
    way = (state.end - state.start[0])[stance, 1]
    away = _OF_SPEED * jnp.where(way >= 0.0, -1.0, 1.0) * state.start[1, stance, 1]
    root = jnp.sqrt(away * away + 4.0 * _OF_WAY * p.body_acceleration * jnp.abs(way) + 1e-9)
    longest = jnp.maximum(away + root, 2.0 * jnp.abs(away)) / (2.0 * p.body_acceleration)
    return jnp.stack([p.body_time, jnp.clip(longest, p.reflex_time, p.body_time), p.reflex_time])

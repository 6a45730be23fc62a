"""The reflex of two speeds: a quick step of the swing foot, under a body that follows at its own speed.

Not in the thesis, whose reflex moves feet and body at one speed. On a floor with grip feet that are pulled under the
body stay where they are, and the robot tips over them; and a body that is stopped in a tenth of a second goes on over
the toes. So here the swing foot goes ahead of the stance foot while it is set down, whatever the body does, and the
body moves to the middle of the feet as slowly as it may.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.adapt.blends import quintic_to_rest
from jaxbiped.adapt.reflex.planned import PayloadState, PlannedReflex
from jaxbiped.planner import SINGLE_SUPPORT

Scalar = Float[Array, ""]
_OF_WAY, _OF_SPEED = 10.0 / 3.0**0.5, 3.94
"""Greatest acceleration of a quintic from rest over a way, in ways over the time squared; of one that only stops, in
speeds over the time."""


def distance(stage: PlannedReflex, now: Scalar, aloft: Bool[Array, ""]) -> Scalar:
    """Return how far the swing foot is to be ahead of the stance foot [m], from how far it is now."""
    p = stage.params
    ahead = jnp.minimum(now + p.quick_step, jnp.maximum(p.longest_step, now))
    return jnp.where(aloft, ahead, now)


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
    """Place of the swing foot relative to the stance foot [m]; on a way of a stride it is lifted as in the plan."""
    p, stance = stage.params, 1 - state.swing
    place, velocity, acceleration = state.start[:, state.swing] - state.start[:, stance]
    way = state.end[state.swing] - state.end[stance] - place
    place = place + quintic_to_rest(since, p.reflex_time, velocity, acceleration, way)
    r = jnp.clip(since / p.reflex_time, 0.0, 1.0)
    bump = (4.0 * r * (1.0 - r)) ** 3  # 0 at both ends with its velocity and acceleration, 1 half-way
    lift = stage.lift * jnp.clip(way[0] / stage.stride, 0.0, 1.0) * bump
    return place.at[2].add(jnp.where(state.support == SINGLE_SUPPORT, lift, 0.0))


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

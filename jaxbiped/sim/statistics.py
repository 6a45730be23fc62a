"""Running statistics and status of a roll-out, so that no trajectory need be stored."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.sim.ground import Contact
from jaxbiped.sim.mjx_adapter import BodyMotion
from jaxbiped.sim.sensors import roll_pitch_yaw

OK, FELL, NONFINITE = 0, 1, 2
STATUS_TEXT = ("ok", "fell", "nonfinite")
FALL_TILT = jnp.deg2rad(45.0)
"""Trunk tilt at which a robot counts as fallen [rad]."""
FALL_HEIGHT = 0.6
"""Height of the pelvis over the lower foot, as a share of that at the start, below which it counts as fallen."""
LOADED = 50.0
"""Vertical force over which a foot counts as loaded [N]."""


class Statistics(eqx.Module):
    """What is kept of a roll-out."""

    status: Int[Array, ""]
    """OK, FELL or NONFINITE; the first failure stays."""
    end_time: Float[Array, ""]
    """Time of the first failure, or the time reached [s]."""
    peak_roll_pitch: Float[Array, "2"]
    """Largest magnitude [rad]."""
    peak_foot_force: Float[Array, "2"]
    """Largest vertical force on each foot [N]."""
    peak_slip: Float[Array, "2"]
    """Largest horizontal distance of each sole from where it was loaded last [m]."""
    anchor: Float[Array, "2 2"]
    """Where each foot was when it was loaded last [m]."""
    loaded: Bool[Array, "2"]
    """Whether each foot is loaded."""
    out_of_reach_time: Float[Array, ""]
    """For how long the targets were beyond the legs' reach or joint ranges [s]."""
    p_world_trunk: Float[Array, "3"]
    """Pelvis frame origin, last [m]."""
    pelvis_height: Float[Array, ""]
    """Pelvis over the lower ankle at the start [m]."""


def init(body: BodyMotion) -> Statistics:
    """Before the first tick."""
    zero = jnp.zeros((), body.centre.dtype)
    return Statistics(
        status=jnp.array(OK, jnp.int32),
        end_time=zero,
        peak_roll_pitch=jnp.zeros(2, zero.dtype),
        peak_foot_force=jnp.zeros(2, zero.dtype),
        peak_slip=jnp.zeros(2, zero.dtype),
        anchor=body.p_world_foot[:, :2],
        loaded=jnp.ones(2, bool),
        out_of_reach_time=zero,
        p_world_trunk=body.p_world_trunk,
        pelvis_height=body.p_world_trunk[2] - body.p_world_foot[:, 2].min(),
    )


def update(stats: Statistics, body: BodyMotion, contact: Contact, time: Float[Array, ""]) -> Statistics:
    """After one physics tick that ended at `time` [s], from the body and contact at its start."""
    vertical = contact.force[..., 2].sum(axis=1)
    loaded = vertical > LOADED
    place = body.p_world_foot[:, :2]
    anchor = jnp.where((loaded & ~stats.loaded)[:, None], place, stats.anchor)
    slip = jnp.where(loaded, jnp.sqrt(jnp.sum((place - anchor) ** 2, axis=1) + 1e-18), 0.0)
    tilt = jnp.abs(roll_pitch_yaw(body.rot_world_trunk)[:2])
    low = body.p_world_trunk[2] - body.p_world_foot[:, 2].min() < FALL_HEIGHT * stats.pelvis_height
    fell = (jnp.max(tilt) > FALL_TILT) | low
    finite = jnp.all(jnp.isfinite(body.p_world_trunk)) & jnp.all(jnp.isfinite(vertical))
    return Statistics(
        status=jnp.where(~finite, NONFINITE, jnp.where(fell, FELL, OK)).astype(jnp.int32),
        end_time=time,
        peak_roll_pitch=jnp.maximum(stats.peak_roll_pitch, tilt),
        peak_foot_force=jnp.maximum(stats.peak_foot_force, vertical),
        peak_slip=jnp.maximum(stats.peak_slip, slip),
        anchor=anchor,
        loaded=loaded,
        out_of_reach_time=stats.out_of_reach_time,
        p_world_trunk=body.p_world_trunk,
        pelvis_height=stats.pelvis_height,
    )

"""Running statistics and status of a roll-out, so that no trajectory need be stored."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.kinematics import leg
from jaxbiped.planner import TaskSpace, support
from jaxbiped.robot import RobotParams
from jaxbiped.sim.seen import Seen
from jaxbiped.sim.sensors import roll_pitch_yaw

OK, FELL, NONFINITE, AIRBORNE = 0, 1, 2, 3
STATUS_TEXT = ("ok", "fell", "nonfinite", "airborne")
"""Words for the status of a whole walk."""
FALL_TILT = math.radians(45.0)
"""Trunk tilt at which a robot counts as fallen [rad]."""
FALL_HEIGHT = 0.6
"""Height of the pelvis over the lower foot, as a share of that at the start, below which it counts as fallen."""
AIRBORNE_TIME = 0.5
"""Time without any ground force after which a robot counts as carried off [s]: gaits have no flight."""
TOUCHING = 1.0
"""Vertical force of both feet together below which there is no ground force [N]."""
LOADED = 50.0
"""Vertical force over which a foot counts as loaded [N]."""
TOUCHDOWN = 0.1
"""Time after it was loaded for which a foot is touching down [s]."""


class Statistics(eqx.Module):
    """Statistics that are kept of a roll-out."""

    status: Int[Array, ""]
    """OK, FELL, NONFINITE or AIRBORNE; the first failure stays."""
    end_time: Float[Array, ""]
    """Time of the first failure, or the time reached [s]."""
    peak_roll_pitch: Float[Array, "2"]
    """Largest magnitude of roll and of pitch [rad]."""
    peak_foot_force: Float[Array, "2"]
    """Largest vertical force on each foot [N]."""
    peak_slip: Float[Array, "2"]
    """Largest horizontal distance of each sole, while it is loaded, from where it was loaded last [m]."""
    peak_touchdown_force: Float[Array, "2"]
    """Largest vertical force on each foot within TOUCHDOWN after it was loaded [N]."""
    peak_touchdown_impulse: Float[Array, "2"]
    """Largest integral over one touchdown of the vertical force on each foot [N s]."""
    zmp_margin: Float[Array, ""]
    """Smallest distance of the center of pressure from the edge of the soles of the loaded feet, seen from above [m];
    0 on an edge; at control ticks."""
    reach_margin: Float[Array, ""]
    """Smallest difference between the longest leg and the most stretched one asked for, negative beyond reach [m]."""
    support_time: Float[Array, ""]
    """Last time with any ground force [s]."""
    touch_time: Float[Array, "2"]
    """Time at which each foot was loaded last, interpolated inside the tick [s]; -1 at the start."""
    touch_impulse: Float[Array, "2"]
    """Integral of the vertical force over the touchdown of each foot so far [N s]."""
    anchor: Float[Array, "2 2"]
    """Place of each foot when it was loaded last, interpolated inside the tick [m]."""
    loaded: Bool[Array, "2"]
    """Whether each foot is loaded."""
    foot_force: Float[Array, "2"]
    """Vertical force on each foot in the last tick [N]."""
    p_world_foot: Float[Array, "2 2"]
    """Place of each foot at the start of the last tick, seen from above [m]."""
    out_of_reach_time: Float[Array, ""]
    """Time for which the targets were beyond the legs' reach or joint ranges [s]."""
    p_world_trunk: Float[Array, "3"]
    """Pelvis frame origin, last [m]."""
    pelvis_height: Float[Array, ""]
    """Pelvis over the lower ankle at the start [m]."""


def init(seen: Seen) -> Statistics:
    """Statistics before the first tick."""
    zero = jnp.zeros((), seen.gap.dtype)
    return Statistics(
        status=jnp.array(OK, jnp.int32),
        end_time=zero,
        peak_roll_pitch=jnp.zeros(2, zero.dtype),
        peak_foot_force=jnp.zeros(2, zero.dtype),
        peak_slip=jnp.zeros(2, zero.dtype),
        peak_touchdown_force=jnp.zeros(2, zero.dtype),
        peak_touchdown_impulse=jnp.zeros(2, zero.dtype),
        zmp_margin=zero + jnp.inf,
        reach_margin=zero + jnp.inf,
        support_time=zero,
        touch_time=jnp.full(2, -1.0, zero.dtype),
        touch_impulse=jnp.zeros(2, zero.dtype),
        anchor=seen.p_world_foot[:, :2],
        loaded=jnp.ones(2, bool),
        foot_force=jnp.zeros(2, zero.dtype),
        p_world_foot=seen.p_world_foot[:, :2],
        out_of_reach_time=zero,
        p_world_trunk=seen.p_world_trunk,
        pelvis_height=seen.p_world_trunk[2] - seen.p_world_foot[:, 2].min(),
    )


def update(stats: Statistics, seen: Seen, time: Float[Array, ""], dt: float) -> Statistics:
    """Update the statistics after a physics tick of `dt` that ended at `time` [s], by what it saw at its start."""
    vertical = seen.force[..., 2].sum(axis=1)
    loaded = vertical > LOADED
    landed, left = loaded & ~stats.loaded, stats.loaded & ~loaded
    place, before = seen.p_world_foot[:, :2], stats.foot_force
    # Where in the tick the force crossed LOADED, and where the foot was then: landing and leaving take effect there.
    crosses = landed | left
    share = jnp.where(crosses, (LOADED - before) / jnp.where(crosses, vertical - before, 1.0), 1.0)
    crossed = stats.p_world_foot + share[:, None] * (place - stats.p_world_foot)
    anchor = jnp.where(landed[:, None], crossed, stats.anchor)
    touch_time = jnp.where(landed, time - dt * (1.0 - share), stats.touch_time)
    # For how long of the tick the foot is touching down.
    within = jnp.minimum(time, touch_time + TOUCHDOWN) - jnp.maximum(time - dt, touch_time)
    within = jnp.where(touch_time >= 0.0, jnp.maximum(within, 0.0), 0.0)
    force = jnp.where(within > 0.0, vertical, 0.0)
    impulse = jnp.where(landed, 0.0, stats.touch_impulse) + within * vertical
    reached = jnp.where(left[:, None], crossed, place)
    slip = jnp.where(loaded | left, jnp.sqrt(jnp.sum((reached - anchor) ** 2, axis=1) + 1e-18), 0.0)
    tilt = jnp.abs(roll_pitch_yaw(seen.rot_world_trunk)[:2])
    low = seen.p_world_trunk[2] - seen.p_world_foot[:, 2].min() < FALL_HEIGHT * stats.pelvis_height
    fell = (jnp.max(tilt) > FALL_TILT) | low
    support_time = jnp.where(vertical.sum() > TOUCHING, time, stats.support_time)
    airborne = time - support_time > AIRBORNE_TIME
    finite = jnp.all(jnp.isfinite(seen.p_world_trunk)) & jnp.all(jnp.isfinite(vertical))
    fine = jnp.where(airborne, AIRBORNE, OK)
    return Statistics(
        status=jnp.where(~finite, NONFINITE, jnp.where(fell, FELL, fine)).astype(jnp.int32),
        end_time=time,
        peak_roll_pitch=jnp.maximum(stats.peak_roll_pitch, tilt),
        peak_foot_force=jnp.maximum(stats.peak_foot_force, vertical),
        peak_slip=jnp.maximum(stats.peak_slip, slip),
        peak_touchdown_force=jnp.maximum(stats.peak_touchdown_force, force),
        peak_touchdown_impulse=jnp.maximum(stats.peak_touchdown_impulse, impulse),
        zmp_margin=stats.zmp_margin,
        reach_margin=stats.reach_margin,
        support_time=support_time,
        touch_time=touch_time,
        touch_impulse=impulse,
        anchor=anchor,
        loaded=loaded,
        foot_force=vertical,
        p_world_foot=place,
        out_of_reach_time=stats.out_of_reach_time,
        p_world_trunk=seen.p_world_trunk,
        pelvis_height=stats.pelvis_height,
    )


def update_margins(
    stats: Statistics,
    robot: RobotParams,
    seen: Seen,
    zmp: Float[Array, "2"],
    asked: TaskSpace,
    out_of_reach: Bool[Array, ""],
    dt: float,
) -> Statistics:
    """Update the margins after one control tick of `dt` [s], by the center of pressure and the targets asked for.

    Args:
        stats: so far.
        robot: nominal.
        seen: in the last physics tick.
        zmp: center of pressure [m].
        asked: targets of this tick.
        out_of_reach: whether inverse kinematics had to move them.
        dt: [s].
    """
    inside = support.margin(seen.p_world_corner[..., :2].reshape(8, 2), jnp.repeat(stats.loaded, 4), zmp)
    reach = reach_margin(robot, asked)
    return eqx.tree_at(
        lambda s: (s.zmp_margin, s.reach_margin, s.out_of_reach_time),
        stats,
        (
            jnp.minimum(stats.zmp_margin, inside),
            jnp.minimum(stats.reach_margin, reach),
            stats.out_of_reach_time + jnp.where(out_of_reach, dt, 0.0),
        ),
    )


def reach_margin(robot: RobotParams, asked: TaskSpace) -> Float[Array, ""]:
    """Smallest difference between the longest leg and the leg length asked for, with level soles [m]."""
    up = jnp.zeros(3, asked.sole.dtype).at[2].set(robot.ankle_height)
    ankle = asked.sole - asked.pelvis + up
    longest = jnp.stack([leg.reach(robot, side)[1] for side in (0, 1)])
    return jnp.min(longest - jnp.sqrt(jnp.sum((ankle - robot.p_pelvis_hip) ** 2, axis=1)))

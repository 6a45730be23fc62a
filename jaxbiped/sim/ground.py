"""Compliant ground under the eight sole corners, outside MuJoCo's constraint solver.

The gap of a corner is its height over the ground under it. Normal force after Hunt and Crossley, N = k d max(0, 1 + s)
in the depth d = max(0, -gap): continuous at touchdown and at lift-off, which is what makes derivatives through a
touchdown mean something. Theirs has s = a d', which makes a hard blow many times harder than the spring alone; here s
levels off at DAMPED, s = a d' / sqrt(1 + (a d' / DAMPED)^2). It acts along the gradient of the gap, so that edges push
back sideways and no energy comes from nothing. Friction by Coulomb, regularized: mu N v / sqrt(v^2 + v_s^2).

Both are stiff: they act with the position and the velocity of the end of the tick, linearized about its start
(`damping_matrix`).
"""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.kinematics import GRAVITY
from jaxbiped.robot import RobotParams
from jaxbiped.sim import mjx_adapter, spatial
from jaxbiped.sim.mjx_adapter import BodyMotion, JointMatrix
from jaxbiped.sim.scenario import EDGE_WIDTH, Ground, Terrain

DAMPED = 3.0
"""Largest share of the spring's force that damping adds; more than 1, so that what comes off the ground is let go."""


class Contact(eqx.Module):
    """Ground forces at one instant."""

    gap: Float[Array, "2 4"]
    """Height of every sole corner over the ground under it [m]."""
    gap_rate: Float[Array, "2 4"]
    """Rate of the gap, the vertical velocity of the corner over level ground [m/s]."""
    gradient: Float[Array, "2 4 3"]
    """Derivative of the gap by the corner's place: (0, 0, 1) over level ground, longer over edges."""
    p_world_corner: Float[Array, "2 4 3"]
    """Place of every sole corner [m]."""
    v_world_corner: Float[Array, "2 4 3"]
    """Velocity of every sole corner [m/s]."""
    force: Float[Array, "2 4 3"]
    """Force on the foot at every sole corner, world axes [N]."""
    normal_damping: Float[Array, "2 4"]
    """Decrease of the force along the gradient per gap rate at the end of the tick [N s/m]."""
    drag: Float[Array, "2 4"]
    """Friction force per sliding speed [N s/m]."""


def height(terrain: Terrain, xy: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """Height of the ground at points (*n, 2) [m]; edges rise over EDGE_WIDTH, centered on the edge."""
    return height_and_slope(terrain, xy)[0]


def height_and_slope(
    terrain: Terrain, xy: Float[Array, "*n 2"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n 2"]]:
    """Height of the ground at points (*n, 2) [m], and how it rises along x and y."""
    point = xy[..., None, :]
    from_lower, to_upper = point - terrain.lower, terrain.upper - point
    share = jnp.clip(jnp.minimum(from_lower, to_upper) / EDGE_WIDTH + 0.5, 0.0, 1.0)
    smooth = share * share * (3.0 - 2.0 * share)
    steep = 6.0 * share * (1.0 - share) / EDGE_WIDTH * jnp.where(from_lower < to_upper, 1.0, -1.0)
    across = jnp.stack([steep[..., 0] * smooth[..., 1], smooth[..., 0] * steep[..., 1]], axis=-1)
    level = jnp.sum(terrain.height * smooth[..., 0] * smooth[..., 1], axis=-1)
    return level, jnp.sum(terrain.height[..., None] * across, axis=-2)


def stiffness(robot: RobotParams, ground: Ground) -> Float[Array, ""]:
    """Stiffness of one corner [N/m] that gives the stated sinkage of the nominal robot on both feet."""
    return robot.total_mass * GRAVITY / (8.0 * ground.sinkage)


def one_sided_spring(
    gap: Float[Array, "*n"],
    rate: Float[Array, "*n"],
    stiffness: Float[Array, "*m"],
    damping: Float[Array, "*m"] | float,
    dt: float,
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Force of a stop after Hunt and Crossley, and how much it falls with the rate at the end of the tick.

    Implicit: the depth is the one at the end of the tick, and so is the rate that damping goes by, but for what levels
    it off, which is the rate at the start: with the slope of the leveled law at high rates too little would be damped
    within a tick, and ticks of 1 and 2 ms would gain energy at edges.

    Args:
        gap: before the stop, negative inside [m or rad].
        rate: of the gap.
        stiffness: force per depth.
        damping: relative force per rate, where that is small [s/m or s/rad].
        dt: [s].
    """
    depth = jnp.maximum(-(gap + dt * rate), 0.0)
    damping = damping / jnp.sqrt(1.0 + jnp.square(damping * rate / DAMPED))
    pressing = jnp.maximum(1.0 - damping * rate, 0.0)
    by_depth = jnp.where(depth > 0.0, dt * stiffness * pressing, 0.0)
    by_rate = jnp.where(pressing > 0.0, stiffness * depth * damping, 0.0)
    return stiffness * depth * pressing, by_depth + by_rate


def contact(
    robot: RobotParams,
    ground: Ground,
    terrain: Terrain,
    body: BodyMotion,
    pressed: Float[Array, "2 4"] | None = None,
    dt: float = 0.0,
) -> Contact:
    """Gap, velocity and ground force of every sole corner, the force at the velocity of the start of the tick.

    Args:
        robot: nominal.
        ground: its law.
        terrain: its shape.
        body: where the robot is and how it moves.
        pressed: normal force at every corner that friction goes by, that of the tick before [N]; None for this one's.
        dt: tick over which the normal force is taken implicitly [s]; 0 for the force at this instant.
    """
    below_ankle = jnp.zeros(3, robot.ankle_height.dtype).at[2].set(-robot.ankle_height)
    arms = jnp.einsum("fij,fcj->fci", body.rot_world_foot, robot.p_sole_corner + below_ankle)
    points = body.p_world_foot[:, None] + arms
    omega, linear = body.twist_foot[:, None, :3], body.twist_foot[:, None, 3:]
    velocity = linear + spatial.cross(omega, points - body.centre)
    level, slope = height_and_slope(terrain, points[..., :2])
    gradient = jnp.concatenate([-slope, jnp.ones_like(slope[..., :1])], axis=-1)
    gap, rate = points[..., 2] - level, jnp.sum(gradient * velocity, axis=-1)
    push, normal_damping = one_sided_spring(gap, rate, stiffness(robot, ground), ground.damping, dt)
    steepness = jnp.sum(gradient * gradient, axis=-1)
    normal = push * jnp.sqrt(steepness) if pressed is None else pressed
    sliding = velocity - (rate / steepness)[..., None] * gradient
    speed = jnp.sqrt(jnp.sum(sliding * sliding, axis=-1) + ground.slip_speed**2)
    drag = ground.friction * normal / speed
    return Contact(
        gap=gap,
        gap_rate=rate,
        gradient=gradient,
        p_world_corner=points,
        v_world_corner=velocity,
        force=push[..., None] * gradient - drag[..., None] * sliding,
        normal_damping=normal_damping,
        drag=drag,
    )


def _give(contact: Contact) -> Float[Array, "2 4 3 3"]:
    """Decrease of the force at every corner per velocity of the corner at the end of the tick [N s/m]."""
    gradient = contact.gradient
    steepness = jnp.sum(gradient * gradient, axis=-1)
    along = contact.normal_damping - contact.drag / steepness
    outer = gradient[..., :, None] * gradient[..., None, :]
    return contact.drag[..., None, None] * jnp.eye(3, dtype=outer.dtype) + along[..., None, None] * outer


def force_after(body: BodyMotion, contact: Contact, d_qvel: Float[Array, " nv"]) -> Float[Array, "2 4 3"]:
    """Force at every corner [N] that acts at the velocity after a change of qvel."""
    twist = mjx_adapter.foot_twist(body, d_qvel)[:, None]
    change = twist[..., 3:] + spatial.cross(twist[..., :3], contact.p_world_corner - body.centre)
    return contact.force - jnp.sum(_give(contact) * change[..., None, :], axis=-1)


def normal_force(contact: Contact) -> Float[Array, "2 4"]:
    """Force at every corner along the ground's normal, which the friction of the next tick goes by [N]."""
    steepness = jnp.sum(contact.gradient * contact.gradient, axis=-1)
    along = jnp.sum(contact.force * contact.gradient, axis=-1) / jnp.sqrt(steepness)
    return jnp.maximum(along, 0.0)


def damping_matrix(body: BodyMotion, contact: Contact) -> JointMatrix:
    """Joint-space damping of the ground forces [qfrc per qvel].

    A corner at r from the center moves with a twist (w, v) at v + w x r, and a force there is the wrench (r x f, f).
    """
    r = contact.p_world_corner - body.centre
    lever = jnp.stack(
        [spatial.cross(r, axis) for axis in jnp.eye(3, dtype=r.dtype)], axis=-1
    )  # r x, as a matrix
    spread = jnp.concatenate([lever, jnp.broadcast_to(jnp.eye(3, dtype=r.dtype), lever.shape)], axis=-2)
    pulled = jnp.sum(spread[..., :, :, None] * _give(contact)[..., None, :, :], axis=-2)
    foot = jnp.sum(pulled[..., :, None, :] * spread[..., None, :, :], axis=(1, -1))
    axes = mjx_adapter.foot_axes(body)
    wrench = [jnp.sum(axes * foot[:, None, i], axis=-1) for i in range(6)]
    products = [w[:, :, None] * axes[:, None, :, i] for i, w in enumerate(wrench)]
    feet = functools.reduce(jnp.add, products)
    return JointMatrix(trunk=feet[:, :6, :6].sum(axis=0), coupling=feet[:, 6:, :6], leg=feet[:, 6:, 6:])

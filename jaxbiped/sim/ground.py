"""Compliant ground under the eight sole corners, outside MuJoCo's constraint solver.

Normal force by Hunt and Crossley, N = k d max(0, 1 + a d'): continuous at touchdown and at lift-off, which is what
makes derivatives through a touchdown mean something. Friction by Coulomb, regularised: mu N v / sqrt(v^2 + v_s^2).
Friction is stiff, mu N / v_s per unit of speed: it acts on the velocity at the end of the tick (`drag_matrix`);
explicit integration would let the feet creep.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.kinematics import GRAVITY
from jaxbiped.robot import RobotParams
from jaxbiped.sim import mjx_adapter
from jaxbiped.sim.mjx_adapter import BodyMotion, JointMatrix
from jaxbiped.sim.scenario import EDGE_WIDTH, Ground, Terrain


class Contact(eqx.Module):
    """Ground forces at one instant."""

    gap: Float[Array, "2 4"]
    """Height of every sole corner over the ground under it [m]."""
    gap_rate: Float[Array, "2 4"]
    """Its rate, vertical velocity of the corner over level ground [m/s]."""
    p_world_corner: Float[Array, "2 4 3"]
    """[m]"""
    v_world_corner: Float[Array, "2 4 3"]
    """[m/s]"""
    force: Float[Array, "2 4 3"]
    """On the foot, world axes, at the velocity of the start of the tick [N]."""
    drag: Float[Array, "2 4"]
    """Friction force per sliding speed [N s/m]."""


def height(terrain: Terrain, xy: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """Height of the ground at points (*n, 2) [m]; edges rise over EDGE_WIDTH, centred on the edge."""
    point = xy[..., None, :]
    into = jnp.minimum(point - terrain.lower, terrain.upper - point)
    share = jnp.clip(into / EDGE_WIDTH + 0.5, 0.0, 1.0)
    smooth = share * share * (3.0 - 2.0 * share)
    return jnp.sum(terrain.height * smooth[..., 0] * smooth[..., 1], axis=-1)


def stiffness(robot: RobotParams, ground: Ground) -> Float[Array, ""]:
    """Stiffness of one corner [N/m] that gives the stated sinkage of the nominal robot on both feet."""
    return robot.total_mass * GRAVITY / (8.0 * ground.sinkage)


def contact(robot: RobotParams, ground: Ground, terrain: Terrain, body: BodyMotion) -> Contact:
    """Gap, velocity and ground force of every sole corner."""
    below_ankle = jnp.zeros(3, robot.ankle_height.dtype).at[2].set(-robot.ankle_height)
    arms = jnp.einsum("fij,fcj->fci", body.rot_world_foot, robot.p_sole_corner + below_ankle)
    points = body.p_world_foot[:, None] + arms
    omega, linear = body.twist_foot[:, None, :3], body.twist_foot[:, None, 3:]
    velocity = linear + jnp.cross(omega, points - body.centre)
    gap = points[..., 2] - height(terrain, points[..., :2])
    depth = jnp.maximum(-gap, 0.0)
    normal = stiffness(robot, ground) * depth * jnp.maximum(1.0 - ground.damping * velocity[..., 2], 0.0)
    sliding = velocity[..., :2]
    speed = jnp.sqrt(jnp.sum(sliding * sliding, axis=-1) + ground.slip_speed**2)
    drag = ground.friction * normal / speed
    return Contact(
        gap=gap,
        gap_rate=velocity[..., 2],
        p_world_corner=points,
        v_world_corner=velocity,
        force=jnp.concatenate([-drag[..., None] * sliding, normal[..., None]], axis=-1),
        drag=drag,
    )


def force_after(body: BodyMotion, contact: Contact, d_qvel: Float[Array, "18"]) -> Float[Array, "2 4 3"]:
    """Force at every corner when friction acts on the velocities after a change of qvel [N]."""
    twist = mjx_adapter.foot_twist(body, d_qvel)[:, None]
    change = twist[..., 3:] + jnp.cross(twist[..., :3], contact.p_world_corner - body.centre)
    return contact.force.at[..., :2].add(-contact.drag[..., None] * change[..., :2])


def drag_matrix(body: BodyMotion, contact: Contact) -> JointMatrix:
    """Joint-space damping of the friction forces [qfrc per qvel].

    A corner at r from the centre moves sideways with a twist (w, v) at v + w x r, so that the drag of a foot's corners
    turns its twist into a wrench as a planar inertia does: by the sums of drag, drag r and drag r r'.
    """
    r, drag = contact.p_world_corner - body.centre, contact.drag[..., None]
    total, first = contact.drag.sum(axis=1), jnp.sum(drag * r, axis=1)
    x, y, z = (first[:, i, None] for i in range(3))
    across, along = jnp.sum(drag * r * r[..., 2:], axis=1), jnp.sum(drag * r * r, axis=1)
    xz, yz, zz = (across[:, i, None] for i in range(3))
    flat = (along[:, 0] + along[:, 1])[:, None]
    axes = mjx_adapter.foot_axes(body)
    wx, wy, wz, vx, vy, _ = (axes[..., i] for i in range(6))
    wrench = (
        zz * wx - xz * wz - z * vy,
        zz * wy - yz * wz + z * vx,
        flat * wz - xz * wx - yz * wy + x * vy - y * vx,
        total[:, None] * vx + z * wy - y * wz,
        total[:, None] * vy - z * wx + x * wz,
    )
    products = [w[:, :, None] * a[:, None, :] for w, a in zip(wrench, (wx, wy, wz, vx, vy), strict=True)]
    feet = functools.reduce(jnp.add, products)
    return JointMatrix(trunk=feet[:, :6, :6].sum(axis=0), coupling=feet[:, 6:, :6], leg=feet[:, 6:, 6:])

"""Spatial vectors of a trunk with two legs: what a small motion of the joints does, and inverse dynamics.

MJX simulates; this is what a tick is differentiated by. With world axes and one reference point for all links, the
recursions along a leg are running sums: a link moves with the sum of what the joints before it do, and a joint carries
the sum of what the links after it need.

Spatial vectors are (angular, linear) about the reference point, the robot's center of mass.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.robot.layout import BASE, BIPED, TURNING


class Links(eqx.Module):
    """The links at one instant."""

    axes: Float[Array, "nv 6"]
    """Spatial motion per unit of each qvel."""
    inertia: Float[Array, "link 10"]
    """Inertia of the trunk and of the links of both legs: xx, yy, zz, xy, xz, yz, first moment, mass."""


class Along(eqx.Module):
    """A spatial vector of every link."""

    trunk: Float[Array, "6"]
    leg: Float[Array, "2 6 6"]
    """Vectors of the links of both legs; the last axis but one goes from hip to foot."""

    @property
    def all(self) -> Float[Array, "link 6"]:
        """Vectors of trunk, left leg and right leg in one array."""
        return jnp.concatenate([self.trunk[None], self.leg.reshape(12, 6)])


def cross(a: Float[Array, "*n 3"], b: Float[Array, "*m 3"]) -> Float[Array, "*k 3"]:
    """Vector product; leading axes are broadcast."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def cross_motion(twist: Float[Array, "*n 6"], motion: Float[Array, "*m 6"]) -> Float[Array, "*k 6"]:
    """Rate of a motion vector that is carried along with a twist."""
    w, v, ang, lin = twist[..., :3], twist[..., 3:], motion[..., :3], motion[..., 3:]
    return jnp.concatenate([cross(w, ang), cross(w, lin) + cross(v, ang)], axis=-1)


def cross_force(twist: Float[Array, "*n 6"], wrench: Float[Array, "*m 6"]) -> Float[Array, "*k 6"]:
    """Rate of a wrench that is carried along with a twist."""
    w, v, moment, force = twist[..., :3], twist[..., 3:], wrench[..., :3], wrench[..., 3:]
    return jnp.concatenate([cross(w, moment) + cross(v, force), cross(w, force)], axis=-1)


def times_inertia(inertia: Float[Array, "*n 10"], motion: Float[Array, "*n 6"]) -> Float[Array, "*n 6"]:
    """Momentum of a motion, or the force of an acceleration."""
    xx, yy, zz, xy, xz, yz = (inertia[..., i] for i in range(6))
    first, mass = inertia[..., 6:9], inertia[..., 9:]
    w, v = motion[..., :3], motion[..., 3:]
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    turn = jnp.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], axis=-1)
    return jnp.concatenate([turn + cross(first, v), mass * v - cross(first, w)], axis=-1)


def _down(trunk: Float[Array, "6"], joints: Float[Array, "2 6 6"]) -> Along:
    """Running sum from the trunk to the feet."""
    total, sums = jnp.broadcast_to(trunk, (2, 6)), []
    for joint in range(6):
        total = total + joints[:, joint]
        sums.append(total)
    return Along(trunk, jnp.stack(sums, axis=1))


def velocities(axes: Float[Array, "nv 6"], speed: Float[Array, " nv"]) -> Along:
    """Twist of every link; for a small shift of the coordinates, the displacement of every link."""
    moving = axes * speed[:, None]
    return _down(moving[BASE].sum(axis=0), BIPED.leg_rows(moving))


def centre_shift(links: Links, moved: Along) -> Float[Array, "3"]:
    """Displacement of the center of mass, which is the reference point."""
    first, mass = links.inertia[:, 6:9], links.inertia[:, 9:]
    way = moved.all
    return jnp.sum(mass * way[:, 3:] + cross(way[:, :3], first), axis=0) / mass.sum()


def point_shift(moved: Float[Array, "*n 6"], point: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Displacement of a point of a link, given its place relative to the reference point."""
    return moved[..., 3:] + cross(moved[..., :3], point)


def turned(by: Float[Array, "*n 3"], rotation: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3 3"]:
    """Change of a rotation matrix that is turned by a small angle."""
    columns = jnp.swapaxes(rotation, -1, -2)
    return jnp.swapaxes(cross(jnp.broadcast_to(by[..., None, :], columns.shape), columns), -1, -2)


def carried_along(links: Links, moved: Along, d_centre: Float[Array, "3"]) -> Links:
    """Change of axes and inertias with the displacement of the links and of the reference point."""
    way = moved.all.at[:, 3:].add(-d_centre)
    joints = cross_motion(way[1:], links.axes[BIPED.leg_dofs])
    rotations = cross_motion(jnp.broadcast_to(way[0], (3, 6)), links.axes[TURNING])
    axes = jnp.concatenate([jnp.zeros_like(rotations), rotations, joints])
    return Links(axes, _inertia_shift(links.inertia, way))


def _inertia_shift(inertia: Float[Array, "link 10"], way: Float[Array, "link 6"]) -> Float[Array, "link 10"]:
    xx, yy, zz, xy, xz, yz = (inertia[:, i] for i in range(6))
    first, mass = inertia[:, 6:9], inertia[:, 9:]
    w, v = way[:, :3], way[:, 3:]
    tensor = jnp.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3)
    turning = turned(w, tensor)
    moving = jnp.sum(first * v, axis=1)[:, None, None] * jnp.eye(3) - first[:, :, None] * v[:, None, :]
    d = turning + moving
    d = d + jnp.swapaxes(d, 1, 2)
    six = jnp.stack([d[:, 0, 0], d[:, 1, 1], d[:, 2, 2], d[:, 0, 1], d[:, 0, 2], d[:, 1, 2]], axis=-1)
    return jnp.concatenate([six, cross(w, first) + mass * v, jnp.zeros_like(mass)], axis=-1)


def inverse_dynamics(
    links: Links, speed: Float[Array, " nv"], acceleration: Float[Array, " nv"], gravity: Float[Array, "3"]
) -> Float[Array, " nv"]:
    """Generalized force that a motion needs, rotors left out (Newton and Euler's recursion).

    Args:
        links: axes and inertias about the reference point.
        speed: qvel.
        acceleration: qacc.
        gravity: [m/s2].
    """
    twist = velocities(links.axes, speed)
    trunk_axes, leg_axes = links.axes[BASE], BIPED.leg_rows(links.axes)
    rates = cross_motion(jnp.broadcast_to(twist.trunk, (3, 6)), trunk_axes[TURNING])
    falling = jnp.concatenate([jnp.zeros_like(gravity), -gravity])
    trunk = jnp.sum(trunk_axes * acceleration[BASE, None], axis=0)
    trunk = trunk + jnp.sum(rates * speed[TURNING, None], axis=0)
    joints = leg_axes * BIPED.leg_columns(acceleration)
    joints = joints + cross_motion(twist.leg, leg_axes) * BIPED.leg_columns(speed)
    accelerating, moving = _down(falling + trunk, joints).all, twist.all
    needed = times_inertia(links.inertia, accelerating)
    needed = needed + cross_force(moving, times_inertia(links.inertia, moving))
    legs = needed[1:].reshape(2, 6, 6)
    carried = [legs[:, 5]]
    for joint in range(4, -1, -1):
        carried.append(carried[-1] + legs[:, joint])
    on_trunk = needed[0] + carried[-1].sum(axis=0)
    on_legs = jnp.sum(leg_axes * jnp.stack(carried[::-1], axis=1), axis=2)
    return BIPED.joint_space(jnp.sum(trunk_axes * on_trunk, axis=1), on_legs)

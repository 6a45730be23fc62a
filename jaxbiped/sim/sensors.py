"""From the simulated world to `Sensed`: what the robot's own sensors would say."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxbiped.adapt import Sensed
from jaxbiped.sim.ground import Contact
from jaxbiped.sim.mjx_adapter import BodyMotion
from jaxbiped.sim.scenario import SensorFaults

class SwitchState(eqx.Module):
    """What the contact switches remember between two ticks."""

    closed: Bool[Array, "2 4"]
    gap: Float[Array, "2 4"]
    """Gap at the last reading [m]."""
    time: Float[Array, "2 4"]
    """When each last closed [s]."""


def init_switches(gap: Float[Array, "2 4"], faults: SensorFaults) -> SwitchState:
    """Switches of a robot that stands: those within their gap are closed, since before the walk."""
    closed = (gap <= faults.delta_z) & (faults.stuck_open < 0.5)
    return SwitchState(closed, gap, jnp.where(closed, 0.0, jnp.inf))


def read_switches(
    state: SwitchState, gap: Float[Array, "2 4"], time: Float[Array, ""], dt: float, faults: SensorFaults
) -> SwitchState:
    """Close every switch whose corner is within its gap of the ground; the instant is interpolated in the tick."""
    closed = (gap <= faults.delta_z) & (faults.stuck_open < 0.5)
    fallen = state.gap - gap
    share = jnp.clip((state.gap - faults.delta_z) / jnp.where(fallen > 0.0, fallen, 1.0), 0.0, 1.0)
    crossed = time - dt * (1.0 - share)
    return SwitchState(closed, gap, jnp.where(closed & ~state.closed, crossed, state.time))


def roll_pitch_yaw(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Roll, pitch and yaw [rad] of rotation = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll = jnp.arctan2(rotation[2, 1], rotation[2, 2])
    pitch = -jnp.arcsin(jnp.clip(rotation[2, 0], -0.999999, 0.999999))
    return jnp.stack([roll, pitch, jnp.arctan2(rotation[1, 0], rotation[0, 0])])


def centre_of_pressure(contact: Contact, otherwise: Float[Array, "2"]) -> Float[Array, "2"]:
    """Centre of the vertical forces at the corners, seen from above [m]; `otherwise` while nothing is loaded."""
    weight = contact.force[..., 2]
    total = weight.sum()
    loaded = total > 1.0
    moment = jnp.einsum("fc,fci->i", weight, contact.p_world_corner[..., :2])
    return jnp.where(loaded, moment / jnp.where(loaded, total, 1.0), otherwise)


def sense(
    body: BodyMotion,
    contact: Contact,
    qvel: Float[Array, "18"],
    angle: Float[Array, "2 6"],
    switches: SwitchState,
    zmp: Float[Array, "2"],
    time: Float[Array, ""],
) -> Sensed:
    """Read every sensor. Ankle wrenches are those of the ground; the foot's own weight and inertia are left out."""
    arm = contact.p_world_corner - body.p_world_foot[:, None]
    force = contact.force.sum(axis=1)
    moment = jnp.cross(arm, contact.force).sum(axis=1)
    to_foot = jnp.swapaxes(body.rot_world_foot, -1, -2)
    wrench = jnp.concatenate([jnp.einsum("fij,fj->fi", to_foot, force), jnp.einsum("fij,fj->fi", to_foot, moment)], 1)
    roll, pitch, yaw = roll_pitch_yaw(body.rot_world_trunk)
    forward, c, s = zmp - body.p_world_trunk[:2], jnp.cos(yaw), jnp.sin(yaw)
    return Sensed(
        time=time,
        switch=switches.closed,
        switch_time=switches.time,
        corner_force=contact.force[..., 2],
        ankle_wrench=wrench,
        angle=angle,
        speed=qvel[6:].reshape(2, 6),
        roll_pitch=jnp.stack([roll, pitch]),
        rate=qvel[3:6],
        zmp_world=zmp,
        zmp_body=jnp.stack([c * forward[0] + s * forward[1], -s * forward[0] + c * forward[1]]),
    )

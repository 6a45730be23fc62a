"""Simulated sensors: from the simulated world to `Sensed`, the readings of the robot's own sensors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.adapt import Sensed
from jaxbiped.kinematics import pose
from jaxbiped.kinematics.rotation import about_x, about_y
from jaxbiped.robot import LINK_NAMES, SIDE_NAMES, RobotParams
from jaxbiped.robot.layout import BIPED, TURNING
from jaxbiped.sim.scenario import SensorFaults
from jaxbiped.sim.seen import Seen

BOUNCE_PERIOD = 1e-3
"""Time for which a bouncing switch stays open or closed [s]."""
LOADED = 1.0
"""Sum of the vertical forces above which their center is defined [N]."""
_FEET = np.array([LINK_NAMES.index(f"{side}_foot") for side in SIDE_NAMES])
"""Numbers of the feet among the links."""


class SwitchState(eqx.Module):
    """State of the contact switches between two ticks."""

    closed: Bool[Array, "2 4"]
    gap: Float[Array, "2 4"]
    """Gap at the last reading [m]."""
    time: Float[Array, "2 4"]
    """Time at which each switch last closed [s]."""


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


def bouncing(state: SwitchState, time: Float[Array, ""], faults: SensorFaults) -> Bool[Array, "2 4"]:
    """Reading of the switches at `time` [s]: for a while after closing they open every other millisecond."""
    since = time - state.time
    opened = (since < faults.bounce) & (jnp.floor(since / BOUNCE_PERIOD) % 2 == 1)
    return state.closed & ~opened


def roll_pitch_yaw(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Roll, pitch and yaw [rad] of rotation = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll = jnp.arctan2(rotation[2, 1], rotation[2, 2])
    pitch = -jnp.arcsin(jnp.clip(rotation[2, 0], -0.999999, 0.999999))
    return jnp.stack([roll, pitch, jnp.arctan2(rotation[1, 0], rotation[0, 0])])


def centre_of_pressure(seen: Seen, otherwise: Float[Array, "2"]) -> Float[Array, "2"]:
    """Center of the vertical forces at the corners, seen from above [m]; `otherwise` while nothing is loaded."""
    weight = seen.force[..., 2]
    total = weight.sum()
    loaded = total > LOADED
    moment = jnp.einsum("fc,fci->i", weight, seen.p_world_corner[..., :2])
    return jnp.where(loaded, moment / jnp.where(loaded, total, 1.0), otherwise)


def sense(
    seen: Seen,
    qpos: Float[Array, " nq"],
    qvel: Float[Array, " nv"],
    switches: SwitchState,
    zmp: Float[Array, "2"],
    time: Float[Array, ""],
    faults: SensorFaults,
) -> Sensed:
    """Read every sensor. Ankle wrenches are those of the ground; the foot's own weight and inertia are left out."""
    arm = seen.p_world_corner - seen.p_world_foot[:, None]
    force = seen.force.sum(axis=1)
    moment = jnp.cross(arm, seen.force).sum(axis=1)
    to_foot = jnp.swapaxes(seen.rot_world_foot, -1, -2)
    wrench = jnp.concatenate(
        [jnp.einsum("fij,fj->fi", to_foot, force), jnp.einsum("fij,fj->fi", to_foot, moment)], 1
    )
    roll, pitch, yaw = roll_pitch_yaw(seen.rot_world_trunk)
    forward, c, s = zmp - seen.p_world_trunk[:2], jnp.cos(yaw), jnp.sin(yaw)
    return Sensed(
        time=time,
        switch=bouncing(switches, time, faults),
        switch_time=switches.time,
        corner_force=seen.force[..., 2],
        ankle_wrench=wrench,
        angle=BIPED.leg_angles(qpos),
        speed=BIPED.leg_speeds(qvel),
        roll_pitch=jnp.stack([roll, pitch]),
        rate=qvel[TURNING],
        zmp_world=zmp,
        zmp_body=jnp.stack([c * forward[0] + s * forward[1], -s * forward[0] + c * forward[1]]),
    )


class _Noise(eqx.Module):
    """Errors of one reading."""

    force: Float[Array, "2 4"]
    """Error of every corner force [N]."""
    angle: Float[Array, "2 6"]
    """Error of every joint angle [rad]."""
    roll_pitch: Float[Array, "2"]
    """Error of roll and pitch [rad]."""


def _draw_noise(faults: SensorFaults, tick: Int[Array, ""], dtype: np.dtype) -> _Noise:
    keys = jax.random.split(jax.random.fold_in(jax.random.key(faults.seed), tick), 3)
    return _Noise(
        force=faults.force_noise * jax.random.normal(keys[0], (2, 4), dtype),
        angle=faults.angle_noise * jax.random.normal(keys[1], (2, 6), dtype),
        roll_pitch=faults.angle_noise * jax.random.normal(keys[2], (2,), dtype),
    )


def add_noise(
    robot: RobotParams,
    sensed: Sensed,
    p_world_corner: Float[Array, "2 4 3"],
    faults: SensorFaults,
    tick: Int[Array, ""],
    every: int,
    control_dt: float,
) -> Sensed:
    """Put Gaussian noise on forces and angles, and on all that a robot computes of them; by seed and tick.

    What is measured: the vertical force at every sole corner, every joint angle, roll and pitch. What follows:

        zmp_world       center of the noisy forces at the true corners
        zmp_body        center of the noisy forces at the corners where noisy joint angles, roll and pitch put them
        ankle_wrench    that of the noisy forces, in the true foot axes
        speed           the noisy angles' change since the last reading, over `control_dt`

    `rate` is a gyroscope's and has no noise, nor has a switch. While nothing is loaded the ZMP stays as it is.

    Args:
        robot: as the planner knows it.
        sensed: readings without noise.
        p_world_corner: sole corners at which the forces act [m].
        faults: sizes of the noise, and its seed.
        tick: physics tick of this reading.
        every: physics ticks between two readings.
        control_dt: time between two readings [s].
    """
    dtype = sensed.angle.dtype
    noise, before = (_draw_noise(faults, at, dtype) for at in (tick, tick - every))
    force = sensed.corner_force + noise.force
    angle, roll_pitch = sensed.angle + noise.angle, sensed.roll_pitch + noise.roll_pitch
    corner, rot_foot = _feet_from_pelvis(robot, sensed.angle, sensed.roll_pitch)
    moved = _feet_from_pelvis(robot, angle, roll_pitch)[0] - corner
    moved = jnp.where(faults.angle_noise > 0.0, moved, 0.0)[..., :2]

    total = force.sum()
    loaded = (sensed.corner_force.sum() > LOADED) & (total > LOADED)
    scale = jnp.where(loaded, 1.0 / jnp.where(loaded, total, 1.0), 0.0)

    def shift(corner: Float[Array, "2 4 2"], zmp: Float[Array, "2"]) -> Float[Array, "2"]:
        """Shift of the center of all forces by the noisy ones."""
        return scale * jnp.einsum("fc,fci->i", noise.force, corner - zmp)

    up = rot_foot[:, 2]  # the world's vertical in foot axes
    arm = robot.p_sole_corner.at[..., 2].add(-robot.ankle_height)
    moment = jnp.einsum("fc,fci->fi", noise.force, jnp.cross(arm, up[:, None]))
    wrench = jnp.concatenate([noise.force.sum(axis=1)[:, None] * up, moment], axis=1)
    return eqx.tree_at(
        lambda s: (s.corner_force, s.ankle_wrench, s.angle, s.speed, s.roll_pitch, s.zmp_world, s.zmp_body),
        sensed,
        (
            force,
            sensed.ankle_wrench + wrench,
            angle,
            sensed.speed + (noise.angle - before.angle) / control_dt,
            roll_pitch,
            sensed.zmp_world + shift(p_world_corner[..., :2], sensed.zmp_world),
            sensed.zmp_body
            + shift(corner[..., :2], sensed.zmp_body)
            + scale * jnp.einsum("fc,fci->i", force, moved),
        ),
    )


def _feet_from_pelvis(
    robot: RobotParams, angle: Float[Array, "2 6"], roll_pitch: Float[Array, "2"]
) -> tuple[Float[Array, "2 4 3"], Float[Array, "2 3 3"]]:
    """Sole corners seen from the pelvis [m] and orientation of the feet, heading axes."""
    tilt = about_y(roll_pitch[1]) @ about_x(roll_pitch[0])
    feet = pose(robot, jnp.zeros(3, angle.dtype), tilt, angle)
    rotation = feet.rot_world_link[_FEET]
    return feet.p_world_sole[:, None] + jnp.einsum("fij,fcj->fci", rotation, robot.p_sole_corner), rotation


class Delay(eqx.Module):
    """The last few readings; what arrives is one of them. `time` is the robot's own clock and is never late."""

    readings: Sensed
    """Readings; the leading axis is their age in control ticks."""

    @classmethod
    def filled(cls, sensed: Sensed, room: int) -> "Delay":
        """Delay of a robot that has stood before the start."""
        return cls(jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (room + 1, *leaf.shape)), sensed))

    def push(self, sensed: Sensed, delay: Float[Array, ""], control_dt: float) -> tuple["Delay", Sensed]:
        """Take in a reading, give out the one that arrives now."""
        shifted = jax.tree.map(lambda old, new: jnp.concatenate([new[None], old[:-1]]), self.readings, sensed)
        age = jnp.clip(jnp.round(delay / control_dt), 0, shifted.time.shape[0] - 1).astype(jnp.int32)
        arriving = jax.tree.map(lambda leaf: leaf[age], shifted)
        return Delay(shifted), eqx.tree_at(lambda s: s.time, arriving, sensed.time)

"""The simulated robot in one scenario: its masses over time, and the forces that act on it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.robot import RobotParams, Servo
from jaxbiped.robot.layout import BIPED
from jaxbiped.sim import ground, mjx_adapter, servo
from jaxbiped.sim.mjx_adapter import PAYLOAD, TRUNK, BodyMotion
from jaxbiped.sim.scenario import Scenario
from jaxbiped.sim.servo import Reference

EXACT, THESIS = "exact", "thesis"
PAYLOAD_MODELS = (EXACT, THESIS)

STOP_STIFFNESS = 10.0
"""Stiffness of the spring at either end of a joint's range, relative to the position gain of its servo."""
STOP_DAMPING = 10.0
"""Damping of the spring at the ends of a joint's range, a in tau = k d (1 + a d') [s/rad]."""

BodyMasses = tuple[Float[Array, " body"], Float[Array, "body 3"], Float[Array, "body 3"]]


class World(eqx.Module):
    """A scenario and its effect on the robot: constant in a walk."""

    scenario: Scenario
    """The scenario."""
    servo: Servo
    """The servos of the simulated robot, model errors included."""
    before: BodyMasses
    """Mass, center of mass and principal inertias of the bodies without the payload."""
    after: BodyMasses
    """Mass, center of mass and principal inertias of the bodies with the payload."""


class Plant(eqx.Module):
    """A robot, its MJX model and the world it walks in."""

    robot: RobotParams
    """The robot as the planner knows it."""
    model: mjx_adapter.Model
    """MJX model of the robot."""
    world: World
    """The scenario and its effect on the robot."""

    @property
    def scenario(self) -> Scenario:
        """The scenario of the world."""
        return self.world.scenario

    @property
    def servo(self) -> Servo:
        """The servos of the simulated robot, model errors included."""
        return self.world.servo

    @property
    def before(self) -> BodyMasses:
        """Mass, center of mass and principal inertias of the bodies without the payload."""
        return self.world.before

    @property
    def after(self) -> BodyMasses:
        """Mass, center of mass and principal inertias of the bodies with the payload."""
        return self.world.after


def make_plant(
    robot: RobotParams, model: mjx_adapter.Model, scenario: Scenario, payload_model: str = EXACT
) -> Plant:
    """Apply a scenario's model errors and payload to the nominal robot.

    The payload's body is in its place from the start, without mass: only masses and inertias change while it comes.
    """
    before = _with_errors(mjx_adapter.masses(model), scenario)
    attach = {EXACT: _attach_exact, THESIS: _attach_thesis}[payload_model]
    scale = scenario.errors.gain_scale
    servos = eqx.tree_at(
        lambda s: (s.kp, s.kv, s.ki),
        robot.servo,
        tuple(scale * g for g in (robot.servo.kp, robot.servo.kv, robot.servo.ki)),
    )
    return Plant(robot, model, World(scenario, servos, before, attach(before, scenario)))


def _with_errors(masses: BodyMasses, scenario: Scenario) -> BodyMasses:
    mass, com, inertia = masses
    links = BIPED.links
    scale = scenario.errors.mass_scale
    return (
        mass.at[links].multiply(scale),
        com.at[TRUNK].add(scenario.errors.trunk_com_offset).at[PAYLOAD].set(scenario.payload.place),
        inertia.at[links].multiply(scale[:, None]),
    )


def _attach_exact(masses: BodyMasses, scenario: Scenario) -> BodyMasses:
    """Weld a uniform cube to the trunk; the parallel-axis theorem follows from the rigid-body dynamics."""
    mass, com, inertia = masses
    load = scenario.payload
    return (
        mass.at[PAYLOAD].set(load.mass),
        com,
        inertia.at[PAYLOAD].set(jnp.broadcast_to(load.mass * load.size**2 / 6.0, (3,))),
    )


def _attach_thesis(masses: BodyMasses, scenario: Scenario) -> BodyMasses:
    """The trunk's mass, center of mass and inertia as in elkahlout Eqs. 3.8-3.10: no parallel-axis term."""
    mass, com, inertia = masses
    load = scenario.payload
    total = mass[TRUNK] + load.mass
    centre = (mass[TRUNK] * com[TRUNK] + load.mass * load.place) / total
    return (
        mass.at[TRUNK].set(total),
        com.at[TRUNK].set(centre),
        inertia.at[TRUNK].multiply(total / mass[TRUNK]),
    )


def body_motion(
    plant: Plant, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], time: Float[Array, ""], dt: float
) -> BodyMotion:
    """Kinematics and dynamics at the masses of this tick; a load counts for the part of it in which it is attached."""
    return _motion(plant, qpos, qvel, plant.scenario.payload.share(time, dt))


def motion_at_rest(plant: Plant, qpos: Float[Array, " nq"]) -> BodyMotion:
    """Kinematics and dynamics at rest before the walk, with a load only if it is carried from the start."""
    carried = plant.scenario.payload.is_carried.astype(qpos.dtype)
    return _motion(plant, qpos, jnp.zeros(BIPED.nv, qpos.dtype), carried)


def _motion(
    plant: Plant, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], share: Float[Array, ""]
) -> BodyMotion:
    return mjx_adapter.motion(mjx_adapter.with_masses(plant.model, *masses(plant, share)), qpos, qvel)


def masses(plant: Plant, share: Float[Array, ""]) -> BodyMasses:
    """Masses of the bodies with a share of the load, 0 to 1."""
    mass, com, inertia = (b + share * (a - b) for b, a in zip(plant.before, plant.after, strict=True))
    return mass, com, inertia


def contact_force(body: BodyMotion, contact: ground.Contact) -> Float[Array, " nv"]:
    """Joint-space force of the ground."""
    arm = contact.p_world_corner - body.centre
    moment = jnp.cross(arm, contact.force).sum(axis=1)
    return mjx_adapter.generalized_force(body, moment, contact.force.sum(axis=1))


def push_force(plant: Plant, body: BodyMotion, time: Float[Array, ""], dt: float) -> Float[Array, " nv"]:
    """Joint-space force of the push, on the trunk's center of mass; its ends count by their share of the tick."""
    push = plant.scenario.push
    overlap = jnp.minimum(time + dt, push.start + push.length) - jnp.maximum(time, push.start)
    force = jnp.clip(overlap / dt, 0.0, 1.0) * push.force
    point = body.p_world_trunk + body.rot_world_trunk @ plant.before[1][TRUNK]
    return mjx_adapter.trunk_force(body, jnp.cross(point - body.centre, force), force)


class Forces(eqx.Module):
    """Forces and inertias from which the acceleration of a tick follows."""

    body: BodyMotion
    """Motion of the body at the start of the tick."""
    contact: ground.Contact
    """Contact forces at the start of the tick."""
    torque: Float[Array, "2 6"]
    """Torques of servos and stops, at the joint speeds of the start of the tick [N m]."""
    damping: Float[Array, "2 6"]
    """Damping that servos and stops still owe, see `servo.torque` [N m s/rad]."""
    push: Float[Array, " nv"]
    """Joint-space force of the push."""
    qvel: Float[Array, " nv"]
    """Joint-space velocity at the start of the tick."""
    gravity: Float[Array, "3"]
    """Gravitational acceleration [m/s2]."""
    armature: Float[Array, " nv"]
    """Inertia of the rotors per joint [kg m2]."""
    dt: float = eqx.field(static=True)
    """Tick [s]."""


@jax.custom_jvp
def acceleration(forces: Forces) -> Float[Array, " nv"]:
    """Joint-space acceleration; ground, stops and the servos' damping act at the velocity of the end of the tick.

    Differentiated through inverse dynamics: what a change leaves of `balance` must be made good by the acceleration.
    Neither the inertia matrix nor the elimination is differentiated.
    """
    return mjx_adapter.solve(_matrix(forces), _force(forces))


@acceleration.defjvp
def _acceleration_jvp(
    primals: tuple[Forces], tangents: tuple[Forces]
) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
    # One elimination for the acceleration and all its tangents.
    inverse = mjx_adapter.inverse(_matrix(*primals))
    qacc = inverse.times(_force(*primals))
    _, left = jax.jvp(lambda forces: balance(forces, qacc), primals, tangents)
    return qacc, inverse.times(left)


def _force(forces: Forces) -> Float[Array, " nv"]:
    """Joint-space force at the velocity of the start of the tick."""
    body, torque = forces.body, forces.torque.reshape(-1)
    return (contact_force(body, forces.contact) + forces.push - body.bias).at[BIPED.leg_dofs].add(torque)


def _matrix(forces: Forces) -> mjx_adapter.JointMatrix:
    """Joint-space inertia, plus the effect of the forces that act at the end of the tick."""
    body, dt = forces.body, forces.dt
    matrix = jax.tree.map(
        lambda inertia, damping: inertia + dt * damping,
        mjx_adapter.blocks(body.mass_matrix),
        ground.damping_matrix(body, forces.contact),
    )
    return eqx.tree_at(lambda m: m.leg, matrix, matrix.leg + dt * forces.damping[..., None] * jnp.eye(6))


def balance(forces: Forces, qacc: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Joint-space force that an acceleration leaves over: zero for the right one."""
    body, change = forces.body, forces.dt * qacc
    late = forces.torque - forces.damping * BIPED.leg_speeds(change)
    contact = eqx.tree_at(lambda c: c.force, forces.contact, ground.force_after(body, forces.contact, change))
    given = (contact_force(body, contact) + forces.push).at[BIPED.leg_dofs].add(late.reshape(-1))
    needed = mjx_adapter.inverse_dynamics(body, forces.qvel, qacc, forces.gravity)
    return given - needed - forces.armature * qacc


def joint_torque(
    plant: Plant,
    reference: Reference,
    qpos: Float[Array, " nq"],
    qvel: Float[Array, " nv"],
    integral: Float[Array, "2 6"],
    dt: float,
    ahead: float = 0.0,
) -> tuple[Float[Array, "2 6"], Float[Array, "2 6"], Float[Array, "2 6"]]:
    """Torques of the servos, torques of servos and stops together, and the damping both still owe.

    At the ends of its range a joint meets a one-sided spring, STOP_STIFFNESS times as stiff as its servo. For `ahead`
    see `servo.torque`.
    """
    angle, speed = BIPED.leg_angles(qpos), BIPED.leg_speeds(qvel)
    torque, damping = servo.torque(plant.servo, reference, angle, speed, integral, ahead)
    lower, upper = plant.robot.joint_range[..., 0], plant.robot.joint_range[..., 1]
    stiffness = STOP_STIFFNESS * plant.servo.kp
    up, up_damping = ground.one_sided_spring(angle - lower, speed, stiffness, STOP_DAMPING, dt)
    down, down_damping = ground.one_sided_spring(upper - angle, -speed, stiffness, STOP_DAMPING, dt)
    return torque, torque + up - down, damping + up_damping + down_damping

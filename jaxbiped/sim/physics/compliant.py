"""MJX's rigid-body dynamics on the compliant ground, with our contacts, servos and joint stops."""

import dataclasses

from jaxtyping import Array, Float

from jaxbiped.robot.layout import BIPED
from jaxbiped.sim import ground, mjx_adapter, plant
from jaxbiped.sim.ground import Contact
from jaxbiped.sim.mjx_adapter import BodyMotion
from jaxbiped.sim.physics.contract import Physics
from jaxbiped.sim.plant import Plant
from jaxbiped.sim.seen import Seen
from jaxbiped.sim.servo import Reference


def advance(
    world: Plant, dt: float, reference: Reference, physics: Physics, ahead: float = 0.0
) -> tuple[Physics, Seen]:
    """Semi-implicit Euler; what is stiff in ground, stops and servos acts with the velocity of the end of the tick.

    Args:
        world: the robot and its scenario.
        dt: tick [s].
        reference: of the servos.
        physics: before the tick.
        ahead: see `servo.torque` [s].
    """
    time = physics.tick * dt
    robot, scenario = world.robot, world.scenario
    body = plant.body_motion(world, physics.qpos, physics.qvel, time, dt)
    before = ground.contact(robot, scenario.ground, scenario.terrain, body, physics.pressed, dt)
    by_servo, torque, damping = plant.joint_torque(
        world, reference, physics.qpos, physics.qvel, physics.integral, dt, ahead
    )
    forces = plant.Forces(
        body=body,
        contact=before,
        torque=torque,
        damping=damping,
        push=plant.push_force(world, body, time, dt),
        qvel=physics.qvel,
        gravity=world.model.opt.gravity,
        armature=world.model.dof_armature,
        dt=dt,
    )
    change = dt * plant.acceleration(forces)
    touch = dataclasses.replace(before, force=ground.force_after(body, before, change))
    qvel = physics.qvel + change
    new = Physics(
        tick=physics.tick + 1,
        qpos=mjx_adapter.integrate(world.model, physics.qpos, qvel, dt),
        qvel=qvel,
        integral=physics.integral + dt * (reference.angle - BIPED.leg_angles(physics.qpos)),
        pressed=ground.normal_force(touch),
    )
    return new, seen(body, touch, by_servo)


def seen(body: BodyMotion, touch: Contact, torque: Float[Array, "2 6"]) -> Seen:
    """Collect the robot's and the ground's state that a tick saw."""
    return Seen(
        p_world_trunk=body.p_world_trunk,
        rot_world_trunk=body.rot_world_trunk,
        p_world_foot=body.p_world_foot,
        rot_world_foot=body.rot_world_foot,
        p_world_corner=touch.p_world_corner,
        gap=touch.gap,
        force=touch.force,
        torque=torque,
    )

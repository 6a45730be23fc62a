"""The physics of a tick on the compliant ground: MJX's rigid-body dynamics, our contacts, servos and stops."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.sim import ground, mjx_adapter, plant, sensors, statistics
from jaxbiped.sim.ground import Contact
from jaxbiped.sim.mjx_adapter import BodyMotion
from jaxbiped.sim.plant import Plant
from jaxbiped.sim.sensors import SwitchState
from jaxbiped.sim.servo import Reference
from jaxbiped.sim.statistics import Statistics


class Physics(eqx.Module):
    """What the physics carries from tick to tick."""

    tick: Int[Array, ""]
    """Physics ticks done."""
    qpos: Float[Array, "19"]
    qvel: Float[Array, "18"]
    integral: Float[Array, "2 6"]
    """Integral of the servos' position errors [rad s]."""
    switches: SwitchState
    pressed: Float[Array, "2 4"]
    """Normal force at every sole corner in the last tick, which friction goes by [N]."""
    filtered: Float[Array, "2 2 4"]
    """Vertical force at every sole corner after each stage of the low pass, see `ground.low_passed` [N]."""
    statistics: Statistics


def physics_tick(
    world: Plant, dt: float, reference: Reference, state: Physics
) -> tuple[Physics, tuple[BodyMotion, Contact, Float[Array, "2 6"]]]:
    """Semi-implicit Euler; what is stiff in ground, stops and servos acts with the velocity of the end of the tick."""
    time = state.tick * dt
    robot, scenario = world.robot, world.scenario
    body = plant.body_motion(world, state.qpos, state.qvel, time, dt)
    before = ground.contact(robot, scenario.ground, scenario.terrain, body, state.pressed, dt)
    by_servo, torque, damping = plant.joint_torque(
        world, reference, state.qpos, state.qvel, state.integral, dt
    )
    forces = plant.Forces(
        body=body,
        contact=before,
        torque=torque,
        damping=damping,
        push=plant.push_force(world, body, time, dt),
        qvel=state.qvel,
        gravity=world.model.opt.gravity,
        armature=world.model.dof_armature,
        dt=dt,
    )
    change = dt * plant.acceleration(forces)
    touch = dataclasses.replace(before, force=ground.force_after(body, before, change))
    qvel = state.qvel + change
    new = Physics(
        tick=state.tick + 1,
        qpos=mjx_adapter.integrate(world.model, state.qpos, qvel, dt),
        qvel=qvel,
        integral=state.integral + dt * (reference.angle - state.qpos[7:].reshape(2, 6)),
        switches=sensors.read_switches(state.switches, touch.gap, time, dt, scenario.sensors),
        pressed=ground.normal_force(touch),
        filtered=ground.low_passed(state.filtered, touch, dt),
        statistics=statistics.update(state.statistics, body, touch, time + dt, dt),
    )
    return frozen(state.statistics.status != statistics.OK, state, new), (body, touch, by_servo)


def frozen(stop: Bool[Array, ""], old: Any, new: Any) -> Any:
    """The old state where a walk has stopped, else the new one."""
    return jax.tree.map(lambda a, b: jnp.where(stop, a, b), old, new)

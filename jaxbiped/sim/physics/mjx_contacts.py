"""MuJoCo's own contacts in the roll-out, through MJX's constraint solver: `Options(contact="mjx")`.

Sole corners are small spheres, the ground is a plane and one box for every rectangle. Solver, contacts and integration
are MJX's; masses are those of the compliant ground. It is slower by an order of magnitude.
"""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from jaxbiped.planner import is_concrete
from jaxbiped.robot import LEFT, RobotParams
from jaxbiped.robot.layout import BIPED
from jaxbiped.sim import ground, mjx_adapter, plant
from jaxbiped.sim.model import build_spec
from jaxbiped.sim.physics.compliant import seen
from jaxbiped.sim.physics.contract import Physics
from jaxbiped.sim.plant import Plant
from jaxbiped.sim.scenario import Terrain
from jaxbiped.sim.seen import Seen
from jaxbiped.sim.servo import Reference

IMPEDANCE = 0.9
"""Contact impedance, the same at all depths, so that a contact is a linear spring and damper."""
ITERATIONS = 6
"""Newton iterations of the constraint solver, which starts cold at every tick."""
MOST_CONTACTS = 16
"""Contacts that are kept at a time, the deepest: every corner may touch a box and the floor."""
DEPTH = 0.5
"""Depth of the boxes below their tops [m]."""
_BOX_0 = 1
"""Number of the first box among the geoms, after the floor."""
_CORNER = 2
"""Contact type of the sole corners in `build_spec`."""
_AWAY = -100.0
"""Height at which unused boxes are parked [m]."""


def base_model(robot: RobotParams, rectangles: int, timestep: float) -> mjx_adapter.Model:
    """MJX model of the nominal robot with room for `rectangles` boxes; timestep [s]."""
    spec = build_spec(robot, timestep)
    for i in range(rectangles):
        spec.worldbody.add_geom(
            name=f"box_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.001] * 3,
            pos=[0.0, 0.0, _AWAY],
            contype=1,
            conaffinity=2,
        )
    spec.add_numeric(name="max_contact_points", data=[MOST_CONTACTS], size=1)
    return mjx_adapter.contact_model(spec, ITERATIONS)


def check_terrain(terrain: Terrain) -> None:
    """Refuse terrain that boxes on a plane cannot represent, where the numbers are known.

    Raises:
        ValueError: if there is a hole, or raised rectangles overlap, which here do not add up.
    """
    if not is_concrete(terrain):
        return
    lower, upper, height = (np.asarray(a) for a in (terrain.lower, terrain.upper, terrain.height))
    used = (lower < upper).all(axis=-1) & (height != 0.0)
    if (height[used] < 0.0).any():
        raise ValueError(f'contact="mjx": got a hole of {height[used].min():g} m, allowed: heights >= 0 m')
    inside = np.minimum(upper[..., :, None, :], upper[..., None, :, :]) - np.maximum(
        lower[..., :, None, :], lower[..., None, :, :]
    )
    both = used[..., :, None] & used[..., None, :] & ~np.eye(height.shape[-1], dtype=bool)
    if (both & (inside > 0.0).all(axis=-1)).any():
        raise ValueError('contact="mjx": got rectangles that overlap, allowed: rectangles apart')


def advance(world: Plant, dt: float, reference: Reference, physics: Physics) -> tuple[Physics, Seen]:
    """One tick by `mjx.step`; `world.model` is from `base_model`."""
    time = physics.tick * dt
    ctrl = _setpoint(world, reference, physics.integral)
    step = mjx_adapter.native_step(
        _model_now(world, time, dt),
        np.flatnonzero(world.model.geom_contype == _CORNER).reshape(2, 4),
        physics.qpos,
        physics.qvel,
        ctrl.reshape(-1),
        _push(world, time, dt),
    )
    touch = ground.contact(world.robot, world.scenario.ground, world.scenario.terrain, step.body)
    touch = dataclasses.replace(touch, force=step.corner_force)
    new = dataclasses.replace(
        physics,
        tick=physics.tick + 1,
        qpos=step.qpos,
        qvel=step.qvel,
        integral=physics.integral + dt * (reference.angle - BIPED.leg_angles(physics.qpos)),
    )
    return new, seen(step.body, touch, step.torque.reshape(2, 6))


def _setpoint(world: Plant, reference: Reference, integral: Float[Array, "2 6"]) -> Float[Array, "2 6"]:
    """Setpoint that makes a position actuator the robot's servo: kp (ctrl - q) - kv qd is its whole torque."""
    servo = world.servo
    speed = jnp.clip(reference.speed, -servo.speed_limit, servo.speed_limit)
    torque = servo.kv * speed + servo.ki * integral + reference.feed_forward
    return reference.angle + torque / servo.kp


def _push(world: Plant, time: Float[Array, ""], dt: float) -> Float[Array, "3"]:
    push = world.scenario.push
    overlap = jnp.minimum(time + dt, push.start + push.length) - jnp.maximum(time, push.start)
    return jnp.clip(overlap / dt, 0.0, 1.0) * push.force


def _model_now(world: Plant, time: Float[Array, ""], dt: float) -> mjx_adapter.Model:
    """The model with this tick's masses, and the scenario's gains, friction, stiffness and boxes."""
    masses = plant.masses(world, world.scenario.payload.share(time, dt))
    model = mjx_adapter.with_masses(world.model, *masses)
    terrain, servo = world.scenario.terrain, world.servo
    kp, kv = servo.kp.reshape(-1), servo.kv.reshape(-1)
    used = (terrain.lower < terrain.upper).all(axis=-1) & (terrain.height > 0.0)
    top = jnp.where(used, terrain.height, _AWAY)
    half = jnp.concatenate(
        [(terrain.upper - terrain.lower) / 2.0, jnp.full_like(top, DEPTH / 2.0)[:, None]], 1
    )
    middle = jnp.concatenate([(terrain.upper + terrain.lower) / 2.0, (top - DEPTH / 2.0)[:, None]], 1)
    boxes = slice(_BOX_0, _BOX_0 + top.shape[0])
    wanted = ground.stiffness(world.robot, world.scenario.ground)
    constant = jnp.sqrt(1.0 / ((1.0 - IMPEDANCE) * wanted * world.model.body_invweight0[BIPED.feet[LEFT], 0]))
    impedance = jnp.array([IMPEDANCE, IMPEDANCE, 1e-3, 0.5, 2.0], kp.dtype)
    return model.replace(
        actuator_gainprm=model.actuator_gainprm.at[:, 0].set(kp),
        actuator_biasprm=model.actuator_biasprm.at[:, 1].set(-kp).at[:, 2].set(-kv),
        geom_pos=model.geom_pos.at[boxes].set(middle),
        geom_size=model.geom_size.at[boxes].set(jnp.maximum(half, 0.001)),
        geom_friction=model.geom_friction.at[:, 0].set(world.scenario.ground.friction),
        geom_solref=jnp.broadcast_to(jnp.stack([constant, jnp.ones_like(constant)]), model.geom_solref.shape),
        geom_solimp=jnp.broadcast_to(impedance, model.geom_solimp.shape),
    )

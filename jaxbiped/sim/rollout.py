"""One walk: start from rest on the ground, tick by tick, to statistics and, if asked for, a trace.

A control tick is `control_every` physics ticks under one servo reference, then a reading of the sensors, one step of
the controller and inverse kinematics. Everything here is one robot in one scenario; batches are made outside by vmap.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped import checked, runtime
from jaxbiped.adapt import Controller, ControllerState, Sensed
from jaxbiped.checked import Quantity
from jaxbiped.kinematics import joint_angles
from jaxbiped.planner import Targets, TaskSpace, at, is_concrete
from jaxbiped.robot import RobotParams
from jaxbiped.sim import (
    equilibrium,
    feed_forward,
    ground,
    mjx_adapter,
    mjx_contacts,
    plant,
    sensors,
    statistics,
)
from jaxbiped.sim.feed_forward import FeedForward
from jaxbiped.sim.ground import Contact
from jaxbiped.sim.mjx_adapter import BodyMotion
from jaxbiped.sim.plant import PAYLOAD_MODELS, Plant
from jaxbiped.sim.scenario import Scenario, require_clear_start
from jaxbiped.sim.sensors import Delay, SwitchState
from jaxbiped.sim.servo import Reference
from jaxbiped.sim.stability import require_stable_dt
from jaxbiped.sim.statistics import Statistics

DURATION = Quantity("s", 0.0, 3600.0, above=True)
"""Of a walk."""
COMPLIANT, MJX = "compliant", "mjx"
CONTACTS = (COMPLIANT, MJX)
MAX_TICKS = 1_000_000


class Options(eqx.Module):
    """Choices made when a roll-out is built; another choice is another compilation."""

    dt: float = eqx.field(static=True, default=5e-4)
    """Physics tick [s]."""
    control_every: int = eqx.field(static=True, default=4)
    """Physics ticks in a control tick."""
    feed_forward: bool = eqx.field(static=True, default=True)
    """Add the plan's inverse dynamics to the servos' torque."""
    payload_model: str = eqx.field(static=True, default=plant.EXACT)
    """`exact` (welded cube) or `thesis` (elkahlout Eqs. 3.8-3.10)."""
    contact: str = eqx.field(static=True, default=COMPLIANT)
    """`compliant` (see `ground`) or `mjx` (MuJoCo's own contacts; slower, no holes)."""
    noise: bool = eqx.field(static=True, default=False)
    """Add the scenario's sensor noise."""
    delay_room: int = eqx.field(static=True, default=0)
    """Control ticks of sensor delay there is room for."""
    trace_every: int = eqx.field(static=True, default=0)
    """Control ticks between two samples of the trace; 0 for no trace."""

    def __check_init__(self) -> None:
        """Refuse what cannot be simulated."""
        object.__setattr__(self, "dt", Quantity("s", 1e-5, 0.01).check("dt", self.dt))
        for name, least in (("control_every", 1), ("delay_room", 0), ("trace_every", 0)):
            object.__setattr__(self, name, checked.whole(name, getattr(self, name), least, MAX_TICKS))
        for name in ("feed_forward", "noise"):
            object.__setattr__(self, name, checked.Flag().check(name, getattr(self, name)))
        if self.payload_model not in PAYLOAD_MODELS:
            raise ValueError(
                f"payload_model: got {self.payload_model!r}, allowed: {', '.join(PAYLOAD_MODELS)}"
            )
        if self.contact not in CONTACTS:
            raise ValueError(f"contact: got {self.contact!r}, allowed: {', '.join(CONTACTS)}")

    @property
    def control_dt(self) -> float:
        """Control tick [s]."""
        return self.dt * self.control_every


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


class State(eqx.Module):
    """What a roll-out carries from control tick to control tick."""

    physics: Physics
    controller: ControllerState
    reference: Reference
    delay: Delay | None
    zmp: Float[Array, "2"]
    """Centre of pressure, the last one while a foot was loaded [m]."""


class Sample(eqx.Module):
    """One row of a trace; with a leading axis, the trace."""

    time: Float[Array, "*n"]
    """[s]"""
    p_world_trunk: Float[Array, "*n 3"]
    """Pelvis frame origin [m]."""
    roll_pitch_yaw: Float[Array, "*n 3"]
    """Of the trunk [rad]."""
    p_world_sole: Float[Array, "*n 2 3"]
    """Origins of the sole frames [m]."""
    foot_force: Float[Array, "*n 2 3"]
    """Ground force on each foot, world axes [N]."""
    corner_force: Float[Array, "*n 2 4"]
    """Vertical force on each sole corner [N]."""
    zmp_world: Float[Array, "*n 2"]
    """Centre of pressure [m]."""
    switch: Bool[Array, "*n 2 4"]
    """Contact switches."""
    torque: Float[Array, "*n 2 6"]
    """Joint torques [N m]."""
    qpos: Float[Array, "*n 19"]
    """MuJoCo coordinates, for replay and drawing."""
    targets: Targets
    """What the controller asked for."""
    filtered_corner_force: Float[Array, "*n 2 4"] | None = None
    """Vertical force on each sole corner, low-passed by `ground.low_passed` [N]; None of walks in C MuJoCo."""


class Walk(eqx.Module):
    """Result of a roll-out."""

    statistics: Statistics
    trace: Sample | None
    controller: ControllerState | None = None
    """State of the controller at the end; None where the walk was led by given references."""
    integral: Float[Array, " m"] | None = None
    """Integral over time of what `simulate` was asked to integrate."""


Rate = Callable[[Sample, Bool[Array, ""]], Float[Array, " m"]]
"""What is to be integrated over a walk, of one sample and of whether the robot has not failed so far."""


def rollout(
    robot: RobotParams,
    controller: Controller,
    scenario: Scenario,
    duration: float,
    options: Options | None = None,
) -> Walk:
    """Walk one robot in one scenario for `duration` [s]; compiled once per shapes and options."""
    duration = DURATION.check("duration", duration)
    options = options or Options()
    require_clear_start(robot, controller.gait, scenario.terrain)
    if is_concrete(scenario):
        gains = float(jnp.max(scenario.errors.gain_scale))
        require_stable_dt(robot, options.dt, float(scenario.ground.sinkage), gains)
    model = base_model(robot, scenario, options)
    return _compiled(robot, model, controller, scenario, float(duration), options)


def base_model(robot: RobotParams, scenario: Scenario, options: Options) -> Any:
    """MJX model for `simulate`; of the scenario only the room for rectangles counts."""
    if options.contact == COMPLIANT:
        return mjx_adapter.base_model(robot)
    mjx_contacts.check_terrain(scenario.terrain)
    return mjx_contacts.base_model(robot, scenario.terrain.height.shape[-1], options.dt)


@runtime.jit
def _compiled(
    robot: RobotParams,
    model: Any,
    controller: Controller,
    scenario: Scenario,
    duration: float,
    options: Options,
) -> Walk:
    torque = make_feed_forward(robot, controller, duration, options)
    return simulate(robot, model, controller, scenario, torque, duration, options)


def make_feed_forward(
    robot: RobotParams, controller: Controller, duration: float, options: Options
) -> FeedForward:
    """The table of feed-forward torques of a walk; it depends on robot and gait, not on the scenario."""
    if not options.feed_forward:
        return feed_forward.none()
    return feed_forward.plan(robot, controller.gait, duration)


def simulate(
    robot: RobotParams,
    model: Any,
    controller: Controller,
    scenario: Scenario,
    torque: FeedForward,
    duration: float,
    options: Options,
    rate: Rate | None = None,
) -> Walk:
    """The roll-out itself, pure: to be mapped over scenarios and differentiated.

    Time goes on for a walk that has failed, with the sample of the failure.
    """
    world = plant.make_plant(robot, model, scenario, options.payload_model)
    state = _start(world, controller, torque, options)
    ticks = round(duration / options.control_dt)
    # Times are looked up, not multiplied in every expression that needs one: XLA rounds those differently (fused
    # multiply-add), and what is decided by a time would be decided differently for different fields of one record.
    clock = jnp.arange(ticks + 1) * options.control_dt
    step = functools.partial(_control_tick, world, controller, torque, options, clock)

    def advance(carry: tuple[State, Any], _: None) -> tuple[tuple[State, Any], Sample]:
        state, total = carry
        state, sample = step(state)
        if rate is not None:
            upright = state.physics.statistics.status == statistics.OK
            total = total + options.control_dt * rate(sample, upright)
        return (state, total), sample

    def quietly(carry: tuple[State, Any], _: None) -> tuple[tuple[State, Any], None]:
        return advance(carry, None)[0], None

    def record(carry: tuple[State, Any], _: None) -> tuple[tuple[State, Any], Sample]:
        carry, _ = jax.lax.scan(quietly, carry, None, length=options.trace_every - 1)
        return advance(carry, None)

    carry, trace = (state, None if rate is None else _zero_of(rate, step, state)), None
    if options.trace_every == 0:
        carry, _ = jax.lax.scan(quietly, carry, None, length=ticks)
    else:
        carry, trace = jax.lax.scan(record, carry, None, length=ticks // options.trace_every)
    state, total = carry
    return Walk(state.physics.statistics, trace, state.controller, total)


def _zero_of(rate: Rate, step: Any, state: State) -> Float[Array, " m"]:
    """An integral before the start."""
    shape = jax.eval_shape(lambda s: rate(step(s)[1], jnp.ones((), bool)), state)
    return jnp.zeros(shape.shape, shape.dtype)


def _start(world: Plant, controller: Controller, torque: FeedForward, options: Options) -> State:
    """Standing still at t = 0, servos settled, feet loaded."""
    targets = at(controller.gait, 0.0)
    reference = servo_reference(world.robot, targets, torque)[0]
    qpos = equilibrium.standing(world, targets.position, reference)
    qvel = jnp.zeros(mjx_adapter.NV, qpos.dtype)
    body = plant.motion_at_rest(world, qpos)
    touch = ground.contact(world.robot, world.scenario.ground, world.scenario.terrain, body)
    physics = Physics(
        tick=jnp.zeros((), jnp.int32),
        qpos=qpos,
        qvel=qvel,
        integral=jnp.zeros((2, 6), qpos.dtype),
        switches=sensors.init_switches(touch.gap, world.scenario.sensors),
        pressed=ground.normal_force(touch),
        filtered=jnp.stack([touch.force[..., 2]] * 2),
        statistics=statistics.init(body),
    )
    zmp = sensors.centre_of_pressure(touch, body.p_world_trunk[:2])
    _, delay = _sense(world, options, physics, body, touch, zmp, jnp.zeros((), qpos.dtype), None)
    return State(physics, controller.init(), reference, delay, zmp)


def _control_tick(
    world: Plant,
    controller: Controller,
    torque: FeedForward,
    options: Options,
    clock: Float[Array, " n"],
    state: State,
) -> tuple[State, Sample]:
    """Move the physics, read the sensors, step the controller, turn its targets into a servo reference."""
    physics, (body, touch, applied) = _physics_ticks(world, options, state)
    time = clock[-(-physics.tick // options.control_every)]  # a lane that failed stays at the end of its tick
    zmp = sensors.centre_of_pressure(touch, state.zmp)
    sensed, delay = _sense(world, options, physics, body, touch, zmp, time, state.delay)
    controller_state, targets = controller.step(state.controller, sensed)
    reference, status = servo_reference(world.robot, targets, torque)
    stats = statistics.update_margins(
        physics.statistics,
        world.robot,
        touch,
        zmp,
        targets.position,
        jnp.any(status != 0),
        options.control_dt,
    )
    physics = eqx.tree_at(lambda p: p.statistics, physics, stats)
    new = State(physics, controller_state, reference, delay, zmp)
    new = _frozen(state.physics.statistics.status != statistics.OK, state, new)
    return new, _sample(world, new, body, touch, applied, targets, time)


def _sense(
    world: Plant,
    options: Options,
    physics: Physics,
    body: BodyMotion,
    touch: Contact,
    zmp: Float[Array, "2"],
    time: Float[Array, ""],
    delay: Delay | None,
) -> tuple[Sensed, Delay | None]:
    """What reaches the controller: the readings, with their noise and their delay if the options ask for them."""
    faults = world.scenario.sensors
    sensed = sensors.sense(body, touch, physics.qpos, physics.qvel, physics.switches, zmp, time, faults)
    if options.noise:
        every, dt = options.control_every, options.control_dt
        sensed = sensors.add_noise(world.robot, sensed, touch.p_world_corner, faults, physics.tick, every, dt)
    if options.delay_room == 0:
        return sensed, None
    delay = Delay.filled(sensed, options.delay_room) if delay is None else delay
    delay, sensed = delay.push(sensed, faults.delay, options.control_dt)
    return sensed, delay


def _physics_ticks(
    world: Plant, options: Options, state: State
) -> tuple[Physics, tuple[BodyMotion, Contact, Float[Array, "2 6"]]]:
    """`control_every` physics ticks; also what the last one saw at its start."""
    physics_tick = mjx_contacts.physics_tick if options.contact == MJX else _physics_tick

    def tick(carry: tuple[Physics, Reference], _: None):
        physics, reference = carry
        physics, seen = physics_tick(world, options.dt, reference, physics)
        return (physics, reference.later(options.dt)), seen

    if options.control_every == 1:
        return physics_tick(world, options.dt, state.reference, state.physics)
    carry = (state.physics, state.reference)
    (physics, _), seen = jax.lax.scan(tick, carry, None, length=options.control_every)
    return physics, jax.tree.map(lambda leaf: leaf[-1], seen)


def _physics_tick(
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
    return _frozen(state.statistics.status != statistics.OK, state, new), (body, touch, by_servo)


def _frozen(stop: Bool[Array, ""], old: Any, new: Any) -> Any:
    """A lane that has failed stays as it was; the others live."""
    return jax.tree.map(lambda a, b: jnp.where(stop, a, b), old, new)


def servo_reference(
    robot: RobotParams, targets: Targets, torque: FeedForward
) -> tuple[Reference, Int[Array, "2"]]:
    """Inverse kinematics of the targets and their velocities, and the status of each leg."""

    def angles(task: TaskSpace) -> tuple[Float[Array, "2 6"], Int[Array, "2"]]:
        return joint_angles(robot, task.sole - task.pelvis)

    angle, speed, status = jax.jvp(angles, (targets.position,), (targets.velocity,), has_aux=True)
    return Reference(angle, speed, torque.at(targets.time)), status


def _sample(
    world: Plant,
    state: State,
    body: BodyMotion,
    touch: Contact,
    torque: Float[Array, "2 6"],
    targets: Targets,
    time: Float[Array, ""],
) -> Sample:
    below = world.robot.ankle_height * body.rot_world_foot[:, :, 2]
    return Sample(
        time=time,
        p_world_trunk=body.p_world_trunk,
        roll_pitch_yaw=sensors.roll_pitch_yaw(body.rot_world_trunk),
        p_world_sole=body.p_world_foot - below,
        foot_force=touch.force.sum(axis=1),
        corner_force=touch.force[..., 2],
        zmp_world=state.zmp,
        switch=state.physics.switches.closed,
        torque=torque,
        qpos=state.physics.qpos,
        targets=targets,
        filtered_corner_force=state.physics.filtered[1],
    )

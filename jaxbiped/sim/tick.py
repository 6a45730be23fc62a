"""The tick of a walk, pure: one robot in one scenario, to be mapped, differentiated and compiled."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.adapt import Controller, ControllerState, Sensed
from jaxbiped.kinematics import joint_angles
from jaxbiped.planner import Targets, TaskSpace, at
from jaxbiped.robot import RobotParams
from jaxbiped.sim import (
    compliant,
    equilibrium,
    feed_forward,
    ground,
    mjx_adapter,
    mjx_contacts,
    plant,
    sensors,
    statistics,
)
from jaxbiped.sim.compliant import Physics, frozen
from jaxbiped.sim.feed_forward import FeedForward
from jaxbiped.sim.ground import Contact
from jaxbiped.sim.mjx_adapter import BodyMotion
from jaxbiped.sim.options import MJX, Options
from jaxbiped.sim.plant import Plant, World
from jaxbiped.sim.scenario import Scenario
from jaxbiped.sim.sensors import Delay
from jaxbiped.sim.servo import Reference
from jaxbiped.sim.statistics import Statistics


class State(eqx.Module):
    """What a walk carries from control tick to control tick."""

    world: World
    """What is walked in; the same in every tick."""
    physics: Physics
    controller: ControllerState
    reference: Reference
    """Of the servos until the next tick."""
    delay: Delay | None
    """Readings on their way; None without sensor delay."""
    zmp: Float[Array, "2"]
    """Centre of pressure; stays while nothing is loaded [m]."""
    time: Float[Array, ""]
    """Of the last control tick [s]."""
    next_time: Float[Array, ""]
    """Of the next one [s]. Kept from tick to tick, since a product of tick and dt is rounded differently in different
    expressions (fused multiply-add), and what is decided by a time would be decided differently in one tick."""
    left: Int[Array, ""]
    """Control ticks that are left of the walk; with none left it stays as it is."""

    @property
    def stopped(self) -> Bool[Array, ""]:
        """Whether it goes no further: the robot has failed, or the time is over."""
        return (self.physics.statistics.status != statistics.OK) | (self.left <= 0)


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
    """Integral over time of what `Simulation.walk` was asked to integrate."""


ENDLESS = 2**31 - 1
"""Control ticks of a walk that is ended from outside."""
Rate = Callable[[Sample, Bool[Array, ""]], Float[Array, " m"]]
"""What is to be integrated over a walk, of one sample and of whether the robot has not failed so far."""


_Self = TypeVar("_Self", bound="PureSimulation")


class PureSimulation(eqx.Module):
    """A robot, its controller and options, ready to walk in any scenario."""

    robot: RobotParams
    """Nominal."""
    controller: Controller
    """Gait and adaptation."""
    model: Any
    """MJX model of the robot."""
    torque: FeedForward
    """Feed-forward torques of the plan."""
    options: Options = eqx.field(static=True)
    """All else that decides what is compiled."""

    def led_by(self: _Self, controller: Controller) -> _Self:
        """The same robot and options with another controller; pure, whose gait may last 1.3 times as long."""
        table = self.torque
        if self.options.feed_forward:
            table = feed_forward.plan(self.robot, controller.gait, table.torque.shape[0], table.interval)
        return dataclasses.replace(self, controller=controller, torque=table)

    def start(self, scenario: Scenario, ticks: int | Int[Array, ""] = ENDLESS) -> State:
        """Standing still at t = 0, servos settled, feet loaded, so many control ticks before it; pure."""
        world = plant.make_plant(self.robot, self.model, scenario, self.options.payload_model)
        targets = at(self.controller.gait, 0.0)
        reference = servo_reference(self.robot, targets, self.torque)[0]
        qpos = equilibrium.standing(world, targets.position, reference)
        body = plant.motion_at_rest(world, qpos)
        touch = ground.contact(self.robot, scenario.ground, scenario.terrain, body)
        zero = jnp.zeros((), qpos.dtype)
        physics = Physics(
            tick=jnp.zeros((), jnp.int32),
            qpos=qpos,
            qvel=jnp.zeros(mjx_adapter.NV, qpos.dtype),
            integral=jnp.zeros((2, 6), qpos.dtype),
            switches=sensors.init_switches(touch.gap, scenario.sensors),
            pressed=ground.normal_force(touch),
            filtered=jnp.stack([touch.force[..., 2]] * 2),
            statistics=statistics.init(body),
        )
        zmp = sensors.centre_of_pressure(touch, body.p_world_trunk[:2])
        _, delay = _sense(world, self.options, physics, body, touch, zmp, zero, None)
        first = zero + self.options.control_dt
        left = jnp.asarray(ticks, jnp.int32)
        state = State(world.world, physics, self.controller.init(), reference, delay, zmp, zero, first, left)
        # Types that depend on nothing: else the first segment would be compiled for others than the second.
        return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), state)

    def tick(self, state: State) -> tuple[State, Sample]:
        """One control tick: move, sense, adapt, track, record; pure. A walk that has stopped stays as it is."""
        options, world = self.options, Plant(self.robot, self.model, state.world)
        physics, (body, touch, applied) = _physics_ticks(world, options, state)
        zmp, time = sensors.centre_of_pressure(touch, state.zmp), state.next_time
        sensed, delay = _sense(world, options, physics, body, touch, zmp, time, state.delay)
        controller, targets = self.controller.step(state.controller, sensed)
        reference, status = servo_reference(self.robot, targets, self.torque)
        stats = statistics.update_margins(
            physics.statistics,
            self.robot,
            touch,
            zmp,
            targets.position,
            jnp.any(status != 0),
            options.control_dt,
        )
        physics = eqx.tree_at(lambda p: p.statistics, physics, stats)
        following = (physics.tick // options.control_every + 1) * options.control_dt
        new = State(state.world, physics, controller, reference, delay, zmp, time, following, state.left - 1)
        new = frozen(state.stopped, state, new)
        return new, _sample(world, new, body, touch, applied, targets)

    def walk(self, scenario: Scenario, ticks: int | Int[Array, ""], rate: Rate | None = None) -> Walk:
        """A whole walk, pure: to be mapped over scenarios and differentiated (forward).

        Args:
            scenario: what is walked in.
            ticks: control ticks. With a trace a number, else it may be traced: one program for every duration.
            rate: what is to be integrated.
        """
        options, first = self.options, self.start(scenario)

        def advance(carry: tuple[State, Any]) -> tuple[tuple[State, Any], Sample]:
            state, total = carry
            state, sample = self.tick(state)
            if rate is not None:
                upright = state.physics.statistics.status == statistics.OK
                total = total + options.control_dt * rate(sample, upright)
            return (state, total), sample

        def quietly(_: Any, carry: tuple[State, Any]) -> tuple[State, Any]:
            return advance(carry)[0]

        def record(carry: tuple[State, Any], _: None) -> tuple[tuple[State, Any], Sample]:
            return advance(jax.lax.fori_loop(0, options.trace_every - 1, quietly, carry))

        carry, trace = (first, None if rate is None else _zero_of(rate, self, first)), None
        if options.trace_every == 0:
            carry = jax.lax.fori_loop(0, ticks, quietly, carry)
        else:
            assert isinstance(ticks, int)
            carry, trace = jax.lax.scan(record, carry, None, length=ticks // options.trace_every)
        state, total = carry
        return Walk(state.physics.statistics, trace, state.controller, total)

    def ticks(self, duration: float) -> int:
        """Control ticks of so long a walk [s]."""
        return round(duration / self.options.control_dt)


def _zero_of(rate: Rate, simulation: PureSimulation, state: State) -> Float[Array, " m"]:
    """An integral before the start."""
    shape = jax.eval_shape(lambda s: rate(simulation.tick(s)[1], jnp.ones((), bool)), state)
    return jnp.zeros(shape.shape, shape.dtype)


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
    physics_tick = mjx_contacts.physics_tick if options.contact == MJX else compliant.physics_tick

    def tick(carry: tuple[Physics, Reference], _: None):
        physics, reference = carry
        physics, seen = physics_tick(world, options.dt, reference, physics)
        return (physics, reference.later(options.dt)), seen

    if options.control_every == 1:
        return physics_tick(world, options.dt, state.reference, state.physics)
    carry = (state.physics, state.reference)
    (physics, _), seen = jax.lax.scan(tick, carry, None, length=options.control_every)
    return physics, jax.tree.map(lambda leaf: leaf[-1], seen)


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
) -> Sample:
    below = world.robot.ankle_height * body.rot_world_foot[:, :, 2]
    return Sample(
        time=state.time,
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

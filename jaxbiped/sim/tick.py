"""The tick of a walk, pure: one robot in one scenario, to be mapped, differentiated and compiled."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxbiped.adapt import Controller, ControllerState, Sensed
from jaxbiped.kinematics import joint_angles
from jaxbiped.planner import Targets, TaskSpace, at
from jaxbiped.robot import RobotParams
from jaxbiped.robot.layout import BIPED
from jaxbiped.sim import equilibrium, feed_forward, ground, mjx_adapter, plant, sensors, statistics
from jaxbiped.sim.feed_forward import FeedForward
from jaxbiped.sim.options import COMPLIANT, LINEAR, MJX, Options
from jaxbiped.sim.physics import compliant, mjx_contacts
from jaxbiped.sim.physics.contract import Advance, Physics
from jaxbiped.sim.plant import Plant, World
from jaxbiped.sim.record import Record, frozen
from jaxbiped.sim.scenario import Scenario
from jaxbiped.sim.seen import Seen
from jaxbiped.sim.sensors import Delay
from jaxbiped.sim.servo import Reference
from jaxbiped.sim.statistics import Statistics


class State(eqx.Module):
    """State of a walk between two control ticks."""

    world: World
    """The world that is walked in; the same in every tick."""
    physics: Physics
    record: Record
    controller: ControllerState
    reference: Reference
    """Reference of the servos until the next tick."""
    delay: Delay | None
    """Readings on their way; None without sensor delay."""
    zmp: Float[Array, "2"]
    """Center of pressure; stays while nothing is loaded [m]."""
    time: Float[Array, ""]
    """Time of the last control tick [s]."""
    next_time: Float[Array, ""]
    """Time of the next control tick [s]. It is kept from tick to tick, since a product of tick and dt is rounded
    differently in different expressions (fused multiply-add), and decisions by it would differ within one tick."""
    left: Int[Array, ""]
    """Control ticks that are left of the walk; with none left it stays as it is."""

    @property
    def stopped(self) -> Bool[Array, ""]:
        """Tell whether the walk goes no further: the robot has failed, or the time is over."""
        return self.record.failed | (self.left <= 0)


class Sample(eqx.Module):
    """One row of a trace; with a leading axis, the trace."""

    time: Float[Array, "*n"]
    """Time of the sample [s]."""
    p_world_trunk: Float[Array, "*n 3"]
    """Pelvis frame origin [m]."""
    roll_pitch_yaw: Float[Array, "*n 3"]
    """Roll, pitch and yaw of the trunk [rad]."""
    p_world_sole: Float[Array, "*n 2 3"]
    """Origins of the sole frames [m]."""
    foot_force: Float[Array, "*n 2 3"]
    """Ground force on each foot, world axes [N]."""
    corner_force: Float[Array, "*n 2 4"]
    """Vertical force on each sole corner [N]."""
    zmp_world: Float[Array, "*n 2"]
    """Center of pressure [m]."""
    switch: Bool[Array, "*n 2 4"]
    """Contact switches."""
    torque: Float[Array, "*n 2 6"]
    """Joint torques [N m]."""
    qpos: Float[Array, "*n nq"]
    """MuJoCo coordinates, for replay and drawing."""
    targets: Targets
    """Targets that the controller asked for."""
    filtered_corner_force: Float[Array, "*n 2 4"]
    """Vertical force on each sole corner, low-passed by `record.low_passed` [N]."""

    @classmethod
    def blank(cls, targets: Targets) -> "Sample":
        """A row of zeros but for its targets."""

        def zeros(*shape: int) -> Array:
            return jnp.zeros(shape, targets.position.pelvis.dtype)

        feet, corners = zeros(2, 3), zeros(2, 4)
        return cls(
            time=zeros(),
            p_world_trunk=zeros(3),
            roll_pitch_yaw=zeros(3),
            p_world_sole=feet,
            foot_force=feet,
            corner_force=corners,
            zmp_world=zeros(2),
            switch=jnp.zeros((2, 4), bool),
            torque=zeros(2, 6),
            qpos=zeros(BIPED.nq),
            targets=targets,
            filtered_corner_force=corners,
        )


class Walk(eqx.Module):
    """Result of a roll-out."""

    statistics: Statistics
    trace: Sample | None
    controller: ControllerState | None = None
    """State of the controller at the end; None where the walk was led by given references."""
    integral: Float[Array, " m"] | None = None
    """Integral over time of the rate given to `PureSimulation.walk`."""


ENDLESS = 2**31 - 1
"""Control ticks of a walk that is ended from outside."""
Rate = Callable[[Sample, Bool[Array, ""]], Float[Array, " m"]]
"""Function of a sample, and of whether the robot has not failed so far: the rate that is integrated over a walk."""


ENGINES: dict[str, Advance] = {COMPLIANT: compliant.advance, MJX: mjx_contacts.advance}
"""Engine of a pure tick, by `Options.contact`; C MuJoCo moves whole walks, see `lockstep`."""
C = TypeVar("C")
_Self = TypeVar("_Self", bound="PureSimulation")


class PureSimulation(eqx.Module):
    """A robot, its controller and options, ready to walk in any scenario."""

    robot: RobotParams
    """The nominal robot."""
    controller: Controller
    """Gait and adaptation."""
    model: mjx_adapter.Model
    """MJX model of the robot."""
    torque: FeedForward
    """Feed-forward torques of the plan."""
    options: Options = eqx.field(static=True)
    """All other choices that decide what is compiled."""

    def led_by(self: _Self, controller: Controller) -> _Self:
        """Return the simulation with another controller, whose gait may last 1.3 times as long; pure."""
        table = self.torque
        if self.options.feed_forward:
            table = feed_forward.plan(self.robot, controller.gait, table.torque.shape[0], table.interval)
        return dataclasses.replace(self, controller=controller, torque=table)

    def start(self, scenario: Scenario, ticks: int | Int[Array, ""] = ENDLESS) -> State:
        """State at t = 0: standing still, servos settled, feet loaded, with a number of control ticks ahead; pure."""
        world = plant.make_plant(self.robot, self.model, scenario, self.options.payload_model)
        targets = at(self.controller.gait, 0.0)
        reference = servo_reference(self.robot, targets, self.torque)[0]
        qpos, body = equilibrium.standing(world, targets.position, reference)
        touch = ground.contact(self.robot, scenario.ground, scenario.terrain, body)
        zero = jnp.zeros((), qpos.dtype)
        physics = Physics(
            tick=jnp.zeros((), jnp.int32),
            qpos=qpos,
            qvel=jnp.zeros(BIPED.nv, qpos.dtype),
            integral=jnp.zeros((2, 6), qpos.dtype),
            pressed=ground.normal_force(touch),
        )
        seen = compliant.seen(body, touch, physics.integral)
        record = Record.begun(seen, scenario.sensors)
        zmp = sensors.centre_of_pressure(seen, body.p_world_trunk[:2])
        _, delay = _sense(world, self.options, physics, record, seen, zmp, zero, None)
        first = zero + self.options.control_dt
        left = jnp.asarray(ticks, jnp.int32)
        state = State(
            world.world, physics, record, self.controller.init(), reference, delay, zmp, zero, first, left
        )
        # Types that depend on nothing: else the first segment would be compiled for others than the second.
        return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), state)

    def tick(self, state: State) -> tuple[State, Sample]:
        """One control tick: move, sense, adapt, track, record; pure. A walk that has stopped stays as it is."""
        return self.conclude(
            state, *_physics_ticks(Plant(self.robot, self.model, state.world), self.options, state)
        )

    def conclude(self, state: State, physics: Physics, record: Record, seen: Seen) -> tuple[State, Sample]:
        """Finish a control tick once the robot has moved; the same for every engine; pure.

        Args:
            state: before the tick.
            physics: after the last physics tick.
            record: after the last physics tick.
            seen: by the last physics tick.
        """
        options, world = self.options, Plant(self.robot, self.model, state.world)
        zmp, time = sensors.centre_of_pressure(seen, state.zmp), state.next_time
        sensed, delay = _sense(world, options, physics, record, seen, zmp, time, state.delay)
        controller, targets = self.controller.step(state.controller, sensed)
        reference, status = servo_reference(self.robot, targets, self.torque)
        stats = statistics.update_margins(
            record.statistics,
            self.robot,
            seen,
            zmp,
            targets.position,
            jnp.any(status != 0),
            options.control_dt,
        )
        record = eqx.tree_at(lambda r: r.statistics, record, stats)
        following = (physics.tick // options.control_every + 1) * options.control_dt
        new = State(
            state.world, physics, record, controller, reference, delay, zmp, time, following, state.left - 1
        )
        new = frozen(state.stopped, state, new)
        return new, _sample(world, new, seen, targets)

    def walk(
        self,
        scenario: Scenario,
        ticks: int | Int[Array, ""],
        rate: Rate | None = None,
        rows: int | None = None,
    ) -> Walk:
        """A whole walk, pure: to be mapped over scenarios and differentiated (forward).

        Args:
            scenario: what is walked in.
            ticks: control ticks. May be traced, one program for every duration, unless the options ask for a trace.
            rate: what is to be integrated.
            rows: of the trace, at equal distances; None for one every `trace_every` ticks, as the options have it.
        """
        options, first = self.options, self.start(scenario)
        if rows is None:
            rows = 0
            if options.trace_every:
                assert isinstance(ticks, int)
                rows, ticks = ticks // options.trace_every, ticks - ticks % options.trace_every

        def advance(carry: tuple[State, PyTree]) -> tuple[tuple[State, PyTree], Sample]:
            state, total = carry
            if rate is not None:
                state, total, sample = self.integrated(state, total, rate)
            else:
                state, sample = self.tick(state)
            return (state, total), sample

        start = (first, None if rate is None else self.integral_of(rate))
        (state, total), trace = sampled(advance, start, ticks, rows)
        return Walk(state.record.statistics, trace, state.controller, total)

    def integrated(
        self, state: State, integral: Float[Array, " m"], rate: Rate
    ) -> tuple[State, Float[Array, " m"], Sample]:
        """One control tick, and the integral of a rate over it; pure."""
        state, sample = self.tick(state)
        return state, integral + self.options.control_dt * rate(sample, ~state.record.failed), sample

    def integral_of(self, rate: Rate) -> Float[Array, " m"]:
        """Integral of a rate before the start: zeros."""
        shape = jax.eval_shape(lambda: rate(Sample.blank(at(self.controller.gait, 0.0)), jnp.ones((), bool)))
        return jnp.zeros(shape.shape, shape.dtype)

    def ticks(self, duration: float) -> int:
        """Number of control ticks of a walk of this duration [s]."""
        return round(duration / self.options.control_dt)


def sampled(
    advance: Callable[[C], tuple[C, Sample]], start: C, ticks: int | Int[Array, ""], rows: int
) -> tuple[C, Sample | None]:
    """Advance so many ticks; what comes of it, and so many samples at equal distances (None for none).

    One loop, whose body holds the tick once: samples between the rows go to a spare row that nobody reads.
    """
    if rows == 0:
        return jax.lax.fori_loop(0, ticks, lambda _, carry: advance(carry)[0], start), None
    interval = jnp.maximum(ticks // rows, 1)

    def tick(i: Int[Array, ""], carry: tuple[C, Sample]) -> tuple[C, Sample]:
        state, sample = advance(carry[0])
        row = jnp.where((i + 1) % interval == 0, jnp.minimum((i + 1) // interval - 1, rows), rows)
        kept = jax.tree.map(
            lambda all_rows, one: jax.lax.dynamic_update_index_in_dim(all_rows, one, row, 0), carry[1], sample
        )
        return state, kept

    shapes = jax.eval_shape(lambda carry: advance(carry)[1], start)
    empty = jax.tree.map(lambda leaf: jnp.zeros((rows + 1, *leaf.shape), leaf.dtype), shapes)
    end, kept = jax.lax.fori_loop(0, ticks, tick, (start, empty))
    return end, jax.tree.map(lambda leaf: leaf[:rows], kept)


def _sense(
    world: Plant,
    options: Options,
    physics: Physics,
    record: Record,
    seen: Seen,
    zmp: Float[Array, "2"],
    time: Float[Array, ""],
    delay: Delay | None,
) -> tuple[Sensed, Delay | None]:
    """Return the readings that reach the controller, with noise and delay if the options ask for them."""
    faults = world.scenario.sensors
    sensed = sensors.sense(seen, physics.qpos, physics.qvel, record.switches, zmp, time, faults)
    if options.noise:
        every, dt = options.control_every, options.control_dt
        sensed = sensors.add_noise(world.robot, sensed, seen.p_world_corner, faults, physics.tick, every, dt)
    if options.delay_room == 0:
        return sensed, None
    delay = Delay.filled(sensed, options.delay_room) if delay is None else delay
    delay, sensed = delay.push(sensed, faults.delay, options.control_dt)
    return sensed, delay


def _physics_ticks(world: Plant, options: Options, state: State) -> tuple[Physics, Record, Seen]:
    """`control_every` physics ticks; also what the last one saw."""
    if options.contact not in ENGINES:
        allowed = ", ".join(ENGINES)
        raise ValueError(f"contact: got {options.contact!r}, which has no pure tick; allowed: {allowed}")
    advance = ENGINES[options.contact]
    if options.implicit == LINEAR:
        advance = partial(compliant.advance, ahead=options.dt)

    def tick(carry: tuple[Physics, Record, Reference], _: None):
        physics, record, reference = carry
        new, seen = advance(world, options.dt, reference, physics)
        physics, record = observed(physics, record, new, seen, options.dt, world.scenario)
        return (physics, record, reference.later(options.dt)), seen

    carry = (state.physics, state.record, state.reference)
    if options.control_every == 1:
        (physics, record, _), seen = tick(carry, None)
        return physics, record, seen
    (physics, record, _), seen = jax.lax.scan(tick, carry, None, length=options.control_every)
    return physics, record, jax.tree.map(lambda leaf: leaf[-1], seen)


def observed(
    physics: Physics, record: Record, moved: Physics, seen: Seen, dt: float, scenario: Scenario
) -> tuple[Physics, Record]:
    """Physics and record after one physics tick that an engine has `moved`; a robot that has failed stays as it is."""
    noted = record.later(seen, physics.tick * dt, dt, scenario.sensors)
    return frozen(record.failed, (physics, record), (moved, noted))


def servo_reference(
    robot: RobotParams, targets: Targets, torque: FeedForward
) -> tuple[Reference, Int[Array, "2"]]:
    """Inverse kinematics of the targets and their velocities, and the status of each leg."""

    def angles(task: TaskSpace) -> tuple[Float[Array, "2 6"], Int[Array, "2"]]:
        return joint_angles(robot, task.sole - task.pelvis)

    angle, speed, status = jax.jvp(angles, (targets.position,), (targets.velocity,), has_aux=True)
    return Reference(angle, speed, torque.at(targets.time)), status


def _sample(world: Plant, state: State, seen: Seen, targets: Targets) -> Sample:
    below = world.robot.ankle_height * seen.rot_world_foot[:, :, 2]
    return Sample(
        time=state.time,
        p_world_trunk=seen.p_world_trunk,
        roll_pitch_yaw=sensors.roll_pitch_yaw(seen.rot_world_trunk),
        p_world_sole=seen.p_world_foot - below,
        foot_force=seen.force.sum(axis=1),
        corner_force=seen.force[..., 2],
        zmp_world=state.zmp,
        switch=state.record.switches.closed,
        torque=seen.torque,
        qpos=state.physics.qpos,
        targets=targets,
        filtered_corner_force=state.record.filtered[1],
    )

"""The same walks in C MuJoCo, tick by tick on the host: a cross-check of `Simulation` that shares no physics with it.

Contacts are MuJoCo's own (`c_world`), between the soles and level boxes; dynamics, servos, statistics and sensors are
done again in C and NumPy. Controller, inverse kinematics, feed-forward and start are those of `Simulation`.
MuJoCo's servos have no speed limit, and its contacts are linear springs and dampers (`solref`) without a slip speed.

Many walks go on in lockstep: MuJoCo moves one robot after the other, everything else is done for all of them at once.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbiped import runtime
from jaxbiped.adapt import Controller, Sensed
from jaxbiped.planner import Targets, at, support
from jaxbiped.robot import RobotParams
from jaxbiped.robot.layout import BIPED
from jaxbiped.sim import c_world, sensors
from jaxbiped.sim.c_world import SPHERES, heights
from jaxbiped.sim.feed_forward import FeedForward
from jaxbiped.sim.mjx_adapter import TRUNK
from jaxbiped.sim.options import COMPLIANT, Options
from jaxbiped.sim.scenario import Scenario, SensorFaults
from jaxbiped.sim.sensors import BOUNCE_PERIOD, Delay
from jaxbiped.sim.simulation import Simulation, prepare
from jaxbiped.sim.statistics import (
    AIRBORNE,
    AIRBORNE_TIME,
    FALL_HEIGHT,
    FALL_TILT,
    FELL,
    LOADED,
    NONFINITE,
    OK,
    TOUCHDOWN,
    TOUCHING,
    Statistics,
    reach_margin,
)
from jaxbiped.sim.tick import Sample, Walk, servo_reference

TOGETHER = 256
"""Control ticks whose support polygons are looked at together."""
_FEET = BIPED.feet.tolist()
_SOLE_SITES, _CORNER_SITES = [0, 5], [1, 2, 3, 4, 6, 7, 8, 9]
"""Numbers of the sites, foot by foot the sole's and its corners'."""
Told = Callable[[float, int], None]
"""What is told of the progress: the time reached [s], and how many robots still walk."""


class References(eqx.Module):
    """What the servos are told at a control tick; with a leading axis, from the start on at every one, or of lanes."""

    angle: Float[Array, "*n 2 6"]
    """[rad]"""
    speed: Float[Array, "*n 2 6"]
    """[rad/s]"""
    feed_forward: Float[Array, "*n 2 6"]
    """[N m]"""
    status: Int[Array, "*n 2"]
    """Status of the inverse kinematics, each leg."""
    reach: Float[Array, "*n"]
    """By how much the more stretched leg stays below the longest one [m]."""
    targets: Targets
    """What the controller asked for."""


def replay_c(
    robot: RobotParams,
    controller: Controller,
    scenario: Scenario,
    duration: float,
    options: Options | None = None,
    references: References | None = None,
    contact: str = SPHERES,
) -> Walk:
    """Walk one robot in one scenario for `duration` [s] in C MuJoCo; runs on the host, cannot be traced.

    Args:
        robot: one robot, without a batch axis.
        controller: stepped at every control tick, unless `references` are given.
        scenario: one scenario, without a batch axis; rectangles may overlap and may be holes.
        duration: [s].
        options: those of `Simulation`.
        references: from `open_loop_references`; for a controller that makes no use of what it senses. Faster.
        contact: model of the contact between soles and ground, one of `c_world.CONTACTS`.

    Returns:
        As from `Simulation.run`, but the trace ends where the walk ends, at a fall too.

    Raises:
        ValueError: if the references are shorter than the walk, or for a model of the contact that there is not.
    """
    scenarios = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], scenario)
    return replay_many(robot, controller, scenarios, duration, options, references, contact)[0]


def replay_many(
    robot: RobotParams,
    controller: Controller,
    scenarios: Scenario,
    duration: float,
    options: Options | None = None,
    references: References | None = None,
    contact: str | Sequence[str] = SPHERES,
    told: Told | None = None,
) -> list[Walk]:
    """Walk one robot in many scenarios, in lockstep; a robot that has failed stays as it is.

    Args:
        robot: as for `replay_c`.
        controller: as for `replay_c`.
        scenarios: with a leading axis.
        duration: as for `replay_c`.
        options: as for `replay_c`.
        references: as for `replay_c`.
        contact: as for `replay_c`, for all or for each.
        told: is told of the progress at every control tick.

    Returns:
        As from `replay_c`, one for every scenario.

    Raises:
        ValueError: as from `replay_c`.
    """
    options = options or Options()
    sinkage = np.asarray(scenarios.ground.sinkage)
    contacts = [contact] * len(sinkage) if isinstance(contact, str) else list(contact)
    if len(contacts) != len(sinkage):
        raise ValueError(f"contact: got {len(contacts)} models, allowed: one, or {len(sinkage)}")
    for one in contacts:
        c_world.CONTACT.check("contact", one)
    ticks = round(duration / options.control_dt)
    simulation = prepare(robot, controller, _on_compliant_ground(options))
    cases = list(zip(sinkage.tolist(), contacts, strict=True))
    depth = {case: c_world.resting_depth(robot, case[0], options.dt, case[1]) for case in set(cases)}
    rests = jnp.asarray([depth[case] for case in cases], sinkage.dtype)
    sunk = eqx.tree_at(lambda s: s.ground.sinkage, scenarios, rests)
    qpos, first = _start(simulation, sunk)
    worlds = _Worlds(robot, scenarios, options, contacts, np.asarray(qpos, float))
    if references is None:
        pilot = _ClosedLoop(robot, controller, scenarios, simulation.torque, options, first, worlds)
    else:
        pilot = _OpenLoop(references, ticks)
    return _walk(worlds, pilot, ticks, told)


def open_loop_references(
    robot: RobotParams, controller: Controller, duration: float, options: Options
) -> References:
    """References of a whole walk (n = control ticks + 1), from a controller that is shown nothing but the time."""
    table = prepare(robot, controller, _on_compliant_ground(options)).torque
    return _open_loop(robot, controller, table, round(duration / options.control_dt), options.control_dt)


@runtime.jit
def _open_loop(
    robot: RobotParams, controller: Controller, table: FeedForward, ticks: int, control_dt: float
) -> References:
    def step(state: Any, tick: Array) -> tuple[Any, References]:
        state, targets = controller.step(state, Sensed.nothing(tick * control_dt))
        return state, _references(robot, targets, table)

    _, rows = jax.lax.scan(step, controller.init(), jnp.arange(1, ticks + 1))
    first = _references(robot, at(controller.gait, 0.0), table)
    return jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, rows)


def _on_compliant_ground(options: Options) -> Options:
    """The same for a start on the compliant ground."""
    return dataclasses.replace(options, contact=COMPLIANT)


def _references(robot: RobotParams, targets: Targets, table: FeedForward) -> References:
    reference, status = servo_reference(robot, targets, table)
    reach = reach_margin(robot, targets.position)
    return References(reference.angle, reference.speed, reference.feed_forward, status, reach, targets)


@runtime.jit
def _start(simulation: Simulation, scenarios: Scenario) -> tuple[Float[Array, "n nq"], References]:
    """Where walks start: at rest on the compliant ground."""
    first = _references(simulation.robot, at(simulation.controller.gait, 0.0), simulation.torque)
    return jax.vmap(lambda scenario: simulation.start(scenario).physics.qpos)(scenarios), first


# The walks -------------------------------------------------------------------------------------------------------

Row = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Angles [rad], speeds [rad/s] and feed-forward torques [N m] of the twelve joints (*n, 12)."""


class _Lane:
    """One simulation, and the places in memory where MuJoCo leaves what is read at every tick."""

    def __init__(
        self, robot: RobotParams, scenario: Scenario, options: Options, contact: str, qpos: np.ndarray
    ):
        self.payload, self.payload_model = scenario.payload, options.payload_model
        self.model = c_world.build_world(robot, scenario, options.dt, contact)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        self.unloaded = c_world.without_load(self.model)
        self.trunk_com = self.model.body_ipos[TRUNK].copy()
        self.push = np.asarray(scenario.push.force, float)
        self.ctrl, self.readings = self.data.ctrl, self.data.sensordata
        self.xpos, self.site = self.data.xpos, self.data.site_xpos
        self.xmat = self.data.xmat.reshape(-1, 3, 3)

    def attach(self) -> None:
        """The load."""
        c_world.attach(self.model, self.payload, self.payload_model)

    def detach(self) -> None:
        """The load, again."""
        c_world.detach(self.model, self.unloaded)

    def set_push(self, share: float) -> None:
        """A share of the force of the push, on the trunk's own centre of mass."""
        force = share * self.push
        arm = self.xmat[TRUNK] @ (self.trunk_com - self.model.body_ipos[TRUNK])
        self.data.xfrc_applied[TRUNK] = np.concatenate([force, np.cross(arm, force)])


class _Worlds:
    """All simulations, and what they saw at the start of the last tick with a leading axis."""

    def __init__(
        self, robot: RobotParams, scenarios: Scenario, options: Options, contacts: list[str], qpos: np.ndarray
    ):
        self.robot, self.options = robot, options
        self.scenarios: Scenario = jax.tree.map(lambda leaf: np.asarray(leaf, float), scenarios)
        self.n = n = len(qpos)
        self.lanes = [_Lane(robot, self.scenario(i), options, contacts[i], qpos[i]) for i in range(n)]
        self.walking = np.ones(n, bool)
        self.xpos, self.xmat = self._all("xpos"), self._all("xmat")
        self.site, self.force = self._all("site"), np.zeros((n, 8, 3))
        self.groups: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self.readings: list[Any] = [None] * n
        for contact in dict.fromkeys(contacts):
            lanes = np.flatnonzero([one == contact for one in contacts])
            rows = np.stack([self.lanes[i].readings for i in lanes])
            self.groups[contact] = lanes, rows
            for i, row in zip(lanes, rows, strict=True):
                self.readings[i] = row
        self.qpos, self.qvel, self.torque = qpos.copy(), np.zeros((n, BIPED.nv)), np.zeros((n, 12))
        payload, push = self.scenarios.payload, self.scenarios.push
        self.attach_time = np.where(payload.mass > 0.0, payload.time, np.inf)
        self.detach_time = np.where(payload.mass > 0.0, payload.end, np.inf)
        self.push_start = push.start
        self.push_end = self.push_start + push.length
        self.kp = np.stack([lane.model.actuator_gainprm[:, 0] for lane in self.lanes])
        self.kv = -np.stack([lane.model.actuator_biasprm[:, 2] for lane in self.lanes])
        gain = self.scenarios.errors.gain_scale.reshape(n, 12)
        self.ki = np.asarray(robot.servo.ki, float).ravel() * gain
        self.has_integral = bool(self.ki.any())
        self.integral = np.zeros((n, 12))
        self.speed_limit = np.asarray(robot.servo.speed_limit, float).ravel()

    def scenario(self, i: int) -> Scenario:
        """That of one lane."""
        return jax.tree.map(lambda leaf: leaf[i], self.scenarios)

    def _all(self, name: str) -> np.ndarray:
        return np.stack([getattr(lane, name) for lane in self.lanes])

    @property
    def corner(self) -> np.ndarray:
        """Sole corners (n, 8, 3) [m]."""
        return self.site[:, _CORNER_SITES]

    @property
    def gap(self) -> np.ndarray:
        """Height of the corners over the ground (n, 2, 4) [m]."""
        corner = self.corner
        return (corner[..., 2] - heights(self.scenarios.terrain, corner[..., :2])).reshape(-1, 2, 4)

    def control_tick(self, number: int, reference: Row, after: Callable[[int], None]) -> None:
        """`control_every` physics ticks, the first one number `number`, under one reference that moves on.

        The setpoint kp^-1 (kp q + kv qd + ff + ki integral) makes MuJoCo's position actuator the robot's servo.
        """
        angle, speed, torque = reference
        dt = self.options.dt
        ctrl = angle + (self.kv * np.clip(speed, -self.speed_limit, self.speed_limit) + torque) / self.kp
        for tick in range(number, number + self.options.control_every):
            self._disturb(tick * dt)
            told = ctrl
            if self.has_integral:
                told = ctrl + self.ki * self.integral / self.kp
                self.integral += dt * (
                    angle - np.stack([lane.data.qpos[BIPED.leg_coordinates] for lane in self.lanes])
                )
                angle = angle + dt * speed
            self._step(told)
            after(tick)
            ctrl = ctrl + dt * speed
        for i in np.flatnonzero(self.walking):
            data = self.lanes[i].data
            self.qpos[i], self.qvel[i], self.torque[i] = data.qpos, data.qvel, data.actuator_force

    def _step(self, ctrl: np.ndarray) -> None:
        """One tick; MuJoCo leaves kinematics and forces of its start."""
        for i in np.flatnonzero(self.walking).tolist():
            lane = self.lanes[i]
            lane.ctrl[:] = ctrl[i]
            mujoco.mj_step(lane.model, lane.data)
            self.xpos[i], self.xmat[i] = lane.xpos, lane.xmat
            self.site[i], self.readings[i][:] = lane.site, lane.readings
        sole, turn = self.site[:, _SOLE_SITES], self.xmat[:, _FEET]
        for contact, (lanes, rows) in self.groups.items():
            self.force[lanes] = c_world.corner_forces(self.robot, contact, rows, sole[lanes], turn[lanes])

    def _disturb(self, time: float) -> None:
        dt = self.options.dt
        for i in np.flatnonzero(self.walking & (time + 0.5 * dt >= self.attach_time)):
            self.lanes[i].attach()
            self.attach_time[i] = np.inf
        for i in np.flatnonzero(self.walking & (time + 0.5 * dt >= self.detach_time)):
            self.lanes[i].detach()
            self.detach_time[i] = np.inf
        pushed = self.walking & (self.push_start - dt < time) & (time < self.push_end + dt)
        for i in np.flatnonzero(pushed):
            overlap = min(time + dt, self.push_end[i]) - max(time, self.push_start[i])
            self.lanes[i].set_push(max(float(overlap) / dt, 0.0))


class _OpenLoop:
    """References known beforehand, the same for all."""

    def __init__(self, references: References, ticks: int):
        if references.angle.shape[0] < ticks + 1:
            raise ValueError(
                f"references: got {references.angle.shape[0] - 1} control ticks, allowed: >= {ticks}"
            )
        self.references = jax.tree.map(np.asarray, references)
        self.tick, self.states = 0, None
        self.rows = [
            a.reshape(-1, 12).astype(float)
            for a in (self.references.angle, self.references.speed, self.references.feed_forward)
        ]
        self.out_of_reach = (self.references.status != 0).any(axis=1)

    def row(self) -> Row:
        angle, speed, torque = (rows[self.tick] for rows in self.rows)
        return angle, speed, torque

    def see(self, worlds: _Worlds, tick: int) -> None:
        pass

    def sense(self, worlds: _Worlds, zmp: np.ndarray, tick: int) -> None:
        self.tick = tick + 1

    def asked(self) -> tuple[np.ndarray, np.ndarray]:
        now = slice(self.tick, self.tick + 1)
        return np.asarray(self.references.reach[now]), self.out_of_reach[now]

    def targets(self, n: int) -> Targets:
        return jax.tree.map(
            lambda leaf: np.broadcast_to(leaf[self.tick], (n, *leaf.shape[1:])), self.references.targets
        )


class _ClosedLoop:
    """The controllers, stepped at every control tick on what the sensors say."""

    def __init__(
        self,
        robot: RobotParams,
        controller: Controller,
        scenarios: Scenario,
        table: FeedForward,
        options: Options,
        first: References,
        worlds: _Worlds,
    ):
        def everywhere(leaf: Any) -> Array:
            return jnp.broadcast_to(jnp.asarray(leaf), (worlds.n, *jnp.shape(leaf)))

        self.known = (robot, controller, table, options, scenarios.sensors)
        self.references, self.states = jax.tree.map(everywhere, (first, controller.init()))
        self.delay: Delay | None = None
        faults = worlds.scenarios.sensors
        self.bounce = faults.bounce[:, None, None]
        self.delta_z, self.stuck = faults.delta_z, faults.stuck_open > 0.5
        self.gap = worlds.gap
        self.closed = (self.gap <= self.delta_z) & ~self.stuck
        self.closing = np.where(self.closed, 0.0, np.inf)

    def row(self) -> Row:
        last = self.references
        angle, speed, torque = (
            np.asarray(a, float).reshape(-1, 12) for a in (last.angle, last.speed, last.feed_forward)
        )
        return angle, speed, torque

    def see(self, worlds: _Worlds, tick: int) -> None:
        """As `sensors.read_switches`: they close within delta_z, at a time interpolated in the tick."""
        gap, dt = worlds.gap, worlds.options.dt
        closed = (gap <= self.delta_z) & ~self.stuck
        fallen = self.gap - gap
        share = np.clip((self.gap - self.delta_z) / np.where(fallen > 0.0, fallen, 1.0), 0.0, 1.0)
        crossed = tick * dt - dt * (1.0 - share)
        self.closing = np.where(closed & ~self.closed, crossed, self.closing)
        self.closed, self.gap = closed, gap

    def sense(self, worlds: _Worlds, zmp: np.ndarray, tick: int) -> None:
        reading = self._reading(worlds, zmp, (tick + 1) * worlds.options.control_dt)
        number = np.int32((tick + 1) * worlds.options.control_every)
        self.states, self.delay, self.references = _control(
            *self.known, self.states, self.delay, reading, worlds.corner, worlds.walking, number
        )

    def _reading(self, worlds: _Worlds, zmp: np.ndarray, time: float) -> dict[str, np.ndarray]:
        """Every field of `Sensed`, by the definitions of `sensors.sense`."""
        n, trunk, feet = worlds.n, worlds.xpos[:, TRUNK], worlds.xpos[:, _FEET]
        force = worlds.force.reshape(n, 2, 4, 3)
        arm = worlds.corner.reshape(n, 2, 4, 3) - feet[:, :, None]
        wrench = np.stack([force.sum(2), np.cross(arm, force).sum(2)], axis=2)
        roll, pitch, yaw = _roll_pitch_yaw(worlds.xmat[:, TRUNK]).T
        (x, y), c, s = (zmp - trunk[:, :2]).T, np.cos(yaw), np.sin(yaw)
        since = time - self.closing
        opened = (since < self.bounce) & (np.floor(since / BOUNCE_PERIOD) % 2 == 1)
        return {
            "time": np.full(n, time),
            "switch": self.closed & ~opened,
            "switch_time": self.closing,
            "corner_force": force[..., 2],
            "ankle_wrench": np.einsum("nfji,nfwj->nfwi", worlds.xmat[:, _FEET], wrench).reshape(n, 2, 6),
            "angle": worlds.qpos[:, 7:].reshape(n, 2, 6),
            "speed": worlds.qvel[:, 6:].reshape(n, 2, 6),
            "roll_pitch": np.stack([roll, pitch], axis=1),
            "rate": worlds.qvel[:, 3:6],
            "zmp_world": zmp,
            "zmp_body": np.stack([c * x + s * y, -s * x + c * y], axis=1),
        }

    def asked(self) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.references.reach), (np.asarray(self.references.status) != 0).any(axis=1)

    def targets(self, n: int) -> Targets:
        return jax.tree.map(np.asarray, self.references.targets)


_Pilot = _OpenLoop | _ClosedLoop
"""Where the references come from: `row` before a control tick, `see` after each physics tick, `sense` after the control
tick; then `asked` is by how much the legs reach the targets and whether they do not, each lane's or all lanes'."""


@runtime.jit
def _control(  # noqa: PLR0913
    robot: RobotParams,
    controller: Controller,
    table: FeedForward,
    options: Options,
    faults: SensorFaults,
    states: Any,
    delays: Delay | None,
    readings: dict[str, Any],
    p_world_corner: Any,
    walking: Any,
    tick: Any,
) -> tuple[Any, Delay | None, References]:
    """One control tick of `Simulation` on readings from elsewhere: noise, delay, controller, inverse kinematics."""

    def one(
        faults: SensorFaults, state: Any, delay: Delay | None, reading: Any, corner: Any, goes_on: Any
    ) -> Any:
        sensed = Sensed(**reading)
        if options.noise:
            every, dt = options.control_every, options.control_dt
            place = corner.reshape(2, 4, 3)
            sensed = sensors.add_noise(robot, sensed, place, faults, tick, every, dt)
        if options.delay_room > 0:
            delay = Delay.filled(sensed, options.delay_room) if delay is None else delay
            delay, sensed = delay.push(sensed, faults.delay, options.control_dt)
        new, targets = controller.step(state, sensed)
        state = jax.tree.map(lambda after, before: jnp.where(goes_on, after, before), new, state)
        return state, delay, _references(robot, targets, table)

    return jax.vmap(one)(faults, states, delays, readings, p_world_corner, walking)


def _walk(worlds: _Worlds, pilot: _Pilot, ticks: int, told: Told | None) -> list[Walk]:
    """Step until the end, or until all have failed."""
    options, n = worlds.options, worlds.n
    tally, margins = _Tally(worlds), _Margins(n)
    trace = _Trace(_sample(worlds, tally, pilot.targets(n), 0.0)) if options.trace_every else None
    ended: dict[int, dict[str, np.ndarray]] = {}

    def after(tick: int) -> None:
        tally.update(worlds, (tick + 1) * options.dt)
        pilot.see(worlds, tick)
        for i in np.flatnonzero(worlds.walking & (tally.status != OK)).tolist():
            ended[i] = tally.lane(i)
            worlds.walking[i] = False

    with np.errstate(invalid="ignore", over="ignore"):
        for tick in range(ticks):
            worlds.control_tick(tick * options.control_every, pilot.row(), after)
            if not worlds.walking.any():
                break
            tally.press(worlds)
            pilot.sense(worlds, tally.zmp, tick)
            margins.add(worlds, tally, *pilot.asked())
            time = (tick + 1) * options.control_dt
            if trace is not None and (tick + 1) % options.trace_every == 0:
                trace.add(_sample(worlds, tally, pilot.targets(n), time), worlds.walking)
            if told is not None:
                told(time, int(worlds.walking.sum()))
    margins.look()
    states, walks = jax.tree.map(np.asarray, pilot.states), []
    for i in range(n):
        kept = (ended.get(i) or tally.lane(i)) | margins.lane(i, options.control_dt)
        stats = Statistics(**{name: _device(value) for name, value in kept.items()})
        state = jax.tree.map(lambda leaf, i=i: jnp.asarray(leaf[i]), states)
        walks.append(Walk(stats, None if trace is None else trace.lane(i), state))
    return walks


# What is kept ----------------------------------------------------------------------------------------------------


def _roll_pitch_yaw(rotation: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw (*n, 3) [rad] of rotations (*n, 3, 3) = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])
    pitch = -np.arcsin(np.clip(rotation[..., 2, 0], -0.999999, 0.999999))
    return np.stack([roll, pitch, np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])], axis=-1)


class _Tally:
    """Statistics of every lane so far, by the definitions of `statistics.update`."""

    def __init__(self, worlds: _Worlds):
        n = worlds.n
        self.status, self.end_time = np.full(n, OK, np.int32), np.zeros(n)
        self.peak_roll_pitch, self.peak_foot_force = np.zeros((n, 2)), np.zeros((n, 2))
        self.peak_slip, self.peak_touchdown_force = np.zeros((n, 2)), np.zeros((n, 2))
        self.peak_touchdown_impulse, self.touch_impulse = np.zeros((n, 2)), np.zeros((n, 2))
        self.support_time, self.touch_time = np.zeros(n), np.full((n, 2), -1.0)
        self.anchor, self.loaded = worlds.xpos[:, _FEET, :2], np.ones((n, 2), bool)
        self.p_world_trunk = worlds.xpos[:, TRUNK].copy()
        self.pelvis_height = _pelvis_height(worlds.xpos)
        self.foot_force, self.p_world_foot = np.zeros((n, 2)), self.anchor
        self.names = list(vars(self))
        self.zmp = self.p_world_trunk[:, :2]

    def update(self, worlds: _Worlds, time: float) -> None:
        """After a physics tick that ended at `time` [s]; what was seen at its start counts."""
        dt = worlds.options.dt
        vertical = worlds.force[..., 2].reshape(-1, 2, 4).sum(axis=2)
        trunk, place = worlds.xpos[:, TRUNK], worlds.xpos[:, _FEET, :2]
        loaded = vertical > LOADED
        landed, left, reached = loaded & ~self.loaded, self.loaded & ~loaded, place
        crosses = landed | left
        if crosses.any():
            rise = np.where(crosses, vertical - self.foot_force, 1.0)
            share = np.where(crosses, (LOADED - self.foot_force) / rise, 0.0)
            touched = self.p_world_foot + share[..., None] * (place - self.p_world_foot)
            reached = np.where(left[..., None], touched, place)
            self.touch_time = np.where(landed, time - dt * (1.0 - share), self.touch_time)
            self.anchor = np.where(landed[..., None], touched, self.anchor)
            self.touch_impulse = np.where(landed, 0.0, self.touch_impulse)
        begin = np.maximum(time - dt, self.touch_time)
        within = np.where(self.touch_time >= 0.0, np.minimum(time, self.touch_time + TOUCHDOWN) - begin, 0.0)
        force = np.where(within > 0.0, vertical, 0.0)
        self.touch_impulse = self.touch_impulse + np.maximum(within, 0.0) * vertical
        slip = np.where(loaded | left, np.sqrt(((reached - self.anchor) ** 2).sum(axis=-1)), 0.0)
        tilt = np.abs(_roll_pitch_yaw(worlds.xmat[:, TRUNK])[:, :2])
        for peak, value in (
            (self.peak_roll_pitch, tilt),
            (self.peak_foot_force, vertical),
            (self.peak_slip, slip),
            (self.peak_touchdown_force, force),
            (self.peak_touchdown_impulse, self.touch_impulse),
        ):
            np.fmax(peak, value, out=peak)
        self.support_time = np.where(vertical.sum(axis=1) > TOUCHING, time, self.support_time)
        low = _pelvis_height(worlds.xpos) < FALL_HEIGHT * self.pelvis_height
        fell = (tilt.max(axis=1) > FALL_TILT) | low
        airborne = time - self.support_time > AIRBORNE_TIME + 1e-9
        finite = np.isfinite(trunk).all(axis=1) & np.isfinite(vertical).all(axis=1)
        fine = np.where(fell, FELL, np.where(airborne, AIRBORNE, OK))
        self.status = np.where(finite, fine, NONFINITE).astype(np.int32)
        self.end_time[:], self.p_world_trunk = time, trunk.copy()
        self.loaded, self.foot_force, self.p_world_foot = loaded, vertical, place

    def press(self, worlds: _Worlds) -> None:
        """Centre of the vertical forces at the corners, at a control tick; the last one while nothing is loaded."""
        weight, corner = worlds.force[..., 2], worlds.corner[..., :2]
        total = weight.sum(axis=1)
        pressed = total > 1.0
        centre = np.einsum("nc,nci->ni", weight, corner) / np.where(pressed, total, 1.0)[:, None]
        self.zmp = np.where(pressed[:, None], centre, self.zmp)

    def lane(self, i: int) -> dict[str, np.ndarray]:
        """Of one lane."""
        return {name: np.array(getattr(self, name)[i]) for name in self.names}


class _Margins:
    """What the control ticks leave, by the definitions of `statistics.update_margins`."""

    def __init__(self, n: int):
        self.zmp_margin, self.reach_margin = np.full(n, np.inf), np.full(n, np.inf)
        self.out_of_reach = np.zeros(n, int)
        self.corner, self.zmp = np.zeros((TOGETHER, n, 8, 2)), np.zeros((TOGETHER, n, 2))
        self.active, self.row = np.zeros((TOGETHER, n, 8), bool), 0

    def add(self, worlds: _Worlds, tally: _Tally, reach: np.ndarray, out_of_reach: np.ndarray) -> None:
        """After a control tick; of those that still walk."""
        walking = worlds.walking
        self.reach_margin = np.where(walking, np.fmin(self.reach_margin, reach), self.reach_margin)
        self.out_of_reach += walking & out_of_reach
        self.corner[self.row], self.zmp[self.row] = worlds.corner[..., :2], tally.zmp
        self.active[self.row] = np.repeat(tally.loaded & walking[:, None], 4, axis=1)
        self.row += 1
        if self.row == TOGETHER:
            self.look()

    def look(self) -> None:
        """At the support polygons of the last control ticks."""
        least = np.asarray(_least_margin(self.corner, self.active, self.zmp))
        self.zmp_margin = np.fmin(self.zmp_margin, least)
        self.active[:], self.row = False, 0

    def lane(self, i: int, control_dt: float) -> dict[str, np.ndarray]:
        """Of one lane."""
        time = np.asarray(self.out_of_reach[i] * control_dt)
        margins = {name: np.asarray(getattr(self, name)[i]) for name in ("zmp_margin", "reach_margin")}
        return {**margins, "out_of_reach_time": time}


@runtime.jit
def _least_margin(corner: Any, active: Any, zmp: Any) -> Float[Array, " n"]:
    return jnp.min(jax.vmap(jax.vmap(support.margin))(corner, active, zmp), axis=0)


def _sample(worlds: _Worlds, tally: _Tally, targets: Targets, time: float) -> dict[str, Any]:
    """Fields of a `Sample` of all lanes, after a control tick."""
    n, faults = worlds.n, worlds.scenarios.sensors
    force = worlds.force.reshape(n, 2, 4, 3)
    return {
        "time": np.full(n, time),
        "p_world_trunk": worlds.xpos[:, TRUNK].copy(),
        "roll_pitch_yaw": _roll_pitch_yaw(worlds.xmat[:, TRUNK]),
        "p_world_sole": worlds.site[:, _SOLE_SITES],
        "foot_force": force.sum(axis=2),
        "corner_force": force[..., 2].copy(),
        "zmp_world": tally.zmp,
        "switch": (worlds.gap <= faults.delta_z) & (faults.stuck_open < 0.5),
        "torque": worlds.torque.reshape(n, 2, 6).copy(),
        "qpos": worlds.qpos.copy(),
        "targets": targets,
    }


class _Trace:
    """Samples of all lanes, and which lanes they are of."""

    def __init__(self, start: dict[str, Any]):
        self.start = start
        """What a sample is like; it is not kept."""
        self.rows: list[dict[str, Any]] = []
        self.walking: list[np.ndarray] = []

    def add(self, row: dict[str, Any], walking: np.ndarray) -> None:
        """After a control tick."""
        self.rows.append(row)
        self.walking.append(walking.copy())

    def lane(self, i: int) -> Sample:
        """Of one lane, as long as it walked."""
        rows = [row for row, walking in zip(self.rows, self.walking, strict=True) if walking[i]]
        stacked = jax.tree.map(lambda *leaves: np.stack([leaf[i] for leaf in leaves])[1:], self.start, *rows)
        return Sample(**jax.tree.map(_device, stacked))


def _pelvis_height(xpos: np.ndarray) -> np.ndarray:
    return xpos[..., TRUNK, 2] - xpos[..., _FEET, 2].min(axis=-1)


def _device(value: np.ndarray) -> Array:
    """As JAX holds it: its default float type, if it is a float."""
    return jnp.asarray(value, jnp.result_type(float) if value.dtype.kind == "f" else None)

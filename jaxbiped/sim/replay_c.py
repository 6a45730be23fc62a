"""The same walk in C MuJoCo, tick by tick on the host: a cross-check of `rollout` that shares no physics with it.

Contacts are MuJoCo's own, between small spheres at the sole corners and level boxes; dynamics, servos, statistics and
sensors are done again in C and NumPy. Controller, inverse kinematics, feed-forward and start are those of `rollout`.
MuJoCo's servos have no speed limit, and its contacts are linear springs and dampers (`solref`) without a slip speed.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbiped import runtime
from jaxbiped.adapt import Controller, Sensed
from jaxbiped.kinematics import GRAVITY
from jaxbiped.planner import Targets, at, support
from jaxbiped.robot import SIDE_NAMES, RobotParams
from jaxbiped.sim import equilibrium, mjx_adapter, plant, sensors
from jaxbiped.sim.feed_forward import FeedForward
from jaxbiped.sim.mjx_adapter import LEFT_FOOT, RIGHT_FOOT, TRUNK
from jaxbiped.sim.model import CORNER_NAMES, build_spec
from jaxbiped.sim.rollout import Options, Sample, Walk, make_feed_forward, servo_reference
from jaxbiped.sim.scenario import Payload, Scenario, SensorFaults, Terrain
from jaxbiped.sim.sensors import BOUNCE_PERIOD, Delay
from jaxbiped.sim.servo import Reference
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

IMPEDANCE = 0.9
"""MuJoCo's contact impedance, the same at all depths, so that a contact is a linear spring and damper."""
OUTER = 50.0
"""How far raised ground reaches where nothing bounds it [m]."""
THICKNESS = 0.1
"""How far boxes reach below the lowest ground [m]."""
CORNERS = tuple(f"{side}_{corner}" for side in SIDE_NAMES for corner in CORNER_NAMES)
"""Names of sites, spheres and contact sensors at the sole corners."""

_FEET = [LEFT_FOOT, RIGHT_FOOT]
_SOLE_SITES, _CORNER_SITES = [0, 5], [1, 2, 3, 4, 6, 7, 8, 9]
"""Numbers of the sites, foot by foot the sole's and its corners'."""
Box = tuple[tuple[float, float], tuple[float, float], float]
"""Smallest and largest (x, y) of a level box, and the height of its top [m]."""


class References(eqx.Module):
    """What the servos are told at a control tick; with a leading axis, from the start on at every one."""

    angle: Float[Array, "*n 2 6"]
    """[rad]"""
    speed: Float[Array, "*n 2 6"]
    """[rad/s]"""
    feed_forward: Float[Array, "*n 2 6"]
    """[N m]"""
    status: Int[Array, "*n 2"]
    """Status of the inverse kinematics, each leg."""
    targets: Targets
    """What the controller asked for."""


def replay_c(
    robot: RobotParams,
    controller: Controller,
    scenario: Scenario,
    duration: float,
    options: Options | None = None,
    references: References | None = None,
) -> Walk:
    """Walk one robot in one scenario for `duration` [s] in C MuJoCo; runs on the host, cannot be traced.

    Args:
        robot: one robot, without a batch axis.
        controller: stepped at every control tick, unless `references` are given.
        scenario: one scenario, without a batch axis; rectangles may overlap and may be holes.
        duration: [s].
        options: those of `rollout`.
        references: from `open_loop_references`; for a controller that makes no use of what it senses. Much faster.

    Returns:
        As from `rollout`, but the trace ends where the walk ends, at a fall too.

    Raises:
        ValueError: if the references are shorter than the walk.
    """
    options = options or Options()
    ticks = round(duration / options.control_dt)
    table = make_feed_forward(robot, controller, duration, options)
    qpos, first = _start(
        robot, mjx_adapter.base_model(robot), controller, scenario, table, options.payload_model
    )
    world = _World(robot, scenario, options, np.asarray(qpos, float))
    if references is None:
        pilot = _ClosedLoop(robot, controller, scenario.sensors, table, options, first)
    else:
        pilot = _OpenLoop(references, ticks)
    log = _Log(ticks, options.control_every, options.dt)
    _walk(world, pilot, log, ticks)
    return _result(world, pilot, log)


@runtime.jit
def open_loop_references(
    robot: RobotParams, controller: Controller, duration: float, options: Options
) -> References:
    """References of a whole walk (n = control ticks + 1), from a controller that is shown nothing but the time."""
    table = make_feed_forward(robot, controller, duration, options)

    def step(state: Any, tick: Array) -> tuple[Any, References]:
        state, targets = controller.step(state, Sensed.nothing(tick * options.control_dt))
        return state, _references(robot, targets, table)

    ticks = jnp.arange(1, round(duration / options.control_dt) + 1)
    _, rows = jax.lax.scan(step, controller.init(), ticks)
    first = _references(robot, at(controller.gait, 0.0), table)
    return jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, rows)


def _references(robot: RobotParams, targets: Targets, table: FeedForward) -> References:
    reference, status = servo_reference(robot, targets, table)
    return References(reference.angle, reference.speed, reference.feed_forward, status, targets)


@runtime.jit
def _start(
    robot: RobotParams,
    model: Any,
    controller: Controller,
    scenario: Scenario,
    table: FeedForward,
    payload_model: str,
) -> tuple[Float[Array, "19"], References]:
    """Where `rollout` starts: at rest on the compliant ground."""
    first = _references(robot, at(controller.gait, 0.0), table)
    world = plant.make_plant(robot, model, scenario, payload_model)
    reference = Reference(first.angle, first.speed, first.feed_forward)
    return equilibrium.standing(world, first.targets.position, reference), first


# The ground ------------------------------------------------------------------------------------------------------


def heights(terrain: Terrain, xy: np.ndarray) -> np.ndarray:
    """Height of the ground with sharp edges at points (*n, 2) [m]."""
    point = xy[..., None, :]
    inside = (point >= np.asarray(terrain.lower)) & (point < np.asarray(terrain.upper))
    return np.sum(np.asarray(terrain.height) * inside.all(-1), axis=-1)


def level_boxes(terrain: Terrain) -> tuple[float, list[Box]]:
    """Height of the lowest ground and the boxes that rise from it; all edges cut the plane into cells.

    For every height there are boxes over all ground at least so high, so that where ground is merely raised there is
    one box for every rectangle; boxes of one height share edges only around holes, where a corner may touch two.
    """
    lower, upper, height = (np.asarray(a, float) for a in (terrain.lower, terrain.upper, terrain.height))
    used = (lower < upper).all(axis=1) & (height != 0.0)
    if not used.any():
        return 0.0, []
    x, y = (np.unique(np.concatenate([[-OUTER, OUTER], lower[used, i], upper[used, i]])) for i in range(2))
    middle = np.stack(np.meshgrid(*((edge[1:] + edge[:-1]) / 2.0 for edge in (x, y)), indexing="ij"), -1)
    cells = np.round(heights(terrain, middle), 9)
    boxes = []
    for level in np.unique(cells)[1:]:
        for i, j, k, m in _rectangles(cells >= level):
            boxes.append(((float(x[i]), float(y[k])), (float(x[j]), float(y[m])), float(level)))
    return float(cells.min()), boxes


def _rectangles(mask: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Cover a mask with rectangles of cells [i, j) x [k, m) that do not overlap."""
    left, found = mask.copy(), []
    for i, k in np.argwhere(mask):
        if not left[i, k]:
            continue
        m = k + 1
        while m < left.shape[1] and left[i, m]:
            m += 1
        j = i + 1
        while j < left.shape[0] and left[j, k:m].all():
            j += 1
        left[i:j, k:m] = False
        found.append((int(i), int(j), int(k), int(m)))
    return found


def contact_time_constant(robot: RobotParams, sinkage: float, invweight: float) -> float:
    """MuJoCo's `solref` time constant [s] with which the nominal robot on both feet sinks in by `sinkage` [m].

    At constant impedance d a contact at rest has force / depth = 1 / ((1 - d) timeconst^2 invweight), `invweight`
    [1/kg] being that of the foot; and that is to be the weight on each of eight corners over the sinkage.
    """
    wanted = float(robot.total_mass) * GRAVITY / (8.0 * sinkage)
    return float(np.sqrt(1.0 / ((1.0 - IMPEDANCE) * wanted * invweight)))


def build_world(robot: RobotParams, scenario: Scenario, timestep: float) -> mujoco.MjModel:
    """The robot with its model errors on the scenario's ground, with a force sensor for every sole corner."""
    base, boxes = level_boxes(scenario.terrain)
    spec = build_spec(_with_errors(robot, scenario), timestep)
    floor = spec.geom("floor")
    assert floor is not None
    floor.pos = [0.0, 0.0, base]
    for i, (lower, upper, top) in enumerate(boxes):
        low, high = np.array([*lower, base - THICKNESS]), np.array([*upper, top])
        box = spec.worldbody.add_geom(
            name=f"box_{i}", type=mujoco.mjtGeom.mjGEOM_BOX, contype=1, conaffinity=2
        )
        box.pos, box.size = (low + high) / 2.0, (high - low) / 2.0
    force, net_force = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3
    for name in CORNERS:
        spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname=name,
            intprm=[force, net_force, 1],
        )
    model = spec.compile()
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    nominal = build_spec(robot).compile().body_invweight0[LEFT_FOOT, 0]
    model.geom_solref[:] = contact_time_constant(robot, float(scenario.ground.sinkage), nominal), 1.0
    model.geom_solimp[:] = IMPEDANCE, IMPEDANCE, 1e-3, 0.5, 2.0
    model.geom_friction[:, 0] = float(scenario.ground.friction)
    return model


def _with_errors(robot: RobotParams, scenario: Scenario) -> RobotParams:
    errors, links, servo = scenario.errors, robot.links, robot.servo
    return eqx.tree_at(
        lambda r: (r.links.mass, r.links.inertia, r.links.com, r.servo.kp, r.servo.kv, r.servo.ki),
        robot,
        (
            links.mass * errors.mass_scale,
            links.inertia * errors.mass_scale[:, None, None],
            links.com.at[0].add(errors.trunk_com_offset),
            servo.kp * errors.gain_scale,
            servo.kv * errors.gain_scale,
            servo.ki * errors.gain_scale,
        ),
    )


# The load --------------------------------------------------------------------------------------------------------


def attach(model: mujoco.MjModel, payload: Payload, payload_model: str) -> None:
    """Give the trunk the mass, centre of mass and inertia of trunk and load in one; contacts stay as they are.

    `exact`: a uniform cube, by the parallel-axis theorem. `thesis`: elkahlout Eqs. 3.8-3.10, where the inertia only
    grows in proportion to the mass.
    """
    mass, load = float(model.body_mass[TRUNK]), float(payload.mass)
    com, place = model.body_ipos[TRUNK].copy(), np.asarray(payload.place, float)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[TRUNK])
    turn = turn.reshape(3, 3)
    inertia = turn @ np.diag(model.body_inertia[TRUNK]) @ turn.T
    total = mass + load
    centre = (mass * com + load * place) / total
    if payload_model == plant.EXACT:
        inertia = inertia + np.eye(3) * load * float(payload.size) ** 2 / 6.0
        inertia = inertia + mass * _offset(com - centre) + load * _offset(place - centre)
    else:
        inertia = inertia * total / mass
    principal, axes = np.linalg.eigh(inertia)
    axes = axes * np.sign(np.linalg.det(axes))
    mujoco.mju_mat2Quat(model.body_iquat[TRUNK], axes.reshape(9))
    model.body_mass[TRUNK], model.body_inertia[TRUNK], model.body_ipos[TRUNK] = total, principal, centre
    model.body_subtreemass[: TRUNK + 1] += load
    model.body_sameframe[TRUNK] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


_WITH_THE_LOAD = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_subtreemass",
    "body_sameframe",
)
"""What `attach` changes."""


def without_load(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """What `detach` needs to take a load off again; to be asked before it is attached."""
    return {name: getattr(model, name).copy() for name in _WITH_THE_LOAD}


def detach(model: mujoco.MjModel, unloaded: dict[str, np.ndarray]) -> None:
    """Take the load off the trunk."""
    for name, value in unloaded.items():
        getattr(model, name)[:] = value


def _offset(arm: np.ndarray) -> np.ndarray:
    """Inertia of a unit of mass at `arm` [m2]."""
    return np.eye(3) * (arm @ arm) - np.outer(arm, arm)


# The walk --------------------------------------------------------------------------------------------------------

Row = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Angles [rad], speeds [rad/s] and feed-forward torques [N m] of the twelve joints."""


class _World:
    """Model and state of the simulation, and what each tick needs of the scenario as plain numbers."""

    def __init__(self, robot: RobotParams, scenario: Scenario, options: Options, qpos: np.ndarray):
        self.robot, self.options, self.scenario = robot, options, scenario
        self.model = build_world(robot, scenario, options.dt)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = qpos
        has_load = float(scenario.payload.mass) > 0.0
        self.attach_time = float(scenario.payload.time) if has_load else np.inf
        self.detach_time = float(scenario.payload.end) if has_load else np.inf
        self.unloaded = without_load(self.model)
        self.trunk_com = self.model.body_ipos[TRUNK].copy()
        push = scenario.push
        self.push, self.push_start = np.asarray(push.force, float), float(push.start)
        self.push_end = self.push_start + float(push.length)
        self.kp = self.model.actuator_gainprm[:, 0].copy()
        self.kv = -self.model.actuator_biasprm[:, 2]
        self.ki = np.asarray(robot.servo.ki * scenario.errors.gain_scale, float).ravel()
        self.has_integral = bool(self.ki.any())
        self.speed_limit = np.asarray(robot.servo.speed_limit, float).ravel()
        self.integral = np.zeros(12)

    def control_tick(self, tick: int, reference: Row, log: "_Log") -> None:
        """`control_every` physics ticks, the first one number `tick`, under one reference that moves on.

        The setpoint kp^-1 (kp q + kv qd + ff + ki integral) makes MuJoCo's position actuator the robot's servo.
        """
        angle, speed, torque = reference
        dt = self.options.dt
        ctrl = angle + (self.kv * np.clip(speed, -self.speed_limit, self.speed_limit) + torque) / self.kp
        for _ in range(self.options.control_every):
            self._disturb(tick * dt)
            self.data.ctrl[:] = ctrl
            if self.has_integral:
                self.data.ctrl += self.ki * self.integral / self.kp
                self.integral += dt * (angle - self.data.qpos[7:])
                angle = angle + dt * speed
            mujoco.mj_step(self.model, self.data)
            log.write(tick, self.data)
            ctrl = ctrl + dt * speed
            tick += 1

    def _disturb(self, time: float) -> None:
        dt = self.options.dt
        if time + 0.5 * dt >= self.attach_time:
            attach(self.model, self.scenario.payload, self.options.payload_model)
            self.attach_time = np.inf
        if time + 0.5 * dt >= self.detach_time:
            detach(self.model, self.unloaded)
            self.detach_time = np.inf
        if not self.push_start - dt < time < self.push_end + dt:
            return
        overlap = min(time + dt, self.push_end) - max(time, self.push_start)
        force = max(overlap / dt, 0.0) * self.push
        arm = self.data.xmat[TRUNK].reshape(3, 3) @ (self.trunk_com - self.model.body_ipos[TRUNK])
        self.data.xfrc_applied[TRUNK] = np.concatenate([force, np.cross(arm, force)])


class _Log:
    """What every physics tick saw at its start (n rows), and the state every control tick ended in (c rows)."""

    def __init__(self, ticks: int, every: int, dt: float):
        n, c = ticks * every, ticks
        self.every, self.dt, self.done = every, dt, 0
        self.xpos, self.xmat = np.zeros((n, 14, 3)), np.zeros((n, 14, 3, 3))
        self.site, self.force = np.zeros((n, 10, 3)), np.zeros((n, 8, 3))
        self.torque, self.qpos, self.qvel = np.zeros((c, 12)), np.zeros((c, 19)), np.zeros((c, 18))

    def write(self, row: int, data: mujoco.MjData) -> None:
        """After `mj_step`, which leaves kinematics and forces of its start."""
        self.xpos[row], self.site[row] = data.xpos, data.site_xpos
        self.xmat[row].reshape(14, 9)[:] = data.xmat
        np.negative(data.sensordata, out=self.force[row].reshape(24))

    def write_control(self, row: int, data: mujoco.MjData) -> None:
        """After a control tick."""
        self.torque[row], self.qpos[row], self.qvel[row] = data.actuator_force, data.qpos, data.qvel
        self.done = row + 1

    @property
    def p_world_corner(self) -> np.ndarray:
        """Sole corners (n, 8, 3) [m]."""
        return self.site[:, _CORNER_SITES]


class _OpenLoop:
    """References known beforehand."""

    def __init__(self, references: References, ticks: int):
        if references.angle.shape[0] < ticks + 1:
            raise ValueError(
                f"references: got {references.angle.shape[0] - 1} control ticks, allowed: >= {ticks}"
            )
        self.references = jax.tree.map(np.asarray, references)
        self.state = None
        self.flat = [
            a.reshape(-1, 12).astype(float)
            for a in (self.references.angle, self.references.speed, self.references.feed_forward)
        ]

    def row(self, tick: int) -> Row:
        angle, speed, torque = self.flat
        return angle[tick], speed[tick], torque[tick]

    def sense(self, world: _World, log: _Log, tick: int) -> None:
        pass

    def asked(self, ticks: np.ndarray) -> tuple[np.ndarray, Targets]:
        rows = jax.tree.map(lambda leaf: leaf[ticks + 1], self.references)
        return rows.status, jax.tree.map(jnp.asarray, rows.targets)


class _ClosedLoop:
    """The controller, stepped at every control tick on what the sensors say."""

    def __init__(
        self,
        robot: RobotParams,
        controller: Controller,
        faults: SensorFaults,
        table: FeedForward,
        options: Options,
        first: References,
    ):
        self.known = (robot, controller, faults, table, options)
        self.delta_z, self.stuck = np.asarray(faults.delta_z), np.asarray(faults.stuck_open) > 0.5
        self.bounce = float(faults.bounce)
        self.history, self.state, self.delay = [first], controller.init(), None
        self.closed: Any = None
        self.gap: Any = None
        self.closing: Any = None
        self.zmp: Any = None

    def row(self, tick: int) -> Row:
        last = self.history[tick]
        angle, speed, torque = (
            np.asarray(a, float).reshape(12) for a in (last.angle, last.speed, last.feed_forward)
        )
        return angle, speed, torque

    def sense(self, world: _World, log: _Log, tick: int) -> None:
        for row in range(tick * log.every, (tick + 1) * log.every):
            self._switches(world, log, row)
        reading = self._reading(log, tick, (tick + 1) * world.options.control_dt)
        number = (tick + 1) * log.every
        corner = log.site[number - 1, _CORNER_SITES].reshape(2, 4, 3)
        self.state, self.delay, reference = _control(
            *self.known, self.state, self.delay, reading, corner, np.int32(number)
        )
        self.history.append(reference)

    def _switches(self, world: _World, log: _Log, row: int) -> None:
        """As `sensors.read_switches`: they close within delta_z, at a time interpolated in the tick."""
        corner, dt = log.site[row, _CORNER_SITES], world.options.dt
        gap = (corner[:, 2] - heights(world.scenario.terrain, corner[:, :2])).reshape(2, 4)
        closed = (gap <= self.delta_z) & ~self.stuck
        if self.gap is None:
            self.closing = np.where(closed, 0.0, np.inf)
        else:
            fallen = self.gap - gap
            share = np.clip((self.gap - self.delta_z) / np.where(fallen > 0.0, fallen, 1.0), 0.0, 1.0)
            self.closing = np.where(closed & ~self.closed, row * dt - dt * (1.0 - share), self.closing)
        self.closed, self.gap = closed, gap

    def _reading(self, log: _Log, tick: int, time: float) -> dict[str, np.ndarray]:
        """Every field of `Sensed`, by the definitions of `sensors.sense`."""
        row = (tick + 1) * log.every - 1
        trunk, feet = log.xpos[row, TRUNK], log.xpos[row, _FEET]
        self.zmp = _zmp(log.force[row, :, 2], log.site[row, _CORNER_SITES], self.zmp, trunk)
        force = log.force[row].reshape(2, 4, 3)
        arm = log.site[row, _CORNER_SITES].reshape(2, 4, 3) - feet[:, None]
        wrench = np.concatenate([force.sum(1), np.cross(arm, force).sum(1)], axis=1).reshape(2, 2, 3)
        roll, pitch, yaw = _roll_pitch_yaw(log.xmat[row, TRUNK])
        forward, c, s = self.zmp - trunk[:2], np.cos(yaw), np.sin(yaw)
        since = time - self.closing
        opened = (since < self.bounce) & (np.floor(since / BOUNCE_PERIOD) % 2 == 1)
        return {
            "time": np.array(time),
            "switch": self.closed & ~opened,
            "switch_time": self.closing,
            "corner_force": force[..., 2],
            "ankle_wrench": np.einsum("fji,fwj->fwi", log.xmat[row, _FEET], wrench).reshape(2, 6),
            "angle": log.qpos[tick, 7:].reshape(2, 6),
            "speed": log.qvel[tick, 6:].reshape(2, 6),
            "roll_pitch": np.array([roll, pitch]),
            "rate": log.qvel[tick, 3:6],
            "zmp_world": self.zmp,
            "zmp_body": np.array([c * forward[0] + s * forward[1], -s * forward[0] + c * forward[1]]),
        }

    def asked(self, ticks: np.ndarray) -> tuple[np.ndarray, Targets]:
        rows = [self.history[tick + 1] for tick in ticks]
        if not rows:
            rows = self.history[:1]
            return np.zeros((0, 2), int), jax.tree.map(lambda leaf: leaf[None][:0], rows[0].targets)
        stacked = jax.tree.map(lambda *leaf: np.stack(leaf), *rows)
        return stacked.status, jax.tree.map(jnp.asarray, stacked.targets)


_Pilot = _OpenLoop | _ClosedLoop
"""Where the references come from: `row` before a control tick, `sense` after it, `asked` at the end."""


@runtime.jit
def _control(
    robot: RobotParams,
    controller: Controller,
    faults: SensorFaults,
    table: FeedForward,
    options: Options,
    state: Any,
    delay: Delay | None,
    reading: dict[str, Any],
    p_world_corner: Any,
    tick: Any,
) -> tuple[Any, Delay | None, References]:
    """One control tick of `rollout` on a reading from elsewhere: noise, delay, controller, inverse kinematics."""
    sensed = Sensed(**reading)
    if options.noise:
        every, dt = options.control_every, options.control_dt
        sensed = sensors.add_noise(robot, sensed, p_world_corner, faults, tick, every, dt)
    if options.delay_room > 0:
        delay = Delay.filled(sensed, options.delay_room) if delay is None else delay
        delay, sensed = delay.push(sensed, faults.delay, options.control_dt)
    state, targets = controller.step(state, sensed)
    return state, delay, _references(robot, targets, table)


def _walk(world: _World, pilot: _Pilot, log: _Log, ticks: int) -> None:
    """Step until the end or soon after a fall."""
    for tick in range(ticks):
        world.control_tick(tick * log.every, pilot.row(tick), log)
        log.write_control(tick, world.data)
        if not np.isfinite(world.data.qpos).all():
            return
        pilot.sense(world, log, tick)
        if tick % 16 == 15 and _status(log, slice(tick * log.every, (tick + 1) * log.every)).any():
            return


# The result ------------------------------------------------------------------------------------------------------


def _roll_pitch_yaw(rotation: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw (*n, 3) [rad] of rotations (*n, 3, 3) = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])
    pitch = -np.arcsin(np.clip(rotation[..., 2, 0], -0.999999, 0.999999))
    return np.stack([roll, pitch, np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])], axis=-1)


def _zmp(weight: np.ndarray, corner: np.ndarray, last: np.ndarray | None, trunk: np.ndarray) -> np.ndarray:
    """Centre of the vertical forces (8,) at the corners (8, 3); the last one while nothing is loaded [m]."""
    total = weight.sum()
    if total > 1.0:
        return weight @ corner[:, :2] / total
    return trunk[:2] if last is None else last


def _status(log: _Log, rows: slice) -> np.ndarray:
    """Status of every tick, by the definitions of `statistics.update`."""
    height = _pelvis_height(log.xpos[rows])
    with np.errstate(invalid="ignore"):
        tilt = np.abs(_roll_pitch_yaw(log.xmat[rows, TRUNK])[:, :2]).max(axis=1)
        fell = (tilt > float(FALL_TILT)) | (height < FALL_HEIGHT * _pelvis_height(log.xpos[:1]))
    finite = np.isfinite(log.xpos[rows, TRUNK]).all(axis=1) & np.isfinite(log.force[rows]).all(axis=(1, 2))
    airborne = _since_support(log, rows.stop)[rows] * log.dt > AIRBORNE_TIME + 1e-9
    return np.where(~finite, NONFINITE, np.where(fell, FELL, np.where(airborne, AIRBORNE, OK)))


def _since_support(log: _Log, n: int) -> np.ndarray:
    """Ticks since there was any ground force, after each of the first n ticks."""
    with np.errstate(invalid="ignore"):
        supported = log.force[:n, :, 2].sum(axis=1) > TOUCHING
    ticks = np.arange(1, n + 1)
    return ticks - np.maximum.accumulate(np.where(supported, ticks, 0))


def _pelvis_height(xpos: np.ndarray) -> np.ndarray:
    return xpos[..., TRUNK, 2] - xpos[..., _FEET, 2].min(axis=-1)


def _result(world: _World, pilot: _Pilot, log: _Log) -> Walk:
    options = world.options
    status = _status(log, slice(0, log.done * log.every))
    failed = np.flatnonzero(status)
    n = int(failed[0]) + 1 if failed.size else status.size
    walked = -(-n // log.every)
    stats = _statistics(log, n, int(status[n - 1]), options)
    stats |= _margins(world, pilot, log, np.arange(walked if not failed.size else walked - 1))
    kept = Statistics(**{name: _device(value) for name, value in stats.items()})
    if options.trace_every == 0:
        return Walk(kept, None, pilot.state)
    samples = np.arange(
        options.trace_every - 1, walked if not failed.size else walked - 1, options.trace_every
    )
    return Walk(kept, _trace(world, pilot, log, samples), pilot.state)


def _statistics(log: _Log, n: int, status: int, options: Options) -> dict[str, np.ndarray]:
    """Of the first n ticks, by the definitions of `statistics.update`."""
    vertical = log.force[:n, :, 2].reshape(n, 2, 4).sum(axis=2)
    place = log.xpos[:n, _FEET, :2]
    with np.errstate(invalid="ignore"):
        loaded = vertical > LOADED
        tilt = np.abs(_roll_pitch_yaw(log.xmat[:n, TRUNK])[:, :2])
    landed = loaded & ~np.concatenate([np.ones((1, 2), bool), loaded[:-1]])
    since = np.maximum.accumulate(np.where(landed, np.arange(n)[:, None], 0), axis=0)
    anchor = np.take_along_axis(place, since[..., None], axis=0)
    slip = np.where(loaded, np.linalg.norm(place - anchor, axis=-1), 0.0)
    touchdown, impulse = _touchdowns(vertical, landed, since, options.dt)
    return {
        "status": np.array(status, np.int32),
        "end_time": np.array(n * options.dt),
        "peak_roll_pitch": np.nanmax(tilt, axis=0),
        "peak_foot_force": np.nanmax(vertical, axis=0),
        "peak_slip": np.nanmax(slip, axis=0),
        "peak_touchdown_force": touchdown.max(axis=0),
        "peak_touchdown_impulse": impulse.max(axis=0),
        "support_time": np.array((n - _since_support(log, n)[-1]) * options.dt),
        "touch_time": np.where(since[-1] > 0, (since[-1] + 1) * options.dt, -1.0),
        "touch_impulse": impulse[-1],
        "anchor": anchor[-1],
        "loaded": loaded[-1],
        "p_world_trunk": log.xpos[n - 1, TRUNK],
        "pelvis_height": _pelvis_height(log.xpos[:1])[0],
    }


def _touchdowns(
    vertical: np.ndarray, landed: np.ndarray, since: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Vertical force while a foot touches down, else 0, and its integral since the foot was loaded (n, 2)."""
    age = np.arange(len(vertical))[:, None] - since
    ever = np.maximum.accumulate(landed, axis=0)
    force = np.where(ever & (age * dt < TOUCHDOWN - 1e-9), np.nan_to_num(vertical), 0.0)
    total = np.cumsum(force * dt, axis=0)
    before = np.take_along_axis(total - force * dt, since, axis=0)
    return force, np.where(ever, total - before, 0.0)


def _margins(world: _World, pilot: _Pilot, log: _Log, ticks: np.ndarray) -> dict[str, Any]:
    """What the control ticks `ticks` leave, by the definitions of `statistics.update_margins`."""
    rows = (ticks + 1) * log.every - 1
    loaded = log.force[rows, :, 2].reshape(-1, 2, 4).sum(axis=2) > LOADED
    corner = _device(log.site[rows][:, _CORNER_SITES][..., :2])
    active, zmp = jnp.repeat(jnp.asarray(loaded), 4, axis=1), _device(_zmps(log, rows))
    legs, asked = pilot.asked(ticks)
    return {
        "zmp_margin": jnp.min(jax.vmap(support.margin)(corner, active, zmp), initial=jnp.inf),
        "reach_margin": jnp.min(
            jax.vmap(reach_margin, (None, 0))(world.robot, asked.position), initial=jnp.inf
        ),
        "out_of_reach_time": (legs != 0).any(axis=1).sum() * world.options.control_dt,
    }


def _zmps(log: _Log, rows: np.ndarray) -> np.ndarray:
    """Centre of pressure (n, 2) at physics ticks `rows`, the last one while the robot is in the air [m]."""
    zmp: list[np.ndarray] = []
    corner, force = log.site[rows][:, _CORNER_SITES], log.force[rows]
    for place, push, trunk in zip(corner, force, log.xpos[rows, TRUNK], strict=True):
        zmp.append(_zmp(push[:, 2], place, zmp[-1] if zmp else None, trunk))
    return np.reshape(zmp, (-1, 2))


def _trace(world: _World, pilot: _Pilot, log: _Log, ticks: np.ndarray) -> Sample:
    """A sample after each of the control ticks `ticks`."""
    rows = (ticks + 1) * log.every - 1
    corner, force = log.site[rows][:, _CORNER_SITES], log.force[rows]
    faults = world.scenario.sensors
    gap = (corner[..., 2] - heights(world.scenario.terrain, corner[..., :2])).reshape(-1, 2, 4)
    fields = {
        "time": (ticks + 1) * world.options.control_dt,
        "p_world_trunk": log.xpos[rows, TRUNK],
        "roll_pitch_yaw": _roll_pitch_yaw(log.xmat[rows, TRUNK]),
        "p_world_sole": log.site[rows][:, _SOLE_SITES],
        "foot_force": force.reshape(-1, 2, 4, 3).sum(axis=2),
        "corner_force": force[..., 2].reshape(-1, 2, 4),
        "zmp_world": _zmps(log, rows),
        "switch": (gap <= np.asarray(faults.delta_z)) & (np.asarray(faults.stuck_open) < 0.5),
        "torque": log.torque[ticks].reshape(-1, 2, 6),
        "qpos": log.qpos[ticks],
    }
    return Sample(**{name: _device(value) for name, value in fields.items()}, targets=pilot.asked(ticks)[1])


def _device(value: Any) -> Array:
    """As JAX holds it: its default float type, if it is a float."""
    return jnp.asarray(value, jnp.result_type(float) if value.dtype.kind == "f" else None)

"""C MuJoCo on the host: a cross-check that shares no physics with the other engines. `Options(contact="c_mujoco")`.

Contacts are MuJoCo's own (`c_world`), between the soles and level boxes. Its servos have no speed limit, and its
contacts are linear springs and dampers (`solref`) without a slip speed. MuJoCo moves one robot after the other, many in
lockstep; all else is done for all of them at once, by the program of the other engines (`PureSimulation.conclude`).
"""

import jax
import mujoco
import numpy as np

from jaxbiped.robot import RobotParams
from jaxbiped.robot.layout import BIPED
from jaxbiped.sim.mjx_adapter import TRUNK
from jaxbiped.sim.options import Options
from jaxbiped.sim.physics import c_world
from jaxbiped.sim.physics.c_world import heights
from jaxbiped.sim.scenario import Scenario
from jaxbiped.sim.servo import Reference

_FEET = BIPED.feet.tolist()
_SOLE_SITES, _CORNER_SITES = [0, 5], [1, 2, 3, 4, 6, 7, 8, 9]
"""Numbers of the sites of the soles and of their corners, foot by foot."""
Fields = dict[str, np.ndarray]
"""Fields of a record, by name."""


class _Lane:
    """One robot, and the places in memory where MuJoCo leaves what is read at every tick."""

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
        """Put the load on."""
        c_world.attach(self.model, self.payload, self.payload_model)

    def detach(self) -> None:
        """Take the load off again."""
        c_world.detach(self.model, self.unloaded)

    def set_push(self, share: float) -> None:
        """Apply a share of the force of the push, on the trunk's own center of mass."""
        force = share * self.push
        arm = self.xmat[TRUNK] @ (self.trunk_com - self.model.body_ipos[TRUNK])
        self.data.xfrc_applied[TRUNK] = np.concatenate([force, np.cross(arm, force)])


class Robots:
    """Robots side by side, each in its own scenario and with its own model of the contact."""

    def __init__(
        self, robot: RobotParams, scenarios: Scenario, options: Options, contacts: list[str], qpos: np.ndarray
    ):
        """Put the robots where they start.

        Args:
            robot: nominal.
            scenarios: with a leading axis.
            options: those of the simulation.
            contacts: each robot's model of the contact, of `c_world.CONTACTS`.
            qpos: where each starts, at rest (n, nq).
        """
        self.robot, self.options = robot, options
        self.scenarios: Scenario = jax.tree.map(lambda leaf: np.asarray(leaf, float), scenarios)
        n = len(qpos)
        self.lanes = [
            _Lane(
                robot, jax.tree.map(lambda leaf, i=i: leaf[i], self.scenarios), options, contacts[i], qpos[i]
            )
            for i in range(n)
        ]
        self.xpos, self.xmat = self._all("xpos"), self._all("xmat")
        self.site, self.force = self._all("site"), np.zeros((n, 8, 3))
        self.qpos, self.qvel, self.torque = np.array(qpos, float), np.zeros((n, BIPED.nv)), np.zeros((n, 12))
        self.groups = self._by_contact(contacts)
        payload, push = self.scenarios.payload, self.scenarios.push
        self.attach_time = np.where(payload.mass > 0.0, payload.time, np.inf)
        self.detach_time = np.where(payload.mass > 0.0, payload.end, np.inf)
        self.push_start, self.push_end = push.start, push.start + push.length
        self.kp = np.stack([lane.model.actuator_gainprm[:, 0] for lane in self.lanes])
        self.kv = -np.stack([lane.model.actuator_biasprm[:, 2] for lane in self.lanes])
        gain = self.scenarios.errors.gain_scale.reshape(n, 12)
        self.ki = np.asarray(robot.servo.ki, float).ravel() * gain
        self.integral = np.zeros((n, 12))
        self.speed_limit = np.asarray(robot.servo.speed_limit, float).ravel()

    def _all(self, name: str) -> np.ndarray:
        return np.stack([getattr(lane, name) for lane in self.lanes])

    def _by_contact(self, contacts: list[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Lanes of every model of the contact, and room for the readings of their sensors."""
        self.readings: list[np.ndarray] = [np.empty(0)] * len(contacts)
        groups = {}
        for contact in dict.fromkeys(contacts):
            lanes = np.flatnonzero([one == contact for one in contacts])
            rows = np.stack([self.lanes[i].readings for i in lanes])
            groups[contact] = lanes, rows
            for i, row in zip(lanes, rows, strict=True):
                self.readings[i] = row
        return groups

    def control_tick(self, number: int, reference: Reference, walking: np.ndarray) -> tuple[Fields, Fields]:
        """`control_every` physics ticks under one reference that moves on.

        Fields of `Physics` after each tick, and of what it has `Seen` at its start, (n, ticks, ...).

        The setpoint kp^-1 (kp q + kv qd + ff + ki integral) makes MuJoCo's position actuator the robot's servo.

        Args:
            number: of the first physics tick.
            reference: of every robot's servos, with a leading axis.
            walking: which robots go on.
        """
        n, dt = len(self.lanes), self.options.dt
        angle, speed, torque = (
            np.asarray(a, float).reshape(n, 12)
            for a in (reference.angle, reference.speed, reference.feed_forward)
        )
        ctrl = angle + (self.kv * np.clip(speed, -self.speed_limit, self.speed_limit) + torque) / self.kp
        ticks = []
        for tick in range(number, number + self.options.control_every):
            self._disturb(tick * dt, walking)
            late = self.ki * self.integral / self.kp
            self.integral = self.integral + dt * (angle - self.qpos[:, BIPED.leg_coordinates])
            self._step(ctrl + late, walking)
            ticks.append((self._physics(tick + 1), self._seen()))
            angle, ctrl = angle + dt * speed, ctrl + dt * speed
        return jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *ticks)

    def _step(self, ctrl: np.ndarray, walking: np.ndarray) -> None:
        """One tick; MuJoCo leaves kinematics and forces of its start."""
        for i in np.flatnonzero(walking).tolist():
            lane, data = self.lanes[i], self.lanes[i].data
            lane.ctrl[:] = ctrl[i]
            mujoco.mj_step(lane.model, data)
            self.xpos[i], self.xmat[i], self.site[i] = lane.xpos, lane.xmat, lane.site
            self.readings[i][:] = lane.readings
            self.qpos[i], self.qvel[i], self.torque[i] = data.qpos, data.qvel, data.actuator_force
        sole, turn = self.site[:, _SOLE_SITES], self.xmat[:, _FEET]
        for contact, (lanes, rows) in self.groups.items():
            self.force[lanes] = c_world.corner_forces(self.robot, contact, rows, sole[lanes], turn[lanes])

    def _disturb(self, time: float, walking: np.ndarray) -> None:
        dt = self.options.dt
        for i in np.flatnonzero(walking & (time + 0.5 * dt >= self.attach_time)):
            self.lanes[i].attach()
            self.attach_time[i] = np.inf
        for i in np.flatnonzero(walking & (time + 0.5 * dt >= self.detach_time)):
            self.lanes[i].detach()
            self.detach_time[i] = np.inf
        pushed = walking & (self.push_start - dt < time) & (time < self.push_end + dt)
        for i in np.flatnonzero(pushed):
            overlap = min(time + dt, self.push_end[i]) - max(time, self.push_start[i])
            self.lanes[i].set_push(max(float(overlap) / dt, 0.0))

    def _physics(self, ticks: int) -> Fields:
        n = len(self.lanes)
        return {
            "tick": np.full(n, ticks, np.int32),
            "qpos": self.qpos.copy(),
            "qvel": self.qvel.copy(),
            "integral": self.integral.reshape(n, 2, 6),
            "pressed": np.zeros((n, 2, 4)),
        }

    def _seen(self) -> Fields:
        n, corner = len(self.lanes), self.site[:, _CORNER_SITES]
        return {
            "p_world_trunk": self.xpos[:, TRUNK].copy(),
            "rot_world_trunk": self.xmat[:, TRUNK].copy(),
            "p_world_foot": self.xpos[:, _FEET],
            "rot_world_foot": self.xmat[:, _FEET],
            "p_world_corner": corner.reshape(n, 2, 4, 3),
            "gap": (corner[..., 2] - heights(self.scenarios.terrain, corner[..., :2])).reshape(n, 2, 4),
            "force": self.force.reshape(n, 2, 4, 3).copy(),
            "torque": self.torque.reshape(n, 2, 6).copy(),
        }

"""Longest physics tick for a robot's servos on its ground: the tick linearized, on the host.

Ground, stops and the servos' damping are taken implicitly and bound no tick. What is left is the servos' stiffness,
which acts at the start of a tick unless `Options.implicit` is `linear`, against the inertia that it moves: of a leg in
the air, whose foot is light, or of the robot that stands.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from jaxbiped.checked import Refusal
from jaxbiped.kinematics import GRAVITY
from jaxbiped.planner import is_concrete
from jaxbiped.robot import SIDE_NAMES, RobotParams
from jaxbiped.robot.layout import BASE_DOFS
from jaxbiped.sim.model import CORNER_NAMES, build_model
from jaxbiped.sim.options import DAMPING, LINEAR

LONGEST_DT = 0.01
"""Longest physics tick there is [s]."""
FASTEST_GROWTH = 20.0
"""Growth of a small disturbance that may be physics [1/s]; that of a tick too long is faster by orders of magnitude."""
_BEND = 0.6
"""Bend of the knees in the posture that is examined [rad]."""


@dataclass(frozen=True)
class _Linear:
    """A robot at rest: matrices over qvel."""

    inertia: np.ndarray
    spring: np.ndarray
    """Stiffness of the servos, explicit or implicit."""
    damping: np.ndarray
    """Damping of the servos, implicit."""
    ground: np.ndarray
    """Stiffness of the ground under all corners, implicit."""

    is_linear: bool
    """Whether the stiffness of the servos is implicit."""

    def grows(self, dt: float) -> bool:
        """Tell whether a small disturbance grows with ticks of dt [s], in the air or on the ground."""
        return max(self._growth(dt, 0.0), self._growth(dt, 1.0)) > FASTEST_GROWTH

    def _growth(self, dt: float, pressed: float) -> float:
        implicit = pressed * self.ground + (self.spring if self.is_linear else 0.0)
        late = np.linalg.inv(self.inertia + dt * self.damping + dt * dt * implicit)
        by_place = -dt * late @ (self.spring + pressed * self.ground)
        by_speed = late @ self.inertia
        unit = np.eye(len(late))
        tick = np.block([[unit + dt * by_place, dt * by_speed], [by_place, by_speed]])
        return float(np.log(np.abs(np.linalg.eigvals(tick)).max()) / dt)


def largest_stable_dt(
    robot: RobotParams, sinkage: float, gain_scale: float = 1.0, implicit: str = DAMPING
) -> float:
    """Longest stable physics tick [s], at most LONGEST_DT.

    Args:
        robot: one robot, without a batch axis.
        sinkage: how deep it sinks into the ground [m].
        gain_scale: factor on the gains of the servos.
        implicit: see `Options.implicit`.
    """
    system = _linear(robot, sinkage, gain_scale, implicit)
    if not system.grows(LONGEST_DT):
        return LONGEST_DT
    low, high = 0.0, LONGEST_DT
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if system.grows(middle) else (middle, high)
    return low


def require_stable_dt(
    robot: RobotParams, dt: float, sinkage: float, gain_scale: float = 1.0, implicit: str = DAMPING
) -> None:
    """Refuse a physics tick that is too long for a robot's servos; robots that are traced are not judged.

    Args:
        robot: one robot, without a batch axis.
        dt: the tick [s].
        sinkage: how deep the robot sinks into the ground [m].
        gain_scale: factor on the gains of the servos; gains that are not finite are not judged.
        implicit: see `Options.implicit`.

    Raises:
        ValueError: naming the tick and the longest one allowed.
    """
    if not (is_concrete(robot) and np.isfinite(gain_scale * np.asarray(robot.servo.kp)).all()):
        return
    if not _linear(robot, sinkage, gain_scale, implicit).grows(dt):
        return
    longest = largest_stable_dt(robot, sinkage, gain_scale, implicit)
    raise Refusal(
        f"dt: got {dt:g} s, allowed: <= {0.99 * longest:.2g} s, where the servos of robot {robot.name!r} are stable"
    )


def _linear(robot: RobotParams, sinkage: float, gain_scale: float, implicit: str) -> _Linear:
    model = build_model(robot)
    data = mujoco.MjData(model)
    for side in SIDE_NAMES:
        for joint, angle in (("hip_pitch", -0.5 * _BEND), ("knee", _BEND), ("ankle_pitch", -0.5 * _BEND)):
            data.joint(f"{side}_{joint}").qpos = angle
    mujoco.mj_forward(model, data)
    inertia, jacobian = np.zeros((model.nv, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    ground = np.zeros_like(inertia)
    stiffness = float(robot.total_mass) * GRAVITY / (8.0 * sinkage)
    for side in SIDE_NAMES:
        for corner in CORNER_NAMES:
            mujoco.mj_jacSite(model, data, jacobian, None, model.site(f"{side}_{corner}").id)
            ground += stiffness * np.outer(jacobian[2], jacobian[2])
    return _Linear(
        inertia,
        _on_joints(gain_scale * np.asarray(robot.servo.kp, float)),
        _on_joints(gain_scale * np.asarray(robot.servo.kv, float)),
        ground,
        implicit == LINEAR,
    )


def _on_joints(gains: np.ndarray) -> np.ndarray:
    return np.diag(np.concatenate([np.zeros(BASE_DOFS), gains.reshape(-1)]))

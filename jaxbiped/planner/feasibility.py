"""Can this robot walk this plan? ZMP, friction, torque, speed, knee of the multibody model (khadiv 2.2)."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxbiped import runtime
from jaxbiped.kinematics import Motion, MotionState, Wrench, body, dynamics, joint_angles
from jaxbiped.planner import support
from jaxbiped.planner.checks import is_concrete
from jaxbiped.planner.targets import DOUBLE_SUPPORT, Phase, Plan, Targets, TaskSpace, at
from jaxbiped.robot import KNEE, RobotParams, nameless

BLOCK = 512
"""Instants that are judged at once."""


class Feasibility(eqx.Module):
    """A plan at one instant (or, with a leading axis, at many)."""

    time: Float[Array, "*n"]
    """Time in the plan [s]."""
    zmp: Float[Array, "*n 2"]
    """Zero moment point on the ground, world x and y [m]."""
    zmp_margin: Float[Array, "*n"]
    """Distance of the ZMP from the edge of the support polygon, negative outside [m]."""
    support_lower: Float[Array, "*n 2"]
    """Lower corner of the support polygon's bounding box [m]."""
    support_upper: Float[Array, "*n 2"]
    """Upper corner of the support polygon's bounding box [m]."""
    com: Float[Array, "*n 3"]
    """Center of mass, world [m]."""
    ground_force: Float[Array, "*n 3"]
    """Total force the ground must give [N]."""
    angle: Float[Array, "*n 2 6"]
    """Joint angles [rad]."""
    speed: Float[Array, "*n 2 6"]
    """Joint speeds [rad/s]."""
    torque: Float[Array, "*n 2 6"]
    """Joint torques [N m]; in double support the feet share the ground wrench by the ZMP."""
    torque_share: Float[Array, "*n"]
    """Largest joint torque over its limit."""
    speed_share: Float[Array, "*n"]
    """Largest joint speed over its limit."""
    ik_status: Int[Array, "*n 2"]
    """Status of the inverse kinematics, each leg."""

    @property
    def friction(self) -> Float[Array, "*n"]:
        """Friction coefficient the plan needs."""
        horizontal = self.ground_force[..., :2]
        return jnp.sqrt(jnp.sum(horizontal * horizontal, -1) + 1e-12) / self.ground_force[..., 2]

    @property
    def knee(self) -> Float[Array, "*n 2"]:
        """Bend of each knee, the distance from the straight leg [rad]."""
        return self.angle[..., KNEE]


def motion_of(robot: RobotParams, task: Callable[[Float[Array, ""]], TaskSpace]) -> Motion:
    """The motion of all links that follows a function time -> TaskSpace, pelvis upright and soles level."""

    def motion(t: Float[Array, ""]):
        here: TaskSpace = task(t)
        angle, _ = joint_angles(robot, here.sole - here.pelvis)
        return body.pose(robot, here.pelvis, jnp.eye(3, dtype=angle.dtype), angle), angle

    return motion


def zmp_of(wrench: Wrench, height: Float[Array, ""] | float = 0.0) -> Float[Array, "2"]:
    """Point (x, y) at `height` [m] about which the ground wrench has no horizontal moment [m]."""
    (fx, fy, fz), (mx, my, _) = wrench.force, wrench.moment
    return jnp.stack([(height * fx - my) / fz, (height * fy + mx) / fz])


def share_between_feet(robot: RobotParams, task: TaskSpace, phase: Phase, wrench: Wrench) -> Wrench:
    """Split the ground wrench between the feet by the place of the ZMP between their centers.

    In single support the stance foot has it all. The two parts always add up to the whole; both feet press
    with the same offset from their centers.
    """
    centre = task.sole[:, :2] + robot.p_sole_corner[:, :, :2].mean(axis=1)
    zmp = zmp_of(wrench)
    across = centre[0] - centre[1]
    of_left = jnp.clip(jnp.dot(zmp - centre[1], across) / jnp.dot(across, across), 0.0, 1.0)
    of_left = jnp.where(phase.support == DOUBLE_SUPPORT, of_left, phase.swing.astype(zmp.dtype))
    share = jnp.stack([of_left, 1.0 - of_left])
    point = centre + zmp - share @ centre
    at = jnp.concatenate([point, jnp.zeros((2, 1), zmp.dtype)], axis=1)
    force = share[:, None] * wrench.force
    twist = wrench.moment[2] - (zmp[0] * wrench.force[1] - zmp[1] * wrench.force[0])
    moment = jnp.cross(at, force).at[:, 2].add(share * twist)
    return Wrench(force, moment)


class Frozen(eqx.Module):
    """The motion through some targets: at time 0 it has their position, velocity and acceleration."""

    targets: Targets
    """Targets at one instant."""

    def task(self, t: Float[Array, ""]) -> TaskSpace:
        """Soles and pelvis, t [s] later."""
        orders = (self.targets.position, self.targets.velocity, self.targets.acceleration)
        return jax.tree.map(lambda p, v, a: p + v * t + 0.5 * a * t * t, *orders)

    def phase(self, t: Float[Array, ""]) -> Phase:
        """The phase of the targets."""
        return self.targets.phase


def instant(robot: RobotParams, gait: Plan | Frozen, t: Float[Array, ""]) -> Feasibility:
    """Feasibility of a gait at time t [s]."""
    state: MotionState = dynamics.evaluate(robot, motion_of(robot, gait.task), t)
    task, phase, wrench = gait.task(t), gait.phase(t), state.ground_wrench
    points, active = support.corners(robot, task), support.loaded(phase)
    torque = dynamics.joint_torques(robot, state, share_between_feet(robot, task, phase, wrench))
    lower, upper = support.box(points, active)
    zmp = zmp_of(wrench)
    return Feasibility(
        time=t,
        zmp=zmp,
        zmp_margin=support.margin(points, active, zmp),
        support_lower=lower,
        support_upper=upper,
        com=body.com(robot, state.body),
        ground_force=wrench.force,
        angle=state.angle,
        speed=state.speed,
        torque=torque,
        torque_share=jnp.max(jnp.abs(torque) / robot.servo.torque_limit),
        speed_share=jnp.max(jnp.abs(state.speed) / robot.servo.speed_limit),
        ik_status=joint_angles(robot, task.sole - task.pelvis)[1],
    )


def feasibility(robot: RobotParams, gait: Plan, times: Float[Array | np.ndarray, " n"]) -> Feasibility:
    """Feasibility of a gait at many times [s], as a leading axis. Differentiable in robot and gait."""
    found = of_targets(robot, targets_at(gait, times))
    return eqx.tree_at(lambda f: f.time, found, jnp.asarray(times))


def of_targets(robot: RobotParams, targets: Targets) -> Feasibility:
    """Feasibility of a gait at the instants of its targets, which have a leading axis; their `time` is 0.

    One program judges every gait of every robot at any number of instants: where all is known, block by block.
    """
    if not is_concrete(robot, targets):
        return judged(robot, targets)
    return jax.tree.map(jnp.asarray, in_blocks(judged, robot, targets))


def in_blocks(
    function: Callable[[RobotParams, Targets], PyTree], robot: RobotParams, targets: Targets
) -> PyTree:
    """A compiled function of targets, which have a leading axis, called with BLOCK of them at a time; on the host."""
    return runtime.in_blocks(partial(function, nameless(robot)), BLOCK, targets)


def targets_at(gait: Plan, times: Float[Array | np.ndarray, " n"]) -> Targets:
    """Targets of a plan at many times [s], as a leading axis; where all is known, block by block."""
    if not is_concrete(gait, times):
        return _targets(gait, times)
    return jax.tree.map(jnp.asarray, runtime.in_blocks(partial(_targets, gait), BLOCK, times))


@runtime.jit
def _targets(gait: Plan, times: Float[Array | np.ndarray, " n"]) -> Targets:
    return jax.vmap(lambda t: at(gait, t))(jnp.asarray(times))


@runtime.jit
def judged(robot: RobotParams, targets: Targets) -> Feasibility:
    """Feasibility of a gait at the instants of its targets, see `of_targets`."""
    return jax.vmap(lambda one: instant(robot, Frozen(one), jnp.zeros_like(one.time)))(targets)


def sample_times(gait: Plan, n: int = 1000) -> Float[Array, " n"]:
    """Times that cover a walk from rest to rest, shifted off the phase changes [s]."""
    return (jnp.arange(n) + 0.5) / n * gait.duration

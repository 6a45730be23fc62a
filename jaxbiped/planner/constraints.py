"""Constraints that a plan breaks, when and by how much (khadiv section 2.2); such a plan is refused when made.

Every support phase is sampled, its ends too. A walk's steps repeat: what is special about its first and last steps dies
out by a factor of 4 or more from step to step, so that of a long walk only the first and last CHECKED_STEPS are judged.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbiped import checked, runtime
from jaxbiped.checked import Quantity
from jaxbiped.kinematics import OK, STATUS_TEXT, joint_angles
from jaxbiped.planner.checks import GaitError
from jaxbiped.planner.feasibility import Feasibility, in_blocks, judged, targets_at
from jaxbiped.planner.targets import Plan, Targets, TaskSpace
from jaxbiped.robot import JOINT_NAMES, KNEE, SIDE_NAMES, RobotParams

FRICTION = 0.8
"""Friction coefficient of the ground that a plan is made for, unless another one is given: that of `Scenario.flat`."""
MIN_KNEE = 0.1
"""Least bend of a knee in a plan [rad]; the straight leg, 0, cannot move the foot along itself."""
CHECKED_STEPS = 8
"""Number of steps that are judged from the start, and to the end, of a walk."""
OR_ALLOW = "; or say allow_infeasible=True"
"""End of a refusal: how to let the plan through all the same."""

_SINGLE, _DOUBLE, _REST = 64, 32, 100
"""Numbers of samples of a single support, of a double support, and of start and stop."""
_EDGE = 1e-3
"""Distance of the first and last samples of a support phase from its ends, as a fraction of the phase."""


@dataclass(frozen=True)
class Violation:
    """A constraint that a plan breaks, where it breaks it most."""

    constraint: str
    """`ZMP`, `friction`, `torque`, `speed` or `knee`."""
    time: float
    """Time of the worst violation [s]."""
    value: float
    """ZMP margin [m], friction coefficient, torque [N m], speed [rad/s] or bend of the knee [rad]."""
    limit: float
    """Limit that is allowed, in the same unit."""
    got: str
    """Value that the plan asks for, in words."""
    allowed: str
    """Allowed range, in words."""

    def words(self, robot: RobotParams, gait: Plan) -> str:
        """Describe the violation in one line for a person."""
        when = f"at t = {self.time:.3f} s of {float(gait.duration):.3f} s on robot {robot.name!r}"
        return f"got {self.got} {when}, allowed: {self.allowed}"


def violations(robot: RobotParams, gait: Plan, friction: float = FRICTION) -> list[Violation]:
    """Find the constraints of khadiv section 2.2 that a plan breaks, each where it breaks it most.

    Args:
        robot: whose limits count; its values must be known, not traced.
        gait: the plan, the same.
        friction: coefficient of the ground.
    """
    return _violations(_Sampled.of(robot, gait), friction)


def require_walkable(robot: RobotParams, gait: Plan, friction: float, allow_infeasible: bool) -> None:
    """Raise a GaitError if a foot is out of reach or, unless that is allowed, the plan breaks a constraint."""
    sampled = _Sampled.of(robot, gait)
    _require_reach(robot, gait, sampled)
    for broken in [] if allow_infeasible else _violations(sampled, friction):
        raise GaitError(f"gait: {broken.words(robot, gait)}{OR_ALLOW}")


def require_reach(robot: RobotParams, gait: Plan) -> None:
    """Raise a GaitError if a foot target of the gait lies beyond the leg's reach or joint ranges."""
    _require_reach(robot, gait, _Sampled.of(robot, gait))


def check_arguments(friction: float, allow_infeasible: object) -> tuple[float, bool]:
    """Return both arguments of `make` and `preset`, or raise a GaitError."""
    friction = Quantity("", 0.01, 5.0).check("friction", friction, GaitError)
    return friction, checked.Flag().check("allow_infeasible", allow_infeasible, GaitError)


@dataclass(frozen=True)
class _Sampled:
    """A plan at instants that cover it, on the host."""

    robot: RobotParams
    time: np.ndarray
    """Sample times [s]."""
    step: np.ndarray
    targets: Targets
    n_steps: int

    @classmethod
    def of(cls, robot: RobotParams, gait: Plan) -> "_Sampled":
        time, step = _times(gait)
        targets = jax.tree.map(np.asarray, targets_at(gait, time))
        return cls(robot, time, step, targets, int(gait.timing.n_steps))

    def judged(self) -> tuple[np.ndarray, Feasibility]:
        """Times [s], and the plan's feasibility there."""
        rows = np.flatnonzero((self.step < CHECKED_STEPS) | (self.step >= self.n_steps - CHECKED_STEPS))
        some = jax.tree.map(lambda leaf: leaf[rows], self.targets)
        return self.time[rows], in_blocks(judged, self.robot, some)

    def statuses(self) -> np.ndarray:
        """Status of each leg's inverse kinematics at all times."""
        return in_blocks(_statuses, self.robot, self.targets)


def _times(gait: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Sample times [s] and the number of the step at each: all support phases, and more of start and stop."""
    timing, duration = gait.timing, np.asarray(gait.duration)
    first, T_s, T_c = (float(t) for t in (timing.first_liftoff, timing.T_s, timing.T_c))
    number = np.arange(int(timing.n_steps))
    liftoff = first + T_c * number[:, None]
    single, double = (np.linspace(_EDGE, 1.0 - _EDGE, n) for n in (_SINGLE, _DOUBLE))
    steps = np.concatenate([liftoff + T_s * single, liftoff + T_s + (T_c - T_s) * double], axis=1)
    start = np.concatenate([np.linspace(0.0, first, _REST), first - (T_c - T_s) * double])
    stop = np.linspace(liftoff[-1, 0] + T_s, float(duration), _REST)
    time = np.concatenate([start, steps.ravel(), stop]).clip(0.0, float(duration))
    sizes = [len(start), *(len(steps[0]) for _ in number), len(stop)]
    step = np.repeat(np.pad(number, 1, mode="edge"), sizes)
    return time.astype(duration.dtype), step


@runtime.jit
def _statuses(robot: RobotParams, targets: Targets) -> Int[Array, "n 2"]:
    def one(task: TaskSpace) -> Int[Array, "2"]:
        return joint_angles(robot, task.sole - task.pelvis)[1]

    return jax.vmap(one)(targets.position)


def _require_reach(robot: RobotParams, gait: Plan, sampled: _Sampled) -> None:
    status = sampled.statuses()
    for i, side in np.argwhere(status != OK):
        raise GaitError(
            f"gait: got a {SIDE_NAMES[side]} foot {STATUS_TEXT[status[i, side]]} at t = {sampled.time[i]:.3f} s "
            f"of {float(gait.duration):.3f} s on robot {robot.name!r}, "
            "allowed: every foot position within reach and joint range"
        )


def _violations(sampled: _Sampled, friction: float) -> list[Violation]:
    """Find the violations, in the order in which the paper lists the constraints."""
    time, judged = sampled.judged()
    forward, left, up = judged.ground_force.T
    needed = np.where(up > 0.0, np.hypot(forward, left) / np.where(up > 0.0, up, 1.0), np.inf)
    servo = sampled.robot.servo
    found = [
        _worst(time, "ZMP", judged.zmp_margin, 0.0, _zmp),
        _worst(time, "friction", -needed, -friction, _friction),
        _worst(time, "torque", -np.abs(judged.torque), -np.asarray(servo.torque_limit), _of_joint("N m")),
        _worst(time, "speed", -np.abs(judged.speed), -np.asarray(servo.speed_limit), _of_joint("rad/s")),
        _worst(time, "knee", judged.angle[..., KNEE], MIN_KNEE, _knee),
    ]
    return [violation for violation in found if violation is not None]


Words = Callable[[str, float, float, tuple[int, ...]], tuple[str, str]]
"""Function (name of the constraint, value, limit, place) -> (what was got, what is allowed), in words."""


def _worst(
    time: np.ndarray,
    name: str,
    value: Float[Array | np.ndarray, "..."] | float,
    least: Float[Array | np.ndarray, "..."] | float,
    words: Words,
) -> Violation | None:
    """Find where value >= least is broken by the largest fraction; upper bounds come with a minus sign."""
    value, least = np.broadcast_arrays(np.asarray(value, float), np.asarray(least, float))
    scale = np.where((least != 0.0) & np.isfinite(least), np.abs(least), 1.0)
    short = np.nan_to_num((least - value) / scale, nan=np.inf)
    place = tuple(int(i) for i in np.unravel_index(np.argmax(short), short.shape))
    if short[place] <= 0.0:
        return None
    sign = -1.0 if least[place] < 0.0 else 1.0
    worst, limit = sign * float(value[place]), sign * float(least[place])
    return Violation(name, float(time[place[0]]), worst, limit, *words(name, worst, limit, place[1:]))


def _zmp(name: str, margin: float, limit: float, place: tuple[int, ...]) -> tuple[str, str]:
    return f"a ZMP {-margin:.4f} m outside the support polygon", "inside it (margin >= 0 m)"


def _friction(name: str, needed: float, limit: float, place: tuple[int, ...]) -> tuple[str, str]:
    got = "a ground that pulls the robot down" if np.isinf(needed) else f"a needed friction of {needed:.3f}"
    return got, f"<= {limit:g}, the ground's"


def _of_joint(unit: str) -> Words:
    def words(name: str, value: float, limit: float, place: tuple[int, ...]) -> tuple[str, str]:
        side, joint = place
        of = f"{SIDE_NAMES[side]} {JOINT_NAMES[joint].replace('_', ' ')}"
        return f"a {of} {name} of {value:.2f} {unit}", f"<= {limit:g} {unit}"

    return words


def _knee(name: str, bend: float, limit: float, place: tuple[int, ...]) -> tuple[str, str]:
    return (
        f"a {SIDE_NAMES[place[0]]} knee bent by {bend:.4f} rad",
        f">= {limit:g} rad (0 is the straight leg)",
    )

"""Refusing gait parameters that cannot be walked, when their values are known (not while being traced)."""

from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbiped import checked, runtime
from jaxbiped.checked import Quantity
from jaxbiped.kinematics import OK, STATUS_TEXT, joint_angles
from jaxbiped.planner.targets import Gait
from jaxbiped.robot import LEFT, RIGHT, SIDE_NAMES, RobotParams

MOST_STEPS = 10_000
"""Longest walk that is planned [steps]."""


class GaitError(checked.Refusal):
    """Gait parameters that cannot be walked: says which, what was got and what is allowed."""


def is_concrete(*trees: Any) -> bool:
    """Whether every leaf has a known value: false under jit, vmap or differentiation."""
    return checked.is_known(trees)


def require_within(record: Any, quantities: Mapping[str, Quantity], where: str = "") -> None:
    """Raise a GaitError unless every parameter of a record is a number within its declared bounds."""
    for name, quantity in quantities.items():
        quantity.check(f"{where}{name}", getattr(record, name), GaitError)


def require(name: str, value: Any, allowed: str, *conditions: Any, unit: str = "s") -> None:
    """Raise a GaitError unless the value is finite and all conditions hold."""
    if not (np.isfinite(value) and all(conditions)):
        raise GaitError(f"{name}: got {float(value):g} {unit}, allowed: {allowed}")


def require_reach(robot: RobotParams, gait: Gait, samples_per_step: int = 50) -> None:
    """Raise a GaitError if a foot target of the gait lies beyond the leg's reach or joint ranges."""
    times = jnp.linspace(0.0, gait.duration, samples_per_step * (gait.timing.n_steps + 2))
    status = np.asarray(_statuses(robot, gait, times))
    for i, side in _failures(status):
        word = STATUS_TEXT[status[i, side]]
        raise GaitError(
            f"gait: got a {SIDE_NAMES[side]} foot {word} at t = {float(times[i]):.3f} s "
            f"of {float(gait.duration):.3f} s on robot {robot.name!r}, "
            "allowed: every foot position within reach and joint range"
        )


def require_steps(n_steps: Any, first_swing: Any) -> tuple[int, int]:
    """Return the number of steps and the first foot as int, or raise a GaitError; NumPy's whole numbers will do."""
    n_steps = checked.whole("n_steps", n_steps, 1, MOST_STEPS, GaitError)
    try:
        return n_steps, checked.whole("first_swing", first_swing, LEFT, RIGHT, GaitError)
    except GaitError:
        got = checked.shown(first_swing)
        raise GaitError(f"first_swing: got {got}, allowed: {LEFT} (left) or {RIGHT} (right)") from None


def _failures(status: np.ndarray) -> Iterable[tuple[int, int]]:
    return ((int(i), int(side)) for i, side in np.argwhere(status != OK))


@runtime.jit
def _statuses(robot: RobotParams, gait: Any, times: Any) -> Any:
    def one(t: Any) -> Any:
        task = gait.task(t)
        return joint_angles(robot, task.sole - task.pelvis)[1]

    return jax.vmap(one)(times)

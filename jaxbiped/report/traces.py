"""Numbers for figures that a trace does not hold outright: plan, commanded ZMP, filtered readings."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbiped.adapt import PayloadReflex
from jaxbiped.planner import PLANNED_STEP, RECOVERY_STEP, REFLEX_STEP, TaskSpace
from jaxbiped.planner.feasibility import of_targets
from jaxbiped.robot import RobotParams
from jaxbiped.score import walked_rows
from jaxbiped.sim import Sample


def thin(trace: Sample, every: int) -> Sample:
    """Every so many-th sample of a trace, up to its end or the fall."""
    rows = slice(0, walked_rows(np.asarray(trace.time)), every)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], trace)


def measured_task(trace: Sample) -> TaskSpace:
    """Measured places of soles and pelvis, with a leading axis."""
    return _task_spaces(trace.p_world_sole, trace.p_world_trunk)


def _task_spaces(sole: np.ndarray | Array, pelvis: np.ndarray | Array) -> TaskSpace:
    return jax.vmap(TaskSpace)(jnp.asarray(sole), jnp.asarray(pelvis))


class Commanded(eqx.Module):
    """Demands on the ground by the commands of a trace; with a leading axis."""

    zmp: Float[Array, "*n 2"]
    """Zero moment point of the commanded motion, world x and y [m]."""
    support_lower: Float[Array, "*n 2"]
    """Lower corner of the support polygon's bounding box [m]."""
    support_upper: Float[Array, "*n 2"]
    """Upper corner of the support polygon's bounding box [m]."""


def commanded(robot: RobotParams, trace: Sample) -> Commanded:
    """ZMP and support of the commanded motion at every sample of a trace; where no stage acts, those of the plan."""
    found = of_targets(robot, trace.targets)  # by the program that judges plans
    return Commanded(found.zmp, found.support_lower, found.support_upper)


def nominal(plan: TaskSpace, trace: Sample, world_shift: float = 0.0, x_shift: float = 0.0) -> TaskSpace:
    """The plan where the robot was walking it; not a number during reflex and recovery.

    A reflex leaves the walk elsewhere than planned. Where it went on is known of the last reflex only; between two of
    them the plan is not a number either.

    Args:
        plan: the gait's task space at the trace's plan times.
        trace: `sim.Sample` with a leading axis.
        world_shift: how far ahead of the plan the walk went on [m].
        x_shift: how far the body is behind the feet since then [m].
    """
    kind = np.asarray(trace.targets.phase.kind)
    seen = np.maximum.accumulate(np.where(kind == PLANNED_STEP, 0, np.arange(1, len(kind) + 1)))
    before, after = seen == 0, seen == seen[-1]
    walked = (kind == PLANNED_STEP) & (before | after)
    forward = np.where(before, 0.0, 1.0)[:, None] * np.eye(3)[0]
    sole = np.asarray(plan.sole) + world_shift * forward[:, None]
    pelvis = np.asarray(plan.pelvis) + (world_shift - x_shift) * forward
    nan = np.where(walked, 0.0, np.nan)
    return _task_spaces(sole + nan[:, None, None], pelvis + nan[:, None])


class Felt(eqx.Module):
    """Filtered readings of the payload stage, computed anew from the samples of a trace."""

    force: np.ndarray
    """Summed vertical foot force [N]."""
    low_passed: np.ndarray
    """Summed vertical foot force, low-passed (elkahlout Eq. 3.7) [N]."""
    weight: np.ndarray
    """The low-passed force that is taken for normal [N]."""
    zmp: np.ndarray
    """ZMP forward of the pelvis [m]."""
    zmp_low_passed: np.ndarray
    """ZMP forward of the pelvis, low-passed (elkahlout Eq. 3.18) [m]."""


def felt(trace: Sample, params: PayloadReflex) -> Felt:
    """Filter foot force and ZMP of a trace with the time constants of the payload stage.

    The controller filters at every tick and the trace has fewer samples, so short peaks count a little otherwise.
    """
    time, force = np.asarray(trace.time, float), np.asarray(trace.foot_force, float)[..., 2].sum(axis=-1)
    zmp, yaw = (
        np.asarray(trace.zmp_world - trace.p_world_trunk[..., :2]),
        np.asarray(trace.roll_pitch_yaw[..., 2]),
    )
    forward = np.cos(yaw) * zmp[..., 0] + np.sin(yaw) * zmp[..., 1]
    low = _low_pass(time, force, float(params.force_time_constant))
    kind = np.asarray(trace.targets.phase.kind)
    read = np.flatnonzero((kind[:-1] == REFLEX_STEP) & (kind[1:] == RECOVERY_STEP)) + 1
    last_read = np.searchsorted(read, np.arange(len(time)), side="right")
    weight = low[np.concatenate([[0], read])][last_read]
    return Felt(force, low, weight, forward, _low_pass(time, forward, float(params.zmp_time_constant)))


def _low_pass(time: np.ndarray, values: np.ndarray, time_constant: float) -> np.ndarray:
    """First-order low-pass; the first value is taken as it is."""
    share = 1.0 - np.exp(-np.diff(time) / time_constant)
    filtered = values.copy()
    for i in range(1, len(values)):
        filtered[i] = filtered[i - 1] + share[i - 1] * (values[i] - filtered[i - 1])
    return filtered

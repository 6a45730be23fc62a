"""The support polygon, and how far inside it a point is."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxbiped.planner.targets import DOUBLE_SUPPORT, Phase, TaskSpace
from jaxbiped.robot import RobotParams


def corners(robot: RobotParams, task: TaskSpace) -> Float[Array, "8 2"]:
    """All eight sole corners seen from above, left foot first [m]; soles level and facing +x."""
    return (task.sole[:, None, :2] + robot.p_sole_corner[..., :2]).reshape(8, 2)


def loaded(phase: Phase) -> Bool[Array, "8"]:
    """Tell which of the eight corners the plan has on the ground."""
    feet = (phase.support == DOUBLE_SUPPORT) | (jnp.arange(2) != phase.swing)
    return jnp.repeat(feet, 4)


def margin(points: Float[Array, "n 2"], active: Bool[Array, " n"], p: Float[Array, "2"]) -> Float[Array, ""]:
    """Distance of a point from the edge of the convex hull of the active points [m], negative outside.

    Outside, it is the largest violation among the edges, a lower bound of the distance. An ordered pair of
    points is an edge of the hull if no active point lies to its right.
    """
    edge = points[None, :] - points[:, None]
    length = jnp.sqrt(jnp.sum(edge * edge, -1) + 1e-18)
    unit = edge / length[..., None]
    to_points = points[None, None, :] - points[:, None, None]
    left_of = unit[..., None, 0] * to_points[..., 1] - unit[..., None, 1] * to_points[..., 0]
    is_edge = (
        jnp.all((left_of >= -1e-6) | ~active, axis=-1) & active[:, None] & active[None, :] & (length > 1e-6)
    )
    to_p = p - points[:, None]
    distance = unit[..., 0] * to_p[..., 1] - unit[..., 1] * to_p[..., 0]
    return jnp.min(jnp.where(is_edge, distance, jnp.inf))


def box(
    points: Float[Array, "n 2"], active: Bool[Array, " n"]
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Lower and upper corner of the active points' bounding box [m]."""
    lower = jnp.min(jnp.where(active[:, None], points, jnp.inf), axis=0)
    upper = jnp.max(jnp.where(active[:, None], points, -jnp.inf), axis=0)
    return lower, upper

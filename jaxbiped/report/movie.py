"""A walk as a moving stick figure, from the side and from behind; needs no graphics card."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.animation import PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxbiped.kinematics import leg
from jaxbiped.robot import RobotParams
from jaxbiped.score import walked_rows
from jaxbiped.sim import Sample

FRAMES_PER_SECOND = 20
COLORS = ("tab:blue", "tab:red")
"""Left and right leg."""


@eqx.filter_jit
def skeleton(robot: RobotParams, qpos: Float[Array, "n 19"]) -> Float[Array, "n 2 8 3"]:
    """Points of each leg in the world [m]: pelvis, hip, knee, ankle, then the sole's corners."""

    def one(q: Float[Array, "19"]) -> Float[Array, "2 8 3"]:
        w, x, y, z = q[3:7]
        rotation = jnp.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

        def points(side: Any, angle: Float[Array, "6"]) -> Float[Array, "8 3"]:
            pose = leg.forward(robot, side, angle)
            corners = pose.p_pelvis_sole + robot.p_sole_corner[side] @ pose.rot_pelvis_sole.T
            joints = pose.p_pelvis_link[jnp.array([0, 3, 5])]
            return jnp.concatenate([jnp.zeros((1, 3), q.dtype), joints, corners]) @ rotation.T + q[:3]

        return jax.vmap(points)(jnp.arange(2), q[7:].reshape(2, 6))

    return jax.vmap(one)(qpos)


def save(robot: RobotParams, trace: Sample, file: Path) -> Path:
    """Write a GIF of a trace, in real time.

    Args:
        robot: nominal.
        trace: samples with a leading axis.
        file: its name ends in .gif.
    """
    time = np.asarray(trace.time, float)[: walked_rows(np.asarray(trace.time))]
    wanted = np.arange(time[0], time[-1], 1.0 / FRAMES_PER_SECOND)
    rows = np.searchsorted(time, wanted)
    points = np.asarray(skeleton(robot, jnp.asarray(np.asarray(trace.qpos)[rows])))
    trunk = np.asarray(trace.p_world_trunk)[rows]
    up = _trunk_top(robot, np.asarray(trace.qpos)[rows])
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    side, behind = figure.subplots(1, 2, width_ratios=(2, 1))
    writer = PillowWriter(fps=FRAMES_PER_SECOND)
    with writer.saving(figure, str(file), dpi=70):
        for i, now in enumerate(time[rows]):
            for axes, across, name in ((side, 0, "x [m]"), (behind, 1, "y [m]")):
                axes.clear()
                _draw(axes, points[i], trunk[i], up[i], across)
                middle = trunk[i, across]
                reach = 1.3 if across == 0 else 0.65
                axes.set(
                    xlim=(middle - reach, middle + reach),
                    ylim=(-0.15, float(robot.height) + 0.2),
                    xlabel=name,
                )
                axes.set_aspect("equal")
            behind.invert_xaxis()  # seen from behind, left is left
            side.set(ylabel="z [m]", title=f"{robot.name}, {now:.2f} s")
            writer.grab_frame()
            figure.set_layout_engine("none")  # laid out once, for the first frame
    return file


def _trunk_top(robot: RobotParams, qpos: np.ndarray) -> np.ndarray:
    """A point on the trunk's axis (n, 3) [m]."""
    w, x, y, z = qpos[:, 3:7].T
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    length = float(robot.height) - float(robot.thigh_length + robot.shank_length + robot.ankle_height)
    return qpos[:, :3] + max(0.3, length) * axis


def _draw(axes: Any, legs: np.ndarray, trunk: np.ndarray, top: np.ndarray, across: int) -> None:
    axes.axhline(0.0, color="0.7", lw=1)
    axes.plot([trunk[across], top[across]], [trunk[2], top[2]], color="0.25", lw=5, solid_capstyle="round")
    for points, color in zip(legs, COLORS, strict=True):
        axes.plot(points[:4, across], points[:4, 2], color=color, lw=3, marker="o", ms=4)
        sole = points[[4, 5, 7, 6, 4]]
        axes.plot(sole[:, across], sole[:, 2], color=color, lw=2)

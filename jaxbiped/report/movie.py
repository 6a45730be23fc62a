"""A walk as a moving stick figure, from the side and from behind; needs no graphics card."""

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxbiped import files, runtime
from jaxbiped.kinematics import leg
from jaxbiped.robot import RobotParams
from jaxbiped.robot.layout import BIPED, POSITION, QUATERNION
from jaxbiped.score import walked_rows
from jaxbiped.sim import Sample
from jaxbiped.sim.scenario import Terrain

FRAMES_PER_SECOND = 20
COLORS = ("tab:blue", "tab:red")
"""Left and right leg."""
PALETTE = 64
"""Colors of a frame."""
LEAST_DEPTH = 0.15
"""Depth of the view below the deepest ground [m]."""
SLIVER = 1e-3
"""Width up to which a strip of a band does not count [m]."""
FAR = 1e3
"""A distance beyond every view [m]."""
GROUND, GROUND_LINE = "0.7", "0.4"
"""Colors of the ground that all bands have in common, and of its surface."""
GROUND_IN_PART = "0.85"
"""Color of ground that is not all across."""


class Rectangles(NamedTuple):
    """Raised and sunk level rectangles."""

    lower: np.ndarray
    """Smallest x and y (n, 2) [m]."""
    upper: np.ndarray
    """Largest x and y (n, 2) [m]."""
    height: np.ndarray
    """Height over the ground (n,) [m]."""


class Profile(NamedTuple):
    """The ground along an axis, in a band of the other one: between two edges it is level."""

    edges: np.ndarray
    """Places where the ground may change (k + 1,) [m]."""
    top: np.ndarray
    """Largest height in the band (k,) [m]."""
    bottom: np.ndarray
    """Smallest height in the band (k,) [m]."""


@runtime.jit
def skeleton(robot: RobotParams, qpos: Float[Array, "n nq"]) -> Float[Array, "n 2 8 3"]:
    """Points of each leg in the world [m]: pelvis, hip, knee, ankle, then the sole's corners."""

    def one(q: Float[Array, " nq"]) -> Float[Array, "2 8 3"]:
        w, x, y, z = q[QUATERNION]
        rotation = jnp.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

        def points(side: Int[Array, ""], angle: Float[Array, "6"]) -> Float[Array, "8 3"]:
            pose = leg.forward(robot, side, angle)
            corners = pose.p_pelvis_sole + robot.p_sole_corner[side] @ pose.rot_pelvis_sole.T
            joints = pose.p_pelvis_link[jnp.array([0, 3, 5])]
            return jnp.concatenate([jnp.zeros((1, 3), q.dtype), joints, corners]) @ rotation.T + q[POSITION]

        return jax.vmap(points)(jnp.arange(2), BIPED.leg_angles(q))

    return jax.vmap(one)(qpos)


def save(robot: RobotParams, trace: Sample, file: Path, terrain: Terrain | None = None) -> Path:
    """Write a GIF of a trace, in real time, whole or not at all.

    From the side, the ground is the one in the lanes of the two feet; from behind, the one the robot stands on or
    over. Where the lanes differ, each has a line in the color of its leg; dashes where only a part of a lane is lower.

    Args:
        robot: nominal.
        trace: samples with a leading axis.
        file: its name ends in .gif.
        terrain: raised and sunk rectangles; level ground without.

    Raises:
        ValueError: if no sample of the trace is finite.
        OSError: with the name of the file, when it cannot be written.
    """
    images = [image for image, _ in frames(robot, trace, terrain)]
    content = io.BytesIO()
    milliseconds = round(1000 / FRAMES_PER_SECOND)
    images[0].save(content, "GIF", save_all=True, append_images=images[1:], duration=milliseconds, loop=0)
    return files.write(file, content.getvalue())


def frames(
    robot: RobotParams, trace: Sample, terrain: Terrain | None = None
) -> Iterator[tuple[Image.Image, Figure]]:
    """Every picture of a trace, and the figure that it is of, which changes with the next one.

    Args:
        robot: nominal.
        trace: samples with a leading axis.
        terrain: raised and sunk rectangles; level ground without.
    """
    rows = _rows(trace)
    time, qpos = np.asarray(trace.time, float)[rows], np.asarray(trace.qpos)[rows]
    points = np.asarray(skeleton(robot, jnp.asarray(qpos)))
    trunk, up = np.asarray(trace.p_world_trunk)[rows], _trunk_top(robot, qpos)
    ground = rectangles(terrain)
    lanes = _lanes(points[:, :, 4:, 1], np.asarray(trace.foot_force)[rows, :, 2] > 0.0)
    floor = min(-LEAST_DEPTH, float(ground.height.min(initial=0.0)) - LEAST_DEPTH)
    figure = Figure(figsize=(9.0, 4.2), dpi=70, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    side, behind = figure.subplots(1, 2, width_ratios=(2, 1))
    for i, now in enumerate(time):
        soles_x = points[i, :, 4:, 0]
        under = np.array([[soles_x.min(), soles_x.max()]])
        for axes, across, bands, name in ((side, 0, lanes, "x [m]"), (behind, 1, under, "y [m]")):
            axes.clear()
            middle = trunk[i, across]
            reach = 1.3 if across == 0 else 0.65
            axes.set(
                xlim=(middle - reach, middle + reach),
                ylim=(floor, float(robot.height) + 0.2),
                xlabel=name,
            )
            axes.set_aspect("equal")
            _draw_ground(axes, [profile(ground, band, across) for band in bands], floor)
            _draw(axes, points[i], trunk[i], up[i], across)
        behind.invert_xaxis()  # seen from behind, left is left
        side.set(ylabel="z [m]", title=f"{robot.name}, {now:.2f} s")
        canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        yield picture.convert("P", palette=Image.Palette.ADAPTIVE, colors=PALETTE), figure
        figure.set_layout_engine("none")  # laid out once, for the first frame


def rectangles(terrain: Terrain | None) -> Rectangles:
    """The rectangles of a terrain that make a difference."""
    if terrain is None:
        return Rectangles(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    lower, upper, height = (np.asarray(a, float) for a in (terrain.lower, terrain.upper, terrain.height))
    used = np.all(lower < upper, axis=1) & (height != 0.0)
    return Rectangles(lower[used], upper[used], height[used])


def profile(ground: Rectangles, band: np.ndarray, across: int) -> Profile:
    """The ground along one axis, in a band of the other one.

    Args:
        ground: rectangles; heights of overlapping ones add up.
        band: smallest and largest place on the other axis (2,) [m].
        across: the axis along which the profile runs: 0 forward, 1 lateral.
    """
    into = 1 - across
    edges = np.unique(np.concatenate([ground.lower[:, across], ground.upper[:, across]]))
    rows = np.concatenate([ground.lower[:, into], ground.upper[:, into], band])
    rows = np.unique(np.clip(rows, band[0], band[1]))
    along = 0.5 * (edges[1:] + edges[:-1])
    strips = np.flatnonzero(np.diff(rows) > SLIVER)
    aside = 0.5 * (rows[strips + 1] + rows[strips]) if strips.size else np.array([np.mean(band)])
    heights = np.zeros((len(along), len(aside)))
    for lower, upper, height in zip(ground.lower, ground.upper, ground.height, strict=True):
        inside = np.outer(
            (lower[across] < along) & (along < upper[across]), (lower[into] < aside) & (aside < upper[into])
        )
        heights += height * inside
    # Level ground before the first edge and behind the last.
    top, bottom = (np.pad(ends, 1) for ends in (heights.max(axis=1), heights.min(axis=1)))
    return Profile(np.concatenate([[-FAR], edges, [FAR]]), top, bottom)


def _rows(trace: Sample) -> np.ndarray:
    """The sample of every frame, up to the last one or the fall; those that are not finite cannot be drawn."""
    time, qpos = np.asarray(trace.time, float), np.asarray(trace.qpos)
    walked = np.arange(len(time)) < walked_rows(time)
    finite = np.flatnonzero(walked & np.isfinite(time) & np.all(np.isfinite(qpos), axis=1))
    if not finite.size:
        raise ValueError(f"trace: got {len(time)} samples, allowed: at least one that is finite")
    time = time[finite]
    wanted = np.arange(time[0], time[-1] + 1.0 / FRAMES_PER_SECOND, 1.0 / FRAMES_PER_SECOND)
    return finite[np.minimum(np.searchsorted(time, wanted), len(time) - 1)]


def _lanes(y: np.ndarray, loaded: np.ndarray) -> np.ndarray:
    """The band (2, 2) of y that each sole stands on [m]; of a foot that never stands, all its places."""
    stood = loaded | ~loaded.any(axis=0)
    return np.array([[y[stood[:, foot], foot].min(), y[stood[:, foot], foot].max()] for foot in (0, 1)])


def _trunk_top(robot: RobotParams, qpos: np.ndarray) -> np.ndarray:
    """A point on the trunk's axis (n, 3) [m]."""
    w, x, y, z = qpos[:, 3:7].T
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    length = float(robot.height) - float(robot.thigh_length + robot.shank_length + robot.ankle_height)
    return qpos[:, :3] + max(0.3, length) * axis


def _draw(axes: Axes, legs: np.ndarray, trunk: np.ndarray, top: np.ndarray, across: int) -> None:
    axes.plot([trunk[across], top[across]], [trunk[2], top[2]], color="0.25", lw=5, solid_capstyle="round")
    for points, color in zip(legs, COLORS, strict=True):
        axes.plot(points[:4, across], points[:4, 2], color=color, lw=3, marker="o", ms=4)
        sole = points[[4, 5, 7, 6, 4]]
        axes.plot(sole[:, across], sole[:, 2], color=color, lw=2)


def _draw_ground(axes: Axes, seen: Sequence[Profile], floor: float) -> None:
    """The ground of one or two bands, with the same or with other edges, down to the edge of the view."""
    edges = np.unique(np.concatenate([one.edges for one in seen]))
    middles = 0.5 * (edges[1:] + edges[:-1])
    tops, bottoms = (
        np.stack([getattr(one, which)[np.searchsorted(one.edges, middles) - 1] for one in seen])
        for which in ("top", "bottom")
    )
    axes.stairs(tops.max(axis=0), edges, baseline=floor, fill=True, color=GROUND_IN_PART, zorder=0.5)
    axes.stairs(bottoms.min(axis=0), edges, baseline=floor, fill=True, color=GROUND, zorder=0.6)
    same = np.all(tops == tops[0], axis=0)
    common = np.where(same, tops[0], np.nan)
    axes.stairs(common, edges, baseline=None, color=GROUND_LINE, lw=1.0, zorder=0.8, label="ground")
    for top, bottom, color in zip(tops, bottoms, COLORS, strict=False):
        of_leg = np.where(same, np.nan, top)
        axes.stairs(of_leg, edges, baseline=None, color=color, lw=1.2, zorder=0.9, label="_lane")
        step = np.flatnonzero((np.diff(top) != 0.0) & ~(same[1:] & same[:-1]))
        axes.vlines(edges[step + 1], top[step], top[step + 1], color=color, lw=1.2, zorder=0.9)
        lower = np.where(bottom < top, bottom, np.nan)
        axes.stairs(
            lower, edges, baseline=None, color=GROUND_LINE, lw=0.8, ls="--", zorder=0.8, label="_part"
        )

"""The moving picture shows the ground the robot walks on, holes too, and its file is whole or not there."""

import errno
import math
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.patches import StepPatch
from PIL import Image

from jaxbiped import planner, robot, sim
from jaxbiped.report import movie
from jaxbiped.sim.scenario import Terrain

N, DT = 40, 0.02
FLAT = sim.Scenario.flat(6)


@pytest.fixture(scope="module")
def elkahlout() -> robot.RobotParams:
    return robot.load("elkahlout")


@pytest.fixture(scope="module")
def trace(elkahlout) -> sim.Sample:
    """A robot with straight legs that glides forward over the origin, both feet loaded."""
    gait, time = planner.CosineGait.preset(elkahlout, 3), (np.arange(N) + 1.0) * DT
    targets = jax.jit(jax.vmap(lambda t: planner.at(gait, t)))(jnp.asarray(time, jnp.float32))
    up = float(elkahlout.thigh_length + elkahlout.shank_length + elkahlout.ankle_height)
    up -= float(elkahlout.p_pelvis_hip[0, 2])
    qpos = np.zeros((N, 19), np.float32)
    qpos[:, 0], qpos[:, 2], qpos[:, 3] = np.linspace(-0.2, 0.2, N), up, 1.0
    zero, force = jnp.zeros((N, 2, 3)), jnp.zeros((N, 2, 3)).at[..., 2].set(400.0)
    return sim.Sample(
        time=targets.time,
        p_world_trunk=jnp.asarray(qpos[:, :3]),
        roll_pitch_yaw=jnp.zeros((N, 3)),
        p_world_sole=zero,
        foot_force=force,
        corner_force=jnp.zeros((N, 2, 4)),
        zmp_world=jnp.zeros((N, 2)),
        switch=jnp.zeros((N, 2, 4), bool),
        torque=jnp.zeros((N, 2, 6)),
        qpos=jnp.asarray(qpos),
        targets=targets,
        filtered_corner_force=jnp.zeros((N, 2, 4)),
    )


@pytest.fixture(scope="module")
def lane(elkahlout) -> float:
    """Where the left foot's lane runs, y [m]."""
    return float(elkahlout.p_pelvis_hip[0, 1])


def along(profile: movie.Profile, place: float) -> tuple[float, float]:
    """Largest and smallest height at a place."""
    i = int(np.searchsorted(profile.edges, place)) - 1
    return float(profile.top[i]), float(profile.bottom[i])


def drawn(axes: Any, label: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Heights and edges of lines of the ground."""
    patches = [p for p in axes.patches if isinstance(p, StepPatch) and p.get_label() == label]
    return [(np.asarray(p.get_data()[0]), np.asarray(p.get_data()[1])) for p in patches]


def heights_at(axes: Any, label: str, place: float) -> list[float]:
    found = [values[np.searchsorted(edges, place) - 1] for values, edges in drawn(axes, label)]
    return [float(value) for value in found if np.isfinite(value)]


def test_profile_of_level_ground_is_level():
    flat = movie.profile(movie.rectangles(None), np.array([-0.1, 0.1]), 0)
    assert along(flat, 0.0) == along(flat, -7.0) == (0.0, 0.0)


def test_unused_rectangles_are_left_out():
    lower, upper = np.zeros((4, 2)), np.ones((4, 2))
    lower[1] = [2.0, 0.0]  # beyond its upper corner
    upper[2] = [1.0, 0.0]  # without width
    terrain = Terrain(lower, upper, np.array([0.02, 0.03, 0.04, 0.0]))
    kept = movie.rectangles(terrain)
    np.testing.assert_allclose(kept.height, [0.02])
    assert movie.rectangles(FLAT.terrain).height.size == 0


def test_profile_is_that_of_the_band_it_is_asked_for():
    world = FLAT.with_rectangle((1.0, 0.0), (2.0, 0.2), 0.03).with_rectangle((1.5, -0.3), (2.5, -0.1), -0.05)
    ground = movie.rectangles(world.terrain)
    left, right, both = (
        movie.profile(ground, np.array(band), 0) for band in ((0.05, 0.1), (-0.2, -0.15), (-0.2, 0.1))
    )
    assert along(left, 1.75) == pytest.approx((0.03, 0.03)) and along(left, 2.25) == (0.0, 0.0)
    assert along(right, 1.75) == pytest.approx((-0.05, -0.05)) and along(right, 1.25) == (0.0, 0.0)
    assert along(both, 1.75) == pytest.approx((0.03, -0.05)) and along(both, 1.25) == pytest.approx(
        (0.03, 0.0)
    )
    beside = movie.profile(ground, np.array([1.6, 1.9]), 1)
    assert along(beside, 0.1) == pytest.approx((0.03, 0.03))
    assert along(beside, -0.2) == pytest.approx((-0.05, -0.05))
    assert along(beside, 0.5) == along(beside, -0.05) == (0.0, 0.0)
    # What only touches the band, but for rounding, is not in it.
    assert along(movie.profile(ground, np.array([0.2, 0.3]), 0), 1.5) == (0.0, 0.0)


def test_heights_of_overlapping_rectangles_add_up():
    world = FLAT.with_rectangle((0.0, -1.0), (2.0, 1.0), 0.03).with_rectangle((1.0, -1.0), (3.0, 1.0), 0.02)
    profile = movie.profile(movie.rectangles(world.terrain), np.array([-0.1, 0.1]), 0)
    assert [along(profile, x)[0] for x in (0.5, 1.5, 2.5)] == pytest.approx([0.03, 0.05, 0.02])


def test_pictures_show_what_lies_in_the_lanes_of_the_feet(elkahlout, trace, lane):
    """A pad in the left lane, a hole in the right one, and a block that nobody comes near."""
    world = FLAT.with_rectangle((-0.5, 0.3 * lane), (0.0, 1.0), 0.03)
    world = world.with_rectangle((0.1, -1.0), (1.0, -0.3 * lane), -0.2).with_rectangle(
        (-1.0, 3.0), (1.0, 4.0), 0.2
    )
    picture, figure = next(movie.frames(elkahlout, trace, world.terrain))
    assert picture.size == (630, 294)
    side, behind = figure.axes
    assert heights_at(side, "_lane", -0.25) == pytest.approx([0.03, 0.0])
    assert heights_at(side, "_lane", 0.5) == pytest.approx([0.0, -0.2])
    assert heights_at(side, "ground", -0.8) == [0.0] and heights_at(side, "ground", -0.25) == []
    assert max(values[np.isfinite(values)].max(initial=0.0) for values, _ in drawn(side, "_lane")) < 0.1
    # In the first frame, the feet are over the pad; behind them is nothing else.
    assert heights_at(behind, "ground", 1.2 * lane) == pytest.approx([0.03])
    assert heights_at(behind, "ground", -lane) == [0.0]
    for axes in (side, behind):
        assert axes.get_ylim()[0] < -0.25


def test_the_view_from_behind_follows_the_robot(elkahlout, trace, lane):
    world = FLAT.with_rectangle((0.2, 0.0), (1.0, 1.0), -0.05)
    *_, (_, figure) = movie.frames(elkahlout, trace, world.terrain)
    behind = figure.axes[1]
    left, right = behind.get_xlim()
    assert left > right
    # The soles reach from before the hole's edge into it: both are shown, the lower by dashes.
    assert heights_at(behind, "_part", lane) == pytest.approx([-0.05])
    assert heights_at(behind, "_part", -lane) == []


def test_level_ground_is_one_line(elkahlout, trace):
    for terrain in (None, FLAT.terrain):
        _, figure = next(movie.frames(elkahlout, trace, terrain))
        for axes in figure.axes:
            assert heights_at(axes, "ground", 0.0) == [0.0]
            assert heights_at(axes, "_lane", 0.0) == heights_at(axes, "_part", 0.0) == []
            assert axes.get_ylim()[0] == pytest.approx(-movie.LEAST_DEPTH)


def test_soles_are_drawn_where_the_ground_is(elkahlout, trace):
    _, figure = next(movie.frames(elkahlout, trace))
    for axes in figure.axes:
        soles = [points for line in axes.get_lines() if len(points := np.asarray(line.get_xydata())) == 5]
        assert len(soles) == 2
        for sole in soles:
            np.testing.assert_allclose(sole[:, 1], 0.0, atol=1e-5)


def test_a_picture_for_every_frame_up_to_the_last_sample(elkahlout, trace, monkeypatch, tmp_path: Path):
    monkeypatch.setattr(movie, "FRAMES_PER_SECOND", 5)
    file = movie.save(elkahlout, trace, tmp_path / "walk.gif", FLAT.terrain)
    with Image.open(file) as gif:
        assert gif.format == "GIF" and gif.info["duration"] == 200 and gif.info["loop"] == 0
        assert gif.n_frames == math.ceil((N - 1) * DT * 5) + 1  # pyright: ignore[reportAttributeAccessIssue]
    *_, (_, figure) = movie.frames(elkahlout, trace)
    assert figure.axes[0].get_title() == f"elkahlout, {N * DT:.2f} s"


@pytest.mark.parametrize("fallen_at", [0, 1, 20])
def test_walks_that_end_early_are_drawn_up_to_their_end(elkahlout, trace, monkeypatch, fallen_at):
    monkeypatch.setattr(movie, "FRAMES_PER_SECOND", 5)
    broken = eqx.tree_at(
        lambda s: (s.time, s.qpos),
        trace,
        (jnp.minimum(trace.time, trace.time[fallen_at]), trace.qpos.at[fallen_at + 1 :].set(jnp.nan)),
    )
    *_, (_, figure) = movie.frames(elkahlout, broken)
    assert figure.axes[0].get_title() == f"elkahlout, {(fallen_at + 1) * DT:.2f} s"
    nothing = eqx.tree_at(lambda s: s.qpos, trace, jnp.full_like(trace.qpos, jnp.nan))
    with pytest.raises(ValueError, match="at least one that is finite"):
        next(movie.frames(elkahlout, nothing))


def test_feet_that_never_stood_have_lanes_too():
    y = np.array([[[0.1, 0.2], [-0.2, -0.1]], [[0.3, 0.4], [-0.3, -0.2]]])
    one = movie._lanes(y, np.array([[True, False], [False, False]]))
    np.testing.assert_allclose(one, [[0.1, 0.2], [-0.3, -0.1]])


def test_a_full_disk_leaves_no_half_file(elkahlout, trace, monkeypatch, tmp_path: Path):
    monkeypatch.setattr(movie, "FRAMES_PER_SECOND", 2)
    file = tmp_path / "walk.gif"
    file.write_bytes(b"old")

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("jaxbiped.files.os.fsync", full)
    with pytest.raises(OSError, match=r"walk\.gif"):
        movie.save(elkahlout, trace, file)
    assert [(one.name, one.read_bytes()) for one in tmp_path.iterdir()] == [("walk.gif", b"old")]

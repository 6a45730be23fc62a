"""The curves of a figure are the plan's own numbers, and the picture is complete."""

import builtins
import errno
import importlib
import os
import sys
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from jaxbiped import planner, robot
from jaxbiped.report import figures

N_STEPS = 8


class Plan(NamedTuple):
    gait: planner.PolynomialGait
    time: jax.Array
    task: planner.TaskSpace
    phase: planner.Phase
    report: planner.Feasibility


@pytest.fixture(scope="module")
def plan() -> Plan:
    surena = robot.load("surena3")
    gait = planner.PolynomialGait.preset(surena, N_STEPS)
    time = planner.sample_times(gait)
    task, phase = jax.jit(jax.vmap(lambda t: (gait.task(t), gait.phase(t))))(time)
    return Plan(gait, time, task, phase, planner.feasibility(surena, gait, time))


@pytest.fixture(scope="module")
def cycle() -> tuple[np.ndarray, planner.TaskSpace, planner.Phase]:
    gait = planner.CosineGait.preset(robot.load("elkahlout"), N_STEPS)
    time = np.linspace(0.0, 2.0 * float(gait.params.T_c), 481)
    at = jax.jit(jax.vmap(lambda t: (gait.task(t), gait.phase(t))))
    return time, *at(jnp.asarray(time) + gait.params.T_ini)


def curve(axes: Axes, label: str) -> np.ndarray:
    (line,) = [line for line in axes.get_lines() if line.get_label() == label]
    return np.asarray(line.get_ydata())


def every_figure(plan: Plan, cycle) -> dict[str, Figure]:
    return {
        "feet": figures.feet(plan.time, plan.task, plan.phase),
        "pelvis": figures.pelvis(plan.time, plan.task, plan.phase),
        "zmp_x": figures.zmp(plan.report, plan.phase, 0),
        "zmp_y": figures.zmp(plan.report, plan.phase, 1),
        "feasibility": figures.feasibility_page(plan.report, plan.phase),
        "feet_in_body": figures.feet_in_body(*cycle),
    }


@pytest.mark.parametrize("axis", range(3))
def test_feet_are_the_gait(plan, axis):
    axes = figures.feet(plan.time, plan.task, plan.phase).axes[axis]
    for side, name in enumerate(robot.SIDE_NAMES):
        drawn = curve(axes, f"{name} foot")
        np.testing.assert_array_equal(drawn, plan.task.sole[:, side, axis])
        assert drawn[0] == pytest.approx((0.0, (0.5 - side) * 0.23, 0.0)[axis], abs=1e-6)


def test_pelvis_is_the_gait(plan):
    for axis, axes in enumerate(figures.pelvis(plan.time, plan.task, plan.phase).axes):
        np.testing.assert_array_equal(curve(axes, "pelvis"), plan.task.pelvis[:, axis])


@pytest.mark.parametrize("axis", range(2))
def test_zmp_stays_between_the_edges_drawn(plan, axis):
    (axes,) = figures.zmp(plan.report, plan.phase, axis).axes
    zmp = curve(axes, "ZMP")
    np.testing.assert_array_equal(zmp, plan.report.zmp[:, axis])
    np.testing.assert_array_equal(curve(axes, "_lower edge"), plan.report.support_lower[:, axis])
    np.testing.assert_array_equal(curve(axes, "edges of the support"), plan.report.support_upper[:, axis])
    assert np.all(curve(axes, "_lower edge") < zmp)
    assert np.all(zmp < curve(axes, "edges of the support"))


def test_feasibility_page_shows_the_report_and_its_worst_values(plan):
    report = plan.report
    margin, friction, torque, speed, knee = figures.feasibility_page(report, plan.phase).axes
    drawn = [np.asarray(axes.get_lines()[0].get_ydata()) for axes in (margin, friction, torque, speed)]
    expected = [
        1e3 * report.zmp_margin,
        report.friction,
        1e2 * report.torque_share,
        1e2 * report.speed_share,
    ]
    for one, other in zip(drawn, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    assert np.asarray(margin.get_lines()[1].get_ydata())[0] == pytest.approx(drawn[0].min())
    for axes, values in zip((friction, torque, speed), drawn[1:], strict=True):
        assert np.asarray(axes.get_lines()[1].get_ydata())[0] == pytest.approx(values.max())
    np.testing.assert_allclose(curve(knee, "left knee"), np.degrees(report.knee[:, 0]), rtol=1e-6)


def test_feet_in_the_body_frame_are_the_thesis_figure(cycle):
    """Golden numbers of elkahlout Eqs. 3.1-3.6 at t = 0 and t = 1.2 s of the thesis' time."""
    time, *_ = cycle
    x, y, z = figures.feet_in_body(*cycle).axes
    start, middle = 0, int(np.argmin(np.abs(time - 1.2)))
    expected = [
        (x, "right foot", start, -0.01),
        (x, "left foot", start, -0.17),
        (y, "right foot", start, -0.11),
        (y, "left foot", start, 0.11),
        (z, "right foot", start, -0.5),
        (z, "left foot", start, -0.5),
        (x, "right foot", middle, -0.09),
        (x, "left foot", middle, -0.09),
        (y, "right foot", middle, 0.02),
        (y, "left foot", middle, 0.24),
        (z, "left foot", middle, -0.47),
    ]
    for axes, label, i, value in expected:
        assert curve(axes, label)[i] == pytest.approx(value, abs=1e-5)


def test_single_support_is_shaded_once_a_step(plan):
    """Bands begin at lift-off and end at touchdown, to within a sample."""
    axes = figures.feet(plan.time, plan.task, plan.phase).axes[0]
    shade = figures.SINGLE_SUPPORT_SHADE
    bands = [patch for patch in axes.patches if to_hex(patch.get_facecolor()) == shade]
    assert len(bands) == N_STEPS
    p, sample = plan.gait.params, float(plan.time[1] - plan.time[0])
    for k, band in enumerate(bands):
        left, right = band.get_extents().transformed(axes.transData.inverted()).intervalx
        assert left == pytest.approx(float(p.T_ini + k * p.T_c), abs=sample)
        assert right - left == pytest.approx(float(p.T_s), abs=2 * sample)


def test_every_figure_is_labeled_and_nothing_is_cut(plan, cycle):
    for name, figure in every_figure(plan, cycle).items():
        assert figure.get_suptitle(), name
        assert "[s]" in figure.axes[-1].get_xlabel()
        legend = figure.axes[0].get_legend()
        assert legend is not None
        assert legend.get_texts()[0].get_text() == figures.SHADE_LABEL
        figure.draw_without_rendering()
        page = figure.bbox
        for axes in figure.axes:
            assert "[" in axes.get_ylabel(), name
            box = axes.get_tightbbox()
            assert box is not None
            assert page.x0 <= box.x0 and box.x1 <= page.x1 + 1, name
            assert page.y0 <= box.y0 and box.y1 <= page.y1, name


def test_save_writes_a_png_of_the_right_size(plan, tmp_path: Path):
    path = figures.save(figures.pelvis(plan.time, plan.task, plan.phase), tmp_path / "pelvis.png")
    header = path.read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    assert int.from_bytes(header[16:20], "big") == 9 * figures.DPI


def test_a_full_disk_leaves_the_old_figure(plan, tmp_path: Path, monkeypatch):
    path = tmp_path / "pelvis.png"
    path.write_bytes(b"old")

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("jaxbiped.files.os.fsync", full)
    with pytest.raises(OSError, match=r"pelvis\.png"):
        figures.save(Figure(), path)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("pelvis.png", b"old")]


def test_a_figure_may_be_read_by_whom_the_umask_lets(tmp_path: Path):
    before = os.umask(0o022)
    try:
        path = figures.save(Figure(), str(tmp_path / "empty.png"))
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize(
    ("margins", "said"),
    [
        ([-0.01, -0.005], "smallest -10"),
        ([0.0, 0.0], "smallest 0"),
        ([1e-9, -6.035e-11], "smallest 0"),
        ([0.01, np.nan], "smallest 10"),
        ([np.nan, np.inf], None),
    ],
)
def test_every_value_of_a_page_is_in_its_panel(plan, margins, said):
    """Also where all of them are below zero, none is anything but zero, or there is none."""
    few = jax.tree.map(lambda leaf: leaf[:2], (plan.report, plan.phase))
    report = eqx.tree_at(lambda r: r.zmp_margin, few[0], jnp.asarray(margins, jnp.float32))
    axes = figures.feasibility_page(report, few[1]).axes[0]
    low, high = axes.get_ylim()
    known = [1e3 * margin for margin in margins if np.isfinite(margin)]
    assert low < high and all(low <= value <= high for value in [*known, 0.0])
    labels = [line.get_label() for line in axes.get_lines()[1:]]
    assert labels == ([] if said is None else [said])


def test_a_single_sample_can_be_drawn(plan):
    one = jax.tree.map(lambda leaf: leaf[:1], (plan.time, plan.task, plan.phase))
    left, right = figures.feet(*one).axes[0].get_xlim()
    assert left < float(plan.time[0]) < right


def test_pyplot_is_not_needed():
    source = Path(figures.__file__).read_text(encoding="utf-8")
    assert "import matplotlib.pyplot" not in source and "from matplotlib import pyplot" not in source


def test_without_matplotlib_the_message_says_what_to_install(monkeypatch):
    real = builtins.__import__

    def no_matplotlib(name, *args, **kwargs):
        if name.split(".")[0] == "matplotlib":
            raise ImportError("No module named 'matplotlib'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", no_matplotlib)
    monkeypatch.delitem(sys.modules, "jaxbiped.report.figures")
    monkeypatch.delitem(sys.modules, "jaxbiped.report")
    with pytest.raises(ImportError, match=r"jaxbiped\[viz\]"):
        importlib.import_module("jaxbiped.report.figures")

"""The support polygon against SciPy's convex hull."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from jaxbiped import robot
from jaxbiped.planner import TaskSpace, support
from jaxbiped.planner.targets import Timing, step_phase

CASES = 300


@pytest.fixture(scope="module")
def scenes():
    """Eight points each, at least three of them active, and a point to judge; half of the scenes two rectangles."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (CASES, 8, 2))
    x, y = np.array([0.1325, 0.1325, -0.1325, -0.1325]), np.array([0.08, -0.08, 0.08, -0.08])
    for i in range(0, CASES, 2):
        ahead = rng.choice([0.0, rng.uniform(-0.3, 0.3)])  # side by side, four corners are on one line
        points[i] = np.concatenate([np.c_[x, y + 0.115], np.c_[x + ahead, y - 0.115]])
    active = rng.uniform(size=(CASES, 8)) < 0.6
    active[::2] = True
    active[::4, 4:] = False
    active[
        np.arange(1, CASES, 2)[:, None], rng.permuted(np.tile(np.arange(8), (CASES // 2, 1)), axis=1)[:, :3]
    ] = True
    return points, active, rng.uniform(-0.35, 0.35, (CASES, 2))


def _hull_margin(points, p):
    """Facet equations are n x + d <= 0 inside, |n| = 1."""
    equations = ConvexHull(points).equations
    return -np.max(equations[:, :2] @ p + equations[:, 2])


@pytest.mark.parametrize(("x64", "tolerance"), [(True, 1e-15), (False, 2e-7)])
def test_margin_is_the_distance_to_scipys_hull(scenes, x64, tolerance):
    points, active, p = scenes
    with jax.enable_x64(x64):
        got = np.asarray(jax.jit(jax.vmap(support.margin))(*(jnp.asarray(a) for a in scenes)))
    expected = np.array([_hull_margin(points[i][active[i]], p[i]) for i in range(CASES)])
    assert (expected > 0.0).sum() > 50
    assert (expected < 0.0).sum() > 50
    assert np.abs(got - expected).max() < tolerance


def test_margin_has_the_derivative_of_finite_differences(scenes, x64):
    """With respect to the points and to what is judged; finite where corners coincide or lie on one line."""
    points, active, p = (jnp.asarray(a) for a in scenes)
    in_points, in_p = jax.jit(jax.vmap(jax.grad(support.margin, argnums=(0, 2))))(points, active, p)
    assert np.all(np.isfinite(in_points))
    assert np.allclose(np.linalg.norm(in_p, axis=-1), 1.0)  # a distance has a unit gradient
    margin, h = jax.jit(jax.vmap(support.margin)), 1e-7
    for axis in (0, 1):
        step = h * jnp.eye(2)[axis]
        along_p = (margin(points, active, p + step) - margin(points, active, p - step)) / (2 * h)
        assert np.median(np.abs(along_p - in_p[:, axis])) < 1e-7
        step = jnp.zeros((8, 2)).at[2, axis].set(h)
        random = slice(1, None, 2)  # where no corners are on one line
        along_point = (margin(points + step, active, p) - margin(points - step, active, p)) / (2 * h)
        assert np.allclose(along_point[random], in_points[random, 2, axis], atol=1e-5)
    same = jnp.zeros((8, 2))
    gradients = jax.grad(support.margin, argnums=(0, 2))(same, jnp.ones(8, bool), jnp.zeros(2))
    assert all(np.all(np.isfinite(g)) for g in gradients)


def test_box_is_that_of_the_active_points(scenes):
    points, active, _ = scenes
    lower, upper = jax.vmap(support.box)(jnp.asarray(points, jnp.float32), jnp.asarray(active))
    for i in range(CASES):
        assert np.allclose(lower[i], points[i][active[i]].min(axis=0), atol=1e-7)
        assert np.allclose(upper[i], points[i][active[i]].max(axis=0), atol=1e-7)


@pytest.mark.parametrize("name", ["surena3", "elkahlout"])
def test_corners_are_those_of_the_robots_soles(name):
    biped = robot.load(name)
    sole = np.array([[1.0, 0.2, 0.05], [0.7, -0.3, 0.0]])
    task = TaskSpace(jnp.asarray(sole, jnp.float32), jnp.zeros(3))
    corners = np.asarray(support.corners(biped, task))
    for side in (0, 1):
        for corner in range(4):
            offset = np.asarray(biped.p_sole_corner)[side, corner, :2]
            assert np.allclose(corners[4 * side + corner], sole[side, :2] + offset, atol=1e-6)


@pytest.mark.parametrize(
    ("t", "feet"),
    [
        (0.5, (True, True)),  # before the walk
        (1.5, (False, True)),
        (2.5, (True, True)),
        (3.5, (True, False)),
        (9.0, (True, True)),  # after it
    ],
)
def test_loaded_are_the_corners_of_the_feet_on_the_ground(t, feet):
    seconds = [jnp.asarray(s) for s in (1.0, 1.0, 2.0)]
    phase = step_phase(Timing(*seconds, n_steps=2, first_swing=0, room=8), jnp.asarray(t))
    assert np.array_equal(support.loaded(phase), np.repeat(feet, 4))

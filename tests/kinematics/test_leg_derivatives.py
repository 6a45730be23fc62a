"""Derivatives of the inverse kinematics: finite differences where it is smooth, finite where it is not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import hip_to_ankle, leg_forward, load, random_angles, random_rotations
from scipy.spatial.transform import Rotation

from jaxbiped import robot
from jaxbiped.kinematics import leg
from jaxbiped.kinematics.rotation import about_x, about_y, about_z

CASES = [("surena3", robot.LEFT), ("elkahlout", robot.RIGHT)]


def angles_at(params, side, base, change):
    """Joint angles when the sole at `base` = (position, rotation) is moved and turned, and the leg grows.

    `change` is nine numbers: the sole's position [m] and turn [rad]; thigh, shank and ankle lengths [m].
    """
    position, rotation = base
    turn = about_z(change[5]) @ about_y(change[4]) @ about_x(change[3])
    lengths = (params.thigh_length, params.shank_length, params.ankle_height)
    grown = tuple(length + by for length, by in zip(lengths, change[6:], strict=True))
    params = eqx.tree_at(lambda r: (r.thigh_length, r.shank_length, r.ankle_height), params, grown)
    return leg.inverse(params, side, position + change[:3], turn @ rotation).angle


def with_value(*args):
    angle = angles_at(*args)
    return angle, angle


value = jax.jit(jax.vmap(angles_at, (None, None, None, 0)), static_argnums=1)
jacobians = [
    jax.jit(derivative(with_value, argnums=3, has_aux=True), static_argnums=1)
    for derivative in (jax.jacfwd, jax.jacrev)
]


def jacobian(params, side, base, change=None):
    """The Jacobian (6, 9), every number in it finite.

    Forward and reverse mode agree; not asked a `change` off a singular pose, where huge numbers cancel.
    """
    base = tuple(jnp.asarray(part) for part in base)
    off_by = jnp.zeros(9) if change is None else jnp.asarray(change)
    (one, angle), (other, _) = (derivative(params, side, base, off_by) for derivative in jacobians)
    assert np.isfinite([*np.ravel(angle), *np.ravel(one), *np.ravel(other)]).all()
    if change is None:
        scale = max(1.0, np.abs(one).max())
        np.testing.assert_allclose(one / scale, other / scale, rtol=0, atol=1e3 * np.finfo(one.dtype).eps)
    return np.asarray(one)


def finite_differences(params, side, base, step):
    """Central differences of fourth order."""
    base = tuple(jnp.asarray(part) for part in base)
    weights = {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
    changes = jnp.asarray(np.concatenate([k * step * np.eye(9) for k in weights]))
    values = np.asarray(value(params, side, base, changes)).reshape(4, 9, 6)
    return np.einsum("k,kij->ji", list(weights.values()), values) / step


def assert_smooth(params, side, base, step=1e-5, rtol=1e-6):
    got, wanted = jacobian(params, side, base), finite_differences(params, side, base, step)
    np.testing.assert_allclose(got, wanted, rtol=0, atol=rtol * max(1.0, np.abs(wanted).max()))
    return got


@pytest.mark.parametrize(("name", "side"), CASES)
def test_equal_finite_differences_at_random_poses(x64, name, side):
    params = load(name)
    angles = random_angles(params, 40, seed=1)[:, side]
    angles[:, robot.KNEE] = np.maximum(angles[:, robot.KNEE], 0.1)
    poses = [leg_forward(params, side, angle) for angle in angles]
    arms = [rotation.T @ hip_to_ankle(params, side, position, rotation) for position, rotation in poses]
    poses = [pose for pose, arm in zip(poses, arms, strict=True) if np.hypot(arm[1], arm[2]) > 0.05]
    assert len(poses) > 30
    for pose in poses:
        got = assert_smooth(params, side, pose)
        assert (np.abs(got).max(axis=1) > 0.1).all()  # every joint moves


def standing(params, side, knee):
    """The pose of a foot below the hip, not turned, the knee bent by `knee` [rad]."""
    a, b = float(params.thigh_length), float(params.shank_length)
    lean = np.arctan2(b * np.sin(knee), a + b * np.cos(knee))
    return leg_forward(params, side, np.array([0.0, 0.0, -lean, knee, lean - knee, 0.0]))


@pytest.mark.parametrize(("name", "side"), CASES)
def test_equal_finite_differences_at_zero_rotation(x64, name, side):
    params = load(name)
    position, rotation = standing(params, side, 0.6)
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-15)
    got = assert_smooth(params, side, (position, np.eye(3)))
    height = -hip_to_ankle(params, side, position, np.eye(3))[2]
    yaw, roll, ankle_roll = map(robot.JOINT_NAMES.index, ("hip_yaw", "hip_roll", "ankle_roll"))
    assert got[yaw, 5] == pytest.approx(1.0)  # turning the foot turns the hip
    assert got[roll, 1] == pytest.approx(1.0 / height)  # moving it aside swings the leg, and the ankle back
    assert got[ankle_roll, 1] == pytest.approx(-1.0 / height)
    assert got[robot.KNEE, 2] > 1.0  # lifting it bends the knee


@pytest.mark.parametrize(("name", "side"), CASES)
@pytest.mark.parametrize(("knee", "step"), [(0.011, 5e-9), (0.02, 5e-8), (0.05, 1e-6)])
def test_equal_finite_differences_just_inside_the_straight_knee(x64, name, side, knee, step):
    params = load(name)
    got = assert_smooth(params, side, standing(params, side, knee), step)
    a, b = float(params.thigh_length), float(params.shank_length)
    steep = np.sqrt(a * a + b * b + 2 * a * b * np.cos(knee)) / (a * b * np.sin(knee))  # law of cosines
    assert got[robot.KNEE, 2] == pytest.approx(steep, rel=1e-6)


@pytest.mark.parametrize("factor", [1.05, 0.25])
def test_equal_finite_differences_beyond_reach(x64, factor):
    params, side = load("surena3"), robot.LEFT
    rotation = Rotation.from_euler("xyz", [0.1, 0.05, 0.2]).as_matrix()
    hip = np.asarray(params.p_pelvis_hip[side])
    position = hip + factor * np.array([0.05, 0.02, -0.72]) - 0.098 * rotation[:, 2]
    got = assert_smooth(params, side, (position, rotation))
    np.testing.assert_allclose(got[robot.KNEE], 0.0, atol=1e-12)
    assert got[robot.JOINT_NAMES.index("hip_roll"), 1] > 1.0


def singular_poses(params, side):
    """Foot poses at which some arctangent, root or clip has no derivative, by name."""
    hip = np.asarray(params.p_pelvis_hip[side], float)
    a, b, h = float(params.thigh_length), float(params.shank_length), float(params.ankle_height)
    eye, up = np.eye(3), np.array([0.0, 0.0, 1.0])
    longest = float(leg.reach(params, side)[1])

    def below(distance, rotation=eye, direction=-up):
        return hip + distance * direction - h * rotation[:, 2], rotation

    quarter_x = Rotation.from_euler("x", 90, degrees=True).as_matrix().round()
    quarter_y = Rotation.from_euler("y", 90, degrees=True).as_matrix().round()
    return {
        "ankle in the hip": below(0.0),
        "ankle in the hip, foot turned": below(0.0, random_rotations(1)[0]),
        "sole in the hip": (hip, eye),
        "straight knee": below(a + b),
        "straightest knee": below(longest),
        "just beyond the straight knee": below(a + b + 1e-7),
        "far beyond reach": below(5.0),
        "most bent knee": below(float(leg.reach(params, side)[0])),
        "bent, not turned": below(0.9 * (a + b)),
        "hip roll of 90 degrees": below(0.9 * (a + b), quarter_x, np.array([0.0, 1.0, 0.0])),
        "hip roll of -90 degrees": below(0.9 * (a + b), quarter_x.T, np.array([0.0, -1.0, 0.0])),
        "ankle roll of 90 degrees": below(0.9 * (a + b), quarter_x),
        "ankle roll of -90 degrees": below(0.9 * (a + b), quarter_x.T),
        "hip on the ankle's roll axis": below(0.9 * (a + b), quarter_y),
        "hip behind on the ankle's roll axis": below(0.9 * (a + b), quarter_y.T),
        "foot upside down": below(0.9 * (a + b), quarter_x @ quarter_x),
        "foot upside down and straight": below(a + b, quarter_x @ quarter_x),
        "foot back to front": below(0.9 * (a + b), np.diag([-1.0, -1.0, 1.0])),
        "foot over the hip": below(0.9 * (a + b), eye, up),
    }


SINGULAR = list(singular_poses(load("surena3"), robot.LEFT))


@pytest.mark.parametrize("pose", SINGULAR)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(("name", "side"), CASES)
def test_finite_at_and_near_every_singular_pose(dtype, name, side, pose):
    """At the pose itself, and a little off it in random directions."""
    with jax.enable_x64(dtype == "float64"):
        params = load(name)
        base = singular_poses(params, side)[pose]
        jacobian(params, side, base)
        rng = np.random.default_rng(0)
        for power in (1, 3, 5, 7, 9, 12, 15, 18, 20, 23, 30, 40):
            jacobian(params, side, base, 10.0**-power * rng.normal(size=9))

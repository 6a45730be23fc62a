"""Inverse kinematics of a leg: undoes the forward kinematics, stops at its limits, never yields NaN."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import (
    BENT,
    MIRROR,
    MIRRORED_JOINT,
    PRESETS,
    ROBOTS,
    SIDES,
    hip_to_ankle,
    leg_forward,
    load,
    random_angles,
    random_rotations,
    reach,
    rotation_error,
)
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from jaxbiped import robot
from jaxbiped.kinematics import AT_JOINT_LIMIT, OK, OUT_OF_REACH, STATUS_TEXT, body, leg

N = 10_000
forward = jax.jit(jax.vmap(leg.forward, (None, None, 0)), static_argnums=1)
inverse = jax.jit(jax.vmap(leg.inverse, (None, None, 0, 0)), static_argnums=1)
PRECISION = [("float64", 1e-10, 1e-9), ("float32", 1e-5, 3e-4)]
"""Type, largest error of the pose [m, rad] and of the joint angles [rad]."""


def short(name: str) -> str:
    return name.split("/")[-1]


def back_and_forth(params, side, positions, rotations):
    """Joint angles, statuses, and the pose they give."""
    found = inverse(params, side, jnp.asarray(positions), jnp.asarray(rotations))
    pose = forward(params, side, found.angle)
    return (
        np.asarray(found.angle),
        np.asarray(found.status),
        np.asarray(pose.p_pelvis_sole),
        np.asarray(pose.rot_pelvis_sole),
    )


def joint_limits(params, side):
    """As they are computed with: in float32 some are further out than in the robot's file, by half a digit."""
    return np.moveaxis(np.asarray(robot.on_device(params).joint_range[side]), -1, 0)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("name", ROBOTS, ids=short)
@pytest.mark.parametrize(("dtype", "pose_error", "angle_error"), PRECISION)
def test_undoes_forward_everywhere_in_the_joint_ranges(dtype, pose_error, angle_error, name, side):
    with jax.enable_x64(dtype == "float64"):
        params = load(name)
        lower, upper = joint_limits(params, side)
        # A float32 pose of a leg at a limit may read as one just beyond it.
        margin = 0.0 if dtype == "float64" else 2e-3
        angles = np.clip(random_angles(params, N)[:, side], lower + margin, upper - margin)
        target = forward(params, side, jnp.asarray(angles))
        found, status, position, rotation = back_and_forth(
            params, side, target.p_pelvis_sole, target.rot_pelvis_sole
        )
        assert found.dtype == dtype
        np.testing.assert_allclose(position, target.p_pelvis_sole, rtol=0, atol=pose_error)
        assert rotation_error(rotation, target.rot_pelvis_sole).max() < pose_error
        assert (status == OK).all()
        # With the hip near the ankle's roll axis, rounding of the pose turns the ankle's roll and the hip.
        arm = hip_to_ankle(params, side, position, rotation)
        off_axis = np.linalg.norm(np.cross(arm, rotation[..., 0]), axis=-1)
        clear = off_axis > 0.03
        assert clear.mean() > 0.95
        np.testing.assert_allclose(found[clear], angles[clear], rtol=0, atol=angle_error)


@pytest.mark.parametrize("name", ROBOTS, ids=short)
def test_deep_squat_is_found_though_the_hip_sinks_below_the_ankle_s_horizon(x64, name):
    params, side = load(name), robot.LEFT
    lower, upper = joint_limits(params, side)
    angle = 0.5 * (lower + upper)
    angle[robot.KNEE], angle[4] = upper[robot.KNEE] - 0.01, upper[4] - 0.01
    position, rotation = leg_forward(params, side, angle)
    assert -hip_to_ankle(params, side, position, rotation) @ rotation[:, 2] < 0.0
    found = inverse(params, side, jnp.asarray(position)[None], jnp.asarray(rotation)[None])
    assert found.status == OK
    np.testing.assert_allclose(found.angle[0], angle, atol=1e-12)


def anything(params, side, n=N, seed=3):
    """Foot poses (n, 3), (n, 3, 3): any rotation, ankles from the hip to beyond the leg's reach by half."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rotations = random_rotations(n, seed)
    ankle = np.asarray(params.p_pelvis_hip[side]) + direction * rng.uniform(
        0.0, 1.5 * reach(params, side)[1], (n, 1)
    )
    return ankle - float(params.ankle_height) * rotations[:, :, 2], rotations


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("name", ROBOTS, ids=short)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_any_target_has_the_right_status_and_angles_within_the_joint_ranges(dtype, name, side):
    with jax.enable_x64(dtype == "float64"):
        params = load(name)
        targets, rotations = anything(params, side)
        angles, status, position, rotation = back_and_forth(params, side, targets, rotations)
        lower, upper = joint_limits(params, side)
        assert np.isfinite(angles).all()
        assert ((angles >= lower) & (angles <= upper)).all()
        distance = np.linalg.norm(hip_to_ankle(params, side, targets, rotations), axis=-1)
        shortest, longest = reach(params, side)
        beyond = (distance < shortest) | (distance > longest)
        clear = np.minimum(np.abs(distance - shortest), np.abs(distance - longest)) > 1e-5
        np.testing.assert_array_equal((status == OUT_OF_REACH)[clear], beyond[clear])
        at_limit = ((angles == lower) | (angles == upper)).any(axis=1)
        assert at_limit[status == AT_JOINT_LIMIT].all()
        error = np.linalg.norm(position - targets, axis=1) + rotation_error(rotation, rotations)
        assert error[status == OK].max(initial=0.0) < (1e-9 if dtype == "float64" else 2e-5)
        assert error[status != OK].min() > (1e-9 if dtype == "float64" else 0.0)
        assert min(np.bincount(status, minlength=3)[[OUT_OF_REACH, AT_JOINT_LIMIT]]) > 1000


def test_every_status_has_its_text():
    assert [STATUS_TEXT[s] for s in (OK, OUT_OF_REACH, AT_JOINT_LIMIT)] == [
        "ok",
        "out of reach",
        "at a joint limit",
    ]


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("joint", [joint for joint in robot.JOINT_NAMES if joint != "knee"])
def test_one_joint_beyond_its_range_stops_at_it(x64, side, joint):
    params, joint = load("surena3"), robot.JOINT_NAMES.index(joint)
    lower, upper = joint_limits(params, side)
    for limit, beyond in ((lower[joint], lower[joint] - 0.05), (upper[joint], upper[joint] + 0.05)):
        angle = 0.5 * (lower + upper)
        angle[joint] = beyond
        position, rotation = leg_forward(params, side, angle)
        found = inverse(params, side, jnp.asarray(position)[None], jnp.asarray(rotation)[None])
        assert found.status == AT_JOINT_LIMIT
        angle[joint] = limit
        np.testing.assert_allclose(found.angle[0], angle, atol=1e-12)


def beyond_reach(params, side, n, seed):
    """Poses whose ankle lies nearer to or farther from the hip than the leg can be, off in all directions.

    Poses from the middle of the joint ranges, pushed along the leg, so that no other joint is in the way.
    """
    rng = np.random.default_rng(seed)
    lower, upper = joint_limits(params, side)
    middle = rng.uniform(0.75 * lower + 0.25 * upper, 0.25 * lower + 0.75 * upper, (n, 6))
    middle[:, robot.KNEE] = np.where(rng.random(n) < 0.7, BENT, upper[robot.KNEE] - 1e-3)
    poses = [leg_forward(params, side, angle) for angle in middle]
    rotations = np.array([rotation for _, rotation in poses])
    arms = hip_to_ankle(params, side, np.array([position for position, _ in poses]), rotations)
    factor = np.where(middle[:, robot.KNEE] == BENT, rng.uniform(1.001, 1.4, n), rng.uniform(0.3, 0.999, n))
    ankles = np.asarray(params.p_pelvis_hip[side]) + arms * factor[:, None]
    return ankles - float(params.ankle_height) * rotations[:, :, 2], rotations


def nearest(params, side, target, rotation, start):
    """Smallest distance [m] from `target` to a sole with that rotation: SciPy over all six joints."""
    lower, upper = joint_limits(params, side)
    bounds = list(zip(lower, upper, strict=True))
    bounds[robot.KNEE] = (max(0.01, lower[robot.KNEE]), upper[robot.KNEE])

    def turned(angle):
        return Rotation.from_matrix(leg_forward(params, side, angle)[1] @ rotation.T).as_rotvec()

    def square(angle):
        return np.sum((leg_forward(params, side, angle)[0] - target) ** 2)

    best = minimize(
        square,
        np.clip(start, *np.transpose(bounds)),
        method="SLSQP",
        bounds=bounds,
        constraints={"type": "eq", "fun": turned},
        options={"ftol": 1e-14, "maxiter": 300},
    )
    assert np.abs(turned(best.x)).max() < 1e-6
    return np.sqrt(best.fun)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("name", PRESETS)
def test_beyond_reach_gives_the_nearest_pose_that_scipy_finds(x64, name, side):
    params = load(name)
    targets, rotations = beyond_reach(params, side, 400, seed=5)
    angles, status, position, rotation = back_and_forth(params, side, targets, rotations)
    assert (status == OUT_OF_REACH).all()
    lower, upper = joint_limits(params, side)
    free = ((angles > lower) & (angles < upper))[:, [0, 1, 2, 4, 5]].all(axis=1)
    assert free.sum() > 100
    assert rotation_error(rotation, rotations)[free].max() < 1e-9
    distance = np.linalg.norm(position - targets, axis=1)
    rng = np.random.default_rng(7)
    for i in np.flatnonzero(free)[:4]:
        starts = [angles[i] + rng.normal(scale=0.15, size=6) for _ in range(2)]
        found = [nearest(params, side, targets[i], rotations[i], start) for start in starts]
        assert distance[i] == pytest.approx(min(found), abs=2e-6)


@pytest.mark.parametrize("name", ROBOTS, ids=short)
def test_beyond_reach_no_other_ankle_within_reach_is_nearer(x64, name):
    """The ankle may lie anywhere in a shell around the hip: try 20,000 of its points for every target."""
    params, side = load(name), robot.LEFT
    targets, rotations = beyond_reach(params, side, 100, seed=11)
    angles, _, position, _ = back_and_forth(params, side, targets, rotations)
    lower, upper = joint_limits(params, side)
    free = ((angles > lower) & (angles < upper))[:, [0, 1, 2, 4, 5]].all(axis=1)
    assert free.sum() > 20
    rng = np.random.default_rng(2)
    direction = rng.normal(size=(20_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    shortest, longest = reach(params, side)
    radius = np.concatenate(
        [np.full(5_000, shortest), np.full(5_000, longest), rng.uniform(shortest, longest, 10_000)]
    )
    ankles = np.asarray(params.p_pelvis_hip[side]) + direction * radius[:, None]
    for i in np.flatnonzero(free):
        wanted = targets[i] + float(params.ankle_height) * rotations[i][:, 2]
        nearest_sample = np.linalg.norm(ankles - wanted, axis=1).min()
        got = np.linalg.norm(position[i] - targets[i])
        assert got <= nearest_sample + 1e-9
        assert got > nearest_sample - 0.03  # the samples are dense enough to mean something


@pytest.mark.parametrize("name", ROBOTS, ids=short)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_mirrored_target_gives_mirrored_angles(dtype, name):
    with jax.enable_x64(dtype == "float64"):
        params = load(name)
        targets, rotations = anything(params, robot.LEFT)
        left = inverse(params, robot.LEFT, jnp.asarray(targets), jnp.asarray(rotations))
        right = inverse(
            params, robot.RIGHT, jnp.asarray(targets @ MIRROR), jnp.asarray(MIRROR @ rotations @ MIRROR)
        )
        np.testing.assert_array_equal(left.status, right.status)
        np.testing.assert_allclose(
            left.angle * MIRRORED_JOINT, right.angle, atol=1e-9 if dtype == "float64" else 1e-4
        )


@pytest.mark.parametrize("name", PRESETS)
def test_both_legs_at_once(x64, name):
    params = load(name)
    for angles in random_angles(params, 3):
        poses = [leg_forward(params, side, angles[side]) for side in SIDES]
        positions, rotations = (jnp.asarray(np.array(part)) for part in zip(*poses, strict=True))
        found, status = body.joint_angles(params, positions, rotations)
        np.testing.assert_allclose(found, angles, atol=1e-9)
        np.testing.assert_array_equal(status, OK)
    flat = jnp.asarray(params.p_pelvis_hip) - jnp.array([0.0, 0.0, 0.5])
    unturned = jnp.broadcast_to(jnp.eye(3), (2, 3, 3))
    for one, other in zip(
        body.joint_angles(params, flat), body.joint_angles(params, flat, unturned), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def changed(params: robot.RobotParams, factor: float) -> robot.RobotParams:
    """The same robot with every number another one."""
    return jax.tree.map(lambda leaf: leaf * factor, params)


@pytest.mark.parametrize("side", SIDES)
def test_one_compilation_serves_all_robots_and_targets(side):
    params = load("surena3")
    runs = []

    @jax.jit
    def there_and_back(params, position, rotation):
        runs.append("traced")
        found = leg.inverse(params, side, position, rotation)
        return leg.forward(params, side, found.angle).p_pelvis_sole

    results = set()
    for factor in (1.0, 1.1, 0.9):
        for target in anything(params, side, 3)[0]:
            for rotation in random_rotations(2):
                result = there_and_back(changed(params, factor), jnp.asarray(target), jnp.asarray(rotation))
                results.add(tuple(np.asarray(result)))
    assert runs == ["traced"]
    assert len(results) == 18


def test_a_batch_of_robots_is_each_robot_by_itself(x64):
    params = load("surena3")
    factors = [0.8, 1.0, 1.3]
    many = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(changed(params, f) for f in factors))
    position, rotation = jnp.array([0.05, 0.1, -0.6]), jnp.asarray(random_rotations(1)[0])
    batch = jax.jit(jax.vmap(leg.inverse, (0, None, None, None)), static_argnums=1)(
        many, robot.LEFT, position, rotation
    )
    for i, factor in enumerate(factors):
        one = inverse(changed(params, factor), robot.LEFT, position[None], rotation[None])
        np.testing.assert_allclose(batch.angle[i], one.angle[0], atol=1e-12)
        assert batch.status[i] == one.status[0]

"""Inertia helpers against clouds of point masses summed one by one."""

import numpy as np
import pytest

from jaxbiped.robot import inertia as rigid

Cloud = tuple[np.ndarray, np.ndarray]


def sum_up(cloud: Cloud) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia about it of point masses, from the definitions."""
    masses, points = cloud
    mass = masses.sum()
    com = (masses[:, None] * points).sum(0) / mass
    inertia = np.zeros((3, 3))
    for m, (x, y, z) in zip(masses, points - com, strict=True):
        inertia += m * np.array(
            [
                [y * y + z * z, -x * y, -x * z],
                [-x * y, x * x + z * z, -y * z],
                [-x * z, -y * z, x * x + y * y],
            ]
        )
    return mass, com, inertia


def random_cloud(rng: np.random.Generator) -> Cloud:
    return rng.uniform(0.1, 3.0, 30), rng.normal(scale=rng.uniform(0.1, 2.0, 3), size=(30, 3)) + rng.normal(
        size=3
    )


@pytest.mark.parametrize("seed", range(20))
def test_welded_bodies_are_the_cloud_of_all_their_points(seed):
    rng = np.random.default_rng(seed)
    clouds = [random_cloud(rng) for _ in range(1 + seed % 4)]
    masses, coms, inertias = map(np.array, zip(*map(sum_up, clouds), strict=True))
    whole = sum_up((np.concatenate([c[0] for c in clouds]), np.concatenate([c[1] for c in clouds])))
    for got, wanted in zip(rigid.combine(masses, coms, inertias), whole, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("size", [(0.2, 0.4, 0.5), (1.0, 1.0, 1.0), (0.01, 2.0, 0.3)])
def test_box_is_a_fine_grid_of_points(size):
    n, mass = 20, 7.0
    ticks = (np.arange(n) + 0.5) / n - 0.5
    points = np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3) * size
    _, com, inertia = sum_up((np.full(n**3, mass / n**3), points))
    np.testing.assert_allclose(com, 0.0, atol=1e-12)
    # n points in a row have 1 - 1/n^2 of the second moment of a solid row.
    np.testing.assert_allclose(
        rigid.box_inertia(mass, np.array(size)) * (1.0 - 1.0 / n**2), inertia, atol=1e-12
    )


@pytest.mark.parametrize("seed", range(10))
def test_mirror_is_that_of_the_mirrored_cloud(seed):
    masses, points = random_cloud(np.random.default_rng(seed))
    _, com, inertia = sum_up((masses, points))
    _, mirrored_com, mirrored_inertia = sum_up((masses, points * [1.0, -1.0, 1.0]))
    np.testing.assert_allclose(rigid.mirror_vector(com), mirrored_com, atol=1e-12)
    np.testing.assert_allclose(rigid.mirror_inertia(inertia), mirrored_inertia, atol=1e-12)


def test_matrix_from_six_numbers_in_the_order_xx_yy_zz_xy_xz_yz():
    np.testing.assert_array_equal(
        rigid.inertia_matrix(np.arange(1.0, 7.0)), [[1.0, 4.0, 5.0], [4.0, 2.0, 6.0], [5.0, 6.0, 3.0]]
    )
    np.testing.assert_array_equal(rigid.inertia_matrix(np.array([1.0, 2.0, 3.0])), np.diag([1.0, 2.0, 3.0]))


@pytest.mark.parametrize("seed", range(10))
def test_inertia_of_any_cloud_is_physical_and_stops_being_so_beyond_the_flat_one(seed):
    rng = np.random.default_rng(seed)
    masses, points = random_cloud(rng)
    assert rigid.is_physical(sum_up((masses, points))[2])
    flat = sum_up((masses, points * [1.0, 1.0, 0.0]))[2]  # the largest moment is the sum of the others
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert rigid.is_physical(turn @ flat @ turn.T)
    assert not rigid.is_physical(turn @ (flat + 0.01 * flat[2, 2] * np.diag([0.0, 0.0, 1.0])) @ turn.T)
    assert not rigid.is_physical(turn @ np.diag([-1e-3, 1.0, 1.0]) @ turn.T)
    assert not rigid.is_physical(np.zeros((3, 3)))

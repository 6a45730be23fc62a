"""Inertia of rigid bodies: boxes, composites, mirror images, and the test that a matrix can be one at all."""

import numpy as np


def box_inertia(mass: float, size: np.ndarray) -> np.ndarray:
    """Return the inertia matrix (3, 3) [kg m2] of a uniform box of `size` (3,) [m] about its center."""
    squares = np.asarray(size, float) ** 2
    return mass / 12.0 * np.diag(squares.sum() - squares)


def inertia_matrix(numbers: np.ndarray) -> np.ndarray:
    """Return (3, 3) [kg m2] from three principal moments or from (xx, yy, zz, xy, xz, yz)."""
    numbers = np.asarray(numbers, float)
    xx, yy, zz, xy, xz, yz = np.concatenate([numbers, np.zeros(6 - numbers.size)])
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def is_physical(inertia: np.ndarray) -> bool:
    """Tell whether some mass distribution has this inertia: positive moments, none above the sum of the others."""
    moments = np.linalg.eigvalsh(inertia)
    return bool(moments[0] > 0.0 and moments[2] <= (moments[0] + moments[1]) * (1.0 + 1e-9))


def combine(
    masses: np.ndarray, coms: np.ndarray, inertias: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Weld n bodies into one by the parallel-axis theorem.

    Args:
        masses: (n,) [kg].
        coms: (n, 3) centers of mass in one common frame [m].
        inertias: (n, 3, 3) about each center of mass, common axes [kg m2].

    Returns:
        Mass [kg], center of mass (3,) [m], inertia (3, 3) about it [kg m2].
    """
    mass = float(np.sum(masses))
    com = np.einsum("n,ni->i", masses, coms) / mass
    arms = np.asarray(coms) - com
    steiner = np.einsum("n,nk,nk->n", masses, arms, arms).sum() * np.eye(3)
    steiner -= np.einsum("n,ni,nj->ij", masses, arms, arms)
    return mass, com, np.sum(inertias, axis=0) + steiner


def mirror_vector(vector: np.ndarray) -> np.ndarray:
    """Reflect position vectors (..., 3) in the sagittal plane, y -> -y."""
    return np.asarray(vector, float) * np.array([1.0, -1.0, 1.0])


def mirror_inertia(inertia: np.ndarray) -> np.ndarray:
    """Reflect inertia matrices (..., 3, 3) in the sagittal plane: xy and yz change sign."""
    flip = np.array([1.0, -1.0, 1.0])
    return np.asarray(inertia, float) * np.outer(flip, flip)

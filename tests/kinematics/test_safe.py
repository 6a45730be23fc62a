"""Every guarded function: right away from its singular point, finite value and derivative at it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped.kinematics import safe

TINY = [0.0, -0.0, 1e-45, 1e-38, 1e-30, 1e-22, 1e-20, 1e-19, 3e-19, 1e-18, 1e-15, 1e-8]
"""Distances from the singular point; squares of the middle ones underflow in float32."""


def derivatives(function, *args):
    """Forward and reverse derivatives with respect to all arguments, one after the other."""
    every = tuple(range(len(args)))
    return [np.stack(jax.jit(d(function, argnums=every))(*args)) for d in (jax.jacfwd, jax.jacrev)]


def assert_both_are(function, args, wanted, rtol=0.0):
    for derivative in derivatives(function, *args):
        np.testing.assert_allclose(derivative, wanted, rtol=rtol)


def test_norm_at_zero():
    assert safe.norm(jnp.zeros(3)) == 0.0
    assert_both_are(safe.norm, [jnp.zeros(3)], np.zeros((1, 3)))


def test_sqrt_at_zero_and_below():
    for x in (0.0, -0.0, -1.0, -1e-30):
        assert safe.sqrt(jnp.array(x)) == 0.0
        assert_both_are(safe.sqrt, [jnp.array(x)], [0.0])


@pytest.mark.parametrize(("y", "x"), [(0.0, 0.0), (-0.0, 0.0), (0.0, -0.0), (-0.0, -0.0)])
def test_atan2_at_the_origin(y, x):
    assert safe.atan2(jnp.array(y), jnp.array(x)) == 0.0
    assert_both_are(safe.atan2, [jnp.array(y), jnp.array(x)], [0.0, 0.0])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_finite_however_near_the_singular_point(dtype):
    with jax.enable_x64(dtype == "float64"):
        near = jnp.array([sign * d for d in TINY for sign in (1.0, -1.0)], dtype)
        y, x = (axis.ravel() for axis in jnp.meshgrid(near, near))
        for function, args in [
            (safe.sqrt, (near,)),
            (safe.atan2, (y, x)),
            (safe.norm, (jnp.stack([y, x, y], -1),)),
        ]:
            value = jax.jit(function)(*args)
            assert value.dtype == dtype and jnp.isfinite(value).all()
            for d in (jax.jacfwd, jax.jacrev):
                row = jax.jit(jax.vmap(d(function, argnums=tuple(range(len(args))))))
                for derivative in row(*args):
                    assert jnp.isfinite(derivative).all(), (function.__name__, d.__name__)


def test_values_and_derivatives_away_from_the_singular_point(x64):
    angle, distance = np.meshgrid(np.linspace(-3.1, 3.1, 50), [1e-9, 1e-3, 1.0, 1e3])
    y, x = jnp.asarray(distance * np.sin(angle)), jnp.asarray(distance * np.cos(angle))
    np.testing.assert_allclose(safe.atan2(y, x), angle, atol=1e-12)
    np.testing.assert_allclose(safe.norm(jnp.stack([x, y], -1)), distance, rtol=1e-12)
    np.testing.assert_allclose(safe.sqrt(jnp.asarray(distance)), distance**0.5, rtol=1e-12)
    x, y = 0.3, -0.7
    length = np.hypot(x, y)
    assert_both_are(safe.atan2, [jnp.array(y), jnp.array(x)], np.array([x, -y]) / length**2, 1e-12)
    assert_both_are(safe.norm, [jnp.array([x, y])], [[x / length, y / length]], 1e-12)
    assert_both_are(safe.sqrt, [jnp.array(0.25)], [1.0], 1e-12)

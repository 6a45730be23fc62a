"""How walks are compiled: with options where XLA knows them, without where it does not, once."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped.sim import compiling, jit_walks


class Turns(eqx.Module):
    """Something to compile: numbers, and a choice."""

    rotations: jax.Array
    times: int = eqx.field(static=True)


@pytest.fixture
def turns():
    """Rotations in a batch: the small products that the options are about."""
    random = np.random.default_rng(0)
    return Turns(jnp.asarray(np.linalg.qr(random.standard_normal((64, 3, 3)))[0], jnp.float32), 3)


@pytest.fixture
def counted():
    """A function to compile, and how often it was traced."""
    traced = []

    def turned(turns, vector):
        traced.append(None)
        for _ in range(turns.times):
            vector = jnp.einsum("nij,nj->ni", turns.rotations, vector)
        return {"vector": vector, "length": jnp.sqrt(jnp.sum(vector**2, axis=-1))}

    return turned, traced


@pytest.fixture
def asked_again():
    """XLA is asked again what it knows, before and after."""
    compiling.options.cache_clear()
    yield
    compiling.options.cache_clear()


def test_the_result_is_that_of_the_function_and_it_is_compiled_once(turns, counted):
    function, traced = counted
    compiled, vector = jit_walks(function), jnp.arange(192.0).reshape(64, 3)
    assert not traced
    for scale in (1.0, -2.0):
        got = compiled(turns, scale * vector)
        far = np.asarray(scale * vector, float)
        want = np.linalg.matrix_power(np.asarray(turns.rotations, float), 3) @ far[..., None]
        np.testing.assert_allclose(got["vector"], want[..., 0], rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(got["length"], np.linalg.norm(want[..., 0], axis=1), rtol=1e-5)
    assert len(traced) == 1
    compiled(Turns(turns.rotations, 2), vector)
    assert len(traced) == 2


def test_names_and_words_stay(counted):
    function, _ = counted
    assert jit_walks(function).__name__ == function.__name__


def test_this_xla_knows_the_options(asked_again):
    """An upgrade that forgets them would cost a tenth of the speed without a word."""
    assert compiling.options() == compiling.OPTIONS


def test_options_that_xla_does_not_know_are_left_out(turns, counted, asked_again, monkeypatch):
    monkeypatch.setattr(compiling, "OPTIONS", {"xla_cpu_no_such_option": ""})
    assert compiling.options() == {}
    got = jit_walks(counted[0])(turns, jnp.ones((64, 3)))
    np.testing.assert_allclose(got["length"], np.sqrt(3.0), rtol=1e-5)

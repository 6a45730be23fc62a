"""The cosine gait against elkahlout Eqs. 3.1 to 3.6 as printed (3.6 with its erratum), in NumPy."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import robot
from jaxbiped.planner import DOUBLE_SUPPORT, SINGLE_SUPPORT, CosineGait, CosineParams, at
from jaxbiped.robot import LEFT, RIGHT

RANDOM = 200
SAMPLES = 400
WALKS = [(n_steps, first_swing) for n_steps in (1, 2, 5) for first_swing in (LEFT, RIGHT)]
JUMP = 1e-9
"""Largest jump of position [m] and velocity [m/s] at a phase change."""
BESIDE = 1e-12


@pytest.fixture
def batch(x64):
    """The thesis' parameters, then random ones."""
    rng = np.random.default_rng(1)
    lower = dict(t_ss=0.5, t_ds=0.2, b_s=0.0, w=-0.15, w_of=0.1, h_b=0.4, h_s=0.01, x_ref=-0.1, y_ref=-0.05)
    upper = dict(t_ss=2.0, t_ds=1.5, b_s=0.12, w=0.15, w_of=0.2, h_b=0.6, h_s=0.1, x_ref=0.1, y_ref=0.05)
    every = [CosineGait.preset_params("elkahlout")]
    for _ in range(RANDOM):
        random = {name: rng.uniform(lower[name], upper[name]) for name in lower}
        every.append(CosineParams(**random, T_ini=rng.uniform(0.4, 2.0), T_end=rng.uniform(0.4, 2.0)))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *every)


@functools.cache
def _targets(n_steps: int, first_swing: int):
    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0, 0))
    def targets(elkahlout, params, times):
        gait = CosineGait.make(elkahlout, params, n_steps, first_swing)
        return jax.vmap(lambda t: at(gait, t))(times)

    return targets


def _walk(batch, times, n_steps, first_swing):
    """Targets as NumPy arrays; `times` (n,) are shares of the walk or (batch, n) seconds, n <= SAMPLES."""
    if np.ndim(times) == 1:
        times = times * _duration(batch, n_steps)
    count = times.shape[1]
    padded = np.pad(times, ((0, 0), (0, SAMPLES - count)), mode="edge")
    got = _targets(n_steps, first_swing)(robot.load("elkahlout"), batch, jnp.asarray(padded))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:, :count], got)


def _column(leaf):
    return np.asarray(leaf)[:, None]


def _duration(batch, n_steps):
    return _column(batch.T_ini + n_steps * (batch.t_ss + batch.t_ds) + batch.T_end)


def _liftoff(batch, n_steps):
    return _column(batch.T_ini + 0.5 * batch.t_ds) + np.arange(n_steps) * _column(batch.t_ss + batch.t_ds)


def _flat(space):
    return np.concatenate([space.sole.reshape(*space.sole.shape[:2], 6), space.pelvis], axis=-1)


def _thesis(p: dict[str, float], t: float) -> np.ndarray:
    """Feet in the body frame, left and right (2, 3), at the thesis' time t: Eqs. 3.1-3.6, case by case."""
    t_ss, t_ds, b_s, h_s = p["t_ss"], p["t_ds"], p["b_s"], p["h_s"]
    t = t % (2 * t_ds + 2 * t_ss)
    if t < t_ds / 2:
        x = b_s
    elif t < t_ds / 2 + t_ss:
        x = b_s * np.cos((t - t_ds / 2) * np.pi / t_ss)
    elif t < 3 / 2 * t_ds + t_ss:
        x = -b_s
    elif t < 3 / 2 * t_ds + 2 * t_ss:
        x = -b_s * np.cos((t - 3 / 2 * t_ds - t_ss) * np.pi / t_ss)
    else:
        x = b_s
    X_r = p["x_ref"] + x  # 3.1
    X_l = 2 * p["x_ref"] - X_r  # 3.2
    Y_r = p["y_ref"] - p["w_of"] + p["w"] * np.sin(t * np.pi / (t_ds + t_ss))  # 3.3
    Y_l = p["y_ref"] + p["w_of"] + p["w"] * np.sin(t * np.pi / (t_ds + t_ss))  # 3.4
    if 3 / 2 * t_ds + t_ss <= t < 3 / 2 * t_ds + 2 * t_ss:
        rise = h_s / 2 * (1 - np.cos((t - 3 / 2 * t_ds - t_ss) * 2 * np.pi / t_ss))
    else:
        rise = 0.0
    Z_r = -p["h_b"] + rise  # 3.5
    rise = 0.0
    if t_ds / 2 <= t < t_ds / 2 + t_ss:
        rise = h_s / 2 * (1 - np.cos((t - t_ds / 2) * 2 * np.pi / t_ss))  # erratum: t_ds / 2, as in 3.1
    Z_l = -p["h_b"] + rise  # 3.6
    return np.array([[X_l, Y_l, Z_l], [X_r, Y_r, Z_r]])


def test_golden_numbers_of_the_thesis(batch):
    T_ini = float(batch.T_ini[0])
    targets = _walk(batch, np.tile([T_ini, T_ini + 1.2], (RANDOM + 1, 1)), 2, LEFT)
    left, right = np.moveaxis((targets.position.sole - targets.position.pelvis[:, :, None])[0], 1, 0)
    assert np.allclose(right[0], [-0.01, -0.11, -0.5], rtol=0.0, atol=1e-12)
    assert np.allclose(left[0], [-0.17, 0.11, -0.5], rtol=0.0, atol=1e-12)
    assert np.allclose(right[1], [-0.09, 0.02, -0.5], rtol=0.0, atol=1e-12)
    assert np.allclose(left[1], [-0.09, 0.24, -0.47], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("n_steps", [2, 5])
def test_feet_in_the_body_frame_are_equations_3_1_to_3_6(n_steps, batch):
    """From t = 0 of the thesis to the last double support; 5 steps are two and a half cycles."""
    since = np.linspace(0.0, 1.0, SAMPLES, endpoint=False) * n_steps * _column(batch.t_ss + batch.t_ds)
    targets = _walk(batch, since + _column(batch.T_ini), n_steps, LEFT)
    got = targets.position.sole - targets.position.pelvis[:, :, None]
    for i in range(0, RANDOM + 1, 10):
        p = {name: float(getattr(batch, name)[i]) for name in vars(batch)}
        expected = np.array([_thesis(p, t) for t in since[i]])
        assert np.allclose(got[i], expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(("n_steps", "first_swing"), WALKS)
def test_position_and_velocity_are_continuous(n_steps, first_swing, batch):
    """The acceleration jumps at lift-off and touchdown, as cosines do; not in start, stop and lateral sway."""
    liftoff, t_ss = _liftoff(batch, n_steps), _column(batch.t_ss)
    walking, stopping = _column(batch.T_ini), _duration(batch, n_steps) - _column(batch.T_end)
    start_stop = np.concatenate([0.0 * walking, walking, stopping, _duration(batch, n_steps)], axis=1)
    changes = np.concatenate([start_stop, liftoff, liftoff + t_ss], axis=1)
    before, after = (_walk(batch, changes + s, n_steps, first_swing) for s in (-BESIDE, BESIDE))
    for derivative in ("position", "velocity"):
        jump = _flat(getattr(after, derivative)) - _flat(getattr(before, derivative))
        assert np.abs(jump).max() < JUMP, derivative
    jump = np.abs(_flat(after.acceleration) - _flat(before.acceleration))
    assert jump[:, :4].max() < JUMP
    assert jump[..., 7].max() < JUMP  # pelvis y
    swing_x = np.asarray(2.0 * batch.b_s * (np.pi / batch.t_ss) ** 2)
    assert np.allclose(jump[:, 4:, [0, 3]].max(axis=-1), swing_x[:, None], rtol=1e-6, atol=1e-9)


@jax.jit
def _motion(gait, times):
    """Position, velocity and acceleration of soles and pelvis (3, times, 9)."""
    targets = jax.vmap(lambda t: at(gait, t))(times)
    orders = (targets.position, targets.velocity, targets.acceleration)
    return [jnp.concatenate([order.sole.reshape(-1, 6), order.pelvis], axis=1) for order in orders]


@pytest.mark.parametrize(("double", "h", "atol"), [(False, 1e-2, 2e-4), (True, 1e-4, 1e-7)])
@pytest.mark.parametrize(("n_steps", "first_swing"), [(1, RIGHT), (2, LEFT)])
def test_rates_at_a_phase_change_are_those_on_either_side(n_steps, first_swing, double, h, atol):
    """By forward differentiation at the very instant, where a clipped time would halve them."""
    with jax.enable_x64(double):
        gait = CosineGait.preset(robot.load("elkahlout"), n_steps, first_swing)
        p, timing = gait.params, gait.timing
        instants = [p.T_ini, p.T_ini + n_steps * p.T_c, timing.liftoff(0), timing.touchdown(n_steps - 1)]
        instant = np.asarray(jnp.stack(instants))[:, None]
        # one of three neighbours is the instant as the compiled walk has it
        there = np.concatenate([np.nextafter(instant, 0.0), instant, np.nextafter(instant, 99.0)], axis=1)
        beside = instant + h * np.arange(-2, 3, dtype=instant.dtype)
        times = np.concatenate([there, beside], axis=1)
        position, velocity, acceleration = (
            np.asarray(order).reshape(*times.shape, 9) for order in _motion(gait, jnp.asarray(times.ravel()))
        )
    before, after = position[:, [5, 4, 3]], position[:, [5, 6, 7]]
    for side, path in ((-h, before), (h, after)):
        slope = (-1.5 * path[:, 0] + 2.0 * path[:, 1] - 0.5 * path[:, 2]) / side
        np.testing.assert_allclose(velocity[:, :3], np.stack([slope] * 3, axis=1), rtol=0.0, atol=atol)
    one_side = np.stack([acceleration[:, 4], acceleration[:, 6]])
    nearest = np.abs(acceleration[:, :3, None] - np.moveaxis(one_side, 0, 1)[:, None]).min(axis=2)
    assert nearest.max() < 3.0 * h


@pytest.mark.parametrize(("n_steps", "first_swing"), WALKS)
def test_feet_stand_still_or_swing_over_the_ground(n_steps, first_swing, batch):
    targets = _walk(batch, (np.arange(SAMPLES) + 0.5) / SAMPLES, n_steps, first_swing)
    sole, phase = targets.position.sole, targets.phase
    swinging = (phase.support == SINGLE_SUPPORT)[..., None] & (phase.swing[..., None] == np.arange(2))
    assert np.all(sole[..., 2][~swinging] == 0.0)
    assert np.all(targets.velocity.sole[~swinging] == 0.0)
    assert np.all(targets.acceleration.sole[~swinging] == 0.0)
    assert np.all(sole[..., 2][swinging] > 0.0)
    w_of = np.asarray(batch.w_of)[:, None, None]
    assert np.array_equal(sole[..., 1], np.broadcast_to(w_of * [1.0, -1.0], sole.shape[:-1]))
    # a foot that stands is b_s ahead of or behind the middle, 2 b_s further in every step
    stance = np.take_along_axis(sole[..., 0], 1 - phase.swing[..., None], axis=-1)[..., 0]
    foothold = _column(batch.x_ref) + (2 * phase.step + 1) * _column(batch.b_s)
    assert np.allclose(stance, foothold, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize(("n_steps", "first_swing"), WALKS)
def test_walk_starts_and_stops_at_rest(n_steps, first_swing, batch):
    end = _duration(batch, n_steps)
    targets = _walk(
        batch, np.concatenate([0 * end - 5.0, 0 * end, end, end + 5.0], axis=1), n_steps, first_swing
    )
    for derivative in (targets.velocity, targets.acceleration):
        assert np.all(_flat(derivative)[:, [0, 3]] == 0.0)
        assert np.abs(_flat(derivative)).max() < 1e-9
    position, b_s = targets.position, np.asarray(batch.b_s)
    assert np.allclose(_flat(position)[:, [0, 3]], _flat(position)[:, [1, 2]], rtol=0.0, atol=1e-12)
    assert np.allclose(position.pelvis[..., 1], -_column(batch.y_ref), rtol=0.0, atol=1e-12)
    swing, stance = first_swing, 1 - first_swing
    x = position.sole[:, 0, :, 0] - np.asarray(batch.x_ref)[:, None]
    assert np.allclose(x[:, swing], -b_s, rtol=0.0, atol=1e-14)
    assert np.allclose(x[:, stance], b_s, rtol=0.0, atol=1e-14)
    assert np.allclose(position.pelvis[:, 0, 0], 0.0, atol=1e-14)
    assert np.allclose(position.pelvis[:, 3, 0], 2 * n_steps * b_s, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("n_steps", [1, 2, 5])
def test_walk_with_the_other_foot_first_is_the_mirror_image(n_steps, batch):
    mirrored = eqx.tree_at(lambda p: p.y_ref, batch, -batch.y_ref)
    shares = np.linspace(-0.05, 1.05, SAMPLES)
    left, right = _walk(batch, shares, n_steps, LEFT), _walk(mirrored, shares, n_steps, RIGHT)
    for derivative in ("position", "velocity", "acceleration"):
        a, b = getattr(left, derivative), getattr(right, derivative)
        assert np.array_equal(a.sole, b.sole[:, :, ::-1] * [1.0, -1.0, 1.0])
        assert np.array_equal(a.pelvis, b.pelvis * [1.0, -1.0, 1.0])
    assert np.array_equal(left.phase.swing, 1 - right.phase.swing)
    assert np.array_equal(left.phase.support, right.phase.support)


@pytest.mark.parametrize(("n_steps", "first_swing"), WALKS)
def test_phase_is_that_of_a_plain_time_table(n_steps, first_swing, batch):
    shares = np.linspace(-0.1, 1.1, SAMPLES)
    phase = _walk(batch, shares, n_steps, first_swing).phase
    times, liftoff = shares * _duration(batch, n_steps), _liftoff(batch, n_steps)
    for i in range(20):
        t_ss = float(batch.t_ss[i])
        for j, t in enumerate(times[i]):
            step = max((k for k in range(n_steps) if t >= liftoff[i, k]), default=0)
            since = t - liftoff[i, step]
            single = 0.0 <= since < t_ss
            in_phase = since if single else (t if since < 0.0 else since - t_ss)
            assert phase.step[i, j] == step
            assert phase.swing[i, j] == (first_swing if step % 2 == 0 else 1 - first_swing)
            assert phase.support[i, j] == (SINGLE_SUPPORT if single else DOUBLE_SUPPORT)
            assert abs(phase.time_in_phase[i, j] - in_phase) < 1e-12
            assert abs(phase.time_since_liftoff[i, j] - since) < 1e-12


def test_preset_is_section_3_2_of_the_thesis():
    p = CosineGait.preset_params("elkahlout")
    stated = dict(t_ss=1.4, t_ds=1.0, b_s=0.08, w=0.13, w_of=0.11, h_b=0.5, h_s=0.03, x_ref=-0.09, y_ref=0.0)
    for name, value in stated.items():
        assert float(getattr(p, name)) == np.float32(value), name

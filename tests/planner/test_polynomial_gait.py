"""The polynomial gait against closed forms, NumPy and SciPy, and laws that hold for every walk."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import polynomial_walks
import pytest
import surena3_gaits
from polynomial_walks import KNOWN, LONG_WALKS, WALKS, duration, one, planned
from polynomial_walks import targets as targets_at
from scipy.interpolate import CubicSpline

from jaxbiped import robot
from jaxbiped.planner import DOUBLE_SUPPORT, SINGLE_SUPPORT, PolynomialGait, at
from jaxbiped.planner.polynomial_gait import (
    steady_pelvis_x,
    steady_pelvis_y,
    steady_pelvis_z,
    swing_x,
    swing_z,
)
from jaxbiped.robot import LEFT, RIGHT

LONG = LONG_WALKS[0]
GAITS = range(len(KNOWN))
C = KNOWN.index("C")
JUMP = 1e-9
"""Largest jump of position [m], velocity [m/s] and acceleration [m/s2] at a phase change."""
BESIDE = 1e-13
"""How far beside a phase change [s]; a jerk of 500 m/s3 makes 1e-10 m/s2 of it."""


@pytest.fixture
def batch(x64):
    return polynomial_walks.batch()


def _phase_changes(batch, n_steps):
    """Start, every lift-off and touchdown, the extremes of the pelvis height, stop: (batch, n) [s]."""
    T_ini, T_s, T_d = (np.asarray(leaf)[:, None] for leaf in (batch.T_ini, batch.T_s, batch.T_d))
    liftoff = T_ini + np.arange(n_steps) * (T_s + T_d)
    highest, lowest = liftoff + 0.5 * T_s, liftoff + T_s + 0.5 * T_d
    first, end = T_ini - 0.5 * T_d, duration(n_steps)[:, None]
    changes = [np.zeros_like(T_ini), first, liftoff, liftoff + T_s, highest, lowest, end]
    return np.concatenate(changes, axis=1)


def _flat(space):
    """(batch, time, 9): both soles and the pelvis."""
    return np.concatenate([space.sole.reshape(*space.sole.shape[:2], 6), space.pelvis], axis=-1)


# Equations 1 to 5


def test_swing_foot_is_equations_1_and_2(batch):
    s = np.linspace(0.0, 1.0, 21)

    @jax.jit
    @jax.vmap
    def curves(p):
        x, z = swing_x(p), swing_z(p)
        by_order = [[jax.vmap(lambda t: c.derivative(t, o))(s * p.T_s) for o in (0, 1, 2)] for c in (x, z)]  # noqa: B023
        return jnp.asarray(by_order)

    got = curves(batch)
    T_s, H_max = np.asarray(batch.T_s)[:, None], np.asarray(batch.H_max)[:, None]
    x = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    z = 64.0 * np.polynomial.Polynomial([0, 0, 0, 1, -3, 3, -1])
    for order in (0, 1, 2):
        dx, dz = (x.deriv(order)(s), z.deriv(order)(s)) if order else (x(s), z(s))
        assert np.allclose(got[:, 0, order] * T_s**order, dx, rtol=0.0, atol=1e-11)
        assert np.allclose(got[:, 1, order] * T_s**order / H_max, dz, rtol=0.0, atol=1e-11)


def _monomials(t, n, order):
    """Row of the derivatives of 1, t, t**2, ... (NumPy)."""
    return np.array([np.polynomial.Polynomial.basis(k).deriv(order)(t) if order else t**k for k in range(n)])


def _equation_4(p) -> np.ndarray:
    """Nine coefficients, the quartic's and the cubic's, from the nine conditions (NumPy, powers of t)."""
    T_s, T_c = p.T_s, p.T_s + p.T_d
    rows, right = [], []

    def condition(value, ssp=None, dsp=None, sign=-1.0, order=0):
        row = np.zeros(9)
        if ssp is not None:
            row[:5] = _monomials(ssp, 5, order)
        if dsp is not None:
            row[5:] = _monomials(dsp, 4, order) * (1.0 if ssp is None else sign)
        rows.append(row)
        right.append(value)

    condition(p.y_d, ssp=0.0)
    condition(p.y_m, ssp=0.5 * T_s)
    condition(p.y_d, ssp=T_s)
    condition(p.y_d, dsp=T_s)
    condition(p.L_p - p.y_d, dsp=T_c)
    for order in (1, 2):
        condition(0.0, ssp=T_s, dsp=T_s, order=order)
        condition(0.0, ssp=0.0, dsp=T_c, sign=1.0, order=order)  # the next step is the mirror image
    return np.linalg.solve(rows, right)


@functools.cache
def _steady():
    """Eqs. 3 to 5 of every gait on a grid over both pieces: (gait, equation, order, piece, time)."""
    s = np.linspace(0.0, 1.0, 11)

    @jax.jit
    @jax.vmap
    def curves(p):
        knots = {
            steady_pelvis_x: (0.0, p.T_s, p.T_c),
            steady_pelvis_y: (0.0, p.T_s, p.T_c),
            steady_pelvis_z: (0.5 * p.T_s, p.T_s + 0.5 * p.T_d, p.T_c + 0.5 * p.T_s),
        }

        def on_grid(piece, order, a, b):
            return jax.vmap(lambda t: piece.derivative(t, order))(a + s * (b - a))

        return jnp.asarray(
            [
                [
                    [on_grid(piece, order, *k) for piece, k in zip(f(p), (t[:2], t[1:]), strict=True)]
                    for order in (0, 1, 2)
                ]
                for f, t in knots.items()
            ]
        )

    return np.asarray(curves(polynomial_walks.batch()))


@pytest.fixture
def steady(x64):
    return _steady()


def test_pelvis_x_is_equation_3(batch, steady):
    """Eight conditions: four values, C2 at T_s and, periodically, from T_c to 0; SciPy's periodic spline."""
    s = np.linspace(0.0, 1.0, 11)
    for i, got in enumerate(steady[:, 0]):
        p = one(i)
        T_c, speed = p.T_s + p.T_d, p.D_s / (p.T_s + p.T_d)
        knots = [0.0, p.T_s, T_c]
        less_drift = [-p.x_s, p.x_e - speed * p.T_s, -p.x_s]
        spline = CubicSpline(knots, less_drift, bc_type="periodic")
        for piece in (0, 1):
            t = knots[piece] + s * (knots[piece + 1] - knots[piece])
            drift = [speed * t, speed, 0.0]
            expected = np.array([spline(t, order) + drift[order] for order in (0, 1, 2)])
            assert np.allclose(got[:, piece], expected, rtol=0.0, atol=1e-9)


def test_pelvis_x_meets_the_conditions_of_equation_3(batch, steady):
    x = steady[:, 0]
    assert np.allclose(x[:, 0, 0, 0], -batch.x_s, rtol=0.0, atol=1e-9)
    assert np.allclose(x[:, 0, :, [-1, 0]][[0, 1], :, [0, 1]], batch.x_e, rtol=0.0, atol=1e-9)
    assert np.allclose(x[:, 0, 1, -1], batch.D_s - batch.x_s, rtol=0.0, atol=1e-9)
    assert np.abs(x[:, 1:, 0, -1] - x[:, 1:, 1, 0]).max() < JUMP
    assert np.abs(x[:, 1:, 0, 0] - x[:, 1:, 1, -1]).max() < JUMP


def test_pelvis_y_is_equation_4(batch, steady):
    s = np.linspace(0.0, 1.0, 11)
    for i, got in enumerate(steady[:, 1]):
        p = one(i)
        c = _equation_4(p)
        for piece, (a, b, coefficients) in enumerate(
            [(0.0, p.T_s, c[:5]), (p.T_s, p.T_s + p.T_d, c[5:])],
        ):
            oracle = np.polynomial.Polynomial(coefficients)
            t = a + s * (b - a)
            expected = np.array([oracle(t), oracle.deriv(1)(t), oracle.deriv(2)(t)])
            assert np.allclose(got[:, piece], expected, rtol=0.0, atol=1e-9)


def test_pelvis_y_meets_the_conditions_of_equation_4(batch, steady):
    y = steady[:, 1]
    assert np.allclose(y[:, 0, 0, 0], batch.y_d, rtol=0.0, atol=1e-9)
    assert np.allclose(y[:, 0, 0, 5], batch.y_m, rtol=0.0, atol=1e-9)
    assert np.allclose(y[:, 0, 0, -1], batch.y_d, rtol=0.0, atol=1e-9)
    assert np.allclose(y[:, 0, 1, -1], batch.L_p - batch.y_d, rtol=0.0, atol=1e-9)
    assert np.abs(y[:, :, 0, -1] - y[:, :, 1, 0]).max() < JUMP
    assert np.abs(y[:, 1:, 1, -1] + y[:, 1:, 0, 0]).max() < JUMP
    assert np.all(y[list(GAITS), 0, 0].argmin(axis=-1) == 5)  # y_m is the smallest distance


def test_pelvis_z_is_equation_5(batch, steady):
    """Each cubic between z_max and z_min with zero end slopes: 3 s**2 - 2 s**3."""
    s = np.linspace(0.0, 1.0, 11)
    drop = np.asarray(batch.z_min - batch.z_max)[:, None]
    half = np.asarray(0.5 * (batch.T_s + batch.T_d))[:, None]
    falling = np.polynomial.Polynomial([0, 0, 3, -2])
    for order in (0, 1, 2):
        d = falling.deriv(order)(s) if order else falling(s)
        down = drop * d / half**order + (np.asarray(batch.z_max)[:, None] if order == 0 else 0.0)
        up = -drop * d / half**order + (np.asarray(batch.z_min)[:, None] if order == 0 else 0.0)
        assert np.allclose(steady[:, 2, order, 0], down, rtol=0.0, atol=1e-9)
        assert np.allclose(steady[:, 2, order, 1], up, rtol=0.0, atol=1e-9)


# Whole walks


@pytest.mark.parametrize(("n_steps", "first_swing"), WALKS)
def test_walk_is_twice_continuously_differentiable(n_steps, first_swing, batch):
    """Soles and pelvis at every phase change, start and stop too, of gaits A to E and 200 random ones."""
    changes = _phase_changes(batch, n_steps)
    before = targets_at(changes - BESIDE, n_steps, first_swing)
    after = targets_at(changes + BESIDE, n_steps, first_swing)
    for derivative in ("position", "velocity", "acceleration"):
        jump = _flat(getattr(after, derivative)) - _flat(getattr(before, derivative))
        assert np.abs(jump).max() < JUMP, derivative


@pytest.mark.parametrize(("n_steps", "first_swing"), WALKS)
def test_walk_starts_and_stops_at_rest(n_steps, first_swing, batch):
    end = duration(n_steps)[:, None]
    times = np.concatenate([0.0 * end - 5.0, 0.0 * end, end, end + 5.0], axis=1)
    targets = targets_at(times, n_steps, first_swing)
    said = jax.vmap(lambda gait: gait.duration)(planned(n_steps, first_swing))
    position = _flat(targets.position)
    assert np.allclose(said, end[:, 0], rtol=1e-15)
    assert np.allclose(position[:, 0], position[:, 1], rtol=0.0, atol=1e-12)
    assert np.allclose(position[:, 2], position[:, 3], rtol=0.0, atol=1e-12)
    for derivative in (targets.velocity, targets.acceleration):
        assert np.all(_flat(derivative)[:, [0, 3]] == 0.0)
        assert np.abs(_flat(derivative)).max() < 1e-9
    sole, pelvis = targets.position.sole, targets.position.pelvis
    travelled, ends = (n_steps - 1) * np.asarray(batch.D_s), batch.start_stop
    assert np.allclose(sole[:, :2, :, 0], 0.0, atol=1e-12)
    assert np.allclose(sole[:, 2:, :, 0], travelled[:, None, None], rtol=0.0, atol=1e-12)
    assert np.allclose(pelvis[:, 0, 0], ends.x_rest_start, rtol=0.0, atol=1e-12)
    assert np.allclose(pelvis[:, -1, 0], travelled + np.asarray(ends.x_rest_end), rtol=0.0, atol=1e-12)
    assert np.allclose(pelvis[:, :, 1], 0.0, atol=1e-12)
    assert np.allclose(pelvis[:, :, 2], np.asarray(batch.z_min)[:, None], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(("n_steps", "first_swing"), WALKS)
def test_feet_stand_still_or_swing_over_the_ground(n_steps, first_swing, batch):
    targets = targets_at((np.arange(400) + 0.5) / 400, n_steps, first_swing)
    sole, phase = targets.position.sole, targets.phase
    L_p = np.asarray(batch.L_p)[:, None, None]
    assert sole[..., 2].min() > -1e-14
    assert np.allclose(sole[..., 1], 0.5 * L_p * [1.0, -1.0], rtol=0.0, atol=1e-16)
    swinging = (phase.support == SINGLE_SUPPORT)[..., None] & (phase.swing[..., None] == np.arange(2))
    assert np.all(sole[..., 2][~swinging] < 1e-14)
    assert np.all(targets.velocity.sole[~swinging] == 0.0)
    assert np.all(targets.acceleration.sole[~swinging] == 0.0)
    assert np.all(sole[..., 2][swinging] > 0.0)
    assert np.all(targets.velocity.sole[..., 0][swinging] >= -1e-12)  # never backwards
    stance = np.take_along_axis(sole[..., 0], 1 - phase.swing[..., None], axis=-1)[..., 0]
    assert np.allclose(stance, np.asarray(batch.D_s)[:, None] * phase.step, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("n_steps", [1, 2, 3, 8])
def test_walk_with_the_other_foot_first_is_the_mirror_image(n_steps, batch):
    shares = np.linspace(-0.05, 1.05, 400)
    left = targets_at(shares, n_steps, LEFT)
    right = targets_at(shares, n_steps, RIGHT)
    for derivative in ("position", "velocity", "acceleration"):
        a, b = getattr(left, derivative), getattr(right, derivative)
        assert np.array_equal(a.sole, b.sole[:, :, ::-1] * [1.0, -1.0, 1.0])
        assert np.array_equal(a.pelvis, b.pelvis * [1.0, -1.0, 1.0])
    assert np.array_equal(left.phase.swing, 1 - right.phase.swing)
    for name in ("step", "support", "time_in_phase", "time_since_liftoff"):
        assert np.array_equal(getattr(left.phase, name), getattr(right.phase, name))


def test_velocity_and_acceleration_are_those_of_finite_differences(batch):
    h, n_steps = 1e-4, 3
    changes = _phase_changes(batch, n_steps)
    times = np.linspace(0.01, 0.99, 60) * duration(n_steps)[:, None]
    clear = np.abs(times[:, :, None] - changes[:, None, :]).min(axis=-1) > 2 * h
    before, middle, after = (targets_at(times + s, n_steps, LEFT) for s in (-h, 0.0, h))
    velocity = (_flat(after.position) - _flat(before.position)) / (2 * h)
    acceleration = (_flat(after.velocity) - _flat(before.velocity)) / (2 * h)
    # the truncation error is h**2 / 6 times the third derivative of what is differentiated
    assert np.abs(velocity - _flat(middle.velocity))[clear].max() < 2e-6
    assert np.abs(acceleration - _flat(middle.acceleration))[clear].max() < 5e-5
    assert np.abs(acceleration[clear]).max() > 1.0


@pytest.mark.parametrize("first_swing", [LEFT, RIGHT])
def test_swing_foot_goes_from_foothold_to_foothold(first_swing, batch):
    """From that of step k - 1 to that of step k + 1, half way and highest in the middle; ends half as far."""
    n_steps = 8
    k = np.arange(n_steps)
    T_ini, T_s, T_d = (np.asarray(leaf)[:, None] for leaf in (batch.T_ini, batch.T_s, batch.T_d))
    liftoff = T_ini + k * (T_s + T_d)
    swing = (first_swing + k) % 2
    come_from, go_to = np.maximum(k - 1, 0), np.minimum(k + 1, n_steps - 1)
    for share, x, z in [
        (1e-9, come_from, 0.0),
        (0.5, 0.5 * (come_from + go_to), 1.0),
        (1 - 1e-9, go_to, 0.0),
    ]:
        targets = targets_at(liftoff + share * T_s, n_steps, first_swing)
        foot = targets.position.sole[:, k, swing]
        assert np.array_equal(targets.phase.swing, np.broadcast_to(swing, liftoff.shape))
        assert np.allclose(foot[..., 0], np.asarray(batch.D_s)[:, None] * x, rtol=0.0, atol=1e-9)
        assert np.allclose(foot[..., 2], np.asarray(batch.H_max)[:, None] * z, rtol=0.0, atol=1e-9)


def test_pelvis_passes_y_m_and_z_max_in_every_single_support_and_z_min_in_every_double_support(batch):
    n_steps = 8
    k = np.arange(n_steps)
    T_ini, T_s, T_d = (np.asarray(leaf)[:, None] for leaf in (batch.T_ini, batch.T_s, batch.T_d))
    liftoff = T_ini + k * (T_s + T_d)
    single = targets_at(liftoff + 0.5 * T_s, n_steps, LEFT)
    stance_y = np.take_along_axis(single.position.sole[..., 1], 1 - single.phase.swing[..., None], -1)[..., 0]
    from_stance = (single.position.pelvis[..., 1] - stance_y) * -np.sign(stance_y)
    assert np.allclose(from_stance, np.asarray(batch.y_m)[:, None], rtol=0.0, atol=1e-9)
    assert np.allclose(single.position.pelvis[..., 2], np.asarray(batch.z_max)[:, None], rtol=0.0, atol=1e-9)
    double = targets_at(liftoff + T_s + 0.5 * T_d, n_steps, LEFT)
    assert np.allclose(double.position.pelvis[..., 2], np.asarray(batch.z_min)[:, None], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("n_steps", "tolerance"), [(8, 2e-5), (24, 1e-12)])
def test_pelvis_x_in_the_middle_of_a_walk_is_equation_3(n_steps, tolerance, batch):
    """What is special about the first and the last step dies out by a factor of 4 or so from knot to knot."""
    shares = np.linspace(0.0, 1.0, 50, endpoint=False)
    k = n_steps // 2
    since_liftoff = shares * np.asarray(batch.T_s + batch.T_d)[:, None]
    times = since_liftoff + np.asarray(batch.T_ini + k * (batch.T_s + batch.T_d))[:, None]
    targets = targets_at(times, n_steps, LEFT)
    for i in GAITS:
        p = one(i)
        speed = p.D_s / (p.T_s + p.T_d)
        knots = [0.0, p.T_s, p.T_s + p.T_d]
        spline = CubicSpline(knots, [-p.x_s, p.x_e - speed * p.T_s, -p.x_s], bc_type="periodic")
        expected = k * p.D_s + speed * since_liftoff[i] + spline(since_liftoff[i])
        assert np.abs(targets.position.pelvis[i, :, 0] - expected).max() < tolerance


def _plain_phase(p, n_steps, first_swing, t):
    """Which step, foot and support, and the times, by walking through the time table."""
    begin = p.T_ini
    if t < begin:
        return 0, first_swing, DOUBLE_SUPPORT, t, t - begin
    for k in range(n_steps):
        last = k == n_steps - 1
        swing = first_swing if k % 2 == 0 else 1 - first_swing
        if t < begin + p.T_s:
            return k, swing, SINGLE_SUPPORT, t - begin, t - begin
        if last or t < begin + p.T_s + p.T_d:
            return k, swing, DOUBLE_SUPPORT, t - begin - p.T_s, t - begin
        begin += p.T_s + p.T_d
    raise AssertionError("a time after the last step belongs to it")


@pytest.mark.parametrize(("n_steps", "first_swing"), WALKS)
def test_phase_is_that_of_a_plain_time_table(n_steps, first_swing, batch):
    shares = np.linspace(-0.2, 1.2, 400)
    times = shares * duration(n_steps)[:, None]
    targets = targets_at(shares, n_steps, first_swing)
    phase = targets.phase
    for i in [*GAITS, *range(len(GAITS), len(GAITS) + 20)]:
        p = one(i)
        table = np.array([_plain_phase(p, n_steps, first_swing, t) for t in times[i]])
        got = (phase.step, phase.swing, phase.support, phase.time_in_phase, phase.time_since_liftoff)
        for column, field in zip(table.T, got, strict=True):
            assert np.allclose(field[i], column, rtol=0.0, atol=1e-12)


def test_make_with_known_numbers_in_float32_plans_the_same_walk_to_a_few_micrometres(batch):
    """Outside jit, where parameters are checked; 24 steps, so far from the origin and from time 0."""
    times = np.linspace(0.0, duration(LONG[0])[C], 400).astype(np.float32)
    expected = targets_at(np.tile(times.astype(float), (len(batch.D_s), 1)), *LONG)
    with jax.enable_x64(False):
        gait = PolynomialGait.make(robot.load("surena3"), surena3_gaits.params("C"), *LONG)
        got = jax.jit(lambda g, t: jax.vmap(lambda s: at(g, s).position)(t))(gait, jnp.asarray(times))
    assert got.pelvis.dtype == np.float32
    assert np.abs(got.sole - expected.position.sole[C]).max() < 5e-6
    assert np.abs(got.pelvis - expected.position.pelvis[C]).max() < 5e-6

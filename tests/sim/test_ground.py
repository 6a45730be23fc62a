"""What the ground does to a mass on a sole: no bounce, no energy from nothing, risers that push back, no jump."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxbiped import robot
from jaxbiped.kinematics import GRAVITY
from jaxbiped.sim import Scenario, ground, record
from jaxbiped.sim.mjx_adapter import BodyMotion
from jaxbiped.sim.physics.compliant import seen

TICKS = (5e-4, 1e-3, 2e-3)
"""Physics ticks [s] that all of this holds for."""
with jax.enable_x64(True):
    BIPED = robot.on_device(robot.load("surena3"))
    FLAT = Scenario.flat(2)


def sled(place: Any, velocity: Any) -> BodyMotion:
    """A left foot that cannot turn, its sole at a place [m], as far as the ground asks; the right one is away."""
    ankle = place + jnp.array([0.0, 0.0, 1.0]) * BIPED.ankle_height
    still = jnp.zeros(3)
    return BodyMotion(
        p_world_foot=jnp.stack([ankle, jnp.array([0.0, -5.0, 5.0])]),
        rot_world_foot=jnp.broadcast_to(jnp.eye(3), (2, 3, 3)),
        p_world_trunk=still,
        rot_world_trunk=jnp.eye(3),
        twist_foot=jnp.stack([jnp.concatenate([still, velocity]), jnp.zeros(6)]),
        centre=jnp.array([0.0, 0.0, 0.5]),
        dof_axes=jnp.zeros((18, 6)).at[:3, 3:].set(jnp.eye(3)),
        link_inertia=jnp.zeros((13, 10)),
        mass_matrix=jnp.zeros((18, 18)),
        bias=jnp.zeros(18),
    )


@partial(jax.jit, static_argnames=("dt", "ticks"))
def slide(scene: Scenario, mass: Any, place: Any, velocity: Any, gravity: Any, dt: float, ticks: int) -> Any:
    """A mass on that foot, tick by tick as in a roll-out: places, velocities, work of the ground, vertical force."""

    def tick(state: Any, _: None) -> Any:
        p, v, pressed, work = state
        body = sled(p, v)
        touch = ground.contact(BIPED, scene.ground, scene.terrain, body, pressed, dt)
        matrix = mass * jnp.eye(3) + dt * ground.damping_matrix(body, touch).trunk[:3, :3]
        weight = jnp.array([0.0, 0.0, -1.0]) * mass * gravity
        change = jnp.linalg.solve(matrix, dt * (touch.force[0].sum(axis=0) + weight))
        force = ground.force_after(body, touch, jnp.zeros(18).at[:3].set(change)).at[1].set(0.0)
        after = v + change
        work = work + dt * jnp.sum(force * after)
        pressed = ground.normal_force(eqx.tree_at(lambda t: t.force, touch, force))
        return (p + dt * after, after, pressed, work), (p + dt * after, after, work, force[..., 2].sum())

    start = (place, velocity, jnp.zeros((2, 4)), jnp.zeros(()))
    return jax.lax.scan(tick, start, None, length=ticks)[1]


@pytest.mark.parametrize("dt", TICKS)
def test_a_foot_set_down_does_not_bounce(x64, dt):
    """From a foot alone to a whole robot, at 0.02 to 0.3 m/s: it leaves the ground at less than a fifth of that."""
    lightest = float(min(robot.load(name).links.mass.min() for name in robot.presets()))
    cases = [(m, v) for m in (lightest, 3.0, 10.0, 80.0) for v in np.geomspace(0.02, 0.3, 7)]
    mass, speed = (jnp.asarray(column) for column in np.array(cases).T)

    def drop(mass: Any, speed: Any) -> Any:
        down = jnp.array([0.0, 0.0, -1.0]) * speed
        return slide(FLAT, mass, jnp.array([0.0, 0.0, 3e-4]), down, 0.0, dt, round(0.2 / dt))

    place, velocity, work, force = jax.vmap(drop)(mass, speed)
    left = np.asarray(velocity[:, -1, 2] / speed)
    assert np.all(np.asarray(force).max(axis=1) > 0.0), "it did not land"
    assert np.all(left < 0.2), left
    assert np.all(np.asarray(place)[:, :, 2] > -2e-3)
    assert np.all(np.asarray(work) <= 1e-12)
    print(f"largest restitution {left.max():.3f}")


@pytest.mark.parametrize("speed", [0.02, 0.1, 0.3])
def test_a_blow_is_the_one_of_the_law(x64, speed):
    """SciPy integrates m d'' = -k d max(0, 1 + s); four corners of the left foot share a sled."""
    mass, ahead = 10.0, 1e-4
    k, a = 4.0 * float(ground.stiffness(BIPED, FLAT.ground)), float(FLAT.ground.damping)

    def force(depth: float, rate: float) -> float:
        return k * max(depth, 0.0) * max(0.0, 1.0 + 3.0 * a * rate / np.hypot(3.0, a * rate))

    law = solve_ivp(
        lambda t, y: [y[1], -force(*y) / mass], (0.0, 0.05), [-ahead, speed], max_step=1e-5, rtol=1e-9
    )
    wanted = max(force(*y) for y in law.y.T)
    down, start = jnp.array([0.0, 0.0, -speed]), jnp.array([0.0, 0.0, ahead])
    _, velocity, _, got = slide(FLAT, mass, start, down, 0.0, 2e-6, 25_000)
    assert np.asarray(got).max() == pytest.approx(wanted, rel=0.02)
    assert float(velocity[-1, 2]) == pytest.approx(-law.y[1, -1], abs=0.01 * speed)
    # at the most as hard as of a spring four times as stiff, however fast
    spring = speed * np.sqrt(k * mass)
    assert 1.2 < wanted / spring < 2.0
    _, _, _, coarse = slide(FLAT, mass, start, down, 0.0, 5e-4, 100)
    literal = solve_ivp(
        lambda t, y: [y[1], -k * max(y[0], 0.0) * max(0.0, 1.0 + a * y[1]) / mass],
        (0.0, 0.05), [-ahead, speed], max_step=1e-5, rtol=1e-9,
    )  # fmt: skip
    hard = max(k * max(d, 0.0) * max(0.0, 1.0 + a * v) for d, v in literal.y.T)
    print(
        f"{mass:g} kg at {speed:g} m/s: leaves at {-law.y[1, -1] / speed:.2f} of it; peak by sqrt(k m) v: the law's "
        f"{wanted / spring:.2f}, with ticks of 0.5 ms {np.asarray(coarse).max() / spring:.2f}, by Hunt and Crossley's "
        f"{hard / spring:.2f}"
    )


@pytest.mark.parametrize("dt", TICKS)
def test_the_force_of_a_touchdown_is_continuous(x64, dt):
    """In the height the mass comes from, across all places of the touch in a tick; and it comes off without a jump."""
    height = jnp.asarray(np.linspace(0.0, 3.0 * dt * 0.2, 1201))

    def land(z: Any) -> Any:
        return slide(FLAT, 5.0, jnp.stack([0.0 * z, 0.0 * z, z]), jnp.array([0.0, 0.0, -0.2]), 0.0, dt, 6)

    *_, force = jax.vmap(land)(height)
    jumps = np.abs(np.diff(np.asarray(force), axis=0)).max(axis=0)
    assert np.asarray(force).max() > 50.0
    assert np.all(jumps < 0.01 * np.asarray(force).max()), jumps

    def lift(v: Any) -> Any:
        up = jnp.stack([0.0 * v, 0.0 * v, v])
        return slide(FLAT, 5.0, jnp.array([0.0, 0.0, -1e-4]), up, 0.0, dt, 4)

    *_, force = jax.vmap(lift)(jnp.asarray(np.linspace(-0.01, 0.02, 1201)))
    jumps = np.abs(np.diff(np.asarray(force), axis=0)).max(axis=0)
    assert np.all(jumps < 0.01 * np.asarray(force).max()), jumps


@pytest.mark.parametrize("dt", TICKS)
def test_no_energy_comes_from_edges(x64, dt):
    """Masses that slide, fall and run into the edges of pads and holes: the ground's work is never positive.

    The tolerance is a millionth of what the mass had.
    """
    rng, n = np.random.default_rng(0), 400
    height = rng.uniform(0.01, 0.05, n) * rng.choice([-1.0, 1.0], n)
    edge = rng.uniform(-0.05, 0.25, n)
    level = rng.uniform(-0.02, 0.05, n)
    speed = rng.uniform(-1.0, 1.0, (n, 3))
    mass, friction = rng.uniform(2.0, 80.0, n), rng.choice([0.0, 0.1, 0.8], n)

    def one(height: Any, edge: Any, level: Any, speed: Any, mass: Any, friction: Any) -> Any:
        lower, upper = jnp.stack([edge, -1.0 + 0.0 * edge]), jnp.array([1.0, 0.01])
        scene = eqx.tree_at(
            lambda s: (s.terrain.lower, s.terrain.upper, s.terrain.height, s.ground.friction),
            FLAT,
            (
                FLAT.terrain.lower.at[0].set(lower),
                FLAT.terrain.upper.at[0].set(upper),
                FLAT.terrain.height.at[0].set(height),
                friction,
            ),
        )
        start = jnp.stack([edge - 0.35, 0.0 * edge, jnp.maximum(level, 0.0) + 1e-4])
        result = slide(scene, mass, start, speed, GRAVITY, dt, round(1.0 / dt))
        clear = ground.contact(BIPED, scene.ground, scene.terrain, sled(start, speed)).gap.min() > 0.0
        return *result, clear, 0.5 * mass * jnp.sum(speed * speed) + mass * GRAVITY * 0.1

    arguments = (jnp.asarray(a) for a in (height, edge, level, speed, mass, friction))
    place, _, work, _, clear, energy = jax.vmap(one)(*arguments)
    clear = np.asarray(clear)
    assert clear.mean() > 0.5
    share = np.asarray(work).max(axis=1) / np.asarray(energy)
    assert np.all(np.isfinite(np.asarray(place)))
    assert np.all(share[clear] <= 1e-6), np.sort(share[clear])[-5:]
    reached = np.asarray(place)[:, :, 0].max(axis=1) > edge - 0.2
    assert (reached & clear).sum() > 50
    assert np.asarray(work).min() < -1.0


@pytest.mark.parametrize("dt", TICKS)
def test_a_riser_stops_a_foot(x64, dt):
    """A foot at 20 mm that slides against a pad of 50 mm: it stops at the edge and is not thrown up."""
    scene = FLAT.with_rectangle((0.0, -1.0), (1.0, 1.0), 0.05)
    toe = float(BIPED.p_sole_corner[0, :, 0].max())
    start, forward = jnp.array([-toe - 0.05, 0.0, 0.02]), jnp.array([0.3, 0.0, 0.0])
    place, velocity, work, _ = slide(scene, 5.0, start, forward, 0.0, dt, round(0.5 / dt))
    assert -0.003 < float(place[-1, 0]) + toe < 0.002
    assert abs(float(velocity[-1, 0])) < 0.06
    assert np.abs(np.asarray(velocity)[:, 2]).max() < 0.05
    assert np.all(np.asarray(work) <= 1e-9)


def test_height_and_slope_of_terrain(x64):
    """The slope is the height's derivative, on edges, plateaus, corners and where rectangles overlap."""
    scene = FLAT.with_rectangle((0.0, -0.1), (0.4, 0.1), 0.03).with_rectangle((0.2, -0.3), (0.6, 0.05), -0.01)
    rng = np.random.default_rng(1)
    near = [[0.0, 0.0], [0.4, 0.05], [0.1, 0.1], [0.2, -0.2], [0.2, 0.0], [0.4, 0.1], [0.3, 0.0]]
    points = jnp.asarray(np.repeat(near, 40, axis=0) + rng.uniform(-0.003, 0.003, (280, 2)))
    height, slope = ground.height_and_slope(scene.terrain, points)
    by_place = jax.vmap(jax.grad(lambda p: ground.height(scene.terrain, p)))(points)
    np.testing.assert_allclose(slope, by_place, atol=1e-12)
    step = 1e-7 * np.eye(2)
    for axis in (0, 1):
        ahead, behind = (ground.height(scene.terrain, points + sign * step[axis]) for sign in (1, -1))
        np.testing.assert_allclose(slope[:, axis], (ahead - behind) / 2e-7, atol=2e-3)
    assert np.abs(np.asarray(slope)).max() > 5.0
    np.testing.assert_array_equal(height, ground.height(scene.terrain, points))


@pytest.mark.parametrize("dt", TICKS)
def test_low_passed_forces_keep_the_impulse_and_hardly_tell_how_it_is_split(x64, dt):
    """One impulse in one tick, or in parts in neighboring ticks: the same integral, nearly the same power of it."""
    n, at = round(0.2 / dt), 3

    def through(share: Any) -> tuple[Any, Any]:
        force = jnp.zeros((n, 2, 4)).at[at].set(share / dt).at[at + 1].set((1.0 - share) / dt)
        body = sled(jnp.zeros(3), jnp.zeros(3))
        touch = ground.contact(BIPED, FLAT.ground, FLAT.terrain, body)
        saw = seen(body, touch, jnp.zeros((2, 6)))

        def tick(filtered: Any, one: Any) -> tuple[Any, Any]:
            now = eqx.tree_at(lambda s: s.force, saw, jnp.zeros((2, 4, 3)).at[..., 2].set(one))
            filtered = record.low_passed(filtered, now, dt)
            return filtered, filtered[1]

        _, passed = jax.lax.scan(tick, jnp.zeros((2, 2, 4)), force)
        return dt * passed.sum(axis=0), dt * (passed**4).sum(axis=0)

    impulse, power = jax.vmap(through)(jnp.linspace(0.0, 1.0, 21))
    np.testing.assert_allclose(impulse, 1.0, rtol=1e-9)
    assert np.ptp(power, axis=0).max() < 0.08 * (dt / 2e-3) ** 1.5 * np.min(power)

"""Derivatives of the single kernels, in float64: forward mode against central differences, reverse against forward.

And not zero where physics says so: a derivative that a `where` or a rounded event instant has cut off is finite, looks
fine, and tunes nothing. State machines run over a made-up history of the sensors, without physics.
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import kinematics, planner, robot
from jaxbiped.adapt import Landing, PayloadReflex, PayloadStage, Sensed, Signals
from jaxbiped.adapt.blends import smooth
from jaxbiped.adapt.landing import LandingStage
from jaxbiped.adapt.reflex.planned import SETTLE, SHIFT, WALK
from jaxbiped.kinematics import GRAVITY
from jaxbiped.kinematics.rotation import about_x, about_y, about_z
from jaxbiped.score import loss
from jaxbiped.sim import Sample, Scenario, ground, sensors, servo
from jaxbiped.sim.mjx_adapter import BodyMotion
from jaxbiped.sim.seen import Seen
from jaxbiped.sim.sensors import SwitchState

NOT_OPTIMISED = {"xla_backend_optimization_level": 0}
"""How to compile what runs once."""
WIDTH = 1e-5
"""Half the width of central differences, as a share of what a number usually changes by."""
ROBOTS = ("surena3", "elkahlout")
Numbers = dict[str, Any]
"""By name, each with a leading axis for the cases."""


class Slopes(NamedTuple):
    """Derivatives along one way for many cases, by name of what is differentiated."""

    forward: Numbers
    central: Numbers


@partial(jax.jit, static_argnums=(0, 1), compiler_options=NOT_OPTIMISED)
def _along(function: Any, reverse: bool, points: Numbers, ways: Numbers):
    """Values, derivatives, and by how much reverse mode gives another <w, J v> than forward mode."""

    def one(point, way):
        value, forward = jax.jvp(function, (point,), (way,))
        if not reverse:
            return value, forward, jnp.zeros(())
        weight = jax.tree.map(lambda v: jnp.cos(1.0 + jnp.arange(v.size)).reshape(v.shape), value)
        (back,) = jax.vjp(function, point)[1](weight)
        products = [
            jnp.concatenate([jnp.ravel(a * b) for a, b in zip(*map(jax.tree.leaves, pair), strict=True)])
            for pair in ((weight, forward), (back, way))
        ]
        size = jnp.maximum(*(jnp.abs(p).sum() for p in products))
        return value, forward, jnp.abs(products[0].sum() - products[1].sum()) / jnp.maximum(size, 1e-300)

    return jax.vmap(one)(points, ways)


def slopes(
    function: Callable[[Numbers], Numbers], at: Numbers, sizes: dict[str, float], reverse: bool = True
) -> tuple[Numbers, dict[str, Slopes]]:
    """Values of many cases, and their derivatives by every number that has a size; one compilation.

    Each is differentiated along a random way of that size, but a number itself by itself; the same function, a little
    ahead and behind, gives the central difference. Reverse mode has to be the transpose.
    """
    rng = np.random.default_rng(7)
    at = {name: np.asarray(value, float) for name, value in at.items()}
    zero = {name: np.zeros_like(value) for name, value in at.items()}
    ways = []
    for name, size in sizes.items():
        random = rng.uniform(0.5, 1.0, at[name].shape) * rng.choice([-1.0, 1.0], at[name].shape)
        ways.append({**zero, name: size * (random if random.ndim > 1 else 1.0 + 0.0 * random)})
    shifts = (0.0, WIDTH, -WIDTH)
    points = [{n: at[n] + s * way[n] for n in at} for way in ways for s in shifts]

    def together(trees: list[Numbers]) -> Numbers:
        return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *trees)

    lanes = _along(function, reverse, together(points), together([way for way in ways for _ in shifts]))
    value, forward, lopsided = jax.tree.map(
        lambda leaf: np.asarray(leaf).reshape(len(ways), 3, -1, *leaf.shape[1:]), lanes
    )
    assert np.max(lopsided) < 1e-12
    found = {}
    for i, (name, size) in enumerate(sizes.items()):
        twin = {k: (v[i, 1] - v[i, 2]) / (2.0 * WIDTH) for k, v in value.items()}
        own = {k: v[i, 0] for k, v in forward.items()}
        unit = size if at[name].ndim == 1 else 1.0
        found[name] = Slopes(*({k: v / unit for k, v in one.items()} for one in (own, twin)))
    return {k: v[0, 0] for k, v in value.items()}, found


def assert_equal(found: dict[str, Slopes], keep: Any = None, rel: float = 1e-6) -> float:
    """Forward mode is what central differences say, to a share of the largest entry of every case; the worst."""
    worst = 0.0
    for name, one in found.items():
        for key, central in one.central.items():
            forward = one.forward[key]
            if keep is not None:
                forward, central = (
                    np.where(keep.reshape(*keep.shape, *(1,) * (x.ndim - keep.ndim)), x, 0.0)
                    for x in (forward, central)
                )
            forward, central = (x.reshape(len(x), -1) for x in (forward, central))
            assert np.all(np.isfinite(forward)), (name, key)
            size = np.abs(central).max(axis=1)
            size = np.maximum(size, 1e-3 * size.max())
            gap = np.abs(forward - central).max(axis=1) / np.where(size > 0.0, size, 1.0)
            assert gap.max() < rel, (name, key, gap)
            worst = max(worst, gap.max())
    print(f"worst difference {worst:.2g}")
    return worst


def uniform(rng: np.random.Generator, cases: int, low: float, high: float, *shape: int) -> np.ndarray:
    return rng.uniform(low, high, (cases, *shape))


# ---------------------------------------------------------------- ground


def level(
    z: Any, speed: Any, xy: Any = None, tilt: Any = None, spin: Any = None, sway: Any = None
) -> BodyMotion:
    """Feet with their ankles at heights z (2,), as far as the ground asks."""
    tilt = jnp.zeros((2, 2)) if tilt is None else tilt
    xy = jnp.zeros((2, 2)) if xy is None else xy
    spin = jnp.zeros((2, 3)) if spin is None else spin
    sway = jnp.zeros((2, 2)) if sway is None else sway
    rotation = jnp.stack([about_x(tilt[foot, 0]) @ about_y(tilt[foot, 1]) for foot in (0, 1)])
    return BodyMotion(
        p_world_foot=jnp.concatenate([xy, z[:, None]], axis=1),
        rot_world_foot=rotation,
        p_world_trunk=jnp.zeros(3),
        rot_world_trunk=jnp.eye(3),
        twist_foot=jnp.concatenate([spin, sway, speed[:, None]], axis=1),
        centre=jnp.array([0.02, -0.01, 0.5]),
        dof_axes=jnp.zeros((18, 6)),
        link_inertia=jnp.zeros((13, 10)),
        mass_matrix=jnp.zeros((18, 18)),
        bias=jnp.zeros(18),
    )


def test_ground_forces(x64):
    """Of corners in the ground and over it, pressed in, pulled out, and sliding; on a pad and beside it."""
    biped, flat = robot.on_device(robot.load("surena3")), Scenario.flat(1)
    terrain = eqx.tree_at(
        lambda t: (t.lower, t.upper), flat.terrain, (jnp.array([[-0.3, 0.0]]), jnp.ones((1, 2)))
    )

    def forces(x: Numbers) -> Numbers:
        fields = ("sinkage", "damping", "friction", "slip_speed")
        earth = eqx.tree_at(lambda g: [getattr(g, f) for f in fields], flat.ground, [x[f] for f in fields])
        earth_height = eqx.tree_at(lambda t: t.height, terrain, x["terrain"][None])
        body = level(x["z"] + biped.ankle_height, x["speed"], x["xy"], x["tilt"], x["spin"], x["sway"])
        touch = ground.contact(biped, earth, earth_height, body)
        names = ("gap", "gap_rate", "gradient", "p_world_corner", "v_world_corner", "force", "drag")
        return {name: getattr(touch, name) for name in names}

    rng, n = np.random.default_rng(0), 60
    at = {
        "z": uniform(rng, n, -4e-3, 1e-3, 2),
        "speed": uniform(rng, n, -0.4, 0.2, 2),
        "xy": np.array([0.1, 0.115]) * [[1, 1], [1, -1]] + uniform(rng, n, -0.02, 0.02, 2, 2),
        "tilt": uniform(rng, n, -0.01, 0.01, 2, 2),
        "spin": uniform(rng, n, -0.2, 0.2, 2, 3),
        "sway": uniform(rng, n, -0.1, 0.1, 2, 2),
        "sinkage": uniform(rng, n, 1e-4, 1e-3),
        "damping": uniform(rng, n, 5.0, 20.0),
        "friction": uniform(rng, n, 0.3, 1.0),
        "slip_speed": uniform(rng, n, 0.005, 0.05),
        "terrain": uniform(rng, n, -2e-3, 2e-3),
    }
    sizes = {name: float(np.ptp(value)) for name, value in at.items()} | {"xy": 0.04}
    value, found = slopes(forces, at, sizes)
    assert_equal(found)

    normal, gap, rate = value["force"][..., 2], value["gap"], value["gap_rate"]
    by_rate = at["damping"][:, None, None] * rate
    bend = 1.0 + (by_rate / ground.DAMPED) ** 2
    pressed = (gap < 0.0) & (by_rate / np.sqrt(bend) < 1.0)
    for some in (pressed, gap > 0.0, (gap < 0.0) & ~pressed):
        assert some.sum() > 5
    by_terrain, by_damping, by_friction = (
        found[n].forward["force"] for n in ("terrain", "damping", "friction")
    )
    left = pressed[:, 0]  # the left foot is on the pad, the right one is not
    stiffness = (normal / -gap)[:, 0]
    np.testing.assert_allclose(by_terrain[:, 0, :, 2][left], stiffness[left], rtol=1e-9)
    np.testing.assert_array_equal(by_terrain[:, 1], 0.0)
    bare = normal / (1.0 - by_rate / np.sqrt(bend))
    np.testing.assert_allclose(by_damping[..., 2][pressed], (-rate * bare / bend**1.5)[pressed], rtol=1e-9)
    assert np.all(np.abs(by_friction[..., :2][pressed]).max(axis=-1) > 1.0)
    for one in found.values():
        np.testing.assert_array_equal(one.forward["force"][~pressed], 0.0)


TOUCH_TICK, AFTER, MOVED = 1e-4, 0.03, 1e-6
"""Tick [s], for how long after the touch the mass is followed [s], and by how much its height is moved [m]."""


@partial(jax.jit, compiler_options=NOT_OPTIMISED)
def _landed(biped: Any, z0: Any, ticks: Any):
    """Speeds of the robot's mass, dropped onto level soles, after so many ticks, and how near a tick was to the touch.

    With their derivatives by its height.
    """
    flat = Scenario.flat(1)

    def speed_at_end(z0: Any, ticks: Any) -> Any:
        def tick(state: Any, i: Any) -> Any:
            z, v, nearest = state
            height, speed = jnp.stack([z, z]) + biped.ankle_height, jnp.stack([v, v])
            touch = ground.contact(biped, flat.ground, flat.terrain, level(height, speed), None, TOUCH_TICK)
            mass = biped.total_mass + TOUCH_TICK * touch.normal_damping.sum()
            v_new = v + TOUCH_TICK * (touch.force[..., 2].sum() - biped.total_mass * GRAVITY) / mass
            new = (z + TOUCH_TICK * v_new, v_new, jnp.minimum(nearest, jnp.abs(z)))
            return jax.tree.map(lambda a, b: jnp.where(i < ticks, a, b), new, state), None

        longest = jnp.arange(int((np.sqrt(2 * DROPS.max() / GRAVITY) + AFTER) / TOUCH_TICK) + 1)
        _, *found = jax.lax.scan(tick, (z0, jnp.zeros(()), z0), longest)[0]
        return found

    return jax.vmap(lambda z, n: jax.jvp(lambda z: speed_at_end(z, n), (z,), (jnp.ones(()),)))(z0, ticks)


DROPS = np.geomspace(0.01, 0.2, 40)
"""Heights the mass falls from [m]."""


def test_mass_that_lands_on_the_ground(x64):
    """Through the instant of the touch, which moves with the height and is nowhere computed.

    The tick's own kink, where the mass touches at a tick to a micrometre, is no derivative's and left out.
    """
    ticks = ((np.sqrt(2 * DROPS / GRAVITY) + AFTER) / TOUCH_TICK).astype(int)
    moved = np.concatenate([DROPS, DROPS + MOVED, DROPS - MOVED])
    (speed, nearest), (slope, _) = _landed(
        robot.load("surena3"), jnp.asarray(moved), jnp.asarray(np.tile(ticks, 3))
    )
    speed, nearest = (np.asarray(x).reshape(3, -1) for x in (speed, nearest))
    slope, central = np.asarray(slope)[: len(DROPS)], (speed[1] - speed[2]) / (2 * MOVED)
    assert np.all(speed[0] > -0.5 * np.sqrt(2 * GRAVITY * DROPS)), "it did not land"
    smooth_there = nearest[0] > 3 * MOVED
    assert smooth_there.mean() > 0.8
    largest = np.abs(slope).max()
    np.testing.assert_allclose(slope[smooth_there], central[smooth_there], rtol=1e-4, atol=1e-4 * largest)
    assert np.mean(np.abs(slope) > 1e-4) > 0.9  # the slope is of something
    print(f"worst difference {np.max(np.abs(slope - central)[smooth_there]) / largest:.2g}")


# ---------------------------------------------------------------- servos


def test_torques(x64):
    """Inside the limits, at the torque limit, where the motor fades, and beyond."""
    biped = robot.load("surena3")
    kp, low, high = (np.asarray(getattr(biped.servo, f)) for f in ("kp", "torque_limit", "speed_limit"))

    def torque(x: Numbers) -> Numbers:
        fields = ("kp", "kv", "ki", "torque_limit", "speed_limit")
        one = eqx.tree_at(lambda s: [getattr(s, f) for f in fields], biped.servo, [x[f] for f in fields])
        reference = servo.Reference(x["wanted_angle"], x["wanted_speed"], x["feed_forward"])
        return {"torque": servo.torque(one, reference, x["angle"], x["speed"], x["integral"])[0]}

    rng, n = np.random.default_rng(1), 60
    shape = (n, 2, 6)
    at = {
        "kp": kp * rng.uniform(0.7, 1.3, shape),
        "kv": rng.uniform(
            2.0, 15.0, shape
        ),  # less than the preset's, which brakes so hard that no motor fades
        "ki": rng.uniform(10.0, 50.0, shape),
        "torque_limit": low * rng.uniform(0.7, 1.3, shape),
        "speed_limit": high * rng.uniform(0.7, 1.3, shape),
        "wanted_angle": low / kp * rng.uniform(-1.5, 1.5, shape),
        "wanted_speed": high * rng.uniform(-1.2, 1.2, shape),
        "feed_forward": low * rng.uniform(-0.3, 0.3, shape),
        "angle": low / kp * rng.uniform(-0.5, 0.5, shape),
        "speed": high * rng.uniform(-1.2, 1.2, shape),
        "integral": rng.uniform(-0.1, 0.1, shape),
    }
    _, found = slopes(torque, at, {name: float(np.ptp(v)) for name, v in at.items()})
    assert_equal(found)

    wanted = np.clip(at["wanted_speed"], -at["speed_limit"], at["speed_limit"])
    free = at["kp"] * (at["wanted_angle"] - at["angle"]) + at["kv"] * (wanted - at["speed"])
    free += at["ki"] * at["integral"] + at["feed_forward"]
    beyond = np.abs(free) > at["torque_limit"]
    faded = (np.abs(at["speed"]) > at["speed_limit"]) & (free * at["speed"] > 0.0)
    follows = np.abs(at["wanted_speed"]) < at["speed_limit"]
    for some in (beyond, ~beyond, faded, ~follows):
        assert some.sum() > 50
    by = {name: one.forward["torque"] for name, one in found.items()}
    asked = free / at["torque_limit"]
    far = np.abs(asked) > 2.0
    assert far.sum() > 20
    for name in ("wanted_angle", "angle", "wanted_speed", "kp", "kv", "ki", "integral", "feed_forward"):
        inside = ~beyond & ~faded & (follows | (name != "wanted_speed"))
        assert np.all(by[name][inside] != 0.0), name
        assert np.abs(by[name][far]).max() < 1e-4 * np.abs(by[name]).max(), name
    limit = np.abs(by["torque_limit"])
    assert np.all(limit[beyond & ~faded] > 0.0) and limit[np.abs(asked) < 0.5].max() < 1e-4 * limit.max()
    np.testing.assert_array_equal(by["wanted_speed"][~follows], 0.0)


@pytest.mark.parametrize("name", ROBOTS)
def test_stiffness_and_damping_are_the_servo_s(x64, name):
    one = robot.on_device(robot.load(name)).servo
    little = 0.1 * one.torque_limit / one.kp

    @partial(jax.jit, compiler_options=NOT_OPTIMISED)
    def along(angle: Any, slope: Any) -> Any:
        def torque(angle: Any, speed: Any) -> Any:
            zero = jnp.zeros((2, 6))
            return servo.torque(one, servo.Reference(angle, speed, zero), zero, zero, zero)[0]

        return jax.jvp(torque, (angle, jnp.zeros((2, 6))), slope)[1]

    ones, none = jnp.ones((2, 6)), jnp.zeros((2, 6))
    np.testing.assert_allclose(along(little, (ones, none)), one.kp, rtol=1e-12)
    np.testing.assert_allclose(along(little, (none, ones)), one.kv, rtol=1e-12)
    np.testing.assert_allclose(along(50.0 * little, (ones, ones)) / (one.kp + one.kv), 0.0, atol=1e-10)


# ---------------------------------------------------------------- sensors


def test_centre_of_pressure(x64):
    """It moves with the corners and with the load on them; unloaded it is what was given."""

    def centre(x: Numbers) -> Numbers:
        force = jnp.zeros((2, 4, 3)).at[..., 2].set(x["force"])
        points = jnp.concatenate([x["points"], jnp.zeros((2, 4, 1))], axis=-1)
        place, turn = jnp.zeros(3), jnp.eye(3)
        feet = jnp.zeros((2, 3)), jnp.broadcast_to(turn, (2, 3, 3))
        seen = Seen(place, turn, *feet, points, jnp.zeros((2, 4)), force, jnp.zeros((2, 6)))
        return {"centre": sensors.centre_of_pressure(seen, x["otherwise"])}

    rng, n = np.random.default_rng(2), 20
    at = {
        "force": uniform(rng, n, 5.0, 200.0, 2, 4),
        "points": uniform(rng, n, -0.2, 0.2, 2, 4, 2),
        "otherwise": uniform(rng, n, -1.0, 1.0, 2),
    }
    at["force"][:5] *= 1e-4
    _, found = slopes(centre, at, {"force": 100.0, "points": 0.1, "otherwise": 1.0})
    assert_equal(found)
    by = {name: one.forward["centre"] for name, one in found.items()}
    for name in ("force", "points"):
        np.testing.assert_array_equal(by[name][:5], 0.0)
        assert np.all(np.abs(by[name][5:]) > 1e-5)
    assert np.all(np.abs(by["otherwise"][:5]) >= 0.5)
    np.testing.assert_array_equal(by["otherwise"][5:], 0.0)


def test_roll_pitch_and_yaw(x64):
    """Of rotations by known angles they are those: the Jacobian is the identity."""

    def turned(x: Numbers) -> Numbers:
        return {"angles": sensors.roll_pitch_yaw(x["rotation"])}

    def matrix(angles: Any) -> Any:
        return about_z(angles[2]) @ about_y(angles[1]) @ about_x(angles[0])

    angles = jnp.asarray(uniform(np.random.default_rng(3), 20, -1.2, 1.2, 3))
    _, found = slopes(turned, {"rotation": jax.vmap(matrix)(angles)}, {"rotation": 1.0})
    assert_equal(found)
    jacobian = jax.jit(jax.vmap(jax.jacfwd(lambda a: sensors.roll_pitch_yaw(matrix(a)))))(angles)
    np.testing.assert_allclose(jacobian, np.broadcast_to(np.eye(3), (20, 3, 3)), rtol=0.0, atol=1e-12)


def test_closing_instant(x64):
    """It moves with both gaps and with the switch's own; that of a closed or an open switch does not."""
    faults, dt = Scenario.flat(1).sensors, 5e-4

    def closing(x: Numbers) -> Numbers:
        before = SwitchState(x["gap_before"] <= x["delta_z"], x["gap_before"], x["last"])
        own = eqx.tree_at(lambda f: f.delta_z, faults, x["delta_z"])
        return {"time": sensors.read_switches(before, x["gap"], x["time"], dt, own).time}

    rng, n = np.random.default_rng(4), 20
    own = uniform(rng, n, 0.005, 0.02, 2, 4)
    drop, share = uniform(rng, n, 1e-4, 1e-3, 2, 4), uniform(rng, n, 0.05, 0.95, 2, 4)
    at = {"gap_before": own + share * drop, "gap": own - (1.0 - share) * drop, "delta_z": own}
    at["gap_before"][0], at["gap"][1] = own[0] - 1e-3, own[1] + 1e-3
    at |= {"time": uniform(rng, n, 1.0, 2.0), "last": uniform(rng, n, 0.0, 1.0, 2, 4)}
    sizes = {"gap_before": 1e-3, "gap": 1e-3, "delta_z": 1e-3, "time": 1e-2, "last": 1e-2}
    _, found = slopes(closing, at, sizes)
    assert_equal(found)
    by = {name: one.forward["time"] for name, one in found.items()}
    np.testing.assert_allclose(by["time"][2:], 1.0, rtol=1e-12)
    for name in ("gap_before", "gap", "delta_z"):
        assert np.all(np.abs(by[name][2:]) > 0.0)
        np.testing.assert_array_equal(by[name][:2], 0.0)
    np.testing.assert_array_equal(by["time"][:2], 0.0)
    assert np.all(by["last"][:2] != 0.0)
    np.testing.assert_array_equal(by["last"][2:], 0.0)


@partial(jax.jit, static_argnums=2)
def _touches(z0: Any, g: Any, dt: float):
    """When a switch closes under falling points, and the derivatives of that by height and by gravity."""
    faults = Scenario.flat(1).sensors

    def when(z0: Any, g: Any) -> Any:
        def gap(time: Any) -> Any:
            return jnp.full((2, 4), z0 - 0.5 * g * time * time)

        def tick(state: SwitchState, i: Any) -> Any:
            time = i * dt
            return sensors.read_switches(state, gap(time), time, dt, faults), None

        start = sensors.init_switches(gap(jnp.zeros(())), faults)
        ticks = 1.0 + jnp.arange(int(np.sqrt(2 * FALLS.max() / GRAVITY) / dt) + 1)
        return jax.lax.scan(tick, start, ticks)[0].time[1, 2]

    def along(z0: Any, by_z0: Any, by_g: Any) -> Any:
        return jax.jvp(when, (z0, g), (by_z0, by_g))

    one, none = jnp.ones_like(z0), jnp.zeros_like(z0)
    time, by_z0 = jax.vmap(along)(z0, one, none)
    return time, by_z0, jax.vmap(along)(z0, none, one)[1]


FALLS = np.geomspace(0.1, 0.8, 24)
"""Heights over the one at which the switch closes [m]."""


def test_instant_of_a_falling_mass(x64):
    """Linear interpolation in a tick is of first order in the derivatives: right to g dt / (2 v), and that it reaches.

    The chord of a parabola has the slope of the middle of the tick, wherever in the tick the crossing is.
    """
    delta_z, t = float(Scenario.flat(1).sensors.delta_z[0, 0]), np.sqrt(2 * FALLS / GRAVITY)
    allowed = {dt: dt / (2 * t) for dt in (2e-5, 8e-5)}
    most = {}
    for dt, bound in allowed.items():
        args = (jnp.asarray(delta_z + FALLS), jnp.asarray(GRAVITY), dt)
        time, by_z0, by_g = map(np.asarray, _touches(*args))
        np.testing.assert_allclose(time, t, rtol=0.0, atol=dt**2 / t.min())
        errors = [by_z0 * GRAVITY * t - 1.0, by_g / (-t / (2 * GRAVITY)) - 1.0]
        for error in errors:
            assert np.all(np.abs(error) < 1.01 * bound)
        most[dt] = [np.max(np.abs(error) / bound) * dt for error in errors]
        if dt == 2e-5:
            assert np.max(np.abs(errors)) < 1e-4
        print(f"dt {dt:g}: worst {np.max(np.abs(errors), axis=1)}")
    np.testing.assert_allclose(np.divide(most[8e-5], most[2e-5]), 4.0, rtol=0.15)


# ---------------------------------------------------------------- inverse kinematics


@pytest.mark.parametrize("name", ROBOTS)
def test_joint_angles(x64, name):
    """Every angle but the yaw moves with the foot, and forward kinematics takes the foot where it was moved."""
    biped = robot.load(name)
    below_hip = jnp.array([0.0, 0.0, -0.93]) * (biped.thigh_length + biped.shank_length)
    below_hip = below_hip.at[2].add(-biped.ankle_height)

    def angles(x: Numbers) -> Numbers:
        found, _ = kinematics.joint_angles(biped, x["sole"])
        return {"angle": found, "sole": kinematics.pose(biped, jnp.zeros(3), jnp.eye(3), found).p_world_sole}

    rng, n = np.random.default_rng(5), 30
    spread = rng.uniform((-0.1, -0.04, 0.0), (0.1, 0.04, 0.06), (n, 2, 3))
    at = {"sole": np.asarray(biped.p_pelvis_hip + below_hip) + spread}
    value, found = slopes(angles, at, {"sole": 0.05})
    assert_equal(found)
    np.testing.assert_allclose(value["sole"], at["sole"], atol=1e-12)
    rates = found["sole"].forward["angle"]
    assert np.all(np.abs(rates[..., 1:]).max(axis=(0, 1)) > 1e-2)
    assert np.all(np.abs(rates[..., 3]) > 1e-5)
    way = found["sole"].forward["sole"]
    assert np.all((np.abs(way) > 0.5 * 0.05 - 1e-9) & (np.abs(way) < 0.05 + 1e-9))


# ---------------------------------------------------------------- gaits

GAITS = {"cosine": planner.CosineGait, "polynomial": planner.PolynomialGait}


@partial(jax.jit, static_argnums=(0, 2), compiler_options=NOT_OPTIMISED)
def preset(kind: str, biped: Any, n_steps: int) -> Any:
    """A preset gait; compiled, it is not asked whether it can be walked, which takes seconds."""
    return GAITS[kind].preset(biped, n_steps)


def scalars_of(params: Any) -> dict[str, float]:
    """Every number of a gait, those of the start and stop too."""
    found = {}
    for name, value in vars(params).items():
        found |= {name: float(value)} if eqx.is_array(value) else scalars_of(value)
    return found


def with_scalars(params: Any, x: Numbers) -> Any:
    for name, value in vars(params).items():
        new = x[name] if eqx.is_array(value) else with_scalars(value, x)
        params = eqx.tree_at(lambda p, n=name: getattr(p, n), params, new)
    return params


@pytest.mark.parametrize("kind", GAITS)
def test_gaits(x64, kind):
    """Every number of a gait moves a target at some time, and none a time before it matters."""
    biped = robot.load("surena3")
    nominal = preset(kind, biped, 4)
    timing, duration = nominal.timing, float(nominal.duration)
    half = 0.5 * np.asarray(timing.T_c - timing.T_s)
    marks = [float(timing.liftoff(k) + s * timing.T_s) for k in range(4) for s in (0.0, 0.5, 1.0)]
    marks += [float(timing.touchdown(k) + half) for k in range(-1, 4)]
    time = np.linspace(0.05, duration - 0.05, 60)
    time = time[np.abs(time[:, None] - np.array(marks)).min(axis=1) > 2e-3]

    def targets(x: Numbers) -> Numbers:
        gait = GAITS[kind].make(biped, with_scalars(nominal.params, x), 4)
        at = jax.vmap(lambda t: planner.at(gait, t))(jnp.asarray(time))
        orders = {"position": at.position, "velocity": at.velocity, "acceleration": at.acceleration}
        return {k: jnp.concatenate([v.sole, v.pelvis[:, None]], axis=1) for k, v in orders.items()}

    numbers = scalars_of(nominal.params)
    sizes = {name: max(abs(value), 0.05) for name, value in numbers.items()}
    at = {name: np.array([value]) for name, value in numbers.items()}
    _, found = slopes(targets, at, sizes, reverse=False)
    assert_equal(found)
    for name, one in found.items():
        moved = np.abs(one.forward["position"][0]).max(axis=(1, 2))
        assert moved.max() > 0.05, name
        if name == "T_end":
            assert moved[time < marks[-1] - half].max() == 0.0


# ---------------------------------------------------------------- the payload stage

WEIGHT, LOAD = 785.0, 80.0
TICK = 0.01
TABLE = {
    "left, left swings": -0.01,
    "right, left swings": 0.012,
    "left, right swings": 0.009,
    "right, right swings": -0.01,
    "left, both stand": 0.008,
    "right, both stand": -0.006,
}
"""Entries of x_reflex [m]. The modified one's 0 while both feet stand is a kink: a step is as long as it is missing."""
SPANS = {
    "threshold": 40.0,
    "force_time_constant": 0.1,
    "zmp_time_constant": 1.0,
    "zmp_balanced": 0.03,
    "reflex_time": 0.1,
    "settling_time": 1.0,
    "shift_time": 0.5,
    "x_ref_gain": 1.0,
    "body_time": 1.0,
    "x_stand": 0.03,
}
"""What the parameters usually change by."""


def reading(time: Any, force: Any = 0.0, zmp: Any = 0.0, switches: SwitchState | None = None) -> Sensed:
    """The clock, forces, ZMP and switches."""
    felt = {} if switches is None else {"switch": switches.closed, "switch_time": switches.time}
    return Sensed.nothing(
        jnp.asarray(time),
        corner_force=jnp.full((2, 4), force / 8.0),
        zmp_body=jnp.stack([jnp.asarray(zmp), jnp.zeros(())]),
        **felt,
    )


def bodies(targets: planner.Targets) -> Any:
    """Left sole, right sole, pelvis."""
    return jnp.concatenate([targets.position.sole, targets.position.pelvis[None]])


def undisturbed(*machines: np.ndarray) -> np.ndarray:
    """Ticks (cases, ticks) that no switch of a state machine is next to."""
    changed = np.zeros(machines[0].shape, bool)
    for one in machines:
        steps = np.diff(one, axis=1) != 0
        changed[:, 1:] |= steps
        changed[:, :-1] |= steps
    return ~changed


@pytest.mark.parametrize(
    ("variant", "kind", "name"),
    [
        ("modified", "cosine", "elkahlout"),
        ("repaired", "polynomial", "surena3"),
    ],
)
def test_payload_stage(x64, variant, kind, name):
    """A load felt while the left foot swings, while the right one does, while both stand; until the walk goes on."""
    biped = robot.load(name)
    gait = preset(kind, biped, 3)
    given = {"threshold": 40.0, "zmp_balanced": -0.03, "settling_time": 1.0}
    base = getattr(PayloadReflex, variant)(
        biped, gait, **given, **({"x_stand": 0.02} if variant == "repaired" else {})
    )
    timing = gait.timing
    loads = [float(timing.liftoff(k) + s * timing.T_s) for k, s in ((0, 0.37), (1, 0.37), (0, 1.03))]
    own = [name for name in SPANS if getattr(base, name) is not None]
    ticks = int((max(loads) + 8.0) / TICK)

    def machine(x: Numbers) -> Numbers:
        table = jnp.stack([x[entry] for entry in TABLE]).reshape(3, 2)
        values = [*(x[n] for n in own), table]
        params = eqx.tree_at(lambda p: [*(getattr(p, n) for n in own), p.x_reflex], base, values)
        stage = PayloadStage.plan(params, gait)

        def tick(state: Any, i: Any) -> Any:
            time = i * TICK
            felt = smooth((time - x["load_time"]) / 0.3)
            zmp = -0.03 + 0.05 * felt + 0.003 * jnp.sin(3.0 * time)
            now = reading(time, WEIGHT + LOAD * felt, zmp)
            state, targets, _ = stage.step(state, gait, planner.at(gait, time), now, Signals.none())
            filters = jnp.stack([state.force, state.slow_force, state.zmp])
            phase = targets.phase
            marks = jnp.stack([state.mode, phase.support, phase.kind, phase.step, state.reflexes])
            return state, (bodies(targets), filters, marks.astype(float), state.trigger_time)

        commanded, filters, marks, trigger = jax.lax.scan(tick, stage.init(), jnp.arange(1.0 * ticks))[1]
        return {"commanded": commanded, "filters": filters, "marks": marks, "trigger": trigger}

    at = {n: np.full(3, float(getattr(base, n))) for n in own} | {"load_time": np.array(loads)}
    at |= {entry: np.full(3, offset) for entry, offset in TABLE.items()}
    sizes = {n: SPANS[n] for n in own} | {"load_time": 0.1} | dict.fromkeys(TABLE, 0.01)
    value, found = slopes(machine, at, sizes, reverse=False)
    mode, *_, reflexes = marks = np.moveaxis(value["marks"], -1, 0)
    begun = reflexes > 0
    calm = undisturbed(*marks)
    for i in range(3):
        assert set(mode[i]) == set(range(6)), "not every mode is reached"
        assert reflexes[i].max() == 1 and mode[i, -1] == WALK
        swings = gait.phase(jnp.asarray(value["trigger"][i, -1]))
        row = 2 if int(swings.support) == planner.DOUBLE_SUPPORT else int(swings.swing)
        assert row == i, "a load is felt in another phase than meant"
    assert_equal(found, keep=calm)

    in_body = {}
    for n, one in found.items():
        commanded = one.forward["commanded"]
        in_body[n] = rate = commanded[:, :, :2] - commanded[:, :, 2:]
        np.testing.assert_array_equal(rate[~begun], 0.0, err_msg=n)
    standing = [np.flatnonzero(one == SETTLE)[-1] for one in mode]
    for i, j in itertools.product(range(3), range(6)):
        rate = in_body[list(TABLE)[j]][i]
        if j // 2 == i:
            np.testing.assert_allclose(rate[standing[i], j % 2, 0], 1.0, rtol=1e-12)
            np.testing.assert_array_equal(rate[standing[i], 1 - j % 2], 0.0)
        else:
            np.testing.assert_array_equal(rate, 0.0)
    for n in own:
        most = np.abs(in_body[n]).max(axis=(1, 2, 3)) * sizes[n]
        if n == "body_time":  # of a smooth reflex whose body is not there sooner
            assert np.any(most > 1e-3) == base.smooth_reflex
        else:
            assert np.all(most > 1e-3), (n, most)
    shifted = begun & ((mode > SHIFT) | (mode == WALK))
    for i in range(3):
        by_zmp, by_gain = (in_body[n][i, :, :, 0] for n in ("zmp_balanced", "x_ref_gain"))
        error = value["filters"][i, standing[i], 2] - base.zmp_balanced
        np.testing.assert_allclose(by_zmp[shifted[i]], -base.x_ref_gain, rtol=1e-12)
        np.testing.assert_allclose(by_gain[shifted[i]], error, rtol=0.02)
        for rate in (by_zmp, by_gain):
            np.testing.assert_array_equal(rate[: standing[i] + 1], 0.0)
    np.testing.assert_allclose(found["load_time"].forward["trigger"][begun], 1.0, rtol=2e-2)
    assert np.all(found["threshold"].forward["trigger"][begun] > 1e-4)
    for column, n in ((0, "force_time_constant"), (2, "zmp_time_constant")):
        rate = found[n].forward["filters"]
        assert np.all(np.abs(rate[..., column]).max(axis=1) > 1e-3), n
        np.testing.assert_array_equal(rate[..., 2 - column], 0.0)


# ---------------------------------------------------------------- the landing stage

DT = 0.004
HEIGHTS = (0.031, -0.031)
"""Of the ground under step 1: an obstacle, on which the foot lands early, and a hole, into which it lands late [m]."""
LANDINGS = {
    "delta_z": 0.01,
    "T_mod": 0.05,
    "delta_x_scale": 1.0,
    "descent_speed": 0.2,
    "descent_acceleration": 3.0,
    "max_descent": 0.08,
    "release_share": 0.9,
}
"""Parameters of the landing; T_mod is shorter than the T* of both, which otherwise stands in its place."""


@pytest.mark.parametrize("variant", ["paper", "repaired"])
def test_landing_stage(x64, variant):
    """An advance landing and a retard one, kept and released. The foot is where it is commanded to be.

    Its way over a tick is the parabola that the command goes on by, so that a switch that closes in the tick says when,
    and that instant moves with whatever the command does.
    """
    biped = robot.load("surena3")
    gait = preset("polynomial", biped, 4)
    base = getattr(Landing, variant)(T_mod=jnp.asarray(LANDINGS["T_mod"]))
    faults, timing = Scenario.flat(1).sensors, gait.timing
    ticks = int(float(timing.liftoff(3)) / DT)

    def machine(x: Numbers) -> Numbers:
        params = eqx.tree_at(lambda p: [getattr(p, n) for n in LANDINGS], base, [x[n] for n in LANDINGS])
        stage = LandingStage.plan(params, gait)

        def tick(carry: Any, i: Any) -> Any:
            state, before, switches = carry
            time = i * DT
            nominal = planner.at(gait, time)
            step, swing = nominal.phase.step, jnp.arange(2) == nominal.phase.swing
            place, rate, change = before
            z = place + DT * rate + 0.5 * DT * DT * change
            floor = jnp.where(swing & (step == 1), x["ground"], 0.0)
            old = eqx.tree_at(lambda s: s.gap, switches, jnp.broadcast_to((place - floor)[:, None], (2, 4)))
            gap = jnp.broadcast_to((z - floor)[:, None], (2, 4))
            switches = sensors.read_switches(old, gap, time, DT, faults)
            seen = reading(time, switches=switches)
            state, targets, _ = stage.step(state, gait, nominal, seen, Signals.none())
            orders = (targets.position, targets.velocity, targets.acceleration)
            marks = jnp.stack([step, nominal.phase.support, state.touched, state.late, state.missed])
            row = (bodies(targets), marks.astype(float), state.touch_tau, state.T_mod)
            return (state, tuple(order.sole[:, 2] for order in orders), switches), row

        still = (jnp.zeros(2),) * 3
        start = (stage.init(), still, sensors.init_switches(jnp.zeros((2, 4)), faults))
        commanded, marks, touch, T_mod = jax.lax.scan(tick, start, jnp.arange(1.0 * ticks))[1]
        return {"commanded": commanded, "marks": marks, "touch": touch, "T_mod": T_mod}

    at = {name: np.full(2, value) for name, value in LANDINGS.items()} | {"ground": np.array(HEIGHTS)}
    sizes = {**LANDINGS, "ground": 0.03}
    value, found = slopes(machine, at, sizes, reverse=False)
    step, _, touched, late, missed = marks = np.moveaxis(value["marks"], -1, 0)
    assert_equal(found, keep=undisturbed(*marks))

    end = [np.flatnonzero(one == 1)[-1] for one in step]
    assert [late[i, end[i]] for i in (0, 1)] == [0, 1] and np.all(missed == 0)
    foot = int((gait.first_swing + 1) % 2)
    by = {name: one.forward["commanded"] for name, one in found.items()}
    for name, rate in by.items():
        np.testing.assert_array_equal(rate[:, : np.argmax(touched[0])], 0.0, err_msg=name)
    touchdown = timing.touchdown(1)
    last_way = gait.task(touchdown).sole[foot, 0] - gait.task(touchdown - LANDINGS["T_mod"]).sole[foot, 0]
    for i, is_late in enumerate((False, True)):
        own, out = (step[i] == 1) & (touched[i] > 0), step[i] == 2

        def most(name: str, ticks: np.ndarray, body: Any = slice(None), i: int = i) -> float:
            return np.abs(by[name][i, ticks, body]).max() * LANDINGS[name]

        # But for what is left, at the touch, of the stance foot's own set-down: it is carried along.
        np.testing.assert_allclose(
            by["delta_z"][i, end[i], foot, 2], -1.0, rtol=0.05 if base.stays_down else 1e-9
        )
        np.testing.assert_allclose(found["T_mod"].forward["T_mod"][i, own], 1.0, rtol=1e-12)
        assert most("T_mod", own, foot) > 1e-3
        wanted = 0.0 if is_late else last_way
        np.testing.assert_allclose(by["delta_x_scale"][i, end[i], foot, 0], wanted, rtol=1e-9)
        assert most("release_share", out) > 1e-2
        assert (most("descent_speed", own, foot) > 1e-2) == is_late
        assert (most("descent_acceleration", own, foot) > 1e-3) == (is_late and variant == "repaired")
        stands = by["ground"][i, end[i], foot, 2]
        np.testing.assert_allclose(stands, 1.0 if base.interpolate else 0.0, rtol=0.02)
        if not is_late:
            for name in ("descent_speed", "descent_acceleration", "max_descent"):
                np.testing.assert_array_equal(by[name][i], 0.0)


# ---------------------------------------------------------------- losses


def test_rates_of_the_loss(x64):
    """By tilt and low-passed corner forces; nothing once the walk has failed."""
    biped = robot.load("surena3")
    weight = float(biped.total_mass) * GRAVITY
    targets = planner.at(preset("polynomial", biped, 4), 1.0)

    def rate(x: Numbers) -> Numbers:
        angles = jnp.concatenate([x["tilt"], jnp.zeros(1)])
        zeros, none = jnp.zeros, jnp.zeros(())
        switch = zeros((2, 4), bool)
        sample = Sample(
            none,
            zeros(3),
            angles,
            zeros((2, 3)),
            zeros((2, 3)),
            zeros((2, 4)),
            zeros(2),
            switch,
            zeros((2, 6)),
            zeros(19),
            targets,
            x["corners"],
        )
        return {"rate": loss.WalkLoss().rate(biped, sample, x["upright"] > 0.5)}

    rng, n = np.random.default_rng(6), 40
    tilts = np.deg2rad(np.where(np.arange(n) % 2, 20.0, 9.0))[:, None]
    at = {
        "tilt": tilts * rng.uniform(-1.0, 1.0, (n, 2)),
        "corners": np.where(np.arange(n) % 3, 0.5, 2.0)[:, None, None]
        * weight
        * uniform(rng, n, 0.05, 1.0, 2, 4) ** 4,
        "upright": np.where(np.arange(n) < 30, 1.0, 0.0),
    }
    value, found = slopes(rate, at, {"tilt": 0.1, "corners": 0.2 * weight})
    assert_equal(found)
    by = {name: one.forward["rate"] for name, one in found.items()}
    fine = at["upright"] > 0.5
    leans = fine & (np.abs(at["tilt"]).max(axis=1) > np.deg2rad(10.0))
    pushed = fine & np.any(at["corners"].sum(axis=-1) > weight, axis=1)
    short = fine & (value["rate"][:, 3] > 0.0)
    for some in (leans, pushed, short, fine & ~leans):
        assert some.sum() > 4
    assert np.all(by["tilt"][fine, 0] != 0.0)
    assert np.all(by["tilt"][leans, 4] != 0.0)
    assert np.all(np.abs(by["corners"][pushed, 1:3]).max(axis=(-2, -1)) > 0.0)
    assert np.all(by["corners"][short, 3] != 0.0)
    np.testing.assert_array_equal(by["tilt"][fine & ~leans, 4], 0.0)
    for one in by.values():
        np.testing.assert_array_equal(one[~fine], 0.0)

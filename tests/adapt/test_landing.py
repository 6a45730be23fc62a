"""The landing stage against the equations: golden T_mod, T*, and the tick-by-tick transcription of Eqs. 6-16.

No physics: a foot that is commanded to within the gap of its step's ground closes its switches.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from landing_transcription import (
    ALL_REPAIRS,
    Numbers,
    Plan,
    Readings,
    Repairs,
    commands,
    longest_T_mod,
    quintic,
)

from jaxbiped import planner, robot
from jaxbiped.adapt import Controller, Landing, Sensed
from jaxbiped.adapt.blends import longest_time_to_rest
from jaxbiped.adapt.landing import SMALLEST_T_MOD, LandingStage, descent, longest_set_down, nominal_T_mod

DT = 0.002
N_STEPS = 6
DELTA_Z = 0.01


def sole_and_pelvis(targets):
    """Position, velocity and acceleration of (left sole, right sole, pelvis), (3 orders, 3 bodies, 3)."""
    orders = (targets.position, targets.velocity, targets.acceleration)
    return jnp.stack([jnp.concatenate([order.sole, order.pelvis[None]]) for order in orders])


@partial(jax.jit, static_argnums=2)
def walk(controller, heights, ticks, delta_z=DELTA_Z):
    """Step the controller over ground of a height per step: commands, plan, switches, phases, misses."""

    def tick(carry, i):
        state, before, closed_at = carry
        time = i * DT
        phase = controller.gait.phase(time)
        close = before[:, 2] <= heights[phase.step] + delta_z
        swings = jnp.arange(2) == phase.swing
        closed = close & swings & (phase.time_since_liftoff > 0.0)
        closed_at = jnp.where(closed, jnp.minimum(closed_at, time), jnp.inf)
        spread = [jnp.broadcast_to(leaf[:, None], (2, 4)) for leaf in (closed, closed_at)]
        state, targets = controller.step(state, Sensed.nothing(time, switch=spread[0], switch_time=spread[1]))
        row = (
            sole_and_pelvis(targets),
            sole_and_pelvis(planner.at(controller.gait, time)),
            spread,
            phase,
        )
        return (state, targets.position.sole, closed_at), row

    start = (controller.init(), controller.gait.task(jnp.zeros(())).sole, jnp.full(2, jnp.inf))
    (state, _, _), rows = jax.lax.scan(tick, start, jnp.arange(ticks))
    return *rows, state.stages["landing"].missed


@pytest.fixture(scope="module")
def gait():
    with jax.enable_x64(True):
        return planner.PolynomialGait.preset(robot.load("surena3"), N_STEPS)


def heights_of(**steps):
    heights = np.zeros(N_STEPS)
    for name, height in steps.items():
        heights[int(name.removeprefix("step"))] = height
    return jnp.asarray(heights)


def ticks_of(gait):
    return int(float(gait.duration) / DT)


@pytest.mark.parametrize(("delta_z", "T_mod"), [(0.005, 0.123), (0.01, 0.161), (0.015, 0.189), (0.02, 0.213)])
def test_nominal_T_mod_is_the_time_the_plan_needs(x64, gait, delta_z, T_mod):
    ours = nominal_T_mod(gait, jnp.asarray(delta_z))
    assert float(ours) == pytest.approx(T_mod, abs=6e-4)
    at_touch = gait.task(gait.timing.touchdown(0) - ours)
    assert float(at_touch.sole[gait.first_swing, 2]) == pytest.approx(delta_z, abs=1e-12)


def test_derivative_of_nominal_T_mod(x64, gait):
    slope = jax.jacfwd(partial(nominal_T_mod, gait))(jnp.asarray(0.01))
    step = 1e-5
    secant = (
        nominal_T_mod(gait, jnp.asarray(0.01 + step)) - nominal_T_mod(gait, jnp.asarray(0.01 - step))
    ) / (2 * step)
    assert float(slope) == pytest.approx(float(secant), rel=1e-6)
    assert float(slope) > 1.0


def test_switches_that_close_on_the_ground_need_no_time_to_set_down(gait):
    """In both precisions: the foot is stopped at once, and no derivative is infinite there."""
    for exact in (True, False):
        with jax.enable_x64(exact):
            plan = planner.PolynomialGait.preset(robot.load("surena3"), N_STEPS)
            for delta_z in (0.0, 1e-9):
                T_mod, slope = jax.jvp(partial(nominal_T_mod, plan), (jnp.asarray(delta_z),), (jnp.ones(()),))
                assert float(T_mod) == pytest.approx(SMALLEST_T_MOD) and float(slope) == 0.0
            times = [float(nominal_T_mod(plan, jnp.asarray(dz))) for dz in (1e-6, 1e-5, 1e-4, 1e-3, 5e-3)]
            assert times == sorted(times) and times[0] > SMALLEST_T_MOD


@pytest.mark.parametrize("make", [Landing.repaired, Landing.paper])
def test_landing_on_time_alone_is_finite_and_as_with_nearly_no_gap(x64, gait, make):
    """Switches and stage at 0 m, ground of 0, +2 and -2 cm: commands and their derivatives, beside those for 0.1 mm."""
    heights, ticks = heights_of(step2=0.02, step4=-0.02), ticks_of(gait)

    def commands(delta_z, speed):
        params = make(delta_z=delta_z, descent_speed=speed)
        bodies, *_, missed = walk(Controller(gait, params), heights, ticks, delta_z)
        return bodies, missed

    zero, speed = jnp.zeros(()), jnp.asarray(0.2)
    on_time, missed = commands(zero, speed)
    nearly, _ = commands(jnp.asarray(1e-4), speed)
    assert int(missed) == 0 and np.isfinite(np.asarray(on_time)).all()
    place = np.asarray(on_time)[:, 0]
    np.testing.assert_allclose(place, np.asarray(nearly)[:, 0], atol=4e-3)
    # Pushed no further into the ground than the time it takes to stop the foot: v SMALLEST_T_MOD / 5 with v < 1 m/s.
    phase_heights = np.asarray(heights)
    assert place[:, :2, 2].min() > phase_heights.min() - 2e-3
    for tangent in ((jnp.ones(()), zero), (zero, jnp.ones(()))):
        _, (slope, _) = jax.jvp(commands, (zero, speed), tangent)
        assert np.isfinite(np.asarray(slope)).all() and np.abs(np.asarray(slope[:, 0])).max() < 1e3


def test_T_star_never_undershoots_and_is_tight(x64):
    """4,000 random touches: at T* the foot never goes below the ground; a fifth longer, and nearly all do."""
    rng = np.random.default_rng(1)
    beyond = []
    for v, a, dz in rng.uniform((0.02, -3.0, 0.003), (0.6, 6.0, 0.03), (4000, 3)):
        T = float(longest_time_to_rest(*map(jnp.asarray, (-v, a, dz))))
        if not np.isfinite(T):
            assert 64 * v * v < 80 * a * dz
            continue
        for stretch in (1.0, 1.2):
            s = np.linspace(0, 1, 200)
            path = quintic((0.0, -v, a), (-dz, 0.0, 0.0), stretch * T)
            depth = np.polynomial.polynomial.polyval(s * stretch * T, path).min() + dz
            if stretch == 1.0:
                assert depth > -1e-9 * dz
            else:
                beyond.append(depth < -1e-6 * dz)
    assert len(beyond) > 3000
    assert np.mean(beyond) > 0.95


def test_T_star_of_a_foot_that_does_not_go_down(x64):
    """Accelerated downward it has a limit too, the oracle's; it never undershoots there, and does a twentieth later."""
    rng = np.random.default_rng(2)
    rates = rng.uniform((0.0, -6.0, 0.003), (0.3, 3.0, 0.03), (2000, 3))
    rates[::10, 0] = 0.0
    ours = np.asarray(jax.vmap(longest_set_down)(*jnp.asarray(rates).T))
    np.testing.assert_allclose(ours, [longest_T_mod(*one) for one in rates], rtol=1e-9)
    s = np.linspace(0.0, 1.0, 2000)
    for (v, a, dz), T in zip(rates[::20], ours[::20], strict=True):
        assert np.isfinite(T) == (a < 0.0)
        for stretch, undershoots in ((1.0, False), (1.05, True)) if a < 0.0 else ():
            path = quintic((0.0, v, a), (-dz, 0.0, 0.0), stretch * T)
            depth = np.polynomial.polynomial.polyval(s * stretch * T, path).min() + dz
            assert (depth < -1e-9 * dz) == undershoots


def test_flat_ground_stays_within_a_millimetre_of_the_plan(x64, gait):
    ours, plan, *_ = walk(Controller(gait, Landing.repaired()), heights_of(), ticks_of(gait))
    assert np.abs(ours[:, 0] - plan[:, 0]).max() < 1e-3


@pytest.mark.parametrize("variant", [Landing.paper, Landing.repaired])
@pytest.mark.parametrize("height", [0.01, 0.03, 0.05])
def test_obstacle_is_stood_on_and_released(x64, gait, variant, height):
    """The foot stands at the obstacle's height until T_c; one single support later nothing is left vertically."""
    ours, plan, _, phase, missed = walk(Controller(gait, variant()), heights_of(step2=height), ticks_of(gait))
    foot = int((gait.first_swing + 2) % 2)
    kept = np.flatnonzero((phase.step == 2) & (phase.time_since_liftoff > gait.params.T_s + 0.05))
    added = np.asarray(ours - plan)[:, 0]
    np.testing.assert_allclose(added[kept, foot, 2], height, atol=1.2e-3)
    assert np.all(added[kept, foot, 0] < 0.0)
    np.testing.assert_array_equal(added[kept, 2], 0.0)
    released = np.flatnonzero((phase.step == 3) & (phase.time_since_liftoff > gait.params.T_s))
    np.testing.assert_allclose(added[released, foot, 2], 0.0, atol=1e-12)
    assert int(missed) == 0


@pytest.mark.parametrize("variant", [Landing.paper, Landing.repaired])
@pytest.mark.parametrize("depth", [0.02, 0.04])
def test_hole_is_reached_with_the_pelvis_following(x64, gait, variant, depth):
    ours, plan, _, phase, missed = walk(Controller(gait, variant()), heights_of(step2=-depth), ticks_of(gait))
    foot = int((gait.first_swing + 2) % 2)
    end = np.flatnonzero(phase.step == 2)[-1]
    added = np.asarray(ours - plan)[end, 0]
    assert added[foot, 2] == pytest.approx(-depth, abs=1e-3)
    pelvis = added[2, 2] if variant == Landing.repaired else added[2, 2] - DELTA_Z
    assert pelvis == pytest.approx(-depth, abs=1e-3)
    assert int(missed) == 0


def test_repaired_commands_are_smooth(x64, gait):
    """C1 everywhere: between ticks no more than velocity and steps of the descent's acceleration explain."""
    heights = heights_of(step1=0.03, step2=-0.03, step4=0.02)
    ours, *_ = walk(Controller(gait, Landing.repaired()), heights, ticks_of(gait))
    p, v, a = np.moveaxis(np.asarray(ours), 1, 0)
    predicted = p[:-1] + DT * v[:-1] + 0.5 * DT**2 * a[:-1]
    step = float(Landing().descent_acceleration)
    assert np.abs(p[1:] - predicted).max() < 0.5 * step * DT**2
    assert np.abs(v[1:] - v[:-1] - DT * a[:-1]).max() < 1.5 * step * DT


def test_a_touch_that_never_comes_stops_and_is_counted(x64, gait):
    ours, plan, _, phase, missed = walk(
        Controller(gait, Landing.repaired()), heights_of(step2=-1.0), ticks_of(gait)
    )
    assert int(missed) == 1
    foot = int((gait.first_swing + 2) % 2)
    end = np.flatnonzero(phase.step == 2)[-1]
    assert -0.0801 <= np.asarray(ours - plan)[end, 0, foot, 2] < -0.05
    np.testing.assert_allclose(np.asarray(ours)[end, 1, foot, 2], 0.0, atol=1e-2)
    jump = np.abs(np.diff(np.asarray(ours)[:, 0], axis=0)).max()
    assert jump < 1.2 * np.abs(np.diff(np.asarray(plan)[:, 0], axis=0)).max()


@pytest.mark.parametrize("max_descent", [0.002, 0.0133, 0.014, 0.08])
def test_descent_ends_where_it_may(x64, max_descent):
    """Also where the descent's speed could not be stopped that soon (v^2 / a = 13.3 mm); its acceleration is kept."""
    p = Landing.repaired(max_descent=jnp.asarray(max_descent))
    t = np.linspace(-0.1, 1.5, 3201)
    depth = np.asarray(jax.vmap(lambda t: descent(p, t, jnp.asarray(1.0)))(jnp.asarray(t)))
    assert depth[t <= 0.0].max() == 0.0
    assert depth.max() == pytest.approx(max_descent, abs=1e-12)
    np.testing.assert_allclose(depth[t > 1.0], max_descent, rtol=0.0, atol=1e-12)
    speed = np.diff(depth) / np.diff(t)
    assert speed.min() > -1e-9
    assert speed.max() < float(p.descent_speed) + 1e-9
    assert np.abs(np.diff(speed) / np.diff(t)[1:]).max() < float(p.descent_acceleration) + 1e-3


@jax.jit
def _touch(stage, nominal, tau):
    return stage._touch(stage.init(), nominal, tau).touch


@pytest.mark.parametrize("commanded", [False, True])
def test_a_touch_inside_a_tick_starts_from_the_rates_there(x64, gait, commanded):
    """Without offsets the commanded rates are the planned ones, so the switch makes no difference."""
    stage = LandingStage.plan(Landing(commanded_velocity=commanded), gait)
    touchdown, ago = gait.timing.touchdown(2), 0.7 * DT
    nominal = planner.at(gait, touchdown - 0.05)
    tau = nominal.phase.time_since_liftoff - ago
    touch = _touch(stage, nominal, tau)
    then = np.asarray(sole_and_pelvis(planner.at(gait, touchdown - 0.05 - ago)))
    foot = int((gait.first_swing + 2) % 2)
    np.testing.assert_allclose(touch[1], then[1, foot, [0, 2]], rtol=0.0, atol=2e-4)
    assert np.abs(ago * np.asarray(touch[2])).max() > 1e-3, "no difference to be seen"


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(
    ("variant", "repairs"),
    [(Landing.paper, Repairs()), (Landing.repaired, ALL_REPAIRS)],
    ids=["paper", "repaired"],
)
def test_random_ground_is_met_as_in_the_transcription(x64, gait, variant, repairs, seed):
    """Random ground under every step: the stage's commands are those of the tick-by-tick transcription."""
    heights = np.random.default_rng(seed).uniform(-0.04, 0.05, N_STEPS)
    controller = Controller(gait, variant())
    ours, plan, switches, phase, _ = jax.tree.map(
        np.asarray, walk(controller, jnp.asarray(heights), ticks_of(gait))
    )
    stage = controller.stage("landing")
    assert stage is not None
    p = stage.params
    numbers = Numbers(
        float(p.delta_z),
        float(stage.T_mod),
        np.asarray(stage.delta_x),
        float(p.descent_speed),
        float(p.descent_acceleration),
        float(p.max_descent),
        float(p.release_share),
    )
    time = DT * np.arange(len(ours))
    T_s, T_c = float(gait.timing.T_s), float(gait.timing.T_c)
    ticks = Plan(time, phase.step, phase.swing, phase.time_since_liftoff, plan, T_s, T_c)
    theirs = commands(ticks, Readings(*switches), numbers, repairs)
    np.testing.assert_allclose(ours[:, 0], theirs.pose[:, 0], rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("name", ["delta_z", "T_mod", "descent_speed", "max_descent", "release_share"])
def test_what_cannot_be_meant_is_refused(name):
    least = ">= 0" if name == "delta_z" else "> 0"
    with pytest.raises(ValueError, match=rf"^{name}: got -1( s| m| m/s)?, allowed: {least} and <= "):
        Landing.repaired(**{name: jnp.asarray(-1.0)})

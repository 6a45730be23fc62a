"""The polynomial gait of Khadiv et al., Eqs. 1-5, for any number of steps, from rest to rest.

Steps are numbered from 0. Step k stands on the foot at x = k D_s while the other one swings from the foothold
of step k - 1 to that of step k + 1; the first swing is half a stride, the last one ends beside the stance
foot. Time runs

    0 .. T_ini          pelvis moves from rest into the steady motion, both feet on the ground
    T_ini + k T_c ..    step k: single support T_s, then double support T_d
    .. duration         pelvis comes to rest in T_end after the last touchdown
"""

from collections.abc import Mapping
from functools import partial
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxbiped import runtime
from jaxbiped.checked import Quantity
from jaxbiped.planner.checks import require
from jaxbiped.planner.gait import PlannedGait, register
from jaxbiped.planner.polynomial import (
    PiecewisePolynomial,
    Polynomial,
    Term,
    alternating,
    as_scalar,
    between,
    boundary_polynomial,
    coupled_polynomials,
    quintic,
    shift,
    spline_slopes,
    taken,
)
from jaxbiped.planner.targets import Count, TaskSpace, Timing, as_count
from jaxbiped.robot import LEFT, RIGHT, RobotParams

Scalar = Float[Array, ""]

_DURATION = Quantity("s", 0.0, 60.0, above=True)
_OFFSET = Quantity("m", -1.0, 1.0)
_REST = Quantity("s", 0.0, 600.0, above=True)
_HEIGHT = Quantity("m", 0.0, 2.0, above=True)
_START_STOP = (
    *("x_rest_start", "x_s_first", "x_e_first", "x_s_second"),
    *("x_e_penultimate", "x_s_last", "x_e_last", "x_rest_end"),
)
QUANTITIES = {
    "D_s": Quantity("m", 0.0, 2.0),
    "T_s": _DURATION,
    "T_d": _DURATION,
    "H_max": Quantity("m", 0.0, 1.0, above=True),
    **dict.fromkeys(("x_s", "x_e", "y_d", "y_m"), _OFFSET),
    "z_max": _HEIGHT,
    "z_min": _HEIGHT,
    "L_p": Quantity("m", 0.0, 2.0, above=True),
    "T_ini": _REST,
    "T_end": _REST,
    **{f"start_stop.{name}": _OFFSET for name in _START_STOP},
    **{f"start_stop.{name}": Quantity("m/s", -5.0, 5.0) for name in ("v_first", "v_last")},
}
"""Allowed values of the parameters, by their dotted names."""


class StartStop(eqx.Module):
    """Sagittal places of the pelvis at rest and in the first and last steps, instead of x_s and x_e.

    Offsets of the pelvis from the stance foot, with the signs of x_s (behind it, start of single support) and
    x_e (ahead of it, end of single support).
    """

    x_rest_start: Scalar = eqx.field(converter=as_scalar)
    """Pelvis ahead of the feet at rest, before the walk [m]."""
    x_s_first: Scalar = eqx.field(converter=as_scalar)
    """x_s of step 0 [m]."""
    x_e_first: Scalar = eqx.field(converter=as_scalar)
    """x_e of step 0 [m]."""
    x_s_second: Scalar = eqx.field(converter=as_scalar)
    """x_s of step 1 [m]."""
    x_e_penultimate: Scalar = eqx.field(converter=as_scalar)
    """x_e of the last step but one [m]."""
    x_s_last: Scalar = eqx.field(converter=as_scalar)
    """x_s of the last step [m]."""
    x_e_last: Scalar = eqx.field(converter=as_scalar)
    """x_e of the last step [m]."""
    x_rest_end: Scalar = eqx.field(converter=as_scalar)
    """Pelvis ahead of the feet at rest, after the walk [m]."""
    v_first: Scalar = eqx.field(converter=as_scalar)
    """Pelvis velocity at the first lift-off [m/s]."""
    v_last: Scalar = eqx.field(converter=as_scalar)
    """Pelvis velocity at the last touchdown [m/s]."""


class PolynomialParams(eqx.Module):
    """Parameters of the polynomial gait, by the paper's symbols."""

    D_s: Scalar = eqx.field(converter=as_scalar)
    """Step length [m]."""
    T_s: Scalar = eqx.field(converter=as_scalar)
    """Duration of single support [s]."""
    T_d: Scalar = eqx.field(converter=as_scalar)
    """Duration of double support [s]."""
    H_max: Scalar = eqx.field(converter=as_scalar)
    """Greatest height of the swing foot [m]."""
    x_s: Scalar = eqx.field(converter=as_scalar)
    """Pelvis behind the stance foot at the start of single support [m]."""
    x_e: Scalar = eqx.field(converter=as_scalar)
    """Pelvis ahead of the stance foot at the end of single support [m]."""
    y_d: Scalar = eqx.field(converter=as_scalar)
    """Lateral distance between pelvis and stance foot at the start and end of single support [m]."""
    y_m: Scalar = eqx.field(converter=as_scalar)
    """Smallest lateral distance between pelvis and stance foot, in mid single support; negative beyond the foot [m]."""
    z_max: Scalar = eqx.field(converter=as_scalar)
    """Greatest pelvis height over the ground, in the middle of single support [m]."""
    z_min: Scalar = eqx.field(converter=as_scalar)
    """Smallest pelvis height over the ground, in the middle of double support [m]."""
    L_p: Scalar = eqx.field(converter=as_scalar)
    """Lateral distance between the feet [m]."""
    T_ini: Scalar = eqx.field(converter=as_scalar)
    """Time from rest to the first lift-off [s]."""
    T_end: Scalar = eqx.field(converter=as_scalar)
    """Time from the last touchdown to rest [s]."""
    start_stop: StartStop
    """Sagittal parameters of start and stop."""

    @property
    def T_c(self) -> Scalar:
        """Duration of a step [s]."""
        return self.T_s + self.T_d


def swing_x(p: PolynomialParams) -> Polynomial:
    """Progress of the swing foot, 0 to 1 of its stride, over the time since lift-off [s] (khadiv Eq. 1)."""
    return quintic(0.0, p.T_s, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))


def swing_z(p: PolynomialParams) -> Polynomial:
    """Height of the swing foot [m] over the time since lift-off [s] (khadiv Eq. 2)."""
    times, orders = [0.0] * 3 + [0.5 * p.T_s] + [p.T_s] * 3, (0, 1, 2, 0, 0, 1, 2)
    return boundary_polynomial(times, orders, (0.0, 0.0, 0.0, p.H_max, 0.0, 0.0, 0.0))


def steady_pelvis_x(p: PolynomialParams) -> tuple[Polynomial, Polynomial]:
    """Pelvis ahead of the stance foot [m] in both phases, over the time since lift-off (khadiv Eq. 3)."""
    ssp, dsp = 0, 1
    start, switch, end = 0.0, p.T_s, p.T_c
    single, double = coupled_polynomials(
        [(start, switch), (switch, end)],
        (3, 3),
        [
            ([Term(ssp, start)], -p.x_s),
            ([Term(ssp, switch)], p.x_e),
            ([Term(dsp, switch)], p.x_e),
            ([Term(dsp, end)], p.D_s - p.x_s),
            *(([Term(ssp, switch, order), Term(dsp, switch, order, -1.0)], 0.0) for order in (1, 2)),
            *(([Term(ssp, start, order), Term(dsp, end, order, -1.0)], 0.0) for order in (1, 2)),
        ],
    )
    return single, double


def steady_pelvis_y(p: PolynomialParams) -> tuple[Polynomial, Polynomial]:
    """Lateral distance of the pelvis from the stance foot [m] in single and double support (khadiv Eq. 4).

    The printed equation lacks y_DSP(T_c) = L_p - y_d; the next step mirrors this one, whence the plus signs.
    """
    ssp, dsp = 0, 1
    start, switch, end = 0.0, p.T_s, p.T_c
    single, double = coupled_polynomials(
        [(start, switch), (switch, end)],
        (4, 3),
        [
            ([Term(ssp, start)], p.y_d),
            ([Term(ssp, 0.5 * p.T_s)], p.y_m),
            ([Term(ssp, switch)], p.y_d),
            ([Term(dsp, switch)], p.y_d),
            ([Term(dsp, end)], p.L_p - p.y_d),
            *(([Term(ssp, switch, order), Term(dsp, switch, order, -1.0)], 0.0) for order in (1, 2)),
            *(([Term(ssp, start, order), Term(dsp, end, order)], 0.0) for order in (1, 2)),
        ],
    )
    return single, double


def steady_pelvis_z(p: PolynomialParams) -> tuple[Polynomial, Polynomial]:
    """Pelvis height [m] falling from mid single support and rising from mid double support (khadiv Eq. 5).

    The printed conditions do not fix the cubics; zero slope at both knots does, and makes them C2.
    """
    middle_single, middle_double = 0.5 * p.T_s, p.T_s + 0.5 * p.T_d
    falling = ([middle_single] * 2 + [middle_double] * 2, (0, 1, 0, 1), (p.z_max, 0.0, p.z_min, 0.0))
    rising = ([middle_double] * 2 + [middle_single + p.T_c] * 2, (0, 1, 0, 1), (p.z_min, 0.0, p.z_max, 0.0))
    return boundary_polynomial(*falling), boundary_polynomial(*rising)


@register
class PolynomialGait(PlannedGait):
    """A planned polynomial walk of `n_steps` steps; build it with `make`."""

    name: ClassVar[str] = "polynomial"
    quantities: ClassVar[Mapping[str, Quantity]] = QUANTITIES
    """Allowed values of the parameters."""
    parameters: ClassVar[type[eqx.Module]] = PolynomialParams
    """The record of the parameters."""
    records: ClassVar[Mapping[str, type[eqx.Module]]] = {"start_stop": StartStop}
    params: PolynomialParams
    """Parameters from which the walk was planned."""
    n_steps: Int[Array, ""]
    """Number of steps."""
    first_swing: Int[Array, ""]
    """The foot that swings first, 0 left or 1 right."""
    foot_x: Polynomial
    """Progress of the swing foot, 0 to 1 (khadiv Eq. 1)."""
    foot_z: Polynomial
    """Height of the swing foot (khadiv Eq. 2) [m]."""
    pelvis_x: PiecewisePolynomial
    """Sagittal pelvis position in the world [m]."""
    pelvis_y: PiecewisePolynomial
    """Lateral pelvis position in the world [m]."""
    pelvis_z: PiecewisePolynomial
    """Pelvis height in the world [m]."""
    room: int = eqx.field(static=True)
    """Number of steps that tables have room for."""

    @classmethod
    def require_sane(cls, robot: RobotParams, params: PolynomialParams) -> None:
        """Raise a GaitError for parameters within their bounds that do not fit each other, or the robot."""
        p = params
        for name in ("T_ini", "T_end"):
            least = 0.5 * p.T_d
            require(name, getattr(p, name), f">= T_d / 2 = {float(least):g} s", getattr(p, name) >= least)
        require("z_max", p.z_max, f">= z_min = {float(p.z_min):g} m", p.z_max >= p.z_min, unit="m")
        inner = float(robot.p_sole_corner[RIGHT, :, 1].max() - robot.p_sole_corner[LEFT, :, 1].min())
        require("L_p", p.L_p, f"> {inner:g} m (the soles must not overlap)", p.L_p > inner, unit="m")

    @classmethod
    def plan(
        cls, params: PolynomialParams, n_steps: Count, first_swing: Count, room: int
    ) -> "PolynomialGait":
        """The walk of these parameters; pure."""
        return _plan(params, as_count(n_steps), as_count(first_swing), room)

    @property
    def duration(self) -> Scalar:
        """Duration of the walk from rest to rest [s]."""
        return self.pelvis_x.breaks[-1]

    @property
    def timing(self) -> Timing:
        """Times of the steps."""
        p = self.params
        return Timing(p.T_ini, p.T_s, p.T_c, self.n_steps, self.first_swing, self.room)

    def task(self, t: Scalar) -> TaskSpace:
        """Soles and pelvis in the world at time t [s]."""
        p, phase = self.params, self.phase(t)
        since_liftoff = jnp.clip(phase.time_since_liftoff, 0.0, p.T_s)
        come_from = p.D_s * jnp.maximum(phase.step - 1, 0)
        go_to = p.D_s * jnp.minimum(phase.step + 1, self.n_steps - 1)
        swing_foot = [
            come_from + (go_to - come_from) * self.foot_x(since_liftoff),
            self.foot_z(since_liftoff),
        ]
        stance_foot = [p.D_s * phase.step, jnp.zeros_like(t)]
        soles = []
        for side, y in ((LEFT, 0.5 * p.L_p), (RIGHT, -0.5 * p.L_p)):
            x, z = (
                jnp.where(phase.swing == side, a, b) for a, b in zip(swing_foot, stance_foot, strict=True)
            )
            soles.append(jnp.stack([x, y, z]))
        return TaskSpace(jnp.stack(soles), jnp.stack([self.pelvis_x(t), self.pelvis_y(t), self.pelvis_z(t)]))


@runtime.jit
def _plan(
    p: PolynomialParams, n_steps: Int[Array, ""], first_swing: Int[Array, ""], room: int
) -> PolynomialGait:
    times = _Times.of(p, n_steps, room)
    return PolynomialGait(
        params=p,
        n_steps=n_steps,
        first_swing=first_swing,
        room=room,
        foot_x=swing_x(p),
        foot_z=swing_z(p),
        pelvis_x=_walk_x(p, times),
        pelvis_y=_walk_y(p, times, first_swing),
        pelvis_z=_walk_z(p, times),
    )


class _Times(NamedTuple):
    """Times of a walk in tables that have room for more steps."""

    n_steps: Int[Array, ""]
    """Number of steps."""
    number: Int[Array, "room"]
    """Numbers of the steps."""
    delay: Float[Array, "room"]
    """Lift-off of every step [s]."""
    knots: Float[Array, "knots"]
    """Lift-off and touchdown of every step [s]."""
    breaks: Float[Array, "breaks"]
    """Start, lift-off and touchdown of every step, end; the end also in place of the steps that are not made [s]."""

    @classmethod
    def of(cls, p: PolynomialParams, n_steps: Int[Array, ""], room: int) -> "_Times":
        number = jnp.arange(room)
        liftoff = p.T_ini + p.T_c * number
        knots = jnp.stack([liftoff, liftoff + p.T_s], axis=1).reshape(-1)
        end = knots[2 * n_steps - 1] + p.T_end
        made = jnp.where(jnp.arange(2 * room) < 2 * n_steps, knots, end)
        breaks = jnp.concatenate([jnp.zeros(1, knots.dtype), made, end[None]])
        return cls(n_steps, number, liftoff, knots, breaks)


def _walk_x(p: PolynomialParams, times: _Times) -> PiecewisePolynomial:
    """One C2 cubic spline through the pelvis' via points of all steps, and quintics from and to rest.

    In the middle of a walk it is khadiv Eq. 3; the first and last steps have via points of their own, without
    which the ZMP would leave the feet while the walk starts and stops.
    """
    ends, number, knots, last = p.start_stop, times.number, times.knots, times.n_steps - 1
    x_s = jnp.where(number == 1, ends.x_s_second, p.x_s)
    x_s = jnp.where(number == 0, ends.x_s_first, jnp.where(number == last, ends.x_s_last, x_s))
    x_e = jnp.where(number == last - 1, ends.x_e_penultimate, p.x_e)
    x_e = jnp.where(number == last, ends.x_e_last, jnp.where(number == 0, ends.x_e_first, x_e))
    stance = p.D_s * number
    via = jnp.stack([stance - x_s, stance + x_e], axis=1).reshape(-1)
    slope = spline_slopes(knots, via, ends.v_first, ends.v_last, 2 * times.n_steps)
    cubics = jax.vmap(_cubic)(knots[:-1], knots[1:], via[:-1], via[1:], slope[:-1], slope[1:])
    used = 2 * times.n_steps - 1
    first, final = taken(cubics, 0), taken(cubics, used - 1)
    touchdown, end = knots[used], times.breaks[-1]
    start = quintic(0.0, p.T_ini, (ends.x_rest_start, 0.0, 0.0), _state(first, knots[0]))
    at_rest = (p.D_s * last + ends.x_rest_end, 0.0, 0.0)
    stop = quintic(touchdown, end, _state(final, touchdown), at_rest)
    return between(start, cubics, stop, times.breaks, used)


def _cubic(
    start: Scalar, end: Scalar, at_start: Scalar, at_end: Scalar, slope_start: Scalar, slope_end: Scalar
) -> Polynomial:
    values = [at_start, slope_start, at_end, slope_end]
    return boundary_polynomial([start, start, end, end], (0, 1, 0, 1), values)


def _state(polynomial: Polynomial, t: Scalar) -> list[Scalar]:
    """Value, speed and acceleration at a time [s]."""
    return [polynomial.derivative(t, order) for order in (0, 1, 2)]


def _walk_y(p: PolynomialParams, times: _Times, first_swing: Int[Array, ""]) -> PiecewisePolynomial:
    """Eq. 4 of khadiv from the first lift-off to the last touchdown, and quintics from and to mid-feet."""
    single, double = steady_pelvis_y(p)
    towards_swing = jnp.where((first_swing + times.number) % 2 == LEFT, 1.0, -1.0)
    stance_y = -towards_swing * 0.5 * p.L_p
    steps = alternating(
        *(jax.vmap(partial(shift, piece))(stance_y, times.delay, towards_swing) for piece in (single, double))
    )
    used = 2 * times.n_steps - 1
    liftoff, touchdown, end = times.breaks[1], times.knots[used], times.breaks[-1]
    at_rest = (0.0, 0.0, 0.0)
    start = quintic(0.0, liftoff, at_rest, _state(taken(steps, 0), liftoff))
    stop = quintic(touchdown, end, _state(taken(steps, used - 1), touchdown), at_rest)
    return between(start, taken(steps, slice(-1)), stop, times.breaks, used)


def _walk_z(p: PolynomialParams, times: _Times) -> PiecewisePolynomial:
    """Eq. 5 of khadiv from mid first to mid last single support, and quintics from and to z_min."""
    falling, rising = steady_pelvis_z(p)
    half, last = 0.5 * p.T_c, times.n_steps - 1
    middle_first, middle_last = p.T_ini + 0.5 * p.T_s, times.delay[last] + 0.5 * p.T_s
    top = (p.z_max, 0.0, falling.derivative(0.5 * p.T_s, 2))
    bottom = (p.z_min, 0.0, 0.0)
    steps = alternating(
        *(jax.vmap(partial(shift, piece, 0.0))(times.delay[:-1]) for piece in (falling, rising))
    )
    start = quintic(middle_first - half, middle_first, bottom, top)
    stop = quintic(middle_last, middle_last + half, top, bottom)
    halves = jnp.minimum(jnp.arange(2 * len(times.number) + 1), 2 * times.n_steps)
    return between(start, steps, stop, middle_first - half + half * halves, 2 * last)

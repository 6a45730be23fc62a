"""Khadiv Eqs. 6-16 in NumPy, tick by tick: what the landing stage is judged against. It shares no code with it.

The plan and what the switches say are data; the quintics are solved as linear systems, the
descent is added up from tick to tick.
"""

from typing import NamedTuple

import numpy as np

Triple = tuple[float, float, float]
"""A value with its rate and its acceleration."""

PELVIS = 2
"""Row of the pelvis, after the left and the right sole."""


class Plan(NamedTuple):
    """A planned walk at its ticks."""

    time: np.ndarray
    """[s] (n,)"""
    step: np.ndarray
    """Number of the step (n,)."""
    swing: np.ndarray
    """Its swing foot (n,)."""
    tau: np.ndarray
    """Time since its lift-off [s] (n,)."""
    pose: np.ndarray
    """Position, velocity, acceleration of left sole, right sole, pelvis (n, 3, 3, 3)."""
    T_s: float
    """[s]"""
    T_c: float
    """[s]"""


class Readings(NamedTuple):
    """What the switches say at the ticks of a walk."""

    closed: np.ndarray
    """(n, 2, 4)"""
    closed_at: np.ndarray
    """When each last closed [s] (n, 2, 4)."""


class Numbers(NamedTuple):
    """Parameters of the landing."""

    delta_z: float
    T_mod: float
    delta_x: np.ndarray
    descent_speed: float
    descent_acceleration: float
    max_descent: float
    release_share: float


class Repairs(NamedTuple):
    """What is mended; `Repairs()` is the letter of the paper."""

    no_undershoot: bool = False
    smooth_descent: bool = False
    pelvis_follows: bool = False
    commanded_velocity: bool = False
    keep_x: bool = False
    interpolate: bool = False
    stays_down: bool = False


ALL_REPAIRS = Repairs(*[True] * 7)


class Commands(NamedTuple):
    """What the landing stage should command."""

    pose: np.ndarray
    """As in the plan (n, 3, 3, 3)."""
    touch: dict[int, float]
    """When the swing foot touched, by step, since its lift-off [s]."""
    kinks: np.ndarray
    """Ticks at which a rate or an acceleration jumps (n,)."""


def quintic(start: Triple, end: Triple, T: float) -> np.ndarray:
    """Coefficients of the quintic with given value, rate and acceleration at 0 and at T, lowest power first."""
    rows = []
    for t in (0.0, T):
        powers = [t**k for k in range(6)]
        rows.append(powers)
        rows.append([k * powers[k - 1] if k > 0 else 0.0 for k in range(6)])
        rows.append([k * (k - 1) * powers[k - 2] if k > 1 else 0.0 for k in range(6)])
    return np.linalg.solve(np.array(rows), np.array([*start, *end]))


def at(coefficients: np.ndarray, t: float) -> Triple:
    """A polynomial with its first two derivatives."""
    value = rate = half = 0.0
    for c in reversed(coefficients.tolist()):
        half = half * t + rate
        rate = rate * t + value
        value = value * t + c
    return value, rate, 2.0 * half


class SetDown(NamedTuple):
    """Eqs. 6 and 7 along one axis, from where the foot was at the touch."""

    start: Triple
    way: float
    T: float
    coefficients: np.ndarray

    @classmethod
    def solve(cls, start: Triple, way: float, T: float) -> "SetDown":
        return cls(start, way, T, quintic((0.0, *start[1:]), (way, 0.0, 0.0), T))

    def mod(self, t: float) -> Triple:
        """x_mod or z_mod, `t` seconds after the touch."""
        return at(self.coefficients, t) if t <= self.T else (self.way, 0.0, 0.0)


class Descent:
    """How far a foot that has not touched by T_s has been lowered, added up tick by tick (Eqs. 12 and 14)."""

    def __init__(self, numbers: Numbers, smooth: bool, T_s: float, T_c: float):
        v, a, T = numbers.descent_speed, numbers.descent_acceleration, T_c - T_s
        self.T_s, self.now, self.depth = T_s, 0.0, 0.0
        if smooth:
            # Up to the speed with the acceleration, and back to rest at max_descent or at T_c, if sooner.
            v = min(v, np.sqrt(a * numbers.max_descent), 0.5 * a * T)
            end = min(numbers.max_descent / v + v / a, T)
            self.knots, self.speeds = np.array([0.0, v / a, end - v / a, end]), np.array([0.0, v, v, 0.0])
        else:
            self.knots, self.speeds = np.array([0.0, T]), np.array([v, v])

    def go_on(self, tau: float) -> Triple:
        """Lower it until `tau` since lift-off: depth, rate, acceleration."""
        to = max(tau - self.T_s, 0.0)
        for k in range(len(self.knots) - 1):
            begin, end = self.knots[k], self.knots[k + 1]
            first, last = max(self.now, begin), min(to, end)
            if last > first:
                middle = 0.5 * (first + last)
                self.depth += (last - first) * self._speed(k, middle)
        self.now = max(to, self.now)
        for k in range(len(self.knots) - 1):
            if self.knots[k] < to <= self.knots[k + 1]:
                return self.depth, self._speed(k, to), self._slope(k)
        return self.depth, 0.0, 0.0

    def kink(self, tau: float) -> bool:
        return bool(np.abs(tau - self.T_s - self.knots).min() < 1e-9)

    def _slope(self, k: int) -> float:
        span = self.knots[k + 1] - self.knots[k]
        return float((self.speeds[k + 1] - self.speeds[k]) / span) if span > 0.0 else 0.0

    def _speed(self, k: int, t: float) -> float:
        return float(self.speeds[k]) + self._slope(k) * (t - float(self.knots[k]))


def longest_T_mod(v: float, a: float, delta_z: float) -> float:
    """T*: the least T > 0 with a T^2 + 8 v T + 20 delta_z = 0, if there is one (v < 0: the foot falls)."""
    roots = np.roots([a, 8.0 * v, 20.0 * delta_z])
    real = [float(r.real) for r in roots if abs(r.imag) < 1e-12 and r.real > 0.0]
    return min(real, default=np.inf)


def commands(plan: Plan, readings: Readings, numbers: Numbers, repairs: Repairs) -> Commands:
    """The commanded soles and pelvis of a walk."""
    T_s, T_c = plan.T_s, plan.T_c
    pose, kinks, touches = plan.pose.copy(), np.zeros(len(plan.tau), bool), {}
    release_time = numbers.release_share * T_s
    release = quintic((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), release_time)  # Eq. 16
    any_closed = np.asarray(readings.closed.any(axis=2)).tolist()
    steps, swings, taus = plan.step.tolist(), plan.swing.tolist(), plan.tau.tolist()

    def kept(t: float) -> Triple:
        return (1.0, 0.0, 0.0) if t < 0.0 else at(release, t) if t < release_time else (0.0, 0.0, 0.0)

    def fresh() -> Descent:
        return Descent(numbers, repairs.smooth_descent, T_s, T_c)

    # Delta of the feet and of the pelvis at the lift-off of this step, which is to be released.
    dx, dz, dpelvis = [0.0, 0.0], [0.0, 0.0], 0.0
    descent, touch, lowered_at_touch, last = fresh(), None, 0.0, steps[0]
    for i, (step, swing, tau) in enumerate(zip(steps, swings, taus, strict=True)):
        stance = 1 - swing

        # What has been applied by T_c is Delta, for the foot that has landed and for the pelvis.
        if step != last:
            landed = stance
            if touch is None:
                sunk = descent.go_on(T_c)[0]
                new_x, new_z, new_pelvis = 0.0, -sunk, -sunk
            else:
                (x, z), t, late = touch, T_c - touches[last], touches[last] > T_s
                new_x = x.start[0] + x.mod(t)[0] - plan.pose[i, 0, landed, 0]
                new_z = z.start[0] + z.mod(t)[0] - plan.pose[i, 0, landed, 2]
                if repairs.stays_down:
                    new_z += kept(T_c)[0] * dz[1 - landed]
                follow = z.mod(t)[0] if repairs.pelvis_follows else 0.0
                new_pelvis = follow - lowered_at_touch if late else 0.0
            dx = [dx[0], dx[1]] if repairs.keep_x else [0.0, 0.0]
            dx[landed] = new_x
            dz = [0.0, 0.0]
            dz[landed], dpelvis = new_z, new_pelvis
            descent, touch, lowered_at_touch, last = fresh(), None, 0.0, step

        # Watch the swing foot from the midpoint of SSP until the end of DSP (first time-table of Fig. 4).
        if touch is None and 0.5 * T_s <= tau <= T_c and any_closed[i][swing]:
            tau_td = tau
            if repairs.interpolate:
                closings = readings.closed_at[i, swing]
                ago = plan.time[i] - closings[readings.closed[i, swing]].min()
                # However old the reading is: what is seen at this tick may have happened before the last one.
                tau_td = max(tau - float(ago), 0.5 * T_s)
            late = tau_td > T_s
            r = tau_td - tau
            p, v, a = plan.pose[i, :, swing]
            x = (float(p[0] + v[0] * r + 0.5 * a[0] * r * r), float(v[0] + a[0] * r), float(a[0]))
            z = (float(p[2] + v[2] * r + 0.5 * a[2] * r * r), float(v[2] + a[2] * r), float(a[2]))
            # Lowered anew up to the touch: the descent has gone on beyond it, unseen.
            sunk, fade = fresh().go_on(tau_td), kept(tau_td)
            lowered_at_touch = sunk[0]
            start_x = (x[0] + fade[0] * dx[swing], *x[1:])
            start_z = (z[0] - sunk[0], *z[1:])
            if repairs.commanded_velocity:
                start_x = (start_x[0], x[1] + fade[1] * dx[swing], x[2] + fade[2] * dx[swing])
                start_z = (start_z[0], z[1] - sunk[1], z[2] - sunk[2])
            if repairs.stays_down:
                # Heights count from what the stance foot stands on, which Eq. 16 is still moving.
                start_z = (start_z[0] - fade[0] * dz[stance], *start_z[1:])
                if repairs.commanded_velocity:
                    start_z = (
                        start_z[0],
                        start_z[1] - fade[1] * dz[stance],
                        start_z[2] - fade[2] * dz[stance],
                    )
            T_mod = numbers.T_mod
            if repairs.no_undershoot:
                T_mod = min(T_mod, longest_T_mod(start_z[1], start_z[2], numbers.delta_z))
            way = 0.0 if late else float(numbers.delta_x[step])
            touches[step] = tau_td
            touch = SetDown.solve(start_x, way, T_mod), SetDown.solve(start_z, -numbers.delta_z, T_mod)

        fade = kept(tau)
        now = pose[i]
        if touch is None:
            sunk = descent.go_on(tau)
            for k in range(3):
                now[k, swing, 0] += fade[k] * dx[swing]
                now[k, swing, 2] -= sunk[k]
                now[k, PELVIS, 2] += fade[k] * dpelvis - sunk[k]
            kinks[i] = descent.kink(tau)
        else:
            t, late = tau - touches[step], touches[step] > T_s
            x_mod, z_mod = touch[0].mod(t), touch[1].mod(t)
            now[:, swing, 0], now[:, swing, 2] = x_mod, z_mod
            now[0, swing, 0] += touch[0].start[0]
            now[0, swing, 2] += touch[1].start[0]
            if repairs.stays_down:
                now[:, swing, 2] += np.array(fade) * dz[stance]
            for k in range(3):
                follow = z_mod[k] if late and repairs.pelvis_follows else 0.0
                now[k, PELVIS, 2] += fade[k] * dpelvis + follow
            if late:
                now[0, PELVIS, 2] -= lowered_at_touch
        for k in range(3):
            stays = fade[k] if not repairs.keep_x else (1.0, 0.0, 0.0)[k]
            now[k, stance, 0] += stays * dx[stance]
            now[k, stance, 2] += fade[k] * dz[stance]
    return Commands(pose, touches, kinks)

"""El-Kahlout's payload reflex, tick by tick from the thesis: the oracle of the payload stage, sharing no code with it.

Eqs. 3.1-3.7, 3.11-3.40, 4.5, 4.6 in the thesis' own variables: feet in the body frame, x_r, x_l, y_r, y_l, z_r, z_l.
Errata applied: the phase of Z_l in Eq. 3.6; z_r_s, z_l_s in Eqs. 3.15, 3.16; the full shift of Eqs. 3.20, 3.21 (the
appendix halves it); Y_l shifts like Y_r under S7 in Eq. 3.30. Where the thesis is silent:

  - The walk is finite. It starts from rest T_ini before the thesis' t = 0 and comes to rest T_end after the last
    mid double support. The walk goes on at the lift-off of whichever foot is behind: the step that was cut short,
    or the one after it if it got far enough; before the first lift-off, from the start.
  - Two low-passes of the force watch for a load. The thesis' own one decides while the robot walks calmly; a slower
    one decides during the recovery, and while the robot walks, for `rearm_time` after it went on instead of the
    fast one. The slower one starts anew with the settling time; what it says at its end is the normal weight then.
  - The shift of x_ref is counted from the original x_ref, so that a second reading of the ZMP replaces the first.
  - Events are taken from inside the tick, by linear interpolation of what was low-passed.
  - A reflex starts one tick after the crossing, which is known at the tick after it: so it can start at any instant.
    For the same reason the tick before the shift of x_ref, and before the walk goes on, knows of it, and the ZMP that
    decides is that of one tick before the shift.
"""

from dataclasses import dataclass, field
from math import acos, cos, pi, sin

import numpy as np

WALK, REFLEX, SETTLE, SHIFT, RECOVER, HOLD = range(6)
THESIS_TICK = 0.0005
LAMBDA_FORCE, LAMBDA_ZMP = 5e-3, 5e-4
NO_HEIGHT = 1e-9
"""What counts as Z = -h_b, for a recovery step that has nothing to recover [m]."""


@dataclass(frozen=True)
class ThesisGait:
    """Section 3.2; `left_first` is the thesis' walk, otherwise its mirror image."""

    n_steps: int
    left_first: bool = True
    t_ss: float = 1.4
    t_ds: float = 1.0
    b_s: float = 0.08
    w: float = 0.13
    w_of: float = 0.11
    h_b: float = 0.5
    h_s: float = 0.03
    x_ref: float = -0.09
    y_ref: float = 0.0
    T_ini: float = 1.2
    T_end: float = 1.2


@dataclass(frozen=True)
class ThesisReflex:
    """Section 3.3, and what the thesis leaves to choose."""

    modified: bool
    threshold: float
    slow_threshold: float
    slow_time_constant: float
    rearm_time: float
    t_refl_per: float
    t_set_t: float
    t_x_ref_as: float
    zmp_balanced: float
    gain: float = 1.0


@dataclass
class Log:
    """What happened: (time, ...) of every event."""

    triggers: list[float] = field(default_factory=list)
    modes_triggered: list[int] = field(default_factory=list)
    resumes: list[float] = field(default_factory=list)
    resume_steps: list[int] = field(default_factory=list)
    recoveries: list[tuple[float, float, float]] = field(default_factory=list)
    """f, t_ss_a, t_ds_a."""
    kinks: list[float] = field(default_factory=list)
    """Instants at which acceleration or velocity of the motion jumps [s]."""


def to_velocity(T: float, speed: float) -> np.ndarray:
    """Coefficients of the quintic from rest at 0 to position 0, `speed`, no acceleration at T."""
    rows = np.zeros((6, 6))
    for n in range(6):
        for row, (t, order) in enumerate([(0.0, 0), (0.0, 1), (0.0, 2), (T, 0), (T, 1), (T, 2)]):
            if n >= order:
                factor = 1.0
                for j in range(order):
                    factor *= n - j
                rows[row, n] = factor * t ** (n - order)
    return np.linalg.solve(rows, [0.0, 0.0, 0.0, 0.0, speed, 0.0])


class Walk:
    """Eqs. 3.1-3.6 for a finite walk, plan time s = t + T_ini, about x_ref = 0."""

    def __init__(self, gait: ThesisGait):
        self.g, self.T_c = gait, gait.t_ss + gait.t_ds
        self.stop = gait.T_ini + gait.n_steps * self.T_c
        self.end = self.stop + gait.T_end
        rising = gait.w * pi / self.T_c
        self.sway_in = [float(c) for c in to_velocity(gait.T_ini, rising)]
        falling = rising if gait.n_steps % 2 == 0 else -rising
        self.sway_out = [float(c) for c in to_velocity(gait.T_end, -falling)]  # run backwards in time

    def liftoff(self, step: int) -> float:
        return self.g.T_ini + 0.5 * self.g.t_ds + step * self.T_c

    def liftoffs_before(self, s: float) -> int:
        """How many steps have begun."""
        return sum(s >= self.liftoff(step) for step in range(self.g.n_steps))

    def aloft(self, s: float) -> bool:
        begun = self.liftoffs_before(s)
        return begun > 0 and s < self.liftoff(begun - 1) + self.g.t_ss

    def swing(self, step: int) -> str:
        return "l" if (step % 2 == 0) == self.g.left_first else "r"

    def resume_time(self, step: int) -> float:
        """Mid double support before a step: t = 0 or t_ss + t_ds; at the ends of the walk, rest."""
        if step == 0:
            return 0.0
        return self.end if step == self.g.n_steps else self.g.T_ini + step * self.T_c

    def pose(self, s: float) -> np.ndarray:
        """x_r, x_l, y_r, y_l, z_r, z_l."""
        g = self.g
        t = min(max(s, g.T_ini), self.stop) - g.T_ini
        x_r, x_l, y, z_r, z_l = self.periodic(t % (2.0 * self.T_c))
        if s < g.T_ini:
            y = sum(c * max(s, 0.0) ** n for n, c in enumerate(self.sway_in))
        elif s > self.stop:
            y = sum(c * max(self.end - s, 0.0) ** n for n, c in enumerate(self.sway_out))
        y_r, y_l = g.y_ref - g.w_of + y, g.y_ref + g.w_of + y
        if g.left_first:
            return np.array([x_r, x_l, y_r, y_l, z_r, z_l])
        return np.array([x_l, x_r, -y_l, -y_r, z_l, z_r])

    def periodic(self, t: float) -> tuple[float, float, float, float, float]:
        """Eqs. 3.1-3.6: X_r, X_l, sway, Z_r, Z_l."""
        g, z_r, z_l = self.g, 0.0, 0.0
        if t < g.t_ds / 2:
            x_r = g.b_s
        elif t < g.t_ds / 2 + g.t_ss:
            x_r = g.b_s * cos((t - g.t_ds / 2) * pi / g.t_ss)
            z_l = g.h_s / 2 * (1 - cos((t - g.t_ds / 2) * 2 * pi / g.t_ss))
        elif t < 1.5 * g.t_ds + g.t_ss:
            x_r = -g.b_s
        elif t < 1.5 * g.t_ds + 2 * g.t_ss:
            x_r = -g.b_s * cos((t - 1.5 * g.t_ds - g.t_ss) * pi / g.t_ss)
            z_r = g.h_s / 2 * (1 - cos((t - 1.5 * g.t_ds - g.t_ss) * 2 * pi / g.t_ss))
        else:
            x_r = g.b_s
        return x_r, -x_r, g.w * sin(t * pi / (g.t_ds + g.t_ss)), z_r - g.h_b, z_l - g.h_b


class PayloadTranscription:
    """The controller: feed it one reading per tick."""

    def __init__(self, gait: ThesisGait, reflex: ThesisReflex):
        self.g, self.p, self.walk, self.log = gait, reflex, Walk(gait), Log()
        self.mode = WALK
        self.now: float | None = None
        self.force = self.slow = self.zmp = self.weight = 0.0
        self.x_ref, self.x_ref_wanted = gait.x_ref, gait.x_ref
        self.resumed_at, self.resumed_from = 0.0, 0.0
        self.trigger = 0.0
        self.next_step = 0

    # ------------------------------------------------------------------ one tick

    def tick(self, t: float, fs: float, zmp: float, shaken: bool) -> np.ndarray:
        """Low-pass, change of mode, watch; the feet in the body frame."""
        then, force, slow, old_zmp = self.now, self.force, self.slow, self.zmp
        self.now = t
        if then is None:
            self.force = self.slow = self.weight = fs
            self.zmp = zmp
            return self.pose(t)
        dt = t - then
        keep_force = (1 - LAMBDA_FORCE) ** (dt / THESIS_TICK)
        keep_zmp = (1 - LAMBDA_ZMP) ** (dt / THESIS_TICK)
        keep_slow = np.exp(-dt / self.p.slow_time_constant)
        self.force = self.force * keep_force + fs * (1 - keep_force)
        self.zmp = self.zmp * keep_zmp + zmp * (1 - keep_zmp)
        self.slow = self.slow * keep_slow + fs * (1 - keep_slow)

        if self.mode == REFLEX and t >= self.end_of(REFLEX):
            share = (self.end_of(REFLEX) - then) / dt
            at_end = force + share * (self.force - force)
            keep = np.exp(-(t - self.end_of(REFLEX)) / self.p.slow_time_constant)
            self.slow = at_end * keep + fs * (1 - keep)
            self.mode = SETTLE
        elif self.mode == SETTLE and t + dt >= self.end_of(SETTLE):
            share = (self.end_of(SETTLE) - t) / dt
            reading = old_zmp + share * (self.zmp - old_zmp)
            self.x_ref_wanted = self.g.x_ref + self.p.gain * (reading - self.p.zmp_balanced)  # 3.19, 3.20
            self.weight = slow + share * (self.slow - slow)
            self.mode = SHIFT
        elif self.mode == SHIFT and t >= self.end_of(SHIFT):
            self.mode = RECOVER
        elif self.mode == RECOVER and t >= self.end_of(RECOVER):
            self.mode = HOLD
        elif self.mode == HOLD and t + dt >= self.end_of(HOLD):
            self.resume()

        pose = self.pose(t)
        crossed = self.watch(then, force, slow, shaken)
        if crossed is not None:
            self.start_reflex(crossed + dt)
        return pose

    def watch(self, then: float, force: float, slow: float, shaken: bool) -> float | None:
        """When a load left the band, if it is felt at this tick."""
        assert self.now is not None
        walking = self.mode == WALK
        fresh = bool(self.log.triggers) and self.now - self.resumed_at < self.p.rearm_time
        if walking and not fresh and not shaken and abs(self.force - self.weight) > self.p.threshold:
            return self.crossing(then, force, self.force, self.p.threshold)
        listening = walking or self.mode in (SHIFT, RECOVER, HOLD)
        if listening and abs(self.slow - self.weight) > self.p.slow_threshold:
            return self.crossing(then, slow, self.slow, self.p.slow_threshold)
        return None

    def crossing(self, then: float, old: float, new: float, threshold: float) -> float:
        """When a straight line between two readings leaves the band; now, if it was out already."""
        assert self.now is not None
        if abs(old - self.weight) >= threshold:
            return self.now
        edge = self.weight + (threshold if new > self.weight else -threshold)
        return then + (edge - old) / (new - old) * (self.now - then)

    # ------------------------------------------------------------------ the walk

    def plan_time(self, t: float) -> float:
        return self.resumed_from + max(t - self.resumed_at, 0.0)

    def pose(self, t: float) -> np.ndarray:
        if self.mode == WALK:
            pose = self.walk.pose(self.plan_time(t))
            pose[:2] += self.x_ref
            return pose
        return self.adapting(t - self.trigger)

    def resume(self) -> None:
        self.resumed_at, self.resumed_from = self.end_of(HOLD), self.walk.resume_time(self.next_step)
        self.x_ref = self.x_ref_wanted
        self.mode = WALK
        self.log.resumes.append(self.resumed_at)
        self.log.resume_steps.append(self.next_step)
        self.log.kinks.append(self.resumed_at)

    # ------------------------------------------------------------------ the reflex

    def x_ref_at(self, t: float) -> float:
        """x_ref that is in force at t."""
        if self.mode in (WALK, REFLEX, SETTLE):
            return self.x_ref
        share = (t - self.trigger - self.p.t_refl_per - self.p.t_set_t) / self.p.t_x_ref_as
        return self.x_ref + min(max(share, 0.0), 1.0) * (self.x_ref_wanted - self.x_ref)

    def swinging(self, t: float) -> tuple[str | None, int]:
        """Foot in the air or None, and number of the step that comes after what is being done."""
        if self.mode == WALK:
            s = self.plan_time(t)
            begun = self.walk.liftoffs_before(s)
            return (self.walk.swing(begun - 1) if self.walk.aloft(s) else None), begun
        since = t - self.end_of(SHIFT) - self.t_ds_a / 2
        in_the_air = self.mode == RECOVER and 0.0 <= since < self.t_ss_a and self.g.h_s * self.f > NO_HEIGHT
        return ("l" if self.left_ahead else "r") if in_the_air else None, self.next_step

    def start_reflex(self, at: float) -> None:
        """Eqs. 3.17, 4.5, 4.6 and 3.22-3.25."""
        assert self.now is not None
        aloft, upcoming = self.swinging(self.now)  # known from the tick that saw the load
        start = self.pose(at)
        x_ref = self.x_ref_at(at)
        self.log.triggers.append(at)
        self.log.modes_triggered.append(self.mode)
        x_refl_r, x_refl_l = -0.01, 0.01
        if self.p.modified:
            x_refl_r, x_refl_l = {"l": (0.01, -0.01), "r": (-0.01, 0.01), None: (0.0, 0.0)}[aloft]
        self.start = start
        self.x_re, self.x_le = start[0] + x_refl_r, start[1] + x_refl_l
        self.left_ahead = self.x_re <= self.x_le
        ahead = "l" if self.left_ahead else "r"
        # the foot behind has to swing next
        self.next_step = upcoming
        if upcoming > 0 and self.walk.swing(upcoming) == ahead:
            self.next_step = upcoming - 1
        g = self.g
        self.dif = abs(self.x_re - self.x_le) / 2  # 3.22
        front = self.x_le if self.left_ahead else self.x_re
        self.f = abs(x_ref + g.b_s - front) / (2 * g.b_s)  # 3.23
        self.t_ss_a = g.t_ss * acos(self.f) / pi  # 3.24
        self.t_ds_a = g.t_ds / g.t_ss * self.t_ss_a  # 3.25
        self.log.recoveries.append((self.f, self.t_ss_a, self.t_ds_a))
        self.x_ref = self.x_ref_wanted = x_ref
        self.trigger, self.mode = at, REFLEX
        ends = [self.end_of(mode) for mode in (REFLEX, SETTLE, SHIFT, RECOVER, HOLD)]
        up = self.end_of(SHIFT) + self.t_ds_a / 2
        self.log.kinks += [at, *ends, up, up + self.t_ss_a]

    def end_of(self, mode: int) -> float:
        end = self.trigger + self.p.t_refl_per
        if mode >= SETTLE:
            end += self.p.t_set_t
        if mode >= SHIFT:
            end += self.p.t_x_ref_as
        if mode >= RECOVER:
            end += self.t_ss_a + self.t_ds_a
        if mode >= HOLD:
            end += self.p.t_set_t / 2
        return end

    def adapting(self, t: float) -> np.ndarray:
        """Eqs. 3.11-3.16, 3.21, 3.26-3.40, t since the trigger."""
        g, p = self.g, self.p
        goal = np.array([self.x_re, self.x_le, g.y_ref - g.w_of, g.y_ref + g.w_of, -g.h_b, -g.h_b])
        if t < p.t_refl_per:
            return self.start + (goal - self.start) / p.t_refl_per * t
        settled = p.t_refl_per + p.t_set_t
        if self.mode in (REFLEX, SETTLE) or t <= settled:
            return goal
        shifted = settled + p.t_x_ref_as
        if t <= shifted:
            goal[:2] += (self.x_ref_wanted - self.x_ref) * (t - settled) / p.t_x_ref_as  # 3.21
            return goal
        x_ref, dif = self.x_ref_wanted, self.dif
        x_re = self.x_re + self.x_ref_wanted - self.x_ref
        x_le = self.x_le + self.x_ref_wanted - self.x_ref
        lift = shifted + self.t_ds_a / 2
        land = lift + self.t_ss_a
        done = shifted + self.t_ds_a + self.t_ss_a
        z_r = z_l = -g.h_b
        if t <= lift:  # S1
            x_r, x_l = x_re, x_le
        elif t <= land:  # S2, S3
            reach = dif + (g.b_s - dif) / 2 * (1 - cos((t - lift) * pi / self.t_ss_a))
            height = g.h_s * self.f / 2 * (1 - cos((t - lift) * 2 * pi / self.t_ss_a))
            if self.left_ahead:
                x_r, x_l, z_l = x_ref - reach, x_ref + reach, z_l + height
            else:
                x_r, x_l, z_r = x_ref + reach, x_ref - reach, z_r + height
        elif self.left_ahead:  # S4, 3.35, 3.36
            x_r, x_l = x_ref - g.b_s, x_ref + g.b_s
        else:  # S5
            x_r, x_l = x_ref + g.b_s, x_ref - g.b_s
        y = 0.0
        if t <= done:  # S6, S7
            y = g.w * self.f / 2 * (1 - cos((t - shifted) * 2 * pi / (self.t_ds_a + self.t_ss_a)))
            y = y if self.left_ahead else -y
        return np.array([x_r, x_l, g.y_ref - g.w_of + y, g.y_ref + g.w_of + y, z_r, z_l])

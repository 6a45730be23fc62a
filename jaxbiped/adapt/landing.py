"""Landing on ground of unknown height: advance and retard landing and release (khadiv section 3, Eqs. 6-16).

All offsets live in the plan's frame: what reaches the joints is (foot + its offset) - (pelvis + its offset). In a step,

    watch     from T_s / 2 to T_c, for a switch of the swing foot to close
    advance   it closes before T_s: the foot stops at the touch pose and sets down gently (z_mod, x_mod)
    retard    it has not closed at T_s: foot and pelvis descend until it does, then the foot sets down
    keep      until T_c
    release   over the next single support, when this foot is the stance foot: the robot rises or sinks onto the new
              height

Variants: `Landing.paper()` follows the equations to the letter, `Landing.repaired()` (the default) mends what they
break; every repair is a switch of its own.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.adapt.blends import longest_time_to_rest, quintic_to_rest, smooth
from jaxbiped.adapt.parameters import reader, require_names, switches
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.checked import Flag, Quantity
from jaxbiped.planner import PLANNED_STEP, REFLEX_STEP, Gait, Phase, Targets, TaskSpace

Scalar = Float[Array, ""]
_BISECTIONS = 40
_SHAKEN_TIME = 0.5
"""For how long after a touch the foot forces say little about the weight [s]."""
SMALLEST_T_MOD, SMALLEST_WAY = 5e-3, 1e-5
"""Time [s] in which a foot whose switches close on the ground is stopped, where there is no way to set it down; and the
way [m] that is taken for none."""


PARAMETERS: dict[str, Quantity | Flag] = {
    "delta_z": Quantity(
        "m",
        0.0,
        0.1,
        text="Height of the sole over the ground when a switch closes, as the controller believes; 0: on the ground.",
    ),
    "T_mod": Quantity(
        "s",
        0.0,
        2.0,
        True,
        optional=True,
        text="Time to set the foot down after a touch; None for the time the plan needs from delta_z to the ground.",
    ),
    "delta_x_scale": Quantity(
        "", 0.0, 5.0, text="Factor on delta_x, the way the plan goes in its last T_mod."
    ),
    "descent_speed": Quantity(
        "m/s", 0.0, 5.0, True, text="Speed of the descent after T_s, h per control tick in the paper."
    ),
    "descent_acceleration": Quantity(
        "m/s2", 0.0, 100.0, True, text="Acceleration of the descent's start and stop, where it is smooth."
    ),
    "max_descent": Quantity(
        "m", 0.0, 1.0, True, text="Depth at which the descent stops, where it is smooth."
    ),
    "release_share": Quantity("", 0.0, 2.0, True, text="Time of release over T_s."),
    "no_undershoot": Flag(
        "Repair: T_mod at most T*, so that the quintic of Eq. 6 never goes below the ground."
    ),
    "smooth_descent": Flag(
        "Repair: the descent starts and stops with limited acceleration instead of a velocity step."
    ),
    "pelvis_follows": Flag("Repair: in a retard landing the pelvis follows the foot through z_mod too."),
    "commanded_velocity": Flag(
        "Repair: Eqs. 6 and 7 start from the commanded, not the preplanned, velocity and acceleration."
    ),
    "keep_x": Flag(
        "Repair: the sagittal offset is kept while the foot stands and blended out in its own next swing."
    ),
    "stays_down": Flag(
        "Repair: a foot that has touched is carried along by the rest of the release, instead of being lifted off or "
        "pushed down by it."
    ),
    "interpolate": Flag("Take the touch at its own instant; False: at the tick that saw it."),
}
"""What the parameters of the landing stage are and may be."""
_read = reader(PARAMETERS)


class Landing(eqx.Module):
    """Parameters of the landing stage; PARAMETERS says what each of them is, its unit and its bounds."""

    delta_z: Scalar = eqx.field(converter=_read("delta_z"), default=0.01)
    T_mod: Scalar | None = eqx.field(converter=_read("T_mod"), default=None)
    delta_x_scale: Scalar = eqx.field(converter=_read("delta_x_scale"), default=1.0)
    descent_speed: Scalar = eqx.field(converter=_read("descent_speed"), default=0.2)
    descent_acceleration: Scalar = eqx.field(converter=_read("descent_acceleration"), default=3.0)
    max_descent: Scalar = eqx.field(converter=_read("max_descent"), default=0.08)
    release_share: Scalar = eqx.field(converter=_read("release_share"), default=1.0)
    no_undershoot: bool = eqx.field(converter=_read("no_undershoot"), static=True, default=True)
    smooth_descent: bool = eqx.field(converter=_read("smooth_descent"), static=True, default=True)
    pelvis_follows: bool = eqx.field(converter=_read("pelvis_follows"), static=True, default=True)
    commanded_velocity: bool = eqx.field(converter=_read("commanded_velocity"), static=True, default=True)
    keep_x: bool = eqx.field(converter=_read("keep_x"), static=True, default=True)
    stays_down: bool = eqx.field(converter=_read("stays_down"), static=True, default=True)
    interpolate: bool = eqx.field(converter=_read("interpolate"), static=True, default=True)

    @classmethod
    def paper(cls, **parameters: Any) -> "Landing":
        """Eqs. 6-16 to the letter: every switch off that is not given.

        Raises:
            TypeError: for a parameter that there is not.
            ValueError: for a value that is not allowed.
        """
        require_names("Landing", parameters, PARAMETERS)
        return cls(**{**dict.fromkeys(switches(PARAMETERS), False), **parameters})

    @classmethod
    def repaired(cls, **parameters: Any) -> "Landing":
        """With every repair that is not switched off; errors as of `paper`."""
        require_names("Landing", parameters, PARAMETERS)
        return cls(**parameters)


class LandingState(eqx.Module):
    """What the stage remembers between two ticks."""

    phase: Phase
    """Phase at the last tick."""
    time: Scalar
    """Of the last tick [s]."""
    aloft: Bool[Array, ""]
    """Whether all switches of the swing foot have been open in this step, up to T_s."""
    touched: Bool[Array, ""]
    """Whether the swing foot has touched in this step."""
    late: Bool[Array, ""]
    """Whether it did so after T_s."""
    descended: Scalar
    """How far foot and pelvis had descended at the touch [m]."""
    touch_tau: Scalar
    """Time since lift-off of the touch [s]."""
    touch: Float[Array, "3 2"]
    """Position, velocity, acceleration of the swing foot commanded at the touch, x and z (over `_ground`) [m]."""
    T_mod: Scalar
    """Time to set the foot down in this step [s]."""
    delta_x: Scalar
    """Sagittal way of setting it down [m]."""
    foot_offset: Float[Array, "2 2"]
    """Offset of each foot at the start of this step, x and z [m]."""
    pelvis_offset: Scalar
    """Vertical offset of the pelvis at the start of this step [m]."""
    missed: Int[Array, ""]
    """Steps that ended without a touch."""

    @property
    def tau(self) -> Scalar:
        """Time since lift-off at the last tick [s]."""
        return self.phase.time_since_liftoff

    def shaken(self) -> Bool[Array, ""]:
        """Whether at the last tick a foot had just touched, or was overdue."""
        overdue = ~self.touched & self.aloft & (self.tau > self.phase.T_s)
        return overdue | (self.touched & (self.tau - self.touch_tau < _SHAKEN_TIME))


class LandingStage(eqx.Module):
    """The landing stage for one planned walk."""

    params: Landing
    """Parameters."""
    T_mod: Scalar
    """Nominal time to set the foot down [s]."""
    delta_x: Float[Array, "n_steps"]
    """Sagittal way the plan's foot goes in its last T_mod, every step [m]."""
    first_phase: Phase
    """At the start of the walk."""

    @classmethod
    def plan(cls, params: Landing, gait: Gait) -> "LandingStage":
        """Read T_mod and delta_x off the plan."""
        T_mod = nominal_T_mod(gait, params.delta_z) if params.T_mod is None else params.T_mod
        steps = jnp.arange(gait.timing.n_steps)
        delta_x = jax.vmap(lambda step: _last_way(gait, step, T_mod))(steps)
        return cls(params, T_mod, delta_x, gait.phase(jnp.zeros_like(T_mod)))

    def init(self) -> LandingState:
        """Before the first tick."""
        zero, no = jnp.zeros_like(self.T_mod), jnp.zeros((), bool)
        return LandingState(
            phase=self.first_phase,
            time=zero,
            aloft=no,
            touched=no,
            late=no,
            descended=zero,
            touch_tau=zero,
            touch=jnp.zeros((3, 2), zero.dtype),
            T_mod=self.T_mod,
            delta_x=zero,
            foot_offset=jnp.zeros((2, 2), zero.dtype),
            pelvis_offset=zero,
            missed=jnp.zeros((), jnp.int32),
        )

    def step(self, state: LandingState, nominal: Targets, sensed: Sensed) -> tuple[LandingState, Targets]:
        """One control tick."""
        phase, last = nominal.phase, state.phase
        new_step = (phase.step != last.step) | (phase.kind != last.kind)
        state = jax.lax.cond(new_step, lambda s: self._next_step(s, nominal, sensed.time), lambda s: s, state)
        state = self._watch(state, nominal, sensed)
        state = eqx.tree_at(lambda s: (s.phase, s.time), state, (phase, sensed.time))
        return state, self._command(state, nominal)

    def _next_step(self, state: LandingState, nominal: Targets, time: Scalar) -> LandingState:
        """Carry the offsets of the step that has ended over into the one that begins.

        A reflex may begin in the midst of a step: then a touch that is being followed is followed on.
        """
        phase, last = nominal.phase, state.phase
        elapsed = phase.time_since_liftoff - phase.begin
        tau = last.time_since_liftoff + (time - elapsed - state.time)
        plan = _taylor(nominal, -elapsed)
        end = self._pose(state, last, plan, tau)
        interrupted = phase.kind == REFLEX_STEP
        follow = interrupted & state.touched
        lowered = jnp.where(follow, self._lowered(state, last, tau), 0.0)
        begun = eqx.tree_at(
            lambda s: (s.phase, s.foot_offset, s.pelvis_offset, s.missed),
            self.init(),
            (
                eqx.tree_at(lambda p: p.time_since_liftoff, phase, phase.begin),
                (end.sole - plan.sole)[:, jnp.array([0, 2])],
                end.pelvis[2] - plan.pelvis[2] + lowered,
                state.missed + (state.aloft & ~state.touched & ~interrupted).astype(jnp.int32),
            ),
        )
        followed = eqx.tree_at(
            lambda s: (s.phase, s.foot_offset, s.pelvis_offset, s.touch_tau),
            state,
            (begun.phase, begun.foot_offset, begun.pelvis_offset, state.touch_tau - tau + phase.begin),
        )
        begun = eqx.tree_at(lambda s: s.aloft, begun, interrupted & state.aloft)
        return jax.tree.map(lambda a, b: jnp.where(follow, a, b), followed, begun)

    def _watch(self, state: LandingState, nominal: Targets, sensed: Sensed) -> LandingState:
        """Look for the first switch of the swing foot to close, from T_s / 2 (in a reflex: at once) to T_c.

        A reading is older than the tick that gets it: the touch is taken at its own instant, however many ticks ago.
        """
        phase = nominal.phase
        tau, closed = phase.time_since_liftoff, sensed.switch[phase.swing]
        in_swing = (tau >= 0.0) & (tau <= phase.T_s)
        state = eqx.tree_at(lambda s: s.aloft, state, state.aloft | (in_swing & ~jnp.any(closed)))
        start = jnp.where(phase.kind == REFLEX_STEP, 0.0, 0.5 * phase.T_s)
        watching = (tau >= start) & (tau <= phase.T_c) & state.aloft & ~state.touched
        touched = watching & jnp.any(closed)
        since = sensed.time - jnp.min(jnp.where(closed, sensed.switch_time[phase.swing], jnp.inf))
        inside = jnp.clip(tau - since, start, tau) if self.params.interpolate else tau
        landed = self._touch(state, nominal, jnp.where(touched, inside, tau))
        return jax.tree.map(lambda a, b: jnp.where(touched, a, b), landed, state)

    def _touch(self, state: LandingState, nominal: Targets, tau: Scalar) -> LandingState:
        """Remember the commanded foot at the touch, and decide how to set it down."""
        p, phase = self.params, nominal.phase

        def swing_foot(t: Scalar) -> Float[Array, "2"]:
            plan = _taylor(nominal, t - phase.time_since_liftoff)
            foot = self._pose(state, phase, plan, t).sole[phase.swing, jnp.array([0, 2])]
            return foot.at[1].add(-self._ground(state, phase, t))

        def swing_velocity(t: Scalar) -> Float[Array, "2"]:
            return jax.jvp(swing_foot, (t,), (jnp.ones_like(t),))[1]

        position = swing_foot(tau)
        velocity, acceleration = jax.jvp(swing_velocity, (tau,), (jnp.ones_like(tau),))
        if not p.commanded_velocity:
            planned = (nominal.velocity, nominal.acceleration)
            velocity, acceleration = (leaf.sole[phase.swing, jnp.array([0, 2])] for leaf in planned)
            velocity = velocity + acceleration * (tau - phase.time_since_liftoff)
        late = tau > phase.T_s
        T_mod = self.T_mod
        if p.no_undershoot:
            longest = _longest_set_down(velocity[1], acceleration[1], jnp.maximum(p.delta_z, SMALLEST_WAY))
            T_mod = jnp.minimum(T_mod, jnp.maximum(longest, SMALLEST_T_MOD))
        in_plan = phase.kind == PLANNED_STEP
        way = jnp.where(in_plan, self.delta_x[phase.step], 0.5 * velocity[0] * T_mod)
        return eqx.tree_at(
            lambda s: (s.touched, s.late, s.descended, s.touch_tau, s.touch, s.T_mod, s.delta_x),
            state,
            (
                jnp.ones_like(state.touched),
                late,
                self._lowered(state, phase, tau),
                tau,
                jnp.stack([position, velocity, acceleration]),
                T_mod,
                jnp.where(late, 0.0, p.delta_x_scale * way),
            ),
        )

    def _command(self, state: LandingState, nominal: Targets) -> Targets:
        """The nominal targets with all offsets, and their derivatives."""
        phase = nominal.phase
        tau = phase.time_since_liftoff
        one = jnp.ones_like(tau)

        def pose(t: Scalar) -> TaskSpace:
            return self._pose(state, phase, _taylor(nominal, t - tau), t)

        def with_velocity(t: Scalar) -> tuple[TaskSpace, TaskSpace]:
            return jax.jvp(pose, (t,), (one,))

        (position, velocity), (_, acceleration) = jax.jvp(with_velocity, (tau,), (one,))
        return Targets(position, velocity, acceleration, phase, nominal.time)

    def _pose(self, state: LandingState, phase: Phase, plan: TaskSpace, tau: Scalar) -> TaskSpace:
        """Commanded task space at `tau` since the lift-off of the step of `phase`, where the plan has `plan`."""
        p, swing, stance = self.params, phase.swing, 1 - phase.swing
        kept = self._kept(phase, tau)
        offset = state.foot_offset
        x_mod, z_mod = self._set_down(state, tau)
        free = plan.sole[swing, jnp.array([0, 2])] + kept * offset[swing]
        lowered = self._lowered(state, phase, tau)
        swing_x = jnp.where(state.touched, state.touch[0, 0] + x_mod, free[0])
        landed = state.touch[0, 1] + z_mod + self._ground(state, phase, tau)
        swing_z = jnp.where(state.touched, landed, free[1] - lowered)
        stance_x = offset[stance, 0] * (1.0 if p.keep_x else kept)
        sole = plan.sole.at[swing, 0].set(swing_x).at[swing, 2].set(swing_z)
        sole = sole.at[stance, 0].add(stance_x).at[stance, 2].add(kept * offset[stance, 1])
        return TaskSpace(sole, plan.pelvis.at[2].add(kept * state.pelvis_offset - lowered))

    def _kept(self, phase: Phase, tau: Scalar) -> Scalar:
        """Share of the offsets that is not released yet (Eq. 16); a reflex releases nothing."""
        kept = 1.0 - smooth(tau / (self.params.release_share * phase.T_s))
        return jnp.where(phase.kind == REFLEX_STEP, 1.0, kept)

    def _ground(self, state: LandingState, phase: Phase, tau: Scalar) -> Scalar:
        """Height in the plan from which a touched foot's is counted [m]: what the stance foot stands on."""
        if not self.params.stays_down:
            return jnp.zeros_like(tau)
        return self._kept(phase, tau) * state.foot_offset[1 - phase.swing, 1]

    def _set_down(self, state: LandingState, tau: Scalar) -> tuple[Scalar, Scalar]:
        """x_mod and z_mod (Eqs. 6 and 7)."""
        since = tau - state.touch_tau
        x_mod, z_mod = (
            quintic_to_rest(since, state.T_mod, state.touch[1, i], state.touch[2, i], way)
            for i, way in ((0, state.delta_x), (1, -self.params.delta_z))
        )
        return x_mod, z_mod

    def _lowered(self, state: LandingState, phase: Phase, tau: Scalar) -> Scalar:
        """How far the pelvis has descended in a retard landing [m] (Eqs. 14 and 15)."""
        _, z_mod = self._set_down(state, tau)
        descent = _descent(self.params, tau - phase.T_s, phase.T_c - phase.T_s)
        after = jnp.where(state.late, state.descended - (z_mod if self.params.pelvis_follows else 0.0), 0.0)
        return jnp.where(state.touched, after, jnp.where(state.aloft, descent, 0.0))


def nominal_T_mod(gait: Gait, delta_z: Scalar) -> Scalar:
    """Time the plan's swing foot needs from height `delta_z` [m] to the ground [s]: z(T_s - T_mod) = delta_z.

    At least SMALLEST_T_MOD: from height 0 no time is needed, and there its derivative is infinite.
    """
    timing = gait.timing
    start, swing = timing.liftoff(0), timing.first_swing

    def above(tau: Scalar) -> Scalar:
        return gait.task(start + tau).sole[swing, 2] - delta_z

    def halve(bracket: tuple[Scalar, Scalar], _: None) -> tuple[tuple[Scalar, Scalar], None]:
        high, low = bracket
        middle = 0.5 * (high + low)
        is_high = above(middle) > 0.0
        return (jnp.where(is_high, middle, high), jnp.where(is_high, low, middle)), None

    (tau, _), _ = jax.lax.scan(halve, (0.5 * timing.T_s, timing.T_s), None, length=_BISECTIONS)
    tau = jax.lax.stop_gradient(tau)
    value, slope = jax.jvp(above, (tau,), (jnp.ones_like(tau),))
    slope = jax.lax.stop_gradient(slope)
    falling = slope < -SMALLEST_WAY  # at rest on the ground it is not
    T_mod = timing.T_s - (tau - value / jnp.where(falling, slope, -1.0))
    return jnp.maximum(T_mod, SMALLEST_T_MOD)


def _last_way(gait: Gait, step: Int[Array, ""], T_mod: Scalar) -> Scalar:
    """delta_x: how far the swing foot of a step goes in the last T_mod before its planned touchdown [m]."""
    touchdown, swing = gait.timing.touchdown(step), (gait.timing.first_swing + step) % 2
    before, after = gait.task(touchdown - T_mod), gait.task(touchdown)
    return after.sole[swing, 0] - before.sole[swing, 0]


def _taylor(nominal: Targets, dt: Scalar) -> TaskSpace:
    return jax.tree.map(
        lambda p, v, a: p + v * dt + 0.5 * a * dt * dt,
        nominal.position,
        nominal.velocity,
        nominal.acceleration,
    )


def _descent(p: Landing, t: Scalar, T_d: Scalar) -> Scalar:
    """How far foot and pelvis have descended `t` seconds after T_s [m] (khadiv Eqs. 12 and 14).

    Smooth: speeds up, goes on at descent_speed, and slows down so as to stand still at max_descent or at T_c,
    whichever comes first; where that is too near for descent_speed, it turns back half-way.
    """
    t = jnp.clip(t, 0.0, T_d)
    if not p.smooth_descent:
        return p.descent_speed * t
    slope = p.descent_acceleration
    fastest = jnp.minimum(jnp.sqrt(slope * p.max_descent), 0.5 * slope * T_d)
    speed = jnp.minimum(p.descent_speed, fastest)
    ramp = speed / slope
    stop = jnp.clip(p.max_descent / speed + ramp, 2.0 * ramp, T_d)
    t = jnp.minimum(t, stop)
    up, left = jnp.minimum(t, ramp), jnp.maximum(t - (stop - ramp), 0.0)
    return 0.5 * slope * up * up + speed * (t - up) - 0.5 * slope * left * left


def _longest_set_down(velocity: Scalar, acceleration: Scalar, way: Scalar) -> Scalar:
    """T* [s] also of a foot that does not go down: a T^2 + 8 v T + 20 way >= 0, with v >= 0 limited for a < 0 only."""
    rising = (velocity >= 0.0) & (acceleration < -1e-6)  # next to none: minutes, and no finite derivative
    v, a = jnp.where(rising, velocity, 0.0), jnp.where(rising, acceleration, -1.0)
    limit = (4.0 * v + jnp.sqrt(16.0 * v * v - 20.0 * a * way)) / -a
    return jnp.where(rising, limit, longest_time_to_rest(velocity, acceleration, way))

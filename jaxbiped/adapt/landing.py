"""Landing on ground of unknown height: advance and retard landing and release (khadiv section 3, Eqs. 6-16).

All offsets live in the plan's frame: what reaches the joints is (foot + its offset) - (pelvis + its offset). In a step,

    watch     from T_s / 2 to T_c, for a switch of the swing foot to close
    advance   it closes before T_s: the foot stops at the touch pose and sets down gently (z_mod, x_mod)
    retard    it has not closed at T_s: foot and pelvis descend until it does, then the foot sets down
    keep      until T_c
    release   over the next single support, when this foot is the stance foot: the robot rises or sinks onto the new
              height

Arms: `Landing.paper()` follows the equations to the letter, `Landing.repaired()` (the default) mends what they break;
every repair is a switch of its own.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.adapt.sensed import Sensed
from jaxbiped.planner import Gait, Targets, TaskSpace, is_concrete
from jaxbiped.planner.polynomial import as_scalar

Scalar = Float[Array, ""]
_BISECTIONS = 40


class Landing(eqx.Module):
    """Parameters of the landing stage."""

    delta_z: Scalar = eqx.field(converter=as_scalar, default=0.01)
    """Height of the sole over the ground when a switch closes, as the controller believes [m]."""
    T_mod: Scalar | None = None
    """Time to set the foot down after a touch [s]; None for the time the plan needs from delta_z to the ground."""
    delta_x_scale: Scalar = eqx.field(converter=as_scalar, default=1.0)
    """Factor on delta_x, the way the plan goes in its last T_mod."""
    descent_speed: Scalar = eqx.field(converter=as_scalar, default=0.2)
    """Speed of the descent after T_s, h per control tick in the paper [m/s]."""
    descent_acceleration: Scalar = eqx.field(converter=as_scalar, default=1.5)
    """Acceleration of the descent's start and stop, where it is smooth [m/s2]."""
    max_descent: Scalar = eqx.field(converter=as_scalar, default=0.08)
    """Depth at which the descent stops, where it is smooth [m]."""
    release_share: Scalar = eqx.field(converter=as_scalar, default=1.0)
    """Time of release as a share of T_s."""
    no_undershoot: bool = eqx.field(static=True, default=True)
    """Repair: T_mod at most T*, so that the quintic of Eq. 6 never goes below the ground."""
    smooth_descent: bool = eqx.field(static=True, default=True)
    """Repair: the descent starts and stops with limited acceleration instead of a velocity step."""
    pelvis_follows: bool = eqx.field(static=True, default=True)
    """Repair: in a retard landing the pelvis follows the foot through z_mod too."""
    commanded_velocity: bool = eqx.field(static=True, default=True)
    """Repair: Eqs. 6 and 7 start from the commanded, not the preplanned, velocity and acceleration."""
    keep_x: bool = eqx.field(static=True, default=True)
    """Repair: the sagittal offset is kept while the foot stands and blended out in its own next swing."""
    interpolate: bool = eqx.field(static=True, default=True)
    """Take the instant of touch from inside the tick; False: from the tick that saw it."""

    def __check_init__(self) -> None:
        """Refuse what cannot be meant."""
        for name in (
            "delta_z",
            "T_mod",
            "descent_speed",
            "descent_acceleration",
            "max_descent",
            "release_share",
        ):
            value = getattr(self, name)
            if value is not None and jnp.ndim(value) == 0 and is_concrete(value) and not value > 0.0:
                unit = {"descent_speed": "m/s", "descent_acceleration": "m/s2", "T_mod": "s"}.get(name, "m")
                raise ValueError(f"{name}: got {float(value):g} {unit}, allowed: > 0 {unit}")

    @classmethod
    def paper(cls, **parameters: Any) -> "Landing":
        """Eqs. 6-16 to the letter."""
        switches = (
            "no_undershoot",
            "smooth_descent",
            "pelvis_follows",
            "commanded_velocity",
            "keep_x",
            "interpolate",
        )
        return cls(**{name: False for name in switches}, **parameters)

    @classmethod
    def repaired(cls, **parameters: Any) -> "Landing":
        """With every repair."""
        return cls(**parameters)


class LandingState(eqx.Module):
    """What the stage remembers between two ticks."""

    step: Int[Array, ""]
    """Number of the step it is in."""
    tau: Scalar
    """Time since lift-off at the last tick [s]."""
    touched: Bool[Array, ""]
    """Whether the swing foot has touched in this step."""
    late: Bool[Array, ""]
    """Whether it did so after T_s."""
    touch_tau: Scalar
    """Time since lift-off of the touch [s]."""
    touch: Float[Array, "3 2"]
    """Commanded position, velocity, acceleration of the swing foot at the touch, x and z [m]."""
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


class LandingStage(eqx.Module):
    """The landing stage for one planned walk."""

    params: Landing
    """Parameters."""
    T_mod: Scalar
    """Nominal time to set the foot down [s]."""
    delta_x: Float[Array, "n_steps"]
    """Sagittal way the plan's foot goes in its last T_mod, every step [m]."""

    @classmethod
    def plan(cls, params: Landing, gait: Gait) -> "LandingStage":
        """Read T_mod and delta_x off the plan."""
        T_mod = nominal_T_mod(gait, params.delta_z) if params.T_mod is None else as_scalar(params.T_mod)
        steps = jnp.arange(gait.timing.n_steps)
        return cls(params, T_mod, jax.vmap(lambda step: _last_way(gait, step, T_mod))(steps))

    def init(self) -> LandingState:
        """Before the first tick."""
        zero = jnp.zeros_like(self.T_mod)
        return LandingState(
            step=jnp.zeros((), jnp.int32),
            tau=zero - 1e6,
            touched=jnp.zeros((), bool),
            late=jnp.zeros((), bool),
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
        new_step = nominal.phase.step != state.step
        state = jax.lax.cond(new_step, lambda s: self._next_step(s, nominal), lambda s: s, state)
        state = self._watch(state, nominal, sensed)
        return state, self._command(state, nominal)

    def _next_step(self, state: LandingState, nominal: Targets) -> LandingState:
        """Carry the offsets of the step that has ended over into the one that begins."""
        phase, at_rest = nominal.phase, nominal.position
        landed = 1 - phase.swing
        end = self._pose(state, nominal, phase.T_c, landed, at_rest)
        reached = jnp.stack([end.sole[landed, 0] - at_rest.sole[landed, 0], end.sole[landed, 2]])
        reached = reached.at[1].add(-at_rest.sole[landed, 2])
        stood_x = state.foot_offset[phase.swing, 0] if self.params.keep_x else jnp.zeros_like(state.tau)
        offset = jnp.zeros_like(state.foot_offset).at[landed].set(reached).at[phase.swing, 0].set(stood_x)
        fresh = self.init()
        return eqx.tree_at(
            lambda s: (s.step, s.tau, s.foot_offset, s.pelvis_offset, s.missed),
            fresh,
            (
                phase.step,
                jnp.zeros_like(state.tau),
                offset,
                end.pelvis[2] - at_rest.pelvis[2],
                state.missed + (~state.touched).astype(jnp.int32),
            ),
        )

    def _watch(self, state: LandingState, nominal: Targets, sensed: Sensed) -> LandingState:
        """Look for the first switch of the swing foot to close, from T_s / 2 to T_c."""
        phase = nominal.phase
        tau, swing = phase.time_since_liftoff, phase.swing
        watching = (tau >= 0.5 * phase.T_s) & (tau <= phase.T_c) & ~state.touched
        touched = watching & jnp.any(sensed.switch[swing])
        since = sensed.time - jnp.min(jnp.where(sensed.switch[swing], sensed.switch_time[swing], jnp.inf))
        earliest = jnp.maximum(state.tau, 0.5 * phase.T_s)
        inside = jnp.clip(tau - since, jnp.minimum(earliest, tau), tau) if self.params.interpolate else tau
        landed = self._touch(state, nominal, jnp.where(touched, inside, tau))
        state = eqx.tree_at(lambda s: s.tau, state, tau)
        landed = eqx.tree_at(lambda s: s.tau, landed, tau)
        return jax.tree.map(lambda a, b: jnp.where(touched, a, b), landed, state)

    def _touch(self, state: LandingState, nominal: Targets, tau: Scalar) -> LandingState:
        """Remember the commanded foot at the touch, and decide how to set it down."""
        phase = nominal.phase

        def swing_foot(t: Scalar) -> Float[Array, "2"]:
            return self._pose(state, nominal, t, phase.swing).sole[phase.swing, jnp.array([0, 2])]

        def swing_velocity(t: Scalar) -> Float[Array, "2"]:
            return jax.jvp(swing_foot, (t,), (jnp.ones_like(t),))[1]

        position = swing_foot(tau)
        velocity, acceleration = jax.jvp(swing_velocity, (tau,), (jnp.ones_like(tau),))
        if not self.params.commanded_velocity:
            planned = (nominal.velocity, nominal.acceleration)
            velocity, acceleration = (leaf.sole[phase.swing, jnp.array([0, 2])] for leaf in planned)
        late = tau > phase.T_s
        T_mod = self.T_mod
        if self.params.no_undershoot:
            T_mod = jnp.minimum(T_mod, longest_T_mod(velocity[1], acceleration[1], self.params.delta_z))
        delta_x = jnp.where(late, 0.0, self.params.delta_x_scale * self.delta_x[phase.step])
        return eqx.tree_at(
            lambda s: (s.touched, s.late, s.touch_tau, s.touch, s.T_mod, s.delta_x),
            state,
            (
                jnp.ones_like(state.touched),
                late,
                tau,
                jnp.stack([position, velocity, acceleration]),
                T_mod,
                delta_x,
            ),
        )

    def _command(self, state: LandingState, nominal: Targets) -> Targets:
        """The nominal targets with all offsets, and their derivatives."""
        tau = nominal.phase.time_since_liftoff
        one = jnp.ones_like(tau)

        def pose(t: Scalar) -> TaskSpace:
            return self._pose(state, nominal, t, nominal.phase.swing)

        def with_velocity(t: Scalar) -> tuple[TaskSpace, TaskSpace]:
            return jax.jvp(pose, (t,), (one,))

        (position, velocity), (_, acceleration) = jax.jvp(with_velocity, (tau,), (one,))
        return Targets(position, velocity, acceleration, nominal.phase, nominal.time)

    def _pose(
        self,
        state: LandingState,
        nominal: Targets,
        tau: Scalar,
        swing: Int[Array, ""],
        at_rest: TaskSpace | None = None,
    ) -> TaskSpace:
        """Commanded task space at `tau` since lift-off, `swing` being the foot that swings in the state's step.

        The plan is taken at `tau` by its Taylor polynomial about the tick (or as `at_rest`, where it stands still).
        """
        p, phase = self.params, nominal.phase
        plan = _taylor(nominal, tau - phase.time_since_liftoff) if at_rest is None else at_rest
        kept = 1.0 - _smooth(tau / (p.release_share * phase.T_s))
        descent = _descent(p, tau - phase.T_s, phase.T_c - phase.T_s)
        since = tau - state.touch_tau
        x_mod, z_mod = (
            _set_down(since, state.T_mod, state.touch[1, i], state.touch[2, i], way)
            for i, way in ((0, state.delta_x), (1, -p.delta_z))
        )
        stance = 1 - swing
        swing_x = plan.sole[swing, 0] + kept * state.foot_offset[swing, 0]
        swing_x = jnp.where(state.touched, state.touch[0, 0] + x_mod, swing_x)
        swing_z = jnp.where(state.touched, state.touch[0, 1] + z_mod, plan.sole[swing, 2] - descent)
        stance_x = state.foot_offset[stance, 0] * (1.0 if p.keep_x else kept)
        at_touch = _descent(p, state.touch_tau - phase.T_s, phase.T_c - phase.T_s)
        lowered = jnp.where(state.touched, at_touch - (z_mod if p.pelvis_follows else 0.0), descent)
        lowered = jnp.where(state.touched & ~state.late, 0.0, lowered)
        sole = plan.sole.at[swing, 0].set(swing_x).at[swing, 2].set(swing_z)
        sole = sole.at[stance, 0].add(stance_x).at[stance, 2].add(kept * state.foot_offset[stance, 1])
        return TaskSpace(sole, plan.pelvis.at[2].add(kept * state.pelvis_offset - lowered))


def nominal_T_mod(gait: Gait, delta_z: Scalar) -> Scalar:
    """Time the plan's swing foot needs from height `delta_z` [m] to the ground [s]: z(T_s - T_mod) = delta_z."""
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
    return timing.T_s - (tau - value / jax.lax.stop_gradient(slope))


def longest_T_mod(velocity: Scalar, acceleration: Scalar, delta_z: Scalar) -> Scalar:
    """T*: the longest time [s] in which Eq. 6 sets a foot down by `delta_z` without going any lower on the way.

    Without undershoot as long as a T^2 - 8 |v| T + 20 delta_z >= 0; infinite where that holds for every T.
    """
    v = jnp.maximum(-velocity, 0.0)
    inside = 64.0 * v * v - 80.0 * acceleration * delta_z
    safe = jnp.where(inside > 0.0, inside, 1.0)
    limit = 40.0 * delta_z / (8.0 * v + jnp.sqrt(safe))
    return jnp.where((inside > 0.0) & (v > 0.0), limit, jnp.inf)


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


def _smooth(u: Scalar) -> Scalar:
    """Quintic from 0 to 1 with zero first and second derivative at both ends (khadiv Eq. 16)."""
    u = jnp.clip(u, 0.0, 1.0)
    return u * u * u * (10.0 + u * (6.0 * u - 15.0))


def _set_down(t: Scalar, T: Scalar, v: Scalar, a: Scalar, way: Scalar) -> Scalar:
    """Quintic from (0, v, a) at 0 to (way, 0, 0) at T, held there (khadiv Eqs. 6 and 7)."""
    r = jnp.minimum(t / T, 1.0)  # not clipped at 0: there the velocity must be v, not half of it
    r2 = r * r
    r3 = r2 * r
    from_velocity = r + r3 * (-6.0 + r * (8.0 - 3.0 * r))
    from_acceleration = 0.5 * r2 + r3 * (-1.5 + r * (1.5 - 0.5 * r))
    return v * T * from_velocity + a * T * T * from_acceleration + way * r3 * (10.0 + r * (6.0 * r - 15.0))


def _descent(p: Landing, t: Scalar, T_d: Scalar) -> Scalar:
    """How far foot and pelvis have descended `t` seconds after T_s [m] (khadiv Eqs. 12 and 14).

    Smooth: speeds up, goes on at descent_speed, and slows down so as to stand still at max_descent or at T_c,
    whichever comes first.
    """
    t = jnp.clip(t, 0.0, T_d)
    if not p.smooth_descent:
        return p.descent_speed * t
    ramp = jnp.minimum(p.descent_speed / p.descent_acceleration, 0.5 * T_d)
    stop = jnp.clip(p.max_descent / p.descent_speed + ramp, 2.0 * ramp, T_d)
    t = jnp.minimum(t, stop)
    up, left = jnp.minimum(t, ramp), jnp.maximum(t - (stop - ramp), 0.0)
    slope = p.descent_speed / ramp
    return 0.5 * slope * up * up + p.descent_speed * (t - up) - 0.5 * slope * left * left

"""Payload reflex and adaptation (El-Kahlout's thesis, sections 3.3, 4.3, 4.4): stand still, lean right, walk on.

The load is felt as a jump of the low-passed sum of the vertical foot forces. Then

    REFLEX    both feet go to a symmetric stance, the swing foot down to the ground (Eqs. 3.11-3.17)
    SETTLE    the robot stands still; at the end the low-passed ZMP is read (Eq. 3.18)
    SHIFT     the body moves over the feet until the ZMP is where it balances, x_ref (Eqs. 3.19-3.21)
    RECOVER   one step of the foot ahead restores the step length (Eqs. 3.22-3.34)
    HOLD      the robot stands still for half the settling time (Eqs. 3.35-3.40)
    WALK      the plan goes on at the matching phase, with the new x_ref

A further change of weight from SHIFT on starts the machine again from wherever the robot is. What shakes the robot
is not taken for one: while it recovers, or a foot is being set down, a second, slower filter decides. Positions are
those of the soles in the body frame, as in the thesis; what is nominal (b_s, w_of, h_b, sway, lift, times) is read off
the plan, so any gait will do. In the world the stance foot stands still.

Variants: `original` (Eq. 3.17, 2 s), `modified` (Eqs. 4.5, 4.6, 4 s), both to the letter of the equations but for the
errata listed in docs/papers.md; `repaired`: every repair a switch of its own.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.adapt.blends import longest_time_to_rest, quintic_to_rest, smooth
from jaxbiped.adapt.parameters import reader, require_names
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.checked import Flag, Quantity, Refusal
from jaxbiped.kinematics import body
from jaxbiped.planner import (
    DOUBLE_SUPPORT,
    RECOVERY_STEP,
    REFLEX_STEP,
    SINGLE_SUPPORT,
    Gait,
    Phase,
    Targets,
    TaskSpace,
    Timing,
    at,
    feasibility,
    is_concrete,
)
from jaxbiped.robot import LEFT, RIGHT, RobotParams

Scalar = Float[Array, ""]

WALK, REFLEX, SETTLE, SHIFT, RECOVER, HOLD = range(6)
FORCE_TIME_CONSTANT = 0.09975
"""Of lambda = 5e-3 per tick of 0.5 ms, the thesis' force filter [s]."""
ZMP_TIME_CONSTANT = 0.99975
"""Of lambda = 5e-4 per tick of 0.5 ms, the thesis' ZMP filter [s]."""
SMALLEST_LOAD = 40.0
"""Weight over which a load is to start the reflex [N]: 15 kg put on at 1.2 and 1.3 s set off the thesis' reflex after
30.5 and 32.5 ms, when its filter has risen by 39 and 41 N."""
X_REFLEX_ORIGINAL = ((0.01, -0.01), (0.01, -0.01), (0.01, -0.01))
"""Eq. 3.17: the left foot forward, the right one back, whatever happens."""
X_REFLEX_MODIFIED = ((-0.01, 0.01), (0.01, -0.01), (0.0, 0.0))
"""Eqs. 4.5, 4.6: the foot on the ground towards the body."""
X_REFLEX_NONE = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
_STEADY_SHARE = 2.4
"""Double support of a steady recovery step over its single support: time to get over the stance foot and back."""
_SMALLEST_WAY = 1e-4
"""Missing step length below which a steady recovery makes no step, but lets the feet give [m]: rounding, or what the
parabola about the tick of the trigger is out by."""
_NOTHING, _FAST, _SLOW = range(3)
"""Which low-pass has felt a load."""
_TIME = {"unit": "s", "low": 0.0, "high": 60.0, "above": True}
_FORCE = {"unit": "N", "low": 0.0, "high": 1e4, "above": True}
PARAMETERS: dict[str, Quantity | Flag] = {
    "zmp_balanced": Quantity(
        "m",
        -0.5,
        0.5,
        text="ZMP forward of the pelvis at which the unloaded robot balances, -0.035 in the thesis.",
    ),
    "x_reflex": Quantity(
        "m",
        -0.2,
        0.2,
        shapes=((3, 2),),
        text="How far the reflex moves (left, right) foot forward; rows: left foot swings, right foot swings, double "
        "support.",
    ),
    "threshold": Quantity(
        **_FORCE,
        text="Change of the low-passed force that starts the reflex; named variants add what the plan itself causes.",
    ),
    "slow_threshold": Quantity(
        **_FORCE, text="The same for the slower low-pass, which decides while other things shake the robot."
    ),
    "slow_time_constant": Quantity(**_TIME, text="Time constant of the slower low-pass."),
    "rearm_time": Quantity(
        "s",
        0.0,
        600.0,
        endless=True,
        text="For how long after going on the slower low-pass decides; infinite: from the first reflex on, for good.",
    ),
    "force_time_constant": Quantity(
        "s", 0.0, 10.0, True, text="Time constant of the low-pass of the summed foot force, Eq. 3.7."
    ),
    "zmp_time_constant": Quantity(**_TIME, text="Time constant of the low-pass of the ZMP, Eq. 3.18."),
    "x_stand": Quantity(
        "m",
        -0.5,
        0.5,
        optional=True,
        text="Sole forward of the pelvis on which a steady recovery stands alone; None: wherever it is.",
    ),
    "reflex_time": Quantity("s", 0.0, 10.0, True, text="t_refl_per."),
    "body_time": Quantity(
        **_TIME,
        text="Longest time in which a smooth reflex brings the body sideways to the middle; it has to be there when "
        "the ZMP is read.",
    ),
    "settling_time": Quantity(**_TIME, text="t_set_t."),
    "shift_time": Quantity(**_TIME, text="t_x_ref_as."),
    "x_ref_gain": Quantity("", 0.0, 5.0, text="Part of the measured ZMP error by which x_ref is shifted."),
    "smooth_reflex": Flag(
        "Repair: the reflex takes over velocity and acceleration instead of starting with a velocity step, and the "
        "body, which cannot be pulled off its stance foot as fast as the other one is set down, has `body_time` to "
        "follow."
    ),
    "smooth_ramp": Flag(
        "The literal reflex's smooth twin, not in the thesis: feet and body take over velocity and acceleration and "
        "are at rest after the same `reflex_time`, instead of moving at constant speeds that start and stop in a "
        "step. Nothing to a smooth reflex."
    ),
    "steady_recovery": Flag(
        "Repair: the recovery step takes a whole T_s, with the body over the stance foot, and the body advances after "
        "it instead of during it."
    ),
    "starts_again": Flag(
        "A further change of weight starts the reflex again; False: once, as the thesis' experiments have it. On a "
        "robot that rocks under its load the literal variants would set themselves off again."
    ),
    "smooth_resume": Flag(
        "Repair: the plan is brought up to speed over a double support instead of at once."
    ),
    "interpolate": Flag("Take events from inside the tick; False: from the tick that saw them."),
}
"""What the parameters of the payload stage are and may be."""
_LITERAL = ("smooth_reflex", "steady_recovery", "smooth_resume", "starts_again")
"""Switches that are off in the thesis."""
_read = reader(PARAMETERS)


class PayloadReflex(eqx.Module):
    """Parameters of the payload stage; PARAMETERS says what each of them is, its unit and its bounds."""

    zmp_balanced: Scalar = eqx.field(converter=_read("zmp_balanced"))
    x_reflex: Float[Array, "3 2"] = eqx.field(converter=_read("x_reflex"), default=X_REFLEX_MODIFIED)
    threshold: Scalar = eqx.field(converter=_read("threshold"), default=SMALLEST_LOAD)
    slow_threshold: Scalar = eqx.field(converter=_read("slow_threshold"), default=SMALLEST_LOAD)
    slow_time_constant: Scalar = eqx.field(converter=_read("slow_time_constant"), default=1.0)
    rearm_time: Scalar = eqx.field(converter=_read("rearm_time"), default=2.5)
    force_time_constant: Scalar = eqx.field(
        converter=_read("force_time_constant"), default=FORCE_TIME_CONSTANT
    )
    zmp_time_constant: Scalar = eqx.field(converter=_read("zmp_time_constant"), default=ZMP_TIME_CONSTANT)
    x_stand: Scalar | None = eqx.field(converter=_read("x_stand"), default=None)
    reflex_time: Scalar = eqx.field(converter=_read("reflex_time"), default=0.1)
    body_time: Scalar = eqx.field(converter=_read("body_time"), default=1.2)
    settling_time: Scalar = eqx.field(converter=_read("settling_time"), default=4.0)
    shift_time: Scalar = eqx.field(converter=_read("shift_time"), default=0.5)
    x_ref_gain: Scalar = eqx.field(converter=_read("x_ref_gain"), default=1.0)
    smooth_reflex: bool = eqx.field(converter=_read("smooth_reflex"), static=True, default=True)
    smooth_ramp: bool = eqx.field(converter=_read("smooth_ramp"), static=True, default=False)
    steady_recovery: bool = eqx.field(converter=_read("steady_recovery"), static=True, default=True)
    starts_again: bool = eqx.field(converter=_read("starts_again"), static=True, default=True)
    smooth_resume: bool = eqx.field(converter=_read("smooth_resume"), static=True, default=True)
    interpolate: bool = eqx.field(converter=_read("interpolate"), static=True, default=True)

    def __check_init__(self) -> None:
        """Refuse a body that is still on its way when the ZMP is read."""
        if self.smooth_reflex and is_concrete(self.reflex_time, self.settling_time, self.body_time):
            still, body_time = float(self.reflex_time) + float(self.settling_time), float(self.body_time)
            if body_time > still * (1.0 + 1e-6):
                raise Refusal(
                    f"body_time: got {body_time:g} s, allowed: <= reflex_time + settling_time = {still:g} s"
                )

    @classmethod
    def original(cls, robot: RobotParams, gait: Gait, **parameters: Any) -> "PayloadReflex":
        """Eqs. 3.7-3.40: settling 2 s.

        Raises:
            TypeError: for a parameter that there is not.
            ValueError: for a value that is not allowed.
        """
        return cls._literal(robot, gait, {"x_reflex": X_REFLEX_ORIGINAL, "settling_time": 2.0, **parameters})

    @classmethod
    def modified(cls, robot: RobotParams, gait: Gait, **parameters: Any) -> "PayloadReflex":
        """With Eqs. 4.5, 4.6 and settling 4 s; errors as of `original`."""
        return cls._literal(robot, gait, {"x_reflex": X_REFLEX_MODIFIED, "settling_time": 4.0, **parameters})

    @classmethod
    def repaired(cls, robot: RobotParams, gait: Gait, **parameters: Any) -> "PayloadReflex":
        """With every repair; the feet stay where they are or come down. Errors as of `original`."""
        require_names("PayloadReflex", parameters, PARAMETERS)
        ours = {"x_reflex": X_REFLEX_NONE, "reflex_time": 0.5}
        if "x_stand" not in parameters:
            ours["x_stand"] = standing_zmp(robot, gait) - robot.p_sole_corner[..., 0].mean()
        return cls(**{**_of_plan(robot, gait, parameters), **ours, **parameters})

    @classmethod
    def _literal(cls, robot: RobotParams, gait: Gait, parameters: dict[str, Any]) -> "PayloadReflex":
        require_names("PayloadReflex", parameters, PARAMETERS)
        off = dict.fromkeys(_LITERAL, False)
        return cls(**{**_of_plan(robot, gait, parameters), **off, **parameters})


class PayloadState(eqx.Module):
    """What the stage remembers between two ticks. The body frame is the pelvis', heading along x."""

    mode: Int[Array, ""]
    """WALK, REFLEX, SETTLE, SHIFT, RECOVER or HOLD."""
    time: Scalar
    """Of the last reading [s]; negative before the first."""
    tick: Scalar
    """From the reading before to the last one [s]: the tick to come is taken to be as long; 0 at the first."""
    force: Scalar
    """Low-passed sum of the vertical foot forces [N]."""
    slow_force: Scalar
    """The same, by the slower low-pass [N]."""
    zmp: Scalar
    """Low-passed ZMP forward of the pelvis [m]."""
    weight: Scalar
    """Low-passed force that is taken for normal [N]."""
    reflexes: Int[Array, ""]
    """How many reflexes there have been."""
    trigger_time: Scalar
    """When the last reflex started [s]: a control tick after the force had left the band."""
    trigger_plan_time: Scalar
    """Plan time then [s]."""
    support: Int[Array, ""]
    """Support phase at the tick that felt the load."""
    swing: Int[Array, ""]
    """The foot that swung then, or swung last."""
    start_sole: Float[Array, "2 3"]
    """Soles in the world then [m]."""
    start: Float[Array, "3 2 3"]
    """Position, velocity, acceleration of the soles in the body frame then [m]."""
    end: Float[Array, "2 3"]
    """Soles in the body frame at the end of the reflex [m]."""
    next_step: Int[Array, ""]
    """Number of the plan's step with which the walk goes on; n_steps if there is none left."""
    x_shift: Scalar
    """Shift of x_ref at the last reflex [m]."""
    x_shift_new: Scalar
    """Shift of x_ref that is wanted [m]."""
    resume_time: Scalar
    """When the walk went on [s]."""
    resume_plan_time: Scalar
    """Plan time then [s]."""
    world_shift: Scalar
    """How far the walk has got ahead of the plan [m]."""

    def share(self, since: Scalar) -> Scalar:
        """A time [s] as a share of a tick, within 0 and 1; 1 before there is one."""
        ticking = self.tick > 0.0
        return jnp.where(ticking, jnp.clip(since / jnp.where(ticking, self.tick, 1.0), 0.0, 1.0), 1.0)


class _Recovery(eqx.Module):
    """The recovery step of a reflex."""

    swing: Int[Array, ""]
    """The foot ahead."""
    f: Scalar
    """Missing step length over twice the step length, Eq. 3.23."""
    t_ss: Scalar
    """Single support, Eq. 3.24 [s]."""
    t_ds: Scalar
    """Double support, Eq. 3.25 [s]."""
    sway: Scalar
    """How far the body goes towards the stance foot [m]."""
    lift: Scalar
    """How high the swing foot goes [m]."""
    goal: Float[Array, "2 3"]
    """Soles in the body frame at the end, but for the new shift of x_ref [m]."""


class PayloadStage(eqx.Module):
    """The payload stage for one planned walk."""

    params: PayloadReflex
    """Parameters."""
    resume_plan_time: Float[Array, " n"]
    """Plan time from which the walk goes on with each step, and at rest after the last [s]."""
    foothold: Float[Array, "n 2"]
    """Where the soles are then, forward in the world [m]."""
    stance: Float[Array, "n 2 3"]
    """Soles in the body frame then [m]."""
    stride: Scalar
    """Distance of the soles in double support, 2 b_s [m]."""
    sway: Scalar
    """Greatest lateral way of the body from the middle, w [m]."""
    lift: Scalar
    """Greatest height of the swing foot, h_s [m]."""

    @classmethod
    def plan(cls, params: PayloadReflex, gait: Gait) -> "PayloadStage":
        """Read the stances and the size of a step off the plan."""
        times = resume_plan_times(gait)
        task = jax.vmap(gait.task)(times)
        middle = gait.task(gait.timing.liftoff(0) + 0.5 * gait.timing.T_s)
        return cls(
            params=params,
            resume_plan_time=times,
            foothold=task.sole[:, :, 0],
            stance=task.sole - task.pelvis[:, None],
            stride=jnp.maximum(jnp.abs(task.sole[:, 0, 0] - task.sole[:, 1, 0]).max(), 1e-3),
            sway=jnp.abs(middle.pelvis[1] - middle.sole[:, 1].mean()),
            lift=middle.sole[:, 2].max(),
        )

    def init(self) -> PayloadState:
        """Before the first tick."""
        zero, count = jnp.zeros_like(self.sway), jnp.zeros((), jnp.int32)
        return PayloadState(
            mode=count + WALK,
            time=zero - 1.0,
            tick=zero,
            force=zero,
            slow_force=zero,
            zmp=zero,
            weight=zero,
            reflexes=count,
            trigger_time=zero,
            trigger_plan_time=zero,
            support=count + DOUBLE_SUPPORT,
            swing=count,
            start_sole=self.stance[0],
            start=jnp.zeros((3, 2, 3), zero.dtype).at[0].set(self.stance[0]),
            end=self.stance[0],
            next_step=count,
            x_shift=zero,
            x_shift_new=zero,
            resume_time=zero,
            resume_plan_time=zero,
            world_shift=zero,
        )

    def step(
        self, state: PayloadState, gait: Gait, sensed: Sensed, shaken: Bool[Array, ""]
    ) -> tuple[PayloadState, Targets]:
        """One control tick: the plan, or what stands in its place.

        Args:
            state: of the last tick.
            gait: the plan.
            sensed: the sensors.
            shaken: whether the robot is being shaken by something the controller knows of.
        """
        state, before = self._filter(state, sensed), state
        state = self._advance(state, before, gait.timing, sensed)
        plan = self._plan_targets(state, gait, sensed.time)
        targets = self._targets(state, plan, gait.timing, sensed.time)
        triggered, trigger_time = self._watch(state, before, shaken)
        reflex = self._trigger(state, targets, gait.timing, trigger_time)
        instead = self._targets(reflex, plan, gait.timing, sensed.time)
        return jax.tree.map(lambda a, b: jnp.where(triggered, a, b), (reflex, instead), (state, targets))

    def _filter(self, state: PayloadState, sensed: Sensed) -> PayloadState:
        """Low-pass force and ZMP (Eqs. 3.7 and 3.18); the first reading is taken as it is."""
        p, first = self.params, state.time < 0.0
        dt = sensed.time - state.time
        force, zmp = sensed.corner_force.sum(), sensed.zmp_body[0]

        def low_pass(old: Scalar, new: Scalar, time_constant: Scalar) -> Scalar:
            return jnp.where(first, new, old + (1.0 - jnp.exp(-dt / time_constant)) * (new - old))

        return eqx.tree_at(
            lambda s: (s.time, s.tick, s.force, s.slow_force, s.zmp, s.weight),
            state,
            (
                sensed.time,
                jnp.where(first, 0.0, dt),
                low_pass(state.force, force, p.force_time_constant),
                low_pass(state.slow_force, force, p.slow_time_constant),
                low_pass(state.zmp, zmp, p.zmp_time_constant),
                jnp.where(first, force, state.weight),
            ),
        )

    def _watch(
        self, state: PayloadState, before: PayloadState, shaken: Bool[Array, ""]
    ) -> tuple[Bool[Array, ""], Scalar]:
        """Whether the force has left the band around the weight, and when the reflex to it starts.

        It is felt up to a tick after it has done so. A start that is felt at once by one tick and late by the next
        would jump by a tick where a little more load moves it on: so every one comes a tick after the crossing.
        """
        p, walking = self.params, state.mode == WALK
        again = state.reflexes > 0
        calm = ~(again & (state.time - state.resume_time < p.rearm_time)) & ~shaken
        fast, fast_time = self._crossing(state, before.force, state.force, p.threshold, before.time)
        slow, slow_time = self._crossing(
            state, before.slow_force, state.slow_force, p.slow_threshold, before.time
        )
        fast, slow = fast & walking & calm, slow & (walking | (state.mode >= SHIFT))
        if not p.starts_again:
            fast, slow = fast & ~again, slow & ~again
        felt = _decided(jnp.where(fast, _FAST, jnp.where(slow, _SLOW, _NOTHING)))
        return felt != _NOTHING, jnp.where(felt == _FAST, fast_time, slow_time)

    def _crossing(
        self, state: PayloadState, then: Scalar, now: Scalar, threshold: Scalar, time: Scalar
    ) -> tuple[Bool[Array, ""], Scalar]:
        """Whether a force that was `then` at `time` and is `now` is out of the band, and when it left it."""
        off_then, off = (jnp.abs(force - state.weight) - threshold for force in (then, now))
        crossed = (off_then < 0.0) & (off > 0.0)
        share = jnp.where(crossed, off_then / jnp.where(crossed, off_then - off, 1.0), 1.0)
        if not self.params.interpolate:
            return off > 0.0, state.time
        return off > 0.0, jnp.where(time < 0.0, state.time, time + share * (state.time - time) + state.tick)

    def _trigger(self, state: PayloadState, targets: Targets, timing: Timing, time: Scalar) -> PayloadState:
        """Start a reflex at `time`, from the targets as they are then (their Taylor polynomial about the tick)."""
        p, back = self.params, time - state.time
        orders = (targets.position, targets.velocity, targets.acceleration)
        sole, velocity, acceleration = (order.sole for order in orders)
        position, speed, change = (order.sole - order.pelvis for order in orders)
        start = jnp.stack(
            [position + back * speed + 0.5 * back * back * change, speed + back * change, change]
        )
        phase = targets.phase
        aloft = phase.support == SINGLE_SUPPORT
        applied = self._applied_shift(state, time)
        row = jnp.where(aloft, phase.swing, 2)
        x = start[0, :, 0] + p.x_reflex[row]
        ahead = _foot_ahead(x)
        next_step = _matching_step(self._upcoming(state, phase), ahead, aloft, timing)
        end = self.stance[next_step].at[:, 0].set(x)
        return eqx.tree_at(
            lambda s: (
                s.mode,
                s.reflexes,
                s.trigger_time,
                s.trigger_plan_time,
                s.support,
                s.swing,
                s.start_sole,
                s.start,
                s.end,
                s.next_step,
                s.x_shift,
                s.x_shift_new,
            ),
            state,
            (
                jnp.full_like(state.mode, REFLEX),
                state.reflexes + 1,
                time,
                targets.time + back,
                phase.support,
                phase.swing,
                sole + back * velocity + 0.5 * back * back * acceleration,
                start,
                end,
                next_step,
                applied,
                applied,
            ),
        )

    def _upcoming(self, state: PayloadState, phase: Phase) -> Int[Array, ""]:
        """Number of the plan's step that comes next."""
        walking = jnp.where(phase.time_since_liftoff < 0.0, phase.step, phase.step + 1)
        return jnp.where(phase.kind == RECOVERY_STEP, state.next_step, walking).astype(jnp.int32)

    def _applied_shift(self, state: PayloadState, time: Scalar) -> Scalar:
        """Shift of x_ref at `time` [m] (Eq. 3.21)."""
        p = self.params
        begin = state.trigger_time + p.reflex_time + p.settling_time
        share = jnp.where(state.mode <= SETTLE, 0.0, self._ramp(state, begin, p.shift_time, time))
        share = jnp.where(state.mode == WALK, 1.0, share)
        return state.x_shift + share * (state.x_shift_new - state.x_shift)

    def _ramp(self, state: PayloadState, begin: Scalar, length: Scalar, time: Scalar) -> Scalar:
        """From 0 at `begin` to 1 `length` later, in the tick to come.

        Servos are told a speed for a whole tick: where the ramp begins or ends inside it, its mean over the tick.
        """
        now, then = (jnp.clip((t - begin) / length, 0.0, 1.0) for t in (state.time, state.time + state.tick))
        return now + (time - state.time) * (then - now) / jnp.where(state.tick > 0.0, state.tick, 1.0)

    def _ends(self, state: PayloadState, timing: Timing) -> Float[Array, "6"]:
        """When each mode ends, by its number [s]."""
        p, step = self.params, self._recovery(state, timing)
        lengths = [
            state.trigger_time,
            p.reflex_time,
            p.settling_time,
            p.shift_time,
            step.t_ss + step.t_ds,
            0.5 * p.settling_time,
        ]
        return jnp.cumsum(jnp.stack(lengths))

    def _advance(
        self, state: PayloadState, before: PayloadState, timing: Timing, sensed: Sensed
    ) -> PayloadState:
        """Leave a mode whose time is over, or is in the tick to come: SETTLE and HOLD, after which there is a speed."""
        p = self.params
        end = self._ends(state, timing)[state.mode]
        ahead = ((state.mode == SETTLE) | (state.mode == HOLD)) & p.interpolate
        over = state.time + jnp.where(ahead, state.tick, 0.0) >= end
        leaving = _decided(jnp.where(over, state.mode, WALK))
        stay = lambda s: s  # noqa: E731

        def to(mode: int) -> Any:
            return lambda s: eqx.tree_at(lambda t: t.mode, s, jnp.full_like(s.mode, mode))

        def settle(s: PayloadState) -> PayloadState:
            """The slower low-pass starts anew at the end of the reflex, free of what was before the load."""
            share = s.share(end - before.time) if p.interpolate else jnp.ones_like(end)
            then, total = before.force + share * (s.force - before.force), sensed.corner_force.sum()
            rest = (1.0 - share) * s.tick
            slow = then + (1.0 - jnp.exp(-rest / p.slow_time_constant)) * (total - then)
            return eqx.tree_at(lambda t: (t.mode, t.slow_force), s, (jnp.full_like(s.mode, SETTLE), slow))

        def read(s: PayloadState) -> PayloadState:
            """Eqs. 3.19 and 3.20, and the weight that is normal from now on; as they were a tick before the end."""
            share = s.share(end - s.time) if p.interpolate else jnp.ones_like(end)
            zmp = before.zmp + share * (s.zmp - before.zmp)
            wanted = p.x_ref_gain * (zmp - p.zmp_balanced)
            weight = before.slow_force + share * (s.slow_force - before.slow_force)
            values = (jnp.full_like(s.mode, SHIFT), wanted, weight)
            return eqx.tree_at(lambda t: (t.mode, t.x_shift_new, t.weight), s, values)

        def resume(s: PayloadState) -> PayloadState:
            stance = 1 - _foot_ahead(s.end[:, 0])
            values = (
                jnp.full_like(s.mode, WALK),
                end if p.interpolate else s.time,
                self.resume_plan_time[s.next_step],
                _stance_place(s, stance)[0] - self.foothold[s.next_step, stance],
                s.x_shift_new,
            )
            return eqx.tree_at(
                lambda t: (t.mode, t.resume_time, t.resume_plan_time, t.world_shift, t.x_shift), s, values
            )

        leave = [stay, settle, read, to(RECOVER), to(HOLD), resume]
        return jax.lax.switch(leaving, leave, state)

    def _recovery(self, state: PayloadState, timing: Timing) -> _Recovery:
        """Eqs. 3.22-3.25; Eq. 3.23 by the step length that is missing, its half in the symmetric stance."""
        T_s, T_d = timing.T_s, timing.T_c - timing.T_s
        goal = self.stance[state.next_step].at[:, 0].add(state.x_shift)
        swing = _foot_ahead(state.end[:, 0])
        missing = (goal[swing, 0] - state.end[swing, 0]) - (goal[1 - swing, 0] - state.end[1 - swing, 0])
        f = jnp.minimum(0.5 * jnp.abs(missing) / self.stride, 0.999)
        if self.params.steady_recovery:
            steps = jnp.where(jnp.abs(missing) > _SMALLEST_WAY, 1.0, 0.0)
            half_distance = 0.5 * (goal[LEFT, 1] - goal[RIGHT, 1])
            return _Recovery(
                swing, f, T_s, _STEADY_SHARE * T_s, steps * half_distance, steps * self.lift, goal
            )
        t_ss = T_s * jnp.arccos(f) / jnp.pi
        return _Recovery(swing, f, t_ss, T_d / T_s * t_ss, self.sway * f, self.lift * f, goal)

    def _plan_time(self, state: PayloadState, timing: Timing, time: Scalar) -> Scalar:
        """Plan time at `time` [s] while the robot walks."""
        since = time - state.resume_time
        if not self.params.smooth_resume:
            going = state.share(state.time + state.tick - state.resume_time)
            going = jnp.where(state.reflexes > 0, going, 1.0)
            begun = jnp.maximum(state.time - state.resume_time, 0.0)
            return state.resume_plan_time + begun + going * (time - state.time)
        since = jnp.where(since < 0.0, 0.0, since)  # jnp.maximum would have half its derivative at 0
        lead = 0.5 * (timing.T_c - timing.T_s)
        r = jnp.minimum(0.5 * since / lead, 1.0)
        slow = lead * r * r * r * (2.0 - r) + jnp.maximum(since - 2.0 * lead, 0.0)
        on_the_way = (state.next_step > 0) & (state.next_step < timing.n_steps) & (state.reflexes > 0)
        return state.resume_plan_time + jnp.where(on_the_way, slow, since)

    def _plan_targets(self, state: PayloadState, gait: Gait, time: Scalar) -> Targets:
        """The plan, wherever the walk has got to; exactly the plan as long as nothing has happened."""
        one = jnp.ones_like(time)

        def plan_time(t: Scalar) -> Scalar:
            return self._plan_time(state, gait.timing, t)

        def with_rate(t: Scalar) -> tuple[Scalar, Scalar]:
            return jax.jvp(plan_time, (t,), (one,))

        (now, rate), (_, change) = jax.jvp(with_rate, (time,), (one,))
        plan = at(gait, now)
        return Targets(
            position=self._in_world(plan.position, state),
            velocity=jax.tree.map(lambda v: v * rate, plan.velocity),
            acceleration=jax.tree.map(
                lambda a, v: a * rate * rate + v * change, plan.acceleration, plan.velocity
            ),
            phase=plan.phase,
            time=now,
        )

    def _in_world(self, task: TaskSpace, state: PayloadState) -> TaskSpace:
        """The plan's task space where the walk is, with the body behind the feet by the shift of x_ref."""
        pelvis = task.pelvis.at[0].add(state.world_shift - state.x_shift)
        return TaskSpace(task.sole.at[:, 0].add(state.world_shift), pelvis)

    def _targets(self, state: PayloadState, plan: Targets, timing: Timing, time: Scalar) -> Targets:
        """What the robot is to do at `time`: the plan, or the pose of the mode it is in."""
        one = jnp.ones_like(time)

        def pose(t: Scalar) -> TaskSpace:
            return self._pose(state, timing, t)

        def with_velocity(t: Scalar) -> tuple[TaskSpace, TaskSpace]:
            return jax.jvp(pose, (t,), (one,))

        (position, velocity), (_, acceleration) = jax.jvp(with_velocity, (time,), (one,))
        plan_time = self._feed_forward_time(state, timing, time)
        instead = Targets(position, velocity, acceleration, plan.phase, plan_time)
        targets = jax.tree.map(lambda a, b: jnp.where(state.mode == WALK, a, b), plan, instead)
        phase = self._phase(state, plan, timing, time)
        return eqx.tree_at(lambda t: t.phase, targets, phase)

    def _pose(self, state: PayloadState, timing: Timing, time: Scalar) -> TaskSpace:
        """Soles and pelvis in the world outside WALK; the stance foot stands still."""
        since = time - state.trigger_time
        step = self._recovery(state, timing)
        before = state.mode < RECOVER
        in_body = jnp.where(
            before,
            self._reflex_pose(state, since, time),
            self._recovery_pose(state, step, time),
        )
        stance = jnp.where(before, 1 - state.swing, 1 - step.swing)
        pelvis = _stance_place(state, stance) - in_body[stance]
        return TaskSpace(pelvis + in_body, pelvis)

    def _reflex_pose(self, state: PayloadState, since: Scalar, time: Scalar) -> Float[Array, "2 3"]:
        """Soles in the body frame up to the end of SHIFT (Eqs. 3.11-3.17 and 3.21)."""
        p, way = self.params, state.end - state.start[0]
        if p.smooth_reflex or p.smooth_ramp:
            T = jnp.stack([p.reflex_time, self._body_time(state), p.reflex_time])
            moved = quintic_to_rest(since, T, state.start[1], state.start[2], way)
        else:
            ramp = self._ramp(state, state.trigger_time, p.reflex_time, time)
            moved = self._before(state, time) + ramp * way
        shift = self._applied_shift(state, time) - state.x_shift
        return (state.start[0] + moved).at[:, 0].add(shift)

    def _before(self, state: PayloadState, time: Scalar) -> Float[Array, "2 3"]:
        """What is left, before a ramp that starts inside the tick to come, of the motion that it ends."""
        back = jnp.minimum(state.time - state.trigger_time, 0.0)
        share = state.share(-back)
        _, velocity, acceleration = state.start
        left = back * velocity + 0.5 * back * back * acceleration
        since = time - state.time
        return left + share * (since * (velocity + back * acceleration) + 0.5 * since * since * acceleration)

    def _body_time(self, state: PayloadState) -> Scalar:
        """Time in which the body gets to the middle [s].

        Not so long that it swings beyond it; the shorter, the nearer it is to the middle of two feet on the ground.
        """
        p, way = self.params, (state.end - state.start[0])[LEFT, 1]
        if not p.smooth_reflex:
            return p.reflex_time
        towards = jnp.where(way >= 0.0, -1.0, 1.0)
        velocity, acceleration = towards * state.start[1, LEFT, 1], towards * state.start[2, LEFT, 1]
        half_distance = 0.5 * (state.end[LEFT, 1] - state.end[RIGHT, 1])
        share = 0.5 + 0.5 * jnp.minimum(jnp.abs(way) / half_distance, 1.0)
        longest = jnp.where(state.support == DOUBLE_SUPPORT, share, 1.0) * p.body_time
        without_overshoot = longest_time_to_rest(velocity, acceleration, jnp.abs(way))
        return jnp.maximum(jnp.minimum(without_overshoot, longest), p.reflex_time)

    def _recovery_pose(self, state: PayloadState, step: _Recovery, time: Scalar) -> Float[Array, "2 3"]:
        """Soles in the body frame in RECOVER and HOLD (Eqs. 3.26-3.40)."""
        p = self.params
        since = time - (state.trigger_time + p.reflex_time + p.settling_time + p.shift_time)
        aloft = jnp.clip((since - 0.5 * step.t_ds) / step.t_ss, 0.0, 1.0)
        wave = jnp.clip(since / (step.t_ss + step.t_ds), 0.0, 1.0)
        foot = 0.5 * (1.0 - jnp.cos(jnp.pi * aloft))
        way, swing = step.goal[:, 0] - state.end[:, 0], step.swing
        body = way[1 - swing] * foot
        if p.steady_recovery:
            begun = smooth(since / (0.5 * step.t_ds))
            ended = smooth((since - 0.5 * step.t_ds - step.t_ss) / (0.5 * step.t_ds))
            body = self._to_stand(state, step) * (begun - ended) + way[1 - swing] * ended
        forward = jnp.full_like(way, body).at[swing].add((way[swing] - way[1 - swing]) * foot)
        aside = jnp.where(swing == LEFT, 1.0, -1.0) * 0.5 * step.sway * (1.0 - jnp.cos(2.0 * jnp.pi * wave))
        up = 0.5 * step.lift * (1.0 - jnp.cos(2.0 * jnp.pi * aloft))
        sole = state.end.at[:, 0].add(forward + state.x_shift_new - state.x_shift)
        return sole.at[:, 1].add(aside).at[swing, 2].add(up)

    def _to_stand(self, state: PayloadState, step: _Recovery) -> Scalar:
        """How far forward the stance foot goes in the body frame before the other one lifts off [m]."""
        if self.params.x_stand is None:
            return jnp.zeros_like(step.f)
        from_here = self.params.x_stand + state.x_shift - state.end[1 - step.swing, 0]
        return jnp.where(step.lift > 0.0, from_here, 0.0)

    def _feed_forward_time(self, state: PayloadState, timing: Timing, time: Scalar) -> Scalar:
        """Plan time whose joint torques suit the pose outside WALK: both feet loaded, or the step of the same foot."""
        step, start = self._recovery(state, timing), self._ends(state, timing)[SHIFT]
        before = self.resume_plan_time[jnp.maximum(state.next_step - 1, 0)]
        after = self.resume_plan_time[state.next_step]
        since = time - state.trigger_time
        down = jnp.clip(since / self._body_time(state), 0.0, 1.0)
        liftoff = jnp.minimum(timing.liftoff(jnp.maximum(state.next_step - 1, 0)), after)
        touchdown = jnp.minimum(liftoff + timing.T_s, after)
        half = 0.5 * step.t_ds
        knots = start + jnp.stack([jnp.zeros_like(half), half, half + step.t_ss, step.t_ss + step.t_ds])
        recovering = jnp.interp(time, knots, jnp.stack([before, liftoff, touchdown, after]))
        return (1.0 - down) * (state.trigger_plan_time + jnp.minimum(since, 0.0)) + down * recovering

    def _phase(self, state: PayloadState, plan: Targets, timing: Timing, time: Scalar) -> Phase:
        """Phase of the plan, of the reflex, or of the recovery step, which lasts until the plan's next lift-off."""
        p, step, ends = self.params, self._recovery(state, timing), self._ends(state, timing)
        since = time - state.trigger_time
        falling = (state.mode == REFLEX) & (state.support == SINGLE_SUPPORT)
        reflex = Phase(
            step=jnp.maximum(state.next_step - 1, 0),
            swing=state.swing,
            support=jnp.where(falling, SINGLE_SUPPORT, DOUBLE_SUPPORT),
            time_in_phase=jnp.where(state.mode == REFLEX, since, time - ends[REFLEX]),
            time_since_liftoff=since,
            T_s=p.reflex_time,
            T_c=p.reflex_time + p.settling_time,
            kind=jnp.full_like(state.mode, REFLEX_STEP),
            begin=jnp.zeros_like(since),
        )
        liftoff = ends[SHIFT] + 0.5 * step.t_ds
        tau = time - liftoff
        single = (tau >= 0.0) & (tau < step.t_ss) & (step.lift > 1e-6)
        standing = jnp.where(tau < 0.0, time - ends[SETTLE], tau - step.t_ss)
        recovery = Phase(
            step=jnp.maximum(state.next_step - 1, 0),
            swing=step.swing,
            support=jnp.where(single, SINGLE_SUPPORT, DOUBLE_SUPPORT),
            time_in_phase=jnp.where(single, tau, standing),
            time_since_liftoff=tau,
            T_s=step.t_ss,
            T_c=ends[HOLD] + self._resume_lead(state, timing) - liftoff,
            kind=jnp.full_like(state.mode, RECOVERY_STEP),
            begin=ends[SETTLE] - liftoff,
        )
        last = state.next_step == timing.n_steps
        waiting = last | (plan.time < timing.liftoff(state.next_step))
        recovering = (state.mode >= SHIFT) | ((state.mode == WALK) & (state.reflexes > 0) & waiting)
        reflexive = (state.mode == REFLEX) | (state.mode == SETTLE)
        phase = jax.tree.map(lambda a, b: jnp.where(recovering, a, b), recovery, plan.phase)
        return jax.tree.map(lambda a, b: jnp.where(reflexive, a, b), reflex, phase)

    def _resume_lead(self, state: PayloadState, timing: Timing) -> Scalar:
        """From the walk's going on to its next lift-off [s]."""
        lead = timing.liftoff(state.next_step) - self.resume_plan_time[state.next_step]
        on_the_way = (state.next_step > 0) & (state.next_step < timing.n_steps)
        lead = jnp.where(on_the_way & self.params.smooth_resume, 2.0 * lead, lead)
        return jnp.where(state.next_step == timing.n_steps, 1e3, lead)


def resume_plan_times(gait: Gait) -> Float[Array, " n"]:
    """Plan times [s] from which the walk can go on: mid double support before each step, the first and last at rest."""
    timing = gait.timing
    middle = timing.liftoff(jnp.arange(1, timing.n_steps)) - 0.5 * (timing.T_c - timing.T_s)
    return jnp.concatenate([jnp.zeros((1,), middle.dtype), middle, gait.duration[None]])


def _of_plan(robot: RobotParams, gait: Gait, given: dict[str, Any]) -> dict[str, Scalar]:
    """What a robot and its plan say about the parameters that are not given."""
    says = {
        "zmp_balanced": lambda: standing_zmp(robot, gait),
        "threshold": lambda: SMALLEST_LOAD + planned_ripple(robot, gait),
    }
    return {name: say() for name, say in says.items() if name not in given}


def planned_ripple(robot: RobotParams, gait: Gait, samples_per_step: int = 60) -> Scalar:
    """Greatest deviation of the plan's vertical ground force from the weight [N]: no sign of a load."""
    times = jnp.linspace(0.0, gait.duration, samples_per_step * (gait.timing.n_steps + 2))
    force = feasibility(robot, gait, times).ground_force[:, 2]
    return jnp.abs(force - force[0]).max()


def standing_zmp(robot: RobotParams, gait: Gait) -> Scalar:
    """ZMP forward of the pelvis [m] of the robot standing still as in mid double support: its centre of mass."""
    task = gait.task(resume_plan_times(gait)[min(1, gait.timing.n_steps)])
    angle, _ = body.joint_angles(robot, task.sole - task.pelvis)
    pose = body.pose(robot, jnp.zeros(3, angle.dtype), jnp.eye(3, dtype=angle.dtype), angle)
    return body.com(robot, pose)[0]


def _decided(choice: Int[Array, ""]) -> Int[Array, ""]:
    """The same small number >= 0, computed once and read by all that goes by it.

    XLA fuses a comparison into each of its uses and may contract products and sums differently there; half a record
    would go one way, half the other. A sort it neither fuses nor makes twice; lax.optimization_barrier is gone by then.
    """
    return jax.lax.sort(jnp.stack([choice, jnp.full_like(choice, jnp.iinfo(choice.dtype).max)]))[0]


def _foot_ahead(x: Float[Array, "2"]) -> Int[Array, ""]:
    """The foot further ahead, the left one if there is none (the conditions on x_r_e <= x_l_e)."""
    return jnp.where(x[RIGHT] <= x[LEFT], LEFT, RIGHT)


def _matching_step(
    upcoming: Int[Array, ""], ahead: Int[Array, ""], aloft: Bool[Array, ""], timing: Timing
) -> Int[Array, ""]:
    """The plan's step to go on with: the one at hand or the one before it, so that the foot behind swings."""
    behind_swings = (timing.first_swing + upcoming) % 2 != ahead
    finished = (upcoming == timing.n_steps) & ~aloft
    return jnp.where(behind_swings | finished | (upcoming == 0), upcoming, upcoming - 1)


def _stance_place(state: PayloadState, foot: Int[Array, ""]) -> Float[Array, "3"]:
    """Where a foot stands in the world since the end of the reflex; before it, this is so for the stance foot."""
    stance = 1 - state.swing
    return state.start_sole[stance] + state.end[foot] - state.end[stance]

"""Verdicts: whether a walk succeeded, by the rules of the two papers.

khadiv: the robot finishes its walk without a fall.
elkahlout (section 4.2): the robot does not fall in the step in which it is loaded, and completes two whole steps after
its recovery; if no reflex came, two whole steps after the step of the loading. Taking a load off is a loading too: a
sudden change of weight. Of two in a walk the last one counts, whether or not the robot had recovered from the first.
A load that is carried from the start (time 0) is own weight: putting it on is no event, taking it off is.

A step is a single support and the double support after it. Rules are met in the time of the plan, which stands still
while a reflex lasts: a robot that falls later than that has succeeded all the same, and its status says that it fell.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbiped import sim
from jaxbiped.adapt import Controller, ControllerState
from jaxbiped.planner import Gait
from jaxbiped.sim import statistics
from jaxbiped.sim.scenario import Payload

Scalar = Float[Array, ""]

UNFINISHED = len(sim.STATUS_TEXT)
STATUS_TEXT = (*sim.STATUS_TEXT, "unfinished")
WHOLE_STEPS = 2
"""Steps to be completed after a recovery."""
STANDS_FOR = 0.5
"""Time for which a robot is watched after its walk [s]."""
_SLACK = 5e-3
"""Time by which the plan may end early and still be in time: no control tick is longer [s]."""


class Verdict(eqx.Module):
    """The verdict on one walk."""

    success: Bool[Array, ""]
    """Whether the robot met the rule that applies: elkahlout's after a sudden change of weight, else khadiv's."""
    finished: Bool[Array, ""]
    """Whether the robot met khadiv's rule."""
    status: Int[Array, ""]
    """Number in STATUS_TEXT, what the robot did over the whole walk: fell, nonfinite or airborne, at any time, even
    after a success; else `ok`, or `unfinished` if simulated time or plan ended before the rule was met."""
    until: Scalar
    """Time until which the robot had to stand [s]; infinite if it did not get as far as to walk on."""
    tilt_margin: Scalar
    """Least tilt of the trunk that was left before a fall, over all the time simulated [rad]."""
    out_of_reach_time: Scalar
    """Time for which the targets were beyond the legs' reach or joint ranges [s]."""


def watch_time(controller: Controller, changes: int) -> float:
    """Time for which a walk is to be simulated for its verdict [s].

    Args:
        controller: with the gait and the stages of the walk.
        changes: how often the weight changes suddenly.
    """
    return float(controller.gait.duration) + STANDS_FOR + controller.longest_delay(changes)


def judge(walk: sim.Walk, gait: Gait, scenario: sim.Scenario) -> Verdict:
    """Judge one walk by its statistics and the last state of its controller; pure, to be mapped over many.

    Of several reflexes the last one counts. A load of 0 kg is none, nor is a change after the simulated time.

    Args:
        walk: result of a roll-out of this gait in this scenario.
        gait: the plan.
        scenario: what happened.
    """
    stats, controller = jax.tree.map(jnp.asarray, (walk.statistics, walk.controller))
    changed, is_changed = _last_change(scenario.payload, stats.end_time)
    time, plan_time, walking = _progress(controller, stats.end_time)
    delay = time - plan_time
    first = _first_whole_step(controller, gait, changed, delay)
    last = first + WHOLE_STEPS
    end = jnp.minimum(gait.timing.liftoff(last), gait.duration)
    goal = jnp.where(is_changed, end, gait.duration)
    can = walking & (~is_changed | (last <= gait.timing.n_steps))
    success = can & (plan_time >= goal - _SLACK)
    failed = stats.status != statistics.OK
    status = jnp.where(failed, stats.status, jnp.where(success, statistics.OK, UNFINISHED))
    return Verdict(
        success=success,
        finished=walking & (plan_time >= gait.duration - _SLACK),
        status=status.astype(jnp.int32),
        until=jnp.where(can, goal + delay, jnp.inf),
        tilt_margin=statistics.FALL_TILT - jnp.max(stats.peak_roll_pitch),
        out_of_reach_time=stats.out_of_reach_time,
    )


def _last_change(load: Payload, end_time: Scalar) -> tuple[Scalar, Bool[Array, ""]]:
    """Return when the weight changed suddenly for the last time before the end [s], and whether it did."""
    time = jnp.where(load.end < end_time, load.end, load.time)
    return time, (load.mass > 0.0) & (time > 0.0) & (time < end_time)


def _progress(controller: ControllerState | None, end_time: Scalar) -> tuple[Scalar, Scalar, Bool[Array, ""]]:
    """Time, time in the plan, and whether the plan was being walked, at the controller's last tick."""
    if controller is None:
        return end_time, end_time, jnp.ones((), bool)
    return controller.time, controller.plan_time, controller.signals.walking


def _first_whole_step(
    controller: ControllerState | None, gait: Gait, change_time: Scalar, delay: Scalar
) -> Int[Array, ""]:
    """Number of the first step that begins after the recovery and after the step in which the weight changed."""
    timing = gait.timing
    loaded_in = jnp.floor((change_time - delay - timing.first_liftoff) / timing.T_c)
    after_load = jnp.clip(loaded_in + 1, 0, timing.n_steps).astype(jnp.int32)
    if controller is None:
        return after_load
    signals = controller.signals
    interrupted = signals.interruptions > 0
    after_recovery = jnp.where(interrupted, signals.next_step, 0)
    before_recovery = interrupted & (change_time < signals.resume_time)
    return jnp.where(before_recovery, after_recovery, jnp.maximum(after_load, after_recovery))

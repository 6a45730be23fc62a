"""Targets of a gait for the robot at one instant."""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

SINGLE_SUPPORT, DOUBLE_SUPPORT = 0, 1
PLANNED_STEP, REFLEX_STEP, RECOVERY_STEP = 0, 1, 2
"""A step of the gait, or what an adaptation does in its place: stand still, and make up for it."""
ROOM = 8
"""Plans have room for a multiple of so many steps."""
Count = int | Int[Array, ""]
"""A whole number that may be traced."""


class TaskSpace(eqx.Module):
    """Soles and pelvis in the world (or their time derivatives); all level, upright and facing +x."""

    sole: Float[Array, "2 3"]
    """Sole frame origins, left and right [m]."""
    pelvis: Float[Array, "3"]
    """Pelvis frame origin [m]."""


class Phase(eqx.Module):
    """Place of an instant in the walk."""

    step: Int[Array, ""]
    """Number of the step, 0 for the first; a step is a single support and the double support after it."""
    swing: Int[Array, ""]
    """The foot that swings in this step, 0 left or 1 right; in double support the one that swung last."""
    support: Int[Array, ""]
    """SINGLE_SUPPORT or DOUBLE_SUPPORT."""
    time_in_phase: Float[Array, ""]
    """Time since this support phase began [s]; before the first lift-off, since the start of the walk."""
    time_since_liftoff: Float[Array, ""]
    """Time since the lift-off of this step [s]; negative before the first one."""
    T_s: Float[Array, ""]
    """Duration of this step's single support [s]."""
    T_c: Float[Array, ""]
    """End of this step, since its lift-off [s]."""
    kind: Int[Array, ""]
    """PLANNED_STEP, REFLEX_STEP or RECOVERY_STEP."""
    begin: Float[Array, ""]
    """Beginning of this step, since its lift-off [s]."""


def room_for(n_steps: int) -> int:
    """Number of steps that a plan of so many has room for: walks of few and of some more steps share programs."""
    return n_steps + -n_steps % ROOM


def as_count(value: object) -> Int[Array, ""]:
    """A whole number as an array; the converter of counts in records."""
    return jnp.asarray(value, jnp.int32)


class Timing(eqx.Module):
    """Times of the steps of a walk."""

    first_liftoff: Float[Array, ""]
    """Time of the first lift-off [s]."""
    T_s: Float[Array, ""]
    """Duration of single support [s]."""
    T_c: Float[Array, ""]
    """Duration of a step [s]."""
    n_steps: Int[Array, ""] = eqx.field(converter=as_count)
    """Number of steps."""
    first_swing: Int[Array, ""] = eqx.field(converter=as_count)
    """The foot that swings first, 0 left or 1 right."""
    room: int = eqx.field(static=True)
    """Number of steps that tables have room for."""

    def liftoff(self, step: int | Int[Array, "*n"]) -> Float[Array, "*n"]:
        """Lift-off of a step [s]."""
        return self.first_liftoff + step * self.T_c

    def touchdown(self, step: int | Int[Array, "*n"]) -> Float[Array, "*n"]:
        """Planned touchdown of a step [s]."""
        return self.liftoff(step) + self.T_s


def step_phase(timing: Timing, t: Float[Array, ""]) -> Phase:
    """Phase at time t [s]."""
    T_s, last = timing.T_s, timing.n_steps - 1
    step = jnp.clip(jnp.floor((t - timing.first_liftoff) / timing.T_c), 0, last).astype(jnp.int32)
    since_liftoff = t - timing.liftoff(step)
    standing, single = since_liftoff < 0.0, (since_liftoff >= 0.0) & (since_liftoff < T_s)
    return Phase(
        step=step,
        swing=(timing.first_swing + step) % 2,
        support=jnp.where(single, SINGLE_SUPPORT, DOUBLE_SUPPORT),
        time_in_phase=jnp.where(standing, t, jnp.where(single, since_liftoff, since_liftoff - T_s)),
        time_since_liftoff=since_liftoff,
        T_s=T_s,
        T_c=timing.T_c,
        kind=jnp.full_like(step, PLANNED_STEP),
        begin=jnp.zeros_like(since_liftoff),
    )


class Targets(eqx.Module):
    """Task-space targets with their first two derivatives, and the phase."""

    position: TaskSpace
    """Positions [m]."""
    velocity: TaskSpace
    """Velocities [m/s]."""
    acceleration: TaskSpace
    """Accelerations [m/s2]."""
    phase: Phase
    """Phase of the walk."""
    time: Float[Array, ""]
    """Time in the plan whose joint torques suit these targets [s]."""


@runtime_checkable
class Plan(Protocol):
    """A planned walk: functions of time, for any time, under jit. A `gait.Gait` is one that knows how it was made."""

    @property
    def duration(self) -> Float[Array, ""]:
        """Duration of the walk from rest to rest [s]."""
        ...

    @property
    def timing(self) -> Timing:
        """Times of the steps."""
        ...

    def task(self, t: Float[Array, ""]) -> TaskSpace:
        """Soles and pelvis at time t [s]."""
        ...

    def phase(self, t: Float[Array, ""]) -> Phase:
        """Phase of the walk at time t [s]."""
        ...


def at(gait: Plan, t: Float[Array, ""] | float) -> Targets:
    """Targets of a plan at time t [s] since its start from rest; before and after it the robot stands."""
    time = jnp.asarray(t, jnp.result_type(float))
    one = jnp.ones_like(time)

    def with_velocity(s: Float[Array, ""]) -> tuple[TaskSpace, TaskSpace]:
        return jax.jvp(gait.task, (s,), (one,))

    (position, velocity), (_, acceleration) = jax.jvp(with_velocity, (time,), (one,))
    return Targets(position, velocity, acceleration, gait.phase(time), time)

"""The cosine gait of El-Kahlout's thesis, Eqs. 3.1-3.6, set into the world, from rest to rest.

The thesis writes the feet in the body frame. Its stance foot is what stands still in the world, which says
where the body is: it advances 2 b_s in every single support and sways by w sin(pi t / (t_ss + t_ds)). Time:

    0 .. T_ini     the robot stands with its feet b_s ahead and behind; a quintic brings the sway up to speed
    T_ini ..       the thesis' time t: half a double support, then steps of t_ss + t_ds
    .. duration    a quintic brings the sway to rest in T_end
"""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxbiped import runtime
from jaxbiped.checked import Quantity
from jaxbiped.planner.checks import require
from jaxbiped.planner.gait import PlannedGait, register
from jaxbiped.planner.polynomial import Polynomial, as_scalar, quintic
from jaxbiped.planner.targets import Count, TaskSpace, Timing, as_count
from jaxbiped.robot import LEFT, RIGHT, RobotParams

Scalar = Float[Array, ""]

_DURATION = Quantity("s", 0.0, 60.0, above=True)
_REST = Quantity("s", 0.0, 600.0, above=True)
QUANTITIES = {
    "t_ss": _DURATION,
    "t_ds": _DURATION,
    "b_s": Quantity("m", 0.0, 1.0),
    "w": Quantity("m", -1.0, 1.0),
    "w_of": Quantity("m", 0.0, 1.0, above=True),
    "h_b": Quantity("m", 0.0, 2.0, above=True),
    "h_s": Quantity("m", 0.0, 1.0, above=True),
    "x_ref": Quantity("m", -1.0, 1.0),
    "y_ref": Quantity("m", -1.0, 1.0),
    "T_ini": _REST,
    "T_end": _REST,
}
"""Allowed values of the parameters."""


class CosineParams(eqx.Module):
    """Parameters of the cosine gait, by the thesis' symbols (section 3.2)."""

    t_ss: Scalar = eqx.field(converter=as_scalar)
    """Duration of single support [s]."""
    t_ds: Scalar = eqx.field(converter=as_scalar)
    """Duration of double support [s]."""
    b_s: Scalar = eqx.field(converter=as_scalar)
    """Half the step length: how far a foot goes ahead of and behind x_ref [m]."""
    w: Scalar = eqx.field(converter=as_scalar)
    """Amplitude of the lateral sway [m]."""
    w_of: Scalar = eqx.field(converter=as_scalar)
    """Half the lateral distance between the feet [m]."""
    h_b: Scalar = eqx.field(converter=as_scalar)
    """Height of the body frame over the soles [m]."""
    h_s: Scalar = eqx.field(converter=as_scalar)
    """Greatest height of the swing foot [m]."""
    x_ref: Scalar = eqx.field(converter=as_scalar)
    """Middle of the feet in the body frame, sagittal (x_ref_as) [m]."""
    y_ref: Scalar = eqx.field(converter=as_scalar)
    """Middle of the feet in the body frame, lateral (y_ref_as) [m]."""
    T_ini: Scalar = eqx.field(converter=as_scalar)
    """Time from rest to t = 0 of the thesis [s]."""
    T_end: Scalar = eqx.field(converter=as_scalar)
    """Time from the middle of the last double support to rest [s]."""

    @property
    def T_c(self) -> Scalar:
        """Duration of a step [s]."""
        return self.t_ss + self.t_ds


@register
class CosineGait(PlannedGait):
    """A planned cosine walk of `n_steps` steps; build it with `make`."""

    name: ClassVar[str] = "cosine"
    quantities: ClassVar[Mapping[str, Quantity]] = QUANTITIES
    """Allowed values of the parameters."""
    parameters: ClassVar[type[eqx.Module]] = CosineParams
    """The record of the parameters."""
    params: CosineParams
    """Parameters from which the walk was planned."""
    n_steps: Int[Array, ""]
    """Number of steps."""
    first_swing: Int[Array, ""]
    """The foot that swings first, 0 left (as in the thesis) or 1 right."""
    sway_in: Polynomial
    """Lateral pelvis position from rest [m]."""
    sway_out: Polynomial
    """Lateral pelvis position to rest [m]."""
    room: int = eqx.field(static=True)
    """Number of steps that tables have room for."""

    @classmethod
    def require_sane(cls, robot: RobotParams, params: CosineParams) -> None:
        """Raise a GaitError for parameters within their bounds that do not fit each other, or the robot."""
        p = params
        inner = 0.5 * float(robot.p_sole_corner[RIGHT, :, 1].max() - robot.p_sole_corner[LEFT, :, 1].min())
        require("w_of", p.w_of, f"> {inner:g} m (the soles must not overlap)", p.w_of > inner, unit="m")

    @classmethod
    def plan(cls, params: CosineParams, n_steps: Count, first_swing: Count, room: int) -> "CosineGait":
        """The walk of these parameters; pure."""
        return _plan(params, as_count(n_steps), as_count(first_swing), room)

    @property
    def duration(self) -> Scalar:
        """Duration of the walk from rest to rest [s]."""
        p = self.params
        return p.T_ini + self.n_steps * p.T_c + p.T_end

    @property
    def clock_start(self) -> Scalar:
        """Time at which the thesis' time starts, since the start of the walk [s]."""
        return self.params.T_ini

    @property
    def timing(self) -> Timing:
        """Times of the steps."""
        p = self.params
        return Timing(p.T_ini + 0.5 * p.t_ds, p.t_ss, p.T_c, self.n_steps, self.first_swing, self.room)

    def task(self, t: Scalar) -> TaskSpace:
        """Soles and pelvis in the world at time t [s]; sole minus pelvis is elkahlout Eqs. 3.1-3.6."""
        p, phase = self.params, self.phase(t)
        angle = jnp.pi * _held(phase.time_since_liftoff, 0.0, p.t_ss) / p.t_ss
        middle = (2 * phase.step + 1) * p.b_s
        stance_foot = [middle + p.x_ref, jnp.zeros_like(t)]
        swing_foot = [
            middle + p.x_ref - 2.0 * p.b_s * jnp.cos(angle),
            0.5 * p.h_s * (1.0 - jnp.cos(2.0 * angle)),
        ]
        soles = []
        for side, y in ((LEFT, p.w_of), (RIGHT, -p.w_of)):
            x, z = (
                jnp.where(phase.swing == side, a, b) for a, b in zip(swing_foot, stance_foot, strict=True)
            )
            soles.append(jnp.stack([x, y, z]))
        pelvis = jnp.stack([middle - p.b_s * jnp.cos(angle), self._sway(t) - p.y_ref, p.h_b])
        return TaskSpace(jnp.stack(soles), pelvis)

    def _sway(self, t: Scalar) -> Scalar:
        p = self.params
        stop = p.T_ini + self.n_steps * p.T_c
        walking = _towards_stance(self.first_swing) * p.w * jnp.sin(jnp.pi * (t - p.T_ini) / p.T_c)
        starting = self.sway_in(_held(t, 0.0, p.T_ini))
        stopping = self.sway_out(_held(t, stop, self.duration))
        return jnp.where(t < p.T_ini, starting, jnp.where(t < stop, walking, stopping))


def _held(t: Scalar, start: Scalar | float, end: Scalar) -> Scalar:
    """Time from `start` to `end` [s], held before and after.

    At `start` its rate is 1, at `end` 0: that of what comes next. The derivative of jnp.clip is 0.5 at both.
    """
    return jnp.where(t < start, start, jnp.where(t < end, t, end))


def _towards_stance(first_swing: Int[Array, ""]) -> Scalar:
    """Lateral direction of the foot that stands in the first step."""
    return 2.0 * first_swing - 1.0


@runtime.jit
def _plan(p: CosineParams, n_steps: Int[Array, ""], first_swing: Int[Array, ""], room: int) -> CosineGait:
    speed = _towards_stance(first_swing) * p.w * jnp.pi / p.T_c
    last_speed = jnp.where(n_steps % 2 == 0, speed, -speed)
    stop = p.T_ini + n_steps * p.T_c
    rest, moving = (0.0, 0.0, 0.0), (0.0, speed, 0.0)
    return CosineGait(
        params=p,
        n_steps=n_steps,
        first_swing=first_swing,
        room=room,
        sway_in=quintic(0.0, p.T_ini, rest, moving),
        sway_out=quintic(stop, stop + p.T_end, (0.0, last_speed, 0.0), rest),
    )

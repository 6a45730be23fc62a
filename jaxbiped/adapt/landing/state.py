"""State of the landing stage between two ticks."""

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from jaxbiped.planner import Phase

Scalar = Float[Array, ""]
_DISTURBED_TIME = 0.5
"""Time after a touch during which foot forces are no reliable measure of the weight [s]."""


class LandingState(eqx.Module):
    """State of the landing stage between two ticks."""

    phase: Phase
    """Phase at the last tick."""
    time: Scalar
    """Time of the last tick [s]."""
    aloft: Bool[Array, ""]
    """Whether all switches of the swing foot have been open in this step, up to T_s."""
    touched: Bool[Array, ""]
    """Whether the swing foot has touched in this step."""
    late: Bool[Array, ""]
    """Whether the swing foot has touched after T_s."""
    descended: Scalar
    """Descent of foot and pelvis at the touch [m]."""
    touch_tau: Scalar
    """Time since lift-off of the touch [s]."""
    touch: Float[Array, "3 2"]
    """Position, velocity, acceleration of the swing foot commanded at the touch, x and z (over `_ground`) [m]."""
    T_mod: Scalar
    """Time to set the foot down in this step [s]."""
    delta_x: Scalar
    """Sagittal distance over which the foot is set down [m]."""
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

    def disturbed(self) -> Bool[Array, ""]:
        """Tell whether at the last tick a foot had just touched, or was overdue."""
        overdue = ~self.touched & self.aloft & (self.tau > self.phase.T_s)
        return overdue | (self.touched & (self.tau - self.touch_tau < _DISTURBED_TIME))

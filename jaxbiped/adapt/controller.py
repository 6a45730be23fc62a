"""The walking controller: a gait, and the stages that adapt it to what the sensors say."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.adapt.landing import Landing, LandingStage, LandingState
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.planner import CosineGait, PolynomialGait, Targets, at


class ControllerState(eqx.Module):
    """What the controller remembers between two ticks."""

    plan_time: Float[Array, ""]
    """Time in the plan [s]."""
    landing: LandingState | None
    """Of the landing stage."""


class Controller(eqx.Module):
    """A gait and the stages that adapt it online; without stages it walks open loop."""

    gait: PolynomialGait | CosineGait
    """The planned walk."""
    landing: LandingStage | None
    """Landing on unknown heights."""

    def __init__(self, gait: PolynomialGait | CosineGait, landing: Landing | None = None):
        self.gait = gait
        self.landing = None if landing is None else LandingStage.plan(landing, gait)

    def init(self) -> ControllerState:
        """State before the first tick."""
        return ControllerState(
            plan_time=jnp.zeros((), jnp.result_type(float)),
            landing=None if self.landing is None else self.landing.init(),
        )

    def step(self, state: ControllerState, sensed: Sensed) -> tuple[ControllerState, Targets]:
        """One control tick: read the sensors, give task-space targets."""
        plan_time, landing = sensed.time, state.landing
        targets = at(self.gait, plan_time)
        if self.landing is not None and landing is not None:
            landing, targets = self.landing.step(landing, targets, sensed)
        return ControllerState(plan_time, landing), targets

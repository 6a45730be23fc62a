"""The walking controller: a gait, and the stages that adapt it to what the sensors say."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.adapt.sensed import Sensed
from jaxbiped.planner import CosineGait, PolynomialGait, Targets, at


class ControllerState(eqx.Module):
    """What the controller remembers between two ticks."""

    plan_time: Float[Array, ""]
    """Time in the plan [s]."""


class Controller(eqx.Module):
    """A gait, open loop. Stages that adapt it online plug in here."""

    gait: PolynomialGait | CosineGait
    """The planned walk."""

    def init(self) -> ControllerState:
        """State before the first tick."""
        return ControllerState(plan_time=jnp.zeros((), jnp.result_type(float)))

    def step(self, state: ControllerState, sensed: Sensed) -> tuple[ControllerState, Targets]:
        """One control tick: read the sensors, give task-space targets."""
        state = ControllerState(plan_time=sensed.time)
        return state, at(self.gait, state.plan_time)

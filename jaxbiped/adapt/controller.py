"""The walking controller: a gait, and the stages that adapt it to what the sensors say."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.adapt.landing import Landing, LandingStage, LandingState
from jaxbiped.adapt.payload import PayloadReflex, PayloadStage, PayloadState
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.planner import CosineGait, PolynomialGait, Targets, at


class ControllerState(eqx.Module):
    """What the controller remembers between two ticks."""

    plan_time: Float[Array, ""]
    """Time in the plan [s]."""
    payload: PayloadState | None
    """Of the payload stage."""
    landing: LandingState | None
    """Of the landing stage."""


class Controller(eqx.Module):
    """A gait and the stages that adapt it online; without stages it walks open loop.

    The payload stage decides what to do, the plan or a recovery; the landing stage fits that to the ground.
    """

    gait: PolynomialGait | CosineGait
    """The planned walk."""
    payload: PayloadStage | None
    """Sudden changes of weight."""
    landing: LandingStage | None
    """Landing on unknown heights."""

    def __init__(
        self,
        gait: PolynomialGait | CosineGait,
        landing: Landing | None = None,
        payload: PayloadReflex | None = None,
    ):
        self.gait = gait
        self.payload = None if payload is None else PayloadStage.plan(payload, gait)
        self.landing = None if landing is None else LandingStage.plan(landing, gait)

    def init(self) -> ControllerState:
        """State before the first tick."""
        return ControllerState(
            plan_time=jnp.zeros((), jnp.result_type(float)),
            payload=None if self.payload is None else self.payload.init(),
            landing=None if self.landing is None else self.landing.init(),
        )

    def longest_delay(self) -> float:
        """For how long a reflex can put the plan off [s]; 0 without a payload stage."""
        if self.payload is None:
            return 0.0
        p, timing = self.payload.params, self.gait.timing
        recovery_step = 2.2 * float(timing.T_s) + float(timing.T_c)
        return float(p.reflex_time + 1.5 * p.settling_time + p.shift_time) + recovery_step

    def step(self, state: ControllerState, sensed: Sensed) -> tuple[ControllerState, Targets]:
        """One control tick: read the sensors, give task-space targets."""
        payload, landing = state.payload, state.landing
        if self.payload is not None and payload is not None:
            shaken = jnp.zeros((), bool) if landing is None else landing.shaken()
            payload, targets = self.payload.step(payload, self.gait, sensed, shaken)
        else:
            targets = at(self.gait, sensed.time)
        if self.landing is not None and landing is not None:
            landing, targets = self.landing.step(landing, targets, sensed)
        return ControllerState(targets.time, payload, landing), targets

"""Online adaptation: what a controller senses and what it makes of it. Knows nothing of scenarios."""

from jaxbiped.adapt.controller import Controller, ControllerState
from jaxbiped.adapt.landing import Landing, LandingStage, LandingState
from jaxbiped.adapt.payload import PayloadReflex, PayloadStage, PayloadState
from jaxbiped.adapt.sensed import Sensed

__all__ = [
    "Controller",
    "ControllerState",
    "Landing",
    "LandingStage",
    "LandingState",
    "PayloadReflex",
    "PayloadStage",
    "PayloadState",
    "Sensed",
]

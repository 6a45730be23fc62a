"""Online adaptation: what a controller senses and what it makes of it. Knows nothing of scenarios."""

from jaxbiped.adapt.controller import Controller, ControllerState
from jaxbiped.adapt.landing import Landing, LandingStage, LandingState
from jaxbiped.adapt.reflex import PayloadReflex, PayloadStage, PayloadState
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.adapt.stage import STAGES, Outcome, PlannedStage, Signals, Stage, register

__all__ = [
    "STAGES",
    "Controller",
    "ControllerState",
    "Landing",
    "LandingStage",
    "LandingState",
    "Outcome",
    "PayloadReflex",
    "PayloadStage",
    "PayloadState",
    "PlannedStage",
    "Sensed",
    "Signals",
    "Stage",
    "register",
]

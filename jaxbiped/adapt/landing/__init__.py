"""Landing on ground of unknown height, a stage: parameters, state, poses, and the stage itself."""

from jaxbiped.adapt.landing.parameters import Landing
from jaxbiped.adapt.landing.poses import descent, longest_set_down
from jaxbiped.adapt.landing.stage import SMALLEST_T_MOD, LandingStage, nominal_T_mod
from jaxbiped.adapt.landing.state import LandingState

__all__ = [
    "SMALLEST_T_MOD",
    "Landing",
    "LandingStage",
    "LandingState",
    "descent",
    "longest_set_down",
    "nominal_T_mod",
]

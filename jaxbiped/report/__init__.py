"""Figures of plans and of simulated walks. Runs no simulation; needs matplotlib (`pip install 'jaxbiped[viz]'`)."""

from jaxbiped.report.figures import (
    feasibility_page,
    feet,
    feet_in_body,
    pelvis,
    save,
    zmp,
)
from jaxbiped.report.walks import measured_zmp, modifications, tilt_and_forces

__all__ = [
    "feasibility_page",
    "feet",
    "feet_in_body",
    "measured_zmp",
    "modifications",
    "pelvis",
    "save",
    "tilt_and_forces",
    "zmp",
]

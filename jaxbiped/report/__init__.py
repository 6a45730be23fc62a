"""Figures of plans and of simulated walks. Runs no simulation; needs matplotlib (`pip install 'jaxbiped[viz]'`)."""

from jaxbiped.report.figures import (
    feasibility_page,
    feet,
    feet_in_body,
    pelvis,
    save,
    zmp,
)
from jaxbiped.report.reflexes import (
    force_and_trigger,
    payload_events,
    pitch,
    references,
    reflex_close_ups,
    settling_zmp,
)
from jaxbiped.report.traces import Commanded, Felt, commanded, felt, measured_task, nominal, thin
from jaxbiped.report.walks import measured_zmp, modifications, tilt_and_forces

__all__ = [
    "Commanded",
    "Felt",
    "commanded",
    "feasibility_page",
    "feet",
    "feet_in_body",
    "felt",
    "force_and_trigger",
    "measured_task",
    "measured_zmp",
    "modifications",
    "nominal",
    "payload_events",
    "pelvis",
    "pitch",
    "references",
    "reflex_close_ups",
    "save",
    "settling_zmp",
    "thin",
    "tilt_and_forces",
    "zmp",
]

"""Figures, tables and pages of plans and of simulated walks. Runs no simulation.

What draws needs matplotlib, and a page jinja2 too (`pip install 'jaxbiped[viz]'`): they are imported when they are
first asked for; `tables`, `quantities` and `traces` do without.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxbiped.report.figures import feasibility_page, feet, feet_in_body, pelvis, save, zmp
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

_PLACES = {
    "figures": ("feasibility_page", "feet", "feet_in_body", "pelvis", "save", "zmp"),
    "reflexes": (
        "force_and_trigger",
        "payload_events",
        "pitch",
        "references",
        "reflex_close_ups",
        "settling_zmp",
    ),
    "traces": ("Commanded", "Felt", "commanded", "felt", "measured_task", "nominal", "thin"),
    "walks": ("measured_zmp", "modifications", "tilt_and_forces"),
}
_PLACE = {name: place for place, names in _PLACES.items() for name in names}

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


def __getattr__(name: str) -> object:
    """A figure, from its module."""
    if name not in _PLACE:
        raise AttributeError(f"module 'jaxbiped.report' has no attribute '{name}'")
    return getattr(importlib.import_module(f"jaxbiped.report.{_PLACE[name]}"), name)

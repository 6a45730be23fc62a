"""The commands of `jaxbiped`, one module each: a record of its arguments, and `run`, which prints and returns."""

from jaxbiped.commands import demo, doctor, export, obstacles, payload, replay, report_page, walk
from jaxbiped.commands.batches import WorkersLost
from jaxbiped.commands.common import InputError

__all__ = [
    "InputError",
    "WorkersLost",
    "demo",
    "doctor",
    "export",
    "obstacles",
    "payload",
    "replay",
    "report_page",
    "walk",
]

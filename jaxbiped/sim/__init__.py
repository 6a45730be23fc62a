"""Simulator: the only room that imports MuJoCo."""

from jaxbiped.sim.model import build_model, build_spec, mjcf, write_mjcf
from jaxbiped.sim.options import Options, own_friction, own_options
from jaxbiped.sim.scenario import Scenario, require_clear_start, require_swing_clears, swing_height, with_room
from jaxbiped.sim.simulation import Simulation, prepare, rectangles_of, rollout
from jaxbiped.sim.statistics import STATUS_TEXT, Statistics
from jaxbiped.sim.tick import Sample, State, Walk

__all__ = [
    "STATUS_TEXT",
    "Options",
    "Sample",
    "Scenario",
    "Simulation",
    "State",
    "Statistics",
    "Walk",
    "build_model",
    "build_spec",
    "mjcf",
    "own_friction",
    "own_options",
    "prepare",
    "rectangles_of",
    "require_clear_start",
    "require_swing_clears",
    "rollout",
    "swing_height",
    "with_room",
    "write_mjcf",
]

"""Simulator: the only room that imports MuJoCo."""

from jaxbiped.sim.model import build_model, build_spec, mjcf, write_mjcf
from jaxbiped.sim.replay_c import open_loop_references, replay_c
from jaxbiped.sim.rollout import Options, Sample, Walk, rollout, simulate
from jaxbiped.sim.scenario import Scenario, require_clear_start, require_swing_clears, swing_height
from jaxbiped.sim.statistics import STATUS_TEXT, Statistics

__all__ = [
    "STATUS_TEXT",
    "Options",
    "Sample",
    "Scenario",
    "Statistics",
    "Walk",
    "build_model",
    "build_spec",
    "mjcf",
    "open_loop_references",
    "replay_c",
    "require_clear_start",
    "require_swing_clears",
    "rollout",
    "simulate",
    "swing_height",
    "write_mjcf",
]

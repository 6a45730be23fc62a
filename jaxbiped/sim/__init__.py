"""Simulator: the only room that imports MuJoCo."""

from jaxbiped.sim.model import build_model, build_spec, write_mjcf
from jaxbiped.sim.rollout import Options, Walk, rollout
from jaxbiped.sim.scenario import Scenario

__all__ = ["Options", "Scenario", "Walk", "build_model", "build_spec", "rollout", "write_mjcf"]

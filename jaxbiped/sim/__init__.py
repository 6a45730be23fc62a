"""Simulator: the only room that imports MuJoCo."""

from jaxbiped.sim.model import build_model, build_spec, write_mjcf

__all__ = ["build_model", "build_spec", "write_mjcf"]

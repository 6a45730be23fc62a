"""Gradients a person can trust, and what they buy."""

from jaxbiped.tune.gradient import Gradient, Problem, central, forward, smoothed, value_and_grad

__all__ = ["Gradient", "Problem", "central", "forward", "smoothed", "value_and_grad"]

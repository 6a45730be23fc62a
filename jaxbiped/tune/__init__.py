"""Gradients a person can trust, and what they buy: trust reports, and tuning of the few numbers of an arm."""

from jaxbiped.tune.arm_file import arm_file
from jaxbiped.tune.descent import Settings, Tuned, tune
from jaxbiped.tune.gradient import Gradient, Problem, central, forward, outcomes, smoothed, value_and_grad
from jaxbiped.tune.trust import Trust
from jaxbiped.tune.trust import report as trust_report

__all__ = [
    "Gradient",
    "Problem",
    "Settings",
    "Trust",
    "Tuned",
    "arm_file",
    "central",
    "forward",
    "outcomes",
    "smoothed",
    "trust_report",
    "tune",
    "value_and_grad",
]

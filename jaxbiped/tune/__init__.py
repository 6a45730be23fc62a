"""Gradients a person can trust, and what they buy: trust reports, and tuning of the few numbers of a variant."""

from jaxbiped.tune.descent import Settings, Tuned, tune
from jaxbiped.tune.gradient import Gradient, Problem, central, forward, outcomes, smoothed, value_and_grad
from jaxbiped.tune.trust import Trust
from jaxbiped.tune.trust import report as trust_report
from jaxbiped.tune.variant_file import variant_file

__all__ = [
    "Gradient",
    "Problem",
    "Settings",
    "Trust",
    "Tuned",
    "central",
    "forward",
    "outcomes",
    "smoothed",
    "trust_report",
    "tune",
    "value_and_grad",
    "variant_file",
]

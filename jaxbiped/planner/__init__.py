"""Planner: both papers' gaits as functions of time, and what they take of a robot, whatever the scenario."""

from jaxbiped.planner import polynomial, support
from jaxbiped.planner.checks import GaitError, is_concrete
from jaxbiped.planner.constraints import FRICTION, MIN_KNEE, Violation, violations
from jaxbiped.planner.cosine_gait import CosineGait, CosineParams
from jaxbiped.planner.feasibility import Feasibility, feasibility, sample_times, targets_at
from jaxbiped.planner.gait import GAITS, Gait, own_gait, own_gait_name, register
from jaxbiped.planner.polynomial_gait import PolynomialGait, PolynomialParams, StartStop
from jaxbiped.planner.presets import known_infeasible
from jaxbiped.planner.targets import (
    DOUBLE_SUPPORT,
    PLANNED_STEP,
    RECOVERY_STEP,
    REFLEX_STEP,
    SINGLE_SUPPORT,
    Phase,
    Plan,
    Targets,
    TaskSpace,
    Timing,
    at,
)

__all__ = [
    "DOUBLE_SUPPORT",
    "FRICTION",
    "GAITS",
    "MIN_KNEE",
    "PLANNED_STEP",
    "RECOVERY_STEP",
    "REFLEX_STEP",
    "SINGLE_SUPPORT",
    "CosineGait",
    "CosineParams",
    "Feasibility",
    "Gait",
    "GaitError",
    "Phase",
    "Plan",
    "PolynomialGait",
    "PolynomialParams",
    "StartStop",
    "Targets",
    "TaskSpace",
    "Timing",
    "Violation",
    "at",
    "feasibility",
    "is_concrete",
    "known_infeasible",
    "own_gait",
    "own_gait_name",
    "polynomial",
    "register",
    "sample_times",
    "support",
    "targets_at",
    "violations",
]

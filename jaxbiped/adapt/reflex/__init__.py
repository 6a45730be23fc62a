"""The payload reflex, a stage: parameters, what it reads off the plan, trigger, modes, poses, targets."""

from jaxbiped.adapt.reflex.parameters import PayloadReflex, planned_ripple, resume_plan_times, standing_zmp
from jaxbiped.adapt.reflex.planned import PayloadState
from jaxbiped.adapt.reflex.stage import PayloadStage

__all__ = [
    "PayloadReflex",
    "PayloadStage",
    "PayloadState",
    "planned_ripple",
    "resume_plan_times",
    "standing_zmp",
]

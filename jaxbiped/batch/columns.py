"""Every column of a results table that is not an input: what it says, with the unit in its name.

Inputs are declared in `inputs`. A column that is declared nowhere is an error, never an input.
"""

from collections.abc import Collection, Iterable, Mapping

from jaxbiped.adapt import Controller, Landing, Outcome, PayloadReflex

IDENTITY = {
    "row": "number of the walk in the table",
    "variant": "name of the controller",
    "scenario": "number of the scenario; every controller meets the same ones",
}
"""Columns that number or name a walk."""

_EACH_FOOT = {
    "peak_force_{}_N": "largest vertical force on the foot",
    "touchdown_force_{}_N": "largest vertical force on the foot just after it was loaded",
    "touchdown_impulse_{}_Ns": "largest integral of that force over one touchdown",
    "slip_{}_m": "largest horizontal distance of the foot from where it was loaded last",
}

OUTCOMES: dict[str, Outcome] = {
    "status": Outcome(
        "what the robot did over the whole walk: ok, fell, nonfinite, airborne, or unfinished", str
    ),
    "success": Outcome("whether the rule of the paper was met, whatever came later", bool),
    "finished": Outcome("whether the planned walk was finished", bool),
    "end_time_s": Outcome("time of the first failure, or the time reached"),
    **PayloadReflex.outcomes,
    "peak_roll_deg": Outcome("largest roll of the trunk"),
    "peak_pitch_deg": Outcome("largest pitch of the trunk"),
    **{name.format(side): Outcome(text) for name, text in _EACH_FOOT.items() for side in ("left", "right")},
    "zmp_margin_m": Outcome("smallest distance of the center of pressure from the edge of the support"),
    "reach_margin_m": Outcome("smallest remaining leg extension; negative beyond it"),
    "out_of_reach_s": Outcome("for how long the targets were beyond the legs' reach or joint ranges"),
    **Landing.outcomes,
    "x_m": Outcome("where the pelvis ended, forward"),
    "y_m": Outcome("where the pelvis ended, to the left"),
}
"""Columns of what came of a walk, in every table."""
ALWAYS = (*PayloadReflex.outcomes, *Landing.outcomes)
"""Outcome columns of stages that every table has, whether or not a controller has the stage."""


FAILED = ("fell", "nonfinite", "airborne")
"""Values of the status of a robot that came to grief, whatever the rule says of it."""


def outcomes(controllers: Iterable[Controller]) -> Mapping[str, Outcome]:
    """The columns of what came of walks with these controllers: those of every table, and of their own stages."""
    stages = [stage.params for controller in controllers for stage in controller.stages]
    return {**OUTCOMES, **{name: column for stage in stages for name, column in stage.outcomes.items()}}


def require_declared(names: Collection[str], declared: Collection[str]) -> None:
    """Check that the columns of an outcome are the declared ones, in any order.

    Raises:
        ValueError: naming those that are not.
    """
    odd = [name for name in names if name not in declared]
    lacking = [name for name in declared if name not in names]
    if odd or lacking:
        what = f"undeclared {', '.join(odd)}" if odd else f"no {', '.join(lacking)}"
        raise ValueError(f"outcome: got {what}, allowed: the columns of batch.columns and of the stages")

"""Every column of a results table that is not an input: what it says, with the unit in its name.

Inputs are declared in `inputs`. A column that is declared nowhere is an error, never an input.
"""

from collections.abc import Collection

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

OUTCOMES = {
    "status": "what the robot did over the whole walk: ok, fell, nonfinite, airborne, or unfinished",
    "success": "whether the rule of the paper was met, whatever came later",
    "finished": "whether the planned walk was finished",
    "end_time_s": "time of the first failure, or the time reached",
    "reflexes": "how many payload reflexes there were",
    "trigger_s": "when the last one began; missing if there was none",
    "peak_roll_deg": "largest roll of the trunk",
    "peak_pitch_deg": "largest pitch of the trunk",
    **{name.format(side): what for name, what in _EACH_FOOT.items() for side in ("left", "right")},
    "zmp_margin_m": "smallest distance of the center of pressure from the edge of the support",
    "reach_margin_m": "smallest remaining leg extension; negative beyond it",
    "out_of_reach_s": "for how long the targets were beyond the legs' reach or joint ranges",
    "missed": "steps that ended without a touchdown, with landing adaptation",
    "x_m": "where the pelvis ended, forward",
    "y_m": "where the pelvis ended, to the left",
}
"""Columns of what came of a walk."""


FAILED = ("fell", "nonfinite", "airborne")
"""Values of the status of a robot that came to grief, whatever the rule says of it."""


def require_declared(names: Collection[str]) -> None:
    """Check that the columns of an outcome are the declared ones, in any order.

    Raises:
        ValueError: naming those that are not.
    """
    odd = [name for name in names if name not in OUTCOMES]
    lacking = [name for name in OUTCOMES if name not in names]
    if odd or lacking:
        what = f"undeclared {', '.join(odd)}" if odd else f"no {', '.join(lacking)}"
        raise ValueError(f"outcome: got {what}, allowed: the columns of batch.columns.OUTCOMES")

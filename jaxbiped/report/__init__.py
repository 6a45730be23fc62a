"""Reports: figures of plans. Runs no simulation; needs matplotlib (`pip install 'jaxbiped[viz]'`)."""

from jaxbiped.report.figures import (
    feasibility_page,
    feet,
    feet_in_body,
    pelvis,
    save,
    zmp,
)

__all__ = ["feasibility_page", "feet", "feet_in_body", "pelvis", "save", "zmp"]

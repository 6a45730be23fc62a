"""jaxbiped: a pure-JAX, differentiable, vectorized simulator and batch tester for biped walking adaptation.

Data flows one way through the rooms: runtime | robot -> kinematics -> planner -> adapt -> sim -> score -> batch ->
tune, report -> commands, cli.
See docs/conventions.md for frames, signs and units.
"""

from jaxbiped._versions import check_installed

check_installed()

from jaxbiped import runtime  # noqa: E402  (before JAX is imported)

__version__ = "0.1.0"

from jaxbiped import adapt, batch, kinematics, planner, robot, score, sim, tune  # noqa: E402  (after the check, on purpose)

__all__ = [
    "__version__",
    "adapt",
    "batch",
    "kinematics",
    "planner",
    "robot",
    "runtime",
    "score",
    "sim",
    "tune",
]

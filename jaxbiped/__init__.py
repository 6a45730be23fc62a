"""jaxbiped: a pure-JAX, differentiable, vectorised simulator and batch tester for biped walking adaptation.

Data flows one way through the rooms: robot -> kinematics -> planner -> adapt -> sim -> score -> report, commands, cli.
See docs/conventions.md for frames, signs and units.
"""

from jaxbiped._versions import check_installed

check_installed()

from jaxbiped import adapt, kinematics, planner, robot, score, sim  # noqa: E402  (after the version check, on purpose)

__version__ = "0.1.0"
__all__ = ["__version__", "adapt", "kinematics", "planner", "robot", "score", "sim"]

"""Meaning of names on the command line: gaits, simulations, variants of adaptation."""

from pathlib import Path

import equinox as eqx

from jaxbiped import adapt, planner, robot
from jaxbiped.adapt import variants
from jaxbiped.adapt.variants import OFF
from jaxbiped.batch import defaults
from jaxbiped.checked import Refusal
from jaxbiped.commands.batches import naming_arguments
from jaxbiped.commands.common import InputError

GAIT_NAMES = "|".join(sorted(planner.GAITS))
PAPER, ORIGINAL, MODIFIED, REPAIRED = "paper", "original", "modified", "repaired"
LANDINGS, REFLEXES = (OFF, *adapt.Landing.variants), (OFF, *adapt.PayloadReflex.variants)
ALLOW_HELP = (
    "Simulate a plan, too, whose ZMP leaves the support polygon or that takes more torque, speed, friction or leg than "
    "there is. Without it such a plan is refused, unless it is a preset that is known to be one."
)


def gait_name(given: str | None, params: robot.RobotParams) -> str:
    """The gait that was asked for, else that of the robot's own paper."""
    with naming_arguments():
        return defaults.own_kind(params) if given is None else given


def make_gait(
    params: robot.RobotParams, name: str, steps: int, allow_infeasible: bool = False
) -> planner.Gait:
    """The preset gait of a robot; refused if it breaks a constraint, unless it is known to or that is allowed."""
    with naming_arguments():
        return defaults.plan(params, name, steps, allow_infeasible=allow_infeasible)


def broken(params: robot.RobotParams, gait: planner.Gait) -> list[str]:
    """Say which constraints a plan breaks; a line for each, with the reason where a preset is known to break one."""
    lines = [violation.words(params, gait) for violation in planner.violations(params, gait)]
    known = planner.known_infeasible(type(gait), params)
    if lines and known and eqx.tree_equal(gait.params, gait.preset_params(params)):
        lines[-1] += f"; known of this preset: {known}"
    return lines


def variant_tables(argument: str, path: Path) -> variants.Tables:
    """The tables of the file of a variant, see `adapt.variants`; `argument` is what to name in a refusal.

    Raises:
        InputError: if the file cannot be read, lacks what it must have, or has what it must not have.
    """
    try:
        return variants.read_tables(path)
    except Refusal as error:
        raise InputError(f"{argument}: {error}") from None


def load_variant(
    argument: str, path: Path, params: robot.RobotParams, gait: planner.Gait, allow_infeasible: bool = False
) -> adapt.Controller:
    """A controller from the TOML file of a variant, see `adapt.variants`; `argument` is what to name in a refusal.

    Raises:
        InputError: if the file cannot be read or says what cannot be meant.
    """
    try:
        return variants.load(path, params, gait, allow_infeasible)
    except Refusal as error:
        raise InputError(f"{argument}: {error}") from None

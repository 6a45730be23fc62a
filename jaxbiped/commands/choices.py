"""What names on the command line stand for: gaits, simulations, variants of adaptation."""

from pathlib import Path
from typing import Any

import equinox as eqx

from jaxbiped import adapt, checked, planner, robot
from jaxbiped.adapt import parameters, tunables
from jaxbiped.checked import Quantity, Refusal, Word
from jaxbiped.commands.common import InputError
from jaxbiped.planner.constraints import OR_ALLOW

GAIT_NAMES = "|".join(sorted(planner.GAITS))
MOST_STEPS = 200
OFF, PAPER, ORIGINAL, MODIFIED, REPAIRED = "off", "paper", "original", "modified", "repaired"
LANDINGS, REFLEXES = (OFF, *adapt.Landing.variants), (OFF, *adapt.PayloadReflex.variants)
ALLOW_KEY, ALLOW = "allow_infeasible", checked.Flag("the plan may break a constraint of khadiv section 2.2")
ALLOW_HELP = (
    "Simulate a plan, too, whose ZMP leaves the support polygon or that takes more torque, speed, friction or leg than "
    "there is. Without it such a plan is refused, unless it is a preset that is known to be one."
)


def stage_fields() -> dict[str, dict[str, checked.Field]]:
    """What the tables of the stages in the file of a variant may hold."""
    return {
        name: {"base": Word((OFF, *stage.variants)), **parameters.declared(stage)}
        for name, stage in adapt.STAGES.items()
    }


def gait_name(given: str | None, params: robot.RobotParams) -> str:
    """The gait that was asked for, else that of the robot's own paper."""
    try:
        return planner.own_gait_name(params) if given is None else given
    except planner.GaitError as error:
        raise InputError(f"--robot, --gait: {error}") from None


def make_gait(
    params: robot.RobotParams, name: str, steps: int, allow_infeasible: bool = False
) -> planner.Gait:
    """The preset gait of a robot; refused if it breaks a constraint, unless it is known to or that is allowed."""
    gaits = planner.GAITS
    if name not in gaits:
        raise InputError(f"--gait: got '{name}', allowed: {', '.join(gaits)}{checked.nearest(name, gaits)}")
    if not 1 <= steps <= MOST_STEPS:
        raise InputError(f"--steps: got {steps}, allowed: 1 to {MOST_STEPS}")
    try:
        return gaits[name].preset(params, steps, allow_infeasible=allow_infeasible)
    except planner.GaitError as error:
        raise InputError(f"--robot, --gait: {_as_flag(error)}") from None


def broken(params: robot.RobotParams, gait: planner.Gait) -> list[str]:
    """Say which constraints a plan breaks; a line for each, with the reason where a preset is known to break one."""
    lines = [violation.words(params, gait) for violation in planner.violations(params, gait)]
    known = planner.known_infeasible(type(gait), params)
    if lines and known and eqx.tree_equal(gait.params, gait.preset_params(params)):
        lines[-1] += f"; known of this preset: {known}"
    return lines


def _as_flag(error: Exception) -> str:
    """A refusal in the words of the command line."""
    return str(error).replace(OR_ALLOW, "; or say --allow-infeasible")


def stage_of(
    name: str, variant: str, params: robot.RobotParams, gait: Any, **given: Any
) -> adapt.Stage | None:
    """Parameters of a stage by its name and that of its variant; None if it is off."""
    return None if variant == OFF else adapt.STAGES[name].named(variant, params, gait, **given)


def variant_tables(argument: str, path: Path) -> dict[str, dict[str, Any]]:
    """The tables of stages ([landing], [payload]) and [gait] of the TOML file of a variant, those that it has.

    That of a stage has `base`, the name of a variant, and any of the parameters of that stage; [gait] has those of the
    gait, those of its start and stop as `start_stop.x_s_first`, and `allow_infeasible = true` if its plan may break
    a constraint. The table [origin], where the numbers came from, may hold anything and is not read.

    Args:
        argument: what to name in a refusal.
        path: of the file.

    Raises:
        InputError: if the file cannot be read, lacks what it must have, or has what it must not have.
    """
    try:
        data = checked.read_toml(path)
        stages = stage_fields()
        checked.refuse_unknown("", data, (*stages, "gait", "origin"))
        if not isinstance(data.get("origin", {}), dict):
            raise Refusal(f"origin: got {checked.shown(data['origin'])}, allowed: a table [origin]")
        tables = {
            name: checked.read_table(name, data[name], fields, ("base",))
            for name, fields in stages.items()
            if name in data
        }
        for name, table in tables.items():
            if table["base"] == OFF and len(table) > 1:
                others = ", ".join(key for key in table if key != "base")
                raise Refusal(
                    f"{name}: got {others} with base = '{OFF}', allowed: nothing else with that base"
                )
        if "gait" in data:
            tables["gait"] = _gait_table(data["gait"])
        if not tables:
            known = ", ".join(f"[{name}]" for name in stages)
            raise Refusal(f"got no table, allowed: a file with a table {known} or [gait]")
    except Refusal as error:
        raise InputError(f"{argument}: '{path}': {str(error).removeprefix(f'{path.name}: ')}") from None
    return tables


def load_variant(
    argument: str, path: Path, params: robot.RobotParams, gait: Any, allow_infeasible: bool = False
) -> adapt.Controller:
    """A controller from the TOML file of a variant; stages that have no table are off.

    Args:
        argument: what to name in a refusal.
        path: of the file.
        params: the robot.
        gait: its gait, unless the file changes it.
        allow_infeasible: whether the file's gait may break a constraint though the file does not say so.

    Raises:
        InputError: if the file cannot be read or says what cannot be meant.
    """
    tables = variant_tables(argument, path)
    try:
        gait = _other_gait(tables.get("gait", {}), params, gait, allow_infeasible)
        stages = [
            stage_of(name, table.pop("base"), params, gait, **table)
            for name, table in tables.items()
            if name != "gait"
        ]
        return adapt.Controller(gait, *stages)
    except (TypeError, ValueError) as error:
        words = str(error).replace(OR_ALLOW, f"{OR_ALLOW.replace('=True', ' = true')} in [gait]")
        raise InputError(f"{argument}: '{path}': {words}") from None


def _gait_table(table: Any) -> dict[str, Any]:
    """The values of a table [gait] by dotted names; which names and ranges there are is up to the gait."""
    if not isinstance(table, dict):
        raise Refusal(f"gait: got {checked.shown(table)}, allowed: a table [gait]")
    flat: dict[str, Any] = {}
    for name, value in table.items():
        flat |= (
            {f"{name}.{key}": item for key, item in value.items()}
            if isinstance(value, dict)
            else {name: value}
        )
    fields = {name: ALLOW if name == ALLOW_KEY else Quantity() for name in flat}
    return {name: fields[name].check(f"gait.{name[:80]}", value) for name, value in flat.items()}


def _other_gait(table: dict[str, Any], params: robot.RobotParams, gait: Any, allow_infeasible: bool) -> Any:
    """The gait with the values of a table [gait]."""
    known = type(gait).quantities
    fields: dict[str, checked.Field] = {
        name: known.get(name, Quantity()) for name in tunables.gait_fields(gait)
    }
    new = checked.read_table("gait", table, {**fields, ALLOW_KEY: ALLOW})
    allow_infeasible = new.pop(ALLOW_KEY, False) or allow_infeasible
    return tunables.other_gait(params, gait, new, allow_infeasible=allow_infeasible)

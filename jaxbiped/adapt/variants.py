"""Files of variants: a controller as the tables of its stages and of its gait, read, checked and written.

The table of a stage ([landing], [payload]) has `base`, the name of a variant, and any of the parameters of that stage;
[gait] has those of the gait, those of its start and stop as `start_stop.x_s_first`, and `allow_infeasible = true` if
its plan may break a constraint. The table [origin], where the numbers came from, may hold anything and is not read.
"""

from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike

from jaxbiped import checked
from jaxbiped.adapt import parameters, tunables
from jaxbiped.adapt.controller import Controller
from jaxbiped.adapt.stage import STAGES, Stage
from jaxbiped.checked import Field, Flag, Quantity, Refusal, Word
from jaxbiped.planner import Gait
from jaxbiped.planner.constraints import OR_ALLOW
from jaxbiped.robot import RobotParams

OFF = "off"
"""Base of a stage that is off."""
GAIT, ORIGIN = "gait", "origin"
ALLOW_KEY, ALLOW = "allow_infeasible", Flag("the plan may break a constraint of khadiv section 2.2")
Tables = dict[str, dict[str, Any]]
"""Tables of a file, by their names."""


def load(path: Path, robot: RobotParams, gait: Gait, allow_infeasible: bool = False) -> Controller:
    """A controller from the file of a variant; stages that have no table are off.

    Args:
        path: of the file.
        robot: that walks.
        gait: its gait, unless the file changes it.
        allow_infeasible: whether the file's gait may break a constraint though the file does not say so.

    Raises:
        Refusal: naming the file, if it cannot be read or says what cannot be meant.
    """
    tables = read_tables(path)
    try:
        return controller(tables, robot, gait, allow_infeasible)
    except Refusal as error:
        raise Refusal(f"'{path}': {error}") from None


def read_tables(path: Path) -> Tables:
    """The tables of the file of a variant, those that it has.

    Raises:
        Refusal: naming the file, if it cannot be read, lacks what it must have, or has what it must not have.
    """
    try:
        tables = check_tables(checked.read_toml(path))
        if not tables:
            known = ", ".join(f"[{name}]" for name in STAGES)
            raise Refusal(f"got no table, allowed: a file with a table {known} or [{GAIT}]")
    except Refusal as error:
        raise Refusal(f"'{path}': {str(error).removeprefix(f'{path.name}: ')}") from None
    return tables


def check_tables(data: Mapping[str, Any], where: str = "") -> Tables:
    """Check the tables of a variant as they stand in a file; [origin] is left out.

    Args:
        data: what the file says.
        where: what stands before the names of its tables, such as `variants.tuned.`.

    Raises:
        Refusal: naming the key, what was got and what is allowed.
    """
    stages = stage_fields()
    checked.refuse_unknown(where, data, (*stages, GAIT, ORIGIN))
    if not isinstance(data.get(ORIGIN, {}), dict):
        raise Refusal(
            f"{where}{ORIGIN}: got {checked.shown(data[ORIGIN])}, allowed: a table [{where}{ORIGIN}]"
        )
    tables = {
        name: checked.read_table(f"{where}{name}", data[name], fields, ("base",))
        for name, fields in stages.items()
        if name in data
    }
    for name, table in tables.items():
        if table["base"] == OFF and len(table) > 1:
            others = ", ".join(key for key in table if key != "base")
            raise Refusal(
                f"{where}{name}: got {others} with base = '{OFF}', allowed: nothing else with that base"
            )
    if GAIT in data:
        tables[GAIT] = _gait_table(data[GAIT], f"{where}{GAIT}")
    return tables


def controller(tables: Tables, robot: RobotParams, gait: Gait, allow_infeasible: bool = False) -> Controller:
    """The controller that checked tables describe; stages that have no table are off.

    Raises:
        Refusal: if they say what cannot be meant, or a gait that cannot be walked.
    """
    try:
        gait = _other_gait(tables.get(GAIT, {}), robot, gait, allow_infeasible)
        stages = [
            stage_of(name, table["base"], robot, gait, **{key: table[key] for key in table if key != "base"})
            for name, table in tables.items()
            if name != GAIT
        ]
        return Controller(gait, *stages)
    except (TypeError, ValueError) as error:
        words = str(error).replace(OR_ALLOW, f"{OR_ALLOW.replace('=True', ' = true')} in [{GAIT}]")
        raise Refusal(words) from None


def stage_of(name: str, variant: str, robot: RobotParams, gait: Gait, **given: object) -> Stage | None:
    """Parameters of a stage by its name and that of its variant, some of them changed; None if it is off."""
    return None if variant == OFF else STAGES[name].named(variant, robot, gait, **given)


def stage_fields() -> dict[str, dict[str, Field]]:
    """Fields that the tables of the stages may hold in the file of a variant."""
    return {
        name: {"base": Word((OFF, *stage.variants)), **parameters.declared(stage)}
        for name, stage in STAGES.items()
    }


def tables_of(controller: Controller, robot: RobotParams, gait: Gait, name: str = "") -> Tables:
    """The tables that make a controller again, with every parameter in them.

    Args:
        controller: to be described.
        robot: that walks.
        gait: which the tables say nothing of, if it is the controller's; else [gait] has all its numbers.
        name: of the variant, the first choice for the base of its stages.

    Raises:
        Refusal: if no file can say what the controller is: a stage that is not registered, a gait of another kind.
    """
    tables = {
        stage.name: _stage_table(stage.params, robot, controller.gait, name) for stage in controller.stages
    }
    if not same(controller.gait, gait):
        tables[GAIT] = {**gait_numbers(controller.gait), ALLOW_KEY: True}
        again = _other_gait(dict(tables[GAIT]), robot, gait, True)
        if not same(again, controller.gait):
            raise Refusal("its gait is not the experiment's with other parameters")
    return tables


def gait_numbers(gait: Gait) -> dict[str, float]:
    """The parameters of a gait by their dotted names."""
    return numbers_of(gait.params)


def numbers_of(record: eqx.Module) -> dict[str, float]:
    """The numbers of a record, and of records in it, by their dotted names."""
    return {name: plain(attrgetter(name)(record)) for name in tunables.numbers_in(record)}


def same(one: object, other: object) -> bool:
    """Tell whether two records are of one kind and hold the same numbers."""
    return type(one) is type(other) and bool(eqx.tree_equal(one, other))


def plain(value: ArrayLike) -> Any:  # noqa: ANN401
    """A number, or a table of them, by the shortest decimals that give it back in its own precision."""
    array = np.asarray(value)
    if array.ndim:
        return [plain(item) for item in array]
    return float(str(array[()])) if array.dtype.kind == "f" else array.item()


def flat(table: Mapping[str, Any]) -> dict[str, Any]:
    """A table by dotted names: `start_stop.x_s_first` of a table in it."""
    found: dict[str, Any] = {}
    for name, value in table.items():
        inner = isinstance(value, dict)
        found |= {f"{name}.{key}": item for key, item in value.items()} if inner else {name: value}
    return found


def nested(table: Mapping[str, Any]) -> dict[str, Any]:
    """Undo `flat`."""
    found: dict[str, Any] = {}
    for name, value in table.items():
        outer, dot, inner = name.partition(".")
        if dot:
            found.setdefault(outer, {})[inner] = value
        else:
            found[name] = value
    return found


def _stage_table(params: Stage, robot: RobotParams, gait: Gait, variant: str) -> dict[str, Any]:
    """All parameters of a stage, and the nearest base that leaves those alone that are None."""
    known = type(params)
    if STAGES.get(params.name) is not known:
        raise Refusal(f"its stage '{params.name}' is not registered")
    values = {name: getattr(params, name) for name in parameters.declared(known)}
    given = {name: plain(value) for name, value in values.items() if value is not None}
    read = {name: values[name] for name in known.read_off_plan}

    def changed(base: str) -> tuple[int, bool]:
        own = known.named(base, robot, gait, **read)
        different = [name for name in values if not eqx.tree_equal(getattr(own, name), values[name])]
        return len(different), base != variant

    for base in sorted(known.variants, key=changed):
        if same(known.named(base, robot, gait, **given), params):
            return {"base": base, **given}
    raise Refusal(f"its stage '{params.name}' is none of {', '.join(known.variants)} with other parameters")


def _gait_table(table: object, name: str) -> dict[str, Any]:
    """The values of a table [gait] by dotted names; which names and ranges there are is up to the gait."""
    if not isinstance(table, dict):
        raise Refusal(f"{name}: got {checked.shown(table)}, allowed: a table [{name}]")
    values = flat(table)
    fields = {key: ALLOW if key == ALLOW_KEY else Quantity() for key in values}
    return {key: fields[key].check(f"{name}.{key[:80]}", value) for key, value in values.items()}


def _other_gait(table: Mapping[str, Any], robot: RobotParams, gait: Gait, allow_infeasible: bool) -> Gait:
    """The gait with the values of a table [gait]."""
    known = type(gait).quantities
    fields: dict[str, Field] = {name: known.get(name, Quantity()) for name in tunables.gait_fields(gait)}
    new = checked.read_table(GAIT, dict(table), {**fields, ALLOW_KEY: ALLOW})
    allow_infeasible = new.pop(ALLOW_KEY, False) or allow_infeasible
    return tunables.other_gait(robot, gait, new, allow_infeasible=allow_infeasible)

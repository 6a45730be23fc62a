"""Records to JSON and back: exact, readable, and able to say where two of them differ.

A record is an `equinox.Module` of this package, written under a name of its own that stays when the code is moved; its
fields are arrays, plain values, or records. Only these classes are ever made again, without calling anything.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator
from typing import Any, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbiped import adapt, planner, robot, sim
from jaxbiped.planner.polynomial import PiecewisePolynomial, Polynomial
from jaxbiped.planner.targets import Phase, as_count, room_for
from jaxbiped.sim import scenario

RECORDS: dict[str, type[eqx.Module]] = {
    "robot": robot.RobotParams,
    "links": robot.Links,
    "servo": robot.Servo,
    "polynomial": Polynomial,
    "piecewise_polynomial": PiecewisePolynomial,
    "phase": Phase,
    "controller": adapt.Controller,
    "options": sim.Options,
    "scenario": sim.Scenario,
    "terrain": scenario.Terrain,
    "payload": scenario.Payload,
    "push": scenario.Push,
    "ground": scenario.Ground,
    "model_errors": scenario.ModelErrors,
    "sensor_faults": scenario.SensorFaults,
}
"""Records by their names in files, but for those of gaits and stages; a name once written stays for good."""


def known() -> dict[str, type[eqx.Module]]:
    """All records by name: those of RECORDS, of every gait and of every stage."""
    return {**RECORDS, **_of_gaits(), **_of_stages()}


def _of_gaits() -> dict[str, type[Any]]:
    """Every gait, its parameters and the records in them."""
    found: dict[str, type[Any]] = {}
    for name, gait in planner.GAITS.items():
        inside = {f"{name}_gait_{key}": record for key, record in gait.records.items()}
        found |= {f"{name}_gait": gait, f"{name}_gait_parameters": gait.parameters, **inside}
    return found


def _of_stages() -> dict[str, type[eqx.Module]]:
    """Every stage, planned and its parameters."""
    stages = {stage.record or stage.name: stage for stage in adapt.STAGES.values()}
    planned = {name: stage.planned for name, stage in stages.items()}
    return {**planned, **{f"{name}_parameters": stage for name, stage in stages.items()}}


_BEFORE_0_2 = {
    "jaxbiped.robot.params:RobotParams": "robot",
    "jaxbiped.robot.params:Links": "links",
    "jaxbiped.robot.params:Servo": "servo",
    "jaxbiped.planner.polynomial_gait:PolynomialGait": "polynomial_gait",
    "jaxbiped.planner.polynomial_gait:PolynomialParams": "polynomial_gait_parameters",
    "jaxbiped.planner.polynomial_gait:StartStop": "polynomial_gait_start_stop",
    "jaxbiped.planner.cosine_gait:CosineGait": "cosine_gait",
    "jaxbiped.planner.cosine_gait:CosineParams": "cosine_gait_parameters",
    "jaxbiped.planner.polynomial:Polynomial": "polynomial",
    "jaxbiped.planner.polynomial:PiecewisePolynomial": "piecewise_polynomial",
    "jaxbiped.planner.targets:Phase": "phase",
    "jaxbiped.adapt.controller:Controller": "controller",
    "jaxbiped.adapt.landing:LandingStage": "landing",
    "jaxbiped.adapt.landing:Landing": "landing_parameters",
    "jaxbiped.adapt.payload:PayloadStage": "payload_reflex",
    "jaxbiped.adapt.payload:PayloadReflex": "payload_reflex_parameters",
    "jaxbiped.sim.rollout:Options": "options",
}
"""Names in the files of version 0.1, which were places in its code."""
_NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def to_json(value: object) -> Any:  # noqa: ANN401
    """Write a value as `json.dumps` takes it; `from_json` gives it back, bit for bit.

    Raises:
        TypeError: for a value that is no array, plain value or record of RECORDS.
    """
    match value:
        case None | bool() | int() | str():
            return value
        case float():
            return _number(value)
        case np.ndarray() | np.generic() | jax.Array():
            array = np.asarray(value)
            return {"dtype": str(array.dtype), "value": _nested(array.tolist())}
        case list():
            return [to_json(item) for item in value]
        case tuple():
            return {"tuple": [to_json(item) for item in value]}
        case dict():
            return {"dict": {str(key): to_json(item) for key, item in value.items()}}
        case eqx.Module() if (name := _name(type(value))) is not None:
            fields = {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
            return {"record": name, **fields}
    raise TypeError(
        f"record: got a {type(value).__name__}, allowed: arrays, plain values, and of records {', '.join(known())}"
    )


def from_json(data: object) -> Any:  # noqa: ANN401
    """The value that `to_json` was given; arrays are JAX's.

    Raises:
        ValueError: for a record of another package or version.
    """
    if isinstance(data, list):
        return [from_json(item) for item in data]
    if not isinstance(data, dict):
        return data
    if "float" in data:
        return _NOT_FINITE[data["float"]]
    if "dtype" in data:
        return jnp.asarray(np.asarray(_numbers(data["value"]), data["dtype"]))
    if "tuple" in data:
        return tuple(from_json(item) for item in data["tuple"])
    if "dict" in data:
        return {key: from_json(item) for key, item in data["dict"].items()}
    return _record(data)


def digest(data: object) -> str:
    """SHA-256 of a JSON value, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def differences(old: object, new: object, path: str = "") -> Iterator[str]:
    """Yield where two JSON values differ, as `path: old -> new`."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(k for k in new if k not in old)]:
            where = f"{path}.{key}" if path else key
            if key not in old or key not in new:
                yield f"{where}: {'missing' if key not in old else 'there'} -> " + (
                    "there" if key not in old else "missing"
                )
            else:
                yield from differences(old[key], new[key], where)
    elif _are_records(old) and _are_records(new) and len(old) == len(new):
        for i, (then, now) in enumerate(zip(old, new, strict=True)):
            yield from differences(then, now, f"{path}.{then.get('record', i)}")
    elif old != new:
        yield f"{path}: {_short(old)} -> {_short(new)}"


def _are_records(value: object) -> TypeGuard[list[dict[str, Any]]]:
    return isinstance(value, list) and all(isinstance(item, dict) for item in value)


def _record(data: dict[str, Any]) -> Any:  # noqa: ANN401
    name = data["record"]
    name = _BEFORE_0_2.get(name, name)
    every = known()
    if name not in every:
        raise ValueError(f"record: got '{name}', allowed: {', '.join(every)}")
    made = every[name]
    fields = {field.name: field for field in dataclasses.fields(made)}
    given = {key: from_json(value) for key, value in data.items() if key != "record"}
    if made is adapt.Controller and "stages" not in given:  # until format 2
        both = (given.pop("payload"), given.pop("landing"))
        given["stages"] = tuple(stage for stage in both if stage is not None)
    if "room" in fields and "room" not in given:  # until numbers of steps shared programs
        counts = {key: as_count(given[key]) for key in ("n_steps", "first_swing")}
        given |= {**counts, "room": room_for(int(given["n_steps"]))}
    # What a version had not yet, it has by default now.
    given = {
        **{key: _default(f) for key, f in fields.items() if f.default is not dataclasses.MISSING},
        **given,
    }
    if fields.keys() != given.keys():
        other = ", ".join(sorted(fields.keys() ^ given.keys()))
        raise ValueError(f"{name} was written by another version: not in both are {other}")
    record = object.__new__(made)
    for key in fields:
        object.__setattr__(record, key, given[key])
    return record


def _name(made: type) -> str | None:
    """Name of a record in files; None if it has none."""
    return next((name for name, record in known().items() if record is made), None)


def _default(field: dataclasses.Field) -> Any:  # noqa: ANN401
    convert = field.metadata.get("converter", lambda value: value)
    return convert(field.default)


def _number(value: float) -> float | dict[str, str]:
    return value if math.isfinite(value) else {"float": repr(value)}


def _nested(value: object) -> object:
    if isinstance(value, list):
        return [_nested(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _numbers(value: object) -> object:
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    return _NOT_FINITE[value] if isinstance(value, str) else value


def _short(value: object, most: int = 60) -> str:
    text = str(value["value"] if isinstance(value, dict) and "value" in value else value)
    return text if len(text) <= most else text[: most - 3] + "..."

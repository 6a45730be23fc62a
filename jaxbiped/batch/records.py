"""Records to JSON and back: exact, readable, and able to say where two of them differ.

A record is an `equinox.Module` of this package; its fields are arrays, plain values, or records. Only classes of this
package are ever made again, without calling anything.
"""

import dataclasses
import importlib
import math
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

PACKAGE = "jaxbiped."
_NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def to_json(value: Any) -> Any:
    """What `json.dumps` takes; `from_json` gives the value back, bit for bit.

    Raises:
        TypeError: for a value that is no array, plain value or record of this package.
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
        case eqx.Module() if type(value).__module__.startswith(PACKAGE):
            fields = {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
            return {"record": f"{type(value).__module__}:{type(value).__qualname__}", **fields}
    raise TypeError(
        f"record: got a {type(value).__name__}, allowed: arrays, plain values, records of jaxbiped"
    )


def from_json(data: Any) -> Any:
    """The value that `to_json` was given; arrays are JAX's.

    Raises:
        ValueError: for a record of another package.
    """
    if isinstance(data, list):
        return [from_json(item) for item in data]
    if isinstance(data, str):
        return data
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


def differences(old: Any, new: Any, path: str = "") -> Iterator[str]:
    """Where two JSON values differ, as `path: old -> new`."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(k for k in new if k not in old)]:
            where = f"{path}.{key}" if path else key
            if key not in old or key not in new:
                yield f"{where}: {'missing' if key not in old else 'there'} -> " + (
                    "there" if key not in old else "missing"
                )
            else:
                yield from differences(old[key], new[key], where)
    elif old != new:
        yield f"{path}: {_short(old)} -> {_short(new)}"


def _record(data: dict[str, Any]) -> Any:
    module, _, name = data["record"].partition(":")
    if not module.startswith(PACKAGE):
        raise ValueError(f"record: got '{data['record']}', allowed: records of jaxbiped")
    made: Any = importlib.import_module(module)
    for part in name.split("."):
        made = getattr(made, part)
    if not (isinstance(made, type) and issubclass(made, eqx.Module)):
        raise ValueError(f"record: got '{data['record']}', allowed: records of jaxbiped")
    names = {field.name for field in dataclasses.fields(made)}
    if names != set(data) - {"record"}:
        other = ", ".join(sorted(names ^ (set(data) - {"record"})))
        raise ValueError(f"{name} was written by another version: not in both are {other}")
    record = object.__new__(made)
    for field in dataclasses.fields(made):
        object.__setattr__(record, field.name, from_json(data[field.name]))
    return record


def _number(value: float) -> Any:
    return value if math.isfinite(value) else {"float": repr(value)}


def _nested(value: Any) -> Any:
    if isinstance(value, list):
        return [_nested(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _numbers(value: Any) -> Any:
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    return _NOT_FINITE[value] if isinstance(value, str) else value


def _short(value: Any, most: int = 60) -> str:
    text = str(value["value"] if isinstance(value, dict) and "value" in value else value)
    return text if len(text) <= most else text[: most - 3] + "..."

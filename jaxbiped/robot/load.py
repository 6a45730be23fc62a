"""Robot files: TOML in, `RobotParams` out, or an error that says which number is wrong."""

import tomllib
from collections.abc import Callable
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from jaxbiped.robot import inertia as rigid
from jaxbiped.robot.fields import Number, RobotFileError, Rule, read_number
from jaxbiped.robot.params import JOINT_NAMES, KNEE, LEG_LINK_NAMES, Links, RobotParams, Servo

_POINT = Rule("m", ((3,),))
_LENGTH = Rule("m", above=0.0)
_JOINTS = ((len(JOINT_NAMES),),)
LEAST_KNEE_RANGE = 0.1
"""Smallest upper knee limit with which a leg has any reach to speak of [rad]."""
_MIRRORED_JOINTS = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, -1.0])
"""How a joint angle of the left leg reads on the mirrored right leg: yaw and the rolls change sign."""

_SECTIONS: dict[str, dict[str, Rule]] = {
    "overall": {"mass": Rule("kg", above=0.0), "height": _LENGTH},
    "geometry": {
        "hip_yaw_axis": _POINT,
        "hip_roll_axis": _POINT,
        "hip_pitch_axis": _POINT,
        "thigh_length": _LENGTH,
        "shank_length": _LENGTH,
        "ankle_height": Rule("m", at_least=0.0),
        "sole_toe": Rule("m"),
        "sole_heel": Rule("m"),
        "sole_outer": Rule("m"),
        "sole_inner": Rule("m"),
    },
    "servo": {
        "kp": Rule("N m/rad", _JOINTS, above=0.0),
        "kv": Rule("N m s/rad", _JOINTS, at_least=0.0),
        "ki": Rule("N m/(rad s)", _JOINTS, at_least=0.0),
        "armature": Rule("kg m2", _JOINTS, at_least=0.0),
        "torque_limit": Rule("N m", _JOINTS, above=0.0),
        "speed_limit": Rule("rad/s", _JOINTS, above=0.0),
    },
    "limits": {"lower": Rule("rad", _JOINTS), "upper": Rule("rad", _JOINTS)},
}
_BODY = {
    "mass": Rule("kg", above=0.0),
    "com": _POINT,
    "box": Rule("m", ((3,),), above=0.0),
    "inertia": Rule("kg m2", ((3,), (6,))),
}

Numbers = dict[str, Number]
T = TypeVar("T")


def presets() -> tuple[str, ...]:
    """Names that `load` knows without a path."""
    folder = resources.files("jaxbiped.robot") / "presets"
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir()))


def load(name_or_path: str | Path) -> RobotParams:
    """Load a preset by name or a robot file by path.

    Raises:
        RobotFileError: naming the file, the field, what was got and what is allowed.
    """
    return _build_from(name_or_path, _build)


def numbers(name_or_path: str | Path) -> list[Number]:
    """List every number of a robot file with its unit and where it comes from.

    Raises:
        RobotFileError: as `load`, but for numbers that contradict each other.
    """
    return _build_from(name_or_path, lambda read: [n for n in read.values() if isinstance(n, Number)])


def _build_from(name_or_path: str | Path, build: Callable[[dict[str, Any]], T]) -> T:
    """Read the file and build something of its checked numbers; every error names the file."""
    file = _file(name_or_path)
    try:
        return build(_read_all(tomllib.loads(file.read_text(encoding="utf-8"))))
    except (RobotFileError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RobotFileError(f"{file.name}: {error}") from None


def _file(name_or_path: str | Path) -> Traversable:
    if str(name_or_path) in presets():
        return resources.files("jaxbiped.robot") / "presets" / f"{name_or_path}.toml"
    path = Path(name_or_path)
    if path.suffix != ".toml" or not path.is_file():
        raise RobotFileError(
            f"robot: got {str(name_or_path)!r}, allowed: {', '.join(presets())} or the path of a .toml file"
        )
    return path


def _read_all(document: dict[str, Any]) -> dict[str, Any]:
    """Check the whole document; returns its numbers by dotted field name, and `name`."""
    name = document.get("name")
    if not isinstance(name, str) or not name:
        raise RobotFileError(f"name: got {name!r}, wanted a text")
    trunk = _table(document, "trunk")
    if not trunk:
        raise RobotFileError("trunk: needs at least one body, as a table [trunk.NAME]")
    read: dict[str, Any] = {"name": name}
    for section, rules in _SECTIONS.items():
        read |= _read_section(section, _table(document, section), rules)
    for body in trunk:
        read |= _read_body(f"trunk.{body}", _table(trunk, body, "trunk."))
    leg = _table(document, "leg")
    _refuse_unknown("leg", leg, LEG_LINK_NAMES)
    for body in LEG_LINK_NAMES:
        read |= _read_body(f"leg.{body}", _table(leg, body, "leg."))
    _refuse_unknown("", document, ("name", "trunk", "leg", *_SECTIONS))
    return read


def _table(parent: dict[str, Any], key: str, prefix: str = "") -> dict[str, Any]:
    if key not in parent:
        raise RobotFileError(f"{prefix}{key}: missing, wanted a table [{prefix}{key}]")
    if not isinstance(parent[key], dict):
        raise RobotFileError(f"{prefix}{key}: got {parent[key]!r}, wanted a table [{prefix}{key}]")
    return parent[key]


def _refuse_unknown(section: str, table: dict[str, Any], known: tuple[str, ...]) -> None:
    for key in table:
        if key not in known:
            field = f"{section}.{key}" if section else key
            raise RobotFileError(f"{field}: unknown field, allowed: {', '.join(known)}")


def _read_section(section: str, table: dict[str, Any], rules: dict[str, Rule]) -> Numbers:
    _refuse_unknown(section, table, tuple(rules))
    for key, rule in rules.items():
        if key not in table:
            raise RobotFileError(f"{section}.{key}: missing, wanted {rule.allowed} [{rule.unit}]")
    return {f"{section}.{key}": read_number(f"{section}.{key}", table[key], rules[key]) for key in rules}


def _read_body(field: str, table: dict[str, Any]) -> Numbers:
    if ("box" in table) == ("inertia" in table):
        raise RobotFileError(f"{field}: needs 'box' [m] or 'inertia' [kg m2], one of them")
    shape = "box" if "box" in table else "inertia"
    read = _read_section(field, table, {key: _BODY[key] for key in ("mass", "com", shape)})
    matrix = _inertia(field, read)
    if not rigid.is_physical(matrix):
        moments = ", ".join(f"{m:.4g}" for m in np.linalg.eigvalsh(matrix))
        raise RobotFileError(
            f"{field}.{shape}: got principal moments {moments} kg m2, allowed: positive, each at most the sum of the "
            "other two (triangle inequality)"
        )
    return read


def _inertia(field: str, read: dict[str, Any]) -> np.ndarray:
    if f"{field}.box" in read:
        return rigid.box_inertia(float(read[f"{field}.mass"].value), read[f"{field}.box"].value)
    return rigid.inertia_matrix(read[f"{field}.inertia"].value)


def _build(read: dict[str, Any]) -> RobotParams:
    value = {field: number.value for field, number in read.items() if isinstance(number, Number)}
    mass, com, inertia = _links(read)
    total = float(mass.sum())
    if abs(total - value["overall.mass"]) > 1e-3:
        raise RobotFileError(
            f"overall.mass: got {value['overall.mass']:g} kg, allowed: the sum of the links, {total:.3f} kg, within 1 g"
        )
    hip = _hip_centre(value)
    return RobotParams(
        name=read["name"],
        p_pelvis_hip=_array(np.stack([hip, rigid.mirror_vector(hip)])),
        thigh_length=_array(value["geometry.thigh_length"]),
        shank_length=_array(value["geometry.shank_length"]),
        ankle_height=_array(value["geometry.ankle_height"]),
        p_sole_corner=_array(_sole_corners(value)),
        links=Links(mass=_array(mass), com=_array(com), inertia=_array(inertia)),
        servo=Servo(
            **{key: _array(np.tile(value[f"servo.{key}"], (2, 1))) for key in _SECTIONS["servo"]},
        ),
        joint_range=_array(_joint_range(value)),
        height=_array(value["overall.height"]),
    )


def _array(value: np.ndarray) -> Any:
    """To the default float type of JAX (float32, or float64 under `jax_enable_x64`)."""
    return jnp.asarray(value, dtype=jnp.result_type(float))


def _hip_centre(value: dict[str, np.ndarray]) -> np.ndarray:
    """Where the yaw axis (along z), roll axis (along x) and pitch axis (along y) meet, left leg."""
    yaw, roll, pitch = (value[f"geometry.hip_{axis}_axis"] for axis in ("yaw", "roll", "pitch"))
    gaps = {"x of yaw and pitch": yaw[0] - pitch[0], "y of yaw and roll": yaw[1] - roll[1]}
    gaps["z of roll and pitch"] = roll[2] - pitch[2]
    for what, gap in gaps.items():
        if abs(gap) > 1e-9:
            raise RobotFileError(
                f"geometry.hip_*_axis: got axes that do not meet, {what} differ by {gap:g} m, allowed: 0 m "
                "(closed-form inverse kinematics needs three hip axes through one point)"
            )
    if yaw[1] <= 0.0:
        raise RobotFileError(
            f"geometry.hip_yaw_axis: got y = {yaw[1]:g} m, allowed: > 0 m (the left leg is given)"
        )
    return np.array([yaw[0], yaw[1], roll[2]])


def _sole_corners(value: dict[str, np.ndarray]) -> np.ndarray:
    toe, heel, outer, inner = (value[f"geometry.sole_{edge}"] for edge in ("toe", "heel", "outer", "inner"))
    for high, low, names in ((toe, heel, "toe and heel"), (outer, inner, "outer and inner")):
        if high <= low:
            raise RobotFileError(
                f"geometry.sole_*: got {names} at {high:g} and {low:g} m, allowed: the first larger"
            )
    left = np.array([[toe, outer, 0], [toe, inner, 0], [heel, outer, 0], [heel, inner, 0]])
    right = rigid.mirror_vector(left)[[1, 0, 3, 2]]
    return np.stack([left, right])


def _joint_range(value: dict[str, np.ndarray]) -> np.ndarray:
    lower, upper = value["limits.lower"], value["limits.upper"]
    for joint, low, high in zip(JOINT_NAMES, lower, upper, strict=True):
        if low >= high:
            raise RobotFileError(f"limits: got {joint} from {low:g} to {high:g} rad, allowed: lower < upper")
    if not LEAST_KNEE_RANGE <= upper[KNEE] <= np.pi:
        raise RobotFileError(
            f"limits.upper: got knee {upper[KNEE]:g} rad, allowed: {LEAST_KNEE_RANGE:g} to {np.pi:.4g} rad "
            "(a knee bends one way, from 0 up)"
        )
    left = np.stack([lower, upper], axis=1)
    right = np.sort(left * _MIRRORED_JOINTS[:, None], axis=1)
    return np.stack([left, right])


def _links(read: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weld the trunk's bodies into one and mirror the left leg; mass, com and inertia of the 13 links."""
    trunk = sorted({field.rsplit(".", 1)[0] for field in read if field.startswith("trunk.")})
    leg = [f"leg.{name}" for name in LEG_LINK_NAMES]
    mass, com, inertia = (
        {body: get(body) for body in trunk + leg}
        for get in (
            lambda body: read[f"{body}.mass"].value,
            lambda body: read[f"{body}.com"].value,
            lambda body: _inertia(body, read),
        )
    )
    whole = rigid.combine(*(np.array([leaf[body] for body in trunk]) for leaf in (mass, com, inertia)))
    left = [np.array([leaf[body] for body in leg]) for leaf in (mass, com, inertia)]
    return (
        np.concatenate([[whole[0]], left[0], left[0]]),
        np.concatenate([whole[1][None], left[1], rigid.mirror_vector(left[1])]),
        np.concatenate([whole[2][None], left[2], rigid.mirror_inertia(left[2])]),
    )

"""Robot files: TOML in, `RobotParams` out, or an error that says which number is wrong."""

import functools
from collections.abc import Callable
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from jaxbiped import checked
from jaxbiped.checked import Quantity
from jaxbiped.robot import defaults as beside
from jaxbiped.robot import inertia as rigid
from jaxbiped.robot.defaults import Defaults
from jaxbiped.robot.fields import Number, RobotFileError, read_number
from jaxbiped.robot.params import JOINT_NAMES, KNEE, LEG_LINK_NAMES, Links, RobotParams, Servo

_JOINTS = ((len(JOINT_NAMES),),)
_POINT = Quantity("m", -3.0, 3.0, shapes=((3,),))
_LENGTH = Quantity("m", 0.02, 2.0)
_EDGE = Quantity("m", -1.0, 1.0)
_ANGLE = Quantity("rad", -2.0 * np.pi, 2.0 * np.pi, shapes=_JOINTS)
LEAST_KNEE_RANGE = 0.1
"""Smallest upper knee limit with which a leg has any reach to speak of [rad]."""
SMALLEST_SOLE = 0.01
"""Smallest length and width of a sole [m]."""
GYRATION = (1e-4, 3.0)
"""Smallest and largest radius of gyration of a body, the root of its inertia over its mass [m]."""
LONGEST_NAME = 100
"""Largest number of characters in the name of a robot."""
_MIRRORED_JOINTS = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, -1.0])
"""Signs that turn a joint angle of the left leg into that of the mirrored right leg: yaw and the rolls change sign."""

# Wide enough for humanoids from 0.3 m and 1 kg to 2.5 m and 300 kg, narrow enough to refuse another unit.
_SECTIONS: dict[str, dict[str, Quantity]] = {
    "overall": {"mass": Quantity("kg", 0.1, 500.0), "height": Quantity("m", 0.1, 4.0)},
    "geometry": {
        "hip_yaw_axis": _POINT,
        "hip_roll_axis": _POINT,
        "hip_pitch_axis": _POINT,
        "thigh_length": _LENGTH,
        "shank_length": _LENGTH,
        "ankle_height": Quantity("m", 0.0, 0.5),
        "sole_toe": _EDGE,
        "sole_heel": _EDGE,
        "sole_outer": _EDGE,
        "sole_inner": _EDGE,
    },
    "servo": {
        "kp": Quantity("N m/rad", 1e-3, 1e7, shapes=_JOINTS),
        "kv": Quantity("N m s/rad", 1e-5, 1e6, shapes=_JOINTS),
        "ki": Quantity("N m/(rad s)", 0.0, 1e7, shapes=_JOINTS),
        "armature": Quantity("kg m2", 1e-6, 100.0, shapes=_JOINTS),
        "torque_limit": Quantity("N m", 1e-2, 1e5, shapes=_JOINTS),
        "speed_limit": Quantity("rad/s", 0.1, 100.0, shapes=_JOINTS),
    },
    "limits": {"lower": _ANGLE, "upper": _ANGLE},
}
_BODY = {
    "mass": Quantity("kg", 1e-3, 500.0),
    "com": _POINT,
    "box": Quantity("m", 1e-3, 3.0, shapes=((3,),)),
    "inertia": Quantity("kg m2", -1e3, 1e3, shapes=((3,), (6,))),
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


def defaults(robot: str | RobotParams) -> Defaults:
    """Choices of the paper of a preset robot beyond its body; none for a robot that walks like no preset.

    Args:
        robot: the robot, or the name of a preset.
    """
    name = robot if isinstance(robot, str) else robot.preset_name
    return _defaults(name) if name in presets() else Defaults()


@functools.cache
def _defaults(preset: str) -> Defaults:
    return beside.read(checked.read_toml(_file(preset), RobotFileError))


def _build_from(name_or_path: str | Path, build: Callable[[dict[str, Any]], T]) -> T:
    """Read the file and build something of its checked numbers; every error names the file."""
    file = _file(name_or_path)
    document = checked.read_toml(file, RobotFileError)
    try:
        return build(_read_all(document))
    except RobotFileError as error:
        raise RobotFileError(f"{file.name}: {error}") from None


def _file(name_or_path: str | Path) -> Traversable:
    if str(name_or_path) in presets():
        return resources.files("jaxbiped.robot") / "presets" / f"{name_or_path}.toml"
    path = Path(name_or_path)
    try:
        found = path.suffix == ".toml" and path.is_file()
    except (OSError, ValueError):  # no name that a file can have
        found = False
    if not found:
        raise RobotFileError(
            f"robot: got {str(name_or_path)!r}, allowed: {', '.join(presets())} or the path of a .toml file"
            f"{checked.nearest(str(name_or_path), presets())}"
        )
    return path


def _read_all(document: dict[str, object]) -> dict[str, Any]:
    """Check the whole document; returns its numbers by dotted field name, `name` and `walks_like`."""
    known = ("name", "walks_like", "trunk", "leg", *_SECTIONS, *beside.TABLES)
    checked.refuse_unknown("", document, known, RobotFileError)
    read: dict[str, Any] = {"name": _name(document)}
    like = read["walks_like"] = _walks_like(document, read["name"])
    beside.require_same(beside.read(document), defaults(like), like)
    trunk = _table(document, "trunk")
    if not trunk:
        raise RobotFileError("trunk: needs at least one body, as a table [trunk.NAME]")
    for section, rules in _SECTIONS.items():
        read |= _read_section(section, _table(document, section), rules)
    for body in trunk:
        read |= _read_body(f"trunk.{body}", _table(trunk, body, "trunk."))
    leg = _table(document, "leg")
    checked.refuse_unknown("leg.", leg, LEG_LINK_NAMES, RobotFileError)
    for body in LEG_LINK_NAMES:
        read |= _read_body(f"leg.{body}", _table(leg, body, "leg."))
    return read


def _name(document: dict[str, object]) -> str:
    """Return the robot's name, which is written into titles, other files and models."""
    name = document.get("name")
    if not isinstance(name, str) or not name.strip():
        raise RobotFileError(f"name: got {checked.shown(name)}, allowed: a text")
    if len(name) > LONGEST_NAME or not name.isprintable() or set(name) & set("\"'\\"):
        raise RobotFileError(
            f"name: got {checked.shown(name)}, allowed: up to {LONGEST_NAME} printable characters without quotation "
            "marks and backslashes"
        )
    return name


def _walks_like(document: dict[str, object], name: str) -> str:
    """Return the preset whose gaits and simulation options fit; for a preset itself, its own name."""
    if "walks_like" not in document:
        return name if name in presets() else ""
    return checked.Word(presets()).check("walks_like", document["walks_like"], RobotFileError)


def _table(parent: dict[str, Any], key: str, prefix: str = "") -> dict[str, Any]:
    if key not in parent:
        raise RobotFileError(f"{prefix}{key}: missing, allowed: a table [{prefix}{key}]")
    if not isinstance(parent[key], dict):
        raise RobotFileError(
            f"{prefix}{key}: got {checked.shown(parent[key])}, allowed: a table [{prefix}{key}]"
        )
    return parent[key]


def _read_section(section: str, table: dict[str, Any], rules: dict[str, Quantity]) -> Numbers:
    checked.refuse_unknown(f"{section}.", table, rules, RobotFileError)
    for key, rule in rules.items():
        if key not in table:
            raise RobotFileError(f"{section}.{key}: missing, allowed: {rule.size}, {rule.allowed}")
    return {f"{section}.{key}": read_number(f"{section}.{key}", table[key], rules[key]) for key in rules}


def _read_body(field: str, table: dict[str, Any]) -> Numbers:
    if ("box" in table) == ("inertia" in table):
        raise RobotFileError(f"{field}: needs 'box' [m] or 'inertia' [kg m2], one of them")
    shape = "box" if "box" in table else "inertia"
    read = _read_section(field, table, {key: _BODY[key] for key in ("mass", "com", shape)})
    _require_inertia(f"{field}.{shape}", float(read[f"{field}.mass"].value), _inertia(field, read))
    return read


def _require_inertia(field: str, mass: float, matrix: np.ndarray) -> None:
    """Refuse what no body of this mass can have, as float32 too."""
    moments = np.linalg.eigvalsh(matrix)
    got = f"got principal moments {', '.join(f'{m:.4g}' for m in moments)} kg m2"
    if not rigid.is_physical(matrix):
        raise RobotFileError(
            f"{field}: {got}, allowed: positive, each at most the sum of the other two (triangle inequality)"
        )
    low, high = (mass * radius**2 for radius in GYRATION)
    if moments[2] > high or np.linalg.eigvalsh(matrix.astype(np.float32))[0] < low:
        near, far = GYRATION
        raise RobotFileError(
            f"{field}: {got} with {mass:g} kg, allowed: {low:.3g} to {high:.3g} kg m2 (the mass times the squares of "
            f"{near:g} and {far:g} m)"
        )


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
        walks_like=read["walks_like"],
    )


def _array(value: np.ndarray) -> np.ndarray:
    """A float64 array that cannot be written to, as records are."""
    array = np.array(value, np.float64)
    array.setflags(write=False)
    return array


def _hip_centre(value: dict[str, np.ndarray]) -> np.ndarray:
    """Point where the yaw axis (along z), roll axis (along x) and pitch axis (along y) meet, left leg."""
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
        if high - low < SMALLEST_SOLE * (1.0 - 1e-9):
            raise RobotFileError(
                f"geometry.sole_*: got {names} at {high:g} and {low:g} m, allowed: the first larger by at least "
                f"{SMALLEST_SOLE:g} m"
            )
    left = np.array([[toe, outer, 0], [toe, inner, 0], [heel, outer, 0], [heel, inner, 0]])
    right = rigid.mirror_vector(left)[[1, 0, 3, 2]]
    return np.stack([left, right])


def _joint_range(value: dict[str, np.ndarray]) -> np.ndarray:
    lower, upper = value["limits.lower"], value["limits.upper"]
    for joint, low, high in zip(JOINT_NAMES, lower, upper, strict=True):
        if np.float32(low) >= np.float32(high):
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

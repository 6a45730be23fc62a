"""A robot file that cannot be used is refused with the field, what was got and what is allowed."""

import copy
import dataclasses
import importlib
import tomllib
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxbiped import checked, robot

loading = importlib.import_module("jaxbiped.robot.load")  # the module; robot.load is its function
LOPSIDED = (Path(__file__).parent / "lopsided.toml").read_text()
THIGH_MASS = 'mass = { value = 6.5, unit = "kg", assumed = "a test" }'
THIGH_INERTIA = (
    'inertia = { value = [0.08, 0.09, 0.02, 0.004, 0.006, -0.005], unit = "kg m2", assumed = "a test" }'
)
PACK_BOX = 'box = { value = [0.15, 0.3, 0.4], unit = "m", assumed = "a test" }'
KP = "[1000.0, 2000.0, 3000.0, 4000.0, 5000.0, 6000.0]"
HIP_AXES = LOPSIDED[LOPSIDED.index("hip_yaw_axis") : LOPSIDED.index("thigh_length")]
FOOT_TABLE = LOPSIDED[LOPSIDED.index("[leg.foot]") : LOPSIDED.index("[servo]")]
TRUNK_TABLES = LOPSIDED[LOPSIDED.index("[trunk.chest]") : LOPSIDED.index("[leg.hip_yaw]")]
LIMITS_TABLE = LOPSIDED[LOPSIDED.index("[limits]") :]

# What is wrong, the line of the good file, what stands there instead, and words that the refusal must hold:
# the field, what was got, what is allowed.
WRONG = [
    # numbers out of range
    ("negative mass", "value = 6.5,", "value = -6.5,", ["leg.thigh.mass", "-6.5 kg", ">= 0.001 and <= 500 kg"]),
    ("zero mass", "value = 6.5,", "value = 0,", ["leg.thigh.mass", "got 0 kg", ">= 0.001 and <= 500 kg"]),
    ("negative trunk mass", "value = 25.0,", "value = -1,", ["trunk.chest.mass", "-1 kg", ">= 0.001 and <= 500 kg"]),
    ("negative total", "value = 61.0,", "value = -61.0,", ["overall.mass", "-61 kg", ">= 0.1 and <= 500 kg"]),
    ("negative height", "value = 1.5, unit = \"m\"", 'value = -1.5, unit = "m"',
     ["overall.height", "-1.5 m", ">= 0.1 and <= 4 m"]),
    ("negative length", "value = 0.33,", "value = -0.33,", ["geometry.thigh_length", "-0.33 m", ">= 0.02 and <= 2 m"]),
    ("zero length", "value = 0.29,", "value = 0.0,", ["geometry.shank_length", "got 0 m", ">= 0.02 and <= 2 m"]),
    ("foot above ankle", "value = 0.07,", "value = -0.07,", ["geometry.ankle_height", "-0.07 m", ">= 0 and <= 0.5 m"]),
    ("flat box", "[0.15, 0.3, 0.4]", "[0.15, 0.3, 0.0]",
     ["trunk.pack.box", "got 0 m in place 3", ">= 0.001 and <= 3 m"]),
    ("negative gain", KP, KP.replace("3000", "-3000"),
     ["servo.kp", "-3000 N m/rad in place 3", ">= 0.001 and <= 1e+07 N m/rad"]),
    ("negative damping", "30.0, 40.0,", "30.0, -40.0,",
     ["servo.kv", "-40 N m s/rad in place 4", ">= 1e-05 and <= 1e+06 N m s/rad"]),
    ("negative integral", "[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], unit = \"N m/(rad s)\"",
     '[1.0, 2.0, -3.0, 4.0, 5.0, 6.0], unit = "N m/(rad s)"',
     ["servo.ki", "-3 N m/(rad s)", ">= 0 and <= 1e+07 N m/(rad s)"]),
    ("negative armature", "[0.1, 0.2, 0.3,", "[0.1, -0.2, 0.3,",
     ["servo.armature", "-0.2 kg m2", ">= 1e-06 and <= 100 kg m2"]),
    ("no torque", "[110.0, ", "[0.0, ", ["servo.torque_limit", "got 0 N m in place 1", ">= 0.01 and <= 100000 N m"]),
    ("no speed", "6.0], unit = \"rad/s\"", '-6.0], unit = "rad/s"',
     ["servo.speed_limit", "-6 rad/s", ">= 0.1 and <= 100 rad/s"]),
    # not numbers
    ("nan", "value = 0.33,", "value = nan,", ["geometry.thigh_length", "nan m", ">= 0.02 and <= 2 m"]),
    ("infinite mass", "value = 6.5,", "value = inf,", ["leg.thigh.mass", "inf kg", ">= 0.001 and <= 500 kg"]),
    ("infinite limit", "-1.9, 0.05", "-inf, 0.05", ["limits.lower", "-inf rad", ">= -6.28319 and <= 6.28319 rad"]),
    ("nan in a vector", "[0.03, 0.01, 0.35]", "[0.03, nan, 0.35]",
     ["trunk.chest.com", "nan m in place 2", ">= -3 and <= 3 m"]),
    ("text", "value = 0.33,", 'value = "0.33",', ["geometry.thigh_length", "the text '0.33'", "one number [m]"]),
    ("truth", "value = 6.5,", "value = true,", ["leg.thigh.mass", "the truth value true", "one number [kg]"]),
    ("text in a vector", "[0.03, 0.01, 0.35]", '[0.03, "a", 0.35]',
     ["trunk.chest.com", "the text 'a'", "3 numbers [m]"]),
    ("nested vector", "[0.03, 0.01, 0.35]", "[[0.03, 0.01, 0.35]]", ["trunk.chest.com", "[[", "numbers [m]"]),
    # wrong size
    ("two coordinates", "[0.03, 0.01, 0.35]", "[0.03, 0.01]",
     ["trunk.chest.com", "[0.03, 0.01]", "3 numbers"]),
    ("a number for a vector", "[0.03, 0.01, 0.35]", "0.03", ["trunk.chest.com", "0.03", "3 numbers [m]"]),
    ("a vector for a number", "value = 6.5,", "value = [6.5],",
     ["leg.thigh.mass", "[6.5]", "one number [kg]"]),
    ("empty vector", "[0.03, 0.01, 0.35]", "[]", ["trunk.chest.com", "[]", "3 numbers [m]"]),
    ("five joints", KP, "[1.0, 1.0, 1.0, 1.0, 1.0]", ["servo.kp", "6 numbers [N m/rad]"]),
    ("four moments", "[0.004, 0.005, 0.006]", "[0.004, 0.005, 0.006, 0.0]",
     ["leg.hip_yaw.inertia", "3 numbers or 6 numbers"]),
    # inertia no body can have
    ("triangle inequality", "[0.004, 0.005, 0.006]", "[0.004, 0.005, 0.0091]",
     ["leg.hip_yaw.inertia", "0.0091", "triangle inequality"]),
    ("triangle inequality, turned", "[1.1, 0.9, 0.6, 0.05, -0.08, 0.03]", "[1.0, 1.0, 0.2, 0.95, 0.0, 0.0]",
     ["trunk.chest.inertia", "1.95", "triangle inequality"]),
    ("negative moment", "[0.004, 0.005, 0.006]", "[-0.004, 0.005, 0.006]",
     ["leg.hip_yaw.inertia", "-0.004", "positive"]),
    # units
    ("wrong unit", 'value = 6.5, unit = "kg"', 'value = 6500, unit = "g"', ["leg.thigh.mass", "'g'", "'kg'"]),
    ("millimetres", 'value = 0.33, unit = "m"', 'value = 330, unit = "mm"',
     ["geometry.thigh_length", "'mm'", "'m'"]),
    ("no unit", 'value = 0.33, unit = "m",', "value = 0.33,", ["geometry.thigh_length", "nothing", "'m'"]),
    ("degrees", '0.6], unit = "rad", assumed', '0.6], unit = "deg", assumed',
     ["limits.upper", "'deg'", "'rad'"]),
    # where it comes from
    ("no source", 'value = 0.33, unit = "m", assumed = "a test"', 'value = 0.33, unit = "m"',
     ["geometry.thigh_length", "stated", "assumed"]),
    ("two sources", 'value = 0.33, unit = "m", assumed', 'value = 0.33, unit = "m", stated = "a", assumed',
     ["geometry.thigh_length", "stated", "assumed", "one of them"]),
    ("blank source",
     'value = 0.33, unit = "m", assumed = "a test"', 'value = 0.33, unit = "m", assumed = " "',
     ["geometry.thigh_length", "as text"]),
    ("source no text",
     'value = 0.33, unit = "m", assumed = "a test"', 'value = 0.33, unit = "m", assumed = 1',
     ["geometry.thigh_length", "as text"]),
    ("bare number", THIGH_MASS, "mass = 6.5", ["leg.thigh.mass", "6.5", "value = ", '"kg"']),
    ("no value", "value = 6.5, ", "", ["leg.thigh.mass", "'value' is missing"]),
    # missing
    ("no name", 'name = "lopsided"', "", ["name", "nothing", "a text"]),
    ("name no text", 'name = "lopsided"', "name = 3", ["name", "3", "a text"]),
    ("no mass", THIGH_MASS, "", ["leg.thigh.mass", "missing", "one number [kg], >= 0.001"]),
    ("no gain", f'kp = {{ value = {KP}, unit = "N m/rad", assumed = "a test" }}', "",
     ["servo.kp", "missing", "N m/rad"]),
    ("no foot", FOOT_TABLE, "", ["leg.foot", "missing", "[leg.foot]"]),
    ("no trunk", TRUNK_TABLES, "", ["trunk", "missing", "[trunk]"]),
    ("empty trunk", TRUNK_TABLES, "[trunk]\n", ["trunk", "at least one", "[trunk.NAME]"]),
    ("no limits", LIMITS_TABLE, "", ["limits", "missing", "[limits]"]),
    ("foot no table", FOOT_TABLE, "[leg]\nfoot = 3\n", ["leg.foot", "3", "a table"]),
    ("neither box nor inertia", PACK_BOX, "", ["trunk.pack", "'box'", "'inertia'", "one of them"]),
    ("both box and inertia", THIGH_INERTIA, f"{THIGH_INERTIA}\n{PACK_BOX}",
     ["leg.thigh", "'box'", "'inertia'", "one of them"]),
    # implausible, or in another unit
    ("thigh in millimetres", "value = 0.33,", "value = 330,",
     ["geometry.thigh_length", "got 330 m", ">= 0.02 and <= 2 m", "330 mm is 0.33 m"]),
    ("shank in centimetres", "value = 0.29,", "value = 29,", ["geometry.shank_length", "29 cm is 0.29 m"]),
    ("height in centimetres", 'value = 1.5, unit = "m"', 'value = 150, unit = "m"', ["150 cm is 1.5 m"]),
    ("sole in millimetres", "value = 0.17,", "value = 170,", ["geometry.sole_toe", "170 mm is 0.17 m"]),
    ("sole of 0.1 mm", "value = -0.05,", "value = 0.0799,",
     ["geometry.sole_", "outer and inner", "0.0799", "at least 0.01 m"]),
    ("thigh in grams", "value = 6.5,", "value = 6500,", ["leg.thigh.mass", "6500 g is 6.5 kg"]),
    ("hip axis in millimetres", "[0.02, 0.09, 0.5]", "[20, 90, 500]", ["geometry.hip_yaw_axis", "20 mm is 0.02 m"]),
    ("box in millimetres", "[0.15, 0.3, 0.4]", "[150, 300, 400]", ["trunk.pack.box", "150 mm is 0.15 m"]),
    ("centre of mass far away", "[0.03, 0.01, 0.35]", "[0.03, 0.01, 35]",
     ["trunk.chest.com", "got 35 m in place 3", "35 mm is 0.035 m"]),
    ("gain beyond float32", KP, KP.replace("3000.0", "1e39"),
     ["servo.kp", "1e+39 N m/rad in place 3 (infinite in float32)"]),
    ("gain 1e30", KP, KP.replace("6000.0", "1e30"), ["servo.kp", "1e+30 N m/rad in place 6", "<= 1e+07"]),
    ("gain that vanishes", KP, KP.replace("1000.0", "1e-60"), ["servo.kp", "1e-60 N m/rad", "(0 in float32)"]),
    ("gain of 400 digits", KP, KP.replace("1000.0", "1" * 400), ["servo.kp", "a whole number of about 400 digits"]),
    ("no damping", "30.0, 40.0,", "30.0, 0.0,", ["servo.kv", "got 0 N m s/rad in place 4"]),
    ("no armature", "[0.1, 0.2, 0.3,", "[0.1, 0, 0.3,", ["servo.armature", "got 0 kg m2 in place 2"]),
    ("armature that vanishes", "[0.1, 0.2, 0.3,", "[0.1, 1e-50, 0.3,", ["servo.armature", "(0 in float32)"]),
    ("armature in kg cm2", "[0.1, 0.2, 0.3,", "[1000, 0.2, 0.3,", ["servo.armature", "1000 kg cm2 is 0.1 kg m2"]),
    ("speed in degrees", "6.0], unit = \"rad/s\"", '344], unit = "rad/s"',
     ["servo.speed_limit", "344 deg/s is 6.004 rad/s"]),
    ("limit in degrees", "-1.9, 0.05", "-109, 0.05", ["limits.lower", "-109 deg is -1.902 rad"]),
    ("limit beyond a turn", "2.2, 0.7", "2.2, 6.4", ["limits.upper", "got 6.4 rad in place 5"]),
    ("limits that meet in float32", "0.9, 0.7, 0.8,", "-0.49999999999, 0.7, 0.8,",
     ["limits", "hip_yaw", "lower < upper"]),
    ("inertia that vanishes", "[0.004, 0.005, 0.006]", "[1e-50, 1e-50, 1e-50]",
     ["leg.hip_yaw.inertia", "1e-50 kg m2", "(0 in float32)"]),
    ("inertia of a point", "[0.004, 0.005, 0.006]", "[4e-12, 5e-12, 6e-12]",
     ["leg.hip_yaw.inertia", "4e-12", "with 1.5 kg", "1.5e-08 to 13.5 kg m2"]),
    ("inertia in kg cm2", "[0.004, 0.005, 0.006]", "[40, 50, 60]",
     ["leg.hip_yaw.inertia", "with 1.5 kg", "to 13.5 kg m2"]),
    ("inertia in kg mm2", "[0.004, 0.005, 0.006]", "[4000, 5000, 6000]",
     ["leg.hip_yaw.inertia", "4000 kg mm2 is 0.004 kg m2"]),
    ("date", "value = 0.33,", "value = 2020-01-02,", ["geometry.thigh_length", "the date or time 2020-01-02"]),
    ("table for a number", "value = 0.33,", "value = {x = 1},", ["geometry.thigh_length", "got a table"]),
    # the name, and what it walks like
    ("name of two lines", 'name = "lopsided"', 'name = "lop\\nsided"', ["name", "printable"]),
    ("name with quotation marks", 'name = "lopsided"', "name = 'lop\"sided'", ["name", "printable"]),
    ("long name", 'name = "lopsided"', f'name = "{"a" * 200}"', ["name", "up to 100"]),
    ("walks like nobody", 'name = "lopsided"', 'name = "lopsided"\nwalks_like = "surena"',
     ["walks_like: got 'surena', allowed: elkahlout, surena3; did you mean 'surena3'?"]),
    ("walks like a number", 'name = "lopsided"', 'name = "lopsided"\nwalks_like = 3', ["walks_like: got 3", "surena3"]),
    # unknown, at every level
    ("misspelt", "thigh_length", "thigh_lenght", ["geometry.thigh_lenght", "did you mean 'thigh_length'?"]),
    ("misspelt table", "[servo]", "[sevro]", ["sevro: unknown", "did you mean 'servo'?"]),
    ("misspelt link", "[leg.shank]", "[leg.shnak]", ["leg.shnak: unknown", "did you mean 'shank'?"]),
    ("two lines in a name", PACK_BOX, f'{PACK_BOX}\n"a\\nb" = 1', ["trunk.pack.a\\nb: unknown"]),
    ("unknown key of a number", "value = 6.5,", "value = 6.5, note = 1,",
     ["leg.thigh.mass.note", "unknown", "unit"]),
    ("unknown field of a link", THIGH_MASS, f"{THIGH_MASS}\ncolour = 1",
     ["leg.thigh.colour", "unknown", "mass, com"]),
    ("unknown field of the trunk", PACK_BOX, f"{PACK_BOX}\nzip = 1",
     ["trunk.pack.zip", "unknown", "mass, com"]),
    ("unknown link", "[leg.foot]", "[leg.toe]\n[leg.foot]", ["leg.toe", "unknown", "shank"]),
    ("unknown length", "[geometry]", "[geometry]\ntoe_length = 1",
     ["geometry.toe_length", "unknown", "thigh_length"]),
    ("unknown gain", "[servo]", "[servo]\nkd = 1", ["servo.kd", "unknown", "kv"]),
    ("unknown table", "[servo]", "[paint]\n[servo]", ["paint", "unknown", "geometry"]),
    ("unknown top field", 'name = "lopsided"', 'name = "lopsided"\ncolour = 1',
     ["colour", "unknown", "geometry"]),
    # numbers that contradict each other
    ("hips apart in x", "[0.02, 0.09, 0.5]", "[0.03, 0.09, 0.5]",
     ["geometry.hip_", "x of yaw and pitch", "0.01 m", "allowed: 0 m"]),
    ("hips apart in y", "[-0.4, 0.09, -0.03]", "[-0.4, 0.08, -0.03]",
     ["geometry.hip_", "y of yaw and roll", "0.01 m", "allowed: 0 m"]),
    ("hips apart in z", "[0.02, 0.7, -0.03]", "[0.02, 0.7, -0.05]",
     ["geometry.hip_", "z of roll and pitch", "0.02 m", "allowed: 0 m"]),
    ("right leg for left", HIP_AXES, HIP_AXES.replace("0.09", "-0.09"),
     ["geometry.hip_yaw_axis", "-0.09 m", "> 0 m"]),
    ("toe behind heel", "value = 0.17,", "value = -0.17,",
     ["geometry.sole_", "toe and heel", "-0.17", "-0.06"]),
    ("toe at heel", "value = 0.17,", "value = -0.06,", ["geometry.sole_", "toe and heel", "-0.06", "larger"]),
    ("outer inside inner", "value = 0.08,", "value = -0.08,",
     ["geometry.sole_", "outer and inner", "-0.08", "-0.05"]),
    ("lower above upper", "-1.9, 0.05", "0.9, 0.05",
     ["limits", "hip_pitch", "0.9", "0.8 rad", "lower < upper"]),
    ("knee beyond half a turn", "0.8, 2.2, 0.7", "0.8, 3.5, 0.7", ["limits.upper", "knee 3.5 rad", "0.1 to 3.142 rad"]),
    ("lower at upper", "[-0.5, ", "[0.9, ", ["limits", "hip_yaw", "0.9 to 0.9 rad", "lower < upper"]),
    ("masses do not add up", "value = 61.0,", "value = 61.002,", ["overall.mass", "61.002 kg", "61.000 kg"]),
    ("mass left out", "value = 6.5,", "value = 6.4,", ["overall.mass", "61 kg", "60.800 kg"]),
]  # fmt: skip


def refusal(path: str | Path) -> str:
    with pytest.raises(robot.RobotFileError) as error:
        robot.load(path)
    return str(error.value)


@pytest.mark.parametrize(("old", "new", "words"), [w[1:] for w in WRONG], ids=[w[0] for w in WRONG])
def test_wrong_file_is_refused_with_field_value_and_what_is_allowed(tmp_path, old, new, words):
    assert old in LOPSIDED
    path = tmp_path / "wrong.toml"
    path.write_text(LOPSIDED.replace(old, new))
    message = refusal(path)
    assert message.startswith("wrong.toml: ") and message.isprintable()
    for word in words:
        assert word in message


def test_masses_may_miss_the_total_by_half_a_gram(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(LOPSIDED.replace("value = 61.0,", "value = 61.0005,"))
    robot.load(path)


@pytest.mark.parametrize(
    "content",
    [
        b"name = ",
        b"\x89PNG\r\n\x1a\n\xff\xfe",
        b"[a]\n[a]\n",
        b"{}",
        b"name = " + b"[" * 100_000,
        b"name = " + b"1" * 5000,
        b"#" * (1 << 21),
    ],
    ids=["cut", "binary", "twice", "json", "deep", "digits", "long"],
)
def test_not_toml(tmp_path, content):
    path = tmp_path / "wrong.toml"
    path.write_bytes(content)
    assert refusal(path).startswith("wrong.toml: ")


def test_empty_file(tmp_path):
    path = tmp_path / "wrong.toml"
    path.write_text("")
    assert "name: got nothing" in refusal(path)


@pytest.mark.parametrize("name", ["surena4", "no/such/robot.toml", "", "nul\0.toml", "a" * 5000 + ".toml"])
def test_no_such_robot(name):
    message = refusal(name)
    assert "elkahlout, surena3 or the path of a .toml file" in message and message.isprintable()
    assert repr(name) in message and ("did you mean 'surena3'?" in message) == (name == "surena4")


def test_folder_is_no_robot(tmp_path):
    folder = tmp_path / "robot.toml"
    folder.mkdir()
    assert "the path of a .toml file" in refusal(folder)


def test_numbers_refuses_like_load(tmp_path):
    path = tmp_path / "wrong.toml"
    for content in (LOPSIDED.replace("value = 6.5,", "value = -6.5,"), "name = "):
        path.write_text(content)
        with pytest.raises(robot.RobotFileError, match=r"^wrong\.toml: "):
            robot.numbers(path)


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_good_file_is_not_refused(tmp_path, mark):
    path = tmp_path / "good.toml"
    path.write_bytes(mark + LOPSIDED.encode())
    assert robot.load(path).name == "lopsided"
    assert robot.load(str(path)).name == "lopsided"


# ---------------------------------------------------------------- what it walks like


def test_presets_and_their_copies_walk_like_themselves(tmp_path):
    for name in robot.presets():
        text = (Path(robot.__file__).parent / "presets" / f"{name}.toml").read_text()
        copied = tmp_path / "mine.toml"
        copied.write_text(text.replace(f'name = "{name}"', 'name = "mine"', 1))
        mine = robot.load(copied)
        assert (mine.name, mine.walks_like, mine.preset_name) == ("mine", name, name)
        copied.write_text(text.replace(f'walks_like = "{name}"\n', ""))
        assert robot.load(copied).walks_like == name
        assert robot.load(name).walks_like == name


def test_a_robot_of_ones_own_walks_like_nobody_unless_it_says_so(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(LOPSIDED)
    assert (robot.load(path).walks_like, robot.load(path).preset_name) == ("", "lopsided")
    path.write_text(f'walks_like = "surena3"\n{LOPSIDED}')
    assert robot.load(path).walks_like == "surena3"
    without = dataclasses.replace(
        robot.load(path), walks_like=robot.RobotParams.__dataclass_fields__["walks_like"].default
    )
    assert without.walks_like == ""


# ---------------------------------------------------------------- robots of every size


@pytest.mark.parametrize("scale", [0.2, 0.35, 0.7, 1.0, 1.4])
@pytest.mark.parametrize("name", robot.presets())
def test_humanoids_from_small_to_large_are_plausible(name, scale):
    """Scaled in length, and so in mass by its third power, torques by its fourth, inertias by its fifth."""
    powers = {"m": 1, "kg": 3, "kg m2": 5, "rad": 0, "rad/s": -0.5}
    document = tomllib.loads((Path(robot.__file__).parent / "presets" / f"{name}.toml").read_text())
    for entry in numbers_of(document):
        factor = scale ** powers.get(entry["unit"], 4)
        entry["value"] = (np.asarray(entry["value"]) * factor).tolist()
    assert_finite(loading._build(loading._read_all(document)))


# ---------------------------------------------------------------- anything at all


DOCUMENTS = {
    str(path): tomllib.loads(path.read_text())
    for path in [
        Path(__file__).parent / "lopsided.toml",
        *sorted((Path(robot.__file__).parent / "presets").iterdir()),
    ]
}
ANY_NUMBER = (
    st.floats(allow_subnormal=True) | st.integers() | st.sampled_from([0, 1e39, 1e-60, 10**400, 1e30, -1.0])
)
ANYTHING = (
    ANY_NUMBER
    | st.booleans()
    | st.text(max_size=5)
    | st.dates()
    | st.lists(ANY_NUMBER, max_size=7)
    | st.just({})
    | st.lists(st.lists(ANY_NUMBER, max_size=2), max_size=2)
)


def numbers_of(table: Any) -> list[dict[str, Any]]:
    """Every `{ value = ..., unit = ... }` of a document, in order."""
    if not isinstance(table, dict):
        return []
    return [table] if "unit" in table else [entry for item in table.values() for entry in numbers_of(item)]


def tables_of(table: dict[str, Any]) -> list[dict[str, Any]]:
    inner = [one for item in table.values() if isinstance(item, dict) for one in tables_of(item)]
    return [table, *inner]


def assert_finite(params: robot.RobotParams) -> None:
    for leaf in jax.tree.leaves(params):
        assert np.isfinite(np.asarray(leaf, np.float32)).all()
    for positive in (
        params.links.mass,
        params.servo.kp,
        params.servo.kv,
        params.servo.armature,
        params.thigh_length,
    ):
        assert (np.asarray(positive, np.float32) > 0.0).all()
    assert (np.linalg.eigvalsh(np.asarray(params.links.inertia, np.float32)) > 0.0).all()


def load_or_refuse(document: dict[str, Any]) -> None:
    try:
        params = loading._build(loading._read_all(document))
    except robot.RobotFileError as error:
        assert str(error).isprintable() and len(str(error)) < 500
    else:
        assert_finite(params)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(list(DOCUMENTS)), st.data())
def test_a_preset_with_other_numbers_is_finite_or_refused(name, data):
    document = copy.deepcopy(DOCUMENTS[name])
    for _ in range(data.draw(st.integers(1, 3))):
        entry = data.draw(st.sampled_from(numbers_of(document)))
        if isinstance(entry["value"], list) and entry["value"] and data.draw(st.booleans()):
            entry["value"][data.draw(st.integers(0, len(entry["value"]) - 1))] = data.draw(ANY_NUMBER)
        else:
            entry["value"] = data.draw(ANYTHING)
    load_or_refuse(document)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(list(DOCUMENTS)), st.data())
def test_a_preset_with_other_tables_is_finite_or_refused(name, data):
    document = copy.deepcopy(DOCUMENTS[name])
    table = data.draw(st.sampled_from(tables_of(document)))
    key = data.draw(st.sampled_from([*table, "new"]) | st.text(max_size=8))
    if data.draw(st.booleans()):
        table.pop(key, None)
    else:
        table[key] = data.draw(ANYTHING)
    load_or_refuse(document)


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(list(DOCUMENTS)), st.integers(0, 9000), st.integers(0, 40), st.binary(max_size=20))
def test_a_preset_with_other_bytes_is_finite_or_refused(name, start, length, other):
    content = Path(name).read_bytes()
    try:
        document = checked.parse_toml(
            "x.toml", content[:start] + other + content[start + length :], robot.RobotFileError
        )
    except robot.RobotFileError as error:
        assert str(error).isprintable()
    else:
        load_or_refuse(document)

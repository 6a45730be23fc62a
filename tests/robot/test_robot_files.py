"""A robot file that cannot be used is refused with the field, what was got and what is allowed."""

from pathlib import Path

import pytest

from jaxbiped import robot

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
    ("negative mass", "value = 6.5,", "value = -6.5,", ["leg.thigh.mass", "-6.5 kg", "> 0 kg"]),
    ("zero mass", "value = 6.5,", "value = 0,", ["leg.thigh.mass", "0 kg", "> 0 kg"]),
    ("negative trunk mass", "value = 25.0,", "value = -1,", ["trunk.chest.mass", "-1 kg", "> 0 kg"]),
    ("negative total", "value = 61.0,", "value = -61.0,", ["overall.mass", "-61 kg", "> 0 kg"]),
    ("negative height", "value = 1.5, unit = \"m\"", 'value = -1.5, unit = "m"',
     ["overall.height", "-1.5 m", "> 0 m"]),
    ("negative length", "value = 0.33,", "value = -0.33,", ["geometry.thigh_length", "-0.33 m", "> 0 m"]),
    ("zero length", "value = 0.29,", "value = 0.0,", ["geometry.shank_length", "got 0 m", "> 0 m"]),
    ("foot above ankle", "value = 0.07,", "value = -0.07,", ["geometry.ankle_height", "-0.07 m", ">= 0 m"]),
    ("flat box", "[0.15, 0.3, 0.4]", "[0.15, 0.3, 0.0]", ["trunk.pack.box", "0 m", "> 0 m"]),
    ("negative gain", KP, KP.replace("3000", "-3000"), ["servo.kp", "-3000 N m/rad", "> 0 N m/rad"]),
    ("negative damping", "30.0, 40.0,", "30.0, -40.0,", ["servo.kv", "-40 N m s/rad", ">= 0"]),
    ("negative integral", "[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], unit = \"N m/(rad s)\"",
     '[1.0, 2.0, -3.0, 4.0, 5.0, 6.0], unit = "N m/(rad s)"', ["servo.ki", "-3 N m/(rad s)", ">= 0"]),
    ("negative armature", "[0.1, 0.2, 0.3,", "[0.1, -0.2, 0.3,",
     ["servo.armature", "-0.2 kg m2", ">= 0 kg m2"]),
    ("no torque", "[110.0, ", "[0.0, ", ["servo.torque_limit", "0 N m", "> 0 N m"]),
    ("no speed", "6.0], unit = \"rad/s\"", '-6.0], unit = "rad/s"',
     ["servo.speed_limit", "-6 rad/s", "> 0 rad/s"]),
    # not numbers
    ("nan", "value = 0.33,", "value = nan,", ["geometry.thigh_length", "nan m", "> 0 m"]),
    ("infinite mass", "value = 6.5,", "value = inf,", ["leg.thigh.mass", "inf kg", "> 0 kg"]),
    ("infinite limit", "-1.9, 0.05", "-inf, 0.05", ["limits.lower", "-inf rad", "any finite number"]),
    ("nan in a vector", "[0.03, 0.01, 0.35]", "[0.03, nan, 0.35]",
     ["trunk.chest.com", "nan m", "any finite"]),
    ("text", "value = 0.33,", 'value = "0.33",', ["geometry.thigh_length", "'0.33'", "numbers [m]"]),
    ("truth", "value = 6.5,", "value = true,", ["leg.thigh.mass", "True", "numbers [kg]"]),
    ("text in a vector", "[0.03, 0.01, 0.35]", '[0.03, "a", 0.35]',
     ["trunk.chest.com", "'a'", "numbers [m]"]),
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
    ("no unit", 'value = 0.33, unit = "m",', "value = 0.33,", ["geometry.thigh_length", "None", "'m'"]),
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
    ("no name", 'name = "lopsided"', "", ["name", "None", "a text"]),
    ("name no text", 'name = "lopsided"', "name = 3", ["name", "3", "a text"]),
    ("no mass", THIGH_MASS, "", ["leg.thigh.mass", "missing", "> 0 [kg]"]),
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
    # unknown, at every level
    ("unknown key of a number", "value = 6.5,", "value = 6.5, note = 1,",
     ["leg.thigh.mass", "'note'", "unit"]),
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
    assert message.startswith("wrong.toml: ")
    for word in words:
        assert word in message


def test_masses_may_miss_the_total_by_half_a_gram(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(LOPSIDED.replace("value = 61.0,", "value = 61.0005,"))
    robot.load(path)


@pytest.mark.parametrize(
    "content",
    [b"name = ", b"\x89PNG\r\n\x1a\n\xff\xfe", b"[a]\n[a]\n", b"{}"],
    ids=["cut", "binary", "twice", "json"],
)
def test_not_toml(tmp_path, content):
    path = tmp_path / "wrong.toml"
    path.write_bytes(content)
    assert refusal(path).startswith("wrong.toml: ")


def test_empty_file(tmp_path):
    path = tmp_path / "wrong.toml"
    path.write_text("")
    assert "name: got None" in refusal(path)


@pytest.mark.parametrize("name", ["surena4", "no/such/robot.toml", ""])
def test_no_such_robot(name):
    message = refusal(name)
    assert "elkahlout, surena3 or the path of a .toml file" in message
    assert name in message


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


def test_good_file_is_not_refused(tmp_path):
    path = tmp_path / "good.toml"
    path.write_text(LOPSIDED)
    assert robot.load(path).name == "lopsided"
    assert robot.load(str(path)).name == "lopsided"

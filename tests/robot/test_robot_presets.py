"""The presets hold the papers' numbers; any robot file becomes a record of two mirrored legs."""

import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxbiped import robot

LOPSIDED = Path(__file__).parent / "lopsided.toml"
ROBOTS = ["surena3", "elkahlout", str(LOPSIDED)]
FLIP = np.array([1.0, -1.0, 1.0])


def by_field(name: str) -> dict[str, robot.Number]:
    return {number.field: number for number in robot.numbers(name)}


def leg_mass(params: robot.RobotParams, side: int) -> float:
    return float(params.links.mass[1 + 6 * side : 7 + 6 * side].sum())


def test_both_presets_are_there():
    assert robot.presets() == ("elkahlout", "surena3")


@pytest.mark.parametrize(
    ("field", "stated"),
    [
        ("leg.foot.mass", 3.859),
        ("leg.ankle.mass", 2.236),
        ("leg.shank.mass", 4.561),
        ("leg.thigh.mass", 6.327),
        ("trunk.pelvis.mass", 17.800),
        ("trunk.upper_body.mass", 28.482),
        ("overall.mass", 82.0),
        ("overall.height", 1.85),
        ("geometry.ankle_height", 0.098),
        ("geometry.shank_length", 0.360),
        ("geometry.thigh_length", 0.360),
    ],
)
def test_surena3_has_the_numbers_of_khadiv_table_1(field, stated):
    number = by_field("surena3")[field]
    assert number.value == stated
    assert number.kind == "stated" and "khadiv Table 1" in number.source


@pytest.mark.parametrize(
    ("high", "low", "stated"),
    [
        ("geometry.sole_toe", "geometry.sole_heel", 0.265),
        ("geometry.sole_outer", "geometry.sole_inner", 0.160),
    ],
)
def test_surena3_has_the_foot_of_khadiv_table_1(high, low, stated):
    numbers = by_field("surena3")
    assert numbers[high].value - numbers[low].value == pytest.approx(stated, abs=1e-12)
    assert {numbers[high].kind, numbers[low].kind} == {"stated"}


@pytest.mark.parametrize("axis", ["yaw", "roll", "pitch"])
def test_surena3_hips_are_230_mm_apart(axis):
    number = by_field("surena3")[f"geometry.hip_{axis}_axis"]
    assert 2.0 * number.value[1] == pytest.approx(0.230, abs=1e-12)
    assert number.kind == "stated"


def test_surena3_upper_body_is_as_high_as_the_stated_distance_from_pelvis_to_head():
    number = by_field("surena3")["trunk.upper_body.box"]
    assert number.value[2] == 0.767
    assert "distance between pelvis and head" in number.source


def test_surena3_mass_is_table_1_plus_the_crosses_it_leaves_out():
    surena3 = robot.load("surena3")
    masses = dict(zip(robot.LINK_NAMES, np.asarray(surena3.links.mass), strict=True))
    crosses = sum(masses[f"{side}_hip_{axis}"] for side in robot.SIDE_NAMES for axis in ("yaw", "roll"))
    listed = 2 * (3.859 + 2.236 + 4.561 + 6.327) + 17.800 + 28.482
    assert listed == pytest.approx(80.248, abs=1e-9)
    assert sum(masses.values()) - crosses == pytest.approx(listed, abs=1e-9)
    assert float(surena3.total_mass) == pytest.approx(82.0, abs=1e-9)


def test_surena3_trunk_is_pelvis_and_upper_body_welded():
    surena3 = robot.load("surena3")
    assert float(surena3.links.mass[0]) == pytest.approx(17.800 + 28.482, abs=1e-9)
    height = (17.800 * 0.05 + 28.482 * 0.3835) / (17.800 + 28.482)
    np.testing.assert_allclose(surena3.links.com[0], [0.0, 0.0, height], atol=1e-12)


def test_elkahlout_has_the_masses_of_section_3_1():
    elkahlout = robot.load("elkahlout")
    assert float(elkahlout.links.mass[0]) == 50.0
    assert leg_mass(elkahlout, robot.LEFT) == pytest.approx(15.0, abs=1e-12)
    assert leg_mass(elkahlout, robot.RIGHT) == pytest.approx(15.0, abs=1e-12)
    assert float(elkahlout.total_mass) == pytest.approx(80.0, abs=1e-12)


def test_elkahlout_trunk_is_the_box_of_section_3_3():
    elkahlout = robot.load("elkahlout")
    length, width, height, mass = 0.2, 0.4, 0.5, 50.0
    moments = mass / 12.0 * np.array([width**2 + height**2, length**2 + height**2, length**2 + width**2])
    np.testing.assert_allclose(elkahlout.links.inertia[0], np.diag(moments), atol=1e-12)
    np.testing.assert_allclose(elkahlout.links.com[0], [-0.05, 0.0, 0.25], atol=1e-12)
    for field in ("mass", "com", "box"):
        assert by_field("elkahlout")[f"trunk.body.{field}"].kind == "stated"


@pytest.mark.parametrize("name", robot.presets())
def test_every_number_of_a_preset_has_its_unit_and_where_it_comes_from(name):
    numbers = robot.numbers(name)
    assert len(numbers) >= 2 + 10 + 3 + 6 * 3 + 6 + 2  # overall, geometry, trunk, legs, servo, limits
    for number in numbers:
        assert number.unit in {
            "kg",
            "m",
            "kg m2",
            "rad",
            "rad/s",
            "N m",
            "N m/rad",
            "N m s/rad",
            "N m/(rad s)",
        }
        assert number.kind in {"stated", "assumed"}
        assert len(number.source) > 8, number.field
        if number.kind == "stated":
            assert number.source.startswith(("khadiv", "elkahlout")), number.field


@pytest.mark.parametrize("name", ROBOTS, ids=lambda name: Path(name).stem)
def test_links_mirror(name):
    links = robot.load(name).links
    left, right = slice(1, 7), slice(7, 13)
    np.testing.assert_array_equal(links.mass[left], links.mass[right])
    np.testing.assert_array_equal(links.com[left] * FLIP, links.com[right])
    mirror = np.diag(FLIP)
    np.testing.assert_array_equal(mirror @ links.inertia[left] @ mirror, links.inertia[right])


@pytest.mark.parametrize("name", ROBOTS, ids=lambda name: Path(name).stem)
def test_hips_and_soles_mirror(name):
    params = robot.load(name)
    np.testing.assert_array_equal(params.p_pelvis_hip[0] * FLIP, params.p_pelvis_hip[1])
    toe_left, toe_right, heel_left, heel_right = np.asarray(params.p_sole_corner[0] * FLIP)
    np.testing.assert_array_equal(params.p_sole_corner[1], [toe_right, toe_left, heel_right, heel_left])
    for corners in np.asarray(params.p_sole_corner):
        assert corners[0, 0] == corners[1, 0] > corners[2, 0] == corners[3, 0]
        assert corners[0, 1] == corners[2, 1] > corners[1, 1] == corners[3, 1]
        assert not corners[:, 2].any()


@pytest.mark.parametrize("name", ROBOTS, ids=lambda name: Path(name).stem)
def test_servos_and_joint_ranges_mirror(name):
    params = robot.load(name)
    for gain in jax.tree.leaves(params.servo):
        np.testing.assert_array_equal(gain[0], gain[1])
    for joint, joint_name in enumerate(robot.JOINT_NAMES):
        lower, upper = np.asarray(params.joint_range[0, joint])
        mirrored = [-upper, -lower] if joint_name in ("hip_yaw", "hip_roll", "ankle_roll") else [lower, upper]
        np.testing.assert_array_equal(params.joint_range[1, joint], mirrored)


def test_users_own_file_is_read_number_by_number():
    own = robot.load(LOPSIDED)
    numbers = by_field(str(LOPSIDED))
    assert own.name == "lopsided"
    np.testing.assert_array_equal(own.p_pelvis_hip[0], [0.02, 0.09, -0.03])
    assert (float(own.thigh_length), float(own.shank_length), float(own.ankle_height)) == (0.33, 0.29, 0.07)
    assert float(own.height) == 1.5
    np.testing.assert_array_equal(
        own.p_sole_corner[0], [[0.17, 0.08, 0], [0.17, -0.05, 0], [-0.06, 0.08, 0], [-0.06, -0.05, 0]]
    )
    for key in ("kp", "kv", "ki", "armature", "torque_limit", "speed_limit"):
        np.testing.assert_array_equal(getattr(own.servo, key)[0], numbers[f"servo.{key}"].value)
    np.testing.assert_array_equal(own.joint_range[0, :, 0], numbers["limits.lower"].value)
    np.testing.assert_array_equal(own.joint_range[0, :, 1], numbers["limits.upper"].value)
    for link, name in enumerate(robot.LEG_LINK_NAMES, start=1):
        assert own.links.mass[link] == numbers[f"leg.{name}.mass"].value
        np.testing.assert_array_equal(own.links.com[link], numbers[f"leg.{name}.com"].value)
    np.testing.assert_array_equal(
        own.links.inertia[3], [[0.08, 0.004, 0.006], [0.004, 0.09, -0.005], [0.006, -0.005, 0.02]]
    )
    np.testing.assert_array_equal(own.links.inertia[1], np.diag([0.004, 0.005, 0.006]))


@pytest.mark.parametrize("name", robot.presets())
def test_copied_preset_loads_like_the_preset(tmp_path, name):
    preset = Path(robot.__file__).parent / "presets" / f"{name}.toml"
    copy = tmp_path / "mine.toml"
    copy.write_text(preset.read_text())
    for one, other in zip(jax.tree.leaves(robot.load(copy)), jax.tree.leaves(robot.load(name)), strict=True):
        np.testing.assert_array_equal(one, other)


def given(name: str) -> dict:
    """The file itself."""
    path = Path(name) if name.endswith(".toml") else Path(robot.__file__).parent / "presets" / f"{name}.toml"
    return tomllib.loads(path.read_text())


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("name", ROBOTS, ids=lambda name: Path(name).stem)
def test_robots_are_kept_on_the_host_as_their_files_say(name, double):
    with jax.enable_x64(double):
        params, file = robot.load(name), given(name)
    for leaf in jax.tree.leaves(params):
        assert isinstance(leaf, np.ndarray) and leaf.dtype == np.float64 and not leaf.flags.writeable
    for key in ("thigh_length", "shank_length", "ankle_height"):
        assert float(getattr(params, key)) == file["geometry"][key]["value"]
    assert float(params.height) == file["overall"]["height"]["value"]
    for key, number in file["servo"].items():
        np.testing.assert_array_equal(getattr(params.servo, key)[0], number["value"])
    for i, limit in enumerate(("lower", "upper")):
        np.testing.assert_array_equal(params.joint_range[0, :, i], file["limits"][limit]["value"])
    for link, body in enumerate(robot.LEG_LINK_NAMES, start=1):
        assert params.links.mass[link] == file["leg"][body]["mass"]["value"]
        np.testing.assert_array_equal(params.links.com[link], file["leg"][body]["com"]["value"])
    trunk = sum(body["mass"]["value"] for body in file["trunk"].values())
    assert params.links.mass[0] == pytest.approx(trunk, rel=1e-15)


@pytest.mark.parametrize(("double", "kind"), [(False, np.float32), (True, np.float64)])
@pytest.mark.parametrize("name", ROBOTS, ids=lambda name: Path(name).stem)
def test_on_the_device_they_have_jax_s_default_float(name, double, kind):
    host = robot.load(name)
    with jax.enable_x64(double):
        device = robot.on_device(host)
        again, traced = robot.on_device(device), jax.jit(lambda r: r)(host)
    assert jax.tree.structure(device) == jax.tree.structure(host)
    trees = (host, device, again, traced)
    for one, other, same, through_jit in zip(*map(jax.tree.leaves, trees), strict=True):
        assert isinstance(other, jax.Array) and other.dtype == kind and not other.weak_type
        np.testing.assert_array_equal(np.asarray(other), one.astype(kind))
        np.testing.assert_array_equal(np.asarray(other), np.asarray(through_jit))
        assert through_jit.dtype == kind and same is other

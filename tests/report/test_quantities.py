"""Values of a table are rounded by the unit of their column, and are never shown as code would."""

import math

import pytest

from jaxbiped.batch import INPUTS, NEVER
from jaxbiped.report import quantities


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("zmp_margin_m", -6.035e-08, "0.0000"),
        ("zmp_margin_m", -0.00005001, "-0.0001"),
        ("x_m", 1.23456, "1.2346"),
        ("peak_pitch_deg", 3.14159, "3.14"),
        ("peak_pitch_deg", -0.001, "0.00"),
        ("peak_force_left_N", 1234567.89, "1234568"),
        ("peak_force_left_N", -0.4, "0"),
        ("touchdown_impulse_left_Ns", 7.26, "7.3"),
        ("end_time_s", 7.00049, "7.000"),
        ("load_kg", 2.5, "2.500"),
        ("angle_noise_rad", 0.01745, "0.0175"),
        ("slip_speed_m_per_s", 0.01, "0.0100"),
        ("damping_s_per_m", 10.0, "10.00"),
        ("sinkage_m", 5e-5, "0.00005"),
        ("information_bits", 0.98765, "0.988"),
        ("rate", 1 / 3, "0.333"),
        ("rate", 1e-12, "0.000"),
        ("friction", 0.8, "0.800"),
        ("gain_scale", 1.0, "1.000"),
        ("row", 12345678, "12345678"),
        ("success", True, "yes"),
        ("success", False, "no"),
        ("variant", "off", "off"),
        ("trigger_s", None, quantities.NOTHING),
        ("peak_pitch_deg", math.nan, quantities.NOTHING),
        ("zmp_margin_m", math.inf, "infinite"),
        ("zmp_margin_m", -math.inf, "minus infinite"),
        ("end_time_s", math.inf, "infinite"),
        ("load_time_s", NEVER, quantities.NEVER_SHOWN),
        ("peak_force_left_N", 1e30, "over 1000000000"),
        ("peak_force_left_N", -1e30, "under -1000000000"),
    ],
)
def test_values_are_rounded_by_the_unit_of_their_column(column, value, said):
    assert quantities.text(value, column) == said


@pytest.mark.parametrize(
    ("column", "value", "said", "with_unit"),
    [
        ("step_2_height_m", 0.03, "30", "30 mm"),
        ("step_2_height_m", -1e-9, "0", "0 mm"),
        ("load_kg", 12.5, "12.5", "12.5 kg"),
        ("load_time_s", 4.125, "4.125", "4.125 s"),
        ("load_time_s", NEVER, "never", "never"),
        ("load_time_s", math.nan, "–", "–"),
        ("load_kg", None, "–", "–"),
        ("push_x_N", 1500.0, "1500", "1500 N"),
        ("angle_noise_rad", math.radians(0.25), "0.25", "0.25 deg"),
        ("friction", 0.4, "0.4", "0.4"),
        ("x_m", 1.5, "1.5", "1.5 m"),
        ("peak_force_left_N", math.inf, "infinite", "infinite"),
    ],
)
def test_figures_show_values_short_and_in_their_units(column, value, said, with_unit):
    assert quantities.short(value, column) == said
    assert quantities.with_unit(value, column) == with_unit


@pytest.mark.parametrize("column", [*INPUTS, "step_3_height_m", "zmp_margin_m", "peak_force_left_N", "rate"])
@pytest.mark.parametrize("magnitude", [1e-300, 1e-20, 1e-7, 1e-4, 0.4, 1.0, 1e5, 1e12, 1e300])
def test_no_number_is_shown_by_powers_of_ten_nor_as_minus_zero(column, magnitude):
    for value in (magnitude, -magnitude):
        for said in (quantities.text(value, column), quantities.short(value, column)):
            assert said == quantities.NEVER_SHOWN or "e" not in said.removeprefix("over ").removeprefix(
                "under "
            )
            assert said.strip("-0.") or not said.startswith("-")
            assert len(said) < 20


@pytest.mark.parametrize("column", INPUTS)
def test_defaults_of_inputs_survive_rounding(column):
    default = float(INPUTS[column].default)
    said = quantities.text(default, column)
    assert said == quantities.NEVER_SHOWN if default >= NEVER else float(said) == default

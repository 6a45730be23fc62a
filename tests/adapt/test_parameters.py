"""Parameters of both stages: declared once, believed by nobody."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

from jaxbiped import robot
from jaxbiped.adapt import STAGES, Landing, PayloadReflex, tunables
from jaxbiped.adapt.parameters import declared as declared_by
from jaxbiped.checked import Flag, Quantity
from jaxbiped.planner import CosineGait

NUMBERS = [
    (record, name, declared)
    for record in (Landing, PayloadReflex)
    for name, declared in declared_by(record).items()
    if isinstance(declared, Quantity)
]
SWITCHES = [
    (record, name)
    for record in (Landing, PayloadReflex)
    for name, declared in declared_by(record).items()
    if isinstance(declared, Flag)
]


@pytest.fixture(autouse=True)
def as_users_meet_it(monkeypatch):
    """Without the tests' own checks of annotations."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def make(record, **parameters):
    needed = {"zmp_balanced": -0.035, "smooth_reflex": False} if record is PayloadReflex else {}
    return record(**{**needed, **parameters})


@pytest.fixture(scope="module")
def walk():
    biped = robot.load("elkahlout")
    return biped, CosineGait.preset(biped, 2)


@pytest.mark.parametrize("record", [Landing, PayloadReflex])
def test_every_parameter_is_declared_with_its_text(record):
    declared = declared_by(record)
    assert [field.name for field in dataclasses.fields(record)] == list(declared)
    assert all(parameter.text.endswith(".") for parameter in declared.values())
    for name, parameter in declared.items():
        if isinstance(parameter, Quantity):
            assert math.isfinite(parameter.low) and math.isfinite(parameter.high), name
            assert parameter.unit in ("m", "s", "m/s", "m/s2", "N", "")


@pytest.mark.parametrize(("record", "name", "declared"), NUMBERS, ids=lambda value: str(value)[:20])
def test_what_is_no_plausible_number_is_refused(record, name, declared):
    table = declared.shapes != ((),)
    wrong = [math.nan, -math.inf, 1e300, -1e300, 1e39, 1e-60, True, "0.1", 10**400, 1e6, -1e6]
    wrong += [] if declared.endless else [math.inf]
    for value in wrong:
        given = [[value, 0.0], [0.0, 0.0], [0.0, 0.0]] if table else value
        with pytest.raises(ValueError, match=rf"^{name}: got .*allowed: ") as refusal:
            make(record, **{name: given})
        assert "\n" not in str(refusal.value)
        if declared.unit:
            assert declared.unit in str(refusal.value)
    for value in ([0.1], [], {}, [[0.1]], jnp.zeros(2)):
        with pytest.raises(ValueError, match=rf"^{name}: got .*allowed: "):
            make(record, **{name: value})
    if not declared.optional:
        with pytest.raises(ValueError, match=rf"^{name}: got nothing"):
            make(record, **{name: None})


@pytest.mark.parametrize(("record", "name", "declared"), NUMBERS, ids=lambda value: str(value)[:20])
def test_bounds_themselves(record, name, declared):
    shape = declared.shapes[0]
    made = make(record, **{name: np.full(shape, declared.high)})
    np.testing.assert_allclose(getattr(made, name), declared.high, rtol=1e-6)
    assert getattr(made, name).dtype == jnp.float32
    if declared.above:
        with pytest.raises(ValueError, match=rf"^{name}: got "):
            make(record, **{name: np.full(shape, declared.low)})
    else:
        make(record, **{name: np.full(shape, declared.low)})


@pytest.mark.parametrize(
    ("name", "value", "hint"),
    [
        ("delta_z", 10.0, "10 mm is 0.01 m"),
        ("T_mod", 70, "70 ms is 0.07 s"),
        ("descent_speed", 200.0, "200 mm/s is 0.2 m/s"),
        ("descent_acceleration", 3000.0, "3000 mm/s2 is 3 m/s2"),
        ("max_descent", 80.0, "80 mm is 0.08 m"),
        ("release_share", 90.0, "90 % is 0.9"),
    ],
)
def test_another_unit_is_named(name, value, hint):
    with pytest.raises(ValueError, match=rf"^{name}: got .*{hint}"):
        Landing(**{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("reflex_time", 100.0),
        ("settling_time", 4000),
        ("shift_time", 500),
        ("zmp_balanced", -35),
        ("body_time", 1200),
    ],
)
def test_another_unit_is_named_by_the_reflex(name, value):
    with pytest.raises(ValueError, match=rf"^{name}: got {value:g} (m|s), .*{value:g} m[ms] is "):
        make(PayloadReflex, **{name: value})


@pytest.mark.parametrize(("record", "name"), SWITCHES)
def test_switches_are_true_or_false(record, name):
    for value in ("no", "false", 0, 1, None, 0.0, [], jnp.asarray(True)):
        with pytest.raises(ValueError, match=rf"^{name}: got .*, allowed: true or false$"):
            make(record, **{name: value})
    for value in (True, False, np.bool_(False)):
        assert getattr(make(record, **{name: value}), name) is bool(value)


@pytest.mark.parametrize(("record", "name"), SWITCHES)
def test_named_variants_accept_switches(walk, record, name):
    biped, gait = walk
    given = {"threshold": 50.0, "zmp_balanced": -0.03, "x_stand": 0.0, "body_time": 0.5}
    for variant in Landing.variants if record is Landing else PayloadReflex.variants:
        for value in (True, False):
            make_variant = getattr(record, variant)
            switch = {name: value}
            made = (
                make_variant(**switch) if record is Landing else make_variant(biped, gait, **given, **switch)
            )
            assert getattr(made, name) is value


def test_the_literal_variants_have_their_switches_off(walk):
    paper = Landing.paper(keep_x=True)
    assert paper.keep_x and not any(
        getattr(paper, name) for name in ("stays_down", "no_undershoot", "interpolate")
    )
    reflex = PayloadReflex.original(*walk, threshold=50.0, zmp_balanced=-0.03, smooth_reflex=True)
    assert reflex.smooth_reflex and reflex.interpolate
    assert not (reflex.two_speeds or reflex.steady_recovery or reflex.starts_again or reflex.smooth_resume)


def test_unknown_parameters_are_a_type_error_with_the_nearest(walk):
    for call in (Landing.paper, Landing.repaired):
        with pytest.raises(TypeError, match=r"descent_sped: unknown, .*did you mean 'descent_speed'\?"):
            call(descent_sped=0.2)
    for call in (PayloadReflex.original, PayloadReflex.modified, PayloadReflex.repaired):
        with pytest.raises(TypeError, match=r"settlingtime: unknown, .*did you mean 'settling_time'\?"):
            call(*walk, settlingtime=0.2)
    with pytest.raises(TypeError):
        Landing(**{"descent_sped": 0.2})  # type: ignore[arg-type]


def test_traced_values_are_not_judged():
    assert jax.jit(lambda speed: Landing.paper(descent_speed=speed).descent_speed)(-1.0) == -1.0
    assert jax.grad(lambda time: make(PayloadReflex, reflex_time=time).reflex_time ** 2)(-1.0) == -2.0
    assert (
        jax.vmap(lambda gain: make(PayloadReflex, x_ref_gain=gain).x_ref_gain)(jnp.array([-1.0, 9.0]))[1]
        == 9.0
    )


def test_another_value_is_checked_too():
    with pytest.raises(ValueError, match=r"^T_mod: got nan s"):
        dataclasses.replace(Landing(), T_mod=math.nan)


@pytest.mark.parametrize("name", tunables.known())
def test_tunables_stay_within_what_is_declared(name):
    tunable = tunables.known()[name]
    declared = declared_by(STAGES[tunable.stage])[tunable.field]
    assert isinstance(declared, Quantity) and tunable.unit == declared.unit
    assert declared.contains([tunable.low, tunable.high]).all()

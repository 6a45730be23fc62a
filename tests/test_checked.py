"""Input is refused in one line that says what was given, what is allowed, the unit and the nearest name."""

import datetime
import math
import tomllib

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxbiped import checked
from jaxbiped.checked import MAX_BYTES, MAX_DEPTH, Flag, Quantity, Refusal, Word

LENGTH = Quantity("m", 0.02, 2.0)
GAINS = Quantity("N m/rad", 1e-3, 1e7, shapes=((6,),))
TABLE = Quantity("m", -0.2, 0.2, shapes=((3, 2),))


@pytest.fixture(autouse=True, scope="module")
def as_users_meet_it():
    """Without the tests' own checks of annotations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jaxtyping.config, "jaxtyping_disable", True)
        yield


def refusal(call, *args, error: type[Exception] = Refusal) -> str:
    with pytest.raises(error) as caught:
        call(*args)
    assert type(caught.value) is error
    assert str(caught.value).isprintable() and len(str(caught.value)) < 600
    return str(caught.value)


# ---------------------------------------------------------------- numbers

RANGE = "allowed: >= 0.02 and <= 2 m"
NO_NUMBERS = [
    ("0.2", "the text '0.2'"),
    (True, "the truth value true"),
    (np.bool_(False), "the truth value false"),
    (jnp.asarray(True), "the truth value true"),
    (np.array("a"), "the text 'a'"),
    (np.array(["a"]), "['a']"),
    (None, "nothing"),
    ({"value": 1}, "a table"),
    (datetime.date(2020, 1, 2), "the date or time 2020-01-02"),
    (datetime.time(7, 30), "the date or time 07:30:00"),
    (1 + 2j, "(1+2j)"),
]


@pytest.mark.parametrize(("value", "words"), NO_NUMBERS, ids=lambda value: str(value)[:20])
def test_what_is_no_number_is_refused_and_named(value, words):
    message = refusal(LENGTH.check, "x", value)
    assert message.startswith("x: got ") and words in message and "one number [m]" in message


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (math.nan, "got nan m"),
        (math.inf, "got inf m"),
        (-math.inf, "got -inf m"),
        (0.0199, "got 0.0199 m"),
        (1e300, "got 1e+300 m (infinite in float32)"),
        (1e39, "got 1e+39 m (infinite in float32)"),
        (1e-60, "got 1e-60 m (0 in float32)"),
        (10**400, "got a whole number of about 401 digits"),
        (10**5000, "got a whole number of about 5001 digits"),
        (-(10**400), "got a whole number of about 401 digits"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_out_of_range_is_refused(value, words):
    message = refusal(LENGTH.check, "x", value)
    assert message.startswith(f"x: {words}") and RANGE in message


@pytest.mark.parametrize(
    ("unit", "low", "high", "value", "hint"),
    [
        ("m", 0.02, 2.0, 360, "360 mm is 0.36 m"),
        ("m", 0.02, 2.0, 36, "36 mm is 0.036 m or 36 cm is 0.36 m"),
        ("s", 0.0, 2.0, 30, "30 ms is 0.03 s"),
        ("rad", -6.3, 6.3, 90, "90 deg is 1.571 rad"),
        ("kg", 0.1, 500.0, 82000, "82000 g is 82 kg"),
        ("m/s", 0.0, 5.0, 200, "200 mm/s is 0.2 m/s"),
        ("rad/s", 0.1, 100.0, 344, "344 deg/s is 6.004 rad/s"),
        ("kg m2", 0.0, 10.0, 80, "80 kg cm2 is 0.008 kg m2"),
        ("", 0.0, 2.0, 90, "90 % is 0.9"),
    ],
)
def test_another_unit_is_named_if_the_number_would_be_in_range(unit, low, high, value, hint):
    assert hint in refusal(Quantity(unit, low, high).check, "x", value)


def test_no_unit_is_named_that_would_not_help():
    for value in (1e9, math.inf, 0.0, -1.0):
        assert refusal(LENGTH.check, "x", value).endswith(RANGE)


@pytest.mark.parametrize(
    "value", [0.3, 1, np.float32(0.3), np.int8(1), jnp.asarray(0.3), np.array(2.0), 0.02, 2.0]
)
def test_numbers_of_every_kind_come_back_as_float(value):
    assert type(LENGTH.check("x", value)) is float and LENGTH.check("x", value) == float(value)


def test_bounds_are_those_of_float32():
    """A bound that float32 rounds is met by the same number in float32."""
    for bound in (0.02, 0.1, 1 / 3, 1e-5):
        assert Quantity("m", bound, 1.0).check("x", np.float32(bound)) == float(np.float32(bound))
    assert Quantity("m", 0.0, 1.0, above=True).check("x", 1e-30) == 1e-30
    for value in (0.0, -0.0, 1e-39, 1e-46):
        assert "> 0 and <= 1 m" in refusal(Quantity("m", 0.0, 1.0, above=True).check, "x", value)


def test_infinite_and_missing_only_where_declared():
    assert Quantity("s", 0.0, 600.0, endless=True).check("x", math.inf) == math.inf
    for value in (-math.inf, math.nan, 601.0, 1e39):
        assert "or infinite" in refusal(Quantity("s", 0.0, 600.0, endless=True).check, "x", value)
    assert Quantity("s", 0.0, 1.0, optional=True).check("x", None) is None


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([1.0] * 5, "allowed: 6 numbers [N m/rad]"),
        ([[1.0] * 6], "got [[1, 1, 1, 1, 1, 1]]"),
        ([], "got []"),
        (3.0, "got 3"),
        ([1, 2, [3], 4, 5, 6], "got [1, 2, [3], 4, 5, 6]"),
        ([1, 2, "3", 4, 5, 6], "the text '3'"),
        ([1, 2, True, 4, 5, 6], "the truth value true"),
        ([1, 2, 3, -4, 5, 6], "got -4 N m/rad in place 4"),
        ([1, 2, 3, 1e39, 5, 6], "got 1e+39 N m/rad in place 4 (infinite in float32)"),
        ([1, 2, 3, 10**400, 5, 6], "a whole number of about 401 digits"),
        (np.ones((6, 1)), "6 numbers"),
        ([1.0] * 100_000, "..."),
    ],
    ids=lambda value: str(value)[:30],
)
def test_tables_of_numbers(value, words):
    assert words in refusal(GAINS.check, "kp", value)


def test_tables_come_back_as_arrays():
    for value in ([1, 2, 3, 4, 5, 6], (1.0, 2, 3, 4, 5, 6), np.arange(1, 7), jnp.arange(1.0, 7.0)):
        np.testing.assert_array_equal(GAINS.check("kp", value), np.arange(1.0, 7.0))
    assert TABLE.check("t", [[0.1, 0.0]] * 3).shape == (3, 2)
    assert "in place 3, 1" in refusal(TABLE.check, "t", [[0.1, 0.0], [0.1, 0.0], [10.0, 0.0]])
    assert "3 x 2 numbers" in refusal(TABLE.check, "t", [[0.1, 0.0]] * 2)


def test_what_is_traced_is_not_judged_but_for_its_shape():
    assert jax.jit(lambda x: LENGTH.check("x", x))(-1.0) == -1.0
    assert jax.grad(lambda x: LENGTH.check("x", x) ** 2)(-1.0) == -2.0
    assert jax.jit(lambda x: TABLE.check("x", [[x, x]] * 3)[0][0])(9.0) == 9.0
    assert "shape (2,)" in refusal(jax.jit(lambda x: LENGTH.check("x", x)), jnp.ones(2))


@given(
    st.floats() | st.integers() | st.text() | st.booleans() | st.lists(st.floats() | st.text(), max_size=8)
)
def test_a_number_is_finite_in_float32_or_refused(value):
    for quantity in (Quantity(), LENGTH, GAINS, Quantity("s", 0.0, above=True)):
        try:
            got = quantity.check("x", value)
        except Refusal as error:
            assert str(error).isprintable()
        else:
            single = np.float32(got)
            assert np.isfinite(single).all() and ((single == 0.0) == (np.asarray(value) == 0.0)).all()


# ---------------------------------------------------------------- switches, words, whole numbers, names


def test_switches_are_true_or_false_only():
    assert Flag().check("x", True) is True and Flag().check("x", np.bool_(False)) is False
    for value, words in (
        ("no", "the text 'no'"),
        (1, "got 1"),
        (0.0, "got 0"),
        ([], "got []"),
        (None, "nothing"),
    ):
        message = refusal(Flag().check, "x", value)
        assert words in message and message.endswith("allowed: true or false")


def test_words_are_one_of_a_few():
    word = Word(("off", "paper", "repaired"))
    assert word.check("base", "paper") == "paper"
    assert refusal(word.check, "base", "papr") == (
        "base: got 'papr', allowed: off, paper, repaired; did you mean 'paper'?"
    )
    assert "the truth value true" in refusal(word.check, "base", True)
    assert "did you mean" not in refusal(word.check, "base", "xyzzy")


def test_whole_numbers():
    for value in (3, np.int64(3), np.uint8(3), jnp.asarray(3)):
        assert type(checked.whole("n", value, 1, 9)) is int
    for value, words in (
        (True, "the truth value true"),
        (np.bool_(True), "the truth value true"),
        (3.0, "the float 3.0"),
        (np.float32(3.0), "the float 3.0"),
        ("3", "the text '3'"),
        (None, "nothing"),
        (0, "got 0"),
        (10, "got 10"),
        (10**5000, "digits"),
    ):
        message = refusal(checked.whole, "n", value, 1, 9)
        assert words in message and message.endswith("allowed: a whole number >= 1 and <= 9")


def test_unknown_names_and_the_nearest():
    message = refusal(checked.refuse_unknown, "payload.", ["setling_time"], ["settling_time", "threshold"])
    assert message == (
        "payload.setling_time: unknown, allowed: settling_time, threshold; did you mean 'settling_time'?"
    )
    assert "\\n" in refusal(checked.refuse_unknown, "", ["a\nb"], ["c"])
    assert len(refusal(checked.refuse_unknown, "", ["a" * 100_000], ["c"])) < 200


def test_a_table_of_a_file():
    fields = {"base": Word(("a", "b")), "x": LENGTH, "on": Flag(), "t": TABLE}
    table = {"base": "a", "x": 1, "on": False, "t": [[0, 0], [0, 0], [0, 0.1]]}
    read = checked.read_table("stage", table, fields, ("base",))
    assert read == {"base": "a", "x": 1.0, "on": False, "t": [[0.0, 0.0], [0.0, 0.0], [0.0, 0.1]]}
    assert "stage: got the text 'a', allowed: a table" in refusal(checked.read_table, "stage", "a", fields)
    assert "stage.base: missing, allowed: a, b" in refusal(checked.read_table, "stage", {}, fields, ("base",))
    assert "stage.z: unknown" in refusal(checked.read_table, "stage", {"z": 1}, fields)
    assert "stage.x: got nan m" in refusal(checked.read_table, "stage", {"x": math.nan}, fields)


# ---------------------------------------------------------------- TOML

DEEP = 100_000
WRONG = {
    "arrays": b"a = " + b"[" * DEEP + b"]" * DEEP,
    "unfinished arrays": b"a = " + b"[" * DEEP,
    "inline tables": b"a = " + b"{a = " * DEEP + b"1" + b"}" * DEEP,
    "dotted keys": b".".join([b"a"] * DEEP) + b" = 1",
    "dotted tables": b"[" + b" . ".join([b'"a"'] * DEEP) + b"]",
    "dotted inline": b"x = {" + b".".join([b"a"] * DEEP) + b" = 1}",
    "brackets after four quotes": b'a = ["""" """", ' + b"[" * DEEP,
    "long": b"# " + b"x" * MAX_BYTES,
    "long number": b"\n\na = " + b"9" * 5000,
    "latin 1": "a = 1\nb = 'ü'".encode("latin-1"),
    "utf 16": "a = 1".encode("utf-16"),
    "cut": b"a = ",
    "twice": b"a = 1\na = 2",
    "table twice": b"[a]\n[a]",
    "date": b"a = 2020-13-45",
    "nul": b"a = \x00",
    "escapes": b'a = """' + b'\\"""' * DEEP,
    "quotes": b"a = '''" + b"'a" * DEEP,
    "return": b"a = 1\rb = 2",
    "yaml": b"a: 1",
}
LINES = {"long number": "at line 3", "latin 1": "at line 2", "utf 16": "at line 1", "date": "at line 1"}
LINES |= {"arrays": "at line 1", "nul": "at line 1"}


@pytest.mark.parametrize("name", WRONG)
def test_no_toml(tmp_path, name):
    path = tmp_path / "wrong.toml"
    path.write_bytes(WRONG[name])
    message = refusal(checked.read_toml, path)
    assert message.startswith("wrong.toml: ") and LINES.get(name, "") in message


@pytest.mark.parametrize(
    ("content", "wanted"),
    [
        (b"\xef\xbb\xbfa = 1", {"a": 1}),
        (b"a = 1\r\nb = 2\r\n", {"a": 1, "b": 2}),
        (b"", {}),
        (b'a = """x""""\nb = [[1]] # [[[[[[[[[[[[[[[[[[[[', {"a": 'x"', "b": [[1]]}),
        (b"a = '[[[[[[[[[[[[[[[[[[[['\nb = \"{{{{{{{{{{{{{{{{{{{{\"", {"a": "[" * 20, "b": "{" * 20}),
        (b"a = [" + b"1.5, " * 1000 + b"]", {"a": [1.5] * 1000}),
        (b"a = " + b"9" * 400, {"a": int("9" * 400)}),
        (b"a = 0x" + b"f" * 5000, {"a": int("f" * 5000, 16)}),
        (b"x = 1.2.3"[:7], {"x": 1.2}),
    ],
)
def test_toml(content, wanted):
    assert checked.parse_toml("x.toml", content) == wanted


def test_files_that_cannot_be_read(tmp_path):
    assert "got no file" in refusal(checked.read_toml, tmp_path / "nowhere.toml")
    assert "got no file" in refusal(checked.read_toml, tmp_path)


def test_the_error_is_the_callers():
    class Mine(Refusal):
        pass

    assert refusal(checked.parse_toml, "x", b"a = ", Mine, error=Mine)
    assert refusal(LENGTH.check, "x", 3, Mine, error=Mine)


LONGER = (
    '"""',
    "'''",
    "b.c",
    '"k"',
    "1e400",
    "nan",
    "inf",
    "true",
    "2020-01-01",
    "07:30:00",
    "0x1f",
    "1_0",
    "[[a]]",
)
PIECES = st.sampled_from([*"a.=[]{},\n\r\"'\\# 1-", *LONGER, "\r\n", "\ufeff", "\u2028"])


@settings(max_examples=400, deadline=None)
@given(st.binary(max_size=200) | st.lists(PIECES, max_size=60).map(lambda parts: "".join(parts).encode()))
@example(b"[" * 900)
def test_any_bytes_are_read_or_refused(content):
    try:
        read = checked.parse_toml("any.toml", content)
    except Refusal as error:
        assert str(error).startswith("any.toml: ") and str(error).isprintable()
    else:
        assert repr(read) == repr(tomllib.loads(content.decode("utf-8-sig")))
        assert depth_of(read) <= 3 * MAX_DEPTH


def depth_of(value) -> int:
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    return 0 if items is None else 1 + max(map(depth_of, items), default=0)

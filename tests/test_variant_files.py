"""The TOML files of a controller: what they may say, what is refused, and that what is written is read again."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxbiped import adapt
from jaxbiped.adapt.parameters import declared as declared_by
from jaxbiped.commands.choices import load_variant, make_gait, variant_tables
from jaxbiped.commands.common import InputError, load_robot

OF_LANDING, OF_REFLEX = declared_by(adapt.Landing), declared_by(adapt.PayloadReflex)
VARIANT_FILE = """
[landing]
base = "repaired"
descent_speed = 0.25
keep_x = false

[payload]
base = "modified"
threshold = 50
zmp_balanced = -0.03
settling_time = 3
rearm_time = inf
x_reflex = [[0.02, 0.01], [0.0, 0.0], [0, 0]]
smooth_resume = true

[gait]
b_s = 0.085
allow_infeasible = true

[origin]
anything = [{ at = "all" }, 3]
"""


@pytest.fixture(scope="module")
def walk():
    robot = load_robot("--robot", "elkahlout")
    return robot, make_gait(robot, "cosine", 3)


def written(folder: Path, text: str | bytes) -> Path:
    file = folder / "tuned.toml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return file


def refusal(folder: Path, walk, text: str | bytes) -> str:
    with pytest.raises(InputError) as caught:
        load_variant("--variant", written(folder, text), *walk)
    assert str(caught.value).startswith("--variant: ") and str(caught.value).isprintable()
    assert "tuned.toml" in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_variant_from_a_file(tmp_path, walk, mark):
    controller: Any = load_variant("--variant", written(tmp_path, mark + VARIANT_FILE.encode()), *walk)
    landed, reflex = controller.stage("landing").params, controller.stage("payload").params
    assert float(landed.descent_speed) == 0.25 and landed.keep_x is False and landed.stays_down is True
    assert float(reflex.settling_time) == 3.0 and float(reflex.rearm_time) == np.inf
    assert reflex.smooth_resume is True and reflex.smooth_reflex is False
    np.testing.assert_allclose(reflex.x_reflex, [[0.02, 0.01], [0.0, 0.0], [0.0, 0.0]], rtol=1e-6)
    assert float(controller.gait.params.b_s) == pytest.approx(0.085)


def test_stages_without_a_table_are_off(tmp_path, walk):
    only = load_variant(
        "--variant",
        written(tmp_path, '[payload]\nbase = "original"\nthreshold = 50\nzmp_balanced = -0.03'),
        *walk,
    )
    assert (
        isinstance(only, adapt.Controller)
        and only.stage("landing") is None
        and only.stage("payload") is not None
    )
    off = load_variant("--variant", written(tmp_path, '[payload]\nbase = "off"\n'), *walk)
    assert off.stage("landing") is None and off.stage("payload") is None


@pytest.mark.parametrize("name", [*OF_LANDING, *OF_REFLEX])
def test_every_parameter_may_be_in_a_file(tmp_path, walk, name):
    stage, base = ("landing", "paper") if name in OF_LANDING else ("payload", "original")
    values = {"x_reflex": [[0.01, 0.02]] * 3, "zmp_balanced": -0.03, "x_stand": 0.02}
    declared = (OF_LANDING if stage == "landing" else OF_REFLEX)[name]
    value = values.get(name, True if declared.allowed == "true or false" else 0.05)
    given = GIVEN if stage == "payload" else ""
    given = "\n".join(line for line in given.splitlines() if not line.startswith(f"{name} "))
    text = f"[{stage}]\nbase = '{base}'\n{given}\n{name} = {str(value).lower() if value is True else value}\n"
    made: Any = load_variant("--variant", written(tmp_path, text), *walk)
    np.testing.assert_allclose(getattr(made.stage(stage).params, name), value, rtol=1e-6)


GIVEN = "threshold = 50\nzmp_balanced = -0.03\n"
"""What would otherwise be read off the plan, which takes long to compile."""
PAYLOAD = '[payload]\nbase = "modified"\n'
LANDING = '[landing]\nbase = "paper"\n'
BAD = {
    # the base
    "[payload]\nbase = 'fast'\n": [
        "payload.base: got 'fast'",
        "off, original, modified, repaired, two_speed",
    ],
    "[landing]\nbase = 'modified'\n": ["landing.base: got 'modified'", "off, paper, repaired"],
    "[landing]\nbase = 'papr'\n": ["did you mean 'paper'?"],
    "[payload]\nsettling_time = 3.0\n": ["payload.base: missing", "off, original"],
    "[payload]\nbase = true\n": ["payload.base: got the truth value true"],
    "[payload]\nbase = 'off'\nsettling_time = 3.0\n": ["payload: got settling_time with base = 'off'"],
    "[landing]\nbase = 'off'\nkeep_x = true\n": ["landing: got keep_x with base = 'off'"],
    # numbers
    f"{PAYLOAD}settling_time = -1.0\n": ["payload.settling_time: got -1 s", "> 0 and <= 60 s"],
    f"{PAYLOAD}settling_time = 4000\n": ["4000 ms is 4 s"],
    f"{PAYLOAD}settling_time = '3'\n": ["payload.settling_time: got the text '3'", "[s]"],
    f"{PAYLOAD}settling_time = [3]\n": ["payload.settling_time: got [3]", "one number [s]"],
    f"{PAYLOAD}settling_time = true\n": ["the truth value true"],
    f"{PAYLOAD}settling_time = 2020-01-02\n": ["the date or time 2020-01-02"],
    f"{PAYLOAD}settling_time = nan\n": ["got nan s"],
    f"{PAYLOAD}settling_time = inf\n": ["got inf s"],
    f"{PAYLOAD}settling_time = 1e39\n": ["(infinite in float32)"],
    f"{PAYLOAD}settling_time = 1e-60\n": ["(0 in float32)"],
    f"{PAYLOAD}settling_time = {'1' * 400}\n": ["a whole number of about 400 digits"],
    f"{PAYLOAD}settling_time = {'9' * 5000}\n": ["digits", "at line 3"],
    f"{PAYLOAD}rearm_time = -1\n": ["payload.rearm_time: got -1 s", "or infinite"],
    f"{PAYLOAD}x_reflex = [[0.01, 0.01]]\n": ["payload.x_reflex: got [[0.01, 0.01]]", "3 x 2 numbers [m]"],
    f"{PAYLOAD}x_reflex = [[0, 0], [0, 0], [0, 10]]\n": [
        "payload.x_reflex: got 10 m in place 3, 2",
        "10 mm is 0.01 m",
    ],
    f"{PAYLOAD}{GIVEN}smooth_reflex = true\nreflex_time = 0.2\nsettling_time = 0.3\n": [
        "body_time: got 1.2 s",
        "= 0.5 s",
    ],
    f"{LANDING}descent_speed = 'x'\n": ["landing.descent_speed: got the text 'x'"],
    f"{LANDING}descent_speed = 200\n": ["200 mm/s is 0.2 m/s"],
    f"{LANDING}T_mod = nan\n": ["landing.T_mod: got nan s"],
    f"{LANDING}release_share = -1\n": ["landing.release_share: got -1, allowed: > 0 and <= 2"],
    # switches
    f"{LANDING}keep_x = 'no'\n": ["landing.keep_x: got the text 'no', allowed: true or false"],
    f"{LANDING}keep_x = 0\n": ["landing.keep_x: got 0, allowed: true or false"],
    f"{PAYLOAD}smooth_reflex = 1.0\n": ["payload.smooth_reflex: got 1", "true or false"],
    # names
    f"{PAYLOAD}speed = 1.0\n": ["payload.speed: unknown", "settling_time"],
    f"{PAYLOAD}setling_time = 1.0\n": ["did you mean 'settling_time'?"],
    f"{LANDING}[paylod]\nbase = 'modified'\n": ["paylod: unknown", "did you mean 'payload'?"],
    f"{LANDING}[orign]\nx = 1\n": ["orign: unknown", "did you mean 'origin'?"],
    "base = 'paper'\n": ["base: unknown", "landing, payload, gait, origin"],
    f"{PAYLOAD}[payload.more]\nx = 1\n": ["payload.more: unknown"],
    # tables
    "[walk]\nbase = 'paper'\n": ["walk: unknown, allowed: landing, payload, gait"],
    "[origin]\nx = 1\n": ["[landing], [payload] or [gait]"],
    "": ["[landing], [payload] or [gait]"],
    "landing = 'paper'\n": ["landing: got the text 'paper'", "a table [landing]"],
    f"[[landing]]\nbase = 'paper'\n{PAYLOAD}": ["landing: got [a table]", "a table [landing]"],
    f"origin = 3\n{LANDING}": ["origin: got 3", "a table [origin]"],
    "gait = 3\n": ["gait: got 3", "a table [gait]"],
    # the gait
    "[gait]\nb_s = true\n": ["gait.b_s: got the truth value true"],
    "[gait]\nb_s = '0.1'\n": ["gait.b_s: got the text '0.1'"],
    "[gait]\nb_s = 80\n": ["gait.b_s: got 80 m", "80 mm is 0.08 m"],
    "[gait]\nb_s = nan\n": ["gait.b_s: got nan"],
    "[gait]\nstride = 1.0\n": ["gait.stride: unknown", "b_s"],
    "[gait]\nn_steps = 3\n": ["gait.n_steps: unknown"],
    "[gait]\nb_s = 0.4\n": ["gait: got a ", "every foot position within reach"],
    "[gait]\nb_s = 0.085\n": ["gait: got a ZMP ", "; or say allow_infeasible = true in [gait]"],
    "[gait]\nb_s = 0.085\nallow_infeasible = false\n": ["gait: got a ZMP "],
    "[gait]\nallow_infeasible = 1\n": ["gait.allow_infeasible: got 1, allowed: true or false"],
    "[gait]\nstart_stop = 0.1\n": ["gait.start_stop: unknown"],
    "[gait]\nstart_stop.x_s_first = 0.1\n": ["gait.start_stop.x_s_first: unknown", "b_s"],
    # no TOML
    "base = ": ["got no TOML"],
    "a = " + "[" * 100_000: ["nesting"],
    "[payload]\nbase = 'modified'\nbase = 'original'\n": ["got no TOML"],
    "# " + "x" * (1 << 20): ["1048576 bytes"],
}


@pytest.mark.parametrize("text", BAD, ids=lambda text: repr(text[-40:]))
def test_bad_files_are_refused(tmp_path, walk, text):
    message = refusal(tmp_path, walk, text)
    for part in BAD[text]:
        assert part in message


def test_files_that_cannot_be_read(tmp_path, walk):
    for path in (tmp_path / "nowhere.toml", tmp_path):
        with pytest.raises(InputError, match=r"^--variant: .*got no file, allowed: a TOML file"):
            load_variant("--variant", path, *walk)
    assert "UTF-8 (at line 2)" in refusal(tmp_path, walk, b"[landing]\nbase = '\xfc'\n")


VALUES = (
    st.floats()
    | st.integers()
    | st.booleans()
    | st.just([[0.01, 0.0]] * 3)
    | st.sampled_from(["paper", "off", "x"])
)
KEYS = st.sampled_from(["base", *OF_LANDING, *OF_REFLEX, "b_s", "T_ini", "keep"])
TABLE = st.dictionaries(KEYS, VALUES, max_size=3)
STAGES = st.dictionaries(
    st.sampled_from(["landing", "payload", "gait", "origin", "paylod"]), TABLE, min_size=1
)


def toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"[{', '.join(map(toml, value))}]" if isinstance(value, list) else repr(value)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(STAGES, st.sampled_from(["repaired", "paper", "modified"]))
def test_any_file_is_read_or_refused(tmp_path, stages, base):
    lines = []
    for name, table in stages.items():
        full = table if name in ("gait", "origin") else {"base": base, **table}
        lines += [f"[{name}]", *(f"{key} = {toml(value)}" for key, value in full.items())]
    try:
        tables = variant_tables("--variant", written(tmp_path, "\n".join(lines)))
    except InputError as error:
        assert str(error).isprintable() and str(error).startswith("--variant: ")
    else:
        assert set(tables) == set(stages) - {"origin"}
        for stage, table in tables.items():
            if stage != "gait" and table.pop("base") != "off":
                make = adapt.Landing if stage == "landing" else adapt.PayloadReflex
                fixed = {"body_time": 1e-3, "zmp_balanced": 0.0} if stage == "payload" else {}
                made = make(**{**fixed, **table, **({"body_time": 1e-3} if stage == "payload" else {})})
                assert all(np.all(np.isfinite(getattr(made, key))) or key == "rearm_time" for key in table)


def test_what_is_written_is_read_again(tmp_path, walk):
    """As `tune.variant_file` writes it: tables of tomli-w, and where they came from."""
    tables = variant_tables("--variant", written(tmp_path, VARIANT_FILE))
    text = tomli_w.dumps({**tables, "origin": {"robot": "x", "loss": 0.1}})
    again = variant_tables("--variant", written(tmp_path, text))
    assert again == tables
    assert tables["payload"]["x_reflex"] == [[0.02, 0.01], [0.0, 0.0], [0.0, 0.0]]
    load_variant("--variant", tmp_path / "tuned.toml", *walk)

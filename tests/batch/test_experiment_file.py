"""Experiment files: what they may say, what is refused, and that what is written is the same experiment again."""

import math
import re
import tomllib
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import polars as pl
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxbiped import adapt, batch, checked, cli, planner, robot, sim
from jaxbiped.adapt import tunables
from jaxbiped.batch import defaults, experiment_file, experiment_writer, inputs, part, store, workers

QUICK_REFLEX = "[variants.tuned.payload]\nbase = 'modified'\nthreshold = 50\nzmp_balanced = -0.03\n"
"""Says what would otherwise be read off the plan, which takes long to compile."""
FILE = f"""
robot = "elkahlout"

[gait]
kind = "cosine"
steps = 3

[variants.off]
{QUICK_REFLEX}
settling_time = 3.0

[scenarios]
clock = "gait"
[scenarios.grid]
load_kg = [2.5, 5.0]
load_time_s = {{ from = 0.3, to = 0.9, step = 0.3 }}
friction = 0.09

[simulation]
dt = 0.001
seed = 3

[score]
rule = "papers"

[report]
pages = ["payload", "overview"]
"""
SMALL = """
robot = "surena3"
[gait]
steps = 2
[variants.off]
[scenarios.grid]
friction = [0.5, 0.6]
"""


def written(folder: Path, text: str) -> Path:
    file = folder / "mine.toml"
    file.write_text(text, encoding="utf-8")
    return file


def read(folder: Path, text: str) -> batch.Experiment:
    return batch.read_experiment(written(folder, text))


def key(experiment: batch.Experiment) -> str:
    return store.Store(Path("nowhere"), experiment).key


def again(folder: Path, experiment: batch.Experiment) -> batch.Experiment:
    """Written and read."""
    return batch.read_experiment(batch.write_experiment(folder / "again.toml", experiment))


@pytest.fixture
def quick(monkeypatch):
    """Chunks made up instead of simulated; the names of those made."""
    made = []

    def walk(one, chunk, told=None):
        made.append(chunk.number)
        rows = np.arange(chunk.start, chunk.stop)
        numbers = {name: np.sin(rows) for name, column in one.outcomes.items() if column.kind is float}
        counts = {name: rows for name, column in one.outcomes.items() if column.kind is int}
        outcome = {
            **numbers,
            **counts,
            "status": np.where(rows % 3, "ok", "fell"),
            "success": rows % 3 != 0,
            "finished": rows % 3 != 0,
        }
        outcome = {name: outcome[name] for name in one.outcomes}
        inputs = one.table[chunk.start : chunk.stop]
        return pl.concat([part._identity(chunk), inputs, pl.DataFrame(outcome)], how="horizontal")

    monkeypatch.setattr(workers, "walk_chunk", walk)
    return made


# Reading ---------------------------------------------------------------------------------------------------------


def test_a_file_is_the_experiment_that_python_makes(tmp_path):
    one = read(tmp_path, FILE)
    params = robot.load("elkahlout")
    gait = planner.CosineGait.preset(params, 3)
    reflex = adapt.PayloadReflex.modified(params, gait, threshold=50, zmp_balanced=-0.03, settling_time=3)
    start = float(gait.clock_start)
    same = batch.Experiment(
        params,
        {"off": adapt.Controller(gait), "tuned": adapt.Controller(gait, reflex)},
        batch.grid(load_kg=[2.5, 5.0], load_time_s=[start + t for t in (0.3, 0.6, 0.9)], friction=0.09),
        sim.Options(dt=1e-3, control_every=1, feed_forward=False, payload_model="thesis"),
        seed=3,
    )
    assert key(one) == key(same)
    assert one.pages == ("payload", "overview") and same.pages == ("overview",)


def test_what_is_left_out_is_as_by_the_commands(tmp_path):
    one = read(tmp_path, SMALL)
    (controller,) = one.variants.values()
    assert isinstance(controller.gait, planner.PolynomialGait) and controller.stages == ()
    assert one.options == sim.Options() and one.seed == 0 and one.duration is None
    assert one.table["friction"].to_list() == [0.5, 0.6]


def test_scenarios_by_rows_draws_and_tables(tmp_path):
    head = SMALL.partition("[scenarios")[0]
    rows = read(tmp_path, f"{head}[scenarios.rows]\nfriction = [0.5, 0.6]\npush_y_N = 10\nseed = [7, 8]\n")
    assert rows.table.select("friction", "push_y_N", "seed").rows() == [(0.5, 10.0, 7), (0.6, 10.0, 8)]
    drawn = read(
        tmp_path,
        f"{head}[scenarios.draw]\nn = 20\nseed = 4\nlatin_hypercube = false\nfriction = {{ uniform = [0.4, 1] }}\n"
        "com_x_m = { normal = [0.0, 0.004] }\ngain_scale = { choice = [0.9, 1.1] }\nload_kg = 2.0\n",
    )
    assert drawn.scenarios.equals(
        batch.draw(
            20,
            4,
            latin_hypercube=False,
            friction=batch.Uniform(0.4, 1.0),
            com_x_m=batch.Normal(0.0, 0.004),
            gain_scale=batch.Choice((0.9, 1.1)),
            load_kg=2.0,
        )
    )
    drawn.scenarios.write_parquet(tmp_path / "mine.parquet")
    assert read(tmp_path, f"{head}[scenarios]\ntable = 'mine.parquet'\n").table.equals(drawn.table)


def test_paths_are_relative_to_the_file(tmp_path, monkeypatch):
    (tmp_path / "tuned.toml").write_text(
        "[landing]\nbase = 'paper'\n[gait]\nH_max = 0.11\n", encoding="utf-8"
    )
    preset = Path(robot.__file__).parent / "presets" / "surena3.toml"
    mine = preset.read_text(encoding="utf-8").replace('name = "surena3"', 'name = "mine"', 1)
    (tmp_path / "robot.toml").write_text(mine, encoding="utf-8")
    monkeypatch.chdir("/")
    text = SMALL.replace('"surena3"', '"robot.toml"').replace("steps = 2", "steps = 2\nfile = 'tuned.toml'")
    one = read(tmp_path, f"{text}[variants.tuned]\nfile = 'tuned.toml'\n")
    assert one.robot.name == "mine" and one.robot_file == str(tmp_path / "robot.toml")
    gait: Any = one.variants["off"].gait
    assert float(gait.params.H_max) == pytest.approx(0.11)
    assert one.variants["tuned"].stage("landing").params == adapt.Landing.paper()
    assert key(again(tmp_path, one)) == key(one)


BAD = {
    "robot = 'elkahlout'\n": ["variants: got none"],
    SMALL.replace("surena3", "surena"): ["robot: got 'surena'", "did you mean 'surena3'?"],
    SMALL.replace('"surena3"', "3"): ["robot: got 3", "the name of a preset"],
    SMALL.replace("robot =", "robt ="): ["robt: unknown", "did you mean 'robot'?"],
    SMALL.replace("[gait]", "gait = 3\n[rest]"): ["rest: unknown"],
    SMALL.replace("[gait]", "[gate]"): ["gate: unknown", "did you mean 'gait'?"],
    SMALL.replace("steps = 2", "steps = 0"): ["gait.steps: got 0, allowed: a whole number >= 1 and <= 200"],
    SMALL.replace("steps = 2", "steps = 2.0"): ["gait.steps: got the float 2.0"],
    SMALL.replace("steps = 2", "kind = 'cosin'"): ["gait.kind: got 'cosin'", "did you mean 'cosine'?"],
    SMALL.replace("steps = 2", "speed = 2"): ["gait.speed: unknown"],
    SMALL.replace("steps = 2", "first_swing = 'both'"): ["gait.first_swing: got 'both'", "left, right"],
    SMALL.replace("steps = 2", "allow_infeasible = 1"): ["gait.allow_infeasible: got 1"],
    SMALL.replace("steps = 2", "file = 'no.toml'"): ["no.toml", "got no file"],
    SMALL.replace("steps = 2", "file = 'x'\nparameters = {}"): ["gait: got file and parameters"],
    SMALL.replace("steps = 2", "parameters = { H_max = 100 }"): ["gait.parameters.H_max: got 100 m", "cm is"],
    SMALL.replace("steps = 2", "parameters = { T_x = 1 }"): ["gait.parameters.T_x: unknown", "T_s"],
    SMALL.replace("steps = 2", "parameters = { D_s = 0.6 }"): ["robot, gait: ", "got a "],
    SMALL.replace("[variants.off]", "[variants]\noff = 1"): ["variants.off: got 1", "a table [variants.off]"],
    SMALL.replace("[variants.off]", "[variants.off.landin]\nbase = 'paper'"): [
        "variants.off.landin: unknown",
        "did you mean 'landing'?",
    ],
    SMALL.replace("[variants.off]", "[variants.a.landing]\nbase = 'papr'"): [
        "variants.a.landing.base: got 'papr'",
        "did you mean 'paper'?",
    ],
    SMALL.replace("[variants.off]", "[variants.a.landing]\nbase = 'paper'\ndescent_speed = 200"): [
        "variants.a.landing.descent_speed: got 200 m/s",
        "200 mm/s is 0.2 m/s",
    ],
    SMALL.replace("[variants.off]", "[variants.a]\nfile = 'no.toml'"): ["variants.a.file: ", "got no file"],
    SMALL.replace("[variants.off]", "[variants.a]\nfile = 'a.toml'\nlanding = {}"): [
        "variants.a: got landing beside a file"
    ],
    SMALL.replace("grid", "gird"): ["scenarios.gird: unknown", "did you mean 'grid'?"],
    SMALL.partition("[scenarios")[0]: ["scenarios: got nothing, allowed: a table [scenarios]"],
    f"{SMALL}[scenarios.rows]\nfriction = 0.5\n": ["scenarios: got grid and rows, allowed: one of grid"],
    SMALL.replace("friction = [0.5, 0.6]", ""): ["scenarios.grid: got no column"],
    SMALL.replace("friction =", "fricton ="): ["scenarios.grid.fricton: unknown", "did you mean 'friction'?"],
    SMALL.replace("[0.5, 0.6]", "[0.5, 60]"): ["scenarios.grid.friction: got 60, allowed: >= 0.01 and <= 5"],
    SMALL.replace("[0.5, 0.6]", "'low'"): ["scenarios.grid.friction: got the text 'low'"],
    SMALL.replace("[0.5, 0.6]", "[]"): ["scenarios.grid.friction: got no values"],
    SMALL.replace("[0.5, 0.6]", "{ from = 0.5, to = 0.6 }"): ["scenarios.grid.friction.step: missing"],
    SMALL.replace("[0.5, 0.6]", "{ from = 0.6, to = 0.5, step = 0.1 }"): ["from 0.6 to 0.5", "from <= to"],
    SMALL.replace("[0.5, 0.6]", "{ from = 0.5, to = 0.6, step = 0 }"): ["friction.step: got 0, allowed: > 0"],
    SMALL.replace("friction = [0.5, 0.6]", "step_9_height_m = 0.01"): ["9"],
    SMALL.replace("[scenarios.grid]", "[scenarios]\nclock = 'wall'\n[scenarios.grid]"): [
        "scenarios.clock: got 'wall', allowed: walk, gait"
    ],
    SMALL.replace("[scenarios.grid]\nfriction = [0.5, 0.6]", "[scenarios]\ntable = 'no.parquet'"): [
        "scenarios.table: got ",
        "allowed: a Parquet file",
    ],
    SMALL.replace("grid]", "rows]\nload_kg = [1, 2, 3]"): [
        "scenarios.rows.friction: got 2 values, allowed: 3"
    ],
    SMALL.replace("grid]", "draw]\nn = 2"): ["scenarios.draw.seed: missing"],
    SMALL.replace("grid]", "draw]\nn = 0\nseed = 1"): ["scenarios.draw.n: got 0"],
    SMALL.replace("grid]", "draw]\nn = 2\nseed = 1"): ["scenarios.draw.friction: got [0.5, 0.6]"],
    SMALL.replace("grid]\nfriction = [0.5, 0.6]", "draw]\nn = 2\nseed = 1\nfriction = { unifrm = [0, 1] }"): [
        "scenarios.draw.friction.unifrm: unknown",
        "did you mean 'uniform'?",
    ],
    SMALL.replace(
        "grid]\nfriction = [0.5, 0.6]", "draw]\nn = 2\nseed = 1\nfriction = { uniform = [1, 0.5] }"
    ): ["scenarios.draw.friction.uniform: uniform: got 1 to 0.5"],
    SMALL.replace("grid]\nfriction = [0.5, 0.6]", "draw]\nn = 2\nseed = 1\nfriction = { normal = [1] }"): [
        "scenarios.draw.friction.normal: got [1], allowed: 2 numbers"
    ],
    f"{SMALL}[simulation]\ndt = 1\n": ["simulation.dt: got 1 s, allowed: >= 1e-05 and <= 0.01 s", "1 ms is"],
    f"{SMALL}[simulation]\ncontrol_every = 0\n": ["simulation.control_every: got 0"],
    f"{SMALL}[simulation]\npayload_model = 'exct'\n": ["payload_model: got 'exct'", "did you mean 'exact'?"],
    f"{SMALL}[simulation]\ncontact = 'hard'\n": [
        "simulation.contact: got 'hard', allowed: compliant, mjx, c_mujoco"
    ],
    f"{SMALL}[simulation]\nduration = -1\n": ["simulation.duration: got -1 s, allowed: > 0"],
    f"{SMALL}[simulation.duration]\nof = 2\n": ["simulation.duration.of: unknown, allowed: off"],
    f"{SMALL}[simulation]\nbatch = 0\n": ["simulation.batch: got 0"],
    f"{SMALL}[simulation]\nspeed = 1\n": ["simulation.speed: unknown"],
    f"{SMALL}[score]\nrule = 'khadiv'\n": ["score.rule: got 'khadiv', allowed: papers"],
    f"{SMALL}[report]\npages = ['overviw']\n": ["report.pages: got 'overviw'", "did you mean 'overview'?"],
    f"{SMALL}[report]\npages = 'overview'\n": ["report.pages: got the text 'overview', allowed: a list"],
    f"incomplete = ['gait: odd']\n{SMALL}": ["incomplete: got ['gait: odd']"],
    "robot = ": ["got no TOML"],
}


@pytest.mark.parametrize("text", BAD, ids=lambda text: repr(text[-40:]))
def test_bad_files_are_refused_in_one_line(tmp_path, text):
    with pytest.raises(checked.Refusal) as caught:
        read(tmp_path, text)
    line = str(caught.value)
    assert line.startswith("mine.toml: ") and line.isprintable()
    for words in BAD[text]:
        assert words in line


def test_bad_keys_are_refused_before_anything_is_planned(tmp_path, monkeypatch):
    monkeypatch.setattr(defaults, "plan", None)  # would fail if it were called
    late = {"gait.parameters", "robot, gait", "9", "1 ms is"}
    for text in (
        text for text, words in BAD.items() if words[0].partition(":")[0] not in late and words != ["9"]
    ):
        with pytest.raises(checked.Refusal):
            read(tmp_path, text)


VALUES = (
    st.floats()
    | st.integers()
    | st.booleans()
    | st.sampled_from(["surena3", "paper", "grid", "cosine", "x.toml", "thesis", ""])
    | st.lists(st.floats(0.0, 3.0) | st.integers() | st.text(max_size=3), max_size=3)
    | st.dictionaries(
        st.sampled_from(["from", "to", "step", "uniform", "choice", "normal"]), st.floats(), max_size=3
    )
)
KEYS = st.sampled_from(
    [
        *("kind", "steps", "parameters", "file", "base", "landing", "off", "H_max", "x y"),
        *("grid", "rows", "draw", "table", "clock", "n", "friction", "load_kg", "step_1_height_m"),
        *("seed", "dt", "duration", "rule", "pages"),
    ]
)
INNER = st.recursive(VALUES, lambda inner: st.dictionaries(KEYS, inner, max_size=3), max_leaves=6)
CHANGES = st.lists(st.tuples(st.sampled_from(experiment_file.TABLES), KEYS, INNER), min_size=1, max_size=2)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(CHANGES, st.booleans())
def test_any_file_is_read_or_refused(surena, tmp_path, monkeypatch, changes, whole):
    monkeypatch.setattr(defaults, "plan", lambda *_, **__: surena[1])
    data: Any = tomllib.loads(SMALL)
    for table, key, value in changes:
        if whole or not isinstance(data.setdefault(table, {}), dict):
            data[table] = value
        else:
            data[table][key] = value
    try:
        one = read(tmp_path, tomli_w.dumps(data))
    except checked.Refusal as error:
        assert str(error).startswith("mine.toml: ") and str(error).isprintable()
    else:
        assert one.rows >= 1


PROJECT = Path(__file__).parents[2]


def examples(page: str) -> list[str]:
    """The whole experiments that a page shows."""
    blocks = re.findall(r"```toml\n(.*?)```", (PROJECT / page).read_text(encoding="utf-8"), re.DOTALL)
    return [block for block in blocks if block.startswith("robot = ")]


@pytest.mark.parametrize(("page", "walks"), [("docs/batch.md", 30), ("README.md", 20)])
def test_the_examples_of_the_docs_are_read_and_planned(tmp_path, page, walks):
    (example,) = examples(page)
    assert batch.plan(read(tmp_path, example), tmp_path / "out").walks == walks


def test_the_example_of_the_docs_says_everything_that_a_file_may(tmp_path):
    (example,) = examples("docs/batch.md")
    keys = {*experiment_file.OPTIONS, *experiment_file.WHOLE, *experiment_file.TABLES, "duration"} - {
        "noise",
        "delay_room",
    }
    assert {key for key in keys if key not in example} == set()
    draw = re.findall(
        r"```toml\n(\[scenarios.draw\].*?)```", (PROJECT / "docs/batch.md").read_text(), re.DOTALL
    )[0]
    assert read(tmp_path, SMALL.partition("[scenarios")[0].replace("2", "4") + draw).rows == 256


def test_the_obstacles_sweep_is_a_file():
    one = batch.read_experiment(PROJECT / "sweeps" / "obstacles.toml")
    assert one.rows == 126 and list(one.variants) == ["off", "paper", "repaired"]
    khadiv = one.table.row(-1, named=True)
    assert [khadiv[f"step_{step}_height_m"] for step in (2, 4, 6)] == [0.03, 0.02, 0.04]


# Writing ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def surena():
    params = robot.load("surena3")
    return params, planner.PolynomialGait.preset(params, 2)


def made(surena, **changed: Any) -> batch.Experiment:
    params, gait = surena
    given = {
        "robot": params,
        "variants": {"off": adapt.Controller(gait)},
        "scenarios": batch.grid(friction=[0.5, 0.6]),
    }
    return batch.Experiment(**{**given, **changed})


ROUND_TRIPS = {
    "a grid": lambda s: {
        "scenarios": batch.grid(friction=[0.6, 0.5], load_kg=[1.0, 2.0, 3.0], load_time_s=1.0)
    },
    "one row": lambda s: {"scenarios": batch.grid(friction=0.3)},
    "rows all the same": lambda s: {"scenarios": pl.DataFrame({"friction": [0.5] * 3})},
    "rows": lambda s: {"scenarios": pl.DataFrame({"friction": [0.5, 0.6], "load_kg": [1, 2]})},
    "own seeds": lambda s: {"scenarios": pl.DataFrame({"friction": [0.5, 0.6], "seed": [1, 2]})},
    "many rows": lambda s: {"scenarios": batch.draw(200, 1, friction=batch.Uniform(0.4, 1.0))},
    "a switch and noise": lambda s: {
        "scenarios": batch.grid(switch_left_toe_left_stuck=[0, 1], force_noise_N=1.0, delay_s=0.01)
    },
    "options": lambda s: {
        "options": sim.Options(dt=1e-3, noise=True, delay_room=3, contact="mjx"),
        "batch": 1,
    },
    "implicit stiffness": lambda s: {"options": sim.Options(dt=2e-3, control_every=1, implicit="linear")},
    "seed and duration": lambda s: {"seed": 9, "duration": 0.02},
    "durations": lambda s: {
        "variants": {"a b": adapt.Controller(s[1]), "b": adapt.Controller(s[1])},
        "duration": {"a b": 0.1, "b": 0.2},
    },
    "stages": lambda s: {
        "variants": {
            "paper": adapt.Controller(s[1], adapt.Landing.paper(T_mod=0.3)),
            "mine": adapt.Controller(
                s[1],
                adapt.Landing.repaired(keep_x=False, descent_speed=1 / 3),
                adapt.PayloadReflex.original(*s, threshold=50, zmp_balanced=-0.03, rearm_time=math.inf),
            ),
        }
    },
    "another gait in a variant": lambda s: {
        "variants": {
            "off": adapt.Controller(s[1]),
            "tuned": adapt.Controller(
                tunables.other_gait(s[0], s[1], {"H_max": 0.11, "start_stop.v_last": 0.01})
            ),
        }
    },
    "the right foot first": lambda s: {
        "variants": {"off": adapt.Controller(planner.PolynomialGait.preset(s[0], 3, robot.RIGHT))}
    },
    "a gait that breaks a constraint": lambda s: {
        "variants": {
            "off": adapt.Controller(
                tunables.other_gait(s[0], s[1], {"y_m": 0.01, "y_d": 0.06}, allow_infeasible=True)
            )
        }
    },
}


@pytest.mark.parametrize("what", ROUND_TRIPS)
def test_what_is_written_is_read_as_the_same_experiment(surena, tmp_path, what):
    one = made(surena, **ROUND_TRIPS[what](surena))
    two = again(tmp_path, one)
    assert experiment_file.INCOMPLETE not in (tmp_path / "again.toml").read_text()
    assert two.resolved == one.resolved and key(two) == key(one)
    assert (tmp_path / "scenarios.parquet").exists() == (what == "many rows")
    assert experiment_writer.text(two) == experiment_writer.text(one)


def test_the_thesis_gait_and_the_whole_file_come_back(tmp_path):
    one = read(tmp_path, FILE)
    two = again(tmp_path, one)
    assert key(two) == key(one) and two.pages == one.pages
    text = (tmp_path / "again.toml").read_text()
    assert "[scenarios.grid]" in text and "b_s = 0.08" in text and 'base = "modified"' in text
    values = set(re.findall(r"^(\w+) = ", text, re.MULTILINE))
    assert values >= {*inputs.INPUTS, *experiment_file.OPTIONS, "batch", "seed", "settling_time"}


class OddLanding(adapt.Landing):
    """A stage that nobody knows."""


LACKING = {
    "robot": lambda s: {"robot": eqx.tree_at(lambda r: r.servo.kp, s[0], s[0].servo.kp * 1.01)},
    "variants.off": lambda s: {"variants": {"off": adapt.Controller(s[1], OddLanding.repaired())}},
    "gait": lambda s: {
        "variants": {
            "off": adapt.Controller(eqx.tree_at(lambda g: g.params.H_max, s[1], s[1].params.H_max * 1.01))
        }
    },
    "variants.other": lambda s: {
        "variants": {
            "off": adapt.Controller(s[1]),
            "other": adapt.Controller(planner.PolynomialGait.preset(s[0], 3)),
        }
    },
}


@pytest.mark.parametrize("what", LACKING)
def test_what_no_file_can_say_is_named_and_never_read_as_something_else(surena, tmp_path, what):
    one = made(surena, **LACKING[what](surena))
    text = batch.write_experiment(tmp_path / "odd.toml", one).read_text()
    assert f'"{what}: ' in text and "friction" in text
    with pytest.raises(checked.Refusal, match=r"odd.toml: incomplete: got"):
        batch.read_experiment(tmp_path / "odd.toml")


# Folders and the command -----------------------------------------------------------------------------------------


def test_every_folder_has_the_file_and_it_runs_again(surena, quick, tmp_path):
    one = made(surena, batch=1)
    batch.run(one, tmp_path / "a", workers=1)
    file = tmp_path / "a" / store.RESOLVED
    assert key(one)[:16] in file.read_text().splitlines()[0]
    quick.clear()
    batch.run(batch.read_experiment(file), tmp_path / "a", workers=1)
    assert quick == []
    other = made(surena, seed=1)
    batch.run(other, tmp_path / "a", workers=1, overwrite=True)
    assert key(batch.read_experiment(file)) == key(other)


def test_a_file_of_the_users_own_is_left_alone(surena, quick, tmp_path):
    file = tmp_path / store.RESOLVED
    file.write_text("# mine\n")
    batch.run(made(surena), tmp_path, workers=1)
    batch.run(made(surena, seed=1), tmp_path, workers=1, overwrite=True)
    assert file.read_text() == "# mine\n"


def test_run_plans_runs_resumes_and_draws(quick, tmp_path, capsys):
    file, out = written(tmp_path, FILE), tmp_path / "out"
    args = ["run", str(file), "--out", str(out), "--workers", "1", "--json"]
    assert cli.main([*args, "--dry-run"]) == cli.OK
    assert '"walks": 12' in capsys.readouterr().out and not out.exists()
    assert cli.main(args) == cli.OK and quick == [0, 1]
    said = capsys.readouterr().out
    assert "off: 4 of 6 succeed" in said and '"variants": [{"variant": "off"' in said.splitlines()[-1]
    assert {"payload_success.png", "payload_pitch.png", "report.html"} <= {f.name for f in out.iterdir()}
    assert cli.main(args) == cli.OK and quick == [0, 1]
    capsys.readouterr()
    written(tmp_path, FILE.replace("seed = 3", "seed = 4"))
    assert cli.main(args) == cli.BAD_INPUT and "another experiment" in capsys.readouterr().err
    assert cli.main([*args, "--overwrite"]) == cli.OK


def test_run_draws_obstacles_where_a_file_asks_for_them(quick, tmp_path, capsys):
    (example,) = examples("docs/batch.md")
    out = tmp_path / "out"
    assert cli.main(["run", str(written(tmp_path, example)), "--out", str(out), "--workers", "1"]) == cli.OK
    assert "2 of 2 pages and figures" in capsys.readouterr().out
    assert {"obstacles.png", "report.html"} <= {f.name for f in out.iterdir()}


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("run",), "FILE"),
        (("run", "no.toml", "--out", "x"), "no.toml: got no file"),
        (("run", "mine.toml"), "--out"),
        (("run", "mine.toml", "--out", "x", "--workers", "0"), "--workers"),
        (("run", "mine.toml", "--out", "x"), "mine.toml: robot: got 'nobody'"),
    ],
)
def test_run_refuses_in_one_line(tmp_path, monkeypatch, capsys, args, says):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, SMALL.replace("surena3", "nobody"))
    assert cli.main(list(args)) == cli.BAD_INPUT
    out, line = capsys.readouterr()
    assert out == "" and says in line and line.count("\n") == 1 and not (tmp_path / "x").exists()


def test_recipes_are_what_the_commands_run(surena, tmp_path):
    params, _ = surena
    gait = planner.PolynomialGait.preset(params, 4)
    one = batch.recipes.obstacles(
        params, variants=("off", "paper"), heights=(0.02, -0.01), step=(2,), steps=4
    )
    same = made(
        surena,
        variants={"off": adapt.Controller(gait), "paper": adapt.Controller(gait, adapt.Landing.paper())},
        scenarios=pl.DataFrame({"step_2_height_m": [0.02, -0.01]}),
    )
    assert key(one) == key(same) == key(again(tmp_path, one)) and one.pages == ("obstacles",)
    with pytest.raises(checked.Refusal, match=r"^heights: got 0.5 m, allowed: -0.2 to 0.2 m"):
        batch.recipes.obstacles(heights=(0.5,))
    with pytest.raises(checked.Refusal, match=r"^gait: got 'gallop'"):
        batch.recipes.payload(gait="gallop")
    with pytest.raises(checked.Refusal, match=r"^variants: got 'quick'"):
        batch.recipes.obstacles(variants=("quick",), steps=2, step=(1,))

"""The exported controller, compiled by a C compiler that takes every warning for an error, beside JAX tick by tick."""

import ctypes
import json
import subprocess
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import cli, robot, runtime
from jaxbiped.adapt import Controller, Landing, PayloadReflex, PlannedStage, Sensed, Stage
from jaxbiped.planner import own_gait
from jaxbiped.sim import Scenario, own_options, prepare
from jaxbiped.sim.compile import build
from jaxbiped.sim.controller_c import CFiles, controller_c, said_of
from jaxbiped.sim.servo import Reference
from jaxbiped.sim.tick import servo_reference

pytestmark = pytest.mark.skipif(build.compiler() is None, reason="no C compiler")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC")


class InC:
    """An exported controller, compiled."""

    def __init__(self, files: CFiles, folder: Path):
        (folder / f"{files.name}.h").write_text(files.header)
        (folder / f"{files.name}.c").write_text(files.source)
        made = folder / "controller.so"
        command = [build.compiler(), *STRICT, "-o", made, folder / f"{files.name}.c", "-lm"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        library = ctypes.CDLL(str(made))
        self.start, self.step = (getattr(library, f"{files.name}_{what}") for what in ("start", "step"))

    def run(self, sensors: Sensed) -> list[np.ndarray]:
        """Angles, speeds and torques for a whole history of readings."""
        state = ctypes.create_string_buffer(1 << 16)
        self.start(state)
        rows = [np.asarray(leaf) for leaf in jax.tree.leaves(sensors)]
        real = rows[0].dtype
        angles = np.zeros((len(rows[0]), 38), real)
        for i, out in enumerate(angles):
            # The members of the structs stand one after the other, and are all of four bytes, or of eight but for int.
            one = [np.asarray(row[i]).astype(np.int32 if row.dtype == bool else real).ravel() for row in rows]
            self.step(state, _packed(one).ctypes, out.ctypes)
        return [angles[:, 12 * k : 12 * k + 12].reshape(-1, 2, 6) for k in range(3)]


def _packed(members: list[np.ndarray]) -> np.ndarray:
    """Members of a struct, each in its place."""
    content = b""
    for member in members:
        content += b"\0" * (-len(content) % member.itemsize) + member.tobytes()
    return np.frombuffer(content + b"\0" * 16, np.uint8).copy()


class Recorder(Stage):
    """Keep what the sensors said."""

    name = "recorder"


class PlannedRecorder(PlannedStage):
    params: Stage

    @classmethod
    def plan(cls, params, gait):
        return cls(params)

    def init(self):
        return Sensed.nothing(jnp.zeros(()))

    def step(self, state, gait, targets, sensed, signals):
        return sensed, targets, signals


Recorder.planned = PlannedRecorder


@runtime.jit
def recorded(simulation, scenario, ticks: int):
    def tick(state, _):
        new = simulation.tick(state)[0]
        return new, (new.controller.stages["recorder"], new.reference)

    end, history = jax.lax.scan(tick, simulation.start(scenario), None, length=ticks)
    return end, history


@runtime.jit
def led(simulation, sensors: Sensed) -> Reference:
    """References by JAX for a history of readings."""

    def tick(state, sensed):
        state, targets = simulation.controller.step(state, sensed)
        return state, servo_reference(simulation.robot, targets, simulation.torque)[0]

    return jax.lax.scan(tick, simulation.controller.init(), sensors)[1]


def test_a_whole_walk_with_an_obstacle_and_a_payload(tmp_path):
    params = robot.load("surena3")
    gait = own_gait(params, 8)
    stages = (PayloadReflex.repaired(params, gait), Landing.repaired())
    options = own_options(params, gait)
    pads = Scenario.flat(1).with_obstacle(params, gait, 1, 0.02).with_payload(8.0, 5.4)
    simulation = prepare(params, Controller(gait, *stages, Recorder()), options)
    ticks = simulation.ticks(float(gait.duration) + 12.0)
    end, (sensors, reference) = recorded(simulation, pads, ticks)
    state = end.controller
    assert not bool(end.record.failed)
    assert int(state.stages["payload"].reflexes) >= 1, "the load was felt"
    assert float(np.ptp(np.asarray(reference.angle)[:, :, 3], axis=0).min()) > 0.3, "it walks"
    files = controller_c(prepare(params, Controller(gait, *stages), options), "walk")
    angle, speed, torque = InC(files, tmp_path).run(sensors)
    difference = np.abs(angle - np.asarray(reference.angle))
    assert difference.max() < 1e-5, f"rad, in tick {difference.max(axis=(1, 2)).argmax()} of {ticks}"
    np.testing.assert_allclose(speed, reference.speed, atol=1e-3)
    np.testing.assert_allclose(torque, reference.feed_forward, atol=1e-2)


def stage_of(kind: str, params, gait):
    return {
        "original": lambda: PayloadReflex.original(params, gait),
        "modified": lambda: PayloadReflex.modified(params, gait),
        "repaired": lambda: PayloadReflex.repaired(params, gait),
        "paper": Landing.paper,
        "landing repaired": Landing.repaired,
    }[kind]()


@pytest.mark.parametrize(
    ("name", "kind"),
    [("elkahlout", k) for k in ("original", "modified", "repaired")]
    + [("surena3", "paper"), ("surena3", "landing repaired")],
)
def test_any_history_of_readings(name, kind, tmp_path, x64):
    params = robot.load(name)
    gait = own_gait(params, 4)
    controller, options = Controller(gait, stage_of(kind, params, gait)), own_options(params, gait)
    ticks, random = 3000, np.random.default_rng(0)
    time = jnp.arange(1, ticks + 1) * options.control_dt
    force = jnp.asarray(np.cumsum(random.normal(0.0, 3.0, (ticks, 2, 4)), axis=0)) + 60.0
    closed = force > 60.0
    since = np.maximum.accumulate(
        np.where(np.diff(closed, axis=0, prepend=False), time[:, None, None], -1.0), axis=0
    )
    sensors = jax.vmap(Sensed.nothing)(time)
    sensors = eqx.tree_at(
        lambda s: (s.switch, s.switch_time, s.corner_force, s.zmp_body),
        sensors,
        (closed, jnp.where(since < 0.0, jnp.inf, since), jnp.maximum(force, 0.0), 1e-4 * force[:, 0, :2]),
    )
    one = prepare(params, controller, options)
    theirs = led(one, sensors)
    ours = InC(controller_c(one, "walk"), tmp_path).run(sensors)
    for mine, his in zip(ours, jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(mine, his, atol=1e-9)


def test_every_reading_is_explained_in_the_header():
    texts = said_of(Sensed)
    assert set(texts) == {field.name for field in Sensed.__dataclass_fields__.values()}
    assert all("[" in text or "open" in text for text in texts.values())


@pytest.mark.parametrize("name", ["", "2walk", "My-Robot", "walk.c"])
def test_a_name_that_is_none_in_c_is_refused(name):
    params = robot.load("elkahlout")
    gait = own_gait(params, 4)
    with pytest.raises(ValueError, match=r"name: got .*, allowed: small letters"):
        controller_c(prepare(params, Controller(gait), own_options(params, gait)), name)


def test_the_command_writes_both_files_and_replaces_no_others(tmp_path, capsys):
    command = [
        "export",
        "--c",
        "--robot",
        "elkahlout",
        "--steps",
        "4",
        "--out",
        str(tmp_path / "c"),
        "--json",
    ]
    assert cli.main(command) == cli.OK
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [Path(file).name for file in result["files"]] == [
        "elkahlout_controller.c",
        "elkahlout_controller.h",
    ]
    assert result["stages"] == ["payload", "landing"] and result["control_dt_s"] == 5e-4
    assert cli.main(command) == cli.OK, "the same again is no harm"
    Path(result["files"][1]).write_text("mine")
    assert cli.main(command) == cli.BAD_INPUT
    assert "elkahlout_controller.h', which is there already" in capsys.readouterr().err
    assert Path(result["files"][1]).read_text() == "mine"


@pytest.mark.parametrize(
    "more", [("--steps", "4"), ("--variant", "modified"), ("--gait", "cosine"), ("--allow-infeasible",)]
)
def test_a_robot_for_mujoco_has_no_gait(more, tmp_path, capsys):
    assert (
        cli.main(["export", "--robot", "elkahlout", "--out", str(tmp_path / "x.xml"), *more]) == cli.BAD_INPUT
    )
    line = capsys.readouterr().err
    assert f"{more[0]}: got a value, allowed: only with --c" in line and line.count("\n") == 1

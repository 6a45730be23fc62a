"""Closed loops in machine code: a tick from random moving states in float64, short walks against XLA's; what is kept.

All in one file, so that one process makes the machine code for all of it.
"""

import dataclasses
import shutil
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_walks import scenarios, simulation

from jaxbiped import runtime
from jaxbiped.sim import Options, Scenario, Simulation, prepare, segments
from jaxbiped.sim.compile import backend, kept
from jaxbiped.sim.compile.evaluate import evaluate
from jaxbiped.sim.compile.machine import Code, Machine
from jaxbiped.sim.compile.program import Program
from jaxbiped.sim.compile.to_jax import Lanes
from jaxbiped.sim.compile.trace import program_of, shared_leaves, tick, trace
from jaxbiped.sim.tick import State

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
LANES = 32
MOST_OPERATIONS = {"elkahlout": 26_500, "surena3": 27_500}
"""Scalar operations of a control tick, its physics ticks as one loop: a ceiling that speed is not to be lost by."""
AMPLIFIED = 5.0
"""By how much more than XLA's own walks from nudged masses those in C may differ from XLA's, at the most."""


def sixteen() -> Scenario:
    """As many as XLA has lanes for, so that one program walks them."""
    return jax.tree.map(lambda leaf: leaf[:16], scenarios(20))


def moving(states: State, duration: float) -> State:
    """States at any time of a walk, somewhere else and moving, some of them failed, some flags turned."""
    random = np.random.default_rng(1)

    def shaken(leaf: np.ndarray) -> np.ndarray:
        if leaf.dtype == bool:
            return random.random(leaf.shape) < 0.5
        if leaf.dtype.kind != "f":
            return leaf
        near = np.where(np.isfinite(leaf), leaf, random.uniform(0.0, 3.0, leaf.shape))
        return near + 0.05 * random.normal(size=leaf.shape) * (1.0 + 0.2 * np.abs(near))

    n, world = len(states.time), states.world
    states = eqx.tree_at(
        lambda s: s.world, jax.tree.map(lambda leaf: shaken(np.asarray(leaf)), states), world
    )
    qpos = states.physics.qpos
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    tick = random.integers(0, int(duration / 5e-4), n).astype(np.int32)
    new = (
        random.normal(0.0, 1.0, states.physics.qvel.shape),
        tick,
        (random.random(n) < 0.15).astype(np.int32),
    )
    return eqx.tree_at(lambda s: (s.physics.qvel, s.physics.tick, s.record.statistics.status), states, new)


def in_double(name: str, make: Callable[[Program], Machine | Lanes]) -> None:
    """Compare a tick from random moving states in double precision with XLA's."""
    one = simulation(name)
    states = segments.begun(one, scenarios(LANES), 1000)
    states = moving(states, float(one.controller.gait.duration))
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), states)
    closed = trace(one, shapes)
    program = program_of(closed, one, shapes)
    assert len(program.order) < MOST_OPERATIONS[name]
    leaves = shared_leaves(one)
    got, want = make(program).advance(leaves, states, 1), backend._by_xla(closed, leaves)(states)
    assert np.asarray(got.physics.tick != states.physics.tick).mean() > 0.5  # they do move
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(got), jax.tree.leaves(want), strict=True):
        b, where = np.asarray(b), jax.tree_util.keystr(path)
        if b.dtype.kind != "f":
            np.testing.assert_array_equal(a, b, err_msg=where)
            continue
        size = max(1.0, np.abs(b[np.isfinite(b)]).max(initial=0.0))
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-10 * size, err_msg=where)


@pytest.mark.parametrize("name", ["elkahlout", "surena3"])
def test_a_tick_from_random_moving_states_in_double(name: str, x64: None):
    in_double(name, lambda program: Machine(Code.of(program, single=False)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["elkahlout", "surena3"])
def test_scalars_given_to_xla_tick_as_it_does_in_double(name: str, x64: None):
    """XLA takes minutes to compile so many operations on a CPU."""
    in_double(name, Lanes)


@pytest.mark.slow
def test_scalars_given_to_xla_walk(in_c: Simulation):
    """By their option, compared with the plain tick at their first use; as near to walks in C as these to XLA's."""
    batch, scalar = sixteen(), simulation("elkahlout", backend="scalar")
    ours, theirs = (one.run_many(batch, 0.05).statistics for one in (scalar, in_c))
    assert float(np.max(ours.end_time)) > 0.045
    name, odd = backend.worst(ours, theirs)
    assert odd == 0.0, name


@pytest.fixture(scope="module")
def in_c() -> Simulation:
    return simulation("elkahlout", backend="c")


def noisy(batch: Scenario) -> Scenario:
    """With noise on forces and angles, of a seed of its own in every one."""
    seeds = jnp.arange(len(batch.ground.sinkage), dtype=jnp.int32)
    return eqx.tree_at(
        lambda s: (s.sensors.force_noise, s.sensors.angle_noise, s.sensors.seed),
        batch,
        (jnp.full(seeds.shape, 5.0), jnp.full(seeds.shape, 1e-3), seeds),
    )


def test_noise_is_that_of_xla():
    """Until touchdowns amplify rounding; it moves the instants of some reflexes, and so the ZMP."""
    batch = noisy(sixteen())
    ours, theirs = (
        simulation("elkahlout", backend=name, noise=True).run_many(batch, 0.4).statistics
        for name in ("c", "xla")
    )
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(theirs), strict=True):
        size = max(1.0, np.abs(np.asarray(b)[np.isfinite(b)]).max(initial=0.0))
        np.testing.assert_allclose(a, b, rtol=0.0, atol=5e-3 * size, err_msg=jax.tree_util.keystr(path))
    calm = np.asarray(simulation("elkahlout", backend="xla").run_many(sixteen(), 0.4).statistics.zmp_margin)
    moved = np.abs(np.asarray(theirs.zmp_margin) - calm) > 1e-3
    assert moved.sum() >= 2
    np.testing.assert_allclose(ours.zmp_margin, theirs.zmp_margin, atol=2e-4)


def test_traces_are_those_of_xla():
    """Row by row; a walk that has failed stands still in both."""
    batch = sixteen()
    ours, theirs = (
        simulation("elkahlout", backend=name, trace_every=20).run_many(batch, 0.9) for name in ("c", "xla")
    )
    assert ours.trace is not None and theirs.trace is not None
    assert ours.trace.time.shape == (16, 90) and ours.trace.qpos.shape == theirs.trace.qpos.shape
    np.testing.assert_array_equal(ours.trace.targets.phase.step, theirs.trace.targets.phase.step)
    for (path, a), b in zip(
        jax.tree_util.tree_leaves_with_path(ours.trace), jax.tree.leaves(theirs.trace), strict=True
    ):
        if a.dtype.kind == "f":
            size = max(1.0, np.abs(b[np.isfinite(b)]).max(initial=0.0))
            share = np.isclose(a, b, rtol=0.0, atol=2e-3 * size, equal_nan=True).mean()
            assert share > 0.99, f"{jax.tree_util.keystr(path)}: {share:.3f}"
    fell = np.asarray(ours.statistics.end_time) < 0.85
    assert fell.any() and (ours.trace.qpos[fell, -1] == ours.trace.qpos[fell, -2]).all()


def test_walks_are_those_of_xla(in_c: Simulation):
    """As close as XLA's own walks are if all masses are changed by their last bit: touchdowns amplify rounding."""
    batch, in_xla = sixteen(), simulation("elkahlout", backend="xla")
    nudged = eqx.tree_at(
        lambda s: s.errors.mass_scale, batch, batch.errors.mass_scale * np.float32(1.0 + 1.2e-7)
    )
    got, want, other = in_c.run_many(batch, 1.0), in_xla.run_many(batch, 1.0), in_xla.run_many(nudged, 1.0)
    np.testing.assert_array_equal(got.statistics.status, want.statistics.status)
    upright = np.asarray(want.statistics.status) == 0
    assert 0.5 < upright.mean() < 1.0
    leaves = jax.tree_util.tree_leaves_with_path(want.statistics)
    for (path, b), a, c in zip(
        leaves, *map(jax.tree.leaves, (got.statistics, other.statistics)), strict=True
    ):
        a, b, c = (np.asarray(x)[upright].astype(float) for x in (a, b, c))
        finite = np.isfinite(b)
        size = max(1.0, np.abs(b[finite]).max(initial=0.0))
        ours, xlas = (np.abs(x[finite] - b[finite]).max(initial=0.0) / size for x in (a, c))
        assert ours <= AMPLIFIED * xlas + 1e-4, jax.tree_util.keystr(path)


def test_walks_do_not_depend_on_the_number_of_lanes_and_threads(
    in_c: Simulation, monkeypatch: pytest.MonkeyPatch
):
    batch = scenarios(40)
    told: list[float] = []
    together, in_turn = in_c.run_many(batch, 1.0), in_c.run_many(batch, 1.0, told.append, lanes=6)
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(in_turn), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    assert told[-1] == 1.0
    monkeypatch.setattr(runtime, "threads", lambda: 3)
    in_threads = in_c.run_many(batch, 1.0)
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(in_threads), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    alone = in_c.run(jax.tree.map(lambda leaf: leaf[5], batch), 1.0)
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[5], np.asarray(b))


def test_other_numbers_walk_by_the_same_machine_code(in_c: Simulation):
    """A heavier trunk and softer servos, as a calibration has them one after the other."""
    batch = sixteen()
    machine = backend.machine_of(in_c, segments.begun(in_c, batch, 1000))
    own = in_c.run_many(batch, 0.2).statistics

    def heavier(one: Simulation) -> Simulation:
        robot, links, servo = one.robot, one.robot.links, one.robot.servo
        links = dataclasses.replace(links, mass=links.mass * np.where(np.arange(13) == 0, 1.16, 1.0))
        servo = dataclasses.replace(servo, kp=servo.kp * 0.7)
        robot = dataclasses.replace(robot, links=links, servo=servo)
        return prepare(robot, one.controller, one.options)

    other, in_xla = heavier(in_c), heavier(simulation("elkahlout", backend="xla"))
    assert backend.machine_of(other, segments.begun(other, batch, 1000)) is machine
    got, want = (one.run_many(batch, 0.2).statistics for one in (other, in_xla))
    np.testing.assert_allclose(got.foot_force, want.foot_force, atol=2.0)
    ratio = np.asarray(want.foot_force).sum(axis=1) / np.asarray(own.foot_force).sum(axis=1)
    np.testing.assert_allclose(ratio, 1.1, atol=0.02)  # 50 kg of 80
    again = in_c.run_many(batch, 0.2).statistics
    np.testing.assert_array_equal(np.asarray(again.foot_force), np.asarray(own.foot_force))


def test_wrong_machine_code_is_refused_by_the_name_of_the_variable(in_c: Simulation):
    states = segments.begun(in_c, scenarios(4), 1000)
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), states)
    closed = trace(in_c, shapes)
    machine, advance = backend.machine_of(in_c, states), Machine.advance

    class Wrong(Machine):
        def __init__(self) -> None:
            self.__dict__.update(machine.__dict__)

        def advance(self, leaves: Any, states: Any, ticks: int) -> Any:
            new = advance(self, leaves, states, ticks)
            return eqx.tree_at(lambda s: s.zmp, new, new.zmp + 0.01)

    with pytest.raises(ValueError, match=r"'c' differs from XLA in zmp in 100% of lanes"):
        backend.compare(Wrong(), closed, in_c, jax.tree.map(np.asarray, states))


def strange(one: Simulation, state: State) -> tuple[State, Any]:
    """A step with what no rule is for."""
    new, stopped = tick(one, state)
    return eqx.tree_at(lambda s: s.zmp, new, jax.lax.erf(new.zmp)), stopped


def test_what_there_is_no_rule_for_is_named(in_c: Simulation):
    states = segments.begun(in_c, scenarios(4), 1000)
    with pytest.raises(backend.NotServedError, match=r"cannot do this walk: no rule for the primitive 'erf'"):
        backend.machine_of(in_c, states, strange)


@pytest.mark.parametrize(
    ("options", "what"),
    [({"contact": "c_mujoco"}, "contact 'c_mujoco'"), ({"contact": "mjx"}, "contact 'mjx'")],
)
def test_what_only_xla_serves_is_refused(options: dict[str, Any], what: str):
    for name in ("c", "scalar"):
        with pytest.raises(ValueError, match=f"backend: got '{name}', which has no {what}; allowed: xla"):
            Options(backend=name, **options)
    with pytest.raises(ValueError, match="backend: got 'fortran', allowed: auto, xla, c, scalar"):
        Options(backend="fortran")


def test_noise_in_double_is_refused(x64: None):
    with pytest.raises(
        ValueError, match="backend: got 'c', which has no noise in double precision; allowed: xla"
    ):
        Options(backend="c", noise=True)


def test_machine_code_is_kept_beside_the_kernels():
    from jaxbiped.sim.compile import build

    assert build.folder().parent == runtime.cache_folder().parent


# Programs kept on disk --------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that has not made any machine code yet; what is on disk stays, as compiling takes long."""
    monkeypatch.setattr(backend, "_machines", {})


@pytest.fixture(scope="module")
def begun() -> tuple[Simulation, State]:
    one = simulation("elkahlout", backend="c")
    states = segments.begun(one, sixteen(), 1000)
    return one, jax.tree.map(np.asarray, states)


def name(one: Simulation, states: State) -> str | None:
    return kept.name_of(one, tick, backend._key(one, states, tick)[:2])


def no_tracing(*_: object) -> None:
    raise AssertionError("traced")


def test_a_program_is_found_again_without_tracing(begun, monkeypatch):
    made = backend.machine_of(*begun)
    backend._machines.clear()
    monkeypatch.setattr(backend, "trace", no_tracing)
    found = backend.machine_of(*begun)
    assert isinstance(found, Machine) and isinstance(made, Machine)
    assert found is not made and found.code.text == made.code.text
    # what is the same for all lanes is computed from the numbers of this robot
    leaves = shared_leaves(begun[0])
    values: list[dict[int, object]] = [{}, {}]
    for machine, into in zip((made, found), values, strict=True):
        evaluate(machine.code.nodes, into, lambda leaf: leaves[leaf].reshape(-1))
    assert len(values[0]) > 100 and values[0] == values[1]
    states = begun[1]
    for a, b in zip(*(jax.tree.leaves(m.advance(leaves, states, 5)) for m in (made, found)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_program_that_does_not_do_what_its_example_says_is_refused(begun, monkeypatch):
    backend.machine_of(*begun)
    named = name(*begun)
    found = kept.recall(named)
    assert found is not None
    after = eqx.tree_at(
        lambda s: s.zmp,
        jax.tree.unflatten(jax.tree.structure(begun[1]), found.example.after),
        replace_fn=lambda x: x + 0.01,
    )
    wrong = found.example._replace(after=jax.tree.leaves(after))
    monkeypatch.setattr(kept, "name_of", lambda *_: "wrong")
    try:
        kept.keep("wrong", kept.Kept(found.code, wrong))
        backend._machines.clear()
        with pytest.raises(ValueError, match=r"'c' differs from XLA in zmp in 100% of lanes"):
            backend.machine_of(*begun)
    finally:
        kept._file("wrong").unlink(missing_ok=True)


def test_a_file_that_is_cut_off_counts_as_none(begun):
    backend.machine_of(*begun)
    named = name(*begun)
    assert named is not None
    whole, half = kept._file(named).read_bytes(), kept._file("half")
    try:
        half.write_bytes(whole[: len(whole) // 2])
        assert kept.recall("half") is None
        half.write_bytes(whole)
        assert kept.recall("half") is not None
    finally:
        half.unlink(missing_ok=True)
    assert kept.recall(None) is None


def test_the_name_covers_all_that_a_program_depends_on(begun, monkeypatch):
    one, states = begun
    own = name(one, states)
    assert own is not None and own == name(simulation("elkahlout", backend="c"), states)
    heavier = eqx.tree_at(lambda s: s.robot.links.mass, one, replace_fn=lambda mass: mass.at[0].multiply(1.1))
    assert name(heavier, states) == own  # a number that the program is given
    without = eqx.tree_at(lambda s: s.robot.servo.ki, one, replace_fn=lambda ki: ki + 1.0)
    coarse = dataclasses.replace(one.options, dt=1e-3)
    others = [
        name(without, states),  # a zero that is part of it
        name(dataclasses.replace(one, options=coarse), states),
        name(one, jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype.kind == "f" else leaf, states)),
        name(simulation("surena3", backend="c"), states),
    ]
    with jax.numpy_dtype_promotion("strict"):
        others.append(name(one, states))
    monkeypatch.setattr(kept.files, "source_hash", lambda: "other sources")
    others.append(name(one, states))
    assert None not in others and len({own, *others}) == 7


def test_what_has_a_class_from_elsewhere_is_not_kept(begun):
    class OfMyOwn(Simulation):
        """A user may change it without its name changing."""

    one, states = begun
    mine = OfMyOwn(one.robot, one.controller, one.model, one.torque, one.options)
    assert name(mine, states) is None

"""Programs that are kept on disk: found by all that they depend on, and compared with their example."""

import dataclasses
import shutil
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_walks import scenarios, simulation

from jaxbiped.sim import Simulation, segments
from jaxbiped.sim.compile import backend, build, kept
from jaxbiped.sim.compile.evaluate import evaluate
from jaxbiped.sim.compile.trace import shared_leaves
from jaxbiped.sim.tick import State

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kept")


@pytest.fixture(autouse=True)
def fresh(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of its own, and a process that has not compiled anything yet."""
    monkeypatch.setattr(build, "folder", lambda: folder)
    monkeypatch.setattr(backend, "_machines", {})


@pytest.fixture(scope="module")
def begun() -> tuple[Simulation, State]:
    one = simulation("elkahlout", backend="c")
    states = segments._begin(one, scenarios(20), jnp.asarray(1000, jnp.int32))
    return one, jax.tree.map(np.asarray, states)


def name(one: Simulation, states: State) -> str | None:
    return kept.name_of(one, backend._key(one, states)[:2])


def no_tracing(*_: object) -> None:
    raise AssertionError("traced")


def test_a_program_is_found_again_without_tracing(begun, folder, monkeypatch):
    made = backend.machine_of(*begun)
    backend._machines.clear()
    monkeypatch.setattr(backend, "trace", no_tracing)
    found = backend.machine_of(*begun)
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


def test_a_program_that_does_not_do_what_its_example_says_is_refused(begun):
    backend.machine_of(*begun)
    named = name(*begun)
    found = kept.recall(named)
    assert found is not None
    after = eqx.tree_at(
        lambda s: s.zmp,
        jax.tree.unflatten(jax.tree.structure(begun[1]), found.example.after),
        replace_fn=lambda x: x + 0.01,
    )
    kept.keep(named, kept.Kept(found.code, found.example._replace(after=jax.tree.leaves(after))))
    backend._machines.clear()
    with pytest.raises(ValueError, match=r"'c' differs from XLA in zmp in 100% of lanes"):
        backend.machine_of(*begun)
    kept.keep(named, found)


def test_a_file_that_is_cut_off_counts_as_none(begun, folder):
    backend.machine_of(*begun)
    (file,) = folder.glob("*.program")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    assert kept.recall(file.stem) is None
    file.write_bytes(whole)
    assert kept.recall(file.stem) is not None
    assert kept.recall(None) is None


def test_the_name_covers_all_that_a_program_depends_on(begun, monkeypatch):
    one, states = begun
    own = name(one, states)
    assert own is not None and own == name(simulation("elkahlout", backend="c"), states)
    heavier = eqx.tree_at(lambda s: s.robot.links.mass, one, replace_fn=lambda mass: mass * 1.1)
    assert name(heavier, states) == own  # a number that the program is given
    without = eqx.tree_at(lambda s: s.robot.servo.ki, one, replace_fn=lambda ki: ki + 1.0)
    coarse = dataclasses.replace(one.options, dt=1e-3)
    others = [
        name(without, states),  # a zero that is part of it
        name(dataclasses.replace(one, options=coarse), states),
        name(one, jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype.kind == "f" else leaf, states)),
        name(simulation("surena3", backend="c"), states),
    ]
    monkeypatch.setattr(kept.files, "source_hash", lambda: "other sources")
    others.append(name(one, states))
    assert None not in others and len({own, *others}) == 6


def test_what_has_a_class_from_elsewhere_is_not_kept(begun):
    class OfMyOwn(Simulation):
        """A user may change it without its name changing."""

    one, states = begun
    mine = OfMyOwn(one.robot, one.controller, one.model, one.torque, one.options)
    assert name(mine, states) is None

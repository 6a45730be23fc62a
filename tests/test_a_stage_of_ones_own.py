"""A third stage, written here and nowhere else: batched, tuned, in a variant file, with its column in the table."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
import tomli_w
from jaxtyping import Array, Float

from jaxbiped import adapt, batch, planner, robot, sim, tune
from jaxbiped.adapt import Landing, Outcome, PlannedStage, Sensed, Signals, Stage, tunables
from jaxbiped.adapt.parameters import Tune, number
from jaxbiped.batch import columns, part
from jaxbiped.checked import Quantity
from jaxbiped.commands.choices import load_variant
from jaxbiped.planner import Gait, Targets

COARSE = sim.Options(dt=2e-3, control_every=2)


class Held(eqx.Module):
    """How far the plan has been put off, and when the last tick was [s]."""

    time: Float[Array, ""]
    held: Float[Array, ""]


class FrozenGait(PlannedStage):
    """The gait stands still while a foot bears more than the limit."""

    params: "Freeze"

    @classmethod
    def plan(cls, params: "Freeze", gait: Gait) -> "FrozenGait":
        return cls(params)

    def init(self) -> Held:
        return Held(jnp.zeros(()), jnp.zeros(()))

    def step(
        self, state: Held, gait: Gait, targets: Targets, sensed: Sensed, signals: Signals
    ) -> tuple[Held, Targets, Signals]:
        over = (sensed.corner_force.sum(axis=1).max() - self.params.limit) / self.params.softness
        rate = jax.nn.sigmoid(over)  # how much of the tick is waited
        held = state.held + rate * (sensed.time - state.time)
        plan = planner.at(gait, sensed.time - held)
        plan = replace(plan, velocity=jax.tree.map(lambda v: (1.0 - rate) * v, plan.velocity))
        return Held(sensed.time, held), plan, signals

    def outcome(self, state: Held) -> dict[str, Array]:
        return {"frozen_s": state.held}


class Freeze(Stage):
    """Parameters of the stage."""

    name: ClassVar[str] = "freeze"
    planned: ClassVar[type[PlannedStage]] = FrozenGait
    replans: ClassVar[bool] = True
    outcomes: ClassVar[dict[str, Outcome]] = {"frozen_s": Outcome("how long the gait was frozen")}

    limit: Float[Array, ""] = number(
        "limit", Quantity("N", 0.0, 1e5, True, text="Force on a foot that freezes the gait."), 1100.0,
        tune=Tune(900.0, 1500.0),
    )  # fmt: skip
    softness: Float[Array, ""] = number(
        "softness", Quantity("N", 0.0, 1e4, True, text="Over which force it does so."), 30.0
    )


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    """Known in the tests of this file only."""
    adapt.register(Freeze)
    yield
    del adapt.STAGES[Freeze.name]


@pytest.fixture(scope="module")
def surena() -> Any:
    params = robot.load("surena3")
    return params, planner.PolynomialGait.preset(params, 2)


@pytest.fixture(scope="module")
def experiment(surena) -> batch.Experiment:
    params, gait = surena
    variants = {"freeze": adapt.Controller(gait, Freeze())}
    swing = float(gait.timing.first_liftoff) + 0.3
    scenarios = batch.grid(push_z_N=[0.0, -500.0], push_time_s=swing, push_length_s=0.2)
    return batch.Experiment(params, variants, scenarios, COARSE, duration=swing + 0.6)


def test_it_acts_before_landing_which_fits_steps_to_the_ground(surena):
    controller = adapt.Controller(surena[1], Landing.repaired(), Freeze())
    assert [stage.name for stage in controller.stages] == ["freeze", "landing"]


def test_it_is_batched_and_has_its_column(experiment, tmp_path):
    """A push of half a kilonewton downward for 0.2 s freezes the gait for as long."""
    table = batch.run(experiment, tmp_path, workers=1)
    alone, pushed = table.sort("push_z_N", descending=True)["frozen_s"]
    assert alone < 0.05 and 0.15 < pushed < 0.3
    again, rows = batch.open_table(tmp_path)
    assert rows.equals(table) and isinstance(again.variants["freeze"].stage("freeze").params, Freeze)


def test_its_column_is_missing_where_a_variant_has_not_the_stage(surena, experiment):
    both = replace(experiment, variants={"off": adapt.Controller(surena[1]), **experiment.variants})
    assert both.outcomes["frozen_s"] == Freeze.outcomes["frozen_s"]
    found = {name: np.zeros(2) for name in columns.OUTCOMES}
    frame = part.outcome_frame({**found, "status": np.zeros(2, int)}, both.outcomes)
    assert frame["frozen_s"].to_list() == [None, None] and frame.schema["frozen_s"] == pl.Float64
    own = {**columns.OUTCOMES, "froze": Outcome("whether it froze", bool), "times": Outcome("how often", int)}
    given = {**found, "status": np.zeros(2, int), "froze": np.array([True, False])}
    frame = part.outcome_frame(given, own)
    assert frame["froze"].to_list() == [True, False] and frame["times"].to_list() == [None, None]


def test_its_numbers_are_differentiated(surena, experiment):
    """How long the gait is frozen under a force that swells and ebbs, by the limit: forward mode and a difference."""
    params, controller = surena[0], experiment.variants["freeze"]
    found = tunables.find(["freeze"], controller)
    assert [(t.name, t.unit, t.low) for t in found] == [("freeze.limit", "N", 900.0)]
    time = 0.004 * jnp.arange(1.0, 200.0)

    def frozen(limit: Array) -> Array:
        changed = tunables.apply(params, controller, found, limit[None])

        def tick(state: Any, t: Array) -> Any:
            force = jnp.full((2, 4), 150.0) + 150.0 * jnp.sin(4.0 * t) ** 2
            return changed.step(state, Sensed.nothing(t, corner_force=force))[0], None

        state = jax.lax.scan(tick, changed.init(), time)[0]
        return changed.outcome(state)["frozen_s"]

    value, slope = jax.jit(lambda x: jax.jvp(frozen, (x,), (jnp.ones_like(x),)))(jnp.asarray(1000.0))
    low, high = jax.jit(jax.vmap(frozen))(jnp.array([990.0, 1010.0]))
    assert 0.1 < value < 0.5 and slope < -1e-5
    assert float(slope) == pytest.approx(float(high - low) / 20.0, rel=0.05)


@pytest.mark.slow
def test_it_is_tuned(experiment, tmp_path):
    """A descent over whole walks moves its limit, and its file says so."""
    problem = tune.Problem.of(experiment, ["freeze"])
    tuned = tune.tune(problem, experiment, tmp_path, tune.Settings(steps=2, scenarios=2, seed=0))
    assert float(tuned.values[0]) != pytest.approx(float(problem.start[0]), abs=1e-3)
    text = tune.variant_file(tuned, {"freeze": {"base": "default"}}, "a test")
    (tmp_path / "tuned.toml").write_text(text)
    back = load_variant("--variant", tmp_path / "tuned.toml", experiment.robot, problem.controller.gait)
    assert float(back.stage("freeze").params.limit) == pytest.approx(float(tuned.values[0]), rel=1e-6)


def test_its_numbers_are_written_to_a_variant_file_and_read_again(surena, experiment, tmp_path):
    params, gait = surena
    controller = experiment.variants["freeze"]
    found = tunables.find(["freeze.limit"], controller)
    tables = tunables.as_tables(params, controller, found, [1000.0])
    file = Path(tmp_path / "frozen.toml")
    file.write_text(tomli_w.dumps({"freeze": {"base": "default", **tables["freeze"]}}))
    back = load_variant("--variant", file, params, gait)
    assert float(back.stage("freeze").params.limit) == 1000.0 and back.stage("landing") is None


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"base": "default", "limit": -1.0}, r"freeze\.limit: got -1 N, allowed: > 0 and <= 100000 N"),
        ({"base": "default", "limits": 1.0}, r"freeze\.limits.*did you mean 'limit'"),
        ({"base": "modified"}, r"freeze\.base: got .*'modified', allowed: off, default"),
    ],
)
def test_what_it_does_not_declare_is_refused(surena, tmp_path, table, says):
    file = Path(tmp_path / "frozen.toml")
    file.write_text(tomli_w.dumps({"freeze": table}))
    with pytest.raises(ValueError, match=says):
        load_variant("--variant", file, *surena)


def test_another_stage_of_the_same_name_is_refused():
    class Other(Freeze):
        pass

    with pytest.raises(ValueError, match=r"got the name 'freeze', allowed: another than landing, payload"):
        adapt.register(Other)

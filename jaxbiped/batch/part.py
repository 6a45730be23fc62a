"""One chunk of walks: from scenarios to rows of the results table."""

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
from jaxtyping import Array

from jaxbiped import runtime, sim
from jaxbiped.adapt import Controller, Outcome
from jaxbiped.batch import inputs
from jaxbiped.batch.columns import ALWAYS, OUTCOMES, require_declared
from jaxbiped.batch.experiment import Chunk, Experiment
from jaxbiped.robot import SIDE_NAMES
from jaxbiped.score import STATUS_TEXT, judge
from jaxbiped.sim import Scenario, Walk

Columns = dict[str, Array]


def walk_chunk(
    experiment: Experiment, chunk: Chunk, told: Callable[[float], None] | None = None
) -> pl.DataFrame:
    """Walk a chunk in this process; rows of the results table.

    Args:
        experiment: whose chunk.
        chunk: which one.
        told: is told from time to time which fraction of it is done.
    """
    n = chunk.stop - chunk.start
    rows = np.minimum(chunk.start + np.arange(max(n, experiment.lanes)), chunk.stop - 1)
    table = experiment.table[rows.tolist()]
    batch = inputs.scenarios_of(table, experiment.pads)
    simulation = sim.prepare(
        experiment.robot, experiment.variants[chunk.variant], experiment.simulation, sim.rectangles_of(batch)
    )
    walks = simulation.run_many(batch, experiment.durations[chunk.variant], told, experiment.lanes)
    outcome = _outcomes(walks, simulation.controller, batch)
    outcome = {name: np.asarray(column)[:n] for name, column in outcome.items()}
    return pl.concat(
        [_identity(chunk), table[:n], outcome_frame(outcome, experiment.outcomes)], how="horizontal"
    )


@runtime.jit
def _outcomes(walks: Walk, controller: Controller, batch: Scenario) -> Columns:
    return jax.vmap(lambda walk, scenario: outcome_of(walk, controller, scenario))(walks, batch)


def outcome_of(walk: Walk, controller: Controller, scenario: Scenario) -> Columns:
    """Columns of the table for one walk, as numbers."""
    s, verdict = walk.statistics, judge(walk, controller.gait, scenario)
    roll, pitch = jnp.rad2deg(s.peak_roll_pitch)
    feet = {
        "peak_force_{}_N": s.peak_foot_force,
        "touchdown_force_{}_N": s.peak_touchdown_force,
        "touchdown_impulse_{}_Ns": s.peak_touchdown_impulse,
        "slip_{}_m": s.peak_slip,
    }
    return {
        "status": verdict.status,
        "success": verdict.success,
        "finished": verdict.finished,
        "end_time_s": s.end_time,
        "peak_roll_deg": roll,
        "peak_pitch_deg": pitch,
        **{name.format(side): both[i] for name, both in feet.items() for i, side in enumerate(SIDE_NAMES)},
        "zmp_margin_m": s.zmp_margin,
        "reach_margin_m": s.reach_margin,
        "out_of_reach_s": s.out_of_reach_time,
        "x_m": s.p_world_trunk[0],
        "y_m": s.p_world_trunk[1],
        **({} if walk.controller is None else controller.outcome(walk.controller)),
    }


def _identity(chunk: Chunk) -> pl.DataFrame:
    scenario = np.arange(chunk.start, chunk.stop)
    return pl.DataFrame(
        {
            "row": pl.Series(chunk.first_row + scenario, dtype=pl.Int64),
            "variant": [chunk.variant] * len(scenario),
            "scenario": pl.Series(scenario, dtype=pl.Int64),
        }
    )


def outcome_frame(
    outcome: Mapping[str, np.ndarray], declared: Mapping[str, Outcome] = OUTCOMES
) -> pl.DataFrame:
    """Columns of the outcome as they are declared; those of stages that the controller has not are filled in.

    Raises:
        ValueError: for a column that is not declared, or one that is missing and has no stage.
    """
    n = len(outcome["status"])
    own = {name for name in declared if name in ALWAYS or name not in OUTCOMES}
    absent = {name: np.full(n, declared[name].absent) for name in own if name not in outcome}
    outcome = {**outcome, **absent}
    require_declared(outcome, declared)
    columns = [_column(name, outcome[name], column.kind) for name, column in declared.items()]
    floats = {name for name in own if declared[name].kind is float}
    return pl.DataFrame([column.fill_nan(None) if column.name in floats else column for column in columns])


_DTYPES = {float: pl.Float64, int: pl.Int64, bool: pl.Boolean, str: pl.String}


def _column(name: str, values: np.ndarray, kind: type) -> pl.Series:
    if name == "status":
        values = np.array([STATUS_TEXT[i] for i in values], object)
    plain = values.tolist() if values.dtype == object else values.astype(kind)
    return pl.Series(name, plain, dtype=_DTYPES[kind])

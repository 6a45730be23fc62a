"""Walks that several test files look at, each simulated once."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import pytest
from closed_loop import Setup, lane, run, setup, standing

from jaxbiped.sim import Scenario
from jaxbiped.sim.statistics import Statistics
from jaxbiped.sim.tick import Sample, Walk

LIFT = (0.0, 0.0, 5000.0)
"""Six times the robot's weight, upward [N]."""
SHOVE, LEAN = (0.0, 300.0, 0.0), (36.0, 18.0, 0.0)
"""Forces [N] that topple a walking robot, and that a standing one must bear."""

CARRIED = (1.0, 0.0, 3.0)
"""A load [kg] from the start on that is taken off again [s]."""


class Walks(NamedTuple):
    """A robot's roll-outs: one batch, of which every lane has a name."""

    one: Setup
    batch: Walk

    def trace(self, name: str) -> Sample:
        return lane(self.batch.trace, LANES.index(name))

    def statistics(self, name: str) -> Statistics:
        return lane(self.batch.statistics, LANES.index(name))


LANES = (
    "walk",
    "without feed-forward",
    "stand",
    "topple",
    "stand and bear",
    "no gain",
    "carried off",
    "hop",
    "carry",
)


@pytest.fixture(scope="session", params=["surena3", "elkahlout"])
def walks(request: pytest.FixtureRequest) -> Walks:
    one = setup(request.param)
    still, flat = standing(one), Scenario.flat()
    broken = flat.errors.gain_scale.at[0, 3].set(jnp.nan)
    cases = [
        (one.gait, flat),
        (one.gait, flat),
        (still, flat),
        (one.gait, flat.with_push(SHOVE, 3.0, 0.5)),
        (still, flat.with_push(LEAN, 1.0, 6.0)),
        (one.gait, eqx.tree_at(lambda s: s.errors.gain_scale, flat, broken)),
        (still, flat.with_push(LIFT, 1.0, 8.0)),
        (still, flat.with_push(LIFT, 1.0, 0.03)),
        (still, flat.with_payload(*CARRIED)),
    ]
    return Walks(one, run(one, cases, [name != "without feed-forward" for name in LANES]))

"""Short walks in which everything happens."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbiped import robot
from jaxbiped.adapt import Controller, Landing, PayloadReflex
from jaxbiped.planner import own_gait
from jaxbiped.sim import Scenario, Simulation, own_options, prepare


def simulation(name: str, **options: Any) -> Simulation:
    """elkahlout with the modified payload reflex, surena3 with the repaired landing."""
    params = robot.load(name)
    gait = own_gait(params, 4)
    stage = PayloadReflex.modified(params, gait) if name == "elkahlout" else Landing.repaired()
    return prepare(params, Controller(gait, stage), dataclasses.replace(own_options(params, gait), **options))


def scenarios(n: int, seed: int = 0) -> Scenario:
    """Loads, pushes, pads, other masses; one robot in eight is pushed over."""
    random, real = np.random.default_rng(seed), jnp.result_type(float)
    batch = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), Scenario.flat(2))
    lower = random.uniform([0.3, -0.3], [0.9, 0.1], (n, 2, 2))
    force = np.where(np.arange(n)[:, None] % 8 == 3, 900.0, random.normal(0.0, 20.0, (n, 3)))
    values = {
        "terrain.lower": lower, "terrain.upper": lower + random.uniform(0.05, 0.4, (n, 2, 2)),
        "terrain.height": random.normal(0.0, 0.01, (n, 2)), "payload.mass": random.uniform(0.0, 15.0, n),
        "payload.time": random.uniform(0.0, 1.5, n), "push.force": force, "push.start": np.full(n, 0.3),
        "push.length": np.full(n, 0.1), "errors.mass_scale": random.uniform(0.95, 1.05, (n, 13)),
    }  # fmt: skip

    parts = lambda s: [getattr(getattr(s, a), b) for a, b in (name.split(".") for name in values)]  # noqa: E731
    return eqx.tree_at(parts, batch, [jnp.asarray(value, real) for value in values.values()])

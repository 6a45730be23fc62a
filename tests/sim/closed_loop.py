"""Closed loops that several test files share: one compilation for each robot, scenarios and gaits as a batch."""

from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbiped import robot
from jaxbiped.adapt import Controller
from jaxbiped.planner import CosineGait, PolynomialGait, StartStop, own_gait
from jaxbiped.sim import Options, Scenario, Walk, own_options, prepare

N_STEPS = 4
FIRM = Path(__file__).with_name("firm_elkahlout.toml")
FOREVER = 100.0
LANES = 4
STANDS_FOR = 0.5
"""How long a walk is watched after its end [s]."""


class Setup(NamedTuple):
    """A robot with its preset gait."""

    params: robot.RobotParams
    gait: Any
    options: Options
    duration: float

    @property
    def weight(self) -> float:
        return float(self.params.total_mass) * 9.81


def firm(name: str) -> robot.RobotParams:
    """A robot that walks as its preset gait plans: a preset, but for elkahlout."""
    return robot.load(FIRM if name == "elkahlout" else name)


def setup(name: str, n_steps: int = N_STEPS, **options: Any) -> Setup:
    params = firm(name)
    gait = own_gait(params, n_steps)
    every = own_options(params, gait).control_every
    chosen = {"control_every": every, "trace_every": 20 // every, **options}
    return Setup(params, gait, Options(**chosen), float(gait.duration) + STANDS_FOR)


def standing(one: Setup) -> Any:
    """A gait of the same kind that does not begin to walk before FOREVER has passed, nor go anywhere then.

    Its later steps, which are never taken, would tip the robot over.
    """
    if one.gait.name == "cosine":
        p = changed(CosineGait.preset_params(one.params.name), T_ini=FOREVER, w=0.0, b_s=0.0)
        return CosineGait.make(one.params, p, one.gait.n_steps, allow_infeasible=True)
    p = PolynomialGait.preset_params(one.params.name)
    x, z = float(p.start_stop.x_rest_start), float(p.z_min)
    ends = {f: -x if f.startswith("x_s_") else x for f in StartStop.__dataclass_fields__}
    ends = StartStop(**{**ends, "v_first": 0.0, "v_last": 0.0})
    half = 0.5 * float(p.L_p)
    p = changed(p, T_ini=FOREVER, D_s=0.0, x_s=-x, x_e=x, y_d=half, y_m=half, z_max=z)
    p = eqx.tree_at(lambda p: p.start_stop, p, ends)
    return PolynomialGait.make(one.params, p, one.gait.n_steps, allow_infeasible=True)


def changed(record: Any, **values: Any) -> Any:
    """A record with other numbers in some fields."""
    names = list(values)
    new = [jnp.asarray(values[n], jnp.result_type(float)) for n in names]
    return eqx.tree_at(lambda r: [getattr(r, n) for n in names], record, new)


def stack(items: list[Any]) -> Any:
    """Records into one with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)


def lane(batch: Any, i: int) -> Any:
    """One of a batch, as NumPy."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[i], batch)


def run(one: Setup, cases: list[tuple[Any, Scenario]], feed_forward: list[bool] | None = None) -> Walk:
    """Walks of (gait, scenario), with the plan's torque or without it: LANES of a gait at a time, by one program."""
    simulation = prepare(one.params, Controller(one.gait), one.options)
    shares, found = feed_forward or [True] * len(cases), [None] * len(cases)
    kinds: dict[tuple[int, bool], list[int]] = {}
    for i, ((gait, _), share) in enumerate(zip(cases, shares, strict=True)):
        kinds.setdefault((id(gait), share), []).append(i)
    for (_, share), rows in kinds.items():
        led = simulation.led_by(Controller(cases[rows[0]][0]))
        led = eqx.tree_at(lambda s: s.torque.torque, led, replace_fn=lambda t, by=float(share): by * t)
        for start in range(0, len(rows), LANES):
            few = rows[start : start + LANES]
            filled = (few + few[-1:] * LANES)[:LANES]
            walks = led.run_many(stack([cases[i][1] for i in filled]), one.duration)
            for k, i in enumerate(few):
                found[i] = lane(walks, k)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)

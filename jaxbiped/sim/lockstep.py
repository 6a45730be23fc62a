"""Whole walks in C MuJoCo, many in lockstep: the engine moves the robots, `conclude` does the rest of every tick."""

import functools
from collections.abc import Callable, Hashable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxbiped import runtime
from jaxbiped.sim.physics import c_world
from jaxbiped.sim.physics.c_mujoco import Fields, Robots
from jaxbiped.sim.physics.c_world import SPHERES
from jaxbiped.sim.physics.contract import Physics
from jaxbiped.sim.record import Record
from jaxbiped.sim.scenario import Scenario, with_room
from jaxbiped.sim.seen import Seen
from jaxbiped.sim.segments import Told, begun, ticks_of_segment
from jaxbiped.sim.tick import PureSimulation, Sample, State, Walk, observed


def run(
    simulation: PureSimulation,
    scenarios: Scenario,
    duration: float,
    told: Told | None = None,
    contact: str | Sequence[str] = SPHERES,
) -> Walk:
    """Walk all scenarios for `duration` [s]; runs on the host, cannot be traced.

    Args:
        simulation: the robot, its controller and the options.
        scenarios: with a leading axis; rectangles may overlap and may be holes.
        duration: [s].
        told: is told which fraction of the walk is done.
        contact: model of the contact between soles and ground, one of `c_world.CONTACTS`; for all or for each.

    Raises:
        ValueError: for a model of the contact that there is not.
    """
    robot, options = simulation.robot, simulation.options
    sinkage, ticks = np.asarray(scenarios.ground.sinkage), simulation.ticks(duration)
    contacts = [contact] * len(sinkage) if isinstance(contact, str) else list(contact)
    if len(contacts) != len(sinkage):
        raise ValueError(f"contact: got {len(contacts)} models, allowed: one, or {len(sinkage)}")
    for one in contacts:
        c_world.CONTACT.check("contact", one)
    cases = list(zip(sinkage.tolist(), contacts, strict=True))
    depth = {case: c_world.resting_depth(robot, case[0], options.dt, case[1]) for case in set(cases)}
    rests = jnp.asarray([depth[case] for case in cases], sinkage.dtype)
    resting = eqx.tree_at(lambda s: s.ground.sinkage, scenarios, rests)
    states = begun(
        simulation, with_room(resting), ticks
    )  # every robot stands at rest on the compliant ground
    robots = Robots(robot, scenarios, options, contacts, np.asarray(states.physics.qpos))
    fixed, kind = jax.tree.flatten(simulation)
    conclude = _conclude(kind)
    every, walking, rows = options.trace_every, np.ones(len(contacts), bool), []
    for tick in range(ticks - ticks % max(every, 1)):
        moved, seen = robots.control_tick(tick * options.control_every, states.reference, walking)
        states, stopped, sample = conclude(fixed, states, moved, seen)
        if every and (tick + 1) % every == 0:
            rows.append(jax.tree.map(np.asarray, sample))
        walking = ~np.asarray(stopped)
        over = not walking.any() and not every
        if told is not None and (over or (tick + 1) % ticks_of_segment(simulation) == 0):
            told(1.0 if over else (tick + 1) / ticks)
        if over:
            break
    trace = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *rows) if rows else None
    return Walk(states.record.statistics, trace, states.controller)


Concluded = Callable[[list[Array | np.ndarray], State, Fields, Fields], tuple[State, Array, Sample]]


@functools.lru_cache(maxsize=16)
def _conclude(kind: Hashable) -> Concluded:
    """The compiled rest of a control tick of simulations of one kind (a tree structure).

    It gives states, which have stopped, and samples. It is called tens of thousands of times in a walk: to look
    for what is static in a simulation at every call, as `runtime.jit` does, would take ten times as long as the tick.
    """

    def conclude(
        fixed: list[Array], states: State, moved: dict[str, Array], seen: dict[str, Array]
    ) -> tuple[State, Array, Sample]:
        simulation: PureSimulation = jax.tree.unflatten(kind, fixed)
        dt = simulation.options.dt

        def one(state: State, moved: Physics, seen: Seen) -> tuple[State, Array, Sample]:
            def tick(
                carry: tuple[Physics, Record], after: tuple[Physics, Seen]
            ) -> tuple[tuple[Physics, Record], None]:
                return observed(*carry, *after, dt, state.world.scenario), None

            (physics, record), _ = jax.lax.scan(tick, (state.physics, state.record), (moved, seen))
            last = jax.tree.map(lambda leaf: leaf[-1], seen)
            state, sample = simulation.conclude(state, physics, record, last)
            return state, state.stopped, sample

        moved, seen = _as_computed((moved, seen), states.physics.qpos.dtype)
        return jax.vmap(one)(states, Physics(**moved), Seen(**seen))

    return runtime.jit_arrays(conclude)


def _as_computed(tree: PyTree, dtype: np.dtype) -> PyTree:
    """Convert all floats of a tree to the float type that JAX computes with."""
    return jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype.kind == "f" else leaf, tree)

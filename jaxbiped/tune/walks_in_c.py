"""Walks with a loss in machine code: what `walks` has XLA compile, by the C compiler.

What depends on the tunables is a number of every lane, so that one program serves walks with different values of them.
So are the tangents: the program of slopes advances a walk and one tangent of it, in a lane for every scenario and
tunable. Only the table of the plan's torques is the same for all lanes of a call.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxbiped import runtime, sim
from jaxbiped.adapt import tunables
from jaxbiped.adapt.controller import Controller
from jaxbiped.runtime import OnHost
from jaxbiped.score import Loss
from jaxbiped.sim.compile import backend
from jaxbiped.sim.compile.trace import shared_leaves
from jaxbiped.sim.tick import State
from jaxbiped.tune.walks import SAMPLES, Setting, poses

BLOCK = 16
"""Walks that are begun and ended at once."""
FEWEST = 8
"""Walks that have to share a table of torques, in the mean, for machine code to be worth calling."""
SLOPE_ROUNDING = {size: 30.0 * rounding for size, rounding in backend.ROUNDING.items()}
"""Tangents of forces on stiff ground are small differences of large numbers: a digit or two are lost."""
Places = tuple[tuple[int, ...], ...]
"""For every leaf of a controller's real numbers, which of its elements depend on tunables."""
T = TypeVar("T")


class Walker(eqx.Module):
    """Record of what all lanes share."""

    simulation: sim.Simulation
    """With the variant's own numbers, and the torques of the plan that is walked."""
    loss: Loss
    places: Places = eqx.field(static=True)
    torque_slope: Float[Array, "n 2 6"] | None = None
    """Derivative of the torques; None where they depend on no tunable, or where nothing is differentiated."""


class Walking(eqx.Module):
    """A walk that has come so far."""

    state: State
    integral: Float[Array, " m"]
    """Of the loss's rates."""
    poses: Float[Array, "12"]
    """Of trunk and soles in the last tick [m, rad]."""
    tuned: Float[Array, " p"]
    """Numbers of the controller that depend on tunables."""


class Differentiated(eqx.Module):
    """A walk and one tangent of it."""

    walking: Walking
    slope: PyTree
    """Tangents of the walk's real numbers, but for those of its world."""


def value_step(walker: Walker, walking: Walking) -> tuple[Walking, Bool[Array, ""]]:
    """Advance a walk by a tick; pure."""
    return _advanced(walker, walker.simulation.torque.torque, walking), jnp.zeros((), bool)


def slope_step(walker: Walker, both: Differentiated) -> tuple[Differentiated, Bool[Array, ""]]:
    """Advance a walk and its tangent by a tick; pure."""
    moving, still = _split(both.walking)

    def further(moving: PyTree, torque: Array) -> tuple[PyTree, Walking]:
        new = _advanced(walker, torque, eqx.combine(moving, still))
        return _split(new)[0], new

    torque = walker.simulation.torque.torque
    if walker.torque_slope is None:
        _, slope, new = jax.jvp(lambda m: further(m, torque), (moving,), (both.slope,), has_aux=True)
    else:
        tangents = (both.slope, walker.torque_slope)
        _, slope, new = jax.jvp(further, (moving, torque), tangents, has_aux=True)
    return Differentiated(new, slope), jnp.zeros((), bool)


def _advanced(walker: Walker, torque: Array, walking: Walking) -> Walking:
    one = _with(walker, torque, walking.tuned)
    state, integral, sample = one.integrated(
        walking.state, walking.integral, partial(walker.loss.rate, one.robot)
    )
    return Walking(state, integral, poses(sample), walking.tuned)


def _split(walking: Walking) -> tuple[PyTree, PyTree]:
    """Part a walk into what may depend on tunables and the rest: its world, and what is no real number."""
    is_moving = jax.tree.map(eqx.is_inexact_array, walking)
    return eqx.partition(walking, eqx.tree_at(lambda w: w.state.world, is_moving, False))


def _with(walker: Walker, torque: Array, tuned: Float[Array, " p"]) -> sim.Simulation:
    """The simulation with other numbers in the controller, and other torques."""
    controller = _replaced(walker.simulation.controller, walker.places, tuned)
    return eqx.tree_at(lambda s: (s.controller, s.torque.torque), walker.simulation, (controller, torque))


def _replaced(controller: Controller, places: Places, tuned: Float[Array, " p"]) -> Controller:
    reals, rest = eqx.partition(controller, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(reals)
    first = 0
    for i, own in enumerate(places):
        if own:
            flat = jnp.ravel(leaves[i]).at[np.array(own)].set(tuned[first : first + len(own)])
            leaves[i], first = flat.reshape(leaves[i].shape), first + len(own)
    return eqx.combine(jax.tree.unflatten(tree, leaves), rest)


class WalksInC:
    """Losses of walks and their slopes, by machine code that is made at its first use."""

    def __init__(self, setting: Setting):
        # Applied, since a number that a variant leaves to be derived is none of its own.
        own = tunables.values(setting.simulation.controller, setting.tunables)
        simulation = dataclasses.replace(setting.simulation, controller=_controller(setting, own))
        self.setting = eqx.tree_at(lambda s: s.simulation, setting, simulation)
        self.own, slopes = _on_host(_slopes_of_numbers(self.setting, own))
        self.places: Places = tuple(_where(np.any(slope != 0.0, axis=0)) for slope in slopes)
        is_gait = any(t.stage == "gait" for t in setting.tunables)
        self.moves_torque = setting.simulation.options.feed_forward and is_gait
        self.can = True
        """Whether there is a rule for all that is walked, as far as is known."""

    def serves(self, points: np.ndarray) -> bool:
        """Tell whether walks at such values (n, k) can be, and enough of them share a table of torques."""
        return self.can and (not self.moves_torque or len(np.unique(points, axis=0)) * FEWEST <= len(points))

    def walk_values(
        self, at: np.ndarray, scenarios: sim.Scenario
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Losses (n,) of scenarios with each its own values of the tunables (n, k); see `walks.walk_values`."""
        numbers = runtime.in_blocks(partial(_numbers, self.setting), BLOCK, at)
        places = self._placed(numbers)
        tuned, walking = _picked(numbers, places), None
        _, group = (
            np.unique(at, axis=0, return_inverse=True) if self.moves_torque else (at, np.zeros(len(at)))
        )
        for lanes in (np.flatnonzero(group == number) for number in np.unique(group)):
            torque = _torque(self.setting, jnp.asarray(at[lanes[0]])) if self.moves_torque else None
            walker = self._walker(places, torque)
            begun = runtime.in_blocks(partial(_begun, walker), BLOCK, tuned[lanes], _rows(scenarios, lanes))
            machine = backend.machine_of(walker, begun, value_step)
            ended = machine.advance(shared_leaves(walker), begun, int(self.setting.ticks), runtime.threads())
            walking = _put(walking, lanes, len(at), ended)
        return runtime.in_blocks(partial(_ended, self.setting, places), BLOCK, walking, scenarios)

    def walk_slopes(
        self, at: np.ndarray, scenarios: sim.Scenario
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Losses, their slopes and more, see `walks.walk_slopes`; a lane for every scenario and tunable."""
        point, k = jnp.asarray(at), len(at)
        numbers, number_slopes = _on_host(_slopes_of_numbers(self.setting, point))
        places = self._placed([leaf[None] for leaf in numbers])
        tuned = _picked([leaf[None] for leaf in numbers], places)[0]
        tuned_slopes = _picked(number_slopes, places)
        torque, torque_slopes = _slopes_of_torque(self.setting, point) if self.moves_torque else (None, None)
        walker = self._walker(places, torque)
        begun, slopes = runtime.in_blocks(
            partial(_begun_slopes, walker, tuned, tuned_slopes, torque_slopes), BLOCK, scenarios
        )
        parts = []
        for together in [[*range(k)]] if torque_slopes is None else [[j] for j in range(k)]:
            if torque_slopes is not None:
                own = torque_slopes[together[0]]
                walker = eqx.tree_at(lambda w: w.torque_slope, walker, own, is_leaf=lambda x: x is None)
            parts.append(self._walked(walker, begun, jax.tree.map(lambda leaf: leaf[:, together], slopes)))  # noqa: B023
        walking, time = parts[0][0], parts[0][3]
        slopes, growth = jax.tree.map(
            lambda *few: np.concatenate(few, axis=1), *(part[1:3] for part in parts)
        )
        ended = runtime.in_blocks(
            partial(_ended_slopes, self.setting, places), BLOCK, walking, slopes, scenarios
        )
        losses, loss_slopes, trigger_slopes, became = ended
        return losses, loss_slopes, trigger_slopes, np.moveaxis(growth, 1, 2), {**became, "time": time}

    def _walked(
        self, walker: Walker, begun: Walking, slopes: PyTree
    ) -> tuple[Walking, PyTree, np.ndarray, np.ndarray]:
        """Walk to the end by some tunables together.

        Returns:
            The walks (n, ...), their tangents (n, k, ...), the norms of those of the poses on the way (n, k, t), and
            when (n, t).
        """
        n, k = slopes.poses.shape[:2]
        lanes = Differentiated(
            jax.tree.map(lambda leaf: np.repeat(leaf, k, axis=0), begun),
            jax.tree.map(lambda leaf: leaf.reshape(n * k, *leaf.shape[2:]), slopes),
        )
        compared = Differentiated(lanes.walking, _like(lanes.slope))
        machine = backend.machine_of(walker, compared, slope_step, rounding=SLOPE_ROUNDING)
        leaves, ticks = shared_leaves(walker), int(self.setting.ticks)
        interval = max(ticks // SAMPLES, 1)
        growth, time = np.zeros((2, n * k, SAMPLES), lanes.walking.poses.dtype)
        for row in range(min(SAMPLES, ticks)):
            lanes = machine.advance(leaves, lanes, interval, runtime.threads())
            growth[:, row] = np.linalg.norm(lanes.slope.poses, axis=-1)
            time[:, row] = lanes.walking.state.time
        lanes = machine.advance(leaves, lanes, max(0, ticks - SAMPLES * interval), runtime.threads())
        walking = jax.tree.map(lambda leaf: leaf[::k], lanes.walking)
        slopes = jax.tree.map(lambda leaf: leaf.reshape(n, k, *leaf.shape[1:]), lanes.slope)
        return walking, slopes, growth.reshape(n, k, SAMPLES), time[::k]

    def _walker(self, places: Places, torque: Array | None) -> Walker:
        simulation = self.setting.simulation
        if torque is not None:
            simulation = eqx.tree_at(lambda s: s.torque.torque, simulation, torque)
        return Walker(simulation, self.setting.loss, places)

    def _placed(self, numbers: list[np.ndarray]) -> Places:
        """Places of all numbers that have a slope, or were ever other than the variant's own, rounding apart.

        Args:
            numbers: leaves of the controller, with a leading axis.
        """
        moved = [_where(~np.all(_same(new, own), axis=0)) for new, own in zip(numbers, self.own, strict=True)]
        self.places = tuple(tuple(sorted({*old, *new})) for old, new in zip(self.places, moved, strict=True))
        return self.places


def _same(new: np.ndarray, own: np.ndarray) -> np.ndarray | np.bool_:
    return np.isclose(new, own, rtol=16.0 * np.finfo(own.dtype).eps, atol=0.0, equal_nan=True)


def _where(flags: np.ndarray | np.bool_) -> tuple[int, ...]:
    return tuple(np.flatnonzero(flags).tolist())


def _reals(controller: Controller) -> list[Array]:
    return jax.tree.leaves(eqx.filter(controller, eqx.is_inexact_array))


def _on_host(tree: PyTree) -> OnHost:
    return jax.tree.map(np.asarray, tree)


def _rows(tree: T, rows: np.ndarray) -> T:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


def _put(all_lanes: OnHost, lanes: np.ndarray, n: int, some: OnHost) -> OnHost:
    """All of n lanes, with new values in some."""
    if all_lanes is None:
        all_lanes = jax.tree.map(lambda leaf: np.zeros((n, *leaf.shape[1:]), leaf.dtype), some)
    for old, new in zip(jax.tree.leaves(all_lanes), jax.tree.leaves(some), strict=True):
        old[lanes] = new
    return all_lanes


def _like(slope: PyTree) -> PyTree:
    """Random tangents of the same shapes, to compare with: in those of a start most numbers are zero."""
    random = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: random.normal(0.0, 1e-2, leaf.shape).astype(leaf.dtype), slope)


def _picked(leaves: list[np.ndarray], places: Places) -> OnHost:
    """Numbers at the places, of leaves with a leading axis (m, p)."""
    parts = [leaf.reshape(len(leaf), -1)[:, own] for leaf, own in zip(leaves, places, strict=True)]
    return np.concatenate(parts, axis=1)


@runtime.jit
def _controller(setting: Setting, at: Float[Array, " k"]) -> Controller:
    return tunables.apply(setting.simulation.robot, setting.simulation.controller, setting.tunables, at)


@runtime.jit
def _torque(setting: Setting, at: Float[Array, " k"]) -> Array:
    return setting.simulation.led_by(_controller(setting, at)).torque.torque


def _all_slopes(function: Callable[[Array], T], at: Float[Array, " k"]) -> tuple[T, T]:
    """The value of a function and its derivatives, with a leading axis."""
    units = jnp.eye(len(at), dtype=at.dtype)
    return jax.vmap(lambda unit: jax.jvp(function, (at,), (unit,)), out_axes=(None, 0))(units)


@runtime.jit
def _numbers(setting: Setting, at: Float[Array, "n k"]) -> list[Array]:
    return jax.vmap(lambda x: _reals(_controller(setting, x)))(at)


@runtime.jit
def _slopes_of_numbers(setting: Setting, at: Float[Array, " k"]) -> tuple[list[Array], list[Array]]:
    return _all_slopes(lambda x: _reals(_controller(setting, x)), at)


@runtime.jit
def _slopes_of_torque(setting: Setting, at: Float[Array, " k"]) -> tuple[Array, Array]:
    return _all_slopes(lambda x: _torque(setting, x), at)


def _start(walker: Walker, torque: Array, tuned: Float[Array, " p"], scenario: sim.Scenario) -> Walking:
    one = _with(walker, torque, tuned)
    integral = one.integral_of(partial(walker.loss.rate, one.robot))
    return Walking(one.start(scenario), integral, jnp.zeros(12, integral.dtype), tuned)


@runtime.jit
def _begun(walker: Walker, tuned: Float[Array, "n p"], scenarios: sim.Scenario) -> Walking:
    torque = walker.simulation.torque.torque
    return jax.vmap(lambda own, scenario: _start(walker, torque, own, scenario))(tuned, scenarios)


@runtime.jit
def _begun_slopes(
    walker: Walker,
    tuned: Float[Array, " p"],
    tuned_slopes: Float[Array, "k p"],
    torque_slopes: Float[Array, "k m 2 6"] | None,
    scenarios: sim.Scenario,
) -> tuple[Walking, PyTree]:
    """Walks that begin (n, ...), and their tangents (n, k, ...)."""
    torque = walker.simulation.torque.torque
    if torque_slopes is None:
        torque_slopes = jnp.zeros((len(tuned_slopes), *torque.shape), torque.dtype)

    def one(tuned_slope: Array, torque_slope: Array, scenario: sim.Scenario) -> tuple[Walking, PyTree]:
        def begin(tuned: Array, torque: Array) -> tuple[PyTree, Walking]:
            walking = _start(walker, torque, tuned, scenario)
            return _split(walking)[0], walking

        _, slope, walking = jax.jvp(begin, (tuned, torque), (tuned_slope, torque_slope), has_aux=True)
        return walking, slope

    by_tunable = jax.vmap(one, in_axes=(0, 0, None), out_axes=(None, 0))
    return jax.vmap(by_tunable, in_axes=(None, None, 0))(tuned_slopes, torque_slopes, scenarios)


def _end(
    setting: Setting, places: Places, walking: Walking, scenario: sim.Scenario
) -> tuple[tuple[Array, Array], dict[str, Array]]:
    """The loss and the start of the last reflex, and what became of the walk."""
    state, controller = walking.state, _replaced(setting.simulation.controller, places, walking.tuned)
    walk = sim.Walk(state.record.statistics, None, state.controller, walking.integral)
    return setting.concluded(walk, controller.gait, scenario)


@runtime.jit
def _ended(
    setting: Setting, places: Places, walking: Walking, scenarios: sim.Scenario
) -> tuple[Array, dict[str, Array]]:
    (losses, _), became = jax.vmap(lambda one, scenario: _end(setting, places, one, scenario))(
        walking, scenarios
    )
    return losses, became


@runtime.jit
def _ended_slopes(
    setting: Setting, places: Places, walking: Walking, slopes: PyTree, scenarios: sim.Scenario
) -> tuple[Array, Array, Array, dict[str, Array]]:
    """Losses (n,), their slopes and those of the reflexes' starts (n, k), and what became of the walks."""

    def one(
        walking: Walking, slope: PyTree, scenario: sim.Scenario
    ) -> tuple[Array, Array, Array, dict[str, Array]]:
        moving, still = _split(walking)
        (loss, _), (loss_slope, trigger_slope), became = jax.jvp(
            lambda m: _end(setting, places, eqx.combine(m, still), scenario),
            (moving,),
            (slope,),
            has_aux=True,
        )
        return loss, loss_slope, trigger_slope, became

    by_slope = jax.vmap(one, in_axes=(None, 0, None), out_axes=(None, 0, 0, None))
    return jax.vmap(by_slope)(walking, slopes, scenarios)

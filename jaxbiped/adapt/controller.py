"""The walking controller: a gait, and the stages that adapt it to what the sensors say."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxbiped import runtime
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.adapt.stage import PlannedStage, Signals, Stage
from jaxbiped.planner import Gait, Targets, at


class ControllerState(eqx.Module):
    """State of the controller between two ticks."""

    time: Float[Array, ""]
    """Time of the last reading [s]."""
    stages: dict[str, PyTree]
    """State of every stage, by its name."""
    signals: Signals
    """Signals of the last tick."""

    @property
    def plan_time(self) -> Float[Array, ""]:
        """Time in the plan [s]."""
        return self.signals.plan_time


class Controller(eqx.Module):
    """A gait and the stages that adapt it online; without stages it walks open loop."""

    gait: Gait
    """The planned walk."""
    stages: tuple[PlannedStage, ...]
    """The planned stages in the order in which they act: first those that decide which step is made."""

    def __init__(self, gait: Gait, *stages: Stage | None):
        """Plan the stages for the gait.

        Args:
            gait: the planned walk.
            *stages: their parameters, each at most once; None is a stage that is off.

        Raises:
            ValueError: if a stage is there twice.
        """
        chosen = sorted((stage for stage in stages if stage is not None), key=lambda stage: not stage.replans)
        names = [stage.name for stage in chosen]
        if len(set(names)) < len(names):
            raise ValueError(f"stages: got {', '.join(names)}, allowed: each at most once")
        self.gait = gait
        self.stages = tuple(_planned(stage, gait) for stage in chosen)

    def stage(self, name: str) -> Any:  # noqa: ANN401
        """The planned stage of this name; None if there is none."""
        return next((stage for stage in self.stages if stage.name == name), None)

    def init(self) -> ControllerState:
        """State before the first tick."""
        states = {stage.name: stage.init() for stage in self.stages}
        return ControllerState(jnp.zeros((), jnp.result_type(float)), states, Signals.none())

    def longest_delay(self, changes: int = 1) -> float:
        """Return the longest time the stages can put the plan off [s], if the weight changes suddenly so often."""
        return sum((stage.longest_delay(self.gait, changes) for stage in self.stages), 0.0)

    def step(self, state: ControllerState, sensed: Sensed) -> tuple[ControllerState, Targets]:
        """One control tick: read the sensors, give task-space targets."""
        states, signals, targets = {}, state.signals, at(self.gait, sensed.time)
        for stage in self.stages:
            states[stage.name], targets, signals = stage.step(
                state.stages[stage.name], self.gait, targets, sensed, signals
            )
        signals = eqx.tree_at(lambda s: s.plan_time, signals, targets.time)
        return ControllerState(sensed.time, states, signals), targets

    def outcome(self, state: ControllerState) -> dict[str, Array]:
        """Outcome columns of all stages, at the end of a walk, which may have been taken to NumPy."""
        states = jax.tree.map(jnp.asarray, state.stages)
        return {
            name: value for stage in self.stages for name, value in stage.outcome(states[stage.name]).items()
        }


@runtime.jit
def _planned(stage: Stage, gait: Gait) -> PlannedStage:
    """Plan a stage; compiled, since its hundred small operations would take seconds one by one."""
    return stage.plan(gait)

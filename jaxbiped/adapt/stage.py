"""Stages, by which a controller adapts, and signals, which stages send each other.

A stage is written as two records. `Stage` holds the parameters, declared by `parameters.number` and `switch`, and says
what belongs to it: the names of its variants, its outcome columns. `PlannedStage` is the stage for one planned walk and
acts in every control tick. `register` makes it known by name, to variant files, tunables and folders of results.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxbiped.adapt.parameters import require_names
from jaxbiped.adapt.sensed import Sensed
from jaxbiped.checked import register_as
from jaxbiped.planner import Gait, Targets
from jaxbiped.robot import RobotParams

Scalar = Float[Array, ""]


class Signals(eqx.Module):
    """Messages of the stages to each other and to the score: where the walk is, and what has interrupted it."""

    plan_time: Scalar
    """Time in the plan [s]."""
    walking: Bool[Array, ""]
    """Whether the plan is being walked; False while a recovery stands in its place."""
    disturbed: Bool[Array, ""]
    """Whether a foot has just touched down, or is overdue: foot forces say little about the weight. Said anew in every
    tick by the one stage that watches the feet; nobody else takes it back."""
    interruptions: Int[Array, ""]
    """Number of interruptions of the walk."""
    interrupted_time: Scalar
    """Time at which the last interruption began [s]."""
    resume_time: Scalar
    """Time at which the walk went on after the last interruption [s]."""
    next_step: Int[Array, ""]
    """Number of the plan's step with which the walk goes on."""

    @classmethod
    def none(cls) -> "Signals":
        """Signals before the first tick: the plan is being walked, and nothing has happened."""
        zero, count = jnp.zeros((), jnp.result_type(float)), jnp.zeros((), jnp.int32)
        return cls(zero, jnp.ones((), bool), jnp.zeros((), bool), count, zero, zero, count)


class Outcome(NamedTuple):
    """A declared column of the outcome of a walk."""

    text: str
    """Description of the column."""
    kind: type = float
    """Type of the values: float, int, bool or str."""
    absent: bool | int | float | str | None = None
    """Value where the controller has not the stage; None is missing."""


class PlannedStage(eqx.Module):
    """A stage for one planned walk."""

    params: eqx.AbstractVar["Stage"]
    """Parameters of the stage."""

    @property
    def name(self) -> str:
        """Name of the stage."""
        return self.params.name

    @classmethod
    @abstractmethod
    def plan(cls, params: "Stage", gait: Gait) -> "PlannedStage":
        """Read off the plan what the stage needs of it; pure, and may be traced."""

    @abstractmethod
    def init(self) -> PyTree:
        """State before the first tick."""

    @abstractmethod
    def step(
        self, state: PyTree, gait: Gait, targets: Targets, sensed: Sensed, signals: Signals
    ) -> tuple[PyTree, Targets, Signals]:
        """Adapt the targets of one control tick; pure.

        Args:
            state: of the last tick.
            gait: the plan.
            targets: what is to be done so far: the plan's, adapted by the stages before this one.
            sensed: what the sensors say.
            signals: of the stages before this one; of those after it, from the last tick.
        """

    def outcome(self, state: PyTree) -> dict[str, Array]:
        """The columns that `Stage.outcomes` declares, from the state at the end of a walk."""
        return {}

    def longest_delay(self, gait: Gait, changes: int) -> float:
        """Return the longest time the stage can put the plan off [s], if the weight changes suddenly so often."""
        return 0.0


class Stage(eqx.Module):
    """The parameters of a stage, and what belongs to it."""

    name: ClassVar[str]
    """Name of the stage in variant files, of tunables and in a controller."""
    record: ClassVar[str] = ""
    """Name of the stage's records in folders of results; the stage's name if empty."""
    planned: ClassVar[type[PlannedStage]]
    """The stage that is planned with these parameters."""
    replans: ClassVar[bool] = False
    """Whether the stage decides which step is made; such stages act before those that fit a step to the ground."""
    variants: ClassVar[tuple[str, ...]] = ("default",)
    """Names that `named` knows."""
    outcomes: ClassVar[Mapping[str, Outcome]] = {}
    """Columns of the stage in the results table."""
    read_off_plan: ClassVar[tuple[str, ...]] = ()
    """Parameters that a variant reads off robot and plan where they are not given."""

    @classmethod
    def named(cls, variant: str, robot: RobotParams, gait: Gait, **parameters: object) -> "Stage":
        """The parameters of a named variant, some of them changed.

        Raises:
            TypeError: for a parameter that there is not.
            ValueError: for a value that is not allowed.
        """
        require_names(cls, parameters)
        return cls(**parameters)

    def plan(self, gait: Gait) -> PlannedStage:
        """The stage for one planned walk."""
        return self.planned.plan(self, gait)


_Stage = TypeVar("_Stage", bound=type[Stage])
STAGES: dict[str, type[Stage]] = {}
"""Stages by name."""


def register(stage: _Stage) -> _Stage:
    """Make a stage known by its name; a class decorator.

    Raises:
        ValueError: if another stage has that name.
    """
    register_as("stage", stage, STAGES)
    return stage

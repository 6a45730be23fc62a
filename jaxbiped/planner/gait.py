"""The interface of a gait to the rest of the package, the registry of gaits, and the gait of a robot's own paper.

A third gait is one file with a class that is registered here, and a file of numbers for every robot that has a preset.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, SupportsIndex, TypeVar, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxbiped import checked
from jaxbiped.checked import Quantity
from jaxbiped.planner import presets
from jaxbiped.planner.checks import GaitError, is_concrete, require_steps, require_within
from jaxbiped.planner.constraints import FRICTION, check_arguments, require_walkable
from jaxbiped.planner.presets import known_infeasible
from jaxbiped.planner.targets import Count, Phase, Plan, TaskSpace, Timing, room_for, step_phase
from jaxbiped.robot import LEFT, RobotParams, defaults

Scalar = Float[Array, ""]


@runtime_checkable
class Gait(Plan, Protocol):
    """Everything that the package uses of a gait: the plan, its parameters, and how another one is made."""

    name: ClassVar[str]
    """Name of the gait on the command line, in files and in folders of results."""
    quantities: ClassVar[Mapping[str, Quantity]]
    """Allowed values of the parameters, by their dotted names."""
    parameters: ClassVar[type[eqx.Module]]
    """The record of the parameters."""
    records: ClassVar[Mapping[str, type[eqx.Module]]]
    """Records that its parameters hold; in folders of results their names come after that of the gait."""

    @property
    def params(self) -> Any:  # noqa: ANN401
        """Parameters from which the gait was planned."""
        ...

    @property
    def n_steps(self) -> Int[Array, ""]:
        """Number of steps."""
        ...

    @property
    def first_swing(self) -> Int[Array, ""]:
        """The foot that swings first, 0 left or 1 right."""
        ...

    @property
    def room(self) -> int:
        """Number of steps that its tables have room for: plans with the same room share programs."""
        ...

    @property
    def clock_start(self) -> Float[Array, ""]:
        """Start of the clock of its paper, by which loading times are told, since the start of the walk [s]."""
        ...

    @classmethod
    def preset_params(cls, robot: str | RobotParams) -> Any:  # noqa: ANN401
        """The preset parameters for a robot."""
        ...

    @classmethod
    def preset(
        cls,
        robot: RobotParams,
        n_steps: SupportsIndex = 8,
        first_swing: SupportsIndex = LEFT,
        *,
        friction: float = FRICTION,
        allow_infeasible: bool = False,
    ) -> "Gait":
        """Plan a walk with the preset parameters."""
        ...

    @classmethod
    def make(
        cls,
        robot: RobotParams,
        params: eqx.Module,
        n_steps: SupportsIndex,
        first_swing: SupportsIndex = LEFT,
        *,
        friction: float = FRICTION,
        allow_infeasible: bool = False,
    ) -> "Gait":
        """Plan a walk."""
        ...

    def replanned(self, robot: RobotParams, params: eqx.Module, *, allow_infeasible: bool = False) -> "Gait":
        """Plan the same walk with other parameters."""
        ...


_Planned = TypeVar("_Planned", bound="PlannedGait")


class PlannedGait(eqx.Module):
    """A gait whose steps are alike, with presets: what a class of gaits has to add is abstract here."""

    name: ClassVar[str]
    quantities: ClassVar[Mapping[str, Quantity]]
    parameters: ClassVar[type[eqx.Module]]
    records: ClassVar[Mapping[str, type[eqx.Module]]] = {}
    params: eqx.AbstractVar[eqx.Module]
    n_steps: eqx.AbstractVar[Int[Array, ""]]
    first_swing: eqx.AbstractVar[Int[Array, ""]]
    room: eqx.AbstractVar[int]

    @classmethod
    @abstractmethod
    def require_sane(cls, robot: RobotParams, params: eqx.Module) -> None:
        """Raise a GaitError for parameters within their bounds that cannot be meant together, or on this robot."""

    @classmethod
    @abstractmethod
    def plan(
        cls: type[_Planned], params: eqx.Module, n_steps: Count, first_swing: Count, room: int
    ) -> _Planned:
        """The walk of these parameters, in tables with room for some more steps; pure."""

    @property
    @abstractmethod
    def timing(self) -> Timing:
        """Times of the steps."""

    @property
    @abstractmethod
    def duration(self) -> Scalar:
        """Duration of the walk from rest to rest [s]."""

    @abstractmethod
    def task(self, t: Scalar) -> TaskSpace:
        """Soles and pelvis in the world at time t [s]."""

    def phase(self, t: Scalar) -> Phase:
        """Phase of the walk at time t [s]."""
        return step_phase(self.timing, t)

    @property
    def clock_start(self) -> Scalar:
        """Start of the clock of its paper, by which loading times are told, since the start of the walk [s]."""
        return jnp.zeros((), jnp.result_type(float))

    @classmethod
    def preset_params(cls, robot: str | RobotParams) -> Any:  # noqa: ANN401
        """The preset parameters for a preset robot, by its name, or for one that walks like it.

        Raises:
            GaitError: if there are none.
        """
        return presets.preset(cls, robot).parameters(cls.parameters)

    @classmethod
    def preset(
        cls: type[_Planned],
        robot: RobotParams,
        n_steps: SupportsIndex = 8,
        first_swing: SupportsIndex = LEFT,
        *,
        friction: float = FRICTION,
        allow_infeasible: bool = False,
    ) -> _Planned:
        """Plan a walk with the preset parameters of a known robot, or of one that walks like it.

        A preset that is known to break a constraint (`known_infeasible` says which and why) is planned nevertheless;
        `violations` says by how much.

        Args:
            robot: that walks.
            n_steps: number of steps.
            first_swing: the foot that swings first, 0 left or 1 right.
            friction: coefficient of the ground.
            allow_infeasible: whether to plan what breaks a constraint, too.

        Raises:
            GaitError: if neither its name nor its `walks_like` is that of a preset, or as `make` says.
        """
        allow, params = allow_infeasible or bool(known_infeasible(cls, robot)), cls.preset_params(robot)
        return cls.make(robot, params, n_steps, first_swing, friction=friction, allow_infeasible=allow)

    @classmethod
    def make(
        cls: type[_Planned],
        robot: RobotParams,
        params: eqx.Module,
        n_steps: SupportsIndex,
        first_swing: SupportsIndex = LEFT,
        *,
        friction: float = FRICTION,
        allow_infeasible: bool = False,
    ) -> _Planned:
        """Plan a walk that breaks no constraint of khadiv section 2.2.

        The ZMP stays inside the support polygon, the friction that is needed below the ground's, joint torques and
        speeds within the robot's limits, knees bent by `MIN_KNEE` or more.

        Args:
            robot: that walks.
            params: of the gait.
            n_steps: number of steps.
            first_swing: the foot that swings first, 0 left or 1 right.
            friction: coefficient of the ground.
            allow_infeasible: whether to plan what breaks a constraint, too.

        Raises:
            GaitError: if the parameters cannot be walked by this robot: out of bounds, a foot out of reach, or a
                constraint broken (only where their values are known: what is traced is not judged).
        """
        number, foot = require_steps(n_steps, first_swing)
        return cls._made(robot, params, (number, foot, room_for(number)), friction, allow_infeasible)

    def replanned(
        self: _Planned, robot: RobotParams, params: eqx.Module, *, allow_infeasible: bool = False
    ) -> _Planned:
        """Plan the same walk with other parameters.

        Args:
            robot: that walks.
            params: of the gait.
            allow_infeasible: whether to plan what breaks a constraint, too.

        Raises:
            GaitError: as `make` says.
        """
        steps = (self.n_steps, self.first_swing, self.room)
        return self._made(robot, params, steps, FRICTION, allow_infeasible)

    @classmethod
    def _made(
        cls: type[_Planned],
        robot: RobotParams,
        params: eqx.Module,
        steps: tuple[Count, Count, int],
        friction: float,
        allow_infeasible: bool,
    ) -> _Planned:
        friction, allow_infeasible = check_arguments(friction, allow_infeasible)
        if not isinstance(params, cls.parameters):
            raise GaitError(f"params: got a {type(params).__name__}, allowed: {cls.parameters.__name__}")
        known = is_concrete(params, robot, friction)
        if known:
            require_within(params, cls.quantities)
            cls.require_sane(robot, params)
        gait = cls.plan(params, *steps)
        if known:
            require_walkable(robot, gait, friction, allow_infeasible)
        return gait


_Class = TypeVar("_Class", bound=type)
GAITS: dict[str, type[Gait]] = {}
"""Gaits by name."""


def register(gait: _Class) -> _Class:
    """Make a gait known by its name, to commands, presets and folders of results; a class decorator.

    Raises:
        ValueError: if another gait has that name.
    """
    checked.register_as("gait", gait, GAITS)
    return gait


def own_gait_name(robot: RobotParams) -> str:
    """Name of the gait of the robot's own paper, or of that of the robot it walks like.

    Raises:
        GaitError: if the files of robots name none.
    """
    name = defaults(robot).gait
    if not name:
        known = tuple(sorted({robot for gait in GAITS.values() for robot in presets.robots(gait)}))
        raise GaitError(f"own gait: {presets.no_preset(robot.preset_name, known)}, or name a gait")
    return name


def own_gait(robot: RobotParams, n_steps: SupportsIndex = 8, first_swing: SupportsIndex = LEFT) -> Gait:
    """Plan the preset walk of the robot's own paper, or of that of the robot it walks like.

    Args:
        robot: that walks.
        n_steps: number of steps.
        first_swing: the foot that swings first, 0 left or 1 right.

    Raises:
        GaitError: if there is none, or as `Gait.preset` says.
    """
    name = own_gait_name(robot)
    if name not in GAITS:
        raise GaitError(f"own gait: got {name!r}, allowed: {', '.join(GAITS)}{checked.nearest(name, GAITS)}")
    return GAITS[name].preset(robot, n_steps, first_swing)

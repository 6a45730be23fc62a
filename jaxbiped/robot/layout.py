"""Places of base, legs, feet and payload in the vectors of a model; no other module counts them.

The coordinates are MuJoCo's: qpos is (position of the base, its quaternion w x y z, angles of the hinges), qvel is
(velocity of the base, its angular velocity about its own axes, speeds of the hinges). Bodies are numbered from the
world, 0. All of it is known before anything is compiled.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbiped.robot.params import JOINT_NAMES, LINK_NAMES, SIDE_NAMES

POSITION, QUATERNION = slice(0, 3), slice(3, 7)
"""Position and quaternion of the base, in qpos."""
REAL, IMAGINARY = 3, slice(4, 7)
"""Real and imaginary parts of the base's quaternion, in qpos."""
TURNING = slice(3, 6)
"""Angular velocity of the base, in qvel; its velocity comes before it."""
BASE = slice(0, TURNING.stop)
"""Degrees of freedom of the base, in qvel."""
BASE_DOFS = BASE.stop


@dataclass(frozen=True)
class Layout:
    """Places in the vectors of one kind of robot: a trunk that floats, two legs, and whatever else has hinges."""

    bodies: tuple[str, ...]
    """Names of the bodies in the order of the model; the world is the first."""
    hinges: tuple[str, ...]
    """Names of the hinges in the order of the model; the free joint of the base comes before them."""

    @cached_property
    def nq(self) -> int:
        """Length of qpos."""
        return QUATERNION.stop + len(self.hinges)

    @cached_property
    def nv(self) -> int:
        """Length of qvel."""
        return BASE_DOFS + len(self.hinges)

    @cached_property
    def trunk(self) -> int:
        """Number of the trunk's body."""
        return self.bodies.index("trunk")

    @cached_property
    def payload(self) -> int:
        """Number of the payload's body."""
        return self.bodies.index("payload")

    @cached_property
    def feet(self) -> Int[np.ndarray, "2"]:
        """Numbers of the feet's bodies, left and right."""
        # int64 trips JAX when float64 and float32 alternate.
        return np.array([self.bodies.index(f"{side}_foot") for side in SIDE_NAMES], np.int32)

    @cached_property
    def links(self) -> slice:
        """The bodies that are links of the robot: from the trunk to before the payload."""
        return slice(self.trunk, self.payload)

    @cached_property
    def legs(self) -> Int[np.ndarray, "2 6"]:
        """Numbers of the legs' hinges, from hip to foot."""
        names = [[f"{side}_{joint}" for joint in JOINT_NAMES] for side in SIDE_NAMES]
        return np.array([[self.hinges.index(name) for name in leg] for leg in names], np.int32)

    @cached_property
    def leg_coordinates(self) -> slice | np.ndarray:
        """Places of the legs' angles in qpos, left and right in a row."""
        return _places(QUATERNION.stop + self.legs.ravel())

    @cached_property
    def leg_dofs(self) -> slice | np.ndarray:
        """Places of the legs' speeds in qvel, left and right in a row."""
        return _places(BASE_DOFS + self.legs.ravel())

    def side_dofs(self, side: int) -> slice | np.ndarray:
        """Places of one leg's speeds in qvel; 0 left, 1 right."""
        return _places(BASE_DOFS + self.legs[side])

    def leg_angles(self, qpos: Float[Array, "*n nq"]) -> Float[Array, "*n 2 6"]:
        """Angles of the legs' joints [rad]."""
        angles = qpos[..., self.leg_coordinates]
        return angles.reshape(*angles.shape[:-1], 2, 6)

    def leg_speeds(self, qvel: Float[Array, "*n nv"]) -> Float[Array, "*n 2 6"]:
        """Speeds of the legs' joints [rad/s], or whatever else stands in a vector like qvel."""
        speeds = qvel[..., self.leg_dofs]
        return speeds.reshape(*speeds.shape[:-1], 2, 6)

    def leg_rows(self, rows: Float[Array, "nv *n"]) -> Float[Array, "2 6 *n"]:
        """The rows of the legs' joints, where each row stands for a degree of freedom."""
        legs = rows[self.leg_dofs]
        return legs.reshape(2, 6, *legs.shape[1:])

    def leg_columns(self, qvel: Float[Array, " nv"]) -> Float[Array, "2 6 1"]:
        """Speeds of the legs' joints, or whatever else stands in a vector like qvel, each to multiply a row."""
        return qvel[self.leg_dofs].reshape(2, 6, 1)

    def joint_space(self, base: Float[Array, "6"], legs: Float[Array, "2 6"]) -> Float[Array, " nv"]:
        """A vector like qvel, of its part for the base and that for the legs; zero for all other joints."""
        if self._legs_are_all:
            return jnp.concatenate([base, legs.reshape(-1)])
        return jnp.zeros(self.nv, legs.dtype).at[BASE].set(base).at[self.leg_dofs].set(legs.reshape(-1))

    def coordinates(
        self, position: Float[Array, "3"], quaternion: Float[Array, "4"], legs: Float[Array, "2 6"]
    ) -> Float[Array, " nq"]:
        """A vector qpos; zero for all joints that are not the legs'."""
        if self._legs_are_all:
            return jnp.concatenate([position, quaternion, legs.reshape(-1)])
        whole = jnp.zeros(self.nq, legs.dtype).at[POSITION].set(position).at[QUATERNION].set(quaternion)
        return whole.at[self.leg_coordinates].set(legs.reshape(-1))

    @cached_property
    def _legs_are_all(self) -> bool:
        """Tell whether the legs' joints are all there are, in order."""
        return np.array_equal(self.legs.ravel(), np.arange(len(self.hinges)))


def _places(numbers: np.ndarray) -> slice | np.ndarray:
    """A slice where the numbers follow one another, which compiles to less than an index array."""
    first, n = int(numbers[0]), len(numbers)
    return slice(first, first + n) if np.array_equal(numbers, np.arange(first, first + n)) else numbers


def of(links: Sequence[str], hinges: Sequence[str]) -> Layout:
    """The layout of a model with these links and hinges in this order, and the body of a payload after the links."""
    return Layout(("world", *links, "payload"), tuple(hinges))


BIPED = of(LINK_NAMES, [f"{side}_{joint}" for side in SIDE_NAMES for joint in JOINT_NAMES])
"""Layout of two legs under a trunk, and nothing else."""

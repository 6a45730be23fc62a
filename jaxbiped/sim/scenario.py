"""A scenario: everything about one walk that the robot does not know. A batch of them has a leading axis."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbiped.planner import Gait, at
from jaxbiped.robot import RobotParams

Scalar = Float[Array, "*batch"]

PAD_BEHIND, PAD_AROUND = 0.115, 0.02
"""How far a pad under a foothold reaches behind the heel, and beyond the other edges of the sole [m]."""


def _array(value: Any) -> Any:
    return jnp.asarray(value, jnp.result_type(float))


class Terrain(eqx.Module):
    """Up to K level rectangles, raised or sunk, on ground of height 0. Heights of overlapping ones add up."""

    lower: Float[Array, "*batch K 2"] = eqx.field(converter=_array)
    """Smallest x and y of each rectangle [m]."""
    upper: Float[Array, "*batch K 2"] = eqx.field(converter=_array)
    """Largest x and y of each rectangle [m]."""
    height: Float[Array, "*batch K"] = eqx.field(converter=_array)
    """Height of each rectangle over the ground, negative for holes [m]."""


class Payload(eqx.Module):
    """A load suddenly attached to the trunk, at rest relative to it."""

    mass: Scalar = eqx.field(converter=_array)
    """[kg]; 0 for none."""
    time: Scalar = eqx.field(converter=_array)
    """When it is attached [s] since the start of the walk."""
    place: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Its centre in the pelvis frame [m]."""
    size: Scalar = eqx.field(converter=_array)
    """Edge of the cube [m]."""


class Push(eqx.Module):
    """A constant force on the trunk's centre of mass for a while."""

    force: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """World axes [N]."""
    start: Scalar = eqx.field(converter=_array)
    """[s]"""
    length: Scalar = eqx.field(converter=_array)
    """[s]"""


class Ground(eqx.Module):
    """The compliant ground: Hunt-Crossley normal force and regularised Coulomb friction at every sole corner."""

    sinkage: Scalar = eqx.field(converter=_array)
    """How deep the standing robot sinks in on both feet [m]; stiffness = weight / (8 corners x sinkage)."""
    damping: Scalar = eqx.field(converter=_array)
    """Relative force per penetration speed, a in N = k d (1 + a d') [s/m]."""
    friction: Scalar = eqx.field(converter=_array)
    """Coulomb coefficient."""
    slip_speed: Scalar = eqx.field(converter=_array)
    """Sliding speed at which friction reaches 71 % of Coulomb's [m/s]."""


class ModelErrors(eqx.Module):
    """How the simulated robot differs from the one the planner knows."""

    mass_scale: Float[Array, "*batch 13"] = eqx.field(converter=_array)
    """Factor on every link's mass and inertia."""
    trunk_com_offset: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Shift of the trunk's centre of mass [m]."""
    gain_scale: Float[Array, "*batch 2 6"] = eqx.field(converter=_array)
    """Factor on every servo's gains."""


class SensorFaults(eqx.Module):
    """How the sensors are set, and what they get wrong."""

    delta_z: Float[Array, "*batch 2 4"] = eqx.field(converter=_array)
    """Gap at which each contact switch closes [m]."""
    stuck_open: Float[Array, "*batch 2 4"] = eqx.field(converter=_array)
    """1 for a switch that never closes, else 0."""
    bounce: Scalar = eqx.field(converter=_array)
    """For how long after closing a switch opens and closes again, every millisecond [s]."""
    delay: Scalar = eqx.field(converter=_array)
    """How late every reading arrives [s]; acts in roll-outs whose options have room for it."""
    force_noise: Scalar = eqx.field(converter=_array)
    """Standard deviation of every corner force [N]; noise acts in roll-outs whose options ask for it."""
    angle_noise: Scalar = eqx.field(converter=_array)
    """Standard deviation of every joint angle, of roll and of pitch [rad]."""
    seed: Int[Array, "*batch"] = eqx.field(converter=lambda v: jnp.asarray(v, jnp.int32))
    """Of the noise."""


class Scenario(eqx.Module):
    """One world. Start from `flat()`, add what happens with the `with_` methods."""

    terrain: Terrain
    """Obstacles and holes."""
    payload: Payload
    """The load."""
    push: Push
    """The push."""
    ground: Ground
    """What the ground is like."""
    errors: ModelErrors
    """How the robot differs from its record."""
    sensors: SensorFaults
    """How its sensors are set and fail."""

    @classmethod
    def flat(cls, rectangles: int = 8) -> "Scenario":
        """Level ground, nothing happens; with room for so many rectangles."""
        return cls(
            terrain=Terrain(jnp.zeros((rectangles, 2)), jnp.zeros((rectangles, 2)), jnp.zeros(rectangles)),
            payload=Payload(mass=0.0, time=1e6, place=(0.2, 0.0, 0.25), size=0.2),
            push=Push(force=(0.0, 0.0, 0.0), start=1e6, length=0.0),
            ground=Ground(sinkage=3e-4, damping=10.0, friction=0.8, slip_speed=0.01),
            errors=ModelErrors(jnp.ones(13), jnp.zeros(3), jnp.ones((2, 6))),
            sensors=SensorFaults(
                delta_z=jnp.full((2, 4), 0.01),
                stuck_open=jnp.zeros((2, 4)),
                bounce=0.0,
                delay=0.0,
                force_noise=0.0,
                angle_noise=0.0,
                seed=0,
            ),
        )

    def with_rectangle(
        self, lower: tuple[float, float], upper: tuple[float, float], height: float
    ) -> "Scenario":
        """Add a level rectangle from `lower` to `upper` (x, y) [m], raised or sunk by `height` [m].

        Raises:
            ValueError: if the corners are not in order, or there is no room for another one.
        """
        if not (lower[0] < upper[0] and lower[1] < upper[1]):
            raise ValueError(
                f"rectangle: got lower {lower} and upper {upper} m, allowed: lower < upper in x and y"
            )
        terrain = self.terrain
        free = np.flatnonzero(np.asarray(terrain.upper[:, 0] <= terrain.lower[:, 0]))
        if free.size == 0:
            room = terrain.height.shape[0]
            raise ValueError(
                f"rectangle: got one more than {room}, allowed: {room}; start from flat(rectangles=...)"
            )
        i = int(free[0])
        new = Terrain(
            terrain.lower.at[i].set(_array(lower)),
            terrain.upper.at[i].set(_array(upper)),
            terrain.height.at[i].set(height),
        )
        return eqx.tree_at(lambda s: s.terrain, self, new)

    def with_obstacle(self, robot: RobotParams, gait: Gait, step: int, height: float) -> "Scenario":
        """Put a pad under the foothold of step number `step` (0 is the first), in that foot's lane only.

        The pad reaches PAD_BEHIND behind the heel, since a foot that touches early lands short, and PAD_AROUND beyond
        the other edges. A negative height [m] makes a hole.

        Raises:
            ValueError: if the gait has no such step, or there is no room for another rectangle.
        """
        lower, upper = pad_under(robot, gait, step)
        return self.with_rectangle(tuple(lower.tolist()), tuple(upper.tolist()), height)

    def with_payload(self, mass: float, time: float) -> "Scenario":
        """Attach a load [kg] to the front of the trunk at a time [s] since the start of the walk."""
        if not mass >= 0.0:
            raise ValueError(f"payload mass: got {mass:g} kg, allowed: >= 0 kg")
        return eqx.tree_at(lambda s: (s.payload.mass, s.payload.time), self, (_array(mass), _array(time)))

    def with_push(self, force: tuple[float, float, float], start: float, length: float) -> "Scenario":
        """Push the trunk with a force [N] from `start` for `length` [s]."""
        if not length >= 0.0:
            raise ValueError(f"push length: got {length:g} s, allowed: >= 0 s")
        return eqx.tree_at(lambda s: s.push, self, Push(force=force, start=start, length=length))

    def with_friction(self, friction: float) -> "Scenario":
        """Another friction coefficient."""
        if not friction > 0.0:
            raise ValueError(f"friction: got {friction:g}, allowed: > 0")
        return eqx.tree_at(lambda s: s.ground.friction, self, _array(friction))


def pad_under(robot: RobotParams, gait: Gait, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest corner (x, y) [m] of the pad that `Scenario.with_obstacle` puts under a foothold.

    Raises:
        ValueError: if the gait has no such step.
    """
    if not 0 <= step < gait.timing.n_steps:
        raise ValueError(f"step: got {step}, allowed: 0 to {gait.timing.n_steps - 1}")
    foot, sole = jax.tree.map(np.asarray, _foothold(gait, jnp.asarray(step)))
    corners = sole[int(foot), :2] + np.asarray(robot.p_sole_corner[int(foot), :, :2])
    return corners.min(axis=0) - [PAD_BEHIND, PAD_AROUND], corners.max(axis=0) + PAD_AROUND


@eqx.filter_jit
def _foothold(gait: Any, step: Int[Array, ""]) -> tuple[Int[Array, ""], Float[Array, "2 3"]]:
    """The foot that lands in a step, and both soles then."""
    landed = at(gait, gait.timing.touchdown(step))
    return landed.phase.swing, landed.position.sole

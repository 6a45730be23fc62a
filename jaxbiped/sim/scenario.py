"""A scenario: everything about one walk that the robot does not know. A batch of them has a leading axis."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, "*batch"]


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
    """What the sensors get wrong."""

    delta_z: Float[Array, "*batch 2 4"] = eqx.field(converter=_array)
    """Gap at which each contact switch closes [m]."""
    stuck_open: Float[Array, "*batch 2 4"] = eqx.field(converter=_array)
    """1 for a switch that never closes, else 0."""
    force_noise: Scalar = eqx.field(converter=_array)
    """Standard deviation of every corner force reading [N]."""


class Scenario(eqx.Module):
    """One world. Build it from `flat()` and the `with_` methods."""

    terrain: Terrain
    payload: Payload
    push: Push
    ground: Ground
    errors: ModelErrors
    sensors: SensorFaults

    @classmethod
    def flat(cls, obstacles: int = 8) -> "Scenario":
        """Level ground, nothing happens; with room for `obstacles` rectangles."""
        return cls(
            terrain=Terrain(jnp.zeros((obstacles, 2)), jnp.zeros((obstacles, 2)), jnp.zeros(obstacles)),
            payload=Payload(mass=0.0, time=1e9, place=(0.2, 0.0, 0.25), size=0.2),
            push=Push(force=(0.0, 0.0, 0.0), start=1e9, length=0.0),
            ground=Ground(sinkage=3e-4, damping=5.0, friction=0.8, slip_speed=0.02),
            errors=ModelErrors(jnp.ones(13), jnp.zeros(3), jnp.ones((2, 6))),
            sensors=SensorFaults(jnp.full((2, 4), 0.01), jnp.zeros((2, 4)), 0.0),
        )

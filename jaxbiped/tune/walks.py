"""Walks with a loss, pure and as XLA compiles them: their losses, and the derivatives by a controller's tunables."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxbiped import runtime, sim
from jaxbiped.adapt import tunables
from jaxbiped.adapt.tunables import Tunable
from jaxbiped.planner import Gait
from jaxbiped.score import Loss, judge

SAMPLES = 8
"""Samples of the tangents' growth over a walk, at equal distances."""


class Setting(eqx.Module):
    """A walk without its scenario and the values of the tunables."""

    simulation: sim.Simulation
    """Simulation with the variant's own values."""
    loss: Loss
    tunables: tuple[Tunable, ...] = eqx.field(static=True)
    duration: Float[Array, ""]
    """Simulated time [s]; no constant, so that one program walks for every duration."""
    ticks: Int[Array, ""]
    """Control ticks of it."""

    def walk(
        self, at: Float[Array, " k"], scenario: sim.Scenario
    ) -> tuple[tuple[Array, Array, Array], dict[str, Array]]:
        """Walk once: (loss, poses, start of the last reflex), to be differentiated, and what became of the walk."""
        controller = tunables.apply(self.simulation.robot, self.simulation.controller, self.tunables, at)
        simulation = self.simulation.led_by(controller)
        walk = simulation.walk(scenario, self.ticks, partial(self.loss.rate, simulation.robot), SAMPLES)
        assert walk.trace is not None
        (loss, trigger), became = self.concluded(walk, controller.gait, scenario)
        return (loss, poses(walk.trace), trigger), {**became, "time": walk.trace.time}

    def concluded(
        self, walk: sim.Walk, gait: Gait, scenario: sim.Scenario
    ) -> tuple[tuple[Array, Array], dict[str, Array]]:
        """Loss of a walk and start of its last reflex, to be differentiated, and what became of the walk; pure."""
        assert walk.integral is not None and walk.controller is not None
        loss = self.loss.total(walk.integral, walk, self.duration)
        became = {"status": walk.statistics.status, "success": judge(walk, gait, scenario).success}
        return (loss, walk.controller.signals.interrupted_time), became


def poses(trace: sim.Sample) -> Float[Array, "*t 12"]:
    """Poses of trunk and soles [m, rad]."""
    soles = trace.p_world_sole.reshape(*trace.p_world_trunk.shape[:-1], 6)
    return jnp.concatenate([trace.p_world_trunk, trace.roll_pitch_yaw, soles], axis=-1)


@runtime.jit
def walk_slopes(
    setting: Setting, at: Float[Array, " k"], scenarios: sim.Scenario
) -> tuple[Array, Array, Array, Array, dict[str, Array]]:
    """Losses (n,), their derivatives and those of the reflexes' starts (n, k), norms of the tangents (n, t, k).

    Walked once, tangents side by side.
    """

    def along(unit: Array) -> tuple[Array, Array, Array, Array, dict[str, Array]]:
        (loss, *_), (slope, poses, trigger), became = jax.jvp(
            lambda x: jax.vmap(lambda one: setting.walk(x, one))(scenarios), (at,), (unit,), has_aux=True
        )
        return loss, slope, trigger, jnp.sqrt(jnp.sum(poses**2, axis=-1)), became

    units = jnp.eye(len(setting.tunables), dtype=at.dtype)
    return jax.vmap(along, out_axes=(None, 1, 1, 2, None))(units)


@runtime.jit
def walk_values(
    setting: Setting, at: Float[Array, "n k"], scenarios: sim.Scenario
) -> tuple[Array, dict[str, Array]]:
    """Losses (n,) of scenarios with each its own values of the tunables."""
    (loss, *_), became = jax.vmap(setting.walk)(at, scenarios)
    return loss, became

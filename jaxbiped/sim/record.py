"""Record of a walk that is kept from physics tick to physics tick, whichever engine moves the robot."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxbiped.sim import sensors, statistics
from jaxbiped.sim.scenario import SensorFaults
from jaxbiped.sim.seen import Seen
from jaxbiped.sim.sensors import SwitchState
from jaxbiped.sim.statistics import Statistics

FORCE_FILTER = 0.005
"""Time constant of each of the two stages by which corner forces are low-passed [s]. A touchdown lasts a tick or two,
and how much of it a single reading meets depends on where in a tick the foot comes down; its impulse does not, and what
a second stage makes of it hardly does."""


class Record(eqx.Module):
    """Contact switches, low-passed forces and statistics."""

    switches: SwitchState
    filtered: Float[Array, "2 2 4"]
    """Vertical force at every sole corner after each stage of the low pass, see `low_passed` [N]."""
    statistics: Statistics

    @classmethod
    def begun(cls, seen: Seen, faults: SensorFaults) -> "Record":
        """Record of a standing robot before the first tick."""
        filtered = jnp.stack([seen.force[..., 2]] * 2)
        return cls(sensors.init_switches(seen.gap, faults), filtered, statistics.init(seen))

    def later(self, seen: Seen, time: Float[Array, ""], dt: float, faults: SensorFaults) -> "Record":
        """Record after one more tick of `dt` [s] that began at `time` [s]."""
        return Record(
            switches=sensors.read_switches(self.switches, seen.gap, time, dt, faults),
            filtered=low_passed(self.filtered, seen, dt),
            statistics=statistics.update(self.statistics, seen, time + dt, dt),
        )

    @property
    def failed(self) -> Bool[Array, ""]:
        """Tell whether the robot has fallen or failed in another way."""
        return self.statistics.status != statistics.OK


def low_passed(filtered: Float[Array, "2 2 4"], seen: Seen, dt: float) -> Float[Array, "2 2 4"]:
    """Both stages of the low-passed vertical corner forces after one more tick of `dt` [s]; they keep the impulse."""
    gain = dt / (FORCE_FILTER + dt)
    first = filtered[0] + gain * (seen.force[..., 2] - filtered[0])
    return jnp.stack([first, filtered[1] + gain * (first - filtered[1])])


def frozen(stop: Bool[Array, ""], old: PyTree, new: PyTree) -> PyTree:
    """The old state where a walk has stopped, else the new one."""
    return jax.tree.map(lambda a, b: jnp.where(stop, a, b), old, new)

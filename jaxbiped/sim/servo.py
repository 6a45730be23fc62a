"""Joint servos: PD on position and speed references, optional integral and feed-forward, torque and speed limits.

The speed-proportional part acts on the speed at the end of the tick (implicitly): explicit integration would make it
chatter. `torque` returns what acts with the speed at the start of the tick, and the damping the integrator must add to
the mass matrix to move it to the end. Of long ticks the position-proportional part does so, too.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped.robot import Servo


class Reference(eqx.Module):
    """Reference that the servos follow."""

    angle: Float[Array, "2 6"]
    """Joint angles [rad]."""
    speed: Float[Array, "2 6"]
    """Joint speeds [rad/s]."""
    feed_forward: Float[Array, "2 6"]
    """Torque added to the servo's own [N m]."""

    def later(self, dt: Float[Array, ""] | float) -> "Reference":
        """Return the reference `dt` seconds later, at constant speed."""
        return Reference(self.angle + dt * self.speed, self.speed, self.feed_forward)


def torque(
    servo: Servo,
    reference: Reference,
    angle: Float[Array, "2 6"],
    speed: Float[Array, "2 6"],
    integral: Float[Array, "2 6"],
    ahead: float = 0.0,
) -> tuple[Float[Array, "2 6"], Float[Array, "2 6"]]:
    """Joint torques [N m] and the damping [N m s/rad] the integrator owes them.

    The torque levels off smoothly below its limit (`saturated`), and the damping with it. Beyond the speed limit the
    motor cannot push any further: the torque that would speed the joint up fades out over a tenth of the limit.

    Args:
        servo: gains and limits.
        reference: at the start of the tick.
        angle: at the start of the tick [rad].
        speed: at the start of the tick [rad/s].
        integral: of the position errors [rad s].
        ahead: how long after the start of the tick the position error is that the torque goes by [s]: 0 or the tick.
    """
    wanted_speed = jnp.clip(reference.speed, -servo.speed_limit, servo.speed_limit)
    free = (
        servo.kp * (reference.angle + ahead * reference.speed - angle - ahead * speed)
        + servo.kv * (wanted_speed - speed)
        + servo.ki * integral
        + reference.feed_forward
    )
    limited, share = saturated(free, servo.torque_limit)
    left = jnp.clip(11.0 - 10.0 * jnp.abs(speed) / servo.speed_limit, 0.0, 1.0)
    applied = jnp.where(limited * speed > 0.0, left * limited, limited)
    return applied, share * (servo.kv + ahead * servo.kp)


def saturated(
    torque: Float[Array, "*n"], limit: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Torque that a motor gives when it is asked for one [N m], and its derivative by that; nowhere is there a kink.

    x / (1 + x^16)^(1/16) of the limit: at three quarters of it all but 0.06 % of what is asked, at the limit 96 %.
    """
    asked = jnp.clip(torque / limit, -100.0, 100.0)  # far beyond, where powers overflow
    root = (1.0 + asked**16) ** (-1.0 / 16.0)
    return limit * asked * root, root**17

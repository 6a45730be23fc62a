"""Rest on the compliant ground: the start of every walk, without any initial drop."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbiped.kinematics import joint_angles
from jaxbiped.planner import TaskSpace
from jaxbiped.robot.layout import BIPED
from jaxbiped.sim import ground, mjx_adapter
from jaxbiped.sim.plant import Plant, contact_force, motion_at_rest
from jaxbiped.sim.servo import Reference

ITERATIONS = 12
_HELD = np.array([0, 1, 5], np.int32)
"""World x, y and yaw, which are held: regularized friction does not resist them, and nothing pushes along them."""


def standing(
    plant: Plant, task: TaskSpace, reference: Reference
) -> tuple[Float[Array, " nq"], mjx_adapter.BodyMotion]:
    """Configuration in which weight, ground and servos are in balance, near the commanded one, and the body in it.

    Newton's method with the stiffness of ground and servos as the Jacobian; what it leaves out (the weight's own
    geometric stiffness) is a few per cent, so that every iteration gains more than a digit. After the last one it goes
    round once more without a step, for the body: MJX's kinematics, which take long to compile, stand here only.
    """
    robot, scenario = plant.robot, plant.scenario
    angle, _ = joint_angles(robot, task.sole - task.pelvis)
    sunk = task.pelvis.at[2].add(-scenario.ground.sinkage)
    upright = jnp.array([1.0, 0.0, 0.0, 0.0], sunk.dtype)
    start = BIPED.coordinates(sunk, upright, angle)
    stiffness = ground.stiffness(robot, scenario.ground)

    def improve(
        carry: tuple[Float[Array, " nq"], mjx_adapter.BodyMotion], left: Int[Array, ""]
    ) -> tuple[tuple[Float[Array, " nq"], mjx_adapter.BodyMotion], None]:
        qpos = carry[0]
        body = motion_at_rest(plant, qpos)
        touch = ground.contact(robot, scenario.ground, scenario.terrain, body)
        torque = plant.servo.kp * (reference.angle - BIPED.leg_angles(qpos)) + reference.feed_forward
        force = contact_force(body, touch) - body.bias
        force = force.at[BIPED.leg_dofs].add(torque.reshape(-1)).at[_HELD].set(0.0)
        rows = jax.vmap(jax.vmap(_lift, (None, 0, None)), (None, 0, 0))(
            body, touch.p_world_corner, jnp.arange(2)
        )
        pressed = jnp.where(touch.gap < 0.0, stiffness, 0.0)
        matrix = jnp.einsum("fc,fci,fcj->ij", pressed, rows, rows)
        springs = BIPED.joint_space(jnp.full(6, 1.0, sunk.dtype), plant.servo.kp)
        step = mjx_adapter.solve(mjx_adapter.blocks(matrix + jnp.diag(springs.at[_HELD].set(1e9))), force)
        moved = mjx_adapter.integrate(plant.model, qpos, jnp.clip(step, -0.02, 0.02), 1.0)
        return (jnp.where(left > 0, moved, qpos), body), None

    nothing = mjx_adapter.BodyMotion.nothing(sunk.dtype)
    return jax.lax.scan(improve, (start, nothing), jnp.arange(ITERATIONS, -1, -1))[0]


def _lift(body: mjx_adapter.BodyMotion, point: Float[Array, "3"], foot: Array) -> Float[Array, " nv"]:
    """Joint-space force of a unit force upwards at a point of a foot."""
    up = jnp.zeros((2, 3), point.dtype).at[foot, 2].set(1.0)
    moment = jnp.cross(point - body.centre, up)
    return mjx_adapter.generalized_force(body, moment, up)

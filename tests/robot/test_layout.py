"""Where everything is in a model's vectors: the numbers of this biped, and of one with arms between its legs."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped import robot
from jaxbiped.robot import layout
from jaxbiped.robot.layout import BIPED
from jaxbiped.sim import mjx_adapter

LEFT_LINKS, RIGHT_LINKS = ([f"{side}_{link}" for link in robot.LEG_LINK_NAMES] for side in robot.SIDE_NAMES)
LEFT_JOINTS, RIGHT_JOINTS = ([f"{side}_{joint}" for joint in robot.JOINT_NAMES] for side in robot.SIDE_NAMES)
ARMED = layout.of(
    ["trunk", *LEFT_LINKS, "left_arm", *RIGHT_LINKS], [*LEFT_JOINTS, "left_elbow", *RIGHT_JOINTS]
)
"""Not of this package: a robot with an arm in between."""


def test_the_numbers_of_the_biped():
    assert (BIPED.nq, BIPED.nv, len(BIPED.bodies)) == (19, 18, 15)
    assert (BIPED.trunk, BIPED.payload, BIPED.links) == (1, 14, slice(1, 14))
    assert BIPED.feet.tolist() == [7, 13] and BIPED.feet.dtype == np.int32
    assert BIPED.leg_coordinates == slice(7, 19) and BIPED.leg_dofs == slice(6, 18)
    assert (BIPED.side_dofs(robot.LEFT), BIPED.side_dofs(robot.RIGHT)) == (slice(6, 12), slice(12, 18))


@pytest.mark.parametrize("name", robot.presets())
def test_mujoco_counts_alike(name):
    """`base_model` refuses a model that is numbered otherwise; lengths are those of the model's vectors."""
    model = mjx_adapter.base_model(robot.load(name))
    assert (model.nq, model.nv, model.nbody) == (BIPED.nq, BIPED.nv, len(BIPED.bodies))


def test_vectors_of_the_biped_come_apart_and_together():
    qpos, qvel = jnp.arange(19.0), jnp.arange(18.0)
    np.testing.assert_array_equal(BIPED.leg_angles(qpos), np.arange(7.0, 19.0).reshape(2, 6))
    np.testing.assert_array_equal(BIPED.leg_speeds(qvel), np.arange(6.0, 18.0).reshape(2, 6))
    np.testing.assert_array_equal(BIPED.joint_space(qvel[layout.BASE], BIPED.leg_speeds(qvel)), qvel)
    together = BIPED.coordinates(qpos[layout.POSITION], qpos[layout.QUATERNION], BIPED.leg_angles(qpos))
    np.testing.assert_array_equal(together, qpos)
    many = jnp.arange(36.0).reshape(2, 18)
    np.testing.assert_array_equal(BIPED.leg_speeds(many), np.asarray(many)[:, 6:].reshape(2, 2, 6))
    np.testing.assert_array_equal(BIPED.leg_rows(many.T), np.asarray(many).T[6:].reshape(2, 6, 2))


def test_joints_that_are_no_leg_s_are_left_out_and_stay_at_zero():
    assert (ARMED.nq, ARMED.nv, ARMED.payload) == (20, 19, 15) and ARMED.feet.tolist() == [7, 14]
    qpos, qvel = jnp.arange(20.0), jnp.arange(19.0)
    right = np.array([*range(6)])
    np.testing.assert_array_equal(ARMED.leg_angles(qpos), np.stack([7 + right, 14 + right]))
    np.testing.assert_array_equal(ARMED.leg_speeds(qvel), np.stack([6 + right, 13 + right]))
    np.testing.assert_array_equal(ARMED.leg_rows(qvel[:, None])[..., 0], ARMED.leg_speeds(qvel))
    np.testing.assert_array_equal(ARMED.leg_columns(qvel)[..., 0], ARMED.leg_speeds(qvel))
    assert ARMED.side_dofs(robot.LEFT) == slice(6, 12) and ARMED.side_dofs(robot.RIGHT) == slice(13, 19)
    whole = ARMED.joint_space(qvel[layout.BASE], ARMED.leg_speeds(qvel))
    np.testing.assert_array_equal(whole, np.asarray(qvel.at[12].set(0.0)))
    whole = ARMED.coordinates(qpos[layout.POSITION], qpos[layout.QUATERNION], ARMED.leg_angles(qpos))
    np.testing.assert_array_equal(whole, np.asarray(qpos.at[13].set(0.0)))

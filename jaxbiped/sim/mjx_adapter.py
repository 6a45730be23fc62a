"""The one file that touches MJX's internals: from joint state to mass matrix, bias force and body motion.

MuJoCo's own conventions stay in here and in `State`: qpos is (world position, quaternion w x y z, 12 angles), qvel is
(world velocity, angular velocity in trunk axes, 12 speeds), spatial vectors are (angular, linear) about the robot's
centre of mass with world axes.
"""

import contextlib
import io
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that its optional GPU back end is missing
    from mujoco import mjx
    from mujoco.mjx._src import smooth, support
    from mujoco.mjx._src.forward import _integrate_pos

from jaxbiped.robot import RobotParams
from jaxbiped.sim.model import FREE_DOFS, build_spec

NQ, NV = 19, 18
TRUNK = 1
LEFT_FOOT, RIGHT_FOOT = 7, 13
PAYLOAD = 14
"""Body numbers in the model: the world is 0, then the links in the record's order, then the payload's box."""
_FEET = np.array([LEFT_FOOT, RIGHT_FOOT], np.int32)  # int64 trips JAX when float64 and float32 alternate
_MOVES_FOOT = np.zeros((2, NV), bool)
_MOVES_FOOT[:, :FREE_DOFS] = True
_MOVES_FOOT[0, FREE_DOFS : FREE_DOFS + 6] = True
_MOVES_FOOT[1, FREE_DOFS + 6 :] = True


class BodyMotion(eqx.Module):
    """Everything the forces of a tick need to know of the robot's configuration and velocity."""

    p_world_foot: Float[Array, "2 3"]
    """Ankle centres [m]."""
    rot_world_foot: Float[Array, "2 3 3"]
    """Orientation of the feet."""
    p_world_trunk: Float[Array, "3"]
    """Pelvis frame origin [m]."""
    rot_world_trunk: Float[Array, "3 3"]
    """Orientation of the trunk."""
    twist_foot: Float[Array, "2 6"]
    """Angular velocity [rad/s] and velocity [m/s] of the point of each foot at `centre`."""
    centre: Float[Array, "3"]
    """Reference point of all spatial vectors: the robot's centre of mass [m]."""
    dof_axes: Float[Array, "18 6"]
    """Spatial motion per unit of each qvel."""
    mass_matrix: Float[Array, "18 18"]
    """Joint-space inertia, armature included."""
    bias: Float[Array, "18"]
    """Coriolis, centrifugal and gravity forces; `mass_matrix @ qacc + bias` = applied forces."""


def base_model(robot: RobotParams) -> Any:
    """MJX model of the nominal robot with an empty payload body welded to the trunk."""
    spec = build_spec(robot)
    trunk = spec.body("trunk")
    payload = trunk.add_body(name="payload")
    payload.mass, payload.inertia, payload.explicitinertial = 1e-9, [1e-9] * 3, True
    model = spec.compile()
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    order = [int(model.body(name).id) for name in ("trunk", "left_foot", "right_foot", "payload")]
    assert order == [TRUNK, LEFT_FOOT, RIGHT_FOOT, PAYLOAD], order
    return mjx.put_model(model)


def with_masses(
    model: Any,
    mass: Float[Array, "15"],
    com: Float[Array, "15 3"],
    inertia: Float[Array, "15 3"],
) -> Any:
    """The model with other masses [kg], centres of mass [m] and principal inertias [kg m2], numbered as bodies."""
    return model.replace(body_mass=mass, body_ipos=com, body_inertia=inertia)


def masses(model: Any) -> tuple[Float[Array, "15"], Float[Array, "15 3"], Float[Array, "15 3"]]:
    """Mass, centre of mass and principal inertias of every body."""
    return model.body_mass, model.body_ipos, model.body_inertia


def motion(model: Any, qpos: Float[Array, "19"], qvel: Float[Array, "18"]) -> BodyMotion:
    """Kinematics, composite inertia and Newton-Euler bias of MJX at one state."""
    data = mjx.make_data(model).replace(qpos=qpos, qvel=qvel)
    data = smooth.kinematics(model, data)
    data = smooth.com_pos(model, data)
    data = smooth.com_vel(model, data)
    data = smooth.crb(model, data)
    data = smooth.rne(model, data)
    return BodyMotion(
        p_world_foot=data.xpos[_FEET],
        rot_world_foot=data.xmat[_FEET],
        p_world_trunk=data.xpos[TRUNK],
        rot_world_trunk=data.xmat[TRUNK],
        twist_foot=data.cvel[_FEET],
        centre=data.subtree_com[TRUNK],
        dof_axes=data.cdof,
        mass_matrix=data._impl.M,  # pyright: ignore[reportAttributeAccessIssue]
        bias=data.qfrc_bias,
    )


def foot_axes(body: BodyMotion) -> Float[Array, "2 18 6"]:
    """Spatial motion of each foot per unit of each qvel: zero for the other leg's joints."""
    return jnp.where(_MOVES_FOOT[..., None], body.dof_axes, 0.0)


def generalized_force(
    body: BodyMotion, moment: Float[Array, "2 3"], force: Float[Array, "2 3"]
) -> Float[Array, "18"]:
    """Joint-space force of a wrench on each foot; moment about `body.centre` [N m], force [N], world axes."""
    return jnp.einsum("fai,fi->a", foot_axes(body), jnp.concatenate([moment, force], axis=1))


def trunk_force(body: BodyMotion, moment: Float[Array, "3"], force: Float[Array, "3"]) -> Float[Array, "18"]:
    """Joint-space force of a wrench on the trunk; moment about `body.centre` [N m], force [N], world axes."""
    wrench = jnp.concatenate([moment, force])
    return (body.dof_axes @ wrench).at[FREE_DOFS:].set(0.0)


def integrate(
    model: Any, qpos: Float[Array, "19"], qvel: Float[Array, "18"], dt: float
) -> Float[Array, "19"]:
    """Move qpos along qvel for dt [s] (the quaternion by its exponential)."""
    return _integrate_pos(model.jnt_type, qpos, qvel, jnp.asarray(dt, qpos.dtype))


def solve(matrix: Float[Array, "18 18"], force: Float[Array, "18"]) -> Float[Array, "18"]:
    """Solve the symmetric positive definite system `matrix @ x = force`."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), force)


# MuJoCo's own contacts, for `mjx_contacts` ---------------------------------------------------------------------


class NativeStep(eqx.Module):
    """One step of MJX: the state after it, and what it saw at its start."""

    qpos: Float[Array, "19"]
    qvel: Float[Array, "18"]
    body: BodyMotion
    corner_force: Float[Array, "2 4 3"]
    """Force on each sole corner, world axes [N]."""
    torque: Float[Array, "12"]
    """Of the actuators [N m]."""


def contact_model(spec: mujoco.MjSpec, iterations: int) -> Any:
    """MJX model with contacts, without joint limits, of a spec to which an empty payload body is added."""
    payload = spec.body("trunk").add_body(name="payload")
    payload.mass, payload.inertia, payload.explicitinertial = 1e-9, [1e-9] * 3, True
    spec.option.iterations, spec.option.ls_iterations = iterations, 2 * iterations
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    model = spec.compile()
    assert int(model.body("payload").id) == PAYLOAD
    return mjx.put_model(model)


def native_step(
    model: Any,
    corner_geom: np.ndarray,
    qpos: Float[Array, "19"],
    qvel: Float[Array, "18"],
    ctrl: Float[Array, "12"],
    push: Float[Array, "3"],
) -> NativeStep:
    """`mjx.step` with a force on the trunk's centre of mass [N]; corner_geom (2, 4) are the corners' geom numbers."""
    data = mjx.make_data(model)
    data = data.replace(
        qpos=qpos, qvel=qvel, ctrl=ctrl, xfrc_applied=data.xfrc_applied.at[TRUNK, :3].set(push)
    )
    data = mjx.step(model, data)
    contact = data._impl.contact  # pyright: ignore[reportAttributeAccessIssue]
    force, _ = support.contact_force_dim(model, data, 3)
    force = jnp.einsum("cij,ci->cj", contact.frame, force[:, :3])
    first, second = (corner_geom.reshape(-1, 1) == contact.geom[:, side] for side in (0, 1))
    sign = second.astype(force.dtype) - first.astype(force.dtype)
    body = BodyMotion(
        p_world_foot=data.xpos[_FEET],
        rot_world_foot=data.xmat[_FEET],
        p_world_trunk=data.xpos[TRUNK],
        rot_world_trunk=data.xmat[TRUNK],
        twist_foot=data.cvel[_FEET],
        centre=data.subtree_com[TRUNK],
        dof_axes=data.cdof,
        mass_matrix=data._impl.M,  # pyright: ignore[reportAttributeAccessIssue]
        bias=data.qfrc_bias,
    )
    return NativeStep(data.qpos, data.qvel, body, (sign @ force).reshape(2, 4, 3), data.actuator_force)

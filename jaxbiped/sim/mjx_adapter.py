"""The one file that touches MJX's internals: from joint state to mass matrix, bias force and body motion.

MuJoCo's own conventions stay in here and in `State`: qpos is (world position, quaternion w x y z, 12 angles), qvel is
(world velocity, angular velocity in trunk axes, 12 speeds), spatial vectors are (angular, linear) about the robot's
centre of mass with world axes.
"""

import contextlib
import io
from typing import Any

import equinox as eqx
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
    _add_payload(spec)
    model = spec.compile()
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    order = [int(model.body(name).id) for name in ("trunk", "left_foot", "right_foot", "payload")]
    assert order == [TRUNK, LEFT_FOOT, RIGHT_FOOT, PAYLOAD], order
    return mjx.put_model(model)


def _add_payload(spec: mujoco.MjSpec) -> None:
    """Weld an empty body to the trunk, to be given its mass later."""
    trunk = spec.body("trunk")
    assert trunk is not None
    payload = trunk.add_body(name="payload")
    payload.mass, payload.inertia, payload.explicitinertial = 1e-9, [1e-9] * 3, True


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
    return _read(data)


def _read(data: Any) -> BodyMotion:
    """What is read off MJX's data after its smooth dynamics."""
    return BodyMotion(
        p_world_foot=data.xpos[_FEET],
        rot_world_foot=data.xmat[_FEET],
        p_world_trunk=data.xpos[TRUNK],
        rot_world_trunk=data.xmat[TRUNK],
        twist_foot=data.cvel[_FEET],
        centre=data.subtree_com[TRUNK],
        dof_axes=data.cdof,
        mass_matrix=data._impl.M,
        bias=data.qfrc_bias,
    )


def foot_axes(body: BodyMotion) -> Float[Array, "2 12 6"]:
    """Spatial motion of each foot per unit of the trunk's six qvel and of its own leg's six; no other moves it."""
    trunk = jnp.broadcast_to(body.dof_axes[:FREE_DOFS], (2, FREE_DOFS, 6))
    return jnp.concatenate([trunk, body.dof_axes[FREE_DOFS:].reshape(2, 6, 6)], axis=1)


def generalized_force(
    body: BodyMotion, moment: Float[Array, "2 3"], force: Float[Array, "2 3"]
) -> Float[Array, "18"]:
    """Joint-space force of a wrench on each foot; moment about `body.centre` [N m], force [N], world axes."""
    wrench = jnp.concatenate([moment, force], axis=1)
    trunk = jnp.sum(body.dof_axes[:FREE_DOFS] * wrench.sum(axis=0), axis=1)
    legs = jnp.sum(body.dof_axes[FREE_DOFS:].reshape(2, 6, 6) * wrench[:, None], axis=2)
    return jnp.concatenate([trunk, legs.reshape(-1)])


def trunk_force(body: BodyMotion, moment: Float[Array, "3"], force: Float[Array, "3"]) -> Float[Array, "18"]:
    """Joint-space force of a wrench on the trunk; moment about `body.centre` [N m], force [N], world axes."""
    wrench = jnp.concatenate([moment, force])
    return (body.dof_axes @ wrench).at[FREE_DOFS:].set(0.0)


def integrate(
    model: Any, qpos: Float[Array, "19"], qvel: Float[Array, "18"], dt: float
) -> Float[Array, "19"]:
    """Move qpos along qvel for dt [s] (the quaternion by its exponential)."""
    return _integrate_pos(model.jnt_type, qpos, qvel, jnp.asarray(dt, qpos.dtype))


class JointMatrix(eqx.Module):
    """Symmetric joint-space matrix of a robot whose legs are coupled through the trunk alone: its blocks."""

    trunk: Float[Array, "6 6"]
    coupling: Float[Array, "2 6 6"]
    """Rows: a leg's joints; columns: the trunk's degrees of freedom."""
    leg: Float[Array, "2 6 6"]


def blocks(matrix: Float[Array, "18 18"]) -> JointMatrix:
    """The blocks of a full matrix; those between the legs are taken to be zero."""
    left, right = slice(FREE_DOFS, FREE_DOFS + 6), slice(FREE_DOFS + 6, NV)
    return JointMatrix(
        trunk=matrix[:FREE_DOFS, :FREE_DOFS],
        coupling=jnp.stack([matrix[left, :FREE_DOFS], matrix[right, :FREE_DOFS]]),
        leg=jnp.stack([matrix[left, left], matrix[right, right]]),
    )


def solve(matrix: JointMatrix, force: Float[Array, "18"]) -> Float[Array, "18"]:
    """Solve the symmetric positive definite system `matrix @ x = force`.

    Both legs are eliminated at once, then the trunk; written out, since LAPACK calls one small matrix at a time.
    """
    on_leg = force[FREE_DOFS:].reshape(2, 6, 1)
    solved = _eliminate(matrix.leg, jnp.concatenate([matrix.coupling, on_leg], axis=2))
    reduced = jnp.concatenate([matrix.trunk, force[:FREE_DOFS, None]], axis=1)
    for leg in range(2):
        for joint in range(6):
            reduced = reduced - matrix.coupling[leg, joint, :, None] * solved[leg, joint]
    trunk = _eliminate(reduced[:, :FREE_DOFS], reduced[:, FREE_DOFS:])[:, 0]
    legs = solved[..., FREE_DOFS] - jnp.sum(solved[..., :FREE_DOFS] * trunk, axis=-1)
    return jnp.concatenate([trunk, legs.reshape(-1)])


def _eliminate(matrix: Float[Array, "*n 6 6"], right: Float[Array, "*n 6 k"]) -> Float[Array, "*n 6 k"]:
    """`inverse(matrix) @ right` by Gauss-Jordan; a positive definite matrix needs no pivoting."""
    table = jnp.concatenate([matrix, right], axis=-1)
    for i in range(6):
        row = table[..., i, 1:] / table[..., i, :1]
        table = (table[..., 1:] - table[..., :1] * row[..., None, :]).at[..., i, :].set(row)
    return table


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
    _add_payload(spec)
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
    return NativeStep(data.qpos, data.qvel, _read(data), (sign @ force).reshape(2, 4, 3), data.actuator_force)

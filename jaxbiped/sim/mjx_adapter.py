"""The one file that touches MJX's internals: from joint state to mass matrix, bias force and body motion.

MuJoCo's own conventions stay in here, in `State` and in `robot.layout`, which says what is where in qpos and qvel.
Spatial vectors are (angular, linear) about the robot's center of mass with world axes.
"""

import contextlib
import functools
import io
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that its optional GPU back end is missing
    from mujoco import mjx
    from mujoco.mjx._src import smooth, support
    from mujoco.mjx._src.forward import _integrate_pos

from jaxbiped.robot import LEFT, RIGHT, RobotParams, nameless
from jaxbiped.robot.layout import BASE, BIPED, IMAGINARY, POSITION, QUATERNION, REAL
from jaxbiped.sim import spatial
from jaxbiped.sim.model import build_spec
from jaxbiped.sim.spatial import Links

TRUNK, PAYLOAD = BIPED.trunk, BIPED.payload
"""Numbers of bodies in the model."""
Model = mjx.Model
"""MJX's model of a robot."""


class BodyMotion(eqx.Module):
    """Configuration and velocity of the robot, as far as the forces of a tick depend on them."""

    p_world_foot: Float[Array, "2 3"]
    """Ankle centers [m]."""
    rot_world_foot: Float[Array, "2 3 3"]
    """Orientation of the feet."""
    p_world_trunk: Float[Array, "3"]
    """Pelvis frame origin [m]."""
    rot_world_trunk: Float[Array, "3 3"]
    """Orientation of the trunk."""
    twist_foot: Float[Array, "2 6"]
    """Angular velocity [rad/s] and velocity [m/s] of the point of each foot at `centre`."""
    centre: Float[Array, "3"]
    """Reference point of all spatial vectors: the robot's center of mass [m]."""
    dof_axes: Float[Array, "nv 6"]
    """Spatial motion per unit of each qvel."""
    link_inertia: Float[Array, "link 10"]
    """Inertia of the trunk with its load and of the links of both legs about `centre`: xx, yy, zz, xy, xz, yz [kg m2],
    first moment [kg m], mass [kg]."""
    mass_matrix: Float[Array, "nv nv"]
    """Joint-space inertia, armature included."""
    bias: Float[Array, " nv"]
    """Coriolis, centrifugal and gravity forces; `mass_matrix @ qacc + bias` = applied forces."""

    @classmethod
    def nothing(cls, dtype: np.dtype) -> "BodyMotion":
        """Zeros."""
        nv, links = BIPED.nv, BIPED.links.stop - BIPED.links.start
        shapes = {
            "p_world_foot": (2, 3),
            "rot_world_foot": (2, 3, 3),
            "p_world_trunk": (3,),
            "rot_world_trunk": (3, 3),
            "twist_foot": (2, 6),
            "centre": (3,),
            "dof_axes": (nv, 6),
            "link_inertia": (links, 10),
            "mass_matrix": (nv, nv),
            "bias": (nv,),
        }
        return cls(**{name: jnp.zeros(shape, dtype) for name, shape in shapes.items()})


def base_model(robot: RobotParams) -> Model:
    """MJX model of the nominal robot with an empty payload body welded to the trunk."""
    spec = build_spec(nameless(robot))
    _add_payload(spec)
    model = spec.compile()
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    _require_layout(model)
    model.geom_rbound[:] = (
        0.0  # of no use without contacts, and MJX compiles anew where its copy of them differs
    )
    return _unbound(mjx.put_model(model))


def _unbound(model: Model) -> Model:
    """The same model, bound to no device: what is computed with a bound one is bound, and JAX compiles anew for it."""
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), model)


def _require_layout(model: mujoco.MjModel) -> None:
    """Require that bodies and hinges are numbered as in `BIPED`."""
    bodies = tuple(model.body(i).name for i in range(model.nbody))
    hinges = tuple(model.joint(i).name for i in range(1, model.njnt))
    assert (bodies, hinges) == (BIPED.bodies, BIPED.hinges), (bodies, hinges)


def _add_payload(spec: mujoco.MjSpec) -> None:
    """Weld an empty body to the trunk, to be given its mass later."""
    trunk = spec.body("trunk")
    assert trunk is not None
    payload = trunk.add_body(name="payload")
    payload.mass, payload.inertia, payload.explicitinertial = 1e-9, [1e-9] * 3, True


def with_masses(
    model: Model,
    mass: Float[Array, " body"],
    com: Float[Array, "body 3"],
    inertia: Float[Array, "body 3"],
) -> Model:
    """The model with other masses [kg], centers of mass [m] and principal inertias [kg m2], numbered as bodies."""
    return model.replace(body_mass=mass, body_ipos=com, body_inertia=inertia)


def masses(model: Model) -> tuple[Float[Array, " body"], Float[Array, "body 3"], Float[Array, "body 3"]]:
    """Mass, center of mass and principal inertias of every body."""
    return model.body_mass, model.body_ipos, model.body_inertia


def motion(model: Model, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> BodyMotion:
    """Kinematics, composite inertia and Newton-Euler bias of MJX at one state.

    Differentiated by how the links move with the joints (`spatial`), not through MJX; by the masses through MJX.
    """
    return _motion(model, qpos, qvel)


def _through_mjx(model: Model, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> BodyMotion:
    data = mjx.make_data(model).replace(qpos=qpos, qvel=qvel)
    data = smooth.kinematics(model, data)
    data = smooth.com_pos(model, data)
    data = smooth.com_vel(model, data)
    data = smooth.crb(model, data)
    data = smooth.rne(model, data)
    return _read(data)


def _read(data: mjx.Data) -> BodyMotion:
    """Read the motion of the body off MJX's data after its smooth dynamics."""
    return BodyMotion(
        p_world_foot=data.xpos[BIPED.feet],
        rot_world_foot=data.xmat[BIPED.feet],
        p_world_trunk=data.xpos[TRUNK],
        rot_world_trunk=data.xmat[TRUNK],
        twist_foot=data.cvel[BIPED.feet],
        centre=data.subtree_com[TRUNK],
        dof_axes=data.cdof,
        link_inertia=data._impl.cinert[BIPED.links].at[0].add(data._impl.cinert[PAYLOAD]),  # pyright: ignore[reportAttributeAccessIssue]
        mass_matrix=data._impl.M,  # pyright: ignore[reportAttributeAccessIssue]
        bias=data.qfrc_bias,
    )


_motion = jax.custom_jvp(_through_mjx)


@functools.partial(_motion.defjvp, symbolic_zeros=True)
def _motion_jvp(
    primals: tuple[Model, Float[Array, " nq"], Float[Array, " nv"]],
    tangents: tuple[PyTree, PyTree, PyTree],
) -> tuple[BodyMotion, BodyMotion]:
    model, qpos, qvel = primals
    body = _motion(model, qpos, qvel)
    d_qpos, d_qvel = (_instantiate(t, p) for t, p in zip(tangents[1:], primals[1:], strict=True))
    d_body = _moved(model, body, qvel, _as_velocity(qpos, d_qpos), d_qvel)
    known = jax.tree.leaves(tangents[0], is_leaf=_is_zero)
    if all(_is_zero(tangent) for tangent in known):
        return body, d_body
    d_model = jax.tree.map(_instantiate, tangents[0], model, is_leaf=_is_zero)
    _, by_model = jax.jvp(lambda m: _through_mjx(m, qpos, qvel), (model,), (d_model,))
    return body, jax.tree.map(jnp.add, d_body, by_model)


def _is_zero(tangent: object) -> bool:
    """Tell whether JAX knows that a tangent is zero."""
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def _instantiate(tangent: jax.custom_derivatives.SymbolicZero | ArrayLike, primal: ArrayLike) -> Any:  # noqa: ANN401
    """Return the tangent itself, or zeros in place of a symbolic zero."""
    if not _is_zero(tangent):
        return tangent
    if jnp.issubdtype(jnp.result_type(primal), jnp.floating):
        return jnp.zeros_like(primal)
    return np.zeros(jnp.shape(primal), jax.dtypes.float0)


def _as_velocity(qpos: Float[Array, " nq"], d_qpos: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """A small change of qpos in the coordinates of qvel."""
    w, v, d_w, d_v = qpos[REAL], qpos[IMAGINARY], d_qpos[REAL], d_qpos[IMAGINARY]
    turned = 2.0 * (w * d_v - d_w * v - spatial.cross(v, d_v)) / (w * w + jnp.sum(v * v))
    return jnp.concatenate([d_qpos[POSITION], turned, d_qpos[QUATERNION.stop :]])


def _moved(
    model: Model,
    body: BodyMotion,
    qvel: Float[Array, " nv"],
    shift: Float[Array, " nv"],
    d_qvel: Float[Array, " nv"],
) -> BodyMotion:
    """Change of the motion with a small shift of the coordinates (as a qvel) and with a change of qvel."""
    links = Links(body.dof_axes, body.link_inertia)
    moved = spatial.velocities(links.axes, shift)
    d_centre = spatial.centre_shift(links, moved)
    d_links = spatial.carried_along(links, moved, d_centre)
    feet = moved.leg[:, -1]

    def twist(axes: Float[Array, "nv 6"], speed: Float[Array, " nv"]) -> Float[Array, "2 6"]:
        return spatial.velocities(axes, speed).leg[:, -1]

    def bias(moving: Links, speed: Float[Array, " nv"]) -> Float[Array, " nv"]:
        return spatial.inverse_dynamics(moving, speed, jnp.zeros_like(speed), model.opt.gravity)

    def column(moving: Links, unit: Float[Array, " nv"]) -> Float[Array, " nv"]:
        return spatial.inverse_dynamics(moving, jnp.zeros_like(unit), unit, jnp.zeros_like(model.opt.gravity))

    units = jnp.eye(BIPED.nv, dtype=qvel.dtype)
    return BodyMotion(
        p_world_foot=spatial.point_shift(feet, body.p_world_foot - body.centre),
        rot_world_foot=spatial.turned(feet[:, :3], body.rot_world_foot),
        p_world_trunk=spatial.point_shift(moved.trunk, body.p_world_trunk - body.centre),
        rot_world_trunk=spatial.turned(moved.trunk[:3], body.rot_world_trunk),
        twist_foot=jax.jvp(twist, (links.axes, qvel), (d_links.axes, d_qvel))[1],
        centre=d_centre,
        dof_axes=d_links.axes,
        link_inertia=d_links.inertia,
        mass_matrix=jax.vmap(lambda unit: jax.jvp(lambda m: column(m, unit), (links,), (d_links,))[1])(units),
        bias=jax.jvp(bias, (links, qvel), (d_links, d_qvel))[1],
    )


def foot_axes(body: BodyMotion) -> Float[Array, "2 12 6"]:
    """Spatial motion of each foot per unit of the trunk's six qvel and of its own leg's six; no other moves it."""
    trunk = jnp.broadcast_to(body.dof_axes[BASE], (2, 6, 6))
    return jnp.concatenate([trunk, BIPED.leg_rows(body.dof_axes)], axis=1)


def foot_twist(body: BodyMotion, qvel: Float[Array, " nv"]) -> Float[Array, "2 6"]:
    """Twist of each foot about `body.centre` for any qvel."""
    return spatial.velocities(body.dof_axes, qvel).leg[:, -1]


def inverse_dynamics(
    body: BodyMotion, qvel: Float[Array, " nv"], qacc: Float[Array, " nv"], gravity: Float[Array, "3"]
) -> Float[Array, " nv"]:
    """Joint-space force that a motion needs, by Newton and Euler: `mass_matrix @ qacc + bias` without the rotors."""
    return spatial.inverse_dynamics(Links(body.dof_axes, body.link_inertia), qvel, qacc, gravity)


def generalized_force(
    body: BodyMotion, moment: Float[Array, "2 3"], force: Float[Array, "2 3"]
) -> Float[Array, " nv"]:
    """Joint-space force of a wrench on each foot; moment about `body.centre` [N m], force [N], world axes."""
    wrench = jnp.concatenate([moment, force], axis=1)
    trunk = jnp.sum(body.dof_axes[BASE] * wrench.sum(axis=0), axis=1)
    legs = jnp.sum(BIPED.leg_rows(body.dof_axes) * wrench[:, None], axis=2)
    return BIPED.joint_space(trunk, legs)


def trunk_force(body: BodyMotion, moment: Float[Array, "3"], force: Float[Array, "3"]) -> Float[Array, " nv"]:
    """Joint-space force of a wrench on the trunk; moment about `body.centre` [N m], force [N], world axes."""
    wrench = jnp.concatenate([moment, force])
    return (body.dof_axes @ wrench).at[BIPED.leg_dofs].set(0.0)


def integrate(
    model: Model, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], dt: float
) -> Float[Array, " nq"]:
    """Move qpos along qvel for dt [s] (the quaternion by its exponential)."""
    return _integrate_pos(model.jnt_type, qpos, qvel, jnp.asarray(dt, qpos.dtype))


class JointMatrix(eqx.Module):
    """Symmetric joint-space matrix of a robot whose legs are coupled through the trunk alone: its blocks."""

    trunk: Float[Array, "6 6"]
    coupling: Float[Array, "2 6 6"]
    """Coupling of legs and trunk: a row for each joint of a leg, a column for each degree of freedom of the trunk."""
    leg: Float[Array, "2 6 6"]


def blocks(matrix: Float[Array, "nv nv"]) -> JointMatrix:
    """The blocks of a full matrix; those between the legs are taken to be zero."""
    left, right = BIPED.side_dofs(LEFT), BIPED.side_dofs(RIGHT)
    return JointMatrix(
        trunk=matrix[BASE, BASE],
        coupling=jnp.stack([matrix[left, BASE], matrix[right, BASE]]),
        leg=jnp.stack([matrix[left, left], matrix[right, right]]),
    )


def solve(matrix: JointMatrix, force: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Solve the symmetric positive definite system `matrix @ x = force`.

    Both legs are eliminated at once, then the trunk; written out, since LAPACK calls one small matrix at a time.
    """
    on_leg = BIPED.leg_columns(force)
    solved = _eliminate(matrix.leg, jnp.concatenate([matrix.coupling, on_leg], axis=2))
    reduced = jnp.concatenate([matrix.trunk, force[BASE, None]], axis=1)
    for leg in range(2):
        for joint in range(6):
            reduced = reduced - matrix.coupling[leg, joint, :, None] * solved[leg, joint]
    trunk = _eliminate(reduced[:, :6], reduced[:, 6:])[:, 0]
    legs = solved[..., 6] - jnp.sum(solved[..., :6] * trunk, axis=-1)
    return BIPED.joint_space(trunk, legs)


class Inverse(eqx.Module):
    """A matrix with its pivots inverted, to be applied to many right-hand sides."""

    trunk: Float[Array, "6 6"]
    """Inverse of what is left of the trunk's block when both legs are eliminated."""
    ratio: Float[Array, "2 6 6"]
    """`inverse(leg) @ coupling`."""
    leg: Float[Array, "2 6 6"]
    """Inverse of the legs' blocks."""

    def times(self, force: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """Solve for one right-hand side."""
        on_leg = BIPED.leg_rows(force)
        left = force[BASE] - jnp.sum(self.ratio * on_leg[..., None], axis=(0, 1))
        trunk = jnp.sum(self.trunk * left, axis=1)
        legs = jnp.sum(self.leg * on_leg[:, None], axis=2) - jnp.sum(self.ratio * trunk, axis=2)
        return BIPED.joint_space(trunk, legs)


def inverse(matrix: JointMatrix) -> Inverse:
    """Eliminate once, for many right-hand sides."""
    unit = jnp.broadcast_to(jnp.eye(6, dtype=matrix.leg.dtype), (2, 6, 6))
    solved = _eliminate(matrix.leg, jnp.concatenate([matrix.coupling, unit], axis=2))
    ratio, leg = solved[..., :6], solved[..., 6:]
    left = matrix.trunk - jnp.einsum("lji,ljk->ik", matrix.coupling, ratio)
    return Inverse(_eliminate(left, unit[0]), ratio, leg)


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

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    body: BodyMotion
    corner_force: Float[Array, "2 4 3"]
    """Force on each sole corner, world axes [N]."""
    torque: Float[Array, "12"]
    """Torques of the actuators [N m]."""


def contact_model(spec: mujoco.MjSpec, iterations: int) -> Model:
    """MJX model with contacts, without joint limits, of a spec to which an empty payload body is added."""
    _add_payload(spec)
    spec.option.iterations, spec.option.ls_iterations = iterations, 2 * iterations
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    model = spec.compile()
    _require_layout(model)
    return _unbound(mjx.put_model(model))


def native_step(
    model: Model,
    corner_geom: np.ndarray,
    qpos: Float[Array, " nq"],
    qvel: Float[Array, " nv"],
    ctrl: Float[Array, "12"],
    push: Float[Array, "3"],
) -> NativeStep:
    """`mjx.step` with a force on the trunk's center of mass [N]; corner_geom (2, 4) are the corners' geom numbers."""
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

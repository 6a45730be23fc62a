"""What the dynamics are compared with: the robot in C MuJoCo without contacts, limits and servos; and random states."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxbiped import robot
from jaxbiped.sim import build_model, build_spec, mjx_adapter, plant
from jaxbiped.sim.scenario import Scenario

PRESETS = ["surena3", "elkahlout"]
NV = 18
IGNORED = (
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    | mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_LIMIT
)


def load(name: str) -> robot.RobotParams:
    """A robot on the device, under a name that all share: the name is static, so they share compiled kernels too."""
    return robot.on_device(dataclasses.replace(robot.load(name), name="any", walks_like=""))


def load64(name: str) -> robot.RobotParams:
    """The same in float64."""
    with jax.enable_x64(True):
        return load(name)


def oracle(params: robot.RobotParams, actuated: bool = False, timestep: float = 5e-4) -> mujoco.MjModel:
    """The robot in C MuJoCo, touching nothing, joints without ends; with its position servos if asked for."""
    model = build_model(params, timestep)
    actuators = 0 if actuated else mujoco.mjtDisableBit.mjDSBL_ACTUATION
    model.opt.disableflags |= int(IGNORED | actuators)
    return model


def with_cube(params: robot.RobotParams, mass: float, place: Any, size: float) -> mujoco.MjModel:
    """The robot in C MuJoCo with a uniform cube welded to its trunk."""
    spec: Any = build_spec(params)
    cube = spec.body("trunk").add_body(name="cube", pos=np.asarray(place, float))
    cube.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[size / 2] * 3, mass=mass, contype=0, conaffinity=0)
    model = spec.compile()
    model.opt.disableflags |= int(IGNORED | mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    return model


def random_states(params: robot.RobotParams, n: int, seed: int = 0, speed: float = 2.0):
    """Configurations (n, 19) anywhere and any way up, joints within their ranges, and velocities (n, 18)."""
    rng = np.random.default_rng(seed)
    lower, upper = np.moveaxis(np.asarray(params.joint_range, float).reshape(12, 2), -1, 0)
    turn = rng.normal(size=(n, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    qpos = np.concatenate([rng.normal(size=(n, 3)), turn, rng.uniform(lower, upper, (n, 12))], axis=1)
    return qpos, rng.normal(scale=speed, size=(n, NV))


def forward(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, applied: Any = 0.0) -> mujoco.MjData:
    """mj_forward at one state."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, applied
    mujoco.mj_forward(model, data)
    return data


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    full = np.zeros((NV, NV))
    mujoco.mj_fullM(model, data, full)
    return full


def applied_force(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    body: int,
    point: Any,
    force: Any,
    moment: Any = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """Joint-space force (18,) of a force at a point of a body, and a moment, by mj_applyFT."""
    out = np.zeros(NV)
    f, m, p = (np.asarray(a, float) for a in (force, moment, point))
    mujoco.mj_applyFT(model, data, f, m, p, body, out)
    return out


motions = jax.jit(jax.vmap(mjx_adapter.motion, in_axes=(None, 0, 0)))
motion_at = eqx.filter_jit(plant.body_motion)


def flat() -> Scenario:
    """Flat ground in JAX's present precision."""
    return Scenario.flat()


def as_arrays(*values: Any) -> Any:
    """In JAX's present precision."""
    return [jnp.asarray(v, jnp.result_type(float)) for v in values]

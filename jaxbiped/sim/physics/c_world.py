"""One robot on its ground in C MuJoCo: level boxes, three models of the contact with them, and the load.

Models of the contact (`CONTACTS`), all with a constant impedance, so that a contact is a linear spring and damper,
critically damped by itself:

    spheres   a small sphere at every sole corner; the nominal robot sinks in on both feet by the scenario's sinkage
    box       one box for every sole, as stiff; MuJoCo decides where it touches, on edges too
    stiff     spheres with half the time constant, so four times as stiff: nothing else differs from `spheres`
"""

import equinox as eqx
import jax
import mujoco
import numpy as np

from jaxbiped.checked import Word
from jaxbiped.kinematics import GRAVITY
from jaxbiped.robot import LEFT, SIDE_NAMES, RobotParams
from jaxbiped.robot.layout import BIPED
from jaxbiped.sim import plant
from jaxbiped.sim.mjx_adapter import TRUNK
from jaxbiped.sim.model import CORNER_NAMES, build_spec
from jaxbiped.sim.scenario import Payload, Scenario, Terrain

SPHERES, BOX, STIFF = "spheres", "box", "stiff"
CONTACTS = (SPHERES, BOX, STIFF)
"""Models of the contact between soles and ground."""
CONTACT = Word(CONTACTS)
IMPEDANCE = 0.9
"""MuJoCo's contact impedance, the same at all depths, so that a contact is a linear spring and damper."""
OUTER = 50.0
"""Reach of raised ground where nothing bounds it [m]."""
THICKNESS = 0.1
"""Depth of the boxes below the lowest ground [m]."""
CORNERS = tuple(f"{side}_{corner}" for side in SIDE_NAMES for corner in CORNER_NAMES)
"""Names of sites, spheres and contact sensors at the sole corners."""
STIFF_SHARE = 0.5
"""Time constant of `stiff` contacts over that of `spheres`."""
SHORTEST = 2.0
"""Shortest time constant of a contact, in ticks: MuJoCo lengthens shorter ones without a word (`refsafe`)."""
MOST_CONTACTS = 32
"""Contacts of one box sole there is room for: four with the floor, eight with each box."""
Box = tuple[tuple[float, float], tuple[float, float], float]
"""Smallest and largest (x, y) of a level box, and the height of its top [m]."""

_FORCE = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
_EACH = sum(
    1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name}"))
    for name in ("FOUND", "FORCE", "POS", "NORMAL", "TANGENT")
)
_NET, _ALL = 3, 0
"""Ways in which a contact sensor puts contacts together."""


# The ground ------------------------------------------------------------------------------------------------------


def heights(terrain: Terrain, xy: np.ndarray) -> np.ndarray:
    """Height of the ground with sharp edges [m].

    Args:
        terrain: of one scenario, or of a batch (*n, ...).
        xy: points (*m, 2), or (*n, m, 2) for a batch [m].
    """
    lower, upper, height = (np.asarray(a, float) for a in (terrain.lower, terrain.upper, terrain.height))
    point = xy[..., None, :]
    inside = (point >= lower[..., None, :, :]) & (point < upper[..., None, :, :])
    return np.sum(height[..., None, :] * inside.all(-1), axis=-1)


def level_boxes(terrain: Terrain) -> tuple[float, list[Box]]:
    """Height of the lowest ground and the boxes that rise from it; all edges cut the plane into cells.

    For every height there are boxes over all ground at least so high, so that where ground is merely raised there is
    one box for every rectangle; boxes of one height share edges only around holes, where a corner may touch two.
    """
    lower, upper, height = (np.asarray(a, float) for a in (terrain.lower, terrain.upper, terrain.height))
    used = (lower < upper).all(axis=1) & (height != 0.0)
    if not used.any():
        return 0.0, []
    x, y = (np.unique(np.concatenate([[-OUTER, OUTER], lower[used, i], upper[used, i]])) for i in range(2))
    middle = np.stack(np.meshgrid(*((edge[1:] + edge[:-1]) / 2.0 for edge in (x, y)), indexing="ij"), -1)
    cells = np.round(heights(terrain, middle), 9)
    boxes = []
    for level in np.unique(cells)[1:]:
        for i, j, k, m in _rectangles(cells >= level):
            boxes.append(((float(x[i]), float(y[k])), (float(x[j]), float(y[m])), float(level)))
    return float(cells.min()), boxes


def _rectangles(mask: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Cover a mask with rectangles of cells [i, j) x [k, m) that do not overlap."""
    left, found = mask.copy(), []
    for i, k in np.argwhere(mask):
        if not left[i, k]:
            continue
        m = k + 1
        while m < left.shape[1] and left[i, m]:
            m += 1
        j = i + 1
        while j < left.shape[0] and left[j, k:m].all():
            j += 1
        left[i:j, k:m] = False
        found.append((int(i), int(j), int(k), int(m)))
    return found


def contact_time_constant(
    robot: RobotParams, sinkage: float, timestep: float, contact: str = SPHERES
) -> float:
    """MuJoCo's `solref` time constant [s] with which the nominal robot on both feet sinks in by `sinkage` [m].

    At constant impedance d a contact at rest has force / depth = 1 / ((1 - d) timeconst^2 invweight), `invweight`
    [1/kg] being that of the foot; and that is to be the weight on each of eight corners over the sinkage.
    """
    robot = jax.tree.map(np.asarray, robot)
    invweight = float(build_spec(robot).compile().body_invweight0[BIPED.feet[LEFT], 0])
    wanted = float(robot.total_mass) * GRAVITY / (8.0 * sinkage)
    constant = float(np.sqrt(1.0 / ((1.0 - IMPEDANCE) * wanted * invweight)))
    return max(constant * (STIFF_SHARE if contact == STIFF else 1.0), SHORTEST * timestep)


def resting_depth(robot: RobotParams, sinkage: float, timestep: float, contact: str) -> float:
    """Depth to which the nominal robot sinks in on both feet [m]; it goes with the square of the time constant."""
    exact = contact_time_constant(robot, sinkage, 0.0)
    return sinkage * (contact_time_constant(robot, sinkage, timestep, contact) / exact) ** 2


def build_world(
    robot: RobotParams, scenario: Scenario, timestep: float, contact: str = SPHERES
) -> mujoco.MjModel:
    """The robot with its model errors on the scenario's ground, with sensors for what touches the soles.

    Raises:
        ValueError: for a model of the contact that there is not.
    """
    contact = CONTACT.check("contact", contact)
    robot = jax.tree.map(np.asarray, robot)  # of which MuJoCo asks every number, one by one
    base, boxes = level_boxes(scenario.terrain)
    spec = build_spec(_with_errors(robot, scenario), timestep)
    floor = spec.geom("floor")
    assert floor is not None
    floor.pos = [0.0, 0.0, base]
    for i, (lower, upper, top) in enumerate(boxes):
        low, high = np.array([*lower, base - THICKNESS]), np.array([*upper, top])
        box = spec.worldbody.add_geom(
            name=f"box_{i}", type=mujoco.mjtGeom.mjGEOM_BOX, contype=1, conaffinity=2
        )
        box.pos, box.size = (low + high) / 2.0, (high - low) / 2.0
    if contact == BOX:
        _stand_on_boxes(spec, robot)
    else:
        for name in CORNERS:
            _feel(spec, name, [_FORCE, _NET, 1])
    model = spec.compile()
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    constant = contact_time_constant(robot, float(scenario.ground.sinkage), timestep, contact)
    model.geom_solref[:] = constant, 1.0
    model.geom_solimp[:] = IMPEDANCE, IMPEDANCE, 1e-3, 0.5, 2.0
    model.geom_friction[:, 0] = float(scenario.ground.friction)
    return model


def _stand_on_boxes(spec: mujoco.MjSpec, robot: RobotParams) -> None:
    """Put a box under each foot in place of the spheres, as high as half the ankle."""
    for name in CORNERS:
        sphere = spec.geom(name)
        assert sphere is not None
        sphere.contype = sphere.conaffinity = 0
    for side, side_name in enumerate(SIDE_NAMES):
        low, high = (f(np.asarray(robot.p_sole_corner[side], float), axis=0) for f in (np.min, np.max))
        foot = spec.site(f"{side_name}_sole")
        assert foot is not None
        half = (high - low) / 2.0
        half[2] = 0.25 * float(robot.ankle_height)
        box = foot.parent.add_geom(
            name=f"{side_name}_box", type=mujoco.mjtGeom.mjGEOM_BOX, contype=2, conaffinity=1, mass=0.0
        )
        box.size, box.pos = half, foot.pos + (low + high) / 2.0 + [0.0, 0.0, half[2]]
        _feel(spec, f"{side_name}_box", [_EACH, _ALL, MOST_CONTACTS])


def _feel(spec: mujoco.MjSpec, geom: str, what: list[int]) -> None:
    """Add a contact sensor."""
    spec.add_sensor(
        name=geom,
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_GEOM,
        objname=geom,
        intprm=what,
    )


def corner_forces(
    robot: RobotParams, contact: str, readings: np.ndarray, sole: np.ndarray, turn: np.ndarray
) -> np.ndarray:
    """Ground force on every sole corner (*n, 8, 3), world axes [N].

    The force of each contact of a box goes to the four corners by the bilinear weights of its place in the sole, so
    that their sum, and for vertical forces their center, are those of the contacts.

    Args:
        robot: nominal.
        contact: model of the contact.
        readings: of the sensors of `build_world` (*n, m).
        sole: origins of the sole frames (*n, 2, 3) [m].
        turn: their rotations (*n, 2, 3, 3).

    Raises:
        RuntimeError: if a box has more contacts than there is room for.
    """
    if contact != BOX:
        return -readings.reshape(*readings.shape[:-1], 8, 3)
    rows = readings.reshape(*readings.shape[:-1], 2, MOST_CONTACTS, 13)
    most = int(rows[..., 0].max(initial=0.0))
    if most > MOST_CONTACTS:
        raise RuntimeError(f"contacts of a sole: got {most}, room for {MOST_CONTACTS}")
    rows = rows[..., :most, :]
    normal, along = rows[..., 7:10], rows[..., 10:13]
    axes = np.stack([normal, along, np.cross(normal, along)], axis=-2)
    force = -np.einsum(
        "...i,...ij->...j", rows[..., 1:4], axes
    )  # the sensor says what the sole does to the ground
    place = np.einsum("...fki,...fij->...fkj", rows[..., 4:7] - sole[..., None, :], turn)[..., :2]
    corner = np.asarray(robot.p_sole_corner, float)[..., :2]
    low, high = corner.min(axis=1)[:, None], corner.max(axis=1)[:, None]
    share = (place - low) / (high - low)
    ahead = (corner > 0.5 * (low + high))[:, None]
    weight = np.where(ahead, share[..., None, :], 1.0 - share[..., None, :]).prod(-1)
    found = np.einsum("...fkc,...fki->...fci", weight, force)
    return found.reshape(*found.shape[:-3], 8, 3)


def _with_errors(robot: RobotParams, scenario: Scenario) -> RobotParams:
    errors, links, servo = scenario.errors, robot.links, robot.servo
    scale, gain = np.asarray(errors.mass_scale), np.asarray(errors.gain_scale)
    centre = np.array(links.com)
    centre[0] += errors.trunk_com_offset
    return eqx.tree_at(
        lambda r: (r.links.mass, r.links.inertia, r.links.com, r.servo.kp, r.servo.kv, r.servo.ki),
        robot,
        (
            np.asarray(links.mass) * scale,
            np.asarray(links.inertia) * scale[:, None, None],
            centre,
            np.asarray(servo.kp) * gain,
            np.asarray(servo.kv) * gain,
            np.asarray(servo.ki) * gain,
        ),
    )


# The load --------------------------------------------------------------------------------------------------------


def attach(model: mujoco.MjModel, payload: Payload, payload_model: str) -> None:
    """Give the trunk the mass, center of mass and inertia of trunk and load in one; contacts stay as they are.

    `exact`: a uniform cube, by the parallel-axis theorem. `thesis`: elkahlout Eqs. 3.8-3.10, where the inertia only
    grows in proportion to the mass.
    """
    mass, load = float(model.body_mass[TRUNK]), float(payload.mass)
    com, place = model.body_ipos[TRUNK].copy(), np.asarray(payload.place, float)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[TRUNK])
    turn = turn.reshape(3, 3)
    inertia = turn @ np.diag(model.body_inertia[TRUNK]) @ turn.T
    total = mass + load
    centre = (mass * com + load * place) / total
    if payload_model == plant.EXACT:
        inertia = inertia + np.eye(3) * load * float(payload.size) ** 2 / 6.0
        inertia = inertia + mass * _offset(com - centre) + load * _offset(place - centre)
    else:
        inertia = inertia * total / mass
    principal, axes = np.linalg.eigh(inertia)
    axes = axes * np.sign(np.linalg.det(axes))
    mujoco.mju_mat2Quat(model.body_iquat[TRUNK], axes.reshape(9))
    model.body_mass[TRUNK], model.body_inertia[TRUNK], model.body_ipos[TRUNK] = total, principal, centre
    model.body_subtreemass[: TRUNK + 1] += load
    model.body_sameframe[TRUNK] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


_WITH_THE_LOAD = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_subtreemass",
    "body_sameframe",
)
"""Fields of the model that `attach` changes."""


def without_load(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return the fields that `detach` needs to take a load off again; call it before `attach`."""
    return {name: getattr(model, name).copy() for name in _WITH_THE_LOAD}


def detach(model: mujoco.MjModel, unloaded: dict[str, np.ndarray]) -> None:
    """Take the load off the trunk."""
    for name, value in unloaded.items():
        getattr(model, name)[:] = value


def _offset(arm: np.ndarray) -> np.ndarray:
    """Inertia of a unit of mass at `arm` [m2]."""
    return np.eye(3) * (arm @ arm) - np.outer(arm, arm)

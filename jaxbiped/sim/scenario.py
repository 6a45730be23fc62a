"""A scenario: everything about one walk that the robot does not know. A batch of them has a leading axis."""

from collections.abc import Mapping
from typing import Any, SupportsIndex

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbiped import checked, runtime
from jaxbiped.checked import Quantity, Refusal
from jaxbiped.planner import Gait, Plan, at, is_concrete
from jaxbiped.robot import LINK_NAMES, SIDE_NAMES, RobotParams

Scalar = Float[Array, "*batch"]

PAD_BEHIND, PAD_AROUND = 0.115, 0.02
"""Margins of a pad under a foothold: behind the heel, and beyond the other edges of the sole [m]."""

EDGE_WIDTH = 0.004
"""Width over which a rectangle's edge rises, so that forces are differentiable in its place [m]."""
MAX_RECTANGLES = 1000
ROOM = 4
"""Terrains that walk by the same compiled program have room for a multiple of so many rectangles."""
NEVER = 1e6
"""A time after every walk [s]."""
_PLACE = Quantity("m", -1000.0, 1000.0, shapes=((2,),))
_TIME = Quantity("s", 0.0, NEVER)
_FORCE = Quantity("N", -5000.0, 5000.0)
RANGES: dict[str, Quantity] = {
    "load_kg": Quantity("kg", 0.0, 200.0),
    "load_time_s": _TIME,
    "load_end_s": _TIME,
    "load_x_m": Quantity("m", -1.0, 1.0),
    "load_y_m": Quantity("m", -1.0, 1.0),
    "load_z_m": Quantity("m", -1.0, 2.0),
    "load_size_m": Quantity("m", 0.01, 1.0),
    "friction": Quantity("", 0.01, 5.0),
    "sinkage_m": Quantity("m", 5e-5, 5e-3),
    "damping_s_per_m": Quantity("s/m", 0.0, 1000.0),
    "slip_speed_m_per_s": Quantity("m/s", 1e-5, 0.1),
    "trunk_mass_scale": Quantity("", 0.5, 2.0),
    "leg_mass_scale": Quantity("", 0.5, 2.0),
    "com_x_m": Quantity("m", -0.1, 0.1),
    "com_y_m": Quantity("m", -0.1, 0.1),
    "com_z_m": Quantity("m", -0.3, 0.3),
    "gain_scale": Quantity("", 0.1, 5.0),
    "delta_z_m": Quantity("m", 0.0, 0.05),
    "bounce_s": Quantity("s", 0.0, 0.1),
    "delay_s": Quantity("s", 0.0, 0.05),
    "force_noise_N": Quantity("N", 0.0, 200.0),
    "angle_noise_rad": Quantity("rad", 0.0, 0.1),
    "push_x_N": _FORCE,
    "push_y_N": _FORCE,
    "push_z_N": _FORCE,
    "push_time_s": _TIME,
    "push_length_s": Quantity("s", 0.0, 10.0),
    "height_m": Quantity("m", -0.2, 0.2),
}
"""Allowed numbers of a scenario, by the names of the columns of a scenario table."""


def _array(value: object) -> Float[Array, "..."]:
    return jnp.asarray(value, jnp.result_type(float))


class Terrain(eqx.Module):
    """Up to K level rectangles, raised or sunk, on ground of height 0. Heights of overlapping ones add up."""

    lower: Float[Array, "*batch K 2"] = eqx.field(converter=_array)
    """Smallest x and y of each rectangle [m]."""
    upper: Float[Array, "*batch K 2"] = eqx.field(converter=_array)
    """Largest x and y of each rectangle [m]."""
    height: Float[Array, "*batch K"] = eqx.field(converter=_array)
    """Height of each rectangle over the ground, negative for holes [m]."""


class Payload(eqx.Module):
    """A load on the trunk from `time` to `end`, put on and taken off suddenly, at rest relative to the trunk.

    A load at time 0 is carried from the start: the robot settles with it, it is own weight, and nothing happens until
    it is taken off.
    """

    mass: Scalar = eqx.field(converter=_array)
    """Mass of the load [kg]; 0 for none."""
    time: Scalar = eqx.field(converter=_array)
    """Time at which the load is attached, since the start of the walk [s]; 0 for one that is carried from the start."""
    place: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Center of the load in the pelvis frame [m]."""
    size: Scalar = eqx.field(converter=_array)
    """Edge of the cube [m]."""
    end: Scalar = eqx.field(converter=_array, default=NEVER)
    """Time at which the load is taken off [s]; NEVER for one that stays."""

    def share(self, time: Scalar, dt: float) -> Scalar:
        """Return the part of the tick from `time` on [s] for which the load is attached, 0 to 1."""
        on, off = (jnp.clip((time + dt - event) / dt, 0.0, 1.0) for event in (self.time, self.end))
        return on - off

    @property
    def is_carried(self) -> Array:
        """Tell whether the robot settles with the load: true for a load at time 0."""
        return self.time <= 0.0


class Push(eqx.Module):
    """A constant force on the trunk's center of mass for a while."""

    force: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Force, world axes [N]."""
    start: Scalar = eqx.field(converter=_array)
    """Time at which the push starts [s]."""
    length: Scalar = eqx.field(converter=_array)
    """Duration of the push [s]."""


class Ground(eqx.Module):
    """The compliant ground: Hunt-Crossley normal force and regularized Coulomb friction at every sole corner."""

    sinkage: Scalar = eqx.field(converter=_array)
    """Depth to which the standing robot sinks in on both feet [m]; stiffness = weight / (8 corners x sinkage)."""
    damping: Scalar = eqx.field(converter=_array)
    """Relative force per penetration speed, a in N = k d (1 + a d') [s/m]."""
    friction: Scalar = eqx.field(converter=_array)
    """Coulomb coefficient."""
    slip_speed: Scalar = eqx.field(converter=_array)
    """Sliding speed at which friction reaches 71 % of Coulomb's [m/s]."""


class ModelErrors(eqx.Module):
    """Differences between the simulated robot and the one that the planner knows."""

    mass_scale: Float[Array, "*batch link"] = eqx.field(converter=_array)
    """Factor on every link's mass and inertia."""
    trunk_com_offset: Float[Array, "*batch 3"] = eqx.field(converter=_array)
    """Shift of the trunk's center of mass [m]."""
    gain_scale: Float[Array, "*batch 2 6"] = eqx.field(converter=_array)
    """Factor on every servo's gains."""


class SensorFaults(eqx.Module):
    """Settings and errors of the sensors."""

    delta_z: Float[Array, "*batch 2 4"] = eqx.field(converter=_array)
    """Gap at which each contact switch closes [m]."""
    stuck_open: Float[Array, "*batch 2 4"] = eqx.field(converter=_array)
    """1 for a switch that never closes, else 0."""
    bounce: Scalar = eqx.field(converter=_array)
    """Time after closing for which a switch opens and closes again, every millisecond [s]."""
    delay: Scalar = eqx.field(converter=_array)
    """Delay of every reading [s]; acts in roll-outs whose options have room for it."""
    force_noise: Scalar = eqx.field(converter=_array)
    """Standard deviation of every corner force [N]; noise acts in roll-outs whose options ask for it."""
    angle_noise: Scalar = eqx.field(converter=_array)
    """Standard deviation of every joint angle, of roll and of pitch [rad]."""
    seed: Int[Array, "*batch"] = eqx.field(converter=lambda v: jnp.asarray(v, jnp.int32))
    """Seed of the noise."""


class Scenario(eqx.Module):
    """One world. Start from `flat()`, add what happens with the `with_` methods."""

    terrain: Terrain
    """Obstacles and holes."""
    payload: Payload
    """The load."""
    push: Push
    """The push."""
    ground: Ground
    """Properties of the ground."""
    errors: ModelErrors
    """Differences between the robot and its record."""
    sensors: SensorFaults
    """Settings and errors of the sensors."""

    @classmethod
    def flat(cls, rectangles: SupportsIndex = 8) -> "Scenario":
        """Level ground, nothing happens; with room for so many rectangles.

        Raises:
            ValueError: if that is no whole number from 0 to MAX_RECTANGLES.
        """
        n = checked.whole("rectangles", rectangles, 0, MAX_RECTANGLES)
        return cls(
            terrain=Terrain(jnp.zeros((n, 2)), jnp.zeros((n, 2)), jnp.zeros(n)),
            payload=Payload(mass=0.0, time=NEVER, place=(0.2, 0.0, 0.25), size=0.2),
            push=Push(force=(0.0, 0.0, 0.0), start=NEVER, length=0.0),
            ground=Ground(sinkage=1.2e-4, damping=300.0, friction=0.8, slip_speed=1e-4),
            errors=ModelErrors(jnp.ones(len(LINK_NAMES)), jnp.zeros(3), jnp.ones((2, 6))),
            sensors=SensorFaults(
                delta_z=jnp.full((2, 4), 0.01),
                stuck_open=jnp.zeros((2, 4)),
                bounce=0.0,
                delay=0.0,
                force_noise=0.0,
                angle_noise=0.0,
                seed=0,
            ),
        )

    def with_rectangle(self, lower: Any, upper: Any, height: Any) -> "Scenario":  # noqa: ANN401
        """Add a level rectangle.

        Args:
            lower: smallest x and y [m].
            upper: largest x and y [m].
            height: over the ground, negative for a hole [m].

        Raises:
            ValueError: if the corners are not in order, a number is out of range, or there is no room for another one.
        """
        lower, upper = _PLACE.check("lower", lower), _PLACE.check("upper", upper)
        height = RANGES["height_m"].check("height", height)
        if is_concrete(lower, upper) and not (lower[0] < upper[0] and lower[1] < upper[1]):
            raise Refusal(
                f"rectangle: got lower {checked.shown(lower)} and upper {checked.shown(upper)} m, allowed: lower < "
                "upper in x and y"
            )
        terrain = self.terrain
        free = np.flatnonzero(np.asarray(terrain.upper)[:, 0] <= np.asarray(terrain.lower)[:, 0])
        if free.size == 0:
            room = terrain.height.shape[0]
            raise Refusal(
                f"rectangle: got one more than {room}, allowed: {room}; start from flat(rectangles=...)"
            )
        i = int(free[0])
        new = Terrain(
            terrain.lower.at[i].set(_array(lower)),
            terrain.upper.at[i].set(_array(upper)),
            terrain.height.at[i].set(height),
        )
        return eqx.tree_at(lambda s: s.terrain, self, new)

    def with_obstacle(
        self, robot: RobotParams, gait: Gait, step: SupportsIndex, height: object
    ) -> "Scenario":
        """Put a pad under the foothold of step number `step` (0 is the first), in that foot's lane only.

        The pad reaches PAD_BEHIND behind the heel, since a foot that touches early lands short, and PAD_AROUND beyond
        the other edges. A negative height [m] makes a hole.

        Raises:
            ValueError: if the gait has no such step, the swing foot does not clear the height, or there is no room for
                another rectangle.
        """
        lower, upper = pad_under(robot, gait, step)
        RANGES["height_m"].check("height", height)
        require_swing_clears(gait, {step: height})
        self._require_apart(step, lower, upper)
        return self.with_rectangle(lower, upper, height)

    def _require_apart(self, step: SupportsIndex, lower: np.ndarray, upper: np.ndarray) -> None:
        """Refuse an obstacle over another one: their heights would add up to something nobody asked for."""
        if not is_concrete(self.terrain):
            return
        low, high = np.asarray(self.terrain.lower), np.asarray(self.terrain.upper)
        used = (low < high).all(axis=-1) & (np.asarray(self.terrain.height) != 0.0)
        if (used & (low < upper).all(axis=-1) & (lower < high).all(axis=-1)).any():
            raise Refusal(f"step {step}: got an obstacle that overlaps another one, allowed: obstacles apart")

    def with_payload(self, mass: object, time: Any, end: Any = NEVER) -> "Scenario":  # noqa: ANN401
        """Attach a load to the front of the trunk.

        Args:
            mass: [kg].
            time: when, since the start of the walk [s]; with 0 the robot settles with the load, as with own weight.
            end: when it is taken off [s].

        Raises:
            ValueError: if a number is out of range, or the load is taken off before it is put on.
        """
        mass = RANGES["load_kg"].check("payload mass", mass)
        time = RANGES["load_time_s"].check("payload time", time)
        end = RANGES["load_end_s"].check("payload end", end)
        if is_concrete(time, end) and time >= end and end < NEVER:
            raise Refusal(
                f"payload end: got {float(end):g} s, allowed: > {float(time):g} s, when it is put on"
            )
        new = (_array(mass), _array(time), _array(end))
        return eqx.tree_at(lambda s: (s.payload.mass, s.payload.time, s.payload.end), self, new)

    def with_push(self, force: object, start: object, length: object) -> "Scenario":
        """Push the trunk with a force (3,) [N] from `start` for `length` [s].

        Raises:
            ValueError: if a number is out of range.
        """
        force = Quantity("N", _FORCE.low, _FORCE.high, shapes=((3,),)).check("push force", force)
        start = RANGES["push_time_s"].check("push start", start)
        length = RANGES["push_length_s"].check("push length", length)
        return eqx.tree_at(lambda s: s.push, self, Push(force=force, start=start, length=length))

    def with_friction(self, friction: object) -> "Scenario":
        """Change the friction coefficient.

        Raises:
            ValueError: if it is out of range.
        """
        friction = RANGES["friction"].check("friction", friction)
        return eqx.tree_at(lambda s: s.ground.friction, self, _array(friction))


def with_room(scenarios: Scenario) -> Scenario:
    """The same scenarios, with a leading axis, with room for a multiple of ROOM rectangles."""
    missing = -scenarios.terrain.height.shape[1] % ROOM

    def padded(leaf: Array | np.ndarray) -> Array | np.ndarray:
        pad = np.pad if is_concrete(leaf) else jnp.pad  # JAX would compile it for every number of scenarios
        return pad(leaf, [(0, 0), (0, missing), *[(0, 0)] * (leaf.ndim - 2)])

    if not missing:
        return scenarios
    return eqx.tree_at(lambda s: s.terrain, scenarios, jax.tree.map(padded, scenarios.terrain))


def pad_under(robot: RobotParams, gait: Gait, step: SupportsIndex) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest corner (x, y) [m] of the pad that `Scenario.with_obstacle` puts under a foothold.

    Raises:
        ValueError: if the gait has no such step.
    """
    foot, sole, _ = _swing(gait, step)
    corners = sole[foot, :2] + np.asarray(robot.p_sole_corner, sole.dtype)[foot, :, :2]
    return corners.min(axis=0) - [PAD_BEHIND, PAD_AROUND], corners.max(axis=0) + PAD_AROUND


def swing_height(gait: Gait, step: SupportsIndex = 0) -> float:
    """Height that the swing foot goes to in the middle of a step [m].

    Raises:
        ValueError: if the gait has no such step.
    """
    return _swing(gait, step)[2]


def require_swing_clears(gait: Gait, heights: Mapping[Any, object]) -> None:
    """Refuse an obstacle under a foothold that is as high as the swing foot goes, or higher.

    Args:
        gait: the plan.
        heights: of the obstacle under the foothold of each of these steps [m]; what is traced is not judged.

    Raises:
        ValueError: naming the step, the height and what is allowed.
    """
    if not is_concrete(gait):
        return
    for step, height in heights.items():
        if not is_concrete(height):
            continue
        apex, height = swing_height(gait, step), RANGES["height_m"].check(f"step {step}, height", height)
        if height >= apex - 1e-6:
            raise Refusal(
                f"step {step}: got an obstacle of {height:g} m, allowed: below {apex:.3g} m, the height the swing foot "
                "goes to"
            )


def require_clear_start(robot: RobotParams, gait: Plan, terrain: Terrain) -> None:
    """Refuse terrain in which a sole of the starting stance overlaps an obstacle or a hole, or touches its edge.

    Args:
        robot: whose soles they are.
        gait: whose stance at its start it is.
        terrain: of one scenario, or of a batch of them; what is traced is not judged.

    Raises:
        ValueError: naming the foot, the rectangle and what is allowed.
    """
    if not is_concrete(robot, gait, terrain):
        return
    with jax.ensure_compile_time_eval():
        start = np.asarray(_start(gait))
    sole = start[:, None, :2] + np.asarray(robot.p_sole_corner, start.dtype)[..., :2]
    low, high = sole.min(axis=1) - 0.5 * EDGE_WIDTH, sole.max(axis=1) + 0.5 * EDGE_WIDTH
    lower, upper, height = (np.asarray(leaf) for leaf in (terrain.lower, terrain.upper, terrain.height))
    there = (height != 0.0) & np.all(lower < upper, axis=-1)
    for foot, side in enumerate(SIDE_NAMES):
        over = there & np.all((lower < high[foot]) & (upper > low[foot]), axis=-1)
        if over.any():
            place = tuple(np.argwhere(over)[0])
            (x0, y0), (x1, y1) = lower[place], upper[place]
            where = f"scenario {', '.join(map(str, place[:-1]))}: " if place[:-1] else ""
            what = "an obstacle" if height[place] > 0.0 else "a hole"
            raise Refusal(
                f"{where}start: got {what} of {height[place]:g} m from ({x0:.3f}, {y0:.3f}) to ({x1:.3f}, {y1:.3f}) m "
                f"under the {side} foot, which starts from ({low[foot, 0]:.3f}, {low[foot, 1]:.3f}) to "
                f"({high[foot, 0]:.3f}, {high[foot, 1]:.3f}) m, allowed: level ground there"
            )


def _swing(gait: Gait, step: SupportsIndex) -> tuple[int, np.ndarray, float]:
    """The foot that lands in a step, both soles then (2, 3) [m], and how high the foot goes before it [m]."""
    number = checked.whole("step", step, 0, int(gait.timing.n_steps) - 1)
    with jax.ensure_compile_time_eval():
        foot, sole, apex = jax.tree.map(np.asarray, _foothold(gait, jnp.asarray(number)))
    return int(foot), sole, float(apex)


@runtime.jit
def _start(gait: Plan) -> Float[Array, "2 3"]:
    """Both soles at the start of a walk."""
    return gait.task(jnp.zeros((), jnp.result_type(float))).sole


@runtime.jit
def _foothold(
    gait: Plan, step: Int[Array, ""]
) -> tuple[Int[Array, ""], Float[Array, "2 3"], Float[Array, ""]]:
    """The foot that lands in a step, both soles then, and the height of the swing foot in the middle of the step."""
    timing = gait.timing
    landed, middle = at(gait, timing.touchdown(step)), gait.task(timing.liftoff(step) + 0.5 * timing.T_s)
    return landed.phase.swing, landed.position.sole, middle.sole[:, 2].max()

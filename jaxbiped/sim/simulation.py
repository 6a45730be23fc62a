"""A robot, a controller and options, ready to walk: from rest on the ground, tick by tick, to statistics and a trace.

    simulation = prepare(robot, controller)
    walk = simulation.run(scenario, duration=17.0)

`start`, `tick` and `walk` are pure and for one robot in one scenario, see `tick`; `run` and `run_many` check what they
are given and compile, see `segments`. Nothing else in the package walks a robot on this ground.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbiped.adapt import Controller
from jaxbiped.planner import is_concrete
from jaxbiped.robot import RobotParams, on_device
from jaxbiped.sim import feed_forward, lockstep, mjx_adapter, segments
from jaxbiped.sim.options import C_MUJOCO, DURATION, MJX, Options
from jaxbiped.sim.physics import mjx_contacts
from jaxbiped.sim.scenario import Scenario, require_clear_start
from jaxbiped.sim.segments import Told
from jaxbiped.sim.stability import require_stable_dt
from jaxbiped.sim.tick import PureSimulation, Walk


class Simulation(PureSimulation):
    """A robot, its controller and options, ready to walk in any scenario."""

    def run(self, scenario: Scenario, duration: float, told: Told | None = None) -> Walk:
        """Walk for `duration` [s] in one scenario, checked and compiled.

        Args:
            scenario: what is walked in.
            duration: how long [s].
            told: is told from time to time which fraction of the walk is done.

        Raises:
            ValueError: for a duration, a terrain or a tick that is not allowed.
        """
        batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], scenario)
        return jax.tree.map(lambda leaf: leaf[0], self.run_many(batch, duration, told))

    def run_many(
        self, scenarios: Scenario, duration: float, told: Told | None = None, lanes: int | None = None
    ) -> Walk:
        """Walk in many scenarios, which have a leading axis, as has the walk that is returned.

        Args:
            scenarios: what is walked in.
            duration: how long every walk is [s].
            told: is told from time to time which fraction of the walks is done.
            lanes: how many walk at once, by XLA some more (see `segments.rounded`), a lane that has finished taking
                the next scenario; None: all of them, as always in C MuJoCo.

        Raises:
            ValueError: for a duration, a terrain or a tick that is not allowed.
        """
        require_allowed(self.robot, self.controller, scenarios, duration, self.options)
        if self.options.contact == C_MUJOCO:
            return lockstep.run(self, scenarios, duration, told)
        return segments.run(self, scenarios, duration, told, lanes)


def prepare(
    robot: RobotParams, controller: Controller, options: Options | None = None, rectangles: int = 0
) -> Simulation:
    """Get a robot ready to walk: its MJX model, and the feed-forward torques of its plan.

    Args:
        robot: nominal.
        controller: gait and adaptation.
        options: the defaults if not given.
        rectangles: how many a terrain has, for MuJoCo's own contacts only.
    """
    robot, options = on_device(robot), options or Options()
    if options.contact == MJX:
        model = mjx_contacts.base_model(robot, rectangles, options.dt)
    else:
        model = mjx_adapter.base_model(robot)
    table = feed_forward.none()
    if options.feed_forward:
        table = feed_forward.plan(robot, controller.gait, feed_forward.rows(controller.gait))
    return Simulation(robot, controller, model, table, options)


def rollout(
    robot: RobotParams,
    controller: Controller,
    scenario: Scenario,
    duration: float,
    options: Options | None = None,
    told: Told | None = None,
) -> Walk:
    """Walk one robot in one scenario for `duration` [s]: `prepare` and `Simulation.run`, and errors as from there."""
    require_allowed(robot, controller, scenario, duration, options or Options())
    return prepare(robot, controller, options, rectangles_of(scenario)).run(scenario, duration, told)


def require_allowed(
    robot: RobotParams, controller: Controller, scenarios: Scenario, duration: float, options: Options
) -> None:
    """Refuse inputs that cannot be walked, before anything is compiled; of scenarios only numbers that are known.

    Raises:
        ValueError: for a duration, a terrain or a tick that is not allowed.
    """
    DURATION.check("duration", duration)
    require_clear_start(robot, controller.gait, scenarios.terrain)
    if is_concrete(scenarios):
        gains, sinkage = (
            np.max(np.asarray(scenarios.errors.gain_scale)),
            np.min(np.asarray(scenarios.ground.sinkage)),
        )
        require_stable_dt(robot, options.dt, float(sinkage), float(gains), options.implicit)
    if options.contact == MJX:
        mjx_contacts.check_terrain(scenarios.terrain)


def rectangles_of(scenario: Scenario) -> int:
    """Number of rectangles that a terrain has room for."""
    return scenario.terrain.height.shape[-1]

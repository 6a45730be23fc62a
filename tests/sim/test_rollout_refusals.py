"""What a roll-out refuses before anything is compiled: durations, options, and feet that start in an obstacle."""

import pytest

from jaxbiped import robot
from jaxbiped.adapt import Controller
from jaxbiped.planner import PolynomialGait
from jaxbiped.robot import RobotParams
from jaxbiped.sim import Options, Scenario, rollout


@pytest.fixture(scope="module")
def surena() -> tuple[RobotParams, Controller]:
    params = robot.load("surena3")
    return params, Controller(PolynomialGait.preset(params, 2))


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan"), float("inf"), 1e9])
def test_durations(surena, duration):
    params, controller = surena
    with pytest.raises(ValueError, match=r"duration: got .* s, allowed: > 0 and <= 3600 s"):
        rollout(params, controller, Scenario.flat(), duration)


@pytest.mark.parametrize(("height", "what"), [(0.02, "an obstacle of 0.02 m"), (-0.02, "a hole of -0.02 m")])
def test_a_foot_in_an_obstacle_at_the_start(surena, height, what):
    """It was accepted, and hit with 25 kN."""
    params, controller = surena
    scenario = Scenario.flat().with_rectangle((0.05, 0.05), (0.3, 0.2), height)
    with pytest.raises(ValueError, match=f"start: got {what} .* under the left foot"):
        rollout(params, controller, scenario, 1.0)


OPTIONS = [
    ({"dt": 0.0}, "dt: got 0 s"),
    ({"dt": float("nan")}, "dt: got nan s"),
    ({"dt": 0.5}, "0.5 ms is 0.0005 s"),
    ({"control_every": 0}, "control_every: got 0"),
    ({"control_every": True}, "control_every: got the truth value true"),
    ({"delay_room": -1}, "delay_room: got -1"),
    ({"trace_every": 10**9}, "trace_every: got 1000000000"),
    ({"payload_model": "heavy"}, "payload_model: got 'heavy', allowed: exact, thesis"),
    ({"contact": "hard"}, "contact: got 'hard', allowed: compliant, mjx"),
]


@pytest.mark.parametrize(("given", "says"), OPTIONS)
def test_options(given, says):
    with pytest.raises(ValueError, match="allowed") as refusal:
        Options(**given)
    assert says in str(refusal.value)

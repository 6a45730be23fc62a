"""Parameters of the payload reflex (El-Kahlout's thesis, sections 3.3, 4.3, 4.4), and its named variants.

`original` (Eq. 3.17, 2 s) and `modified` (Eqs. 4.5, 4.6, 4 s) are to the letter of the equations but for the errata
listed in docs/papers.md; in `repaired` every repair is a switch of its own; `two_speed` is `repaired` with a reflex of
two speeds, for floors with grip.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbiped import runtime
from jaxbiped.adapt.parameters import Tune, number, require_names, switch
from jaxbiped.adapt.stage import Outcome, Stage, register
from jaxbiped.checked import Quantity, Refusal
from jaxbiped.kinematics import body
from jaxbiped.planner import Gait, feasibility, is_concrete
from jaxbiped.robot import RobotParams, on_device

Scalar = Float[Array, ""]

FORCE_TIME_CONSTANT = 0.09975
"""Time constant of the thesis' force filter, lambda = 5e-3 per tick of 0.5 ms [s]."""
ZMP_TIME_CONSTANT = 0.99975
"""Time constant of the thesis' ZMP filter, lambda = 5e-4 per tick of 0.5 ms [s]."""
SMALLEST_LOAD = 40.0
"""Weight over which a load is to start the reflex [N]: 15 kg put on at 1.2 and 1.3 s set off the thesis' reflex after
30.5 and 32.5 ms, when its filter has risen by 39 and 41 N."""
X_REFLEX_ORIGINAL = ((0.01, -0.01), (0.01, -0.01), (0.01, -0.01))
"""Eq. 3.17: the left foot forward, the right one back, whatever happens."""
X_REFLEX_MODIFIED = ((-0.01, 0.01), (0.01, -0.01), (0.0, 0.0))
"""Eqs. 4.5, 4.6: the foot on the ground towards the body."""
X_REFLEX_NONE = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
LEAN = 0.011
"""How far behind the standing robot's ZMP that of `two_speed` is to balance [m]: the thesis' plan, whose ZMP passes the
toes at the end of single support, leaves no room for the error of a reading."""
_ENTRIES = {
    f"x_{foot}_{phase}": (row, column)
    for row, phase in enumerate(("left_swings", "right_swings", "both_stand"))
    for column, foot in enumerate(("left", "right"))
}
_LITERAL = ("smooth_reflex", "two_speeds", "steady_recovery", "smooth_resume", "starts_again")
"""Switches that are off in the thesis."""


@register
class PayloadReflex(Stage):
    """Parameters of the payload stage; every field says what it is, its unit and its bounds."""

    name: ClassVar[str] = "payload"
    record: ClassVar[str] = "payload_reflex"
    replans: ClassVar[bool] = True
    variants: ClassVar[tuple[str, ...]] = ("original", "modified", "repaired", "two_speed")
    outcomes: ClassVar[dict[str, Outcome]] = {
        "reflexes": Outcome("how many payload reflexes there were", int, 0),
        "trigger_s": Outcome("when the last one began; missing if there was none"),
    }
    read_off_plan: ClassVar[tuple[str, ...]] = ("zmp_balanced", "threshold", "slow_threshold", "x_stand")

    zmp_balanced: Scalar = number(
        "zmp_balanced",
        Quantity(
            "m",
            -0.5,
            0.5,
            text="ZMP forward of the pelvis at which the unloaded robot balances, -0.035 in the thesis.",
        ),
        tune=Tune(-0.1, 0.05, "thesis: -0.035"),
    )
    x_reflex: Float[Array, "3 2"] = number(
        "x_reflex",
        Quantity(
            "m",
            -0.2,
            0.2,
            shapes=((3, 2),),
            text="How far the reflex moves (left, right) foot forward; rows: left foot swings, right foot "
            "swings, double support.",
        ),
        X_REFLEX_MODIFIED,
        tune=Tune(-0.03, 0.03, "thesis: 0.01 forward or back", _ENTRIES),
    )
    threshold: Scalar = number(
        "threshold",
        Quantity(
            "N",
            0.0,
            1e4,
            True,
            text="Change of the low-passed force that starts the reflex; named variants add what the plan "
            "itself causes.",
        ),
        SMALLEST_LOAD,
        tune=Tune(5.0, 200.0),
    )
    slow_threshold: Scalar = number(
        "slow_threshold",
        Quantity(
            "N",
            0.0,
            1e4,
            True,
            text="The same for the slower low-pass, which decides while other things shake the robot.",
        ),
        SMALLEST_LOAD,
    )
    slow_time_constant: Scalar = number(
        "slow_time_constant",
        Quantity("s", 0.0, 60.0, True, text="Time constant of the slower low-pass."),
        1.0,
    )
    rearm_time: Scalar = number(
        "rearm_time",
        Quantity(
            "s",
            0.0,
            600.0,
            endless=True,
            text="For how long after going on the slower low-pass decides; infinite: from the first reflex "
            "on, for good.",
        ),
        2.5,
    )
    force_time_constant: Scalar = number(
        "force_time_constant",
        Quantity(
            "s", 0.0, 10.0, True, text="Time constant of the low-pass of the summed foot force, Eq. 3.7."
        ),
        FORCE_TIME_CONSTANT,
    )
    zmp_time_constant: Scalar = number(
        "zmp_time_constant",
        Quantity("s", 0.0, 60.0, True, text="Time constant of the low-pass of the ZMP, Eq. 3.18."),
        ZMP_TIME_CONSTANT,
    )
    x_stand: Scalar | None = number(
        "x_stand",
        Quantity(
            "m",
            -0.5,
            0.5,
            optional=True,
            text="Sole forward of the pelvis on which a steady recovery stands alone; None: wherever it is.",
        ),
        None,
    )
    reflex_time: Scalar = number(
        "reflex_time",
        Quantity("s", 0.0, 10.0, True, text="t_refl_per."),
        0.1,
        tune=Tune(0.04, 1.0, "thesis: 0.1"),
    )
    body_time: Scalar = number(
        "body_time",
        Quantity(
            "s",
            0.0,
            60.0,
            True,
            text="Longest time in which a smooth reflex brings the body sideways to the middle, one of two "
            "speeds forward too; it has to be there when the ZMP is read.",
        ),
        1.2,
    )
    body_acceleration: Scalar = number(
        "body_acceleration",
        Quantity(
            "m/s2",
            0.0,
            100.0,
            True,
            text="About the greatest acceleration of the body in a reflex of two speeds, which decides "
            "how long the body takes, within reflex_time and body_time.",
        ),
        1.6,
        tune=Tune(0.5, 4.0, only_with="two_speeds"),
    )
    quick_step: Scalar = number(
        "quick_step",
        Quantity(
            "m",
            -1.0,
            1.0,
            text="How far a reflex of two speeds takes the swing foot forward while it sets it down.",
        ),
        0.25,
        tune=Tune(0.0, 0.4, only_with="two_speeds"),
    )
    longest_step: Scalar = number(
        "longest_step",
        Quantity(
            "m",
            0.0,
            2.0,
            text="How far ahead of the stance foot a reflex of two speeds sets the swing foot down at most.",
        ),
        0.3,
        tune=Tune(0.05, 0.5, only_with="two_speeds"),
    )
    behind: Scalar = number(
        "behind",
        Quantity(
            "m",
            -0.5,
            0.5,
            text="How far behind the middle of the feet a reflex of two speeds brings the body, from where "
            "the plan has it in double support.",
        ),
        0.03,
        tune=Tune(-0.05, 0.1, only_with="two_speeds"),
    )
    settling_time: Scalar = number(
        "settling_time",
        Quantity("s", 0.0, 60.0, True, text="t_set_t."),
        4.0,
        tune=Tune(1.5, 6.0, "thesis: 2, then 4"),
    )
    hold_time: Scalar | None = number(
        "hold_time",
        Quantity(
            "s",
            0.0,
            60.0,
            True,
            optional=True,
            text="Standing still after the recovery step; None: half of settling_time, as in the thesis.",
        ),
        None,
    )
    shift_time: Scalar = number("shift_time", Quantity("s", 0.0, 60.0, True, text="t_x_ref_as."), 0.5)
    x_ref_gain: Scalar = number(
        "x_ref_gain",
        Quantity("", 0.0, 5.0, text="Part of the measured ZMP error by which x_ref is shifted."),
        1.0,
        tune=Tune(0.0, 2.0, "thesis: 1"),
    )
    smooth_reflex: bool = switch(
        "smooth_reflex",
        True,
        "Repair: the reflex takes over velocity and acceleration instead of starting with a "
        "velocity step, and the body, which cannot be pulled off its stance foot as fast as the "
        "other one is set down, has `body_time` to follow.",
    )
    smooth_ramp: bool = switch(
        "smooth_ramp",
        False,
        "The literal reflex's smooth twin, not in the thesis: feet and body take over velocity "
        "and acceleration and are at rest after the same `reflex_time`, instead of moving at "
        "constant speeds that start and stop in a step. Nothing to a smooth reflex.",
    )
    two_speeds: bool = switch(
        "two_speeds",
        False,
        "Not in the thesis: the swing foot takes a quick step ahead, in `reflex_time`, while the body "
        "follows at its own speed; a smooth reflex in all else, whatever `smooth_reflex` says.",
    )
    steady_recovery: bool = switch(
        "steady_recovery",
        True,
        "Repair: the recovery step takes a whole T_s, with the body over the stance foot, and the "
        "body advances after it instead of during it.",
    )
    starts_again: bool = switch(
        "starts_again",
        True,
        "A further change of weight starts the reflex again; False: once, as the thesis' "
        "experiments have it. On a robot that rocks under its load the literal variants would set "
        "themselves off again.",
    )
    smooth_resume: bool = switch(
        "smooth_resume",
        True,
        "Repair: the plan is brought up to speed over a double support instead of at once.",
    )
    interpolate: bool = switch(
        "interpolate", True, "Take events from inside the tick; False: from the tick that saw them."
    )

    def __check_init__(self) -> None:
        """Refuse a body that is still on its way when the ZMP is read."""
        slow = self.smooth_reflex or self.two_speeds
        if slow and is_concrete(self.reflex_time, self.settling_time, self.body_time):
            still, body_time = float(self.reflex_time) + float(self.settling_time), float(self.body_time)
            if body_time > still * (1.0 + 1e-6):
                raise Refusal(
                    f"body_time: got {body_time:g} s, allowed: <= reflex_time + settling_time = {still:g} s"
                )

    @classmethod
    def named(cls, variant: str, robot: RobotParams, gait: Gait, **parameters: object) -> "PayloadReflex":
        """Parameters of one of `variants`; raises its errors."""
        make = {name: getattr(cls, name) for name in cls.variants}
        return make[variant](robot, gait, **parameters)

    @classmethod
    def original(cls, robot: RobotParams, gait: Gait, **parameters: object) -> "PayloadReflex":
        """Parameters of Eqs. 3.7-3.40, with settling 2 s.

        Raises:
            TypeError: for a parameter that there is not.
            ValueError: for a value that is not allowed.
        """
        return cls._literal(robot, gait, {"x_reflex": X_REFLEX_ORIGINAL, "settling_time": 2.0, **parameters})

    @classmethod
    def modified(cls, robot: RobotParams, gait: Gait, **parameters: object) -> "PayloadReflex":
        """Parameters with Eqs. 4.5, 4.6 and settling 4 s; raises the errors of `original`."""
        return cls._literal(robot, gait, {"x_reflex": X_REFLEX_MODIFIED, "settling_time": 4.0, **parameters})

    @classmethod
    def repaired(cls, robot: RobotParams, gait: Gait, **parameters: Any) -> "PayloadReflex":  # noqa: ANN401
        """Parameters with every repair; feet stay where they are or come down. Raises the errors of `original`."""
        require_names(cls, parameters)
        ours = {"x_reflex": X_REFLEX_NONE, "reflex_time": 0.5}
        if "x_stand" not in parameters:
            ours["x_stand"] = standing_zmp(robot, gait) - on_device(robot).p_sole_corner[..., 0].mean()
        return cls(**{**_of_plan(robot, gait, parameters), **ours, **parameters})

    @classmethod
    def two_speed(cls, robot: RobotParams, gait: Gait, **parameters: Any) -> "PayloadReflex":  # noqa: ANN401
        """Parameters with every repair and one reflex of two speeds; raises the errors of `original`.

        One in a walk: in C MuJoCo the steps of a loaded robot set off further ones, in which it falls.
        """
        require_names(cls, parameters)
        ours = {"two_speeds": True, "starts_again": False, "reflex_time": 0.25, "body_time": 0.9}
        if "zmp_balanced" not in parameters:
            ours["zmp_balanced"] = standing_zmp(robot, gait) - LEAN
        return cls.repaired(robot, gait, **{**ours, **parameters})

    @property
    def hold(self) -> Scalar:
        """Return how long the robot stands still after the recovery step [s]."""
        return 0.5 * self.settling_time if self.hold_time is None else self.hold_time

    @classmethod
    def _literal(cls, robot: RobotParams, gait: Gait, parameters: dict[str, Any]) -> "PayloadReflex":
        require_names(cls, parameters)
        off = dict.fromkeys(_LITERAL, False)
        return cls(**{**_of_plan(robot, gait, parameters), **off, **parameters})


def _of_plan(robot: RobotParams, gait: Gait, given: Mapping[str, object]) -> dict[str, Scalar]:
    """Values that robot and plan imply for the parameters that are not given."""
    says = {
        "zmp_balanced": lambda: standing_zmp(robot, gait),
        "threshold": lambda: SMALLEST_LOAD + planned_ripple(robot, gait),
    }
    return {name: say() for name, say in says.items() if name not in given}


def planned_ripple(robot: RobotParams, gait: Gait, samples_per_step: int = 60) -> Scalar:
    """Greatest deviation of the plan's vertical ground force from the weight [N]: no sign of a load.

    Sampled so often in every step of the plan; where its number of steps is traced, of those there is room for.
    """
    timing = gait.timing
    steps = int(timing.n_steps) if is_concrete(timing) else timing.room
    times = jnp.linspace(0.0, gait.duration, samples_per_step * (steps + 2))
    force = feasibility(robot, gait, times).ground_force[:, 2]
    return jnp.abs(force - force[0]).max()


@runtime.jit
def standing_zmp(robot: RobotParams, gait: Gait) -> Scalar:
    """ZMP forward of the pelvis [m] of the robot standing still as in mid double support: its center of mass."""
    task = gait.task(resume_plan_times(gait)[1])
    angle, _ = body.joint_angles(robot, task.sole - task.pelvis)
    pose = body.pose(robot, jnp.zeros(3, angle.dtype), jnp.eye(3, dtype=angle.dtype), angle)
    return body.com(robot, pose)[0]


def resume_plan_times(gait: Gait) -> Float[Array, " n"]:
    """Plan times [s] from which the walk can go on: at rest, mid double support before each further step, the end."""
    timing = gait.timing
    number = jnp.arange(timing.room + 1)
    middle = timing.liftoff(number) - 0.5 * (timing.T_c - timing.T_s)
    times = jnp.where(number < timing.n_steps, middle, gait.duration)
    return jnp.where(number == 0, 0.0, times)

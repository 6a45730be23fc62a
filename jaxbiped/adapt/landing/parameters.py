"""Parameters of landing on ground of unknown height (khadiv section 3), and their named variants.

`Landing.paper()` follows the equations to the letter, `Landing.repaired()` (the default) mends what they break; every
repair is a switch of its own.
"""

from typing import Any, ClassVar

from jaxtyping import Array, Float

from jaxbiped.adapt.parameters import Tune, number, require_names, switch, switches
from jaxbiped.adapt.stage import Outcome, Stage, register
from jaxbiped.checked import Quantity
from jaxbiped.planner import Gait
from jaxbiped.robot import RobotParams

Scalar = Float[Array, ""]


@register
class Landing(Stage):
    """Parameters of the landing stage; every field says what it is, its unit and its bounds."""

    name: ClassVar[str] = "landing"
    variants: ClassVar[tuple[str, ...]] = ("paper", "repaired")
    outcomes: ClassVar[dict[str, Outcome]] = {
        "missed": Outcome("steps that ended without a touchdown, with landing adaptation", int, 0),
    }

    delta_z: Scalar = number(
        "delta_z",
        Quantity(
            "m",
            0.0,
            0.1,
            text="Height of the sole over the ground when a switch closes, as the controller believes; 0: on it.",
        ),
        0.01,
    )
    T_mod: Scalar | None = number(
        "T_mod",
        Quantity(
            "s",
            0.0,
            2.0,
            True,
            optional=True,
            text="Time to set the foot down after a touch; None for the time the plan needs from delta_z down.",
        ),
        None,
        tune=Tune(0.01, 0.3, "khadiv: what the plan needs"),
    )
    delta_x_scale: Scalar = number(
        "delta_x_scale",
        Quantity("", 0.0, 5.0, text="Factor on delta_x, the way the plan goes in its last T_mod."),
        1.0,
        tune=Tune(0.0, 2.0, "khadiv: 1"),
    )
    descent_speed: Scalar = number(
        "descent_speed",
        Quantity(
            "m/s", 0.0, 5.0, True, text="Speed of the descent after T_s, h per control tick in the paper."
        ),
        0.2,
        tune=Tune(0.05, 0.5),
    )
    descent_acceleration: Scalar = number(
        "descent_acceleration",
        Quantity(
            "m/s2", 0.0, 100.0, True, text="Acceleration of the descent's start and stop, where it is smooth."
        ),
        3.0,
    )
    max_descent: Scalar = number(
        "max_descent",
        Quantity("m", 0.0, 1.0, True, text="Depth at which the descent stops, where it is smooth."),
        0.08,
    )
    release_share: Scalar = number(
        "release_share",
        Quantity("", 0.0, 2.0, True, text="Time of release over T_s."),
        1.0,
        tune=Tune(0.3, 1.0, "khadiv: 1"),
    )
    no_undershoot: bool = switch(
        "no_undershoot",
        True,
        "Repair: T_mod at most T*, so that the quintic of Eq. 6 never goes below the ground.",
    )
    smooth_descent: bool = switch(
        "smooth_descent",
        True,
        "Repair: the descent starts and stops with limited acceleration instead of a velocity step.",
    )
    pelvis_follows: bool = switch(
        "pelvis_follows", True, "Repair: in a retard landing the pelvis follows the foot through z_mod too."
    )
    commanded_velocity: bool = switch(
        "commanded_velocity",
        True,
        "Repair: Eqs. 6 and 7 start from the commanded, not the preplanned, velocity and acceleration.",
    )
    keep_x: bool = switch(
        "keep_x",
        True,
        "Repair: the sagittal offset is kept while the foot stands and blended out in its own next swing.",
    )
    stays_down: bool = switch(
        "stays_down",
        True,
        "Repair: a foot that has touched is carried along by the rest of the release, instead of being lifted off or "
        "pushed down by it.",
    )
    interpolate: bool = switch(
        "interpolate", True, "Take the touch at its own instant; False: at the tick that saw it."
    )

    @classmethod
    def paper(cls, **parameters: Any) -> "Landing":  # noqa: ANN401
        """Parameters of Eqs. 6-16 to the letter: every switch off that is not given.

        Raises:
            TypeError: for a parameter that there is not.
            ValueError: for a value that is not allowed.
        """
        require_names(cls, parameters)
        return cls(**{**dict.fromkeys(switches(cls), False), **parameters})

    @classmethod
    def repaired(cls, **parameters: Any) -> "Landing":  # noqa: ANN401
        """Parameters with every repair that is not switched off; raises the errors of `paper`."""
        require_names(cls, parameters)
        return cls(**parameters)

    @classmethod
    def named(cls, variant: str, robot: RobotParams, gait: Gait, **parameters: object) -> "Landing":
        """Parameters of the variant `paper` or `repaired`; raises their errors."""
        return {"paper": cls.paper, "repaired": cls.repaired}[variant](**parameters)

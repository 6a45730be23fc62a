"""Gait parameters of the preset robots.

surena3, polynomial: the paper does not state its numbers. D_s, T_s, T_d, H_max, z_max, z_min are chosen; x_s,
x_e, y_d, y_m and the start and stop were optimised for the ZMP margin, as section 2.2 of the paper proposes.
elkahlout, polynomial: neither source has it; chosen and optimised in the same way.
elkahlout, cosine: section 3.2 of the thesis states them all, but for the start from and stop to rest. The ZMP of this
one leaves the support polygon, see `known_infeasible`; no other preset breaks a constraint.
surena3, cosine: neither source has it; w and x_ref were optimised for the ZMP margin, the rest is chosen.
`python sweeps/plan_presets.py` optimises them all again and says what every preset takes of its robot.
"""

from jaxbiped.planner.checks import GaitError
from jaxbiped.planner.cosine_gait import CosineGait, CosineParams
from jaxbiped.planner.polynomial_gait import PolynomialParams, StartStop
from jaxbiped.robot import RobotParams


def polynomial_params(robot: str | RobotParams) -> PolynomialParams:
    """Return the preset of the polynomial gait for a preset robot, by its name, or for one that walks like it.

    Raises:
        GaitError: if there is none.
    """
    return _of(_POLYNOMIAL, robot, "PolynomialGait.make(robot, PolynomialParams(...), n_steps)")()


def cosine_params(robot: str | RobotParams) -> CosineParams:
    """Return the preset of the cosine gait for a preset robot, by its name, or for one that walks like it.

    Raises:
        GaitError: if there is none.
    """
    return _of(_COSINE, robot, "CosineGait.make(robot, CosineParams(...), n_steps)")()


def known_infeasible(gait: type, robot: str | RobotParams) -> str:
    """Say why the preset of a robot breaks a constraint although it is one; empty if it is not known to.

    Args:
        gait: `PolynomialGait` or `CosineGait`.
        robot: the robot that walks, or its name.
    """
    name = robot if isinstance(robot, str) else robot.preset_name
    return _INFEASIBLE.get((gait, name), "")


def _of(table: dict, robot: str | RobotParams, otherwise: str):
    name = robot if isinstance(robot, str) else robot.preset_name
    if name not in table:
        raise GaitError(
            f"preset gait: got robot {name!r}, allowed: {', '.join(table)}; otherwise add "
            f"walks_like = {' or '.join(f'{known!r}' for known in table)} to the robot's file, or use {otherwise}"
        )
    return table[name]


def _surena3_polynomial() -> PolynomialParams:
    return PolynomialParams(
        D_s=0.25,
        T_s=1.2,
        T_d=0.6,
        H_max=0.10,
        x_s=0.05489,
        x_e=0.01021,
        y_d=0.02505,
        y_m=-0.02198,
        z_max=0.76,
        z_min=0.745,
        L_p=0.23,
        T_ini=1.5,
        T_end=1.5,
        start_stop=StartStop(
            x_rest_start=-0.0308,
            x_s_first=0.02316,
            x_e_first=0.02104,
            x_s_second=0.04945,
            x_e_penultimate=0.00590,
            x_s_last=0.06154,
            x_e_last=-0.02857,
            x_rest_end=-0.03076,
            v_first=-0.00255,
            v_last=0.00883,
        ),
    )


def _elkahlout_polynomial() -> PolynomialParams:
    """Optimised by sequential linear programming for the smallest ZMP margin of a walk of 6 steps.

    With knees bent by 40 degrees or more, which leaves the reach to step 3 cm down. The pelvis is ahead of the
    feet (x_s about 0): the centre of mass is 35 mm behind the pelvis frame, the middle of the soles 40 mm ahead
    of the ankles. D_s leaves room between an obstacle and the other footholds.
    """
    return PolynomialParams(
        D_s=0.22,
        T_s=1.2,
        T_d=0.6,
        H_max=0.10,
        x_s=0.00077,
        x_e=0.05976,
        y_d=0.02974,
        y_m=-0.01110,
        z_max=0.49,
        z_min=0.48,
        L_p=0.22,
        T_ini=1.5,
        T_end=1.5,
        start_stop=StartStop(
            x_rest_start=0.08513,
            x_s_first=-0.04737,
            x_e_first=0.06201,
            x_s_second=-0.00071,
            x_e_penultimate=0.05966,
            x_s_last=-0.00267,
            x_e_last=0.06061,
            x_rest_end=0.01851,
            v_first=0.06301,
            v_last=0.12359,
        ),
    )


def _surena3_cosine() -> CosineParams:
    """Optimised by pattern search for the smallest ZMP margin of a walk of 4 steps: w and x_ref.

    The body stands still in double support and moves over the whole foot in single support, so that the margin
    falls with b_s and grows with t_ss. t_ds is as long as t_ss: with a shorter one the sway leaves a foot that
    lands late behind, and landing adaptation falls sideways on pads of 2 cm.
    """
    return CosineParams(
        t_ss=1.6,
        t_ds=1.6,
        b_s=0.085,
        w=0.1687,
        w_of=0.115,
        h_b=0.74,
        h_s=0.12,
        x_ref=0.0225,
        y_ref=0.0,
        T_ini=1.5,
        T_end=1.5,
    )


def _elkahlout_cosine() -> CosineParams:
    return CosineParams(
        t_ss=1.4,
        t_ds=1.0,
        b_s=0.08,
        w=0.13,
        w_of=0.11,
        h_b=0.5,
        h_s=0.03,
        x_ref=-0.09,
        y_ref=0.0,
        T_ini=1.2,
        T_end=1.2,
    )


_POLYNOMIAL = {"surena3": _surena3_polynomial, "elkahlout": _elkahlout_polynomial}
_COSINE = {"elkahlout": _elkahlout_cosine, "surena3": _surena3_cosine}
_INFEASIBLE = {
    (
        CosineGait,
        "elkahlout",
    ): "these are the thesis' own numbers, which do not fit the sole that its Table 4.1 asks for: "
    "the ZMP passes the toes at the end of every single support"
}

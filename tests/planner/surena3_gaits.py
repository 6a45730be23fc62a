"""Five polynomial gaits of surena3, optimised for their ZMP margin; C is the preset before rounding."""

from typing import Any

from jaxbiped.planner import PolynomialParams, StartStop

NAMES = ("A", "B", "C", "D", "E")

_SHARED = {"L_p": 0.23, "T_ini": 1.5, "T_end": 1.5}
_WALK = {
    "A": dict(D_s=0.20, T_s=1.0, T_d=0.5, H_max=0.08, z_max=0.76, z_min=0.745),
    "B": dict(D_s=0.25, T_s=1.0, T_d=0.5, H_max=0.08, z_max=0.76, z_min=0.745),
    "C": dict(D_s=0.25, T_s=1.2, T_d=0.6, H_max=0.10, z_max=0.76, z_min=0.745),
    "D": dict(D_s=0.25, T_s=1.0, T_d=0.8, H_max=0.10, z_max=0.76, z_min=0.745),
    "E": dict(D_s=0.30, T_s=1.2, T_d=0.6, H_max=0.10, z_max=0.75, z_min=0.735),
}
_PELVIS = {
    "A": dict(x_s=0.05714677, x_e=0.00787201, y_d=0.03503420, y_m=-0.01117363),
    "B": dict(x_s=0.06399234, x_e=0.01828208, y_d=0.03224603, y_m=-0.01557302),
    "C": dict(x_s=0.05489436, x_e=0.01020970, y_d=0.02504919, y_m=-0.02198462),
    "D": dict(x_s=0.03705560, x_e=-0.00167847, y_d=0.01422000, y_m=-0.01772774),
    "E": dict(x_s=0.06069399, x_e=0.02025347, y_d=0.02439497, y_m=-0.02229836),
}
_ENDS = ("x_s_first", "x_e_first", "x_s_second", "x_e_penultimate", "x_s_last", "x_e_last", "x_rest_end")
_START_STOP = {
    "A": (0.02159945, 0.01722579, 0.05251790, 0.00467487, 0.06265522, -0.02752391, -0.02868811),
    "B": (0.02131137, 0.02948883, 0.05744252, 0.01526754, 0.06943094, -0.02747336, -0.02865045),
    "C": (0.02315675, 0.02103726, 0.04944727, 0.00590476, 0.06153745, -0.02856672, -0.03076265),
    "D": (0.02175248, 0.00763493, 0.03213057, -0.00602021, 0.04304452, -0.02832791, -0.02899334),
    "E": (0.02439083, 0.03000338, 0.05499650, 0.01737805, 0.06587446, -0.03083305, -0.03260401),
}
_SPEED = {
    "A": (-0.00463218, 0.00945566),
    "B": (-0.00456650, 0.00893056),
    "C": (-0.00254543, 0.00883173),
    "D": (-0.01135168, 0.00115861),
    "E": (-0.00328605, 0.00844630),
}


def numbers(name: str) -> dict[str, Any]:
    """Parameters of a gait as plain numbers, `start_stop` as a dict."""
    v_first, v_last = _SPEED[name]
    ends = dict(zip(_ENDS, _START_STOP[name], strict=True))
    start_stop = {"x_rest_start": -0.0308, **ends, "v_first": v_first, "v_last": v_last}
    return {**_WALK[name], **_PELVIS[name], **_SHARED, "start_stop": start_stop}


def params(name: str, **changes: Any) -> PolynomialParams:
    """Parameters of a gait, some of them changed, those of its `StartStop` too."""
    plain = numbers(name)
    for key, value in changes.items():
        owner = plain["start_stop"] if key in plain["start_stop"] else plain
        owner[key] = value
    return PolynomialParams(**{**plain, "start_stop": StartStop(**plain["start_stop"])})

"""What names on the command line stand for: gaits, simulations, arms of adaptation."""

import tomllib
from pathlib import Path
from typing import Any

from jaxbiped import adapt, planner, robot, sim
from jaxbiped.adapt import tunables
from jaxbiped.commands.common import InputError

GAITS = {"polynomial": planner.PolynomialGait, "cosine": planner.CosineGait}
OWN_GAIT = {"elkahlout": "cosine"}
"""The gait of each robot's own paper, where it is not the polynomial one."""
MOST_STEPS = 200
OFF, PAPER, ORIGINAL, MODIFIED, REPAIRED = "off", "paper", "original", "modified", "repaired"
LANDINGS = (OFF, PAPER, REPAIRED)
REFLEXES = (OFF, ORIGINAL, MODIFIED, REPAIRED)


def own_gait(params: robot.RobotParams) -> str:
    """Name of the gait of the robot's own paper."""
    return OWN_GAIT.get(params.name, "polynomial")


def make_gait(params: robot.RobotParams, name: str, steps: int) -> Any:
    """The preset gait of a robot."""
    if name not in GAITS:
        raise InputError(f"--gait: got '{name}', allowed: {', '.join(GAITS)}")
    if not 1 <= steps <= MOST_STEPS:
        raise InputError(f"--steps: got {steps}, allowed: 1 to {MOST_STEPS}")
    try:
        return GAITS[name].preset(params, steps)
    except planner.GaitError as error:
        raise InputError(f"--robot, --gait: {error}") from None


def simulation_options(params: robot.RobotParams, gait: Any) -> sim.Options:
    """The thesis' own walk by its own means: no feed-forward, control every tick, trunk with load by Eqs. 3.8-3.10."""
    thesis = params.name == "elkahlout" and isinstance(gait, planner.CosineGait)
    return sim.Options(
        control_every=1 if thesis else 4,
        feed_forward=not thesis,
        payload_model="thesis" if thesis else "exact",
    )


def clock_start(gait: Any) -> float:
    """When the clock of loading times starts, since the start of the walk [s].

    The thesis' time begins T_ini after the start of a cosine gait.
    """
    return float(gait.params.T_ini) if isinstance(gait, planner.CosineGait) else 0.0


def landing_of(name: str, **parameters: Any) -> adapt.Landing | None:
    """Parameters of the landing stage by the name of its arm."""
    return None if name == OFF else getattr(adapt.Landing, name)(**parameters)


def reflex_of(
    name: str, params: robot.RobotParams, gait: Any, **parameters: Any
) -> adapt.PayloadReflex | None:
    """Parameters of the payload stage by the name of its arm."""
    return None if name == OFF else getattr(adapt.PayloadReflex, name)(params, gait, **parameters)


def arm_tables(argument: str, path: Path) -> dict[str, dict[str, Any]]:
    """The tables [landing], [payload] and [gait] of the TOML file of an arm, those that it has.

    The first two have `base`, the name of an arm, and any of the parameters of that stage; the last one parameters of
    the gait. Other tables, as of where the numbers came from, are not read.

    Raises:
        InputError: if the file cannot be read or lacks what it must have.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{argument}: got '{path}' ({error}), allowed: a TOML file of an arm") from None
    bases = {"landing": LANDINGS, "payload": REFLEXES}
    tables = {name: data[name] for name in (*bases, "gait") if name in data}
    if not tables:
        raise InputError(
            f"{argument}: got '{path}', allowed: a file with a table [landing], [payload] or [gait]"
        )
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise InputError(f"{argument}: got {name} = {table!r} in '{path}', allowed: a table [{name}]")
        if name in bases and table.get("base") not in bases[name]:
            raise InputError(
                f"{argument}: got base {table.get('base')!r} of [{name}] in '{path}', allowed: "
                f"{', '.join(bases[name])}"
            )
    return tables


def load_arm(argument: str, path: Path, params: robot.RobotParams, gait: Any) -> adapt.Controller:
    """A controller from the TOML file of an arm; stages that have no table are off.

    Raises:
        InputError: if the file cannot be read or says what cannot be meant.
    """
    tables = arm_tables(argument, path)
    landing, payload = ({"base": OFF, **tables.get(name, {})} for name in ("landing", "payload"))
    try:
        gait = _other_gait(tables.get("gait", {}), params, gait)
        return adapt.Controller(
            gait,
            landing=landing_of(landing.pop("base"), **landing),
            payload=reflex_of(payload.pop("base"), params, gait, **payload),
        )
    except (TypeError, ValueError) as error:
        raise InputError(f"{argument}: '{path}': {error}") from None


def _other_gait(table: dict[str, Any], params: robot.RobotParams, gait: Any) -> Any:
    """The gait with the values of a table [gait]."""
    allowed = tunables.gait_fields(gait)
    for name, value in table.items():
        if name not in allowed or not isinstance(value, int | float):
            raise ValueError(f"[gait]: got {name} = {value!r}, allowed: numbers for {', '.join(allowed)}")
    return tunables.other_gait(params, gait, {name: float(value) for name, value in table.items()})

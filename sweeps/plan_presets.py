"""Find the numbers of the gait presets again: the largest least ZMP margin of a walk, as khadiv section 2.2 proposes.

Friction, joint torque and speed, and a least bend of the knees are constraints. Sequential linear programming inside a
trust region, with the derivatives of `planner.feasibility`, from a plain first guess that knows nothing of the presets.
Then every preset beside what was found, and what each takes of its robot. Needs SciPy (of the extra `dev`).

    python sweeps/plan_presets.py
    python sweeps/plan_presets.py --robot surena3 --gait cosine
    python sweeps/plan_presets.py --steps 0            # only what the presets take
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import jaxbiped.runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linprog

import jaxbiped as jb
from jaxbiped.adapt.tunables import other_gait
from jaxbiped.planner import GAITS, CosineGait, PolynomialGait, known_infeasible

SAMPLES = 600
"""Instants of a walk that are looked at."""
RADIUS, SMALLEST_RADIUS = 0.02, 2e-6
"""How far a number may move in a step, at first and at last [m, m/s]."""
PENALTY = 10.0
"""What a broken constraint costs in margin [m], by the share of its limit."""
TAKEN = ("ZMP margin [mm]", "knee bend [deg]", "friction", "torque [% of limit]", "speed [% of limit]")


@dataclass(frozen=True)
class Case:
    """A preset whose numbers are to be found."""

    robot: str
    kind: Any
    walk: int
    """Number of steps of the walk that is looked at."""
    knee_deg: float
    """Least bend of the knees."""
    guess: Mapping[str, float]
    """The numbers that are found, and from where."""
    finds: bool = True
    """Whether they are found; otherwise the preset is only judged."""

    @property
    def title(self) -> str:
        """Robot and gait."""
        return f"{self.robot}, {self.kind.__name__}, {self.walk} steps"


def polynomial_guess(D_s: float, L_p: float) -> dict[str, float]:
    """The pelvis goes from D_s / 4 behind to D_s / 4 ahead of the stance foot, L_p / 4 beside it, and rests over it."""
    behind = ("x_s_first", "x_s_second", "x_s_last")
    ahead = ("x_e_first", "x_e_penultimate", "x_e_last")
    return {
        "x_s": D_s / 4,
        "x_e": D_s / 4,
        "y_d": L_p / 4,
        "y_m": 0.0,
        **{f"start_stop.{name}": D_s / 4 for name in (*behind, *ahead)},
        **{f"start_stop.{name}": 0.0 for name in ("x_rest_start", "x_rest_end", "v_first", "v_last")},
    }


CASES = (
    Case("surena3", PolynomialGait, 6, 20.0, polynomial_guess(0.25, 0.23)),
    Case("elkahlout", PolynomialGait, 6, 40.0, polynomial_guess(0.22, 0.22)),
    Case("surena3", CosineGait, 4, 40.0, {"w": 0.115, "x_ref": 0.0}),
    Case("elkahlout", CosineGait, 4, 40.0, {"w": 0.11, "x_ref": 0.0}, finds=False),  # the thesis' own
)


def rows_of(case: Case, gait: Any) -> Callable[[Any], tuple[Any, Any]]:
    """Numbers -> margins [m] (SAMPLES,) and how much is left of the other limits, as a share of them (SAMPLES, 5)."""
    robot = jb.robot.load(case.robot)
    times, bend = jb.planner.sample_times(gait, SAMPLES), np.radians(case.knee_deg)

    @jb.runtime.jit
    def rows(numbers: Any) -> tuple[Any, Any]:
        planned = other_gait(robot, gait, dict(zip(case.guess, numbers, strict=True)))
        judged = jb.planner.feasibility(robot, planned, times)
        left = [
            1.0 - judged.friction / jb.planner.FRICTION,
            1.0 - judged.torque_share,
            1.0 - judged.speed_share,
        ]
        return judged.zmp_margin, jnp.stack([*(judged.knee / bend - 1.0).T, *left], axis=1)

    return rows


def with_derivatives(rows: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The same with the derivatives by the numbers."""

    @jb.runtime.jit
    def both(numbers: Any) -> Any:
        units = jnp.eye(len(numbers))
        return jax.vmap(lambda unit: jax.jvp(rows, (numbers,), (unit,)), out_axes=((None, None), -1))(units)

    return both


def merit(margin: Any, left: Any) -> float:
    """The least margin, less what broken constraints cost [m]."""
    return float(np.min(margin) + PENALTY * min(0.0, float(np.min(left))))


def step(numbers: np.ndarray, rows: Any, radius: float) -> np.ndarray:
    """The best move inside the trust region, were margins and constraints linear.

    Unknown are the moves, the least margin, which is to be largest, and by how much the constraints are broken.
    """
    (margin, left), (by_margin, by_left) = jax.tree.map(np.asarray, rows)
    n, m, k = len(numbers), margin.size, left.size
    rise = [-by_margin.reshape(m, n), np.ones((m, 1)), np.zeros((m, 1))]
    keep = [-by_left.reshape(k, n), np.zeros((k, 1)), -np.ones((k, 1))]
    found = linprog(
        c=[*np.zeros(n), -1.0, PENALTY],
        A_ub=np.block([rise, keep]),
        b_ub=np.concatenate([margin, left.ravel()]),
        bounds=[*[(-radius, radius)] * n, (None, None), (0.0, None)],
    )
    return found.x[:n]


def optimize(case: Case, rows: Any, steps: int) -> np.ndarray:
    """Numbers with the largest least margin, from the guess."""
    numbers, radius = np.array(list(case.guess.values())), RADIUS
    now = rows(numbers)
    for i in range(steps):
        move = step(numbers, now, radius)
        then = rows(numbers + move)
        if merit(*then[0]) > merit(*now[0]):
            numbers, now, radius = numbers + move, then, 1.5 * radius
        else:
            radius *= 0.4
        if i % 5 == 0:
            print(f"  step {i:3d}: {1e3 * merit(*now[0]):9.3f} mm, radius {1e3 * radius:.4f} mm", flush=True)
        if radius < SMALLEST_RADIUS:
            break
    return numbers


def taken(case: Case, rows: Any, numbers: np.ndarray) -> list[float]:
    """What a plan takes, worst over the walk, in the order and units of TAKEN."""
    margin, left = rows(numbers)[0]
    *knees, friction, torque, speed = np.asarray(left).min(axis=0)
    knee, mu = case.knee_deg * (1.0 + min(knees)), jb.planner.FRICTION * (1.0 - friction)
    return [1e3 * float(margin.min()), knee, mu, 100.0 * (1.0 - torque), 100.0 * (1.0 - speed)]


def tell(case: Case, gait: Any, steps: int) -> None:
    """The preset and, if there is anything to find, what is found, beside each other."""
    robot, rows = jb.robot.load(case.robot), with_derivatives(rows_of(case, gait))
    columns = {"preset": np.array([float(attrgetter(name)(gait.params)) for name in case.guess])}
    if case.finds and steps:
        columns["found"] = optimize(case, rows, steps)
    print(f"{'':32s}" + "".join(f"{name:>12s}" for name in columns))
    for name, row in zip(case.guess, np.transpose(list(columns.values())), strict=True):
        print(f"{name:32s}" + "".join(f"{value:12.5f}" for value in row))
    of_each = [taken(case, rows, numbers) for numbers in columns.values()]
    for name, row in zip(TAKEN, np.transpose(of_each), strict=True):
        print(f"{name:32s}" + "".join(f"{value:12.3f}" for value in row))
    for name, numbers in columns.items():
        new = dict(zip(case.guess, numbers, strict=True))
        planned = other_gait(robot, gait, new, allow_infeasible=True)
        for violation in jb.planner.violations(robot, planned):
            print(f"{name}: {violation.words(robot, planned)}")
    why = known_infeasible(case.kind, robot)
    print(f"known of this preset: {why}\n" if why else "", flush=True)


def main() -> None:
    """Optimise, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", choices=jb.robot.presets(), help="only this robot")
    parser.add_argument("--gait", choices=list(GAITS), help="only this gait")
    parser.add_argument("--steps", type=int, default=80, help="of the optimization, at most; 0: none")
    arguments = parser.parse_args()
    for case in CASES:
        if arguments.robot in (None, case.robot) and arguments.gait in (None, case.kind.name):
            print(case.title, flush=True)
            gait = case.kind.preset(jb.robot.load(case.robot), case.walk, allow_infeasible=True)
            tell(case, gait, arguments.steps)


if __name__ == "__main__":
    with jax.enable_x64(True):
        main()

"""surena3 over courses it does not know of: no adaptation, the paper's landing and the repaired one.

Ten steps. A course says how high the ground is under which footholds; each foot has a lane of its own:

    pads    a pad or hole under each of them as `Scenario.with_obstacle` puts it: from 115 mm behind the heel, since
            a foot that touches early lands short, to 20 mm beyond the toe, and 20 mm wider than the sole
    levels  platforms and staircases: the same ahead and behind, without gaps from foothold to foothold of a lane,
            and from the middle line to 0.3 m beside it; one lane changes its height 0.25 m after the other
    toes    the first and the last step are so short (0.25 m; the sole is 0.265 m long) that the foot comes down where
            its toes stood before: a pad that begins 10 mm beyond them carries toes only, and a pad under step 7
            reaches 35 mm under the heel of the last, step 9

    python sweeps/courses.py --out runs/courses
    python sweeps/courses.py --only khadiv 'platform*' --variants paper repaired --c
"""

import argparse
import csv
import time
from fnmatch import fnmatch
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import jaxbiped.runtime  # isort: skip  (before JAX is imported: it sets what XLA reads then)

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

import jaxbiped as jb

STEPS, PADDED, MOST = 10, 4, 9
"""Steps of the walk, the one with a single pad, and the highest such pad [cm]."""
BEHIND, BEYOND, LANE = 0.115, 0.02, 0.3
"""How far levels reach behind a heel, beyond a toe and to the side [m]."""
STANDS_FOR = 0.5
"""How long a walk is watched after its end [s]."""
VARIANTS = {"none": None, "paper": jb.adapt.Landing.paper(), "repaired": jb.adapt.Landing.repaired()}
SIMULATORS = {"compliant": "compliant", "C MuJoCo": "c_mujoco"}
"""By name, `Options.contact`."""
FORCES = (800.0, 3200.0)
"""Ends of the color scale [N]; the robot weighs 804 N."""
Row = dict[str, Any]


class Course(NamedTuple):
    """The ground of one walk."""

    name: str
    """Numbered with # if it is one of a set."""
    heights: dict[int, float]
    """Height of the ground under a step's foothold [cm]; 0 under all others."""
    kind: str = "pads"
    """`pads`, `levels` or `toes`."""


class Setup(NamedTuple):
    """The robot, its gait, and the duration of a walk [s]."""

    robot: jb.robot.RobotParams
    gait: jb.planner.PolynomialGait
    duration: float


def courses() -> list[Course]:
    """All courses; the first is khadiv's experiment (section 4), as the demonstration walks it."""
    return [
        Course("khadiv +3 +2 +4 cm", {2: 3, 4: 2, 6: 4}),
        *(Course(f"single {s * cm:+d} cm", {PADDED: s * cm}) for s in (1, -1) for cm in range(1, MOST + 1)),
        *(Course(f"two in a row {cm:+d} cm", {4: cm, 5: cm}) for cm in (3, 5, -3, -5)),
        Course("in a row +3 -3 +2 cm", {3: 3, 4: -3, 5: 2}),
        *(Course(f"first full step {cm:+d} cm", {1: cm}) for cm in (3, -3)),
        *(Course(f"last full step {cm:+d} cm", {STEPS - 2: cm}) for cm in (3, -3)),
        *(Course(f"platform {cm:+d} cm", _platform(cm), "levels") for cm in (2, 3, 4, 5, -2, -3, -4, -5)),
        *(Course(f"staircase 4 x {cm:+d} cm", _staircase(cm), "levels") for cm in (2, 3, 4, -2, -3, -4)),
        *_random(2),
        *_random(3),
        *(Course(f"toes of first step {cm:+d} cm", {0: cm}, "toes") for cm in (1, 2, 3)),
        *(Course(f"toes of last step {cm:+d} cm", {STEPS - 1: cm}, "toes") for cm in (1, 2, 3)),
        Course("hole beyond reach -15 cm", {PADDED: -15}),
    ]


def _platform(height: float) -> dict[int, float]:
    """Both feet stand on it twice."""
    return dict.fromkeys(range(2, 6), height)


def _staircase(rise: float) -> dict[int, float]:
    """Four stairs, one a step, and on at the height of the last."""
    return {step: rise * min(step - 1, 4) for step in range(2, STEPS)}


def _random(height: float, n: int = 12, share: float = 0.6) -> list[Course]:
    """A pad or a hole under that share of the full steps."""
    rng = np.random.default_rng(1)
    chosen, up = rng.random((n, STEPS)) < share, rng.random((n, STEPS)) < 0.5
    heights = np.where(up, height, -height)
    return [
        Course(
            f"random +-{height:g} cm #{i}",
            {step: float(heights[i, step]) for step in range(1, STEPS - 1) if chosen[i, step]},
        )
        for i in range(n)
    ]


# The walks -------------------------------------------------------------------------------------------------------


def setup() -> Setup:
    """surena3 and its preset gait."""
    robot = jb.robot.load("surena3")
    gait = jb.planner.PolynomialGait.preset(robot, STEPS)
    return Setup(robot, gait, float(gait.duration) + STANDS_FOR)


def scenarios(one: Setup, chosen: list[Course]) -> list[jb.sim.Scenario]:
    """Every course as level rectangles."""
    timing = one.gait.timing
    instants = jnp.array([0.0, *(float(timing.touchdown(step)) for step in range(STEPS))])
    sole = np.asarray(jax.vmap(lambda t: jb.planner.at(one.gait, t).position.sole)(instants))
    feet = (timing.first_swing + np.arange(STEPS)) % 2
    corner = np.asarray(one.robot.p_sole_corner)
    heel = sole[1 + np.arange(STEPS), feet, 0] + corner[feet, :, 0].min(axis=1)
    toe = sole[:, :, 0] + corner[:, :, 0].max(axis=1)  # of both feet at the start and after every step

    def rectangle(course: Course, step: int) -> tuple[tuple[float, float], tuple[float, float]]:
        foot, end = feet[step], toe[step + 1, feet[step]] + BEYOND
        start = heel[step] - BEHIND
        if course.kind == "toes":
            start = toe[step, foot] + 0.01
        elif step + 2 in course.heights:
            end = heel[step + 2] - BEHIND
        side = (0.0, LANE) if sole[step, foot, 1] > 0.0 else (-LANE, 0.0)
        return (float(start), side[0]), (float(end), side[1])

    def scenario(course: Course) -> jb.sim.Scenario:
        world = jb.sim.Scenario.flat(rectangles=STEPS)
        for step, height in course.heights.items():
            if course.kind == "pads":
                world = world.with_obstacle(one.robot, one.gait, step, 0.01 * height)
            else:
                world = world.with_rectangle(*rectangle(course, step), 0.01 * height)
        return world

    return [scenario(course) for course in chosen]


def walk_all(one: Setup, variant: str, chosen: list[Course], simulator: str) -> list[Row]:
    """Walk all courses at once in one of the simulators."""
    controller = jb.adapt.Controller(one.gait, VARIANTS[variant])
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenarios(one, chosen))
    simulation = jb.sim.prepare(one.robot, controller, jb.sim.Options(contact=SIMULATORS[simulator]))
    done = jax.tree.map(np.asarray, simulation.run_many(batch, one.duration))
    lanes = [jax.tree.map(lambda leaf, i=i: leaf[i], done) for i in range(len(chosen))]
    rows = [
        _row(course, variant, simulator, lane.statistics, _missed(lane))
        for course, lane in zip(chosen, lanes, strict=True)
    ]
    return rows


def _missed(walk: jb.sim.Walk) -> Any:
    landing = None if walk.controller is None else walk.controller.stages.get("landing")
    return jnp.zeros((), jnp.int32) if landing is None else landing.missed


def _row(course: Course, variant: str, simulator: str, stats: jb.sim.Statistics, missed: Any) -> Row:
    roll, pitch = np.degrees(np.asarray(stats.peak_roll_pitch))
    return {
        "course": course.name,
        "variant": variant,
        "simulator": simulator,
        "status": jb.sim.STATUS_TEXT[int(stats.status)],
        "end_time_s": round(float(stats.end_time), 3),
        "peak_foot_force_N": round(float(np.max(stats.peak_foot_force)), 1),
        "peak_roll_deg": round(float(roll), 3),
        "peak_pitch_deg": round(float(pitch), 3),
        "peak_slip_mm": round(1e3 * float(np.max(stats.peak_slip)), 2),
        "out_of_reach_s": round(float(stats.out_of_reach_time), 3),
        "missed": int(missed),
    }


# What comes out --------------------------------------------------------------------------------------------------


def in_words(row: Row) -> str:
    """One walk in a few words."""
    tilt, slip = max(row["peak_roll_deg"], row["peak_pitch_deg"]), row["peak_slip_mm"]
    if row["status"] == "ok":
        return f"{row['peak_foot_force_N']:5,.0f} N {tilt:4.1f} deg {slip:3.0f} mm"
    return f"{row['status']} at {row['end_time_s']:.1f} s" + f", missed {row['missed']}" * (row["missed"] > 0)


def summary(rows: list[Row]) -> str:
    """The same course, or a set of courses, in a few words."""
    if len(rows) == 1:
        return in_words(rows[0])
    ok = [row for row in rows if row["status"] == "ok"]
    return f"{len(ok)} of {len(rows)} walk" + (f", <= {_worst(ok):,.0f} N" if ok else "")


def _worst(rows: list[Row]) -> float:
    return max(row["peak_foot_force_N"] for row in rows)


def grouped(rows: list[Row]) -> dict[str, dict[str, list[Row]]]:
    """Rows by course, sets of courses together, then by variant."""
    groups: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        groups.setdefault(row["course"].split(" #")[0], {}).setdefault(row["variant"], []).append(row)
    return groups


def print_table(rows: list[Row]) -> None:
    """One line for every course: peak foot force, tilt and slip, or when it fell."""
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    print(f"{'':26s}" + "".join(f"{variant:26s}" for variant in variants))
    for name, by_variant in grouped(rows).items():
        print(f"{name:26s}" + "".join(f"{summary(by_variant[variant]):26s}" for variant in variants))


def print_limits(rows: list[Row]) -> None:
    """How high and how deep single pads may be, by centimetres up to the first fall."""
    walked = {(row["variant"], row["course"]) for row in rows if row["status"] == "ok"}

    def most(variant: str, sign: int) -> int:
        names = ((variant, f"single {sign * cm:+d} cm") for cm in range(1, MOST + 1))
        return len(list(takewhile(walked.__contains__, names)))

    for variant in dict.fromkeys(row["variant"] for row in rows):
        print(
            f"{variant} walks over single pads of up to {most(variant, 1)} cm and holes of up to {most(variant, -1)} cm"
        )


def print_agreement(rows: list[Row]) -> None:
    """Verdict and force of both simulators, for the walks that were done in both."""
    walks: dict[tuple[str, str], dict[str, Row]] = {}
    for row in rows:
        walks.setdefault((row["variant"], row["course"]), {})[row["simulator"]] = row
    both = {key: walk for key, walk in walks.items() if len(walk) == 2}
    agree = {key: len({row["status"] for row in walk.values()}) == 1 for key, walk in both.items()}
    print(f"\n{'variant':10s}{'course':26s}{'compliant ground':26s}{'C MuJoCo':26s}")
    for (variant, course), walk in both.items():
        words = [f"{in_words(walk[simulator]):26s}" for simulator in ("compliant", "C MuJoCo")]
        print(f"{variant:10s}{course:26s}" + "".join(words) + ("" if agree[variant, course] else "DIFFER"))
    print(f"verdicts agree in {sum(agree.values())} of {len(agree)} walks")


def draw(rows: list[Row], file: Path) -> None:
    """Survival and peak foot force of every course and variant; single pads on the left, ordered by height."""
    groups = grouped(rows)
    singles = sorted(
        (name for name in groups if name.startswith("single ")), key=lambda name: -int(name.split()[1])
    )
    panels = [names for names in (singles, [name for name in groups if name not in singles]) if names]
    height = 1.6 + 0.27 * max(len(names) for names in panels)
    figure = Figure(figsize=(6.2 * len(panels), height), layout="constrained")
    for axes, names in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw_panel(axes, {name: groups[name] for name in names})
    figure.suptitle("surena3 over unknown ground: peak force on either foot, or when it falls (weight 804 N)")
    figure.savefig(file, dpi=120)


def _draw_panel(axes: Axes, groups: dict[str, dict[str, list[Row]]]) -> None:
    variants, colors, scale = list(next(iter(groups.values()))), colormaps["YlOrRd"], LogNorm(*FORCES)
    for y, by_variant in enumerate(groups.values()):
        for x, variant in enumerate(variants):
            rows = by_variant[variant]
            ok = [row for row in rows if row["status"] == "ok"]
            text = f"{_worst(ok):,.0f} N" if ok else f"falls at {rows[0]['end_time_s']:.1f} s"
            if len(rows) > 1:
                text = f"{len(ok)} of {len(rows)}" + (f", {text}" if ok else "")
            all_ok = len(ok) == len(rows)
            face = colors(0.8 * float(scale(_worst(ok)))) if all_ok else "#9a9a9a" if ok else "#4d4d4d"
            axes.barh(y, 0.96, 0.92, x - 0.48, color=face)
            axes.text(x, y, text, ha="center", va="center", fontsize=8, color="k" if all_ok else "w")
    axes.set(xlim=(-0.5, len(variants) - 0.5), ylim=(len(groups) - 0.5, -0.5))
    axes.set_xticks(range(len(variants)), variants)
    axes.set_yticks(range(len(groups)), list(groups), fontsize=8)
    axes.tick_params(length=0, top=True, labeltop=True, bottom=False, labelbottom=False)
    axes.spines[:].set_visible(False)


def write(rows: list[Row], file: Path) -> None:
    """One line for every walk."""
    with file.open("w", newline="", encoding="utf-8") as out:
        table = csv.DictWriter(out, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


def main() -> None:
    """Walk, print, write and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/courses"))
    parser.add_argument("--only", nargs="+", default=["*"], help="names of courses, with * for anything")
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--c", action="store_true", help="in C MuJoCo too: some 5 s a walk")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    chosen = [c for c in courses() if any(fnmatch(c.name, pattern) for pattern in arguments.only)]
    if not chosen:
        parser.error(f"--only: got {arguments.only}, allowed: {', '.join(c.name for c in courses())}")
    one, rows = setup(), []
    for variant in arguments.variants:
        start = time.perf_counter()
        rows += walk_all(one, variant, chosen, "compliant")
        print(f"{variant}: {len(chosen)} walks in {time.perf_counter() - start:.0f} s, compilation included")
    print_table(rows)
    print_limits(rows)
    draw(rows, arguments.out / "courses.png")
    if arguments.c:
        native = [row for variant in arguments.variants for row in walk_all(one, variant, chosen, "C MuJoCo")]
        print_agreement(rows + native)
        rows += native
    write(rows, arguments.out / "courses.csv")
    print(f"courses.csv and courses.png in {arguments.out}")


if __name__ == "__main__":
    main()

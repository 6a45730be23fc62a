"""Landing adaptation carries surena3 over whole courses; they are those of sweeps/courses.py."""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbiped.planner import at
from jaxbiped.sim import ground

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "sweeps"))
import courses  # type: ignore[import-not-found]

pytestmark = pytest.mark.slow

MOST_FORCE = 1700.0
"""On either foot [N]; the robot weighs 804 N."""
SINGLES = tuple(f"single {cm:+d} cm" for cm in (3, 5, -3, -5))
KHADIV, HOLE = "khadiv +3 +2 +4 cm", "hole beyond reach -15 cm"
SURVIVED = (
    KHADIV,
    *SINGLES,
    *(f"{place} full step {cm:+d} cm" for place in ("first", "last") for cm in (3, -3)),
    *(f"platform {cm:+d} cm" for cm in (5, -5)),
    "staircase 4 x +2 cm",
    *(f"random +-2 cm #{i}" for i in range(12)),
)
Rows = dict[tuple[str, str], dict[str, Any]]


@pytest.fixture(scope="module")
def rows() -> Rows:
    """One batch a variant, of the same shape."""
    one = courses.setup()
    chosen = [course for course in courses.courses() if course.name in (*SURVIVED, HOLE)]
    assert len(chosen) == len(SURVIVED) + 1
    walked = [
        row for variant in courses.VARIANTS for row in courses.walk_all(one, variant, chosen, "compliant")
    ]
    return {(row["variant"], row["course"]): row for row in walked}


@pytest.mark.parametrize("course", SURVIVED)
def test_repaired_landing_survives_with_bounded_force(rows: Rows, course: str):
    row = rows["repaired", course]
    assert row["status"] == "ok"
    assert row["peak_foot_force_N"] < MOST_FORCE
    assert row["missed"] == 0


@pytest.mark.parametrize("course", SINGLES)
def test_paper_hits_the_ground_at_least_twice_as_hard(rows: Rows, course: str):
    paper, repaired = (rows[variant, course]["peak_foot_force_N"] for variant in ("paper", "repaired"))
    assert paper >= 2.0 * repaired


def test_without_adaptation_the_papers_experiment_ends_in_a_fall(rows: Rows):
    assert rows["none", KHADIV]["status"] == "fell"


def test_ground_beyond_reach_is_counted_and_ends_in_a_fall(rows: Rows):
    assert rows["repaired", HOLE]["missed"] >= 1
    for variant in courses.VARIANTS:
        row = rows[variant, HOLE]
        assert row["status"] == "fell"
        assert all(np.isfinite(value) for value in row.values() if isinstance(value, (int, float)))


def test_courses_lie_under_their_footholds():
    """All corners of every foothold stand at the stated height, but for pads that carry toes or reach the last heel."""
    one = courses.setup()
    timing, corner = one.gait.timing, one.robot.p_sole_corner[..., :2]
    instants = jnp.array([0.0, *(timing.touchdown(step) for step in range(courses.STEPS))])
    corners = jax.vmap(lambda t: at(one.gait, t).position.sole)(instants)[:, :, None, :2] + corner
    swings = [0, *((timing.first_swing + np.arange(courses.STEPS)) % 2)]
    chosen = [course for course in courses.courses() if course.kind != "toes"]
    for course, scenario in zip(chosen, courses.scenarios(one, chosen), strict=True):
        found = np.asarray(ground.height(scenario.terrain, corners))
        np.testing.assert_allclose(found[0], 0.0, atol=1e-6, err_msg=course.name)
        steps = range(courses.STEPS - (courses.STEPS - 3 in course.heights))
        under = [found[1 + step, swings[1 + step]] for step in steps]
        wanted = [[0.01 * course.heights.get(step, 0.0)] * 4 for step in steps]
        np.testing.assert_allclose(under, wanted, atol=1e-6, err_msg=course.name)

"""Changing a number never compiles anew."""

import equinox as eqx
import jax
import numpy as np
import pytest
import surena3_gaits

from jaxbiped import robot
from jaxbiped.planner import (
    CosineGait,
    PolynomialGait,
    at,
    feasibility,
    sample_times,
    violations,
)

_at = jax.jit(lambda gait, times: jax.vmap(lambda t: at(gait, t))(times))
TRUNK_UP = np.where(np.arange(len(robot.LINK_NAMES)) == 0, 1.1, 1.0)
CASES = {
    "polynomial": (PolynomialGait, "surena3", lambda: surena3_gaits.params("C")),
    "cosine": (CosineGait, "elkahlout", lambda: CosineGait.preset_params("elkahlout")),
}


@pytest.mark.parametrize("case", CASES)
def test_no_parameter_of_gait_or_robot_recompiles(case, compilations):
    kind, name, params = CASES[case]
    biped = robot.load(name)

    def everything(biped, params):
        gait = kind.make(biped, params, 8, allow_infeasible=True)
        violations(biped, gait)  # as `make` does where it is not told to allow them
        times = sample_times(gait, 150)
        return jax.block_until_ready((feasibility(biped, gait, times).zmp, _at(gait, times).position.pelvis))

    leaves, structure = jax.tree.flatten(params())
    changed = [
        structure.unflatten([*leaves[:i], leaf + 1e-3, *leaves[i + 1 :]]) for i, leaf in enumerate(leaves)
    ]
    leaning = eqx.tree_at(lambda b: b.links.com, biped, biped.links.com + 0.01)
    heavier = eqx.tree_at(lambda b: b.links.mass, biped, biped.links.mass * TRUNK_UP)
    zmp, _ = everything(biped, params())
    warm = len(compilations)
    moved = [everything(biped, other)[0] for other in changed]
    moved += [everything(other, params())[0] for other in (leaning, heavier)]
    assert len(compilations) == warm
    effect = [np.abs(np.asarray(other) - np.asarray(zmp)).max() for other in moved]
    assert np.all(effect)
    assert min(effect[-2:]) > 1e-3
    gait = kind.make(biped, params(), 8, allow_infeasible=True)
    _at(gait, sample_times(gait, 149))
    assert len(compilations) > warm  # the listener listens


def test_one_program_judges_every_gait_of_every_robot(compilations):
    """Another number of steps, kind of gait or robot compiles what plans, not what judges."""

    def judge(kind, name, n_steps):
        biped = robot.load(name)
        gait = kind.preset(biped, n_steps)
        jax.block_until_ready(_at(gait, sample_times(gait, 10)))
        before = len(compilations)
        violations(biped, gait)
        return len(compilations) - before

    judge(PolynomialGait, "surena3", 2)
    others = [(CosineGait, "surena3", 2), (PolynomialGait, "elkahlout", 3), (CosineGait, "elkahlout", 1)]
    assert [judge(*other) for other in others] == [0, 0, 0]

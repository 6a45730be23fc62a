"""Statistics of whole walks against NumPy, which goes through what C MuJoCo saw tick by tick."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import setup

from jaxbiped.adapt import Controller
from jaxbiped.planner import support
from jaxbiped.sim import Options, Scenario, lockstep, prepare
from jaxbiped.sim.options import C_MUJOCO
from jaxbiped.sim.physics.c_mujoco import Fields, Robots
from jaxbiped.sim.record import FORCE_FILTER
from jaxbiped.sim.statistics import (
    AIRBORNE,
    AIRBORNE_TIME,
    FALL_HEIGHT,
    FALL_TILT,
    FELL,
    LOADED,
    NONFINITE,
    OK,
    TOUCHDOWN,
    TOUCHING,
)

OPTIONS = Options(dt=1e-3, control_every=5, feed_forward=False, contact=C_MUJOCO)
DURATION = 2.6


class Tally:
    """What is kept of one walk, by the definitions of `Statistics`, in plain NumPy."""

    def __init__(self) -> None:
        self.kept: dict[str, Any] = {
            "status": OK,
            "end_time": 0.0,
            "peak_roll_pitch": np.zeros(2),
            "peak_foot_force": np.zeros(2),
            "peak_slip": np.zeros(2),
            "peak_touchdown_force": np.zeros(2),
            "peak_touchdown_impulse": np.zeros(2),
            "zmp_margin": math.inf,
        }
        self.touched: list[float | None] = [None, None]
        self.anchor: list[np.ndarray] = []
        self.last: list[tuple[float, np.ndarray]] = []
        self.impulse, self.supported, self.zmp = [0.0, 0.0], 0.0, np.zeros(2)
        self.filtered = np.zeros((2, 2, 4))
        self.pelvis_height = 0.0

    def begin(self, seen: Fields) -> None:
        """From what the first tick saw."""
        self.pelvis_height = seen["p_world_trunk"][2] - seen["p_world_foot"][:, 2].min()
        self.anchor = [place[:2] for place in seen["p_world_foot"]]
        self.last = [(math.inf, place[:2]) for place in seen["p_world_foot"]]
        self.kept["status"] = OK

    def tick(self, seen: Fields, time: float, dt: float) -> None:
        """After a tick that ended at `time`."""
        force, kept = seen["force"][..., 2].sum(axis=1), self.kept
        for foot in range(2):
            self._foot(foot, float(force[foot]), seen["p_world_foot"][foot, :2], time, dt)
        rotation = seen["rot_world_trunk"]
        roll, pitch = math.atan2(rotation[2, 1], rotation[2, 2]), -math.asin(rotation[2, 0])
        tilt = np.abs([roll, pitch])
        kept["peak_roll_pitch"] = np.maximum(kept["peak_roll_pitch"], tilt)
        kept["peak_foot_force"] = np.maximum(kept["peak_foot_force"], force)
        if force.sum() > TOUCHING:
            self.supported = time
        height = seen["p_world_trunk"][2] - seen["p_world_foot"][:, 2].min()
        if not (np.isfinite(seen["p_world_trunk"]).all() and np.isfinite(force).all()):
            kept["status"] = NONFINITE
        elif tilt.max() > FALL_TILT or height < FALL_HEIGHT * self.pelvis_height:
            kept["status"] = FELL
        elif time - self.supported > AIRBORNE_TIME + 1e-9:
            kept["status"] = AIRBORNE
        kept["end_time"] = time
        gain = dt / (FORCE_FILTER + dt)
        self.filtered[0] += gain * (seen["force"][..., 2] - self.filtered[0])
        self.filtered[1] += gain * (self.filtered[0] - self.filtered[1])

    def _foot(self, foot: int, force: float, place: np.ndarray, time: float, dt: float) -> None:
        before, where = self.last[foot]
        loaded, was = force > LOADED, before > LOADED
        reached = place
        if loaded != was and math.isfinite(before):
            share = (LOADED - before) / (force - before)
            crossing = where + share * (place - where)
            if loaded:
                self.touched[foot], self.anchor[foot], self.impulse[foot] = (
                    time - dt * (1 - share),
                    crossing,
                    0.0,
                )
            else:
                reached = crossing
        start = self.touched[foot]
        if start is not None:
            within = max(min(time, start + TOUCHDOWN) - max(time - dt, start), 0.0)
            self.impulse[foot] += within * force
            if within > 0.0:
                self._peak("peak_touchdown_force", foot, force)
        self._peak("peak_touchdown_impulse", foot, self.impulse[foot])
        if loaded or was:
            self._peak("peak_slip", foot, float(np.hypot(*(reached - self.anchor[foot]))))
        self.last[foot] = force, place

    def _peak(self, name: str, foot: int, value: float) -> None:
        self.kept[name][foot] = max(self.kept[name][foot], value)

    def control_tick(self, seen: Fields) -> None:
        """After the last physics tick of a control tick."""
        weight, corner = seen["force"][..., 2].reshape(8), seen["p_world_corner"].reshape(8, 3)[:, :2]
        if weight.sum() > TOUCHING:
            self.zmp = weight @ corner / weight.sum()
        active = np.repeat(seen["force"][..., 2].sum(axis=1) > LOADED, 4)
        with jax.enable_x64(True):
            margin = float(support.margin(*map(jnp.asarray, (corner, active, self.zmp))))
        self.kept["zmp_margin"] = min(self.kept["zmp_margin"], margin)


@pytest.fixture(scope="module")
def walked() -> Any:
    """Walks in C MuJoCo, in float64, and what every tick of them saw."""
    seen: list[Fields] = []

    class Recorded(Robots):
        def control_tick(self, *arguments: Any) -> tuple[Fields, Fields]:
            moved, saw = super().control_tick(*arguments)
            seen.append(saw)
            return moved, saw

    with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
        patch.setattr(lockstep, "Robots", Recorded)
        one, flat = setup("elkahlout", n_steps=2), Scenario.flat(1)
        scenarios = [
            flat,
            flat.with_push((0.0, 900.0, 0.0), 0.05, 0.2),
            flat.with_push((0.0, 0.0, 5000.0), 0.02, 2.0),
            flat.with_payload(4.0, 1.2).with_friction(0.12),
        ]
        batch = jax.tree.map(lambda *leaves: np.stack(leaves), *scenarios)
        walks = prepare(one.params, Controller(one.gait), OPTIONS).run_many(batch, DURATION)
    return walks, seen


def test_every_kind_of_end_is_there(walked):
    walks, _ = walked
    assert walks.statistics.status.tolist() == [OK, FELL, AIRBORNE, OK]


@pytest.mark.parametrize("lane", range(4))
def test_they_are_those_of_numpy(walked, lane):
    walks, seen = walked
    tally = Tally()
    tally.begin({name: rows[lane, 0] for name, rows in seen[0].items()})
    number = 0
    for saw in seen:
        each = [{name: rows[lane, i] for name, rows in saw.items()} for i in range(OPTIONS.control_every)]
        for one in each:
            number += 1
            tally.tick(one, number * OPTIONS.dt, OPTIONS.dt)
            if tally.kept["status"] != OK:
                break
        tally.control_tick(each[-1])
        if tally.kept["status"] != OK:
            break
    stats = walks.statistics
    if tally.kept["status"] != OK:  # inside a control tick, whose other physics ticks must leave it as it is
        assert number % OPTIONS.control_every != 0
    last = {
        "touch_time": [-1.0 if touched is None else touched for touched in tally.touched],
        "anchor": tally.anchor,
        "touch_impulse": tally.impulse,
        "support_time": tally.supported,
    }
    for name, wanted in (tally.kept | last).items():
        got = np.asarray(getattr(stats, name))[lane]
        np.testing.assert_allclose(got, wanted, rtol=1e-7, atol=1e-8, err_msg=name)
    assert tally.kept["peak_touchdown_force"].max() > LOADED or lane in (1, 2)

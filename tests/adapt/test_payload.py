"""The payload stage: against the tick-by-tick transcription of the thesis, its golden numbers, and its own laws.

No loop is closed: forces and ZMP are what the history has them be, whatever the stage commands.
"""

import dataclasses
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from payload_transcription import (
    LAMBDA_FORCE,
    LAMBDA_ZMP,
    THESIS_TICK,
    Log,
    PayloadTranscription,
    ThesisGait,
    ThesisReflex,
)

from jaxbiped import robot
from jaxbiped.adapt import PayloadReflex, PayloadStage, Sensed, Signals
from jaxbiped.adapt.reflex import parameters
from jaxbiped.adapt.reflex.parameters import FORCE_TIME_CONSTANT, ZMP_TIME_CONSTANT
from jaxbiped.adapt.reflex.planned import HOLD, RECOVER, REFLEX, SETTLE, SHIFT, WALK, decided
from jaxbiped.planner import (
    DOUBLE_SUPPORT,
    PLANNED_STEP,
    RECOVERY_STEP,
    REFLEX_STEP,
    SINGLE_SUPPORT,
    CosineGait,
    PolynomialGait,
    at,
)

WEIGHT = 785.0
NOT_OPTIMISED = {"xla_backend_optimization_level": 0}
"""How to compile what runs once: faster to compile, slower to run."""
KINDS = {"cosine": CosineGait, "polynomial": PolynomialGait}
ROBOTS = ("elkahlout", "surena3")
VARIANTS = PayloadReflex.variants
SHARES = ((0.1, 0.2, 0.05, 0.05), (0.3, 0.0, 0.2, 0.1))
"""Of the force, at the corners of the soles."""


def reading(time, force, zmp):
    """What the payload stage reads: the clock, forces and ZMP."""
    return Sensed.nothing(
        time,
        corner_force=force * jnp.asarray(SHARES),
        zmp_world=jnp.stack([zmp + 7.0, 5.0 * zmp]),
        zmp_body=jnp.stack([zmp, 0.3 - zmp]),
    )


def bodies(task):
    """Left sole, right sole, pelvis."""
    return jnp.concatenate([task.sole, task.pelvis[None]])


def stacked(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


@dataclasses.dataclass
class Histories:
    """Readings of many walks, (walks, ticks)."""

    time: np.ndarray
    force: np.ndarray
    zmp: np.ndarray
    shaken: np.ndarray

    @classmethod
    def quiet(cls, time: np.ndarray) -> "Histories":
        nothing = np.zeros_like(time)
        return cls(time, nothing + WEIGHT, nothing, nothing.astype(bool))

    def change(self, walk: int, time: float, force: float = 0.0, zmp: float = 0.0) -> None:
        """Add to the force and set the ZMP from a time on."""
        later = self.time[walk] >= time
        self.force[walk, later] += force
        self.zmp[walk, later] = zmp


def _stepped(params, gait, readings, orders):
    def one(params, gait, readings):
        stage = PayloadStage.plan(params, gait)

        def tick(state, row):
            time, force, zmp, shaken = row
            signals = dataclasses.replace(Signals.none(), disturbed=shaken)
            sensed = reading(time, force, zmp)
            state, targets, _ = stage.step(state, gait, at(gait, time), sensed, signals)
            motion = [targets.position, targets.velocity, targets.acceleration][:orders]
            row = {
                "motion": jnp.stack([bodies(order) for order in motion]),
                "phase": targets.phase,
                "plan_time": targets.time,
                "mode": state.mode,
                "trigger_time": state.trigger_time,
                "reflexes": state.reflexes,
                "resume_time": state.resume_time,
                "next_step": state.next_step,
            }
            return state, row

        return jax.lax.scan(tick, stage.init(), readings)[1]

    return jax.vmap(one)(params, gait, readings)


_run = jax.jit(_stepped, static_argnums=3)
_run_once = jax.jit(_stepped, static_argnums=3, compiler_options=NOT_OPTIMISED)


def run(params, gaits, histories: Histories, orders: int = 1, compiled: Any = _run) -> Any:
    """Step one stage per walk; rows of (walks, ticks, ...)."""
    rows = [jnp.asarray(getattr(histories, f.name)) for f in dataclasses.fields(histories)]
    return jax.tree.map(np.asarray, compiled(stacked(params), stacked(gaits), tuple(rows), orders))


@cache
def preset(kind: str, name: str, n_steps: int, first_swing: int):
    with jax.enable_x64(True):
        return KINDS[kind].preset(robot.load(name), n_steps, first_swing)


@partial(jax.jit, compiler_options=NOT_OPTIMISED)
def _variants(biped, gait):
    return {variant: getattr(PayloadReflex, variant)(biped, gait, starts_again=True) for variant in VARIANTS}


@cache
def variants() -> dict[str, PayloadReflex]:
    """The named parameters, for the thesis' robot and gait."""
    with jax.enable_x64(True):
        return _variants(robot.load("elkahlout"), preset("cosine", "elkahlout", 3, 0))


def with_numbers(params: PayloadReflex, **numbers: float) -> PayloadReflex:
    new = [jnp.asarray(value, jnp.float64) for value in numbers.values()]
    return eqx.tree_at(lambda p: [getattr(p, name) for name in numbers], params, new)


# ---------------------------------------------------------------- the transcription

TICKS = 4000
N_STEPS = 3
WALKS = 100
OURS = {
    "threshold": "threshold",
    "slow_threshold": "slow_threshold",
    "slow_time_constant": "slow_time_constant",
    "rearm_time": "rearm_time",
    "t_refl_per": "reflex_time",
    "t_set_t": "settling_time",
    "t_x_ref_as": "shift_time",
    "zmp_balanced": "zmp_balanced",
    "gain": "x_ref_gain",
}
"""Our names for the transcription's parameters."""


def random_reflex(rng: np.random.Generator, modified: bool, dt: float) -> ThesisReflex:
    printed = dt == 0.005 and rng.random() < 0.4
    settling = (4.0 if modified else 2.0) if printed else rng.uniform(0.3, 1.5)
    return ThesisReflex(
        modified=modified,
        threshold=rng.choice([25.0, rng.uniform(15.0, 40.0)]),
        slow_threshold=rng.uniform(15.0, 30.0),
        slow_time_constant=rng.uniform(0.2, 1.2),
        rearm_time=rng.uniform(0.3, 2.5),
        t_refl_per=rng.choice([0.1, 0.2]),
        t_set_t=settling,
        t_x_ref_as=rng.choice([0.5, rng.uniform(0.2, 0.8)]),
        zmp_balanced=rng.uniform(-0.04, 0.0),
        gain=rng.choice([1.0, rng.uniform(0.3, 1.0)]),
    )


def random_histories(seed: int) -> tuple[list[ThesisReflex], Histories]:
    """Loads from start to end of the walk, most followed by another change; noise, impacts, and times of shaking."""
    rng = np.random.default_rng(seed)
    dt = np.where(np.arange(WALKS) % 4 == 0, 0.002, 0.005)
    histories = Histories.quiet(dt[:, None] * np.arange(TICKS))
    reflexes = []
    for i, time in enumerate(histories.time):
        p = random_reflex(rng, bool(i % 2), dt[i])
        force = histories.force[i]
        force += rng.normal(0.0, rng.choice([0.0, 3.0, 8.0]), TICKS)
        force += (rng.random(TICKS) < 1.5 * dt[i]) * rng.uniform(50.0, 250.0, TICKS)
        load_time = 0.15 + (i + rng.random()) / WALKS * (9.4 if dt[i] == 0.005 else 5.0)
        small = rng.random() < 0.08
        load = rng.uniform(5.0, 12.0) if small else rng.uniform(42.0, 150.0)
        histories.zmp[i] = p.zmp_balanced
        histories.change(i, load_time, load, rng.uniform(-0.05, 0.06))
        if rng.random() < 0.75 and not small:
            settled = load_time + 0.1 + p.t_refl_per + p.t_set_t
            after = rng.uniform(-0.4, p.t_x_ref_as + 1.0 + p.t_set_t / 2 + 2.0)
            change = rng.choice([-1, 1, 1]) * rng.uniform(30.0, 150.0)
            histories.change(i, settled + after, change, rng.uniform(-0.05, 0.06))
        histories.zmp[i] += rng.normal(0.0, 0.01, TICKS)
        if rng.random() < 0.3:
            for begin in rng.uniform(0.0, time[-1], 6):
                histories.shaken[i] |= (time > begin) & (time < begin + rng.uniform(0.1, 0.8))
        reflexes.append(p)
    return reflexes, histories


def ours_of(reflex: ThesisReflex) -> PayloadReflex:
    variant = "modified" if reflex.modified else "original"
    numbers = {ours: getattr(reflex, theirs) for theirs, ours in OURS.items()}
    constant = {
        f"{name}_time_constant": -THESIS_TICK / np.log1p(-share)
        for name, share in (("force", LAMBDA_FORCE), ("zmp", LAMBDA_ZMP))
    }
    return with_numbers(variants()[variant], **numbers, **constant)


@cache
def compared(first_swing: int):
    """Ours, and theirs: poses, modes and logs."""
    with jax.enable_x64(True):
        reflexes, histories = random_histories(20 + first_swing)
        gait = preset("cosine", "elkahlout", N_STEPS, first_swing)
        ours = run([ours_of(p) for p in reflexes], [gait] * WALKS, histories)
    gait = ThesisGait(N_STEPS, left_first=first_swing == 0)
    poses, modes, logs = np.empty((WALKS, TICKS, 6)), np.empty((WALKS, TICKS), int), []
    for i, p in enumerate(reflexes):
        theirs = PayloadTranscription(gait, p)
        rows = (getattr(histories, f.name)[i].tolist() for f in dataclasses.fields(histories))
        for j, row in enumerate(zip(*rows, strict=True)):
            poses[i, j] = theirs.tick(*row)
            modes[i, j] = theirs.mode
        logs.append(theirs.log)
    return histories, ours, poses, modes, logs


for_first_swings = pytest.mark.parametrize("first_swing", [0, pytest.param(1, marks=pytest.mark.slow)])
"""The mirror image is left to the slow tests."""


def overlooked(log: Log, dt: float) -> bool:
    """Whether something began between a tick that felt a load and the start of the reflex, less than a tick later."""
    return any(trigger - dt < kink < trigger for trigger in log.triggers for kink in log.kinks)


@for_first_swings
def test_feet_are_where_the_thesis_has_them(first_swing):
    """100 random histories each, at every tick; 0.1 um.

    The pose at the start of a reflex is a parabola about the tick before, exact but for the third derivative; if
    something begins in between, e.g. a lift-off, the parabola does not know of it.
    """
    histories, ours, poses, _, logs = compared(first_swing)
    body = ours["motion"][:, :, 0]
    feet = body[:, :, [1, 0]] - body[:, :, 2:]  # right, left
    error = np.abs(feet.swapaxes(2, 3).reshape(poses.shape) - poses).max(axis=(1, 2))
    for i, log in enumerate(logs):
        assert error[i] < (5e-5 if overlooked(log, histories.time[i, 1]) else 1e-7), (i, log)


@for_first_swings
def test_machine_is_the_thesis_machine(first_swing):
    """Modes at every tick, times of the triggers and of going on, and with which step; 1 us.

    A recovery step is as long as f has it, and f is a pose at the trigger, a parabola.
    """
    histories, ours, _, modes, logs = compared(first_swing)
    for i, log in enumerate(logs):
        time, atol = histories.time[i], 2e-4 if overlooked(log, histories.time[i, 1]) else 1e-6
        ends = time[:, None] - np.array([*log.kinks, -1.0])  # SETTLE and HOLD are left a tick before them
        at_a_tick = np.minimum(np.abs(ends), np.abs(ends + time[1] - time[0])).min(axis=1) < atol
        np.testing.assert_array_equal(ours["mode"][i][~at_a_tick], modes[i][~at_a_tick])
        assert at_a_tick.mean() < 0.01
        begin = np.flatnonzero(np.diff(ours["reflexes"][i]) > 0) + 1
        np.testing.assert_allclose(ours["trigger_time"][i][begin], log.triggers, rtol=0, atol=1e-9)
        go_on = np.flatnonzero((ours["mode"][i][1:] == WALK) & (ours["mode"][i][:-1] == HOLD)) + 1
        np.testing.assert_allclose(ours["resume_time"][i][go_on], log.resumes, rtol=0, atol=atol)
        np.testing.assert_array_equal(ours["next_step"][i][go_on], log.resume_steps)


@for_first_swings
def test_histories_reach_everything(first_swing):
    """Loads in every phase of the walk, seconds in every mode that listens, some felt by the slower filter only."""
    first, again, none = set(), set(), 0
    *_, logs = compared(first_swing)
    for log in logs:
        none += not log.triggers
        if log.triggers:
            tau, part = divmod(log.triggers[0] - 1.7, 2.4)
            phase = "double" if part >= 1.4 else "late" if part > 0.7 else "early"
            first.add((max(int(tau), -1), phase if tau >= 0 else "start"))
        again |= set(log.modes_triggered[1:])
    walked = {(k, phase) for k in range(N_STEPS) for phase in ("early", "late", "double")}
    assert first >= walked | {(-1, "start")}
    assert again == {WALK, SHIFT, RECOVER, HOLD}
    assert none >= 2


def test_low_passes_are_the_thesis_ones():
    for constant, share in ((FORCE_TIME_CONSTANT, LAMBDA_FORCE), (ZMP_TIME_CONSTANT, LAMBDA_ZMP)):
        assert -np.expm1(-THESIS_TICK / constant) == pytest.approx(share, rel=1e-5)


# ---------------------------------------------------------------- golden numbers


@cache
def golden():
    """The thesis' two printed cases: a force that crosses the threshold in the middle of a tick, a tick before them.

    As many walks as the random ones, and so with the same compiled kernel.
    """
    with jax.enable_x64(True):
        gait, dt = preset("cosine", "elkahlout", N_STEPS, 0), 0.0016
        T_ini, params = float(gait.params.T_ini), with_numbers(variants()["original"], threshold=25.0)
        histories = Histories.quiet(np.tile(dt * np.arange(TICKS), (WALKS, 1)))
        cases = []
        for i in range(WALKS):
            trigger, reflex_time = ((1.2305, 0.2), (1.2625, 0.1))[i % 2]
            before = int((T_ini + trigger) / dt - 1.5)
            histories.time[i] += T_ini + trigger - 1.5 * dt - histories.time[i, before]
            # the next tick goes twice as far as the threshold
            jump = 2.0 * 25.0 / -np.expm1(-dt / float(params.force_time_constant))
            histories.force[i, before + 1] += jump
            histories.force[i, before + 2 :] += 2.0 * 25.0
            cases.append(with_numbers(params, reflex_time=reflex_time))
        return T_ini, dt, histories.time, run(cases, [gait] * WALKS, histories)


@pytest.mark.parametrize(("case", "trigger", "recovery"), [(0, 1.2305, 0.883), (1, 1.2625, 0.9124)])
def test_recovery_takes_as_long_as_in_the_thesis(case, trigger, recovery):
    """Figure 3.8: 3.931 -> 4.814 s, f = 0.4033; the second by the equations (the text says 0.9230)."""
    T_ini, dt, time, rows = golden()
    time, mode, phase = time[case] - T_ini, rows["mode"][case], rows["phase"]
    assert rows["trigger_time"][case][-1] - T_ini == pytest.approx(trigger, abs=1e-9)
    assert rows["reflexes"][case][-1] == 1
    begin, end = (time[np.flatnonzero(mode == m)[0]] for m in (RECOVER, HOLD))
    shifted = trigger + (0.2, 0.1)[case] + 2.0 + 0.5
    assert shifted - 1e-9 <= begin < shifted + dt
    assert shifted + recovery - 5e-4 < end < shifted + recovery + dt + 5e-4
    aloft = (mode == RECOVER) & (phase.support[case] == SINGLE_SUPPORT)
    t_ss_a = phase.T_s[case][aloft][0]
    assert 2.4 / 1.4 * t_ss_a == pytest.approx(recovery, abs=5e-4)
    if case == 0:
        assert np.cos(np.pi * t_ss_a / 1.4) == pytest.approx(0.4033, abs=5e-5)


def test_defaults_are_the_thesis_ones(x64):
    original, modified = (variants()[variant] for variant in ("original", "modified"))
    assert float(original.settling_time) == 2.0
    assert float(modified.settling_time) == 4.0
    for variant in (original, modified):
        assert float(variant.reflex_time) == pytest.approx(0.1)
        assert float(variant.shift_time) == 0.5
        assert float(variant.x_ref_gain) == 1.0
        assert float(variant.zmp_balanced) == pytest.approx(-0.035, abs=0.01)
    for constant, share in ((FORCE_TIME_CONSTANT, LAMBDA_FORCE), (ZMP_TIME_CONSTANT, LAMBDA_ZMP)):
        assert -np.expm1(-THESIS_TICK / constant) == pytest.approx(share, rel=1e-5)


# ---------------------------------------------------------------- motion

DT = 0.005
MOTION_TICKS = 3900
MOTION_STEPS = 2
OFF = 0.37
"""Of a tick: no tick is at the very instant at which something begins."""
TRIGGERS = 32
"""Per robot."""
GROUPS = {"literal": ("original", "modified"), "repaired": ("repaired",), "two_speed": ("two_speed",)}
UNITS = [("literal", "polynomial", 1), ("repaired", "cosine", 1), ("repaired", "polynomial", 0)]
UNITS += [("two_speed", "cosine", 0)]
OTHERS = [("literal", "cosine", 0), ("literal", "cosine", 1)]
OTHERS += [(group, kind, 1 - first) for group, kind, first in UNITS]
REFLEX_TIME = {"literal": 0.1, "repaired": 0.6, "two_speed": 0.6}
"""The longer one where acceleration is asked for: a quintic of 0.1 s has 7 km/s3."""


def for_units(*groups: str):
    """Run a test for every unit of the groups; the slow tests have the other first foot, and the thesis' variants on
    its own gait, whose positions the transcription has."""
    fast = [unit for unit in UNITS if unit[0] in groups]
    slow = [pytest.param(*unit, marks=pytest.mark.slow) for unit in OTHERS if unit[0] in groups]
    return pytest.mark.parametrize(("group", "kind", "first_swing"), fast + slow)


@cache
def motions(group: str, kind: str, first_swing: int):
    """Loads at random times from the start of the walk to its end, on both robots."""
    rng = np.random.default_rng([*UNITS, *OTHERS].index((group, kind, first_swing)))
    with jax.enable_x64(True):
        params, gaits, times = [], [], []
        for name in ROBOTS:
            gait = preset(kind, name, MOTION_STEPS, first_swing)
            for i in range(TRIGGERS):
                variant = variants()[GROUPS[group][i % len(GROUPS[group])]]
                numbers = {"reflex_time": REFLEX_TIME[group], "settling_time": 1.0, "zmp_time_constant": 0.1}
                params.append(with_numbers(variant, **numbers))
                gaits.append(gait)
                times.append((i + rng.random()) / TRIGGERS * float(gait.duration))
        histories = Histories.quiet(np.tile(DT * (np.arange(MOTION_TICKS) + OFF), (len(times), 1)))
        for i, time in enumerate(times):
            histories.zmp[i] = float(params[i].zmp_balanced)
            histories.change(i, time, 100.0, rng.uniform(-0.05, 0.06))
        return run(params, gaits, histories, orders=3)


def within(change, begin, end, slack) -> np.ndarray:
    """Whether what changed by `change` in a tick can have done so at a rate between those at its ends."""
    low, high = DT * np.minimum(begin, end) - slack, DT * np.maximum(begin, end) + slack
    return (change >= low) & (change <= high)


@for_units("literal", "repaired", "two_speed")
def test_positions_do_not_jump(group, kind, first_swing):
    """Of all loads, both soles and the pelvis: no further in a tick than the commanded speeds at its ends have it.

    Also in the body frame. So does the time in the plan, by which the feed-forward goes.
    """
    rows = motions(group, kind, first_swing)
    assert np.all(rows["reflexes"][:, -1] == 1)
    assert np.all(rows["mode"][:, -1] == WALK)
    motion = rows["motion"]
    for frame in (motion, motion - motion[:, :, :, 2:]):
        p, v, a = np.moveaxis(frame, 2, 0)
        curved = DT**2 * np.maximum(np.abs(a[:, 1:]), np.abs(a[:, :-1]))
        fine = within(np.diff(p, axis=1), v[:, :-1], v[:, 1:], curved + 2e-7)
        assert fine.all(), [
            (int(i), rows["mode"][i, j], rows["mode"][i, j + 1]) for i, j in np.argwhere(~fine)[:, :2]
        ]
    mode, plan_time = rows["mode"], np.diff(rows["plan_time"], axis=1)
    fastest = np.where((mode[:, 1:] >= REFLEX) & (mode[:, 1:] <= SHIFT), 7.0 / REFLEX_TIME[group], 16.0)
    fastest[(mode[:, 1:] == WALK) & (mode[:, :-1] == WALK)] = 1.0
    assert np.all(np.abs(plan_time) <= DT * fastest + 1e-9)


@for_units("repaired", "two_speed")
def test_repaired_velocities_do_not_jump(group, kind, first_swing):
    """Nowhere but at the ends of the shift of x_ref, a ramp: there in two ticks, the first of which gets the mean."""
    rows = motions(group, kind, first_swing)
    _, v, a = np.moveaxis(rows["motion"], 2, 0)
    fine = within(np.diff(v, axis=1), a[:, :-1], a[:, 1:], 2e-3)
    mode = rows["mode"]
    begins, ends = ((mode[:, 1:] == m) & (mode[:, :-1] == m - 1) for m in (SHIFT, RECOVER))
    ramp = begins | np.roll(begins, 1, axis=1) | ends | np.roll(ends, -1, axis=1)
    fine[ramp, :, 0] = True
    assert fine.all(), [(int(i), mode[i, j], mode[i, j + 1]) for i, j in np.argwhere(~fine)[:, :2]]
    events = (mode[:, 1:] != mode[:, :-1]) & ((mode[:, 1:] == REFLEX) | (mode[:, 1:] == WALK))
    assert events.sum() == 2 * len(mode)
    # at the trigger, in the tick to come, not even acceleration: no more than in the ticks before and after
    i, j = np.nonzero(events & (mode[:, 1:] == REFLEX))
    jerk = np.abs(np.diff(a, axis=1))
    there, explained = np.maximum(jerk[i, j], jerk[i, j + 1]), jerk[i, j - 1] + jerk[i, j + 2]
    assert np.mean(there <= explained + 0.02) > 0.99  # a lift-off in that tick is a jump of the plan's own


@for_units("literal", "repaired", "two_speed")
def test_feet_on_the_ground_stand_still(group, kind, first_swing):
    """In the world: the stance foot always, both in double support; a foot that is up is a single support's.

    The reflex may move both feet that are down, and so may a recovery that has too little to make up for a step: in
    the repaired variant 0.1 mm.
    """
    rows = motions(group, kind, first_swing)
    sole, mode, phase = rows["motion"][:, :, 0, :2], rows["mode"], rows["phase"]
    same = (phase.swing[:, 1:] == phase.swing[:, :-1]) & (mode[:, 1:] == mode[:, :-1])
    moved = np.abs(np.diff(sole, axis=1)).max(axis=3)
    stance = np.take_along_axis(moved, 1 - phase.swing[:, 1:, None], axis=2)[:, :, 0]
    assert stance[same].max() < 1e-12
    both = same & (phase.support[:, 1:] == DOUBLE_SUPPORT) & (phase.support[:, :-1] == DOUBLE_SUPPORT)
    still = both & (mode[:, 1:] != REFLEX) & (mode[:, 1:] != RECOVER)
    assert moved[still].max() < 1e-12
    if group == "repaired":
        slid = np.where(both & (mode[:, 1:] == RECOVER), moved.max(axis=2), 0.0).sum(axis=1)
        assert slid.max() < 1.1e-4
    for m in (SETTLE, SHIFT, HOLD):
        assert np.all(phase.support[mode == m] == DOUBLE_SUPPORT)
    double = phase.support == DOUBLE_SUPPORT
    assert np.abs(sole[double][:, :, 2]).max() < 1e-12
    height = np.take_along_axis(sole[..., 2], phase.swing[:, :, None], axis=2)[:, :, 0]
    recovering = (mode == RECOVER) & ~double
    tau = phase.time_since_liftoff / phase.T_s
    clear = recovering & (tau > 0.2) & (tau < 0.8)
    assert clear.any()
    assert height[clear].min() > 1e-7, "single support without a lift"


@for_units("literal", "repaired", "two_speed")
def test_walk_goes_on_as_planned(group, kind, first_swing):
    """From the matching phase, the foot behind swinging first, to the end of the plan."""
    rows = motions(group, kind, first_swing)
    ahead, first_x = rows["motion"][..., 0, :2, 0], rows["motion"][:, 0, 0, :2, 0]
    mode, phase = rows["mode"], rows["phase"]
    again = (mode == WALK) & (rows["reflexes"] > 0)
    for i in range(len(mode)):
        begin = np.flatnonzero(again[i])[0]
        next_step = rows["next_step"][i, begin]
        aloft = np.flatnonzero(again[i] & (phase.support[i] == SINGLE_SUPPORT))
        assert len(aloft) > 0 or next_step == MOTION_STEPS
        if len(aloft) > 0:
            assert phase.step[i, aloft[0]] == next_step
            swing = phase.swing[i, aloft[0]]
            assert ahead[i, begin, swing] <= ahead[i, begin, 1 - swing] + 1e-9
            assert phase.kind[i, aloft[0]] == PLANNED_STEP
        assert rows["plan_time"][i, -1] >= rows["plan_time"][i, begin]
    assert np.all(ahead[:, -1].max(axis=1) > first_x.max(axis=1) - 0.02)


@for_units("literal", "repaired", "two_speed")
def test_no_step_is_left_out_or_made_twice(x64, group, kind, first_swing):
    """Felt on two feet: the plan's next step; felt on one: the next if the foot in the air is ahead, else this one."""
    rows = motions(group, kind, first_swing)
    for i in range(len(rows["mode"])):
        timing = preset(kind, ROBOTS[i // TRIGGERS], MOTION_STEPS, first_swing).timing
        trigger, j = rows["trigger_time"][i, -1], np.flatnonzero(rows["mode"][i] == REFLEX)[0]
        liftoff = float(timing.first_liftoff) + np.arange(MOTION_STEPS) * float(timing.T_c)
        since = trigger - np.stack([liftoff, liftoff + float(timing.T_s)])
        if np.abs(since).min() < DT:  # the tick may have known better
            continue
        begun, ended = (since > 0.0).sum(axis=1)
        x = rows["motion"][i, j - 1, 0, :2, 0]
        swing = (first_swing + begun + 1) % 2
        step = 0.25 if group == "two_speed" else 0.0  # `quick_step`
        passed = begun == ended or x[swing] + step > x[1 - swing]
        if group != "literal" or abs(x[0] - x[1]) > 0.025:  # no nearer than the reflex moves the feet
            assert rows["next_step"][i, -1] == (begun if passed else begun - 1)


@for_units("literal", "repaired", "two_speed")
def test_phase_tells_when_feet_move(group, kind, first_swing):
    """Begin, lift-off and end of the recovery step; landing adaptation goes by them."""
    rows = motions(group, kind, first_swing)
    mode, phase = rows["mode"], rows["phase"]
    np.testing.assert_array_equal(phase.kind == REFLEX_STEP, (mode == REFLEX) | (mode == SETTLE))
    tau = phase.time_since_liftoff
    same = (np.diff(phase.kind, axis=1) == 0) & (np.diff(phase.step, axis=1) == 0)
    np.testing.assert_allclose(np.diff(tau, axis=1)[same & (mode[:, 1:] != WALK)], DT, rtol=0, atol=1e-9)
    for i in range(len(mode)):
        recovering = np.flatnonzero(phase.kind[i] == RECOVERY_STEP)
        assert np.all(mode[i, recovering] >= SHIFT) or np.any(mode[i, recovering] == WALK)
        begin, end = recovering[0], recovering[-1]
        assert mode[i, begin] == SHIFT
        assert -DT <= tau[i, begin] - phase.begin[i, begin] < 0.0
        aloft = recovering[phase.support[i, recovering] == SINGLE_SUPPORT]
        if len(aloft) > 0:
            assert 0.0 <= tau[i, aloft[0]] < DT
            assert phase.T_s[i, aloft[-1]] - DT <= tau[i, aloft[-1]] < phase.T_s[i, aloft[-1]]
        if rows["next_step"][i, -1] < MOTION_STEPS:
            assert phase.T_c[i, end] - DT <= tau[i, end] < phase.T_c[i, end]
            assert phase.support[i, end + 1] == SINGLE_SUPPORT
        reflex = np.flatnonzero(phase.kind[i] == REFLEX_STEP)
        assert -DT <= tau[i, reflex[0]] < 0.0
        assert phase.T_c[i, reflex[-1]] - 2 * DT <= tau[i, reflex[-1]] < phase.T_c[i, reflex[-1]] - DT


def test_loads_come_in_every_phase():
    count = 0
    for unit in UNITS:
        rows = motions(*unit)
        mode, phase = rows["mode"], rows["phase"]
        i, j = np.nonzero((mode[:, 1:] == REFLEX) & (mode[:, :-1] == WALK))
        came = set(zip(phase.step[i, j], phase.support[i, j], strict=True))
        assert came == {(step, support) for step in range(MOTION_STEPS) for support in (0, 1)}
        count += len(i)
    assert count == 2 * TRIGGERS * len(UNITS)


# ---------------------------------------------------------------- a second payload

LOAD = 100.0
SECONDS = ((SHIFT, 80.0), (RECOVER, -LOAD), (RECOVER, 80.0), (HOLD, -LOAD), (WALK, 80.0), (WALK, -LOAD))
"""In which mode the second change comes, and what it is [N]."""


@eqx.filter_jit
def feet_of_plan(gait, times):
    def feet(t):
        task = gait.task(t)
        return task.sole - task.pelvis

    return jax.vmap(feet)(times)


def two_payloads(group: str, kind: str, names: tuple[str, ...], n_steps: int, first_swing: int, **shape):
    """A load, and another change of weight with another ZMP; both are read with hardly any low-pass."""
    rng = np.random.default_rng(6)
    walks, dt = shape["walks"], shape["dt"]
    histories = Histories.quiet(np.tile(dt * (np.arange(shape["ticks"]) + OFF), (walks, 1)))
    params, gaits, wanted = [], [], []
    numbers = {"threshold": 25.0, "slow_threshold": 25.0, "slow_time_constant": 0.2, "rearm_time": 1.0}
    numbers |= {"zmp_time_constant": 0.02, "reflex_time": 0.1, "settling_time": 1.2}
    for i in range(walks):
        gaits.append(preset(kind, names[i * len(names) // walks], n_steps, first_swing))
        numbers |= {"zmp_balanced": rng.uniform(-0.05, 0.0), "x_ref_gain": rng.choice([1.0, 0.6])}
        params.append(with_numbers(variants()[GROUPS[group][i % len(GROUPS[group])]], **numbers))
        histories.zmp[i] = numbers["zmp_balanced"]
        histories.change(i, rng.uniform(0.2, float(gaits[i].duration)), LOAD, rng.uniform(-0.05, 0.05))
    mode = run(params, gaits, histories, orders=shape["orders"])["mode"]
    for i in range(walks):
        m, change = SECONDS[i % len(SECONDS)]
        during = np.flatnonzero(mode[i] == m)
        if m == WALK:
            during = np.flatnonzero(mode[i] == HOLD)[-1] + np.arange(int(1.5 / dt))
        late = during[: -int(0.1 / dt)]  # it takes a little until it is felt
        balanced = float(params[i].zmp_balanced)
        zmp = rng.uniform(-0.05, 0.05) if change > 0.0 else balanced
        histories.change(i, histories.time[i, rng.choice(late)], change, zmp)
        wanted.append(float(params[i].x_ref_gain) * (zmp - balanced))
    return run(params, gaits, histories, orders=shape["orders"]), gaits, wanted


def check_two_payloads(rows, gaits, wanted) -> None:
    mode = rows["mode"]
    assert np.all(rows["reflexes"][:, -1] == 2)
    again = (mode[:, 1:] == REFLEX) & (mode[:, :-1] != REFLEX)
    assert {int(m) for m in mode[:, :-1][again]} == {WALK, SHIFT, RECOVER, HOLD}
    for i, gait in enumerate(gaits):
        assert mode[i, -1] == WALK
        order = mode[i, np.flatnonzero(np.diff(mode[i], prepend=-1))].tolist()
        assert order[-6:] == [REFLEX, SETTLE, SHIFT, RECOVER, HOLD, WALK]
        last = np.flatnonzero(mode[i] != WALK)[-1] + 1
        body = rows["motion"][i, last:, 0]
        feet = np.array(feet_of_plan(gait, jnp.asarray(rows["plan_time"][i])))[last:]
        feet[:, :, 0] += wanted[i]
        np.testing.assert_allclose(body[:, :2] - body[:, 2:], feet, atol=1e-9)
        before = rows["motion"][i, last - 1, 0]
        np.testing.assert_allclose(before[:2] - before[2:], feet[0], atol=2e-3)


def test_literal_variants_have_one_reflex_only(x64):
    """As the thesis' experiments; ours start again."""
    gait, dt = preset("cosine", "elkahlout", N_STEPS, 0), 0.005
    histories = Histories.quiet(dt * (np.arange(TICKS) + OFF)[None])
    histories.change(0, 1.7, LOAD, 0.0)
    histories.change(0, 0.8 * float(histories.time[0, -1]), LOAD, 0.0)
    biped = robot.load("elkahlout")
    for variant in VARIANTS:
        params = getattr(PayloadReflex, variant)(biped, gait)
        rows = run([params], [gait], histories, compiled=_run_once)
        assert rows["reflexes"][0, -1] == (2 if variant == "repaired" else 1)


def test_second_payload_counts_from_the_start(x64):
    """More, or taken off, during the recovery or after it: in the end x_ref is as if it had been so from the start."""
    shape = {"walks": WALKS, "ticks": TICKS, "dt": 0.005, "orders": 1}
    check_two_payloads(*two_payloads("literal", "cosine", ("elkahlout",), N_STEPS, 0, **shape))


@pytest.mark.parametrize("unit", [unit for unit in UNITS if unit[0] == "repaired"])
def test_second_payload_counts_from_the_start_repaired(x64, unit):
    shape = {"walks": 2 * TRIGGERS, "ticks": MOTION_TICKS, "dt": 0.008, "orders": 3}
    check_two_payloads(*two_payloads("repaired", unit[1], ROBOTS, MOTION_STEPS, unit[2], **shape))


def test_events_from_the_tick_that_saw_them(x64):
    """interpolate=False: reflex and walk begin with a tick."""
    gait = preset("cosine", "elkahlout", 1, 0)
    numbers = {"settling_time": 0.3, "threshold": 25.0}
    params = dataclasses.replace(with_numbers(variants()["original"], **numbers), interpolate=False)
    histories = Histories.quiet(0.005 * np.arange(600)[None])
    histories.change(0, 0.5, 60.0)
    rows = run([params], [gait], histories, compiled=_run_once)
    time, mode = histories.time[0], rows["mode"][0]
    begin, again = np.flatnonzero(mode == REFLEX)[0], np.flatnonzero(mode == HOLD)[-1] + 1
    assert rows["trigger_time"][0, begin] == time[begin]
    assert rows["resume_time"][0, again] == time[again]


# ---------------------------------------------------------------- what is refused


UNIT = {
    "threshold": "N",
    "slow_threshold": "N",
    "slow_time_constant": "s",
    "force_time_constant": "s",
    "zmp_time_constant": "s",
    "reflex_time": "s",
    "body_time": "s",
    "settling_time": "s",
    "shift_time": "s",
}
NOT_FINITE = [
    (name, value) for name in ("zmp_balanced", "x_stand", "x_ref_gain") for value in (np.nan, np.inf)
]


def reflex(**parameters) -> PayloadReflex:
    return PayloadReflex(**{"zmp_balanced": -0.035, **parameters})


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize("name", UNIT)
def test_what_cannot_be_meant_is_refused(name, value):
    unit = UNIT[name]
    with pytest.raises(
        ValueError, match=rf"^{name}: got {value:g} {unit}, allowed: > 0 and <= [0-9]+ {unit}$"
    ):
        reflex(**{name: jnp.asarray(value)})


@pytest.mark.parametrize(("name", "value"), NOT_FINITE)
def test_what_is_not_finite_is_refused(name, value):
    unit = "" if name == "x_ref_gain" else " m"
    with pytest.raises(
        ValueError, match=rf"^{name}: got {value:g}{unit}, allowed: >= -?[0-9.]+ and <= [0-9.]+{unit}$"
    ):
        reflex(**{name: value})


def test_a_table_that_cannot_be_meant_is_refused():
    table = [[0.0, 0.0], [0.0, float("nan")], [0.0, 0.0]]
    with pytest.raises(
        ValueError, match=r"^x_reflex: got nan m in place 2, 2, allowed: >= -0\.2 and <= 0\.2 m$"
    ):
        reflex(x_reflex=table)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("x_reflex", [[0.01, -0.01]], r"3 x 2 numbers \[m\]"),
        ("threshold", [40.0, 50.0], r"one number \[N\]"),
        ("slow_threshold", [40.0, 50.0], r"one number \[N\]"),
        ("reflex_time", [0.1], r"one number \[s\]"),
    ],
)
def test_a_wrong_shape_is_refused(monkeypatch, name, value, allowed):
    """As users meet it: without the tests' own checks of annotations."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match=rf"^{name}: got \[.*\], allowed: {allowed}$"):
        reflex(**{name: jnp.asarray(value)})


@pytest.mark.parametrize("value", [-1e-3, np.nan])
def test_rearming_takes_no_negative_time(value):
    with pytest.raises(
        ValueError, match=rf"^rearm_time: got {value:g} s, allowed: >= 0 and <= 600 s or infinite$"
    ):
        reflex(rearm_time=value)
    for fine in (0.0, np.inf):
        assert float(reflex(rearm_time=fine).rearm_time) == fine


def test_the_body_has_to_stand_when_the_zmp_is_read():
    times = {"reflex_time": 0.5, "settling_time": 0.5}
    message = r"^body_time: got 1.2 s, allowed: <= reflex_time \+ settling_time = 1 s$"
    with pytest.raises(ValueError, match=message):
        reflex(**times)
    reflex(**times, body_time=1.0)
    reflex(**times, smooth_reflex=False)


def test_unknown_values_are_not_judged():
    assert jax.jit(lambda time: reflex(rearm_time=time, threshold=-time).rearm_time)(-1.0) == -1.0


def test_a_given_threshold_spares_the_look_at_the_plan(x64, monkeypatch):
    monkeypatch.setattr(parameters, "planned_ripple", lambda *_: pytest.fail("looked"))
    biped, gait = robot.load("elkahlout"), preset("cosine", "elkahlout", 3, 0)
    given = {"threshold": 50.0, "zmp_balanced": -0.03, "x_stand": 0.0}
    for variant in VARIANTS:
        assert float(getattr(PayloadReflex, variant)(biped, gait, **given).threshold) == 50.0


# ---------------------------------------------------------------- at the edges


PULSES = {"fast again": 0.5, "slow for good": np.inf, "slow, and it stays": np.inf}
"""Time of rearming [s] of the walks that get a pulse."""


@cache
def edges():
    """Walks with a pulse after the recovery; and loads that come to the threshold but for some roundings.

    As many walks as the random ones, and so with the same compiled kernel.
    """
    with jax.enable_x64(True):
        gait, dt = preset("cosine", "elkahlout", N_STEPS, 0), 0.005
        base = with_numbers(variants()["original"], threshold=40.0, slow_threshold=40.0, settling_time=1.0)
        histories, load = Histories.quiet(np.tile(dt * np.arange(TICKS), (WALKS, 1))), 100.0
        edge = load * -np.expm1(-dt / float(base.force_time_constant))
        cases = [with_numbers(base, rearm_time=time) for time in PULSES.values()]
        for i in range(len(PULSES)):
            histories.change(i, 0.5, load)
            histories.change(i, 8.5, 300.0)
            if i < len(PULSES) - 1:
                histories.change(i, 8.6, -300.0)
        for i in range(len(PULSES), WALKS):
            threshold = edge + (i - WALKS // 2) * np.spacing(WEIGHT)
            cases.append(with_numbers(base, threshold=threshold, slow_threshold=1e3))
            histories.change(i, 3.0, load)
            histories.change(i, 3.0 + 0.5 * dt, -load)
        return run(cases, [gait] * WALKS, histories)


def test_rearming_may_take_for_ever():
    """Then only the slower low-pass decides, which a pulse does not move and a load that stays does."""
    rows = edges()
    found = dict(zip(PULSES, rows["reflexes"][: len(PULSES), -1], strict=True))
    assert found["fast again"] >= 2
    assert found["slow for good"] == 1
    assert found["slow, and it stays"] == 2
    for i in range(len(PULSES)):
        assert np.isfinite(rows["motion"][i]).all()
        assert np.flatnonzero(rows["mode"][i] == HOLD)[0] < 8.5 / 0.005 < TICKS


def test_a_load_at_the_threshold_is_felt_by_the_whole_record():
    """Or by nothing of it, whatever way the comparison is rounded."""
    rows = jax.tree.map(lambda leaf: leaf[len(PULSES) :], edges())
    felt = rows["reflexes"] > 0
    assert 0 < felt[:, -1].sum() < len(felt)
    begun = np.logical_or.accumulate(rows["mode"] == REFLEX, axis=1)
    np.testing.assert_array_equal(begun, felt)
    np.testing.assert_array_equal(rows["trigger_time"] > 0.0, felt)
    np.testing.assert_array_equal(rows["phase"].kind == REFLEX_STEP, np.isin(rows["mode"], (REFLEX, SETTLE)))


@pytest.mark.parametrize("lanes", [1, 100])
def test_the_decision_is_compiled_once(lanes):
    """What is fused into its uses is computed in each of them; a sort is not."""
    compiled = jax.jit(jax.vmap(decided)).lower(jnp.zeros(lanes, jnp.int32)).compile()
    text = compiled.as_text()
    assert text is not None
    assert " sort(" in text
    np.testing.assert_array_equal(compiled(jnp.arange(lanes) % 6), np.arange(lanes) % 6)


# ---------------------------------------------------------------- no payload


@eqx.filter_jit
def walk_of(params, gait, time, force):
    stage = PayloadStage.plan(params, gait)

    def tick(state, row):
        t, total = row
        sensed = reading(t, total, 0.01 * t)
        return stage.step(state, gait, at(gait, t), sensed, Signals.none())[:2]

    return jax.lax.scan(tick, stage.init(), (time, force))[1]


@eqx.filter_jit
def plan_of(gait, time):
    return jax.lax.scan(lambda nothing, t: (nothing, at(gait, t)), None, time)[1]


IDENTITIES = {
    ("cosine", "elkahlout"): ("original", "modified"),
    ("polynomial", "surena3"): ("repaired",),
}
"""Variants of the fast tests; the slow ones have the others."""


@pytest.mark.parametrize(
    ("kind", "name", "variant"),
    [
        pytest.param(*plan, variant, marks=() if variant in fast else pytest.mark.slow)
        for plan, fast in IDENTITIES.items()
        for variant in VARIANTS
    ],
)
def test_without_payload_the_stage_is_the_plan(kind, name, variant):
    """To the last bit, in float32, for a force that is constant or fluctuates by 12 N."""
    gait = KINDS[kind].preset(robot.load(name), MOTION_STEPS)
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), variants()[variant])
    time = jnp.linspace(0.0, float(gait.duration) + 0.5, 1500)
    noise = np.random.default_rng(3).uniform(-12.0, 12.0, 1500)
    noise[0] = 0.0
    plan = plan_of(gait, time)
    for force in (np.zeros(1500), noise):
        ours = walk_of(params, gait, time, jnp.asarray(WEIGHT + force, jnp.float32))
        jax.tree.map(np.testing.assert_array_equal, ours, plan)

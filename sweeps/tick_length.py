"""How long may a physics tick be, and do both backends say the same? The same random walks in all of these ways.

The scenarios are those of `agreement.py`: pads and holes, loads, friction, masses off by up to 10 %, pushes. A control
tick stays at 2 ms. A walk near an edge changes its verdict with anything that is changed: how many do so by rounding
alone is shown beside it, by walks with every mass off by 1e-6. Where C and XLA do not agree, the walk is named, and
how many of NUDGES more walks in C change their verdict by such a nudge: with none, the backends would differ.

    python sweeps/tick_length.py --json runs/tick_length.json
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import agreement
import equinox as eqx
import jax
import numpy as np

from jaxbiped import checked, files, runtime
from jaxbiped.batch.summary import wilson
from jaxbiped.checked import Refusal
from jaxbiped.sim import STATUS_TEXT, Options, Scenario, prepare
from jaxbiped.sim.options import DAMPING, LINEAR, XLA, C

CONTROL_DT = 2e-3
VARIANTS = {"surena3": "both-repaired", "elkahlout": "payload-repaired"}
"""What is walked by each robot, by its name in `agreement`."""
SHORTEST = "0.25 ms"
NUDGED = f"{SHORTEST}, nudged"
USUAL, BY_XLA = "0.5 ms", "0.5 ms, XLA"
NUDGE, NUDGES = 1e-6, 20
"""How far masses are off in nudged walks, as a share, and how many such walks there are where backends differ."""


class Tick(NamedTuple):
    """A way of ticking."""

    dt: float
    """[s]"""
    implicit: str = DAMPING
    backend: str = C

    @property
    def options(self) -> Options:
        """Options of the simulation."""
        every = round(CONTROL_DT / self.dt)
        return Options(dt=self.dt, implicit=self.implicit, control_every=every, backend=self.backend)


TICKS = {
    SHORTEST: Tick(2.5e-4),
    USUAL: Tick(5e-4),
    BY_XLA: Tick(5e-4, backend=XLA),
    "1 ms": Tick(1e-3),
    "2 ms": Tick(2e-3),
    "2 ms, linear": Tick(2e-3, LINEAR),
}


def measure(name: str, n: int, seed: int) -> dict[str, Any]:
    """Everything of one robot."""
    params, controller, _ = agreement.set_up(name, VARIANTS[name])
    batch = agreement.stacked([agreement.drawn(params, controller.gait, (seed, i)) for i in range(n)])

    def walk(label: str, tick: Tick, scenarios: Scenario) -> agreement.Columns:
        began = time.monotonic()
        walks = prepare(params, controller, tick.options).run_many(scenarios, agreement.DURATION)
        found = agreement.columns(walks)
        print(f"{name}, {label}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
        return found

    found = {label: walk(label, tick, batch) for label, tick in TICKS.items()}
    found[NUDGED] = walk(NUDGED, TICKS[SHORTEST], nudged(batch, seed))
    differ = np.flatnonzero(found[USUAL]["status"] != found[BY_XLA]["status"]).tolist()
    rows = [i for i in differ for _ in range(NUDGES)]
    named = []
    if rows:
        again = nudged(jax.tree.map(lambda leaf: leaf[np.array(rows)], batch), seed)
        status = walk("nudged where backends differ", TICKS[USUAL], again)["status"].reshape(-1, NUDGES)
        for number, own in zip(differ, status, strict=True):
            scenario = jax.tree.map(lambda leaf, i=number: leaf[i], batch)
            changed = int((own != found[USUAL]["status"][number]).sum())
            row = {"number": number, "changed_by_a_nudge": changed, "scenario": agreement.described(scenario)}
            named.append(
                row | {label: STATUS_TEXT[int(found[label]["status"][number])] for label in (USUAL, BY_XLA)}
            )
    return {"ticks": compare(found), "backends_differ": named}


def nudged(batch: Scenario, seed: int) -> Scenario:
    """The same with all masses off by a nudge, up or down at random."""
    own = batch.errors.mass_scale
    factor = np.random.default_rng(seed).choice([1.0 - NUDGE, 1.0 + NUDGE], own.shape)
    return eqx.tree_at(lambda s: s.errors.mass_scale, batch, (own * factor).astype(own.dtype))


def compare(found: Mapping[str, agreement.Columns]) -> dict[str, Any]:
    """Every tick against the shortest."""
    best, said = found[SHORTEST], {}
    for label, own in found.items():
        same = own["status"] == best["status"]
        both = same & (own["status"] == 0)
        apart = {
            "force_percent": 100.0 * (own["force_N"][both] / best["force_N"][both] - 1.0),
            "tilt_deg": own["tilt_deg"][both] - best["tilt_deg"][both],
        }
        said[label] = {
            "agree": int(same.sum()),
            "n": len(same),
            "interval": list(wilson(int(same.sum()), len(same))),
            "survived": int((own["status"] == 0).sum()),
            "both_walk": int(both.sum()),
            **{what: quantiles(values) for what, values in apart.items()},
        }
    return said


def quantiles(values: np.ndarray) -> dict[str, float]:
    """Median, and median and 90th percentile of how far off."""
    return {
        "median": float(np.median(values)),
        "median_off": float(np.median(np.abs(values))),
        "p90_off": float(np.quantile(np.abs(values), 0.9)),
    }


def show(name: str, said: Mapping[str, Any]) -> None:
    """Print a table, and the walks in which backends differ."""
    print(f"\n{name}, {VARIANTS[name]}, against ticks of {SHORTEST}")
    print(
        "| tick | same verdict | survived | peak force: shift, off (median, 90 %) | tilt off (median, 90 %) |"
    )
    print("|---|---:|---:|---:|---:|")
    for label, one in said["ticks"].items():
        force, tilt = one["force_percent"], one["tilt_deg"]
        print(
            f"| {label} | {one['agree']} of {one['n']}, {100.0 * one['agree'] / one['n']:.1f} % | {one['survived']} | "
            f"{force['median']:+.2f} %; {force['median_off']:.2f}, {force['p90_off']:.1f} % | "
            f"{tilt['median_off']:.2f}, {tilt['p90_off']:.2f} deg |"
        )
    differ, n = said["backends_differ"], said["ticks"][USUAL]["n"]
    print(f"C and XLA give the same verdict in {n - len(differ)} of {n}")
    for row in differ:
        print(
            f"  number {row['number']}: {row[USUAL]} in C, {row[BY_XLA]} by XLA; {row['changed_by_a_nudge']} of "
            f"{NUDGES} change by a nudge of {NUDGE:g}: {json.dumps(row['scenario'])}"
        )


def main() -> None:
    """Parse the command line, walk and compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robot", choices=list(VARIANTS), nargs="+", default=list(VARIANTS))
    parser.add_argument("--n", type=int, default=500, help="scenarios of each robot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="file for all numbers")
    given = parser.parse_args()
    try:
        checked.whole("--n", given.n, 1, 100_000)
        checked.whole("--seed", given.seed, 0, 2**31)
    except Refusal as error:
        sys.exit(str(error))
    runtime.keep_compiled_kernels()
    said = {}
    for name in given.robot:
        said[name] = measure(name, given.n, given.seed)
        show(name, said[name])
    if given.json is not None:
        given.json.parent.mkdir(parents=True, exist_ok=True)
        files.write(given.json, json.dumps({"n": given.n, "seed": given.seed, "robots": said}, indent=1))


if __name__ == "__main__":
    main()

"""Experiments: a robot, variants of adaptation, and scenarios; every variant meets every scenario."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import InitVar, dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
import polars as pl

from jaxbiped.adapt import Controller, Outcome
from jaxbiped.batch import inputs, records
from jaxbiped.batch.columns import outcomes
from jaxbiped.checked import Refusal, Word, refuse_unknown, whole
from jaxbiped.robot import RobotParams, on_device
from jaxbiped.score import watch_time
from jaxbiped.sim import Options
from jaxbiped.sim.compile import backend
from jaxbiped.sim.options import AUTO, DURATION, SCALAR, XLA, C
from jaxbiped.sim.scenario import pad_under, require_clear_start, require_swing_clears
from jaxbiped.sim.stability import require_stable_dt

MAX_BATCH = 65536
MAX_LANES = {XLA: 128, C: 256, SCALAR: 65_536}
"""By backend, most walks at once where nobody says otherwise: more are no faster on a core, or hardly, and hardly on a
GPU, which scalars are for."""
MAX_TURNS, MIN_CHUNKS = 4, 32
"""Most scenarios that a lane takes one after the other, and fewest chunks of a variant at that."""
PAGES = Word(("overview", "payload", "obstacles"), "what is drawn of the results, see `report.pages`")
RULES = Word(("papers",), "success by elkahlout's rule where the weight changes suddenly, else by khadiv's")


_KINDS = {"robot": RobotParams, "variants": Mapping, "scenarios": pl.DataFrame, "options": Options}
"""Types of the parts of an experiment."""


@dataclass(frozen=True)
class Experiment:
    """A robot, named controllers for it, and the scenarios all of them meet (paired).

    Raises:
        ValueError: naming what was got and what is allowed.
    """

    robot: RobotParams
    """The robot as the planner knows it; kept in JAX\'s default float, in which it is walked and written."""
    variants: Mapping[str, Controller]
    """Controllers by name. Pads lie under the footholds of the first one's gait."""
    scenarios: pl.DataFrame
    """One row for each scenario, see `inputs`; from `grid`, `draw` or by hand."""
    options: Options = field(default_factory=Options)
    """Options of the simulation; noise and delay are switched on where a scenario has some."""
    duration: float | Mapping[str, float] | None = None
    """Simulated time of all walks, or by variant [s]; None: as long as each needs, see `durations`."""
    seed: int | np.integer = 0
    """Seed of the sensors' noise."""
    batch: int | np.integer | None = None
    """Walks at once; None: up to MAX_LANES of the backend."""
    robot_file: str = ""
    """File that the robot was read from; empty if it is a preset, or in no file. Only for experiment files."""
    pages: tuple[str, ...] = ("overview",)
    """Names of PAGES that `jaxbiped run` draws; they decide nothing else."""

    judge: InitVar[bool] = True
    """Whether obstacles that nobody can walk over are refused; not where an experiment was run before."""

    def __post_init__(self, judge: bool) -> None:
        """Refuse what cannot be simulated."""
        self._require_kinds()
        object.__setattr__(self, "robot", on_device(self.robot))
        object.__setattr__(self, "duration", self._checked_duration())
        for page in self.pages:
            PAGES.check("pages", page)
        if self.batch is not None:
            object.__setattr__(self, "batch", whole("batch", self.batch, 1, MAX_BATCH))
        object.__setattr__(self, "seed", whole("seed", self.seed, 0, 2**31 - 1))
        if self.options.trace_every:
            raise ValueError(
                f"trace_every: got {self.options.trace_every}, allowed: 0; replay a row for its trace"
            )
        inputs.require_apart(self.table, self.pads)
        if judge:
            sinkage, gains = (self.table[name].to_numpy() for name in ("sinkage_m", "gain_scale"))
            least, strongest = float(np.min(sinkage)), float(np.max(gains))
            require_stable_dt(self.robot, self.options.dt, least, strongest, self.options.implicit)
        for name, variant in self.variants.items() if judge else ():
            self._require_walkable(name, variant)

    def _require_kinds(self) -> None:
        """Check that the parts are of their kinds, and the variants have names."""
        for name, kind in _KINDS.items():
            if not isinstance(getattr(self, name), kind):
                raise ValueError(
                    f"{name}: got a {type(getattr(self, name)).__name__}, allowed: a {kind.__name__}"
                )
        if not self.variants:
            raise ValueError("variants: got none, allowed: at least one")
        for name in self.variants:
            if not isinstance(name, str) or not name or not name.isprintable():
                raise ValueError(f"variants: got the name {name!r}, allowed: a text on one line")
            if not isinstance(self.variants[name], Controller):
                raise ValueError(
                    f"variants: got a {type(self.variants[name]).__name__} as '{name}', allowed: a Controller"
                )

    def _checked_duration(self) -> float | dict[str, float] | None:
        """Simulated time of the walks [s], every number within its range."""
        given = self.duration
        if given is None or not isinstance(given, Mapping):
            return None if given is None else DURATION.check("duration", given)
        refuse_unknown("duration.", given, self.variants)
        missing = [name for name in self.variants if name not in given]
        if missing:
            raise ValueError(f"duration.{missing[0]}: missing, allowed: {DURATION.allowed}")
        return {name: DURATION.check(f"duration.{name}", given[name]) for name in self.variants}

    def _require_walkable(self, name: str, variant: Controller) -> None:
        """Refuse obstacles that the swing foot runs into, or that it stands in at the start."""
        highest = {step: float(self.table[inputs.height_column(step)].max()) for step in self.steps}  # type: ignore[arg-type]
        own = {step: height for step, height in highest.items() if step < int(variant.gait.timing.n_steps)}
        try:
            require_swing_clears(variant.gait, own)
            require_clear_start(self.robot, variant.gait, inputs.terrain_extremes(self.table, self.pads))
        except Refusal as error:
            raise ValueError(f"scenarios, variant '{name}': {error}") from None

    @property
    def steps(self) -> list[int]:
        """Steps that have a column with the height under their foothold."""
        return inputs.steps_of(self.table.columns)

    @cached_property
    def table(self) -> pl.DataFrame:
        """The scenarios with every input."""
        return inputs.complete(self.scenarios, int(self.seed))

    @cached_property
    def pads(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Smallest and largest corner of the pad under every step that has a column."""
        first = next(iter(self.variants.values()))
        return [pad_under(self.robot, first.gait, step) for step in self.steps]

    @cached_property
    def simulation(self) -> Options:
        """The options, with room for what the scenarios bring; the backend by the walks that share a program."""
        given, delay = self.options, float(np.max(self.table["delay_s"].to_numpy()))
        noise = bool((self.table["force_noise_N"] > 0.0).any() or (self.table["angle_noise_rad"] > 0.0).any())
        room = max(given.delay_room, int(np.ceil(delay / given.control_dt - 1e-9)))
        options = replace(given, noise=given.noise or noise, delay_room=room)
        alike = max(Counter(jax.tree.structure(variant) for variant in self.variants.values()).values())
        ticks = alike * self.table.height * min(self.durations.values()) / given.dt
        return replace(options, backend=backend.chosen(options, int(ticks)))

    @cached_property
    def durations(self) -> dict[str, float]:
        """Simulated time of every variant [s]: the plan, and a recovery for every change of weight."""
        if isinstance(self.duration, Mapping):
            return dict(self.duration)
        if self.duration is not None:
            return dict.fromkeys(self.variants, self.duration)
        changes = inputs.changes_of_weight(self.table)
        needed = {name: watch_time(variant, changes) for name, variant in self.variants.items()}
        # Variants with the same stages are walked for the same time: their statistics are of as long a walk.
        alike = {
            name: tuple(stage.name for stage in variant.stages) for name, variant in self.variants.items()
        }
        return {
            name: round(max(t for other, t in needed.items() if alike[other] == alike[name]), 3)
            for name in needed
        }

    @cached_property
    def lanes(self) -> int:
        """Walks at once in a chunk, the last one padded: it depends on the experiment only, never on the workers.

        Never more than there are scenarios.
        """
        n = self.table.height
        if self.batch is not None:
            return min(int(self.batch), n)
        chunks = -(-n // MAX_LANES[self.simulation.backend])
        return -(-n // chunks)

    @cached_property
    def chunk_rows(self) -> int:
        """Scenarios in a chunk: several times as many as lanes where there are very many."""
        return self.lanes * max(1, min(MAX_TURNS, self.table.height // (MIN_CHUNKS * self.lanes)))

    @cached_property
    def chunks(self) -> list["Chunk"]:
        """All chunks, in the order of the table's rows."""
        n, found = self.table.height, []
        for index, variant in enumerate(self.variants):
            for start in range(0, n, self.chunk_rows):
                stop = min(start + self.chunk_rows, n)
                found.append(Chunk(len(found), variant, start, stop, index * n))
        return found

    @cached_property
    def outcomes(self) -> Mapping[str, Outcome]:
        """Columns of what comes of the walks."""
        return outcomes(self.variants.values())

    @property
    def rows(self) -> int:
        """Number of rows of the results table."""
        return len(self.variants) * self.table.height

    @property
    def ticks(self) -> int:
        """Number of physics ticks of all walks."""
        each = sum(round(self.durations[name] / self.simulation.dt) for name in self.variants)
        return each * self.table.height

    @cached_property
    def resolved(self) -> dict[str, Any]:
        """Everything that decides the table, for JSON; the scenarios, in a file of their own, by their hash."""
        return {
            "robot": records.to_json(self.robot),
            "variants": {name: records.to_json(variant) for name, variant in self.variants.items()},
            "options": records.to_json(self.simulation),
            "durations_s": self.durations,
            "lanes": self.lanes,
            "chunk_rows": self.chunk_rows,
            "scenarios": {
                "rows": self.table.height,
                "columns": self.table.columns,
                "sha256": table_hash(self.table),
            },
        }

    @classmethod
    def from_resolved(cls, resolved: Mapping[str, Any], scenarios: pl.DataFrame) -> "Experiment":
        """The experiment that was written as `resolved`, with its scenarios."""
        written = resolved["variants"] if "variants" in resolved else resolved["arms"]  # until format 2
        variants = {name: records.from_json(variant) for name, variant in written.items()}
        options = records.from_json(resolved["options"])
        if options.backend == AUTO:  # there was only one
            options = replace(options, backend=XLA)
        made = cls(
            records.from_json(resolved["robot"]),
            variants,
            scenarios,
            options,
            duration=resolved["durations_s"],
            batch=resolved["lanes"],
            judge=False,
        )
        # A cached property, as it was: until format 2 a chunk had as many rows as lanes.
        made.__dict__["chunk_rows"] = resolved.get("chunk_rows", resolved["lanes"])
        return made


@dataclass(frozen=True)
class Chunk:
    """Walks of one variant that are simulated at once: scenarios `start` to `stop`."""

    number: int
    variant: str
    start: int
    stop: int
    first_row: int
    """Row of the results table of this variant's first scenario."""


def table_hash(table: pl.DataFrame) -> str:
    """SHA-256 of a table of numbers: its columns' names and values."""
    digest = hashlib.sha256(json.dumps(table.columns).encode())
    for name in table.columns:
        digest.update(np.ascontiguousarray(table[name].to_numpy()).tobytes())
    return digest.hexdigest()

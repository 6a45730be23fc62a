"""The batch tester: experiments, workers, and a results table that survives anything."""

from jaxbiped.batch import recipes, summary
from jaxbiped.batch.draws import Choice, Normal, Uniform, draw, grid
from jaxbiped.batch.experiment import Experiment
from jaxbiped.batch.experiment_file import read as read_experiment
from jaxbiped.batch.experiment_writer import write as write_experiment
from jaxbiped.batch.inputs import INPUTS, NEVER, height_column, scenarios_of, steps_of
from jaxbiped.batch.progress import Progress, show, waiting
from jaxbiped.batch.run import Plan, plan, run
from jaxbiped.batch.store import StoreError, open_table
from jaxbiped.batch.workers import WorkersError, require_address

__all__ = [
    "INPUTS",
    "NEVER",
    "Choice",
    "Experiment",
    "Normal",
    "Plan",
    "Progress",
    "StoreError",
    "Uniform",
    "WorkersError",
    "draw",
    "grid",
    "height_column",
    "open_table",
    "plan",
    "read_experiment",
    "recipes",
    "require_address",
    "run",
    "scenarios_of",
    "show",
    "steps_of",
    "summary",
    "waiting",
    "write_experiment",
]

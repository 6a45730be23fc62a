"""A run that tests kill: python kill_child.py FOLDER WORKERS [SCHEDULER]; prints nothing if all goes well."""

import sys

import numpy as np

from jaxbiped import adapt, batch, planner, robot

SCENARIOS, LANES = 40, 4


def experiment() -> batch.Experiment:
    """Cheap to walk: ten chunks of one variant."""
    params = robot.load("surena3")
    variants = {"off": adapt.Controller(planner.PolynomialGait.preset(params, 2))}
    table = batch.grid(friction=np.linspace(0.4, 0.9, SCENARIOS).tolist())
    return batch.Experiment(params, variants, table, duration=0.3, batch=LANES)


def main(folder: str, workers: str, scheduler: str | None = None) -> int:
    """Run; 3 if the workers were lost."""
    try:
        batch.run(experiment(), folder, int(workers), scheduler)
    except (batch.WorkersError, ValueError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

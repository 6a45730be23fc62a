"""Walks made up instead of simulated: every column of the results table, by the inputs alone."""

import numpy as np
import polars as pl

from jaxbiped.batch import columns, part


def walk_chunk(one, chunk, told=None):
    """Loads of 10 kg and more fall, 15 kg late; obstacles over 4 cm fall; all else succeeds."""
    inputs = one.table[chunk.start : chunk.stop]
    load, n = inputs["load_kg"].to_numpy(), inputs.height
    heights = [name for name in inputs.columns if name.endswith("_height_m")]
    height = inputs.select(heights).to_numpy().max(axis=1) if heights else np.zeros(n)
    late = load == 15.0
    fell = (load >= 10.0) | (height > 0.04)
    outcome = {name: np.linspace(0.1, 0.2, n) for name in columns.OUTCOMES}
    outcome |= {
        "status": np.where(fell, 1, 0),
        "success": ~fell | late,
        "finished": ~fell,
        "end_time_s": np.where(fell, 3.0, 16.8),
        "reflexes": (load > 0.0).astype(int),
        "trigger_s": np.where(load > 0.0, 2.5, np.nan),
        "missed": np.zeros(n, int),
    }
    frames = [part._identity(chunk), inputs, part.outcome_frame(outcome)]
    return pl.concat(frames, how="horizontal")

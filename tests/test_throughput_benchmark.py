"""The throughput benchmark runs, and its last line is what a machine reads."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["elkahlout", "surena3"])
def test_throughput_runs_and_ends_with_one_json_object(robot):
    command = [sys.executable, str(BENCHMARKS / "throughput.py"), "--quick", "--json", "--robot", robot]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])

    for key in ("closed_loop_per_core", "c_mujoco_per_core", "python_loop", "mjx_contacts_per_core"):
        assert result[key] > 0.0, key
    assert result["ratios"].keys() == {"c_mujoco_per_core", "python_loop", "mjx_contacts_per_core"}
    assert result["header"]["versions"].keys() >= {"jax", "mujoco"}
    assert result["robot"] == robot

    # The peers walk the same walk: same angles, and none has fallen.
    assert result["numpy_loop"]["angle_error_rad"] < 1e-5
    assert result["numpy_loop"]["upright"] == result["c_mujoco"]["upright"] == 1.0
    assert all(one["walks_upright"] == 1.0 for one in result["closed_loop"].values())
    assert result["compile"]["from_cache_s"] < result["compile"]["cold_s"]
    if shutil.which("cc") is not None:
        assert result["by_backend"].keys() == {"xla", "c"} and result["backend"] == "c"
        assert all(one["walks_upright"] == 1.0 for one in result["closed_loop_in_c"].values())
        assert result["compile_in_c"]["from_cache_s"] < result["compile_in_c"]["cold_s"]
    assert result["robot_seconds_per_core"] == pytest.approx(5e-4 * result["closed_loop_per_core"])

"""The benchmarks run, and their last line is what a machine reads."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.mark.slow
def test_kernels_run_and_end_with_one_json_object():
    command = [sys.executable, str(BENCHMARKS / "kernels.py"), "--quick", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])

    for key in ("ik_per_s", "mink_ik_per_s", "scipy_ik_per_s", "ratio_to_mink", "ratio_to_scipy"):
        assert result[key] > 0.0, key
    assert result["header"]["versions"].keys() >= {"jax", "mujoco", "mink", "scipy"}
    assert set(result["compilations"].values()) == {1}
    assert len(result["gait_per_s"]) == 4

    for name, position, rotation in (
        ("float32", 1e-5, 1e-5),
        ("float64", 1e-10, 1e-10),
        ("mink", 1e-4, 1e-4),
    ):
        one = result["ik"][name]
        assert one["position_max_m"] <= position, name
        assert one["rotation_max_rad"] <= rotation, name
        assert one["beyond_range_max_rad"] <= 1e-6, name
    assert result["ik"]["mink"]["solved"] > 0.5


@pytest.mark.slow
def test_the_script_for_gpus_runs_on_a_cpu():
    command = [sys.executable, str(BENCHMARKS / "gpu.py"), "--quick"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["row"] for row in rows] == ["device", "throughput", "gradient"]
    assert rows[1]["batch"] == 8 and rows[1]["ticks_per_s"] > 0.0
    assert rows[2]["tunables"] == 4 and rows[2]["seconds"] > 0.0

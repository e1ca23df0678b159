"""Every benchmark runs at its quick size and writes its table."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
OF_THEIR_OWN = ("gpu.py", "monte_carlo.py", "throughput.py")
"""They choose JAX's type and devices, of which a process has one; the others spare themselves
another start."""
BEFORE_A_RELEASE = {"armour.py", "constraints.py", "tuning.py"}
"""Their quick sizes compile for a quarter of a minute."""

NO_BENCHMARK = "comparison.py"
"""It compares the results of the others, and `test_release.py` tests it."""
NEEDED = {"ros2.py": ("mujoco", "rclpy")}
"""Benchmark -> libraries that not every environment has."""


def benchmarks():
    """Every benchmark, with its mark."""
    for path in sorted(set(FOLDER.glob("[a-z]*.py")) - {FOLDER / NO_BENCHMARK}):
        mark = pytest.mark.release if path.name in BEFORE_A_RELEASE else pytest.mark.slow
        yield pytest.param(path.name, marks=mark)


@pytest.mark.parametrize("name", list(benchmarks()))
def test_quick_benchmark(name, tmp_path, monkeypatch):
    for library in NEEDED.get(name, ()):
        pytest.importorskip(library, reason=f"{name} needs {library}")
    output = tmp_path / "table.json"
    words = [str(FOLDER / name), "--quick", "--json", str(output)]
    if name in OF_THEIR_OWN:
        subprocess.run([sys.executable, *words], check=True, timeout=280, capture_output=True)
    else:
        monkeypatch.setattr(sys, "argv", words)
        monkeypatch.syspath_prepend(FOLDER)
        runpy.run_path(words[0], run_name="__main__")
    table = json.loads(output.read_text())
    assert table["rows"]
    assert table["machine"]["jax"]

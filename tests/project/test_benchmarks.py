"""Every benchmark runs at its quick size and writes its table."""

import importlib
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from packaging.version import Version

FOLDER = Path(__file__).parents[2] / "benchmarks"
OF_THEIR_OWN = ("errors.py", "gpu.py", "monte_carlo.py", "throughput.py")
"""They choose JAX's type and devices, of which a process has one; the others spare themselves
another start."""
BEFORE_A_RELEASE = {
    *("armour.py", "constraints.py", "laws.py", "monte_carlo.py", "proofs.py"),
    *("robust_tuning.py", "small_levels.py", "starts.py", "throughput.py", "tuning.py"),
}
"""Their quick sizes take more than a quarter of a minute."""
NO_BENCHMARK = {"comparison.py", "losses.py", "withdrawn.py"}
"""One compares the results of the others, and `test_release.py` tests it; one compares commits, and
`test_losses.py` tests it; one names the results that were removed."""
NEEDED = {"ros2.py": ("mujoco", "rclpy")}
"""Benchmark -> libraries that not every environment has."""
NOTED = {"date", "python", "jax", "jaxlib", "numpy", "iblf_jax", "commit"}
"""What every result names."""
COMMIT = re.compile("[0-9a-f]{40}( with uncommitted changes|, which added this table; .*)?")
PLACES = ("results", "field/results", "field/checks")
RESULTS = sorted(path for place in PLACES for path in (FOLDER / place).glob("*.json"))


def benchmarks():
    for path in sorted(set(FOLDER.glob("[a-z]*.py")) - {FOLDER / name for name in NO_BENCHMARK}):
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
    assert set(table["machine"]) >= NOTED
    assert table["machine"]["jax"] == jax.__version__


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: f"{path.parent.parent.name}-{path.stem}")
def test_a_result_names_its_versions_and_its_commit(path):
    machine = json.loads(path.read_text(encoding="utf-8"))["machine"]
    assert set(machine) >= NOTED
    assert COMMIT.fullmatch(machine["commit"])
    # Tables of these versions were wrong before measurements noted their commit.
    if Version(machine["jax"]) >= Version("0.11"):
        assert "which added this table" not in machine["commit"]


def test_results_that_are_withdrawn_are_not_there(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    names = importlib.import_module("withdrawn").BENCHMARKS
    assert names and not [name for name in names if (FOLDER / "results" / f"{name}.json").exists()]

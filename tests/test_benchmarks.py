"""Every benchmark runs at its quick size and writes its table."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.name for path in FOLDER.glob("[a-z]*.py")))
def test_quick_benchmark(name, tmp_path):
    output = tmp_path / "table.json"
    subprocess.run([sys.executable, str(FOLDER / name), "--quick", "--json", str(output)], check=True, timeout=280, capture_output=True)
    table = json.loads(output.read_text())
    assert table["rows"]
    assert table["machine"]["jax"]

"""The notebooks run from top to bottom, as a reader would run them; the site shows what they
gave."""

from __future__ import annotations

import sys

import pytest
from conftest import ROOT

sys.path.append(str(ROOT / "docs"))
import build

FOLDER = ROOT / "notebooks"


@pytest.mark.site
@pytest.mark.usefixtures("optimised_kernels")
@pytest.mark.parametrize("name", sorted(path.name for path in FOLDER.glob("*.ipynb")))
def test_notebook_runs(name, tmp_path):
    notebook = build.execute(FOLDER / name, tmp_path)
    shown = [
        output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
    ]
    assert any("image/png" in output.get("data", {}) for output in shown), "no figure was shown"


def test_there_are_notebooks():
    assert "01_reproduce_the_paper.ipynb" in {path.name for path in FOLDER.glob("*.ipynb")}

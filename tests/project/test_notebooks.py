"""The notebooks run from top to bottom, as a reader would run them; the site shows what they
gave.

Each of them begins with goals and prerequisites, and ends with exercises, whose solutions run with
it, and with a link to the next one.
"""

import copy
import itertools
import re
import sys
import tomllib
from pathlib import Path

import nbformat
import pytest
from conftest import ROOT

# First, because a package index has a `build` too.
sys.path.insert(0, str(ROOT / "docs"))
import build

FOLDER = ROOT / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
GOALS = ("## Goals", "After this notebook you can")
PREREQUISITES = ("Notebooks:", "Knowledge:", "Extras:", "Time:")
LONG = ("05_certificates", "07_from_paper_to_robot", "09_from_log_to_gains", "10_flexible_arm")
"""Notebooks that take more than a minute of a processor, but for that on tuning."""
EXERCISES = range(2, 5)
"""Numbers of exercises that a notebook may have."""


def marked(path: Path):
    """The name of a notebook; a long one is slow and not required for a draft of the site."""
    is_long = path.stem in LONG
    return pytest.param(path.name, marks=pytest.mark.slow if is_long else pytest.mark.site)


@pytest.mark.usefixtures("optimised_kernels")
@pytest.mark.parametrize("name", map(marked, NOTEBOOKS))
def test_notebook_runs(name, tmp_path):
    cells = build.execute(FOLDER / name, tmp_path).cells
    shown = [output for cell in cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in shown), "no figure was shown"
    assert not [output for output in shown if is_progress(output)]


def is_progress(output: dict) -> bool:
    """Whether an output of a cell is a bar, or a box, of progress."""
    text = str(output.get("text", ""))
    return "\r" in text or "%|" in text or any("widget" in kind for kind in output.get("data", {}))


def test_a_bar_of_progress_is_found():
    assert is_progress({"output_type": "stream", "text": "tune:  40%|####      | 4/10"})
    assert is_progress({"data": {"application/vnd.jupyter.widget-view+json": {}}})
    assert not is_progress({"output_type": "stream", "text": "97 % of the runs"})


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_installed_by_one_line_where_the_package_is_not(path):
    cells = nbformat.read(path, as_version=4).cells
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]
    needed = set(re.findall(r"`(\w+)`", cells[1].source.split("Extras:")[1].split("Time:")[0]))
    first = next(cell.source for cell in cells if cell.cell_type == "code")
    found = re.search(r'^# %pip install "iblf_jax(\[[\w,]+\])? @ git\+(\S+)"$', first, re.MULTILINE)
    assert found and found[2] == urls["Repository"]
    start = (ROOT / "docs" / "start.md").read_text(encoding="utf-8")
    assert f'pip install "iblf_jax @ git+{found[2]}"' in start
    extras = set((found[1] or "[]")[1:-1].split(",")) - {""}
    assert extras == needed - {"notebooks"}  # such a service has what opens a notebook


def target_of_next(cells: list) -> Path:
    """The file that the last cell of a notebook links to."""
    (link,) = re.findall(r"\]\(([^)]+)\)", cells[-1].source)[:1] or ["no link"]
    folder = FOLDER if link.endswith(".ipynb") else ROOT / "docs" / "tutorials"
    return (folder / link).resolve()


def missing_parts(cells: list) -> list[str]:
    """What a notebook lacks for a reader who learns with it."""
    missing = [text for text in (*GOALS, *PREREQUISITES) if text not in cells[1].source]
    exercises = [i for i, cell in enumerate(cells) if cell.source.startswith("### Exercise")]
    if len(exercises) not in EXERCISES:
        missing.append(f"two to four exercises, not {len(exercises)}")
    for i in exercises:
        solution = cells[i + 1]
        is_collapsed = "hide-cell" in solution.metadata.get("tags", [])
        if solution.cell_type != "code" or not is_collapsed or "assert" not in solution.source:
            missing.append(f"a collapsed solution with an assertion of {cells[i].source[:15]!r}")
    if not cells[-1].source.startswith("## Next") or not target_of_next(cells).exists():
        missing.append("a link to what is next")
    return missing


def test_notebooks_have_goals_prerequisites_and_exercises_and_lead_to_the_next():
    """One without these parts is found."""
    assert NOTEBOOKS[0].name == "01_reproduce_the_paper.ipynb"
    for path, following in itertools.zip_longest(NOTEBOOKS, NOTEBOOKS[1:]):
        cells = nbformat.read(path, as_version=4).cells
        assert missing_parts(cells) == [], path
        assert following is None or target_of_next(cells) == following, path
    cells = nbformat.read(NOTEBOOKS[0], as_version=4).cells
    assert "## Goals" in missing_parts(cells[:1] + cells[2:])
    assert "two to four exercises, not 0" in missing_parts(cells[:4] + cells[-1:])
    assert "a link to what is next" in missing_parts(cells[:-1])
    unchecked = copy.deepcopy(cells)
    for cell in unchecked:
        cell.source = cell.source.replace("assert", "print")
    assert len(missing_parts(unchecked)) == 3

"""The files of a release agree, and the release script finds it where they do not."""

import importlib.machinery
import importlib.util
import shutil
import sys

import pytest
from conftest import ROOT
from refused import assert_refused


def module_of(path, name):
    """A program of the repository as a module; it may have no suffix."""
    loader = importlib.machinery.SourceFileLoader(name, str(path))
    spec = importlib.util.spec_from_loader(name, loader)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    loader.exec_module(module)
    return module


sys.path.insert(0, str(ROOT / "tools"))  # as when Python runs a program there
release = module_of(ROOT / "tools" / "release", "release")
comparison = module_of(ROOT / "benchmarks" / "comparison.py", "comparison")


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("CITATION.cff", "\nversion: ", "\nversion: 9", "CITATION.cff must have the line"),
        ("pyproject.toml", '\nversion = "', '\nversion = "9.', "CITATION.cff must have"),
        ("CHANGELOG.md", "\n## {version} - ", "\n## 0.0.1 - ", "no heading '## "),
    ],
)
def test_all_files_name_the_same_version_and_another_one_is_found(
    file, old, new, message, tmp_path
):
    for name in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md"):
        shutil.copy(ROOT / name, tmp_path)
    version = release.check_versions()
    assert version == release.project()["version"]
    text = (tmp_path / file).read_text(encoding="utf-8")
    changed = text.replace(old.format(version=version), new.format(version=version), 1)
    assert changed != text
    (tmp_path / file).write_text(changed, encoding="utf-8")
    assert_refused(message, release.check_versions, tmp_path, error=release.ReleaseError)


def test_readme_and_article_have_the_measured_numbers_and_another_one_is_found():
    assert comparison.outdated() == []
    text = comparison.FILES[0].read_text(encoding="utf-8")
    changed = text.replace(" ms of a processor", " s of a processor", 1)
    assert changed != text and comparison.replaced(changed) == text
    assert_refused("has no place for the table", comparison.replaced, "nothing", error=LookupError)
    wrong = comparison.COMPARISONS[0]._replace(ours={"row": "native"})
    assert_refused("rows with", comparison.row, wrong, error=LookupError)


def test_the_article_shows_the_figures_that_its_program_makes():
    figures = module_of(ROOT / "paper" / "figures.py", "article_figures")
    assert figures.faults() == []
    assert all((ROOT / "paper" / name).exists() for name in figures.FIGURES)

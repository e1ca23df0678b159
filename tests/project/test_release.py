"""The files of a release agree, and the release script finds it where they do not."""

import importlib.machinery
import importlib.util
import shutil
import sys

import pytest
from conftest import ROOT


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


def test_all_files_name_the_same_version():
    assert release.check_versions() == release.project()["version"]


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("CITATION.cff", "\nversion: ", "\nversion: 9", "CITATION.cff must have the line"),
        ("pyproject.toml", '\nversion = "', '\nversion = "9.', "CITATION.cff must have"),
        ("CHANGELOG.md", "\n## {version} - ", "\n## 0.0.1 - ", "no heading '## "),
    ],
)
def test_a_file_with_another_version_is_found(file, old, new, message, tmp_path):
    for name in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md"):
        shutil.copy(ROOT / name, tmp_path)
    version = release.project()["version"]
    text = (tmp_path / file).read_text(encoding="utf-8")
    changed = text.replace(old.format(version=version), new.format(version=version), 1)
    assert changed != text
    (tmp_path / file).write_text(changed, encoding="utf-8")
    with pytest.raises(release.ReleaseError, match=message):
        release.check_versions(tmp_path)


def test_readme_and_article_have_the_measured_numbers_and_another_one_is_found():
    assert comparison.outdated() == []
    text = comparison.FILES[0].read_text(encoding="utf-8")
    changed = text.replace(" ms of a processor", " s of a processor", 1)
    assert changed != text and comparison.replaced(changed) == text
    with pytest.raises(LookupError, match="has no place for the table"):
        comparison.replaced("nothing")
    wrong = comparison.COMPARISONS[0]._replace(ours={"row": "native"})
    with pytest.raises(LookupError, match="rows with"):
        comparison.row(wrong)


def test_the_article_shows_the_figures_that_its_program_makes():
    figures = module_of(ROOT / "paper" / "figures.py", "article_figures")
    assert figures.faults() == []
    assert all((ROOT / "paper" / name).exists() for name in figures.FIGURES)

"""Tests mirror the package: a file of tests has the name of a module, so that a reader finds it."""

import pytest
from conftest import ROOT

SUBJECTS = {
    "engine": {
        "costs": "operations of a step and programs of a first call, on every preset",
        "digests": "every number of short runs, on every preset",
        "plant_runs": "all stages of a run, for plants in strict-feedback form",
        "programs_of_members": "the program of every member, beside all others",
    },
    "kernels": {"package": "what the package imports, and the example that it shows"},
}
"""Folder -> subject of a file of tests that is about no single module -> what it is about."""


@pytest.mark.parametrize("folder", SUBJECTS)
def test_files_have_the_names_of_modules_or_of_subjects(folder):
    modules = {path.stem for path in (ROOT / "iblf_jax" / folder).glob("*.py")}
    files = (ROOT / "tests" / folder).glob("test_*.py")
    assert {path.stem.removeprefix("test_") for path in files} - modules == {*SUBJECTS[folder]}

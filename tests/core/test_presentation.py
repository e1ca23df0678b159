"""Results reach figures, reports and files by name, and load them at first use."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

from iblf_jax.core.presentation import PRESENTATIONS, present


@pytest.mark.parametrize("name", PRESENTATIONS)
def test_every_presentation_exists(name):
    module, function = PRESENTATIONS[name]
    assert callable(getattr(importlib.import_module(module), function))


def test_an_unknown_presentation_is_an_error():
    with pytest.raises(KeyError, match="no such figure"):
        present("no such figure", None)


@pytest.mark.slow
def test_studies_and_results_load_no_figures():
    code = (
        "import sys, iblf_jax as ij; ij.monte_carlo, ij.Rollout, ij.certify, ij.tune\n"
        "loaded = {'iblf_jax.plotting', 'iblf_jax.reports', 'matplotlib'} & set(sys.modules)\n"
        "assert not loaded, loaded"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)

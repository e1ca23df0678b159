"""Results reach figures, reports and files by name, and load them at first use."""

import importlib

import pytest

from iblf_jax.core.presentation import PRESENTATIONS


@pytest.mark.parametrize("name", PRESENTATIONS)
def test_every_presentation_exists(name):
    module, function = PRESENTATIONS[name]
    assert callable(getattr(importlib.import_module(module), function))

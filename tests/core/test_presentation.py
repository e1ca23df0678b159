"""Results reach figures, reports and files by name, and load them at first use."""

from __future__ import annotations

import importlib

import pytest

from iblf_jax.core.presentation import PRESENTATIONS, present


@pytest.mark.parametrize("name", PRESENTATIONS)
def test_every_presentation_exists(name):
    module, function = PRESENTATIONS[name]
    assert callable(getattr(importlib.import_module(module), function))


def test_an_unknown_presentation_is_an_error():
    with pytest.raises(KeyError, match="no such figure"):
        present("no such figure", None)

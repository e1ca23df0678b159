"""Optional packages of solvers."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

EXTRA = "iblf_jax[tuning]"


def missing(name: str) -> ImportError:
    """The error of a package that is not installed."""
    return ImportError(f'This solver needs the {name} package: pip install "{EXTRA}".')


def check_installed(name: str) -> None:
    """Raises ImportError, with the remedy, if a package is not installed."""
    if importlib.util.find_spec(name) is None:
        raise missing(name)


def package(name: str) -> Any:
    """A package; ImportError with the remedy if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise missing(name) from error

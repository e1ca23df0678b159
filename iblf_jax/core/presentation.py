"""Reaches figures, reports and files from results without importing them.

Results lie below `plotting`, `reports` and `files` in the layers of the package. Their methods
`plot`, `save`, `to_xarray` and `_repr_html_` call the functions of this table by name, and Python
imports the module at the first call. A new presentation is one entry of the table.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

PRESENTATIONS = {
    "certificate figure": ("iblf_jax.plotting.certificates", "certificate"),
    "comparison figure": ("iblf_jax.plotting", "comparison"),
    "failure figure": ("iblf_jax.plotting", "failure_probability"),
    "first exit figure": ("iblf_jax.plotting", "first_exit"),
    "front figure": ("iblf_jax.plotting", "pareto"),
    "identification figure": ("iblf_jax.plotting", "identification"),
    "proof figure": ("iblf_jax.plotting", "guaranteed_tube"),
    "rollout figure": ("iblf_jax.plotting", "overview"),
    "study figure": ("iblf_jax.plotting", "study_overview"),
    "tuning figure": ("iblf_jax.plotting", "tuning"),
    "card": ("iblf_jax.reports", "card"),
    "report": ("iblf_jax.reports", "report"),
    "proof dataset": ("iblf_jax.files.proofs", "proof_to_xarray"),
    "result file": ("iblf_jax.files.results", "save"),
    "rollout dataset": ("iblf_jax.files.rollouts", "rollout_to_xarray"),
}
"""Name of a presentation -> the module and the function that makes it."""


def present(name: str, result: Any, *args: Any, **options: Any) -> Any:
    """Makes one presentation of a result.

    Args:
      name: key of `PRESENTATIONS`.
      result: the object to present.
      args, options: further arguments of the function.

    Returns:
      What the function returns.
    """
    module, function = PRESENTATIONS[name]
    return getattr(importlib.import_module(module), function)(result, *args, **options)


class Result:
    """What a study, a search or a proof finds: it can be saved."""

    __slots__ = ()

    def save(self, path: str | os.PathLike) -> Path:
        """Writes everything to one file, from which `ij.load` returns an equal result.

        Args:
          path: the file; its folder must exist.  Its name may have any ending.

        Returns:
          The path.

        Raises:
          ValueError: the result holds a class that no file can name; the message says how to
            register it.
          OSError: the file cannot be written.

        Source: `iblf_jax.files.results`.
        """
        return present("result file", self, path)

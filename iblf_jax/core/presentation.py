"""The base class of results, which print as text and HTML and can be saved; it reaches figures,
reports and files without importing them.

Results lie below `plotting`, `reports` and `files` in the layers of the package. Their methods
`plot`, `save`, `to_xarray` and `_repr_html_` call the functions of this table by name, and Python
imports the module at the first call. A new presentation is one entry of the table.
"""

from __future__ import annotations

import importlib
import itertools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

from iblf_jax.core.tables import Table

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


def present(name: str, result: object, *args: Any, **options: Any) -> Any:
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


Content: TypeAlias = Sequence[str | Table]
"""A result as texts, of a line or several, and tables, in the order in which it prints."""


class Result:
    """What a study, a search or a proof finds: it prints, is a card in a notebook, and can be
    saved.

    A subclass has `_content`, and `repr=False` where it is a dataclass.
    """

    __slots__ = ()

    def _content(self) -> Content:
        """Its texts and tables, of which this class makes the text, and `reports` the HTML."""
        raise NotImplementedError(f"{type(self).__name__} states no content")

    def __repr__(self) -> str:
        lines = (x.lines() if isinstance(x, Table) else [x] for x in self._content())
        return "\n".join(itertools.chain.from_iterable(lines))

    def _repr_html_(self) -> str:
        return present("card", self)

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

"""Checkpoints of a search: its state and history after each step, in one file.

The file is written under another name and then renamed, so that it is complete or not there.  A
search that was killed continues from it and gives the same numbers, bit by bit, as one that was
not.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from iblf_jax.core import checks
from iblf_jax.core.attributes import has_members
from iblf_jax.core.program_digest import CallsPythonError, program_digest
from iblf_jax.core.pytree import field_values
from iblf_jax.core.whole_files import written_whole
from iblf_jax.studies.store_config import computed_by, structure
from iblf_jax.tuning.evaluation import Evaluator
from iblf_jax.tuning.search import Search, SearchState
from iblf_jax.tuning.solvers import Solver

NOT_PART_OF_THE_PROBLEM = ("patience",)
"""Options with which a search may be continued that began with others."""


def fingerprint(evaluate: Evaluator, solver: Solver, mode: str, iterations: int) -> str:
    """A hash of everything that a checkpoint must agree with.

    Args:
      evaluate: the problem. Its numbers and its program are part of the hash: names of classes
        would not tell that the code of a user has changed.
      solver: its class and its options are part of the hash; those of a solver must be known.
      mode: of differentiation.
      iterations: of the search, which a schedule depends on.

    Raises:
      ValueError: the program calls functions of Python while it runs.
    """
    parts = [
        described_solver(solver, iterations),
        mode,
        structure(evaluate.problem),
        _digest_of(evaluate.traced()),
        computed_by(evaluate.problem.request.backend),
    ]
    digest = hashlib.sha256(repr(parts).encode())
    for x in jax.tree.leaves((evaluate.problem, evaluate.candidates)):
        digest.update(f"{np.shape(x)} ".encode() + np.asarray(x).tobytes())
    return digest.hexdigest()


def _digest_of(traced: jax.stages.Traced) -> str:
    """The digest of a program; ValueError for one that calls functions of Python."""
    try:
        return program_digest(traced)
    except CallsPythonError as error:
        callback = checks.with_article(str(error))
        remedy = f"It has {callback}: what that computes cannot be compared. Leave checkpoint out."
        raise checks.fail(
            "checkpoint", checks.Words("a program that calls Python"), "a compiled program", remedy
        ) from error


def described_solver(solver: Solver, iterations: int) -> tuple[str, dict[str, Any]]:
    """The class of a solver and its options.

    Raises:
      ValueError: a class of a user that is no dataclass, whose options are not known.
    """
    cls = type(solver)
    if not dataclasses.is_dataclass(solver):
        remedy = "Make its class a dataclass, so that its options can be compared, or leave it out."
        raise checks.fail("checkpoint", cls, "a solver whose class is a dataclass", remedy)
    options: dict[str, Any] = field_values(solver)
    for name in NOT_PART_OF_THE_PROBLEM:
        options.pop(name, None)
    for name, value in options.items():
        if has_members(value, "init", "update"):
            options[name] = _program_of(value)
    if "schedule" in options:
        options["iterations"] = iterations  # a schedule ends with the last step
    return f"{cls.__module__}.{cls.__qualname__}", options


def _program_of(optimiser: optax.GradientTransformation) -> str:
    """The digest of the first two steps of an optimiser of optax, with the numbers of its start.

    Its functions print as addresses, which differ between processes.
    """

    def steps(w: jax.Array) -> Any:
        extended = optax.with_extra_args_support(optimiser)
        state = extended.init(w)
        found, state = extended.update(w, state, w, value=w[0])
        return found, extended.update(w, state, w, value=w[0])

    with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of several types
        return _digest_of(jax.jit(steps).trace(jnp.zeros(1)))


def _named_leaves(state: SearchState) -> dict[str, np.ndarray]:
    """Name -> array of every leaf of a state."""
    pairs = jax.tree_util.tree_leaves_with_path(vars(state))
    return {f"state{jax.tree_util.keystr(path)}": np.asarray(x) for path, x in pairs}


def _shapes(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    return {name: (x.shape, x.dtype) for name, x in arrays.items()}


def save_checkpoint(search: Search, path: str | os.PathLike, mark: str) -> None:
    """Writes state and history of a search.

    Args:
      search: after a step.
      path: of the file.
      mark: `fingerprint` of the problem.
    """
    arrays = _named_leaves(search.state)
    arrays |= {f"history_{name}": np.stack(x) for name, x in search.history.items()}
    with written_whole(Path(path)) as file:
        np.savez(file, allow_pickle=False, fingerprint=np.asarray(mark), **arrays)


def load_checkpoint(path: str | os.PathLike, search: Search, mark: str) -> None:
    """Sets state and history of a search to those of its checkpoint.

    Raises:
      ValueError: the file is not a checkpoint, or one of another problem.
    """
    place = checks.file_to_read("checkpoint", path)
    try:
        with np.load(place) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception as error:  # incomplete, another kind of file, or one that begins like a zip
        remedy = (
            f"It cannot be read ({type(error).__name__}: {error}): delete it or name another file."
        )
        raise checks.fail("checkpoint", str(path), "a checkpoint of tune", remedy) from error
    if str(arrays.get("fingerprint")) != mark:
        remedy = (
            "Scenario, objective, options or the package's version differ: delete it or name"
            " another file."
        )
        raise checks.fail("checkpoint", str(path), "a checkpoint of this very problem", remedy)
    expected = _named_leaves(search.state)
    found = {name: np.array(x) for name, x in arrays.items() if name.startswith("state[")}
    if _shapes(found) != _shapes(expected):
        remedy = "An array is missing in it: delete it or name another file."
        raise checks.fail("checkpoint", str(path), "a complete checkpoint", remedy)
    before = vars(search.state)
    loaded = jax.tree.unflatten(jax.tree.structure(before), [found[name] for name in expected])
    numbers = {k: type(x)(loaded[k]) for k, x in before.items() if isinstance(x, int)}
    search.state = SearchState(**loaded | numbers)
    search.history = {
        name.removeprefix("history_"): list(x)
        for name, x in arrays.items()
        if name.startswith("history_")
    }

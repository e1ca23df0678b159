"""Reads study files: a Monte-Carlo study, a sweep or a probability of failure as validated TOML.

A study file is a scenario file (`files.scenario`) with more tables:

    preset = "zhang_yan_2024"     # or the complete scenario
    [run]                         # required: duration, dt, method
    duration = 10.0
    [perturbations]               # path -> its perturbation
    "plant.mass[1]" = { factor = "uniform", low = 0.7, high = 1.3 }
    "initial.q" = { offset = "normal", mean = 0.0, std = 0.02 }
    [study]                       # Monte-Carlo: runs, seed, sampler, replicates
    runs = 10000
    [failure]                     # or a probability of failure: estimator, runs, seed, margin,
    estimator = "subset"          # limit, confidence
    [sweep]                       # or a sweep: also design, points, unit
    runs = 256
    [grid]                        # path -> values, or a perturbation in a random design
    "controller.K2" = [10.0, 20.0, 40.0]

A perturbation names its kind (factor, offset or value), its distribution (uniform, normal,
log_uniform, choice, joint_normal or joint_samples), the numbers of the distribution, and `shared =
true` if all entries of a vector leaf get the same draw.  Correlated leaves are joint_normal, each
with its mean, its rows of the factor of the covariance, and the group = "name" of the joint draw;
or joint_samples, each with its values in a list of samples, and the group.  Tuning files have the
same table [perturbations].  Every error is a ValueError that names file and key.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from iblf_jax.core import checks
from iblf_jax.files.components import construct
from iblf_jax.files.scenario import from_dict, read_toml
from iblf_jax.files.values import (
    Words,
    as_table,
    by_path,
    decode_static,
    did_you_mean,
    known_keys,
    missing,
    numbers,
)
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies import Design, distributions
from iblf_jax.studies.distributions import KINDS, Perturbation

OPTIONS: dict[str, dict[str, type]] = {
    "study": {"runs": int, "seed": int, "sampler": str, "replicates": int},
}
OPTIONS["failure"] = {
    "estimator": str,
    "runs": int,
    "seed": int,
    "margin": str,
    "limit": float,
    "confidence": float,
}
OPTIONS["sweep"] = OPTIONS["study"] | {"design": str, "points": int, "unit": int}
"""Table -> key -> type."""

EXAMPLE = 'Write, for example, { factor = "uniform", low = 0.9, high = 1.1 }.'


class StudyFile(NamedTuple):
    """The content of a study file, as the arguments of `monte_carlo`, `sweep` or
    `failure_probability`.
    """

    scenario: Scenario
    perturbations: dict[str, Perturbation]
    grid: dict[str, Any]
    options: dict[str, Any]
    """duration, dt, method, and the entries of [study], [sweep] or [failure]."""


def load_study_file(
    path: str | os.PathLike, kind: str, *, modules: Mapping[str, Any] | None = None
) -> StudyFile:
    """Reads a study file.

    Args:
      path: the file.
      kind: "study", "sweep" or "failure", the table that it must have.
      modules: modules that the file cannot describe, as `load_scenario` takes them.

    Raises:
      ValueError: the file is not TOML or does not describe such a study; the message names file,
        key and remedy.
      OSError: it cannot be read.
    """
    checks.one_of("kind", kind, tuple(OPTIONS))
    data = read_toml(path)
    return study_from_dict(data, kind, os.fspath(path), Path(path).parent, modules)


def study_from_dict(
    data: dict[str, Any],
    kind: str,
    source: str = "",
    folder: str | os.PathLike = "",
    modules: Mapping[str, Any] | None = None,
) -> StudyFile:
    """As `load_study_file`, from the tables of a file."""
    own: dict[str, tuple[str, ...]] = {name: (name, "perturbations") for name in OPTIONS}
    own["sweep"] = (*own["sweep"], "grid")
    file = from_dict(data, source, other_tables=own[kind], folder=folder, modules=modules)
    try:
        if "record_every" in file.run:
            came = file.run["record_every"]
            remedy = "A study records no trajectories: leave it out."
            raise checks.fail("run.record_every", came, "nothing", remedy)
        if "duration" not in file.run:
            remedy = "Add [run] with duration = ..."
            raise missing("run.duration", "the length of a run [s]", remedy)
        options = file.run | _options(data.get(kind), kind)
        perturbations = perturbations_of(data)
        grid = {}
        if kind == "sweep":
            for path, entry in _entries(data, "grid").items():
                read = _perturbation if isinstance(entry, dict) else numbers
                grid[path] = read(entry, f"grid.{path}")
        return StudyFile(file.scenario, perturbations, grid, options)
    except ValueError as error:
        raise checks.with_location(source, error) from error


def _options(table: Any, kind: str) -> dict[str, Any]:
    if table is None:
        raise missing(kind, f"a table [{kind}]", "Write runs = 1000 in it, for example.")
    known_keys(as_table(table, kind), kind, OPTIONS[kind])
    for key, value in table.items():
        decode_static(value, OPTIONS[kind][key], f"{kind}.{key}")
    if kind == "study" and "runs" not in table:
        raise missing("study.runs", "a number of runs")
    options = dict(table)
    if "points" in options:
        options["design"] = Design(options.get("design", "grid"), options.pop("points"))
    return options


def perturbations_of(data: dict[str, Any]) -> dict[str, Perturbation]:
    """The table [perturbations] of any file of this package: path -> perturbation.

    Raises:
      ValueError: an entry that is not a perturbation.
    """
    entries = _entries(data, "perturbations")
    return {path: _perturbation(table, f"perturbations.{path}") for path, table in entries.items()}


def _entries(data: dict[str, Any], name: str) -> dict[str, Any]:
    """Path -> entry of the table [name] of a file, which may be missing."""
    keys_of_entries = {"shared", *KINDS, *distributions.MEMBERS}
    for member in distributions.MEMBERS:
        keys_of_entries |= set(_arguments(member))

    def is_entry(value: object) -> bool:
        """Whether a value is an entry; otherwise it is a table that continues a path."""
        if not isinstance(value, dict) or keys_of_entries & set(value):
            return True
        return any(isinstance(x, str) for x in value.values())

    return by_path(as_table(data.get(name, {}), name), is_entry)


def _distribution_maker(name: str) -> Any:
    """The function that makes a distribution with its defaults; for a user's distribution, the
    class.
    """
    return getattr(distributions, name, distributions.MEMBERS[name])


def _arguments(name: str) -> dict[str, bool]:
    """The arguments of a distribution, and whether each is required."""
    taken = inspect.signature(_distribution_maker(name)).parameters
    return {word: argument.default is argument.empty for word, argument in taken.items()}


def _perturbation(table: object, path: str) -> Perturbation:
    if not isinstance(table, dict):
        raise checks.fail(path, table, "a table with a kind and a distribution", EXAMPLE)
    kinds = [kind for kind in KINDS if kind in table]
    if len(kinds) != 1:
        came = Words(" and ".join(kinds) or "none of them")
        raise checks.fail(path, came, f"one of {', '.join(KINDS)}", EXAMPLE)
    (kind,) = kinds
    name = table[kind]
    if not isinstance(name, str) or name not in distributions.MEMBERS:
        remedy = did_you_mean(name, distributions.MEMBERS)
        raise checks.fail(f"{path}.{kind}", name, "the name of a distribution", remedy)
    arguments = _arguments(name)
    known_keys(table, path, (kind, "shared", *arguments))
    shared = decode_static(table.get("shared", False), bool, f"{path}.shared")
    values = {}
    for word, is_required in arguments.items():
        key = f"{path}.{word}"
        if word in table:
            values[word] = table[word]
            if word == "group":
                checks.string(key, table[word], "a name")
            else:
                values[word] = numbers(table[word], key)
        elif is_required:
            raise missing(key, "a number or a list of numbers", f"{name} needs it.")
    distribution = construct(_distribution_maker(name), values, path)
    return getattr(distributions, kind)(distribution, shared=shared)

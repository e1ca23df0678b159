"""Study files: a Monte-Carlo study or a sweep as typed, validated TOML.

A study file is a scenario file (`scenario_file`) with more tables:

    preset = "zhang_yan_2024"                                      # or the scenario written out
    [run]                                                          # required: duration, dt, method
    duration = 10.0
    [perturbations]                                                # path -> how it is drawn
    "plant.mass[1]" = { factor = "uniform", low = 0.7, high = 1.3 }
    "initial.q" = { offset = "normal", mean = 0.0, std = 0.02 }
    [study]                                                        # Monte-Carlo: runs, seed, sampler, replicates
    runs = 10000
    [sweep]                                                        # or a sweep: also design, points, unit
    runs = 256
    [grid]                                                         # path -> values, or how it is drawn in a random design
    "controller.K2" = [10.0, 20.0, 40.0]

A draw names its kind (factor, offset or value), its distribution (uniform, normal, log_uniform or choice), that one's numbers, and
`shared = true` where all entries of a vector leaf get the same.  Every refusal is a ValueError that names file and key.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

from iblf_jax import checks, distributions
from iblf_jax.codec import construct
from iblf_jax.distributions import KINDS, Perturbation
from iblf_jax.plain import Words, as_table, did_you_mean, known_keys, numbers
from iblf_jax.scenario import Scenario
from iblf_jax.scenario_file import from_dict, read_toml

DISTRIBUTIONS = {
    "uniform": (distributions.uniform, ("low", "high")),
    "normal": (distributions.normal, ("mean", "std")),
    "log_uniform": (distributions.log_uniform, ("low", "high")),
    "choice": (distributions.choice, ("values", "weights")),
}
"""Name -> function and what it takes."""

OPTIONS: dict[str, dict[str, type]] = {
    "study": {"runs": int, "seed": int, "sampler": str, "replicates": int},
    "sweep": {"runs": int, "seed": int, "sampler": str, "replicates": int, "design": str, "points": int, "unit": int},
}
"""Table -> key -> type."""

_WORDS = {*KINDS, "shared", *(word for _, words in DISTRIBUTIONS.values() for word in words)}


class StudyFile(NamedTuple):
    """What a study file holds, as the arguments of `monte_carlo` or `sweep`."""

    scenario: Scenario
    perturbations: dict[str, Perturbation]
    grid: dict[str, Any]
    options: dict[str, Any]
    """duration, dt, method, and what [study] or [sweep] says."""


def load_study_file(path: str | os.PathLike, kind: str) -> StudyFile:
    """Reads a study file.

    Args:
      path: the file.
      kind: "study" or "sweep": the table that it must have.

    Raises:
      ValueError: the file is not TOML or does not describe such a study; the message names file, key and mend.
      OSError: it cannot be read.
    """
    checks.one_of("kind", kind, tuple(OPTIONS))
    data = read_toml(path)
    return study_from_dict(data, kind, os.fspath(path), Path(path).parent)


def study_from_dict(data: dict[str, Any], kind: str, source: str = "", folder: str | os.PathLike = "") -> StudyFile:
    """As `load_study_file`, from the tables of a file."""
    own = (kind, "perturbations", *(("grid",) if kind == "sweep" else ()))
    file = from_dict(data, source, other_tables=own, folder=folder)
    try:
        if "record_every" in file.run:
            raise checks.fail("run.record_every", file.run["record_every"], "nothing", "A study records no trajectories: leave it out.")
        if "duration" not in file.run:
            raise checks.fail("run.duration", Words("nothing"), "the length of a run [s]", "Add [run] with duration = ...")
        options = file.run | _options(data.get(kind), kind)
        ways = {path: _perturbation(table, f"perturbations.{path}") for path, table in _by_path(data, "perturbations").items()}
        grid = {path: _axis(entry, f"grid.{path}") for path, entry in _by_path(data, "grid").items()} if kind == "sweep" else {}
        return StudyFile(file.scenario, ways, grid, options)
    except ValueError as error:
        raise checks.inside(source, error) from error


def _options(table: Any, kind: str) -> dict[str, Any]:
    if table is None:
        raise checks.fail(kind, Words("nothing"), f"a table [{kind}]", "Write runs = 1000 in it, for example.")
    known_keys(as_table(table, kind), kind, OPTIONS[kind])
    for key, value in table.items():
        if type(value) is not OPTIONS[kind][key]:
            raise checks.fail(f"{kind}.{key}", value, "a whole number" if OPTIONS[kind][key] is int else "a string")
    if kind == "study" and "runs" not in table:
        raise checks.fail("study.runs", Words("nothing"), "a number of runs")
    return dict(table)


def _by_path(data: dict[str, Any], name: str) -> dict[str, Any]:
    """Path -> entry: `"plant.mass" = {...}` and `plant.mass = {...}` mean the same."""

    def flat(table: dict[str, Any], prefix: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, value in table.items():
            path = f"{prefix}.{key}" if prefix else key
            nested = isinstance(value, dict) and not _WORDS & set(value) and not any(isinstance(x, str) for x in value.values())
            found |= flat(value, path) if nested else {path: value}
        return found

    return flat(as_table(data.get(name, {}), name), "")


def _axis(entry: Any, path: str) -> Any:
    """Values of a grid, or a perturbation that a random design draws from."""
    return _perturbation(entry, path) if isinstance(entry, dict) else numbers(entry, path)


def _perturbation(table: Any, path: str) -> Perturbation:
    kinds = [kind for kind in KINDS if kind in as_table(table, path)]
    if len(kinds) != 1:
        came = Words(" and ".join(kinds) if kinds else "none of them")
        raise checks.fail(path, came, f"one of {', '.join(KINDS)}", 'Such as { factor = "uniform", low = 0.9, high = 1.1 }.')
    name = table[kinds[0]]
    if not isinstance(name, str) or name not in DISTRIBUTIONS:
        raise checks.fail(f"{path}.{kinds[0]}", name, "the name of a distribution", did_you_mean(name, DISTRIBUTIONS))
    make, words = DISTRIBUTIONS[name]
    known_keys(table, path, (kinds[0], "shared", *words))
    shared = table.get("shared", False)
    if not isinstance(shared, bool):
        raise checks.fail(f"{path}.shared", shared, "true or false")
    values = {key: numbers(value, f"{path}.{key}") for key, value in table.items() if key in words}
    for word in words:
        if word not in values and name != "normal" and word != "weights":
            raise checks.fail(f"{path}.{word}", Words("nothing"), "a number or a list of numbers", f"{name} needs it.")
    return getattr(distributions, kinds[0])(construct(make, values, path), shared=shared)

"""Study files: a Monte-Carlo study or a sweep as typed, validated TOML.

A study file is a scenario file (`files.scenario`) with more tables:

    preset = "zhang_yan_2024"                                      # or the scenario written out
    [run]                                                          # required: duration, dt, method
    duration = 10.0
    [perturbations]                                                # path -> how it is drawn
    "plant.mass[1]" = { factor = "uniform", low = 0.7, high = 1.3 }
    "initial.q" = { offset = "normal", mean = 0.0, std = 0.02 }
    [study]                                                        # Monte-Carlo: runs, seed,
    sampler, replicates runs = 10000
    [sweep]                                                        # or a sweep: also design,
    points, unit runs = 256
    [grid]                                                         # path -> values, or how it is
    drawn in a random design "controller.K2" = [10.0, 20.0, 40.0]

A draw names its kind (factor, offset or value), its distribution (uniform, normal, log_uniform,
choice or joint_normal), that one's numbers, and `shared = true` where all entries of a vector leaf
get the same.  Leaves that vary together are joint_normal, each with its mean, its rows of the
covariance's factor, and the group = "name" of their draws.  [perturbations] is the same table in
tuning files.  Every refusal is a ValueError that names file and key.
"""

from __future__ import annotations

import inspect
import os
from pathlib import Path
from typing import Any, NamedTuple

from iblf_jax.core import checks
from iblf_jax.files.components import construct
from iblf_jax.files.scenario import from_dict, read_toml
from iblf_jax.files.values import Words, as_table, did_you_mean, inline_table, known_keys, numbers
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies import Design, distributions
from iblf_jax.studies.distributions import KINDS, Perturbation

OPTIONS: dict[str, dict[str, type]] = {
    "study": {"runs": int, "seed": int, "sampler": str, "replicates": int},
    "sweep": {
        "runs": int,
        "seed": int,
        "sampler": str,
        "replicates": int,
        "design": str,
        "points": int,
        "unit": int,
    },
}
"""Table -> key -> type."""

SUCH_AS = 'Such as { factor = "uniform", low = 0.9, high = 1.1 }.'


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
      ValueError: the file is not TOML or does not describe such a study; the message names file,
        key and remedy.
      OSError: it cannot be read.
    """
    checks.one_of("kind", kind, tuple(OPTIONS))
    data = read_toml(path)
    return study_from_dict(data, kind, os.fspath(path), Path(path).parent)


def study_from_dict(
    data: dict[str, Any], kind: str, source: str = "", folder: str | os.PathLike = ""
) -> StudyFile:
    """As `load_study_file`, from the tables of a file."""
    own = (kind, "perturbations", *(("grid",) if kind == "sweep" else ()))
    file = from_dict(data, source, other_tables=own, folder=folder)
    try:
        if "record_every" in file.run:
            raise checks.fail(
                "run.record_every",
                file.run["record_every"],
                "nothing",
                "A study records no trajectories: leave it out.",
            )
        if "duration" not in file.run:
            raise checks.fail(
                "run.duration",
                Words("nothing"),
                "the length of a run [s]",
                "Add [run] with duration = ...",
            )
        options = file.run | _options(data.get(kind), kind)
        ways = perturbations_of(data)
        grid = (
            {path: _axis(entry, f"grid.{path}") for path, entry in _by_path(data, "grid").items()}
            if kind == "sweep"
            else {}
        )
        return StudyFile(file.scenario, ways, grid, options)
    except ValueError as error:
        raise checks.inside(source, error) from error


def _options(table: Any, kind: str) -> dict[str, Any]:
    if table is None:
        raise checks.fail(
            kind, Words("nothing"), f"a table [{kind}]", "Write runs = 1000 in it, for example."
        )
    known_keys(as_table(table, kind), kind, OPTIONS[kind])
    for key, value in table.items():
        if type(value) is not OPTIONS[kind][key]:
            raise checks.fail(
                f"{kind}.{key}",
                value,
                "a whole number" if OPTIONS[kind][key] is int else "a string",
            )
    if kind == "study" and "runs" not in table:
        raise checks.fail("study.runs", Words("nothing"), "a number of runs")
    options = dict(table)
    if "points" in options:
        options["design"] = Design(options.get("design", "grid"), options.pop("points"))
    return options


def perturbations_of(data: dict[str, Any]) -> dict[str, Perturbation]:
    """The [perturbations] of any file of this package: path -> perturbation; ValueError for what is
    none.
    """
    return {
        path: _perturbation(table, f"perturbations.{path}")
        for path, table in _by_path(data, "perturbations").items()
    }


def _by_path(data: dict[str, Any], name: str) -> dict[str, Any]:
    """Path -> entry: `"plant.mass" = {...}` and `plant.mass = {...}` mean the same."""
    words = {
        *KINDS,
        "shared",
        *distributions.MEMBERS,
        *(word for member in distributions.MEMBERS for word in _taken(member)),
    }

    def flat(table: dict[str, Any], prefix: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, value in table.items():
            path = f"{prefix}.{key}" if prefix else key
            nested = (
                isinstance(value, dict)
                and not words & set(value)
                and not any(isinstance(x, str) for x in value.values())
            )
            found |= flat(value, path) if nested else {path: value}
        return found

    return flat(as_table(data.get(name, {}), name), "")


def _made_by(name: str) -> Any:
    """The function that makes a distribution, which knows its defaults; the class itself if a user
    has named one of his own.
    """
    return getattr(distributions, name, distributions.MEMBERS[name])


def _taken(name: str) -> dict[str, bool]:
    """What a distribution takes, and whether it has to be given."""
    return {
        word: x.default is x.empty
        for word, x in inspect.signature(_made_by(name)).parameters.items()
    }


def _axis(entry: Any, path: str) -> Any:
    """Values of a grid, or a perturbation that a random design draws from."""
    return _perturbation(entry, path) if isinstance(entry, dict) else numbers(entry, path)


def _perturbation(table: Any, path: str) -> Perturbation:
    if not isinstance(table, dict):
        raise checks.fail(
            path, table, "how the draw acts on the leaf, and its distribution", SUCH_AS
        )
    kinds = [kind for kind in KINDS if kind in table]
    if len(kinds) != 1:
        came = Words(" and ".join(kinds) if kinds else "none of them")
        raise checks.fail(path, came, f"one of {', '.join(KINDS)}", SUCH_AS)
    (kind,) = kinds
    name = table[kind]
    if isinstance(name, dict):
        raise checks.fail(
            f"{path}.{kind}", name, "the name of a distribution", _said_as_now(kind, name, table)
        )
    if not isinstance(name, str) or name not in distributions.MEMBERS:
        raise checks.fail(
            f"{path}.{kind}",
            name,
            "the name of a distribution",
            did_you_mean(name, distributions.MEMBERS),
        )
    taken = _taken(name)
    known_keys(table, path, (kind, "shared", *taken))
    shared = table.get("shared", False)
    if not isinstance(shared, bool):
        raise checks.fail(f"{path}.shared", shared, "true or false")
    values = {
        word: _argument(word, table[word], f"{path}.{word}") for word in taken if word in table
    }
    for word, needed in taken.items():
        if needed and word not in values:
            raise checks.fail(
                f"{path}.{word}",
                Words("nothing"),
                "a number or a list of numbers",
                f"{name} needs it.",
            )
    return getattr(distributions, kind)(construct(_made_by(name), values, path), shared=shared)


def _argument(word: str, value: Any, path: str) -> Any:
    """What a distribution is given: numbers, or the name of a group."""
    return checks.word(path, value, "a name") if word == "group" else numbers(value, path)


def _said_as_now(kind: str, old: dict[str, Any], table: dict[str, Any]) -> str:
    """The remedy for the spelling that tuning files once had, { factor = { uniform = [0.7, 1.3] }
    }, with the user's own numbers.
    """
    name, given = next(iter(old.items()), ("", None))
    if len(old) != 1 or name not in distributions.MEMBERS:
        return SUCH_AS
    values = given if isinstance(given, list) and name != "choice" else [given]
    said = given if isinstance(given, dict) else dict(zip(_taken(name), values, strict=False))
    missing = {word: Words("...") for word, needed in _taken(name).items() if needed}
    rest = {key: value for key, value in table.items() if key != kind}
    return f"This is now written {inline_table({kind: name} | missing | said | rest)}."

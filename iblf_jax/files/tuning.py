"""Reads tuning files, which describe a tuning as validated TOML, and results of earlier versions.

A tuning file is a scenario file (`files.scenario`) with four more tables, of which [perturbations]
is that of a study file (`files.study`):

    preset = "zhang_yan_2024"
    [run]                                   # duration, dt, method
    duration = 5.0
    [tune]                                  # runs, seed, risk, level, effort, confirm of `tune`
    parameters = [
      "controller.k1",
      { path = "controller.K2", low = 0.6, high = 40.0, tied = true },
    ]
    [tune.solver]                           # or solver = "sqp"; without it, `tune` chooses one
    kind = "sqp"                            # a name in ij.tuning.SOLVERS, with the options of its
    starts = 4                              # class, such as ij.tuning.SQP
    [tune.report]                           # the options of ij.tuning.Report
    runs = 2000
    [[objective]]                           # functions of iblf_jax.objectives with their arguments,
    kind = "tracking"                       # and a weight
    [[objective]]
    kind = "effort"
    weight = 0.5
    [[objective]]                           # any metric by its name; `fold` only for one with
    kind = "metric"                         # thresholds of one's own
    name = "iae"
    [[requirement]]
    kind = "margin_above"
    limit = 0.05
    [[requirement]]                         # of some joints, by index, name or slice;
    kind = "peak_torque_below"              # a limit for each, or one for all
    joints = ["shoulder", "elbow"]          # or [0, 1], or "0:2"
    limit = [140.0, 27.0]
    [perturbations]
    "plant.mass[1]" = { factor = "uniform", low = 0.7, high = 1.3 }
    "initial.q" = { offset = "normal", mean = 0.0, std = 0.02, shared = true }

Every value is checked, and each error is a ValueError that names the dotted key.  Earlier versions
wrote the result of a tuning as JSON with all its numbers in full precision; `ij.load` reads it.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from iblf_jax.core import checks
from iblf_jax.files import components
from iblf_jax.files.scenario import from_dict, read_toml
from iblf_jax.files.study import perturbations_of
from iblf_jax.files.values import Words, as_table, did_you_mean, known_keys, missing, numbers
from iblf_jax.simulation import metrics
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.studies import distributions
from iblf_jax.studies.distributions import Distribution, Perturbation
from iblf_jax.studies.draws import targets_of
from iblf_jax.tuning import objectives, quantities
from iblf_jax.tuning._tune import tune
from iblf_jax.tuning.objectives import Objective, checked
from iblf_jax.tuning.options import Effort, Report, effort_of
from iblf_jax.tuning.parameters import tunable
from iblf_jax.tuning.result import TuneResult, TuneSetup
from iblf_jax.tuning.robust import KINDS, Risk, cvar
from iblf_jax.tuning.solvers import SOLVERS

components.FAMILIES.setdefault(
    quantities.Quantity, components.family("tuning.quantities", quantities.MEMBERS)
)
components.FAMILIES.setdefault(metrics.Fold, components.family("metrics", metrics.MEMBERS))
components.FAMILIES.setdefault(
    Distribution, components.family("studies.distributions", distributions.MEMBERS)
)

OBJECTIVES = (
    "tracking",
    "effort",
    "torque_rate",
    "settle",
    "peak_torque",
    "margin",
    "velocity_margin",
    "region_margin",
    "metric",
)
REQUIREMENTS = (
    "error_below",
    "peak_torque_below",
    "margin_above",
    "velocity_margin_above",
    "region_margin_above",
    "violation_probability_below",
)
TABLES = ("tune", "objective", "requirement", "perturbations")
HISTORY = dict.fromkeys(
    ("loss", "objective", "terms", "excess", "margin", "gradient_norm", "z", "x"), "f"
) | {
    "valid": "b",
    "evaluations": "iu",
}
"""Name of an array in the history of a result -> the kinds of number that it may have."""
ARGUMENTS = ("runs", "seed", "backend", "confirm")
"""Keys of [tune] besides `parameters`, `risk`, `level`, `solver`, `effort` and `report`."""


def load_tuning_file(
    path: str | os.PathLike, *, modules: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The arguments of `tune` that a tuning file describes, the scenario among them.

    Args:
      path: a file in the format that the docstring of this module describes.
      modules: modules that the file cannot describe, as `load_scenario` takes them.

    Raises:
      ValueError: the file is not TOML or does not describe a tuning; the message names file, key
        and remedy.
      OSError: the file cannot be read.
    """
    data, source, folder = read_toml(path), os.fspath(path), Path(path).parent
    file = from_dict(data, source, other_tables=TABLES, folder=folder, modules=modules)
    try:
        options = _options(as_table(data.get("tune", {}), "tune"))
        options["objective"] = _objective(data)
        options["perturbations"] = perturbations_of(data)
    except ValueError as error:
        raise checks.with_location(source, error) from error
    timing = {key: x for key, x in file.run.items() if key != "record_every"}
    return {"scenario": file.scenario, "duration": 5.0, **options, **timing}


def tune_file(
    path: str | os.PathLike, *, modules: Mapping[str, Any] | None = None, **options: Any
) -> TuneResult:
    """Runs `tune` on a tuning file; options replace the file's.

    Args:
      path: a tuning file.
      modules: modules that the file cannot describe, as `load_scenario` takes them.
      options: arguments of `tune`.

    Raises:
      ValueError, OSError: as `load_tuning_file` and `tune`.
    """
    return tune(**{**load_tuning_file(path, modules=modules), **options})


def _options(table: dict[str, Any]) -> dict[str, Any]:
    """The arguments of `tune` in the table [tune]."""
    own = ("parameters", "risk", "level", "solver", "effort", "report")
    known_keys(table, "tune", (*own, *ARGUMENTS))
    parameters = table.get("parameters", Words("nothing"))
    if not isinstance(parameters, list):
        expected = 'a list of paths, such as ["controller.K2"]'
        raise checks.fail("tune.parameters", parameters, expected)
    options: dict[str, Any] = {
        "parameters": [_parameter(x, f"tune.parameters[{i}]") for i, x in enumerate(parameters)]
    }
    options |= {key: table[key] for key in ARGUMENTS if key in table}
    if "solver" in table:
        options["solver"] = _solver(table["solver"])
    if isinstance(table.get("effort"), dict):
        known_keys(table["effort"], "tune.effort", [x.name for x in dataclasses.fields(Effort)])
        options["effort"] = components.construct(Effort, dict(table["effort"]), "tune.effort")
    elif "effort" in table:
        options["effort"] = effort_of(table["effort"])
    if "report" in table:
        report = as_table(table["report"], "tune.report")
        known_keys(report, "tune.report", [field.name for field in dataclasses.fields(Report)])
        options["report"] = components.construct(Report, dict(report), "tune.report")
    if "risk" in table:
        checks.one_of("tune.risk", table["risk"], KINDS)
        options["risk"] = table["risk"]
    if options.get("risk") == "cvar" and "level" in table:
        options["risk"] = components.construct(cvar, {"level": table["level"]}, "tune.level")
    return options


def _solver(given: object) -> Any:
    """The solver of a name, or of a table with its kind and options."""
    if isinstance(given, str):
        given = {"kind": given}
    table = dict(as_table(given, "tune.solver"))
    kind = table.pop("kind", Words("nothing"))
    checks.one_of("tune.solver.kind", kind, SOLVERS)
    options = [field.name for field in dataclasses.fields(SOLVERS[kind])]
    known_keys(table, "tune.solver", ("kind", *options))
    return components.construct(SOLVERS[kind], table, "tune.solver")


def _parameter(entry: object, key: str) -> Any:
    if isinstance(entry, str):
        return entry
    table = dict(as_table(entry, key))
    known_keys(table, key, ("path", "low", "high", "tied", "scale"))
    path = checks.string(f"{key}.path", table.pop("path", Words("nothing")), "the path of a leaf")
    for name in ("low", "high"):
        if name in table:
            table[name] = numbers(table[name], f"{key}.{name}")
    return components.construct(tunable, {"path": path, **table}, key)


def _term(
    allowed: tuple[str, ...],
    entry: object,
    key: str,
    other_keys: tuple[str, ...] = (),
) -> Any:
    """The objective or requirement that a table describes.

    Args:
      allowed: the functions of `objectives` that `kind` may name.
      entry: the table.
      key: dotted key of the table.
      other_keys: further keys that the table may have.
    """
    table = as_table(entry, key)
    checks.one_of(f"{key}.kind", table.get("kind"), allowed)
    function = getattr(objectives, table["kind"])
    if function is objectives.metric and "fold" not in table:
        result = table.get("name", Words("nothing"))
        owners = {
            name: kind
            for kind, fold in metrics.MEMBERS.items()
            for name in getattr(fold, "units", ())
        }
        if not isinstance(result, str) or result not in owners:
            remedy = did_you_mean(result, owners)
            raise checks.fail(f"{key}.name", result, "the name of a metric", remedy)
        table = table | {"fold": owners[result]}
    taken = inspect.signature(function).parameters
    known_keys(table, key, ("kind", *other_keys, *taken))
    for name, parameter in taken.items():
        if parameter.default is parameter.empty and name not in table:
            expected = f"{_TEXT_ARGUMENTS.get(name, 'a number')}; {table['kind']} needs it"
            raise missing(f"{key}.{name}", expected)
    given = {name: _argument(name, table[name], f"{key}.{name}") for name in taken if name in table}
    return components.construct(function, given, key)


_TEXT_ARGUMENTS = {"fold": "a metric", "name": "the name of one of its results"}
"""Argument of an objective that is not a number -> its description in words."""


def _argument(name: str, value: object, key: str) -> Any:
    if name == "joints":
        return value  # the function checks it
    if name == "name":
        return checks.string(key, value, _TEXT_ARGUMENTS[name])
    if name != "fold":
        return numbers(value, key)
    if isinstance(value, str):
        value = {"kind": value}
    return components.decode(value, metrics.Fold, key)


def _objective(data: dict[str, Any]) -> Objective:
    """The objective with its requirements."""
    terms, requirements = data.get("objective", []), data.get("requirement", [])
    if not isinstance(terms, list) or not terms:
        came = terms or Words("nothing")
        remedy = 'Such as kind = "tracking".'
        raise checks.fail("objective", came, "at least one [[objective]] table", remedy)
    total = Objective()
    for i, entry in enumerate(terms):
        key = f"objective[{i}]"
        term = _term(OBJECTIVES, entry, key, ("weight",))
        weight = numbers(entry.get("weight", 1.0), f"{key}.weight")
        total += components.construct(term.__mul__, {"weight": weight}, key)
    if not isinstance(requirements, list):
        remedy = 'Such as kind = "margin_above".'
        raise checks.fail("requirement", requirements, "[[requirement]] tables", remedy)
    for i, entry in enumerate(requirements):
        total += _term(REQUIREMENTS, entry, f"requirement[{i}]")
    return total


# ------------------------------------------------------------- saved results of earlier versions


def load_tuning(path: str | os.PathLike, *, modules: Mapping[str, Any] | None = None) -> TuneResult:
    """A result in the JSON of earlier versions; its `report` is made again, on the same fresh
    draws.

    Args:
      path: a file that `TuneResult.save` wrote in these versions.
      modules: modules that the file cannot describe, as `load_scenario` takes them.

    Raises:
      ValueError: the file is something else, or a module that it cannot describe is missing.
      OSError: the file cannot be read.
    """
    place, expected = checks.file_to_read("path", path), "a file that TuneResult.save wrote"
    try:
        data = json.loads(place.read_text(encoding="utf-8"))
        if data["what"] != "iblf_jax tuning result":
            raise KeyError("what")
    except Exception as error:
        raise checks.fail("path", str(place), expected) from error
    try:
        return _decoded(data, modules)
    except Exception as error:  # A missing or wrong entry raises errors of many kinds.
        found = f"{type(error).__name__}: {error}"
        raise checks.fail("path", str(place), expected, found) from error


def _array(entry: dict[str, Any], kinds: str) -> np.ndarray:
    if np.dtype(entry["dtype"]).kind not in kinds:
        raise checks.fail("history", entry["dtype"], f"numbers of kind {kinds}")
    return np.asarray(entry["values"], entry["dtype"]).reshape(entry["shape"])


def _with_new_names(table: Any) -> Any:
    """The table of an objective with the key `weights` in place of `joints`, as earlier versions
    called the weights of a quantity: floating-point numbers.
    """
    if isinstance(table, list):
        return [_with_new_names(x) for x in table]
    if not isinstance(table, dict):
        return table
    found = {key: _with_new_names(value) for key, value in table.items()}
    if table.get("kind") in quantities.MEMBERS and "joints" in table:
        joints = table["joints"]
        entries = joints if isinstance(joints, list) else [joints]
        if any(isinstance(x, float) for x in entries):
            found["weights"] = found.pop("joints")
    return found


OF_REPORT = {"report_runs": "runs", "report_seed": "seed", "confidence": "confidence"}
"""Name of an option in these files -> its name in `Report`."""


def _decoded_setup(data: dict[str, Any]) -> TuneSetup:
    """The options of a saved result, checked."""
    saved = dict(data["setup"])
    report = Report(**{field: saved.pop(name) for name, field in OF_REPORT.items()})
    checks.seed(report.seed, "report_seed")
    for name, decode in (("limits", float), ("reasons", str)):
        saved[name] = tuple((decode(low), decode(high)) for low, high in saved.get(name, ()))
    objective = _with_new_names(data["objective"])
    setup = TuneSetup(
        objective=checked(components.decode_fields(Objective, objective, "objective")),
        perturbations={
            key: components.decode_fields(Perturbation, x, key)
            for key, x in data["perturbations"].items()
        },
        risk=Risk(*data["risk"]),
        report=report,
        **saved,
    )
    return setup.checked()


def _decoded_history(table: dict[str, Any], count: int) -> dict[str, np.ndarray]:
    """The history of a saved result with `count` tuned numbers, checked."""
    history = {name: _array(table[name], kinds) for name, kinds in HISTORY.items()}
    steps, starts, size = history["x"].shape
    shapes = {x.shape[:2] for name, x in history.items() if name != "evaluations"}
    fits = shapes == {(steps, starts)} and history["evaluations"].shape == (steps,)
    if size != count or not steps or not fits:
        came = Words("arrays that do not fit each other")
        raise checks.fail("history", came, f"(steps, starts, ...) of {count} numbers")
    return history


def _tuned_objective(data: dict[str, Any], history: dict[str, np.ndarray]) -> float:
    """The objective at the tuned gains; earlier versions stored it in the history only, where it is
    the lowest one without a violation.
    """
    if "tuned_objective" in data:
        return float(data["tuned_objective"])
    violation = np.maximum(np.sum(np.maximum(history["excess"], 0.0), axis=-1), 0.0)
    violation = np.where(history["valid"], violation + np.maximum(-history["margin"], 0.0), np.inf)
    is_best = violation == np.min(violation)
    return float(np.min(np.where(is_best, history["objective"], np.inf)))


def _decoded(data: dict[str, Any], modules: Mapping[str, Any] | None) -> TuneResult:
    """The result that a file describes."""
    start = from_dict(data["start"], modules=modules).scenario
    values = {key: np.asarray(numbers(x, key)) for key, x in data["values"].items()}
    setup = _decoded_setup(data)
    targets_of(start, setup.perturbations)
    words = {
        name: checks.string(name, data[name], "a string")
        for name in ("stopped", "optimiser", "mode")
    }
    if words["optimiser"] == "newton":  # as earlier versions called SQP
        words["optimiser"] = "sqp"
    names = tuple(checks.string("names", name, "a string") for name in data["names"])
    history = _decoded_history(data["history"], len(names))
    starts = history["x"].shape[1]
    best = checks.positive_integer("best_start", data["best_start"], least=0, most=starts - 1)
    seconds = checks.positive_number("seconds", data["seconds"], "s", zero=True)
    return TuneResult(
        with_parameters(start, values),
        start,
        values,
        names,
        history,
        best,
        seconds=seconds,
        setup=setup,
        multipliers=tuple(map(float, data["multipliers"])),
        residuals=tuple(map(float, data["residuals"])),
        probes=checks.positive_integer("probes", data["probes"], least=0),
        objective=_tuned_objective(data, history),
        tried=tuple(checks.string("tried", x, "a string") for x in data.get("tried", ())),
        stopped=words["stopped"],
        optimiser=words["optimiser"],
        mode=words["mode"],
    )

"""Tuning files: what to tune, as typed, validated TOML; and saved results, from which the report can be made again.

A tuning file is a scenario file (`scenario_file`) with four more tables:

    preset = "zhang_yan_2024"
    [run]                                   # duration, dt, method
    duration = 5.0
    [tune]                                  # the arguments of `tune`: runs, seed, risk, level, starts, iterations, report_runs, ...
    parameters = ["controller.k1", { path = "controller.K2", low = 0.6, high = 40.0, tied = true }]
    [[objective]]                           # functions of iblf_jax.objectives with their arguments, and a weight
    kind = "tracking"
    [[objective]]
    kind = "effort"
    weight = 0.5
    [[requirement]]
    kind = "margin_above"
    limit = 0.05
    [perturbations]
    "plant.mass[1]" = { factor = { uniform = [0.7, 1.3] } }
    "initial.q" = { offset = { normal = [0.0, 0.02] }, shared = true }

Everything is checked; each refusal is a ValueError that names the dotted key.  A saved result is JSON with all its numbers in full.
"""

from __future__ import annotations

import inspect
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from iblf_jax import checks, codec, distributions, metrics
from iblf_jax.distributions import Distribution, Perturbation
from iblf_jax.paths import with_parameters
from iblf_jax.plain import Words, as_table, known_keys
from iblf_jax.scenario_file import from_dict, read_toml, scenario_to_dict
from iblf_jax.tuning import objectives, quantities
from iblf_jax.tuning._tune import tune
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.parameters import tunable
from iblf_jax.tuning.result import Setup, TuneResult
from iblf_jax.tuning.robust import Risk, cvar

DISTRIBUTIONS = {
    "uniform": distributions.Uniform,
    "normal": distributions.Normal,
    "log_uniform": distributions.LogUniform,
    "choice": distributions.Choice,
}
codec.FAMILIES.setdefault(quantities.Quantity, ("quantities", quantities.MEMBERS))
codec.FAMILIES.setdefault(metrics.Fold, ("metrics", metrics.MEMBERS))
codec.FAMILIES.setdefault(Distribution, ("distributions", DISTRIBUTIONS))

OBJECTIVES = ("tracking", "effort", "torque_rate", "settle", "peak_torque", "margin")
REQUIREMENTS = ("error_below", "peak_torque_below", "margin_above", "violation_probability_below")
TABLES = ("tune", "objective", "requirement", "perturbations")
ARGUMENTS = (
    *("runs", "seed", "resample", "optimiser", "mode", "starts", "sharpenings", "iterations", "tolerance", "patience"),
    *("learning_rate", "backend", "report_runs", "report_seed", "confidence"),
)
"""What [tune] may hold besides `parameters`, `risk` and `level`."""


def load_tuning_file(path: str | os.PathLike) -> dict[str, Any]:
    """The arguments of `tune` that a tuning file describes, the scenario among them.

    Args:
      path: a file in the format at the head of this module.

    Raises:
      ValueError: the file is not TOML or does not describe a tuning; the message names file, key and mend.
      OSError: the file cannot be read.
    """
    data, source = read_toml(path), os.fspath(path)
    file = from_dict(data, source=source, other_tables=TABLES, folder=Path(path).parent)
    try:
        options = _options(as_table(data.get("tune", {}), "tune"))
        goal = _objective(data.get("objective", []), data.get("requirement", []))
        table = as_table(data.get("perturbations", {}), "perturbations")
        drawn = {key: _perturbation(value, f"perturbations.{key}") for key, value in table.items()}
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error
    timing = {"duration": 5.0} | {key: x for key, x in dict(file.run or {}).items() if key in ("duration", "dt", "method")}
    return {"scenario": file.scenario, "objective": goal, "perturbations": drawn, **options, **timing}


def tune_file(path: str | os.PathLike, **options: Any) -> TuneResult:
    """Runs `tune` on a tuning file; options replace the file's.

    Raises:
      ValueError, OSError: as `load_tuning_file` and `tune`.
    """
    return tune(**{**load_tuning_file(path), **options})


def _options(table: dict[str, Any]) -> dict[str, Any]:
    known_keys(table, "tune", ("parameters", "risk", "level", *ARGUMENTS))
    if not isinstance(table.get("parameters"), list):
        raise checks.fail("tune.parameters", table.get("parameters", Words("nothing")), 'a list of paths, such as ["controller.K2"]')
    parameters = [_parameter(x, f"tune.parameters[{i}]") for i, x in enumerate(table["parameters"])]
    options = {"parameters": parameters, **{key: table[key] for key in ARGUMENTS if key in table}}
    if "risk" in table:
        options["risk"] = cvar(table["level"]) if table["risk"] == "cvar" and "level" in table else table["risk"]
    return options


def _parameter(entry: Any, key: str) -> Any:
    if isinstance(entry, str):
        return entry
    table = as_table(entry, key)
    known_keys(table, key, ("path", "low", "high", "tied", "scale"))
    if "path" not in table:
        raise checks.fail(f"{key}.path", Words("nothing"), "the path of a leaf")
    return tunable(**table)


def _called(module: Any, allowed: tuple[str, ...], entry: Any, key: str, besides: tuple[str, ...] = ()) -> Any:
    table = as_table(entry, key)
    checks.one_of(f"{key}.kind", table.get("kind"), allowed)
    function = getattr(module, table["kind"])
    known_keys(table, key, ("kind", *besides, *inspect.signature(function).parameters))
    arguments = {name: value for name, value in table.items() if name not in ("kind", *besides)}
    try:
        return function(**arguments)
    except TypeError as error:
        raise ValueError(f"{key}: {error}") from error


def _objective(terms: Any, requirements: Any) -> Objective:
    if not isinstance(terms, list) or not terms:
        raise checks.fail("objective", Words("nothing"), "at least one [[objective]] table", 'Such as kind = "tracking".')
    total = Objective()
    for i, entry in enumerate(terms):
        key = f"objective[{i}]"
        total += as_table(entry, key).get("weight", 1.0) * _called(objectives, OBJECTIVES, entry, key, ("weight",))
    for i, entry in enumerate(requirements):
        total += _called(objectives, REQUIREMENTS, entry, f"requirement[{i}]")
    return total


def _perturbation(entry: Any, key: str) -> Perturbation:
    table = dict(as_table(entry, key))
    shared = table.pop("shared", False)
    if len(table) != 1 or next(iter(table)) not in distributions.KINDS:
        raise checks.fail(key, entry, "one of factor, offset, value", "Such as { factor = { uniform = [0.7, 1.3] } }.")
    kind, inner = next(iter(table.items()))
    inner = as_table(inner, f"{key}.{kind}")
    if len(inner) != 1 or next(iter(inner)) not in DISTRIBUTIONS:
        raise checks.fail(f"{key}.{kind}", inner, "one of " + ", ".join(DISTRIBUTIONS), "Such as { uniform = [0.7, 1.3] }.")
    name, arguments = next(iter(inner.items()))
    if not isinstance(arguments, list):
        raise checks.fail(f"{key}.{kind}.{name}", arguments, "a list of its arguments")
    arguments = [arguments] if name == "choice" else arguments
    return getattr(distributions, kind)(getattr(distributions, name)(*arguments), shared=shared)


# ------------------------------------------------------------------------------------------------------------- saved results


def save_tuning(result: TuneResult, path: str | os.PathLike) -> None:
    """Writes a result to a JSON file that `load_tuning` gives back; errors as `TuneResult.save`."""
    setup = result.setup
    numbers = {name: {"dtype": str(x.dtype), "shape": x.shape, "values": x.ravel().tolist()} for name, x in result.history.items()}
    plain = ("runs", "seed", "duration", "dt", "method", "backend", "report_runs", "report_seed", "confidence", "limits")
    data = {
        "what": "iblf_jax tuning result",
        "start": scenario_to_dict(result.start),
        "values": {key: np.asarray(x).tolist() for key, x in result.values.items()},
        "history": numbers,
        "setup": {name: getattr(setup, name) for name in plain},
        "risk": list(setup.risk),
        "objective": codec.encode_fields(setup.objective, "objective"),
        "perturbations": {key: codec.encode_fields(x, key) for key, x in setup.perturbations.items()},
        **{name: getattr(result, name) for name in ("names", "best_start", "stopped", "optimiser", "mode", "seconds")},
        "report": result.report.to_dict(),
    }
    target = Path(path)
    temporary = target.with_name(f".{target.name}.partial")
    temporary.write_text(json.dumps(data, indent=1), encoding="utf-8")
    os.replace(temporary, target)


def load_tuning(path: str | os.PathLike) -> TuneResult:
    """A saved result; its `report` is made again, on the same fresh draws.

    Args:
      path: a file that `TuneResult.save` wrote.

    Raises:
      ValueError: the file is something else.
      OSError: the file cannot be read.
    """
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
        if data["what"] != "iblf_jax tuning result":
            raise KeyError("what")
    except (ValueError, KeyError, TypeError) as error:
        raise checks.fail("path", os.fspath(path), "a file that TuneResult.save wrote") from error
    start = from_dict(data["start"], source=os.fspath(path)).scenario
    values = {key: np.asarray(x) for key, x in data["values"].items()}
    setup = Setup(
        objective=codec.decode_fields(Objective, data["objective"], "objective"),
        perturbations={key: codec.decode_fields(Perturbation, x, key) for key, x in data["perturbations"].items()},
        risk=Risk(*data["risk"]),
        **data["setup"] | {"limits": tuple((low, high) for low, high in data["setup"].get("limits", ()))},
    )
    history = {name: np.asarray(x["values"], x["dtype"]).reshape(x["shape"]) for name, x in data["history"].items()}
    rest = {name: data[name] for name in ("best_start", "stopped", "optimiser", "mode", "seconds")}
    return TuneResult(with_parameters(start, values), start, values, tuple(data["names"]), history, setup=setup, **rest)

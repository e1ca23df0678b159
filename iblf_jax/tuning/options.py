"""Options of `tune`: the report's, the choice of a solver, and keyword arguments of earlier
versions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from iblf_jax.core import checks, notices
from iblf_jax.studies.designs import MAX_RUNS
from iblf_jax.studies.statistics import check_confidence
from iblf_jax.tuning.runs import differentiates_forward
from iblf_jax.tuning.solvers import SOLVERS, Solver
from iblf_jax.tuning.solvers._base import CHECKS

EARLIER_NAMES = {"auto": "auto", "newton": "sqp", "lbfgs": "lbfgs", "adam": "adam"}
"""Value of `optimiser` in earlier versions -> name of the solver."""


@dataclasses.dataclass(frozen=True)
class Report:
    """Options of the report on a tuning.

    Args:
      runs: fresh runs; without perturbations the report is on the one nominal run.
      seed: of their draws; the tuning's seed + 1 if not given.
      confidence: of the intervals.
    """

    runs: int = 1000
    seed: int | None = None
    confidence: float = 0.95

    def __post_init__(self) -> None:
        runs = checks.positive_integer("report_runs", self.runs, most=MAX_RUNS)
        object.__setattr__(self, "runs", runs)
        if self.seed is not None:
            object.__setattr__(self, "seed", checks.seed(self.seed, "report_seed"))
        object.__setattr__(self, "confidence", check_confidence(self.confidence))


REPLACED = {
    "optimiser": "solver=ij.tuning.SQP(), ij.tuning.LBFGS() or ij.tuning.Adam()",
    "mode": "solver=ij.tuning.LBFGS(mode=...)",
    "resample": "solver=ij.tuning.Adam(resample=...)",
    "learning_rate": "solver=ij.tuning.Adam(learning_rate=...)",
    **{
        name: f"solver=ij.tuning.SQP({name}=...)"
        for name in ("starts", "sharpenings", "tolerance", "patience")
    },
    "report_runs": "report=ij.tuning.Report(runs=...)",
    "report_seed": "report=ij.tuning.Report(seed=...)",
    "confidence": "report=ij.tuning.Report(confidence=...)",
    "callback": "progress=callback",
}
"""Keyword argument of `tune` in earlier versions -> what replaces it."""
OF_REPORT = {"report_runs": "runs", "report_seed": "seed", "confidence": "confidence"}
ARGUMENTS = (
    *("scenario", "parameters", "objective", "duration", "dt", "method", "backend"),
    *("perturbations", "runs", "seed", "risk", "solver", "iterations", "report", "checkpoint"),
    "progress",
)


class Options(NamedTuple):
    """The options of a call of `tune`."""

    solver: Solver | None
    """None: chosen by the number of coordinates."""
    of_automatic: dict[str, Any]
    """Options of the solver that is chosen automatically, from deprecated keyword arguments."""
    report: Report
    show: bool | None
    """Whether a progress bar is shown."""
    callback: Callable[[Any], None] | None
    """Called with the search after each step."""


def options_of(
    solver: Solver | str | None,
    report: Report | None,
    progress: bool | Callable[[Any], None] | None,
    deprecated: Mapping[str, Any],
) -> Options:
    """Checks the options of `tune`.

    Args:
      solver, report, progress: as the user gave them.
      deprecated: further keyword arguments.

    Raises:
      TypeError: an unknown keyword argument.
      ValueError: an option that is not valid.
    """
    for name in deprecated:
        if name not in REPLACED:
            near = checks.did_you_mean(name, (*ARGUMENTS, *REPLACED))
            text = f"tune() got an unexpected keyword argument {name!r}. {near}".rstrip()
            raise TypeError(f"{text} Its arguments are {', '.join(ARGUMENTS)}.")
        notices.warn(
            f"The keyword argument {name} of ij.tune is deprecated: write {REPLACED[name]}.",
            DeprecationWarning,
        )
    given = dict(deprecated)
    callback = given.pop("callback", None)
    if callback is not None and not callable(callback):
        expected = "a function that is called with the search after each step"
        raise checks.fail("callback", callback, expected)
    of_report = {OF_REPORT[name]: given.pop(name) for name in OF_REPORT if name in given}
    if of_report and report is not None:
        raise _given_twice("report", of_report)
    report = Report(**of_report) if of_report else _report(report)
    if given and solver is not None:
        raise _given_twice("solver", given)
    checked = {name: _checked(name, value) for name, value in given.items()}
    if callable(progress):
        return Options(_solver(solver), checked, report, False, progress)
    return Options(_solver(solver), checked, report, progress, callback)


def _report(given: Any) -> Report:
    if given is None:
        return Report()
    if not isinstance(given, Report):
        remedy = "Such as ij.tuning.Report(runs=200)."
        raise checks.fail("report", given, "an ij.tuning.Report", remedy)
    return given


def _given_twice(name: str, further: Mapping[str, Any]) -> ValueError:
    names = ", ".join(further)
    return checks.fail(
        name, checks.Words(f"{name}= and {names}"), "one of them", f"Put {names} into {name}."
    )


def _checked(name: str, value: Any) -> Any:
    if name == "optimiser":
        checks.one_of(name, value, EARLIER_NAMES)
        return EARLIER_NAMES[value]
    return CHECKS[name](name, value)


def _solver(given: Any) -> Solver | None:
    """A solver by its name, or as it is."""
    if given is None:
        return None
    if isinstance(given, str):
        if given == "auto":
            return None
        checks.one_of("solver", given, ("auto", *SOLVERS))
        return SOLVERS[given]()
    members = [x for x in vars(Solver) if not x.startswith("_")]
    expected = f"a solver: one of {', '.join(map(repr, SOLVERS))}, or as ij.tuning.SQP()"
    checks.offers("solver", given, tuple(members), expected)
    return given


def chosen_solver(options: Options, size: int) -> tuple[Solver, str]:
    """The solver for so many coordinates, and the mode of differentiation."""
    solver = options.solver
    if solver is None:
        solver = _automatic(options.of_automatic, size)
    if solver.mode != "auto":
        return solver, solver.mode
    return solver, "forward" if differentiates_forward(size) else "reverse"


def _automatic(given: Mapping[str, Any], size: int) -> Solver:
    """SQP where forward mode is used, else L-BFGS; Adam where runs are resampled."""
    mode = given.get("mode", "auto")
    resample = given.get("resample", False)
    name = given.get("optimiser", "auto")
    is_forward = mode == "forward" or (mode == "auto" and differentiates_forward(size))
    if name == "auto" and resample:
        name = "adam"
    elif name == "auto":
        name = "sqp" if is_forward else "lbfgs"
    if name == "sqp" and mode == "reverse":
        remedy = "Reverse mode has no Gauss-Newton matrix: take solver=ij.tuning.LBFGS()."
        raise checks.fail("mode", mode, '"forward" with SQP', remedy)
    if name != "adam" and resample:
        remedy = "It compares losses of the same runs: take solver=ij.tuning.Adam(resample=True)."
        raise checks.fail("resample", resample, f"False with {name}", remedy)
    solver: Any = SOLVERS[name]
    fields = [field.name for field in dataclasses.fields(solver)]
    return solver(**{option: x for option, x in given.items() if option in fields})

"""The options of `tune`: those of its runs, of its report and of its search."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Self

import jax

from iblf_jax.core import checks
from iblf_jax.core.families import required_members
from iblf_jax.engine import Runs, differentiates_forward
from iblf_jax.studies.designs import MAX_RUNS
from iblf_jax.studies.statistics import check_confidence
from iblf_jax.tuning.robust import as_risk
from iblf_jax.tuning.solvers import SOLVERS, Solver


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("duration", "dt", "perturbations", "seed"),
    meta_fields=("method", "backend", "runs", "risk"),
)
@dataclasses.dataclass(frozen=True, eq=False)
class TuningRunOptions(Runs):
    """The options of the runs of a tuning, which its problem, its result and its report share.

    To add an option, add a field of this class and a keyword argument of `tune`, which passes it to
    `TuningProblem.build`.
    """

    perturbations: Any = None
    """Path -> `Perturbation`; if empty, there is one nominal run."""
    runs: int = 1
    """Number of perturbed runs in the loss."""
    risk: Any = "mean"
    """How the losses of the runs are combined; a `Risk` once it is checked."""

    # Objects with traced numbers have no value to compare.
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def __post_init__(self) -> None:
        """Checks nothing, because JAX makes the object with traced numbers too."""

    def checked(self) -> Self:
        """The options after a check, converted to their types.

        The perturbations are not checked here, because that requires a scenario.

        Raises:
          ValueError: an option that is not valid; the message names it and the remedy.
        """
        checked = dataclasses.replace(
            self,
            runs=checks.positive_integer("runs", self.runs, most=MAX_RUNS),
            perturbations={} if self.perturbations is None else self.perturbations,
            risk=as_risk(self.risk),
        )
        Runs.__post_init__(checked)
        return checked


@dataclasses.dataclass(frozen=True)
class Report:
    """Options of the report on a tuning.

    Args:
      runs: number of fresh runs; without perturbations the report is on the one nominal run.
      seed: of the draws of these runs; the tuning's seed + 1 if not given.
      confidence: level of the confidence intervals.
    """

    runs: int = 1000
    seed: int | None = None
    confidence: float = 0.95

    def __post_init__(self) -> None:
        runs = checks.positive_integer("report.runs", self.runs, most=MAX_RUNS)
        object.__setattr__(self, "runs", runs)
        if self.seed is not None:
            object.__setattr__(self, "seed", checks.seed(self.seed, "report.seed"))
        object.__setattr__(self, "confidence", check_confidence(self.confidence))


@dataclasses.dataclass(frozen=True)
class Effort:
    """How much a tuning evaluates at most.

    All starts take `selection` steps, those that have not come near a better one take as many
    again, and so once more, the better third of these takes as many again, and so on until the best
    one is left.  Until then a search takes at most 565 evaluations with derivatives with the
    defaults: five steps each of 32, 32, 32, 11, 4 and 2 starts.  With more than six starts of SQP a
    second search follows from up to four points at which one or two of the best gains are at an end
    of their range, chosen from a third as many points.  Where fewer than an eighth of the starts
    came within 0.5 % of the best objective, searches from eight points around the best gains may
    follow (`search`).

    Args:
      values: number of points that are evaluated without derivatives to find the starts.  With many
        runs there are fewer points, so that they need at most 50,000 runs.
      starts: number of points that the search begins from.  With more than 128 runs for all of them
        together, and with other solvers than SQP, there are fewer: a fifth or more, and at least
        six.
      iterations: largest number of steps of the solver in each phase of the search.  A step
        evaluates every start that is still active.
      selection: number of steps after which starts near better ones end, and from the third time
        on all but the better third.
      second_starts: number of further starts of the second search around the best gains of the
        first one, chosen from a third as many points; if not given, 12 where only one of more than
        six starts came within 0.5 % of the best objective.  In problems of many gains the best
        optimum is often near a good one.
    """

    values: int = 1024
    starts: int = 32
    iterations: int = 60
    selection: int = 5
    second_starts: int = 0

    def __post_init__(self) -> None:
        limits = {"values": (0, MAX_RUNS), "starts": (1, 1000), "second_starts": (0, 1000)}
        for field in dataclasses.fields(self):
            least, most = limits.get(field.name, (1, checks.MAX_STEPS))
            number = getattr(self, field.name)
            name = f"effort.{field.name}"
            checked = checks.positive_integer(name, number, least=least, most=most)
            object.__setattr__(self, field.name, checked)


EFFORTS = {
    "quick": Effort(values=0, starts=1),
    "normal": Effort(),
    "thorough": Effort(values=8192, starts=96, iterations=120, selection=8, second_starts=32),
}
"""Name -> effort."""


def effort_of(given: str | Effort) -> Effort:
    """The effort that was given, or the one of a name in EFFORTS.

    Raises:
      ValueError: the argument is neither an effort nor a name of one.
    """
    if isinstance(given, Effort):
        return given
    checks.one_of("effort", given, EFFORTS)
    return EFFORTS[given]


class SearchOptions(NamedTuple):
    """The options of a search, of its report and of the progress that it shows."""

    solver: Solver | None
    """The solver; None if `chosen_solver` decides by the number of coordinates."""
    report: Report
    show: bool | None
    """Whether a progress bar is shown; None to show it on a terminal or in a notebook."""
    callback: Callable[[Any], None] | None
    """Function that is called with the search after each step."""
    effort: Effort


def options_of(
    solver: Solver | str | None,
    effort: str | Effort,
    report: Report | None,
    progress: bool | Callable[[Any], None] | None,
) -> SearchOptions:
    """Checks the options of the search and of the report, which are arguments of `tune`.

    Raises:
      ValueError: an option that is not valid.
    """
    budget = effort_of(effort)
    callback = None
    if callable(progress):
        callback = progress
        progress = False
    if report is None:
        report = Report()
    if not isinstance(report, Report):
        remedy = "Such as ij.tuning.Report(runs=200)."
        raise checks.fail("report", report, "an ij.tuning.Report", remedy)
    return SearchOptions(_solver(solver), report, progress, callback, budget)


def _solver(given: Solver | str | None) -> Solver | None:
    """The solver that was given, or the one of a name in SOLVERS; None for "auto" and None."""
    if given is None:
        return None
    if isinstance(given, str):
        checks.one_of("solver", given, ("auto", *SOLVERS))
        return None if given == "auto" else SOLVERS[given]()
    expected = f"a solver: one of {', '.join(map(repr, SOLVERS))}, or as ij.tuning.SQP()"
    checks.offers("solver", given, required_members(Solver), expected)
    return given


def chosen_solver(given: Solver | None, size: int) -> tuple[Solver, str]:
    """The solver for a problem of `size` coordinates, and its mode of differentiation.

    If none is given, SQP in forward mode, and L-BFGS in reverse mode.
    """
    is_forward = differentiates_forward(size)
    solver = given or SOLVERS["sqp" if is_forward else "lbfgs"]()
    if solver.mode != "auto":
        return solver, solver.mode
    return solver, "forward" if is_forward else "reverse"

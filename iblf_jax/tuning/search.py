"""The search calls a solver step by step, updates multipliers and smoothing, and keeps the best
point so far, the incumbent.

Requirements.  A solver with `handles_requirements` gets the requirements as constraints.  For the
other solvers they are part of an augmented Lagrangian.  Its multipliers y and penalty parameter mu
are updated whenever a start has converged, or after STEPS_PER_UPDATE steps,

    y <- max(0, y + mu G),     mu <- PENALTY_FACTOR mu  if the largest G is above a quarter of the
                                                        largest G before,

so that a start that violates requirements becomes feasible while the penalty stays finite.

Comparison.  Points are compared by their violation, the largest excess G of a requirement or bound,
and at equal violation by the objective without smoothing.  A feasible point has the violation 0.
Every point that was evaluated, with derivatives or without, is a candidate for the incumbent,
unless its objective depends on the time step.

Time step.  Gains may be good at the time step of the runs only.  A search with
`Strategy.comparison` therefore evaluates points at a quarter of the step as well (`StepComparison`)
before a phase begins at them, and the best points of the starts after every `selection` steps and
at the end of the phase.  Points do not count where the objective changes too much or the run is
inaccurate even there.  A start whose best point does not count begins anew on the straight line
between its last point that did and this one (`_take_back`), if its objective is below that of the
incumbent; otherwise it is retired.  Points without derivatives are compared before one of them
becomes the incumbent.

Stages.  A peak over time in the objective is replaced by a smooth maximum, which lies above the
maximum by the smoothing times a logarithm.  The smooth objective has its minimum at other gains,
but no narrow valleys, and its minimum is found in few steps.  The search therefore begins with much
smoothing and divides it by SHARPENING at each stage.  An objective without smoothing has one stage.
A stage but the last one ends when all starts have converged to COARSE_TOLERANCE, after `patience`
steps without a better result, or, in problems without requirements, after COARSE_STEPS steps of
several starts or STEPS_PER_UPDATE steps of one.

Phases.  A search with a `Strategy` has up to four phases:

1. OPTIMISE.  All starts take steps as one batch.
2. REPAIR, if phase 1 ends without a feasible point.  As many further points as before are
   evaluated without derivatives.  From the points with the smallest excess the solver minimises
   the largest excess alone.  The phase ends at the first feasible point, when all starts have
   converged, or after REPAIR_STEPS steps.
3. SECOND_SEARCH, if phase 2 found a feasible point, or if phase 1 found one but did not converge.
   It begins at the incumbent and at the best screened point that is far from all earlier starts.
   With `Strategy.starts_at_ends` it also begins at the best points that differ from the incumbent
   in one gain or two, which are at an end of their range, and these also follow a phase 1 that has
   converged.  The best optimum often has some gains at an end: on a problem of two links, whose
   best one has four, most starts of some seeds ended in another valley 4.5 % above it, from which
   the best of such points by the weight 1 led there.
   With `Strategy.second_points` it always follows a feasible point, and begins at the best of so
   many further points instead, which are spread around the incumbent as those of phase 1 around the
   scenario's gains: the best optimum is often near a good one.  Where only one of many starts came
   within SAME_OBJECTIVE of the best objective (`reached_by_one_start`), such a search follows too,
   from STARTS_IF_SINGLE of a third as many points as before.
4. SEARCH_AROUND, with `Strategy.starts_around`, where fewer than AROUND_SHARE of the starts came
   within SAME_OBJECTIVE of the best objective and phase 3 began at no points that are spread around
   the incumbent.  It begins at the best of a third as many points of this kind as before.  It
   follows again where such a phase improved the objective by more than SAME_OBJECTIVE, until
   MOST_AROUND phases began at such points.  The best optimum may differ from the second best in
   most gains.  On a problem of 14 gains two of three searches ended 1 % above the best known
   objective at an optimum to which all of 16 starts within 0.3 returned, and each of four sets of
   eight starts of this phase, taken to their ends, led to within 0.1 % of it.

Every phase also ends after `patience` steps without a better result.  A search without a strategy
has phase 1 only.

Retired starts.  A start that is `finished` takes no steps until the smoothing changes or a phase
begins; a start that is `retired` is finished and takes no steps in the rest of its phase.  Starts
are retired in three places: `_select` keeps the better ones after every `selection` steps of a
phase, `_next_stage` keeps the better half at each stage, and `_begin_phase` retires all starts of
the previous phase.  Rows that only fill up a batch are retired before the first step.  Starts that
take no step cost only the rows that fill the last group of the others (`Evaluator`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.tuning.evaluation import Derivatives, Evaluator, Value
from iblf_jax.tuning.kinks import (
    FIRST_REACH,
    FRACTIONS,
    IMPROVEMENT,
    LEAST_REACH,
    MOST_ROUNDS,
    SHRINK_FACTOR,
    points_near,
    step_between_kinks,
)
from iblf_jax.tuning.objectives import is_smoothed, sharper
from iblf_jax.tuning.optimality import Conditions, conditions, conditions_of_penalty
from iblf_jax.tuning.parameters import along
from iblf_jax.tuning.problem import FIRST_PENALTY
from iblf_jax.tuning.solvers import SQP, SearchSpace, Solver
from iblf_jax.tuning.solvers._base import EXCESS_WEIGHT, violations
from iblf_jax.tuning.solvers.sqp import STATIONARITY_TOLERANCE, Point
from iblf_jax.tuning.starts import (
    FEW_POINTS,
    FEW_STARTS,
    SAME_OBJECTIVE,
    WEIGHTS,
    Screening,
    StepComparison,
    distinct,
    is_near,
    points_at_ends,
    ranked,
    spread_points,
)

if TYPE_CHECKING:
    from iblf_jax.tuning.solvers._base import Evaluation

STEPS_PER_UPDATE = 12
"""Largest number of steps between two updates of the multipliers."""
REPAIR_SEED_OFFSET = 1000
"""Added to the seed for the points that are evaluated in the phase REPAIR."""
SECOND_SEED_OFFSET = 2000
"""Added to the seed for the points that are evaluated before the phase SECOND_SEARCH."""
MAX_UPDATES = 12
"""Largest number of updates of the multipliers in a stage."""
PENALTY_FACTOR = 5.0
"""Factor by which the penalty parameter is increased."""
MAX_PENALTY = 1e6
EXCESS_TOLERANCE = 1e-3
"""Largest |G| at which a start that has converged is finished."""
SHARPENING = 4.0
"""Factor by which the smoothing is divided at each stage."""
COARSE_TOLERANCE = 1e-3
"""Smallest tolerance of the solver in all stages but the last one."""
COARSE_STEPS = 6
"""Largest number of steps of a stage of several starts without requirements.  So many steps are
enough to compare the starts."""
KEPT = 3
"""One of so many starts continues after a selection."""
SELECTIONS_BY_DISTANCE = 2
"""Number of selections in which only starts end that have come near a better one."""
OPTIMISE, REPAIR, SECOND_SEARCH, SEARCH_AROUND = range(4)
"""The phases of a search, in order."""
REPAIR_STEPS = 30
"""Largest number of steps of the phase REPAIR."""
REPAIR_STARTS = 6
"""Largest number of starts of the phase REPAIR."""
MOST_MULTIPLES = 32
"""Largest number of sampling periods that are compared with that of the incumbent."""
KINK_REACH = 0.05
"""Largest distance, in any coordinate z, of a rejected trial whose pieces may be active together
with those of the incumbent (see `optimality`)."""
SAME_VALLEY = 0.5
"""Two points whose distance in every coordinate z is at most this are in the same valley, the
region around one local minimum."""

CONFIRMING_SHARE = 1 / 3
"""Smallest share of the starts that come within SAME_OBJECTIVE of the best objective for which the
search has converged.  Of one tuning of two links, eight of 32 starts ended in a valley 4.5 % above
the best."""
STARTS_AT_ENDS = 4
"""Number of starts of the second search that have one or two gains at an end of their range."""
STARTS_IF_SINGLE = 12
"""Number of starts of the second search where no other start confirms the best objective."""
STARTS_AROUND = 8
"""Number of starts of the phase SEARCH_AROUND."""
AROUND_SHARE = 1 / 8
"""Share of the starts that come within SAME_OBJECTIVE of the best objective below which this phase
follows.  It takes a quarter of a search.  Below a third it would follow in most tunings of nine
gains, where four to seven of 32 starts came near and it changed nothing in three."""
MOST_AROUND = 3
"""Largest number of phases that begin at points around the incumbent."""
FRACTIONS_BACK = np.arange(1, 8) / 8
"""Points on the way from the last point of a start that the time step resolves to one that it does
not resolve.  On a problem of ten gains most of this way is resolved, and the objective falls along
it."""
MOST_COMPARED = 32
"""Largest number of points without derivatives that are evaluated again at a quarter of the time
step."""


class Strategy(NamedTuple):
    """What a search in phases needs besides its starts."""

    screening: Screening
    """The points that were evaluated without derivatives."""
    selection: int
    """Number of steps after which the better starts continue, again and again."""
    starts: int
    """Number of starts in the first phase.  A search has more rows than that where a later phase
    may begin at more points."""
    second_points: int = 0
    """Number of points around the best gains that are evaluated before the phase SECOND_SEARCH."""
    second_starts: int = 0
    """Number of starts of this phase besides the best gains.  If it is 0, the phase follows only
    where the first one did not converge."""
    starts_at_ends: int = 0
    """Number of starts of this phase with one or two gains at an end of their range and all others
    as the best ones.  If it is not 0, the phase always follows."""
    starts_around: int = 0
    """Number of starts of the phase SEARCH_AROUND."""
    comparison: StepComparison | None = None
    """Without it the time step is not examined."""


@dataclasses.dataclass
class SearchState:
    """The state of a search from S starts, which a checkpoint stores."""

    solver: Any
    """State of the solver."""
    best_z: np.ndarray
    """Best trial of each start, (S, p)."""
    best_key: np.ndarray
    """Violation and objective at these trials, (S, 2)."""
    resolved_z: np.ndarray
    """The last of these trials that the time step resolved, (S, p)."""
    incumbent_z: np.ndarray
    """(p,)."""
    multipliers: np.ndarray
    """y of the augmented Lagrangian, (S, R)."""
    penalty: np.ndarray
    """mu of the augmented Lagrangian, (S,)."""
    largest_excess: np.ndarray
    """Largest G at the last update of y, (S,)."""
    steps_since_update: np.ndarray
    """Steps since y was updated, (S,)."""
    updates: np.ndarray
    """Updates of y in this stage, (S,)."""
    finished: np.ndarray
    """See the head of this module, (S,) bool."""
    retired: np.ndarray
    """See the head of this module, (S,) bool."""
    incumbent_key: np.ndarray = dataclasses.field(default_factory=lambda: np.full(2, np.inf))
    """Violation and objective of the incumbent, (2,)."""
    valleys: np.ndarray = dataclasses.field(default_factory=lambda: np.asarray([1, 1, 1, 0]))
    """See `Search._valleys`, (4,)."""
    iteration: int = 0
    """Steps in all."""
    phase: int = OPTIMISE
    """OPTIMISE, REPAIR, SECOND_SEARCH or SEARCH_AROUND."""
    phase_steps: int = 0
    """Steps in this phase."""
    stage: int = 0
    """0 to the number of sharpenings."""
    stage_steps: int = 0
    """Steps in this stage."""
    steps_without_better: int = 0
    """Steps since the best result of all starts improved."""
    evaluations: int = 0
    """Points that were evaluated with derivatives."""
    plain_values: int = 0
    """Points that were evaluated without derivatives."""
    counted_objective: np.ndarray = dataclasses.field(default_factory=lambda: np.asarray(np.inf))
    """The objective of the incumbent when the starts near it were counted, ()."""
    phases_around: int = 0
    """Number of phases that began at points spread around the incumbent."""
    unresolved: int = 0
    """Points at which no search began, and starts that were retired, because their objective
    depends on the time step."""
    repair_ended: bool = False
    """Whether REPAIR ended at a stationary point of the largest excess."""
    least_excess: np.ndarray = dataclasses.field(default_factory=lambda: np.full((1, 1), np.inf))
    """The smallest value, over all points that were evaluated, of the larger excess of every two
    requirements, (R + 1, R + 1); on the diagonal that of one requirement alone.  The bounds are the
    last one."""

    @staticmethod
    def first(solver: Any, z: np.ndarray, requirements: int) -> SearchState:
        """The state before the first step.

        Args:
          solver: state of the solver.
          z: starting points, (S, p).
          requirements: their number R.
        """
        starts = len(z)
        return SearchState(
            solver=solver,
            best_z=z.copy(),
            best_key=np.full((starts, 2), np.inf),
            resolved_z=z.copy(),
            incumbent_z=z[0].copy(),
            multipliers=np.zeros((starts, requirements)),
            penalty=np.full(starts, FIRST_PENALTY),
            largest_excess=np.full(starts, np.inf),
            steps_since_update=np.zeros(starts, int),
            updates=np.zeros(starts, int),
            finished=np.zeros(starts, bool),
            retired=np.zeros(starts, bool),
            least_excess=np.full((requirements + 1, requirements + 1), np.inf),
        )

    def note_excess(self, found: Value) -> None:
        """Updates `least_excess` by the values at further points."""
        excess = np.column_stack([found.exact_excess, -found.margin])
        excess = excess[found.valid & np.all(np.isfinite(excess), axis=1)]
        larger = np.maximum(excess[:, :, None], excess[:, None, :])
        self.least_excess = np.minimum(self.least_excess, np.min(larger, axis=0, initial=np.inf))


class Search:
    """A search from S starts; `run` continues from its `state`.

    Args:
      evaluate: the problem.
      solver: with its options.
      z: starting points, (S, p).
      strategy: of a search in phases.  Without it the search has one phase and no selection.
    """

    def __init__(
        self,
        evaluate: Evaluator,
        solver: Solver,
        z: np.ndarray,
        strategy: Strategy | None = None,
    ):
        self.evaluate = evaluate
        self.solver = solver
        self.strategy = strategy
        self.smoothest = evaluate.problem.objective
        self.stages = 0
        if is_smoothed(self.smoothest):
            self.stages = solver.sharpenings
        self.history: dict[str, list[np.ndarray]] = {}
        self.last_conditions: tuple[int, Conditions] | None = None
        """The number of steps before the conditions were determined, and the conditions."""
        requirements = len(evaluate.problem.allowed)
        self.state = SearchState.first(solver.init(evaluate.space, z), z, requirements)
        evaluate.on_values = self.consider_values
        if strategy is not None:
            self._count(strategy.screening.found)
            if strategy.comparison is not None:
                self.state.plain_values += strategy.comparison.points
                self.state.unresolved = strategy.comparison.unresolved

    def retire(self, starts: slice | np.ndarray | list[int]) -> None:
        """Ends some starts for the rest of the phase."""
        self.state.finished[starts] = True
        self.state.retired[starts] = True

    @property
    def best(self) -> int:
        """The start that found the best result so far."""
        keys = self.state.best_key
        return min(range(len(keys)), key=lambda s: tuple(keys[s]))

    @property
    def is_violated(self) -> bool:
        """Whether the incumbent violates a requirement or a bound, so that no feasible point is
        known.
        """
        return bool(self.state.incumbent_key[0] > 0)

    @property
    def reached_by_one_start(self) -> bool:
        """Whether the search had many starts, and one of them only came within SAME_OBJECTIVE of
        the best objective, so that a better one may well exist.
        """
        return self._reached_by_fewer_than(2)

    @property
    def is_unconfirmed(self) -> bool:
        """Whether the search had many starts, and fewer than CONFIRMING_SHARE of them came within
        SAME_OBJECTIVE of the best objective, or one ended below it, where it broke a requirement.

        Such a start shows another valley, in which a better optimum may lie.  On a problem of ten
        gains 14 and 18 of 32 starts of two seeds came near an optimum 2.5 % above the best one.
        Two and three others ended below it, at an excess of 0.03.
        """
        if self.strategy is None or self.strategy.starts <= FEW_STARTS:
            return False
        is_below = bool(self.state.valleys[3] > 0)
        return is_below or self._reached_by_fewer_than(CONFIRMING_SHARE * self.strategy.starts)

    def _reached_by_fewer_than(self, count: float) -> bool:
        if self.strategy is None or self.strategy.starts <= FEW_STARTS:
            return False
        return bool(self.state.valleys[2] < count)

    def consider_values(self, z: np.ndarray, found: Value) -> None:
        """Counts points, (N, p), that were evaluated without derivatives, and replaces the
        incumbent where one of them is better.
        """
        self._count(found)
        self._consider_points(z, found)

    def _count(self, found: Value) -> None:
        """Counts points that were evaluated without derivatives."""
        self.state.plain_values += len(found.valid)
        self.state.note_excess(found)

    def _consider_points(self, z: np.ndarray, found: Value) -> None:
        """Replaces the incumbent by the best of some points, (N, p), that the time step resolves,
        if that is better.
        """
        keys = _keys(found)
        best = tuple(self.state.incumbent_key)
        valid = np.flatnonzero(found.valid & np.isfinite(found.objective)).tolist()
        better = sorted((i for i in valid if keys[i] < best), key=keys.__getitem__)[:MOST_COMPARED]
        for i in np.array(better, int)[self._are_resolved(z[better], found.objective[better])]:
            self._consider(z[i], keys[i])

    def _consider_starts(self) -> None:
        """Replaces the incumbent by the best point of a start.  The starts whose best point the
        time step does not resolve are taken back, where that point promises a better incumbent, or
        retired.
        """
        state = self.state
        starts = np.flatnonzero(~state.retired & np.isfinite(state.best_key[:, 1]))
        resolved = self._are_resolved(state.best_z[starts], state.best_key[starts, 1])
        for s in starts[resolved]:
            self._consider(state.best_z[s], tuple(state.best_key[s]))
            state.resolved_z[s] = state.best_z[s]
        lost = starts[~resolved].tolist()
        if lost:
            incumbent = tuple(state.incumbent_key)
            promising = [s for s in lost if tuple(state.best_key[s]) < incumbent]
            state.best_key[lost] = np.inf
            state.unresolved += len(lost)
            state.steps_without_better = 0
            returned = self._take_back(promising)
            self.retire([s for s in lost if s not in returned])

    def _take_back(self, starts: list[int]) -> list[int]:
        """Begins starts whose best point the time step does not resolve anew: at the best of
        the points at FRACTIONS_BACK of the way from their last one that it resolves to this one.

        Returns:
          The starts with a point that the time step resolves among these.
        """
        state = self.state
        if not starts:
            return []
        last = state.resolved_z[starts]
        points = last + FRACTIONS_BACK[:, None, None] * (state.best_z[starts] - last)
        points = points.reshape(-1, last.shape[1])
        found = self.evaluate.values(points)
        keys = _keys(found)
        usable = found.valid & self._are_resolved(points, found.objective)
        returned = []
        for i, s in enumerate(starts):
            own = [j for j in range(i, len(points), len(starts)) if usable[j]]
            if own:
                best = min(own, key=keys.__getitem__)
                state.best_z[s] = state.resolved_z[s] = points[best]
                state.best_key[s] = keys[best]
                state.finished[s] = False
                self.solver.restart(self._space(state.phase), state.solver, s, points[best])
                returned.append(s)
        return returned

    def _are_resolved(self, z: np.ndarray, objective: np.ndarray) -> np.ndarray:
        """Whether the objective, (N,), at points, (N, p), is about the same at a quarter of the
        time step, (N,).
        """
        if self.strategy is None or self.strategy.comparison is None:
            return np.ones(len(z), bool)
        self.state.plain_values += len(z)
        return self.strategy.comparison(z, objective)

    def _are_usable(self, z: np.ndarray, objective: np.ndarray) -> np.ndarray:
        """As `_are_resolved`, at points where a search would begin."""
        resolved = self._are_resolved(z, objective)
        self.state.unresolved += int(np.sum(~resolved))
        return resolved

    def _consider(self, z: np.ndarray, key: tuple[float, float]) -> None:
        """Replaces the incumbent by a point, (p,), where that is better."""
        if key < tuple(self.state.incumbent_key):
            self.state.incumbent_key = np.array(key)
            self.state.incumbent_z = np.array(z)

    def run(self, iterations: int, on_step: Callable[[Search], None] = lambda search: None) -> str:
        """Runs all phases; returns why the last one ended.

        Args:
          iterations: largest number of steps of a phase, those before a checkpoint included.
          on_step: called with the search after each step.
        """
        while True:
            stopped = self._run_phase(iterations, on_step)
            self._consider_starts()
            if not self._next_phase(stopped):
                return stopped

    def _run_phase(self, iterations: int, on_step: Callable[[Search], None]) -> str:
        """Takes steps until the phase ends; returns why it ended."""
        state = self.state
        patience = self.solver.patience
        if state.phase == REPAIR:
            iterations = min(iterations, REPAIR_STEPS)
        while state.phase_steps < iterations:
            finished = bool(np.all(state.finished))
            exhausted = state.steps_without_better >= patience
            if state.phase == REPAIR and not self.is_violated:
                return "the requirements are kept"
            if state.stage < self.stages:
                # Only problems without requirements have a largest number of steps of a stage.
                longest = COARSE_STEPS if np.sum(~state.retired) > 1 else STEPS_PER_UPDATE
                is_unlimited = state.multipliers.shape[1] > 0 or state.stage_steps < longest
                if finished or exhausted or not is_unlimited:
                    self._next_stage()
            elif finished:
                return "converged"
            elif exhausted:
                return f"no improvement in {patience} steps"
            self._step()
            on_step(self)
        return "converged" if np.all(state.finished) else "iterations used up"

    # ------------------------------------------------------------------------------------ phases

    def _next_phase(self, stopped: str) -> bool:
        """Begins a further phase where one is needed; returns whether it has."""
        state = self.state
        if self.strategy is None:
            return False
        if state.phase >= SECOND_SEARCH:
            has_improved = not self._are_near_best(state.counted_objective)
            if has_improved:
                # No start of the phases before came near the better gains of this one.
                state.valleys[2] = self._starts_near_best()
                state.counted_objective = np.asarray(state.incumbent_key[1])
            return (has_improved or not state.phases_around) and self._begin_around()
        if state.phase == REPAIR and self.is_violated:
            state.repair_ended = bool(self.conditions().hold)
            return False
        if state.phase == OPTIMISE:
            self._consider_points(self.strategy.screening.points, self.strategy.screening.found)
            state.valleys = self._valleys()
            state.counted_objective = np.asarray(state.incumbent_key[1])
            # A sampling period is a whole number of steps and has no derivative, so that the values
            # with other periods than that of the incumbent are compared.
            problem = self.evaluate.problem
            others = along(problem.blocks, problem.box, state.incumbent_z, MOST_MULTIPLES)
            if len(others):
                self.evaluate.values(others)
            if self.is_violated:
                self._begin_phase(REPAIR, self._repair_starts())
                return True
            # Only screened points or retired starts may be known in the valley of the incumbent.
            distance = np.max(np.abs(state.best_z - state.incumbent_z), axis=1)
            is_explored = bool(np.any((distance <= SAME_VALLEY) & ~state.retired))
            is_last = self.strategy.second_starts == 0 and not self.reached_by_one_start
            if is_last and stopped == "converged" and is_explored and self.conditions().hold:
                has_begun = self._begin_beside_best(SECOND_SEARCH, self._starts_at_ends)
                return has_begun or self._begin_around()
        points, starts = self.strategy.second_points, self.strategy.second_starts
        has_ended = state.phase == OPTIMISE and stopped != "iterations used up"
        if not points and has_ended and self.reached_by_one_start:
            points = len(self.strategy.screening.points) // 3
            starts = min(STARTS_IF_SINGLE, len(state.finished) - 1)
        at_ends = self._starts_at_ends()
        further = self._second_starts(points, starts)
        z = np.concatenate([state.incumbent_z[None], at_ends, further])[: len(state.finished)]
        self._begin_phase(SECOND_SEARCH, z)
        return True

    def _begin_beside_best(self, phase: int, starts: Callable[[], np.ndarray]) -> bool:
        """Begins a phase from points that are chosen around an optimum; returns whether there are
        such points.  The start that converged there only takes part in the selections, so that
        starts that come near it end.

        Args:
          phase: SECOND_SEARCH or SEARCH_AROUND.
          starts: function that returns the points, (k, p).
        """
        state = self.state
        s = self._converged_near_incumbent()[0]
        optimum = state.incumbent_z  # one of the points may become the incumbent
        key = state.incumbent_key
        z = starts()
        if not len(z):
            return False
        self._begin_phase(phase, z[: len(state.finished) - 1], converged=s)
        state.best_z[s] = optimum
        state.best_key[s] = key
        return True

    def _begin_around(self) -> bool:
        """Begins the phase SEARCH_AROUND where very few starts came near the best objective;
        returns whether it has.
        """
        strategy = self.strategy
        assert strategy is not None
        starts = strategy.starts_around
        is_confirmed = not self._reached_by_fewer_than(AROUND_SHARE * strategy.starts)
        if not starts or self.state.phases_around == MOST_AROUND or is_confirmed:
            return False
        points = len(strategy.screening.points) // 3
        return self._begin_beside_best(SEARCH_AROUND, partial(self._second_starts, points, starts))

    def _starts_at_ends(self) -> np.ndarray:
        """The best points that differ from the incumbent in one gain or two, which are at an end of
        their range, (k, p) with k at most `Strategy.starts_at_ends`.
        """
        assert self.strategy is not None
        problem = self.evaluate.problem
        best = self.state.incumbent_z
        if not self.strategy.starts_at_ends:
            return np.empty((0, len(best)))
        most = len(self.strategy.screening.points) // 3
        points = points_at_ends(problem.box, best, most, int(problem.options.seed))
        return self._best_of(points, self.strategy.starts_at_ends)

    def _second_starts(self, count_of_points: int, count: int) -> np.ndarray:
        """The best of so many points around the incumbent that differ; without such points, the
        best screened point that is far from all earlier starts, (k, p).
        """
        assert self.strategy is not None
        problem = self.evaluate.problem
        best = self.state.incumbent_z[None]
        if count_of_points:
            box = dataclasses.replace(problem.box, z=best[0])
            seed = int(problem.options.seed) + SECOND_SEED_OFFSET + self.state.phases_around
            self.state.phases_around += 1
            return self._best_of(spread_points(box, count_of_points, seed), count)
        screening = self.strategy.screening
        count = min(2, len(self.state.finished)) - 1
        explored = np.concatenate([best, self.history["z"][0], self.state.best_z])
        refused = problem.sampled_too_slowly
        usable = self._are_usable
        return distinct(
            screening, [screening.order()], count, problem.box, refused, usable, explored
        )

    def _best_of(self, points: np.ndarray, count: int) -> np.ndarray:
        """The best of some points, (N, p), by each of the rankings in turn, that differ from one
        another and from the incumbent, (k, p) with k at most `count`.
        """
        problem = self.evaluate.problem
        explored = self.state.incumbent_z[None]  # one of the points may become the incumbent
        screening = ranked(points, self.evaluate.values(points))
        orders = [screening.order(weight) for weight in WEIGHTS]
        refused = problem.sampled_too_slowly
        usable = self._are_usable
        return distinct(screening, orders, count, problem.box, refused, usable, explored)

    def conditions(self) -> Conditions:
        """The optimality conditions at the incumbent, which is evaluated once more; determined once
        if no step follows.
        """
        iteration = self.state.iteration
        if self.last_conditions is None or self.last_conditions[0] != iteration:
            self.last_conditions = iteration, self._conditions()
        return self.last_conditions[1]

    def _conditions(self) -> Conditions:
        """The optimality conditions at the incumbent, which is evaluated once more.

        The incumbent may be a trial that is better than the point where a nearby start converged
        by less than the tolerance of the solver.  That point then becomes the incumbent, as the
        conditions hold there more exactly.
        """
        state = self.state
        row, z = self._converged_near_incumbent()
        found = self._derivatives_at(row, z)
        violation, objective = _keys(found.value)[row]
        least, best = state.incumbent_key
        small = self.solver.tolerance * max(1e-3, abs(float(best)))
        if found.value.valid[row] and violation <= least and objective <= best + small:
            state.incumbent_z = np.array(z)
            state.incumbent_key = np.array(_keys(found.value)[row])
        elif not np.array_equal(z, state.incumbent_z):
            z = state.incumbent_z
            found = self._derivatives_at(row, z)
        if not self.solver.handles_requirements:
            y, mu = state.multipliers[row], state.penalty[row]
            return conditions_of_penalty(self.evaluate, found, row, z, y, mu)
        nearby = []
        if isinstance(self.solver, SQP):
            nearby = self.solver.nearby_pieces(state.solver, z, KINK_REACH)
        result = conditions(self.evaluate, found, row, z, violated=self.is_violated, nearby=nearby)
        is_examined = np.all(np.isfinite(result.residuals)) and len(result.multipliers) > 0
        if result.hold or self.is_violated or not is_examined:
            return result
        holds = self._holds_at_kink()
        if not np.array_equal(z, state.incumbent_z):
            found = self._derivatives_at(row, state.incumbent_z)
            result = conditions(
                self.evaluate, found, row, state.incumbent_z, violated=False, nearby=[]
            )
        return result._replace(at_kink=holds and not result.are_small)

    def _holds_at_kink(self) -> bool:
        """Whether the conditions of an optimum hold with the gradients of points around the
        incumbent, which is replaced by better ones that are found (see `kinks`).
        """
        state = self.state
        box = self.evaluate.problem.box
        rng = np.random.default_rng([int(self.evaluate.problem.options.seed), 5])
        reach = FIRST_REACH
        for _ in range(MOST_ROUNDS):
            z = state.incumbent_z
            objective = float(state.incumbent_key[1])
            size = max(1e-3, abs(objective))
            points = np.concatenate([z[None], points_near(box, z, reach, rng)])
            here, *nearby = self._points_at(points)
            if not here.is_finite:  # the incumbent was found by a value
                break
            valid = [
                (x, point) for x, point in zip(points[1:], nearby, strict=True) if point.is_finite
            ]
            step = step_between_kinks(self.evaluate.space, z, here, valid, reach)
            line = z + FRACTIONS[:, None] * step.step
            self.evaluate.values(np.clip(line, box.low, box.high))
            if objective - float(state.incumbent_key[1]) > IMPROVEMENT * size:
                continue
            if -step.change <= STATIONARITY_TOLERANCE * reach * size:
                return True
            reach *= SHRINK_FACTOR
            if reach < LEAST_REACH:
                break
        return False

    def _points_at(self, z: np.ndarray) -> list[Point]:
        """The derivatives at any number of points, (N, p), which are candidates for the
        incumbent.
        """
        rows = len(self.evaluate.active)
        found = []
        for first in range(0, len(z), rows):
            some = z[first : first + rows]
            derivatives = self._derivatives_at(np.arange(len(some)), some)
            self._consider_points(some, Value(*(x[: len(some)] for x in derivatives.value)))
            found += [Point.of(self.evaluate.space, derivatives, s) for s in range(len(some))]
        return found

    def _converged_near_incumbent(self) -> tuple[int, np.ndarray]:
        """The start that has converged nearest to the incumbent in its valley, and its point.

        Where there is none, or the solver is not `SQP`: the start that found the best result, and
        the incumbent itself.
        """
        z = self.state.incumbent_z
        if not isinstance(self.solver, SQP):  # the state of another solver cannot be read
            return self.best, z
        converged = {}
        distances = {}
        for s, own in enumerate(self.state.solver):
            distance = float(np.max(np.abs(own.z - z)))
            is_resolved = np.isfinite(self.state.best_key[s, 1])
            if own.done and is_resolved and distance <= SAME_VALLEY:
                converged[s] = own.z
                distances[s] = distance
        if not converged:
            return self.best, z
        nearest = min(distances, key=distances.__getitem__)
        return nearest, converged[nearest]

    def _derivatives_at(self, rows: int | np.ndarray, z: np.ndarray) -> Derivatives:
        """The derivatives at one point or several, (p,) or (k, p), with the multipliers of some
        starts and in their rows.
        """
        evaluate = self.evaluate
        before = evaluate.evaluations
        self._prepare_evaluation()
        evaluate.active = np.isin(np.arange(len(evaluate.active)), rows)
        points = np.tile(self.state.incumbent_z, (len(evaluate.active), 1))
        points[rows] = z
        found = evaluate(points)
        self.state.evaluations += evaluate.evaluations - before
        self.history["evaluations"][-1] = np.array(self.state.evaluations)
        return found

    def _begin_phase(self, phase: int, z: np.ndarray, converged: int | None = None) -> None:
        """Begins a phase with the first k starts at the points z, (k, p), k <= S; the other starts
        are retired.  A start that has converged may be excluded: it takes no steps, but is not
        retired.
        """
        state = self.state
        self.retire(slice(None))
        if converged is not None:
            state.retired[converged] = False
        free = [s for s in range(len(state.finished)) if s != converged]
        for s, start in zip(free, z, strict=False):
            self.solver.restart(self._space(phase), state.solver, s, start)
            state.finished[s] = False
            state.retired[s] = False
            state.best_z[s] = start
            state.best_key[s] = np.inf
            state.resolved_z[s] = start
        state.phase = phase
        state.phase_steps = 0
        state.stage = self.stages
        state.stage_steps = 0
        state.steps_without_better = 0

    def _space(self, phase: int) -> SearchSpace:
        """The solver's view of the problem, in which REPAIR counts the largest excess only."""
        space = self.evaluate.space
        if phase != REPAIR:
            return space
        return space._replace(constraints=space.constraints._replace(largest_only=True))

    def _repair_starts(self) -> np.ndarray:
        """The points from which the largest excess is minimised, (k, p): the incumbent and the
        screened points with the smallest excess.

        As many new points as before, at least FEW_POINTS, are evaluated first.  If one of them is
        feasible, it is the incumbent and the only start.
        """
        assert self.strategy is not None
        problem = self.evaluate.problem
        first = self.strategy.screening
        count = max(len(first.points) - 1, FEW_POINTS)
        points = spread_points(problem.box, count, int(problem.options.seed) + REPAIR_SEED_OFFSET)
        new = ranked(points, self.evaluate.values(points))
        both = Screening(*(_joined(x, y) for x, y in zip(first, new, strict=True)))
        best = self.state.incumbent_z[None]
        if not self.is_violated:
            return best
        starts = min(REPAIR_STARTS, len(self.state.finished)) - 1
        order = np.argsort(both.excess, kind="stable")
        refused = problem.sampled_too_slowly
        further = distinct(both, [order], starts, problem.box, refused, others=best)
        return np.concatenate([best, further])

    def _valleys(self) -> np.ndarray:
        """Number of valleys in which the starts ended or were retired, number of starts in the best
        valley, number of starts that kept the requirements within SAME_OBJECTIVE of the best
        objective, and number of starts that broke one at an objective further below it, (4,).
        """
        reached = np.flatnonzero(np.isfinite(self.state.best_key[:, 1]))
        z = self.state.best_z[reached]
        near = np.max(np.abs(z[:, None] - z[None]), axis=2) <= SAME_VALLEY
        # Two starts are in one valley if a chain of near starts connects them: each product of
        # the matrix with itself doubles the length of the chains.
        for _ in range(len(z)):
            near = near.astype(int) @ near.astype(int) > 0
        count = len(np.unique(near, axis=0))
        of_best = near[np.flatnonzero(reached == self.best)].sum() if len(z) else 0
        violation, objective = self.state.best_key.T
        best = float(self.state.incumbent_key[1])
        below = np.sum((violation > 0) & (objective < best - SAME_OBJECTIVE * abs(best)))
        return np.asarray([count, of_best, self._starts_near_best(), below])

    def _starts_near_best(self) -> int:
        """Number of starts that kept the requirements within SAME_OBJECTIVE of the best
        objective.
        """
        violation, objective = self.state.best_key.T
        return int(np.sum((violation <= 0) & self._are_near_best(objective)))

    def _are_near_best(self, objective: np.ndarray) -> np.ndarray:
        """Whether objectives are at most SAME_OBJECTIVE above that of the incumbent."""
        best = float(self.state.incumbent_key[1])
        return objective <= best + SAME_OBJECTIVE * abs(best)

    def _select(self) -> None:
        """Retires starts after every `selection` steps of the phase: those that have come near a
        better one, as they will end where that one ends, and all but the better third.

        The better third is only determined after `SELECTIONS_BY_DISTANCE` selections, as the order
        of the starts says little after the first steps: on a problem of six gains the only start
        that ended in the best valley was the 23rd of 32 after five steps, the 28th after ten and
        the first one after fifteen.
        """
        state = self.state
        if self.strategy is None or state.phase == REPAIR:
            return
        if state.phase_steps % self.strategy.selection:
            return
        order = sorted(np.flatnonzero(~state.retired).tolist(), key=self._rank)
        kept: list[int] = []
        box = self.evaluate.problem.box
        for s in order:
            if not np.any(is_near(state.best_z[kept], state.best_z[s], box)):
                kept.append(s)
        if state.phase_steps > SELECTIONS_BY_DISTANCE * self.strategy.selection:
            kept = kept[: checks.ceil_div(len(order), KEPT)]
        self.retire(sorted(set(order) - set(kept)))

    def _rank(self, start: int) -> float:
        """The merit of a start, the smaller the better: its objective relative to that of the
        incumbent, plus a weight times its violation.

        Starts are not ranked by the violation first, because a small violation may still vanish.
        """
        violation, objective = self.state.best_key[start]
        size = max(abs(float(self.state.incumbent_key[1])), 1e-12)
        return float(objective) / size + EXCESS_WEIGHT * float(violation)

    # ------------------------------------------------------------------------------------ stages

    def _next_stage(self) -> None:
        """Reduces the smoothing and retires the worse half of the starts."""
        state = self.state
        remaining = np.flatnonzero(~state.retired).tolist()
        order = sorted(remaining, key=lambda s: tuple(state.best_key[s]))
        half = checks.ceil_div(len(order), 2)
        for s in order[:half]:
            state.finished[s] = False
            state.steps_since_update[s] = 0
            state.updates[s] = 0
            if is_smoothed(self.smoothest):  # otherwise the loss is still the same
                self.solver.restart(self.evaluate.space, state.solver, s)
        self.retire(order[half:])
        state.stage += 1
        state.stage_steps = 0
        state.steps_without_better = 0

    # ------------------------------------------------------------------------------------- steps

    def _step(self) -> None:
        """Takes one step of the solver, stores it, and updates multipliers and selection."""
        state = self.state
        self._prepare_evaluation()
        before = self.evaluate.evaluations
        evaluate: Evaluation = self.evaluate
        if state.phase == REPAIR:
            evaluate = ExcessOnly(self.evaluate, self._space(REPAIR))
        tolerance = self.solver.tolerance
        if state.stage < self.stages:
            tolerance = max(tolerance, COARSE_TOLERANCE)
        z, found = self.solver.step(evaluate, state.solver, tolerance)
        state.evaluations += self.evaluate.evaluations - before
        improved = self._keep_best(z, found)
        state.steps_without_better += 1
        if improved:
            state.steps_without_better = 0
        self._record(z, found)
        converged = self.solver.converged(state.solver)
        for s in range(len(z)):
            self._update_start(s, bool(converged[s]), found)
        state.iteration += 1
        state.phase_steps += 1
        state.stage_steps += 1
        if self._is_due:
            self._consider_starts()
        self._select()

    @property
    def _is_due(self) -> bool:
        """Whether the best points of the starts are considered after this step."""
        if self.strategy is None or self.strategy.comparison is None:
            return True
        is_selection = self.state.phase_steps % self.strategy.selection == 0
        return self.state.phase == REPAIR or is_selection

    def _prepare_evaluation(self) -> None:
        """Sets smoothing, run numbers, multipliers and active starts of the next step."""
        state = self.state
        evaluate = self.evaluate
        if self.stages:
            objective = sharper(self.smoothest, SHARPENING**-state.stage)
            evaluate.problem = evaluate.problem.with_objective(objective)
        candidates = evaluate.candidates._replace(
            multipliers=state.multipliers.copy(), penalty=state.penalty.copy()
        )
        if self.solver.resample:
            runs = candidates.index.shape[1]
            first = np.uint32(runs * state.iteration)
            index = np.arange(runs, dtype=np.uint32) + first
            candidates = candidates._replace(index=np.broadcast_to(index, candidates.index.shape))
        evaluate.candidates = candidates
        evaluate.active = ~state.finished

    def _keep_best(self, z: np.ndarray, found: Derivatives) -> bool:
        """Stores the best trial of each start; returns whether the best of all has improved by
        more than the tolerance.
        """
        state = self.state
        tolerance = self.solver.tolerance
        improved = False
        state.note_excess(found.value)
        keys = _keys(found.value)
        for s in np.flatnonzero(found.value.valid).tolist():
            key = keys[s]
            if not np.isfinite(key[1]) or key >= tuple(state.best_key[s]):
                continue
            overall = tuple(min(map(tuple, state.best_key)))
            small = tolerance * max(1e-3, abs(key[1]))
            is_less_violated = key[0] < overall[0] - tolerance
            is_lower = key[0] <= overall[0] and key[1] < overall[1] - small
            improved |= is_less_violated or is_lower
            state.best_key[s] = key
            state.best_z[s] = z[s]
        return improved

    def _record(self, z: np.ndarray, found: Derivatives) -> None:
        """Appends one step to the history."""
        value = found.value
        entries = {
            "z": z,
            "loss": value.loss,
            "objective": value.objective,
            "terms": value.terms,
            "excess": value.exact_excess,
            "margin": value.margin,
            "gradient_norm": np.linalg.norm(found.gradient, axis=-1),
            "valid": value.valid,
            "evaluations": self.state.evaluations,
        }
        for name, x in entries.items():
            self.history.setdefault(name, []).append(np.array(x))

    def _update_start(self, s: int, converged: bool, found: Derivatives) -> None:
        """Updates the multipliers of one start if an update is due, or marks it as finished."""
        state = self.state
        state.steps_since_update[s] += 1
        is_due = converged or state.steps_since_update[s] >= STEPS_PER_UPDATE
        if state.finished[s] or not is_due:
            return
        in_loss = not self.solver.handles_requirements and state.multipliers.shape[1] > 0
        if not in_loss or not found.value.valid[s]:
            state.finished[s] = converged
            return
        excess = found.value.smooth_excess[s]
        multipliers = state.multipliers[s]
        penalty = state.penalty[s]
        worst = float(np.max(np.maximum(excess, -multipliers / penalty)))
        if converged and (abs(worst) < EXCESS_TOLERANCE or state.updates[s] >= MAX_UPDATES):
            state.finished[s] = True
            return
        # The multipliers are updated with the penalty parameter of the past steps, and only then
        # is that increased.
        state.multipliers[s] = np.maximum(0.0, multipliers + penalty * excess)
        if max(worst, 0.0) > 0.25 * state.largest_excess[s]:
            state.penalty[s] = min(PENALTY_FACTOR * penalty, MAX_PENALTY)
        state.largest_excess[s] = max(worst, 0.0)
        state.steps_since_update[s] = 0
        state.updates[s] += 1
        state.steps_without_better = 0
        self.solver.restart(self.evaluate.space, state.solver, s)


def _joined(first: Any, second: Any) -> Any:
    """The rows of two arrays, or of the arrays of two tuples, one after the other."""
    return jax.tree.map(lambda x, y: np.concatenate([x, y]), first, second)


def _keys(found: Value) -> list[tuple[float, float]]:
    """What each point is compared by, in this order: the violation, which is the largest excess of
    a requirement or bound, and the objective.
    """
    return list(zip(violations(found).tolist(), found.objective.tolist(), strict=True))


class ExcessOnly:
    """The evaluation of a problem without its objective.

    Args:
      evaluate: the problem.
      space: in which the violation is the largest excess.
    """

    def __init__(self, evaluate: Evaluator, space: SearchSpace):
        self.inner = evaluate
        self.space = space
        self.active = evaluate.active

    def __call__(self, z: np.ndarray) -> Derivatives:
        """As `Evaluator`, with loss, gradient and matrix zero; an infinite loss stays infinite."""
        found = self.inner(z)
        loss = np.where(np.isfinite(found.value.loss), 0.0, np.inf)
        return found._replace(
            value=found.value._replace(loss=loss),
            gradient=np.zeros_like(found.gradient),
            hessian=np.zeros_like(found.hessian),
        )

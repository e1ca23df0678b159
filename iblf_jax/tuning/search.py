"""The search calls a solver step by step, updates multipliers and smoothing, and keeps the best
result so far.

Solvers that handle requirements (`SQP`) get them as constraints.  For the others they are part of
an augmented Lagrangian, whose parameters are updated whenever a start has converged (or after
STEPS_PER_UPDATE steps),

    y <- max(0, y + mu G),     mu <- 5 mu where the largest G has not fallen to a quarter,

so that a start that violates them becomes feasible while the penalty stays finite everywhere.  The
best result so far has the lowest objective of those that satisfy requirements and bounds, or, while
there is none, the smallest violation, the largest positive G.

A peak in the objective is smoothed in the loss.  The smooth maximum lies above the maximum by
smoothing times a logarithm, so its minimum is at other gains; but it is found soon, and narrow
valleys are not in it.  So the smoothing is reduced in stages: once all starts have converged to
COARSE_TOLERANCE (or after STEPS_PER_UPDATE steps, COARSE_STEPS where several starts are left), it
is divided by SHARPENING, the better half of the starts goes on and the others are retired.
Results are always compared without smoothing.

A tuning that begins at several of many points (`starts`) is a search in phases:

1. All starts take steps as one batch.  After `selection` steps the better half of them goes on, and
   after twice as many only the best (successive halving).
2. If no point that keeps the requirements is known at the end, as many further points are
   evaluated, and the largest excess alone is minimised from those with the smallest ones, until a
   point keeps the requirements, or all starts are at stationary points of the largest excess.
3. If phase 1 did not converge, or phase 2 found such a point, a second search begins at the best
   point and at the best one that is far from all earlier starts.

Every point that was evaluated, with derivatives or without, is a candidate for the result.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.tuning.evaluation import Derivatives, Evaluator, Value
from iblf_jax.tuning.objectives import is_smoothed, sharper
from iblf_jax.tuning.optimality import Conditions, conditions, conditions_of_penalty
from iblf_jax.tuning.parameters import along
from iblf_jax.tuning.problem import FIRST_PENALTY
from iblf_jax.tuning.solvers import SQP, SearchSpace, Solver
from iblf_jax.tuning.starts import (
    EXCESS_WEIGHT,
    FEW_POINTS,
    Screening,
    distinct,
    ranked,
    spread_points,
)

STEPS_PER_UPDATE = 12
"""Steps at most between two updates of the multipliers."""
SECOND_DRAW = 1000
"""Added to the seed for the points of the second phase."""
MAX_UPDATES = 12
"""Updates of the multipliers in a stage."""
PENALTY_FACTOR = 5.0
"""Factor by which the penalty parameter is increased."""
MAX_PENALTY = 1e6
EXCESS_TOLERANCE = 1e-3
"""Largest |G| at which a converged start ends."""
SHARPENING = 4.0
"""Factor by which the smoothing is divided at each stage."""
COARSE_TOLERANCE = 1e-3
"""Tolerance before the last stage, whose result is a point to go on from."""
COARSE_STEPS = 6
"""Steps at most of a stage of several starts without requirements: enough to choose by."""
OPTIMISE, REPAIR, SECOND = range(3)
"""The phases."""
REPAIR_STEPS = 30
"""Steps at most in which the largest excess is minimised."""
REPAIR_STARTS = 6
"""Points from which it is minimised."""
MOST_MULTIPLES = 32
"""Multiples of a leaf that are compared, the nearest ones."""
KINK_REACH = 0.05
"""Distance at most of points whose peaks may be at their limits too at a kink."""
SAME_VALLEY = 0.5
"""Largest distance, in any coordinate z, of two starts that ended in one valley."""


class Strategy(NamedTuple):
    """How a search goes on from several starts."""

    screening: Screening
    """The points that were evaluated without derivatives."""
    selection: int
    """Steps after which the better half of the starts goes on."""
    starts: int
    """Number of starts; further rows of the search belong to later phases."""


class Search:
    """A search from S starts; `run` continues from its `state`, which is a pytree of arrays.

    Args:
      evaluate: the problem.
      solver: with its options.
      z: starting points, (S, p).
      strategy: of a search in phases; without it there is the first one only, and no selection.
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
        starts = len(z)
        requirements = len(evaluate.problem.allowed)
        self.history: dict[str, list[np.ndarray]] = {}
        self.state: dict[str, Any] = {
            "solver": solver.init(evaluate.space, z),
            "iteration": np.asarray(0),
            "evaluations": np.asarray(0),
            "stage": np.asarray(0),
            "stage_steps": np.asarray(0),
            "steps_without_better": np.asarray(0),
            "multipliers": np.zeros((starts, requirements)),
            "penalty": np.full(starts, FIRST_PENALTY),
            "steps_since_update": np.zeros(starts, int),
            "updates": np.zeros(starts, int),
            "largest_excess": np.full(starts, np.inf),
            "finished": np.zeros(starts, bool),
            "retired": np.zeros(starts, bool),
            "best_z": z.copy(),
            "best_key": np.full((starts, 2), np.inf),
            "phase": np.asarray(OPTIMISE),
            "phase_steps": np.asarray(0),
            "plain_values": np.asarray(0),
            "incumbent_z": z[0].copy(),
            "incumbent_key": np.full(2, np.inf),
            "valleys": np.asarray([1, 1]),
            "repair_ended": np.asarray(False),
        }
        evaluate.on_values = self.see
        if strategy is not None:
            self.see(strategy.screening.points, strategy.screening.found)

    def retire(self, starts: Any) -> None:
        """Ends some starts for good."""
        self.state["finished"][starts] = True
        self.state["retired"][starts] = True

    @property
    def best(self) -> int:
        """The start that found the best result so far."""
        keys = self.state["best_key"]
        return min(range(len(keys)), key=lambda s: tuple(keys[s]))

    @property
    def is_violated(self) -> bool:
        """Whether no point is known that keeps requirements and bounds."""
        return bool(self.state["incumbent_key"][0] > 0)

    def see(self, z: np.ndarray, found: Value) -> None:
        """Remembers the best of some points, (N, p), that were evaluated without derivatives."""
        self.state["plain_values"] = self.state["plain_values"] + len(z)
        for i in np.flatnonzero(found.valid).tolist():
            self._consider(z[i], _key(found, i))

    def _consider(self, z: np.ndarray, key: tuple[float, float]) -> None:
        if np.isfinite(key[1]) and key < tuple(self.state["incumbent_key"]):
            self.state["incumbent_key"] = np.array(key)
            self.state["incumbent_z"] = np.array(z)

    def run(self, iterations: int, on_step: Callable[[Search], None] = lambda search: None) -> str:
        """Steps until the search ends; returns why it ended.

        Args:
          iterations: number of steps at most in a phase, those before a checkpoint included.
          on_step: called with the search after each step.
        """
        while True:
            stopped = self._run_phase(iterations, on_step)
            if not self._next_phase(stopped):
                return stopped

    def _run_phase(self, iterations: int, on_step: Callable[[Search], None]) -> str:
        """Steps until a phase ends; returns why it ended."""
        state = self.state
        patience = self.solver.patience
        if state["phase"] == REPAIR:
            iterations = min(iterations, REPAIR_STEPS)
        while int(state["phase_steps"]) < iterations:
            finished = bool(np.all(state["finished"]))
            exhausted = int(state["steps_without_better"]) >= patience
            if state["phase"] == REPAIR and not self.is_violated:
                return "the requirements are kept"
            if int(state["stage"]) < self.stages:
                if finished or exhausted or self._stage_is_long():
                    self._next_stage()
            elif finished:
                return "converged"
            elif exhausted:
                return f"no improvement in {patience} steps"
            self._step()
            on_step(self)
        return "converged" if np.all(state["finished"]) else "iterations used up"

    # ------------------------------------------------------------------------------------ phases

    def _next_phase(self, stopped: str) -> bool:
        """Begins a further phase where one is due; whether it does."""
        if self.strategy is None:
            return False
        phase = int(self.state["phase"])
        if phase == OPTIMISE:
            self.state["valleys"] = self._valleys()
            self._compare_multiples()
            if self.is_violated:
                self._begin(REPAIR, self._least_violated())
                return True
            if stopped == "converged" and self._ended_at_incumbent() and self.conditions().hold:
                return False
        elif phase == REPAIR:
            if self.is_violated:
                self.state["repair_ended"] = np.asarray(self.conditions().hold)
                return False
        else:
            return False
        self._begin(SECOND, self._unexplored())
        return True

    def _compare_multiples(self) -> None:
        """Evaluates other multiples of leaves that are whole numbers of steps, with all else as at
        the best point: the sampling period, by which there is no derivative.
        """
        problem = self.evaluate.problem
        z = self.state["incumbent_z"]
        others = along(problem.blocks, problem.box, z, MOST_MULTIPLES)
        if len(others):
            self.evaluate.values(others)

    def conditions(self) -> Conditions:
        """The optimality conditions at the best point, which is evaluated once more.

        Where a start has converged to a point that is as good up to the tolerance of the solver,
        that one becomes the best point: an earlier trial beside it may be better by less.
        """
        state = self.state
        row, z = self._end_beside_incumbent()
        found = self._evaluated(row, z)
        if self._is_as_good(found.value, row):
            state["incumbent_z"] = np.array(z)
            state["incumbent_key"] = np.array(_key(found.value, row))
        elif not np.array_equal(z, state["incumbent_z"]):
            z = state["incumbent_z"]
            found = self._evaluated(row, z)
        if not self.solver.handles_requirements:
            return conditions_of_penalty(self.evaluate, found, row, z, state)
        nearby = []
        if isinstance(self.solver, SQP):
            nearby = self.solver.nearby_pieces(state["solver"], z, KINK_REACH)
        return conditions(self.evaluate, found, row, z, violated=self.is_violated, nearby=nearby)

    def _end_beside_incumbent(self) -> tuple[int, np.ndarray]:
        """A start that has converged in the valley of the best point, and where; otherwise the best
        point itself.
        """
        z = self.state["incumbent_z"]
        if not isinstance(self.solver, SQP):
            return self.best, z
        ends = {
            s: own.z
            for s, own in enumerate(self.state["solver"])
            if own.done and np.max(np.abs(own.z - z)) <= SAME_VALLEY
        }
        if not ends:
            return self.best, z
        nearest = min(ends, key=lambda s: float(np.max(np.abs(ends[s] - z))))
        return nearest, ends[nearest]

    def _is_as_good(self, found: Value, row: int) -> bool:
        """Whether a point is as good as the best one, up to the tolerance of the solver."""
        if not found.valid[row]:
            return False
        violation, objective = _key(found, row)
        least, best = self.state["incumbent_key"]
        small = self.solver.tolerance * max(1e-3, abs(float(best)))
        return violation <= least and objective <= best + small

    def _evaluated(self, row: int, z: np.ndarray) -> Derivatives:
        """The derivatives at one point, in one row."""
        evaluate = self.evaluate
        before = evaluate.evaluations
        self._prepare_evaluation()
        evaluate.active = np.arange(len(evaluate.active)) == row
        found = evaluate(np.tile(z, (len(evaluate.active), 1)))
        self.state["evaluations"] = self.state["evaluations"] + evaluate.evaluations - before
        self.history["evaluations"][-1] = self.state["evaluations"]
        return found

    def _ended_at_incumbent(self) -> bool:
        """Whether the best point belongs to a start that went on to its end: the search of others
        was cut off.
        """
        distance = np.max(np.abs(self.state["best_z"] - self.state["incumbent_z"]), axis=1)
        return bool(np.any((distance <= SAME_VALLEY) & ~self.state["retired"]))

    def _begin(self, phase: int, z: np.ndarray) -> None:
        """Begins a phase at some points, (k, p), k <= S; the other starts are retired."""
        state = self.state
        self.retire(slice(None))
        for s, start in enumerate(z):
            self.solver.restart(self._space(phase), state["solver"], s, start)
            state["finished"][s] = state["retired"][s] = False
            state["best_z"][s] = start
            state["best_key"][s] = np.inf
        state["phase"] = np.asarray(phase)
        state["phase_steps"] = np.asarray(0)
        state["stage"] = np.asarray(self.stages)
        state["stage_steps"] = np.asarray(0)
        state["steps_without_better"] = np.asarray(0)

    def _space(self, phase: int) -> SearchSpace:
        space = self.evaluate.space
        if phase != REPAIR:
            return space
        return space._replace(constraints=space.constraints._replace(largest_only=True))

    def _least_violated(self) -> np.ndarray:
        """The points from which the largest excess is minimised: the best one of all, and those
        with the smallest excess among as many new points as there were before.
        """
        assert self.strategy is not None
        problem = self.evaluate.problem
        first = self.strategy.screening
        count = max(len(first.points) - 1, FEW_POINTS)
        points = spread_points(problem.box, count, int(problem.options.seed) + SECOND_DRAW)
        new = ranked(points, self.evaluate.values(points))
        both = Screening(*(_joined(x, y) for x, y in zip(first, new, strict=True)))
        best = self.state["incumbent_z"][None]
        if not self.is_violated:
            return best
        starts = min(REPAIR_STARTS, len(self.state["finished"])) - 1
        order = np.argsort(both.excess, kind="stable")
        return np.concatenate([best, self._distinct(both, order, starts, best)])

    def _unexplored(self) -> np.ndarray:
        """The best point, and the best one that is far from all starts."""
        assert self.strategy is not None
        best = self.state["incumbent_z"][None]
        explored = np.concatenate([best, self.history["z"][0], self.state["best_z"]])
        order = np.argsort(self.strategy.screening.merit, kind="stable")
        count = min(2, len(self.state["finished"])) - 1
        further = self._distinct(self.strategy.screening, order, count, explored)
        return np.concatenate([best, further])

    def _distinct(
        self, screening: Screening, order: np.ndarray, count: int, others: np.ndarray
    ) -> np.ndarray:
        problem = self.evaluate.problem
        refused = problem.sampled_too_slowly
        if count == 0:
            return np.zeros((0, problem.size))
        return distinct(screening, order, count, problem.box, refused, others)

    def _valleys(self) -> np.ndarray:
        """In how many valleys the starts ended or were retired, and how many of them in the best
        one, (2,).
        """
        reached = np.flatnonzero(np.isfinite(self.state["best_key"][:, 1]))
        z = self.state["best_z"][reached]
        near = np.max(np.abs(z[:, None] - z[None]), axis=2) <= SAME_VALLEY
        # Starts belong together where a chain of near ones connects them.
        for _ in range(len(z)):
            near = near.astype(int) @ near.astype(int) > 0
        count = len(np.unique(near, axis=0))
        of_best = near[np.flatnonzero(reached == self.best)].sum() if len(z) else 0
        return np.asarray([count, of_best])

    def _select(self) -> None:
        """Retires the worse starts after the steps of the selection."""
        if self.strategy is None or self.state["phase"] == REPAIR:
            return
        steps = int(self.state["phase_steps"])
        left = np.flatnonzero(~self.state["retired"]).tolist()
        order = sorted(left, key=self._rank)
        if steps == self.strategy.selection:
            self.retire(order[checks.ceil_div(len(order), 2) :])
        elif steps == 2 * self.strategy.selection:
            self.retire(order[1:])

    def _rank(self, start: int) -> float:
        """What the starts are selected by: a small violation may still vanish."""
        violation, objective = self.state["best_key"][start]
        size = max(abs(float(self.state["incumbent_key"][1])), 1e-12)
        return float(objective) / size + EXCESS_WEIGHT * float(violation)

    # ------------------------------------------------------------------------------------ stages

    def _stage_is_long(self) -> bool:
        """Whether a stage without requirements has taken all of its steps."""
        if self.state["multipliers"].shape[1] > 0:
            return False
        if np.sum(~self.state["retired"]) > 1:
            return int(self.state["stage_steps"]) >= COARSE_STEPS
        return int(self.state["stage_steps"]) >= STEPS_PER_UPDATE

    def _next_stage(self) -> None:
        """Reduces the smoothing; the better half of the starts goes on."""
        state = self.state
        left = np.flatnonzero(~state["retired"]).tolist()
        order = sorted(left, key=lambda s: tuple(state["best_key"][s]))
        half = checks.ceil_div(len(order), 2)
        for s in order[:half]:
            state["finished"][s] = False
            state["steps_since_update"][s] = 0
            state["updates"][s] = 0
            if is_smoothed(self.smoothest):  # otherwise the loss is still the same
                self.solver.restart(self.evaluate.space, state["solver"], s)
        self.retire(order[half:])
        state["stage"] = state["stage"] + 1
        state["stage_steps"] = np.asarray(0)
        state["steps_without_better"] = np.asarray(0)

    def _tolerance(self) -> float:
        """Of the present stage."""
        if int(self.state["stage"]) == self.stages:
            return self.solver.tolerance
        return max(self.solver.tolerance, COARSE_TOLERANCE)

    # ------------------------------------------------------------------------------------- steps

    def _step(self) -> None:
        """One step of the solver, and what follows from it."""
        state = self.state
        self._prepare_evaluation()
        before = self.evaluate.evaluations
        evaluate: Any = self.evaluate
        if state["phase"] == REPAIR:
            evaluate = ExcessOnly(self.evaluate, self._space(REPAIR))
        z, found = self.solver.step(evaluate, state["solver"], self._tolerance())
        state["evaluations"] = state["evaluations"] + self.evaluate.evaluations - before
        improved = self._keep_best(z, found)
        state["steps_without_better"] = state["steps_without_better"] + 1
        if improved:
            state["steps_without_better"] = np.asarray(0)
        self._record(z, found)
        converged = self.solver.converged(state["solver"])
        for s in range(len(z)):
            self._update_start(s, bool(converged[s]), found)
        state["iteration"] = state["iteration"] + 1
        state["phase_steps"] = state["phase_steps"] + 1
        state["stage_steps"] = state["stage_steps"] + 1
        self._select()

    def _prepare_evaluation(self) -> None:
        """Sets smoothing, run numbers, multipliers and active starts of the next step."""
        state = self.state
        evaluate = self.evaluate
        if self.stages:
            objective = sharper(self.smoothest, SHARPENING ** -int(state["stage"]))
            evaluate.problem = evaluate.problem.with_objective(objective)
        candidates = evaluate.candidates._replace(
            multipliers=state["multipliers"].copy(), penalty=state["penalty"].copy()
        )
        if self.solver.resample:
            runs = candidates.index.shape[1]
            first = np.uint32(runs * int(state["iteration"]))
            index = np.arange(runs, dtype=np.uint32) + first
            candidates = candidates._replace(index=np.broadcast_to(index, candidates.index.shape))
        evaluate.candidates = candidates
        evaluate.active = ~state["finished"]

    def _keep_best(self, z: np.ndarray, found: Derivatives) -> bool:
        """Stores the best result of each start; whether the best of all has improved."""
        state = self.state
        tolerance = self.solver.tolerance
        improved = False
        for s in np.flatnonzero(found.value.valid).tolist():
            key = _key(found.value, s)
            self._consider(z[s], key)
            if not np.isfinite(key[1]) or key >= tuple(state["best_key"][s]):
                continue
            overall = tuple(min(map(tuple, state["best_key"])))
            small = tolerance * max(1e-3, abs(key[1]))
            is_less_violated = key[0] < overall[0] - tolerance
            is_lower = key[0] <= overall[0] and key[1] < overall[1] - small
            improved |= is_less_violated or is_lower
            state["best_key"][s] = key
            state["best_z"][s] = z[s]
        return improved

    def _record(self, z: np.ndarray, found: Derivatives) -> None:
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
            "evaluations": self.state["evaluations"],
        }
        for name, x in entries.items():
            self.history.setdefault(name, []).append(np.array(x))

    def _update_start(self, s: int, converged: bool, found: Derivatives) -> None:
        """Updates the multipliers of one start when it is time, or marks it as finished."""
        state = self.state
        state["steps_since_update"][s] += 1
        is_due = converged or state["steps_since_update"][s] >= STEPS_PER_UPDATE
        if state["finished"][s] or not is_due:
            return
        in_loss = not self.solver.handles_requirements and state["multipliers"].shape[1] > 0
        if not in_loss or not found.value.valid[s]:
            state["finished"][s] = converged
            return
        excess = found.value.smooth_excess[s]
        multipliers = state["multipliers"][s]
        penalty = state["penalty"][s]
        worst = float(np.max(np.maximum(excess, -multipliers / penalty)))
        if converged and (abs(worst) < EXCESS_TOLERANCE or state["updates"][s] >= MAX_UPDATES):
            state["finished"][s] = True
            return
        # The multipliers follow from the penalty parameter of the steps that have been made.
        state["multipliers"][s] = np.maximum(0.0, multipliers + penalty * excess)
        if max(worst, 0.0) > 0.25 * state["largest_excess"][s]:
            state["penalty"][s] = min(PENALTY_FACTOR * penalty, MAX_PENALTY)
        state["largest_excess"][s] = max(worst, 0.0)
        state["steps_since_update"][s] = 0
        state["updates"][s] += 1
        state["steps_without_better"] = np.asarray(0)
        self.solver.restart(self.evaluate.space, state["solver"], s)


def _joined(first: Any, second: Any) -> Any:
    """Two arrays, or tuples of arrays, one after the other."""
    return jax.tree.map(lambda x, y: np.concatenate([x, y]), first, second)


def _key(found: Value, row: int) -> tuple[float, float]:
    """What results are compared by: the largest excess of a requirement or bound, then the
    objective.
    """
    excess = float(np.max(found.exact_excess[row], initial=0.0))
    return max(excess, -float(found.margin[row]), 0.0), float(found.objective[row])


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
        """As `Evaluator`, with loss, gradient and matrix zero."""
        found = self.inner(z)
        loss = np.where(np.isfinite(found.value.loss), 0.0, np.inf)
        zeros = np.zeros_like(found.gradient), np.zeros_like(found.hessian)
        gradient, hessian = zeros
        value = found.value._replace(loss=loss)
        return found._replace(value=value, gradient=gradient, hessian=hessian)

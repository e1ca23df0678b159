"""The search calls a solver step by step, updates multipliers and smoothing, and keeps the best
result so far.

Solvers that handle requirements (`SQP`) get them as constraints.  For the others they are part of
an augmented Lagrangian, whose parameters are updated whenever a start has converged (or after
STEPS_PER_UPDATE steps),

    y <- max(0, y + mu G),     mu <- 5 mu where the largest G has not fallen to a quarter,

so that a start that violates them becomes feasible while the penalty stays finite everywhere.  The
best result so far has the lowest objective of those that satisfy requirements and bounds, or, while
there is none, the smallest violation, the sum of the positive G.

A peak in the objective is smoothed in the loss.  The smooth maximum lies above the maximum by
smoothing times a logarithm, so its minimum is at other gains; but it is found soon, and narrow
valleys are not in it.  So the smoothing is reduced in stages: once all starts have converged to
COARSE_TOLERANCE (or after STEPS_PER_UPDATE steps, COARSE_STEPS where several starts are left), it
is divided by SHARPENING, the better half of the starts goes on and the others are retired.
Results are always compared without smoothing.

Where several minima are expected, a single start is followed by a second one (`starts`): the first
runs until it has converged to COARSE_TOLERANCE; then, if that took at most SECOND_START_WITHIN
evaluations, the second one runs until SECOND_START_UNTIL evaluations are used up; the better of the
two goes on to the end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from iblf_jax.core import checks
from iblf_jax.tuning.evaluation import Derivatives, Evaluator
from iblf_jax.tuning.objectives import is_smoothed, sharper
from iblf_jax.tuning.problem import FIRST_PENALTY
from iblf_jax.tuning.solvers import Solver

STEPS_PER_UPDATE = 12
"""Steps at most between two updates of the multipliers."""
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
SECOND_START_WITHIN = 25
"""Evaluations of the first start at most, for which the second one begins."""
SECOND_START_UNTIL = 40
"""Evaluations of both, after which the second one ends."""

SecondStart = Callable[[np.ndarray], np.ndarray | None]
"""Function of where the first search began and ended, (2, p); where the second begins, or None."""


class Search:
    """A search from S starts; `run` continues from its `state`, which is a pytree of arrays.

    Args:
      evaluate: the problem.
      solver: with its options.
      z: starting points, (S, p).
      second_start: of two starts, the second waits until the first has converged, and begins where
        this function says.
    """

    def __init__(
        self,
        evaluate: Evaluator,
        solver: Solver,
        z: np.ndarray,
        second_start: SecondStart | None = None,
    ):
        self.evaluate = evaluate
        self.solver = solver
        self.second_start = second_start
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
            "waiting": np.zeros(starts, bool),
            "best_z": z.copy(),
            "best_key": np.full((starts, 2), np.inf),
        }
        if second_start is not None:
            self.stages = max(self.stages, 1)
            self.state["waiting"][1] = self.state["finished"][1] = True

    def retire(self, starts: Any) -> None:
        """Ends some starts for good."""
        self.state["finished"][starts] = True
        self.state["retired"][starts] = True

    @property
    def best(self) -> int:
        """The start that found the best result so far."""
        keys = self.state["best_key"]
        return min(range(len(keys)), key=lambda s: tuple(keys[s]))

    def run(self, iterations: int, on_step: Callable[[Search], None] = lambda search: None) -> str:
        """Steps until the search ends; returns why it ended.

        Args:
          iterations: number of steps at most, those before a checkpoint included.
          on_step: called with the search after each step.
        """
        patience = self.solver.patience
        while int(self.state["iteration"]) < iterations:
            finished = bool(np.all(self.state["finished"]))
            exhausted = int(self.state["steps_without_better"]) >= patience
            if int(self.state["stage"]) < self.stages:
                if finished or exhausted or self._stage_is_long():
                    self._next_stage()
            elif finished:
                return "converged"
            elif exhausted:
                return f"no improvement in {patience} steps"
            self._step()
            on_step(self)
        return "converged" if np.all(self.state["finished"]) else "iterations used up"

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
        z, found = self.solver.step(self.evaluate, state["solver"], self._tolerance())
        state["evaluations"] = state["evaluations"] + self.evaluate.evaluations - before
        improved = self._keep_best(z, found)
        state["steps_without_better"] = state["steps_without_better"] + 1
        if improved:
            state["steps_without_better"] = np.asarray(0)
        self._record(z, found)
        converged = self.solver.converged(state["solver"])
        for s in range(len(z)):
            self._update_start(s, bool(converged[s]), found)
        if self.second_start is not None and not state["stage"]:
            self._alternate(self.second_start)
        state["iteration"] = state["iteration"] + 1
        state["stage_steps"] = state["stage_steps"] + 1

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
            out_of_bounds = max(-float(found.value.margin[s]), 0.0)
            excess = np.sum(np.maximum(found.value.exact_excess[s], 0.0))
            violation = float(excess) + out_of_bounds
            key = (violation, float(found.value.objective[s]))
            if not np.isfinite(key[1]) or key >= tuple(state["best_key"][s]):
                continue
            overall = tuple(min(map(tuple, state["best_key"])))
            small = tolerance * max(1e-3, abs(key[1]))
            improved |= key[0] < overall[0] - tolerance or key[1] < overall[1] - small
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

    def _alternate(self, second_start: SecondStart) -> None:
        """Begins the second start once the first has converged, and ends it after its share of
        evaluations.
        """
        state = self.state
        evaluations = int(state["evaluations"])
        if not state["waiting"][1]:
            if evaluations >= SECOND_START_UNTIL:
                state["finished"][1] = True
            return
        if not state["finished"][0]:
            return
        state["waiting"][1] = False
        first = self.solver.optimality(state["solver"], 0)
        if evaluations > SECOND_START_WITHIN or first is None:
            return
        z = second_start(np.stack([self.history["z"][0][0], first.z]))
        if z is not None:
            self.solver.restart(self.evaluate.space, state["solver"], 1, z)
            state["finished"][1] = False
            state["steps_since_update"][1] = 0
            state["steps_without_better"] = np.asarray(0)

"""The tuning problem: one object that `tune`, `pareto`, the solvers and the report share.

`TuningProblem.build` checks the arguments of the user once.  A `TuningProblem` is a pytree: its
arrays are traced and its structure is static, so it is passed to the compiled functions of
`evaluation` as it is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.noise import has_noise
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario, canonical, check_step, fit_joints
from iblf_jax.studies.designs import MAX_RUNS
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.draws import Cases, Target, targets_of
from iblf_jax.studies.recommended import recommended_dt
from iblf_jax.tuning.evaluation import NO_LEVEL, NUMBERS_A_RUN, Candidate, Value, piece_counts
from iblf_jax.tuning.evaluation import value as evaluated
from iblf_jax.tuning.objectives import (
    Objective,
    check_signals,
    checked,
    complete,
    for_scenario,
    is_complete,
)
from iblf_jax.tuning.parameters import Block, Box, Tunable, layout, values_at
from iblf_jax.tuning.ranges import sampled_too_slowly
from iblf_jax.tuning.robust import Risk, as_risk
from iblf_jax.tuning.runs import RunRequest, check_backend, values_together
from iblf_jax.tuning.solvers import Constraints, SearchSpace, Solver

FIRST_PENALTY = 10.0
"""Penalty parameter of the augmented Lagrangian at the start."""
MULTIMODAL_FROM = 6
"""Number of coordinates from which a problem with requirements is expected to have several local
minima.  Of three problems of six gains, one became 4 % better by the search from several points,
the others were as good without."""

STATIC = (
    *("blocks", "targets", "runs", "request", "risk", "allowed"),
    *("piece_counts", "on_front", "requirements_in_loss"),
)
TRACED = ("cases", "objective", "dt", "box", "perturbations", "seed")


@partial(jax.tree_util.register_dataclass, data_fields=TRACED, meta_fields=STATIC)
@dataclasses.dataclass(frozen=True, eq=False)
class TuningProblem:
    """Parameters with ranges, objective with requirements, cases and risk of a tuning."""

    cases: Cases
    """The scenario, canonical, with the perturbations of its leaves and the key of the draws."""
    objective: Objective
    """With requirements; with all scales and limits."""
    dt: jax.Array
    """Time step, () [s]."""
    box: Box
    """Start and range of the coordinates z."""
    perturbations: dict[str, Perturbation]
    """As the user gave them."""
    seed: Any
    """Of the draws."""
    blocks: tuple[Block, ...]
    """The tuned leaves, as parts of z."""
    targets: tuple[Target, ...]
    """The perturbed leaves."""
    runs: int
    """Number B of perturbed runs."""
    request: RunRequest
    """Of the engine: steps, integrator, backend."""
    risk: Risk
    allowed: tuple[float, ...]
    """Share of the runs that may violate each requirement."""
    piece_counts: tuple[int, ...]
    """Number of pieces of each quantity, the margin's last."""
    on_front: bool = False
    """Whether the terms are objectives of a front, with weights and levels of each start."""
    requirements_in_loss: bool = False
    """Whether the loss is the augmented Lagrangian, for solvers without constraints."""

    @staticmethod
    def build(
        scenario: Scenario,
        parameters: Sequence[str | Tunable],
        objective: Any,
        *,
        duration: float,
        dt: float = 1e-3,
        method: str = "rk4",
        backend: str = "auto",
        perturbations: Mapping[str, Perturbation] | None = None,
        runs: int = 1,
        seed: int = 0,
        risk: str | Risk = "mean",
        on_front: bool = False,
    ) -> TuningProblem:
        """Checks the arguments of `tune` and puts them together; scales and limits that are not
        given become the values at the start.

        Raises:
          ValueError: an argument that is not valid; the message names it and the remedy.
        """
        tableau(method)
        backend = check_backend(backend)
        steps = checks.whole_steps(duration, dt)
        goal = checked(objective)
        seed = checks.seed(seed)
        runs = checks.positive_integer("runs", runs, most=MAX_RUNS)
        scenario = canonical(scenario)
        check_step(scenario, float(dt))
        if perturbations is None:
            perturbations = {}
        targets, by_path = targets_of(scenario, perturbations)
        _check_runs(runs, bool(targets) or has_noise(scenario))
        blocks, box = layout(scenario, parameters, float(dt), method)
        checks.fits("runs", runs, 8.0 * (1 + len(box.z)) * NUMBERS_A_RUN)
        goal = _fitted(goal, scenario)
        # Terms without a scale are evaluated once with scale 1, for their values at the start.
        dtype = scenario.initial.q.dtype
        arrays = complete(goal, np.ones(len(goal.terms))), by_path, dt
        scaled, by_path, step = jax.tree.map(lambda x: jnp.asarray(x, dtype), arrays)
        problem = TuningProblem(
            cases=Cases(scenario, by_path, jax.random.PRNGKey(seed)),
            objective=scaled,
            dt=step,
            box=box,
            perturbations=dict(perturbations),
            seed=np.uint32(seed),
            blocks=blocks,
            targets=targets,
            runs=runs,
            request=RunRequest.of(scenario, steps=steps, method=method, backend=backend),
            risk=as_risk(risk),
            allowed=tuple(float(r.allowed) for r in goal.requirements),
            piece_counts=piece_counts(scaled, scenario, float(duration)),
            on_front=on_front,
        )
        if is_complete(goal):
            return problem
        goal = complete(goal, problem.at_start().exact[0, : len(goal.terms)])
        return problem.with_objective(jax.tree.map(lambda x: jnp.asarray(x, dtype), goal))

    def with_objective(self, objective: Objective) -> TuningProblem:
        """The problem with another objective of the same structure."""
        return dataclasses.replace(self, objective=objective)

    def for_solver(self, solver: Solver) -> TuningProblem:
        """The problem as a solver needs it."""
        return dataclasses.replace(
            self,
            requirements_in_loss=not solver.handles_requirements,
            request=self.request._replace(nested=solver.traces_evaluation),
        )

    # -------------------------------------------------------------------------------- properties

    @property
    def scenario(self) -> Scenario:
        """The scenario that tuning starts from."""
        return self.cases.scenario

    @property
    def size(self) -> int:
        """Number p of coordinates."""
        return len(self.box.z)

    @property
    def multimodal(self) -> bool:
        """Whether several local minima are expected, so that searches from different starts end at
        different gains.
        """
        return bool(self.allowed) and self.size >= MULTIMODAL_FROM

    def search_space(self, iterations: int) -> SearchSpace:
        """What a solver knows of the problem, in a search of so many steps at most."""
        terms = len(self.objective.terms)
        counts = self.piece_counts[terms:-1]
        shares = self.allowed
        if self.on_front:  # the levels of the terms
            counts = (*counts, *(1,) * terms)
            shares = (*shares, *(0.0,) * terms)
        constraints = Constraints.of(counts, shares, self.runs)
        return SearchSpace(self.box, constraints, self.multimodal, iterations)

    # -------------------------------------------------------------------------------- evaluation

    def candidates(self, z: np.ndarray) -> Candidate:
        """Candidates at z, (S, p): the same runs for all, multipliers 0."""
        dtype = self.dt.dtype
        starts = len(z)
        terms = len(self.objective.terms)
        index = np.arange(self.runs, dtype=np.uint32)
        return Candidate(
            z=np.asarray(z, dtype),
            index=np.broadcast_to(index, (starts, self.runs)),
            weights=np.ones((starts, terms), dtype),
            multipliers=np.zeros((starts, len(self.allowed)), dtype),
            penalty=np.full(starts, FIRST_PENALTY, dtype),
            levels=np.full((starts, terms), NO_LEVEL, dtype),
        )

    def values(self, z: np.ndarray) -> Value:
        """The problem without derivatives at points z, (S, p), as NumPy arrays.

        Points are evaluated in groups of one size, so that few shapes are compiled.
        """
        # Where many points will be evaluated later, one point is evaluated by their program.
        many = len(z) > 1 or self.runs > 1 or self.multimodal or self.on_front
        group = values_together(self.runs) if many else 1
        parts = []
        for first in range(0, len(z), group):
            points = np.resize(z[first : first + group], (group, z.shape[1]))
            parts.append(jax.tree.map(np.asarray, evaluated(self, self.candidates(points))))
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(z)], *parts)

    def at_start(self) -> Value:
        """The problem at its start, (1, ...)."""
        return self.values(self.box.z[None])

    def sampled_too_slowly(self, z: np.ndarray) -> bool:
        """Whether the law's sampling period is too long for the gains at z, (p,)."""
        values = values_at(self.blocks, jnp.asarray(z))
        return sampled_too_slowly(with_parameters(self.scenario, values))

    def unstable_error(self, trusted: float = 0.0) -> ValueError:
        """The error of a problem of which no tested gains have runs that can all be integrated; it
        names a smaller step.

        Args:
          trusted: share of the runs that can be integrated, at the best of these gains.
        """
        count = round(trusted * self.runs)
        how_many = "no run"
        if count:
            how_many = f"only {count} of {self.runs} runs"
        remedy = (
            f"Take dt={self.suggested_dt():g}, not {float(self.dt):g} s (ij.recommended_dt), lower"
            " gains, or narrower perturbations."
        )
        came = f"gains with which {how_many} can be integrated to the end, and stably"
        return checks.fail("scenario", came, "a start with which all runs can", remedy)

    def suggested_dt(self) -> float:
        """The largest stable time step, found by simulation [s]."""
        return recommended_dt(
            self.scenario,
            duration=self.request.steps * float(self.dt),
            method=self.request.method,
            perturbations=self.perturbations or None,
            seed=int(self.seed),
        )


def _fitted(objective: Objective, scenario: Scenario) -> Objective:
    """The objective for the joints and signals of a scenario."""
    fitted = for_scenario(objective, scenario)
    check_signals(fitted, scenario)
    fit_joints(fitted, scenario.n, "objective")
    return fitted


def _check_runs(runs: int, differ: bool) -> None:
    if runs > 1 and not differ:
        remedy = "All runs would be the same: give perturbations."
        raise checks.fail("runs", runs, "1 without perturbations", remedy)

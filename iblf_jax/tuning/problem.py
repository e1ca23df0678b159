"""The tuning problem: one object that `tune`, `pareto`, the solvers and the report share.

`TuningProblem.build` checks the arguments of the user once.  A `TuningProblem` is a pytree: its
arrays are traced and its structure is static, so it is passed to the compiled functions of
`evaluation` as it is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, programs
from iblf_jax.core.units import POSITION
from iblf_jax.engine import RunRequest, points_per_batch
from iblf_jax.simulation.noise import has_noise
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario, canonical, fitted_to_step
from iblf_jax.simulation.units import unit_text
from iblf_jax.studies.draws import Target, UncertainScenario, targets_of
from iblf_jax.studies.time_step import recommended_dt
from iblf_jax.tuning.objectives import (
    Objective,
    checked,
    complete,
    fitted,
    is_complete,
)
from iblf_jax.tuning.options import TuningRunOptions
from iblf_jax.tuning.parameters import Block, Box, Tunable, layout, values_at
from iblf_jax.tuning.quantities import Quantities
from iblf_jax.tuning.ranges import sampled_too_slowly
from iblf_jax.tuning.rollouts import Rollouts, draw_run, fold_of, piece_counts, rollouts
from iblf_jax.tuning.runs import NUMBERS_A_RUN
from iblf_jax.tuning.solvers import Constraints, SearchSpace, Solver

FIRST_PENALTY = 10.0
"""Penalty parameter of the augmented Lagrangian at the start."""
MULTIMODAL_FROM = 6
"""Number of coordinates from which a problem with requirements is expected to have several local
minima.  Of three problems of six gains, one became 4 % better by the search from several points,
the others were as good without."""
NO_LEVEL = 1e6
"""A level of a front that no objective reaches."""

STATIC = (
    *("blocks", "targets", "request", "allowed", "piece_counts"),
    *("on_front", "requirements_in_loss", "screens"),
)
TRACED = ("cases", "objective", "dt", "box", "options")


class Candidate(NamedTuple):
    """Where one start is evaluated, and with which weights; batches have the starts first."""

    z: Any
    """Coordinates, (p,)."""
    index: Any
    """Run numbers, (B,)."""
    weights: Any
    """Of the terms, (n_terms,)."""
    multipliers: Any
    """Of the requirements in the augmented Lagrangian, (n_requirements,)."""
    penalty: Any
    """Penalty parameter mu of the augmented Lagrangian, ()."""
    levels: Any = ()
    """Of the terms on a front, (n_terms,); NO_LEVEL where there is none."""


@partial(jax.tree_util.register_dataclass, data_fields=TRACED, meta_fields=STATIC)
@dataclasses.dataclass(frozen=True, eq=False)
class TuningProblem:
    """A tuning: parameters with ranges, an objective with requirements, and options of its runs."""

    cases: UncertainScenario
    """The scenario, canonical, with the perturbations of its leaves and the key of the draws."""
    objective: Objective
    """Terms and requirements, with all scales and limits."""
    dt: jax.Array
    """Time step as an array of the runs' type, () [s]."""
    box: Box
    """Start and range of the coordinates z."""
    options: TuningRunOptions
    """Options of the runs, checked."""
    blocks: tuple[Block, ...]
    """The tuned leaves, as parts of z."""
    targets: tuple[Target, ...]
    """The perturbed leaves."""
    request: RunRequest
    """What the engine runs: number of steps, integrator, executor; without the assessment of the
    runs, which a search does not read."""
    allowed: tuple[float, ...]
    """Share of the runs that may violate each requirement."""
    piece_counts: tuple[int, ...]
    """Number of pieces of each quantity, the margin's last."""
    on_front: bool = False
    """Whether the terms are objectives of a front, with weights and levels of each start."""
    requirements_in_loss: bool = False
    """Whether the loss is the augmented Lagrangian, for solvers without constraints."""
    screens: bool = False
    """Whether many points will be evaluated without derivatives."""

    @staticmethod
    def build(
        scenario: Scenario,
        parameters: Sequence[str | Tunable],
        objective: object,
        *,
        on_front: bool = False,
        screens: bool = False,
        **options: Any,
    ) -> TuningProblem:
        """Checks the arguments of `tune` and puts them together; scales and limits that are not
        given become the values at the start.

        Args:
          scenario, parameters, objective: as `tune`.
          on_front: whether the terms are objectives of a front.
          screens: whether many points will be evaluated without derivatives.
          options: of the runs, the fields of `TuningRunOptions`.

        Raises:
          ValueError: an argument that is not valid; the message names it and the remedy.
        """
        run = TuningRunOptions(**options).checked()
        goal = checked(objective)
        scenario = fitted_to_step(canonical(scenario), run.dt)
        targets, by_path = targets_of(scenario, run.perturbations)
        if run.runs > 1 and not (targets or has_noise(scenario)):
            remedy = "All runs would be the same: give perturbations."
            raise checks.fail("runs", run.runs, "1 without perturbations", remedy)
        blocks, box = layout(scenario, parameters, run.dt, run.method)
        checks.fits_memory("runs", run.runs, 8.0 * (1 + len(box.z)) * NUMBERS_A_RUN)
        goal = fitted(goal, scenario)
        dtype = scenario.initial.q.dtype
        # Terms without a scale are evaluated once with scale 1, for their values at the start.
        arrays = complete(goal, np.ones(len(goal.terms))), by_path, run.dt
        scaled, by_path, dt = jax.tree.map(lambda x: jnp.asarray(x, dtype), arrays)
        problem = TuningProblem(
            cases=UncertainScenario(scenario, by_path, jax.random.PRNGKey(run.seed)),
            objective=scaled,
            dt=dt,
            box=box,
            options=dataclasses.replace(
                run, seed=cast(int, np.uint32(run.seed)), perturbations=dict(run.perturbations)
            ),
            blocks=blocks,
            targets=targets,
            request=run.request(scenario)._replace(assessed=False),
            allowed=tuple(float(r.allowed) for r in goal.requirements),
            piece_counts=piece_counts(scaled, scenario, run.duration),
            on_front=on_front,
            screens=screens,
        )
        if is_complete(goal):
            return problem
        *at_start, deficit = problem.exact_at_start()
        unit = unit_text(scenario, POSITION)
        goal = complete(goal, at_start[: len(goal.terms)], margin=-float(deficit), unit=unit)
        return problem.with_objective(jax.tree.map(lambda x: jnp.asarray(x, dtype), goal))

    def with_objective(self, objective: Objective) -> TuningProblem:
        """The problem with another objective of the same structure."""
        return dataclasses.replace(self, objective=objective)

    def for_solver(self, solver: Solver) -> TuningProblem:
        """The problem as a solver needs it."""
        return dataclasses.replace(self, requirements_in_loss=not solver.handles_requirements)

    # A problem and its arrays do not change, so it keeps what every value of a search needs.

    @cached_property
    def at_half_the_step(self) -> TuningProblem:
        """The problem with half the time step."""
        half = 0.5 * float(self.options.dt)
        return dataclasses.replace(
            self,
            dt=jnp.asarray(half, self.dt.dtype),
            options=dataclasses.replace(self.options, dt=half),
            request=self.request._replace(steps=2 * self.request.steps),
        )

    @cached_property
    def at_any_step(self) -> TuningProblem:
        """The problem without its number of steps, for functions that do not read it: they are then
        compiled once for all time steps.
        """
        return dataclasses.replace(self, request=self.request._replace(steps=0))

    @cached_property
    def fold(self) -> tuple[Quantities, ...]:
        """The quantities of its runs and the margin; read it outside of `jit`, as it would keep
        the tracers of a program.
        """
        return fold_of(self.objective, self.dt.dtype, self.request.steps * self.dt)

    # -------------------------------------------------------------------------------- properties

    @property
    def scenario(self) -> Scenario:
        """The scenario that tuning starts from."""
        return self.cases.scenario

    @property
    def runs(self) -> int:
        """Number B of perturbed runs."""
        return self.options.runs

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

    # -------------------------------------------------------------------------------------- runs

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

    def leaves(self, z: jax.Array, index: jax.Array) -> dict[str, jax.Array]:
        """Path -> value of each tuned or perturbed leaf in one run, at coordinates z, (p,)."""
        point = {path: x.astype(self.dt.dtype) for path, x in values_at(self.blocks, z).items()}
        return draw_run(self.cases, self.targets, point, index)[0]

    def leaves_of_runs(self, candidates: Candidate) -> dict[str, jax.Array]:
        """Path -> values of the leaves in all runs of all starts, (S * B, ...)."""
        return of_runs(self.leaves, candidates)

    def rollouts(self, candidates: Candidate, *, assessed: bool = False) -> Rollouts:
        """All runs of all starts, without derivatives, (S * B, ...); with the error of each run if
        they are `RunRequest.assessed`.
        """
        varied = _leaves_of_runs(self.at_any_step, candidates)
        request = self.request._replace(assessed=assessed)
        return rollouts(self.scenario, varied, self.fold, self.dt, request=request)

    def points_together(self, points: int) -> int:
        """How many of some points are evaluated without derivatives in one batch.

        Where many points will be evaluated later, one point is evaluated by their program.
        """
        many = points > 1 or self.screens or self.runs > 1 or self.multimodal or self.on_front
        return points_per_batch(self.runs) if many else 1

    def exact_at_start(self) -> np.ndarray:
        """Each quantity at the start without smoothing, averaged over the runs, (K + 1,)."""
        z = np.tile(self.box.z, (self.points_together(1), 1))
        found = self.rollouts(self.candidates(z))
        return np.asarray(jnp.mean(found.exact[: self.runs], axis=0))

    def sampled_too_slowly(self, z: np.ndarray) -> bool:
        """Whether the law's sampling period is too long for the gains at z, (p,)."""
        if self.scenario.sampling is None:
            return False
        values = values_at(self.blocks, jnp.asarray(z))
        return sampled_too_slowly(with_parameters(self.scenario, values))

    def unstable_error(self, trusted: float = 0.0) -> ValueError:
        """The error of a problem of which no tested gains have runs that can all be integrated; it
        names a smaller step.

        Args:
          trusted: share of the runs that can be integrated, at the best of these gains.
        """
        count = round(trusted * self.runs)
        how_many = f"only {count} of {self.runs} runs" if count else "no run"
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
            duration=self.options.duration,
            method=self.options.method,
            perturbations=self.options.perturbations or None,
            seed=int(self.options.seed),
        )


_leaves_of_runs = programs.jit(TuningProblem.leaves_of_runs, kept=True)


def of_runs(function: Callable[[jax.Array, jax.Array], object], candidates: Candidate) -> Any:
    """A function of the coordinates and the number of one run, for all runs of all starts,
    (S * B, ...).
    """
    by_start = jax.vmap(jax.vmap(function, in_axes=(None, 0)))(candidates.z, candidates.index)
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), by_start)

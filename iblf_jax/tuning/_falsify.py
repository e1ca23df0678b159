"""`falsify`: searches for a run that violates its bounds, by derivatives over start, disturbance
and plant within stated ranges.

Random runs seldom contain the worst case: in d dimensions its corner of the set is small.  Here the
uniform number u in [0, 1]^d behind each perturbation is the unknown, and each of S attacks, which
start at random points, solves

    minimise  margin(u) = min over time and joints of min(q - lower, upper - q)
    subject to     0 <= u <= 1

(or the margin of the velocities, or of the regions) by `solvers.sqp`: with the exact margin and its
gradient, which are those of the joint, side and instant that come nearest, a Hessian estimated from
changes of the gradient, and a trust region.  An attack that has converged starts anew at another
point.  All attacks run in one batch, derivatives by forward mode.  The result is the run with the
smallest margin of all, so it is never better than the starting points.

Runs that say nothing about the law are no result: a start outside its bounds, a mass matrix that is
not positive definite, a reference that leaves the bounds.  Attacks start at admissible points, and
a step to a point that is not admissible is halved.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices, programs
from iblf_jax.core.presentation import Content, Result
from iblf_jax.core.progress import announced, bar
from iblf_jax.core.pytree import astype
from iblf_jax.core.status import VIOLATED, Status, describe, has_flag
from iblf_jax.engine import RunRequest, Runs, takes_runs
from iblf_jax.engine.simulate import simulate
from iblf_jax.simulation.metrics import check_needs
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical, fitted_to_step
from iblf_jax.simulation.units import status_words, unit_text
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.perturbation_cube import Cube, unit_cube
from iblf_jax.studies.worst import Losses, WorstCaseSearch, search
from iblf_jax.tuning.evaluation import Derivatives, Value
from iblf_jax.tuning.margins import pieces_of_margins
from iblf_jax.tuning.parameters import Box
from iblf_jax.tuning.quantities import DEFICITS, SIGNAL_OF_MARGIN, Peak
from iblf_jax.tuning.runs import NUMBERS_A_RUN
from iblf_jax.tuning.solvers import SQP, SearchSpace

if TYPE_CHECKING:
    from tqdm import tqdm

SOLVER = SQP(tolerance=1e-4, radius=0.5)
MAX_HALVINGS = 8
"""How often a step to a point that is not admissible is halved before the attack stays where it
is."""
UNINFORMATIVE = Status.INFEASIBLE_REFERENCE | Status.STEP_TOO_LARGE
"""Flags of runs that say nothing about the law: no law could keep the bounds, or the time step is
too large."""
ALL_UNINFORMATIVE = (
    "In every run that was tried the reference leaves the bounds (Assumption 2) or the step is too"
    " large: narrow the perturbations, widen the bounds, or take a smaller dt."
)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class WorstCase(Result):
    """The worst run that `falsify` found."""

    scenario: Scenario
    """With the worst parameters in it."""
    values: dict[str, np.ndarray]
    """Path -> worst value, in the leaf's unit."""
    margin: float
    """Its smallest margin, in `unit`; negative if a bound was violated."""
    first_margin: float
    """The smallest margin of the random starting points."""
    status: int
    """Flags of `Status` of that run."""
    history: np.ndarray
    """Margin of every attack's trial at every step, (iterations + 1, starts); NaN for runs that say
    nothing about the law (`UNINFORMATIVE`)."""
    runs: int
    """Number of rollouts with derivatives."""
    run: Runs
    """How the worst run is computed again."""
    unit: str = dataclasses.field(default="rad", kw_only=True)
    """Of the margins."""

    @property
    def violated(self) -> bool:
        """Whether the scenario was falsified: a run within the sets did not keep its bounds or
        regions, or ran away.
        """
        return has_flag(self.status, VIOLATED | Status.NOT_FINITE)

    def replay(self, record_every: int = 1) -> Rollout:
        """The worst run, in full."""
        return simulate(self.scenario, record_every=record_every, runs_as=self.run)

    def _content(self) -> Content:
        word = "not falsified"
        if self.violated:
            word = "FALSIFIED"
        elif has_flag(self.status, Status.SAMPLING_TOO_SLOW):
            word = "bounds kept, but the sampled loop is unstable at this draw"
        lines = [
            f"WorstCase({word}: smallest margin {self.margin:.4g} {self.unit},"
            f" {self.first_margin:.4g} at random; {self.runs} runs)",
            f"  status: {describe(self.status, status_words(self.scenario))}",
        ]
        for path, x in self.values.items():
            lines.append(f"  {path}: {np.array2string(np.asarray(x), precision=5)}")
        return lines


@notices.each_warning_once
@checks.known_keywords
@announced("compiling the programs of a search for a failure")
@takes_runs
def falsify(
    scenario: Scenario,
    perturbations: Mapping[str, Perturbation],
    *,
    duration: float,
    dt: float = 1e-3,
    method: str = "rk4",
    backend: str = "auto",
    starts: int = 16,
    iterations: int = 12,
    seed: int = 0,
    margin: str = "positions",
    progress: bool | None = None,
) -> WorstCase:
    """Searches for the run with the smallest margin within stated sets.

        minimise over u in [0, 1]^d:   min over t and joints of min(q - lower, upper - q)

    or the margin of velocities or regions, by `margin`.

    Args:
      scenario: what to attack, with its tuned gains for example.
      perturbations: path -> `factor`, `offset` or `value` of a distribution with two finite ends,
        as in `monte_carlo`: the set.
      duration: length of a run [s], a multiple of the step.
      dt: time step [s].
      method: integrator.
      backend: as `tune`.
      starts: number of attacks, each from its own random point, in one batch; one that has
        converged starts anew from another point.
      iterations: steps of each of them.
      seed: of the starting points.
      margin: which one is minimised: of the "positions", the "velocities" or the "regions".
      progress: whether to show a progress bar; on a terminal or in a notebook, if not given.
      runs_as: an `ij.Runs`, in place of its fields.

    Returns:
      A `WorstCase`: the worst run found, and whether it left its bounds.  That no such run is found
      proves nothing.

    Raises:
      ValueError: a perturbation without ends (a normal distribution), no such margin, perturbations
        without an admissible run, or another argument that is not valid.

    Source: head of this module.
    """
    options = Runs(duration, dt, method, backend, seed)
    scenario = fitted_to_step(canonical(scenario), dt)
    request = options.request(scenario)
    starts = checks.positive_integer("starts", starts)
    checks.fits_memory("starts", starts, 8.0 * NUMBERS_A_RUN)
    iterations = checks.positive_integer("iterations", iterations, most=checks.MAX_STEPS)
    checks.fits_memory("iterations", iterations, 8 * starts)
    cube = unit_cube(scenario, perturbations)
    checks.fits_memory("starts", starts, 8.0 * (1 + cube.size) * NUMBERS_A_RUN)
    checks.one_of("margin", margin, SIGNAL_OF_MARGIN)
    one: Any = 1.0
    dtype = scenario.initial.q.dtype
    peak = astype(Peak(one, SIGNAL_OF_MARGIN[margin]), dtype)
    check_needs("margin", peak, scenario)
    unit = unit_text(scenario, DEFICITS[peak.signal])
    losses = partial(_losses, cube, peak, jnp.asarray(dt, dtype), request)
    problem = WorstCaseSearch(cube, losses, starts, (options.seed, 3))
    with bar(progress, iterations + 1, unit="steps") as shown:
        worst = search(problem, partial(_attack, iterations, shown, unit), ALL_UNINFORMATIVE)
    point = cube.values(jnp.asarray(worst.u, dtype))
    values = {path: np.asarray(x) for path, x in point.items()}
    history = np.stack(problem.history)
    first = history[np.isfinite(history).any(axis=1)][0]
    return WorstCase(
        scenario=with_parameters(scenario, values),
        values=values,
        margin=worst.loss,
        first_margin=float(np.min(first)),
        status=worst.status,
        history=np.where(np.isfinite(history), history, np.nan),
        runs=history.size,
        run=Runs(options.duration, options.dt, method),
        unit=unit,
    )


@dataclasses.dataclass
class _Attacks:
    """All attacks, as `solvers.sqp` evaluates them."""

    problem: WorstCaseSearch
    space: SearchSpace
    active: np.ndarray

    def __call__(self, u: np.ndarray) -> Derivatives:
        """The margins and their gradients; infinite where a run says nothing about the law."""
        found = self.problem(u)
        starts, size = u.shape
        return Derivatives(Value(found.values), found.gradients, np.zeros((starts, size, size)))


def _attack(iterations: int, shown: tqdm, unit: str, problem: WorstCaseSearch) -> None:
    """All steps of all attacks."""
    d, starts = problem.cube.size, problem.starts
    space = SearchSpace(Box(np.full(d, 0.5), np.zeros(d), np.ones(d)))
    attacks = _Attacks(problem, space, np.ones(starts, bool))
    state = SOLVER.init(space, problem.points())
    for step in range(iterations + 1):
        for attack in state:
            attack.trial = _admissible(problem.why_unusable, attack.z, attack.trial)
        SOLVER.step(attacks, state, SOLVER.tolerance)
        converged = np.flatnonzero(SOLVER.converged(state)).tolist()
        if converged:
            points = problem.points(step + 1)
            for s in converged:
                SOLVER.restart(space, state, s, points[s])
        shown.update(1)
        if problem.worst is not None:
            shown.set_postfix_str(f"margin {problem.worst.loss:.4g} {unit}")


def _admissible(
    refused: Callable[[np.ndarray], str], accepted: np.ndarray, trial: np.ndarray
) -> np.ndarray:
    """The trial, or the first of the points halfway back to the accepted one that is admissible."""
    for _ in range(MAX_HALVINGS):
        if not refused(trial):
            return trial
        trial = 0.5 * (accepted + trial)
    return accepted.copy()


def _losses(cube: Cube, peak: Peak, dt: jax.Array, request: RunRequest, u: np.ndarray) -> Losses:
    """The margins at u, (S, d), their gradients, and the status of each run."""
    found = _margins(cube, peak, dt, jnp.asarray(u, dt.dtype), request=request)
    margins, gradients, status = (np.asarray(x) for x in found)
    fine = np.isfinite(margins) & (status & int(UNINFORMATIVE) == 0)
    return Losses(np.where(fine, margins, np.inf), gradients, status)


@programs.jit(static_argnames="request")
def _margins(
    cube: Cube, peak: Peak, dt: jax.Array, u: jax.Array, *, request: RunRequest
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Smallest margin (S,), minus the peak of a deficit, its gradient by u (S, d) and the status of
    each attack.
    """
    margins, gradients, status = pieces_of_margins(cube, peak, dt, u, request=request)
    worst = jnp.argmin(margins, axis=1)
    margin = jnp.take_along_axis(margins, worst[:, None], axis=1)[:, 0]
    gradient = jnp.take_along_axis(gradients, worst[:, None, None], axis=1)[:, 0]
    return margin, gradient, status

"""Evaluates objective and requirements of a tuning problem, and their derivatives, by compiled
functions of the coordinates z.

For each start s and run b one rollout gives the quantities m_bk of the objective.  The objective is

    f(z) = risk_b [ sum_k w_k term_k(m_bk) ],

and its derivatives follow from the rollout's tangents dm/dz by the chain rule,

    df/dz = sum df/dm dm/dz,      d2f/dz2 ~ sum df/dm N + (dm/dz)^T d2f/dm2 dm/dz,

with the matrices N of `quantities`.

A requirement r is violated by G_r, the mean of g_r over the worst `allowed` share of the runs.
Within a run g_r is the largest of the pieces of its quantity, g_rj = (p_j - limit) / scale.  The
pieces and their exact gradients are returned for solvers that treat requirements as constraints.
For solvers that accept one loss only, the augmented Lagrangian

    L(z) = f(z) + sum_r psi(G_r; y_r, mu),     psi(G; y, mu) = (max(0, y + mu G)^2 - y^2) / (2 mu)

contains the requirements, with multipliers y and penalty parameter mu.

On a Pareto front every term k is an objective of its own, F_k = log risk_b[term_kb].  A start
minimises sum_k w_k F_k subject to levels of its own, F_k <= level_k, which are requirements of one
piece each.

Forward mode gives all of this in one pass; reverse mode, for many parameters, gives the gradient
of L only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import programs
from iblf_jax.core.status import UNTRUSTED, Status, has_flag
from iblf_jax.engine import run_batch_vjp, starts_per_batch
from iblf_jax.simulation.noise import NOISE_NAME
from iblf_jax.studies.draws import paths_overlap
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.problem import NO_LEVEL, Candidate, TuningProblem, of_runs
from iblf_jax.tuning.quantities import Quantities
from iblf_jax.tuning.robust import Risk, combine, worst_share
from iblf_jax.tuning.rollouts import Rollouts, fold_of
from iblf_jax.tuning.runs import in_groups, tangents_of_runs
from iblf_jax.tuning.solvers import SearchSpace
from iblf_jax.tuning.solvers._base import Derivatives, Value

if TYPE_CHECKING:
    from iblf_jax.engine.outcome import Outcome

T = TypeVar("T")


def _fold(problem: TuningProblem) -> tuple[Quantities, ...]:
    return fold_of(problem.objective, problem.dt.dtype, problem.request.steps * problem.dt)


def _by_start(tree: T, candidates: Candidate) -> T:
    """Arrays (S * B, ...) as (S, B, ...)."""
    return jax.tree.map(lambda x: x.reshape(*candidates.index.shape, *x.shape[1:]), tree)


# ----------------------------------------------------------- one start, from its B runs' numbers


def _terms(risk: Risk, objective: Objective, quantities: jax.Array) -> jax.Array:
    """Each term, combined over the runs, (n_terms,), from the quantities (B, K)."""
    terms = jax.vmap(objective.values)(quantities)
    return jax.vmap(partial(combine, risk), in_axes=1)(terms)


def _objective(problem: TuningProblem, candidate: Candidate, quantities: jax.Array) -> jax.Array:
    """f, from the quantities of the runs, (B, K)."""
    if problem.on_front:
        terms = _terms(problem.options.risk, problem.objective, quantities)
        return jnp.log(terms) @ candidate.weights
    losses = jax.vmap(problem.objective.values)(quantities) @ candidate.weights
    return combine(problem.options.risk, losses)


def _excesses(problem: TuningProblem, quantities: jax.Array) -> jax.Array:
    """G_r of each requirement, (n_requirements,)."""
    if not problem.allowed:
        return jnp.zeros((0,), quantities.dtype)
    each = jax.vmap(problem.objective.excesses)(quantities)
    return jnp.stack([worst_share(each[:, r], share) for r, share in enumerate(problem.allowed)])


def _loss(problem: TuningProblem, candidate: Candidate, smooth: jax.Array) -> jax.Array:
    """L = f + sum_r psi(G_r; y_r, mu), or f where the requirements are not part of the loss."""
    objective = _objective(problem, candidate, smooth)
    if not problem.requirements_in_loss:
        return objective
    y, mu = candidate.multipliers, candidate.penalty
    active = jnp.maximum(0.0, y + mu * _excesses(problem, smooth))
    return objective + jnp.sum(active**2 - y**2) / (2 * mu)


def value_of_start(
    problem: TuningProblem,
    candidate: Candidate,
    smooth: jax.Array,
    exact: jax.Array,
    status: jax.Array,
) -> Value:
    """The `Value` of one start.

    Args:
      problem: what is tuned.
      candidate: where, without a batch axis.
      smooth, exact: quantities of the runs, (B, K + 1).
      status: flags of the runs, (B,).
    """
    fine = (status & int(UNTRUSTED) == 0) & jnp.all(jnp.isfinite(smooth), axis=-1)
    valid = jnp.all(fine)
    risk = Risk()  # the mean
    if problem.on_front:
        risk = problem.options.risk
    return Value(
        loss=jnp.where(valid, _loss(problem, candidate, smooth), jnp.inf),
        objective=_objective(problem, candidate, exact),
        terms=_terms(risk, problem.objective, exact),
        smooth_excess=_excesses(problem, smooth),
        exact_excess=_excesses(problem, exact),
        margin=-jnp.max(exact[:, -1]),
        valid=valid,
        trusted=jnp.mean(fine.astype(exact.dtype)),
    )


def _derivatives_of_start(
    problem: TuningProblem,
    candidate: Candidate,
    outcome: Outcome,
    tangents: Mapping[str, jax.Array],
    products: tuple[jax.Array, ...],
) -> Derivatives:
    """Loss, gradient and Gauss-Newton matrix of one start, and the pieces of its requirements."""
    smooth, exact, pieces = (outcome.metrics[name] for name in Quantities.units)
    J = tangents["tuning_smooth"]
    pull = jax.grad(partial(_loss, problem, candidate))
    d_loss = pull(smooth)
    gradient = jnp.einsum("bk,buk->u", d_loss, J)
    ends = np.cumsum(problem.piece_counts)[:-1].tolist()
    by_quantity = jnp.split(pieces, ends, axis=1)
    gradients = jnp.split(tangents["tuning_pieces"], ends, axis=2)
    N = jax.vmap(_fold(problem)[0].hessians)(products, by_quantity, gradients)
    second = jax.vmap(lambda tangent: jax.jvp(pull, (smooth,), (tangent,))[1], in_axes=1)(J)
    hessian = jnp.einsum("bk,bkuv->uv", d_loss, N) + jnp.einsum("ubk,bvk->uv", second, J)
    value = value_of_start(problem, candidate, smooth, exact, outcome.status)
    found = Derivatives(value, gradient, hessian)

    requirements = problem.objective.requirements
    first = len(problem.objective.terms)
    own = range(first, first + len(requirements))
    excess = [r.excess(by_quantity[k]) for r, k in zip(requirements, own, strict=True)]
    slopes = [gradients[k] / r.scale for r, k in zip(requirements, own, strict=True)]
    if problem.on_front:

        def over(smooth: jax.Array) -> jax.Array:
            terms = _terms(problem.options.risk, problem.objective, smooth)
            return jnp.log(terms) - candidate.levels

        # F_k - level_k in the first of the runs, and far below zero in the others.
        slope = jnp.einsum("tbk,buk->ut", jax.jacrev(over)(smooth), J)
        below = jnp.full((len(smooth), len(candidate.levels)), -NO_LEVEL, smooth.dtype)
        excess.append(below.at[0].set(over(smooth)))
        flat = jnp.zeros((len(smooth), *slope.shape), smooth.dtype)
        slopes.append(flat.at[0].set(slope))
    if not excess:
        return found
    return found._replace(
        pieces=jnp.concatenate(excess, axis=1), piece_gradients=jnp.concatenate(slopes, axis=2)
    )


# -------------------------------------------------------------------------------- compiled calls


def value(problem: TuningProblem, candidates: Candidate) -> Value:
    """The problem at the coordinates of each start, (S, ...)."""
    return _values(problem.at_any_step, candidates, problem.rollouts(candidates))


def values(
    problem: TuningProblem, z: np.ndarray, advance: Callable[[int], object] = lambda points: None
) -> Value:
    """The problem without derivatives at points z, (S, p), as NumPy arrays; `advance` is called
    with the number of points of each group.
    """
    group = problem.points_together(len(z))

    def of_rows(rows: np.ndarray) -> Value:
        return value(problem, problem.candidates(z[rows]))

    return in_groups(of_rows, len(z), group, advance)


def objective_at_quarter_step(problem: TuningProblem, z: np.ndarray) -> np.ndarray:
    """The objective at a quarter of the time step at points z, (S, p); NaN where a run is invalid
    or its estimated error too large even there, (S,).
    """
    fine = problem.at_half_the_step.at_half_the_step

    def of_rows(rows: np.ndarray) -> np.ndarray:
        candidates = fine.candidates(z[rows])
        found = fine.rollouts(candidates, assessed=True)
        each = _values(fine.at_any_step, candidates, found)
        is_inaccurate = _by_start(has_flag(np.asarray(found.status), Status.INACCURATE), candidates)
        is_usable = np.asarray(each.valid) & ~np.any(is_inaccurate, axis=1)
        return np.where(is_usable, each.objective, np.nan)

    # Many points follow one another, so that one program serves them all.
    return in_groups(of_rows, len(z), fine.points_together(2))


@programs.jit(kept=True)
def _values(problem: TuningProblem, candidates: Candidate, found: Rollouts) -> Value:
    by_start = _by_start((found.smooth, found.exact, found.status), candidates)
    return jax.vmap(partial(value_of_start, problem))(candidates, *by_start)


@programs.jit(kept=True)
def forward_derivatives(problem: TuningProblem, candidates: Candidate) -> Derivatives:
    """The problem with gradient (S, p), Gauss-Newton matrix (S, p, p) and the pieces of the
    requirements, by forward mode.
    """
    # The tied leaves that no perturbation changes have one number for all of their entries.
    perturbed = [target.path for target in problem.targets]
    tied = [block.path for block in problem.blocks if block.size == 1]
    found = tangents_of_runs(
        problem.scenario,
        problem.leaves_of_runs(candidates),
        _jacobians(problem, candidates),
        _fold(problem),
        problem.dt,
        problem.request,
        uniform=[path for path in tied if not _overlaps(problem, path, perturbed)],
    )
    by_start = _by_start((found.outcome, found.tangents, found.products), candidates)
    return jax.vmap(partial(_derivatives_of_start, problem))(candidates, *by_start)


def _jacobians(problem: TuningProblem, candidates: Candidate) -> dict[str, jax.Array]:
    """Path -> dx/dz, (S * B, ..., p), for the leaves that depend on the coordinates."""
    every = of_runs(jax.jacfwd(problem.leaves), candidates)
    tuned = [block.path for block in problem.blocks]
    return {
        path: x
        for path, x in every.items()
        if path != NOISE_NAME and _overlaps(problem, path, tuned)
    }


def _overlaps(problem: TuningProblem, path: str, others: list[str]) -> bool:
    return any(paths_overlap(problem.scenario, path, other) for other in others)


@programs.jit(kept=True)
def reverse_derivatives(problem: TuningProblem, candidates: Candidate) -> Derivatives:
    """The problem with gradient (S, p), by reverse mode; its matrix is zero."""
    tuned = [block.path for block in problem.blocks]

    def leaves(z: jax.Array) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
        """The leaves that depend on the coordinates, and the others."""
        values = problem.leaves_of_runs(candidates._replace(z=z))
        depends = {
            path: x
            for path, x in values.items()
            if path != NOISE_NAME and _overlaps(problem, path, tuned)
        }
        return depends, {path: x for path, x in values.items() if path not in depends}

    depends, to_coordinates, others = jax.vjp(leaves, candidates.z, has_aux=True)
    outcome, to_leaves = run_batch_vjp(
        problem.scenario,
        depends | others,
        list(depends),
        ["tuning_smooth"],
        _fold(problem),
        problem.dt,
        problem.request,
    )
    numbers = outcome.metrics["tuning_smooth"], outcome.metrics["tuning_exact"], outcome.status
    smooth, exact, status = _by_start(numbers, candidates)
    value = jax.vmap(partial(value_of_start, problem))(candidates, smooth, exact, status)
    slopes = jax.vmap(jax.grad(partial(_loss, problem), argnums=1))(candidates, smooth)
    slopes = slopes.reshape(-1, slopes.shape[-1])
    (gradients,) = to_coordinates(to_leaves({"tuning_smooth": slopes}))
    size = gradients.shape[-1]
    return Derivatives(value, gradients, jnp.zeros((*gradients.shape, size), gradients.dtype))


DERIVATIVES = {"forward": forward_derivatives, "reverse": reverse_derivatives}
"""Mode of differentiation -> function of a problem and candidates."""


# ---------------------------------------------------------------------------------- on the host


class Evaluator:
    """The compiled problem on the host: coordinates in, NumPy arrays out.

    Args:
      problem: what is tuned.
      candidates: of S starts; their z is replaced at each call.
      mode: of differentiation.
      space: what the solver knows of the problem.
      most: largest number of starts in a group; as many as the vectors of a processor hold if not
        given.
    """

    def __init__(
        self,
        problem: TuningProblem,
        candidates: Candidate,
        mode: str,
        space: SearchSpace,
        most: int | None = None,
    ):
        self.problem = problem
        self.candidates = candidates
        self.derivatives = DERIVATIVES[mode]
        self.space = space
        self.evaluations = 0
        """Number of points that were evaluated with derivatives."""
        self.plain_values = 0
        """Number of points that were evaluated without derivatives."""
        self.on_values: Callable[[np.ndarray, Value], None] = lambda z, found: None
        """Called with points and their values after each evaluation without derivatives."""
        starts, runs = candidates.index.shape
        self.group = starts_per_batch(starts if most is None else min(starts, most), runs)
        self.active = np.ones(starts, bool)
        """Which starts are evaluated; the others are returned as invalid."""

    def __call__(self, z: np.ndarray) -> Derivatives:
        """Value and derivatives at z, (S, p).

        Active starts are evaluated in groups of one size, so that one shape is compiled.
        """
        active = np.flatnonzero(self.active)
        self.evaluations += len(active)
        candidates = self.candidates._replace(z=np.asarray(z, self.problem.dt.dtype))

        def derivatives(rows: np.ndarray) -> Derivatives:
            group = jax.tree.map(lambda x: np.asarray(x)[active[rows]], candidates)
            return self.derivatives(self.problem, group)

        found = in_groups(derivatives, len(active), self.group)
        if len(active) == len(z):
            return found

        def among_all(x: np.ndarray) -> np.ndarray:
            full = np.zeros((len(z), *x.shape[1:]), x.dtype)
            if np.issubdtype(x.dtype, np.floating):
                full[:] = np.nan
            full[active] = x
            return full

        found = jax.tree.map(among_all, found)
        found.value.loss[~found.value.valid] = np.inf  # the other starts are invalid
        return found

    def traced(self) -> Any:
        """The program of value and derivatives of a group of starts, traced."""
        group = jax.tree.map(lambda x: np.asarray(x)[: self.group], self.candidates)
        return self.derivatives.trace(self.problem, group)

    def values(self, z: np.ndarray) -> Value:
        """Value at any number of points z, (N, p), on the problem's own runs, without
        derivatives.
        """
        found = values(self.problem, z)
        self.plain_values += len(z)
        self.on_values(z, found)
        return found

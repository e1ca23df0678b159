"""The tuning problem as compiled functions of the coordinates z: objective and requirements, with
their derivatives.

Per start s and run b the quantities m_bk of the objective come from one rollout; the objective puts
them together,

    f(z) = risk_b [ sum_k w_k term_k(m_bk) ],

and its derivatives follow from the rollout's tangents dm/dz by the chain rule,

    df/dz = sum df/dm dm/dz,      d2f/dz2 ~ sum df/dm N + (dm/dz)^T d2f/dm2 dm/dz,
    N: see `quantities`.

A requirement r is broken by G_r, the mean of g_r over the worst `allowed` share of the runs.  In a
run g_r is the largest of its quantity's pieces, g_rj = (p_j - limit) / scale, and these come with
their exact slopes, for the default method (`newton`).  The methods of optax know one loss only,
with an augmented Lagrangian in it,

    L(z) = f(z) + sum_r psi(G_r; lam_r, mu),     psi(G; lam, mu) = (max(0, lam + mu G)^2 - lam^2) /
    (2 mu).

For a front every term k is an objective of its own, F_k = log risk_b[term_kb].  A start minimises
sum_k w_k F_k under levels of its own, F_k <= level_k, which are requirements of one piece each.

Forward mode gives all of it at once; reverse mode, for many parameters, the gradient of L.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core.status import UNTRUSTED
from iblf_jax.engine.execute import run_batch, run_for_reverse
from iblf_jax.engine.mechanism import Mechanism
from iblf_jax.engine.step import Run
from iblf_jax.simulation.accuracy import RELATIVE
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.metrics import Torque
from iblf_jax.simulation.paths import get, with_parameters
from iblf_jax.simulation.sampling import NOISE_NAME, noise_of
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.draws import Cases, Target, draw, merge, same_place
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.parameters import Block, values_at
from iblf_jax.tuning.quantities import Peak, Quantities
from iblf_jax.tuning.robust import Risk, combine, worst_share
from iblf_jax.tuning.tangents import by_coordinates


class Formulation(NamedTuple):
    """What is fixed of a tuning problem: which leaves move, how long the runs are, how they are
    weighed; static.
    """

    blocks: tuple[Block, ...]
    targets: tuple[Target, ...]
    steps: int
    method: str
    risk: Risk
    shares: tuple[float, ...]
    """Share of the runs that G_r is taken over, for each requirement."""
    levels: bool = False
    """Whether the terms are objectives of a front: each start has its own weights and levels of
    F_k."""
    backend: str = "auto"
    """What values and forward mode run on; reverse mode is plain XLA."""
    nested: bool = False
    """Whether they are called from a loop of JAX's."""
    mechanism: Mechanism | None = None
    """What of the robots is compiled in."""
    pieces: tuple[int, ...] = ()
    """How many pieces each quantity has, the margin's last."""
    penalised: bool = False
    """Whether the requirements are in the loss."""


class ProblemInputs(NamedTuple):
    """What all starts share; traced."""

    cases: Cases
    objective: Objective
    dt: jax.Array


class Lane(NamedTuple):
    """What differs between starts: coordinates (p,), run numbers (B,), weights of the terms,
    multipliers, levels of the terms.
    """

    z: Any
    index: Any
    weights: Any
    lam: Any
    mu: Any
    level: Any = ()
    """For a front, (n_terms,); NO_LEVEL where there is none."""


NO_LEVEL = 1e6
"""A level that nothing reaches."""

NUMBERS_A_RUN = 100
"""Numbers that one run of a batch holds while it is computed, roughly: its state, its stages, its
folds."""


class Value(NamedTuple):
    """A problem at one z."""

    loss: Any
    """L, infinite where a run was invalid."""
    objective: Any = ()
    """L without requirements and without smoothing: what results are compared by."""
    terms: Any = ()
    """Each unweighted term without smoothing, averaged over the runs, for a front combined as the
    risk says, (n_terms,)."""
    excess: Any = ()
    """G_r from the smooth quantities, (n_requirements,)."""
    exact_excess: Any = ()
    """G_r from the exact ones."""
    margin: Any = ()
    """The smallest margin of all runs [rad]."""
    valid: Any = ()
    exact: Any = ()
    """Each quantity without smoothing, averaged over the runs, (K + 1,); the last is minus the
    margin."""
    trusted: Any = ()
    """Share of the runs that were integrated to their end, and stably; 1 where valid."""


class Slope(NamedTuple):
    """A problem at one z, with derivatives."""

    value: Value
    gradient: Any
    hessian: Any
    excess: Any = ()
    """g of each piece of each requirement in each run, (B, M), one requirement after the other,
    levels last and in the first run alone."""
    slopes: Any = ()
    """Their slopes, (B, p, M)."""


WINDOWS = 8
"""Windows of time of a peak: within one of them a signal seldom has two peaks of one height.  With
8, a peak of `presets.ur5` takes 1,400 choices of a step with 14 tangents, of some 200,000
operations."""


def fold_of(objective: Objective, dtype, duration: Any = None) -> tuple[Quantities, ...]:
    """The fold of a problem: its quantities, peaks in windows of the duration if there is one, and
    the margin last.
    """
    one: Any = 1.0
    parts = objective.quantities
    if duration is not None:
        edges = jnp.asarray(duration, dtype) * jnp.asarray(np.arange(1, WINDOWS) / WINDOWS, dtype)
        parts = tuple(
            dataclasses.replace(x, windows=edges) if isinstance(x, Peak) else x for x in parts
        )
    return (
        jax.tree.map(lambda x: jnp.asarray(x, dtype), Quantities((*parts, Peak(one, "deficit")))),
    )


def piece_counts(objective: Objective, scenario: Scenario, duration: float) -> tuple[int, ...]:
    """How many pieces each quantity has, the margin's last."""
    sample = jax.eval_shape(
        lambda s: evaluate(s, jnp.zeros_like(s.initial.q[0]), initial_state(s))[1], scenario
    )
    return fold_of(objective, scenario.initial.q.dtype, duration)[0].counts(sample)


def _fold(formulation: Formulation, shared: ProblemInputs) -> tuple[Quantities, ...]:
    return fold_of(shared.objective, shared.dt.dtype, formulation.steps * shared.dt)


def _varied(
    formulation: Formulation, shared: ProblemInputs, z: jax.Array, index: jax.Array
) -> dict[str, jax.Array]:
    """Path -> value for one run."""
    point = {
        path: x.astype(shared.dt.dtype) for path, x in values_at(formulation.blocks, z).items()
    }
    return _drawn(shared.cases, formulation.targets, point, index)[0]


def _drawn(
    cases: Cases,
    targets: tuple[Target, ...],
    point: dict[str, jax.Array],
    index: jax.Array,
    nominal: bool = False,
):
    """Path -> value for one run with the leaves of a point, and whether its draws were
    admissible.
    """
    noise = noise_of(cases.scenario, cases.key, index)
    if not targets:
        return point | noise, jnp.asarray(True)
    made, _, admissible = draw(cases, targets, index, point, {})
    if nominal:
        scenario = with_parameters(cases.scenario, point)
        made, admissible = (
            {path: jnp.asarray(get(scenario, path)) for path in made},
            jnp.asarray(True),
        )
    return merge(cases.scenario, point, made) | noise, admissible


def _of_lanes(formulation: Formulation, shared: ProblemInputs, lanes: Lane):
    """Path -> values (S, B, ...)."""
    one = partial(_varied, formulation, shared)
    return jax.vmap(jax.vmap(one, in_axes=(None, 0)))(lanes.z, lanes.index)


def _flat(tree, lead: int = 2):
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[lead:])), tree)


def _penalty(excess: jax.Array, lam: jax.Array, mu: jax.Array) -> jax.Array:
    return jnp.sum(jnp.maximum(0.0, lam + mu * excess) ** 2 - lam**2) / (2 * mu)


def _excesses(formulation: Formulation, objective: Objective, quantities: jax.Array) -> jax.Array:
    each = jax.vmap(objective.excesses)(quantities)
    found = [worst_share(each[:, r], share) for r, share in enumerate(formulation.shares)]
    return jnp.stack(found) if found else jnp.zeros((0,), quantities.dtype)


def _objective(
    formulation: Formulation, shared: ProblemInputs, lane: Lane, smooth: jax.Array
) -> jax.Array:
    if formulation.levels:
        return jnp.log(_each(formulation.risk, shared, smooth)) @ lane.weights
    return combine(formulation.risk, jax.vmap(shared.objective.values)(smooth) @ lane.weights)


def _each(risk: Risk, shared: ProblemInputs, quantities: jax.Array) -> jax.Array:
    """Each term, its runs combined, (n_terms,), from the quantities of the runs (B, K)."""
    return jax.vmap(partial(combine, risk), in_axes=1)(
        jax.vmap(shared.objective.values)(quantities)
    )


def _loss(
    formulation: Formulation, shared: ProblemInputs, lane: Lane, smooth: jax.Array
) -> jax.Array:
    """L of one start, from the quantities of its runs (B, K); f where the requirements are not in
    it.
    """
    objective = _objective(formulation, shared, lane, smooth)
    if not formulation.penalised:
        return objective
    return objective + _penalty(_excesses(formulation, shared.objective, smooth), lane.lam, lane.mu)


def _value(
    formulation: Formulation, shared: ProblemInputs, lane: Lane, smooth, exact, status
) -> Value:
    fine = (status & int(UNTRUSTED) == 0) & jnp.all(jnp.isfinite(smooth), axis=-1)
    valid = jnp.all(fine)
    return Value(
        jnp.where(valid, _loss(formulation, shared, lane, smooth), jnp.inf),
        _objective(formulation, shared, lane, exact),
        _each(formulation.risk if formulation.levels else Risk(), shared, exact),
        _excesses(formulation, shared.objective, smooth),
        _excesses(formulation, shared.objective, exact),
        -jnp.max(exact[:, -1]),
        valid,
        jnp.mean(exact, axis=0),
        jnp.mean(fine.astype(exact.dtype)),
    )


def _slope(
    formulation: Formulation, shared: ProblemInputs, lane: Lane, outcome, tangents, products
) -> Slope:
    """Loss, gradient and Gauss-Newton matrix of one start, and the pieces of its requirements;
    arrays of its B runs.
    """
    smooth, exact, pieces = (outcome.metrics[name] for name in Quantities.units)
    pull = jax.grad(partial(_loss, formulation, shared, lane))
    d_loss = pull(smooth)
    J = tangents["tuning_smooth"]
    gradient = jnp.einsum("bk,buk->u", d_loss, J)
    ends = np.cumsum(formulation.pieces)[:-1].tolist()
    parts, slopes = (
        jnp.split(pieces, ends, axis=1),
        jnp.split(tangents["tuning_pieces"], ends, axis=2),
    )
    N = jax.vmap(_fold(formulation, shared)[0].hessians)(products, parts, slopes)
    bent = jax.vmap(lambda tangent: jax.jvp(pull, (smooth,), (tangent,))[1], in_axes=1)(J)
    hessian = jnp.einsum("bk,bkuv->uv", d_loss, N) + jnp.einsum("ubk,bvk->uv", bent, J)
    found = Slope(
        _value(formulation, shared, lane, smooth, exact, outcome.status), gradient, hessian
    )
    requirements = shared.objective.requirements
    own = range(len(shared.objective.terms), len(parts) - 1)
    excess = [r.excess(parts[k]) for r, k in zip(requirements, own, strict=True)]
    moved = [slopes[k] / r.scale for r, k in zip(requirements, own, strict=True)]
    if formulation.levels:
        over, along = _over_levels(formulation, shared, lane, smooth, J)
        excess, moved = [*excess, over], [*moved, along]
    if not excess:
        return found
    return found._replace(
        excess=jnp.concatenate(excess, axis=1), slopes=jnp.concatenate(moved, axis=2)
    )


def _over_levels(
    formulation: Formulation, shared: ProblemInputs, lane: Lane, smooth: jax.Array, J: jax.Array
):
    """F_k - level_k in the first of the runs, far below zero in the others, (B, n_terms), and their
    slopes, (B, p, n_terms).
    """

    def over(smooth):
        return jnp.log(_each(formulation.risk, shared, smooth)) - lane.level

    slopes = jnp.einsum("tbk,buk->ut", jax.jacrev(over)(smooth), J)
    excess = (
        jnp.full((len(smooth), len(lane.level)), -NO_LEVEL, smooth.dtype).at[0].set(over(smooth))
    )
    return excess, jnp.zeros((len(smooth), *slopes.shape), smooth.dtype).at[0].set(slopes)


class Rollouts(NamedTuple):
    """What runs give, (R, ...)."""

    smooth: Any
    exact: Any
    """Each quantity, the last minus the margin, (R, K + 1)."""
    peak_torque: Any
    """Joint by joint, (R, n)."""
    relative_error: Any
    """What the step made of each run, as a part of its tube."""
    status: Any
    fastest_mode: Any


@partial(jax.jit, static_argnames=("run", "backend"))
def rollouts(
    scenario: Scenario,
    varied: dict[str, jax.Array],
    objective: Objective,
    dt: jax.Array,
    *,
    run: Run,
    backend: str,
) -> Rollouts:
    """Runs without derivatives: what a search, and the report on what it found, have in common.

    Args:
      scenario, varied, dt, run, backend: as `run_batch`.
      objective: complete.
    """
    folds = (*fold_of(objective, dt.dtype, run.steps * dt), Torque())
    outcome = run_batch(scenario, varied, folds, dt, run, backend=backend)
    smooth, exact, peak_torque, error = (
        outcome.metrics[name] for name in ("tuning_smooth", "tuning_exact", "peak_torque", RELATIVE)
    )
    return Rollouts(smooth, exact, peak_torque, error, outcome.status, outcome.fastest_mode)


@partial(jax.jit, static_argnames=("targets", "nominal"))
def drawn(
    cases: Cases,
    points: dict[str, jax.Array],
    index: jax.Array,
    *,
    targets: tuple[Target, ...],
    nominal: bool,
):
    """Path -> values of runs by their points (R, ...) and numbers (R,), drawn or `nominal`, and
    whether their draws were admissible.
    """
    return jax.vmap(lambda point, i: _drawn(cases, targets, point, i, nominal))(points, index)


def value(shared: ProblemInputs, lanes: Lane, *, formulation: Formulation) -> Value:
    """The problem at the coordinates of each start, (S, ...)."""
    run = Run(formulation.steps, formulation.method, mechanism=formulation.mechanism)
    varied = _flat_varied(shared, lanes, formulation=formulation)
    found = rollouts(
        shared.cases.scenario,
        varied,
        shared.objective,
        shared.dt,
        run=run,
        backend=formulation.backend,
    )
    return _values(shared, lanes, found, formulation=formulation)


@partial(jax.jit, static_argnames="formulation")
def _flat_varied(
    shared: ProblemInputs, lanes: Lane, *, formulation: Formulation
) -> dict[str, jax.Array]:
    return _flat(_of_lanes(formulation, shared, lanes))


@partial(jax.jit, static_argnames="formulation")
def _values(
    shared: ProblemInputs, lanes: Lane, found: Rollouts, *, formulation: Formulation
) -> Value:
    smooth, exact, status = (
        x.reshape(*lanes.index.shape, *x.shape[1:])
        for x in (found.smooth, found.exact, found.status)
    )
    return jax.vmap(partial(_value, formulation, shared))(lanes, smooth, exact, status)


@partial(jax.jit, static_argnames="formulation")
def slope(shared: ProblemInputs, lanes: Lane, *, formulation: Formulation) -> Slope:
    """The problem with gradient (S, p) and Gauss-Newton matrix (S, p, p), by forward mode."""
    fold = _fold(formulation, shared)
    one, overlap = partial(_varied, formulation, shared), partial(same_place, shared.cases.scenario)
    jacobian = jax.vmap(jax.vmap(jax.jacfwd(one), in_axes=(None, 0)))(lanes.z, lanes.index)
    moving = {
        path: x
        for path, x in _flat(jacobian).items()
        if path != NOISE_NAME and any(overlap(path, block.path) for block in formulation.blocks)
    }
    tied = [
        b.path
        for b in formulation.blocks
        if b.size == 1 and not any(overlap(b.path, t.path) for t in formulation.targets)
    ]
    varied = _flat(_of_lanes(formulation, shared, lanes))
    run = Run(formulation.steps, formulation.method, mechanism=formulation.mechanism)
    found = by_coordinates(
        shared.cases.scenario,
        varied,
        moving,
        fold,
        shared.dt,
        run,
        backend=formulation.backend,
        nested=formulation.nested,
        together=tied,
    )
    parts = jax.tree.map(
        lambda x: x.reshape(*lanes.index.shape, *x.shape[1:]),
        (found.outcome, found.tangents, found.products),
    )
    return jax.vmap(partial(_slope, formulation, shared))(lanes, *parts)


@partial(jax.jit, static_argnames="formulation")
def gradient(shared: ProblemInputs, lanes: Lane, *, formulation: Formulation) -> Slope:
    """The problem with gradient (S, p), by reverse mode; its matrix is zero."""

    def one_run(lane: Lane, index):
        values = _varied(formulation, shared, lane.z, index)
        noise = values.pop(NOISE_NAME, None)
        scenario, fold = with_parameters(shared.cases.scenario, values), _fold(formulation, shared)
        outcome = run_for_reverse(
            scenario, fold, shared.dt, Run(formulation.steps, formulation.method), noise
        )
        return outcome.metrics["tuning_smooth"], (outcome.metrics["tuning_exact"], outcome.status)

    def loss(z, lane: Lane):
        lane = lane._replace(z=z)
        smooth, (exact, status) = jax.vmap(partial(one_run, lane))(lane.index)
        return _loss(formulation, shared, lane, smooth), _value(
            formulation, shared, lane, smooth, exact, status
        )

    (_, found), slopes = jax.vmap(jax.value_and_grad(loss, has_aux=True))(lanes.z, lanes)
    return Slope(found, slopes, jnp.zeros((*slopes.shape, slopes.shape[-1]), slopes.dtype))

"""Sequential quadratic programming with Gauss-Newton matrices in a trust region: the default solver
for few gains.

At z the objective is modelled by f + g.s + s.B.s/2, and every piece j of every requirement by
e_j + a_j.s + s.C_j.s/2, with its value e_j = g_rj (`evaluation`) and its exact gradient a_j.  At an
optimum several peaks are at their limit at once, and each of them is a constraint of its own.  The
subproblem for the step s is, within |s_i| <= delta and the ranges of the gains,

    minimise  g.s + s.(B + sum_j y_j C_j).s/2 + rho sum_r v_r
    subject to     c_j + a_j.s <= v_r,  v_r >= 0      for the pieces j of r,

first with c_j = e_j, and then, CURVATURE_SOLVES times, with c_j = e_j + s.C_j.s/2 at the last
solution.  The trial is the solution of which the quadratic models predict the largest decrease.  y
are the multipliers of the previous subproblem.  A requirement that a share of B runs may violate, k
> 1 of them, has as G_r the mean of its k worst runs, which is exactly

    min over t of  t + sum_b max(0, max_j g_bj - t) / k,

so that t and one u_b >= 0 a run are unknowns beside s.  rho is larger than the multipliers, so that
f + rho sum_r max(0, G_r) is an exact penalty function, by which a trial is accepted or rejected.
rho is increased where that reduces the predicted violation.  Requirements that cannot be satisfied
together are thus violated as little as possible.

B = N + A, where N is the Gauss-Newton matrix at z, which forward mode provides at no extra cost.  A
approximates the omitted second derivatives of the motion, and C_j is the second derivative of a
piece.  Both are estimated from changes of gradients by the symmetric rank-one update,

    A <- A + r r^T / (r.s),      r = (change of g) - B s;
    C_j likewise,                r = (change of a_j) - C_j s,

also after rejected steps.  With many runs, C_j is stored for the worst pieces of each requirement
only.  delta grows and shrinks with the ratio of actual to predicted decrease.  A rejected step is
tried once more with c_j such that c_j + a_j.s is the value found (second-order correction).  A
trial with an invalid run is rejected, and delta shrinks: non-finite numbers never reach z.

Source: R. Fletcher, Practical Methods of Optimization, 2nd ed., section 14.4 (the subproblem and
its correction);
R. H. Byrd, J. Nocedal, R. A. Waltz, Optim. Methods Softw. 23 (2008) 645-665 (rho);
R. T. Rockafellar, S. Uryasev, J. Risk 2 (2000) 21-41 (the mean of the worst runs);
J. E. Dennis, D. M. Gay, R. E. Welsch, ACM Trans. Math. Softw. 7 (1981) 348-368 (A);
A. R. Conn, N. I. M. Gould, P. L. Toint, Math. Program. 50 (1991) 177-195 (rank-one updates in trust
regions).
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.tuning import quadratic
from iblf_jax.tuning.solvers._base import Constraints, Optimality, SearchSpace, check_options

RADIUS, RADIUS_IF_MULTIMODAL = 1.0, 0.5
"""First |s_i|; 1 is a factor e for a gain.  With 0.5 where several minima are expected, the mean
gap to the best known optimum of ten problems fell from 6.1 % to 3.1 % (see `starts`)."""
LARGEST_RADIUS = 4.0
ACCEPTED, POOR, GOOD = 1e-4, 0.25, 0.7
"""Ratio of actual to predicted decrease above which a trial is accepted, below which delta shrinks,
and above which it grows."""
SHRINK, GROW = 0.4, 2.0
SMALLEST_EIGENVALUE = 1e-6
"""Of the model's matrix, relative to its largest."""
TARGET_EXCESS = 1e-5
"""How far inside its limit a requirement is aimed at, in its scale, so that rounding does not
violate it."""
MIN_PENALTY, LARGEST_PENALTY, PENALTY_FACTOR = 2.0, 1e6, 10.0
"""rho, relative to the size of the objective, and the factor by which it is increased."""
CURVATURE_SOLVES = 3
COLLAPSED_RADIUS = 1e-3
"""delta below which a start is stuck: the model does not predict the objective even so near."""
RANGE_TOLERANCE = 1e-6
"""Distance in z from the end of a range within which the range blocks a gain."""
MAX_PIECES, RUNS_PER_WORST = 200, 3
"""Largest number of pieces of one requirement in a subproblem, and of runs where G_r is the mean of
k of them, as a multiple of k; the worst are taken."""
MAX_CURVATURES = 4000
"""Largest number of pieces of one requirement of which C_j is stored.  With the 200 of a subproblem
only, 64 runs of two joints took 26 evaluations instead of 14."""


# --------------------------------------------------------------------------------- the subproblem


class Step(NamedTuple):
    """The solution of a subproblem."""

    step: np.ndarray
    change: float
    """Predicted change of f."""
    violation: np.ndarray
    """Predicted violation of each requirement: v_r, (R,)."""
    piece_multipliers: np.ndarray
    """Multiplier of each piece in each run, (B, M)."""
    multipliers: np.ndarray
    """Multiplier of each requirement, (R,)."""
    lagrangian: np.ndarray
    """Gradient of the Lagrangian, (p,)."""


class Selected(NamedTuple):
    """The pieces of one requirement that are constraints of a subproblem."""

    run: np.ndarray
    piece: np.ndarray


class Unknowns(NamedTuple):
    """Where the unknowns of a subproblem stand in its vector: s, v, and for each requirement that
    is a mean of runs its t and its u.
    """

    step: slice
    violation: slice
    threshold: dict[int, int]
    """Requirement -> column of t."""
    surplus: dict[int, np.ndarray]
    """Requirement -> columns of u, one a run with selected pieces."""
    total: int

    @staticmethod
    def of(size: int, worst: tuple[int, ...], selected: list[Selected]) -> Unknowns:
        """The columns for p = `size` coordinates and these requirements."""
        threshold, surplus = {}, {}
        column = size + len(worst)
        for r, k in enumerate(worst):
            if k > 1:
                runs = len(np.unique(selected[r].run))
                threshold[r] = column
                surplus[r] = column + 1 + np.arange(runs)
                column += 1 + runs
        return Unknowns(slice(size), slice(size, size + len(worst)), threshold, surplus, column)

    @property
    def nonnegative(self) -> np.ndarray:
        """The columns of v and u."""
        violation = np.arange(self.violation.start, self.violation.stop)
        return np.concatenate([violation, *self.surplus.values()]).astype(int)


def solve_subproblem(
    gradient: np.ndarray,
    matrix: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    constraints: Constraints,
    pieces: np.ndarray,
    piece_gradients: np.ndarray,
    penalty: float,
) -> Step:
    """The step of the subproblem above.

    Args:
      gradient, matrix: g, (p,), and B, (p, p), positive definite.
      low, high: bounds of the step, (p,): trust region and ranges of the gains.
      constraints: the requirements.
      pieces: c, (B, M).
      piece_gradients: a, (B, p, M).
      penalty: rho.
    """
    size = len(gradient)
    count = len(constraints.worst)
    low = np.minimum(low, -1e-12)
    high = np.maximum(high, 1e-12)
    reach = np.maximum(-low, high)
    selected = [
        _pieces_that_may_bind(constraints, r, pieces, piece_gradients, reach) for r in range(count)
    ]
    unknowns = Unknowns.of(size, constraints.worst, selected)
    A, b = _linear_constraints(unknowns, constraints, selected, pieces, piece_gradients)
    bounds = np.eye(size, unknowns.total)
    A = np.concatenate([A, bounds, -bounds])
    b = np.concatenate([b, high, -low])
    H = np.zeros((unknowns.total, unknowns.total))
    H[unknowns.step, unknowns.step] = matrix
    c = np.zeros(unknowns.total)
    c[unknowns.step] = gradient
    c[unknowns.violation] = penalty
    x, y = quadratic.solve(H, c, A, b)

    step = np.clip(x[unknowns.step], low, high)
    # The rows of the pieces are the first ones.
    piece_multipliers = np.zeros_like(pieces)
    multipliers = np.zeros(count)
    row = 0
    for r, chosen in enumerate(selected):
        own = y[row : row + len(chosen.run)]
        piece_multipliers[chosen.run, chosen.piece] = own
        multipliers[r] = own.sum()
        row += len(chosen.run)
    return Step(
        step=step,
        change=float(gradient @ step + 0.5 * step @ matrix @ step),
        violation=np.maximum(x[unknowns.violation], 0.0),
        piece_multipliers=piece_multipliers,
        multipliers=multipliers,
        lagrangian=gradient + np.einsum("bm,bpm->p", piece_multipliers, piece_gradients),
    )


def _linear_constraints(
    unknowns: Unknowns,
    constraints: Constraints,
    selected: list[Selected],
    pieces: np.ndarray,
    piece_gradients: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """A and b of A x <= b: rows of the pieces, of the means of runs, and of the signs of v, u."""
    piece_rows = [
        _piece_rows(unknowns, r, chosen, piece_gradients) for r, chosen in enumerate(selected)
    ]
    mean_rows = [_mean_row(unknowns, r, constraints.worst[r]) for r in unknowns.threshold]
    nonnegative = unknowns.nonnegative
    A = np.concatenate([*piece_rows, *mean_rows, -np.eye(unknowns.total)[nonnegative]])
    limits = [-pieces[x.run, x.piece] - TARGET_EXCESS for x in selected]
    return A, np.concatenate([*limits, np.zeros(len(mean_rows) + len(nonnegative))])


def _piece_rows(
    unknowns: Unknowns, r: int, chosen: Selected, piece_gradients: np.ndarray
) -> np.ndarray:
    """Rows a_j.s - v_r, or a_j.s - t - u_b where the requirement is a mean of runs."""
    rows = np.zeros((len(chosen.run), unknowns.total))
    rows[:, unknowns.step] = piece_gradients[chosen.run, :, chosen.piece]
    if r not in unknowns.threshold:
        rows[:, unknowns.violation.start + r] = -1.0
        return rows
    rows[:, unknowns.threshold[r]] = -1.0
    position_of_run = np.unique(chosen.run, return_inverse=True)[1]
    rows[np.arange(len(rows)), unknowns.surplus[r][position_of_run]] = -1.0
    return rows


def _mean_row(unknowns: Unknowns, r: int, k: int) -> np.ndarray:
    """The row t + sum_b u_b / k - v_r <= 0."""
    row = np.zeros((1, unknowns.total))
    row[0, unknowns.threshold[r]] = 1.0
    row[0, unknowns.surplus[r]] = 1.0 / k
    row[0, unknowns.violation.start + r] = -1.0
    return row


def _pieces_that_may_bind(
    constraints: Constraints,
    r: int,
    pieces: np.ndarray,
    piece_gradients: np.ndarray,
    reach: np.ndarray,
) -> Selected:
    """The pieces of a requirement that may become active within steps |s_i| <= reach; of many, the
    worst.
    """
    own = constraints.pieces_of(r)
    k = constraints.worst[r]
    is_mean = k > 1
    values = pieces[:, own]
    change = np.einsum("bpm,p->bm", np.abs(piece_gradients[:, :, own]), reach)
    # What a piece reaches at most is compared with what the largest of its run reaches at least.
    threshold = np.max(values - change, axis=1, keepdims=True)
    if not is_mean:
        threshold = np.maximum(threshold, -TARGET_EXCESS)
    may_bind = values + change >= threshold
    if is_mean:
        from_worst = np.argsort(-np.max(values, axis=1), kind="stable")
        may_bind[from_worst[RUNS_PER_WORST * k :]] = False
    run, piece = np.nonzero(may_bind)
    room = MAX_PIECES
    is_further = np.zeros(len(run), bool)
    if is_mean:
        # A mean of k runs needs k runs: the worst piece of each run comes before all others.
        worst_of_run = np.argmax(np.where(may_bind, values, -np.inf), axis=1)
        is_further = piece != worst_of_run[run]
        room = max(MAX_PIECES, int(np.sum(~is_further)))
    order = np.lexsort((-values[run, piece], is_further))[:room]
    return Selected(run[order], own[piece[order]])


def positive_definite(matrix: np.ndarray) -> np.ndarray:
    """The symmetric matrix with its eigenvalues increased to a positive lower limit."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    largest = max(float(np.max(np.abs(values))), 1e-12)
    return (vectors * np.maximum(values, SMALLEST_EIGENVALUE * largest)) @ vectors.T


# ------------------------------------------------------------------------------------ the solver


class Point(NamedTuple):
    """What the evaluation at one trial gave."""

    loss: float
    gradient: np.ndarray
    matrix: np.ndarray
    """Gauss-Newton matrix N."""
    pieces: np.ndarray
    """e, (B, M)."""
    piece_gradients: np.ndarray
    """a, (B, p, M)."""

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(bool(np.all(np.isfinite(x))) for x in self)


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class SQPState:
    """The state of one start."""

    z: np.ndarray
    """The accepted point."""
    loss: Any
    gradient: np.ndarray
    matrix: np.ndarray
    """N at z."""
    correction: np.ndarray
    """A."""
    pieces: np.ndarray
    piece_gradients: np.ndarray
    piece_multipliers: np.ndarray
    """y, (B, M)."""
    curved: np.ndarray
    """The pieces of which C_j is stored, as indices into (B, M) in row order."""
    curvatures: np.ndarray
    """Their C_j, (len(curved), p, p)."""
    multipliers: np.ndarray
    penalty: Any
    """rho."""
    radius: Any
    """delta."""
    trial: np.ndarray
    """Where the next evaluation is."""
    predicted: Any
    """Decrease of the penalty function that the model predicts for the trial."""
    corrected: Any
    """Whether the trial is a second-order correction."""
    residuals: np.ndarray
    evaluated: Any
    """Whether z has been evaluated with the present loss."""
    done: Any
    stuck: Any

    @property
    def size(self) -> float:
        """Size of the loss, for relative tolerances."""
        return max(1e-3, abs(float(self.loss)))

    def curvature_along(self, step: np.ndarray) -> np.ndarray:
        """s.C_j.s/2 of every piece, (B, M)."""
        found = np.zeros_like(self.pieces)
        found.flat[self.curved] = 0.5 * np.einsum("p,kpq,q->k", step, self.curvatures, step)
        return found

    def linear_change(self, step: np.ndarray) -> np.ndarray:
        """a_j.s of every piece, (B, M)."""
        return np.einsum("p,bpm->bm", step, self.piece_gradients)


@dataclasses.dataclass(frozen=True)
class SQP:
    """Sequential quadratic programming with requirements as constraints; forward mode.

    Args:
      tolerance: relative change of the loss below which a start has converged.
      starts: number of starting points; with one, and requirements on six gains and more, the best
        of some points near the scenario's gains (`starts`).
      sharpenings: how often the smoothing of peaks in the objective is divided by 4, each time once
        the starts have converged.
      patience: steps without a better result after which the search ends.
      radius: of the first trust region, in the coordinates z; 1, or 0.5 where several minima are
        expected, if not given.
    """

    tolerance: float = 1e-5
    starts: int = 1
    sharpenings: int = 2
    patience: int = 15
    radius: float | None = None
    name: ClassVar[str] = "sqp"
    handles_requirements: ClassVar[bool] = True
    traces_evaluation: ClassVar[bool] = False
    mode: ClassVar[str] = "forward"
    resample: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_options(self)

    def init(self, space: SearchSpace, z: np.ndarray) -> list[SQPState]:
        """The state of each start.

        Raises:
          ValueError: more runs than the memory holds, as each has a gradient for every piece.
        """
        starts, size = z.shape
        constraints = space.constraints
        pieces = len(constraints.owner)
        curved = sum(_curvatures_kept(constraints))
        numbers = curved * size + constraints.runs * pieces
        checks.fits("runs", constraints.runs, 8.0 * starts * size * numbers)
        return [self._new_start(space, x, curved) for x in z]

    def _first_radius(self, space: SearchSpace) -> float:
        if self.radius is not None:
            return self.radius
        if space.multimodal:
            return RADIUS_IF_MULTIMODAL
        return RADIUS

    def _new_start(self, space: SearchSpace, z: np.ndarray, curved: int) -> SQPState:
        size = len(z)
        runs = space.constraints.runs
        pieces = len(space.constraints.owner)
        return SQPState(
            z=z.copy(),
            loss=np.inf,
            gradient=np.zeros(size),
            matrix=np.zeros((size, size)),
            correction=np.zeros((size, size)),
            pieces=np.zeros((runs, pieces)),
            piece_gradients=np.zeros((runs, size, pieces)),
            piece_multipliers=np.zeros((runs, pieces)),
            curved=np.zeros(curved, int),
            curvatures=np.zeros((curved, size, size)),
            multipliers=np.zeros(len(space.constraints.worst)),
            penalty=0.0,
            radius=self._first_radius(space),
            trial=z.copy(),
            predicted=0.0,
            corrected=False,
            residuals=np.full(3, np.nan),
            evaluated=False,
            done=False,
            stuck=False,
        )

    def restart(
        self, space: SearchSpace, state: list[SQPState], start: int, z: np.ndarray | None = None
    ) -> None:
        """As `Solver.restart`."""
        if z is not None:
            state[start] = self._new_start(space, z, len(state[start].curved))
            return
        here = state[start]
        here.evaluated = False
        here.done = False
        here.correction[:] = 0.0
        here.trial = here.z.copy()
        here.radius = max(here.radius, 0.1 * self._first_radius(space))

    def converged(self, state: list[SQPState]) -> np.ndarray:
        """As `Solver.converged`."""
        return np.array([start.done for start in state], bool)

    def optimality(self, state: list[SQPState], start: int) -> Optimality:
        """As `Solver.optimality`."""
        here = state[start]
        return Optimality(here.z, here.multipliers, here.residuals, bool(here.stuck))

    def step(
        self, evaluate: Any, state: list[SQPState], tolerance: float
    ) -> tuple[np.ndarray, Any]:
        """One trial of every active start, as `Solver.step`."""
        space: SearchSpace = evaluate.space
        trials = np.stack([start.trial for start in state])
        found = evaluate(trials)
        for s in np.flatnonzero(evaluate.active).tolist():
            _advance(space, state[s], _point(space, found, s), tolerance)
        return trials, found


def _point(space: SearchSpace, found: Any, s: int) -> Point:
    """What was found for one start, in double precision."""
    gradient = np.asarray(found.gradient[s], float)
    runs = space.constraints.runs
    pieces = np.zeros((runs, 0))
    piece_gradients = np.zeros((runs, len(gradient), 0))
    if len(space.constraints.owner):
        pieces = np.asarray(found.pieces[s], float)
        piece_gradients = np.asarray(found.piece_gradients[s], float)
    matrix = np.asarray(found.hessian[s], float)
    return Point(float(found.value.loss[s]), gradient, matrix, pieces, piece_gradients)


def _advance(space: SearchSpace, state: SQPState, found: Point, tolerance: float) -> None:
    """Accepts or rejects the trial of one start, and plans the next."""
    valid = found.is_finite
    state.done = False
    if not state.evaluated:
        state.evaluated = True
        state.done = not valid
        if valid:
            _accept(space, state, found)
            _plan(space, state, tolerance)
        return
    step = state.trial - state.z
    length = float(np.max(np.abs(step)))
    ratio = -np.inf
    if valid:
        ratio = _decrease_ratio(space, state, found)
        _update_curvatures(state, step, found)
    if ratio > ACCEPTED:
        _accept(space, state, found)
    elif valid and not state.corrected and _correct(space, state, step, found.pieces):
        return
    if ratio < POOR:
        state.radius = SHRINK * length
    elif ratio > GOOD and length > 0.9 * state.radius:
        state.radius = min(GROW * state.radius, LARGEST_RADIUS)
    _plan(space, state, tolerance)


def _merit(space: SearchSpace, state: SQPState, loss: float, pieces: np.ndarray) -> float:
    """The exact penalty function."""
    excess = space.constraints.excess(pieces) + TARGET_EXCESS
    return loss + state.penalty * float(np.sum(np.maximum(excess, 0.0)))


def _decrease_ratio(space: SearchSpace, state: SQPState, found: Point) -> float:
    """Ratio of actual to predicted decrease of the penalty function."""
    if not state.predicted > 0:
        return -np.inf
    before = _merit(space, state, state.loss, state.pieces)
    return (before - _merit(space, state, found.loss, found.pieces)) / state.predicted


def _accept(space: SearchSpace, state: SQPState, found: Point) -> None:
    """Moves to the trial; curvatures of pieces that are no longer among the worst are dropped."""
    state.z = state.trial.copy()
    state.loss = found.loss
    state.gradient = found.gradient
    state.matrix = found.matrix
    state.pieces = found.pieces
    state.piece_gradients = found.piece_gradients
    curved = _worst_pieces(space.constraints, found.pieces)
    curvatures = np.zeros_like(state.curvatures)
    _, new, old = np.intersect1d(curved, state.curved, return_indices=True)
    curvatures[new] = state.curvatures[old]
    state.curved = curved
    state.curvatures = curvatures


def _curvatures_kept(constraints: Constraints) -> list[int]:
    """The number of pieces of each requirement of which C_j is stored."""
    counts = [len(constraints.pieces_of(r)) for r in range(len(constraints.worst))]
    return [min(constraints.runs * count, MAX_CURVATURES) for count in counts]


def _worst_pieces(constraints: Constraints, pieces: np.ndarray) -> np.ndarray:
    """The worst pieces of each requirement, in increasing order, as indices into `pieces` in row
    order.
    """
    chosen = [np.zeros(0, int)]
    for r, count in enumerate(_curvatures_kept(constraints)):
        own = np.flatnonzero(np.tile(constraints.owner == r, constraints.runs))
        from_worst = np.argsort(-pieces.ravel()[own], kind="stable")
        chosen.append(np.sort(own[from_worst[:count]]))
    return np.concatenate(chosen)


def _solve(space: SearchSpace, state: SQPState, pieces: np.ndarray, penalty: float) -> Step:
    """The subproblem at the accepted point, with `pieces` as c."""
    multipliers = state.piece_multipliers.ravel()[state.curved]
    of_pieces = np.einsum("k,kpq->pq", multipliers, state.curvatures)
    matrix = positive_definite(state.matrix + state.correction + of_pieces)
    low = np.maximum(space.box.low - state.z, -state.radius)
    high = np.minimum(space.box.high - state.z, state.radius)
    return solve_subproblem(
        state.gradient,
        matrix,
        low,
        high,
        space.constraints,
        pieces,
        state.piece_gradients,
        penalty,
    )


def _predicted_decrease(space: SearchSpace, state: SQPState, step: np.ndarray) -> float:
    """Decrease of the penalty function by the quadratic models of objective and pieces."""
    pieces = state.pieces + state.linear_change(step) + state.curvature_along(step)
    matrix = state.matrix + state.correction
    change = float(state.gradient @ step + 0.5 * step @ matrix @ step)
    return _merit(space, state, 0.0, state.pieces) - _merit(space, state, change, pieces)


def _with_penalty(space: SearchSpace, state: SQPState) -> tuple[Step, float]:
    """The step and rho, which is increased as long as that reduces the predicted violation."""
    size = state.size
    largest = LARGEST_PENALTY * size
    twice = 2.0 * float(np.max(state.multipliers, initial=0.0))
    penalty = min(max(twice, MIN_PENALTY * size), largest)
    found = _solve(space, state, state.pieces, penalty)
    while found.violation.sum() > TARGET_EXCESS and penalty < largest:
        other = _solve(space, state, state.pieces, PENALTY_FACTOR * penalty)
        if found.violation.sum() - other.violation.sum() < 0.01 * found.violation.sum():
            break
        found = other
        penalty = PENALTY_FACTOR * penalty
    return found, penalty


def _plan(space: SearchSpace, state: SQPState, tolerance: float) -> None:
    """Plans the next trial of one start, or ends it."""
    found, penalty = _with_penalty(space, state)
    state.penalty = penalty
    if found.violation.sum() <= TARGET_EXCESS:
        state.penalty = max(penalty, 2.0 * float(np.max(found.multipliers, initial=0.0)))
    state.piece_multipliers = found.piece_multipliers
    state.multipliers = found.multipliers

    excess = space.constraints.excess(state.pieces)
    violation = float(np.sum(np.maximum(excess + TARGET_EXCESS, 0.0)))
    reduction = violation - float(np.sum(found.violation))
    linear_decrease = -found.change + state.penalty * reduction
    step, decrease = _best_with_curvature(space, state, found, penalty)
    state.trial = np.clip(state.z + step, space.box.low, space.box.high)
    state.predicted = linear_decrease
    if decrease > 0.1 * linear_decrease:
        state.predicted = decrease
    state.corrected = False

    state.residuals = _residuals(space, state, found, excess)
    length = np.max(np.abs(found.step))
    is_feasible = violation <= TARGET_EXCESS or reduction < 1e-3 * violation
    is_flat = is_feasible and linear_decrease < tolerance * state.size
    state.done = bool(length < 1e-7 or is_flat)
    limited_by_radius = length > 0.9 * state.radius
    state.stuck = bool(state.done and limited_by_radius and state.radius < COLLAPSED_RADIUS)


def _best_with_curvature(
    space: SearchSpace, state: SQPState, found: Step, penalty: float
) -> tuple[np.ndarray, float]:
    """Of the steps of all rounds, the one with the largest predicted decrease, and the decrease."""
    best = found.step
    decrease = _predicted_decrease(space, state, best)
    if not state.pieces.size:
        return best, decrease
    last = found
    for _ in range(CURVATURE_SOLVES):
        last = _solve(space, state, state.pieces + state.curvature_along(last.step), penalty)
        other = _predicted_decrease(space, state, last.step)
        if other > decrease:
            best = last.step
            decrease = other
    return best, decrease


def _residuals(space: SearchSpace, state: SQPState, found: Step, excess: np.ndarray) -> np.ndarray:
    """Residuals of the optimality conditions, as in `Optimality`."""
    slope = found.lagrangian
    blocked_below = (state.z < space.box.low + RANGE_TOLERANCE) & (slope > 0)
    blocked_above = (state.z > space.box.high - RANGE_TOLERANCE) & (slope < 0)
    stationarity = np.max(np.abs(np.where(blocked_below | blocked_above, 0.0, slope)))
    products = np.sum(found.piece_multipliers * state.pieces, axis=0)
    complementarity = sum(
        abs(float(np.sum(products[space.constraints.pieces_of(r)]))) for r in range(len(excess))
    )
    worst = float(np.max(excess, initial=-np.inf))
    return np.array([stationarity, max(worst, 0.0), complementarity])


def _correct(space: SearchSpace, state: SQPState, step: np.ndarray, pieces: np.ndarray) -> bool:
    """Plans the second-order correction of a rejected step; whether it differs from the step."""
    if not len(space.constraints.owner):
        return False
    found = _solve(space, state, pieces - state.linear_change(step), state.penalty)
    state.trial = np.clip(state.z + found.step, space.box.low, space.box.high)
    state.corrected = True
    difference = np.max(np.abs(state.trial - state.z - step))
    return bool(difference > 1e-3 * np.max(np.abs(step)))


def _update_curvatures(state: SQPState, step: np.ndarray, found: Point) -> None:
    """The symmetric rank-one updates of A and of every stored C_j."""
    change = found.gradient - state.gradient - state.matrix @ step
    _rank_one_update(state.correction, change, step)
    changes = np.swapaxes(found.piece_gradients - state.piece_gradients, 1, 2)
    _rank_one_update(state.curvatures, changes.reshape(-1, len(step))[state.curved], step)


def _rank_one_update(matrix: np.ndarray, change: np.ndarray, step: np.ndarray) -> None:
    """Makes matrix @ step the change of a gradient, (..., p), where that is well determined; in
    place.
    """
    error = change - matrix @ step
    along = error @ step
    scale = np.linalg.norm(error, axis=-1) * np.linalg.norm(step)
    fine = np.abs(along) > 1e-8 * scale
    inverse = np.where(fine, 1 / np.where(fine, np.abs(along), 1.0), 0.0)
    error *= np.sqrt(inverse)[..., None]
    matrix += np.sign(along)[..., None, None] * error[..., :, None] * error[..., None, :]

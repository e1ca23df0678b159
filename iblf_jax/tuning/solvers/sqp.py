"""Sequential quadratic programming with Gauss-Newton matrices in a trust region: the default solver
for few gains.

Model.  At the accepted point z the objective is modelled by f + g.s + s.B.s/2.  A requirement
consists of pieces, the largest values of its signal in windows of time.  Every piece j is modelled
by e_j + a_j.s + s.C_j.s/2, with its value e_j = g_rj (`evaluation`) and its exact gradient a_j.  At
an optimum several peaks are at their limit at once, and each of them is a constraint of its own.

Subproblem.  The step s solves, within |s_i| <= delta and the ranges of the gains,

    minimise  g.s + s.(B + sum_j y_j C_j).s/2 + rho sum_r v_r
    subject to     c_j + a_j.s <= v_r,  v_r >= 0      for the pieces j of r,

where y are the multipliers of the previous subproblem.  It is solved first with c_j = e_j, and
then, once curvatures are known, CURVATURE_SOLVES times with c_j = e_j + s.C_j.s/2 at the last
solution.  The trial is z + s with the solution of which the quadratic models predict the largest
decrease.  The subproblems of all starts are solved side by side (`together`).

Requirements on a share of the runs.  If k > 1 of the B runs may violate a requirement, its G_r is
the mean of its k worst runs, which equals

    min over t of  t + sum_b max(0, max_j g_bj - t) / k.

In the subproblem t and one u_b >= 0 for each run are unknowns beside s.

Penalty.  A trial is accepted or rejected by f + rho sum_r max(0, G_r).  rho is larger than the
multipliers, so that this penalty function is exact.  rho is increased as long as that reduces the
predicted violation.  Requirements that cannot be satisfied together are thus violated as little as
possible.  Where only the largest excess counts (`Constraints.largest_only`), sum_r is replaced by
max_r.

Curvature.  B = N + A, where N is the Gauss-Newton matrix at z, which forward mode provides at no
extra cost.  A approximates the omitted second derivatives of the motion, and C_j is the second
derivative of a piece.  Both are estimated from changes of gradients by the symmetric rank-one
update,

    A <- A + r r^T / (r.s),      r = (change of g) - B s;
    C_j likewise,                r = (change of a_j) - C_j s.

Rejected steps update them too, unless the loss of the trial is far above that at z: such a trial is
unstable, and its gradients contain no information on the curvature at z.  A and C_j are set to zero
after MOST_REJECTIONS rejected steps in a row.  With many runs, C_j is stored for the worst pieces
of each requirement only.

Rejected trials.  delta grows and shrinks with the ratio of actual to predicted decrease.  After a
rejected step the subproblem is solved once more, with c_j such that c_j + a_j.s is the value at the
rejected trial (second-order correction).  The gradient of a piece jumps where another peak becomes
the largest.  The pieces of the last CUTS rejected trials, linearised there, are therefore further
constraints of the subproblem, as in a bundle method.  A trial with an invalid run is rejected, and
delta shrinks, so that z is always finite.

Convergence.  A start has converged if the model predicts no decrease and the gradient of the
Lagrangian is below STATIONARITY_TOLERANCE.  It also ends if delta falls below COLLAPSED_RADIUS, or
if its first evaluation is not finite.

Source: R. Fletcher, Practical Methods of Optimization, 2nd ed., section 14.4 (the subproblem and
its correction);
R. H. Byrd, J. Nocedal, R. A. Waltz, Optim. Methods Softw. 23 (2008) 645-665 (rho);
R. T. Rockafellar, S. Uryasev, J. Risk 2 (2000) 21-41 (the mean of the worst runs);
J. E. Dennis, D. M. Gay, R. E. Welsch, ACM Trans. Math. Softw. 7 (1981) 348-368 (A);
A. R. Conn, N. I. M. Gould, P. L. Toint, Math. Program. 50 (1991) 177-195 (rank-one updates in trust
regions).
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Generator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import jax
import numpy as np

from iblf_jax.core import checks
from iblf_jax.tuning.parameters import Box
from iblf_jax.tuning.solvers import quadratic
from iblf_jax.tuning.solvers._base import Constraints, SearchSpace, Solver, check_options

if TYPE_CHECKING:
    from iblf_jax.tuning.solvers._base import Derivatives, Evaluation

INITIAL_RADIUS = 1.0
"""First delta in the coordinates z; 1 is a factor e for a gain."""
INITIAL_RADIUS_IF_MULTIMODAL = 0.5
"""First delta where several minima are expected.  With 0.5 instead of 1, the mean gap to the best
known optimum of ten problems fell from 6.1 % to 3.1 %."""
LARGEST_RADIUS = 4.0
RATIO_TO_ACCEPT = 1e-4
"""Ratio of actual to predicted decrease above which a trial is accepted."""
RATIO_TO_SHRINK = 0.25
"""Ratio below which delta shrinks."""
RATIO_TO_GROW = 0.7
"""Ratio above which delta grows."""
SHRINK_FACTOR = 0.4
GROWTH_FACTOR = 2.0
SMALLEST_EIGENVALUE = 1e-6
"""Smallest eigenvalue of the model's matrix, relative to the largest one of the model or of the
Gauss-Newton matrix, whichever is smaller: that of the model is much too large where A or C_j is
wrong."""
LARGEST_LOSS_FACTOR = 10.0
"""Largest rise of the loss, relative to that at the accepted point, with which a trial updates A
and C_j."""
MOST_REJECTIONS = 4
"""Number of rejected steps in a row after which A and C_j are set to zero."""
CUTS = 3
"""Number of rejected trials whose pieces are kept as constraints."""
CUT_REACH = 3.0
"""Largest distance of such a trial from the accepted point, relative to delta."""
BETA = 1.0
"""Curvature, relative to the objective, with which `conditions_at` determines multipliers."""
MULTIPLIER_LIMIT = 1e3
"""Largest multiplier of `conditions_at`, relative to the objective.  With 1e6 the precision of the
quadratic programme would not be sufficient."""
AT_LIMIT = 1e-4
"""Largest distance of a piece from its limit, in its scale, at which `conditions_at` assumes it to
be at its limit."""
STATIONARITY_TOLERANCE = 1e-3
"""Largest entry of the Lagrangian's gradient at convergence, relative to the larger of the
objective and its gradient."""
TARGET_EXCESS = 1e-5
"""Distance from its limit, in its scale, at which the solver keeps a requirement, so that rounding
does not violate it."""
MIN_PENALTY = 2.0
"""Smallest rho, relative to the size of the objective."""
LARGEST_PENALTY = 1e6
"""Largest rho, relative to the size of the objective."""
PENALTY_FACTOR = 10.0
"""Factor by which rho is increased."""
CURVATURE_SOLVES = 3
"""Number of subproblems for one trial that contain the curvature of the pieces."""
COLLAPSED_RADIUS = 1e-3
"""A start ends if delta is smaller, as the model does not predict the objective even so near."""
RANGE_TOLERANCE = 1e-6
"""Largest distance in z from the end of a range at which the range blocks a gain."""
MAX_PIECES = 200
"""Largest number of pieces of one requirement in a subproblem, which contains the worst ones."""
RUNS_PER_WORST = 3
"""Where G_r is the mean of the k worst runs, a subproblem contains the worst RUNS_PER_WORST * k
runs, as other runs may become the k worst ones."""
LARGEST_NUMBER = 1e100
"""Largest number at a point that counts as finite, so that products of three of them are finite.
Gradients of a sliding mode that chatters exceed 1e150 and do not tell which step to take."""
MAX_CURVATURES = 4000
"""Largest number of pieces of one requirement of which C_j is stored.  With the MAX_PIECES of a
subproblem only, a tuning of two joints with 64 runs took 26 evaluations instead of 14."""


# --------------------------------------------------------------------------------- the subproblem


class Subproblem(NamedTuple):
    """The numbers of one subproblem."""

    gradient: np.ndarray
    """g, (p,)."""
    matrix: np.ndarray
    """B + sum_j y_j C_j, (p, p), positive definite."""
    low: np.ndarray
    """Bounds of the step, (p,): trust region and ranges of the gains."""
    high: np.ndarray
    pieces: np.ndarray
    """c, (B, k M): k times the pieces of the requirements, at several points."""
    piece_gradients: np.ndarray
    """a, (B, p, k M)."""
    penalty: float
    """rho."""


class Step(NamedTuple):
    """The solution of a subproblem."""

    step: np.ndarray
    """s, (p,)."""
    change: float
    """Predicted change of f."""
    violation: np.ndarray
    """Predicted violation of each requirement: v_r, (R,)."""
    piece_multipliers: np.ndarray
    """Multiplier of each piece in each run, (B, M).  A piece at several points is one constraint,
    which has one multiplier."""
    multipliers: np.ndarray
    """Multiplier of each requirement, (R,)."""
    lagrangian: np.ndarray
    """Gradient of the Lagrangian, (p,)."""


class Rows(NamedTuple):
    """The pieces of one requirement that are constraints of some subproblems, m in all."""

    start: np.ndarray
    """Index of the subproblem of each piece, (m,), in increasing order."""
    run: np.ndarray
    """Index of its run, (m,)."""
    piece: np.ndarray
    """Index among all pieces of a run, (m,)."""
    place: np.ndarray
    """0, 1, ... among the pieces of its subproblem, (m,)."""
    number: np.ndarray
    """Number of pieces of each subproblem, (S,)."""


T = TypeVar("T")
Task = Generator[Subproblem, Step, T]
"""An algorithm that yields subproblems, receives their solutions, and returns a T."""


def together(constraints: Constraints, tasks: Sequence[Task[None]]) -> None:
    """Runs some algorithms, whose subproblems are formed and solved side by side."""
    solutions: dict[int, Step | None] = dict.fromkeys(range(len(tasks)))
    while solutions:
        requested = {}
        for i, solution in solutions.items():
            # An algorithm that has ended yields nothing.
            with contextlib.suppress(StopIteration):
                requested[i] = tasks[i].send(solution)  # type: ignore[arg-type]
        solved = subproblems(constraints, list(requested.values()))
        solutions = dict(zip(requested, solved, strict=True))


def subproblems(constraints: Constraints, requested: Sequence[Subproblem]) -> list[Step]:
    """Solves subproblems of this module as quadratic programmes, all of them together.

    The columns of a programme are the step and the unknowns of each requirement.  Its rows are both
    bounds of the step, the pieces of each requirement and the conditions of `_own_columns`.
    """
    if not requested:
        return []
    count = len(requested)
    gradient, matrix, low, high = (np.stack([q[i] for q in requested]) for i in range(4))
    penalty = np.array([q.penalty for q in requested])
    # The interior-point method needs an interior, also where z is at the end of a range.
    low = np.minimum(low, -1e-12)
    high = np.maximum(high, 1e-12)
    pieces, piece_gradients = _stacked_pieces(requested)
    reach = np.maximum(-low, high)
    change = (reach[:, None, None] @ np.abs(piece_gradients))[:, :, 0]
    size = gradient.shape[1]
    copies = max(1, pieces.shape[2] // max(1, len(constraints.owner)))
    own = [_copies_of(constraints, r, copies) for r in range(len(constraints.worst))]
    selected = [
        _pieces_that_may_bind(columns, k, pieces, change)
        for columns, k in zip(own, constraints.worst, strict=True)
    ]
    columns = size + np.arange(len(selected))  # of v_r; one where only the largest excess counts
    if constraints.largest_only:
        columns[:] = size
    A, b, first_rows = _rows_of_programmes(
        low, high, constraints, columns, selected, pieces, piece_gradients
    )
    H = np.zeros((count, A.shape[2], A.shape[2]))
    H[:, :size, :size] = matrix
    c = np.zeros((count, A.shape[2]))
    c[:, :size] = gradient
    c[:, columns] = penalty[:, None]
    x, y = quadratic.solve(quadratic.Programmes(H, c, A, b))
    step = np.clip(x[:, :size], low, high)
    violation = np.maximum(x[:, columns], 0.0)
    each = np.zeros_like(pieces)
    multipliers = np.zeros(violation.shape)
    for r, rows in enumerate(selected):
        found = y[rows.start, first_rows[r, rows.start] + rows.place]
        each[rows.start, rows.run, rows.piece] = found
        multipliers[:, r] = np.bincount(rows.start, found, count)
    lagrangian = gradient + (piece_gradients @ each[..., None])[..., 0].sum(axis=1)
    each = each.reshape(*each.shape[:2], copies, -1).sum(axis=2)
    slope = gradient + 0.5 * (matrix @ step[..., None])[..., 0]
    change_of_loss = np.sum(slope * step, axis=1).tolist()
    steps = zip(step, change_of_loss, violation, each, multipliers, lagrangian, strict=True)
    return [Step(*numbers) for numbers in steps]


def _stacked_pieces(requested: Sequence[Subproblem]) -> tuple[np.ndarray, np.ndarray]:
    """The pieces of all subproblems, (S, B, k M), and their gradients, (S, B, p, k M).

    Subproblems with the pieces of fewer points are filled up with pieces far below their limits.
    """
    most = max(q.pieces.shape[1] for q in requested)
    runs, size, _ = requested[0].piece_gradients.shape
    pieces = np.full((len(requested), runs, most), -np.inf)
    gradients = np.zeros((len(requested), runs, size, most))
    for i, q in enumerate(requested):
        count = q.pieces.shape[1]
        pieces[i, :, :count] = q.pieces
        gradients[i, :, :, :count] = q.piece_gradients
    return pieces, gradients


def _copies_of(constraints: Constraints, requirement: int, copies: int) -> np.ndarray:
    """Indices of the pieces of a requirement, where all pieces are there at several points."""
    own = constraints.pieces_of(requirement)
    return (own + len(constraints.owner) * np.arange(copies)[:, None]).ravel()


def _rows_of_programmes(
    low: np.ndarray,
    high: np.ndarray,
    constraints: Constraints,
    columns: np.ndarray,
    selected: list[Rows],
    pieces: np.ndarray,
    piece_gradients: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A and b of the programmes of S subproblems, and the first row of each requirement, (R, S).

    The columns are the step, v_r in the columns that are given, (R,), and the further unknowns of
    each requirement.
    """
    count, size = low.shape
    own = [
        [_own_columns(run, k) for run in np.split(rows.run, np.cumsum(rows.number)[:-1])]
        for rows, k in zip(selected, constraints.worst, strict=True)
    ]
    shapes = np.array([x.shape for of_all in own for x in of_all], int)
    heights, widths = shapes.reshape(len(own), count, 2).transpose(2, 0, 1)
    # The first row of each requirement, and the first column of its further unknowns.
    row = 2 * size + np.cumsum(heights, axis=0) - heights
    number_of_v = len(np.unique(columns))
    further = size + number_of_v + np.cumsum(widths - 1, axis=0) - (widths - 1)
    most_rows = 2 * size + int(np.max(heights.sum(axis=0)))
    A = np.zeros((count, most_rows, size + number_of_v + int(np.max((widths - 1).sum(axis=0)))))
    b = np.ones((count, most_rows))
    A[:, :size, :size] = np.eye(size)
    A[:, size : 2 * size, :size] = -np.eye(size)
    b[:, :size] = high
    b[:, size : 2 * size] = -low
    for r, rows in enumerate(selected):
        for s, block in enumerate(own[r]):
            height, width = block.shape
            place = slice(row[r, s], row[r, s] + height)
            A[s, place, columns[r]] = block[:, 0]
            A[s, place, further[r, s] : further[r, s] + width - 1] = block[:, 1:]
            b[s, place] = 0.0
        place = row[r, rows.start] + rows.place
        A[rows.start, place, :size] = piece_gradients[rows.start, rows.run, :, rows.piece]
        b[rows.start, place] = -pieces[rows.start, rows.run, rows.piece] - TARGET_EXCESS
    return A, b, row


def _own_columns(run: np.ndarray, k: int) -> np.ndarray:
    """The rows of one requirement in the columns of its own unknowns: v, and, where it is a mean of
    k > 1 runs, t and one u_b for each run.

        a_j.s - v <= -c_j                                           -v <= 0
        a_j.s - t - u_b <= -c_j,      t + sum_b u_b / k - v <= 0,   -v <= 0,   -u_b <= 0

    Args:
      run: the run of each selected piece, (m,).
      k: number of worst runs.
    """
    if k == 1:
        return -np.ones((len(run) + 1, 1))
    different, position = np.unique(run, return_inverse=True)
    unknowns = 2 + len(different)
    of_pieces = np.zeros((len(run), unknowns))
    of_pieces[:, 1] = -1.0
    of_pieces[np.arange(len(run)), 2 + position] = -1.0
    mean = np.concatenate([[-1.0, 1.0], np.full(len(different), 1.0 / k)])
    nonnegative = -np.delete(np.eye(unknowns), 1, axis=0)
    return np.vstack([of_pieces, mean, nonnegative])


def _pieces_that_may_bind(
    columns: np.ndarray, k: int, pieces: np.ndarray, change: np.ndarray
) -> Rows:
    """The pieces of a requirement that may become active within the bounds of the step, in each of
    S subproblems.  Of more than MAX_PIECES the worst ones are taken.

    Args:
      columns: the pieces of the requirement, (m,).
      k: number of worst runs of the requirement.
      pieces: c, (S, B, M).
      change: the largest change of each linear piece within the bounds, (S, B, M).
    """
    values = pieces[:, :, columns]
    change = change[:, :, columns]
    # A piece may become the largest of its run if the largest value that it can reach is at least
    # the smallest value that the largest piece can reach.
    threshold = np.max(values - change, axis=2, keepdims=True)
    if k == 1:
        # The mean of several runs needs their pieces also where these are far below the limit.
        threshold = np.maximum(threshold, -TARGET_EXCESS)
    may_bind = values + change >= threshold
    is_further = np.zeros(values.shape, bool)
    most = np.full(len(values), MAX_PIECES)
    if k > 1:
        from_worst = np.argsort(-np.max(values, axis=2), axis=1, kind="stable")
        np.put_along_axis(may_bind, from_worst[:, RUNS_PER_WORST * k :, None], False, axis=1)
        # The mean of k runs needs pieces of k runs, so that the worst piece of each run is always
        # selected.
        worst = np.argmax(np.where(may_bind, values, -np.inf), axis=2)[..., None]
        is_further[:] = True
        np.put_along_axis(is_further, worst, False, axis=2)
        most = np.maximum(most, np.sum(may_bind & ~is_further, axis=(1, 2)))
    start, run, piece = np.nonzero(may_bind)
    found = start, run, piece
    order = np.lexsort((-values[found], is_further[found], start))
    count = np.bincount(start, minlength=len(values))
    place = np.arange(len(start)) - np.repeat(np.cumsum(count) - count, count)
    is_taken = place < most[start]
    order = order[is_taken]
    count = np.minimum(count, most)
    return Rows(start[order], run[order], columns[piece[order]], place[is_taken], count)


def positive_definite(matrix: np.ndarray, scale: float) -> np.ndarray:
    """The symmetric matrix with its eigenvalues increased to SMALLEST_EIGENVALUE times the smaller
    of `scale` and its largest eigenvalue.
    """
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    largest = max(min(scale, float(np.max(np.abs(values)))), 1e-12)
    return (vectors * np.maximum(values, SMALLEST_EIGENVALUE * largest)) @ vectors.T


# ------------------------------------------------------------------------------------ the solver


class Point(NamedTuple):
    """The loss and the pieces at one point, with their derivatives."""

    loss: float
    """f."""
    gradient: np.ndarray
    """g, (p,)."""
    matrix: np.ndarray
    """Gauss-Newton matrix N."""
    pieces: np.ndarray
    """e, (B, M)."""
    piece_gradients: np.ndarray
    """a, (B, p, M)."""

    @staticmethod
    def of(space: SearchSpace, found: Derivatives, start: int) -> Point:
        """The numbers of one start from `Derivatives` of all, in double precision."""
        gradient = np.asarray(found.gradient[start], float)
        runs = space.constraints.runs
        pieces = np.zeros((runs, 0))
        piece_gradients = np.zeros((runs, len(gradient), 0))
        if len(space.constraints.owner):
            pieces = np.asarray(found.pieces[start], float)
            piece_gradients = np.asarray(found.piece_gradients[start], float)
        matrix = np.asarray(found.hessian[start], float)
        return Point(float(found.value.loss[start]), gradient, matrix, pieces, piece_gradients)

    @property
    def is_finite(self) -> bool:
        """Whether no number is infinite or larger than LARGEST_NUMBER."""
        return all(bool((np.abs(x) <= LARGEST_NUMBER).all()) for x in self)

    def linear_change(self, step: np.ndarray) -> np.ndarray:
        """a_j.s of every piece, (B, M)."""
        return step @ self.piece_gradients


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class SQPState:
    """The state of one start."""

    z: np.ndarray
    """The accepted point, (p,)."""
    here: Point
    """Loss, pieces and derivatives at z."""
    correction: np.ndarray
    """A."""
    piece_multipliers: np.ndarray
    """y, (B, M)."""
    curved: np.ndarray
    """The pieces of which C_j is stored, as indices into (B, M) in row order."""
    curvatures: np.ndarray
    """Their C_j, (len(curved), p, p)."""
    multipliers: np.ndarray
    """Multiplier of each requirement, (R,)."""
    penalty: Any
    """rho."""
    radius: Any
    """delta."""
    trial: np.ndarray
    """The point of the next evaluation, (p,)."""
    predicted: Any
    """Decrease of the penalty function that the model predicts for the trial."""
    corrected: np.ndarray | bool
    """Whether the trial is a second-order correction."""
    residuals: np.ndarray
    """As `optimality.Conditions.residuals`, at z, (3,)."""
    evaluated: np.ndarray | bool
    """Whether z has been evaluated with the present loss."""
    done: np.ndarray | bool
    """Whether the start has converged or cannot continue."""
    rejections: np.ndarray | int
    """Rejected steps since the last accepted one."""
    cut_z: np.ndarray
    """Rejected trials of which the pieces are also constraints, (CUTS, p); NaN where there is
    none."""
    cut_pieces: np.ndarray
    """Their e, (CUTS, B, M)."""
    cut_gradients: np.ndarray
    """Their a, (CUTS, B, p, M)."""

    @property
    def size(self) -> float:
        """Size of the loss, for relative tolerances."""
        return max(1e-3, abs(float(self.here.loss)))

    def curvature_along(self, step: np.ndarray) -> np.ndarray:
        """s.C_j.s/2 of every piece, (B, M)."""
        found = np.zeros_like(self.here.pieces)
        size = len(step)
        products = (self.curvatures.reshape(-1, size) @ step).reshape(-1, size)
        found.flat[self.curved] = 0.5 * (products @ step)
        return found


@dataclasses.dataclass(frozen=True)
class SQP(Solver):
    """Sequential quadratic programming with requirements as constraints; forward mode.

    Args:
      tolerance: relative change of the loss below which a start has converged.
      starts: number of starting points; by the effort of the tuning if not given.
      sharpenings: number of times that the smoothing of peaks in the objective is divided by 4,
        each time after the starts have converged.
      patience: number of steps without a better result after which a phase of the search ends.
      radius: radius of the first trust region in the coordinates z.  If not given, it is 1, or 0.5
        where several minima are expected.
    """

    tolerance: float = 1e-5
    starts: int | None = None
    sharpenings: int = 2
    patience: int = 15
    radius: float | None = None
    name: ClassVar[str] = "sqp"
    handles_requirements: ClassVar[bool] = True
    mode = "forward"
    resample = False

    def __post_init__(self) -> None:
        check_options(self)

    def init(self, space: SearchSpace, z: np.ndarray) -> list[SQPState]:
        """The state of each start.

        Raises:
          ValueError: more runs than the memory holds, as each run has a gradient for every piece.
        """
        starts, size = z.shape
        constraints = space.constraints
        pieces = len(constraints.owner)
        curved = sum(_curvatures_kept(constraints))
        numbers = curved * size + constraints.runs * pieces
        checks.fits_memory("runs", constraints.runs, 8.0 * starts * size * numbers)
        return [self._new_start(space, x, curved) for x in z]

    def _first_radius(self, space: SearchSpace) -> float:
        """The option `radius`, or its default for this problem."""
        if self.radius is not None:
            return self.radius
        if space.multimodal:
            return INITIAL_RADIUS_IF_MULTIMODAL
        return INITIAL_RADIUS

    def _new_start(self, space: SearchSpace, z: np.ndarray, curved: int) -> SQPState:
        """The state of a start at z, (p,), before its first evaluation; `curved` matrices C_j are
        stored.
        """
        size = len(z)
        runs = space.constraints.runs
        pieces = len(space.constraints.owner)
        return SQPState(
            z=z.copy(),
            here=Point(
                loss=np.inf,
                gradient=np.zeros(size),
                matrix=np.zeros((size, size)),
                pieces=np.zeros((runs, pieces)),
                piece_gradients=np.zeros((runs, size, pieces)),
            ),
            correction=np.zeros((size, size)),
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
            rejections=0,
            cut_z=np.full((CUTS, size), np.nan),
            cut_pieces=np.zeros((CUTS, runs, pieces)),
            cut_gradients=np.zeros((CUTS, runs, size, pieces)),
        )

    def restart(
        self, space: SearchSpace, state: list[SQPState], start: int, z: np.ndarray | None = None
    ) -> None:
        """As `Solver.restart`."""
        if z is not None:
            state[start] = self._new_start(space, z, len(state[start].curved))
            return
        own = state[start]
        own.evaluated = False
        own.done = False
        own.correction[:] = 0.0
        own.trial = own.z.copy()
        own.radius = max(own.radius, 0.1 * self._first_radius(space))

    def converged(self, state: list[SQPState]) -> np.ndarray:
        """As `Solver.converged`."""
        return np.array([start.done for start in state], bool)

    def nearby_pieces(self, state: list[SQPState], z: np.ndarray, reach: float) -> list[Point]:
        """The pieces of all rejected trials within `reach` of a point, linearised at each trial and
        evaluated at the point.
        """
        found = []
        for own in state:
            for c in np.flatnonzero(np.max(np.abs(own.cut_z - z), axis=1) <= reach):
                gradients = own.cut_gradients[c]
                values = own.cut_pieces[c] + (z - own.cut_z[c]) @ gradients
                found.append(own.here._replace(pieces=values, piece_gradients=gradients))
        return found

    def step(
        self, evaluate: Evaluation, state: list[SQPState], tolerance: float
    ) -> tuple[np.ndarray, Any]:
        """One trial of every active start, as `Solver.step`."""
        space: SearchSpace = evaluate.space
        trials = np.stack([start.trial for start in state])
        found = evaluate(trials)
        together(
            space.constraints,
            [
                _advance(space, state[s], Point.of(space, found, s), tolerance)
                for s in np.flatnonzero(evaluate.active).tolist()
            ],
        )
        return trials, found


def _advance(space: SearchSpace, state: SQPState, found: Point, tolerance: float) -> Task[None]:
    """Accepts or rejects the trial of one start, and determines the next one.

    The first evaluation of a start, or the first one after the loss has changed, is accepted
    without a comparison.
    """
    valid = found.is_finite
    state.done = False
    if not state.evaluated:
        state.evaluated = True
        state.done = not valid
        if valid:
            _accept(space, state, found)
            yield from _plan(space, state, tolerance)
        return
    step = state.trial - state.z
    length = float(np.max(np.abs(step)))
    ratio = -np.inf
    if valid and state.predicted > 0:
        before = _merit(space, state, state.here.loss, state.here.pieces)
        decrease = before - _merit(space, state, found.loss, found.pieces)
        ratio = decrease / state.predicted
    if valid and _is_comparable(state, found):
        # the symmetric rank-one updates of A and of every stored C_j
        change = found.gradient - state.here.gradient - state.here.matrix @ step
        _rank_one_update(state.correction, change, step)
        changes = np.swapaxes(found.piece_gradients - state.here.piece_gradients, 1, 2)
        _rank_one_update(state.curvatures, changes.reshape(-1, len(step))[state.curved], step)
    is_accepted = ratio > RATIO_TO_ACCEPT
    state.rejections = 0 if is_accepted else state.rejections + 1
    if state.rejections >= MOST_REJECTIONS:
        # The model has failed repeatedly.
        state.correction[:] = 0.0
        state.curvatures[:] = 0.0
        state.rejections = 0
    if is_accepted:
        _accept(space, state, found)
    elif valid:
        # Its pieces replace the oldest ones of rejected trials.
        new = (state.trial, found.pieces, found.piece_gradients)
        kept = (state.cut_z, state.cut_pieces, state.cut_gradients)
        for stored, x in zip(kept, new, strict=True):
            stored[1:] = stored[:-1].copy()
            stored[0] = x
        if not state.corrected and (yield from _correct(space, state, step, found.pieces)):
            return
    if ratio < RATIO_TO_SHRINK:
        state.radius = SHRINK_FACTOR * length
    elif ratio > RATIO_TO_GROW and length > 0.9 * state.radius:
        state.radius = min(GROWTH_FACTOR * state.radius, LARGEST_RADIUS)
    yield from _plan(space, state, tolerance)


def _is_comparable(state: SQPState, found: Point) -> bool:
    """Whether loss and pieces of a trial are of the same order of magnitude as at the accepted
    point, so that changes of gradients are estimates of the curvature.
    """
    worst = float(np.max(found.pieces, initial=0.0))
    largest = LARGEST_LOSS_FACTOR * (1.0 + float(np.max(state.here.pieces, initial=0.0)))
    rise = found.loss - state.here.loss
    return rise <= LARGEST_LOSS_FACTOR * state.size and worst <= largest


def _merit(space: SearchSpace, state: SQPState, loss: float, pieces: np.ndarray) -> float:
    """The exact penalty function, with each requirement TARGET_EXCESS inside of its limit."""
    excess = space.constraints.excess(pieces) + TARGET_EXCESS
    return loss + state.penalty * space.constraints.violation(excess)


def _accept(space: SearchSpace, state: SQPState, found: Point) -> None:
    """Makes the trial the accepted point.

    The C_j of pieces that are no longer among the worst ones are dropped, and those of new ones are
    zero.
    """
    state.z = state.trial.copy()
    state.here = found
    # The worst pieces of each requirement have a C_j; in row order, and in increasing order.
    constraints = space.constraints
    chosen = [np.zeros(0, int)]
    for r, count in enumerate(_curvatures_kept(constraints)):
        own = np.flatnonzero(np.tile(constraints.owner == r, constraints.runs))
        if count < len(own):
            from_worst = np.argsort(-found.pieces.ravel()[own], kind="stable")
            own = np.sort(own[from_worst[:count]])
        chosen.append(own)
    curved = np.concatenate(chosen)
    if np.array_equal(curved, state.curved):
        return
    curvatures = np.zeros_like(state.curvatures)
    _, new, old = np.intersect1d(curved, state.curved, return_indices=True)
    curvatures[new] = state.curvatures[old]
    state.curved = curved
    state.curvatures = curvatures


def _curvatures_kept(constraints: Constraints) -> list[int]:
    """The number of pieces of each requirement of which C_j is stored."""
    counts = [len(constraints.pieces_of(r)) for r in range(len(constraints.worst))]
    return [min(constraints.runs * count, MAX_CURVATURES) for count in counts]


class Model(NamedTuple):
    """What the subproblems of one trial have in common."""

    matrix: np.ndarray
    """B + sum_j y_j C_j, positive definite, (p, p)."""
    scale: float
    """Largest eigenvalue of the Gauss-Newton matrix, in magnitude."""
    low: np.ndarray
    """Bounds of the step: trust region and ranges of the gains, (p,)."""
    high: np.ndarray
    cuts: list[np.ndarray]
    """The pieces of each near rejected trial, linearised there and evaluated at the accepted point,
    (B, M)."""
    piece_gradients: np.ndarray
    """a_j of the pieces of the accepted point and of these trials, (B, p, (1 + cuts) M)."""


def _model(space: SearchSpace, state: SQPState) -> Model:
    """The model at the accepted point, with the present multipliers."""
    scale = float(np.max(np.abs(np.linalg.eigvalsh(state.here.matrix))))
    cuts = _near_cuts(state)
    gradients = state.here.piece_gradients
    if cuts:
        gradients = np.concatenate([gradients, *state.cut_gradients[cuts]], axis=2)
    return Model(
        matrix=_model_matrix(state, scale),
        scale=scale,
        low=np.maximum(space.box.low - state.z, -state.radius),
        high=np.minimum(space.box.high - state.z, state.radius),
        cuts=[_cut_values(state, c) for c in cuts],
        piece_gradients=gradients,
    )


def _model_matrix(state: SQPState, scale: float) -> np.ndarray:
    """`Model.matrix` with the present multipliers."""
    multipliers = state.piece_multipliers.ravel()[state.curved]
    matrix = state.here.matrix + state.correction
    of_pieces = multipliers @ state.curvatures.reshape(len(multipliers), matrix.size)
    return positive_definite(matrix + of_pieces.reshape(matrix.shape), scale)


def _solve(model: Model, state: SQPState, pieces: np.ndarray, penalty: float) -> Task[Step]:
    """The subproblem at the accepted point, with `pieces` as c."""
    return (
        yield Subproblem(
            state.here.gradient,
            model.matrix,
            model.low,
            model.high,
            np.concatenate([pieces, *model.cuts], axis=1),
            model.piece_gradients,
            penalty,
        )
    )


def _near_cuts(state: SQPState) -> list[int]:
    """Indices of the rejected trials within CUT_REACH radii of the accepted point."""
    distance = np.max(np.abs(state.cut_z - state.z), axis=1)
    return np.flatnonzero((distance > 0) & (distance <= CUT_REACH * state.radius)).tolist()


def _cut_values(state: SQPState, c: int) -> np.ndarray:
    """The pieces of a rejected trial, linearised there and evaluated at the accepted point, (B, M).

    The linear model of a concave piece is above the piece itself.  It is lowered to the piece, so
    that the accepted point does not seem to violate it.
    """
    change = (state.z - state.cut_z[c]) @ state.cut_gradients[c]
    return np.minimum(state.cut_pieces[c] + change, state.here.pieces)


def _predicted_merit(
    space: SearchSpace, state: SQPState, model: Model, step: np.ndarray, curved: np.ndarray
) -> float:
    """The penalty function after a step by the quadratic models of objective and pieces, without f
    at the accepted point; `curved` is e_j + s.C_j.s/2, (B, M).
    """
    linear = step @ model.piece_gradients
    count = curved.shape[1]
    pieces = curved + linear[:, :count]
    for i, values in enumerate(model.cuts, start=1):
        pieces = np.maximum(pieces, values + linear[:, i * count : (i + 1) * count])
    matrix = state.here.matrix + state.correction
    change = float(state.here.gradient @ step + 0.5 * step @ matrix @ step)
    return _merit(space, state, change, pieces)


def _with_penalty(space: SearchSpace, state: SQPState, model: Model) -> Task[tuple[Step, float]]:
    """The step of the subproblem and rho, which is increased as long as that reduces the predicted
    violation.
    """
    size = state.size
    largest = LARGEST_PENALTY * size
    smallest = max(2.0 * float(np.max(state.multipliers, initial=0.0)), MIN_PENALTY * size)
    penalty = min(smallest, largest)
    total = space.constraints.violation
    found = yield from _solve(model, state, state.here.pieces, penalty)
    while total(found.violation) > TARGET_EXCESS and penalty < largest:
        other = yield from _solve(model, state, state.here.pieces, PENALTY_FACTOR * penalty)
        if total(other.violation) > 0.99 * total(found.violation):
            break
        found = other
        penalty = PENALTY_FACTOR * penalty
    return found, penalty


def _plan(space: SearchSpace, state: SQPState, tolerance: float) -> Task[None]:
    """Determines the next trial of one start, or ends the start."""
    model = _model(space, state)
    found, penalty = yield from _with_penalty(space, state, model)
    state.penalty = penalty
    predicted_violation = space.constraints.violation(found.violation)
    if predicted_violation <= TARGET_EXCESS:
        state.penalty = max(penalty, 2.0 * float(np.max(found.multipliers, initial=0.0)))
    state.piece_multipliers = found.piece_multipliers
    state.multipliers = found.multipliers

    model = model._replace(matrix=_model_matrix(state, model.scale))
    excess = space.constraints.excess(state.here.pieces)
    violation = space.constraints.violation(excess + TARGET_EXCESS)
    reduction = violation - predicted_violation
    linear_decrease = -found.change + state.penalty * reduction
    step = found.step
    merit = state.penalty * violation
    curved = state.here.pieces + state.curvature_along(step)
    decrease = merit - _predicted_merit(space, state, model, step, curved)
    if np.any(state.curvatures):
        # The step with the largest predicted decrease, among the one found and those of
        # subproblems with the curvature of the pieces, becomes the trial.
        for _ in range(CURVATURE_SOLVES):
            last = yield from _solve(model, state, curved, penalty)
            curved = state.here.pieces + state.curvature_along(last.step)
            other = merit - _predicted_merit(space, state, model, last.step, curved)
            if other > decrease:
                step = last.step
                decrease = other
    state.trial = np.clip(state.z + step, space.box.low, space.box.high)
    # The quadratic models are used unless their prediction is far below that of the linear pieces.
    state.predicted = linear_decrease
    if decrease > 0.1 * linear_decrease:
        state.predicted = decrease
    state.corrected = False

    state.residuals = _residuals(space, state.z, state.here.pieces, found, excess)
    length = np.max(np.abs(found.step))
    is_feasible = violation <= TARGET_EXCESS or reduction < 1e-3 * violation
    is_flat = is_feasible and linear_decrease < tolerance * state.size
    slope_scale = slope_size(state.here)
    if violation > TARGET_EXCESS:
        slope_scale = max(slope_scale, state.penalty)
    is_stationary = state.residuals[0] <= STATIONARITY_TOLERANCE * slope_scale
    is_optimal = bool(length < 1e-7 or (is_flat and is_stationary))
    state.done = is_optimal or bool(state.radius < COLLAPSED_RADIUS)


def slope_size(here: Point) -> float:
    """The larger of the objective and the largest entry of its gradient.  The gradient of the
    Lagrangian counts as zero if it is small relative to this number.
    """
    return max(1e-3, abs(here.loss), float(np.max(np.abs(here.gradient))))


def free_slope(box: Box, z: np.ndarray, slope: np.ndarray) -> float:
    """The largest entry of a gradient that no range blocks."""
    blocked_below = (z < box.low + RANGE_TOLERANCE) & (slope > 0)
    blocked_above = (z > box.high - RANGE_TOLERANCE) & (slope < 0)
    return float(np.max(np.abs(np.where(blocked_below | blocked_above, 0.0, slope))))


def with_nearby_pieces(
    space: SearchSpace, found: Point, nearby: list[Point]
) -> tuple[SearchSpace, Point]:
    """A point with its own pieces and those of nearby points as further pieces of the same
    requirements.  A further piece is lowered to the point's own where it is above it.
    """
    pieces = [found.pieces, *(np.minimum(x.pieces, found.pieces) for x in nearby)]
    gradients = [found.piece_gradients, *(x.piece_gradients for x in nearby)]
    owner = np.tile(space.constraints.owner, len(pieces))
    space = space._replace(constraints=space.constraints._replace(owner=owner))
    return space, found._replace(
        pieces=np.concatenate(pieces, axis=1), piece_gradients=np.concatenate(gradients, axis=2)
    )


def conditions_at(space: SearchSpace, z: np.ndarray, found: Point) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers of each requirement, (R,), and residuals of the optimality conditions, (3,), at
    any point z.

    The multipliers are those of the subproblem with the matrix BETA |f| I.  Its dual problem is

        minimise over y >= 0    |g + sum_j y_j a_j|^2 / (2 BETA |f|) - sum_j y_j e_j,

    in which a piece has a multiplier only if it is at its limit.  Where only the largest excess
    counts, f is omitted, the multipliers add up to 1, and a piece is at its limit if its excess is
    the largest one.
    """
    size = max(1e-3, abs(found.loss))
    penalty = MULTIPLIER_LIMIT * size
    if space.constraints.largest_only:
        size = penalty = 1.0
        found = found._replace(gradient=np.zeros_like(found.gradient))
    requested = Subproblem(
        found.gradient,
        BETA * size * np.eye(len(z)),
        np.maximum(space.box.low - z, -1.0),
        np.minimum(space.box.high - z, 1.0),
        np.where(np.abs(found.pieces) < AT_LIMIT, -TARGET_EXCESS, found.pieces),
        found.piece_gradients,
        penalty,
    )
    (solved,) = subproblems(space.constraints, [requested])
    excess = space.constraints.excess(found.pieces)
    over_limit = found.pieces
    if space.constraints.largest_only:
        over_limit = found.pieces - max(float(np.max(excess)), 0.0)
    return solved.multipliers, _residuals(space, z, over_limit, solved, excess)


def _residuals(
    space: SearchSpace, z: np.ndarray, pieces: np.ndarray, found: Step, excess: np.ndarray
) -> np.ndarray:
    """The residuals of `optimality.Conditions`, (3,): stationarity, largest excess and
    complementarity.
    """
    stationarity = free_slope(space.box, z, found.lagrangian)
    products = np.sum(found.piece_multipliers * pieces, axis=0)
    by_requirement = np.bincount(space.constraints.owner, products, len(excess))
    complementarity = float(np.sum(np.abs(by_requirement)))
    worst = float(np.max(excess, initial=-np.inf))
    return np.array([stationarity, max(worst, 0.0), complementarity])


def _correct(
    space: SearchSpace, state: SQPState, step: np.ndarray, pieces: np.ndarray
) -> Task[bool]:
    """Makes the second-order correction of a rejected step the next trial; returns whether it
    differs from the rejected one.
    """
    if not len(space.constraints.owner):
        return False
    pieces = pieces - state.here.linear_change(step)
    found = yield from _solve(_model(space, state), state, pieces, state.penalty)
    state.trial = np.clip(state.z + found.step, space.box.low, space.box.high)
    state.corrected = True
    difference = np.max(np.abs(state.trial - state.z - step))
    return bool(difference > 1e-3 * np.max(np.abs(step)))


def _rank_one_update(matrix: np.ndarray, change: np.ndarray, step: np.ndarray) -> None:
    """Updates matrices, (..., p, p), in place, so that matrix @ step is the change of a gradient,
    (..., p).  A matrix whose denominator r.s is too small is not updated.
    """
    error = change - matrix @ step
    along = error @ step
    scale = np.linalg.norm(error, axis=-1) * np.linalg.norm(step)
    is_determined = np.abs(along) > 1e-8 * scale
    denominator = np.where(is_determined, np.abs(along), 1.0)
    inverse = np.where(is_determined, 1 / denominator, 0.0)
    error *= np.sqrt(inverse)[..., None]
    matrix += np.sign(along)[..., None, None] * error[..., :, None] * error[..., None, :]

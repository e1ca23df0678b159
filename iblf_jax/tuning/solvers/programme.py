"""A tuning problem as a nonlinear programme, for libraries that run their own loop.

    minimise  f(z) / |f(z0)|   subject to  g_j(z) <= -TARGET_EXCESS,   low <= z <= high

A requirement that no run may violate consists of smooth pieces (`evaluation`), each of which is
one constraint g_j, as in `sqp`.  The library gets only the pieces that may bind near the first
point.  If another piece is violated at the end of a run of the library, it becomes a constraint
too, and the library runs again from there; it runs at most MAX_RUNS_OF_LIBRARY times.  A
requirement that some of the runs may violate is one constraint, the mean of its k worst runs.  Its
gradient jumps where other runs become the worst.

One evaluation gives value, gradient, constraints and Jacobian at a point.  Where a run is invalid,
the objective is INVALID_OBJECTIVE and each constraint is violated by 1, so that a line search
shortens its step.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import numpy as np

from iblf_jax.tuning.solvers._base import SearchSpace, Solver, violations
from iblf_jax.tuning.solvers.sqp import MAX_PIECES, TARGET_EXCESS

if TYPE_CHECKING:
    from iblf_jax.tuning.solvers._base import Derivatives, Evaluation

T = TypeVar("T")


INVALID_OBJECTIVE = 1e3
"""Value of f / |f0| where a run is invalid."""
REACH = 1.0
"""Distance in z within which a piece must be able to bind to be among the first constraints; 1 is a
factor e for a gain."""
SMALLEST_CHANGE = 1e-9
"""A piece that changes by less than this within REACH is assumed not to depend on the gains."""
MAX_RUNS_OF_LIBRARY = 4
"""Largest number of runs of the library from one start."""
POINTS_KEPT = 8
"""Number of evaluated points that are stored, as a library requests objective, constraints and
their derivatives at a point one after the other."""


class Row(NamedTuple):
    """The numbers of a programme at one point."""

    objective: float
    gradient: np.ndarray
    """Of the objective, (p,)."""
    hessian: np.ndarray
    """Gauss-Newton approximation for the objective, (p, p)."""
    pieces: np.ndarray
    """Values of the pieces, (B, M); -infinity for requirements that some runs may violate."""
    piece_gradients: np.ndarray
    """Their gradients, (B, p, M)."""
    means: np.ndarray
    """Mean of the k worst runs, for each of the R' requirements with k > 1, (R',)."""
    mean_gradients: np.ndarray
    """Their gradients, (R', p)."""


class Programme:
    """One start of a tuning problem, as functions of z, (p,).

    Args:
      evaluate: as in `Solver.step`, for S starts.
      start: index of this start.
      z: point where the run begins, (p,).
    """

    def __init__(self, evaluate: Evaluation, start: int, z: np.ndarray):
        self.evaluate = evaluate
        self.start = start
        self.space: SearchSpace = evaluate.space
        self.low = self.space.box.low
        self.high = self.space.box.high
        self.z = np.clip(z, self.low, self.high)
        self.rows: OrderedDict[bytes, Row | None] = OrderedDict()
        self.scale = 1.0
        self.best: tuple[tuple[float, float], np.ndarray, Any] | None = None
        """Key, point and derivatives of the best point so far."""
        self.first = self.row(self.z)
        """The numbers at the first point; None where they are not finite."""
        shape = (self.space.constraints.runs, len(self.space.constraints.owner))
        self.chosen = np.zeros(shape, bool)
        """Whether each piece of each run is a constraint."""
        if self.first is not None:
            self.scale = max(abs(self.first.objective), 1e-3)
            self.chosen = self._pieces_that_may_bind(self.first)

    # --------------------------------------------------------------------------- for a library

    @property
    def constraints(self) -> int:
        """Number of constraints."""
        means = sum(k > 1 for k in self.space.constraints.worst)
        return int(np.sum(self.chosen)) + means

    def objective(self, z: np.ndarray) -> float:
        """The objective f / |f0|."""
        row = self.row(z)
        return INVALID_OBJECTIVE if row is None else row.objective / self.scale

    def gradient(self, z: np.ndarray) -> np.ndarray:
        """Gradient of the objective, (p,)."""
        row = self.row(z)
        return np.zeros(len(z)) if row is None else row.gradient / self.scale

    def hessian(self, z: np.ndarray) -> np.ndarray:
        """Gauss-Newton approximation for the objective, (p, p)."""
        row = self.row(z)
        return np.eye(len(z)) if row is None else row.hessian / self.scale

    def excess(self, z: np.ndarray) -> np.ndarray:
        """Left-hand side of each constraint <= 0, (m,): g_j + TARGET_EXCESS."""
        row = self.row(z)
        if row is None:
            return np.ones(self.constraints)
        return np.concatenate([row.pieces[self.chosen], row.means]) + TARGET_EXCESS

    def jacobian(self, z: np.ndarray) -> np.ndarray:
        """Gradients of the constraints, (m, p)."""
        row = self.row(z)
        if row is None:
            return np.zeros((self.constraints, len(z)))
        of_pieces = np.swapaxes(row.piece_gradients, 1, 2)[self.chosen]
        return np.concatenate([of_pieces, row.mean_gradients])

    # ---------------------------------------------------------------------------- evaluation

    def row(self, z: np.ndarray) -> Row | None:
        """The numbers at z, from the stored ones if z is among them; None where they are not
        finite.
        """
        z = np.clip(np.asarray(z, float), self.low, self.high)
        point = z.tobytes()
        if point not in self.rows:
            self.rows[point] = self._evaluated(z)
            if len(self.rows) > POINTS_KEPT:
                self.rows.popitem(last=False)
        return self.rows[point]

    def _evaluated(self, z: np.ndarray) -> Row | None:
        """Evaluates z with this start as the only active one, and stores it if it is the best."""
        evaluate = self.evaluate
        active = evaluate.active
        evaluate.active = np.arange(len(active)) == self.start
        try:
            found = evaluate(np.tile(z, (len(active), 1)))
        finally:
            evaluate.active = active
        # Violation and loss compare the points.
        key = (np.inf, np.inf)
        if found.value.valid[self.start]:
            violation = violations(found.value)[self.start]
            key = (float(violation), float(found.value.loss[self.start]))
        if self.best is None or key < self.best[0]:
            self.best = key, z, found
        row = self._row_of(found)
        numbers = (row.objective, row.gradient, row.piece_gradients, row.means)
        is_finite = all(bool(np.all(np.isfinite(x))) for x in numbers)
        return row if is_finite else None

    def _row_of(self, found: Derivatives) -> Row:
        """The numbers of this start from `Derivatives` of all starts."""
        gradient = np.asarray(found.gradient[self.start], float)
        objective = float(found.value.loss[self.start])
        hessian = np.asarray(found.hessian[self.start], float)
        constraints = self.space.constraints
        size = len(gradient)
        if not len(constraints.owner):
            none = np.zeros((constraints.runs, 0)), np.zeros((constraints.runs, size, 0))
            return Row(objective, gradient, hessian, *none, np.zeros(0), np.zeros((0, size)))
        pieces = np.array(found.pieces[self.start], float)
        piece_gradients = np.asarray(found.piece_gradients[self.start], float)
        means = []
        mean_gradients = []
        for r, k in enumerate(constraints.worst):
            own = constraints.pieces_of(r)
            if k == 1:
                continue
            largest = own[np.argmax(pieces[:, own], axis=1)]
            by_run = pieces[np.arange(len(pieces)), largest]
            worst = np.argsort(by_run)[-k:]
            means.append(by_run[worst].mean())
            mean_gradients.append(piece_gradients[worst, :, largest[worst]].mean(axis=0))
            pieces[:, own] = -np.inf
        slopes = np.reshape(mean_gradients, (len(means), size))
        return Row(objective, gradient, hessian, pieces, piece_gradients, np.asarray(means), slopes)

    # -------------------------------------------------------------------------- constraints

    def _pieces_that_may_bind(self, row: Row) -> np.ndarray:
        """Whether each piece may be at its limit within REACH, (B, M).

        Of more than MAX_PIECES pieces of a requirement, the worst ones are taken.
        A piece that no gain changes, such as the margin at t = 0, is excluded, because no step can
        move it inside its limit by TARGET_EXCESS.
        """
        change = REACH * np.sum(np.abs(row.piece_gradients), axis=1)
        may_bind = (row.pieces + change >= -TARGET_EXCESS) & (change > SMALLEST_CHANGE)
        for r in range(len(self.space.constraints.worst)):
            own = self.space.constraints.owner == r
            values = np.where(may_bind & own, row.pieces + change, -np.inf)
            least = np.sort(values, axis=None)[-MAX_PIECES:][0]
            may_bind &= ~own | (values >= least)
        return may_bind & np.isfinite(row.pieces)

    def add_violated(self, z: np.ndarray) -> bool:
        """Makes a constraint of every violated piece at z that is none yet; returns whether there
        was any.
        """
        row = self.row(z)
        if row is None:
            return False
        missing = (row.pieces > 0) & ~self.chosen
        self.chosen |= missing
        return bool(np.any(missing))


class RunsToItsEnd(Solver):
    """Base class of solvers whose library runs its own loop.

    One step is a whole run of the library from each start, so that a checkpoint exists only after
    such a run.  A derived class defines `minimise` and the members of `Solver` that are not defined
    here.
    """

    def minimise(self, programme: Programme, iterations: int, tolerance: float) -> np.ndarray:
        """Runs the library from `programme.z`; returns the point where it ended, (p,)."""
        raise NotImplementedError

    def init(self, space: SearchSpace, z: np.ndarray) -> dict[str, np.ndarray]:
        """As `Solver.init`."""
        return {"z": np.array(z, float), "done": np.zeros(len(z), bool)}

    def restart(
        self,
        space: SearchSpace,
        state: dict[str, np.ndarray],
        start: int,
        z: np.ndarray | None = None,
    ) -> None:
        """As `Solver.restart`."""
        state["done"][start] = False
        if z is not None:
            state["z"][start] = z

    def converged(self, state: dict[str, np.ndarray]) -> np.ndarray:
        """Whether the run of each start has ended, (S,) bool."""
        return state["done"].copy()

    def step(
        self, evaluate: Any, state: dict[str, np.ndarray], tolerance: float
    ) -> tuple[np.ndarray, Any]:
        """A whole run of every active start, one after the other, as `Solver.step`.

        Returns:
          The best point of each start, and the derivatives there.
        """
        found: Any = None
        for s in np.flatnonzero(evaluate.active).tolist():
            best, of_start = self._run(evaluate, s, state["z"][s], tolerance)
            state["z"][s] = best
            state["done"][s] = True
            found = of_start if found is None else _with_row(found, of_start, s)
        return state["z"].copy(), found

    def _run(
        self, evaluate: Any, start: int, z: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, Any]:
        """The best point of one start, and its derivatives."""
        programme = Programme(evaluate, start, z)
        runs = MAX_RUNS_OF_LIBRARY if programme.first is not None else 0
        for _ in range(runs):
            programme.z = np.clip(
                self.minimise(programme, evaluate.space.iterations, tolerance),
                programme.low,
                programme.high,
            )
            if not programme.add_violated(programme.z):
                break
        assert programme.best is not None
        _, best, found = programme.best
        return best, found


def _with_row(tree: T, other: T, row: int) -> T:
    """Derivatives of several starts in which one row is replaced by that of `other`."""

    def replaced(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        joined = np.array(x)
        joined[row] = y[row]
        return joined

    return jax.tree.map(replaced, tree, other)

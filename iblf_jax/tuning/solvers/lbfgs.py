"""L-BFGS, on coordinates that are squashed into the box.

It suits many parameters (reverse mode); for few gains `sqp` needs fewer rollouts.  The direction is
that of `optax.scale_by_lbfgs`.  The line search runs on the host and calls one compiled function,
so that the gradient, whose compilation takes longer than many evaluations, is compiled once.  It
finds a step t along the direction d with

    L(w + t d) <= L(w) + c1 t g.d     and     g(w + t d).d >= c2 g.d

by doubling and bisection: t is too long where the first condition fails, and too short where only
the second one does.  A point with an invalid run is too far.  The method needs no smooth loss, and
the second condition keeps the curvature along the step positive.

Source: A. S. Lewis, M. L. Overton, Math. Program. 141 (2013) 135-163, algorithm 2.6.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from iblf_jax.tuning.parameters import squashed, unsquash
from iblf_jax.tuning.solvers._base import SearchSpace, Solver, check_options, where_rows

if TYPE_CHECKING:
    from iblf_jax.tuning.solvers._base import Derivatives, Evaluation

SUFFICIENT_DECREASE = 1e-4
"""c1."""
CURVATURE = 0.9
"""c2."""


@dataclasses.dataclass(frozen=True)
class LBFGS(Solver):
    """L-BFGS; requirements are penalties.

    All starts take the steps of their line searches together, in one batch.

    Args:
      memory: number of previous steps in the approximation of the Hessian.
      line_steps: evaluations of one line search at most.
      mode: "forward", "reverse", or "auto": forward up to 32 numbers.
      tolerance: relative change of the loss below which a start has converged.
      starts: number of starting points.
      sharpenings: how often the smoothing of peaks in the objective is divided by 4, each time once
        the starts have converged.
      patience: steps without a better result after which the search ends.
    """

    memory: int = 10
    line_steps: int = 12
    mode: str = "auto"
    tolerance: float = 1e-5
    starts: int = 1
    sharpenings: int = 2
    patience: int = 15
    name: ClassVar[str] = "lbfgs"
    handles_requirements: ClassVar[bool] = False
    resample = False

    def __post_init__(self) -> None:
        check_options(self)

    def init(self, space: SearchSpace, z: np.ndarray) -> dict[str, Any]:
        """As `Solver.init`."""
        w = np.stack([unsquash(x, space.box) for x in z])
        return {
            "w": w,
            "loss": np.full(len(z), np.inf),
            "gradient": np.zeros_like(w),
            "evaluated": np.zeros(len(z), bool),
            "inner": self._memory_at(w),
            "done": np.zeros(len(z), bool),
        }

    def restart(
        self, space: SearchSpace, state: dict[str, Any], start: int, z: np.ndarray | None = None
    ) -> None:
        """As `Solver.restart`; forgets the curvature, and the loss at the present point."""
        if z is not None:
            state["w"][start] = unsquash(z, space.box)
        state["evaluated"][start] = False
        state["done"][start] = False
        self._forget(state, np.arange(len(state["w"])) == start)

    def converged(self, state: dict[str, Any]) -> np.ndarray:
        """As `Solver.converged`."""
        return state["done"].copy()

    def step(
        self, evaluate: Evaluation, state: dict[str, Any], tolerance: float
    ) -> tuple[np.ndarray, Derivatives]:
        """One line search of every active start, as `Solver.step`."""
        active = evaluate.active.copy()
        found: Any = None
        if not np.all(state["evaluated"][active]):
            z, pull = squashed(evaluate.space.box, state["w"])
            found = evaluate(z)
            gradient = pull(found.gradient)
            valid = active & _is_finite(found.value.loss, gradient)
            state["loss"] = np.where(valid, found.value.loss, state["loss"])
            state["gradient"] = where_rows(valid, gradient, state["gradient"])
            state["evaluated"] = state["evaluated"] | valid
        search = LineSearch(evaluate, self._directions(state), state, found)
        search.run(active & state["evaluated"], self.line_steps)
        evaluate.active = active

        change = np.abs(state["loss"] - search.loss)
        small = change < tolerance * np.maximum(1e-3, np.abs(search.loss))
        state["done"] = np.where(active, small | ~search.improved, state["done"])
        for name in ("w", "loss", "gradient"):
            state[name] = where_rows(search.improved, getattr(search, name), state[name])
        return search.z, search.found

    def _directions(self, state: dict[str, Any]) -> np.ndarray:
        """The direction of descent of each start, (S, p), by a curvature that includes its last
        step; a curvature that gives no descent is forgotten.
        """
        directions = self._updated(state)
        ascends = np.sum(directions * state["gradient"], axis=1) >= 0
        if np.any(ascends):
            self._forget(state, ascends)
            directions = where_rows(ascends, self._updated(state), directions)
        return directions

    def _updated(self, state: dict[str, Any]) -> np.ndarray:
        scaled, inner = _scaled(state["gradient"], state["inner"], state["w"], self.memory)
        # The update of a row with the same point and gradient once more would add an empty pair.
        moved = np.any(np.asarray(state["inner"].params) != state["w"], axis=1)
        new = moved | (state["inner"].count == 0)
        state["inner"] = jax.tree.map(partial(where_rows, new), inner, state["inner"])
        return -np.asarray(scaled)

    def _forget(self, state: dict[str, Any], rows: np.ndarray) -> None:
        """Forgets the curvature of the starts for which `rows`, (S,), is true."""
        blank = self._memory_at(state["w"])
        state["inner"] = jax.tree.map(partial(where_rows, rows), blank, state["inner"])

    def _memory_at(self, w: np.ndarray) -> Any:
        blank = jax.vmap(optax.scale_by_lbfgs(self.memory).init)(jnp.asarray(w))
        return jax.tree.map(np.array, blank)


@partial(jax.jit, static_argnames="memory")
def _scaled(gradient: jax.Array, inner: Any, w: jax.Array, memory: int) -> Any:
    """The gradients times the approximate inverse of the Hessian, and the new memory."""
    with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of several types
        return jax.vmap(optax.scale_by_lbfgs(memory).update)(gradient, inner, w)


def _is_finite(loss: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    return np.isfinite(loss) & np.all(np.isfinite(gradient), axis=1)


class LineSearch:
    """The line searches of S starts; each keeps the trial with the lowest loss that has a
    sufficient decrease.

    Args:
      evaluate: as of `Solver.step`.
      directions: (S, p).
      state: of the solver.
      here: `Derivatives` at the present points, or None.
    """

    def __init__(
        self,
        evaluate: Evaluation,
        directions: np.ndarray,
        state: dict[str, Any],
        here: Any,
    ):
        self.evaluate = evaluate
        self.directions = directions
        self.origin = state["w"]
        self.loss_at_origin = state["loss"]
        self.slopes = np.sum(directions * state["gradient"], axis=1)
        self.improved = np.zeros(len(self.origin), bool)
        """Whether a start has found a sufficient decrease."""
        self.w = self.origin.copy()
        self.z = squashed(evaluate.space.box, self.w)[0].copy()
        self.loss = self.loss_at_origin.copy()
        self.gradient = state["gradient"].copy()
        self.found = here
        """`Derivatives` at `z`: of the best trials; where there is none, of the present points if
        they have been evaluated in this step, otherwise of the last trials."""
        self.keeps_failures = here is None

    def run(self, searching: np.ndarray, line_steps: int) -> None:
        """The line searches of the starts for which `searching`, (S,), is true."""
        t = np.ones(len(self.origin))
        low = np.zeros(len(t))
        high = np.full(len(t), np.inf)
        for _ in range(line_steps):
            if self.found is not None and not np.any(searching):
                return
            trial = self._tried(searching, t)
            fits = searching & trial.decreased
            flat = trial.slopes >= CURVATURE * self.slopes
            self._keep(trial, searching, fits & (trial.loss < self.loss))
            low = np.where(fits, t, low)
            high = np.where(searching & ~fits, t, high)
            searching = searching & ~(fits & flat)
            t = np.where(np.isfinite(high), 0.5 * (low + high), 2.0 * t)

    def _tried(self, searching: np.ndarray, t: np.ndarray) -> Trial:
        """The points at steps t, (S,), along the directions."""
        self.evaluate.active = searching
        w = self.origin + np.where(searching, t, 0.0)[:, None] * self.directions
        z, pull = squashed(self.evaluate.space.box, w)
        found = self.evaluate(z)
        gradient = pull(found.gradient)
        loss = np.asarray(found.value.loss)
        limit = self.loss_at_origin + SUFFICIENT_DECREASE * t * self.slopes
        decreased = _is_finite(loss, gradient) & (loss <= limit)
        slopes = np.sum(np.where(decreased[:, None], gradient, 0.0) * self.directions, axis=1)
        return Trial(w, z, found, loss, gradient, decreased, slopes)

    def _keep(self, trial: Trial, searching: np.ndarray, better: np.ndarray) -> None:
        self.improved = self.improved | better
        self.w = where_rows(better, trial.w, self.w)
        self.loss = np.where(better, trial.loss, self.loss)
        self.gradient = where_rows(better, trial.gradient, self.gradient)
        shown = better
        if self.keeps_failures:
            shown = better | (searching & ~self.improved)
        self.z = where_rows(shown, trial.z, self.z)
        if self.found is None:
            self.found = trial.found
            return
        self.found = jax.tree.map(partial(where_rows, shown), trial.found, self.found)


class Trial(NamedTuple):
    """One evaluation of a line search, of S starts."""

    w: np.ndarray
    z: np.ndarray
    found: Derivatives
    loss: np.ndarray
    gradient: np.ndarray
    """By w, (S, p)."""
    decreased: np.ndarray
    """Whether the decrease is sufficient, (S,)."""
    slopes: np.ndarray
    """Along the directions, (S,)."""

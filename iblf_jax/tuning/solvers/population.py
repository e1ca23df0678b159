"""Solvers that compare values of many points and use no derivatives.

One step is one generation, whose points are evaluated in one batch.  Requirements and bounds are an
exact penalty,

    f / |f0| + PENALTY max(0, max_r G_r, -margin),

with the objective f0 at the start, or at the first valid point.  Where a run is invalid the loss is
INVALID_LOSS.

The state holds the losses of all points so far.  With them the library's own state is restored from
a checkpoint: it asks for the same points again, and gets the stored losses.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np

from iblf_jax.tuning.solvers._base import SearchSpace

PENALTY = 200.0
"""Of the largest excess, as that by which starts are chosen (`starts`)."""
INVALID_LOSS = 1e6
BATCHES_IN_FIRST_STEP = 2
"""A library may evaluate a first population beside the first generation."""

Losses = Callable[[np.ndarray], np.ndarray]
"""Function of points, (N, p), that returns their losses, (N,)."""


class Library:
    """The library's own object, and how many points it has got the losses of."""

    def __init__(self) -> None:
        self.inner: Any = None
        self.count = 0


class Values(NamedTuple):
    """The fields of `Derivatives`, of which only the value is known."""

    value: Any
    gradient: np.ndarray
    hessian: np.ndarray
    pieces: Any = ()
    piece_gradients: Any = ()


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("z", "losses", "count", "generations", "reference", "done"),
    meta_fields=("library",),
)
@dataclasses.dataclass(eq=False)
class PopulationState:
    """The state of the one start."""

    z: np.ndarray
    """Where it begins, (p,)."""
    losses: np.ndarray
    """Of all points so far, NaN where there is none yet."""
    count: Any
    """Number of points so far."""
    generations: Any
    reference: Any
    """|f0|; NaN before the first valid point."""
    done: Any
    library: Library
    """Not part of a checkpoint."""


class Population:
    """Base of these solvers; a class has the options and the methods `begin` and `generation`.

    There is one start.  Its `step` returns the best point of the generation, with NaN as its
    derivatives.
    """

    population: int
    handles_requirements: ClassVar[bool] = True
    mode: ClassVar[str] = "forward"
    resample: ClassVar[bool] = False
    starts: ClassVar[int] = 1
    sharpenings: ClassVar[int] = 0

    def begin(self, space: SearchSpace, z: np.ndarray) -> Any:
        """The library's own object for a search that begins at z, (p,)."""
        raise NotImplementedError

    def generation(self, library: Any, losses: Losses) -> bool:
        """Advances the library's object by one generation; whether it has converged."""
        raise NotImplementedError

    @staticmethod
    def near(space: SearchSpace, z: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """The limits of z within a reach of the start, (p,) each."""
        return np.maximum(space.box.low, z - reach), np.minimum(space.box.high, z + reach)

    def init(self, space: SearchSpace, z: np.ndarray) -> list[PopulationState]:
        """As `Solver.init`."""
        return [self._state(space, start) for start in z]

    def _state(self, space: SearchSpace, z: np.ndarray) -> PopulationState:
        points = self.population * (space.iterations + BATCHES_IN_FIRST_STEP)
        return PopulationState(
            z=np.array(z, float),
            losses=np.full(points, np.nan),
            count=np.asarray(0),
            generations=np.asarray(0),
            reference=np.asarray(np.nan),
            done=np.asarray(False),
            library=Library(),
        )

    def restart(
        self,
        space: SearchSpace,
        state: list[PopulationState],
        start: int,
        z: np.ndarray | None = None,
    ) -> None:
        """As `Solver.restart`; without z the search begins anew where it began."""
        state[start] = self._state(space, state[start].z if z is None else z)

    def converged(self, state: list[PopulationState]) -> np.ndarray:
        """As `Solver.converged`."""
        return np.array([start.done for start in state], bool)

    def step(
        self, evaluate: Any, state: list[PopulationState], tolerance: float
    ) -> tuple[np.ndarray, Any]:
        """One generation, as `Solver.step`."""
        own = state[0]
        library = self._library(evaluate.space, own)
        seen: list[tuple[np.ndarray, Any]] = []

        def losses(points: np.ndarray) -> np.ndarray:
            found = _losses(evaluate, own, np.asarray(points, float), seen)
            own.losses[int(own.count) : int(own.count) + len(found)] = found
            own.count = own.count + len(found)
            return found

        own.done = np.asarray(self.generation(library.inner, losses))
        own.generations = own.generations + 1
        library.count = int(own.count)
        return _best_of(seen)

    def _library(self, space: SearchSpace, own: PopulationState) -> Library:
        """The library's object, restored from the losses where it is not that of the state."""
        library = own.library
        if library.inner is not None and library.count == int(own.count):
            return library
        library.inner = self.begin(space, own.z)
        first = 0

        def stored(points: np.ndarray) -> np.ndarray:
            nonlocal first
            first += len(points)
            return own.losses[first - len(points) : first].copy()

        for _ in range(int(own.generations)):
            self.generation(library.inner, stored)
        library.count = first
        return library


def _losses(
    evaluate: Any, own: PopulationState, points: np.ndarray, seen: list[tuple[np.ndarray, Any]]
) -> np.ndarray:
    """The losses of points, (N,), which are added to those seen; the first batch contains the
    start too.
    """
    batch = points
    if int(own.count) == 0:
        batch = np.concatenate([points, own.z[None]])
    found = evaluate.values(batch)
    seen.append((batch, found))
    valid = found.valid & np.isfinite(found.objective)
    if np.isnan(own.reference) and np.any(valid):
        first = -1 if valid[-1] else int(np.argmax(valid))
        own.reference = np.asarray(max(abs(float(found.objective[first])), 1e-12))
    with np.errstate(invalid="ignore"):
        losses = found.objective / own.reference + PENALTY * violation(found)
    return np.where(valid, np.nan_to_num(losses, nan=INVALID_LOSS), INVALID_LOSS)[: len(points)]


def violation(value: Any) -> np.ndarray:
    """The largest excess of a requirement or bound at each point, (N,)."""
    excess = np.max(value.exact_excess, axis=1, initial=0.0)
    return np.maximum(excess, -value.margin)


def _best_of(seen: list[tuple[np.ndarray, Any]]) -> tuple[np.ndarray, Values]:
    """Of all points of a generation the best one, as trial of one start."""
    points = np.concatenate([batch for batch, _ in seen])
    value = jax.tree.map(lambda *x: np.concatenate(x), *(found for _, found in seen))
    objective = np.where(value.valid, value.objective, np.inf)
    excess = np.where(value.valid, violation(value), np.inf)
    best = int(np.lexsort((objective, excess))[0])
    one = jax.tree.map(lambda x: x[best : best + 1], value)
    size = points.shape[1]
    unknown = Values(one, np.full((1, size), np.nan), np.full((1, size, size), np.nan))
    return points[best : best + 1], unknown

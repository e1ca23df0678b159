"""Solvers that compare values of many points and use no derivatives.

One step is one generation, whose points are evaluated in one batch.  The loss contains requirements
and bounds as an exact penalty,

    f / |f0| + EXCESS_WEIGHT max(0, max_r G_r, -margin),

where f0 is the objective at the start, or at the first valid point if the start is invalid.  Where
a run is invalid the loss is INVALID_LOSS.

A checkpoint cannot store the library's own object.  The state therefore holds the losses of all
points so far.  To continue from a checkpoint, a new object of the library repeats all generations
with these losses, which gives the same points again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import numpy as np

from iblf_jax.tuning.solvers._base import EXCESS_WEIGHT, SearchSpace, Solver, violations

if TYPE_CHECKING:
    from iblf_jax.tuning.evaluation import Evaluator, Value

INVALID_LOSS = 1e6
BATCHES_IN_FIRST_STEP = 2
"""Largest number of populations in the first step: a library may evaluate an initial population
besides the first generation."""

Losses = Callable[[np.ndarray], np.ndarray]
"""Function of points, (N, p), that returns their losses, (N,)."""


class Library:
    """The library's own object and its progress."""

    def __init__(self) -> None:
        self.inner: Any = None
        """The object; None before it is needed."""
        self.count = 0
        """Number of points whose losses the object has received."""


class Values(NamedTuple):
    """The fields of `Derivatives` where only the value is known."""

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
    """The point where it begins, (p,)."""
    losses: np.ndarray
    """Losses of all points so far, NaN in the places of later ones."""
    count: np.ndarray | int
    """Number of points so far."""
    generations: np.ndarray | int
    """Number of generations so far."""
    reference: np.ndarray | float
    """|f0|; NaN before the first valid point."""
    done: np.ndarray | bool
    """Whether the library has converged."""
    library: Library
    """The library's object; not part of a checkpoint."""


class Population(Solver):
    """Base class of solvers that use values only.

    A derived class defines its options, `begin`, `generation` and the members of `Solver` that are
    not defined here.  The search has one start.  `step` returns the best point of the generation,
    with NaN as its derivatives.
    """

    population: int
    """Number of points of a generation."""
    handles_requirements: ClassVar[bool] = True
    mode = "forward"
    resample = False
    starts = 1
    sharpenings = 0

    def begin(self, space: SearchSpace, z: np.ndarray) -> Any:
        """The library's own object for a search that begins at z, (p,)."""
        raise NotImplementedError

    def generation(self, library: Any, losses: Losses) -> bool:
        """Advances the library's object by one generation; returns whether it has converged."""
        raise NotImplementedError

    @staticmethod
    def near(space: SearchSpace, z: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limits of z within a distance `reach` of the start and within the ranges,
        (p,) each.
        """
        return np.maximum(space.box.low, z - reach), np.minimum(space.box.high, z + reach)

    def init(self, space: SearchSpace, z: np.ndarray) -> list[PopulationState]:
        """As `Solver.init`."""
        return [self._state(space, start) for start in z]

    def _state(self, space: SearchSpace, z: np.ndarray) -> PopulationState:
        """The state of a start at z, (p,), before its first generation."""
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
        """The library's object.  Where it is missing or of another state, a new one repeats all
        generations with the stored losses.
        """
        library = own.library
        if library.inner is not None and library.count == int(own.count):
            return library
        library.inner = self.begin(space, own.z)
        count = 0

        def stored_losses(points: np.ndarray) -> np.ndarray:
            nonlocal count
            first = count
            count += len(points)
            return own.losses[first:count].copy()

        for _ in range(int(own.generations)):
            self.generation(library.inner, stored_losses)
        library.count = count
        return library


def _losses(
    evaluate: Evaluator,
    own: PopulationState,
    points: np.ndarray,
    seen: list[tuple[np.ndarray, Value]],
) -> np.ndarray:
    """Evaluates points, (N, p), appends them to `seen` and returns their losses, (N,).

    The first batch also contains the start, whose objective is the reference of the losses.
    """
    batch = points
    if int(own.count) == 0:
        batch = np.concatenate([points, own.z[None]])
    found = evaluate.values(batch)
    seen.append((batch, found))
    valid = found.valid & np.isfinite(found.objective)
    if np.isnan(own.reference) and np.any(valid):
        first = -1 if valid[-1] else int(np.argmax(valid))  # the start is the last point
        own.reference = np.asarray(max(abs(float(found.objective[first])), 1e-12))
    with np.errstate(invalid="ignore"):
        losses = found.objective / own.reference + EXCESS_WEIGHT * violations(found)
    return np.where(valid, np.nan_to_num(losses, nan=INVALID_LOSS), INVALID_LOSS)[: len(points)]


def _best_of(seen: list[tuple[np.ndarray, Any]]) -> tuple[np.ndarray, Values]:
    """The best point of a generation and its value, with shapes (1, ...) as for one start.

    Points are compared by their violation and then by their objective.
    """
    points = np.concatenate([batch for batch, _ in seen])
    value = jax.tree.map(lambda *x: np.concatenate(x), *(found for _, found in seen))
    objective = np.where(value.valid, value.objective, np.inf)
    excess = np.where(value.valid, violations(value), np.inf)
    best = int(np.lexsort((objective, excess))[0])
    one = jax.tree.map(lambda x: x[best : best + 1], value)
    size = points.shape[1]
    unknown = Values(one, np.full((1, size), np.nan), np.full((1, size, size), np.nan))
    return points[best : best + 1], unknown

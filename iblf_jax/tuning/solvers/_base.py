"""The contract of a solver, and what a solver knows of the problem that it solves."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.attributes import has_members
from iblf_jax.core.pytree import field_values
from iblf_jax.studies.designs import MAX_RUNS
from iblf_jax.tuning.parameters import Box
from iblf_jax.tuning.robust import worst_count

MODES = ("auto", "forward", "reverse")
SCHEDULES = ("cosine", "constant")
MAX_SHARPENINGS = 60
"""With more, the smoothing is not representable in float32."""
LEARNING_RATES = (1e-12, 1e3)
SAMPLERS = ("tpe", "qmc", "random")
PRESETS = ("filtersqp", "ipopt", "filterslp")
POPULATIONS = (5, 100_000)


class Constraints(NamedTuple):
    """The requirements as constraints of a programme, on the host.

    A requirement consists of pieces: the largest values of a signal in windows of time.  Its excess
    in one run is that of the largest piece.  Its excess G_r over all runs is the mean of the k
    worst runs.
    """

    owner: np.ndarray
    """Index of the requirement that each piece belongs to, (M,)."""
    worst: tuple[int, ...]
    """Number k of worst runs, for each requirement, (R,)."""
    runs: int
    """Number B of runs."""
    largest_only: bool = False
    """Whether the violation is the largest excess of all requirements, and not their sum."""

    @staticmethod
    def of(counts: Sequence[int], shares: Sequence[float], runs: int) -> Constraints:
        """The constraints from the number of pieces of each requirement and the share of the runs
        that may violate it.
        """
        owner = np.repeat(np.arange(len(counts)), counts)
        return Constraints(owner, tuple(worst_count(runs, share) for share in shares), runs)

    def pieces_of(self, requirement: int) -> np.ndarray:
        """Indices of the pieces of a requirement."""
        return np.flatnonzero(self.owner == requirement)

    def violation(self, excess: np.ndarray) -> float:
        """The violation from the excess of each requirement, (R,)."""
        positive = np.maximum(excess, 0.0)
        if self.largest_only:
            return float(np.max(positive, initial=0.0))
        return float(np.sum(positive))

    def excess(self, pieces: np.ndarray) -> np.ndarray:
        """G_r, (R,), from the pieces' values, (B, M)."""
        found = np.zeros(len(self.worst))
        for r, k in enumerate(self.worst):
            own = pieces[:, self.owner == r]
            if k == 1:
                found[r] = own.max()
            else:
                found[r] = np.sort(own.max(axis=1))[-k:].mean()
        return found


class SearchSpace(NamedTuple):
    """What a solver knows of a problem."""

    box: Box
    """Start and range of the coordinates z: logarithms of positive gains, other numbers as they
    are."""
    constraints: Constraints = Constraints(np.zeros(0, int), (), 1)
    multimodal: bool = False
    """Whether several local minima are expected."""
    iterations: int = 60
    """Largest number of steps of the search, for schedules."""


class Value(NamedTuple):
    """A problem at one z."""

    loss: Any
    """L, infinite where a run was invalid."""
    objective: Any = ()
    """f without smoothing: what results are compared by."""
    terms: Any = ()
    """Each unweighted term without smoothing, averaged over the runs, on a front combined by the
    risk, (n_terms,)."""
    smooth_excess: Any = ()
    """G_r from the smooth quantities, (n_requirements,)."""
    exact_excess: Any = ()
    """G_r from the exact quantities, (n_requirements,)."""
    margin: Any = ()
    """The smallest margin of all runs [rad]."""
    valid: Any = ()
    trusted: Any = ()
    """Share of the runs that were integrated to their end, and stably; 1 where valid."""


class Derivatives(NamedTuple):
    """A problem at one z, with derivatives."""

    value: Value
    gradient: Any
    hessian: Any
    """Gauss-Newton approximation, (p, p)."""
    pieces: Any = ()
    """g of each piece of each requirement in each run, (B, M), one requirement after the other;
    levels last, and in the first run only."""
    piece_gradients: Any = ()
    """Their gradients, (B, p, M)."""


class Evaluation(Protocol):
    """A problem as a function of coordinates z, (S, p), whose derivatives are NumPy arrays."""

    space: SearchSpace
    """Of this step."""
    active: np.ndarray
    """Which starts are to be advanced, (S,) bool."""

    def __call__(self, z: np.ndarray, /) -> Derivatives:
        """The derivatives at z."""


class Solver(abc.ABC):
    """An algorithm with its options; a frozen dataclass without state of its own.

    It advances S starts together.  The state is any pytree of NumPy arrays, which `step` and
    `restart` may change in place.

    In the phase REPAIR of a search (see `search`) the loss is zero, and
    `space.constraints.largest_only` is true: a solver with the requirements as constraints then
    minimises the largest excess alone.
    """

    name: ClassVar[str]
    """Name of the solver in `SOLVERS`, in files and in results."""
    handles_requirements: ClassVar[bool]
    """Whether requirements are constraints of the solver.  Otherwise the loss is an augmented
    Lagrangian, of which the search updates the multipliers."""
    mode: str
    """Mode of differentiation: "forward", "reverse", or "auto" to let the number of coordinates
    decide."""
    resample: bool
    """Whether the runs are drawn anew at every step."""
    starts: int | None
    """Number of starting points, or None to let the effort of the tuning decide.

    With None, the tuning evaluates many points without derivatives, begins at several of them and
    continues from the best one (see `search`)."""
    tolerance: float
    """Relative change of the loss below which a start has converged."""
    sharpenings: int
    """How often the smoothing of peaks in the objective is divided by 4, each time once the starts
    have converged."""
    patience: int
    """Steps without a better result after which the search or its stage ends."""

    @abc.abstractmethod
    def init(self, space: SearchSpace, z: np.ndarray) -> Any:
        """The state of S starts at z, (S, p), before the first evaluation."""

    @abc.abstractmethod
    def step(
        self, evaluate: Evaluation, state: Any, tolerance: float
    ) -> tuple[np.ndarray, Derivatives]:
        """Advances the active starts by one trial each.

        Args:
          evaluate: the problem.
          state: of `init`, changed in place.
          tolerance: of this step; larger than the solver's own while peaks are still smoothed.

        Returns:
          The trial points (S, p) and their `Derivatives`.
        """

    @abc.abstractmethod
    def converged(self, state: Any) -> np.ndarray:
        """Whether each start has converged or cannot continue, (S,) bool."""

    @abc.abstractmethod
    def restart(
        self, space: SearchSpace, state: Any, start: int, z: np.ndarray | None = None
    ) -> None:
        """Begins one start anew at z, (p,).

        Without z the start continues from where it is.  As the loss has changed, what was stored of
        the former loss, such as curvature, is discarded.
        """


EXCESS_WEIGHT = 200.0
"""Weight of the violation where points are ranked by one number, relative to the objective.  With a
weight of 5 alone, six of eight searches of a problem of nine gains began, and ended, in regions
where the requirements cannot be kept; for the starts see `starts.WEIGHTS`."""


def violations(value: Value) -> np.ndarray:
    """The largest excess at each point of a `Value`, of requirements in their scales and of bounds
    in rad, (N,); 0 at feasible points.
    """
    excess = np.max(value.exact_excess, axis=1, initial=0.0)
    return np.maximum(excess, np.maximum(-value.margin, 0.0))


def _word(name: str, value: str, allowed: tuple[str, ...]) -> str:
    checks.one_of(name, value, allowed)
    return value


def _optimiser(name: str, value: object) -> object:
    """An optimiser of optax, which is a tuple of functions, or None."""
    expected = "an optax.GradientTransformation such as optax.lion(1e-3)"
    if value is not None and not has_members(value, "init", "update"):
        raise checks.fail(name, value, expected)
    return value


CHECKS: dict[str, Any] = {
    "optimiser": _optimiser,
    "batch": lambda name, x: x if x is None else checks.positive_integer(name, x, most=MAX_RUNS),
    "mode": lambda name, x: _word(name, x, MODES),
    "resample": checks.boolean,
    "starts": lambda name, x: None if x is None else checks.positive_integer(name, x),
    "tolerance": lambda name, x: checks.number_between(name, x, 0.0, 1.0, "1"),
    "sharpenings": lambda name, x: checks.positive_integer(name, x, least=0, most=MAX_SHARPENINGS),
    "patience": lambda name, x: checks.positive_integer(name, x, most=checks.MAX_STEPS),
    "learning_rate": lambda name, x: checks.number_between(name, x, *LEARNING_RATES, "1"),
    "schedule": lambda name, x: _word(name, x, SCHEDULES),
    "memory": lambda name, x: checks.positive_integer(name, x, most=1000),
    "line_steps": lambda name, x: checks.positive_integer(name, x, most=1000),
    "radius": lambda name, x: None if x is None else checks.positive_number(name, x, "1"),
    "population": lambda name, x: checks.positive_integer(
        name, x, least=POPULATIONS[0], most=POPULATIONS[1]
    ),
    "step_size": lambda name, x: checks.positive_number(name, x, "1"),
    "reach": lambda name, x: checks.positive_number(name, x, "1"),
    "seed": lambda name, x: checks.seed(x, name),
    "sampler": lambda name, x: _word(name, x, SAMPLERS),
    "preset": lambda name, x: _word(name, x, PRESETS),
}
"""Option -> function of its name and value that returns the value in its type, or raises
ValueError."""


def check_options(options: object) -> None:
    """Checks the fields of a frozen dataclass of options, and converts them to their types."""
    for name, value in field_values(options).items():
        object.__setattr__(options, name, CHECKS[name](name, value))


def where_rows(mask: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """Rows of `new` where the mask, (S,), is true, of `old` otherwise."""
    return np.where(mask.reshape((-1,) + (1,) * (np.ndim(new) - 1)), new, old)

"""Adam with a schedule, by the steps of `optax_steps`.

It suits many parameters (reverse mode), mini-batches and runs that are drawn anew at every step;
for few gains `sqp` needs fewer rollouts.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import optax

from iblf_jax.tuning.solvers import optax_steps
from iblf_jax.tuning.solvers._base import SearchSpace, Solver, check_options

if TYPE_CHECKING:
    pass

FINAL_RATE = 0.02
"""Last learning rate of the cosine schedule, relative to the first."""


@dataclasses.dataclass(frozen=True)
class Adam(Solver):
    """Adam; requirements are penalties.  `Optax` takes any other optimiser.

    Args:
      learning_rate: in the squashed coordinates.
      schedule: "cosine", down to 2 % over the iterations, or "constant".
      batch: number of the runs that a step evaluates, as `Optax.batch`; all of them if not given.
      resample: whether the runs are drawn anew at every step; otherwise they are the same.
      mode: "forward", "reverse", or "auto": forward up to 32 numbers.
      starts: number of starting points.
      patience: steps without a better result after which the search ends.
      tolerance: relative change of the objective that counts as a better result.
    """

    learning_rate: float = 0.1
    schedule: str = "cosine"
    resample: bool = False
    mode: str = "auto"
    starts: int = 1
    patience: int = 15
    tolerance: float = 1e-5
    batch: int | None = None
    name: ClassVar[str] = "adam"
    handles_requirements: ClassVar[bool] = False
    sharpenings = 0

    def __post_init__(self) -> None:
        check_options(self)

    def transformation(self, iterations: int) -> optax.GradientTransformation:
        """Adam of optax, with the schedule of a search of so many steps."""
        if self.schedule == "constant":
            return optax.adam(self.learning_rate)
        schedule = optax.cosine_decay_schedule(self.learning_rate, iterations, FINAL_RATE)
        return optax.adam(schedule)

    def init(self, space: SearchSpace, z: np.ndarray) -> dict[str, Any]:
        """As `Solver.init`."""
        return optax_steps.init(self, space, z)

    def step(
        self, evaluate: Any, state: dict[str, Any], tolerance: float
    ) -> tuple[np.ndarray, Any]:
        """As `Solver.step`."""
        return optax_steps.step(self, evaluate, state)

    def restart(
        self, space: SearchSpace, state: dict[str, Any], start: int, z: np.ndarray | None = None
    ) -> None:
        """As `Solver.restart`; a change of the loss makes nothing in the state wrong."""
        optax_steps.restart(self, space, state, start, z)

    def converged(self, state: dict[str, Any]) -> np.ndarray:
        """Never: Adam ends by the number of iterations, or without a better result."""
        return np.zeros(len(state["w"]), bool)

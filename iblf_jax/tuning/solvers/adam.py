"""Adam with a schedule, by optax, on coordinates that are squashed into the box.

It suits many parameters (reverse mode) and runs that are drawn anew at every step; for few gains
`sqp` needs fewer rollouts.  A step to a point with an invalid run is rejected: the start goes back
to its last valid point, and its rate stays halved.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from iblf_jax.tuning.parameters import squashed, unsquash
from iblf_jax.tuning.solvers._base import Optimality, SearchSpace, check_options

FINAL_RATE = 0.02
"""Last learning rate of the cosine schedule, relative to the first."""


@dataclasses.dataclass(frozen=True)
class Adam:
    """Adam; requirements are penalties.

    Args:
      learning_rate: in the squashed coordinates.
      schedule: "cosine", down to 2 % over the iterations, or "constant".
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
    name: ClassVar[str] = "adam"
    handles_requirements: ClassVar[bool] = False
    traces_evaluation: ClassVar[bool] = False
    sharpenings: ClassVar[int] = 0

    def __post_init__(self) -> None:
        check_options(self)

    def _optimiser(self, iterations: int) -> optax.GradientTransformation:
        if self.schedule == "constant":
            return optax.adam(self.learning_rate)
        schedule = optax.cosine_decay_schedule(self.learning_rate, iterations, FINAL_RATE)
        return optax.adam(schedule)

    def init(self, space: SearchSpace, z: np.ndarray) -> dict[str, Any]:
        """As `Solver.init`."""
        w = np.stack([unsquash(x, space.box) for x in z])
        inner = jax.vmap(self._optimiser(space.iterations).init)(jnp.asarray(w))
        return {
            "w": w,
            "last_valid": w.copy(),
            "inner": jax.tree.map(np.array, inner),
            "rate": np.ones(len(z)),
        }

    def restart(
        self, space: SearchSpace, state: dict[str, Any], start: int, z: np.ndarray | None = None
    ) -> None:
        """As `Solver.restart`; a change of the loss makes nothing in the state wrong."""
        if z is not None:
            new = self.init(space, z[None])
            jax.tree.map(lambda old, x: old.__setitem__(start, x[0]), state, new)

    def converged(self, state: dict[str, Any]) -> np.ndarray:
        """Never: Adam ends by the number of iterations, or without a better result."""
        return np.zeros(len(state["w"]), bool)

    def optimality(self, state: dict[str, Any], start: int) -> Optimality | None:
        """None."""
        return None

    def step(
        self, evaluate: Any, state: dict[str, Any], tolerance: float
    ) -> tuple[np.ndarray, Any]:
        """As `Solver.step`."""
        space = evaluate.space
        z, pull = squashed(space.box, state["w"])
        found = evaluate(z)
        gradient = pull(found.gradient)
        valid = np.isfinite(found.value.loss) & np.all(np.isfinite(gradient), axis=1)
        finite = jnp.asarray(np.where(valid[:, None], gradient, 0.0))
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of several types
            move, inner = _update(finite, state["inner"], self, space.iterations)
        state["inner"] = jax.tree.map(partial(_where_rows, valid), inner, state["inner"])
        state["rate"] = np.where(valid, state["rate"], 0.5 * state["rate"])
        state["last_valid"] = _where_rows(valid, state["w"], state["last_valid"])
        forward = state["w"] + state["rate"][:, None] * np.asarray(move)
        back = 0.5 * (state["w"] + state["last_valid"])
        state["w"] = _where_rows(valid, forward, back)
        return z, found


@partial(jax.jit, static_argnums=(2, 3))
def _update(gradient: jax.Array, inner: Any, solver: Adam, iterations: int) -> Any:
    return jax.vmap(solver._optimiser(iterations).update)(gradient, inner)


def _where_rows(mask: np.ndarray, new: Any, old: Any) -> np.ndarray:
    """Rows of `new` where the mask, (S,), is true, of `old` otherwise."""
    return np.where(mask.reshape((-1,) + (1,) * (np.ndim(new) - 1)), new, old)

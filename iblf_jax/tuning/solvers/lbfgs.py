"""L-BFGS with a zoom line search, by optax, on coordinates that are squashed into the box.

It suits many parameters (reverse mode); for few gains `sqp` needs fewer rollouts.  The line search
takes the loss of a point with an invalid run for very large.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from iblf_jax.tuning.parameters import squash, squashed, unsquash
from iblf_jax.tuning.solvers._base import Optimality, SearchSpace, check_options

INVALID_LOSS = 1e6
"""What a line search gets in place of an infinite loss."""


@dataclasses.dataclass(frozen=True)
class LBFGS:
    """L-BFGS; requirements are penalties.

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
    traces_evaluation: ClassVar[bool] = True
    resample: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_options(self)

    def init(self, space: SearchSpace, z: np.ndarray) -> dict[str, Any]:
        """As `Solver.init`."""
        w = np.stack([unsquash(x, space.box) for x in z])
        inner = jax.vmap(_optimiser(self.memory, self.line_steps).init)(jnp.asarray(w))
        return {
            "w": w,
            "inner": jax.tree.map(np.array, inner),
            "loss": np.full(len(z), np.inf),
            "done": np.zeros(len(z), bool),
        }

    def restart(
        self, space: SearchSpace, state: dict[str, Any], start: int, z: np.ndarray | None = None
    ) -> None:
        """As `Solver.restart`; forgets curvature and line search."""
        if z is not None:
            state["w"][start] = unsquash(z, space.box)
        w = jnp.asarray(state["w"][start])
        _set_row(state["inner"], start, _optimiser(self.memory, self.line_steps).init(w))
        state["done"][start] = False

    def converged(self, state: dict[str, Any]) -> np.ndarray:
        """As `Solver.converged`."""
        return state["done"].copy()

    def optimality(self, state: dict[str, Any], start: int) -> Optimality | None:
        """None."""
        return None

    def step(
        self, evaluate: Any, state: dict[str, Any], tolerance: float
    ) -> tuple[np.ndarray, Any]:
        """One line search of every active start, as `Solver.step`."""
        box = evaluate.space.box
        for s in np.flatnonzero(evaluate.active).tolist():
            problem, candidate = evaluate.row(s)
            w, inner = _line_search(
                problem,
                candidate,
                box,
                jnp.asarray(state["w"][s]),
                jax.tree.map(lambda x, s=s: jnp.asarray(x[s]), state["inner"]),
                derivatives=evaluate.derivatives,
                memory=self.memory,
                line_steps=self.line_steps,
            )
            evaluate.evaluations += int(np.asarray(optax.tree.get(inner, "num_linesearch_steps")))
            _set_row(state["inner"], s, inner)
            state["w"][s] = np.asarray(w)
        z, _ = squashed(box, state["w"])
        found = evaluate(z)
        change = np.abs(state["loss"] - found.value.loss)
        small = change < tolerance * np.maximum(1e-3, np.abs(found.value.loss))
        state["done"] = np.where(evaluate.active, small, state["done"])
        state["loss"] = np.array(found.value.loss)
        return z, found


def _optimiser(memory: int, line_steps: int) -> optax.GradientTransformationExtraArgs:
    search = optax.scale_by_zoom_linesearch(
        max_linesearch_steps=line_steps, initial_guess_strategy="one"
    )
    return optax.lbfgs(memory_size=memory, linesearch=search)


@partial(jax.jit, static_argnames=("derivatives", "memory", "line_steps"))
def _line_search(
    problem: Any,
    candidate: Any,
    box: Any,
    w: jax.Array,
    inner: Any,
    *,
    derivatives: Any,
    memory: int,
    line_steps: int,
) -> tuple[jax.Array, Any]:
    """One line search of one start; `candidate` has one row."""
    optimiser = _optimiser(memory, line_steps)

    def loss_and_gradient(w: jax.Array) -> tuple[jax.Array, jax.Array]:
        z, pull = jax.vjp(partial(squash, box=box), w)
        found = derivatives(problem, candidate._replace(z=z[None]))
        loss = found.value.loss[0]
        gradient = pull(found.gradient[0])[0]
        valid = jnp.isfinite(loss) & jnp.all(jnp.isfinite(gradient))
        return jnp.where(valid, loss, INVALID_LOSS), jnp.where(valid, gradient, 0.0)

    @jax.custom_jvp
    def loss(w: jax.Array) -> jax.Array:
        return loss_and_gradient(w)[0]

    @loss.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        value, gradient = loss_and_gradient(*primals)
        return value, gradient @ tangents[0]

    value, gradient = optax.value_and_grad_from_state(loss)(w, state=inner)
    with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of several types
        move, inner = optimiser.update(
            gradient, inner, w, value=value, grad=gradient, value_fn=loss
        )
    return optax.apply_updates(w, move), inner


def _set_row(tree: Any, row: int, values: Any) -> None:
    """Writes one start's values into arrays that have the starts first."""
    jax.tree.map(lambda old, new: old.__setitem__(row, np.asarray(new)), tree, values)

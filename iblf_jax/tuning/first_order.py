"""The methods of optax: adam with a schedule, and L-BFGS with its line search, on coordinates that
are squashed into the box.

A step to where a run is invalid is rejected: adam goes back to where it was and halves its rate,
  for good; the line search of L-BFGS
takes the loss there for very large.  They suit many parameters (reverse mode) and runs that are
drawn anew at every step; for few gains `newton` needs fewer rollouts.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from iblf_jax.tuning.parameters import Box, squash, unsquash

INVALID_LOSS = 1e6
"""What a line search sees in place of an infinite loss."""


def squashed(box: Box, w: np.ndarray):
    """Squashed coordinates z, row by row, and the function that takes a gradient by z to one by
    w.
    """
    z, pull = jax.vjp(jax.vmap(partial(squash, box=box)), jnp.asarray(w))
    return np.asarray(z), lambda g: np.asarray(pull(jnp.asarray(g, z.dtype))[0])


class Adam:
    """Adam for S starts at once, with a cosine schedule; its state is a dict of arrays."""

    converges = False
    penalised = True

    def __init__(
        self, box: Box, iterations: int, learning_rate: float = 0.1, schedule: str = "cosine"
    ):
        self.box = box
        rate = (
            optax.cosine_decay_schedule(learning_rate, iterations, 0.02)
            if schedule == "cosine"
            else learning_rate
        )
        self.optimiser = optax.adam(rate)
        self.update = jax.jit(jax.vmap(self.optimiser.update))

    def init(self, z: np.ndarray) -> dict[str, Any]:
        """The state before the first step."""
        w = np.stack([unsquash(x, self.box) for x in z])
        inner = jax.tree.map(np.asarray, jax.vmap(self.optimiser.init)(jnp.asarray(w)))
        starts = len(z)
        return {
            "w": w,
            "safe": w.copy(),
            "inner": inner,
            "slower": np.ones(starts),
            "done": np.zeros(starts, bool),
        }

    def restart(self, state, start: int) -> None:
        """Nothing is kept that a change of the loss would make wrong."""

    def step(self, evaluate: Any, state):
        """Evaluates, moves, and goes back where the last move made a run invalid.

        Args and returns as `Newton.step`.
        """
        z, pull = squashed(self.box, state["w"])
        found = evaluate(z)
        gradient = pull(found.gradient)
        valid = np.isfinite(found.value.loss) & np.all(np.isfinite(gradient), axis=1)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of several types
            move, inner = self.update(
                jnp.asarray(np.where(valid[:, None], gradient, 0.0)), state["inner"]
            )
        keep = jax.tree.map(
            lambda new, old: np.where(valid.reshape((-1,) + (1,) * (np.ndim(new) - 1)), new, old),
            inner,
            state["inner"],
        )
        state["inner"] = jax.tree.map(np.asarray, keep)
        state["slower"] = np.where(valid, state["slower"], 0.5 * state["slower"])
        state["safe"] = np.where(valid[:, None], state["w"], state["safe"])
        back = 0.5 * (state["w"] + state["safe"])
        state["w"] = np.where(
            valid[:, None], state["w"] + state["slower"][:, None] * np.asarray(move), back
        )
        return z, found


class LBFGS:
    """L-BFGS of optax with its zoom line search, one start after another; its state is a dict of
    arrays.
    """

    converges = True
    penalised = True

    def __init__(self, box: Box, tolerance: float = 1e-6, memory: int = 10, line_steps: int = 12):
        self.box, self.tolerance = box, tolerance
        search = optax.scale_by_zoom_linesearch(
            max_linesearch_steps=line_steps, initial_guess_strategy="one"
        )
        self.optimiser = optax.lbfgs(memory_size=memory, linesearch=search)
        self.compiled = jax.jit(self._search, static_argnames=("derive",))

    def init(self, z: np.ndarray) -> dict[str, Any]:
        """The state before the first step."""
        w = np.stack([unsquash(x, self.box) for x in z])
        inner = jax.tree.map(np.array, jax.vmap(self.optimiser.init)(jnp.asarray(w)))
        return {
            "w": w,
            "inner": inner,
            "loss": np.full(len(z), np.inf),
            "done": np.zeros(len(z), bool),
        }

    def restart(self, state, start: int) -> None:
        """Forget curvature and line search of one start."""
        _put(state["inner"], self.optimiser.init(jnp.asarray(state["w"][start])), start)
        state["done"][start] = False

    def retire(self, state, start: int) -> None:
        """No more line searches from one start."""
        state["done"][start] = True

    def _search(self, shared, lanes, w, inner, *, derive):
        """One line search for one start; lanes has one row."""

        def both(w):
            z, pull = jax.vjp(partial(squash, box=self.box), w)
            found = derive(shared, lanes._replace(z=z[None]))
            loss, gradient = found.value.loss[0], pull(found.gradient[0])[0]
            valid = jnp.isfinite(loss) & jnp.all(jnp.isfinite(gradient))
            return jnp.where(valid, loss, INVALID_LOSS), jnp.where(valid, gradient, 0.0)

        @jax.custom_jvp
        def loss(w):
            return both(w)[0]

        @loss.defjvp
        def _(primals, tangents):
            value, gradient = both(*primals)
            return value, gradient @ tangents[0]

        value, gradient = optax.value_and_grad_from_state(loss)(w, state=inner)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of several types
            move, inner = self.optimiser.update(
                gradient, inner, w, value=value, grad=gradient, value_fn=loss
            )
        return optax.apply_updates(w, move), inner

    def step(self, evaluate: Any, state):
        """One line search for every start; args and returns as `Newton.step`."""
        for s in np.flatnonzero(~state["done"]).tolist():
            shared, lanes = evaluate.row(s)
            inner = jax.tree.map(lambda x, s=s: jnp.asarray(x[s]), state["inner"])
            w, inner = self.compiled(
                shared, lanes, jnp.asarray(state["w"][s]), inner, derive=evaluate.derive
            )
            evaluate.evaluations += int(np.asarray(optax.tree.get(inner, "num_linesearch_steps")))
            _put(state["inner"], inner, s)
            state["w"][s] = np.asarray(w)
        z, _ = squashed(self.box, state["w"])
        found = evaluate(z)
        drop = state["loss"] - found.value.loss
        state["done"] |= np.abs(drop) < self.tolerance * np.maximum(1e-3, np.abs(found.value.loss))
        state["loss"] = np.array(found.value.loss)
        return z, found


def _put(tree: Any, row: Any, index: int) -> None:
    """Writes one row into arrays that have the starts first."""

    def write(old, new):
        old[index] = np.asarray(new)
        return old

    jax.tree.map(write, tree, row)

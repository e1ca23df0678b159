"""The default method for few gains: Gauss-Newton in a box, corrected by what it has seen, inside a trust region.

At z the loss is modelled by L + g.s + s.B.s/2 with B = N + A: N is the Gauss-Newton matrix of this point, which forward mode gives
for nothing, and A makes up for what it leaves out (the second derivatives of the motion), by the symmetric rank-one update

    A <- A + r r^T / (r.s),      r = (g_new - g) - B s,

also after steps that are rejected.  The step minimises the model over |s_i| <= delta and the limits of the gains; delta grows and
shrinks with how well the model foretold the loss.  A trial that makes a run invalid has an infinite loss, so it is rejected and
delta shrinks: numbers that are not finite never reach z.

Source: J. E. Dennis, D. M. Gay, R. E. Welsch, ACM Trans. Math. Softw. 7 (1981) 348-368 (structured secant updates);
A. R. Conn, N. I. M. Gould, P. L. Toint, Math. Program. 50 (1991) 177-195 (rank-one updates in trust regions).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from iblf_jax.tuning.parameters import Box

FIRST_RADIUS = 1.0
"""|s_i| of the first step: a factor e for a gain."""
LARGEST_RADIUS = 4.0
FLATTEST = 1e-6
"""Smallest eigenvalue of the model's matrix, relative to its largest."""


def box_step(gradient: np.ndarray, matrix: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """The step in [low, high] that minimises g.s + s.B.s/2, B made positive definite; and by how much that lowers the model."""
    size, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    size = np.maximum(size, FLATTEST * max(float(np.max(np.abs(size))), 1e-12))
    root = np.sqrt(size)[:, None] * vectors.T
    target = -(vectors.T @ gradient) / np.sqrt(size)
    low, high = np.minimum(low, -1e-14), np.maximum(high, 1e-14)
    step = np.clip(lsq_linear(root, target, (low, high), method="bvls").x, low, high)
    return step, -float(gradient @ step + 0.5 * np.sum((root @ step) ** 2))


class Newton:
    """The method, for S starts at once; its state is a dict of arrays."""

    converges = True
    """Whether it knows by itself when it is done."""

    def __init__(self, box: Box, tolerance: float = 1e-6, radius: float = FIRST_RADIUS):
        self.box, self.tolerance, self.radius = box, tolerance, radius

    def init(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """The state before the first evaluation."""
        starts, size = z.shape
        square = np.zeros((starts, size, size))
        return {
            "z": z.copy(),
            "loss": np.full(starts, np.inf),
            "gradient": np.zeros_like(z),
            "matrix": square,
            "secant": square.copy(),
            "radius": np.full(starts, self.radius),
            "fresh": np.zeros(starts, bool),
            "done": np.zeros(starts, bool),
        }

    def restart(self, state: dict[str, np.ndarray], start: int) -> None:
        """After a change of the loss: evaluate again at the same z before the next step."""
        state["fresh"][start], state["done"][start] = False, False
        state["secant"][start] = 0.0
        state["radius"][start] = max(state["radius"][start], 0.1 * self.radius)

    def retire(self, state: dict[str, np.ndarray], start: int) -> None:
        """One start is given up: no more trials."""
        state["done"][start] = True

    def step(self, evaluate: Any, state: dict[str, np.ndarray]):
        """One trial for every start.

        Args:
          evaluate: function of z (S, p) -> `Slope` as NumPy arrays.
          state: changed in place.

        Returns:
          The trials (S, p) and what they gave.
        """
        plans = [self._plan(state, s) for s in range(len(state["z"]))]
        trial = np.stack([z for z, _ in plans])
        found = evaluate(trial)
        for s, (_, foretold) in enumerate(plans):
            self._judge(state, s, trial[s], foretold, found)
        return trial, found

    def _plan(self, state, s: int) -> tuple[np.ndarray, float]:
        """The next trial of one start, and what the model foretells; the point itself where there is no model yet."""
        z = state["z"][s]
        if not state["fresh"][s] or not np.isfinite(state["loss"][s]) or state["done"][s]:
            return z, 0.0
        reach = state["radius"][s]
        low, high = np.maximum(self.box.low - z, -reach), np.minimum(self.box.high - z, reach)
        step, foretold = box_step(state["gradient"][s], state["matrix"][s] + state["secant"][s], low, high)
        return np.clip(z + step, self.box.low, self.box.high), foretold

    def _judge(self, state, s: int, trial: np.ndarray, foretold: float, found) -> None:
        loss, gradient, matrix = (float(found.value.loss[s]), found.gradient[s], found.hessian[s])
        valid = np.isfinite(loss) and np.all(np.isfinite(gradient)) and np.all(np.isfinite(matrix))
        if state["done"][s]:
            return
        if not state["fresh"][s]:
            state["fresh"][s] = True
            if valid:
                state["loss"][s], state["gradient"][s], state["matrix"][s] = loss, gradient, matrix
            state["done"][s] = not valid
            return
        step = trial - state["z"][s]
        gain = (state["loss"][s] - loss) / foretold if valid and foretold > 0 else -np.inf
        if valid:
            self._learn(state, s, step, gradient)
        if gain > 1e-4:
            state["z"][s], state["loss"][s], state["gradient"][s], state["matrix"][s] = trial, loss, gradient, matrix
        size = float(np.max(np.abs(step)))
        if gain < 0.25:
            state["radius"][s] = 0.4 * size
        elif gain > 0.7 and size > 0.9 * state["radius"][s]:
            state["radius"][s] = min(2 * state["radius"][s], LARGEST_RADIUS)
        small = self.tolerance * max(1e-3, abs(state["loss"][s]))
        state["done"][s] = foretold < small or size < 1e-7

    def _learn(self, state, s: int, step: np.ndarray, gradient: np.ndarray) -> None:
        """The symmetric rank-one update of the secant part."""
        error = gradient - state["gradient"][s] - (state["matrix"][s] + state["secant"][s]) @ step
        along = float(error @ step)
        if abs(along) > 1e-8 * np.linalg.norm(error) * np.linalg.norm(step):
            state["secant"][s] += np.outer(error, error) / along

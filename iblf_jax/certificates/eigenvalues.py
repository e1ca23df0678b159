"""The eigenvalues of the mass matrix over the admissible box of joint positions.

rho (3.19), (3.27) contains lambda_max(M0), and (3.23), (3.31) contain lambda_min(M0). Along one run
they are known. Before it, they must be taken over every position that the bounds admit, the box
min_t k_lc < q < max_t k_uc. The maximum of an eigenvalue over a box has no closed form for a
general arm: `eigenvalues_over` searches a grid (up to 3 joints) or a Sobol sequence (more), and
improves the best points by projected quasi-Newton steps. It reports what it searched.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.world.robots import Robot

BATCH_SIZE = 512
"""Positions whose eigenvalues are computed together; bounds the memory."""
POINTS_PER_AXIS = {1: 257, 2: 65, 3: 21}
"""Points of the grid per axis, by number of joints."""
SOBOL_POINTS = 4096
REFINED_POINTS = 4
"""Number of the best points that are improved."""


class Extremes(NamedTuple):
    """Extreme eigenvalues of M0 over a box [kg m^2], their positions, and what was searched."""

    lambda_min: float
    lambda_max: float
    q_min: np.ndarray
    q_max: np.ndarray
    searched: str


@jax.jit
@partial(jax.value_and_grad, argnums=1)
def _with_gradient(robot: Robot, q: jax.Array, sign: int) -> jax.Array:
    """lambda_max(M0) for sign 1, -lambda_min(M0) for sign -1, and its gradient by q."""
    eigenvalues = jnp.linalg.eigvalsh(robot.mass_matrix(q))
    return jnp.where(sign > 0, eigenvalues[-1], -eigenvalues[0])


@jax.jit
def _eigenvalues(robot: Robot, points: jax.Array) -> jax.Array:
    """Eigenvalues of M0 at each point, ascending, (m, n)."""
    return jax.lax.map(
        lambda q: jnp.linalg.eigvalsh(robot.mass_matrix(q)), points, batch_size=BATCH_SIZE
    )


def maximise(
    value_and_gradient, start: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[float, np.ndarray]:
    """A local maximum of a function over a box, by projected quasi-Newton ascent (L-BFGS-B)."""
    from scipy.optimize import minimize

    def negative(x):
        value, gradient = value_and_gradient(x)
        return -float(value), -np.asarray(gradient, float)

    found = minimize(
        negative,
        np.asarray(start, float),
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
    )
    return -float(found.fun), np.clip(found.x, low, high)


def points_in(low: np.ndarray, high: np.ndarray, *, seed: int = 0) -> tuple[np.ndarray, str]:
    """Points that fill a box, (m, n), and their description."""
    from scipy.stats import qmc

    n = low.size
    if n in POINTS_PER_AXIS:
        axes = [np.linspace(a, b, POINTS_PER_AXIS[n]) for a, b in zip(low, high, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, n)
        return points, f"{len(points)} grid points"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        unit = qmc.Sobol(n, seed=seed).random(SOBOL_POINTS)
    return low + (high - low) * unit, f"{SOBOL_POINTS} Sobol points"


def eigenvalues_over(robot: Robot, low: np.ndarray, high: np.ndarray) -> Extremes:
    """lambda_min and lambda_max of M(q) for q in a box.

    Args:
      robot: the model, of n joints.
      low, high: the box, (n,) [rad].
    """
    dtype = jax.eval_shape(robot.mass_matrix, jnp.asarray(low)).dtype
    low, high = np.asarray(low, float), np.asarray(high, float)
    points, description = points_in(low, high)
    eigenvalues = np.asarray(_eigenvalues(robot, points.astype(dtype)), float)

    def largest(sign: int, values: np.ndarray) -> tuple[float, np.ndarray]:
        """The largest of sign * eigenvalue over the box: the best point, or an improvement."""
        best = np.argsort(values)[::-1][:REFINED_POINTS]
        improved = [
            maximise(lambda x: _with_gradient(robot, np.asarray(x, dtype), sign), start, low, high)
            for start in points[best]
        ]
        on_grid = (float(values.max()), points[np.argmax(values)])
        return max([*improved, on_grid], key=lambda pair: pair[0])

    lambda_max, q_max = largest(1, eigenvalues[:, -1])
    negative_min, q_min = largest(-1, -eigenvalues[:, 0])
    searched = f"{description}, the best {REFINED_POINTS} improved by L-BFGS-B"
    return Extremes(-negative_min, lambda_max, q_min, q_max, searched)

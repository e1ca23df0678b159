"""The eigenvalues of the mass matrix over the admissible box of joint positions.

rho (3.19), (3.27) holds lambda_max(M0), and (3.23), (3.31) hold lambda_min(M0).  Along one run they
are known; before it, they must be taken over every position that the bounds admit, the box  min_t
k_lc < q < max_t k_uc.  The maximum of an eigenvalue over a box has no closed form for a general
arm: a grid (up to 3 joints) or a Sobol set (more) is searched, and the best points are improved by
  projected quasi-Newton steps.  What was searched is said in words beside the number.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.engine.plan import CERTIFY_TOGETHER
from iblf_jax.world.robots import Robot

GRID = {1: 257, 2: 65, 3: 21}
"""Points an axis, by number of joints."""
SOBOL_POINTS = 4096
REFINED = 4
"""How many of the best points are improved."""


class Extremes(NamedTuple):
    """Eigenvalues of M0 over a box [kg m^2], where they are taken, and what was searched."""

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
def _both_ends(robot: Robot, points: jax.Array) -> jax.Array:
    return jax.lax.map(
        lambda q: jnp.linalg.eigvalsh(robot.mass_matrix(q)), points, batch_size=CERTIFY_TOGETHER
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
    """Points that fill a box, (m, n), and in words how they were laid."""
    from scipy.stats import qmc

    n = low.size
    if n in GRID:
        axes = [np.linspace(a, b, GRID[n]) for a, b in zip(low, high, strict=True)]
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
    points, words = points_in(low, high)
    ends = np.asarray(_both_ends(robot, points.astype(dtype)), float)
    found = {}
    for sign, values in ((1, ends[:, -1]), (-1, -ends[:, 0])):
        starts = points[np.argsort(values)[::-1][:REFINED]]
        tries = [
            maximise(
                lambda x, s=sign: _with_gradient(robot, np.asarray(x, dtype), s), start, low, high
            )
            for start in starts
        ]
        found[sign] = max(
            [*tries, (float(values.max()), points[np.argmax(values)])], key=lambda pair: pair[0]
        )
    searched = f"{words}, the best {REFINED} improved by L-BFGS-B"
    return Extremes(-found[-1][0], found[1][0], found[-1][1], found[1][1], searched)

"""What a proof of a level set needs of a family of plants: coordinates, bounds and points."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

PARTS_OF_TIME = 32
"""Parts of the time interval, each of which is searched on its own: over a long part a tube may
have no positive width, so that no bisection would be better than another."""


class LevelState(NamedTuple):
    """A point of the level set in physical numbers."""

    t: float
    """[s]."""
    q: np.ndarray
    """Position, (n,) [rad]."""
    dq: np.ndarray
    """Velocity, (n,) [rad/s]."""
    f_tilde: np.ndarray
    """Error of the observer's estimate, (n,) [N m]."""
    f_hat: np.ndarray
    """The estimate, (n,) [N m]."""
    eta: np.ndarray
    """State of the observer, (n,) [N m]."""
    parameters: dict[str, float]
    """Path of each uncertain entry -> its value."""
    rate: np.ndarray
    """Rate of the further disturbance, (n,) [N m/s]; (0,) if there is none."""


def length_of_part(duration: float) -> float:
    """The length of each part of a time interval, () [s]: parts overlap by more than the rounding
    of their starts.
    """
    return duration / PARTS_OF_TIME * (1.0 + 1e-9)


def patterns_of(signs: int, duration: float) -> np.ndarray:
    """The signs of the errors and the start of each part of the time interval, (p, signs + 1)."""
    sides = itertools.product((-1.0, 1.0), repeat=signs)
    starts = np.arange(PARTS_OF_TIME) * (duration / PARTS_OF_TIME)
    return np.array([[*side, start] for side in sides for start in starts])


def random_points(
    seed: int, count: int, duration: float, terms: int, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Random points (t, s, z), (count, 1 + terms + m); every second one has its parameters at a
    corner.

    Args:
      seed: of the points.
      count: their number.
      duration: length of the time interval [s].
      terms: length of s.
      low: least z, (m,).
      high: greatest z, (m,).
    """
    generator = np.random.default_rng(seed)
    t = generator.uniform(0.0, duration, (count, 1))
    s = generator.normal(size=(count, terms))
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    share = generator.uniform(size=(count, len(low)))
    share[::2] = np.round(share[::2])
    return np.concatenate([t, s, low + share * (high - low)], axis=1)


@dataclasses.dataclass(frozen=True, eq=False)
class LevelSetProblem:
    """Is V_w' < 0 at every point of V_w = level, at every time and for all parameters of a box?

    A box is one of coordinates x = (`lower`, `upper`) together with a row of `patterns`, which are
    the last coordinates and are not divided.  `bound(x, constants)` returns upper bounds of V_w'
    over a box, of which one must be negative, (k,), and numbers of which one is positive if the box
    holds no point of the level set, (0,) here.

    A point is a vector (t, s, z) with s of any length: s/|s| divides the level among the terms
    of V_w, and z are the parameters.
    """

    names: tuple[str, ...]
    """Of the coordinates and of the patterns."""
    lower: np.ndarray
    upper: np.ndarray
    patterns: np.ndarray
    bound: Callable
    """A hashable function (x, constants) for `search.search`."""
    constants: Callable[[float, float], list[np.ndarray]]
    """The constants of a weight w_f and a level; ValueError for a level that is not admissible."""
    point_rate: Callable[[jax.Array, Any], jax.Array]
    """V_w' at a point in plain floating-point numbers, to be compiled and differentiated."""
    sample: Callable[[int, int], np.ndarray]
    """Random points from a seed and their number, (count, p): half of them with parameters at the
    corners."""
    state_of: Callable[[Any, Any], LevelState]
    """A point in physical numbers."""
    scenario_at: Callable[[Any, Any], Any]
    """The scenario whose run starts at a point."""
    scales: dict[str, tuple[float, float]]
    """Path of each uncertain entry -> its least and its greatest value."""
    duration: float
    """Length of the time interval of the proof [s]."""
    is_period: bool
    """Whether the time interval is a period, so that the proof is for all times."""
    assumptions: tuple[str, ...]
    """What was assumed, as sentences."""

    def rate(self, points: Any, constants: Any) -> np.ndarray:
        """V_w' at points, (count, p) -> (count,) [N m rad/s], in plain floating-point numbers."""
        with jax.enable_x64(True):
            return np.asarray(_rates(self.point_rate, np.asarray(points, float), list(constants)))


@partial(jax.jit, static_argnums=0)
def _rates(point_rate: Callable, points: Any, constants: Any) -> jax.Array:
    return jax.vmap(point_rate, (0, None))(points, constants)

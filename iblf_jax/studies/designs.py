"""The uniform numbers of a study: independent draws, a Latin hypercube or Sobol points.

Independent draws are made run by run inside the compiled block (`draws`).  A design covers the unit
cube more evenly, so means converge faster, but its points are not independent: no Clopper-Pearson
interval holds.  So a designed study is made of `replicates` designs, scrambled independently, and
its intervals come from the spread between them.

Source: A. B. Owen, Monte Carlo theory, methods and examples, chapters 10 and 17; SciPy's
  `stats.qmc` makes the points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from iblf_jax.core import checks

SAMPLERS = ("independent", "latin_hypercube", "sobol")
MAX_RUNS = 2**32
"""The draws of a run depend on its number, which is a uint32."""
MAX_SOBOL = (21201, 2**30)
"""Dimensions and points that SciPy's Sobol sequence has."""


def check_sampler(sampler: str, runs: int, replicates: object) -> int:
    """The number of replicates; ValueError for a sampler, a number of runs and replicates that do
    not fit together.
    """
    checks.one_of("sampler", sampler, SAMPLERS)
    replicates = checks.positive_integer("replicates", replicates, most=runs)
    if sampler == "independent" and replicates != 1:
        raise checks.fail(
            "replicates",
            replicates,
            "1 with independent draws",
            'Replicates belong to sampler="latin_hypercube" or "sobol".',
        )
    if runs % replicates:
        raise checks.fail(
            "runs",
            runs,
            f"a multiple of replicates = {replicates}",
            f"Take runs={replicates * max(1, runs // replicates)}.",
        )
    each = runs // replicates
    if sampler == "sobol" and each & (each - 1):
        near = 1 << max(0, round(np.log2(each)))
        raise checks.fail(
            "runs",
            runs,
            "a power of two for each replicate of Sobol points",
            f"Take runs={near * replicates}.",
        )
    return replicates


def unit_points(
    sampler: str, dimension: int, runs: int, replicates: int, seed: int, salt: int = 0
) -> np.ndarray:
    """Points in the open unit cube, (runs, dimension): `replicates` independent designs, one after
    another.

    Raises:
      ValueError: more points than fit the memory or the sequence has.
    """
    checks.fits_memory("runs" if not salt else "points", runs, 3 * 8.0 * dimension)
    if sampler == "sobol" and (dimension > MAX_SOBOL[0] or runs // replicates > MAX_SOBOL[1]):
        came = f"{runs // replicates} of {dimension} numbers"
        raise checks.fail(
            "sampler",
            sampler,
            f"at most {MAX_SOBOL[1]} points of {MAX_SOBOL[0]} numbers in a design, not {came}",
        )
    from scipy.stats import qmc  # a second to import

    engine = qmc.Sobol if sampler == "sobol" else qmc.LatinHypercube
    designs = []
    for replicate in range(replicates):
        rng = np.random.default_rng([seed, replicate, salt])
        designs.append(engine(dimension, rng=rng).random(runs // replicates))
    return np.concatenate(designs)


def designed_numbers(
    sampler: str,
    shapes: Mapping[str, tuple[int, ...]],
    runs: int,
    replicates: int,
    seed: int,
    dtype: np.dtype,
    salt: int = 0,
) -> dict[str, np.ndarray]:
    """Name of the draws -> their uniform numbers in all runs, (runs, ...); arguments as
    `unit_points`.
    """
    dimension = sum(math.prod(shape) for shape in shapes.values())
    return split(unit_points(sampler, dimension, runs, replicates, seed, salt), shapes, dtype)


def split(
    points: np.ndarray, shapes: Mapping[str, tuple[int, ...]], dtype: np.dtype
) -> dict[str, np.ndarray]:
    """The columns of `points` by path, each with its leaf's shape, kept off 0 and 1 in `dtype`."""
    edge = np.finfo(dtype).eps / 2
    inside = np.clip(points.astype(dtype), edge, 1 - edge)
    parts, start = {}, 0
    for path, shape in shapes.items():
        width = math.prod(shape)
        parts[path] = inside[:, start : start + width].reshape((-1, *shape))
        start += width
    return parts

"""Estimators of rare probabilities on functions whose probabilities are known.

    python benchmarks/rare_failures.py [--quick] [--json FILE] [--repetitions 200]

A point of d standard normal numbers fails beyond one of m planes, which are at one distance from
the origin.  Each estimator repeats each case with other seeds: `mean` is the mean estimate divided
by the exact probability, `variation` the standard deviation of the estimates divided by their mean,
`reported` the mean of the coefficients of variation that the estimator gives, `covered` the share
of its 95 % intervals that contain the exact probability.  OpenTURNS takes the same number of points
a level in blocks of 500; it is left out where it is not installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from _timing import report
from scipy.stats import norm

from iblf_jax.studies.rare_events.design_points import Pieces, design_points
from iblf_jax.studies.rare_events.importance import importance_sampling
from iblf_jax.studies.rare_events.subset import subset_simulation

RUNS = 4000
"""Points of a level of subset simulation, as by default."""
WEIGHTED = 2000
"""Points of importance sampling."""
BLOCK = 500
CONFIDENCE = 0.95
COLUMNS = ["case", "estimator", "probability", "points", "mean", "variation", "reported", "covered"]


class Planes(NamedTuple):
    """Failure beyond planes: normal vectors (m, d), all at one distance, parallel or alone."""

    normals: np.ndarray
    distance: float

    @property
    def probability(self) -> float:
        """The exact one."""
        return len(self.normals) * float(norm.sf(self.distance))

    def pieces(self, z: np.ndarray) -> Pieces:
        """The margin to each plane, with its gradient."""
        margins = self.distance - z @ self.normals.T
        return Pieces(margins, np.broadcast_to(-self.normals, (len(z), *self.normals.shape)))

    def margin(self, z: np.ndarray) -> np.ndarray:
        """The smallest margin."""
        return np.min(self.distance - z @ self.normals.T, axis=1)


def one_plane(dimension: int, distance: float) -> Planes:
    """Equally inclined to all axes."""
    return Planes(np.full((1, dimension), dimension**-0.5), distance)


CASES = {
    "1e-3, 6 numbers": one_plane(6, 3.09),
    "1e-6, 2 numbers": one_plane(2, 4.753),
    "1e-6, 50 numbers": one_plane(50, 4.753),
    "1e-8, 10 numbers": one_plane(10, 5.612),
    "7e-6, two opposite regions": Planes(np.eye(10)[:1] * [[1.0], [-1.0]], 4.5),
}


class Found(NamedTuple):
    """One estimate."""

    probability: float
    variation: float
    low: float
    high: float
    points: int


def counted(margin: Callable[[np.ndarray], np.ndarray]) -> tuple[Callable, list[int]]:
    """The margin, and a list to which each call appends its number of points."""
    sizes: list[int] = []

    def call(z: np.ndarray) -> np.ndarray:
        sizes.append(len(z))
        return margin(z)

    return call, sizes


def by_subset(case: Planes, seed: int) -> Found:
    margin, sizes = counted(case.margin)
    found = subset_simulation(
        margin,
        case.normals.shape[1],
        runs=RUNS,
        share=0.1,
        levels=20,
        seed=seed,
        confidence=CONFIDENCE,
    )
    return Found(
        found.probability, found.coefficient_of_variation, found.low, found.high, sum(sizes)
    )


def by_importance(case: Planes, seed: int) -> Found:
    points, evaluations = design_points(case.pieces, np.zeros((0, case.normals.shape[1])))
    found = importance_sampling(
        case.margin, points, runs=WEIGHTED, seed=seed, confidence=CONFIDENCE
    )
    variation = found.coefficient_of_variation
    return Found(found.probability, variation, found.low, found.high, WEIGHTED + evaluations)


def by_openturns(case: Planes, seed: int) -> Found:
    import openturns as ot

    dimension = case.normals.shape[1]
    margin, sizes = counted(case.margin)
    ot.RandomGenerator.SetSeed(seed)
    function = ot.PythonFunction(dimension, 1, func_sample=lambda x: margin(np.asarray(x))[:, None])
    vector = ot.CompositeRandomVector(function, ot.RandomVector(ot.Normal(dimension)))
    algorithm = ot.SubsetSampling(ot.ThresholdEvent(vector, ot.LessOrEqual(), 0.0))
    algorithm.setBlockSize(BLOCK)
    algorithm.setMaximumOuterSampling(RUNS // BLOCK)
    algorithm.run()
    result = algorithm.getResult()
    p, half = result.getProbabilityEstimate(), 0.5 * result.getConfidenceLength(CONFIDENCE)
    return Found(p, result.getCoefficientOfVariation(), p - half, p + half, sum(sizes))


def row(name: str, estimator: str, found: list[Found]) -> list[Any]:
    exact = CASES[name].probability
    estimates = np.array([x.probability for x in found])
    return [
        name,
        estimator,
        exact,
        round(float(np.mean([x.points for x in found]))),
        round(float(np.mean(estimates)) / exact, 3),
        round(float(np.std(estimates) / np.mean(estimates)), 3),
        round(float(np.mean([x.variation for x in found])), 3),
        round(float(np.mean([x.low <= exact <= x.high for x in found])), 3),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json")
    parser.add_argument("--repetitions", type=int, default=200)
    args = parser.parse_args()
    repetitions = 3 if args.quick else args.repetitions
    estimators = {"subset": by_subset, "importance": by_importance}
    if importlib.util.find_spec("openturns") is not None:
        warnings.simplefilter("ignore")
        estimators["OpenTURNS, subset"] = by_openturns
    rows = [
        row(name, estimator, [estimate(case, seed) for seed in range(repetitions)])
        for name, case in CASES.items()
        for estimator, estimate in estimators.items()
    ]
    title = f"Rare probabilities, {repetitions} repetitions"
    report(title, COLUMNS, rows, args.json)


if __name__ == "__main__":
    main()

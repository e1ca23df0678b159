"""Samplers of the package `optuna`."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any, ClassVar

import numpy as np

from iblf_jax.tuning.solvers._base import SearchSpace, check_options
from iblf_jax.tuning.solvers.packages import check_installed, package
from iblf_jax.tuning.solvers.population import Losses, Population


@dataclasses.dataclass(frozen=True)
class Optuna(Population):
    """A sampler of Optuna with an exact penalty (`population`); one generation is one batch of
    values, without derivatives.  It needs the package `optuna`: pip install "iblf_jax[tuning]".

    The time that the tree-structured Parzen estimator takes itself grows with the square of the
    number of points.

    Args:
      sampler: "tpe" (tree-structured Parzen estimator), "qmc" (a Sobol sequence) or "random".
      population: points of a generation.
      reach: distance in z from the start within which it searches, inside of the ranges; 4 is a
        factor 55 for a gain.
      seed: of its random numbers.
      tolerance: relative change of the objective that counts as a better result.
      patience: generations without a better result after which the search ends.

    Source: T. Akiba et al., Optuna, KDD 2019, 2623-2631.
    """

    sampler: str = "tpe"
    population: int = 8
    reach: float = 4.0
    seed: int = 0
    tolerance: float = 1e-5
    patience: int = 30
    name: ClassVar[str] = "optuna"

    def __post_init__(self) -> None:
        check_options(self)
        check_installed("optuna")

    def begin(self, space: SearchSpace, z: np.ndarray) -> Any:
        """As `Population.begin`."""
        optuna = package("optuna")
        low, high = self.near(space, z, self.reach)
        ranges = {
            f"z{i}": optuna.distributions.FloatDistribution(float(a), float(b))
            for i, (a, b) in enumerate(zip(low, high, strict=True))
        }
        level = optuna.logging.get_verbosity()
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # experimental options
                study = optuna.create_study(sampler=self._sampler(optuna))
        finally:
            optuna.logging.set_verbosity(level)
        study.enqueue_trial(dict(zip(ranges, z.tolist(), strict=True)))
        return study, ranges

    def _sampler(self, optuna: Any) -> Any:
        if self.sampler == "random":
            return optuna.samplers.RandomSampler(seed=self.seed)
        if self.sampler == "qmc":
            return optuna.samplers.QMCSampler(qmc_type="sobol", scramble=True, seed=self.seed)
        return optuna.samplers.TPESampler(
            multivariate=True,
            constant_liar=True,
            n_startup_trials=4 * self.population,
            seed=self.seed,
        )

    def generation(self, library: Any, losses: Losses) -> bool:
        """As `Population.generation`; it ends without a better result, or with the iterations."""
        study, ranges = library
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trials = [study.ask(ranges) for _ in range(self.population)]
            points = np.array([[trial.params[name] for name in ranges] for trial in trials])
            for trial, loss in zip(trials, losses(points).tolist(), strict=True):
                study.tell(trial, loss)
        return False

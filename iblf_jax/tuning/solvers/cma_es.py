"""CMA-ES, by the package `cma`."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any, ClassVar

import numpy as np

from iblf_jax.tuning.solvers._base import SearchSpace, check_options
from iblf_jax.tuning.solvers.packages import check_installed, package
from iblf_jax.tuning.solvers.population import Losses, Population


@dataclasses.dataclass(frozen=True)
class CMAES(Population):
    """CMA-ES with an exact penalty (`population`); one generation is one batch of values, without
    derivatives.  It needs the package `cma`: pip install "iblf_jax[tuning]".

    Args:
      population: points of a generation.
      step_size: first standard deviation of the points in the coordinates z; 0.5 is a factor 1.6
        for a gain.
      seed: of its random numbers.
      tolerance: difference of the losses, relative to the first, below which it has converged.
      patience: generations without a better result after which the search ends.

    Source: N. Hansen, The CMA Evolution Strategy: A Tutorial, arXiv:1604.00772.
    """

    population: int = 32
    step_size: float = 0.5
    seed: int = 0
    tolerance: float = 1e-5
    patience: int = 30
    name: ClassVar[str] = "cma"

    def __post_init__(self) -> None:
        check_options(self)
        check_installed("cma")

    def begin(self, space: SearchSpace, z: np.ndarray) -> Any:
        """As `Population.begin`; its random numbers are not those of `numpy.random`."""
        cma = package("cma")
        rng = np.random.default_rng(self.seed)
        options = {
            "bounds": [space.box.low.tolist(), space.box.high.tolist()],
            "popsize": self.population,
            "seed": np.nan,
            "randn": lambda *shape: rng.standard_normal(shape),
            "tolfun": self.tolerance,
            "tolfunhist": 0.1 * self.tolerance,
            "verbose": -10,
            "verb_log": 0,
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return cma.CMAEvolutionStrategy(z.tolist(), self.step_size, options)

    def generation(self, library: Any, losses: Losses) -> bool:
        """As `Population.generation`."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            points = library.ask()
            library.tell(points, losses(np.stack(points)).tolist())
            return bool(library.stop())

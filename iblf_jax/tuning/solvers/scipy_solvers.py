"""Solvers of SciPy behind the same tuning problem."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any, ClassVar

import numpy as np
from scipy import optimize

from iblf_jax.tuning.solvers._base import SearchSpace, check_options
from iblf_jax.tuning.solvers.population import Losses, Population
from iblf_jax.tuning.solvers.programme import Programme, RunsToItsEnd

TRUST_RADIUS = 1.0
"""First radius of `TrustConstr` in the coordinates z."""
ITERATIONS_OF_TRUST_CONSTR = 5
"""Its iterations, each of which solves a part of a barrier problem, for one of the tuning's."""


@dataclasses.dataclass(frozen=True)
class SLSQP(RunsToItsEnd):
    """SciPy's sequential least-squares programming, with exact gradients and each peak of a
    requirement as a constraint; forward mode.

    The library runs its own loop: each of the tuning's steps is a whole run, and a checkpoint
    exists after it only.

    Args:
      tolerance: relative change of the objective below which a run ends.
      starts: number of starting points, whose runs follow one another, each to its end; by the
        effort of the tuning if not given.
      sharpenings: how often the smoothing of peaks in the objective is divided by 4, each time
        after a run.
      patience: runs without a better result after which the search ends.

    Source: D. Kraft, ACM Trans. Math. Softw. 20 (1994) 262-281.
    """

    tolerance: float = 1e-6
    starts: int | None = None
    sharpenings: int = 2
    patience: int = 15
    name: ClassVar[str] = "slsqp"
    handles_requirements: ClassVar[bool] = True
    mode = "forward"
    resample = False

    def __post_init__(self) -> None:
        check_options(self)

    def minimise(self, programme: Programme, iterations: int, tolerance: float) -> np.ndarray:
        """As `RunsToItsEnd.minimise`."""
        limits = {
            "type": "ineq",
            "fun": lambda z: -programme.excess(z),
            "jac": lambda z: -programme.jacobian(z),
        }
        found = optimize.minimize(
            programme.objective,
            programme.z,
            jac=programme.gradient,
            method="SLSQP",
            bounds=optimize.Bounds(programme.low, programme.high),
            constraints=[limits] if programme.constraints else [],
            options={"maxiter": iterations, "ftol": tolerance},
        )
        return found.x


@dataclasses.dataclass(frozen=True)
class TrustConstr(RunsToItsEnd):
    """SciPy's trust-region interior-point method, with exact gradients, the Gauss-Newton matrix of
    the objective, and each peak of a requirement as a constraint; forward mode.

    The library runs its own loop: each of the tuning's steps is a whole run, and a checkpoint
    exists after it only.

    Args:
      tolerance: of a run: largest entry of the Lagrangian's gradient relative to the objective,
        smallest barrier parameter and smallest radius.
      starts: number of starting points, whose runs follow one another, each to its end; by the
        effort of the tuning if not given.
      sharpenings: how often the smoothing of peaks in the objective is divided by 4, each time
        after a run.
      patience: runs without a better result after which the search ends.

    Source: R. H. Byrd, M. E. Hribar, J. Nocedal, SIAM J. Optim. 9 (1999) 877-900.
    """

    tolerance: float = 1e-5
    starts: int | None = None
    sharpenings: int = 2
    patience: int = 15
    name: ClassVar[str] = "trust-constr"
    handles_requirements: ClassVar[bool] = True
    mode = "forward"
    resample = False

    def __post_init__(self) -> None:
        check_options(self)

    def minimise(self, programme: Programme, iterations: int, tolerance: float) -> np.ndarray:
        """As `RunsToItsEnd.minimise`."""
        limits = optimize.NonlinearConstraint(
            programme.excess, -np.inf, 0.0, jac=programme.jacobian, hess=optimize.BFGS()
        )
        options = {
            "maxiter": ITERATIONS_OF_TRUST_CONSTR * iterations,
            "gtol": tolerance,
            "xtol": tolerance,
            "barrier_tol": tolerance,
            "initial_tr_radius": TRUST_RADIUS,
        }
        with warnings.catch_warnings():
            # A quasi-Newton update that is skipped, and a Jacobian without full rank.
            warnings.simplefilter("ignore", UserWarning)
            found = optimize.minimize(
                programme.objective,
                programme.z,
                jac=programme.gradient,
                hess=programme.hessian,
                method="trust-constr",
                bounds=optimize.Bounds(programme.low, programme.high),
                constraints=[limits] if programme.constraints else [],
                options=options,
            )
        return found.x


@dataclasses.dataclass(frozen=True)
class DifferentialEvolution(Population):
    """SciPy's differential evolution with an exact penalty (`population`); one generation is one
    batch of values, without derivatives.

    Args:
      population: points of a generation.
      reach: distance in z from the start within which it searches, inside of the ranges; 4 is a
        factor 55 for a gain.
      seed: of its random numbers.
      tolerance: relative spread of the population below which it has converged.
      patience: generations without a better result after which the search ends.

    Source: R. Storn, K. Price, J. Global Optim. 11 (1997) 341-359.
    """

    population: int = 32
    reach: float = 4.0
    seed: int = 0
    tolerance: float = 1e-5
    patience: int = 30
    name: ClassVar[str] = "differential-evolution"

    def __post_init__(self) -> None:
        check_options(self)

    def begin(self, space: SearchSpace, z: np.ndarray) -> dict[str, Any]:
        """As `Population.begin`."""
        low, high = self.near(space, z, self.reach)
        rng = np.random.default_rng(self.seed)
        first = low + (high - low) * rng.random((self.population, len(z)))
        first[0] = z
        return {"low": low, "high": high, "points": first, "losses": None, "generations": 0}

    def generation(self, library: dict[str, Any], losses: Losses) -> bool:
        """As `Population.generation`; the first one evaluates two populations.

        SciPy runs for one generation from the last one, of which it gets the known losses.
        """
        if library["losses"] is None:
            library["losses"] = losses(library["points"])
        known = [library["losses"]]

        def of_columns(columns: np.ndarray) -> np.ndarray:
            return known.pop() if known else losses(columns.T)

        library["generations"] += 1
        found = optimize.differential_evolution(
            of_columns,
            list(zip(library["low"], library["high"], strict=True)),
            init=library["points"],
            maxiter=1,
            tol=0.0,
            polish=False,
            updating="deferred",
            vectorized=True,
            seed=np.random.default_rng([self.seed, library["generations"]]),
        )
        library["points"] = found.population
        library["losses"] = found.population_energies
        spread = float(np.std(library["losses"]))
        return spread <= self.tolerance * abs(float(np.mean(library["losses"])))

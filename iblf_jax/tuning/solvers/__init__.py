"""Solvers of tuning problems.

The Protocol `Solver` in `_base` is the contract.  A new solver is one file in this folder and one
entry of `SOLVERS`; an object of a class of your own can be passed as `tune(..., solver=...)` as it
is.
"""

from typing import Any

from iblf_jax.tuning.solvers._base import Constraints as Constraints
from iblf_jax.tuning.solvers._base import SearchSpace as SearchSpace
from iblf_jax.tuning.solvers._base import Solver as Solver
from iblf_jax.tuning.solvers.adam import Adam as Adam
from iblf_jax.tuning.solvers.cma_es import CMAES as CMAES
from iblf_jax.tuning.solvers.lbfgs import LBFGS as LBFGS
from iblf_jax.tuning.solvers.optax_steps import Optax as Optax
from iblf_jax.tuning.solvers.optuna_search import Optuna as Optuna
from iblf_jax.tuning.solvers.scipy_solvers import SLSQP as SLSQP
from iblf_jax.tuning.solvers.scipy_solvers import DifferentialEvolution as DifferentialEvolution
from iblf_jax.tuning.solvers.scipy_solvers import TrustConstr as TrustConstr
from iblf_jax.tuning.solvers.sqp import SQP as SQP
from iblf_jax.tuning.solvers.uno import Uno as Uno

OWN = (SQP, LBFGS, Adam, Optax)
OF_LIBRARIES = (SLSQP, TrustConstr, Uno, DifferentialEvolution, CMAES, Optuna)
SOLVERS: dict[str, Any] = {solver.name: solver for solver in (*OWN, *OF_LIBRARIES)}
"""Name -> class of each solver; options have defaults."""

"""Solvers of tuning problems.

The base class `Solver` in `_base` is the contract of a solver.  An object with its members can be
passed as `tune(..., solver=...)` as it is.  A solver of this package needs

1. a file in this folder with a frozen dataclass, whose fields are its options;
2. a check in `_base.CHECKS` for each option with a new name;
3. an entry of `OWN` or `OF_LIBRARIES` below, by which the solver gets its name;
4. an import in `iblf_jax/tuning/__init__.py`, and a line in docs/how_to/tune_gains.md.

Three base classes take over most of the contract:

| If the algorithm | derive from | and write | Example |
|---|---|---|---|
| can be advanced step by step | `Solver` | all of it | `adam`, `lbfgs`, `sqp` |
| belongs to a library with its own loop | `programme.RunsToItsEnd` | `minimise` | `uno` |
| uses values of many points only | `population.Population` | `begin`, `generation` | `cma_es` |
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

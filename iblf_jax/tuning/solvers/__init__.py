"""Solvers of tuning problems.

The Protocol `Solver` in `_base` is the contract.  A new solver is one file in this folder and one
entry of `SOLVERS`; an object of a class of your own can be passed as `tune(..., solver=...)` as it
is.
"""

from iblf_jax.tuning.solvers._base import Constraints as Constraints
from iblf_jax.tuning.solvers._base import SearchSpace as SearchSpace
from iblf_jax.tuning.solvers._base import Solver as Solver
from iblf_jax.tuning.solvers.adam import Adam as Adam
from iblf_jax.tuning.solvers.lbfgs import LBFGS as LBFGS
from iblf_jax.tuning.solvers.optax_steps import Optax as Optax
from iblf_jax.tuning.solvers.sqp import SQP as SQP

SOLVERS = {solver.name: solver for solver in (SQP, LBFGS, Adam, Optax)}
"""Name -> class of each solver; options have defaults."""

"""Tunes gains by derivatives through the closed loop, under requirements and over perturbed runs,
and validates the result on fresh runs.

    best = ij.tune(
        scenario,
        ["controller.k1", "controller.K2", "observer.kf"],
        ij.objectives.tracking() + 0.5 * ij.objectives.effort() + ij.objectives.margin_above(0.05),
        duration=5.0,
        effort="thorough",
        report=ij.tuning.Report(runs=2000),
    )
    best.scenario, best.report, best.plot()

| Module | Purpose |
|---|---|
| `objectives`, `quantities` | what is minimised and required |
| `parameters`, `ranges` | which leaves vary, in which coordinates and within which limits |
| `robust` | one number from many perturbed runs |
| `options` | options of the runs, of the report and of the search |
| `problem` | `TuningProblem`: all of the above in one object |
| `rollouts`, `runs` | batches of runs without and with derivatives |
| `evaluation` | value and derivatives of the problem |
| `solvers` | the contract `Solver`; `SQP`, `LBFGS`, `Adam`, `Optax`, and those of other libraries |
| `starts`, `search`, `checkpoints` | where a search begins, its steps, its stored state |
| `optimality`, `kinks` | multipliers and residuals at the returned gains, also where slopes jump |
| `result`, `report` | what `tune` returns, and its validation on fresh runs |
| `samples`, `failures`, `step_check` | runs for the report, why fresh runs failed, and dt / 2 |
| `confirmation` | fresh runs that show how seldom the tuned gains fail |
| `_tune` | `tune`, which calls these in this order |
| `_pareto`, `_falsify` | fronts of two objectives, and attacks on a result |
| `_failure_probability`, `margins` | probabilities of rare failures, gradients of margins |
"""

from iblf_jax.tuning import objectives as objectives
from iblf_jax.tuning._failure_probability import failure_probability as failure_probability
from iblf_jax.tuning._falsify import WorstCase as WorstCase
from iblf_jax.tuning._falsify import falsify as falsify
from iblf_jax.tuning._pareto import ParetoFront as ParetoFront
from iblf_jax.tuning._pareto import pareto as pareto
from iblf_jax.tuning._tune import tune as tune
from iblf_jax.tuning.confirmation import Confirmation as Confirmation
from iblf_jax.tuning.failures import FailedRuns as FailedRuns
from iblf_jax.tuning.options import Effort as Effort
from iblf_jax.tuning.options import Report as Report
from iblf_jax.tuning.parameters import tunable as tunable
from iblf_jax.tuning.problem import TuningProblem as TuningProblem
from iblf_jax.tuning.report import TuningReport as TuningReport
from iblf_jax.tuning.result import TuneResult as TuneResult
from iblf_jax.tuning.robust import cvar as cvar
from iblf_jax.tuning.solvers import CMAES as CMAES
from iblf_jax.tuning.solvers import LBFGS as LBFGS
from iblf_jax.tuning.solvers import SLSQP as SLSQP
from iblf_jax.tuning.solvers import SOLVERS as SOLVERS
from iblf_jax.tuning.solvers import SQP as SQP
from iblf_jax.tuning.solvers import Adam as Adam
from iblf_jax.tuning.solvers import DifferentialEvolution as DifferentialEvolution
from iblf_jax.tuning.solvers import Optax as Optax
from iblf_jax.tuning.solvers import Optuna as Optuna
from iblf_jax.tuning.solvers import SearchSpace as SearchSpace
from iblf_jax.tuning.solvers import Solver as Solver
from iblf_jax.tuning.solvers import TrustConstr as TrustConstr
from iblf_jax.tuning.solvers import Uno as Uno
from iblf_jax.tuning.solvers._base import Derivatives as Derivatives
from iblf_jax.tuning.solvers._base import Evaluation as Evaluation
from iblf_jax.tuning.solvers._base import Value as Value
from iblf_jax.tuning.step_check import StepCheck as StepCheck

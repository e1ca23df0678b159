"""Gain tuning by gradient through the closed loop, under requirements, over perturbed runs, checked
on fresh ones.

    best = ij.tune(scenario, ["controller.k1", "controller.K2", "observer.kf"],
                   ij.objectives.tracking() + 0.5 * ij.objectives.effort() +
                   ij.objectives.margin_above(0.05), duration=5.0)
    best.scenario, best.report, best.plot()

`parameters`  which leaves, within which limits, in which coordinates      `quantities`,
`objectives`  what for `robust`      one number from many perturbed runs
`problem`      the compiled loss and its derivatives `newton`, `quadratic`, `first_order`  how to
step                          `optimise`     the loop: best so far, resume `report`      the
  verdict, on fresh runs if perturbed                      `_pareto`, `_falsify`  fronts, and
  attacks on a result
"""

from iblf_jax.tuning import objectives as objectives
from iblf_jax.tuning._falsify import Attack as Attack
from iblf_jax.tuning._falsify import falsify as falsify
from iblf_jax.tuning._pareto import Front as Front
from iblf_jax.tuning._pareto import pareto as pareto
from iblf_jax.tuning._tune import tune as tune
from iblf_jax.tuning.parameters import tunable as tunable
from iblf_jax.tuning.report import Report as Report
from iblf_jax.tuning.result import TuneResult as TuneResult
from iblf_jax.tuning.robust import cvar as cvar

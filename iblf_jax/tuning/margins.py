"""Margins of runs and their gradients by the coordinates of perturbations, by forward mode: for
`falsify`, which minimises the smallest one, and for the design points of `failure_probability`.
"""

from __future__ import annotations

import jax

from iblf_jax.core import programs
from iblf_jax.engine import RunRequest
from iblf_jax.studies.perturbation_cube import Cube
from iblf_jax.tuning.quantities import Peak, Quantities
from iblf_jax.tuning.runs import tangents_of_runs


@programs.jit(static_argnames="request")
def pieces_of_margins(
    cube: Cube, peak: Peak, dt: jax.Array, u: jax.Array, *, request: RunRequest
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The margin of each joint, side and window of time of `peak`, (S, m), its gradient by u,
    (S, m, d), and the status of each run, (S,).

    Args:
      cube: the perturbations.
      peak: of the deficit that is minus the margin.
      dt: time step, () [s].
      u: coordinates of the runs, (S, d).
      request: what is run, static.
    """
    varied = jax.vmap(cube.values)(u)
    jacobians = jax.vmap(jax.jacfwd(cube.values))(u)
    folds = (Quantities((peak,)),)
    found = tangents_of_runs(cube.uncertain.scenario, varied, jacobians, folds, dt, request)
    margins = -found.outcome.metrics["tuning_pieces"]
    gradients = -found.tangents["tuning_pieces"]
    return margins, gradients.swapaxes(1, 2), found.outcome.status

"""Runs batches without derivatives and returns the quantities of an objective, for the values of a
search and for the report on its result.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import programs
from iblf_jax.engine import RunRequest, run_batch_in_parts
from iblf_jax.simulation.closed_loop import evaluate, initial_state
from iblf_jax.simulation.error_growth import errors_by_step
from iblf_jax.simulation.metrics import Torque
from iblf_jax.simulation.noise import noise_values
from iblf_jax.simulation.paths import get, with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.stability import RADIUS
from iblf_jax.studies.draws import Target, UncertainScenario, draw, replaced_leaves
from iblf_jax.tuning.objectives import Objective
from iblf_jax.tuning.quantities import Peak, Quantities

WINDOWS = 8
"""Time windows of a peak: within one of them a signal seldom has two peaks of one height.  With 8,
a peak of `presets.ur5` takes 1,400 choices of a step with 14 tangents, of some 200,000
operations."""


def fold_of(
    objective: Objective, dtype: np.dtype, duration: jax.Array | float | None = None
) -> tuple[Quantities, ...]:
    """The fold of a problem: its quantities and the margin last.

    Args:
      objective: with scales and limits.
      dtype: of the runs.
      duration: of a run [s]; peaks are split into windows of it, if given.
    """
    parts = objective.quantities
    if duration is not None:
        edges = jnp.asarray(duration, dtype) * jnp.asarray(np.arange(1, WINDOWS) / WINDOWS, dtype)
        parts = tuple(
            dataclasses.replace(x, windows=edges) if isinstance(x, Peak) else x for x in parts
        )
    one: Any = 1.0
    fold = Quantities((*parts, Peak(one, "deficit")))
    return (jax.tree.map(lambda x: jnp.asarray(x, dtype), fold),)


def piece_counts(objective: Objective, scenario: Scenario, duration: float) -> tuple[int, ...]:
    """The number of pieces of each quantity, the margin's last."""

    def first_sample(s: Scenario) -> Any:
        return evaluate(s, jnp.zeros_like(s.initial.q[0]), initial_state(s))[1]

    sample = jax.eval_shape(first_sample, scenario)
    return fold_of(objective, scenario.initial.q.dtype, duration)[0].counts(sample)


def draw_run(
    cases: UncertainScenario,
    targets: tuple[Target, ...],
    point: dict[str, jax.Array],
    index: jax.Array,
    nominal: bool = False,
) -> tuple[dict[str, jax.Array], jax.Array]:
    """Path -> value for one run with the leaves of a point, and whether its draws were
    admissible.
    """
    noise = noise_values(cases.scenario, cases.key, index)
    if not targets:
        return point | noise, jnp.asarray(True)
    drawn, _, admissible = draw(cases, targets, index, point, {})
    if nominal:
        scenario = with_parameters(cases.scenario, point)
        drawn = {path: jnp.asarray(get(scenario, path)) for path in drawn}
        admissible = jnp.asarray(True)
    return replaced_leaves(cases.scenario, point, drawn) | noise, admissible


@programs.jit(static_argnames=("targets", "nominal"), kept=True)
def draw_runs(
    cases: UncertainScenario,
    points: dict[str, jax.Array],
    index: jax.Array,
    *,
    targets: tuple[Target, ...],
    nominal: bool,
) -> tuple[dict[str, jax.Array], jax.Array]:
    """Path -> values of runs by their points (R, ...) and numbers (R,), drawn or `nominal`, and
    whether their draws were admissible.
    """
    return jax.vmap(lambda point, i: draw_run(cases, targets, point, i, nominal))(points, index)


class Rollouts(NamedTuple):
    """What runs give, (R, ...)."""

    smooth: Any
    exact: Any
    """Each quantity, the last minus the margin, (R, K + 1)."""
    peak_torque: Any
    """Of each joint, (R, n)."""
    relative_error: Any
    """Estimated error of each run by the time step, relative to its tube."""
    status: Any
    fastest_mode: Any
    sampling_radius: Any
    """Spectral radius of the one-period map, (R,); NaN for a continuous law."""


def rollouts(
    scenario: Scenario,
    varied: dict[str, jax.Array],
    fold: tuple[Quantities, ...],
    dt: jax.Array,
    *,
    request: RunRequest,
) -> Rollouts:
    """Runs a batch; call it outside of `jit`.

    Args:
      scenario, varied, dt, request: as `run_batch_in_parts`; errors and radii are NaN where the
        request is not `assessed`.
      fold: `fold_of` the objective.
    """
    outcome = run_batch_in_parts(scenario, varied, (*fold, Torque()), dt, request)
    smooth, exact, peak_torque = (
        outcome.metrics[name] for name in ("tuning_smooth", "tuning_exact", "peak_torque")
    )
    unknown = np.full(len(smooth), np.nan, dt.dtype)
    error = errors_by_step(outcome.metrics) if request.assessed else unknown
    radius = outcome.metrics.get(RADIUS, unknown)
    return Rollouts(smooth, exact, peak_torque, error, outcome.status, outcome.fastest_mode, radius)

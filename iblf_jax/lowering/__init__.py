"""How a batch of runs is executed.  The physics is written once, for one run; a backend decides how many are stepped at a time.

`run_batch` is the one entry: studies call it with the leaves that differ between runs, and all backends give the same results.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax

from iblf_jax import checks
from iblf_jax.one_function import as_one_function
from iblf_jax.paths import with_parameters
from iblf_jax.rollout import Outcome, run
from iblf_jax.scenario import Scenario

BACKENDS = ("auto", "vmap")
"""How a batch can be executed."""

_SMALL = 64
"""Runs up to which a batch gains from being one machine function; XLA refuses some of its fusions there from 128 on."""


def run_batch(
    scenario: Scenario,
    varied: Mapping[str, jax.Array],
    folds,
    dt: jax.Array,
    *,
    steps: int,
    method: str,
    record_every: int | None = None,
    backend: str = "auto",
) -> Outcome:
    """Runs a scenario once for every entry of `varied`; call it inside `jit`.

    Args:
      scenario: the scenario that all runs share, canonical.
      varied: path -> values, batch axis first; each run replaces these leaves.
      folds: the metrics.
      dt: time step, () [s].
      steps: number of steps, static.
      method: integrator, static.
      record_every: record every so-many-th step, or None for metrics only, static.
      backend: one of BACKENDS, static.

    Returns:
      An `Outcome` with a leading batch axis on every array.
    """

    def one(varied):
        return run(with_parameters(scenario, varied), folds, dt, steps=steps, method=method, record_every=record_every)

    checks.one_of("backend", backend, BACKENDS)
    batched = jax.vmap(one)
    if min(len(values) for values in varied.values()) <= _SMALL:
        batched = as_one_function(batched)
    return batched(dict(varied))

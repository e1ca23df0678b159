"""What a type checker knows of what users get: `mypy` reads this file beside the package, and nothing runs it."""

from __future__ import annotations

from typing import assert_type

import jax

import iblf_jax as ij


def of_a_run(scenario: ij.Scenario) -> None:
    """The signals of a run and its metrics are arrays."""
    run = ij.simulate(scenario, duration=1.0)
    assert_type(run.q, jax.Array)
    assert_type(run.disturbance_estimate, jax.Array)
    assert_type(run.metrics.rmse, jax.Array)
    assert_type(run[0], ij.Rollout)

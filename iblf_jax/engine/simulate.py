"""`simulate`: runs one scenario and returns a `Rollout`.

request = RunRequest.of(...)     what is requested, checked
output  = run_one(...)           planned, compiled and executed (`single_run`)
result  = Rollout(...)           named arrays with units
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from iblf_jax.core import checks, notices
from iblf_jax.engine.diagnosis import SimulationError as SimulationError
from iblf_jax.engine.diagnosis import SimulationWarning as SimulationWarning
from iblf_jax.engine.diagnosis import report
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.single_run import run_one
from iblf_jax.engine.transformable import run_transformable
from iblf_jax.simulation.metrics import Fold, as_folds, metric_units
from iblf_jax.simulation.noise import has_noise, noise_key
from iblf_jax.simulation.results import Metrics, Rollout
from iblf_jax.simulation.scenario import Scenario, canonical, check_step

MAX_SAMPLES = 20_000_000
"""Recorded samples of a run at most: a mistake in `duration` or `dt` must not fill the memory.  For
two joints they take some 5 GB."""


@notices.each_warning_once
def simulate(
    scenario: Scenario,
    *,
    duration: float,
    dt: float = 1e-3,
    method: str = "rk4",
    record_every: int = 1,
    metrics: Sequence[Fold] | None = None,
    throw: bool = False,
    backend: str = "auto",
    seed: int = 0,
) -> Rollout:
    """Runs a scenario with a fixed step and returns everything that can be looked at.

        x' = rate(t, x),   x = (q, q', states of law, observer and actuator)        (closed_loop)

    Works under `jax.jit`, `vmap`, `grad`, `jacfwd`: differentiate any array by leaves of the
    scenario.  New values of leaves do not recompile, except where other numbers of an arm's
    geometry become 0, 1, -1 or equal; a new structure or method does.  Another number of steps, or
    `record_every`, compiles the steps alone, except on "vmap".

    Args:
      scenario: what to run, of n joints.
      duration: length of the run [s], a whole number of steps.
      dt: time step [s]; `recommended_dt(scenario)` says which will do.
      method: "rk4", "heun" or "euler".
      record_every: record every so-many-th step; metrics and status cover every step.
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      throw: raise instead of warn when the run failed.
      backend: "native", C code built once for a structure and kept on disk; "gpu", the same on an
        NVIDIA GPU; "vmap", plain JAX; or "auto", the first of these that JAX's default device runs.
        Inside your own `jit` or `vmap` a run is plain JAX; except on "vmap", kernels compute its
        derivatives by the scenario, of all that is recorded: record little if metrics suffice.
      seed: fixes the noise of a sensor; the run is number 0 of a study with this seed.

    Returns:
      A `Rollout` with T = steps // record_every + 1 samples.

    Raises:
      ValueError: bad arguments; the message names the field, the value and the remedy.
      SimulationError: with `throw`, when the run failed.

    Source: design of this package; the closed loop is Zhang & Yan 2024, section 3.
    """
    steps = checks.whole_steps(duration, dt)
    every = _checked_record(record_every, steps)
    throw = checks.boolean("throw", throw)
    seed = checks.seed(seed)
    scenario = canonical(scenario)
    check_step(scenario, dt)
    request = RunRequest.of(
        scenario, steps=steps, method=method, record_every=every, backend=backend
    )
    step = jnp.asarray(dt, scenario.initial.q.dtype)
    folds = as_folds(metrics, step.dtype, scenario)
    noise = noise_key(jax.random.PRNGKey(seed)) if has_noise(scenario) else None
    result = run_rollout(scenario, folds, step, request, noise)
    if checks.is_concrete(result.status) and result.status.ndim == 0:
        report(result, steps, throw)
    return result


def _checked_record(record_every: int, steps: int) -> int:
    """The interval of the recorded samples; raises ValueError where they would be too many."""
    record_every = checks.recorded_every(record_every, steps)
    if steps // record_every <= MAX_SAMPLES:
        return record_every
    remedy = (
        f"Take record_every={-(-steps // MAX_SAMPLES)} or more; metrics cover every step all"
        " the same."
    )
    raise checks.fail(
        "record_every",
        record_every,
        f"at most {MAX_SAMPLES} recorded samples of {steps} steps",
        remedy,
    )


def run_rollout(
    scenario: Scenario,
    folds: tuple[Fold, ...],
    dt: jax.Array,
    request: RunRequest,
    noise: jax.Array | None = None,
) -> Rollout:
    """One run as a `Rollout`, without checks and warnings.

    Args:
      scenario: canonical, or with parameters that a study has drawn.
      folds: the metrics, as `as_folds` gives them.
      dt: time step, () [s].
      request: the checked request; it records at least one instant.
      noise: key of a sensor's noise (`noise.noise_key`).
    """
    if checks.is_concrete((scenario, folds, dt)):
        outcome = run_one(scenario, folds, dt, request, noise)
    else:
        outcome = run_transformable(scenario, folds, dt, request, noise)
    arrays, controller_state, observer_state, actuator_state, measured = outcome.records
    return Rollout(
        scenario=scenario,
        controller_state=controller_state,
        observer_state=observer_state,
        metrics=Metrics(outcome.metrics, metric_units(folds)),
        status=outcome.status,
        fastest_mode=outcome.fastest_mode,
        dt=dt,
        actuator_state=actuator_state,
        measured=measured,
        method=request.method,
        steps=request.steps,
        **arrays,
    )

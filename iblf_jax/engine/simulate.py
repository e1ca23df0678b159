"""`simulate` runs one scenario and returns a `Rollout`.

request = runs.request(...)      checks what is requested
outcome = run_one(...)           plans, compiles and executes it (`single_run`); under a
                                 transformation of JAX `run_transformable` (`transformable`)
result  = Rollout(...)           arrays with names and units
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import announced
from iblf_jax.engine.diagnosis import SimulationError as SimulationError
from iblf_jax.engine.diagnosis import SimulationWarning as SimulationWarning
from iblf_jax.engine.diagnosis import report
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.runs import Runs, takes_runs
from iblf_jax.engine.single_run import run_one
from iblf_jax.engine.transformable import run_transformable
from iblf_jax.simulation.metrics import Fold, as_folds, metric_units
from iblf_jax.simulation.noise import has_noise, noise_key, realised
from iblf_jax.simulation.results import Metrics, Rollout
from iblf_jax.simulation.scenario import Scenario, canonical, fitted_to_step

MAX_SAMPLES = 20_000_000
"""Largest number of recorded samples, so that a mistake in `duration` or `dt` does not fill the
memory.  For two joints they take about 5 GB."""


@notices.each_warning_once
@announced("simulating; the first run of a structure compiles its programs")
@takes_runs
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
    """Runs a scenario with a fixed step and returns its signals, metrics and status.

        x' = rate(t, x),   x = (q, q', states of law, observer and actuator)        (closed_loop)

    `jax.jit`, `vmap`, `grad`, `jacfwd` and their compositions apply to it; every array of the
    result is differentiable with respect to leaves of the scenario.  New parameter values reuse the
    compiled program, except where they change which structural constants (0, 1, -1 or equal entries
    of a robot's geometry, 0 or 1 in a factor of the law) hold.  A new structure or method compiles
    again.  A new number of steps or `record_every` recompiles only the time loop, or on "vmap" the
    complete run.

    Args:
      scenario: what to run, of n joints.
      duration: length of the run [s], a whole number of steps.
      dt: time step [s]; `recommended_dt(scenario)` returns a suitable one.
      method: "rk4", "heun" or "euler"; with process noise "euler_maruyama" or, where the noise is
        additive, "stochastic_heun".
      record_every: interval of the recorded samples in steps; metrics and status cover every step.
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      throw: whether to raise instead of warn if the run failed; inside a transformation of JAX it
        does neither.
      backend: "native", C code that is built once for a structure and kept on disk; "gpu", the same
        on an NVIDIA GPU; "vmap", JAX without kernels; or "auto", the first one available on the
        default device.  A run inside `jit` or `vmap` uses "vmap".  Its derivatives by the scenario
        use kernels unless backend="vmap".  They include every recorded signal: raise `record_every`
        if you need metrics only.
      seed: seed of the noise of a sensor, of process noise and of random switching times; the run
        is run 0 of a study with this seed.
      runs_as: an `ij.Runs`, in place of its fields.

    Returns:
      A `Rollout` with T = steps // record_every + 1 samples.

    Raises:
      ValueError: bad arguments; the message names the field, the value and the remedy.
      SimulationError: with `throw`, when the run failed.

    Source: design of this package; the closed loop is Zhang & Yan 2024, section 3.
    """
    runs = Runs(duration, dt, method, backend, seed)
    every = checks.recorded_every(record_every, runs.steps)
    if runs.steps // every > MAX_SAMPLES:
        fewest = checks.ceil_div(runs.steps, MAX_SAMPLES)
        expected = f"an interval with at most {MAX_SAMPLES} recorded samples in {runs.steps} steps"
        remedy = f"Take record_every={fewest} or more; metrics cover every step all the same."
        raise checks.fail("record_every", every, expected, remedy)
    throw = checks.boolean("throw", throw)
    scenario = fitted_to_step(canonical(scenario), dt)
    request = runs.request(scenario, record_every=every)
    step = jnp.asarray(dt, scenario.initial.q.dtype)
    folds = as_folds(metrics, step.dtype, scenario)
    key = noise_key(jax.random.PRNGKey(runs.seed)) if has_noise(scenario) else None
    result = run_rollout(scenario, folds, step, request, key)
    # Inside a transformation the status may be a number, while the metrics are traced.
    if checks.is_concrete(result) and result.status.ndim == 0:
        report(result, request.steps, throw)
    return result


def run_rollout(
    scenario: Scenario,
    folds: tuple[Fold, ...],
    dt: jax.Array,
    request: RunRequest,
    key: jax.Array | None = None,
) -> Rollout:
    """One run as a `Rollout`, without checks and warnings.

    Args:
      scenario: canonical scenario; its parameters may be those of a run of a study.
      folds: the metrics, as `as_folds` returns them.
      dt: time step, () [s].
      request: the request; its `record_every` is not None.
      key: of the run's random numbers (`noise.noise_key`).
    """
    if key is not None:
        scenario = realised(scenario, key.astype(dt.dtype))
    if checks.is_concrete((scenario, folds, dt)):
        outcome = run_one(scenario, folds, dt, request, key)
    else:
        outcome = run_transformable(scenario, folds, dt, request, key)
    states = outcome.records._asdict()
    return Rollout(
        **states.pop("signals"),
        **states,
        scenario=scenario,
        metrics=Metrics(outcome.metrics, metric_units(folds, scenario)),
        status=outcome.status,
        fastest_mode=outcome.fastest_mode,
        dt=dt,
        method=request.method,
        steps=request.steps,
    )

"""`simulate`: runs one scenario and returns a `Rollout`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import FAILED, Status, describe
from iblf_jax.engine.limiting_term import limiting_term
from iblf_jax.engine.mechanism import known_of
from iblf_jax.engine.registry import single_run_backends
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.single_run import run_one
from iblf_jax.engine.step_size import comfortable_dt, find_dt
from iblf_jax.engine.transformable import run_transformable
from iblf_jax.simulation.accuracy import ERROR, RELATIVE, TOLERANCE
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.metrics import Fold, as_folds, metric_units
from iblf_jax.simulation.results import Metrics, Rollout
from iblf_jax.simulation.sampling import check_step, has_noise, noise_key
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.simulation.signals import has
from iblf_jax.simulation.stability import RADIUS, WIDEST
from iblf_jax.world.bounds import tube_at
from iblf_jax.world.regions import in_words
from iblf_jax.world.robots import joint_names

MOST_SAMPLES = 20_000_000
"""More are not recorded, lest a slip in `duration` or `dt` fill the memory: for two joints they
take some 5 GB."""


LOOKED_AT = (
    Status.INACCURATE
    | Status.GUARD_STAYED
    | Status.SAMPLING_TOO_SLOW
    | Status.FILTER_INFEASIBLE
    | Status.INFINITE_SLOPE
)
"""The flags of a run that did not fail and that a user should see."""


class SimulationError(RuntimeError):
    """A run that did not do its job, raised by `simulate(..., throw=True)`."""


class SimulationWarning(UserWarning):
    """A run whose result needs a second look."""


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

        x' = rate(t, x),   x = (q, q', state of the law, state of the observer)
        (closed_loop)

    Works under `jax.jit`, `vmap`, `grad`, `jacfwd`: differentiate `run.metrics` or any array by the
      leaves of the scenario.
    New values of leaves do not recompile, but for which numbers of an arm's geometry are 0, 1, -1
    or equal; a new structure or method does.  Another number of steps, or `record_every`, compiles
    the steps alone, unless they run as plain JAX.

    Args:
      scenario: what to run, of n joints.
      duration: length of the run [s], a whole number of steps.
      dt: time step [s]; `recommended_dt(scenario)` says which will do.
      method: "rk4", "heun" or "euler".
      record_every: record every so-many-th step; metrics and status cover every step whatever is
        recorded.
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      throw: raise instead of warn when the run failed.
      backend: "native": generated code, built by the system's compiler once for a structure and
        kept on disk; "xla": the same program without a compiler, twice as slow; "gpu": the same as
        one kernel on an NVIDIA GPU; "auto": native, or gpu if that is JAX's default device, where
        there is a compiler, else xla.  A long step (an arm of many joints) runs as plain JAX on
        "xla".  Inside your own `jit` or `vmap` a run is plain JAX; where it is differentiated by
        numbers of the scenario, it and its first and second derivatives are the kernel's if there
        is one, but for "xla".  Derivatives are of all that is recorded, so record little where only
        metrics matter.
      seed: fixes the noise of a sensor; the run is number 0 of a study with this seed.

    Returns:
      A `Rollout` with T = steps // record_every + 1 samples.

    Raises:
      ValueError: bad arguments; the message names the field, the value and the remedy.
      SimulationError: with `throw`, when a bound was violated, the state ran away or the step was
        too large.

    Source: design of this package; the closed loop is Zhang & Yan 2024, section 3.
    """
    tableau(method)
    checks.one_of("backend", backend, single_run_backends())
    steps = checks.whole_steps(duration, dt)
    record_every, throw = checks.recorded_every(record_every, steps), checks.flag("throw", throw)
    if steps // record_every > MOST_SAMPLES:
        remedy = (
            f"Take record_every={-(-steps // MOST_SAMPLES)} or more; metrics cover every step all"
            " the same."
        )
        raise checks.fail(
            "record_every",
            record_every,
            f"at most {MOST_SAMPLES} recorded samples of {steps} steps",
            remedy,
        )
    scenario, seed = canonical(scenario), checks.seed(seed)
    check_step(scenario, dt)
    dtype = scenario.initial.q.dtype
    folds = as_folds(metrics, dtype, scenario)
    step_size, noise = (
        jnp.asarray(dt, dtype),
        (noise_key(jax.random.PRNGKey(seed)) if has_noise(scenario) else None),
    )
    result = simulate_unchecked(
        scenario,
        folds,
        step_size,
        noise,
        steps=steps,
        method=method,
        record_every=record_every,
        backend=backend,
    )
    if checks.is_concrete(result.status) and result.status.ndim == 0:
        report(result, steps, throw)
    return result


def simulate_unchecked(
    scenario: Scenario,
    folds,
    dt,
    noise: jax.Array | None = None,
    *,
    steps: int,
    method: str,
    record_every: int,
    backend: str = "auto",
) -> Rollout:
    """The former form of `run_rollout`."""
    request = RunRequest(steps, method, record_every, known_of(scenario), backend)
    return run_rollout(scenario, folds, dt, request, noise)


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
      noise: key of a sensor's noise (`sampling.noise_key`).
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


def report(result: Rollout, steps: int, throw: bool) -> None:
    """Raises or warns, with the physics in the message, if a run failed."""
    status = Status(int(result.status))
    if status & Status.INFEASIBLE_REFERENCE:
        raise _infeasible(result, steps)
    failed = status & FAILED
    told = failed | status & LOOKED_AT
    if getattr(unwrapped(result.scenario.controller), "needs_velocity_bounds", False):
        told |= status & Status.ALPHA_INFEASIBLE
    if not told:
        return
    heading = f"{'The run failed' if failed else 'Look again'}: {describe(told)}."
    text = " ".join(
        [heading, *_explanations(result, told | status & ~Status.ALPHA_INFEASIBLE, steps)]
    )
    if throw and failed:
        raise SimulationError(text)
    notices.warn(text, SimulationWarning)


def _explanations(result: Rollout, status: Status, steps: int) -> list[str]:
    texts = []
    metrics = result.metrics
    if status & Status.BOUND_VIOLATED and "first_violation_time" in metrics:
        joint = int(metrics["first_violation_joint"])
        texts.append(
            f"{_called(result, joint)} left its bounds first, at t ="
            f" {float(metrics['first_violation_time']):.4g} s; its smallest margin is"
            f" {float(metrics['margin'][joint]):.3g} rad."
        )
    if status & Status.VELOCITY_VIOLATED and "first_velocity_violation_time" in metrics:
        joint = int(metrics["first_velocity_violation_joint"])
        texts.append(
            f"{_called(result, joint)} left its velocity bounds first, at t ="
            f" {float(metrics['first_velocity_violation_time']):.4g} s; its smallest margin is"
            f" {float(metrics['velocity_margin'][joint]):.3g} rad/s."
        )
    if status & Status.REGION_VIOLATED and "first_region_violation_time" in metrics:
        i, plant = int(metrics["first_region_violation_region"]), result.scenario.plant
        texts.append(
            f"regions[{i}]: {in_words(result.scenario.regions[i], plant)} crossed its wall, at t ="
            f" {float(metrics['first_region_violation_time']):.4g} s; its smallest margin is"
            f" {float(metrics['region_margin'][i]):.3g} m."
        )
    if status & Status.STEP_TOO_LARGE:
        mode = float(result.fastest_mode)
        limit = tableau(result.method).stability / mode
        texts.append(
            f"The closed loop's fastest mode is {mode:.4g} 1/s, so {result.method} is stable up to"
            f" dt = {limit:.3g} s only; dt = {float(result.dt):g} s was asked for. Take"
            f" dt={comfortable_dt(mode):g}{_or_change(result)}."
        )
    elif status & Status.NOT_FINITE and np.isfinite(result.fastest_mode):
        texts.append(
            "The step was small enough for the fastest mode: look at the gains, the start and the"
            " disturbance."
        )
    elif status & Status.INACCURATE:
        texts.append(_about_accuracy(result, status, steps))
    if status & Status.INFINITE_SLOPE:
        texts.append(
            "At an isolated instant the derivative of the closed loop with respect to a state is"
            " infinite or nearly so, as that of |e2|^a sign(e2) with a < 1 is with respect to e2 ="
            " q' - alpha where e2 = 0, or that of sharp dry friction at a reversal. That is no"
            f" fast mode, so the time step is judged by differences of {WIDEST:g} rad/s there."
            " Derivatives of the run are not reliable; replace such a power by e2 (e2^2 +"
            " delta^2)^((a - 1)/2) with a small delta."
        )
    if status & Status.SAMPLING_TOO_SLOW:
        texts.append(
            f"From one period to the next the loop grows, by {float(metrics[RADIUS]):.4g} at the"
            " worst of the instants that were looked at. Sample faster (ij.recommended_period says"
            f" how fast){_or_change(result)}."
        )
    if status & Status.FILTER_INFEASIBLE:
        worst = f"{float(np.max(result.slack)):.3g} rad/s^2 (run.slack)"
        if has(result, "region_slack"):
            worst += f" and {float(np.max(result.region_slack)):.3g} m/s^2 (run.region_slack)"
        texts.append(
            "At the recorded samples its accelerations were beyond what its conditions allow by up"
            f" to {worst}. Raise controller.limit, or lower a1, a2, a3, b1 and b2, so that it"
            " brakes sooner."
        )
    if status & Status.ALPHA_INFEASIBLE:
        worst = (
            f"by up to {-float(np.min(metrics['alpha_margin'])):.3g} rad/s"
            if "alpha_margin" in metrics
            else "at some time"
        )
        texts.append(
            f"The virtual velocity alpha left the velocity bounds {worst}: nothing is claimed"
            " there. Start nearer to the reference, slow it down, widen the velocity bounds or"
            " lower controller.k1."
        )
    if status & Status.GUARD_STAYED:
        texts.append(
            "While the guard is active the barrier is softer than the one that was asked for: what"
            " ran there is another law. Start or stay further from the bounds, or give the barrier"
            " a smaller guard."
        )
    return texts


def _about_accuracy(result: Rollout, status: Status, steps: int) -> str:
    """How inaccurate a run is, and what helps."""
    error, relative = (float(np.max(result.metrics[name])) for name in (ERROR, RELATIVE))
    size = (
        f"Their error is estimated at {error:.2g} rad, {100 * relative:.2g} % of the tube, where"
        f" {100 * TOLERANCE:g} % are tolerated"
    )
    if status & Status.SAMPLING_TOO_SLOW:
        return (
            f"{size}: a loop that grows from one period to the next magnifies every error, whatever"
            " dt is."
        )
    return (
        f"{size}: dt = {float(result.dt):g} s is too large for what drives this loop. Take"
        f" {_smaller_step(result, steps)}."
    )


def _smaller_step(result: Rollout, steps: int) -> str:
    """A step with which this run would be accurate, in words."""
    if not checks.is_concrete(result.scenario):
        return "a smaller one"
    duration = steps * float(result.dt)
    try:
        return f"dt={find_dt(result.scenario, duration=duration, method=result.method):g}"
    except ValueError:  # the run is too long for a step to be tried
        return "a smaller one"


def _or_change(result: Rollout) -> str:
    """What else to change, the one term that limits the loop of a run, as the end of a sentence;
    empty where there is no such term.
    """
    limit = limiting_term(result) if checks.is_concrete(result.scenario) else None
    return (
        ""
        if limit is None
        else f", or {limit.advice}: of all terms {limit.term.words} limits this loop"
    )


def _called(result: Rollout, joint: int) -> str:
    """A joint by its number, and by its name if it has one."""
    name = joint_names(result.scenario.plant, result.n)[joint]
    return f"Joint {joint}" if name == f"joint {joint}" else f"Joint {joint} ({name})"


def _infeasible(result: Rollout, steps: int) -> ValueError:
    """The error for a reference that touches a bound (Assumption 2), with joint and time."""
    times = jnp.arange(steps + 1).astype(result.dt.dtype) * result.dt
    tube = jax.jit(jax.vmap(partial(tube_at, result.scenario.reference, result.scenario.bounds)))(
        times
    )
    q_d, lower, upper = (np.asarray(x) for x in (tube.q_d, tube.lower, tube.upper))
    sample, joint = np.unravel_index(np.argmin(np.minimum(q_d - lower, upper - q_d)), q_d.shape)
    where = f"t = {float(times[sample]):.4g} s"
    return checks.fail(
        f"reference of {joint_names(result.scenario.plant, result.n)[joint]}",
        float(q_d[sample, joint]),
        f"a value inside the bounds ({float(lower[sample, joint]):.6g},"
        f" {float(upper[sample, joint]):.6g}) at {where}",
        "The reference must stay strictly inside the bounds (Assumption 2): move it, widen the"
        " bounds or shorten the run.",
    )

"""The largest valid time step for a scenario, or for all runs that a study draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import announced
from iblf_jax.core.status import LOST, Status, has_flag
from iblf_jax.engine import block_size, step_size
from iblf_jax.simulation.error_estimate import TOLERANCE
from iblf_jax.simulation.error_growth import errors_by_step
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.simulation.stability import growth_in_words
from iblf_jax.studies.blocks import run_blocks
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.draws import targets_of
from iblf_jax.studies.options import RunOptions
from iblf_jax.studies.study_setup import prepare

STEP_FLAGS = Status.STEP_TOO_LARGE | Status.INACCURATE
"""Flags of a run whose time step was too large."""
MAX_TRIES = 8


@notices.each_warning_once
@announced("searching for the largest accurate time step")
def recommended_dt(
    scenario: Scenario,
    *,
    duration: float = 20.0,
    method: str = "rk4",
    perturbations: Mapping[str, Perturbation] | None = None,
    seed: int = 0,
) -> float:
    """A rounded time step [s] at which `simulate`, or a study, is stable and accurate.

    For one run the step is at most 1.5 / max |eigenvalue of the closed loop's Jacobian|, at the
    start, along the reference and where the run is nearest to a bound.  At this step the run agrees
    with one of about a third of the step to 0.1 % of the tube, and its error estimate is below
    0.5 %.  The step is rounded down to 1, 2 or 5 times a power of ten.

    Under process noise the noise is left out, because runs of different steps have different noise,
    and the step is at most 0.09 (euler_maruyama) or 0.4 (stochastic_heun) times the time constant
    of the fastest mode: the stationary variance of that mode is then right to 5 %.  A run whose
    step is beyond the limit of stability is flagged STEP_TOO_LARGE; no flag says that its
    variances are inaccurate.

    With perturbations the step is so small that no run of a first block of the study (256 runs on
    CPU) is flagged STEP_TOO_LARGE or INACCURATE.  Runs that leave their bounds or diverge at
    every step are an exception.

    Args:
      scenario: what is to run.
      duration: length of the run [s].
      method: the integrator.
      perturbations: as `monte_carlo` takes them; None for the scenario alone.
      seed: of the draws.

    Returns:
      The step [s].  If no step is accurate (for example of a loop that amplifies every error), the
      step of the eigenvalue criterion alone, with a warning.  If runs of a study leave their bounds
      or diverge at a step and at a smaller one, the smaller one, with a warning.

    Raises:
      ValueError: bad scenario, duration, method, perturbations or seed, or a method that does not
        fit the process noise.
    """
    tableau(method)
    seed = checks.seed(seed)
    duration = checks.time_span("duration", duration)
    if perturbations is None:
        perturbations = {}
    checks.mapping(
        "perturbations", perturbations, '{"plant.mass": ij.factor(ij.uniform(0.9, 1.1))}'
    )
    if perturbations:  # checked here, before the search for a step
        targets_of(canonical(scenario), perturbations)
    dt = step_size.find_dt(scenario, duration=duration, method=method)
    if not perturbations:
        return dt
    first_block = partial(_first_block, scenario, perturbations, duration, method, seed)
    return _dt_for_all(first_block, duration, dt, method)


def _dt_for_all(
    first_block: Callable[[float], Any], duration: float, dt: float, method: str
) -> float:
    """The step, at most dt, at which no run of a first block is flagged because of its step;
    `first_block` returns the results at a step.
    """
    lost_before = None
    for _ in range(MAX_TRIES):
        results = first_block(dt)
        errors = np.asarray(errors_by_step(results.metrics))
        needed = _dt_to_try(results.status, results.fastest_mode, errors, dt, method)
        if needed is None:
            return dt
        flagged = has_flag(results.status, STEP_FLAGS)
        lost = np.sum(flagged & has_flag(results.status, LOST))
        fails_at_any_step = lost == np.sum(flagged) and lost == lost_before
        if fails_at_any_step or duration / needed > step_size.MAX_TRIED:
            notices.warn(
                f"At dt = {dt:g} s, {np.sum(flagged)} of {flagged.size} runs are unstable or"
                f" inaccurate, of which {lost} left their bounds or diverged. A smaller step was"
                " not tried, or did not help: inspect them, by study.worst() of a study at this"
                " step."
            )
            return dt
        dt, lost_before = needed, lost
    return dt


def _first_block(
    scenario: Scenario,
    perturbations: Mapping[str, Perturbation],
    duration: float,
    method: str,
    seed: int,
    dt: float,
) -> Any:
    """The results of the first block of a study at a step."""
    length = max(round(duration / dt), 1) * dt
    options = RunOptions(length, dt, method, seed=seed, runs=block_size())
    prepared = prepare(scenario, perturbations, options, metrics=())
    ((_, results),) = run_blocks(prepared, [0])
    return results


def _dt_to_try(
    status: np.ndarray, modes: np.ndarray, errors: np.ndarray, dt: float, method: str
) -> float | None:
    """`needed_dt`, where runs that left their bounds or diverged reduce the step at most ten times
    at once.
    """
    kept = ~has_flag(status, LOST)
    of_kept = needed_dt(status[kept], modes[kept], errors[kept], dt, method)
    of_lost = needed_dt(status[~kept], modes[~kept], errors[~kept], dt, method)
    if of_lost is not None:
        of_lost = step_size.limited(of_lost, dt)
    return min((step for step in (of_kept, of_lost) if step is not None), default=None)


def needed_dt(
    status: np.ndarray, modes: np.ndarray, errors: np.ndarray, dt: float, method: str
) -> float | None:
    """A smaller step for the runs that were flagged for their time step; None if there are none.

    Args:
      status, modes, errors: flags, fastest mode [1/s] and estimated error relative to the tube of
        each run (`errors_by_step`).
      dt: their time step [s].
      method: the integrator.
    """
    stiff = has_flag(status, Status.STEP_TOO_LARGE)
    inaccurate = has_flag(status, Status.INACCURATE) & ~stiff & (errors != 0.0)
    needed = []
    if np.any(stiff):
        needed.append(step_size.comfortable_dt(float(np.max(modes[stiff])), method))
    if np.any(inaccurate):
        excess = float(np.max(errors[inaccurate])) / TOLERANCE
        needed.append(step_size.smaller(dt, excess, tableau(method).order))
    return min(needed, default=None)


def warn_of_step(
    status: np.ndarray, modes: np.ndarray, errors: np.ndarray, dt: float, method: str
) -> None:
    """Warns if runs of a study were flagged because of their step, and names a smaller one;
    arguments as `needed_dt`.
    """
    needed = _dt_to_try(status, modes, errors, dt, method)
    if needed is None:
        return
    flagged = has_flag(status, STEP_FLAGS)
    lost = np.sum(flagged & has_flag(status, LOST))
    text = (
        f"The time step dt = {dt:g} s is too large for {np.sum(flagged)} of {status.size} runs,"
        f" which are unstable or inaccurate. Take dt={needed:g}; ij.recommended_dt(scenario,"
        " perturbations=..., duration=...) finds one beforehand."
    )
    if lost:
        text += (
            f" {lost} of them left their bounds or diverged: those that still do so at that step do"
            " probably not fail because of the step; study.worst() finds them."
        )
    notices.warn(text)


def warn_of_sampling(status: np.ndarray, radii: np.ndarray | None) -> None:
    """Warns if deviations of sampled runs of a study grow because of the sampling.

    Args:
      status: of each run, (N,).
      radii: `sampling_radius` of each run, (N,) [1]; None for a continuous law.
    """
    slow = has_flag(status, Status.SAMPLING_TOO_SLOW)
    if radii is None or not slow.any():
        return
    worst = int(np.argmax(np.where(slow, radii, -np.inf)))
    notices.warn(
        f"The law is sampled too slowly in {slow.sum()} of {status.size} runs: the deviation of the"
        f" loop grows from one period to the next, by {growth_in_words(float(radii[worst]))} at"
        f" the worst of the assessed states (run {worst}). Make sampling.period [s] shorter (in"
        " Python, ij.recommended_period(study.replay(i).scenario) returns how long it may be in"
        " run i)."
    )

"""The messages about a run that failed or may be unreliable: its status flags in words, with the
quantities that caused them and the remedy.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.controllers._base import law_member
from iblf_jax.core import checks, notices
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import FAILED, Status, describe
from iblf_jax.engine.limiting_term import limiting_term
from iblf_jax.engine.step_size import comfortable_dt, find_dt
from iblf_jax.simulation.error_estimate import ERROR, RELATIVE, TOLERANCE
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.signals import has
from iblf_jax.simulation.stability import RADIUS, THIRD_SIZE
from iblf_jax.world.bounds import tube_at
from iblf_jax.world.regions import in_words
from iblf_jax.world.robots import joint_names

REPORTED = (
    Status.INACCURATE
    | Status.GUARD_STAYED
    | Status.SAMPLING_TOO_SLOW
    | Status.FILTER_INFEASIBLE
    | Status.INFINITE_SLOPE
)
"""The flags that a warning reports although the run did not fail."""


class SimulationError(RuntimeError):
    """A run that failed, raised by `simulate(..., throw=True)`."""


class SimulationWarning(UserWarning):
    """A run that failed or whose result may be unreliable."""


def report(result: Rollout, steps: int, throw: bool) -> None:
    """Raises (`throw`) or warns if a run failed, and warns if it may be unreliable."""
    status = Status(int(result.status))
    if status & Status.INFEASIBLE_REFERENCE:
        raise _infeasible(result, steps)
    failed = status & FAILED
    reported = failed | status & REPORTED
    if law_member(unwrapped(result.scenario.controller), "needs_velocity_bounds"):
        reported |= status & Status.ALPHA_INFEASIBLE
    if not reported:
        return
    heading = "Look again"
    if failed:
        heading = "The run failed"
    explained = status
    if not reported & Status.ALPHA_INFEASIBLE:
        explained &= ~Status.ALPHA_INFEASIBLE
    text = " ".join([f"{heading}: {describe(reported)}.", *_explanations(result, explained, steps)])
    if throw and failed:
        raise SimulationError(text)
    notices.warn(text, SimulationWarning)


def _explanations(result: Rollout, status: Status, steps: int) -> list[str]:
    """The explanations of the flags of a status that have one."""
    texts = [text(result) for flag, text in BOUND_EXPLANATIONS.items() if status & flag]
    if status & Status.STEP_TOO_LARGE:
        texts.append(_unstable_step(result))
    elif status & Status.NOT_FINITE and np.isfinite(result.fastest_mode):
        texts.append(
            "The step was small enough for the fastest mode: look at the gains, the start and the"
            " disturbance."
        )
    elif status & Status.INACCURATE:
        texts.append(_inaccurate(result, status, steps))
    texts += [text(result) for flag, text in LOOP_EXPLANATIONS.items() if status & flag]
    return [text for text in texts if text]


def _joint_violation(bounds: str, prefix: str, margin: str, unit: str, result: Rollout) -> str:
    """Which joint violated its bounds first; `prefix` and `margin` are names of metrics."""
    metrics = result.metrics
    if f"{prefix}_time" not in metrics:
        return ""
    joint = int(metrics[f"{prefix}_joint"])
    what = f"{_joint_in_words(result, joint)} left its {bounds} first"
    return _first_violation(what, metrics[f"{prefix}_time"], metrics[margin][joint], unit)


def _region_violation(result: Rollout) -> str:
    metrics = result.metrics
    if "first_region_violation_time" not in metrics:
        return ""
    i = int(metrics["first_region_violation_region"])
    region = in_words(result.scenario.regions[i], result.scenario.plant)
    return _first_violation(
        f"regions[{i}]: {region} crossed its boundary",
        metrics["first_region_violation_time"],
        metrics["region_margin"][i],
        "m",
    )


def _first_violation(what: str, time: jax.Array, margin: jax.Array, unit: str) -> str:
    return f"{what}, at t = {float(time):.4g} s; its smallest margin is {float(margin):.3g} {unit}."


def _unstable_step(result: Rollout) -> str:
    mode = float(result.fastest_mode)
    limit = tableau(result.method).stability / mode
    return (
        f"The closed loop's fastest mode is {mode:.4g} 1/s, so {result.method} is stable up to"
        f" dt = {limit:.3g} s only; dt = {float(result.dt):g} s was requested. Take"
        f" dt={comfortable_dt(mode):g}{_alternative_remedy(result)}."
    )


def _infinite_slope(result: Rollout) -> str:
    return (
        "At an isolated instant the derivative of the closed loop with respect to a state is"
        " infinite or nearly so, as that of |e2|^a sign(e2) with a < 1 is with respect to e2 ="
        " q' - alpha where e2 = 0, or that of sharp dry friction at a reversal. That is no"
        f" fast mode, so the time step is assessed by differences of {THIRD_SIZE:g} rad/s there."
        " Derivatives of the run are not reliable; replace such a power by e2 (e2^2 +"
        " delta^2)^((a - 1)/2) with a small delta."
    )


def _sampling_too_slow(result: Rollout) -> str:
    return (
        "The deviation of the loop grows from one period to the next, by"
        f" {float(result.metrics[RADIUS]):.4g} at the worst of the assessed instants. Sample faster"
        f" (ij.recommended_period says how fast){_alternative_remedy(result)}."
    )


def _filter_infeasible(result: Rollout) -> str:
    worst = f"{float(np.max(result.slack)):.3g} rad/s^2 (run.slack)"
    if has(result, "region_slack"):
        worst += f" and {float(np.max(result.region_slack)):.3g} m/s^2 (run.region_slack)"
    return (
        "At the recorded samples the filter's accelerations exceeded what its conditions allow by"
        f" up to {worst}. Raise controller.limit, or lower a1, a2, a3, b1 and b2, so that it"
        " brakes sooner."
    )


def _alpha_infeasible(result: Rollout) -> str:
    worst = "at some time"
    if "alpha_margin" in result.metrics:
        worst = f"by up to {-float(np.min(result.metrics['alpha_margin'])):.3g} rad/s"
    return (
        f"The virtual velocity alpha left the velocity bounds {worst}: nothing is claimed"
        " there. Start nearer to the reference, slow it down, widen the velocity bounds or"
        " lower controller.k1."
    )


def _guard_stayed(result: Rollout) -> str:
    return (
        "While the guard is active the barrier is softer than the requested one: what ran there is"
        " another law. Start or stay further from the bounds, or give the barrier a smaller guard."
    )


BOUND_EXPLANATIONS: dict[Status, Callable[[Rollout], str]] = {
    Status.BOUND_VIOLATED: partial(_joint_violation, "bounds", "first_violation", "margin", "rad"),
    Status.VELOCITY_VIOLATED: partial(
        _joint_violation, "velocity bounds", "first_velocity_violation", "velocity_margin", "rad/s"
    ),
    Status.REGION_VIOLATED: _region_violation,
}
"""The explanation of each flag of a violated bound."""
LOOP_EXPLANATIONS: dict[Status, Callable[[Rollout], str]] = {
    Status.INFINITE_SLOPE: _infinite_slope,
    Status.SAMPLING_TOO_SLOW: _sampling_too_slow,
    Status.FILTER_INFEASIBLE: _filter_infeasible,
    Status.ALPHA_INFEASIBLE: _alpha_infeasible,
    Status.GUARD_STAYED: _guard_stayed,
}
"""The explanation of each flag of the control law and its sampling."""


def _inaccurate(result: Rollout, status: Status, steps: int) -> str:
    """The estimated error of a run, and the remedy."""
    error = float(np.max(result.metrics[ERROR]))
    relative = float(np.max(result.metrics[RELATIVE]))
    estimate = (
        f"Their error is estimated at {error:.2g} rad, {100 * relative:.2g} % of the tube, where"
        f" {100 * TOLERANCE:g} % are tolerated"
    )
    if status & Status.SAMPLING_TOO_SLOW:
        return (
            f"{estimate}: a loop whose deviation grows from one period to the next magnifies every"
            " error, whatever dt is."
        )
    return (
        f"{estimate}: dt = {float(result.dt):g} s is too large for the signals that drive this"
        f" loop. Take {_smaller_step(result, steps)}."
    )


def _smaller_step(result: Rollout, steps: int) -> str:
    """A time step that makes this run accurate, in words."""
    if not checks.is_concrete(result.scenario):
        return "a smaller one"
    duration = steps * float(result.dt)
    try:
        return f"dt={find_dt(result.scenario, duration=duration, method=result.method):g}"
    except ValueError:  # the run is too long for trial runs
        return "a smaller one"


def _alternative_remedy(result: Rollout) -> str:
    """The end of a sentence: the term that limits the loop, and how to change it; empty if no
    single term does.
    """
    if not checks.is_concrete(result.scenario):
        return ""
    limit = limiting_term(result)
    if limit is None:
        return ""
    return f", or {limit.advice}: of all terms {limit.term.words} limits this loop"


def _joint_in_words(result: Rollout, joint: int) -> str:
    """A joint by its number, and by its name if it has one."""
    name = joint_names(result.scenario.plant, result.n)[joint]
    if name == f"joint {joint}":
        return f"Joint {joint}"
    return f"Joint {joint} ({name})"


def _infeasible(result: Rollout, steps: int) -> ValueError:
    """The error for a reference that touches a bound (Assumption 2), with joint and time."""
    times = jnp.arange(steps + 1).astype(result.dt.dtype) * result.dt
    tube_of_run = partial(tube_at, result.scenario.reference, result.scenario.bounds)
    tube = jax.jit(jax.vmap(tube_of_run))(times)
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

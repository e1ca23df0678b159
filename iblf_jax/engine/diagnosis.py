"""The messages about a run that failed or may be unreliable: its status flags in words, with the
quantities that caused them and the remedy.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.barriers import Quadratic
from iblf_jax.core import checks, notices
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import FAILED, LOST, Status, describe
from iblf_jax.core.units import POSITION, VELOCITY
from iblf_jax.engine.limiting_term import limiting_term
from iblf_jax.engine.step_size import comfortable_dt, find_dt, limited
from iblf_jax.simulation.error_estimate import ERROR, RELATIVE, TOLERANCE
from iblf_jax.simulation.error_growth import BOUND
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.metrics import VIOLATION_TIMES
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import has
from iblf_jax.simulation.stability import RADIUS, THIRD_SIZE, growth_in_words
from iblf_jax.simulation.units import status_words, unit_text
from iblf_jax.world import plants
from iblf_jax.world.bounds import NARROWEST, tube_at
from iblf_jax.world.references import WaypointSpline
from iblf_jax.world.regions import in_words

REPORTED = (
    Status.INACCURATE
    | Status.GUARD_STAYED
    | Status.SAMPLING_TOO_SLOW
    | Status.FILTER_INFEASIBLE
    | Status.INFINITE_SLOPE
    | Status.MODES_EXHAUSTED
)
"""The flags that a warning reports although the run did not fail."""


CONSEQUENCES = Status.INACCURATE | Status.GUARD_STAYED | Status.INFINITE_SLOPE
"""The flags that a message leaves out of a run that diverged: they follow from it, and the causes
stand out without them."""


class SimulationError(RuntimeError):
    """A run that failed, raised by `simulate(..., throw=True)`."""


class SimulationWarning(UserWarning):
    """A run that failed or whose result may be unreliable."""


def report(result: Rollout, steps: int, throw: bool) -> None:
    """Raises (`throw`) or warns if a run failed, and warns if it may be unreliable."""
    status = Status(int(result.status))
    if status & Status.INFEASIBLE_REFERENCE:
        raise _infeasible(result, steps)
    if status & Status.NOT_FINITE:
        status &= ~CONSEQUENCES
    failed = status & FAILED
    reported = failed | status & REPORTED
    law = unwrapped(result.scenario.controller)
    knows_bounds = law.needs_velocity_bounds or law.receives_x
    if knows_bounds or _fast_reference(result):
        reported |= status & Status.ALPHA_INFEASIBLE
    if not reported:
        return
    heading = "Look again"
    if failed:
        heading = "The run failed"
    explained = status
    if not reported & Status.ALPHA_INFEASIBLE:
        explained &= ~Status.ALPHA_INFEASIBLE
    text = " ".join(
        [
            f"{heading}: {describe(status, status_words(result.scenario))}.",
            *_explanations(result, explained, steps),
        ]
    )
    if throw and failed:
        raise SimulationError(text)
    notices.warn(text, SimulationWarning)


def _explanations(result: Rollout, status: Status, steps: int) -> list[str]:
    """The explanations of the flags of a status that have one."""
    violated = [flag for flag in BOUND_EXPLANATIONS if status & flag]
    violated.sort(key=lambda flag: float(result.metrics.get(VIOLATION_TIMES[flag], np.inf)))
    texts = [BOUND_EXPLANATIONS[flag](result) for flag in violated]
    sampling = result.scenario.sampling
    if violated and sampling is not None:
        time = float(result.metrics.get(VIOLATION_TIMES[violated[0]], np.inf))
        if time < float(sampling.period):
            texts.append(
                f"The law had run once until then: sampling.period is {float(sampling.period):g} s."
                " Make it shorter."
            )
    singular = ""
    if status & (Status.SINGULAR_GAIN | Status.NOT_FINITE):
        singular = _singular_gain(result)
    if status & Status.STEP_TOO_LARGE:
        texts.append(_unstable_step(result))
    elif singular:
        texts.append(singular)
    elif status & Status.NOT_FINITE and np.isfinite(result.fastest_mode):
        texts.append(
            "The step was small enough for the fastest mode: look at the gains, the start and the"
            " disturbance."
        )
    elif status & Status.INACCURATE:
        texts.append(_inaccurate(result, status, steps))
    if status & (Status.VELOCITY_VIOLATED | Status.ALPHA_INFEASIBLE):
        texts.append(_fast_reference(result))
    texts += [text(result) for flag, text in LOOP_EXPLANATIONS.items() if status & flag]
    return [text for text in texts if text]


def _violation(level: int, prefix: str, margin: str, result: Rollout) -> str:
    """Which component violated the bounds of the first or second level first; `prefix` and `margin`
    are names of metrics.
    """
    metrics = result.metrics
    if f"{prefix}_time" not in metrics:
        return ""
    joint = int(metrics[f"{prefix}_joint"])
    return _first_violation_of(
        result, level, joint, metrics[f"{prefix}_time"], metrics[margin][joint]
    )


def _higher_violation(result: Rollout) -> str:
    """Which level from the third on violated its bounds first."""
    metrics = result.metrics
    if "first_level_violation_time" not in metrics:
        return ""
    level = int(metrics["first_level_violation_level"])
    joint = int(metrics["first_level_violation_component"])
    margin = metrics["level_margin"][level - 3, joint]  # its first row is that of level 3
    return _first_violation_of(result, level, joint, metrics["first_level_violation_time"], margin)


def _first_violation_of(
    result: Rollout, level: int, joint: int, time: jax.Array, margin: jax.Array
) -> str:
    """That a component of a level left its bounds first, and how these can be kept."""
    scenario, plant = result.scenario, result.scenario.loop.plant
    unit = unit_text(scenario, plants.units_of(plant)[level - 1], joint)
    what = f"{plant.notation.left_bounds(level, joint)} first"
    found = _first_violation(what, time, margin, unit)
    if level <= plant.reference_levels:
        return found
    return f"{found} {_level_remedy(scenario, level)}"


def _level_remedy(scenario: Scenario, level: int) -> str:
    """How the bounds of a level above the first can be kept, in words."""
    law = unwrapped(scenario.controller)
    field = f"bounds[{level - 1}]"
    if not law.receives_x:
        return (
            f"{type(law).__name__} knows no bounds of that level; controllers.BarrierBackstepping"
            " keeps them."
        )
    barriers = law.barriers
    if level <= len(barriers) and isinstance(barriers[level - 1], Quadratic):
        return (
            "The law has barriers.Quadratic() on that level, which keeps no bounds: give it"
            " barriers.TransformedError() there."
        )
    return (
        f"Widen {field}, start nearer to the virtual control, reduce the disturbances or take a"
        " smaller dt."
    )


def _singular_gain(result: Rollout) -> str:
    """Which gain is singular where a run ends, in words; empty if none is."""
    scenario = result.scenario
    model = scenario.loop.model
    if not model.loses_input:
        return ""
    # The last recorded sample at which the state still moved and the input was finite.
    moved = np.any(np.diff(np.asarray(result.x), axis=0) != 0, axis=(1, 2))
    has_input = np.isfinite(np.asarray(result.tau)).all(axis=-1)
    valid = np.flatnonzero(np.append(True, moved) & has_input)
    at = int(valid[-1]) if valid.size else 0
    x, t = np.asarray(result.x)[:, : model.order], np.asarray(result.t)
    ahead = range(EXAMINED_AHEAD + 1)
    states = [x[0], *[x[at] + k * (x[at] - x[max(at - 1, 0)]) for k in ahead]]
    times = [t[0], *[t[at]] * len(ahead)]
    smallest = np.array([_smallest_gains(model, *each) for each in zip(times, states, strict=True)])
    worst = np.min(smallest[1:] / smallest[0], axis=0)
    level = int(np.argmin(worst)) + 1
    if not worst[level - 1] < NEARLY_SINGULAR:
        return ""
    name = scenario.loop.plant.notation.numbered(level)
    state = np.array2string(x[at].ravel(), precision=4, threshold=8)
    return (
        f"At t = {t[at]:.4g} s the gain of {name} is singular, or nearly so, at or"
        f" next to x = {state}, so that the law's input has no value: bound the levels so that they"
        " stay away from that state, or change the reference or the start."
    )


def _smallest_gains(model: Any, t: Any, x: np.ndarray) -> np.ndarray:
    """The smallest singular value of the gain of each level, 0 where it is not finite, (order,)."""
    found = []
    for gain in np.asarray(model.gain(jnp.asarray(t), jnp.asarray(x))):
        matrix = np.diag(gain) if gain.ndim == 1 else gain
        finite = bool(np.all(np.isfinite(matrix)))
        found.append(np.linalg.norm(matrix, -2) if finite else 0.0)
    return np.array(found)


EXAMINED_AHEAD = 3
"""Recorded samples by which the motion is continued beyond the last valid one."""
NEARLY_SINGULAR = 1e-3
"""A gain counts as nearly singular where its smallest singular value is below this share of that
at the start."""


def _region_violation(result: Rollout) -> str:
    metrics = result.metrics
    if "first_region_violation_time" not in metrics:
        return ""
    i = int(metrics["first_region_violation_region"])
    robot = checks.given(result.scenario.loop.plant.robot)
    region = in_words(result.scenario.regions[i], robot)
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
    needed = comfortable_dt(mode, result.method)
    if int(result.status) & LOST:
        to_try = limited(needed, float(result.dt))
        if to_try > needed:
            return (
                f"The closed loop's fastest mode is {mode:.4g} 1/s, but the run left its bounds or"
                f" diverged, and the mode may be that of the failure. Take dt={to_try:g}: if the"
                " run fails at that step too, the step is not the cause. Then look at the gains,"
                " the start and the disturbance."
            )
    return (
        f"The closed loop's fastest mode is {mode:.4g} 1/s, so {result.method} is stable up to"
        f" dt = {limit:.3g} s only; dt = {float(result.dt):g} s was requested. Take"
        f" dt={needed:g}{_alternative_remedy(result)}."
    )


def _infinite_slope(result: Rollout) -> str:
    return (
        "At an isolated instant the derivative of the closed loop with respect to a state is"
        " infinite or nearly so, as that of a power |e2|^a sign(e2) with a < 1 with respect to e2"
        " at e2 = 0, of a square root at 0, or of sharp dry friction at a reversal. That is no"
        f" fast mode, so the time step is assessed by differences of {THIRD_SIZE:g}"
        f" {result.scenario.loop.plant.notation.difference} there."
        " Derivatives of the run are not reliable. If the law has such a power, replace it by"
        " e2 (e2^2 + delta^2)^((a - 1)/2) with a small delta."
    )


def _sampling_too_slow(result: Rollout) -> str:
    period = float(result.scenario.sampling.period)  # type: ignore[union-attr]
    return (
        "The deviation of the loop grows from one period to the next, by"
        f" {growth_in_words(float(result.metrics[RADIUS]))} at the worst of the assessed states of"
        " this run (another start visits others). Sample faster: sampling.period is"
        f" {period:g} s (in Python, ij.recommended_period(scenario) returns how long it may"
        f" be){_alternative_remedy(result)}."
    )


def _modes_exhausted(result: Rollout) -> str:
    plant: Any = result.scenario.plant
    return (
        f"The path of the plant's modes ends after {plant.switches} switches, before the end of the"
        " run. Increase plant.switches."
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
    if result.scenario.loop.plant.reference_levels == 1:
        return _alphas_infeasible(result)
    worst = "at some time"
    if "alpha_margin" in result.metrics:
        worst = f"by up to {-float(np.min(result.metrics['alpha_margin'])):.3g} rad/s"
    return (
        f"The virtual velocity alpha left the velocity bounds {worst}: nothing is claimed"
        " there. Start nearer to the reference, slow it down, widen the velocity bounds or"
        " lower controller.k1."
    )


def _fast_reference(result: Rollout) -> str:
    """Which joint's reference touches or leaves its velocity bounds, in words; empty if none does.

    A reference has a second level where this is the derivative of the first one.
    """
    if result.scenario.loop.plant.reference_levels == 1 or not has(result, "dq_lower"):
        return ""
    if not checks.is_concrete(result):
        return ""
    dq_d, lower, upper = (np.asarray(x) for x in (result.dq_d, result.dq_lower, result.dq_upper))
    margin = np.minimum(dq_d - lower, upper - dq_d)
    sample, joint = np.unravel_index(np.argmin(margin), margin.shape)
    if margin[sample, joint] > NARROWEST:
        return ""
    reached, limit = dq_d[sample, joint], upper[sample, joint]
    if reached < lower[sample, joint] + NARROWEST:
        limit = lower[sample, joint]
    unit = unit_text(result.scenario, VELOCITY, int(joint))
    return (
        f"The reference of {plants.components_in_words(result.scenario.plant)[joint]} reaches"
        f" {reached:.4g} {unit} at t = {float(result.t[sample]):.4g} s, its limit is"
        f" {limit:.4g} {unit}: no law can follow it inside the velocity bounds. Slow it down, or"
        " widen scenario.bounds[1]."
    )


def _torque_saturated(result: Rollout) -> str:
    """How long the actuator cut the input of a run that failed or is doubtful."""
    if "saturated_share" not in result.metrics or not checks.is_concrete(result):
        return ""
    share = np.asarray(result.metrics["saturated_share"])
    names = plants.component_names(result.scenario.plant)
    shares = [
        f"{100 * x:.2g} % of the time in {name}"
        for name, x in zip(names, share, strict=True)
        if x > 0
    ]
    return (
        f"The actuator's limit cut the input, {', '.join(shares)}: no claim of the law holds there."
    )


def _alphas_infeasible(result: Rollout) -> str:
    """Which virtual controls left the bounds of the levels that they are for, and by how much."""
    scenario, plant = result.scenario, result.scenario.loop.plant
    found = []
    for level in range(2, plant.order + 1):
        margin = _alpha_margin(result, level)
        if margin is None or np.min(margin) > NARROWEST:
            continue
        joint = int(np.argmin(margin))
        unit = unit_text(scenario, plants.units_of(plant)[level - 1], joint)
        found.append(
            f"Alpha_{level - 1}, the virtual control for level {level}, left the bounds by up to"
            f" {-margin[joint]:.3g} {unit}{_first_time_outside(result, level)}:"
            f" {plant.notation.numbered_component(level, joint)} cannot follow it inside them."
        )
    if not found:
        found.append("A virtual control left the bounds of the level that it is for.")
    found.append(
        "As for a reference outside its bounds (Assumption 2), nothing is claimed there. Start"
        " nearer to the reference, slow it down, widen the bounds of the level or lower"
        " controller.k of the levels below."
    )
    return " ".join(found)


def _alpha_margin(result: Rollout, level: int) -> np.ndarray | None:
    """The smallest distance of a level's virtual control to the bounds of the level, (n,); None
    where the run has no such metric.
    """
    if level == 2 and "alpha_margin" in result.metrics:
        return np.asarray(result.metrics["alpha_margin"])
    margins = np.asarray(result.metrics.get("level_alpha_margin", ()))
    return margins[level - 3] if 2 < level < len(margins) + 3 else None


def _first_time_outside(result: Rollout, level: int) -> str:
    """When a virtual control is outside the bounds of its level first, among the recorded
    samples, in words; empty if it is inside at all of them.
    """
    i = level - 1
    alpha = result.alpha if level == 2 else result.x[:, i] - result.e[:, i]
    lower, upper = result.level_lower[:, i], result.level_upper[:, i]
    outside = np.any(np.minimum(alpha - lower, upper - alpha) <= 0, axis=-1)
    if not outside.any():
        return ""
    return f", first at t = {float(result.t[int(np.argmax(outside))]):.4g} s"


def _guard_stayed(result: Rollout) -> str:
    return (
        "While the guard is active the barrier is softer than the requested one: what ran there is"
        " another law. Start or stay further from the bounds, or give the barrier a smaller guard."
    )


BOUND_EXPLANATIONS: dict[Status, Callable[[Rollout], str]] = {
    Status.BOUND_VIOLATED: partial(_violation, 1, "first_violation", "margin"),
    Status.VELOCITY_VIOLATED: partial(_violation, 2, "first_velocity_violation", "velocity_margin"),
    Status.STATE_BOUND_VIOLATED: _higher_violation,
    Status.REGION_VIOLATED: _region_violation,
}
"""The explanation of each flag of a violated bound."""
LOOP_EXPLANATIONS: dict[Status, Callable[[Rollout], str]] = {
    Status.INFINITE_SLOPE: _infinite_slope,
    Status.SAMPLING_TOO_SLOW: _sampling_too_slow,
    Status.FILTER_INFEASIBLE: _filter_infeasible,
    Status.ALPHA_INFEASIBLE: _alpha_infeasible,
    Status.TORQUE_SATURATED: _torque_saturated,
    Status.GUARD_STAYED: _guard_stayed,
    Status.MODES_EXHAUSTED: _modes_exhausted,
}
"""The explanation of each flag of the control law and its sampling."""


def _inaccurate(result: Rollout, status: Status, steps: int) -> str:
    """The estimated error of a run, and the remedy."""
    errors = np.asarray(result.metrics[ERROR])
    worst = int(np.argmax(errors))
    unit = unit_text(result.scenario, POSITION, worst)
    relative = float(np.max(result.metrics[RELATIVE]))
    estimate = (
        f"Their error is estimated at {errors[worst]:.2g} {unit}, {100 * relative:.2g} % of the"
        f" tube, where {100 * TOLERANCE:g} % are tolerated"
    )
    if status & Status.SAMPLING_TOO_SLOW:
        return (
            f"{estimate}: a loop whose deviation grows from one period to the next magnifies every"
            " error, whatever dt is."
        )
    if np.max(result.metrics.get(BOUND, 0.0)) > TOLERANCE:
        return (
            f"{estimate}. The loop rounds a reading or a torque, has a dead zone or play, or holds"
            " commands until an event. At one sample at least the error of this run is so large"
            " that a code or an event may differ from that of the exact solution; the motions then"
            " differ by up to that bound, whatever dt is. Statistics of many such runs are not"
            " concerned. Refine the resolution, such as sensor.counts or actuator.step, to reduce"
            f" the bound, or compare this run with one at dt={float(result.dt) / 10.0:g}: where"
            " no error reaches a code, it has no such bound."
        )
    step = _smaller_step(result, steps)
    if not step:
        return (
            f"{estimate}. Trial runs recommend no smaller step: compare this run with one at a"
            " tenth of dt. If they differ, the loop magnifies every error, whatever dt is."
        )
    return (
        f"{estimate}: dt = {float(result.dt):g} s is too large for the signals that drive this"
        f" loop. Take {step}."
    )


def _smaller_step(result: Rollout, steps: int) -> str:
    """A time step that makes this run accurate, in words; empty if trial runs find none that is
    smaller.
    """
    if not checks.is_concrete(result.scenario):
        return "a smaller one"
    if result.scenario.actuator.input_delay is not None:
        # Every number of steps in a delay is a program of its own.
        return "a smaller one, a whole part of actuator.delay"
    duration = steps * float(result.dt)
    try:
        dt = find_dt(result.scenario, duration=duration, method=result.method)
    except ValueError:  # the run is too long for trial runs
        return "a smaller one"
    if dt >= float(result.dt):
        return ""
    return f"dt={dt:g}"


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


def _infeasible(result: Rollout, steps: int) -> ValueError:
    """The error for a reference that touches a bound (Assumption 2), with joint and time."""
    times = jnp.arange(steps + 1).astype(result.dt.dtype) * result.dt
    tube_of_run = partial(tube_at, result.scenario.reference, result.scenario.bounds[0])
    tube = jax.jit(jax.vmap(tube_of_run))(times)
    q_d, lower, upper = (np.asarray(x) for x in (tube.q_d, tube.lower, tube.upper))
    sample, joint = np.unravel_index(np.argmin(np.minimum(q_d - lower, upper - q_d)), q_d.shape)
    where = f"t = {float(times[sample]):.4g} s"
    remedy = "The reference must stay strictly inside the bounds (Assumption 2): move it, widen the"
    remedy += " bounds or shorten the run."
    if isinstance(result.scenario.reference, WaypointSpline):
        remedy += (
            " A WaypointSpline may pass beyond its waypoints: move those near the bound further"
            " inside, or add some there."
        )
    return checks.fail(
        f"reference of {plants.components_in_words(result.scenario.plant)[joint]}",
        float(q_d[sample, joint]),
        f"a value inside the bounds ({float(lower[sample, joint]):.6g},"
        f" {float(upper[sample, joint]):.6g}) at {where}",
        f"{remedy} A law that keeps the bounds whatever the reference is states has_slack = True,"
        " and its Command has a slack.",
    )

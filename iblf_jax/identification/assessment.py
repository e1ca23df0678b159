"""Assessment of a fit: statistics, verdicts and notes, which `assessed` puts into the result."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iblf_jax.identification.coordinates import DELAY_PATH, DELAY_SCALE, Coordinates, to_x
from iblf_jax.identification.missing_terms import (
    MissingTerms,
    biased,
    describe_finding,
    missing_terms,
    remedy_for,
)
from iblf_jax.identification.problem import IdentificationProblem
from iblf_jax.identification.regression import InitialEstimate, inverse_dynamics_along
from iblf_jax.identification.result import (
    BIASED,
    IDENTIFIED,
    INCOMPLETE_RATIO,
    LIMITED,
    NOT_ESTIMATED,
    NOT_IDENTIFIABLE,
    Fit,
    Identification,
    Number,
)
from iblf_jax.identification.shooting import Refinement
from iblf_jax.identification.smoothing import SmoothedMotion
from iblf_jax.identification.statistics import (
    IDENTIFIABLE_BELOW,
    Uncertainty,
    Whiteness,
    describe_direction,
    uncertainty,
    whiteness,
)
from iblf_jax.simulation.paths import parameters, with_parameters
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world.robots import joint_names

REPORTED_RATIO = 1.1
"""Ratio of standard errors to those for white noise above which a note reports it."""
MIN_INFORMATION = 1e-8
"""Information of a combination, relative to the best one, above which it enters the step without
limits."""
LIMIT_TOLERANCE = 1e-6
"""Distance from a limit, in scales, within which a number is at it."""


def assessed(
    problem: IdentificationProblem,
    initial: InitialEstimate,
    refinement: Refinement,
    residuals_before: np.ndarray,
    friction_ratio: float,
    seconds: float,
) -> Identification:
    """The result of a fit, with its statistics.

    Args:
      problem: what was identified from which data.
      initial: the regression.
      refinement: the fit.
      residuals_before: residuals with the parameters of the start.
      friction_ratio: residual of the friction law relative to that of free torques (0 without).
      seconds: computing time.
    """
    start, c, windows = problem.start, problem.coordinates, problem.windows
    residuals = refinement.statistics.residuals
    white = [whiteness(joint) for joint in np.moveaxis(residuals[windows.kept], -1, 0)]
    fit = _fits(problem, residuals, residuals_before, white, initial)
    scale = np.append(initial.scale, DELAY_SCALE)
    found = _statistics(problem, refinement, scale, max(one.lacking for one in fit))
    x = np.where(refinement.free.fixed, c.x, to_x(c, refinement.z[:-1])[0])
    missing = MissingTerms((), np.zeros(len(x)))
    if any(one.has_structure for one in fit):
        fitted = found.estimated & ~found.at_limits.any(axis=0)
        missing = missing_terms_of_fit(problem.simulated, c, problem.motion, refinement.z, fitted)
    numbers = _numbers(c, x, refinement, found, biased(missing, x, found.errors[:-1]), scale)
    scenario, scenario_notes = _with_numbers(start, c, x, refinement.z[-1], found.errors[-1])
    return Identification(
        scenario=scenario,
        start=start,
        paths=c.paths,
        requested=problem.requested,
        numbers=numbers,
        covariance=found.covariance[:-1, :-1],
        delay=float(refinement.z[-1]),
        delay_error=found.delay_error,
        singular_values=found.uncertainty.singular,
        combinations=found.combinations,
        untold=found.unidentifiable,
        scales=scale[:-1],
        fit=fit,
        residuals=residuals,
        times=windows.t,
        kept=windows.kept,
        autocorrelations=np.array([one.correlations for one in white]),
        notes=(
            *_notes_on_missing_terms(start, missing, numbers),
            *scenario_notes,
            *_notes_on_limits(c, numbers, found.unlimited_step, problem.limits),
            *_notes_on_residuals(found.uncertainty, numbers, fit),
            *_notes_on_standstill(start, refinement, friction_ratio),
        ),
        logs=tuple(log.name for log in problem.logs),
        steps=refinement.steps,
        seconds=seconds,
    )


# ----------------------------------------------------------------- statistics and verdicts


class _Statistics(NamedTuple):
    """The uncertainty of a fit; arrays have the p parameters and the delay."""

    estimated: np.ndarray
    """Entries that are estimated, (p + 1,) bool."""
    uncertainty: Uncertainty
    errors: np.ndarray
    """Standard errors, (p + 1,); infinite where an entry is not estimated."""
    covariance: np.ndarray
    """(p + 1, p + 1); zero where an entry is not estimated."""
    unlimited_step: np.ndarray
    """The Gauss-Newton step without limits, (p + 1,)."""
    at_limits: np.ndarray
    """Whether an entry is at its lower and at its upper limit, (2, p + 1) bool."""
    combinations: tuple[str, ...]
    """The combinations of parameters, from the best one on."""

    @property
    def delay_error(self) -> float | None:
        """Standard error of the delay [s]; None if the delay was given."""
        if not self.estimated[-1]:
            return None
        return float(self.errors[-1])

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """The combinations that the log does not identify."""
        pairs = zip(self.combinations, self.uncertainty.singular, strict=True)
        return tuple(text for text, size in pairs if not size > 1.0 / IDENTIFIABLE_BELOW)


def _statistics(
    problem: IdentificationProblem, refinement: Refinement, scale: np.ndarray, lacking: float
) -> _Statistics:
    """The statistics of a fit.

    Args:
      problem: what was identified from which data.
      refinement: the fit.
      scale: of the parameters and the delay, (p + 1,).
      lacking: the largest residual, relative to the noise of the positions.
    """
    kept = problem.windows.kept
    x, slope = to_x(problem.coordinates, refinement.z[:-1])
    p = len(x)
    z_by_x = np.eye(p + 1)
    z_by_x[:p, :p] = np.linalg.inv(slope)
    estimated = np.append(~refinement.free.fixed, problem.fixed_delay is None)
    both = np.ix_(estimated, estimated)
    information = z_by_x.T @ refinement.statistics.information[kept] @ z_by_x
    information = information[:, estimated][:, :, estimated]
    scores = (refinement.statistics.scores[kept] @ z_by_x)[:, estimated]
    precision = np.zeros((p + 1, p + 1))
    precision[:p, :p] = problem.prior.precision
    if lacking <= INCOMPLETE_RATIO:  # the residuals are noise
        lacking = 1.0
    own_scale = scale[estimated]
    found = uncertainty(information, scores, precision[both], own_scale, lacking)
    errors = np.full(p + 1, np.inf)
    errors[estimated] = found.errors
    covariance = np.zeros((p + 1, p + 1))
    covariance[both] = found.covariance
    from_prior = precision @ np.append(x - problem.prior.mean, 0.0)
    all_scores = scores + from_prior[estimated] / len(scores)
    A = np.sum(information, axis=0) * own_scale[:, None] * own_scale
    g = np.sum(all_scores, axis=0) * own_scale
    unlimited_step = np.zeros(p + 1)
    unlimited_step[estimated] = -own_scale * np.linalg.lstsq(A, g, rcond=MIN_INFORMATION)[0]
    at_limits = np.abs(refinement.z - np.stack(problem.limits)) < LIMIT_TOLERANCE * scale
    all_names = np.array([*problem.coordinates.names, "the torque's delay"])
    names = tuple(all_names[estimated])
    combinations = tuple(describe_direction(column, names) for column in found.directions.T)
    return _Statistics(
        estimated, found, errors, covariance, unlimited_step, at_limits, combinations
    )


def missing_terms_of_fit(
    simulated: Scenario, c: Coordinates, motion: SmoothedMotion, z: np.ndarray, fitted: np.ndarray
) -> MissingTerms:
    """The terms that a fit lacks.

    Args:
      simulated: scenario whose plant was simulated.
      c: coordinates of the parameters.
      motion: the smoothed logs.
      z: end of the fit, (p + 1,), the delay last.
      fitted: entries of z that the fit could move, (p + 1,) bool.
    """
    at_end = inverse_dynamics_along(simulated, c, to_x(c, z[:-1])[0], motion)
    torque, by_x = np.asarray(at_end.torque), np.asarray(at_end.by_x)
    return missing_terms(motion, torque, by_x, float(z[-1]), fitted)


def _numbers(
    c: Coordinates,
    x: np.ndarray,
    refinement: Refinement,
    found: _Statistics,
    bias: np.ndarray,
    scale: np.ndarray,
) -> tuple[Number, ...]:
    """The parameters with their verdicts."""
    numbers = []
    for i, (name, unit) in enumerate(zip(c.names, c.units, strict=True)):
        at_low, at_high = found.at_limits[:, i]
        step = found.unlimited_step[i] / scale[i]
        outwards = (at_low and step < -LIMIT_TOLERANCE) or (at_high and step > LIMIT_TOLERANCE)
        value: float | None = float(x[i])
        error: float | None = None
        if np.isfinite(found.errors[i]):
            error = float(found.errors[i])
        verdict = IDENTIFIED
        if refinement.free.fixed[i]:
            value, error, verdict = None, None, NOT_ESTIMATED
        elif error is None and not outwards:
            value, verdict = None, NOT_IDENTIFIABLE
        elif at_low or at_high:
            verdict = LIMITED
        elif bias[i]:
            verdict = BIASED
        own = Number(name, unit, float(c.x[i]), value, error, verdict)
        if verdict == BIASED:
            own = own._replace(bias=float(bias[i]))
        numbers.append(own)
    return tuple(numbers)


def _fits(
    problem: IdentificationProblem,
    residuals: np.ndarray,
    residuals_before: np.ndarray,
    white: list[Whiteness],
    initial: InitialEstimate,
) -> tuple[Fit, ...]:
    """The fit of each joint."""

    def rms(r: np.ndarray, chosen: np.ndarray) -> list[float]:
        if not np.any(chosen):
            return [np.nan] * r.shape[-1]
        return np.sqrt(np.mean(r[chosen] ** 2, axis=(0, 1))).tolist()

    kept = problem.windows.kept
    return tuple(
        Fit(
            joint=joint,
            before=first,
            after=fitted,
            held_back=other,
            correlation=float(np.max(np.abs(test.correlations))),
            white=test.p,
            explained=explained,
            noise=noise,
        )
        for joint, first, fitted, other, test, explained, noise in zip(
            joint_names(problem.start.plant, problem.start.n),
            rms(residuals_before, kept),
            rms(residuals, kept),
            rms(residuals, ~kept),
            white,
            initial.explained.tolist(),
            initial.noise.tolist(),
            strict=True,
        )
    )


def _with_numbers(
    start: Scenario, c: Coordinates, x: np.ndarray, delay: float, delay_error: float
) -> tuple[Scenario, list[str]]:
    """The scenario with the new parameters, and notes on those that the model does not have."""
    scenario, notes = start, []
    for path, place in zip(c.paths, c.places, strict=True):
        own = x[place.start : place.start + place.size].reshape(place.shape)
        root, _, rest = path.partition(".")
        if root not in ("robot", "plant"):
            scenario = with_parameters(scenario, {path: own})
            continue
        scenario = with_parameters(scenario, {f"plant.{rest}": own})
        try:
            scenario = with_parameters(scenario, {f"model.{rest}": own})
        except ValueError:
            notes.append(f"The model has no model.{rest}: only the plant has this parameter.")
    if c.has_delay_path:
        scenario = with_parameters(scenario, {DELAY_PATH: max(delay, 0.0)})
        if delay < -3.0 * delay_error:
            notes.append(EARLY_TORQUE)
    return scenario, notes


# ----------------------------------------------------------------- notes

EARLY_TORQUE = (
    "The logged torque acts before its time: it is not the command, and the scenario's delay is 0."
)


def _notes_on_missing_terms(
    start: Scenario, missing: MissingTerms, numbers: tuple[Number, ...]
) -> list[str]:
    """Notes on missing terms, remedies, and the parameters that they bias."""
    joints = joint_names(start.plant, start.n)
    leaves = [leaf.path for leaf in parameters(start, named=False)]
    available = [path for path in leaves if path.startswith(("plant.", "disturbance."))]
    names = tuple(number.name for number in numbers)
    lines = [
        describe_finding(one, joints[one.joint], remedy_for(one, available, names))
        for one in missing.findings
    ]
    moved = [f"{x.name} by about {x.bias:+.2g} {x.unit}" for x in numbers if x.verdict == BIASED]
    if moved:
        lines.append(
            f"These parameters compensate for missing terms, and are biased: {', '.join(moved)}."
        )
    return lines


def _notes_on_residuals(
    found: Uncertainty, numbers: tuple[Number, ...], fit: tuple[Fit, ...]
) -> list[str]:
    """Notes on coloured residuals, and on residuals that are larger than the noise."""
    notes = []
    widest = float(np.max(found.widened))
    if not all(one.is_white for one in fit) and widest > REPORTED_RATIO:
        notes.append(
            f"The residuals are coloured: standard errors are up to {widest:.2g} times those of"
            " white noise."
        )
    worst = max(fit, key=lambda one: one.lacking)
    if worst.lacking <= INCOMPLETE_RATIO:
        return notes
    likely = "dry friction that is not identified, backlash, a torque that changes between samples"
    if any(number.verdict == LIMITED for number in numbers):
        likely = f"a value that a limit excludes, {likely}"
    end = "."
    if any(number.value is None for number in numbers):
        end = "; with a complete model, more parameters may be identifiable."
    notes.append(
        f"The residual of {worst.joint} is {worst.lacking:.2g} times the noise of its positions:"
        f" the model is incomplete ({likely}), and all standard errors contain this factor{end}"
    )
    return notes


def _notes_on_limits(
    c: Coordinates,
    numbers: tuple[Number, ...],
    unlimited_step: np.ndarray,
    limits: tuple[np.ndarray, ...],
) -> list[str]:
    """Notes on active limits, and the values that the log suggests."""
    notes = []
    for place, path in zip(c.places, c.paths, strict=True):
        for i in range(place.start, place.start + place.size):
            x = numbers[i]
            if x.verdict != LIMITED or x.value is None:
                continue
            to_low, to_high = (abs(x.value - side[i]) for side in limits)
            side = "lower" if to_low < to_high else "upper"
            notes.append(
                f"{x.name} is at its limit, {x.value:.4g} {x.unit}, and the log asks for about"
                f" {x.value + unlimited_step[i]:.4g}: its standard error has no meaning,"
                f" and other parameters compensate for it.  The {side} end of limits[{path!r}]"
                " changes it."
            )
    return notes


def _notes_on_standstill(start: Scenario, refinement: Refinement, ratio: float) -> list[str]:
    """A note on free torques near standstill; none without them."""
    share = refinement.free.share
    if not np.any(share):
        return []
    names = [
        name for name, part in zip(joint_names(start.plant, start.n), share, strict=True) if part
    ]
    whose = ", ".join(names)
    if len(names) == start.n:
        whose = "all joints"
    ends = share[share > 0].min(), share.max()
    percent = [f"{100 * part:.{int(part <= 0.1)}f}" for part in ends]
    parts = " to ".join(dict.fromkeys(percent))
    return [
        f"Near standstill (slower than {refinement.free.speed_threshold:g} rad/s: {parts} % of the"
        f" time) free torques replaced the friction of {whose}: with coulomb tanh(q' / width) the"
        f" residual is {ratio:.2g} times as large.  The widths are the scenario's."
    ]

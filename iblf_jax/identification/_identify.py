"""`identify`: parameters of a robot from its log."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.pytree import astype
from iblf_jax.identification.coordinates import (
    DELAY_PATH,
    DELAY_SCALE,
    Coordinates,
    coordinates,
    to_x,
    to_z,
    with_widths,
)
from iblf_jax.identification.log import Log, read
from iblf_jax.identification.problem import IdentificationProblem
from iblf_jax.identification.regression import (
    LARGEST_DELAY,
    InitialEstimate,
    coordinate_scales,
    initial_estimate,
)
from iblf_jax.identification.result import INCOMPLETE_RATIO, MIN_NOISE, Identification, assessed
from iblf_jax.identification.shooting import Prior, Refinement, Windows, windows
from iblf_jax.identification.smoothing import smooth_logs
from iblf_jax.identification.standstill import (
    ACCEPTED_RATIO,
    NO_FRICTION_WIDTH,
    REJECTED_RATIO,
    SPEED_THRESHOLDS,
    WORTHWHILE_RATIO,
    FreeTorques,
    free_torques_at_standstill,
    no_free_torques,
)
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical

LOSSES = ("squares", "huber")
TORQUES = ("held", "interpolated")


@notices.each_warning_once
def identify(
    scenario: Scenario,
    log: Any,
    paths: list[str],
    *,
    held_out: Any = 0.2,
    window: float = 0.5,
    torque: str | None = None,
    delay: float | None = None,
    loss: str = "squares",
    widths: bool = True,
    limits: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    iterations: int = 30,
) -> Identification:
    """Parameters of a robot from its log: linear regression, refined by simulation error over
    windows.

        minimise  sum over windows, samples, joints of  rho((y - q) / sigma) / 2,    q the plant
        under the logged torque

    Each window of the log has an initial state of its own, which is estimated as well; sigma of
    each joint is estimated.  The motion comes from positions only, and no control law need be
    known.

    Args:
      scenario: on a robot of n joints; the search starts from its plant's parameters.
      log: t (N,) [s], q (N, n) [rad], tau (N, n) [N m], dq (N, n) [rad/s] if there is one: an
        xarray Dataset, a mapping, a `Rollout`, a CSV
        file (its heading: t, q[0], ..., tau[0], ...) or a netCDF file, or a list of these.  Times
          may be irregular and have gaps.
      paths: of leaves of robot (plant and model), plant, model or disturbance; "sampling.delay" for
        the torque's delay.
      held_out: the share of each log, at its end, that is held back for validation; or a log, or a
        list of logs, for it.
      window: length of the windows [s]; longer ones contain more information, and are more
        sensitive to model errors.
      torque: "held" from a sample to the next, as a digital loop does, or "interpolated", for
        torques that were measured; if not given, interpolated for a `Rollout` of a continuous loop,
        else held.
      delay: delay of the logged torque [s]; estimated if not given.
      loss: "squares", or "huber" for logs with outliers.
      widths: whether the behaviour of Coulomb friction near standstill is identified as well: it is
        tanh(q' / width) with an estimated width, or another law (sticking, a bristle, an impulse)
        that free torques replace.  Otherwise the scenario's widths are assumed; a wrong width
        biases all parameters (7 joints with dry friction: by up to 34 %).
      limits: path -> (low, high) in the leaf's unit, None for the default: masses are above 0,
        friction and damping not below.
      priors: path -> (mean, standard deviation) of what is known from elsewhere, in the leaf's
        unit.
      iterations: Gauss-Newton steps, at most.

    Returns:
      An `Identification`: values with standard errors, what the log does not identify, the fit, and
        `.scenario` with the new parameters.

    Raises:
      ValueError: a path that does not move the plant; a log that is incomplete, has rows without
        numbers, times that do not increase, wrong units or columns, or in which the robot stands
        still; the message names the value and the remedy.
      OSError: a file cannot be read.

    Source: H. G. Bock's multiple shooting; L. Ljung, System Identification, 2nd ed., 1999; C.
      Rucker, P. M. Wensing 2022 for inertias.
    """
    began = time.monotonic()
    given = canonical(scenario)
    options = _checked_options(log, window, torque, delay, loss, widths, limits, priors, iterations)
    with jax.enable_x64(True):  # noise of 1e-4 rad leaves no room for the rounding of float32
        problem = _problem(given, log, paths, held_out, options)
        result = _solved(problem, began)
    dtype = given.initial.q.dtype
    return dataclasses.replace(result, scenario=astype(result.scenario, dtype), start=given)


class Options(NamedTuple):
    """The checked options of `identify`."""

    window: float
    zero_order_hold: bool
    delay: float | None
    loss: str
    widths: bool
    limits: Mapping[str, Any]
    priors: Mapping[str, Any]
    iterations: int


def _checked_options(
    log: Any,
    window: Any,
    torque: Any,
    delay: Any,
    loss: Any,
    widths: Any,
    limits: Any,
    priors: Any,
    iterations: Any,
) -> Options:
    """The options of `identify`; ValueError for one that is invalid."""
    if torque is None:
        torque = "interpolated" if _is_continuous(log) else "held"
    checks.one_of("torque", torque, TORQUES)
    checks.one_of("loss", loss, LOSSES)
    window = checks.time_span("window", window)
    iterations = checks.positive_integer("iterations", iterations, most=checks.MAX_STEPS)
    if limits is None:
        limits = {}
    limits = checks.mapping("limits", limits, '{"plant.mass": (0.1, 5.0)}')
    if priors is None:
        priors = {}
    priors = checks.mapping("priors", priors, '{"plant.mass": (2.0, 0.1)}')
    _check_delay(delay)
    widths = checks.flag("widths", widths)
    return Options(window, torque == "held", delay, loss, widths, limits, priors, iterations)


def _problem(
    given: Scenario, log: Any, paths: list[str], held_out: Any, options: Options
) -> IdentificationProblem:
    """What is identified, from which data; ValueError for logs that are too short."""
    start = canonical(astype(given, "float64"))
    all_paths = with_widths(start, paths) if options.widths else paths
    simulated, c = coordinates(start, all_paths, options.limits)
    logs, held_back = _logs(log, held_out, start.n)
    fitted_windows = windows(logs, options.window, held_back, options.zero_order_hold)
    _enough(fitted_windows, len(c.x), logs, options.window)
    fitted_logs = [
        part
        for one, share in zip(logs, held_back, strict=True)
        for part in _front(one, 1.0 - share)
    ]
    fixed_delay = None
    if options.delay is not None and not c.delay:
        fixed_delay = float(options.delay)
    return IdentificationProblem(
        start=start,
        simulated=simulated,
        coordinates=c,
        logs=logs,
        windows=fitted_windows,
        smooth=smooth_logs(fitted_logs, options.zero_order_hold),
        prior=_prior(c, options.priors),
        requested=len([path for path in paths if path != DELAY_PATH]),
        fixed_delay=fixed_delay,
        zero_order_hold=options.zero_order_hold,
        loss=options.loss,
        iterations=options.iterations,
    )


def _solved(problem: IdentificationProblem, began: float) -> Identification:
    """The result: regression, free torques near standstill, then the friction law."""
    guess = initial_estimate(
        problem.simulated, problem.coordinates, problem.smooth, "log", problem.fixed_delay
    )
    noise = np.maximum(problem.smooth.noise, 1e-9)
    by_law = no_free_torques(problem.windows.y.shape, len(problem.coordinates.x))
    before = problem.replay(problem.coordinates.x, by_law).best_starts(
        np.append(to_z(problem.coordinates, problem.coordinates.x), guess.delay), noise
    )[1]
    search = _Search(problem, guess, noise)
    free_fit = search.with_free_torques()
    end, friction_ratio = search.with_friction_law(by_law, free_fit)
    return assessed(problem, guess, end, before, friction_ratio, time.monotonic() - began)


class _Search:
    """The nonlinear search: simulation error over windows, by `ShootingProblem.refine`."""

    def __init__(
        self, problem: IdentificationProblem, guess: InitialEstimate, noise: np.ndarray
    ) -> None:
        self.problem = problem
        self.first = np.append(guess.z, guess.delay)
        self.noise = noise
        scales = coordinate_scales(problem.coordinates, guess.scale)
        self.scale = np.append(scales, DELAY_SCALE)

    def refine(
        self, x: np.ndarray, z: np.ndarray, free: FreeTorques, hopeless: Any = np.inf
    ) -> Refinement:
        """The fit from z on, with these free torques.

        Args:
          x: parameters at which the steps of the integrator are chosen.
          z: start of the search, the delay last.
          free: torques that are free near standstill.
          hopeless: residuals at which the search is given up.
        """
        problem = self.problem
        return problem.replay(x, free).refine(
            z, problem.limits, self.scale, self.noise, problem.prior, problem.iterations, hopeless
        )

    def with_free_torques(self) -> Refinement | None:
        """The best fit with free torques near standstill; None if no friction is identified.

        The friction law may be wrong near standstill, and this search converges from any start. A
        larger range of speeds is tried only if the smaller one leaves more than noise.
        """
        problem = self.problem
        noise = np.maximum(problem.smooth.noise, MIN_NOISE)
        size = np.std(problem.smooth.tau, axis=0)
        best: Refinement | None = None
        for speed in SPEED_THRESHOLDS:
            free = free_torques_at_standstill(
                problem.simulated,
                problem.coordinates,
                problem.windows,
                problem.logs,
                size,
                speed,
            )
            if not free.fixed.any():
                break
            z = self.first if best is None else best.z
            x = np.where(free.fixed, NO_FRICTION_WIDTH, to_x(problem.coordinates, z[:-1])[0])
            found = self.refine(x, z, free)
            residual = np.max(found.rms / noise)
            if best is not None and not residual < WORTHWHILE_RATIO * np.max(best.rms / noise):
                break
            best = found
            if residual < INCOMPLETE_RATIO:
                break
        return best

    def with_friction_law(
        self, by_law: FreeTorques, free_fit: Refinement | None
    ) -> tuple[Refinement, float]:
        """The fit with the friction law, or the one with free torques if that is clearly better.

        Returns:
          The fit, and the residual of the friction law relative to that of free torques, 0 without
          these.
        """
        z = self.first if free_fit is None else free_fit.z
        x = to_x(self.problem.coordinates, z[:-1])[0]
        if free_fit is None:
            return self.refine(x, z, by_law), 0.0
        # A log of a simulation has no noise: a smaller residual is no improvement.
        smallest = np.maximum(free_fit.rms, MIN_NOISE)
        law_fit = self.refine(x, z, by_law, REJECTED_RATIO * smallest)
        ratio = float(np.max(law_fit.rms / smallest))
        chosen = free_fit if ratio > ACCEPTED_RATIO else law_fit
        return chosen._replace(steps=free_fit.steps + law_fit.steps), ratio


def _check_delay(delay: Any) -> None:
    """Raises ValueError for a delay of the torque that is not a number or too long."""
    if delay is None:
        return
    number = checks.as_floats("delay", delay)
    if number.ndim != 0 or not abs(float(number)) <= LARGEST_DELAY:
        expected = f"one number [s], of a size of at most {LARGEST_DELAY:g} s"
        raise checks.fail("delay", delay, expected, "Leave it out to have it found from the log.")


def _is_continuous(log: Any) -> bool:
    """Whether a log is of runs whose law was not sampled."""
    runs = log if isinstance(log, list | tuple) else [log]
    return all(isinstance(run, Rollout) and run.scenario.sampling is None for run in runs)


def _logs(log: Any, held_out: Any, n: int) -> tuple[list[Log], list[float]]:
    """The logs, and the share of each that is held back."""
    logs = read(log, n)
    if isinstance(held_out, int | float) and not isinstance(held_out, bool):
        if not 0.0 <= held_out <= 0.9:
            raise checks.fail("held_out", held_out, "a share from 0 to 0.9, or a log")
        return logs, [float(held_out)] * len(logs)
    others = read(held_out, n, "held_out")
    return logs + others, [0.0] * len(logs) + [1.0] * len(others)


def _front(log: Log, share: float) -> list[Log]:
    """The first share of a log; an empty list for one that is held back."""
    count = round(share * len(log.t))
    if not count:
        return []
    dq = None if log.dq is None else log.dq[:count]
    return [log._replace(t=log.t[:count], q=log.q[:count], tau=log.tau[:count], dq=dq)]


def _enough(w: Windows, p: int, logs: list[Log], length: float) -> None:
    """Raises ValueError for logs that are too short for the parameters."""
    numbers = 0
    if len(w.t):
        _, samples, n = w.y.shape
        numbers = int(np.sum(w.kept)) * (samples - 2) * n
    if numbers < 3 * p or not numbers:
        came = checks.Words(
            f"{sum(x.t[-1] - x.t[0] for x in logs):.3g} s of log between gaps, in"
            f" {int(np.sum(w.kept))} windows of {length:g} s to fit"
        )
        raise checks.fail(
            "log",
            came,
            f"at least one window, and 3 measured numbers for each of the {p} parameters",
            "Log for longer, or take a shorter window.",
        )


def _prior(c: Coordinates, priors: Mapping[str, Any]) -> Prior:
    mean, precision = c.x.copy(), np.zeros((len(c.x), len(c.x)))
    for path, given in priors.items():
        if path not in c.paths:
            raise checks.fail("priors", path, f"one of the paths: {', '.join(c.paths)}")
        place = c.places[c.paths.index(path)]
        if not isinstance(given, tuple | list) or len(given) != 2:
            raise checks.fail(
                f"priors[{path!r}]",
                given,
                "(mean, standard deviation), each a number or one an entry",
            )
        own = slice(place.start, place.start + place.size)
        centre, std = (
            np.broadcast_to(
                np.asarray(checks.as_floats(f"priors[{path!r}]", x), float), place.shape
            ).ravel()
            for x in given
        )
        checks.check_values(f"priors[{path!r}]: standard deviation", std, "positive")
        mean[own], precision[own, own] = centre, np.diag(std**-2)
    return Prior(mean, precision)

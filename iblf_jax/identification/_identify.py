"""`identify`: parameters of a robot from its log."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.progress import announced
from iblf_jax.core.pytree import astype
from iblf_jax.identification.assessment import assessed
from iblf_jax.identification.coordinates import (
    DELAY_PATH,
    DELAY_SCALE,
    LARGEST_DELAY,
    Coordinates,
    coordinates,
    to_x,
    to_z,
    with_widths,
)
from iblf_jax.identification.log import Log, read
from iblf_jax.identification.problem import IdentificationProblem
from iblf_jax.identification.regression import coordinate_scales, initial_estimate
from iblf_jax.identification.result import INCOMPLETE_RATIO, MIN_NOISE, Identification
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
from iblf_jax.world import plants

LOSSES = ("squares", "huber")
TORQUES = ("held", "interpolated")


@notices.each_warning_once
@announced("identifying parameters from a log")
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
    """Parameters of a robot from its log: regression, refined by simulation error over windows.

        minimise  sum over windows, samples, joints of  rho((y - q) / sigma) / 2

    Here q is the motion of the plant under the logged torque.  The initial state of each window and
    sigma of each joint are estimated as well.  No logged velocities and no control law are needed.

    Args:
      scenario: on a robot of n joints; the search starts from its plant's parameters.
      log: t (N,) [s], q (N, n) [rad], tau (N, n) [N m], dq (N, n) [rad/s] if there is one: an
        xarray Dataset, a mapping, a `Rollout`, a CSV file with the heading t, q[0], ..., tau[0],
        ..., a netCDF file, the folder of a rosbag2 recording with the topics `joint_states` and
        `efforts` (extra `ros`), or a list of these.  Times may be irregular and have gaps.
      paths: of leaves of robot (plant and model), plant, model, disturbance, or "sampling.delay".
      held_out: the share of each log, at its end, that is held back for validation; or logs for it.
      window: length of the windows [s]; long ones contain more information and more model error.
      torque: "held" between samples, as in a digital loop, or "interpolated", for measured torques;
        if not given, interpolated for a `Rollout` of a continuous loop, else held.
      delay: delay of the logged torque [s]; estimated if not given.
      loss: "squares", or "huber" for logs with outliers.
      widths: whether Coulomb friction near standstill is identified: tanh(q' / width) with an
        estimated width, or free torques where it obeys another law (sticking, a bristle).  A wrong
        width biases all parameters (7 joints with dry friction: by up to 34 %).
      limits: path -> (low, high) in the leaf's unit, None for the default: masses are above 0,
        friction and damping not below.
      priors: path -> (mean, standard deviation) known from elsewhere, in the leaf's unit.
      iterations: largest number of Gauss-Newton steps.

    Returns:
      An `Identification`: values with standard errors, the fit, and the new `.scenario`.

    Raises:
      ValueError: a path that does not move the plant; a log that is incomplete, in wrong units or
        columns, has rows without numbers or times that do not increase, or shows no motion.
      OSError: a file cannot be read.

    Source: H. G. Bock; L. Ljung, System Identification, 1999; C. Rucker, P. M. Wensing 2022.
    """
    began = time.monotonic()
    given = canonical(scenario)
    options = Options(window, torque, delay, loss, widths, limits, priors, iterations)
    options = _checked(options, log)
    with jax.enable_x64(True):  # noise of 1e-4 rad leaves no room for the rounding of float32
        result = _solved(_problem(given, log, paths, held_out, options), began)
    dtype = given.initial.q.dtype
    return dataclasses.replace(result, scenario=astype(result.scenario, dtype), start=given)


class Options(NamedTuple):
    """The options of `identify`, as its arguments of the same names."""

    window: Any
    torque: Any
    delay: Any
    loss: str
    widths: bool
    limits: Any
    priors: Any
    iterations: int


def _checked(options: Options, log: object) -> Options:
    """The options with their defaults; ValueError for one that is invalid."""
    torque, delay = options.torque, options.delay
    if torque is None:
        runs = log if isinstance(log, list | tuple) else [log]
        continuous = all(isinstance(x, Rollout) and x.scenario.sampling is None for x in runs)
        torque = "held"
        if continuous:
            torque = "interpolated"
    checks.one_of("torque", torque, TORQUES)
    checks.one_of("loss", options.loss, LOSSES)
    if delay is not None:
        number = checks.as_floats("delay", delay)
        if number.ndim != 0 or not abs(float(number)) <= LARGEST_DELAY:
            expected = f"one number [s], of a size of at most {LARGEST_DELAY:g} s"
            remedy = "Leave it out to have it found from the log."
            raise checks.fail("delay", delay, expected, remedy)
        delay = float(delay)
    return Options(
        window=checks.time_span("window", options.window),
        torque=torque,
        delay=delay,
        loss=options.loss,
        widths=checks.boolean("widths", options.widths),
        limits=_by_path("limits", options.limits, '{"plant.mass": (0.1, 5.0)}'),
        priors=_by_path("priors", options.priors, '{"plant.mass": (2.0, 0.1)}'),
        iterations=checks.positive_integer("iterations", options.iterations, most=checks.MAX_STEPS),
    )


def _by_path(name: str, given: object, example: str) -> Mapping[str, Any]:
    """A mapping from paths that may be left out."""
    if given is None:
        return {}
    return checks.mapping(name, given, example)


def _problem(
    given: Scenario, log: object, paths: list[str], held_out: Any, options: Options
) -> IdentificationProblem:
    """What is identified, from which data; ValueError for logs that are too short."""
    start = canonical(astype(given, "float64"))
    hold = options.torque == "held"
    all_paths = with_widths(start, paths) if options.widths else paths
    simulated, c = coordinates(start, all_paths, options.limits)
    logs, held_back = _logs(log, held_out, start)
    fitted_windows = windows(logs, options.window, held_back, hold)
    _check_size(fitted_windows, len(c.x), logs, options.window)
    fronts = []
    for one, share in zip(logs, held_back, strict=True):
        count = round((1.0 - share) * len(one.t))  # the rest is held back
        dq = None if one.dq is None else one.dq[:count]
        fronts.append(Log(one.name, one.t[:count], one.q[:count], one.tau[:count], dq))
    return IdentificationProblem(
        start=start,
        simulated=simulated,
        coordinates=c,
        logs=logs,
        windows=fitted_windows,
        motion=smooth_logs([front for front in fronts if len(front.t)], hold),
        prior=_prior(c, options.priors),
        requested=len([path for path in paths if path != DELAY_PATH]),
        fixed_delay=None if c.has_delay_path else options.delay,
        zero_order_hold=hold,
        loss=options.loss,
        iterations=options.iterations,
    )


def _solved(problem: IdentificationProblem, began: float) -> Identification:
    """The result: regression, free torques near standstill, then the friction law."""
    c, noise = problem.coordinates, np.maximum(problem.motion.noise, 1e-9)
    initial = initial_estimate(problem.simulated, c, problem.motion, problem.limits)
    no_free = no_free_torques(problem.windows.y.shape, len(c.x))
    z_of_scenario = np.append(to_z(c, c.x), initial.delay)
    _, residuals_before = problem.shooting(c.x, no_free).best_starts(z_of_scenario, noise)
    scale = np.append(coordinate_scales(c, initial.scale), DELAY_SCALE)
    search = _Search(problem, np.append(initial.z, initial.delay), noise, scale)
    free_fit = search.with_free_torques()
    fit, friction_ratio = search.with_friction_law(no_free, free_fit)
    seconds = time.monotonic() - began
    return assessed(problem, initial, fit, residuals_before, friction_ratio, seconds)


class _Search(NamedTuple):
    """The nonlinear search: simulation error over windows, by `ShootingProblem.refine`."""

    problem: IdentificationProblem
    z_start: np.ndarray
    """z at the start of the search, (p + 1,), the delay last."""
    noise: np.ndarray
    """First noise level of each joint, (n,) [rad]."""
    scale: np.ndarray
    """Scales of z, (p + 1,)."""

    def refine(
        self,
        x: np.ndarray,
        z: np.ndarray,
        free: FreeTorques,
        rms_limit: np.ndarray | float = np.inf,
    ) -> Refinement:
        """The fit from z on, with these free torques.

        Args:
          x: parameters at which the steps of the integrator are chosen.
          z: start of the search, the delay last.
          free: torques that are free near standstill.
          rms_limit: residual of each joint above which the search stops, (n,) [rad].
        """
        problem = self.problem
        return problem.shooting(x, free).refine(
            z, problem.limits, self.scale, self.noise, problem.prior, problem.iterations, rms_limit
        )

    def with_free_torques(self) -> Refinement | None:
        """The best fit with free torques near standstill; None if no friction is identified.

        The friction law may be wrong near standstill, and this search converges from any start. A
        larger range of speeds is tried only if the smaller one leaves more than noise.
        """
        problem = self.problem
        noise = np.maximum(problem.motion.noise, MIN_NOISE)
        size = np.std(problem.motion.tau, axis=0)
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
            z = self.z_start if best is None else best.z
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
        self, no_free: FreeTorques, free_fit: Refinement | None
    ) -> tuple[Refinement, float]:
        """The fit with the friction law, or the one with free torques if that is clearly better.

        Returns:
          The fit, and the residual of the friction law relative to that of free torques, 0 without
          these.
        """
        z = self.z_start if free_fit is None else free_fit.z
        x = to_x(self.problem.coordinates, z[:-1])[0]
        if free_fit is None:
            return self.refine(x, z, no_free), 0.0
        # A log of a simulation has no noise: a smaller residual is no improvement.
        smallest = np.maximum(free_fit.rms, MIN_NOISE)
        law_fit = self.refine(x, z, no_free, REJECTED_RATIO * smallest)
        ratio = float(np.max(law_fit.rms / smallest))
        chosen = free_fit if ratio > ACCEPTED_RATIO else law_fit
        return chosen._replace(steps=free_fit.steps + law_fit.steps), ratio


def _logs(log: object, held_out: Any, start: Scenario) -> tuple[list[Log], list[float]]:
    """The logs, and the share of each that is held back."""
    joints = plants.declared_joints(start.plant)
    logs = read(log, start.n, joints=joints)
    if isinstance(held_out, int | float) and not isinstance(held_out, bool):
        if not 0.0 <= held_out <= 0.9:
            raise checks.fail("held_out", held_out, "a share from 0 to 0.9, or a log")
        return logs, [float(held_out)] * len(logs)
    others = read(held_out, start.n, "held_out", joints)
    return logs + others, [0.0] * len(logs) + [1.0] * len(others)


def _check_size(w: Windows, p: int, logs: list[Log], length: float) -> None:
    """Raises ValueError for logs that are too short for p parameters."""
    fitted = int(np.sum(w.kept))
    numbers = 0
    if fitted:
        _, samples, n = w.y.shape
        numbers = fitted * (samples - 2) * n
    if numbers < 3 * p or not numbers:
        duration = sum(log.t[-1] - log.t[0] for log in logs)
        raise checks.fail(
            "log",
            checks.Words(
                f"{duration:.3g} s of log between gaps, in {fitted} windows of {length:g} s to fit"
            ),
            f"at least one window, and 3 measured numbers for each of the {p} parameters",
            "Log for longer, or take a shorter window.",
        )


def _prior(c: Coordinates, priors: Mapping[str, Any]) -> Prior:
    """The prior knowledge of x; ValueError for one that is invalid."""
    mean, precision = c.x.copy(), np.zeros(len(c.x))
    for path, given in priors.items():
        name = f"priors[{path!r}]"
        if path not in c.paths:
            raise checks.fail("priors", path, f"one of the paths: {', '.join(c.paths)}")
        if not isinstance(given, tuple | list) or len(given) != 2:
            expected = "(mean, standard deviation), each a number or one an entry"
            raise checks.fail(name, given, expected)
        place = c.places[c.paths.index(path)]
        own = slice(place.start, place.start + place.size)
        centre, std = (
            np.broadcast_to(np.asarray(checks.as_floats(name, x), float), place.shape).ravel()
            for x in given
        )
        checks.check_values(f"{name}: standard deviation", std, "positive")
        mean[own], precision[own] = centre, std**-2
    return Prior(mean, np.diag(precision))

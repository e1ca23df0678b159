"""`identify`: parameters of a robot from its log."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, notices
from iblf_jax.core.pytree import astype
from iblf_jax.identification.coordinates import (
    DELAY,
    OFFSET,
    Coordinates,
    coordinates,
    to_x,
    to_z,
    with_widths,
)
from iblf_jax.identification.log import Log, Said, read
from iblf_jax.identification.regression import LARGEST_DELAY, coordinate_scales, started
from iblf_jax.identification.replay import slopes, slopes_under
from iblf_jax.identification.result import FINEST, LACKS, Identification, judged
from iblf_jax.identification.shooting import Prior, Replay, Windows, substeps_for, windows
from iblf_jax.identification.smoothing import Smoothed, smoothed
from iblf_jax.identification.standstill import (
    BETTER,
    HOPELESS,
    NONE,
    SLOW,
    WORSE,
    by_the_law,
    free_about_standstill,
)
from iblf_jax.identification.structure import LeftOut, left_out
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
    """Parameters of a robot from what it logged: linear regression, refined by simulation error
    over windows.

        minimise  sum over windows, samples, joints of  rho((y - q) / sigma) / 2,    q the plant
        under the logged torque

    Each window of the log has a start of its own, which is looked for too; sigma of each joint is
    estimated.  The motion comes from positions alone; of a law nothing need be known.

    Args:
      scenario: on a robot of n joints; its plant's numbers are where the search starts.
      log: t (N,) [s], q (N, n) [rad], tau (N, n) [N m], dq (N, n) [rad/s] if there is one: an
        xarray Dataset, a mapping, a `Rollout`, a CSV
        file (its heading: t, q[0], ..., tau[0], ...) or a netCDF file, or a list of these.  Times
          may be irregular and have gaps.
      paths: of leaves of robot (plant and model), plant, model or disturbance; "sampling.delay" for
        the torque's delay.
      held_out: the share of each log, at its end, that is held back to judge the result; or a log,
        or a list of logs, for that.
      window: length of the windows [s]; longer ones know more, and more of what the model lacks.
      torque: "held" from a sample to the next, as a digital loop does, or "interpolated", for
        torques that were measured; if not given, interpolated for a `Rollout` of a continuous loop,
        else held.
      delay: how late the logged torque acts [s]; found too if not given.
      loss: "squares", or "huber" for logs with outliers.
      widths: whether what Coulomb friction does about standstill is looked for with it: whether it
        is tanh(q' / width), and with which width, or another law (sticking, a bristle, an impulse),
        which the log then decides by free torques.  If not, the scenario's widths are believed: one
        that is wrong spoils all numbers (7 joints with dry friction: by up to 34 %).
      limits: path -> (low, high) in the leaf's unit, None for the default: masses are above 0,
        friction and damping not below.
      priors: path -> (mean, standard deviation) of what is known from elsewhere, in the leaf's
        unit.
      iterations: Gauss-Newton steps, at most.

    Returns:
      An `Identification`: values with standard errors, what the log cannot tell, the fit, and
        `.scenario` with the new numbers.

    Raises:
      ValueError: a path that does not move the plant; a log that is incomplete, has rows without
        numbers, times that do not increase, wrong units or columns, or in which the robot stands
        still; the message names what came and the remedy.
      OSError: a file cannot be read.

    Source: H. G. Bock's multiple shooting; L. Ljung, System Identification, 2nd ed., 1999; C.
      Rucker, P. M. Wensing 2022 for inertias.
    """
    begin = time.monotonic()
    torque = ("interpolated" if _is_continuous(log) else "held") if torque is None else torque
    checks.one_of("torque", torque, TORQUES)
    checks.one_of("loss", loss, LOSSES)
    window = checks.time_span("window", window)
    iterations = checks.positive_integer("iterations", iterations, most=checks.MOST_STEPS)
    limits = (
        {} if limits is None else checks.mapping("limits", limits, '{"plant.mass": (0.1, 5.0)}')
    )
    priors = (
        {} if priors is None else checks.mapping("priors", priors, '{"plant.mass": (2.0, 0.1)}')
    )
    _check_delay(delay)
    given = canonical(scenario)
    with jax.enable_x64(True):  # noise of 1e-4 rad leaves no room for the rounding of float32
        start = canonical(astype(given, "float64"))
        wanted = with_widths(start, paths) if checks.flag("widths", widths) else paths
        replayed, c = coordinates(start, wanted, limits)
        if c.delay:
            delay = None
        logs, back = _logs(log, held_out, start.n)
        held = torque == "held"
        w = windows(logs, window, back, held)
        _enough(w, len(c.x), logs, window)
        seen = smoothed(
            [
                fitted
                for x, share in zip(logs, back, strict=True)
                for fitted in _front(x, 1.0 - share)
            ],
            held,
        )
        prior = _prior(c, priors)
        guess = started(replayed, c, seen, "log", delay)

        law = by_the_law(w.y.shape, len(c.x))

        def replay(x, friction):
            return Replay(
                replayed,
                c,
                w,
                logs,
                held,
                loss,
                _substeps(replayed, c, x, seen, min(one.step for one in logs)),
                friction,
            )

        noise, counts = np.maximum(seen.noise, 1e-9), np.maximum(seen.noise, FINEST)
        fixed = None if delay is None else float(delay)
        ends = tuple(
            np.append(x, side * LARGEST_DELAY if fixed is None else fixed)
            for x, side in ((c.low, -1.0), (c.high, 1.0))
        )
        first = np.append(to_z(c, c.x), guess.delay)
        before = replay(c.x, law).best_starts(first, noise)[1]
        scale = np.append(coordinate_scales(c, guess.scale), OFFSET)
        z, loose, worse = np.append(guess.z, guess.delay), None, 0.0
        for slow in SLOW:  # found from any start; then the law of friction from there
            free = free_about_standstill(replayed, c, w, logs, np.std(seen.tau, axis=0), slow)
            if not free.held.any():
                break
            found = replay(np.where(free.held, NONE, to_x(c, z[:-1])[0]), free).refined(
                z, ends, scale, noise, prior, iterations
            )
            if loose is not None and not np.max(found.left / counts) < BETTER * np.max(
                loose.left / counts
            ):
                break
            loose, z = found, found.z
            if np.max(loose.left / counts) < LACKS:
                break
        least = (
            np.inf if loose is None else np.maximum(loose.left, FINEST)
        )  # a log of a simulation has no noise: less is not better
        hopeless = HOPELESS * least
        end = replay(to_x(c, z[:-1])[0], law).refined(
            z, ends, scale, noise, prior, iterations, hopeless
        )
        if loose is not None:
            worse = float(np.max(end.left / least))
            end = (loose if worse > WORSE else end)._replace(steps=loose.steps + end.steps)
        result = judged(
            start,
            c,
            w,
            end,
            prior,
            before,
            guess,
            len([path for path in paths if path != DELAY]),
            ends,
            fixed is None,
            worse,
            tuple(x.name for x in logs),
            time.monotonic() - begin,
            partial(_lacking_terms, replayed, c, seen),
        )
    return dataclasses.replace(
        result, scenario=astype(result.scenario, given.initial.q.dtype), start=given
    )


def _check_delay(delay: Any) -> None:
    """Raises ValueError for a delay of the torque that is no number or too long."""
    if delay is None:
        return
    number = checks.as_floats("delay", delay)
    if number.ndim != 0 or not abs(float(number)) <= LARGEST_DELAY:
        expected = f"one number [s], of a size of at most {LARGEST_DELAY:g} s"
        raise checks.fail("delay", delay, expected, "Leave it out to have it found from the log.")


def _lacking_terms(
    scenario: Scenario, c: Coordinates, seen: Smoothed, z: np.ndarray, fitted: np.ndarray
) -> LeftOut:
    """The terms that a fit which ended at z, the delay last, lacks; `fitted` are the numbers that
    it moved, (p + 1,) bool.
    """
    x, _ = to_x(c, z[:-1])
    points = (jnp.asarray(a) for a in (x, seen.t, seen.q, seen.dq, seen.ddq))
    at_end = slopes(scenario, *points, places=c.places)
    return left_out(seen, np.asarray(at_end.torque), np.asarray(at_end.by_x), float(z[-1]), fitted)


def _is_continuous(log: Any) -> bool:
    """Whether a log is of runs whose law was not sampled."""
    runs = log if isinstance(log, list | tuple) else [log]
    return all(isinstance(run, Rollout) and run.scenario.sampling is None for run in runs)


def _logs(log: Any, held_out: Any, n: int) -> tuple[list[Log], list[float]]:
    """The logs, and which share of each is held back."""
    logs = read(log, n)
    if isinstance(held_out, int | float) and not isinstance(held_out, bool):
        if not 0.0 <= held_out <= 0.9:
            raise checks.fail("held_out", held_out, "a share from 0 to 0.9, or a log")
        return logs, [float(held_out)] * len(logs)
    others = read(held_out, n, "held_out")
    return logs + others, [0.0] * len(logs) + [1.0] * len(others)


def _front(log: Log, share: float) -> list[Log]:
    """The first share of a log; nothing of one that is held back."""
    count = round(share * len(log.t))
    return (
        [
            log._replace(
                t=log.t[:count],
                q=log.q[:count],
                tau=log.tau[:count],
                dq=None if log.dq is None else log.dq[:count],
            )
        ]
        if count
        else []
    )


def _enough(w: Windows, p: int, logs: list[Log], length: float) -> None:
    """Raises ValueError for logs that are too short for what is looked for."""
    n = w.y.shape[-1] if len(w.t) else 1
    numbers = int(np.sum(w.kept)) * (w.t.shape[1] - 2) * n if len(w.t) else 0
    if numbers < 3 * p or not numbers:
        came = Said(
            f"{sum(x.t[-1] - x.t[0] for x in logs):.3g} s of log between gaps, in"
            f" {int(np.sum(w.kept))} windows of {length:g} s to fit"
        )
        raise checks.fail(
            "log",
            came,
            f"at least one window, and 3 measured numbers for each of the {p} looked for",
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


def _substeps(
    scenario: Scenario, c: Coordinates, x: np.ndarray, seen: Smoothed, step: float
) -> int:
    """Steps of the integrator from sample to sample."""
    points = (jnp.asarray(a) for a in (seen.t, seen.q, seen.dq, seen.tau))
    return substeps_for(slopes_under(scenario, jnp.asarray(x), *points, places=c.places), step)

"""`recommended_dt`: a time step that is small enough for the modes of the loop and for the signals
that drive it.

The first candidate follows the fastest mode of the loop.  Then two runs are integrated side by
side: one in steps dt, the other with each of these steps divided into three unequal ones, so that
no signal passes through whole periods between the stages of both.  The step is reduced until the
two runs agree and the error estimate of the run (`error_estimate`) is within its tolerance.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from iblf_jax.core import checks, notices, programs
from iblf_jax.core.status import Status, has_flag
from iblf_jax.engine.request import RunRequest
from iblf_jax.engine.single_run import run_one
from iblf_jax.engine.thresholds import STEP_SIZE_CHUNK
from iblf_jax.simulation import discontinuities, error_estimate, error_growth
from iblf_jax.simulation.closed_loop import LoopState, evaluate, initial_state
from iblf_jax.simulation.initial import Initial
from iblf_jax.simulation.integrators import tableau
from iblf_jax.simulation.levels import levels_on_reference
from iblf_jax.simulation.noise import check_method
from iblf_jax.simulation.scenario import Scenario, canonical, with_history
from iblf_jax.simulation.stability import SLOWEST_RATE, jacobian
from iblf_jax.world import plants

RECOMMENDED_PHASE = 1.5
"""|dt * mode| that is recommended: RK4 follows the fastest mode itself to a few per cent there."""
NOISY_PHASES = {"euler_maruyama": 0.09, "stochastic_heun": 0.4}
"""|dt * mode| that is recommended under process noise.  A mode x' = -a x with additive noise has a
stationary variance.  With z = a dt the variance of a method is that, times

    1/(1 - z/2)                          Euler-Maruyama,
    (1 - z/2)/(1 - z/2 + z^2/4)          stochastic Heun,

so it is right to 5 % at these values, while both methods are stable up to z = 2."""
RECOMMENDED_ERROR = error_estimate.TOLERANCE / 5
"""Difference of the two runs, relative to the tube, that a recommended step may leave."""
MODE_INSTANTS = 33
"""Instants along the reference at which modes are computed."""
MAX_TRIED = 5_000_000
"""Steps of a run that is tried, at most."""
DIVISORS = tuple(f * 10**k for k in range(7) for f in (1, 2, 5))
"""Numbers of steps in a sampling period or a delay that are tried."""
MAX_STEPS_IN_DELAY = 20
"""Steps in the delay of an input that are tried, at most: each number of them is a program of its
own, which contains all commands on their way."""
INTERVALS = ((0.0, 1.0), (0.0, 0.382), (0.382, 0.618), (0.618, 1.0))
"""Start and end of the intervals that are integrated for each step, in steps: the whole step and
its three parts."""


class Pair(NamedTuple):
    """Two runs side by side."""

    step: jax.Array
    coarse: jax.Array
    fine: jax.Array
    accuracy: error_estimate.Accuracy
    difference: jax.Array
    """Largest so far, relative to the tube."""
    nearest: tuple[jax.Array, jax.Array, jax.Array]
    """|xi|, time and state of the fine run where it was nearest to a bound."""
    going: jax.Array
    """Whether the fine run has not diverged."""


def side_by_side(scenario: Scenario, dt: float, steps: int, *, method: str) -> Pair:
    """A run in steps dt beside one in steps of about dt / 3, until the end of both, or until they
    differ by more than the width of the tube.

    Args:
      scenario: canonical.
      dt: time step [s].
      steps: how many; another number does not compile anew.
      method: the integrator.
    """
    size, end = jnp.asarray(dt, scenario.initial.q.dtype), jnp.int32(steps)
    pair = _start(scenario, size, end, method=method)
    while int(pair.step) < steps and bool(pair.going) and float(pair.difference) <= 1.0:
        pair = _advanced(scenario, size, end, pair, method=method)
    return pair


@programs.jit(static_argnames="method", options=programs.SHORTEST_TO_COMPILE)
def _start(scenario: Scenario, dt: jax.Array, steps: jax.Array, *, method: str) -> Pair:
    start, zero = initial_state(scenario), jnp.zeros_like(dt)
    x = ravel_pytree(start)[0]
    watched = error_estimate.watched_indices(start)
    accuracy = error_estimate.initial_accuracy(
        method, jacobian(scenario, zero, start)[watched][:, watched], start
    )
    accuracy = error_estimate.with_unresolved(
        accuracy,
        error_estimate.with_acceleration(
            scenario, error_estimate.unresolved_signals(scenario, method, dt, steps)
        ),
    )
    return Pair(jnp.int32(0), x, x, accuracy, zero, (zero - 1.0, zero, x), jnp.bool_(True))


@programs.jit(static_argnames="method")
def _advanced(
    scenario: Scenario, dt: jax.Array, steps: jax.Array, pair: Pair, *, method: str
) -> Pair:
    """The pair after the next `STEP_SIZE_CHUNK` steps, or after the last one."""
    times = scenario.jump_times()

    def one(pair, _):
        after = _one_step(scenario, times, dt, pair, method)
        goes_on = pair.going & (pair.step < steps)
        return jax.tree.map(partial(jnp.where, goes_on), after, pair), None

    return jax.lax.scan(one, pair, None, STEP_SIZE_CHUNK)[0]


def _one_step(scenario: Scenario, times: jax.Array, dt: jax.Array, pair: Pair, method: str) -> Pair:
    """Both runs one step later; `times` are the jump times."""
    as_state = ravel_pytree(initial_state(scenario))[1]
    number = pair.step.astype(dt.dtype)
    begin, end = number * dt, (number + 1.0) * dt

    def interval(both, cut):
        coarse, fine = both
        is_coarse, h = cut[1] - cut[0] == 1.0, (cut[1] - cut[0]) * dt
        x = jnp.where(is_coarse, coarse, fine)
        end_of_interval = jnp.where(cut[1] == 1.0, end, begin + cut[1] * dt)
        division = discontinuities.divide_step(
            times, discontinuities.Span(begin + cut[0] * dt, end_of_interval, h)
        )
        stepped = discontinuities.integrate_pieces(
            method, partial(evaluate, scenario), division, as_state(x), rolled=True
        )
        new, sample = ravel_pytree(stepped.state)[0], stepped.aux
        seen = (
            stepped.piece_slopes,
            sample.upper - sample.lower,
            sample.xi,
            division.too_many_jumps,
        )
        return (jnp.where(is_coarse, new, coarse), jnp.where(is_coarse, fine, new)), seen

    (coarse, fine), seen = jax.lax.scan(
        interval, (pair.coarse, pair.fine), jnp.asarray(INTERVALS, dt.dtype)
    )
    piece_slopes, width, _, too_many_jumps = jax.tree.map(lambda x: x[0], seen)
    xi_of_fine = seen[2][1]
    restarts = None
    if times.size:
        restarts = discontinuities.has_jump(
            times, (number - error_estimate.steps_back(method)) * dt, end
        )
    accuracy = error_estimate.update(
        pair.accuracy,
        method,
        dt,
        pair.step,
        piece_slopes,
        width,
        restarts=restarts,
        too_many_jumps=too_many_jumps,
        absolute=error_growth.rounds_continuously(scenario),
    )
    near = jnp.max(jnp.abs(xi_of_fine))
    nearest = jax.tree.map(
        partial(jnp.where, near > pair.nearest[0]), (near, begin, pair.fine), pair.nearest
    )
    off = jnp.max(jnp.abs(as_state(coarse).q - as_state(fine).q) / width)
    limit = plants.speed_limit(scenario.plant)
    going = jnp.all(jnp.isfinite(fine)) & jnp.all(jnp.abs(as_state(fine).dq) < limit)
    larger = jnp.maximum(pair.difference, jnp.where(off <= 1.0, off, jnp.inf))
    difference = jnp.where(going, larger, pair.difference)
    return Pair(pair.step + 1, coarse, fine, accuracy, difference, nearest, going)


@programs.jit(options=programs.SHORTEST_TO_COMPILE, kept=True)
def start_and_along(scenario: Scenario, times: jax.Array) -> LoopState:
    """The state at the start, and those of a loop that follows its reference exactly; time axis
    first, (1 + T, ...).
    """

    def at(t):
        start = Initial(x=levels_on_reference(scenario, t))
        return initial_state(dataclasses.replace(scenario, initial=start))

    return jax.tree.map(
        lambda x, xs: jnp.concatenate([x[None], xs]), initial_state(scenario), jax.vmap(at)(times)
    )


def fastest_along(scenario: Scenario, times: np.ndarray) -> float:
    """The fastest mode at the start and along the reference at some times [1/s]; infinite where the
    loop has no finite derivative.
    """
    states = start_and_along(scenario, jnp.asarray(times, scenario.initial.q.dtype))
    # On the host, where the rows of an array need no programs.
    states = jax.device_get(states)
    return max(
        _mode(scenario, t, jax.tree.map(lambda x, i=i: x[i], states))
        for i, t in enumerate([0.0, *times])
    )


def _mode(scenario: Scenario, t: float | jax.Array, state: LoopState) -> float:
    """The fastest mode at one state [1/s]."""
    found = np.asarray(jacobian(scenario, jnp.asarray(t, scenario.initial.q.dtype), state), float)
    return largest_eigenvalue(found)


def largest_eigenvalue(matrices: np.ndarray) -> float:
    """The largest modulus of an eigenvalue of some matrices; infinite where they are not finite."""
    if not np.all(np.isfinite(matrices)):
        return np.inf
    return float(np.max(np.abs(np.linalg.eigvals(matrices))))


def round_down(dt: float) -> float:
    """1, 2 or 5 times a power of ten, not above dt [s]."""
    decade = 10.0 ** math.floor(math.log10(dt))
    factor = max((f for f in (1.0, 2.0, 5.0) if f * decade <= dt * (1 + 1e-12)), default=1.0)
    return float(f"{factor * decade:.1g}")


def comfortable_dt(mode: float, method: str) -> float:
    """A round step (1, 2 or 5 times a power of ten) that follows a mode [1/s] comfortably, [s]."""
    phase = NOISY_PHASES.get(method, RECOMMENDED_PHASE)
    return round_down(phase / max(mode, SLOWEST_RATE))


def limited(needed: float, dt: float) -> float:
    """The step to try after a run of step dt that left its bounds or diverged: at most ten times
    smaller [s].  Near a bound the guard makes the loop fast, so that `needed`, the step for the
    fastest mode of such a run, says little.
    """
    return max(needed, round_down(dt / 10.0))


def smaller(dt: float, excess: float, order: int) -> float:
    """The round step to try after dt, whose error is `excess` times what it may be: one to ten
    times smaller.
    """
    bounded = 1e9
    if np.isfinite(excess):
        bounded = max(min(excess, 1e9), 1.0)
    sufficient = dt / bounded ** (1.0 / order)
    return round_down(min(max(sufficient, dt / 10.0), 0.7 * dt))


def find_dt(scenario: Scenario, *, duration: float, method: str) -> float:
    """`iblf_jax.recommended_dt` for one scenario."""
    order = tableau(method).order
    scenario = canonical(scenario)
    check_method(scenario, method)
    # Runs with different steps have different noise, so their accuracy is compared without it.
    scenario = dataclasses.replace(scenario, process_noise=None)
    duration = checks.positive_number("duration", duration, "s")
    if scenario.sampling is not None:
        return _find_part(scenario, float(scenario.sampling.period), duration, method)
    delay = scenario.actuator.input_delay
    if delay is not None:
        return _find_part(scenario, float(delay.delay), duration, method, MAX_STEPS_IN_DELAY)
    mode = fastest_along(scenario, np.linspace(0.0, duration, MODE_INSTANTS))
    if not np.isfinite(mode):
        raise checks.fail(
            "scenario",
            "a Jacobian that is not finite",
            "a closed loop with finite derivatives along its reference",
        )
    dt = for_modes = min(comfortable_dt(mode, method), round_down(duration))
    _can_be_tried(duration, dt)
    as_state = ravel_pytree(initial_state(scenario))[1]
    while duration / dt <= MAX_TRIED:
        pair = side_by_side(scenario, dt, math.ceil(duration / dt * (1 - 1e-9)), method=method)
        excess = max(
            float(pair.difference) / RECOMMENDED_ERROR,
            float(pair.accuracy.relative) / error_estimate.TOLERANCE,
        )
        if not excess > 1.0:
            nearest = _mode(scenario, pair.nearest[1], as_state(pair.nearest[2]))
            limit = comfortable_dt(nearest, method)
            if dt <= limit:
                return dt
            dt = for_modes = limit
        else:
            dt = smaller(dt, excess, order)
    notices.warn(
        f"No step down to {duration / MAX_TRIED:.1g} s makes this run accurate: the loop may"
        f" magnify every error, or a signal may be faster than that. {for_modes:g} s is what the"
        " loop's modes allow."
    )
    return for_modes


def _find_part(
    scenario: Scenario, period: float, duration: float, method: str, most_divisor: int = MAX_TRIED
) -> float:
    """`find_dt` for a sampled law or a delayed input: the largest accurate fraction of the sampling
    period or of the delay [s], by one of DIVISORS up to `most_divisor`.
    """
    noise_key = jnp.zeros((4,)) if scenario.sampling is not None else None
    _can_be_tried(duration, period)
    periods = max(math.ceil(duration / period - 1e-9), 1)
    before, poor_before, coarser = None, 0, period
    for divisor in DIVISORS:
        if periods * divisor > MAX_TRIED or divisor > most_divisor:
            break
        dt = jnp.asarray(period / divisor, scenario.initial.q.dtype)
        fitted = with_history(scenario, period / divisor)
        found = run_one(fitted, (), dt, RunRequest(periods * divisor, method, divisor), noise_key)
        signals = found.records.signals
        q = signals["x"][:, 0]
        width = signals["level_upper"][:, 0] - signals["level_lower"][:, 0]
        poor = has_flag(int(found.status), Status.STEP_TOO_LARGE)
        # A step of any size leaves the error that a different code makes.
        if float(error_growth.errors_by_step(found.metrics)) != 0.0:
            poor |= has_flag(int(found.status), Status.INACCURATE)
        if method in NOISY_PHASES:
            poor |= float(dt) * float(found.fastest_mode) > NOISY_PHASES[method]
        if (
            before is not None
            and not poor_before
            and float(jnp.max(jnp.abs(q - before) / width)) <= RECOMMENDED_ERROR
        ):
            return coarser
        before, poor_before, coarser = q, poor, float(dt)
    problem = "makes this run accurate: the loop may magnify every error."
    notices.warn(f"No step down to {coarser:g} s {problem}")
    return coarser


def _can_be_tried(duration: float, dt: float) -> None:
    """Raises ValueError where a run is too long for a step to be tried on it."""
    if duration / dt > MAX_TRIED:
        expected = f"at most {MAX_TRIED * dt:g} s, which are {MAX_TRIED} steps of {dt:g} s"
        remedy = (
            "Longer runs are not tried: give a time after which the motion repeats or has settled."
        )
        raise checks.fail("duration", duration, expected, remedy)

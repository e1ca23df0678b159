"""Estimate of the position error that the time step causes, computed along every run.

The local error of a step follows from differences of the rates x' at the last instants. For rk4,
whose third stage lies in the middle of a step,

    l_k = dt (x'_{k-2} - 4 x'_{k-3/2} + 6 x'_{k-1} - 4 x'_{k-1/2} + x'_k) / 18,

and the other methods have formulas of their own (`integrators.Tableau.differences`). The factor is
ten times that of a smooth loop, so that the estimate also covers a torque that jumps within a step.
Local errors accumulate and decay,

    L_k = (1 - dt r) L_{k-1} + l_k,   r = `stability.SLOWEST_RATE`,

and an error y of the velocities and of the observer displaces the positions by R y, with
R = [I 0] (r I - J)^-1 and J the Jacobian of their rates at the start. The position error is about

    max_k max(|L_q|, |L_q + R L_y|).

The torque of a sampled law jumps from step to step, so differences between steps carry no
information, and the local error is estimated from the stages of each step. For x' = A x the stages
of rk4 satisfy k_3 - k_2 = (dt A / 2) (k_2 - k_1), which gives |dt A|, and the local error is
dt |k_3 - k_2| |dt A|^2 / 30. That of Heun's method is dt |k_2 - k_1| |dt A| / 6, where |dt A| is
|k_2 - k_1| / |k_1|. The same factor of ten applies. J is the one-period map expressed as a rate.

The stages cannot resolve a reference or a disturbance with whole periods between them;
`unresolved_signals` measures these separately. Errors of a loop that rounds a reading or a torque
do not decay as above; `error_growth` has their estimate. A step is divided at the jump times of a
scenario (`discontinuities`). Differences are not taken across a jump: the stages of that step give
its error.

Under process noise there is no estimate, and the results are NaN (`unknown`).

Compared with runs at a sixteenth of the step, the estimate is 1/3 to 30 times the error where the
error exceeds 1e-4 of the tube, and larger below.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from iblf_jax.core.linalg import matvec, solve, solve_spd
from iblf_jax.core.pytree import is_absent
from iblf_jax.core.units import POSITION
from iblf_jax.simulation.closed_loop import LoopState, perturbed_state
from iblf_jax.simulation.discontinuities import has_jump
from iblf_jax.simulation.integrators import Tableau, tableau
from iblf_jax.simulation.levels import disturbance_torque
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.stability import SLOWEST_RATE
from iblf_jax.world.bounds import Tube

TOLERANCE = 0.005
"""Estimated position error, relative to the width of the tube, above which a run is flagged
INACCURATE."""
EXAMINED_STEPS = 16
"""Steps, spread over a run, in which `unresolved_signals` examines the signals between stages."""
ONSET_RATIO = 3.0
"""Ratio of the displacement by a torque at its onset to that after the observer has estimated the
torque."""
GAUSS = ((0.5 - 0.15**0.5, 5 / 18), (0.5, 8 / 18), (0.5 + 0.15**0.5, 5 / 18))
"""Nodes and weights of Gauss's quadrature, the reference for the quadrature of a method."""
GOLDEN_RATIO = 0.6180339887498949
ERROR, RELATIVE = "numerical_error", "relative_numerical_error"
ACCURACY_UNITS = ((ERROR, POSITION), (RELATIVE, "1"))
"""Name and unit of the accuracy results that every run has beside its metrics."""


StepSlopes: TypeAlias = list[tuple[jax.Array, list[LoopState]]]
"""Length [s] of each piece of a step, and the slopes of its stages."""


class Accuracy(NamedTuple):
    """The estimate between two steps. Of m watched numbers, n are positions and the others are
    velocities and the states of observer and actuator.
    """

    pending: tuple[jax.Array, ...]
    """Contributions of past rates to the local errors at the next instants, (2 n,) each: n for the
    positions, then n for their final displacement, from x'_q + R x'_y."""
    accumulated_error: jax.Array
    """Accumulated error L of the same 2 n numbers."""
    response: jax.Array
    """R, (n, m - n); of a sampled loop its columns of the levels from the second on."""
    error: jax.Array
    """Largest position error so far, (n,) [rad]."""
    relative: jax.Array
    """Largest position error so far, relative to the width of its tube, () [1]."""
    error_growth: Any = ()
    """The `error_growth.ErrorGrowth` of a loop whose feedback is interrupted; `()` of others."""


# --- the watched numbers and their response ------------------------------------------------------


def _watched(state: LoopState, values: LoopState) -> list:
    """The leaves of `values` at the levels of the plant and at the floating-point states of
    observer and actuator of `state`. The state of the law is not watched.
    """
    reference_leaves = jax.tree.leaves((state.x, state.observer, state.actuator))
    found = jax.tree.leaves((values.x, values.observer, values.actuator))
    pairs = zip(reference_leaves, found, strict=True)
    return [x for leaf, x in pairs if jnp.issubdtype(leaf.dtype, jnp.floating)]


def watched_indices(state: LoopState) -> np.ndarray:
    """Indices of the m watched numbers in the flat `closed_loop.perturbed_state`; all of them for a
    sampled loop.
    """
    if not is_absent(state.sampled):
        return np.arange(sum(x.size for x in jax.tree.leaves(perturbed_state(state))))
    leaves, structure = jax.tree.flatten(state)
    ends = np.cumsum([0, *(x.size for x in leaves)])
    indices = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    return np.concatenate(_watched(state, jax.tree.unflatten(structure, indices)))


@partial(jax.jit, static_argnames="n", inline=True)  # inline, so that JAX traces it once
def response(jacobian: jax.Array, n: int) -> jax.Array:
    """R of the Jacobian by the watched numbers, (m, m) [1/s]; 0 where it is not finite."""
    inner = jacobian[n:, n:]
    size = len(inner)
    resolvent = SLOWEST_RATE * jnp.eye(size, dtype=inner.dtype) - inner.T
    found = solve(resolvent, jnp.eye(size, n, dtype=inner.dtype)).T
    return jnp.where(jnp.isfinite(found), found, 0.0)


def _rate(accuracy: Accuracy, slope: LoopState) -> jax.Array:
    """The rate of the positions and of their final displacement, (2 n,)."""
    n = slope.x.shape[-1]
    flat = jnp.concatenate([jnp.ravel(x) for x in _watched(slope, slope)])
    flat = jax.lax.stop_gradient(flat)
    return jnp.concatenate([flat[:n], flat[:n] + matvec(accuracy.response, flat[n:])])


# --- local errors from step to step --------------------------------------------------------------


def _rates_per_step(table: Tableau) -> int:
    """Rates of a step that enter the differences: at its start, and in its middle if the method
    has a stage there.
    """
    return 2 if table.halfway else 1


def steps_back(method: str) -> int:
    """Number of past steps that enter the differences."""
    table = tableau(method)
    return (len(table.differences) - 1) // _rates_per_step(table)


def initial_accuracy(method: str, jacobian: jax.Array, state: LoopState) -> Accuracy:
    """The estimate before the first step.

    Args:
      method: the integrator.
      jacobian: of the closed loop at the start by the watched numbers, (m, m) [1/s].
      state: state at the start.
    """
    n = state.x.shape[-1]
    R = response(jacobian, n)
    none = jnp.zeros((2 * n,), jacobian.dtype)
    pending = (none,) * steps_back(method)
    if not is_absent(state.sampled):
        # Only a method of one stage uses an earlier rate; only levels have a local error.
        pending = (none,) if len(tableau(method).c) == 1 else ()
        R = R[:, : state.x[1:].size]
    return Accuracy(pending, none, R, none[:n], none[0])


def update(
    accuracy: Accuracy,
    method: str,
    dt: jax.Array,
    index: jax.Array,
    pieces: StepSlopes,
    width: jax.Array,
    sampled: bool = False,
    restarts: jax.Array | None = None,
    too_many_jumps: jax.Array | None = None,
    absolute: bool = False,
) -> Accuracy:
    """The estimate after one more step.

    Args:
      accuracy: before it.
      method: the integrator.
      dt: time step, () [s].
      index: number of the step, () int.
      pieces: of the step.
      width: of the tube, (n,) [rad].
      sampled: whether the law is sampled.
      restarts: whether a jump lies in this step or in one of those that the differences cover,
        () bool; None for scenarios without jumps.
      too_many_jumps: whether jumps lie at more times than a step is divided at, () bool; None where
        this cannot happen.
      absolute: whether the absolute values of the local errors are summed, for a continuous loop
        whose input jumps within the steps.
    """
    table = tableau(method)
    if too_many_jumps is not None:
        accuracy = accuracy._replace(
            error=jnp.where(too_many_jumps, jnp.inf, accuracy.error),
            relative=jnp.where(too_many_jumps, jnp.inf, accuracy.relative),
        )
    width = jax.lax.stop_gradient(width)
    if sampled:
        return _update_by_stages(accuracy, table, dt, pieces, width, restarts)
    return _update_by_differences(accuracy, table, dt, index, pieces, width, restarts, absolute)


def _update_by_differences(
    accuracy: Accuracy,
    table: Tableau,
    dt: jax.Array,
    index: jax.Array,
    pieces: StepSlopes,
    width: jax.Array,
    restarts: jax.Array | None,
    absolute: bool,
) -> Accuracy:
    """The estimate of a continuous loop: differences of rates over several steps.

    `pending[k]` collects the local error of the step k later. Its oldest entry is complete with
    the rate at this instant; the others receive the weighted rates of this step.
    """
    slopes = pieces[0][1]
    newest_first = table.differences[::-1]
    per_step = _rates_per_step(table)
    here = _rate(accuracy, slopes[0])
    local_error = accuracy.pending[0] + newest_first[0] * here
    has_history = index >= len(accuracy.pending)
    added = jnp.where(has_history, dt, 0.0) * local_error
    if restarts is not None:
        rate = partial(_rate, accuracy)
        by_stages = sum(_error_by_stages(rate, table, length, each) for length, each in pieces)
        added = jnp.where(restarts, by_stages, added)
    if absolute:
        added = jnp.abs(added)
    accumulated = (1.0 - SLOWEST_RATE * dt) * accuracy.accumulated_error + added
    pending = [
        x + newest_first[per_step * (k + 1)] * here
        for k, x in enumerate((*accuracy.pending[1:], jnp.zeros_like(here)))
    ]
    if table.halfway:
        middle = _rate(accuracy, slopes[table.halfway])
        pending = [x + newest_first[2 * k + 1] * middle for k, x in enumerate(pending)]
    return _with_error(accuracy, tuple(pending), accumulated, width)


def _update_by_stages(
    accuracy: Accuracy,
    table: Tableau,
    dt: jax.Array,
    pieces: StepSlopes,
    width: jax.Array,
    restarts: jax.Array | None,
) -> Accuracy:
    """The estimate of a sampled loop: from the stages of one step. A method of one stage is
    compared with the step before.
    """
    accumulated = (1.0 - SLOWEST_RATE * dt) * accuracy.accumulated_error

    def motion_rate(slope: LoopState) -> jax.Array:
        return _rate(accuracy, slope._replace(observer=(), actuator=()))

    if not accuracy.pending:
        for length, slopes in pieces:
            accumulated = accumulated + _error_by_stages(motion_rate, table, length, slopes)
        return _with_error(accuracy, (), accumulated, width)
    before = accuracy.pending[0]
    for length, slopes in pieces:
        here = motion_rate(slopes[0])
        local_error = (here - before) / 2.0
        if restarts is not None:
            local_error = jnp.where(restarts, 0.0, local_error)
        accumulated = accumulated + jax.lax.stop_gradient(length) * local_error
        before = here
    return _with_error(accuracy, (motion_rate(pieces[0][1][0]),), accumulated, width)


def _error_by_stages(
    rate: Callable,
    table: Tableau,
    length: jax.Array,
    slopes: list[LoopState],
    ratio_of: Callable | None = None,
) -> jax.Array:
    """Local error of one step of this length from the slopes of its stages, in terms of `rate` of a
    slope.

    A method of one stage has no such estimate, and the result is 0. The factors below are those of
    rk4, which has a stage in the middle of a step, and of Heun's method.
    """
    if len(table.c) == 1:
        return jnp.zeros_like(rate(slopes[0]))
    late = table.halfway or 1
    later = jax.tree.map(jnp.subtract, slopes[late], slopes[late - 1])
    early, fraction = slopes[0], 1.0
    if table.halfway:
        early, fraction = jax.tree.map(jnp.subtract, slopes[1], slopes[0]), 2.0
    tiny = jnp.finfo(length.dtype).tiny
    if ratio_of is None:
        ratio = fraction * _size(later) / jnp.maximum(_size(early), tiny)
    else:
        ratio = fraction * ratio_of(later, early, tiny)
    dt_A = jnp.minimum(ratio, 2.0)
    factor = dt_A**2 / 3.0 if table.halfway else dt_A * 5.0 / 3.0
    return jax.lax.stop_gradient(length) * (rate(later) * factor)


def local_error_of_state(
    method: str, pieces: StepSlopes, rate_at_end: Callable[[], LoopState]
) -> jax.Array:
    """The local error of a step, of the flat `integrated_part`.

    Args:
      method: the integrator.
      pieces: of the step.
      rate_at_end: gives the rate at the end of a step of Euler's method, whose local error is
        dt (F(x + dt F) - F(x)) / 2.
    """

    def flat(slope: LoopState) -> jax.Array:
        slope = slope._replace(command=())
        return jax.lax.stop_gradient(ravel_pytree(slope)[0])

    table = tableau(method)
    if len(table.c) == 1:
        length, slopes = pieces[0]
        return 0.5 * jax.lax.stop_gradient(length) * (flat(rate_at_end()) - flat(slopes[0]))
    total: Any = 0.0
    for length, slopes in pieces:
        total = total + _error_by_stages(flat, table, length, slopes, _ratio_by_levels)
    return total  # type: ignore[no-any-return]


def _ratio_by_levels(later: LoopState, early: LoopState, tiny: jax.Array) -> jax.Array:
    """Ratio of two differences of slopes, () [1].

    Each level drives the other, so the geometric mean of the ratios of position and velocity is
    dt |A| whatever their units are; the states of other parts have a ratio of their own.
    """

    def ratio(of: Callable) -> jax.Array:
        return _size(of(later)) / jnp.maximum(_size(of(early)), tiny)  # type: ignore[no-any-return]

    def others(slope: LoopState) -> tuple:
        return slope.controller, slope.observer, slope.actuator, slope.x[2:]

    levels = jnp.sqrt(ratio(lambda slope: slope.x[0]) * ratio(lambda slope: slope.x[1]))
    if not any(x.size for x in jax.tree.leaves(others(later))):
        return levels
    return jnp.maximum(levels, ratio(others))


def _size(slope: LoopState) -> Any:
    """Sum of the absolute values of all numbers of a slope."""
    return sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(jax.lax.stop_gradient(slope)))


def _with_error(
    accuracy: Accuracy,
    pending: tuple[jax.Array, ...],
    accumulated: jax.Array,
    width: jax.Array,
) -> Accuracy:
    """The estimate with a new accumulated error."""
    n = width.size
    size = jnp.maximum(jnp.abs(accumulated[:n]), jnp.abs(accumulated[n:]))
    return accuracy._replace(
        pending=pending,
        accumulated_error=accumulated,
        error=jnp.maximum(accuracy.error, size),
        relative=jnp.maximum(accuracy.relative, jnp.max(size / width)),
    )


# --- signals that the stages cannot resolve ------------------------------------------------------


class UnresolvedSignals(NamedTuple):
    """Largest quadrature errors of a method for the signals of a scenario."""

    rate_error: jax.Array
    """Quadrature error of the rates of reference and bounds, (n,) [rad/s]."""
    disturbance_error: jax.Array
    """Quadrature error of the disturbance, (n,) [N m]; after `with_acceleration`, the acceleration
    that it causes, (n,) [rad/s^2]."""
    width: jax.Array
    """Smallest width of the tube, (n,) [rad]."""

    @staticmethod
    def zero(n: int, dtype: Any) -> UnresolvedSignals:
        """Zeros, where no estimate is of interest."""
        none = jnp.zeros(n, dtype)
        return UnresolvedSignals(none, none, none)


def unresolved_signals(
    scenario: Scenario, method: str, dt: jax.Array, steps: int | jax.Array
) -> UnresolvedSignals:
    """Quadrature errors of a method for reference, bounds and disturbance, in some steps of a run.

    The weighted rates of reference and bounds at the stages are compared with their change over the
    step, and the weighted torque of the disturbance with Gauss's three-point quadrature.
    """
    table, n = tableau(method), scenario.n
    scenario, dt = jax.lax.stop_gradient((scenario, dt))
    # Fractions of the golden ratio, so that the steps share no period with a signal.
    spread = jnp.asarray(np.arange(EXAMINED_STEPS) * GOLDEN_RATIO % 1.0, dt.dtype)
    starts = jnp.floor(spread * jnp.asarray(steps, spread.dtype)) * dt
    nodes = jnp.asarray([*table.c, *(node for node, _ in GAUSS), 1.0], dt.dtype)
    times = starts[:, None] + nodes * dt
    tube = _at_all_times(scenario.context.tube, times)
    weights = np.asarray(table.b, dt.dtype)[:, None]
    values = jnp.concatenate([tube.q_d, tube.lower, tube.upper], axis=-1)
    rates = jnp.concatenate([tube.dq_d, tube.dlower, tube.dupper], axis=-1)
    rate = jnp.sum(weights * rates[:, : len(table.c)], axis=1)
    change = (values[:, -1] - values[:, 0]) / dt
    # Rounding of the two values grows with the time at which they are evaluated.
    sizes = jnp.abs(values[:, 0]) + starts[:, None] * jnp.abs(rate)
    rounding = 4.0 * jnp.finfo(dt.dtype).eps * sizes / dt
    rate_error = jnp.maximum(jnp.abs(rate - change) - rounding, 0.0)
    rate_error = jnp.max(rate_error.reshape(EXAMINED_STEPS, -1, n), axis=1)
    disturbance_error = _disturbance_error(scenario, table, tube, times)
    jumps = scenario.jump_times()
    if jumps.size:
        # A step is divided at declared jumps, so its stages resolve them.
        before = starts - 0.5 * dt
        divided = jax.vmap(lambda start: has_jump(jumps, start, start + 2.0 * dt))(before)[:, None]
        rate_error = jnp.where(divided, 0.0, rate_error)
        disturbance_error = jnp.where(divided, 0.0, disturbance_error)
    rate_error = jnp.max(rate_error, axis=0)
    if scenario.sampling is not None:
        # A sampled law reads reference and bounds at its samples only.
        rate_error = jnp.zeros_like(rate_error)
    width = jnp.min((tube.upper - tube.lower)[:, 0], axis=0)
    return UnresolvedSignals(rate_error, jnp.max(disturbance_error, axis=0), width)


def _at_all_times(signal: Callable, times: jax.Array, *others: jax.Array) -> Any:
    """A signal at all nodes of all steps, (steps, nodes, ...), from arrays with these two axes."""
    flat = [x.reshape(times.size, *x.shape[2:]) for x in (times, *others)]
    found = jax.vmap(signal)(*flat)
    return jax.tree.map(lambda x: x.reshape(*times.shape, *x.shape[1:]), found)


def _disturbance_error(
    scenario: Scenario, table: Tableau, tube: Tube, times: jax.Array
) -> jax.Array:
    """Quadrature error of the disturbance, (steps, n) [N m], along the reference at the start of
    each step.
    """

    def torque(t: jax.Array, q: jax.Array, dq: jax.Array) -> jax.Array:
        if scenario.loop.plant.robot is None:
            return jnp.zeros_like(q)
        return disturbance_torque(scenario, t, q, dq)

    stages = len(table.c)
    own = np.asarray(table.b, times.dtype)[:, None]
    exact = np.asarray([weight for _, weight in GAUSS], times.dtype)[:, None]
    # The first stage of every method is at the start of the step.
    start = [jnp.broadcast_to(x[:, :1], x.shape) for x in (tube.q_d, tube.dq_d)]
    torques = _at_all_times(torque, times, *start)
    by_stages = jnp.sum(own * torques[:, :stages], axis=1)
    by_gauss = jnp.sum(exact * torques[:, stages:-1], axis=1)
    return jnp.abs(by_stages - by_gauss)


def with_acceleration(scenario: Scenario, found: UnresolvedSignals) -> UnresolvedSignals:
    """`found` with the error of the disturbance as an acceleration of the plant at the start."""
    t = jnp.zeros_like(found.disturbance_error[0])
    robot = scenario.loop.plant.at(t).robot
    if robot is None:
        return found
    M = robot.mass_matrix(scenario.initial.q)
    return found._replace(
        disturbance_error=jax.lax.stop_gradient(solve_spd(M, found.disturbance_error))
    )


def with_unresolved(accuracy: Accuracy, found: UnresolvedSignals) -> Accuracy:
    """The estimate with the unresolved signals after `with_acceleration`; the largest of them is
    assumed to last for 1/r.
    """
    displaced = jnp.abs(
        matvec(accuracy.response[:, : found.disturbance_error.size], found.disturbance_error)
    )
    error = (found.rate_error + ONSET_RATIO * displaced) / SLOWEST_RATE
    return accuracy._replace(
        error=jnp.maximum(accuracy.error, error),
        relative=jnp.maximum(accuracy.relative, jnp.max(error / found.width)),
    )


def results(accuracy: Accuracy) -> dict[str, jax.Array]:
    """The accuracy results of a run; infinite where the estimate is not a number."""
    found = {ERROR: accuracy.error, RELATIVE: accuracy.relative}
    return {name: jnp.where(jnp.isnan(x), jnp.inf, x) for name, x in found.items()}


def unknown(results: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """The accuracy results of a run with process noise, NaN: differences of rates show the noise
    and not the error of the method.
    """
    return {name: jnp.full_like(x, jnp.nan) for name, x in results.items()}

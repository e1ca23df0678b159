"""How accurate a run is: the error of its positions that the time step is to blame for, estimated
along every run.

A step's own error shows in the differences of the rates x' at the last instants; for rk4, whose
third stage is half a step on,

    l_k = dt (x'_{k-2} - 4 x'_{k-3/2} + 6 x'_{k-1} - 4 x'_{k-1/2} + x'_k) / 18,

and likewise for the other methods (`integrators.Tableau.differences`).  The factor is ten times
that of a smooth loop, so that a torque that jumps within a step is seen too.  Such errors add up
and are forgotten,

    L_k = (1 - dt r) L_{k-1} + l_k,   r = `stability.SLOWEST`,

and an error y of the velocities and of the observer moves the positions by R y, R = [I 0] (r I -
J)^-1, J the Jacobian of their rates at the start.  So the error of the positions is about

    max_k max(|L_q|, |L_q + R L_y|).

Where the law is sampled its torque jumps from step to step, and no difference of steps says
anything: there a step's own error is told by its stages alone.  For x' = A x those of rk4 have k_3
  - k_2 = (dt A / 2) (k_2 - k_1), which says how large |dt A| is, and the step's error
is dt |k_3 - k_2| |dt A|^2 / 30; Heun's is dt |k_2 - k_1| |dt A| / 6, where |dt A| is |k_2 - k_1| /
|k_1|.  Again ten times that is taken.  J is what the map from a period to the next is as a rate.

What the stages of a step cannot see, a reference or a disturbance that goes through whole periods
between them, is looked for on its own (`between_stages`).  At the jump times of a scenario a step
is divided (`jumps`), and no difference reaches over one of them: there, too, the stages of a step
give its error.  Against runs at a sixteenth of the step the estimate is a third to thirty times the
error where that matters, above 1e-4 of the tube, and larger below.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core.linalg import matvec, solve, solve_spd
from iblf_jax.simulation.closed_loop import LoopState, surroundings
from iblf_jax.simulation.integrators import Tableau, tableau
from iblf_jax.simulation.jumps import within
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.stability import SLOWEST
from iblf_jax.world.robots import at_time

TOLERANCE = 0.005
"""Estimated error of a position, relative to the width of its tube, above which a run is flagged
INACCURATE."""
INSTANTS = 16
"""Steps, spread over a run, in which signals are looked at between the stages."""
ONSET = 3.0
"""How much further a torque moves the positions when it sets in than when an observer has learnt
it."""
GAUSS = ((0.5 - 0.15**0.5, 5 / 18), (0.5, 8 / 18), (0.5 + 0.15**0.5, 5 / 18))
"""Places and weights of the quadrature that a step's own is held against."""
ERROR, RELATIVE = "numerical_error", "relative_numerical_error"
UNITS = ((ERROR, "rad"), (RELATIVE, "1"))
"""Name and unit of what every run says of its accuracy, beside its metrics."""


class Accuracy(NamedTuple):
    """The estimate as it goes from step to step.  m numbers: positions, velocities, state of the
    observer.
    """

    pending: tuple[jax.Array, ...]
    """What the rates so far add to the step errors of the next instants, (2 n,) each: of the
    positions, and of where they end up, from x'_q + R x'_y."""
    drift: jax.Array
    """L of these, (2 n,)."""
    response: jax.Array
    """R, (n, m - n)."""
    error: jax.Array
    """Largest error so far, (n,) [rad]."""
    relative: jax.Array
    """The largest, relative to the width of its tube, () [1]."""


def _watched(state: LoopState, of: LoopState | None = None) -> list:
    """The leaves of `of`, `state` if not given, that stand where `state` has positions, velocities
    and the floating-point state of observer and actuator.

    What a law has learnt is left out.
    """
    parts = [jax.tree.leaves((x.q, x.dq, x.observer, x.actuator)) for x in (state, of or state)]
    return [x for kind, x in zip(*parts, strict=True) if jnp.issubdtype(kind.dtype, jnp.floating)]


def places(state: LoopState) -> np.ndarray:
    """Where the numbers that are watched, m of them, stand in what `closed_loop.surroundings`
    gives, flat; all of a sampled loop.
    """
    if state.held:
        return np.arange(sum(x.size for x in jax.tree.leaves(surroundings(state))))
    leaves, structure = jax.tree.flatten(state)
    ends = np.cumsum([0, *(x.size for x in leaves)])
    numbered = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    return np.concatenate(_watched(state, jax.tree.unflatten(structure, numbered)))


@partial(jax.jit, static_argnames="n", inline=True)  # so that it is traced once
def response(jacobian: jax.Array, n: int) -> jax.Array:
    """R from the Jacobian by the numbers that are watched, (m, m) [1/s]; 0 where there is none."""
    inner = jacobian[n:, n:]
    size = len(inner)
    found = solve(
        SLOWEST * jnp.eye(size, dtype=inner.dtype) - inner.T, jnp.eye(size, n, dtype=inner.dtype)
    ).T
    return jnp.where(jnp.isfinite(found), found, 0.0)


def steps_back(method: str) -> int:
    """Over how many steps the differences reach that tell of a step's error."""
    table = tableau(method)
    return (len(table.differences) - 1) // (2 if table.halfway else 1)


def begin(method: str, jacobian: jax.Array, state: LoopState) -> Accuracy:
    """The estimate before the first step.

    Args:
      method: the integrator.
      jacobian: of the closed loop at the start, by the numbers that are watched, (m, m) [1/s].
      state: the state at the start.
    """
    n = state.q.size
    table = tableau(method)
    none = jnp.zeros((2 * n,), jacobian.dtype)
    if state.held:
        return Accuracy(
            (none,) if len(table.c) == 1 else (),
            none,
            response(jacobian, n)[:, :n],
            none[:n],
            none[0],
        )
    pending = (none,) * steps_back(method)
    return Accuracy(pending, none, response(jacobian, n), none[:n], none[0])


def _rate(accuracy: Accuracy, slope: LoopState) -> jax.Array:
    """The rate of the positions, and of where they end up, (2 n,)."""
    flat, n = (
        jax.lax.stop_gradient(jnp.concatenate([jnp.ravel(x) for x in _watched(slope)])),
        slope.q.size,
    )
    return jnp.concatenate([flat[:n], flat[:n] + matvec(accuracy.response, flat[n:])])


def observed(
    accuracy: Accuracy,
    method: str,
    dt: jax.Array,
    index: jax.Array,
    pieces: list[tuple[jax.Array, list[LoopState]]],
    width: jax.Array,
    held: bool = False,
    restarts: Any = None,
    overfull: Any = None,
) -> Accuracy:
    """The estimate after one more instant.

    Args:
      accuracy: before it.
      method: the integrator.
      dt: time step, () [s].
      index: number of the instant, () int.
      pieces: length [s] of each piece of the step from it (`jumps`), and the slopes of the stages
        there.
      width: of the tube, (n,) [rad].
      held: whether the torque is, as in a sampled loop.
      restarts: whether the differences reach over a jump, or there is one in this step, () bool;
        None where there are no jumps.
      overfull: whether a step has more jumps than it is divided at, () bool; None where that cannot
        be.
    """
    table, n = tableau(method), width.size
    if overfull is not None:
        accuracy = accuracy._replace(
            error=jnp.where(overfull, jnp.inf, accuracy.error),
            relative=jnp.where(overfull, jnp.inf, accuracy.relative),
        )
    if held:
        return _observed_within(accuracy, table, dt, pieces, width, restarts)
    slopes = pieces[0][1]
    weights, each = table.differences[::-1], 2 if table.halfway else 1
    width = jax.lax.stop_gradient(width)
    here = _rate(accuracy, slopes[0])
    complete = index >= len(accuracy.pending)
    error = accuracy.pending[0] + weights[0] * here
    added = jnp.where(complete, dt, 0.0) * error
    if restarts is not None:
        added = jnp.where(
            restarts,
            sum(
                _by_stages(partial(_rate, accuracy), table, length, slopes)
                for length, slopes in pieces
            ),
            added,
        )
    drift = (1.0 - SLOWEST * dt) * accuracy.drift + added
    pending = [
        x + weights[each * (k + 1)] * here
        for k, x in enumerate((*accuracy.pending[1:], jnp.zeros_like(here)))
    ]
    if table.halfway:
        middle = _rate(accuracy, slopes[table.halfway])
        pending = [x + weights[2 * k + 1] * middle for k, x in enumerate(pending)]
    size = jnp.maximum(jnp.abs(drift[:n]), jnp.abs(drift[n:]))
    relative = jnp.maximum(accuracy.relative, jnp.max(size / width))
    return Accuracy(
        tuple(pending), drift, accuracy.response, jnp.maximum(accuracy.error, size), relative
    )


def _by_stages(
    rate: Callable, table: Tableau, length: jax.Array, slopes: list[LoopState]
) -> jax.Array:
    """The error of one step of this length by the slopes of its stages, in terms of `rate` of a
    slope; 0 for a method of one stage.
    """
    if len(table.c) == 1:
        return jnp.zeros_like(rate(slopes[0]))
    late = table.halfway or 1
    later = jax.tree.map(jnp.subtract, slopes[late], slopes[late - 1])
    early = jax.tree.map(jnp.subtract, slopes[1], slopes[0]) if table.halfway else slopes[0]
    sizes = [
        sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(jax.lax.stop_gradient(part)))
        for part in (early, later)
    ]
    fast = jnp.minimum(
        (2.0 if table.halfway else 1.0)
        * sizes[1]
        / jnp.maximum(sizes[0], jnp.finfo(length.dtype).tiny),
        2.0,
    )
    error = rate(later) * (fast**2 / 3.0 if table.halfway else fast * 5.0 / 3.0)
    return jax.lax.stop_gradient(length) * error


def _observed_within(
    accuracy: Accuracy,
    table: Tableau,
    dt: jax.Array,
    pieces: list[tuple[jax.Array, list[LoopState]]],
    width: jax.Array,
    restarts: Any,
) -> Accuracy:
    """As `observed`, from the stages of one step; a method of one stage is held against the step
    before.
    """
    n, drift, before = width.size, (1.0 - SLOWEST * dt) * accuracy.drift, accuracy.pending

    def moved(slope: LoopState) -> jax.Array:
        return _rate(accuracy, slope._replace(observer=(), actuator=()))

    for length, slopes in pieces:
        if not before:
            drift = drift + _by_stages(moved, table, length, slopes)
            continue
        here = moved(slopes[0])
        error, before = (here - before[0]) / 2.0, (here,)
        if restarts is not None:
            error = jnp.where(restarts, 0.0, error)
        drift = drift + jax.lax.stop_gradient(length) * error
    size = jnp.maximum(jnp.abs(drift[:n]), jnp.abs(drift[n:]))
    relative = jnp.maximum(accuracy.relative, jnp.max(size / jax.lax.stop_gradient(width)))
    pending = (moved(pieces[0][1][0]),) if before else ()
    return Accuracy(pending, drift, accuracy.response, jnp.maximum(accuracy.error, size), relative)


class Unseen(NamedTuple):
    """The worst that the stages of a step cannot see, in the steps that were looked at."""

    missed: jax.Array
    """Of the rates of reference and bounds, (n,) [rad/s]."""
    push: jax.Array
    """Of the disturbance, (n,) [N m]; after `kicked` what it accelerates, (n,) [rad/s^2]."""
    width: jax.Array
    """Of the tube, where it is narrowest, (n,) [rad]."""


def unseen(scenario: Scenario, method: str, dt: jax.Array, steps: int | jax.Array) -> Unseen:
    """What reference, bounds and disturbance do between the stages of a step.

    In some steps the method's own quadrature of each signal is held against what the signal does:
    the rates of reference and bounds against their change over the step, the disturbance's torque
    against Gauss's three points.
    """
    table, n = tableau(method), scenario.n
    scenario, dt = jax.lax.stop_gradient((scenario, dt))
    own, exact = (
        np.asarray(weights, dt.dtype)[:, None] for weights in (table.b, [w for _, w in GAUSS])
    )
    places = jnp.asarray([*table.c, *(place for place, _ in GAUSS), 1.0], dt.dtype)
    stages, others = slice(len(table.c)), slice(len(table.c), -1)
    # Steps in the places of the golden section, so that they share no period with a signal.
    spread = jnp.asarray(np.arange(INSTANTS) * 0.6180339887498949 % 1.0, dt.dtype)
    starts = jnp.floor(spread * jnp.asarray(steps, spread.dtype)) * dt
    times = starts[:, None] + places * dt

    def at_all(signal: Callable, *args: jax.Array) -> Any:
        """A signal at all places of all steps, (INSTANTS, places, ...), from arrays with these two
        axes.
        """
        found = jax.vmap(signal)(*(x.reshape(times.size, *x.shape[2:]) for x in args))
        return jax.tree.map(lambda x: x.reshape(*times.shape, *x.shape[1:]), found)

    def torque(t: jax.Array, q: jax.Array, dq: jax.Array) -> jax.Array:
        return scenario.disturbance.torque(t, q, dq, at_time(scenario.plant, t), scenario.model)

    tube = at_all(scenario.context.tube, times)
    ends = jnp.concatenate([tube.q_d, tube.lower, tube.upper], axis=-1)
    rates = jnp.concatenate([tube.dq_d, tube.dlower, tube.dupper], axis=-1)
    # The first stage of every method is at the start of the step.
    torques = at_all(
        torque, times, *(jnp.broadcast_to(x[:, :1], x.shape) for x in (tube.q_d, tube.dq_d))
    )
    rate = jnp.sum(own * rates[:, stages], axis=1)
    # The difference of two positions is rounded, the more so the later it is: that much is no
    # error.
    noise = (
        4.0 * jnp.finfo(dt.dtype).eps * (jnp.abs(ends[:, 0]) + starts[:, None] * jnp.abs(rate)) / dt
    )
    missed = jnp.maximum(jnp.abs(rate - (ends[:, -1] - ends[:, 0]) / dt) - noise, 0.0)
    missed = jnp.max(missed.reshape(INSTANTS, -1, n), axis=1)
    push = jnp.abs(
        jnp.sum(own * torques[:, stages], axis=1) - jnp.sum(exact * torques[:, others], axis=1)
    )
    jumps = scenario.jump_times()
    if jumps.size:
        # A step is divided at the jumps that are declared: its stages see them.
        divided = jax.vmap(lambda start: within(jumps, start, start + 2.0 * dt))(starts - 0.5 * dt)[
            :, None
        ]
        missed, push = jnp.where(divided, 0.0, missed), jnp.where(divided, 0.0, push)
    missed = jnp.max(missed, axis=0)
    width = jnp.min((tube.upper - tube.lower)[:, 0], axis=0)
    # A sampled law reads them at its samples: what they do between is no error of the step.
    return Unseen(
        missed if scenario.sampling is None else jnp.zeros_like(missed),
        jnp.max(push, axis=0),
        width,
    )


def kicked(scenario: Scenario, found: Unseen) -> Unseen:
    """`found`, its torque turned into what it accelerates at the start."""
    M = at_time(scenario.plant, jnp.zeros_like(found.push[0])).mass_matrix(scenario.initial.q)
    return found._replace(push=jax.lax.stop_gradient(solve_spd(M, found.push)))


def between_stages(accuracy: Accuracy, found: Unseen) -> Accuracy:
    """The estimate, with what the stages did not see, given as accelerations; the worst is taken to
    last for 1/r.
    """
    pushed = jnp.abs(matvec(accuracy.response[:, : found.push.size], found.push))
    error = (found.missed + ONSET * pushed) / SLOWEST
    relative = jnp.max(error / found.width)
    return accuracy._replace(
        error=jnp.maximum(accuracy.error, error), relative=jnp.maximum(accuracy.relative, relative)
    )


def results(accuracy: Accuracy) -> dict[str, jax.Array]:
    """What a run says of its accuracy: infinite where nothing can be said."""
    found = {ERROR: accuracy.error, RELATIVE: accuracy.relative}
    return {name: jnp.where(jnp.isnan(x), jnp.inf, x) for name, x in found.items()}

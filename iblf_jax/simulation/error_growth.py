"""Growth of the numerical error in a loop whose feedback is interrupted.

The reading of an encoder and the torque of a quantiser are piecewise constant functions. While all
of them keep their values, a small error of the state does not act back on the torque, and it grows
as in the open loop. `error_estimate` assumes that errors decay, so such loops have an estimate of
their own. The same holds inside a dead zone or a backlash, and while an event trigger holds the
command.

Without a jump. A method of one step with the map Phi and the local error l has the global error

    e_(k+1) = Phi(x_k + e_k) - Phi(x_k) + l_k.                                            (A.1)

Phi is the real loop, with open dead zones and held codes. To first order in e and in dt,

    Phi(x + e) - Phi(x) = e + dt [F(x + s d, u + s du) - F(x, u)] |e| / s,   d = e / |e|,  (A.2)

with the rate F and a small s, and at a sample the law runs once more at the state x + s d. This
gives the errors of the command u and of the states of law, observer and sensor. The torque behind
a quantiser has no error, nor has a command that follows from rounded readings. A level that is
measured without rounding besides rounded ones is neglected, as its feedback damps the error. The
local error is that of the stages of the step, which is ten times that of a smooth loop, and the
rounding error of the numbers is added to it.

With a jump. A code may differ between the run and the exact solution if the error reaches the next
edge:

    |e_i| >= step_i / 2 - |round(y_i) - y_i|   at any sample, or the same for the command. (A.3)

An event trigger compares the command u with the held one h. Both have errors, e_u and e_h, and the
threshold depends on h. An event may differ if

    max_i (|e_u - e_h|_i + relative_i |e_h|_i) >= |max_i (|u_i - h_i| - relative_i |h_i| - a_i)|.

After that (A.2) does not hold. Both solutions are then those of the loop without rounding, driven
by rounding errors w with |w_i| <= step_i / 2 each, so their difference z satisfies

    z_(k+1) = Phi_s z_k + G (w_k - w'_k),   |w_i - w'_i| <= step_i,
    |z| <= sum_j |Phi_s^j G| step,                                                        (A.4)

with Phi_s the map of the smooth loop over a period (`stability.period_map`). The deviation of a
dead zone, a backlash or an event trigger from the smooth loop is bounded too, with its width in
the place of the step. Of an event trigger it is 2 (relative max |u| + absolute). (A.4) does not
depend on the time step. It holds with or without a jump, as far as the states at which the loop is
linearised (start, end, nearest to a bound) stand for the run.

The sum is attained only by errors v_k = w_k - w'_k whose signs follow those of Phi_s^j G. The
usual model of rounding is that of a noise. Here v_k is the sum of a constant and of a part whose
mean is zero, given all earlier ones; both are at most the step. The first acts through the gain for
constants. The second is a martingale, to which the inequality of Azuma and Hoeffding applies at
each of N samples for n positions. With the probability 1 - delta the run satisfies

    |z| <= |sum_j Phi_s^j G| step + (2 ln(2 n N / delta) sum_j |Phi_s^j G step|^2)^(1/2),  (A.5)

delta = PROBABILITY, |.| by columns and the last sum over all columns. The deviations of dead zones,
backlash and event triggers are no noise: their part is that of (A.4). The smaller one of (A.4) and
(A.5) counts. (A.5) is thus a probable bound under an assumption, and no proof. The assumption does
not hold in a limit cycle at a resonance of the loop, such as that of an arm at rest whose reading
alternates between two codes. Pairs of runs of 534 random two-link loops, a part of them found by a
search for large ratios, differed by at most 0.61 times the relative stated error; the medians by
sensor and actuator were 0.03 to 0.3. The worst limit cycle reached 0.81 times (A.5) of a joint.

The difference of two exact solutions does not contain the error of the loop without rounding,
which falls with the time step and is added. The stated error is the smaller one of the largest e
and this sum before a jump, and the sum after it.
In a continuous loop a quantiser jumps within the steps. The quadrature of a step across a jump of
the torque by `step` is wrong by up to dt step / 3 (rk4), and the differences of `error_estimate`
sum to 16/18 of dt step in absolute value. There the absolute values are summed, because those of
different jumps need not cancel. (A.4) and (A.5) are not computed, and the bound is not rigorous
there: it was compared with runs at a sixteenth of the step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from iblf_jax.control.sensors._base import sensor_of_x
from iblf_jax.core import checks
from iblf_jax.core.pytree import Absent, is_absent
from iblf_jax.kernels import matmul_in_order
from iblf_jax.simulation.closed_loop import (
    LoopState,
    evaluate,
    integrated_part,
    run_sampled_law,
    with_integrated_part,
)
from iblf_jax.simulation.error_estimate import RELATIVE, TOLERANCE, Accuracy
from iblf_jax.simulation.noise import normals
from iblf_jax.simulation.sampling import Instant, step_commands
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.stability import linear_flow

T = TypeVar("T")

BOUND = "relative_rounding_error"
"""Name of the smaller one of the bounds (A.4) and (A.5), relative to the width of the tube, among
the metrics of a sampled run whose feedback is interrupted; 0 where, to first order, no error
reached a code."""
SUMMED_PERIODS = 256
"""Periods over which the sum of (A.4) is exact."""
PROBABILITY = 1e-9
"""Of an error above (A.5) anywhere in a run, if its assumption holds. It is so small that (A.5)
covered the limit cycles that were found, to which the assumption does not apply."""
ARITHMETIC = 4.0
"""Rounding error of a reading or a command, in units of its last place."""


class ErrorGrowth(NamedTuple):
    """The error of (A.1) between two steps."""

    error: Any
    """Of the `_variables` of the state."""
    jumped: jax.Array
    """1 if a code may have differed at a sample so far, else 0, ()."""
    largest: jax.Array
    """Largest position error before a jump, (n,) [rad]."""
    relative: jax.Array
    """The same relative to the width of the tube, () [1]."""
    peak: jax.Array | Absent
    """Largest command so far, (n,) [N m], in a loop with an event trigger; `()` in others."""


def is_interrupted(scenario: Scenario) -> bool:
    """Whether a part of the loop does not pass on every small difference: it rounds, has a dead
    zone or play, or holds commands until an event.
    """
    sampling, smooth = scenario.sampling, scenario.actuator.smooth
    if sampling is None:
        return smooth is not scenario.actuator and not rounds_continuously(scenario)
    if sampling.trigger is not None or smooth is not scenario.actuator:
        return True
    return _rounds_readings(scenario)


def rounds_continuously(scenario: Scenario) -> bool:
    """Whether the input of a continuous loop may jump within every step, or is delayed and passes
    an interrupted actuator.
    """
    actuator = scenario.actuator
    if scenario.sampling is not None or actuator.smooth is actuator:
        return False
    if actuator.input_delay is not None:
        return True
    return _rounds_torque(scenario)


def _rounds_readings(scenario: Scenario) -> bool:
    """Whether the sensor rounds."""
    return scenario.sensor.unrounded is not scenario.sensor


def _rounds_torque(scenario: Scenario) -> bool:
    """Whether the actuator rounds."""
    return scenario.actuator.resolution is not None


def _variables(scenario: Scenario, state: LoopState) -> Any:
    """The part of the state that has an error: of a loop with a sampled law the plant and the
    actuator, then law, observer and sensor, the commands in transit and the one sent last; only the
    first of these where the readings are rounded.
    """
    if scenario.sampling is None:
        return state
    if _rounds_readings(scenario):
        return (integrated_part(state),)
    sampled = state.sampled
    memory = (state.controller, state.observer, sampled.sensor)
    return integrated_part(state), memory, sampled.commands, sampled.sent


def initial_growth(scenario: Scenario, state: LoopState, derivative: jax.Array) -> Any:
    """The error before the first step, 0; `()` for a loop that is not interrupted.

    Args:
      scenario: the scenario.
      state: at the start.
      derivative: of `closed_loop.perturbed_rate` there, (M, M).
    """
    if not is_interrupted(scenario):
        return ()
    zero = jnp.zeros(scenario.n, state.x.dtype)
    peak: jax.Array | Absent = ()
    jumped = zero[0]
    sampling = scenario.sampling
    has_trigger = sampling is not None and sampling.trigger is not None
    if has_trigger:
        peak = zero
    rounds_twice = sampling is not None and (has_trigger or _rounds_torque(scenario))
    if rounds_twice and _rounds_readings(scenario):
        # Where the law depends on a level without rounding, the error of its command is not
        # followed, so any of its codes may differ.
        plant = ravel_pytree(integrated_part(state))[0].size
        steps = _resolution(scenario, state.x)
        by_level = [
            jnp.where(step == 0, derivative[plant:, rows], 0.0)
            for rows, step in zip(_rows_of_levels(state), steps, strict=True)
        ]
        jumped = jnp.where(jnp.any(jnp.stack(by_level) != 0.0), 1.0, jumped)
    none = jax.tree.map(jnp.zeros_like, _variables(scenario, state))
    return ErrorGrowth(none, jumped, zero, zero[0], peak)


def _rows_of_levels(state: LoopState) -> list[slice]:
    """Where each level lies in the flat `integrated_part`."""
    order, n = state.x.shape
    return [slice(k * n, (k + 1) * n) for k in range(order)]


# --- a step --------------------------------------------------------------------------------------


def _shifted(x: T, by: Any, factor: jax.Array) -> T:
    """A pytree x + factor by; leaves that are no floats stay."""

    def one(a: jax.Array, b: jax.Array) -> jax.Array:
        return a + factor * b if jnp.issubdtype(a.dtype, jnp.floating) else a

    return jax.tree.map(one, x, by)


def _scales(error: Any) -> tuple[jax.Array, jax.Array]:
    """The factors s / |e|, by which an error becomes a small difference, and |e| / s."""
    leaves = [x for x in jax.tree.leaves(error) if jnp.issubdtype(x.dtype, jnp.floating)]
    size = jnp.sum(jnp.stack([jnp.sum(jnp.abs(x)) for x in leaves]))
    small = jnp.finfo(size.dtype).eps ** 0.5
    size = jnp.maximum(size, jnp.finfo(size.dtype).eps ** 2)
    return small / size, size / small


def update(
    growth: ErrorGrowth,
    scenario: Scenario,
    dt: jax.Array,
    index: jax.Array,
    now: Instant | None,
    noise_key: jax.Array,
    before: LoopState,
    state: LoopState,
    local_error: jax.Array,
    width: jax.Array,
) -> ErrorGrowth:
    """The error after one more step.

    Args:
      growth: before it.
      scenario: the scenario.
      dt: time step, () [s].
      index: number of the step, () int.
      now: its position between samples; None for a continuous loop.
      noise_key: key of the run's random numbers.
      before, state: the state at the start of the step, before and after the law has run.
      local_error: of the step, of the flat `integrated_part`.
      width: of the tube, (n,) [rad].
    """
    scenario, before, state, local_error, width = jax.lax.stop_gradient(
        (scenario, before, state, local_error, width)
    )
    t = index.astype(dt.dtype) * dt
    command_error: jax.Array | None = None
    command: jax.Array | None = None
    if now is not None:
        growth = jax.lax.cond(
            now.phase == 0,
            lambda old: _at_sample(old, scenario, t, now, noise_key, before, state),
            lambda old: old,
            growth,
        )
        command, command_error = _command_with_error(scenario, dt, now, state, growth)
    part = growth.error
    if now is not None:
        part = part[0]  # of the `_variables`
    errors = (part, command_error)
    small, back = _scales(errors)
    base = integrated_part(state)
    rate = _rate(scenario, t, state, base, command)
    if command is not None and command_error is not None:
        command = command + small * command_error
    shifted = _rate(scenario, t, state, _shifted(base, part, small), command)
    flat, unflatten = ravel_pytree(part)
    grown = flat + dt * back * (ravel_pytree(shifted)[0] - ravel_pytree(rate)[0])
    rounding = jnp.finfo(dt.dtype).eps * jnp.abs(ravel_pytree(base)[0])
    grown = grown + local_error
    grown = grown + jnp.where(grown < 0, -rounding, rounding)
    grown = jnp.where(growth.jumped > 0, 0.0, grown)
    error = unflatten(grown)
    if now is not None:
        error = (error, *growth.error[1:])
    size = jnp.where(growth.jumped > 0, 0.0, jnp.abs(grown[: width.size]))
    return growth._replace(
        error=error,
        largest=jnp.maximum(growth.largest, size),
        relative=jnp.maximum(growth.relative, jnp.max(size / width)),
    )


def rate_at_end(
    scenario: Scenario, dt: jax.Array, index: jax.Array, now: Instant | None, state: LoopState
) -> LoopState:
    """The rate at the end of a step of Euler's method from a state."""
    t, command = index.astype(dt.dtype) * dt, None
    if now is not None:
        sampling = checks.given(scenario.sampling)
        command = step_commands(sampling, dt, now, state.sampled.commands).first
    part = integrated_part(state)
    end = _shifted(part, _rate(scenario, t, state, part, command), dt)
    return _rate(scenario, t + dt, state, end, command)


def _rate(
    scenario: Scenario,
    t: jax.Array,
    state: LoopState,
    part: LoopState,
    command: jax.Array | None,
) -> LoopState:
    """The rate of the `integrated_part` of a state."""
    arguments = () if command is None else (command,)
    return evaluate(scenario, t, with_integrated_part(state, part), *arguments)[0]


def _command_with_error(
    scenario: Scenario, dt: jax.Array, now: Instant, state: LoopState, growth: ErrorGrowth
) -> tuple[jax.Array, jax.Array]:
    """The command at the actuator at the start of a step, (n,), and its mean error over the
    step.
    """
    sampling = checks.given(scenario.sampling)
    command = step_commands(sampling, dt, now, state.sampled.commands).first
    is_cut = _rounds_readings(scenario) or _rounds_torque(scenario)
    if is_cut:
        return command, jnp.zeros_like(command)
    errors = step_commands(sampling, dt, now, growth.error[2])
    mean = errors.arrival * errors.first + (1.0 - errors.arrival) * errors.next
    return command, jnp.where(errors.arrives, mean, errors.first)


def _at_sample(
    growth: ErrorGrowth,
    scenario: Scenario,
    t: jax.Array,
    now: Instant,
    noise_key: jax.Array,
    before: LoopState,
    state: LoopState,
) -> ErrorGrowth:
    """The errors after the law has run, and whether a code may differ (A.3)."""
    normal = normals(noise_key, now.sampling_index, scenario.sensor.draws, scenario.n).astype(
        state.x.dtype
    )
    if not _rounds_readings(scenario):
        return _after_law(growth, scenario, t, normal, before, state)
    # A code differs if the error of a level reaches the next one.
    step = _resolution(scenario, before.x)
    period = checks.given(scenario.sampling).period
    rounded, exact = (
        sensor_of_x(sensor).measure(before.x, normal, period, before.sampled.sensor)[0].x
        for sensor in (scenario.sensor, scenario.sensor.unrounded)
    )
    distance = 0.5 * step - jnp.abs(rounded - exact)
    blur = ARITHMETIC * jnp.finfo(step.dtype).eps * jnp.abs(rounded)
    reaches = jnp.any((step > 0) & (jnp.abs(growth.error[0].x) + blur >= distance))
    return growth._replace(jumped=jnp.where(reaches, 1.0, growth.jumped))


def _after_law(
    growth: ErrorGrowth,
    scenario: Scenario,
    t: jax.Array,
    normal: jax.Array,
    before: LoopState,
    state: LoopState,
) -> ErrorGrowth:
    """The errors of command and memory after a law that receives readings without rounding, and
    whether an event or a level of the torque may differ.
    """
    sampling = checks.given(scenario.sampling)
    always = dataclasses.replace(scenario, sampling=dataclasses.replace(sampling, trigger=None))
    part, memory, commands, sent = growth.error
    sampled = before.sampled
    states = (before.controller, before.observer, sampled.sensor)
    small, back = _scales((part.x, memory))

    def law(scale: jax.Array) -> tuple[jax.Array, Any]:
        x = _shifted(before.x, part.x, scale)
        controller, observer, sensor = _shifted(states, memory, scale)
        at = before._replace(x=x, controller=controller, observer=observer)
        at = at._replace(sampled=sampled._replace(sensor=sensor, sent=()))
        after = run_sampled_law(always, t, at, normal)
        after_memory = (after.controller, after.observer, after.sampled.sensor)
        return after.sampled.commands[0], after_memory

    unshifted, shifted = law(jnp.zeros_like(small)), law(small)
    command = unshifted[0]
    command_error, memory = _shifted(
        jax.tree.map(jnp.zeros_like, unshifted), _difference(unshifted, shifted), back
    )
    blur = ARITHMETIC * jnp.finfo(command.dtype).eps * jnp.abs(command)
    reaches, peak = jnp.zeros((), bool), growth.peak
    if sampling.trigger is not None and not is_absent(peak):
        peak = jnp.maximum(peak, jnp.abs(command))
        relative = sampling.trigger.relative
        size = jnp.abs(sampled.sent.input)
        threshold = relative * size + sampling.trigger.absolute
        distance = jnp.abs(jnp.max(jnp.abs(command - sampled.sent.input) - threshold))
        moved = jnp.abs(command_error - sent.input) + relative * jnp.abs(sent.input)
        rounding = blur + ARITHMETIC * jnp.finfo(size.dtype).eps * (size + threshold)
        reaches = (jnp.max(moved + rounding) >= distance) & (sampled.sent.number > 0)
        fires = state.sampled.sent.number > sampled.sent.number
        command_error = jnp.where(fires, command_error, sent.input)
        sent = sent._replace(input=command_error, torque=command_error)
    if _rounds_torque(scenario):
        actuator: Any = scenario.actuator.at(t)
        distance = actuator.distance_to_jump(state.sampled.commands[0], state.x[1], state.actuator)
        reaches = reaches | jnp.any(jnp.abs(command_error) + blur >= distance)
    jumped = jnp.where(reaches, 1.0, growth.jumped)
    commands = jnp.concatenate([command_error[None], commands[:-1]])
    after = (memory, commands, sent)
    after = jax.tree.map(lambda x: jnp.where(jumped > 0, jnp.zeros_like(x), x), after)
    return growth._replace(error=(part, *after), jumped=jumped, peak=peak)


def _difference(x: T, y: T) -> T:
    """The difference y - x of two pytrees; 0 for leaves that are no floats."""

    def one(a: jax.Array, b: jax.Array) -> jax.Array:
        return b - a if jnp.issubdtype(a.dtype, jnp.floating) else jnp.zeros_like(a)

    return jax.tree.map(one, x, y)


def _resolution(scenario: Scenario, x: jax.Array) -> jax.Array:
    """The step of the readings of each level of a state x, (r, n); 0 for one that is not
    rounded.
    """
    step = jnp.asarray(scenario.sensor.resolution, x.dtype)
    if step.ndim < 2:
        first = jnp.broadcast_to(step, x[:1].shape)
        return jnp.concatenate([first, jnp.zeros_like(x[1:])])
    return jnp.broadcast_to(step, x.shape)


# --- the bound after a jump ----------------------------------------------------------------------


def bound(
    scenario: Scenario,
    growth: ErrorGrowth,
    state: LoopState,
    derivative: jax.Array,
    Phi: jax.Array,
    periods: jax.Array,
) -> jax.Array:
    """The smaller one of (A.4) and (A.5), (n,) [rad]; infinite where the sums overflow.

    Args:
      scenario: with a sampling.
      growth: after the run.
      state: of the loop, for its structure.
      derivative: of `closed_loop.perturbed_rate` by `closed_loop.perturbed_state`, (M, M).
      Phi: its `stability.period_map`, (m, m) [1].
      periods: in the run, () [1].
    """
    arguments = jax.lax.stop_gradient((scenario, growth, state, derivative, Phi, periods))
    rigorous, probable = (jnp.where(jnp.isnan(x), jnp.inf, x) for x in _bounds(*arguments))
    return jnp.minimum(rigorous, probable)


def _bounds(
    scenario: Scenario,
    growth: ErrorGrowth,
    state: LoopState,
    derivative: jax.Array,
    Phi: jax.Array,
    periods: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """(A.4) and (A.5), (n,) [rad] each; infinite or not a number where the sums overflow."""
    n = scenario.n
    others, rounding = _inputs(scenario, growth, state, derivative, len(Phi))
    G = jnp.concatenate([others, rounding], axis=1)

    def add(j: jax.Array, found: tuple) -> tuple:
        total, term = found
        total = total + jnp.where(j < periods, jnp.abs(term), 0.0)
        return total, matmul_in_order(Phi, term)

    total, _ = jax.lax.fori_loop(0, SUMMED_PERIODS, add, (jnp.zeros_like(G), G))
    sums = _doubled(Phi, total, rounding, periods)
    by_column = sums.absolute[:n]
    rigorous = jnp.sum(by_column, axis=1)
    deviations = jnp.sqrt(jnp.diagonal(sums.gramian)[:n])
    likely = jnp.sqrt(2.0 * jnp.log(2.0 * n * periods / PROBABILITY)) * deviations
    constant = jnp.sum(jnp.abs(sums.effect[:n]), axis=1)
    probable = jnp.sum(by_column[:, : others.shape[1]], axis=1) + constant + likely
    return rigorous, probable


class _Sums(NamedTuple):
    """Sums of powers Phi^j over the first periods, and the next power."""

    periods: jax.Array
    """That the sums cover, () [1]; a power of two."""
    power: jax.Array
    """Phi^periods, (m, m)."""
    absolute: jax.Array
    """Of |Phi^j G|, (m, c + o), with the inputs that do not round; at least over SUMMED_PERIODS."""
    effect: jax.Array
    """Of Phi^j G, (m, c): of a constant rounding error."""
    gramian: jax.Array
    """Of Phi^j G G^T Phi^j^T, (m, m)."""


def _doubled(Phi: jax.Array, absolute: jax.Array, G: jax.Array, periods: jax.Array) -> _Sums:
    """The sums over at least this number of periods, from those of |Phi^j G| over SUMMED_PERIODS
    and the effects G of the rounding errors.

    The doubled sums are exact, but that of absolute values: |Phi^N| times their sum over the first
    N periods is at least that over the next N.
    """

    def doubled(sums: _Sums) -> _Sums:
        power = sums.power
        more = matmul_in_order(jnp.abs(power), sums.absolute)
        inputs = jnp.concatenate([sums.effect, sums.gramian, power], axis=1)
        later, by_gramian, squared = jnp.split(
            matmul_in_order(power, inputs), [G.shape[1], G.shape[1] + len(Phi)], axis=1
        )
        return _Sums(
            2.0 * sums.periods,
            squared,
            sums.absolute + jnp.where(sums.periods >= SUMMED_PERIODS, more, 0.0),
            sums.effect + later,
            sums.gramian + matmul_in_order(by_gramian, power.T),
        )

    one = jnp.ones((), Phi.dtype)
    start = _Sums(one, Phi, absolute, G, matmul_in_order(G, G.T))
    return jax.lax.while_loop(lambda sums: sums.periods < periods, doubled, start)


def _inputs(
    scenario: Scenario, growth: ErrorGrowth, state: LoopState, derivative: jax.Array, size: int
) -> tuple[jax.Array, jax.Array]:
    """The effects G of the deviations of dead zone, backlash and event trigger, (m, n), and of
    those of rounding, (m, c), each times its largest value; `size` is m.  What a loop does not have
    has no columns: their sums of powers would take most of the time.
    """
    sampling = checks.given(scenario.sampling)
    n = scenario.n
    plant = ravel_pytree(integrated_part(state))[0].size
    memory = len(derivative) - plant - n
    A, B = derivative[:plant, :plant], derivative[:plant, plant : plant + n]
    by_torque = linear_flow(A, B, sampling.period)[:, plant:]

    def columns(plant_rows: jax.Array, memory_rows: jax.Array) -> jax.Array:
        rest = jnp.zeros((size - plant - memory, n), derivative.dtype)
        return jnp.concatenate([plant_rows, memory_rows, rest])

    direct = columns(by_torque, jnp.zeros((memory, n), derivative.dtype))
    width, step_of_torque = _torque_widths(scenario, growth)
    inputs = []
    if step_of_torque is not None:
        inputs.append(direct * step_of_torque)
    if _rounds_readings(scenario):
        levels = list(zip(_rows_of_levels(state), _resolution(scenario, state.x), strict=True))
        if jnp.ndim(scenario.sensor.resolution) < 2:
            levels = levels[:1]  # only the positions are rounded
        for rows, of_level in levels:
            law = derivative[plant : plant + n, rows]
            by_law = columns(matmul_in_order(by_torque, law), derivative[plant + n :, rows])
            if sampling.queue:
                # The command waits in the queue.
                last = plant + memory
                waiting = [by_law[plant:last], law, by_law[last + n :]]
                by_law = jnp.concatenate([jnp.zeros_like(by_law[:plant]), *waiting])
            inputs.append(by_law * of_level)
    none = jnp.zeros((size, 1), derivative.dtype)
    others = none[:, :0]
    if width is not None:
        others = direct * width
    return others, jnp.concatenate(inputs or [none], axis=1)


def with_growth(
    accuracy: Accuracy, bounds: jax.Array, width: jax.Array
) -> tuple[Accuracy, dict[str, jax.Array]]:
    """The `error_estimate.Accuracy` of a run, as the head of this module states, and the results
    that it adds to the metrics.

    Args:
      accuracy: after the run; its error is that of the loop without rounding.
      bounds: of `bound`, (n,) [rad].
      width: smallest width of the tube, (n,) [rad].
    """
    growth = accuracy.error_growth
    of_codes = jnp.max(bounds / width)
    bounds = bounds + accuracy.error
    relative = of_codes + accuracy.relative
    jumped = growth.jumped > 0
    before = jnp.maximum(accuracy.error, growth.largest)
    before_relative = jnp.maximum(accuracy.relative, growth.relative)
    found = accuracy._replace(
        error=jnp.where(jumped, bounds, jnp.minimum(before, bounds)),
        relative=jnp.where(jumped, relative, jnp.minimum(before_relative, relative)),
    )
    return found, {BOUND: jnp.where(jumped, of_codes, 0.0)}


def errors_by_step(metrics: Mapping[Any, Any]) -> jax.Array:
    """The stated error of runs relative to the tube, as far as a smaller step makes it tolerable;
    `metrics` are by name.

    No step makes a bound above the tolerance tolerable. Of such a run it is the rest of the
    error, or 0 if that is tolerable.
    """
    if BOUND not in metrics:
        return metrics[RELATIVE]
    errors, bounds = jnp.asarray(metrics[RELATIVE]), jnp.asarray(metrics[BOUND])
    # Less the rounding error of the sum, so that it does not count as an error by the step.
    rest = errors - (1.0 + ARITHMETIC * jnp.finfo(errors.dtype).eps) * bounds
    return jnp.where(bounds > TOLERANCE, jnp.where(rest > TOLERANCE, rest, 0.0), errors)


def _torque_widths(scenario: Scenario, growth: ErrorGrowth) -> tuple[jax.Array | None, Any]:
    """Largest difference of two deviations of the torque from that of the smooth loop, (n,)
    [N m], less that of rounding, and that of rounding; None for a torque that does not deviate, and
    for one that is not rounded.
    """
    sampling = checks.given(scenario.sampling)
    deviation, step = scenario.actuator.deviation, scenario.actuator.resolution
    terms: list[Any] = []
    if deviation is not None:
        terms.append(deviation)
    elif scenario.actuator.smooth is not scenario.actuator:
        terms.append(jnp.inf)
    if step is not None:
        terms.append(-step)
    if sampling.trigger is not None:
        trigger = sampling.trigger
        terms.append(2.0 * (trigger.relative * growth.peak + trigger.absolute))
    if not terms:
        return None, step
    return sum(terms, jnp.zeros((scenario.n,), growth.largest.dtype)), step

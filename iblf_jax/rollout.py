"""The time loop: `simulate` runs one scenario and returns a `Rollout`.

Time is scanned here and nowhere else.  Per step: the closed loop is evaluated once for record, metrics and the first stage of the
integrator; a state that runs away is frozen at its last good value and flagged, so that no NaN ever enters a batch or a
gradient; the instant nearest to a bound is remembered, because the loop is stiffest there.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from iblf_jax import checks
from iblf_jax.bounds import NARROWEST, tube_at
from iblf_jax.closed_loop import LoopState, Sample, evaluate, initial_state
from iblf_jax.integrators import stages, step, tableau
from iblf_jax.metrics import Fold, as_folds
from iblf_jax.one_function import as_one_function, is_long
from iblf_jax.results import Metrics, Rollout
from iblf_jax.scenario import Scenario, canonical
from iblf_jax.stability import comfortable_dt, fastest_mode, fastest_mode_by_differences
from iblf_jax.status import FAILED, VELOCITY_LIMIT, Status, describe, flag

RECORDED = tuple(f.name for f in dataclasses.fields(Rollout) if f.name in Sample._fields and f.name != "dt")

MOST_SAMPLES = 20_000_000
"""More are not recorded, lest a slip in `duration` or `dt` fill the memory: for two joints they take some 5 GB."""


class SimulationError(RuntimeError):
    """A run that did not do its job, raised by `simulate(..., throw=True)`."""


class SimulationWarning(UserWarning):
    """A run whose result needs a second look."""


class Nearest(NamedTuple):
    """The instant at which a joint was nearest to its bound."""

    xi: jax.Array
    t: jax.Array
    state: LoopState


class Carry(NamedTuple):
    """What goes from step to step."""

    state: LoopState
    accumulators: tuple
    status: jax.Array
    nearest: Nearest


class Outcome(NamedTuple):
    """What the time loop returns."""

    records: Any
    metrics: dict[str, jax.Array]
    status: jax.Array
    fastest_mode: jax.Array


def sample_status(sample: Sample) -> jax.Array:
    """The flags that one sample raises, () int32."""
    narrowest = jnp.minimum(sample.q_d - sample.lower, sample.upper - sample.q_d)
    margin = jnp.minimum(sample.q - sample.lower, sample.upper - sample.q)
    return (
        flag(jnp.any(~(margin > 0)), Status.BOUND_VIOLATED)
        | flag(jnp.any(narrowest < NARROWEST), Status.INFEASIBLE_REFERENCE)
        | flag(jnp.any(sample.guard_active), Status.GUARD_ACTIVE)
        | flag(jnp.any(sample.saturated), Status.TORQUE_SATURATED)
    )


def is_sound(state: LoopState) -> jax.Array:
    """Whether a state is finite and slow enough to be a robot's, () bool."""
    finite = jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(state)])
    return jnp.all(finite) & jnp.all(jnp.abs(state.dq) < VELOCITY_LIMIT)


def _keep_if(condition, new, old):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _folded(folds, sample: Sample, carry: Carry) -> Carry:
    """The carry with a sample folded in."""
    accumulators = tuple(fold.update(acc, sample) for fold, acc in zip(folds, carry.accumulators, strict=True))
    near = jnp.max(jnp.abs(jax.lax.stop_gradient(sample.xi)))
    here = Nearest(near, sample.t, jax.lax.stop_gradient(carry.state))
    nearest = _keep_if(near > carry.nearest.xi, here, carry.nearest)
    return Carry(carry.state, accumulators, carry.status | sample_status(sample), nearest)


def advance(scenario: Scenario, folds, method: str, dt, carry: Carry, index, loop=evaluate) -> tuple[Carry, Sample]:
    """One step of the time loop: observe, integrate, freeze what runs away.  `loop` stands for `closed_loop.evaluate`."""
    t = index.astype(dt.dtype) * dt
    slope, sample = loop(scenario, t, carry.state, dt)
    carry = _folded(folds, sample, carry)
    stepped = step(method, lambda t, state: loop(scenario, t, state)[0], t, carry.state, dt, slope)
    return _moved(carry, stepped), sample


def _moved(carry: Carry, stepped: LoopState, moving: jax.Array | bool = True) -> Carry:
    """The carry at the next instant if `moving`, its state frozen if that ran away."""
    sound = is_sound(stepped) & (carry.status & int(Status.NOT_FINITE) == 0)
    state = _keep_if(sound & moving, stepped, carry.state)
    return carry._replace(state=state, status=carry.status | flag(~sound & moving, Status.NOT_FINITE))


def start(scenario: Scenario, folds, dt) -> Carry:
    """The carry before the first step."""
    state, zero = initial_state(scenario), jnp.zeros_like(dt)
    _, first = evaluate(scenario, zero, state, dt)
    nearest = Nearest(-jnp.ones_like(dt), zero, jax.lax.stop_gradient(state))
    return Carry(state, tuple(fold.init(first) for fold in folds), jnp.int32(0), nearest)


def finish(scenario: Scenario, folds, method: str, dt, steps: int, carry: Carry) -> tuple[Carry, Sample, Outcome]:
    """The last sample, the folds' results and the verdict on the step."""
    carry, sample = observe_end(scenario, folds, dt, steps, carry)
    modes = jax.vmap(partial(fastest_mode, scenario))(*critical_instants(scenario, dt, steps, carry))
    return carry, sample, verdict(folds, method, dt, carry, modes)


def observe_end(scenario: Scenario, folds, dt, steps: int, carry: Carry) -> tuple[Carry, Sample]:
    """The carry and the sample after the last step."""
    _, sample = evaluate(scenario, dt * steps, carry.state, jnp.zeros_like(dt))
    return _folded(folds, sample, carry), sample


def critical_instants(scenario: Scenario, dt, steps: int, carry: Carry) -> tuple[jax.Array, LoopState]:
    """Times and states, stacked, at which the loop's modes are measured: the start, where a joint was nearest to its bound, the end."""
    end = dt * steps
    times = jnp.stack([jnp.zeros_like(end), carry.nearest.t, end])
    states = jax.tree.map(lambda *xs: jnp.stack(xs), initial_state(scenario), carry.nearest.state, carry.state)
    return jax.lax.stop_gradient((times, states))


def verdict(folds, method: str, dt, carry: Carry, modes: jax.Array) -> Outcome:
    """The folds' results, and the status with the verdict on the step, given the measured modes [1/s]."""
    mode = jnp.max(jnp.where(jnp.isfinite(modes), modes, 0.0))
    status = carry.status | flag(dt * mode > tableau(method).stability, Status.STEP_TOO_LARGE)
    metrics: dict[str, jax.Array] = {}
    for fold, acc in zip(folds, carry.accumulators, strict=True):
        metrics |= fold.finish(acc)
    return Outcome(None, metrics, status, mode)


def record_of(sample: Sample, state: LoopState):
    """What is kept of a sample, and the states of law and observer."""
    return {name: getattr(sample, name) for name in RECORDED}, state.controller, state.observer


def run(scenario: Scenario, folds, dt, *, steps: int, record_every: int | None, method: str) -> Outcome:
    """The whole time loop for one run, pure and unchecked.

    Records are stacked every `record_every` steps; with None there are none, and memory does not grow with time.
    """
    if _is_long(scenario, dt):
        return run_compactly(scenario, folds, dt, steps=steps, record_every=record_every, method=method)
    advance_one = partial(advance, scenario, folds, method, dt)

    def recorded(carry, index):
        state = carry.state
        carry, sample = advance_one(carry, index)
        return carry, record_of(sample, state)

    def unrecorded(carry, index):
        return advance_one(carry, index)[0], None

    def block(carry, index):
        carry, record = recorded(carry, index)
        return jax.lax.scan(unrecorded, carry, index + jnp.arange(1, record_every))[0], record

    carry = start(scenario, folds, dt)
    if record_every is None:
        carry, _ = jax.lax.scan(unrecorded, carry, jnp.arange(steps))
        return finish(scenario, folds, method, dt, steps, carry)[2]
    blocks, rest = divmod(steps, record_every)
    carry, records = jax.lax.scan(recorded if record_every == 1 else block, carry, record_every * jnp.arange(blocks))
    if rest:
        last = record_of(evaluate(scenario, dt * (blocks * record_every), carry.state, dt)[1], carry.state)
        carry, _ = jax.lax.scan(unrecorded, carry, blocks * record_every + jnp.arange(rest))
    carry, sample, outcome = finish(scenario, folds, method, dt, steps, carry)
    if not rest:
        last = record_of(sample, carry.state)
    records = jax.tree.map(lambda many, one: jnp.concatenate([many, one[None]]), records, last)
    return outcome._replace(records=records)


_evaluate_once = jax.jit(evaluate)
"""`closed_loop.evaluate`, traced once however often it is called."""


def _is_long(scenario: Scenario, dt) -> bool:
    """Whether the closed loop is for `run_compactly`."""
    return is_long(_evaluate_once, scenario, jnp.zeros_like(dt), initial_state(scenario), dt)


def run_compactly(scenario: Scenario, folds, dt, *, steps: int, record_every: int | None, method: str, alone: bool = False) -> Outcome:
    """As `run`, for a closed loop of so many operations that compiling is what takes the time.

    The closed loop is there once, in a loop over the stages of the integrator, and once more where its modes are measured.  So the
    sample at the end is that of a step that is not made, and the accumulators begin with the first sample.  `alone` says that nobody
    will batch it from outside: then its pieces become machine functions.
    """
    piece = as_one_function if alone else lambda function: function
    every = min(record_every or 1, steps + 1)
    state, zero = initial_state(scenario), jnp.zeros_like(dt)
    shapes = jax.eval_shape(_evaluate_once, scenario, zero, state, dt)
    _, whole_sample = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes[1]))
    _, whole = ravel_pytree(state)
    weights = tuple(jnp.asarray(w, dt.dtype) for w in stages(method))

    @piece
    def loop(scenario, t, x, covered):
        return tuple(ravel_pytree(part)[0] for part in _evaluate_once(scenario, t, whole(x), covered))

    @piece
    def after(carry, record, index, sample, stepped):
        sample = whole_sample(sample)
        begun = carry._replace(accumulators=_keep_if(index > 0, carry.accumulators, tuple(fold.init(sample) for fold in folds)))
        moved = _moved(_folded(folds, sample, begun), whole(stepped), index < steps)
        record = _keep_if(index % every == 0, record_of(sample, carry.state), record) if record_every else None
        return _keep_if(index <= steps, moved, carry), record

    def one(carried, index):
        carry, record = carried
        t, x = index.astype(dt.dtype) * dt, ravel_pytree(carry.state)[0]
        covered = jnp.where(index < steps, dt, zero)

        def stage(slope_and_sum, weights):
            (k, total), (c, a, b) = slope_and_sum, weights
            k, sample = loop(scenario, t + c * dt, x + dt * (a * k), covered)
            return (k, total + b * k), sample

        (_, total), samples = jax.lax.scan(stage, (jnp.zeros_like(x), jnp.zeros_like(x)), weights)
        return after(carry, record, index, samples[0], x + dt * total), None

    def block(carried, first):
        carried, _ = jax.lax.scan(one, carried, first + jnp.arange(every))
        return carried, carried[1]

    blank = jax.eval_shape(lambda sample: tuple(fold.init(sample) for fold in folds), shapes[1])
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), blank)
    carry = Carry(state, blank, jnp.int32(0), Nearest(-jnp.ones_like(dt), zero, jax.lax.stop_gradient(state)))
    record = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(record_of, shapes[1], state)) if record_every else None
    (carry, _), records = jax.lax.scan(block, (carry, record), every * jnp.arange(steps // every + 1))
    times, states = critical_instants(scenario, dt, steps, carry)

    def mode(instant):
        t, state = instant
        return fastest_mode_by_differences(lambda x: loop(scenario, t, x, zero)[0], ravel_pytree(state)[0])

    modes = jax.lax.map(mode, (times, states))
    return verdict(folds, method, dt, carry, modes)._replace(records=records)


@partial(jax.jit, static_argnames=("steps", "record_every", "method", "alone"))
def _run_compiled(scenario, folds, dt, *, steps, record_every, method, alone):
    """`run`, compiled; `alone` says that nobody will batch it from outside, so that it may become one machine function."""
    options: dict[str, Any] = {"steps": steps, "record_every": record_every, "method": method}
    if alone and _is_long(scenario, dt):
        return run_compactly(scenario, folds, dt, alone=True, **options)
    one = partial(run, steps=steps, record_every=record_every, method=method)
    return (as_one_function(one) if alone else one)(scenario, folds, dt)


@partial(jax.jit, static_argnames=("steps", "record_every", "method", "backend"))
def _run_lowered(scenario, folds, dt, *, steps, record_every, method, backend):
    """`run` by the scalar program of its step, which is not differentiable in reverse; what is long or does not lower runs as it is."""
    from iblf_jax.lowering import run_alone

    options = {"steps": steps, "record_every": record_every, "method": method}
    if backend == "xla" and _is_long(scenario, dt):
        return run_compactly(scenario, folds, dt, alone=True, **options)
    return run_alone(scenario, folds, dt, backend=backend, **options)


SINGLE_RUN_BACKENDS = ("xla", "native", "gpu")
"""How `simulate` can execute one run."""


def simulate(
    scenario: Scenario,
    *,
    duration: float,
    dt: float = 1e-3,
    method: str = "rk4",
    record_every: int = 1,
    metrics: Sequence[Fold] | None = None,
    throw: bool = False,
    backend: str = "xla",
) -> Rollout:
    """Runs a scenario with a fixed step and returns everything that can be looked at.

        x' = rate(t, x),   x = (q, q', state of the law, state of the observer)                 (closed_loop)

    Works under `jax.jit`, `vmap`, `grad`, `jacfwd`: differentiate `run.metrics` or any array by the leaves of the scenario.
    New values of leaves do not recompile; a new structure, number of steps or method does.

    Args:
      scenario: what to run, of n joints.
      duration: length of the run [s], a whole number of steps.
      dt: time step [s]; `recommended_dt(scenario)` says which will do.
      method: "rk4", "heun" or "euler".
      record_every: record every so-many-th step; metrics and status cover every step whatever is recorded.
      metrics: the folds to run; None for `iblf_jax.metrics.standard()`.
      throw: raise instead of warn when the run failed.
      backend: "xla", or "native": the same program as generated code, several times faster once the system's compiler has built it
        (seconds, once for a structure; kept on disk), or "gpu": the same as one kernel on an NVIDIA GPU.  Inside your own `jit`, `vmap`
        or `grad` a run is always on xla.

    Returns:
      A `Rollout` with T = steps // record_every + 1 samples.

    Raises:
      ValueError: bad arguments; the message names the field, the value and the mend.
      SimulationError: with `throw`, when a bound was violated, the state ran away or the step was too large.

    Source: design of this package; the closed loop is Zhang & Yan 2024, section 3.
    """
    tableau(method)
    checks.one_of("backend", backend, SINGLE_RUN_BACKENDS)
    steps = checks.whole_steps(duration, dt)
    record_every = checks.positive_integer("record_every", record_every)
    if steps // record_every > MOST_SAMPLES:
        mend = f"Take record_every={-(-steps // MOST_SAMPLES)} or more; metrics cover every step all the same."
        raise checks.fail("record_every", record_every, f"at most {MOST_SAMPLES} recorded samples of {steps} steps", mend)
    scenario = canonical(scenario)
    dtype = scenario.initial.q.dtype
    folds = as_folds(metrics, dtype)
    step_size = jnp.asarray(dt, dtype)
    result = trajectory(scenario, folds, step_size, steps=steps, method=method, record_every=record_every, backend=backend)
    if checks.is_concrete(result.status) and result.status.ndim == 0:
        _report(result, steps, throw)
    return result


def trajectory(scenario: Scenario, folds, dt, *, steps: int, method: str, record_every: int, backend: str = "xla") -> Rollout:
    """`simulate` without checks and verdicts: for scenarios that are canonical, or that a study has drawn."""
    options = {"steps": steps, "record_every": record_every, "method": method}
    if checks.is_concrete((scenario, folds)):
        outcome = _run_lowered(scenario, folds, dt, **options, backend=backend)
        if checks.is_concrete(outcome.status) and int(outcome.status) & int(Status.NOT_FINITE):
            # A lowered sine is NaN for an argument that is very large; the library's is not.
            outcome = _run_compiled(scenario, folds, dt, alone=True, **options)
    else:
        outcome = _run_compiled(scenario, folds, dt, alone=False, **options)
    arrays, controller_state, observer_state = outcome.records
    units = tuple(pair for fold in folds for pair in getattr(fold, "units", {}).items())
    return Rollout(
        scenario=scenario,
        controller_state=controller_state,
        observer_state=observer_state,
        metrics=Metrics(outcome.metrics, units),
        status=outcome.status,
        fastest_mode=outcome.fastest_mode,
        dt=dt,
        method=method,
        **arrays,
    )


def _report(result: Rollout, steps: int, throw: bool) -> None:
    """Raises or warns, with the physics in the message, if a run failed."""
    status = Status(int(result.status))
    if status & Status.INFEASIBLE_REFERENCE:
        raise _infeasible(result, steps)
    if not status & FAILED:
        return
    text = f"The run failed: {describe(status & FAILED)}. " + " ".join(_explanations(result, status))
    if throw:
        raise SimulationError(text)
    warnings.warn(text, SimulationWarning, stacklevel=3)


def _explanations(result: Rollout, status: Status) -> list[str]:
    texts = []
    metrics = result.metrics
    if status & Status.BOUND_VIOLATED and "first_violation_time" in metrics:
        joint = int(metrics["first_violation_joint"])
        texts.append(
            f"Joint {joint} left its bounds first, at t = {float(metrics['first_violation_time']):.4g} s; "
            f"its smallest margin is {float(metrics['margin'][joint]):.3g} rad."
        )
    if status & Status.STEP_TOO_LARGE:
        mode = float(result.fastest_mode)
        limit = tableau(result.method).stability / mode
        texts.append(
            f"The closed loop's fastest mode is {mode:.4g} 1/s, so {result.method} is stable up to dt = {limit:.3g} s only; "
            f"dt = {float(result.dt):g} s was asked for. Take dt={comfortable_dt(mode):g}, or lower controller.K2 or observer.kf."
        )
    elif status & Status.NOT_FINITE:
        texts.append("The step was small enough for the fastest mode: look at the gains, the start and the disturbance.")
    return texts


def _infeasible(result: Rollout, steps: int) -> ValueError:
    """The error for a reference that touches a bound (Assumption 2), with joint and time."""
    times = jnp.arange(steps + 1).astype(result.dt.dtype) * result.dt
    tube = jax.jit(jax.vmap(partial(tube_at, result.scenario.reference, result.scenario.bounds)))(times)
    q_d, lower, upper = (np.asarray(x) for x in (tube.q_d, tube.lower, tube.upper))
    sample, joint = np.unravel_index(np.argmin(np.minimum(q_d - lower, upper - q_d)), q_d.shape)
    where = f"t = {float(times[sample]):.4g} s"
    return checks.fail(
        f"reference of joint {joint}",
        float(q_d[sample, joint]),
        f"a value inside the bounds ({float(lower[sample, joint]):.6g}, {float(upper[sample, joint]):.6g}) at {where}",
        "The reference must stay strictly inside the bounds (Assumption 2): move it, widen the bounds or shorten the run.",
    )

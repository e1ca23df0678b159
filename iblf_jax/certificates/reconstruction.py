"""Reconstruction of every step of a run from its recorded samples, with the terms of its claims.

A recorded sample holds the complete state of the loop. The steps between two samples are therefore
integrated again from the first, and must arrive at the second; and the recorded signals must be
those that the scenario gives there. If not, the run is refused, because a certificate would be
about another loop. Rounding differences (another backend, another machine) are tolerated; the
restart at every sample keeps them small.

A run whose status makes its numbers meaningless is not reconstructed: its recorded samples are used
as they are.

This is the only module of the package that runs the engine step by step. It works in blocks of
`BLOCK_STEPS` steps, so that one compiled program serves runs of every length.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from iblf_jax.certificates.terms import terms_and_sample
from iblf_jax.core import checks
from iblf_jax.core.attributes import attributes
from iblf_jax.core.families import is_default
from iblf_jax.core.status import UNTRUSTED, Status, describe, has_flag
from iblf_jax.engine import Step, step_states
from iblf_jax.simulation import discontinuities
from iblf_jax.simulation.closed_loop import LoopState, evaluate, initial_state
from iblf_jax.simulation.results import Rollout
from iblf_jax.world.plants import Plant

if TYPE_CHECKING:
    from iblf_jax.certificates.claims._base import Claim

BLOCK_STEPS = 1024
"""Steps in a block: memory does not grow with the length of a run, and one program serves every
length."""
STATES = {
    "q": "position",
    "dq": "speed",
    "controller_state": "memory",
    "observer_state": "memory",
    "x[2:]": "level",
}
SIGNALS = {
    "q_d": "position",
    "lower": "position",
    "upper": "position",
    "alpha": "speed",
    "tau": "torque",
    "disturbance": "torque",
    "disturbance_estimate": "torque",
    "e": "level",
    "level_lower": "level",
    "level_upper": "level",
}
"""Part of a state or signal -> kind of its tolerance.  A level above the second and each array of a
memory have units of their own, hence their own scale if it is larger."""


T = TypeVar("T")


class TimeGrid(NamedTuple):
    """The steps of a run."""

    record_every: int
    """Steps from one recorded sample to the next."""
    last: int
    """Number of the last step."""
    duration: float
    """[s]."""


class Steps(NamedTuple):
    """Consecutive steps of a run, on the host; time axis first."""

    t: np.ndarray
    sample: Any
    """`Sample` at each step."""
    terms: Any
    """`Terms` of NumPy arrays at each step."""
    recorded: np.ndarray
    """Whether the run recorded the step, bool."""
    defect: np.ndarray
    """Error of the integrator in V over one step from each."""
    defect_f: np.ndarray
    """Error of the integrator in |f_tilde|^2/2 over one step from each."""


def is_valid(run: Rollout) -> bool:
    """Whether the status of a run leaves its numbers meaningful."""
    return not int(run.status) & int(UNTRUSTED)


def time_grid(run: Rollout) -> TimeGrid:
    """The steps of a run; ValueError if its samples do not determine them."""
    t, dt = np.asarray(run.t, float), float(run.dt)
    every = (run.steps or 0) + 1
    if t.size > 1:
        every = int(np.rint((t[1] - t[0]) / dt))
    tolerance = 16 * np.finfo(np.asarray(run.t).dtype).eps * max(abs(t[-1]), dt)
    if every < 1 or not np.all(np.abs(t - np.arange(t.size) * every * dt) <= tolerance):
        raise checks.fail(
            "run.t",
            run.t,
            f"0 and whole multiples of run.dt, {dt:g} s, at equal distances",
            "Simulate it again.",
        )
    last_recorded = (t.size - 1) * every
    last = last_recorded if run.steps is None else run.steps
    if not last > 0 or not 0 <= last - last_recorded < every:
        raise checks.fail(
            "run",
            f"{t.size} recorded samples of {run.steps} steps",
            "samples that cover the run",
            "Simulate it again with record_every so small that there are two.",
        )
    return TimeGrid(every, last, last * dt)


def steps_of(run: Rollout, grid: TimeGrid, claims: tuple[Claim, ...]) -> Iterator[Steps]:
    """All steps of one run, its arrays on the host, in order, in blocks, with the terms of some
    claims about its scenario.

    Raises:
      ValueError: the scenario of the run does not give what the run recorded.
    """
    valid, sizes = is_valid(run), tolerances(run)
    blocks = _integrated_again(run, grid) if valid else _as_recorded(run, grid)
    for index, states in blocks:
        t, padded = index.astype(run.t.dtype) * run.dt, padded_index(index.size)
        padded_states = _rows(jax.tree.map(np.asarray, states), padded)
        found = terms_along(run, index[padded], padded_states, claims)
        terms, sample, defect, defect_f = _rows(found, slice(0, index.size))
        steps = Steps(t, sample, terms, index % grid.record_every == 0, defect, defect_f)
        if valid:
            _check_signals(run, steps, index[steps.recorded] // grid.record_every, sizes)
        yield steps


# --- the states of all steps ---------------------------------------------------------------------


def _recorded_states(run: Rollout) -> LoopState:
    """The states at the recorded samples."""
    return LoopState(run.x, run.controller_state, run.observer_state, run.actuator_state)


def _rows(tree: T, rows: np.ndarray | slice | tuple[slice, int]) -> T:
    """Some rows of every array of a pytree."""
    return jax.tree.map(lambda x: x[rows], tree)


def _as_recorded(run: Rollout, grid: TimeGrid) -> Iterator[tuple[np.ndarray, LoopState]]:
    """Numbers and states of the recorded steps only."""
    states = _recorded_states(run)
    for first in range(0, run.t.size, BLOCK_STEPS):
        rows = np.arange(first, min(first + BLOCK_STEPS, run.t.size))
        yield rows * grid.record_every, _rows(states, rows)


def _integrated_again(run: Rollout, grid: TimeGrid) -> Iterator[tuple[np.ndarray, LoopState]]:
    """Numbers and states of all steps, integrated again from each recorded sample to the next.

    A block holds the intervals of several samples where these are short, and a part of one interval
    where it is long.
    """
    recorded = _recorded_states(run)
    count, every = run.t.size, grid.record_every
    intervals, length = max(1, BLOCK_STEPS // every), min(every, BLOCK_STEPS)  # of a block
    offsets = range(0, every, length)
    start = jax.tree.map(lambda x: np.asarray(x)[None], initial_state(run.scenario))
    _check_arrival(run, _rows(recorded, slice(0, 1)), start, np.zeros(1, int))
    for first_row in range(0, count, intervals):
        samples = np.arange(first_row, first_row + intervals)
        rows = np.minimum(samples, count - 1)  # the last block repeats the last sample
        states = _rows(recorded, rows)
        for offset in offsets:
            first = rows * every + offset
            states, path = _advance(run, first, states, length)
            index = first[:, None] + np.arange(length)
            in_interval = np.arange(offset, offset + length) < every
            keep = (samples < count)[:, None] & in_interval & (index <= grid.last)
            if not keep.any():
                return
            path = jax.tree.map(np.asarray, path)
            yield index[keep], _rows(path, keep)
        # The last part of an interval may be shorter than `length`: its end lies on the path.
        arrived = jax.tree.map(np.asarray, states)
        remaining = every - offsets[-1]
        if remaining < length:
            arrived = _rows(path, (slice(None), remaining))
        has_next = samples < count - 1
        following = rows[has_next] + 1
        _check_arrival(run, _rows(recorded, following), _rows(arrived, has_next), following)


# --- steps of the engine -------------------------------------------------------------------------


class Position(NamedTuple):
    """A state of a run and its time, as a number of steps of a size."""

    steps: jax.Array
    """(), a float."""
    size: jax.Array
    """() [s]."""
    state: LoopState


@dataclasses.dataclass(frozen=True)
class ObserveStep(Step):
    """A step of the engine that keeps its position and records the terms of some claims there."""

    claims: tuple[Claim, ...]

    is_derivative: ClassVar[bool] = True

    def __call__(self, inputs: Any, at: Position, index: jax.Array, form: Any) -> tuple[Any, Any]:
        """The position, and its terms and sample."""
        t = at.steps * at.size
        return at, terms_and_sample(inputs.scenario, t, at.state, self.claims)


@dataclasses.dataclass(frozen=True)
class AdvanceStep(Step):
    """A step of the engine that makes the run's own step, of any size, and records the state, V2
    and |f_tilde|^2/2 before it.
    """

    method: str

    def __call__(self, inputs, at: Position, index: jax.Array, form):
        """The position after the step; the state, V2 and |f_tilde|^2/2 before it."""
        number = at.steps + index.astype(at.steps.dtype)
        span = discontinuities.Span(number * at.size, (number + 1.0) * at.size, at.size)
        division = discontinuities.divide_step(inputs.scenario.jump_times(), span)
        result = discontinuities.integrate_pieces(
            self.method,
            partial(evaluate, inputs.scenario),
            division,
            at.state,
            rolled=form.rolled,
        )
        f_tilde = result.aux.disturbance - result.aux.disturbance_estimate
        energies = (result.aux.V, 0.5 * jnp.sum(f_tilde**2))
        return at._replace(state=result.state), (at.state, energies)


def _positions(index: np.ndarray, states: LoopState, dt: jax.Array, substeps: int = 1) -> Position:
    """Positions of some steps, in time steps of dt divided by `substeps`."""
    dtype = np.asarray(dt).dtype
    steps = (substeps * index).astype(dtype)
    size = np.full(index.shape, float(dt) / substeps, dtype)
    return Position(jax.device_put(steps), jax.device_put(size), states)


def _advance(
    run: Rollout, first: np.ndarray, states: LoopState, length: int
) -> tuple[LoopState, LoopState]:
    """States after `length` steps from each of some states, and along the way."""
    at = _positions(first, states, run.dt)
    end, (path, _) = step_states(
        run.scenario, run.dt, at, step=AdvanceStep(run.method), steps=length
    )
    return end.state, path


def padded_index(size: int) -> np.ndarray:
    """Indices of an array of this size, the last one repeated up to the size of a block, so that
    one compiled program serves blocks of every size.
    """
    return np.minimum(np.arange(BLOCK_STEPS), size - 1)


def terms_along(
    run: Rollout, index: np.ndarray, states: LoopState, claims: tuple[Claim, ...]
) -> tuple[Any, Any, np.ndarray, np.ndarray]:
    """Terms of claims, samples and integration errors at some steps of a run.

    Args:
      run: its scenario, dt and method are used.
      index: numbers of the steps, (T,).
      states: the states before them, (T, ...).
      claims: about the scenario.

    Returns:
      Terms and samples; and the errors of the integrator in V and in |f_tilde|^2/2 over one step,
      on the host; (T, ...) each.
    """
    scenario, dt = run.scenario, run.dt
    full, halves = (_positions(index, states, dt, substeps) for substeps in (1, 2))
    # One step is compared with two half steps, because the envelopes are compared with a run in
    # which V has fallen below what the integrator resolves. Both are advanced three times, so that
    # they are one call of one program.
    both = jax.tree.map(lambda *xs: np.concatenate(xs), full, halves)
    energies = step_states(scenario, dt, both, step=AdvanceStep(run.method), steps=3)[1][1]
    found = step_states(scenario, dt, full, step=ObserveStep(claims))[1]
    terms, sample = jax.tree.map(lambda x: np.asarray(x)[:, 0], found)
    defect, defect_f = map(_defect, energies)
    energy = scenario.loop.model.energy_of_errors
    omits_f_tilde = any(claim.omits_f_tilde and claim.key in terms.claims for claim in claims)
    if omits_f_tilde and not is_default(energy, Plant.energy_of_errors):
        # V of a sample then includes |f_tilde|^2/2, which V of the claim does not.
        defect = defect + defect_f
    return terms, sample, defect, defect_f


def _defect(energy: jax.Array) -> np.ndarray:
    """Difference of an energy after one step and after two half steps, (T,), from its values along
    both, (2 T, 3); twice, for safety.
    """
    full, halves = np.split(np.asarray(energy), 2)
    return 2.0 * np.abs(full[:, 1] - halves[:, 2])


# --- comparison with what the run recorded -------------------------------------------------------


def tolerances(run: Rollout) -> dict[str, Any]:
    """Admissible differences between recorded and reconstructed signals, by kind: of positions,
    speeds and torques, () [rad, rad/s, N m], and of each level, (r, 1).
    """
    relative = np.sqrt(np.finfo(run.q.dtype).eps)

    def of_kind(kind: str, *states: str) -> float:
        names = (*states, *(name for name, own in SIGNALS.items() if own == kind))
        return max(relative * _largest(values) for values in attributes(run, names).values())

    position = of_kind("position", "q")
    # The speeds of a loop at rest are rounding errors, so positions set their scale, too.
    speed = max(of_kind("speed", "dq"), position)
    level = np.array([position, *[speed] * (run.x.shape[1] - 1)])
    for values in (run.x, run.e, run.level_lower, run.level_upper):
        for i in range(2, values.shape[1]):
            level[i] = max(level[i], relative * _largest(values[:, i]))
    return {
        "position": position,
        "speed": speed,
        "torque": of_kind("torque"),
        "level": level[:, None],
    }


def _largest(values: ArrayLike) -> float:
    """The largest finite size of some numbers; 0 without one."""
    return float(np.max(np.abs(values), where=np.isfinite(values), initial=0.0))


def _parts_of_state(state: LoopState) -> dict[str, Any]:
    """The parts that `STATES` names."""
    return {
        "q": state.q,
        "dq": state.dq,
        "controller_state": state.controller,
        "observer_state": state.observer,
        "x[2:]": state.x[:, 2:],
    }


def _check_arrival(
    run: Rollout, recorded: LoopState, reconstructed: LoopState, rows: np.ndarray
) -> None:
    """Raises ValueError if the reconstructed states are not those that the run recorded."""
    sizes = tolerances(run)
    expected, reached = map(_parts_of_state, (recorded, reconstructed))
    for label, kind in STATES.items():
        leaves = (jax.tree.leaves(expected[label]), jax.tree.leaves(reached[label]))
        for kept, made in zip(*leaves, strict=True):
            if kind == "memory":
                own = np.sqrt(np.finfo(kept.dtype).eps) * np.max(np.abs(kept), initial=0.0)
                tolerance = max(sizes["torque"], own)
            elif kind == "level":
                tolerance = sizes[kind][2:]
            else:
                tolerance = sizes[kind]
            _compare(run, label, kept, made, rows, tolerance)


def _check_signals(run: Rollout, steps: Steps, rows: np.ndarray, sizes: dict[str, Any]) -> None:
    """Raises ValueError if the signals of the scenario at recorded states are not those that the
    run recorded.
    """
    reconstructed = attributes(steps.sample, SIGNALS)
    for name, recorded in attributes(run, SIGNALS).items():
        tolerance = sizes[SIGNALS[name]]
        if SIGNALS[name] == "level":
            tolerance = tolerance[: recorded.shape[1]]
        _compare(run, name, recorded[rows], reconstructed[name][steps.recorded], rows, tolerance)


def _compare(
    run: Rollout,
    name: str,
    recorded: np.ndarray,
    reconstructed: np.ndarray,
    rows: np.ndarray,
    tolerance: float | np.ndarray,
) -> None:
    """Raises ValueError if a reconstructed signal differs from the recorded one."""
    # Levels without bounds have infinite ones.
    close = np.isclose(reconstructed, recorded, rtol=0.0, atol=tolerance)
    far = ~np.all(close, axis=tuple(range(1, np.ndim(recorded))))
    if not far.any():
        return
    k = int(np.argmax(far))
    where = f"{name} of sample {int(rows[k])} (t = {float(run.t[rows[k]]):.6g} s)"
    remedy = (
        f"Its scenario, dt and method do not reproduce the run: {where} is {recorded[k]}, and"
        f" {reconstructed[k]} when integrated again. Simulate it again; a loop that amplifies"
        " rounding that much needs record_every=1."
    )
    raise checks.fail(
        "run", "samples that its scenario does not give", "the run of run.scenario", remedy
    )


def check_status(run: Rollout, distance: float) -> None:
    """Raises ValueError if the status of a run contradicts the smallest distance to a bound over
    all its steps [rad] beyond rounding.
    """
    flagged = has_flag(int(run.status), Status.BOUND_VIOLATED)
    # Without the number of steps, the run may have left its bounds after its last sample.
    after_last_sample = flagged and distance > 0 and run.steps is None
    agrees = flagged == (not distance > 0)
    if agrees or after_last_sample or abs(distance) <= tolerances(run)["position"]:
        return
    remedy = (
        f"All its steps, integrated again, have a smallest margin of {distance:.3g} rad. Simulate"
        " it again."
    )
    raise checks.fail("run.status", describe(int(run.status)), "the status of run.scenario", remedy)

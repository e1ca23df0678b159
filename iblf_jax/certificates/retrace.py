"""Every step of a run again, from the samples that it recorded, in stretches of bounded size.

A recorded sample holds the whole state of the loop.  So the steps between two of them are made
again from the first, and must arrive at the second; and what the run recorded must be what its
scenario gives there.  If not, the run is refused: a certificate would speak of another loop.
  Differences of rounding (another backend, another machine) are let pass; starting anew at every
  sample keeps them small.

A run that is not to be believed is not made again: its recorded samples are looked at as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.certificates.proof_terms import Onward, Place, along_run
from iblf_jax.core import checks
from iblf_jax.core.status import UNTRUSTED, Status, describe
from iblf_jax.engine.execute import run_from
from iblf_jax.engine.plan import CERTIFY_STRETCH
from iblf_jax.simulation.closed_loop import LoopState, initial_state

POSITIONS, SPEEDS = ("q", "q_d", "lower", "upper"), ("dq", "alpha")
TORQUES = ("tau", "disturbance", "disturbance_estimate")


class Stretch(NamedTuple):
    """Consecutive steps of a run, on the host; time axis first."""

    t: np.ndarray
    sample: Any
    """Their `Sample`."""
    proof: Any
    """Their `ProofTerms`."""
    defect: np.ndarray
    """The integrator's error in V2 over one step from each."""
    recorded: np.ndarray
    """Whether the run recorded the step, bool."""
    defect_f: np.ndarray
    """As `defect`, in |f_tilde|^2/2."""


def states_of(run: Any) -> LoopState:
    """The states at the recorded samples."""
    return LoopState(run.q, run.dq, run.controller_state, run.observer_state, run.actuator_state)


def believed(run: Any) -> bool:
    """Whether the run's status leaves something to judge."""
    return not int(run.status) & int(UNTRUSTED)


def stretches(run: Any) -> Iterator[Stretch]:
    """All steps of one run, its arrays on the host, in their order.

    Raises:
      ValueError: the run's scenario does not give what it recorded.
    """
    every, last = grid(run)
    counted = _again(run, every, last) if believed(run) else _as_recorded(run, every)
    sizes = tolerances(run)
    for index, states in counted:
        stretch = _looked_at(run, index, states, every)
        if believed(run):
            _check_signals(run, stretch, index[stretch.recorded] // every, sizes)
        yield stretch


def grid(run: Any) -> tuple[int, int]:
    """Steps from one recorded sample to the next, and the number of the run's last step."""
    t, dt = np.asarray(run.t, float), float(run.dt)
    every = int(np.rint((t[1] - t[0]) / dt)) if t.size > 1 else (run.steps or 0) + 1
    slack = 16 * np.finfo(np.asarray(run.t).dtype).eps * max(abs(t[-1]), dt)
    if every < 1 or not np.all(np.abs(t - np.arange(t.size) * every * dt) <= slack):
        raise checks.fail(
            "run.t",
            run.t,
            f"0 and whole multiples of run.dt, {dt:g} s, at equal distances",
            "Simulate it again.",
        )
    last = (t.size - 1) * every if run.steps is None else run.steps
    if not last > 0 or not 0 <= last - (t.size - 1) * every < every:
        remedy = "Simulate it again with record_every so small that there are two."
        raise checks.fail(
            "run",
            f"{t.size} recorded samples of {run.steps} steps",
            "samples that cover the run",
            remedy,
        )
    return every, last


def tolerances(run: Any) -> dict[str, float]:
    """By how much a recorded quantity may differ from what the scenario gives, by kind [rad, rad/s,
    N m].
    """

    def largest(names):
        return max(float(np.max(np.abs(getattr(run, name)), initial=0.0)) for name in names)

    rough, position, torque = (
        np.sqrt(np.finfo(run.q.dtype).eps),
        largest(POSITIONS),
        largest(TORQUES),
    )
    # A loop at rest has speeds of rounding alone, which is why they are not held to their own size.
    return {
        "position": rough * position,
        "speed": rough * max(largest(SPEEDS), position),
        "torque": rough * torque,
    }


def _as_recorded(run: Any, every: int) -> Iterator[tuple[np.ndarray, LoopState]]:
    """Step numbers and states of the recorded samples alone."""
    for at in range(0, run.t.size, CERTIFY_STRETCH):
        rows = slice(at, min(at + CERTIFY_STRETCH, run.t.size))
        yield (
            np.arange(rows.start, rows.stop) * every,
            jax.tree.map(lambda x, rows=rows: x[rows], states_of(run)),
        )


def _again(run: Any, every: int, last: int) -> Iterator[tuple[np.ndarray, LoopState]]:
    """Step numbers and states of all steps, made again; several of the pieces between samples at
    once where they are short.
    """
    recorded, count = states_of(run), run.t.size
    together, length = max(1, CERTIFY_STRETCH // every), min(every, CERTIFY_STRETCH)
    start = jax.tree.map(np.asarray, initial_state(run.scenario))
    _check_arrival(
        run,
        jax.tree.map(lambda x: x[:1], recorded),
        jax.tree.map(lambda x: x[None], start),
        np.zeros(1, int),
    )
    for at in range(0, count, together):
        rows = np.minimum(np.arange(at, at + together), count - 1)
        states = jax.tree.map(lambda x, rows=rows: x[rows], recorded)
        for offset in range(0, every, length):
            first = rows * every + offset
            place = Place(
                jax.device_put(first.astype(run.dt.dtype)),
                jax.device_put(np.full(first.shape, run.dt, run.dt.dtype)),
                states,
            )
            (_, _, states), (path, _) = run_from(
                run.scenario, run.dt, place, step=Onward(run.method), steps=length
            )
            index = first[:, None] + np.arange(length)
            keep = (
                (np.arange(at, at + together) < count)[:, None]
                & (np.arange(offset, offset + length) < every)
                & (index <= last)
            )
            if not keep.any():
                return
            host = jax.tree.map(np.asarray, path)
            yield index[keep], jax.tree.map(lambda x, keep=keep: x[keep], host)
        arrived, rest = jax.tree.map(np.asarray, states), every - offset
        if rest < length:
            arrived = jax.tree.map(lambda x, rest=rest: x[:, rest], host)
        come = np.arange(at, at + together) < count - 1
        arrived = jax.tree.map(lambda x, come=come: x[come], arrived)
        _check_arrival(
            run,
            jax.tree.map(lambda x, rows=rows, come=come: x[rows[come] + 1], recorded),
            arrived,
            rows[come] + 1,
        )


def _looked_at(run: Any, index: np.ndarray, states: LoopState, every: int) -> Stretch:
    """What there is at some steps, by a program of one size."""
    size, places = index.size, np.minimum(np.arange(CERTIFY_STRETCH), index.size - 1)
    t = index.astype(run.t.dtype) * run.dt
    padded = jax.tree.map(lambda x: np.asarray(x)[places], states)
    found = along_run(run.scenario, index[places], padded, run.dt, method=run.method)
    proof, sample, defect, defect_f = jax.tree.map(lambda x: x[:size], found)
    return Stretch(t, sample, proof, defect, index % every == 0, defect_f)


def _check_arrival(run: Any, recorded: LoopState, made: LoopState, rows: np.ndarray) -> None:
    """Raises ValueError if the states that were made again are not those that the run recorded
    there.
    """
    sizes = tolerances(run)
    for name, kind in (
        ("q", "position"),
        ("dq", "speed"),
        ("controller", "torque"),
        ("observer", "torque"),
    ):
        label = {"controller": "controller_state", "observer": "observer_state"}.get(name, name)
        for kept, again in zip(
            jax.tree.leaves(getattr(recorded, name)),
            jax.tree.leaves(getattr(made, name)),
            strict=True,
        ):
            # A state of law or observer has a unit of its own: it is held to its own size, where
            # that is larger.
            own = (
                np.sqrt(np.finfo(kept.dtype).eps) * np.max(np.abs(kept), initial=0.0)
                if "state" in label
                else 0.0
            )
            _compare(run, label, kept, again, rows, max(sizes[kind], own))


def _check_signals(run: Any, stretch: Stretch, rows: np.ndarray, sizes: dict[str, float]) -> None:
    """Raises ValueError if what the scenario gives at recorded states is not what the run recorded
    there.
    """
    for names, kind in ((POSITIONS, "position"), (SPEEDS, "speed"), (TORQUES, "torque")):
        for name in names:
            _compare(
                run,
                name,
                getattr(run, name)[rows],
                getattr(stretch.sample, name)[stretch.recorded],
                rows,
                sizes[kind],
            )


def _compare(
    run: Any, name: str, kept: np.ndarray, made: np.ndarray, rows: np.ndarray, tolerance: float
) -> None:
    far = np.any(~(np.abs(made - kept) <= tolerance), axis=tuple(range(1, np.ndim(kept))))
    if far.any():
        k = int(np.argmax(far))
        where = f"{name} of sample {int(rows[k])} (t = {float(run.t[rows[k]]):.6g} s)"
        remedy = (
            f"Its scenario, dt and method do not reproduce the run: {where} is {kept[k]}, made"
            f" again {made[k]}. "
        )
        remedy += (
            "Simulate it again; a loop that amplifies rounding that much needs record_every=1."
        )
        raise checks.fail(
            "run", "samples that its scenario does not give", "the run of run.scenario", remedy
        )


def check_status(run: Any, margin: float) -> None:
    """Raises ValueError if the run's status and the smallest margin of all steps [rad] contradict
    each other beyond rounding.
    """
    flagged = bool(int(run.status) & int(Status.BOUND_VIOLATED))
    # Without the number of steps, the run may have left its bounds after its last sample.
    unseen = flagged and margin > 0 and run.steps is None
    if flagged == (not margin > 0) or unseen or abs(margin) <= tolerances(run)["position"]:
        return
    remedy = (
        f"All its steps, made again, have a smallest margin of {margin:.3g} rad. Simulate it again."
    )
    raise checks.fail("run.status", describe(int(run.status)), "the status of run.scenario", remedy)

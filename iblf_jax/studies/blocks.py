"""Blocks: the one compiled shape in which studies run, whatever their size.

XLA rounds differently at different batch sizes, so every device always runs a block of the same
number of runs: run i sits in block i // B at place i % B, whether a study has ten runs or a
  million, one device or eight, one process or many, and however many blocks are
in flight.  The last block is filled up with repetitions, which are cut off.  Blocks are dealt to
the devices of this process in turn, each with its own copy of the same program: runs are
independent, so devices never talk to each other.  (`shard_map` would do the same with one program
for all, but XLA compiles that one otherwise for one device than for two, and the last digits
differ.)

Memory does not grow with time: a block returns its folds' results, its status and its draws.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks
from iblf_jax.core.devices import chosen, default
from iblf_jax.core.status import Status, flag
from iblf_jax.engine import (
    STUDY_MEMORY,
    CompiledBatch,
    RunRequest,
    block_size,
    blocks_in_flight,
    compile_batch,
    wait_until_ready,
)
from iblf_jax.simulation.sampling import noise_of
from iblf_jax.studies.draws import Cases, Lanes, Target, draw, merge


class StudyRun(NamedTuple):
    """What every block of a study runs: which leaves are drawn, how many steps, by what; static."""

    targets: tuple[Target, ...]
    program: CompiledBatch

    @property
    def request(self) -> RunRequest:
        """What is requested of each run."""
        return self.program.request

    @property
    def steps(self) -> int:
        """Time steps of each run."""
        return self.request.steps

    @property
    def method(self) -> str:
        """The integrator."""
        return self.request.method

    @property
    def backend(self) -> str:
        """The executor that runs the blocks."""
        return self.program.executor


class StudyInputs(NamedTuple):
    """What all runs share; traced."""

    cases: Cases
    folds: Any
    dt: jax.Array


class Results(NamedTuple):
    """What a run leaves, run axis first."""

    metrics: dict[str, Any]
    status: Any
    fastest_mode: Any
    samples: dict[str, Any]


MOST_MEMORY = 2.0**60
"""Bytes.  No machine has more."""


def checked_how(chunk: Any, memory: Any, devices: Any) -> dict[str, Any]:
    """A user's arguments of `run_blocks` that say how and change no number, checked; they may be
    None (all devices, `memory` rules).
    """
    chunk = (
        None if chunk is None else checks.positive_integer("chunk", chunk, most=checks.MOST_STEPS)
    )
    remedy = "Such as memory=4e9."
    memory = checks.number_between("memory", memory, 1.0, MOST_MEMORY, "bytes", remedy)
    return {"chunk": chunk, "memory": memory, "devices": checks.devices("devices", devices)}


def _without_inadmissible(admissible: jax.Array, x: jax.Array) -> jax.Array:
    """`x` where the draws were admissible, else NaN (-1 for whole numbers)."""
    mark = jnp.nan if jnp.issubdtype(x.dtype, jnp.floating) else -1
    return jnp.where(
        admissible.reshape(admissible.shape + (1,) * (x.ndim - 1)), x, jnp.asarray(mark, x.dtype)
    )


def _draws(targets: tuple[Target, ...], shared: StudyInputs, lanes: Lanes):
    """The leaves that a block's runs replace, the draws, and whether they were admissible."""

    def one(lane: Lanes):
        made, drawn, admissible = draw(shared.cases, targets, lane.index, lane.points, lane.u)
        varied = merge(shared.cases.scenario, lane.points, made) | noise_of(
            shared.cases.scenario, shared.cases.key, lane.index
        )
        return varied, drawn, admissible

    # Without the barrier XLA works the random numbers into every operation of the run: 18 s to
    # compile instead of 5.
    return jax.lax.optimization_barrier(jax.vmap(one)(lanes))


def compile_study(
    targets: tuple[Target, ...], request: RunRequest, shared: StudyInputs, lanes: Lanes
) -> StudyRun:
    """What the blocks of a study run, on the first executor that works.

    Args:
      targets: the leaves that are drawn.
      request: what is requested of each run.
      shared: what all runs share.
      lanes: what differs between the runs of one block.
    """
    varied, _, _ = jax.eval_shape(partial(_draws, targets), shared, lanes)
    program = compile_batch(request, shared.cases.scenario, varied, shared.folds, shared.dt)
    return StudyRun(targets, program)


def _block(study_run: StudyRun, shared: StudyInputs, lanes: Lanes) -> Results:
    """Draws and runs one block."""
    varied, drawn, admissible = _draws(study_run.targets, shared, lanes)
    outcome = study_run.program(shared.cases.scenario, varied, shared.folds, shared.dt)
    metrics = {name: _without_inadmissible(admissible, x) for name, x in outcome.metrics.items()}
    status = jnp.where(admissible, outcome.status, flag(~admissible, Status.INADMISSIBLE_DRAW))
    return Results(metrics, status, _without_inadmissible(admissible, outcome.fastest_mode), drawn)


def _record_block(study_run: StudyRun, shared: StudyInputs, lanes: Lanes, record_every: int):
    """Positions of a block's runs, (B, T, n), and their status."""
    varied, _, admissible = _draws(study_run.targets, shared, lanes)
    outcome = study_run.program(
        shared.cases.scenario, varied, shared.folds, shared.dt, record_every=record_every
    )
    arrays = outcome.records[0]
    return (
        {name: arrays[name] for name in ("q", "e1", "lower", "upper", "q_d")},
        arrays["t"],
        outcome.status,
        admissible,
    )


@partial(jax.jit, static_argnames=("study_run", "record_every"))
def _execute(
    shared: StudyInputs, lanes: Lanes, *, study_run: StudyRun, record_every: int | None = None
):
    if record_every is None:
        return _block(study_run, shared, lanes)
    return _record_block(study_run, shared, lanes, record_every)


def run_blocks(
    study_run: StudyRun,
    shared: StudyInputs,
    lanes_of: Callable[[np.ndarray], Lanes],
    blocks: Sequence[int],
    *,
    chunk: int | None = None,
    memory: float = STUDY_MEMORY,
    devices: list[jax.Device] | None = None,
    record_every: int | None = None,
) -> Iterator[tuple[int, Any]]:
    """Runs blocks and yields (block, its results on the host), in order.

    Args:
      study_run, shared: what to run.
      lanes_of: cases (m,) -> what differs between them; it must accept cases past the last one and
        repeat there.
      blocks: numbers of the blocks to run.
      chunk: runs in flight; from `memory` if not given.
      memory: bytes that runs in flight may take.
      devices: the devices; all of this process if not given.
      record_every: record trajectories instead of metrics.
    """
    if not blocks:
        return
    size = block_size()
    places, chosen_device = (devices or default())[: len(blocks)], chosen()
    call = partial(_execute, study_run=study_run, record_every=record_every)
    copies = [jax.device_put(shared, place) for place in places]
    if len(places) > 1:
        _compile(
            study_run,
            record_every,
            copies,
            [jax.device_put(lanes_of(np.arange(size)), place) for place in places],
        )

    def results(k: int) -> tuple[Any, int]:
        """Those of block `blocks[k]`, on the host, and how many bytes it took."""
        place = k % len(places)
        lanes = jax.device_put(
            lanes_of(np.arange(blocks[k] * size, (blocks[k] + 1) * size)), places[place]
        )
        with jax.default_device(chosen_device):  # which is a thread's own
            out = call(copies[place], lanes)
        wait_until_ready(out)
        return jax.tree.map(np.asarray, out), sum(x.nbytes for x in jax.tree.leaves((lanes, out)))

    first, each = results(
        0
    )  # alone: what is compiled is compiled once, and what a block takes is known after it
    yield blocks[0], first
    in_flight = blocks_in_flight(chunk, memory, each, len(places))
    # A thread a block in flight: draws, start and results of one are made while another is stepped.
    pool, waiting = ThreadPoolExecutor(in_flight, "block"), deque[tuple[int, Future]]()
    try:
        for k in range(1, len(blocks)):
            waiting.append((blocks[k], pool.submit(results, k)))
            if len(waiting) == in_flight:
                yield _first_of(waiting)
        while waiting:
            yield _first_of(waiting)
    finally:
        pool.shutdown(cancel_futures=True)


def _first_of(waiting: deque[tuple[int, Future]]) -> tuple[int, Any]:
    """The block that waits longest, and its results."""
    block, future = waiting.popleft()
    return block, future.result()[0]


def _compile(
    study_run: StudyRun, record_every: int | None, copies: list[StudyInputs], lanes: list[Lanes]
) -> None:
    """Compiles the block for several devices at the same time; tracing is done once and shared."""
    _execute.trace(copies[0], lanes[0], study_run=study_run, record_every=record_every)

    def one(shared, lane):
        _execute.lower(shared, lane, study_run=study_run, record_every=record_every).compile()

    with ThreadPoolExecutor(len(copies)) as pool:
        list(pool.map(one, copies, lanes))

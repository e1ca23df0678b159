"""Blocks: the compiled shape in which studies run.

Every device always runs a block of the same number of runs: run i is in block i // B at place
i % B, with one device or eight, one process or many, and however many blocks are in flight.  The
last block is filled with repetitions of the last run, which are cut off.

B is the same for all stored studies.  A large study in memory has larger blocks.  XLA may round
differently at another batch size where it chooses the order of a sum, so what is computed before
and after the steps has no sums whose order is free (`core.linalg.matmul_in_order`); the steps are
made by kernels, run by run.  A test compares the bits of runs in blocks of both sizes, and
`Study.replay` warns if a run has other numbers.

The devices of this process take the blocks in turn, each with its own copy of the same program:
runs are independent, so devices never communicate.  (`shard_map` would use one program for all
devices, but XLA compiles that program otherwise for one device than for two, and the last digits
differ.)

Memory does not grow with the length of a run: a block returns the results of its folds, its status
and its draws.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.core import checks, kept_programs, programs
from iblf_jax.core.caches import memoised
from iblf_jax.core.devices import default_devices
from iblf_jax.core.status import Status, flag
from iblf_jax.core.thread_options import current_options, with_options_of_caller
from iblf_jax.engine import CompiledBatch, block_size, blocks_in_flight, wait_until_ready
from iblf_jax.studies.dataset import DRAWN
from iblf_jax.studies.draws import CaseInputs
from iblf_jax.studies.options import LocalExecutor
from iblf_jax.studies.study_setup import (
    PreparedStudy,
    SharedInputs,
    StudyProgram,
    bytes_of,
    drawn_leaves,
)

if TYPE_CHECKING:
    from jax.tree_util import PyTreeDef


class BlockResults(NamedTuple):
    """The results of runs, run axis first."""

    metrics: dict[str, Any]
    status: Any
    fastest_mode: Any
    samples: dict[str, Any]


def named_arrays(results: BlockResults) -> dict[str, Any]:
    """The arrays of results by the names that they have in a store."""
    drawn = {DRAWN + path: x for path, x in results.samples.items()}
    status = {"status": results.status, "fastest_mode": results.fastest_mode}
    return {**results.metrics, **status, **drawn}


def result_shapes(prepared: PreparedStudy) -> BlockResults:
    """Shapes and types of the results of one block."""
    inputs = prepared.inputs_of(np.arange(block_size()))
    leaves, structure = jax.tree.flatten((prepared.shared, inputs))
    types = tuple([(x.shape, x.dtype, x.weak_type) for x in map(jax.typeof, leaves)])
    # What decides the types of the results besides those of the inputs.
    options = tuple(current_options().values())
    return _shapes_of_results(prepared.program, structure, types, options)


@memoised(64)
def _shapes_of_results(
    program: StudyProgram, structure: PyTreeDef, types: tuple, options: tuple
) -> BlockResults:
    """`result_shapes` for arguments of a structure and of types, under some options of JAX."""

    def shapes() -> BlockResults:
        arguments = [
            jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in types
        ]
        found = traced(program, *jax.tree.unflatten(structure, arguments)).out_info
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), found)

    return kept_programs.computed_once(shapes, result_shapes, program, structure, types)


def traced(program: StudyProgram, shared: SharedInputs, inputs: CaseInputs) -> Any:
    """The trace of the program of a block, which is that of `run_blocks`.

    Args:
      program: what to run.
      shared: what all runs share, or its shapes and types.
      inputs: those of a block, or their shapes and types.
    """

    def by(batch: CompiledBatch) -> Any:
        by_batch = program._replace(batch=batch)
        return _execute.trace(shared, inputs, program=by_batch, record_every=None)

    return program.batch.first_that_works(by)


def case_bytes(prepared: PreparedStudy) -> float:
    """Memory that the results of one case take [bytes]."""
    return bytes_of(result_shapes(prepared)) / block_size()


def _without_inadmissible(admissible: jax.Array, x: jax.Array) -> jax.Array:
    """`x` where the draws were admissible; elsewhere NaN, or -1 for integers."""
    mark: float = -1
    if jnp.issubdtype(x.dtype, jnp.floating):
        mark = jnp.nan
    mask = admissible.reshape(admissible.shape + (1,) * (x.ndim - 1))
    return jnp.where(mask, x, jnp.asarray(mark, x.dtype))


@programs.jit(static_argnames=("program", "record_every"), kept=True)
def _execute(
    shared: SharedInputs,
    inputs: CaseInputs,
    *,
    program: StudyProgram,
    record_every: int | None = None,
):
    """Draws and runs one block; with `record_every` its recorded positions, signal -> (B, T, n),
    and the times, (B, T).
    """
    varied, drawn, admissible = drawn_leaves(program.targets, shared, inputs)
    scenario = shared.uncertain.scenario
    if record_every is not None:
        recorded = program.batch.positions(scenario, varied, shared.dt, record_every)
        return recorded, recorded.pop("t")
    outcome = program.batch(scenario, varied, shared.folds, shared.dt)
    metrics = {name: _without_inadmissible(admissible, x) for name, x in outcome.metrics.items()}
    status = jnp.where(admissible, outcome.status, flag(~admissible, Status.INADMISSIBLE_DRAW))
    mode = _without_inadmissible(admissible, outcome.fastest_mode)
    return BlockResults(metrics, status, mode, drawn)


def run_blocks(
    prepared: PreparedStudy,
    blocks: Iterable[int],
    here: LocalExecutor | None = None,
    *,
    record_every: int | None = None,
    size: int | None = None,
) -> Iterator[tuple[int, Any]]:
    """Runs blocks in this process and yields (block, its results on the host), in their order.

    Args:
      prepared: what to run.
      blocks: numbers of the blocks; each is taken when the block is started.
      here: devices and limits; all devices and the default memory if not given.
      record_every: steps between two records; if given, trajectories are returned instead of
        metrics.
      size: runs of a block; `block_size()` if not given.
    """
    here = here or LocalExecutor()
    size = size or block_size()
    remaining = iter(blocks)
    devices = here.devices or default_devices()
    # No more devices are used than there are blocks.
    first_blocks = list(itertools.islice(remaining, len(devices)))
    if not first_blocks:
        return
    devices = devices[: len(first_blocks)]
    copies = [jax.device_put(prepared.shared, device) for device in devices]

    def compute(execute: partial, block: int, device: int) -> Any:
        """The results of a block on the device of this number."""
        cases = np.arange(block * size, (block + 1) * size)
        inputs = jax.device_put(prepared.inputs_of(cases), devices[device])
        out = execute(copies[device], inputs)
        wait_until_ready(out)
        return jax.tree.map(np.asarray, out)

    def first_of(batch: CompiledBatch) -> tuple[partial, Any]:
        """The program of blocks by a batch, and the results of the first block."""
        program = prepared.program._replace(batch=batch)
        execute = partial(_execute, program=program, record_every=record_every)
        if len(devices) > 1:
            inputs = prepared.inputs_of(np.arange(size))
            _compile(execute, copies, [jax.device_put(inputs, device) for device in devices])
        return execute, compute(execute, first_blocks[0], 0)

    # The first block runs before the others: it compiles the program, on the scan if the executor
    # fails, and gives the bytes of one.
    execute, first = prepared.program.batch.first_that_works(first_of)
    yield first_blocks[0], first
    bytes_taken = bytes_of((prepared.inputs_of(np.arange(size)), first))
    in_flight = blocks_in_flight(here.chunk, here.memory, bytes_taken, len(devices))
    # Each block in flight has a thread, which draws, starts or copies results while the block of
    # another thread is integrated.
    compute_in_pool = with_options_of_caller(partial(compute, execute))
    pool = ThreadPoolExecutor(in_flight, "block")
    waiting = deque[tuple[int, Future]]()
    try:
        for k, block in enumerate(itertools.chain(first_blocks[1:], remaining), start=1):
            waiting.append((block, pool.submit(compute_in_pool, block, k % len(devices))))
            if len(waiting) == in_flight:
                block, future = waiting.popleft()
                yield block, future.result()
        for block, future in waiting:
            yield block, future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _compile(execute: partial, copies: list[SharedInputs], inputs: list[CaseInputs]) -> None:
    """Compiles the block for several devices at the same time; it is traced once for all."""
    program: Any = execute.func
    options = execute.keywords
    program.trace(copies[0], inputs[0], **options)

    def compile_on_device(shared, inputs):
        program.lower(shared, inputs, **options).compile()

    with ThreadPoolExecutor(len(copies)) as pool:
        list(pool.map(with_options_of_caller(compile_on_device), copies, inputs))


def run_spans_here(
    prepared: PreparedStudy,
    spans: Iterable[slice],
    here: LocalExecutor,
    advance: Callable[[int], None] = lambda cases: None,
    size: int | None = None,
) -> Iterator[tuple[slice, BlockResults]]:
    """Computes spans of consecutive cases in this process, in their order, and yields each with its
    results; arguments as `execution.run_spans` and `run_blocks`.
    """
    size = size or block_size()
    started: deque[slice] = deque()

    def blocks() -> Iterator[int]:
        for span in spans:
            started.append(span)
            yield from range(span.start // size, checks.ceil_div(span.stop, size))

    parts: list[BlockResults] = []
    for block, results in run_blocks(prepared, blocks(), here, size=size):
        span = started[0]
        first = block * size
        count = min(size, span.stop - first)
        parts.append(jax.tree.map(lambda x, count=count: x[:count], results))
        advance(count)
        if first + count == span.stop:
            yield started.popleft(), jax.tree.map(_joined, *parts)
            parts = []


def _joined(*parts: np.ndarray) -> np.ndarray:
    if len(parts) == 1:
        return parts[0]
    return np.concatenate(parts)

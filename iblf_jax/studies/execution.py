"""Execution of a study: consecutive cases are computed in this process or by an executor's workers.

`run_spans` is the only function that distinguishes the two.  The results of a case are the same
bits wherever and together with whatever it is computed (head of `studies.blocks`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor

import jax
import numpy as np

from iblf_jax.engine import block_size, block_size_in_memory
from iblf_jax.studies.blocks import BlockResults, run_spans_here
from iblf_jax.studies.options import LocalExecutor
from iblf_jax.studies.study_setup import PreparedStudy


def run_spans(
    prepared: PreparedStudy,
    spans: Iterable[slice],
    executor: LocalExecutor | Executor,
    advance: Callable[[int], None],
    size: int | None = None,
) -> Iterator[tuple[slice, BlockResults]]:
    """Computes spans of consecutive cases and yields each with its results.

    Args:
      prepared: what to run.
      spans: cases, each from the beginning of a block to the end of a block or of the study; each
        is taken when it is started.
      executor: where they are computed.
      advance: called with a number of cases whenever so many are computed.
      size: runs of a block in this process; `block_size()` if not given.
    """
    if isinstance(executor, LocalExecutor):
        yield from run_spans_here(prepared, spans, executor, advance, size)
        return
    from iblf_jax.studies.workers import run_on_workers

    for span, results in run_on_workers(prepared, spans, executor):
        advance(span.stop - span.start)
        yield span, results


def size_in_memory(prepared: PreparedStudy, executor: LocalExecutor | Executor) -> int:
    """Runs of a block of a study in memory; workers and a limited executor have the usual one."""
    if not isinstance(executor, LocalExecutor) or executor.is_limited:
        return block_size()
    return block_size_in_memory(prepared.cases, prepared.options.steps)


def run_all_cases(
    prepared: PreparedStudy,
    executor: LocalExecutor | Executor,
    advance: Callable[[int], None],
) -> BlockResults:
    """The results of all cases of a study in memory, case axis first."""
    cases = prepared.cases
    size = size_in_memory(prepared, executor)
    spans = [slice(first, min(first + size, cases)) for first in range(0, cases, size)]
    everything: BlockResults | None = None
    for span, results in run_spans(prepared, spans, executor, advance, size):
        if everything is None:
            everything = jax.tree.map(lambda x: np.zeros((cases, *x.shape[1:]), x.dtype), results)
        pairs = zip(jax.tree.leaves(everything), jax.tree.leaves(results), strict=True)
        for values, part in pairs:
            values[span] = part
    assert everything is not None, "a study has at least one case"
    return everything

"""Execution of a study: consecutive cases are computed in this process or by an executor's workers.

`run_spans` is the only function that distinguishes the two.  The results of a case are the same
bits wherever and together with whatever it is computed, because every block has one shape.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor

import jax
import numpy as np

from iblf_jax.engine import block_size
from iblf_jax.studies.blocks import BlockResults, run_blocks
from iblf_jax.studies.options import ThisProcess
from iblf_jax.studies.study_setup import PreparedStudy


def block_spans(cases: int) -> list[slice]:
    """The cases of every block of a study."""
    size = block_size()
    return [slice(first, min(first + size, cases)) for first in range(0, cases, size)]


def run_spans(
    study: PreparedStudy,
    spans: Iterable[slice],
    executor: ThisProcess | Executor,
    advance: Callable[[int], None],
) -> Iterator[tuple[slice, BlockResults]]:
    """Computes spans of consecutive cases and yields each with its results.

    Args:
      study: what to run.
      spans: cases, each from the beginning of a block to the end of a block or of the study; each
        is taken when it is started.
      executor: where they are computed.
      advance: called with a number of cases whenever so many are computed.
    """
    if isinstance(executor, ThisProcess):
        yield from run_spans_here(study, spans, executor, advance)
        return
    from iblf_jax.studies.workers import run_on_workers

    for span, results in run_on_workers(study, spans, executor):
        advance(span.stop - span.start)
        yield span, results


def run_spans_here(
    study: PreparedStudy,
    spans: Iterable[slice],
    here: ThisProcess,
    advance: Callable[[int], None] = lambda cases: None,
) -> Iterator[tuple[slice, BlockResults]]:
    """As `run_spans`, in this process and in the order of the spans."""
    size = block_size()
    started: deque[slice] = deque()

    def blocks() -> Iterator[int]:
        for span in spans:
            started.append(span)
            yield from range(span.start // size, -(-span.stop // size))

    pieces: list[BlockResults] = []
    for block, results in run_blocks(study, blocks(), here):
        span = started[0]
        first = block * size
        count = min(size, span.stop - first)
        pieces.append(jax.tree.map(lambda x, count=count: x[:count], results))
        advance(count)
        if first + count == span.stop:
            yield started.popleft(), jax.tree.map(_joined, *pieces)
            pieces = []


def _joined(*pieces: np.ndarray) -> np.ndarray:
    if len(pieces) == 1:
        return pieces[0]
    return np.concatenate(pieces)


def run_all_cases(
    study: PreparedStudy,
    executor: ThisProcess | Executor,
    advance: Callable[[int], None],
) -> BlockResults:
    """The results of all cases of a study in memory, case axis first."""
    everything: BlockResults | None = None
    for span, results in run_spans(study, block_spans(study.cases), executor, advance):
        if everything is None:
            everything = jax.tree.map(
                lambda x: np.zeros((study.cases, *x.shape[1:]), x.dtype), results
            )
        for target, values in zip(
            jax.tree.leaves(everything), jax.tree.leaves(results), strict=True
        ):
            target[span] = values
    assert everything is not None, "a study has at least one case"
    return everything

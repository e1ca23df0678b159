"""Studies on other processes and machines, through any `concurrent.futures.Executor`.

    client     run_on_workers: packs the study once, submits one task for each span of cases
    worker     run_task: compares its environment with the client's, unpacks the study, computes the
               span, and returns the results or writes them to a store on a shared disk

The executor (a Dask client's, MPI's, a process pool) places the tasks, repeats them if it can (only
Dask does) and shows them.  A task carries its study by cloudpickle, so that classes and functions
of a notebook or a script arrive by value.

Processes must start by spawn or forkserver: a process that is forked after JAX has run hangs.
"""

from __future__ import annotations

import io
import itertools
import multiprocessing
import os
import pickle
import signal
import socket
import sys
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from typing import Any, NamedTuple

import jax

from iblf_jax.core import devices, thread_options
from iblf_jax.core.caches import CACHE
from iblf_jax.core.families import adopt_again
from iblf_jax.core.pytree import is_component_class, register_component
from iblf_jax.engine import uses_host_compiler
from iblf_jax.studies.blocks import BlockResults, named_arrays, run_spans_here
from iblf_jax.studies.options import LocalExecutor
from iblf_jax.studies.store import Store, StoreError, load_store
from iblf_jax.studies.study_setup import PreparedStudy

MAX_IN_FLIGHT = 1024
"""Tasks that are submitted and not done: their results may wait in the client's memory."""
THREAD_VARIABLES = ("IBLF_JAX_THREADS", "NPROC", "OMP_NUM_THREADS")
"""Environment variables that limit the threads of kernels, XLA and other libraries."""


class WorkerError(RuntimeError):
    """A worker of an executor was lost, or cannot compute what the client would; the message says
    which, and the remedy.
    """


class SharedStore(NamedTuple):
    """A store that workers write themselves."""

    path: str
    """Absolute path, which every worker must see."""
    config: dict[str, Any]
    """What the store must have been made with."""


class WorkerTask(NamedTuple):
    """What all tasks of a study share."""

    prepared: PreparedStudy
    store: SharedStore | None
    jax_options: dict[str, Any]
    """Options of JAX of the client's thread (`core.thread_options`)."""


def initialize_worker(x64: bool = True, threads: int | None = 1) -> None:
    """Prepares a worker process for studies; call it before the process uses JAX.

    It is the `initializer` of a process pool, or the function of Dask's
    `client.register_worker_callbacks`.

    Args:
      x64: whether the worker computes in float64, as the client must do.
      threads: threads of one worker; None does not change their number.  With one worker for each
        processor, 1 is the fastest.
    """
    jax.config.update("jax_enable_x64", x64)
    if threads is not None:
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    is_child = multiprocessing.parent_process() is not None
    if is_child and threading.current_thread() is threading.main_thread():
        # A terminal sends Ctrl-C to all processes; only the client decides what it stops.
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def environment(backend: str) -> dict[str, Any]:
    """The versions and settings of this process that the bits of a result depend on.

    Args:
      backend: the backend of the runs; a native kernel depends on processor and compiler.
    """
    import jaxlib

    import iblf_jax

    found = {
        "iblf_jax": iblf_jax.__version__,
        "jax": jax.__version__,
        "jaxlib": jaxlib.__version__,
        "python": f"{sys.version_info.major}.{sys.version_info.minor}",
        "jax_enable_x64": bool(jax.config.jax_enable_x64),  # type: ignore[attr-defined]
        "platform": devices.platform(),
    }
    if uses_host_compiler(backend):
        from iblf_jax.kernels import ToolchainError, built_for

        try:
            found |= built_for()
        except ToolchainError:
            found |= {"processor": "unknown", "compiler": "none"}
    return found


REMEDIES = {
    "jax_enable_x64": "Start the worker with JAX_ENABLE_X64=1, or call"
    " ij.studies.initialize_worker in it.",
    "platform": "Start workers on the client's kind of device, or the client with JAX_PLATFORMS.",
    "processor": 'Use machines of the same kind, or backend="vmap".',
    "compiler": 'Install the same compiler everywhere, or use backend="vmap".',
}


def check_environment(client: dict[str, Any], backend: str) -> None:
    """Raises WorkerError if the results of this worker could differ from the client's."""
    here = environment(backend)
    for name, expected in client.items():
        if here.get(name) == expected:
            continue
        remedy = REMEDIES.get(name, "Install the same versions on the client and all workers.")
        raise WorkerError(
            f"The worker on {socket.gethostname()} differs from the client: {name} is"
            f" {here.get(name)!r} there, and {expected!r} on the client. {remedy}"
        )


def packed(task: WorkerTask) -> bytes:
    """A task as bytes, with the environment that a worker needs.

    Classes of a notebook or a script travel by value.  The decorator of a component's class, which
    registers it with JAX, does not run at the other end, so these classes are listed, too.
    """
    try:
        import cloudpickle
    except ImportError:
        raise WorkerError(
            "An executor needs cloudpickle, which is not installed: pip install cloudpickle, or"
            " '.[sweep]' in a clone."
        ) from None
    components: list[type] = []

    class Pickler(cloudpickle.Pickler):
        def reducer_override(self, obj: Any) -> Any:
            reduced = super().reducer_override(obj)
            if reduced is not NotImplemented and is_component_class(obj):
                components.append(obj)
            return reduced

    file = io.BytesIO()
    # The list is pickled after the task, and is complete by then.
    Pickler(file).dump((task, components))
    backend = task.prepared.backend
    return pickle.dumps((environment(backend), backend, file.getvalue()))


@CACHE.memoised(2)
def _unpacked(payload: bytes) -> WorkerTask:
    client, backend, content = pickle.loads(payload)
    check_environment(client, backend)
    task, components = pickle.loads(content)
    for cls in components:
        register_component(cls)
        adopt_again(cls)
    return task


def run_task(payload: bytes, first: int, last: int) -> BlockResults | None:
    """Computes the cases `first` to `last` - 1 of a packed study; a worker calls it.

    Returns:
      The results, or None if this worker has written them to the store.

    Raises:
      WorkerError: the environment of this worker differs from the client's.
      StoreError: the store cannot be written here.
    """
    task = _unpacked(payload)
    store = None
    if task.store is not None:
        store = _open_shared(task.store)
        unit = first // store.unit
        if store.marks()[unit] and store.read(unit) is not None:
            return None
    with thread_options.applied(task.jax_options):
        ((_, results),) = run_spans_here(task.prepared, [slice(first, last)], LocalExecutor())
    if store is None:
        return results
    store.write(unit, named_arrays(results))
    return None


def _open_shared(shared: SharedStore) -> Store:
    try:
        store = load_store(shared.path)
    except StoreError as error:
        raise StoreError(
            f"{error} The worker on {socket.gethostname()} cannot use it: writer='worker' needs a"
            " disk that all workers share; writer='client' does not."
        ) from error
    if store.config != shared.config:
        raise StoreError(
            f"{shared.path}: the worker on {socket.gethostname()} finds another sweep there."
            " Give a path that is the same folder for client and workers."
        )
    return store


def run_on_workers(
    prepared: PreparedStudy,
    spans: Iterable[slice],
    executor: Executor,
    store: SharedStore | None = None,
) -> Iterator[tuple[slice, Any]]:
    """Computes spans of cases on an executor's workers and yields each with the result of
    `run_task`, in the order of completion.

    Args:
      prepared: what to run.
      spans: as `execution.run_spans`.
      executor: the executor.
      store: written by the workers; None if they return their results.

    Raises:
      WorkerError: a worker was lost, or its environment differs from the client's.
      ValueError: the study cannot be sent to another process.
    """
    payload = packed(WorkerTask(prepared, store, thread_options.of_any_process()))
    remaining, waiting = iter(spans), dict[Future, slice]()
    try:
        while True:
            for span in itertools.islice(remaining, MAX_IN_FLIGHT - len(waiting)):
                waiting[executor.submit(run_task, payload, span.start, span.stop)] = span
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
    except Exception as error:
        is_of_executor = isinstance(error, BrokenExecutor | CancelledError)
        if not is_of_executor and type(error).__module__.partition(".")[0] != "distributed":
            raise  # the task failed
        raise WorkerError(
            f"A worker of the executor was lost ({type(error).__name__}: {error}). What is written"
            " in a store is valid: start the same call again, with this or another executor, to"
            " compute the rest."
        ) from error
    finally:
        for future in waiting:
            future.cancel()

"""More than one process, on one machine or on many, through JAX's own runtime (`jax.distributed`).

Every process runs the same program.  `initialize` comes first; after it `monte_carlo` and `sweep`
share their work: each process runs its blocks or units on its own devices, and all get the same
  result at the end.  Runs are independent, so processes talk only at
the start and at the end, and results are bit-identical to those of one process.

When a process is lost, the others end too, within about `heartbeat` seconds, with a message and
exit code 3; what is in a store stays valid, and the same command goes on from there.  A process
that is alive but makes no progress is waited for, `PATIENCE` times as long as a piece of work took
here.

Workers of one's own (`multiprocessing`) are another matter, and to be started by `spawn` or
`forkserver`: JAX has threads, and a `fork` of a process in which it has run hangs.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from iblf_jax.core import checks

PATIENCE = 20.0
"""How many times the longest piece of work here another process may take before it is given up."""
LEAST_PATIENCE = 120.0
"""Seconds that another process is waited for at least."""
LOST = 3
"""Exit code of a process that ends because another one was lost."""
LONGEST_WAIT = 86400
"""Seconds of a heartbeat or of a start, at most: a day."""

_WATCHER = (
    "import sys\nlast = sys.stdin.buffer.read()\nif not last.endswith(b'bye'):\n   "
    " print(sys.argv[1], file=sys.stderr, flush=True)\n"
)


_GO_ON = (
    "What is written in a store is valid: start the same command again, on all processes, to go on"
    " from there."
)


class ProcessLostError(RuntimeError):
    """Another process of the job has gone or makes no progress."""


def rank() -> int:
    """Number of this process, from 0."""
    return jax.process_index()


def size() -> int:
    """Number of processes."""
    return jax.process_count()


def initialize(
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
    *,
    heartbeat: int = 10,
    start: int = 300,
) -> None:
    """Makes this process one of a job; call it before anything else that uses JAX.

    Under SLURM (in processes that `srun` started), Open MPI and on TPUs nothing need be given: JAX
    finds out by itself.  Elsewhere every process gets the same `coordinator` and `num_processes`,
    and its own `process_id`.  SLURM's processes meet at a port that JAX takes from the number of
    the job: two `srun` at a time in one job need a $JAX_COORDINATOR_PORT each.

    Args:
      coordinator: address of process 0, "host:port".
      num_processes: number of processes.
      process_id: number of this one, from 0.
      heartbeat: seconds after which a process that gives no sign of life counts as lost, 1 to
        86400.
      start: seconds to wait for all processes to be there, 1 to 86400.

    Raises:
      ValueError: some of the three are given and some are not, they do not fit together, or the
        port is not free on process 0.
      ProcessLostError: not all processes came, where JAX says so; where it ends the process
        instead, that has exit code 3.

    Source: jax.distributed.
    """
    given = (coordinator, num_processes, process_id)
    if any(x is None for x in given) and not all(x is None for x in given):
        raise checks.fail(
            "coordinator, num_processes, process_id",
            given,
            "all three, or none where JAX finds them by itself",
        )
    check_seconds("heartbeat", heartbeat)
    check_seconds("start", start)
    if coordinator is not None:
        _check_job(coordinator, num_processes, process_id)
    watcher = _last_words(process_id)
    _end_with_a_code(
        f"not all processes of the job came within {start} s, or the coordinator is not at"
        f" {coordinator}.",
        watcher,
    )
    try:
        jax.distributed.initialize(
            coordinator,
            num_processes,
            process_id,
            initialization_timeout=start,
            heartbeat_timeout_seconds=heartbeat,
            shutdown_timeout_seconds=max(heartbeat, 30),
        )
    except ValueError as error:
        _end_with_a_code(None, watcher)
        _say_bye(watcher)
        remedy = (
            "Start the processes with srun."
            if "SLURM_JOB_ID" in os.environ
            else "Give coordinator, num_processes and process_id."
        )
        raise ValueError(
            f"No cluster was found that says where the processes meet: {error} {remedy}"
        ) from error
    except RuntimeError as error:
        _end_with_a_code(None, watcher)
        _say_bye(watcher)
        raise ProcessLostError(
            f"Not all processes of the job came within {start} s, or the coordinator is not at"
            f" {coordinator}: {error}"
        ) from error
    _end_with_a_code(f"another process was lost (what JAX says of it is above). {_GO_ON}", watcher)
    sys.excepthook = _leave_on_error
    if (
        threading.current_thread() is threading.main_thread()
    ):  # JAX's runtime swallows SIGTERM, with which a cluster asks a job to end
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)


def check_seconds(name: str, seconds: Any) -> None:
    """ValueError unless it is a number of seconds that JAX's runtime can take."""
    if (
        isinstance(seconds, bool)
        or not isinstance(seconds, int)
        or not 1 <= seconds <= LONGEST_WAIT
    ):
        raise checks.fail(name, seconds, f"a whole number of seconds from 1 to {LONGEST_WAIT}")


def _check_job(coordinator: Any, num_processes: Any, process_id: Any) -> None:
    host, _, port = str(coordinator).rpartition(":")
    expected = 'an address and a port from 1 to 65535, such as "10.0.0.1:1234"'
    digits = port.isascii() and port.isdigit() and len(port) < 10
    if (
        not isinstance(coordinator, str)
        or not host
        or not host.isprintable()
        or " " in host
        or not digits
        or not 0 < int(port) < 2**16
    ):
        raise checks.fail("coordinator", coordinator, expected)
    number = checks.positive_integer("num_processes", num_processes)
    if (
        isinstance(process_id, bool)
        or not isinstance(process_id, int)
        or not 0 <= process_id < number
    ):
        raise checks.fail("process_id", process_id, f"a whole number from 0 to {number - 1}")
    if process_id == 0 and (why := _not_free(int(port))):
        raise checks.fail("coordinator", coordinator, f"a port that is free on process 0 ({why})")


def _not_free(port: int) -> str | None:
    """Why this process cannot listen at a port, or None if it can; JAX's runtime would end the
    process.
    """
    family = socket.AF_INET6 if socket.has_dualstack_ipv6() else socket.AF_INET
    try:
        socket.create_server(
            ("", port), family=family, dualstack_ipv6=family == socket.AF_INET6
        ).close()
    except OSError as error:
        return error.strerror or str(error)
    return None


def _last_words(process_id: int | None) -> subprocess.Popen:
    """Starts a small process that says what happened if this one ends without saying goodbye.

    JAX's runtime ends a process whose peer is lost by an abort, which Python can neither catch nor
    explain.
    """
    who = "" if process_id is None else f" {process_id}"
    text = (
        f"iblf_jax: process{who} of this job was ended before it was done: another process was"
        f" lost, or this one was killed. {_GO_ON}"
    )
    watcher = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", _WATCHER, text],
        stdin=subprocess.PIPE,
        start_new_session=True,
    )
    atexit.register(
        _say_bye, watcher
    )  # before jax registers its own goodbye, so that it comes after
    return watcher


def _end_with_a_code(text: str | None, watcher: subprocess.Popen) -> None:
    """Has an abort of JAX's runtime end this process with a line and the exit code `LOST`; without
    a text it is an abort again.

    The runtime aborts from a thread of its own, and takes no other advice (in jaxlib 0.10 its
    callback for that fails).  The handler is the C library's, because Python's own runs when the
    main thread comes round to it, which an abort does not wait for.
    """
    if os.name != "posix":
        return

    def end(_: int) -> None:
        os.write(2, f"\niblf_jax: {text}\n".encode())
        _say_bye(watcher)
        os._exit(LOST)

    _handlers.append(
        ctypes.CFUNCTYPE(None, ctypes.c_int)(end) if text else ctypes.c_void_p(signal.SIG_DFL)
    )
    ctypes.CDLL(None).signal(ctypes.c_int(signal.SIGABRT), _handlers[-1])


_handlers: list[Any] = []
"""Kept for C, which does not."""


def _say_bye(watcher: subprocess.Popen) -> None:
    if watcher.stdin is not None and not watcher.stdin.closed:
        watcher.stdin.write(b"bye")
        watcher.stdin.close()
        watcher.wait(5)


def _leave_on_error(kind: type[BaseException], error: BaseException, trace: Any) -> None:
    """An error ends the process at once; the goodbye of JAX's runtime would wait for the others
    first.
    """
    traceback.print_exception(kind, error, trace)
    leave(130 if issubclass(kind, KeyboardInterrupt) else 1)


def leave(code: int) -> None:
    """Ends this process at once, without waiting for the others, if there are any; they notice
    within the heartbeat.
    """
    if size() > 1:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def share(pieces: Sequence[int]) -> list[int]:
    """The pieces of work of this process: every size()-th, by their own number, so that all
    processes agree without talking.
    """
    return [int(piece) for piece in pieces if piece % size() == rank()]


def wait_for(progress: Callable[[], int], whole: int, longest: float, what: str) -> None:
    """Waits until all pieces of work are done, wherever they are.

    Args:
      progress: how many are done.
      whole: how many there are.
      longest: seconds that the longest took here.
      what: for the message.

    Raises:
      ProcessLostError: nothing happened for too long.
    """
    patience, done, since = max(LEAST_PATIENCE, PATIENCE * longest), progress(), time.monotonic()
    pause = 0.05
    while done < whole:
        time.sleep(pause)
        pause = min(1.0, 1.5 * pause)
        now = progress()
        if now != done:
            done, since = now, time.monotonic()
        elif time.monotonic() - since > patience:
            raise ProcessLostError(
                f"Another process has finished nothing for {patience:.0f} s: {what} has {done} of"
                f" {whole} units, which are valid. Start the same command again, on all processes,"
                " to go on."
            )


def gather_rows(results: Any, blocks: Sequence[int], block: int, longest: float) -> Any:
    """Exchanges the rows that the processes have computed: afterwards every process has all.

    Args:
      results: pytree of arrays (N, ...), in which this process has filled the rows of its blocks.
      blocks: numbers of all blocks.
      block: rows in a block.
      longest: seconds that the longest block took here.

    Raises:
      ProcessLostError: another process has gone or does not answer.
    """
    if size() == 1:
        return results
    from jax.experimental import multihost_utils

    rows = [_rows(blocks, p, block, len(jax.tree.leaves(results)[0])) for p in range(size())]
    most = max(len(r) for r in rows)

    def exchange(whole: np.ndarray) -> np.ndarray:
        mine = np.zeros((most, *whole.shape[1:]), whole.dtype)
        mine[: len(rows[rank()])] = whole[rows[rank()]]
        everyone = np.asarray(multihost_utils.process_allgather(mine))
        for p, theirs in enumerate(rows):
            whole[theirs] = everyone[p, : len(theirs)]
        return whole

    return bounded(
        lambda: jax.tree.map(exchange, results),
        max(LEAST_PATIENCE, PATIENCE * longest * len(blocks)),
    )


def _rows(blocks: Sequence[int], process: int, block: int, runs: int) -> np.ndarray:
    mine = [
        np.arange(b * block, min((b + 1) * block, runs)) for b in blocks if b % size() == process
    ]
    return np.concatenate(mine) if mine else np.zeros(0, int)


def bounded(call: Callable[[], Any], seconds: float) -> Any:
    """`call()`, given up after so many seconds or when the runtime says that another process has
    gone (ProcessLostError).
    """
    box: dict[str, Any] = {}

    def work():
        try:
            box["value"] = call()
        except Exception as error:
            box["error"] = error

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(seconds)
    if "value" in box:
        return box["value"]
    if "error" in box and not isinstance(box["error"], jax.errors.JaxRuntimeError):
        raise box["error"]
    why = (
        str(box["error"]).splitlines()[0]
        if "error" in box
        else f"it did not answer for {seconds:.0f} s"
    )
    raise ProcessLostError(
        f"Another process of this job was lost: {why}. Start the job again; a sweep with a store"
        " goes on where it was."
    )


__all__ = ["ProcessLostError", "initialize", "rank", "size"]


def __dir__() -> list[str]:
    return __all__

"""Functions that `montecarlo` and `sweep` share: arguments, executors, exit codes and output."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray

MAX_DEVICES = 256
"""Largest number of CPU devices: each has its own threads, and XLA aborts if the system has none
left."""
UNFINISHED = 3
"""Exit code if a disk is full or a worker was lost; the same command then computes the rest."""

DASK_TIMEOUT = 30
"""Seconds to wait for a Dask scheduler."""

STUDY_EPILOG = (
    "Exit codes: 0 every run is ok; 1 done, and some runs failed; 2 bad arguments or files, or a"
    " store of another configuration; 3 not finished (disk full, worker lost), what is written"
    " stays valid; 130 interrupted."
)


def add_study_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds --out, --devices, --chunk, --quiet and --dask."""
    parser.add_argument("--out", metavar="FILE.nc", help="write the results as netCDF")
    parser.add_argument(
        "--devices",
        type=int,
        metavar="N",
        help="use N CPU devices, one per core (default: those of JAX, usually 1)",
    )
    parser.add_argument(
        "--chunk",
        type=int,
        metavar="N",
        help="runs that are computed together (default: from a memory budget)",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="compute on the workers of this Dask scheduler, such as tcp://10.0.0.1:8786",
    )


def run_study(args: argparse.Namespace, work: Callable[[dict[str, Any]], int]) -> int:
    """Sets up devices and workers, runs a study, and turns its errors into exit codes.

    Args:
      args: the arguments of the command.
      work: runs the study with the keyword arguments `executor` and `progress`; returns the exit
        code.

    Returns:
      The exit code.
    """
    from iblf_jax.cli import INTERRUPTED, complain
    from iblf_jax.studies import WorkerError
    from iblf_jax.studies.store import StoreError, StoreWriteError

    if args.out is not None:
        if Path(args.out).suffix != ".nc":
            raise ValueError(f"--out: got {args.out!r}, expected a file that ends in .nc.")
        if not Path(args.out).absolute().parent.is_dir():
            raise ValueError(f"--out: got {args.out!r}, expected a file in a folder that exists.")
    _set_devices(args.devices)
    try:
        with _executor(args) as executor:
            return work({"executor": executor, "progress": False if args.quiet else None})
    except KeyboardInterrupt as stop:
        complain(str(stop) or "interrupted")
        return INTERRUPTED
    except (StoreWriteError, WorkerError) as error:
        complain(str(error))
        return UNFINISHED
    except (StoreError, ValueError, OSError) as error:
        complain(str(error))
        return 2


def _set_devices(number: int | None) -> None:
    import jax

    from iblf_jax.core import checks

    if number is None:
        return
    number = checks.positive_integer("--devices", number, most=MAX_DEVICES)
    try:
        jax.config.update("jax_num_cpu_devices", number)
    except RuntimeError:  # `main` was called in a process in which JAX has run
        expected = f"{jax.local_device_count()}, as many as JAX has in this process"
        raise checks.fail(
            "--devices", number, expected, "Start the command in a process of its own."
        ) from None


@contextlib.contextmanager
def _executor(args: argparse.Namespace) -> Iterator[Any]:
    """Yields the executor of the runs: this process, or the workers of --dask."""
    from iblf_jax.studies import LocalExecutor, initialize_worker

    if args.dask is None:
        yield LocalExecutor(chunk=args.chunk).checked()
        return
    if args.chunk is not None or args.devices is not None:
        raise ValueError("--dask: got --chunk or --devices as well, which are of this process.")
    try:
        from distributed import Client
    except ImportError:
        raise ValueError(
            "--dask: needs Dask, which is not installed: pip install distributed, or '.[sweep]' in"
            " a clone."
        ) from None
    with Client(args.dask, timeout=DASK_TIMEOUT) as client:
        client.register_worker_callbacks(initialize_worker)
        yield client.get_executor()


def write_netcdf(data: xarray.Dataset, name: str | None) -> None:
    """Writes the file of --out."""
    if name is not None:
        data.to_netcdf(name, engine="scipy")
        print(f"\nwritten to {name}")

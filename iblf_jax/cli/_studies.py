"""What the commands for many runs share: devices and processes, how they end, and what they
print.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray

MOST_DEVICES = 256
"""CPU devices of one process; each has threads of its own, and XLA aborts where the system gives it
no more."""
UNFINISHED = 3
"""Exit code: a disk is full or another process was lost; start the same command again."""

EPILOG = (
    "Exit codes: 0 every run is ok; 1 done, and some runs failed; 2 bad arguments or files, or a"
    " store of another configuration; 3 not finished (disk full, another process lost), what is"
    " written stays valid; 130 interrupted."
)


def add_study_arguments(parser: argparse.ArgumentParser) -> None:
    """--out, --devices, --chunk, --quiet, and those of a job of several processes."""
    parser.add_argument("--out", metavar="FILE.nc", help="write the results as netCDF")
    parser.add_argument(
        "--devices",
        type=int,
        metavar="N",
        help="use N CPU devices, one a core (default: JAX's, one)",
    )
    parser.add_argument(
        "--chunk",
        type=int,
        metavar="N",
        help="runs in flight at a time (default: from a memory budget)",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    job = parser.add_argument_group("several processes", "Every process runs the same command.")
    job.add_argument(
        "--distributed",
        action="store_true",
        help="under SLURM or Open MPI: JAX finds the processes by itself",
    )
    job.add_argument("--coordinator", metavar="HOST:PORT", help="elsewhere: address of process 0")
    job.add_argument("--num-processes", type=int, metavar="N")
    job.add_argument("--process-id", type=int, metavar="I")
    job.add_argument(
        "--heartbeat",
        type=int,
        default=10,
        metavar="S",
        help="seconds after which a silent process is lost (default: 10)",
    )


def carried_out(args: argparse.Namespace, work: Callable[[dict[str, Any]], int]) -> int:
    """Sets up devices and processes, does the work, and turns its errors into exit codes.

    Args:
      args: the arguments.
      work: gets the keyword arguments that `monte_carlo` and `sweep` share; returns the exit code.
    """
    import jax

    from iblf_jax.cli import INTERRUPTED, complain
    from iblf_jax.core import checks
    from iblf_jax.studies import distributed
    from iblf_jax.studies.store import StoreError, StoreWriteError

    _check_out(args.out)
    distributed.check_seconds("--heartbeat", args.heartbeat)
    if args.devices is not None:
        devices = checks.positive_integer("--devices", args.devices, most=MOST_DEVICES)
        try:
            jax.config.update("jax_num_cpu_devices", devices)
        except RuntimeError:  # who calls `main` where JAX has run
            expected = f"{jax.local_device_count()}, as many as JAX has in this process"
            raise checks.fail(
                "--devices", devices, expected, "Start the command in a process of its own."
            ) from None
    job = (args.coordinator, args.num_processes, args.process_id)
    try:
        if args.distributed or any(word is not None for word in job):
            distributed.initialize(*job, heartbeat=args.heartbeat)
        code = work(
            {"chunk": args.chunk, "progress": False if args.quiet or distributed.rank() else None}
        )
    except KeyboardInterrupt as stop:
        complain(str(stop) or "interrupted")
        code = INTERRUPTED
    except (StoreWriteError, distributed.ProcessLostError) as error:
        complain(str(error))
        code = UNFINISHED
    except StoreError as error:
        complain(str(error))
        code = 2
    except (ValueError, OSError) as error:
        complain(str(error))
        code = 2
    if code not in (0, 1):
        distributed.leave(code)
    return code


def _check_out(name: str | None) -> None:
    if name is not None:
        if Path(name).suffix != ".nc":
            raise ValueError(f"--out: got {name!r}, expected a file that ends in .nc.")
        if not Path(name).absolute().parent.is_dir():
            raise ValueError(f"--out: got {name!r}, expected a file in a folder that exists.")


def write_netcdf(data: xarray.Dataset, name: str | None) -> None:
    """Writes the file of --out, on the first process."""
    from iblf_jax.studies import distributed

    if name is not None and distributed.rank() == 0:
        data.to_netcdf(name, engine="scipy")
        print(f"\nwritten to {name}")

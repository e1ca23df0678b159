"""The one small study that these tests share, in this process and in others: few programs to
compile.

As a script it does the small sweep in a process of its own: `python study_cases.py OUT [--store S]
[--devices N] [--shared]`; with `--serve` alone, in a process for each line that comes in (`Forks`).
"""

import argparse
import json
import os
import subprocess
import sys
import threading
import tomllib
import traceback
from pathlib import Path
from subprocess import PIPE
from typing import Any, Self

import numpy as np


def perturbations(mass=0.1, q=0.05):
    """Two perturbations by standard deviation; other numbers do not recompile."""
    import iblf_jax as ij

    draws = {"plant.mass[1]": ij.factor(ij.normal(1.0, mass))}
    return draws | {"initial.q": ij.offset(ij.normal(0.0, q))}


def options():
    import iblf_jax as ij

    run = {"duration": 0.02, "dt": 1e-3, "method": "euler"}
    return run | {"metrics": (ij.metrics.Margin(),), "seed": 3}


GRID = {"controller.K2": [10.0, 20.0, 40.0], "observer.kf": [10.0, 20.0]}
RUNS = 500
"""3000 cases: 12 blocks of 256."""
UNIT = 256
STUDY = """
preset = "zhang_yan_2024"
[run]
duration = 0.02
method = "euler"
[perturbations]
"plant.mass[1]" = { factor = "normal", mean = 1.0, std = 0.1 }
initial.q = { offset = "normal", std = 0.05 }
[study]
runs = 300
seed = 3
"""
AXES = """
unit = 256
[grid]
"controller.K2" = [10.0, 20.0, 40.0]
observer.kf = [10.0, 20.0]
"""
SWEEP = STUDY.replace("[study]", "[sweep]") + AXES
"""The same for the command line, with the standard metrics."""


def from_file(text, **more):
    import iblf_jax as ij
    from iblf_jax.files import study as study_file

    file = study_file.study_from_dict(tomllib.loads(text), "sweep")
    options = dict(file.options)
    options.pop("unit", None)
    return ij.sweep(file.scenario, file.grid, perturbations=file.perturbations, **options | more)


def study(runs=600, ways=None, **more):
    import iblf_jax as ij

    paper = ij.presets.zhang_yan_2024()
    return ij.monte_carlo(paper, ways or perturbations(), runs=runs, **options() | more)


def table(store=None, unit=UNIT, scenario=None, **more):
    """The small sweep; `store` is a path, or a `StoreOptions` that has its unit."""
    import iblf_jax as ij

    if store is not None and not isinstance(store, ij.studies.StoreOptions):
        store = ij.studies.StoreOptions(store, unit)
    given = {"perturbations": perturbations(), "runs": RUNS, "store": store} | options() | more
    return ij.sweep(scenario or ij.presets.zhang_yan_2024(), GRID, **given)


def arrays(dataset):
    return {str(name): np.asarray(dataset[name]) for name in dataset.variables}


def named(found):
    """The arrays of a study, by names that no sweep has."""
    values = dict(found.metrics) | found.samples | {"status": found.status}
    return {f"study {name}": np.asarray(x) for name, x in values.items()}


def same(a, b):
    """Whether two mappings of arrays have the same names and bits."""
    pairs = [(np.asarray(a[k]), np.asarray(b[k])) for k in a.keys() & b.keys()]
    return set(a) == set(b) and all(
        x.dtype == y.dtype and np.array_equal(x, y, equal_nan=True) for x, y in pairs
    )


def environment(cache: Path, **more: str) -> dict[str, str]:
    """For a process of its own: this package, float64, and compiled programs shared between such
    processes."""
    root = str(Path(__file__).parents[1])
    import jax

    chosen = {
        "JAX_ENABLE_X64": str(int(jax.config.jax_enable_x64)),
        "JAX_ENABLE_COMPILATION_CACHE": "1",
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH", "")]))
    chosen |= {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu", "PYTHONUNBUFFERED": "1"}
    return os.environ | chosen | more


def start(cache: Path, *words: str, **more: str) -> subprocess.Popen:
    return start_python(cache, __file__, *words, **more)


def start_python(cache: Path, *words: str, stderr: Any = PIPE, **more: str) -> subprocess.Popen:
    """Starts Python with these words; its input, output and errors can be read and written."""
    pipes: dict[str, Any] = {"stdin": PIPE, "stdout": PIPE, "stderr": stderr, "text": True}
    return subprocess.Popen([sys.executable, *words], env=environment(cache, **more), **pipes)


class Forks:
    """Many processes of this script, each forked from one that has imported everything and started
    nothing: half of a start is imports.  They share a folder of compiled programs, and a file for
    what they say on stderr."""

    def __init__(self, cache: Path, errors: Path):
        with errors.open("w") as file:
            self.server = start_python(cache, __file__, "--serve", stderr=file)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_) -> None:
        self.server.kill()
        self.server.communicate()

    def start(self, *words: str) -> int:
        """The process that does what the script does with these words; the one before must have
        ended."""
        self.server.stdin.write(json.dumps(words) + "\n")
        self.server.stdin.flush()
        return int(self.line().removeprefix("pid "))

    def line(self) -> str:
        """What the process says next; "ended CODE" once it has ended."""
        return self.server.stdout.readline()

    def ended(self) -> int:
        """Waits for the end of the process: its exit code, or less than 0 the signal that ended
        it."""
        while not (said := self.line()).startswith("ended"):
            assert said, "the server of processes is gone"
        return int(said.removeprefix("ended "))


def serve() -> None:
    """Forks for each line of words, and says when the child has ended; threads, which do not
    survive a fork, have not been started."""
    import jax  # noqa: F401
    import xarray  # noqa: F401
    import zarr  # noqa: F401

    import iblf_jax as ij

    ij.sweep, ij.presets.zhang_yan_2024  # noqa: B018
    assert threading.active_count() == 1
    for line in sys.stdin:
        child = os.fork()
        if not child:
            sys.argv[1:] = json.loads(line)
            print("pid", os.getpid(), flush=True)
            os._exit(_exit_code_of_main())
        print("ended", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def _exit_code_of_main() -> int:
    try:
        main()
    except BaseException:
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("--store")
    parser.add_argument("--devices", type=int, default=1)
    parser.add_argument("--shared", action="store_true", help="of a store for several processes")
    parser.add_argument("--slow", type=float, default=0.0, help="sleep so long after each unit")
    parser.add_argument("--die-after", type=int, help="kill this process after so many units")
    parser.add_argument("--study", action="store_true", help="beside the sweep, if with a store")
    args = parser.parse_args()
    import jax

    jax.config.update("jax_num_cpu_devices", args.devices)
    import iblf_jax as ij

    if args.slow or args.die_after is not None:
        _hinder(args)
    data = {}
    if args.store:
        store = ij.studies.StoreOptions(args.store, UNIT, shared=args.shared)
        data = arrays(table(store=store))
    elif not args.study:
        data = arrays(table())
    if args.study:
        data |= named(study())
    np.savez(args.out, **data)
    print("done")


def _hinder(args) -> None:
    import signal
    import time

    from iblf_jax.studies.store import Store

    plain, written = Store.write, []

    def write(self, unit, data):
        plain(self, unit, data)
        written.append(unit)
        print("unit", unit, flush=True)
        time.sleep(args.slow)
        if args.die_after is not None and len(written) >= args.die_after:
            os.kill(os.getpid(), signal.SIGKILL)

    Store.write = write


if __name__ == "__main__":
    serve() if sys.argv[1:] == ["--serve"] else main()

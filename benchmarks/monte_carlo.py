"""Monte-Carlo: runs a second and resident memory, against what one would do otherwise.

    python benchmarks/monte_carlo.py [--quick] [--json FILE] [--budget S] [--backend NAME] [--parts
    runs devices]

One study: the paper's loop, 10 s at 1 ms, with a random start.  Rows of this package are made in a
  process each, so that the memory is
theirs: 1e3 to 1e6 runs.  Where the whole length does not fit into the budget of a row, its runs are
  shorter and runs/s is extrapolated
by the number of steps; memory does not depend on the length.  Then, for each backend and type, what
two CPU devices of one process give over one, beside what two processes on a core each give over one
of them: the machine does not have more.  The others: a Python loop over SciPy's LSODA, the same in
  a process pool (16 runs timed), and diffrax under vmap (Tsit5, adaptive; 64 runs timed).  The last
column says what was extrapolated.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import subprocess
import sys
import time

import numpy as np

DURATION, DT = 10.0, 1e-3
SPREAD = 0.02
COLUMNS = ["way", "runs", "runs/s", "times the Python loop", "resident MB", "remark"]
SIZES = {"native": 20_480, "vmap": 2_048}
"""Runs of 1 s that one device is timed on: seconds."""


def study(
    runs: int, steps: int, backend: str, dtype: str, devices: int, method: str
) -> dict[str, float]:
    """One study in this process: seconds without compilation, and the most memory it held."""
    import jax

    jax.config.update("jax_enable_x64", dtype == "float64")
    jax.config.update("jax_num_cpu_devices", devices)
    import iblf_jax as ij
    from iblf_jax.studies.blocks import block_size

    scenario = ij.presets.zhang_yan_2024()
    start = {"initial.q": ij.offset(ij.normal(0.0, SPREAD))}
    options = {
        "duration": steps * DT,
        "dt": DT,
        "method": method,
        "seed": 0,
        "backend": backend,
        "progress": False,
    }
    ij.monte_carlo(
        scenario, start, runs=block_size() * devices, **options
    )  # compiles, for every device
    begin = time.perf_counter()
    ij.monte_carlo(scenario, start, runs=runs, **options)
    return {
        "seconds": time.perf_counter() - begin,
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


PIPES = {
    "stdin": subprocess.PIPE,
    "stdout": subprocess.PIPE,
    "stderr": subprocess.DEVNULL,
    "text": True,
}


def _command(name: str, **words) -> list[str]:
    """Calls a function of this file in a process of its own, which prints what it returns."""
    here = os.path.dirname(os.path.abspath(__file__))
    code = (
        "import sys, json; sys.path.insert(0, sys.argv[1]); import monte_carlo as m; "
        "print(json.dumps(getattr(m, sys.argv[2])(**json.loads(sys.argv[3]))))"
    )
    return [sys.executable, "-c", code, here, name, json.dumps(words)]


def in_its_own_process(name: str = "study", **words) -> dict[str, float]:
    done = subprocess.run(_command(name, **words), check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def two_devices(
    backend: str, dtype: str, runs: int, steps: int, method: str, repeats: int
) -> dict[str, float]:
    """Seconds of one study in this process on one and on two of its devices, and in one and in two
    processes on a core each.
    """
    import jax

    jax.config.update("jax_num_cpu_devices", 2)
    words = {"backend": backend, "dtype": dtype, "runs": runs, "steps": steps, "method": method}
    workers = [
        subprocess.Popen(_command("worker", core=core, **words), **PIPES) for core in two_cores()
    ]
    here = _study(**words)
    for worker in workers:
        worker.stdout.readline()

    def together(some) -> None:
        for worker in some:
            worker.stdin.write("go\n")
            worker.stdin.flush()
        for worker in some:
            worker.stdout.readline()

    from _timing import interleaved

    calls = {
        "one": lambda: here(jax.devices()[:1]),
        "two": lambda: here(jax.devices()),
        "process": lambda: together(workers[:1]),
        "processes": lambda: together(workers),
    }
    found = interleaved(calls, repeats)
    for worker in workers:
        worker.stdin.close()
        worker.wait()
    return found


def two_cores() -> list[int]:
    """Two cores of this process."""
    return sorted(os.sched_getaffinity(0))[:2]


def worker(core: int, **words) -> None:
    """Keeps to one core and runs the study for every line that comes in."""
    os.sched_setaffinity(0, {core})
    run = _study(**words)
    print("ready", flush=True)
    for _ in sys.stdin:
        run()
        print("done", flush=True)


def _study(backend: str, dtype: str, runs: int, steps: int, method: str):
    """A study with a mass and the start drawn, as a function of the devices; compiled for all of
    them.
    """
    import jax

    jax.config.update("jax_enable_x64", dtype == "float64")
    import iblf_jax as ij
    from iblf_jax.studies.blocks import block_size

    ways = {
        "plant.mass[1]": ij.factor(ij.uniform(0.7, 1.3)),
        "initial.q": ij.offset(ij.normal(0.0, SPREAD)),
    }
    options = {
        "duration": steps * DT,
        "dt": DT,
        "method": method,
        "backend": backend,
        "progress": False,
    }

    def run(devices=None, runs=runs) -> None:
        executor = ij.studies.LocalExecutor(devices)
        ij.monte_carlo(ij.presets.zhang_yan_2024(), ways, runs=runs, executor=executor, **options)

    run(runs=2 * block_size())
    return run


def scipy_run(seed: int, duration: float = DURATION) -> float:
    """One run by SciPy on the loop in NumPy; returns the largest error seen."""
    from latency import numpy_loop
    from scipy.integrate import solve_ivp

    start = np.concatenate([0.8 + SPREAD * np.random.default_rng(seed).normal(size=2), np.zeros(4)])
    solution = solve_ivp(numpy_loop, (0.0, duration), start, method="LSODA", rtol=1e-6, atol=1e-9)
    return float(np.abs(solution.y[:2]).max())


def python_loop(count: int, duration: float) -> float:
    scipy_run(0, 0.01)
    begin = time.perf_counter()
    for seed in range(count):
        scipy_run(seed, duration)
    return count / (time.perf_counter() - begin)


def process_pool(count: int, duration: float) -> float:
    with multiprocessing.get_context("spawn").Pool() as pool:
        pool.starmap(scipy_run, [(seed, 0.01) for seed in range(os.cpu_count() or 1)])
        begin = time.perf_counter()
        pool.starmap(scipy_run, [(seed, duration) for seed in range(count)], chunksize=1)
        return count / (time.perf_counter() - begin)


def diffrax_vmap(count: int, duration: float) -> float:
    """Runs a second of diffrax under vmap on this package's vector field, compilation apart."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import diffrax

    import iblf_jax as ij

    field = ij.vector_field(ij.presets.zhang_yan_2024())
    term = diffrax.ODETerm(field)
    control = diffrax.PIDController(rtol=1e-6, atol=1e-9)

    @jax.jit
    @jax.vmap
    def solve(x):
        return diffrax.diffeqsolve(
            term,
            diffrax.Tsit5(),
            0.0,
            duration,
            None,
            x,
            stepsize_controller=control,
            max_steps=200_000,
        ).ys

    starts = np.tile(np.asarray(field.start), (count, 1))
    starts[:, :2] += SPREAD * np.random.default_rng(0).normal(size=(count, 2))
    jax.block_until_ready(solve(starts))
    begin = time.perf_counter()
    jax.block_until_ready(solve(starts))
    return count / (time.perf_counter() - begin)


def method_of(args: argparse.Namespace) -> str:
    """The quick size is there to be run, and four stages compile four times as long as one."""
    return "euler" if args.quick else "rk4"


def ours(args: argparse.Namespace, reference: float) -> list[list]:
    """Rows of this package; the length of a row's runs is fitted to the budget by the rate of the
    row before.
    """
    rows, whole = [], round(DURATION / DT)
    ways = (
        ("float64", "float64", 1),
        ("float32", "float32", 1),
        ("float32, 2 devices", "float32", 2),
    )
    for name, dtype, devices in ways[1:2] if args.quick else ways:
        rate = 1e6
        for runs in (300,) if args.quick else (1_000, 10_000, 100_000, 1_000_000):
            steps = int(np.clip(args.budget * rate / max(runs, 256), 5, whole))
            found = in_its_own_process(
                runs=runs,
                steps=steps,
                backend=args.backend,
                dtype=dtype,
                devices=devices,
                method=method_of(args),
            )
            rate = max(runs, 256) * steps / found["seconds"]
            speed = runs / found["seconds"] * steps / whole
            said = "measured" if steps == whole else f"from {steps} steps of {whole}"
            rows.append(
                [f"monte_carlo, {name}", runs, speed, speed / reference, found["megabytes"], said]
            )
    return rows


def devices(args: argparse.Namespace, reference: float) -> list[list]:
    """What a second device gives, backend by backend."""
    rows = []
    for backend in ("native",) if args.quick else SIZES:
        for dtype in ("float32",) if args.quick else ("float64", "float32"):
            steps, runs = (20, 512) if args.quick else (round(1.0 / DT), SIZES[backend])
            words = {
                "backend": backend,
                "dtype": dtype,
                "runs": runs,
                "steps": steps,
                "method": method_of(args),
            }
            found = in_its_own_process("two_devices", **words, repeats=1 if args.quick else 5)
            speed = runs / found["two"] * steps * DT / DURATION
            gain, most = found["one"] / found["two"], 2 * found["process"] / found["processes"]
            said = (
                f"{gain:.2f} times one device; two processes {most:.2f} times one (runs of"
                f" {steps * DT:g} s)"
            )
            rows.append(
                [f"{backend}, {dtype}, 2 devices", runs, speed, speed / reference, "-", said]
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small numbers and short runs")
    parser.add_argument("--json", help="also write the table to this file")
    parser.add_argument("--budget", type=float, help="seconds for a row (default 60; quick 0.2)")
    parser.add_argument("--backend", default="auto")
    parser.add_argument(
        "--parts",
        nargs="+",
        choices=("runs", "devices"),
        default=("runs", "devices"),
        help="rows of this package",
    )
    args = parser.parse_args()
    args.budget = args.budget or (0.2 if args.quick else 60.0)
    count, lanes, duration = (2, 2, 0.2) if args.quick else (16, 64, DURATION)
    share = duration / DURATION
    said = f"{count} runs timed" + ("" if share == 1 else f", of {duration:g} s")
    reference = python_loop(count, duration) * share
    rows = [["Python loop, SciPy LSODA", count, reference, 1.0, "-", said]]
    pool = process_pool(count, duration) * share
    rows.append(
        [f"{os.cpu_count()} processes, SciPy LSODA", count, pool, pool / reference, "-", said]
    )
    try:
        speed = diffrax_vmap(lanes, duration) * share
        rows.append(
            [
                "diffrax, vmap",
                lanes,
                speed,
                speed / reference,
                "-",
                said.replace(f"{count} runs", f"{lanes} runs"),
            ]
        )
    except ImportError:
        print("diffrax is not installed: pip install '.[bench]' in a clone")
    if "runs" in args.parts:
        rows += ours(args, reference)
    if "devices" in args.parts and len(os.sched_getaffinity(0)) > 1:
        rows += devices(args, reference)
    from _timing import report

    report(
        f"Runs of {DURATION:g} s at {DT:g} s by {method_of(args)}, random start",
        COLUMNS,
        rows,
        args.json,
    )


if __name__ == "__main__":
    main()

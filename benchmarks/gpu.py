"""The gpu backend on a GPU: one kernel a rollout against XLA on the same device and against this
machine's processor, side by side.

    python benchmarks/gpu.py [--quick] [--json FILE] [--dtype float32|float64] [--batches
    4096,65536,1048576] [--chain] [--arm] [--all]

On a GPU it first holds the kernel to the reference (largest difference, statuses), then prints the
rows of the GPU (`gpu`, `vmap`, textbook `jit(vmap(scan))`) and, from a process of its own, those of
the processor.  `--chain` adds a chain of four joints, and `--arm` the `iiwa14` with a joint
controller beside the same arm and controller in MJX and in MuJoCo Warp (`peers/servo_arm.py`), if
they are installed.  `--all` is every row of the GPU in one command: both types, the chain and the
arm; rows other than `gpu` for 65,536 runs of the paper's loop only, and none of the processor,
which `throughput.py` measures.  `of peak` counts the instructions of the scalar program
(`ij.explain`) against what the multiprocessors can issue at their highest clock.  Without a GPU
there are the processor's rows only.  Progress goes to stderr.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from _timing import compiled_side_by_side, interleaved, report
from peers import servo_arm
from throughput import GAINS, chain, draws, method_for, textbook

import iblf_jax as ij
from iblf_jax.engine import RunRequest
from iblf_jax.engine.execute import run_batch, run_batch_jvp
from iblf_jax.engine.structural_constants import robot_constants
from iblf_jax.simulation.metrics import standard
from iblf_jax.simulation.scenario import canonical

LANES = {
    "float32": {"8.0": 64, "7.0": 64, "7.5": 64},
    "float64": {"7.0": 32, "8.0": 32, "9.0": 64, "10.0": 64},
}
"""Instructions that a multiprocessor issues a cycle, by compute capability; else 128 and 2 (CUDA
C++ Programming Guide, arithmetic throughput)."""
COLUMNS = [
    "loop",
    "device",
    "type",
    "runs",
    "row",
    "steps",
    "compile s",
    "steps/s",
    "x textbook",
    "of peak",
]
RATES = {"textbook": 1e6, "vmap": 1e6, "gpu + 6 tangents": 1e9, "gpu": 5e9, "gpu, no metrics": 5e9}
"""Steps/s to expect, so that a row takes about a second; of textbook and vmap on a processor."""
LAUNCHED = {"textbook": 200, "vmap": 200}
"""Steps of the rows in which XLA launches the kernels of each step one after the other: those take
as long for one run as for many."""
MAIN_BATCH = 65_536
"""Runs for which `--all` has all rows."""
COMPILERS = 8
"""Programs that XLA compiles at the same time for a GPU; on a processor one, as that would disturb
the seconds."""
SERVO_RUNS = MAIN_BATCH
SERVO_STEPS = 50
"""Runs and steps of the arm with a joint controller."""
QUICK = ("textbook", "native", "gpu", "gpu + 6 tangents")
"""The rows of the quick size: each compiles for seconds, and `throughput` has the processor's
others."""


STARTED = time.perf_counter()


def progress(text: str) -> None:
    print(f"[{time.perf_counter() - STARTED:.0f} s] {text}", file=sys.stderr, flush=True)


def on_a_gpu() -> bool:
    return jax.default_backend() == "gpu"


def peak(dtype: str) -> float:
    """Instructions a second that the GPU can issue on numbers of a type, or NaN on a processor."""
    if not on_a_gpu():
        return math.nan
    driver, clock = ctypes.CDLL("libcuda.so.1"), ctypes.c_int()
    if driver.cuDeviceGetAttribute(
        ctypes.byref(clock), 13, 0
    ):  # CU_DEVICE_ATTRIBUTE_CLOCK_RATE, in kHz
        return math.nan
    device = jax.local_devices()[0]
    lanes = LANES[dtype].get(device.compute_capability, 128 if dtype == "float32" else 2)
    return 1e3 * clock.value * lanes * device.core_count


def candidates(scenario, dtype: str, is_paper: bool, method: str) -> dict:
    """Name -> function of (values, dt, steps)."""
    folds = jax.tree.map(lambda x: jnp.asarray(x, dtype), standard())

    def on(backend, folds=folds):
        return lambda v, dt, steps: run_batch(
            scenario, v, folds, dt, RunRequest(steps, method, backend=backend)
        )

    def tangents(v, dt, steps):
        request = RunRequest(steps, method, backend=compiled)
        return run_batch_jvp(scenario, v, GAINS, folds[:1], dt, request)

    compiled = compiled_backend()
    rows = {"textbook": lambda v, dt, steps: textbook(v, dt, steps=steps)} if is_paper else {}
    rows |= {
        "vmap": on("vmap"),
        compiled: on(compiled),
        f"{compiled}, no metrics": on(compiled, ()),
    }
    return rows | ({f"{compiled} + 6 tangents": tangents} if is_paper else {})


CHECKED = 300
"""Runs of the check."""


def checks(scenario, dtype: str, steps: int, method: str) -> dict:
    """("check", backend) -> function and arguments of some runs, by the kernel and by the
    reference.
    """
    folds, dt = jax.tree.map(lambda x: jnp.asarray(x, dtype), standard()), jnp.asarray(1e-3, dtype)

    def outcome(values, backend):
        request = RunRequest(steps, method, backend=backend)
        return run_batch(scenario, values, folds, dt, request)

    arguments = (draws(scenario, CHECKED, dtype),)
    return {
        ("check", backend): (partial(outcome, backend=backend), arguments)
        for backend in ("vmap", "gpu")
    }


def print_difference(found, expected, dtype: str, steps: int) -> None:
    """Prints how far the kernel is from the reference."""
    worst = 0.0
    for x, y in zip(jax.tree.leaves(found.metrics), jax.tree.leaves(expected.metrics), strict=True):
        finite = np.isfinite(y)
        scale = 1 + np.max(np.abs(np.asarray(y)[finite]), initial=0)
        worst = max(
            worst,
            float(
                np.max(
                    np.abs(np.asarray(x, float)[finite] - np.asarray(y, float)[finite]), initial=0
                )
            )
            / scale,
        )
    same = "equal" if np.array_equal(found.status, expected.status) else "DIFFERENT"
    print(
        f"gpu against the reference, {dtype}, {CHECKED} runs of {steps} steps: largest difference"
        f" {worst:.2g}, statuses {same}"
    )


def is_measured(name: str, which: str, runs: int, options: argparse.Namespace) -> bool:
    """Whether a row is one of those that the options ask for."""
    if options.quick:
        return name in QUICK
    return (
        not options.all or name == compiled_backend() or (which == "paper" and runs == MAIN_BATCH)
    )


def steps_of(name: str, runs: int, quick: bool) -> int:
    """Steps of a row, so that it takes about a second."""
    if quick:
        return 20
    expected = RATES.get(name, 5e7) / runs
    long = LAUNCHED.get(name, expected) if on_a_gpu() else expected
    return int(min(max(long, 40), 10_000)) // 20 * 20


def table(which: str, dtype: str, options: argparse.Namespace) -> list[list]:
    """The rows of this process's device."""
    quick = options.quick
    progress(f"{which}, {dtype}")
    scenario = canonical(
        ij.astype(ij.presets.zhang_yan_2024() if which == "paper" else chain(4), dtype)
    )
    dt, device = jnp.asarray(1e-3, dtype), jax.local_devices()[0].device_kind
    slots = ij.explain(scenario, varied=["plant.mass[1]"]).slots
    is_checked = on_a_gpu() and not (options.all and which != "paper")
    checked_steps = 20 if quick else 2000
    functions = {}
    if is_checked:
        functions |= checks(scenario, dtype, checked_steps, method_for(quick))
    for runs in options.batches:
        values = draws(scenario, runs, dtype)
        rows = candidates(scenario, dtype, which == "paper", method_for(quick))
        for name, function in rows.items():
            if is_measured(name, which, runs, options):
                steps = steps_of(name, runs, quick)
                functions[runs, name] = partial(function, steps=steps), (values, dt)
    found = compiled_side_by_side(functions, COMPILERS if on_a_gpu() else 1)
    progress("compiled")
    if is_checked:
        outcomes = [
            found["check", backend][1](*functions["check", backend][1])
            for backend in ("gpu", "vmap")
        ]
        print_difference(*outcomes, dtype, checked_steps)
    return [
        [which, device, dtype, *row]
        for runs in options.batches
        for row in timed(slots, dtype, runs, quick, functions, found)
    ]


def timed(slots: int, dtype: str, runs: int, quick: bool, functions, found) -> list[list]:
    """The rows of so many runs, without the columns before `runs`."""
    calls = {}
    for (of_runs, name), (_, arguments) in functions.items():
        if of_runs == runs:
            calls[name] = partial(found[runs, name][1], *arguments)
            jax.block_until_ready(calls[name]())
    best = interleaved(calls, 1 if quick else 3)
    steps = {name: steps_of(name, runs, quick) for name in calls}
    speed = {name: runs * steps[name] / best[name] for name in calls}
    rows = []
    for name, s in speed.items():
        share = s * slots / peak(dtype) if name == "gpu" else ""
        ratio = s / speed["textbook"] if "textbook" in speed else ""
        progress(f"{runs} runs, {name}: {s:.3e} steps/s")
        rows.append([runs, name, steps[name], found[runs, name][0], s, ratio, share])
    return rows


def servo_rows(runs: int, quick: bool) -> list[list]:
    """The arm with a joint controller, by this package and by the peers, in float32."""
    device = jax.local_devices()[0].device_kind
    steps = 20 if quick else SERVO_STEPS
    compiled = {}
    seconds = {}
    for name, build in servo_candidates(quick).items():
        start = time.perf_counter()
        try:
            compiled[name] = build(runs, steps)
        except (ImportError, RuntimeError) as error:  # absent, or without its binaries
            print(f"iiwa14: no row of {name}: {error}")
            continue
        seconds[name] = time.perf_counter() - start
        progress(f"iiwa14, {name}: compiled")
    positions = {name: np.asarray(call()) for name, call in compiled.items()}
    best = interleaved(compiled, 1 if quick else 2)
    ours = next(iter(positions.values()))
    for name, found in positions.items():
        difference = float(np.max(np.abs(found - ours)))
        print(f"iiwa14, {name}: positions after {steps} steps differ by {difference:.2g} rad")
        progress(f"iiwa14, {name}: {runs * steps / best[name]:.3e} steps/s")
    return [
        ["iiwa14", device, "float32", runs, name, steps, s, runs * steps / best[name], "", ""]
        for name, s in seconds.items()
    ]


def servo_candidates(quick: bool) -> dict:
    """Name -> function of (runs, steps) that compiles a call, which returns the final positions."""

    def ours(folds, runs, steps):
        scenario = servo_arm.servo_scenario("float32")
        request = RunRequest(
            steps,
            method_for(quick),
            record_every=steps,
            constants=robot_constants(scenario),
            backend=compiled_backend(),
        )
        values = {"initial.q": jnp.asarray(servo_arm.starts(scenario, runs), "float32")}
        dt = jnp.asarray(servo_arm.DT, "float32")

        def final(v):
            outcome = run_batch(scenario, v, folds, dt, request)
            signals, *_ = outcome.records
            return signals["x"][:, -1, 0], outcome.metrics

        call = jax.jit(final).lower(values).compile()
        return lambda: call(values)[0]

    folds = jax.tree.map(lambda x: jnp.asarray(x, "float32"), standard())
    rows = {compiled_backend(): partial(ours, folds)}
    if quick:
        return rows
    return rows | {"MJX": servo_arm.with_mjx, "MuJoCo Warp": servo_arm.with_mujoco_warp}


def compiled_backend() -> str:
    """The executor of this process's device."""
    if on_a_gpu():
        return "gpu"
    return "native"


def rows_of_the_processor(arguments: list[str]) -> list[list]:
    """The rows of this machine's processor, from a process that has no GPU."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.json"
        command = [sys.executable, __file__, *arguments, "--json", str(path)]
        subprocess.run(
            command,
            check=True,
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
            stdout=subprocess.DEVNULL,
        )
        return [[row[name] for name in COLUMNS] for row in json.loads(path.read_text())["rows"]]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json")
    parser.add_argument("--dtype", default="float32", choices=["float32", "float64"])
    parser.add_argument("--batches", default="4096,65536,1048576")
    parser.add_argument("--chain", action="store_true", help="a planar chain of four joints, too")
    parser.add_argument("--arm", action="store_true", help="the iiwa14 beside its peers, too")
    parser.add_argument("--all", action="store_true", help="every row of the GPU")
    options = parser.parse_args()
    options.batches = [2] if options.quick else [int(x) for x in options.batches.split(",")]
    dtypes = ["float32", "float64"] if options.all else [options.dtype]
    jax.config.update("jax_enable_x64", "float64" in dtypes)
    rows = []
    for dtype in dtypes:
        rows += table("paper", dtype, options)
        if options.chain or options.all:
            rows += table("chain of 4", dtype, options)
    if on_a_gpu() and not options.all:
        same = ["--dtype", options.dtype, "--batches", "4096"]
        rows += rows_of_the_processor([*same, *(["--quick"] if options.quick else [])])
    if options.arm or options.all:
        rows += servo_rows(SERVO_RUNS if not options.quick else 2, options.quick)
    report(
        f"One kernel a rollout, {method_for(options.quick)} at 1 ms", COLUMNS, rows, options.json
    )


if __name__ == "__main__":
    main()

"""How the benchmarks measure: compile and run apart, results blocked on, one table, one JSON file.

Machines are shared and noisy, so rows are compared within one run of a benchmark: every timed thing
is repeated in turn (`interleaved`) and the smallest time of each is kept.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jaxlib
import numpy as np

import iblf_jax as ij
from iblf_jax.kernels import processor

ROOT = Path(__file__).resolve().parents[1]
ARM = """
jax.config.update("jax_enable_x64", True)
import iblf_jax as ij
sensor = ij.sensors.Encoder(counts=2.0**16, velocity=ij.sensors.FilteredDifference(cutoff=300.0))
arm = ij.with_parts(
    ij.presets.ur5(),
    sampling=ij.Sampling(period=2e-3, delay=1e-3),
    sensor=sensor,
    actuator=ij.actuators.Motor(bandwidth=200.0),
)
"""
"""An arm whose first results are measured, as the text of a program: sampled, with encoders and
motors."""
PEERS = ("scipy", "diffrax", "mujoco", "pin", "casadi", "openturns", "cma", "optuna")
"""The distributions of other software that some benchmark runs."""


def once(call: Callable[[], Any]) -> float:
    """Seconds of one call, its results blocked on."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def in_turn(calls: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, tuple[float, float]]:
    """The smallest wall and processor seconds of each call, taken in turn so that a slow moment of
    the machine meets all of them.
    """
    best = dict.fromkeys(calls, (float("inf"), float("inf")))
    for _ in range(repeats):
        for name, call in calls.items():
            cpu = time.process_time()
            wall, used = once(call), time.process_time() - cpu
            best[name] = min(best[name][0], wall), min(best[name][1], used)
    return best


def interleaved(calls: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """The smallest wall seconds of each call, as `in_turn`."""
    return {name: wall for name, (wall, _) in in_turn(calls, repeats).items()}


def compile_seconds(function: Callable, *args: Any) -> tuple[float, Callable]:
    """Seconds to trace and compile `jax.jit(function)` for these arguments, and the compiled
    function.
    """
    return compiled_side_by_side({"": (function, args)}, threads=1)[""]


def compiled_side_by_side(
    functions: Mapping[Any, tuple[Callable, Sequence[Any]]], threads: int
) -> dict[Any, tuple[float, Callable]]:
    """The same for many functions: name -> `compile_seconds`.

    They are traced one after the other; XLA compiles so many at the same time.
    """

    def timed(call):
        start = time.perf_counter()
        return call(), time.perf_counter() - start

    def compiled(lowered, tracing):
        found, compiling = timed(lowered.compile)
        return tracing + compiling, found

    with ThreadPoolExecutor(threads) as pool:
        started = {}
        for name, (function, args) in functions.items():
            lowered, tracing = timed(partial(jax.jit(function).lower, *args))
            started[name] = pool.submit(compiled, lowered, tracing)
        return {name: future.result() for name, future in started.items()}


def machine() -> dict[str, str]:
    """What the numbers were measured with (no host names)."""
    models = {
        line.partition(":")[2].strip()
        for line in processor().splitlines()
        if line.startswith("model name")
    }
    return {
        "date": time.strftime("%Y-%m-%d"),
        "processor": ", ".join(models) or platform.processor() or platform.machine(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxlib": jaxlib.__version__,
        "numpy": np.__version__,
        "iblf_jax": ij.__version__,
        "commit": commit(),
        "backend": jax.default_backend(),
        "peers": ", ".join(f"{name} {version}" for name, version in peers().items()),
    }


def peers() -> dict[str, str]:
    """The versions of the other software that is installed."""
    found = {}
    for name in PEERS:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def commit() -> str:
    """The commit of the package and of the benchmarks, and whether they were changed since."""
    if Path(ij.__file__).resolve().parents[1] != ROOT:
        return "unknown: iblf_jax was imported from another folder than that of the benchmarks"
    try:
        head = _git("rev-parse", "HEAD")
        # Results that were measured before do not change what is measured.
        changed = _git(
            "status", "--porcelain", "--", "iblf_jax", "benchmarks", ":!*/results/*", ":!*/checks/*"
        )
    except (OSError, subprocess.CalledProcessError) as error:
        return f"unknown: {error}"
    return f"{head} with uncommitted changes" if changed else head


def _git(*words: str) -> str:
    """What git prints in the folder of the repository."""
    call = subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True)
    return call.stdout.strip()


def report(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    json_path: str | None,
    further: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Prints one table and, if asked, writes it as JSON, with further results beside it."""
    shown = [[f"{x:.4g}" if isinstance(x, float) else str(x) for x in row] for row in rows]
    widths = [max(len(line[i]) for line in [list(columns), *shown]) for i in range(len(columns))]
    print(title)
    for line in [list(columns), *shown]:
        print(
            "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        )
    if json_path:
        write_results(title, columns, rows, json_path, further)


def write_results(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    json_path: str,
    further: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Writes a table as JSON; a long program does so after each of its parts."""
    table = [dict(zip(columns, row, strict=True)) for row in rows]
    words = [
        word for word in sys.argv[1:] if word not in ("--json", json_path, f"--json={json_path}")
    ]
    command = shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *words])
    found = {"title": title, "command": command, "machine": machine(), "rows": table, **further}
    Path(json_path).write_text(json.dumps(found, indent=1) + "\n")

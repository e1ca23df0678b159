"""Latency of one run: the paper's 20 s by RK4 in float64 against SciPy's LSODA on the same closed
loop, in processor time, with the largest error of a position at the instants that each returns.

    python benchmarks/latency.py [--quick] [--first] [--json FILE]

Rows: LSODA at rtol 1e-6 on the loop in NumPy, LSODA on this package's own compiled vector field,
  which Python calls at every evaluation, and `simulate` on its two backends at 1 ms and, on
  "native", at 0.5 ms.  LSODA chooses its steps; those of RK4 are fixed and have to be known.
  The reference of the errors is DOP853 at rtol 1e-10.
`import` is the time of `import iblf_jax` above `import jax`, each in a fresh process.
With `--first`, the rows are the first results of an arm of six joints with a sampled law, encoders
  and motors instead: processor seconds of a call in a fresh process, those of the compilers it
  starts included, with an empty cache and in a second process.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from functools import partial

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from _timing import ARM, in_turn, report
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import iblf_jax as ij
from iblf_jax.engine import RunRequest
from iblf_jax.engine.single_run import run_one
from iblf_jax.simulation.closed_loop import initial_state, rate
from iblf_jax.simulation.metrics import standard


def numpy_loop(t: float, x: np.ndarray) -> np.ndarray:
    """The paper's closed loop (integral barrier, printed variant) as one writes it in NumPy, its
    derivatives by hand.
    """
    q, dq, eta = x[:2], x[2:4], x[4:]
    p1, p2, p3, p4, p5, g = 0.226625, 0.0408425, 0.0461125, 0.6475, 0.13175, 9.81
    s2, c2 = p3 * np.sin(q[1]), p3 * np.cos(q[1])
    M = np.array([[p1 + p2 + 2 * c2, p2 + c2], [p2 + c2, p2]])
    C = np.array([[-s2 * dq[1], -s2 * (dq[0] + dq[1])], [s2 * dq[0], 0.0]])
    outer = p5 * g * np.cos(q[0] + q[1])
    G = np.array([p4 * g * np.cos(q[0]) + outer, outer])

    wave = 0.14 * np.array([np.sin(t), np.cos(t)])
    dwave = 0.14 * np.array([np.cos(t), -np.sin(t)])
    swapped, dswapped = wave[::-1], np.array([-0.14 * np.sin(t), 0.14 * np.cos(t)])
    e1 = q - wave - 0.5
    k_l, dk_l, ddk_l = 0.3 + wave - swapped, dwave - dswapped, swapped - wave
    k_u, dk_u, ddk_u = 0.4 - wave + swapped, dswapped - dwave, wave - swapped
    a, b = dk_u / k_u, dk_l / k_l
    kappa = np.sqrt(a**2 + b**2 + 0.1)
    dkappa = (a * (ddk_u / k_u - a**2) + b * (ddk_l / k_l - b**2)) / kappa
    alpha = dwave - (2.0 + kappa) * e1
    dalpha = -wave - (2.0 + kappa) * (dq - dwave) - dkappa * e1

    k = np.where(e1 > 0, k_u, k_l)
    f_hat = eta + 20.0 * M @ dq
    tau = C @ dq + G + M @ dalpha - f_hat - 20.0 * (dq - alpha) - 2.0 * e1 / (k**2 - e1**2)
    f = M @ np.array([0.3 * np.sin(t), 0.3 * np.cos(t)]) + C @ np.array(
        [0.3 * np.cos(0.5 * t), 0.3 * np.sin(0.5 * t)]
    )
    ddq = np.linalg.solve(M, tau + f - C @ dq - G)
    return np.concatenate([dq, ddq, -20.0 * (f_hat + tau - C @ dq - G)])


FIRST_RESULTS = {
    "simulate": "ij.simulate(arm, **timing)",
    "recommended_period": "ij.recommended_period(arm, duration=1.5)",
    "export": "ij.export(arm, folder)",
    "monte_carlo": "study()",
    "report of a study": "ij.report(found, folder + '/report.html')",
}
"""Call -> its text in FIRST_RESULT."""
FIRST_RESULT = f"""
import resource, sys, tempfile
import jax
{ARM}timing = {{"duration": 1.5, "dt": 1e-3}}
def study():
    unknown = {{"plant.payload": ij.value(ij.uniform(1.0, 2.0))}}
    return ij.monte_carlo(arm, unknown, runs=64, **timing)
def used():
    whose = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(sum(resource.getrusage(each)[:2]) for each in whose)
if "found" in sys.argv[1]:
    found = study()
with tempfile.TemporaryDirectory() as folder:
    start = used()
    eval(sys.argv[1])
    print(used() - start)
"""


def first_results(calls: list[str]) -> list[list]:
    """Rows of the first results: call, seconds with an empty cache and in a second process."""
    rows = []
    for name in calls:
        command = [sys.executable, "-c", FIRST_RESULT, FIRST_RESULTS[name]]
        with tempfile.TemporaryDirectory() as cache:
            environment = os.environ | {"XDG_CACHE_HOME": cache}
            seconds = [
                subprocess.run(
                    command, check=True, capture_output=True, text=True, env=environment
                ).stdout.split()[-1]
                for _ in range(2)
            ]
        rows.append([name, *map(float, seconds)])
    return rows


def import_seconds(repeats: int) -> float:
    """Seconds of `import iblf_jax` after `import jax`, in a fresh process; the smallest of some."""
    code = (
        "import jax, time; t = time.perf_counter(); import iblf_jax; print(time.perf_counter() - t)"
    )
    command = [sys.executable, "-c", code]
    return min(
        float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        for _ in range(repeats)
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="half a second of motion by Euler's method, one repeat"
    )
    parser.add_argument("--first", action="store_true", help="first results of an arm instead")
    parser.add_argument("--json", help="also write the table to this file")
    args = parser.parse_args()
    if args.first:
        columns = ["call", "empty cache, s", "second process, s"]
        calls = list(FIRST_RESULTS)[:1] if args.quick else list(FIRST_RESULTS)
        report("First results, processor time", columns, first_results(calls), args.json)
        return
    duration, method, repeats = (0.5, "euler", 1) if args.quick else (20.0, "rk4", 5)
    steps = round(duration / 1e-3)

    scenario = ij.presets.zhang_yan_2024()
    dt = jnp.asarray(1e-3)
    folds = standard()
    compiled, compile_times = {}, {}
    for backend in ("vmap", "native"):
        start = time.perf_counter()
        run = partial(run_one, request=RunRequest(steps, method, 1, backend=backend))
        compiled[backend] = jax.jit(run).lower(scenario, folds, dt).compile()
        compile_times[backend] = time.perf_counter() - start

    x0, unravel = ravel_pytree(initial_state(scenario))
    field = jax.jit(lambda t, x: ravel_pytree(rate(scenario, t, unravel(x)))[0])
    assert np.allclose(
        numpy_loop(0.3, np.asarray(x0) + 0.01), field(0.3, x0 + 0.01), rtol=1e-9, atol=1e-9
    )
    solve = partial(solve_ivp, t_span=(0.0, duration), y0=np.asarray(x0))
    lsoda = partial(solve, method="LSODA", rtol=1e-6, atol=1e-9)

    def compiled_field(t, x):
        return np.asarray(field(t, x))

    exact = solve(compiled_field, method="DOP853", rtol=1e-10, atol=1e-12, dense_output=True).sol
    calls = {
        "LSODA, NumPy loop": lambda: lsoda(numpy_loop),
        "LSODA, compiled field": lambda: lsoda(compiled_field),
    }
    simulate = partial(ij.simulate, scenario, duration=duration, method=method)
    calls["vmap, user's call"] = partial(simulate, dt=1e-3, backend="vmap")
    calls["native, user's call"] = partial(simulate, dt=1e-3, backend="native")
    calls["native, user's call, 0.5 ms"] = partial(simulate, dt=5e-4, backend="native")
    errors = {}
    for name, call in calls.items():
        found = call()
        t, q = (found.t, found.y[:2]) if "LSODA" in name else (found.t, np.transpose(found.q))
        errors[name] = float(np.abs(q - exact(np.asarray(t))[:2]).max())
    for backend, function in compiled.items():
        calls[f"{backend}, compiled"] = partial(function, scenario, folds, dt)
        errors[f"{backend}, compiled"] = errors[f"{backend}, user's call"]
    best = {name: used for name, (_, used) in in_turn(calls, repeats).items()}
    reference = best["LSODA, NumPy loop"]
    rows = [
        [name, 1e3 * seconds, reference / seconds, errors[name]] for name, seconds in best.items()
    ]
    report(
        f"One run of {duration:g} s, {method} at 1 ms where no step is named, float64",
        ["row", "processor ms", "times less", "largest error [rad]"],
        rows,
        args.json,
    )
    built = ", ".join(f"{seconds:.2f} s ({backend})" for backend, seconds in compile_times.items())
    print(
        f"compile {built}; import iblf_jax above import jax {import_seconds(min(repeats, 3)):.2f} s"
    )


if __name__ == "__main__":
    main()

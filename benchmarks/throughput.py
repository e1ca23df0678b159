"""Throughput of many runs at once, RK4 at 1 ms, steps per second, everything side by side in one
run.

    python benchmarks/throughput.py [--quick] [--json FILE] [--dtypes float32,float64] [--batches
    1,64,4096,65536] [--loops paper,chain,arm]

Rows: SciPy LSODA and diffrax (of the same motion, in steps of 1 ms), the textbook `jit(vmap(scan))`
  with `jnp.linalg.solve`, this
package's backends with the standard metrics and without, on one thread and on all, value and 6
forward sensitivities, and the limit: a rollout written by hand in C++ (`limit/paper_loop.cc`),
  which carries the state alone and is there for the paper's loop only.  The second
loop is a planar chain of four joints; the third, a real arm of seven (`presets.iiwa14`), whose step
is too long for XLA.  Last, `native` on 1e4, 1e5 and 1e6 runs, the whole call of `monte_carlo`
beside the limit (of the limit: in processor time), and `native` on a law that is sampled beside one
that is not; and gradients by the weights of a network in reverse mode, by kernels and by the
scan, whose cost `in values` is that of so many runs without derivatives.  `a core` is steps per
second of processor time: on a shared machine it is the number to compare.  A row that needs a
package which is not there is left out.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.util
import itertools
import math
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _timing import compile_seconds, in_turn, report, write_results

import iblf_jax as ij
from iblf_jax import kernels
from iblf_jax.core import devices
from iblf_jax.engine import RunRequest
from iblf_jax.engine.execute import run_batch, run_batch_jvp, run_batch_vjp
from iblf_jax.engine.structural_constants import constants_of, robot_constants
from iblf_jax.kernels import toolchain
from iblf_jax.simulation.metrics import standard
from iblf_jax.simulation.paths import get
from iblf_jax.simulation.scenario import canonical

FOLDER = Path(__file__).parent
GAINS = {
    name: np.eye(6)[:, 2 * i : 2 * i + 2]
    for i, name in enumerate(("controller.k1", "controller.K2", "observer.kf"))
}


def chain(n: int):
    """A planar chain of n links in the paper's setting."""
    plant = ij.robots.PlanarChain(mass=np.full(n, 0.5), length=0.25, centre=0.125, inertia=0.01)
    side = ij.bounds.Constant(np.full(n, 0.2)), ij.bounds.Constant(np.full(n, 0.9))
    return ij.Scenario(
        plant=plant,
        reference=ij.references.Sinusoid(
            offset=0.5, amplitude=0.14, frequency=1.0, phase=np.arange(n) * 1.0
        ),
        bounds=ij.bounds.Bounds(*side),
        controller=ij.controllers.Backstepping(k1=2.0, K2=20.0, o=0.1),
        observer=ij.observers.Momentum(kf=20.0),
        initial=ij.Initial(q=0.55),
    )


LOOPS = {"paper": ij.presets.zhang_yan_2024, "chain": lambda: chain(4), "arm": ij.presets.iiwa14}


def draws(scenario, runs: int, dtype):
    """A mass of the plant and the start, one each a run."""
    rng = np.random.default_rng(0)
    start = np.asarray(scenario.initial.q) + 0.01 * rng.standard_normal((runs, scenario.n))
    nominal = float(np.asarray(scenario.plant.mass)[1])
    return {
        "plant.mass[1]": jnp.asarray(nominal * rng.uniform(0.7, 1.3, runs), dtype),
        "initial.q": jnp.asarray(start, dtype),
    }


def textbook_slope(mass, t, x):
    """The paper's loop as one writes it in JAX: arrays of two joints, derivatives by jvp,
    `jnp.linalg.solve`.
    """
    q, dq, eta = x

    def lumped(m2):
        return (
            0.1225 + m2 * 0.1225,
            m2 * 0.024025 + 0.02042125,
            m2 * 0.05425,
            0.35 + m2 * 0.35,
            m2 * 0.155,
        )

    def matrices(p, q, dq):
        c, s = p[2] * jnp.cos(q[1]), p[2] * jnp.sin(q[1])
        M = jnp.array([[p[0] + p[1] + 2 * c, p[1] + c], [p[1] + c, p[1]]])
        C = jnp.array([[-s * dq[1], -s * (dq[0] + dq[1])], [s * dq[0], 0.0]])
        outer = p[4] * 9.81 * jnp.cos(q[0] + q[1])
        return M, C, jnp.array([p[3] * 9.81 * jnp.cos(q[0]) + outer, outer])

    def tube(t):
        wave, swapped = (
            0.14 * jnp.array([jnp.sin(t), jnp.cos(t)]),
            0.14 * jnp.array([jnp.cos(t), jnp.sin(t)]),
        )
        return 0.5 + wave, 0.3 + wave - swapped, 0.4 - wave + swapped

    def alpha(t, q):
        (q_d, k_l, k_u), (dq_d, dk_l, dk_u) = jax.jvp(tube, (t,), (jnp.ones_like(t),))
        return dq_d - (2.0 + jnp.sqrt((dk_u / k_u) ** 2 + (dk_l / k_l) ** 2 + 0.1)) * (q - q_d)

    M, C, G = matrices(lumped(mass), q, dq)
    M0, C0, G0 = matrices(lumped(0.85), q, dq)
    a, da = jax.jvp(alpha, (t, q), (jnp.ones_like(t), dq))
    q_d, k_l, k_u = tube(t)
    e = q - q_d
    k = jnp.where(e > 0, k_u, k_l)
    f_hat = eta + 20.0 * (M0 @ dq)
    tau = C0 @ dq + G0 + M0 @ da - f_hat - 20.0 * (dq - a) - 2.0 * e / (k**2 - e**2)
    push = M0 @ (0.3 * jnp.array([jnp.sin(t), jnp.cos(t)])) + C0 @ (
        0.3 * jnp.array([jnp.cos(0.5 * t), jnp.sin(0.5 * t)])
    )
    ddq = jnp.linalg.solve(M, tau + push - C @ dq - G)
    return dq, ddq, -20.0 * (f_hat + tau - C0 @ dq - G0)


def textbook(values, dt, *, steps: int):
    """`vmap` over runs of a `scan` over time."""

    def one(mass, q0):
        def step(x, i):
            t = i * dt
            add = lambda x, h, k: jax.tree.map(lambda a, b: a + h * b, x, k)  # noqa: E731
            k1 = textbook_slope(mass, t, x)
            k2 = textbook_slope(mass, t + dt / 2, add(x, dt / 2, k1))
            k3 = textbook_slope(mass, t + dt / 2, add(x, dt / 2, k2))
            k4 = textbook_slope(mass, t + dt, add(x, dt, k3))
            return (
                jax.tree.map(
                    lambda x, a, b, c, d: x + dt / 6 * (a + 2 * b + 2 * c + d), x, k1, k2, k3, k4
                ),
                None,
            )

        return jax.lax.scan(step, (q0, 0 * q0, 0 * q0), jnp.arange(steps, dtype=dt.dtype))[0]

    return jax.vmap(one)(values["plant.mass[1]"], values["initial.q"])


def with_diffrax(values, dt, *, steps: int):
    """The same loop by diffrax: the classical Runge-Kutta method with a constant step, vmapped, so
    that a step has four evaluations as in the other rows.
    """
    import diffrax

    class Classical(diffrax.AbstractERK):
        tableau = diffrax.ButcherTableau(
            a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
            b_sol=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
            b_error=np.zeros(4),
            c=np.array([0.5, 0.5, 1.0]),
        )
        interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

        def order(self, terms):
            return 4

    def one(mass, q0):
        term = diffrax.ODETerm(lambda t, x, _: textbook_slope(mass, t, x))
        t1 = steps * dt
        return diffrax.diffeqsolve(
            term, Classical(), 0 * t1, t1, dt, (q0, 0 * q0, 0 * q0), max_steps=steps + 1
        ).ys

    return jax.vmap(one)(values["plant.mass[1]"], values["initial.q"])


def with_scipy(steps: int) -> float:
    """Seconds of SciPy's LSODA for the motion of so many steps."""
    from latency import numpy_loop
    from scipy.integrate import solve_ivp

    start = time.perf_counter()
    solve_ivp(
        numpy_loop,
        (0.0, steps * 1e-3),
        np.array([0.8, 0.8, 0, 0, 0, 0]),
        method="LSODA",
        rtol=1e-6,
        atol=1e-8,
    )
    return time.perf_counter() - start


def limit(dtype):
    """The rollout written by hand as a function of (values, steps), or None without a compiler."""
    try:
        text = (FOLDER / "limit" / "paper_loop.cc").read_text()
        for name in ("vector.h", "mathlib.h"):
            text = text.replace(
                f'#include "{name}"', (Path(kernels.__file__).parent / "c" / name).read_text()
            )
        library = toolchain.loaded(
            toolchain.built(f"#define DOUBLE {int(dtype == 'float64')}\n" + text, ("-O3",))[0]
        )
    except toolchain.ToolchainError as error:
        print(f"no limit: {error}")
        return None

    def run(values, steps):
        mass, q = np.asarray(values["plant.mass[1]"]), np.asarray(values["initial.q"])
        runs = -(-len(mass) // 64) * 64
        x = np.zeros((6, runs), dtype)
        x[:2, : len(mass)] = q.T
        mass = np.concatenate([mass, np.full(runs - len(mass), 0.85, dtype)])
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in (mass, x)]
        library.paper_loop(
            *pointers,
            *map(ctypes.c_long, (runs, steps)),
            ctypes.c_double(1e-3),
            ctypes.c_long(devices.threads()),
        )
        return x[:, : len(q)]

    return run


def measured(call, repeats: int) -> tuple[float, float]:
    """The smallest wall and processor seconds of a call."""
    return in_turn({"": call}, repeats)[""]


class Row(NamedTuple):
    """One row of the table: `call(values, dt, steps)` is compiled, or called as it is if it is
    `ready`.
    """

    name: str
    call: Callable
    rate: float
    """Steps per second that are expected, to choose how many to run."""
    threads: int | None = None
    batches: tuple[int, ...] | None = None
    """The batches that it is measured on; None for all."""
    ready: bool = False
    most: int = 10_000_000
    """Runs at most: the textbook's batched LAPACK call was seen to hang with 65536 on two cores, so
    that it is measured on 16384."""


LARGE = (4096, 65536)
QUICK = (
    "textbook",
    "diffrax",
    "vmap",
    "native, one thread",
    "native, rmse + 6 tangents",
    "limit, one thread",
)
"""The rows of the quick size: one of each kind, as each compiles for seconds."""


def rows_of(scenario, dtype: str, loop: str, method: str) -> list[Row]:
    """What is measured on a loop."""
    folds, mechanism = (
        jax.tree.map(lambda x: jnp.asarray(x, dtype), standard()),
        robot_constants(scenario),
    )

    def on(backend, folds=folds):
        return lambda v, dt, steps: run_batch(
            scenario,
            v,
            folds,
            dt,
            RunRequest(steps, method, constants=mechanism, backend=backend),
        )

    def sensitivities(folds):
        return lambda v, dt, steps: run_batch_jvp(
            scenario,
            v,
            GAINS,
            folds,
            dt,
            RunRequest(steps, method, constants=mechanism, backend="native"),
        )

    if loop == "arm":
        return [
            Row("vmap", on("vmap"), 2e4, batches=(1, 64)),
            Row("native", on("native"), 2e6, batches=(1, 64, 4096)),
        ]
    rows = [
        Row("vmap", on("vmap"), 4e5, batches=(1, 64, 4096)),
        Row("native", on("native"), 1e8),
        Row("native, one thread", on("native"), 1e8, threads=1, batches=LARGE[1:]),
    ]
    if loop != "paper":
        return rows
    first = [Row("textbook", lambda v, dt, steps: textbook(v, dt, steps=steps), 4e5, most=16_384)]
    if importlib.util.find_spec("diffrax"):
        first.append(
            Row(
                "diffrax",
                lambda v, dt, steps: with_diffrax(v, dt, steps=steps),
                3e5,
                batches=(4096,),
            )
        )
    rows += [
        Row("native, no metrics", on("native", ()), 1e8, batches=LARGE),
        Row("native + 6 tangents", sensitivities(folds), 3e7, batches=LARGE),
        Row("native, rmse", on("native", folds[:1]), 1e8, batches=LARGE[:1]),
        Row("native, rmse + 6 tangents", sensitivities(folds[:1]), 3e7, batches=LARGE[:1]),
    ]
    by_hand = limit(dtype)
    if by_hand:
        call = lambda v, dt, steps: by_hand(v, steps)  # noqa: E731
        rows += [
            Row("limit", call, 1e8, ready=True),
            Row("limit, one thread", call, 1e8, threads=1, batches=LARGE[1:], ready=True),
        ]
    return first + rows


def steps_for(row: Row, runs: int, quick: bool) -> int:
    """So many steps that a row takes about a second."""
    return 20 if quick else int(min(max(min(row.rate, 2e5 * runs) / runs, 40), 10_000)) // 20 * 20


def method_for(quick: bool) -> str:
    """The method of this package's rows: the quick size is there to be run, and four stages compile
    four times as long as one.
    """
    return "euler" if quick else "rk4"


def timed(row: Row, values, dt, steps: int, repeats: int) -> tuple[float, float, float]:
    """Seconds to compile, smallest wall and processor seconds."""
    before = os.environ.get("IBLF_JAX_THREADS")
    if row.threads:
        os.environ["IBLF_JAX_THREADS"] = str(row.threads)
    try:
        seconds, call = (
            (0.0, partial(row.call, steps=steps))
            if row.ready
            else compile_seconds(partial(row.call, steps=steps), values, dt)
        )
        jax.block_until_ready(call(values, dt))
        return seconds, *measured(partial(call, values, dt), repeats)
    finally:
        if row.threads:
            os.environ.pop("IBLF_JAX_THREADS")
            os.environ.update({"IBLF_JAX_THREADS": before} if before else {})


def table(dtype: str, batches, loop: str, quick: bool) -> list[list]:
    """The rows of one loop and type."""
    jax.config.update("jax_enable_x64", dtype == "float64")
    scenario = canonical(ij.astype(LOOPS[loop](), dtype))
    dt, result, rows = (
        jnp.asarray(1e-3, dtype),
        [],
        rows_of(scenario, dtype, loop, method_for(quick)),
    )
    for runs in batches:
        values, found = draws(scenario, runs, dtype), []
        for row in rows:
            if row.name in QUICK if quick else row.batches is None or runs in row.batches:
                count = min(runs, row.most)
                steps = steps_for(row, count, quick)
                seconds, wall, cpu = timed(
                    row, {k: x[:count] for k, x in values.items()}, dt, steps, 1 if quick else 3
                )
                found.append((row.name, steps, seconds, count * steps / wall, count * steps / cpu))
                print(
                    f"{loop} {dtype} {runs} {row.name}: {found[-1][3]:.3g} steps/s",
                    file=sys.stderr,
                    flush=True,
                )
        bases = [
            next((speed for name, *_, speed, _ in found if name == base), math.nan)
            for base in ("textbook", "limit")
        ]
        result += [
            [loop, dtype, runs, *line, line[3] / bases[0], line[3] / bases[1]] for line in found
        ]
    return result


def flat(quick: bool) -> list[list]:
    """`native` on more and more runs, whose speed should not depend on how many there are."""
    jax.config.update("jax_enable_x64", False)
    scenario, dt = (
        canonical(ij.astype(ij.presets.zhang_yan_2024(), "float32")),
        jnp.asarray(1e-3, "float32"),
    )
    row = next(
        row
        for row in rows_of(scenario, "float32", "chain", method_for(quick))
        if row.name == "native"
    )
    result, steps = [], 20 if quick else 200
    for runs in (4,) if quick else (10_000, 100_000, 1_000_000):
        seconds, wall, cpu = timed(
            row, draws(scenario, runs, "float32"), dt, steps, 1 if quick else 3
        )
        speeds = runs * steps / wall, runs * steps / cpu
        result.append(
            ["paper", "float32", runs, "native, flat", steps, seconds, *speeds, math.nan, math.nan]
        )
    return result


CALLS = ((65_536, 1_000), (4_096, 10_000))
"""Runs and steps of the studies whose whole call is measured."""


def calls(quick: bool) -> list[list]:
    """The whole call of `monte_carlo`, which draws, runs, assesses the steps and makes the results,
    beside the limit, which only steps: in turn, and compared in processor time.
    """
    jax.config.update("jax_enable_x64", False)
    scenario = ij.presets.zhang_yan_2024()
    unknown = {"plant.mass[1]": ij.factor(ij.uniform(0.9, 1.1))}
    method, by_hand = method_for(quick), limit("float32")
    result = []
    for runs, steps in ((2, 20),) if quick else CALLS:
        study = partial(ij.monte_carlo, scenario, unknown, runs=runs, duration=1e-3 * steps)
        name_of_call, name_of_limit = "monte_carlo, whole call", "limit, in turn with it"
        ways = {name_of_call: partial(study, method=method, progress=False)}
        if by_hand:
            values = draws(canonical(ij.astype(scenario, "float32")), runs, "float32")
            ways[name_of_limit] = partial(by_hand, values, steps)
        first = time.perf_counter()
        ways[name_of_call]()
        seconds = time.perf_counter() - first
        found = in_turn(ways, 1 if quick else 5)
        least = found.get(name_of_limit, (math.nan, math.nan))[1]
        for name, (wall, cpu) in found.items():
            speeds = runs * steps / wall, runs * steps / cpu
            first_call = seconds if name == name_of_call else 0.0
            row = ["paper", "float32", runs, name, steps, first_call]
            result.append([*row, *speeds, math.nan, least / cpu])
    return result


SAMPLED = {
    "law at every instant": None,
    "law every 4 steps": ij.Sampling(4e-3),
    "law every 4 steps, late": ij.Sampling(4e-3, delay=1.3e-3),
    "law every step": ij.Sampling(1e-3),
}


def soft_paper():
    """The paper's loop, soft enough to be sampled every 4 ms."""
    return ij.with_parameters(
        ij.presets.zhang_yan_2024(variant="corrected"), {"controller.K2": 4.0, "observer.kf": 4.0}
    )


def sampled(quick: bool) -> list[list]:
    """`native` where the law runs at every instant, once a period, and late: all in turn."""
    result = []
    sizes = {
        "paper": (soft_paper, 2048, 4000, 4),
        "ur5": (ij.presets.ur5, 256, 1000, 2),
        "arm": (ij.presets.iiwa14, 256, 1000, 2),
    }
    if quick:
        sizes = {"paper": (soft_paper, 2, 20, 2)}
    for (loop, (make, runs, steps, rows)), dtype in itertools.product(
        sizes.items(), ("float64",) if quick else ("float64", "float32")
    ):
        jax.config.update("jax_enable_x64", dtype == "float64")
        dt, calls, compiled = jnp.asarray(1e-3, dtype), {}, {}
        for name in list(SAMPLED)[:rows]:
            scenario = canonical(ij.astype(ij.with_parts(make(), sampling=SAMPLED[name]), dtype))
            values = draws(scenario, runs, dtype)
            row = next(
                row
                for row in rows_of(scenario, dtype, "chain", method_for(quick))
                if row.name == "native"
            )
            compiled[name], call = compile_seconds(partial(row.call, steps=steps), values, dt)
            calls[name] = partial(call, values, dt)
            jax.block_until_ready(calls[name]())
        for name, (wall, cpu) in in_turn(calls, 1 if quick else 7).items():
            speeds = runs * steps / wall, runs * steps / cpu
            result.append(
                [
                    loop,
                    dtype,
                    runs,
                    f"native, {name}",
                    steps,
                    compiled[name],
                    *speeds,
                    math.nan,
                    math.nan,
                ]
            )
            print(
                f"{loop} {dtype} {runs} {name}: {speeds[1]:.3g} steps/s per core",
                file=sys.stderr,
                flush=True,
            )
    return result


@ij.component
class Network:
    """Torque of a network of q, q' and the time."""

    layers: Any

    def torque(self, t, q, dq, plant, model):
        """The output of the network."""
        periodic = jnp.stack([jnp.sin(t), jnp.cos(t), jnp.sin(2 * t), jnp.cos(2 * t)])
        x = jnp.concatenate([q, dq, periodic])
        for weights, offsets in self.layers[:-1]:
            x = jnp.tanh(weights @ x + offsets)
        weights, offsets = self.layers[-1]
        return weights @ x + offsets

    def jump_times(self):
        """None."""
        return jnp.zeros(0)


def with_network(width: int) -> ij.Scenario:
    """The paper's scenario with a network of two hidden layers as its disturbance."""
    rng = np.random.default_rng(0)
    sizes = [(width, 8), (width, width), (2, width)]
    layers = [(0.1 * rng.normal(size=size), 0.1 * rng.normal(size=size[0])) for size in sizes]
    return canonical(ij.with_parts(ij.presets.zhang_yan_2024(), disturbance=Network(layers)))


def gradients(quick: bool) -> list[list]:
    """Runs and their gradients by all weights of a network, in turn."""
    jax.config.update("jax_enable_x64", True)
    sizes = [(2, 2, 20)] if quick else [(8, 1, 3000), (8, 64, 500), (16, 64, 500)]
    dt, folds, method = jnp.asarray(1e-3), standard()[:1], method_for(quick)
    result = []
    for width, runs, steps in sizes:
        scenario = with_network(width)
        weights = {
            name.path: jnp.asarray(get(scenario, name.path))
            for name in ij.parameters(scenario)
            if ".layers" in name.path
        }
        varied = {
            path: jnp.broadcast_to(x, (runs, *x.shape)) for path, x in weights.items()
        } | draws(scenario, runs, "float64")
        request = RunRequest(steps, method, constants=constants_of(scenario))

        def value(varied, scenario=scenario, request=request):
            return run_batch(scenario, varied, folds, dt, request).metrics["rmse"]

        def gradient(varied, backend, scenario=scenario, request=request, weights=weights):
            outcome, pullback = run_batch_vjp(
                scenario,
                varied,
                list(weights),
                ["rmse"],
                folds,
                dt,
                request._replace(backend=backend),
            )
            found = pullback({"rmse": jnp.ones_like(outcome.metrics["rmse"])})
            return {path: jnp.sum(x, axis=0) for path, x in found.items()}

        count = sum(x.size for x in weights.values())
        functions = {
            "native, with a network": value,
            f"native, gradient by {count} weights": partial(gradient, backend="native"),
            f"vmap, gradient by {count} weights": partial(gradient, backend="vmap"),
        }
        compiled = {name: compile_seconds(f, varied) for name, f in functions.items()}
        calls = {name: partial(call, varied) for name, (_, call) in compiled.items()}
        for call in calls.values():
            jax.block_until_ready(call())
        found = in_turn(calls, 1 if quick else 7)
        least = found["native, with a network"][1]
        for name, (wall, cpu) in found.items():
            speeds = runs * steps / wall, runs * steps / cpu
            row = ["paper", "float64", runs, name, steps, compiled[name][0], *speeds]
            result.append([*row, math.nan, math.nan, cpu / least])
            print(f"{runs} runs, {name}: {cpu / least:.1f} values", file=sys.stderr, flush=True)
    return result


def by_scipy() -> list[list]:
    """One run by SciPy's LSODA."""
    jax.config.update("jax_enable_x64", True)
    speed = 10_000 / with_scipy(10_000)
    return [["paper", "float64", 1, "SciPy LSODA", 10_000, 0.0, speed, speed, math.nan, math.nan]]


COLUMNS = (
    "loop",
    "type",
    "runs",
    "row",
    "steps",
    "compile s",
    "steps/s",
    "steps/s per core",
    "x textbook",
    "of limit",
    "in values",
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json")
    parser.add_argument("--dtypes", default="float32,float64")
    parser.add_argument("--batches", default="1,64,4096,65536")
    parser.add_argument("--loops", default="paper,chain,arm")
    options = parser.parse_args()
    batches = [2] if options.quick else [int(x) for x in options.batches.split(",")]
    quick = options.quick
    loops = ["paper"] if quick else options.loops.split(",")
    dtypes = ["float32"] if quick else options.dtypes.split(",")
    parts = [
        partial(table, dtype, batches, loop, quick)
        for loop, dtype in itertools.product(loops, dtypes)
    ]
    parts += [partial(part, quick) for part in (flat, calls, sampled, gradients)]
    if not quick:
        parts.insert(0, by_scipy)
    title = f"Throughput, {method_for(quick)} at 1 ms"
    rows: list[list] = []
    for part in parts:
        rows += [[*row, math.nan][: len(COLUMNS)] for row in part()]
        if options.json:  # all parts take half an hour
            write_results(title, COLUMNS, rows, options.json)
    report(title, COLUMNS, rows, options.json)


if __name__ == "__main__":
    main()

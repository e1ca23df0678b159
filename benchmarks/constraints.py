"""What keeps constraints: barrier laws, full state, dynamic surface, governor, safety filter, and
nonlinear MPC.

    python benchmarks/constraints.py [--quick] [--json FILE] [--runs 400] [--mpc-runs 20]

The paper's arm, reference, bounds and disturbance, with bounds on the velocities, and a wall for
the tip that the reference crosses.  Each law's gains are scaled by the factor at which its RMS
torque above gravity is the integral barrier's (`ij.compare`), where there is one; then many runs
from starts within +-0.03 rad.  The MPC (`peers/mpc.py`; needs CasADi, and is left out without it)
has a cost and a period of its own, 20 ms, solves to convergence, and its runs are the first of the
others': its time a step is no number to compare with that of a formula that runs once in 1 ms.
`left` is the share of the runs that left it, `least` the smallest margin of all runs; rmse (worst
joint) and effort above gravity are medians; `us a step` is the processor time of one control step:
of a period of 1 ms with the plant's motion, in one compiled loop, or of one MPC of 20 ms, which is
called from Python.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
import warnings
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from _timing import report

import iblf_jax as ij
from iblf_jax import bounds, metrics, regions
from iblf_jax.core.linalg import solve_spd
from iblf_jax.engine import RunRequest, run_rollout
from iblf_jax.simulation.scenario import canonical

LAWS = (
    "integral",
    "log",
    "tan",
    "backstepping",
    "dynamic_surface",
    "full_state",
    "reference_governor",
    "safety_filter",
)
WALL, DT, PERIOD = 0.52, 1e-3, 1e-3
"""m, s, s."""
COLUMNS = [
    "law",
    "factor",
    "left q",
    "left q'",
    "left wall",
    "least q [rad]",
    "least q' [rad/s]",
    "least wall [m]",
]
COLUMNS += ["rmse [rad]", "effort [N m]", "us a step"]
MARGINS = {
    "margin": ij.Status.BOUND_VIOLATED,
    "velocity_margin": ij.Status.VELOCITY_VIOLATED,
    "region_margin": ij.Status.REGION_VIOLATED,
}
"""Metric -> the flag of runs in which it is not positive."""


def scenario() -> ij.Scenario:
    """What is to be kept."""
    speeds = bounds.Bounds(lower=bounds.Constant([-1.0, -0.6]), upper=bounds.Constant([0.6, 0.5]))
    wall = regions.HalfSpace(normal=[-1.0, 0.0], offset=-WALL)
    preset = ij.presets.zhang_yan_2024_full_state()
    return ij.with_parts(preset, bounds=(preset.bounds[0], speeds), regions=(wall,))


def step_seconds(one: ij.Scenario) -> float:
    """Processor seconds of one period of a sampled law, the plant's motion with it."""
    sampled, steps = canonical(ij.with_parts(one, sampling=ij.Sampling(period=PERIOD))), 5000
    request = RunRequest.of(sampled, steps=steps, record_every=steps)

    def run():
        jax.block_until_ready(run_rollout(sampled, (), jnp.asarray(DT), request).q)

    run()
    return min(_processor_seconds(run) for _ in range(3)) / steps


def _processor_seconds(call) -> float:
    began = time.process_time()
    call()
    return time.process_time() - began


def law_rows(base: ij.Scenario, laws, duration: float, runs: int) -> tuple[list, np.ndarray]:
    """A row a law, and the starts."""
    found = ij.compare(base, laws, duration=duration, dt=DT)
    print(found)
    folds, rows = (*metrics.standard(), *metrics.optional_folds(base), metrics.AboveGravity()), []
    starts = {"initial.q": ij.offset(ij.uniform(-0.03, 0.03))}
    for name in laws:
        one = found.equal_effort.get(name, found.rollouts[name]).scenario
        study = ij.monte_carlo(
            one, starts, runs=runs, duration=duration, dt=DT, metrics=folds, progress=False, seed=1
        )
        left = [float(np.mean(study.status & int(flag) != 0)) for flag in MARGINS.values()]
        least = [float(np.min(study.metrics[margin])) for margin in MARGINS]
        rmse = float(np.median(np.max(study.metrics.rmse, axis=1)))
        effort = float(np.median(study.metrics.effort_above_gravity))
        factor = found.factors[name] if name in found.equal_effort else "as given"
        rows.append([name, factor, *left, *least, rmse, effort, 1e6 * step_seconds(one)])
    return rows, np.asarray(study.samples["initial.q"])


def mpc_row(base: ij.Scenario, starts: np.ndarray, duration: float) -> list:
    """The same of the MPC, its plant and observer (momentum) this package's, stepped at 1 ms."""
    sys.path.insert(0, str(Path(__file__).parent / "peers"))
    from mpc import HORIZON, PERIOD, Mpc

    plant, h = base.plant, jnp.asarray(DT)

    def acceleration(t, q, dq, tau):
        pushed = tau + base.disturbance.torque(t, q, dq, plant, plant)
        return solve_spd(
            plant.mass_matrix(q), pushed - plant.coriolis(q, dq, dq) - plant.gravity(q)
        )

    def rate(t, x, tau):
        q, dq, eta = x
        told = base.observer.derivative(t, q, dq, tau, plant, eta)
        return dq, acceleration(t, q, dq, tau), told

    def moved(x, rates, by):
        return jax.tree.map(lambda a, b: a + by * b, x, rates)

    @jax.jit
    def held(t, x, tau):
        """One period, at each of its steps what a run is judged by."""

        def step(x, k):
            now = t + k * h
            k1 = rate(now, x, tau)
            k2 = rate(now + h / 2, moved(x, k1, h / 2), tau)
            k3 = rate(now + h / 2, moved(x, k2, h / 2), tau)
            k4 = rate(now + h, moved(x, k3, h), tau)
            after = jax.tree.map(
                lambda x, a, b, c, d: x + h / 6 * (a + 2 * b + 2 * c + d), x, k1, k2, k3, k4
            )
            q, dq, tube = x[0], x[1], base.context.tube(now)
            slow, fast = base.context.speed_limits(now)
            margin = [
                jnp.min(jnp.minimum(q - tube.lower, tube.upper - q)),
                jnp.min(jnp.minimum(dq - slow, fast - dq)),
            ]
            margin.append(regions.margins(base.regions, plant, q)[0])
            return after, (
                jnp.stack(margin),
                (q - tube.q_d) ** 2,
                jnp.sum((tau - plant.gravity(q)) ** 2),
            )

        return jax.lax.scan(step, x, jnp.arange(round(PERIOD / DT), dtype=h.dtype))

    @jax.jit
    def ahead(t):
        def at(t):
            tube = base.context.tube(t)
            return tube.q_d, tube.dq_d, tube.lower, tube.upper, *base.context.speed_limits(t)

        return jax.vmap(at)(t + PERIOD * jnp.arange(HORIZON + 1, dtype=h.dtype))

    estimate = jax.jit(lambda t, x: base.observer.estimate(t, x[0], x[1], plant, x[2]))
    least, rmse, effort, seconds, solved = [], [], [], 0.0, 0
    for start in starts:
        law, told = Mpc(plant, WALL), []
        x = (
            jnp.asarray(start),
            jnp.zeros(2),
            base.observer.init(jnp.asarray(start), jnp.zeros(2), plant),
        )
        for k in range(round(duration / PERIOD)):
            t = jnp.asarray(k * PERIOD)
            known = [np.asarray(y) for y in (x[0], x[1], estimate(t, x), *ahead(t))]
            began = time.process_time()
            tau = law.torque(*known)
            seconds, solved = seconds + time.process_time() - began, solved + 1
            x, now = held(t, x, jnp.asarray(tau))
            told.append(now)
        margin, error, square = (
            np.concatenate([np.asarray(one[i]) for one in told]) for i in range(3)
        )
        least.append(margin.min(axis=0))
        rmse.append(np.sqrt(error.mean(axis=0)).max())
        effort.append(np.sqrt(square.mean()))
    left, worst = np.mean(np.array(least) <= 0, axis=0), np.min(least, axis=0)
    return [
        "MPC (CasADi)",
        "its own",
        *left.tolist(),
        *worst.tolist(),
        *map(float, map(np.median, (rmse, effort))),
        1e6 * seconds / solved,
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="0.2 s of motion, four laws, few runs")
    parser.add_argument("--runs", type=int, default=400, help="runs a law")
    parser.add_argument("--mpc-runs", type=int, default=20, help="runs of the MPC")
    parser.add_argument("--json", help="also write the table to this file")
    args = parser.parse_args()
    laws = ("integral", "full_state", "reference_governor") if args.quick else LAWS
    duration, runs, peers = (0.2, 8, 1) if args.quick else (6.0, args.runs, args.mpc_runs)
    base = scenario()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # laws that leave what they do not know of
        rows, starts = law_rows(base, laws, duration, runs)
    if importlib.util.find_spec("casadi"):
        rows.append(mpc_row(base, starts[:peers], duration))
    report(
        f"Constraints: {runs} runs of {duration:g} s a law, {peers} of the MPC",
        COLUMNS,
        rows,
        args.json,
    )


if __name__ == "__main__":
    main()

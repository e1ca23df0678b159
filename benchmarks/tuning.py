"""Gain tuning against black-box search, on the same compiled rollout.

    python benchmarks/tuning.py [--quick] [--problem two_link|chain_4|chain_7] [--json FILE]

The loss, without smoothing, is

    J = ISE / ISE_0 + 0.5 E / E_0 + 10 softplus(20 (p / p_0 - 1)) / 20

(E the integral of |tau|^2, p the largest |tau| over joints and time; 0: at the starting gains).  Rectangle sums at 1 ms: tau as it is
applied at the start of a step, e1 as it is reached at its end.  With e1 at the start of a step too, the error of the start, which no
gain changes, would be a part of the ISE and J 0.003 larger.  Columns: the best J of each method; rollout-equivalents and seconds until
it was within 0.5 % of the best J of all methods (compile time apart).  One rollout-equivalent is one value of J; a value with its
derivatives counts by its cost, measured in the same run.

Peers: CMA-ES (`cma`) and Optuna's TPE, in logarithms of the gains, from the same start, within the same limits; CMA-ES over several
seeds, of which the median counts.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from _timing import interleaved, report

import iblf_jax as ij
from iblf_jax import bounds, controllers, disturbances, observers, references, robots
from iblf_jax.tuning import _tune, problem

WITHIN = 1.005
FOUND_LIMITS = (0.1, 1e3)
"""Where no upper limit is given to the searches: far above what any of them wants."""


def chain(n: int) -> ij.Scenario:
    """A planar chain of n equal links, 1.2 m and 3 kg in all, that follows sinusoids inside a funnel, disturbed as in the paper."""
    length, mass = 1.2 / n, 3.0 / n
    arm = robots.PlanarChain(mass=[mass] * n, length=length, centre=length / 2, inertia=mass * length**2 / 4)
    phase = [0.7 * i for i in range(n)]
    offset = [0.6] + [0.25] * (n - 1)
    start = [o + 0.14 * float(np.sin(p)) + 0.12 for o, p in zip(offset, phase, strict=True)]
    softest = float(np.linalg.eigvalsh(np.asarray(arm.mass_matrix(jnp.asarray(start))))[0])
    return ij.Scenario(
        plant=arm,
        reference=references.Sinusoid(offset=offset, amplitude=0.14, frequency=1.0, phase=phase),
        bounds=bounds.Bounds(lower=bounds.Funnel(-0.4, -0.25, 1.0), upper=bounds.Funnel(0.4, 0.25, 1.0)),
        disturbance=disturbances.ModelShaped(
            acceleration_amplitude=0.3,
            acceleration_frequency=1.0,
            acceleration_phase=phase,
            velocity_amplitude=0.3,
            velocity_frequency=0.5,
            velocity_phase=0.0,
        ),
        controller=controllers.Backstepping(k1=2.0, K2=0.6 * softest / 1e-3, o=0.1),
        observer=observers.Printed(kf=20.0),
        initial=ij.Initial(q=start),
    )


def problem_of(name: str, quick: bool) -> tuple[ij.Scenario, list[Any], float]:
    """Scenario, parameters with limits, duration."""
    if name == "two_link":
        limits = [ij.tunable("controller.k1", 0.1, 300.0), ij.tunable("controller.K2", 0.5, 200.0), ij.tunable("observer.kf", 1.0, 1e3)]
        return ij.presets.zhang_yan_2024(), limits, 0.5 if quick else 5.0
    scenario = chain(int(name.split("_")[1]))
    K2 = float(scenario.controller.K2[0])
    limits = [ij.tunable("controller.k1", 0.1, 300.0), ij.tunable("controller.K2", 0.02 * K2, 8 * K2), ij.tunable("observer.kf", 1.0, 1e3)]
    return scenario, limits, 0.2 if quick else 1.0


class Loss:
    """J of a scenario.  The package's ISE sums e1 at the start of each step; J's, at its end, leaves out the first error |e1(0)|^2 dt.

    The errors at 0 and T are part of one sum and not of the other; the one at T, below 1e-8 of the ISE, is left alone.
    """

    def __init__(self, scenario: ij.Scenario, duration: float):
        e1 = np.asarray(ij.simulate(scenario, duration=duration, dt=1e-3).e1)
        from_start, first = np.sum(e1[:-1] ** 2), np.sum(e1[0] ** 2)
        self.weight = float(from_start / (from_start - first))
        self.offset = self.weight - 1.0

    def objective(self, smoothing: float) -> ij.objectives.Objective:
        """J + offset, its peak smoothed so much."""
        effort, peak = ij.objectives.effort(), ij.objectives.peak_torque(smoothing=smoothing)
        return self.weight * ij.objectives.tracking() + 0.5 * effort + 10 * peak


class Judge:
    """J without smoothing at many points; every value counted and timed."""

    def __init__(self, built: _tune.Problem, offset: float):
        self.built, self.offset = built, offset
        self.seen: list[float] = []
        self.began = time.perf_counter()
        self.times: list[float] = []

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """J at points (S, p) or (p,)."""
        found = problem.value(self.built.shared, self.built.lanes(np.atleast_2d(points)), plan=self.built.plan)
        losses = np.where(np.asarray(found.sound), np.asarray(found.loss) - self.offset, 1e6)
        losses = np.where(np.isfinite(losses), losses, 1e6)
        self.seen += losses.tolist()
        self.times += [time.perf_counter() - self.began] * len(losses)
        return losses


def run_cma(built: _tune.Problem, offset: float, evaluations: int, seed: int) -> Judge:
    """CMA-ES, first step size 0.5 in logarithms, otherwise as it comes."""
    import cma

    options = {"bounds": [built.box.low.tolist(), built.box.high.tolist()], "seed": seed, "verbose": -9, "maxfevals": evaluations}
    search = cma.CMAEvolutionStrategy(built.box.z, 0.5, options)
    size = search.popsize
    problem.value(built.shared, built.lanes(np.stack([built.box.z] * size)), plan=built.plan)  # compile
    judge = Judge(built, offset)
    while not search.stop() and len(judge.seen) < evaluations:
        points = search.ask()
        search.tell(points, judge(np.stack(points)).tolist())
    return judge


def run_tpe(built: _tune.Problem, offset: float, evaluations: int, seed: int) -> Judge:
    """Optuna's TPE from the same start."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    names = [f"z{i}" for i in range(len(built.box.z))]
    study.enqueue_trial(dict(zip(names, built.box.z.tolist(), strict=True)))
    judge = Judge(built, offset)
    judge(built.box.z)
    judge = Judge(built, offset)

    def target(trial):
        z = [trial.suggest_float(n, float(a), float(b)) for n, a, b in zip(names, built.box.low, built.box.high, strict=True)]
        return float(judge(np.asarray(z))[0])

    study.optimize(target, n_trials=evaluations)
    return judge


def run_ours(scenario, parameters, duration: float, hard: _tune.Problem, loss: Loss, iterations: int, smoothing: float):
    """`tune` with its defaults: J of every trial, seconds of every trial, after a first call that compiles."""
    times: list[float] = []

    def once(iterations, callback=None):
        return ij.tune(
            scenario,
            parameters,
            loss.objective(smoothing),
            duration=duration,
            iterations=iterations,
            patience=100,
            progress=False,
            callback=callback,
        )

    once(1)
    began = time.perf_counter()
    best = once(iterations, lambda loop: times.append(time.perf_counter() - began))
    judge = Judge(hard, loss.offset)
    judge(best.history["z"][:, 0])
    judge.times = times
    return judge, best


def reached(judge: Judge, goal: float) -> int | None:
    """How many values it took to come to the goal."""
    hit = np.flatnonzero(np.asarray(judge.seen) <= goal)
    return int(hit[0]) + 1 if len(hit) else None


def compare(name: str, quick: bool) -> list[list[Any]]:
    """The rows of one problem."""
    scenario, parameters, duration = problem_of(name, quick)
    timing = {"duration": duration, "dt": 1e-3, "method": "rk4"}
    loss = Loss(scenario, duration)
    hard = _tune.build(scenario, parameters, loss.objective(1e-6), None, 1, 0, "mean", timing)
    lanes, size = hard.lanes(hard.box.z[None]), len(hard.box.z)
    calls = {
        "value": lambda: problem.value(hard.shared, lanes, plan=hard.plan),
        "slope": lambda: problem.slope(hard.shared, lanes, plan=hard.plan),
    }
    seconds = interleaved(calls, 2 if quick else 10)
    cost = seconds["slope"] / seconds["value"]
    budget = (40, 20) if quick else {"two_link": (1500, 1500), "chain_4": (4000, 1500), "chain_7": (6000, 1500)}[name]
    ours, tuned = run_ours(scenario, parameters, duration, hard, loss, 4 if quick else 80, 0.012)
    peers = {f"CMA-ES seed {s}": run_cma(hard, loss.offset, budget[0], s) for s in ((1,) if quick else (1, 2, 3))}
    peers["Optuna TPE"] = run_tpe(hard, loss.offset, budget[1], 1)
    goal = WITHIN * min(min(j.seen) for j in (ours, *peers.values()))
    rows = [_row(name, size, f"iblf_jax {tuned.optimiser}", ours, goal, cost)]
    rows += [_row(name, size, peer, judge, goal, 1.0) for peer, judge in peers.items()]
    counts = [r[5] for r in rows if str(r[2]).startswith("CMA") and r[5] != "never"]
    if counts and rows[0][5] != "never":
        ratio = np.median(counts) / rows[0][5]
        print(f"{name}: derivative with value costs {cost:.2f} values; CMA-ES (median) needs {ratio:.2f} x the rollouts")
    return rows


def _row(name: str, size: int, method: str, judge: Judge, goal: float, cost: float) -> list[Any]:
    count = reached(judge, goal)
    within: list[Any] = ["never", "never"] if count is None else [cost * count, judge.times[count - 1]]
    return [name, size, method, float(judge.seen[0]), float(min(judge.seen)), *within, cost]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="half a second of motion, few values")
    parser.add_argument("--problem", choices=("two_link", "chain_4", "chain_7"), help="one problem only")
    parser.add_argument("--json", help="also write the table to this file")
    args = parser.parse_args()
    names = [args.problem] if args.problem else ["two_link"] if args.quick else ["two_link", "chain_4", "chain_7"]
    rows = [row for name in names for row in compare(name, args.quick)]
    columns = ["problem", "gains", "method", "first J", "best J", "rollouts to 0.5 %", "seconds to 0.5 %", "cost of one"]
    report("Gain tuning", columns, rows, args.json)


if __name__ == "__main__":
    main()

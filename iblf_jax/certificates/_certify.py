"""`certify`: one run, a batch of runs or a study held against Theorem 2."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import numpy as np

from iblf_jax.certificates import claims, own_law, weighted_lines
from iblf_jax.certificates.lines import (
    applicable_case,
    bounds_along,
    left_side,
    of_stretch,
    over_run,
)
from iblf_jax.certificates.result import FAILS, HOLDS, NOT_APPLICABLE, Certificate, Line, Traces
from iblf_jax.certificates.retrace import believed, grid
from iblf_jax.certificates.trajectory import Trajectory, Whole, look, same_structure, same_tree
from iblf_jax.control import actuators, sensors
from iblf_jax.core import checks, notices
from iblf_jax.engine.plan import CERTIFY_RECORDED
from iblf_jax.engine.simulate import SimulationWarning, simulate
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical, with_parts
from iblf_jax.world.robots import joint_names

WORST = 16


@notices.each_warning_once
def certify(
    scenario: Scenario,
    run: Any = None,
    *,
    duration: float = 20.0,
    dt: float = 1e-3,
    method: str = "rk4",
    worst: int | None = WORST,
) -> Certificate:
    """Theorem 2, inequality by inequality, with margins.

        V2' + rho V2 - 1/2 |f'|^2 <= 0  at every step, and what follows from it
        (3.17)-(3.31)

    A law that states a Lyapunov function V of its own and its decay W (`controllers.LyapunovLaw`)
    is held against

        V' <= -W + T

    V', V2' and f' are exact (by jvp along the vector field of the whole loop).  A law, an observer
    or a situation without a claim is "not applicable", never "fails"; a sampled loop is held
    against its continuous run instead.  Steps that a run did not record are made again, from each
    recorded sample to the next.

    Args:
      scenario: what runs.
      run: a `Rollout` of it (one run or a batch), or a study (with `replay(i)`, `metrics`, `len`),
        whose runs that were not made are left out; simulated here if not given.
      duration, dt, method: of the simulation, if `run` is not given [s].
      worst: of a study, judge that many runs, those nearest to their bounds; None for all.

    Returns:
      A `Certificate`; over many runs each line is that of the run with the smallest margin.  It
      prints the lines that apply, and why the others do not in one sentence; its `lines` are all of
      them.

    Raises:
      ValueError: a law that states half of a claim; a run of another scenario, one that its own
        scenario, dt and method do not reproduce (or whose samples do not say how many steps it
        had), or arguments of the wrong kind.

    Source: Zhang & Yan 2024, Theorem 2 and its proof, (3.16)-(3.31).
    """
    scenario = canonical(scenario)
    if not checks.is_concrete(scenario):
        raise checks.fail(
            "scenario",
            "traced values",
            "numbers",
            "certify works on the host: call it outside jit, vmap and grad.",
        )
    own_law.stating_law(scenario)
    if run is None:
        every = 1 + checks.whole_steps(duration, dt) // CERTIFY_RECORDED
        run = simulate(scenario, duration=duration, dt=dt, method=method, record_every=every)
    worst = None if worst is None else checks.positive_integer("worst", worst)
    if isinstance(run, Rollout):
        if run.is_batch:
            _check_same_kind(scenario, run)
            on_host = jax.tree.map(np.asarray, run)
            return _many(((i, on_host[i]) for i in range(len(run))), len(run))
        _check_same(scenario, run)
        return _one(jax.tree.map(np.asarray, run))
    if hasattr(run, "replay") and hasattr(run, "metrics") and hasattr(run, "__len__"):
        indices = _worst_of(run, worst)
        return _many(
            ((i, jax.tree.map(np.asarray, _replayed(run, i))) for i in indices), len(indices)
        )
    raise checks.fail(
        "run",
        run,
        "a Rollout, a study or None",
        "Pass what ij.simulate or ij.monte_carlo returned.",
    )


def _check_same_kind(scenario: Scenario, run: Rollout) -> None:
    if not same_structure(scenario, run.scenario):
        raise checks.fail(
            "run",
            "a run of another kind of scenario",
            "a run of `scenario`",
            "Pass run.scenario as the scenario.",
        )


def _check_same(scenario: Scenario, run: Rollout) -> None:
    _check_same_kind(scenario, run)
    if not same_tree(scenario, run.scenario):
        raise checks.fail(
            "run",
            "a run of a scenario with other numbers",
            "a run of `scenario`",
            "Pass run.scenario as the scenario.",
        )


def _worst_of(study: Any, worst: int | None) -> list[int]:
    """The runs of a study that came nearest to their bounds, the nearest first, of those that were
    made.
    """
    count = len(study)
    made = np.broadcast_to(getattr(study, "made", True), (count,))
    if worst is None or worst >= np.sum(made):
        return np.flatnonzero(made).tolist()
    try:
        margin = np.asarray(study.metrics["xi_margin"])
    except KeyError:
        raise checks.fail(
            "run.metrics",
            list(study.metrics),
            "the metric xi_margin",
            "Run the study with metrics.Margin, or pass worst=None.",
        ) from None
    nearest = np.min(margin.reshape(count, -1), axis=1)
    order = np.argsort(np.nan_to_num(nearest, nan=-np.inf), kind="stable")
    return order[made[order]][:worst].tolist()


def _replayed(study: Any, index: int) -> Rollout:
    """One run of a study, with no more samples than memory should hold."""
    steps = (
        round(study.duration / study.dt)
        if hasattr(study, "duration") and hasattr(study, "dt")
        else 0
    )
    return (
        study.replay(index, record_every=1 + steps // CERTIFY_RECORDED)
        if steps > CERTIFY_RECORDED
        else study.replay(index)
    )


def _heading(scenario: Scenario) -> str:
    law = claims.law_of(scenario)
    parts = [type(law).__name__]
    if hasattr(law, "barrier"):
        parts.append(f"barrier {type(law.barrier).__name__}")
    if hasattr(law, "reading"):
        parts.append(f"reading {law.reading}")
    return ", ".join([*parts, f"observer {type(scenario.observer).__name__}"])


def _one(run: Rollout) -> Certificate:
    """The certificate of one run, its arrays on the host."""
    if run.scenario.sampling is not None:
        return _sampled(run)
    whole, stretches = look(run)
    parts, traces = [], []
    for trajectory in stretches:
        lines_there, shares = of_stretch(trajectory)
        parts.append(([*lines_there, *weighted_lines.of_stretch(trajectory)], shares))
        traces.append(_traces(trajectory))
    lines = with_rates(over_run(whole, parts), weighted_lines.rates(whole))
    joined = Traces(*map(np.concatenate, zip(*traces, strict=True)))
    return Certificate(
        _heading(run.scenario),
        lines,
        _numbers(whole),
        joined,
        joints=joint_names(run.scenario.plant, run.n),
    )


def with_rates(lines: list[Line], rates: list[Line]) -> tuple[Line, ...]:
    """The lines of a run, with the rates of the claim with weights before what follows from
    them.
    """
    first = next(
        (i for i, line in enumerate(lines) if line.name.startswith("weighted")), len(lines)
    )
    return (*lines[:first], *rates, *lines[first:])


def _sampled(run: Rollout) -> Certificate:
    """That of a run whose law is sampled: nothing is claimed of it, and it is held against the
    continuous run instead.
    """
    scenario, (every, steps) = run.scenario, grid(run)
    ideal = with_parts(scenario, sampling=None, sensor=sensors.Ideal(), actuator=actuators.Ideal())
    with notices.muted(SimulationWarning):
        continuous = simulate(
            ideal,
            duration=steps * float(run.dt),
            dt=float(run.dt),
            method=run.method,
            record_every=every,
        )
    beside = jax.tree.map(np.asarray, continuous)
    certificate = _one(beside)
    nothing: dict[str, Any] = dict.fromkeys(("margin", "value", "joint", "time", "first"))
    lines = tuple(
        dataclasses.replace(line, verdict=NOT_APPLICABLE, note=SAMPLED, **nothing)
        for line in certificate.lines
    )
    excess, margins = run.V - beside.V, [_margins(x) for x in (run, beside)]
    k, joint = int(np.argmax(excess)), int(np.argmin(margins[0] - margins[1]))
    measured = (
        Line("V2, sampled less continuous", "(3.12)", "max over t of V2 of this run less V2 of the continuous one", NOT_APPLICABLE,
             value=float(excess[k]), time=float(run.t[k]), note=MEASURED, counts=False),
        Line("margin, sampled less continuous", "(2.2)", "smallest distance to a bound, less that of the continuous run", NOT_APPLICABLE,
             value=float((margins[0] - margins[1])[joint]), unit="rad", joint=joint, note=MEASURED, counts=False),
    )  # fmt: skip
    nan = np.full(run.t.shape, np.nan)
    traces = Traces(*(nan for _ in Traces._fields))._replace(
        t=np.asarray(run.t), V=np.asarray(run.V), xi=np.asarray(run.xi), xi_bound=np.full(run.xi.shape, np.nan),
        e2=np.linalg.norm(run.e2, axis=1),
        f_tilde=np.linalg.norm(run.disturbance - run.disturbance_estimate, axis=1), held=np.ones(run.t.shape, bool),
    )  # fmt: skip
    return Certificate(
        _heading(scenario),
        (*lines, *measured),
        certificate.numbers,
        traces,
        joints=joint_names(scenario.plant, run.n),
    )


SAMPLED = "the loop is sampled, and Theorem 2 is about a law that runs at every instant"
MEASURED = "how far the sampled run is from the continuous one; no claim of the theorem"


def _margins(run: Rollout) -> np.ndarray:
    """Smallest distance of each joint to a bound at the recorded samples, (n,) [rad]."""
    return np.min(np.minimum(run.q - run.lower, run.upper - run.q), axis=0)


def _numbers(whole: Whole) -> dict[str, Any]:
    """The constants of the claim."""
    rho = {f"rho_{where}_case_{case}": value for (case, where), value in whole.rho.items()}
    return rho | {
        "case": whole.case,
        "F_m": whole.F_m,
        "F_d": whole.F_d,
        "rho2": whole.F_d**2 / 2,
        "V2_start": whole.V_ends[0],
        "V2_end": whole.V_ends[1],
        "lambda_min_run": whole.lambda_min,
        "lambda_max_run": whole.lambda_max,
        "lambda_min_box": whole.over_box.lambda_min,
        "lambda_max_box": whole.over_box.lambda_max,
        "lambda_searched": whole.over_box.searched,
        "q_of_lambda_max_box": whole.over_box.q_max,
        "jump_times": whole.jumps,
        "lambda_min_K2_over_M0_run": whole.slowest,
        **{
            f"{name}_weighted_case_{case}": x
            for case, found in whole.weights.items()
            for name, x in found._asdict().items()
        },
        "samples": whole.samples,
        "samples_left_out": whole.left_out,
    }


def _traces(trajectory: Trajectory) -> Traces:
    """What the figure shows of a stretch, at its recorded samples; NaN where there is no claim.

    Of a law that has only a claim of its own, V and the left side are those of that claim.
    """
    sample, proof, case = trajectory.sample, trajectory.proof, applicable_case(trajectory.whole)
    nothing = np.full(trajectory.t.shape, np.nan)
    envelope, left = (
        (nothing, nothing)
        if case is None
        else (trajectory.envelope[case].bound, left_side(trajectory, case))
    )
    bounds = (
        {"xi, by V1": np.full(sample.q.shape, np.nan), "e2": nothing, "f_tilde": nothing}
        if case is None
        else bounds_along(trajectory, envelope)
    )
    traces = Traces(
        t=trajectory.t,
        V=proof.V,
        envelope=envelope,
        left=np.where(proof.held, np.nan, left),
        dropped=proof.dropped_e2 + proof.dropped_f,
        xi=sample.xi,
        xi_bound=bounds["xi, by V1"],
        e2=np.linalg.norm(proof.e2, axis=1),
        e2_bound=bounds["e2"],
        f_tilde=np.linalg.norm(proof.f_tilde, axis=1),
        f_tilde_bound=bounds["f_tilde"],
        held=proof.held,
    )
    if case is None and own_law.applies(trajectory):
        left = np.where(proof.held, np.nan, own_law.left_side(proof.own))
        traces = traces._replace(V=proof.own.V, left=left, dropped=np.zeros_like(left))
    return Traces(*(x[trajectory.recorded] for x in traces))


def _many(
    runs: Iterable[tuple[int, Rollout]] | Iterator[tuple[int, Rollout]], count: int
) -> Certificate:
    """One certificate over many runs: each line is that of its worst run; the traces are those of
    the worst run of all.
    """
    if count == 0:
        raise checks.fail("run", "no runs", "at least one run")
    lines: dict[str, list[Line]] = {}
    judged: list[int] = []
    disbelieved: list[int] = []
    worst: tuple[tuple, int, Certificate] | None = None
    for index, run in runs:
        certificate = _one(run)
        judged.append(index)
        disbelieved += [] if believed(run) else [index]
        for line in certificate.lines:
            lines.setdefault(line.name, []).append(dataclasses.replace(line, run=index))
        badness = min(
            map(_badness, filter(lambda line: "inequality" in line.name, certificate.lines))
        )
        badness = min(badness, (0.0 if certificate.verdict == FAILS else 1.0, badness[1]))
        if worst is None or badness < worst[0]:
            worst = (badness, index, certificate)
    assert worst is not None
    merged = tuple(_worst_line(same, disbelieved) for same in lines.values())
    _, index, certificate = worst
    return Certificate(
        certificate.heading,
        merged,
        certificate.numbers,
        certificate.traces,
        tuple(judged),
        certificate.joints,
        index,
    )


def _badness(line: Line) -> tuple[float, float]:
    """Order of lines: failed first, then by margin, those that do not apply last; where there is no
    margin, by value downward.
    """
    rank = {FAILS: 0.0, NOT_APPLICABLE: 2.0}.get(line.verdict, 1.0)
    if line.margin is not None:
        return rank, line.margin
    return rank, np.inf if line.value is None else -line.value


def _worst_line(same: list[Line], disbelieved: list[int]) -> Line:
    """The line of the worst run, with a word on how many runs failed or had no claim.

    What is not judged in a run that is not to be believed does not hold in all runs.
    """
    worst = min(same, key=_badness)
    if worst.verdict == HOLDS:
        worst = next(
            (line for line in same if line.run in disbelieved and line.verdict == NOT_APPLICABLE),
            worst,
        )
    failed = sum(line.verdict == FAILS for line in same)
    absent = sum(line.verdict == NOT_APPLICABLE for line in same)
    notes = [f"fails in {failed} of {len(same)} runs"] if failed else []
    if 0 < absent < len(same):
        notes.append(f"not applicable in {absent} of {len(same)} runs")
    return dataclasses.replace(
        worst, note="; ".join([*notes, *([worst.note] if worst.note else [])])
    )

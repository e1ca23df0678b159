"""`certify`: checks one run, a batch of runs or a study against the claims about its loop.

`certify` checks what the caller passed and lists the runs. `_certificate_of` takes one run through
its summary and its segments (`summary`, which runs the engine), the lines of its claims (`claims`)
and the traces. `_over_runs` combines the certificates of many runs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from iblf_jax.certificates import lines
from iblf_jax.certificates.claims import claims_of, main_claim
from iblf_jax.certificates.claims.own import OWN
from iblf_jax.certificates.lines import FAILS, NOT_APPLICABLE, Line, Statement, measured
from iblf_jax.certificates.reconstruction import is_valid, time_grid
from iblf_jax.certificates.result import Certificate
from iblf_jax.certificates.summary import summarise
from iblf_jax.certificates.terms import adaptive_law, receives_q_dq
from iblf_jax.control import actuators, sensors
from iblf_jax.control.controllers import EventCompensated
from iblf_jax.control.controllers.event_compensated import excess
from iblf_jax.core import checks, notices
from iblf_jax.core.progress import announced
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.status import Status, has_flag
from iblf_jax.engine import takes_runs
from iblf_jax.engine.simulate import SimulationWarning, simulate
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario, canonical, with_history, with_parts
from iblf_jax.studies.study import Study
from iblf_jax.world import plants

MAX_RECORDED = 20_000
"""Largest number of recorded samples of a run that `certify` makes; the other steps are
reconstructed."""
DEFAULT_WORST = 16
"""Runs of a study that are checked if the caller does not say how many."""
SAMPLED = "the loop is sampled, and the claim is about a law that runs at every instant"
NOISY = (
    "the plant has process noise, and the claim is about its drift; a study with"
    " metrics.LyapunovValue estimates E[V]"
)
TRIGGERED = Statement(
    "event trigger",
    "(E.1)",
    "max over t of sum |e2_i| (delta_i |tau_i| + m_i), which held commands may add to V2'",
    "N m rad/s",
)
COMPENSATED = Statement(
    "event trigger, compensated",
    "(E.3)",
    "sum 0.557 epsilon_i, which held commands may add to V' at a check",
    "N m rad/s",
)
DELAYED = "the input has a delay, and the claim is about a torque that acts at once"

AT_CHECKS = "measured; it holds at the instants at which the condition of the trigger is checked"


@notices.each_warning_once
@announced("checking the conditions of the theorem along a run")
@takes_runs
def certify(
    scenario: Scenario,
    run: Rollout | Study | None = None,
    *,
    duration: float = 20.0,
    dt: float = 1e-3,
    method: str = "rk4",
    worst: int | None = DEFAULT_WORST,
) -> Certificate:
    """Checks every inequality of Theorem 2, or of (S.3), on a run, with margins.

        V2' + rho V2 - 1/2 |f'|^2 <= 0  at every step, and what follows from it       (3.17)-(3.31)

    `controllers.BarrierBackstepping`, on a plant in strict-feedback form or on a robot, is checked
    against the claim about V = sum w_i V_i, with d_tilde = d - d_hat of the run,

        V' <= -sum w_i decay_i - sum c_i w_i |s_i|^2 + dV/dx . d_tilde + dV/dd_hat . d_hat'    (S.3)

    and what follows from it: the decay of V and a bound on the error of every level.

    A law with `decays` is also checked against the settling time that these predict,

        E' <= -sum w_j rate_j(k_j(t, V_j)) V_j + g,   E = sum w_j V_j                         (D.2)

    A law that states a Lyapunov function V of its own and its decay W (`controllers.LyapunovLaw`)
    is checked against

        V' <= -W + T

    V', V2' and f' are exact: they are derivatives along the vector field of the whole loop, by
    forward-mode differentiation.  A law, an observer or a situation without a claim is "not
    applicable", never "fails"; a sampled loop is compared with its continuous run instead.  Steps
    that a run did not record are integrated again, from each recorded sample to the next.

    Args:
      scenario: the scenario.
      run: a `Rollout` of it (one run or a batch), or a study (with `replay(i)`, `metrics`, `len`),
        whose runs that were not made are ignored; simulated here if not given.
      duration, dt, method, runs_as: of the simulation, if `run` is not given [s].
      worst: of a study, check this many runs, those nearest to their bounds; None for all.

    Returns:
      A `Certificate`; over many runs each line is that of the run with the smallest margin.  It
      prints the lines that apply, and why the others do not in one sentence; its `lines` has all.
      Its first lines say how many of the runs have the flag INACCURATE, whose numbers are not
      reliable.

    Raises:
      ValueError: a law that states half of a claim; a run of another scenario, one that its own
        scenario, dt and method do not reproduce (or whose samples do not determine its number of
        steps), or arguments of the wrong kind.

    Source: Zhang & Yan 2024, Theorem 2 and its proof, (3.16)-(3.31); (S.3) as at the head of
      `iblf_jax.certificates.claims.levels`, (D.2) as at that of `claims.settling` there.
    """
    if isinstance(scenario, Rollout | Study):
        remedy = "Pass certify(scenario, run) or certify(scenario, study)."
        raise checks.fail("scenario", type(scenario).__name__, "a Scenario", remedy)
    scenario = canonical(scenario)
    if scenario.actuator.input_delay is not None:
        # The scenario gets as many past commands as the run has.
        step = run.dt if isinstance(run, Rollout | Study) else dt
        scenario = with_history(scenario, float(step))
    if not checks.is_concrete(scenario):
        remedy = "certify works on the host: call it outside jit, vmap and grad."
        raise checks.fail("scenario", "traced values", "numbers", remedy)
    OWN.why_not(scenario)  # refuses half of a claim before a run is made
    if run is None:
        every = 1 + checks.whole_steps(duration, dt) // MAX_RECORDED
        run = simulate(scenario, duration=duration, dt=dt, method=method, record_every=every)
    if worst is not None:
        worst = checks.positive_integer("worst", worst)
    if isinstance(run, Rollout):
        _check_same(scenario, run.scenario, numbers=not run.is_batch)
        run = _on_host(run)
        if not run.is_batch:
            return _certificate_of(run)
        return _over_runs((i, run[i]) for i in range(len(run)))
    if not isinstance(run, Study):
        remedy = "Pass what ij.simulate or ij.monte_carlo returned."
        raise checks.fail("run", run, "a Rollout, a study or None", remedy)
    _check_same(scenario, canonical(run.scenario), numbers=True)
    return _over_runs((i, _replayed(run, i)) for i in _nearest_to_bounds(run, worst))


# --- the runs ------------------------------------------------------------------------------------


def _on_host(run: Rollout) -> Rollout:
    """A run with NumPy arrays."""
    return jax.tree.map(np.asarray, run)


def _check_same(scenario: Scenario, of_run: Scenario, *, numbers: bool) -> None:
    """Raises ValueError for a run or a study of another scenario; the numbers of the runs of a
    batch may differ.
    """
    structure: Any = jax.tree.structure(scenario)
    got = ""
    if structure != jax.tree.structure(of_run):
        got = "a run of another kind of scenario"
    elif numbers:
        pairs = zip(jax.tree.leaves(scenario), jax.tree.leaves(of_run), strict=True)
        if not all(np.array_equal(a, b) for a, b in pairs):
            got = "a run of a scenario with other numbers"
    if got:
        remedy = "Pass run.scenario as the scenario."
        raise checks.fail("run", got, "a run of `scenario`", remedy)


def _nearest_to_bounds(study: Study, worst: int | None) -> list[int]:
    """The runs of a study that came nearest to their bounds, the nearest first, among those that
    were made.
    """
    count = len(study)
    made = study.made
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


def _replayed(study: Study, index: int) -> Rollout:
    """One run of a study on the host, with a bounded number of recorded samples."""
    options = {}
    steps = round(study.duration / study.dt)
    if steps > MAX_RECORDED:
        options["record_every"] = 1 + steps // MAX_RECORDED
    return _on_host(study.replay(index, **options))


# --- one run -------------------------------------------------------------------------------------


def _certificate_of(run: Rollout) -> Certificate:
    """The certificate of one run, its arrays on the host."""
    if run.scenario.process_noise is not None:
        return _certificate_by_comparison(run, "noisy", NOISY)
    if run.scenario.sampling is not None:
        return _certificate_by_comparison(run, "sampled", SAMPLED)
    if run.scenario.actuator.input_delay is not None:
        return _certificate_by_comparison(run, "delayed", DELAYED)
    scenario, main = run.scenario, main_claim(run.scenario)
    summary, segments = summarise(run, claims_of(scenario))
    assumptions: list[Line] = []
    at_steps: dict[str, list[Line]] = {claim.key: [] for claim in summary.claims}
    data: dict[str, list[Any]] = {claim.key: [] for claim in summary.claims}
    traces = []
    for segment in segments:
        for claim in summary.claims:
            assumptions += claim.assumptions(segment)
            at_steps[claim.key] += claim.lines(segment)
            data[claim.key].append(claim.segment_data(segment))
        traces.append(main.traces(segment))
    by_name = lines.merged(assumptions)
    for claim in summary.claims:
        by_name |= {line.name: line for line in claim.gain_lines(summary)}
    by_name |= lines.merged([line for claim in summary.claims for line in at_steps[claim.key]])
    for claim in summary.claims:
        # A list first: the lines of a claim do not read one another.
        last = list(claim.run_lines(summary, data[claim.key], by_name))
        by_name |= {line.name: line for line in last}
    numbers = {name: x for claim in summary.claims for name, x in claim.numbers(summary).items()}
    curves = (np.concatenate(parts) for parts in zip(*traces, strict=True))
    return Certificate(
        _heading_of(scenario),
        tuple(by_name.values()),
        numbers | {"samples": summary.samples, "samples_left_out": summary.excluded},
        type(traces[0])(*curves),
        joints=plants.component_names(scenario.plant),
        claim=main.in_words,
        levels=main.labels(scenario),
        inaccurate=_inaccurate(run),
    )


def _inaccurate(run: Rollout) -> int:
    """`Certificate.inaccurate` of one run."""
    return int(has_flag(int(run.status), Status.INACCURATE))


def _heading_of(scenario: Scenario) -> str:
    """Law, barriers, variant and observer, in words."""
    law = unwrapped(scenario.controller)
    adaptive = adaptive_law(scenario)
    parts = [type(law).__name__]
    if adaptive is not None:
        parts.insert(0, f"{type(adaptive).__name__} of {len(adaptive.parameters)}")
    if law.barrier is not None:
        parts.append(f"barrier {type(law.barrier).__name__}")
    if law.barriers:
        parts.append("barriers " + " ".join(type(x).__name__ for x in law.barriers))
    if law.variant:
        parts.append(f"variant {law.variant}")
    return ", ".join([*parts, f"observer {type(scenario.observer).__name__}"])


# --- one run of a sampled, delayed or noisy loop -------------------------------------------------


def _certificate_by_comparison(run: Rollout, kind: str, reason: str) -> Certificate:
    """The certificate of a run whose law is sampled, whose input has a delay or whose plant has
    noise: nothing is claimed about it, and it is compared with the run without these instead.

    Args:
      run: the run.
      kind: "sampled", "delayed" or "noisy".
      reason: why nothing is claimed.
    """
    scenario, grid = run.scenario, time_grid(run)
    ideal = with_parts(
        scenario,
        sampling=None,
        sensor=sensors.Ideal(),
        actuator=actuators.Ideal(),
        process_noise=None,
    )
    method = run.method
    if scenario.process_noise is not None:
        method = "heun"
    with notices.muted(SimulationWarning):
        simulated = simulate(
            ideal,
            duration=grid.duration,
            dt=float(run.dt),
            method=method,
            record_every=grid.record_every,
        )
    continuous = _on_host(simulated)
    certificate = _certificate_of(continuous)
    cleared: dict[str, Any] = dict.fromkeys(("margin", "value", "joint", "time", "first_broken"))
    unclaimed = tuple(
        dataclasses.replace(line, verdict=NOT_APPLICABLE, note=reason, **cleared)
        for line in certificate.lines
    )
    return dataclasses.replace(
        certificate,
        lines=(*unclaimed, *_compared(run, continuous, kind), *_trigger_lines(run)),
        traces=main_claim(scenario).unclaimed_traces(run),
        inaccurate=_inaccurate(run),
    )


def _compared(run: Rollout, continuous: Rollout, kind: str) -> tuple[Line, Line]:
    """The differences of V2 and of the margin between a run without claims and the continuous
    one.
    """
    about = f"how far the {kind} run is from the continuous one; no claim of the theorem"
    V_excess = run.V - continuous.V
    at = int(np.argmax(V_excess))
    margin_excess = _margins(run) - _margins(continuous)
    joint = int(np.argmin(margin_excess))
    by_V = Statement(
        f"V2, {kind} less continuous",
        "(3.12)",
        "max over t of V2 of this run less V2 of the continuous one",
    )
    by_margin = Statement(
        f"margin, {kind} less continuous",
        "(2.2)",
        "smallest distance to a bound, less that of the continuous run",
        "rad",
    )
    scale = f"{about}; the largest V2 of the continuous run is {np.max(continuous.V):.4g}"
    return (
        measured(by_V, scale, value=float(V_excess[at]), time=float(run.t[at])),
        measured(by_margin, about, value=float(margin_excess[joint]), joint=joint),
    )


def _trigger_lines(run: Rollout) -> tuple[Line, ...]:
    """What the held commands of an event trigger may add to V' at a check, for laws whose
    derivative of V along the input is e2, and for compensated ones.
    """
    scenario = run.scenario
    sampling, law = scenario.sampling, scenario.controller
    if sampling is None or sampling.trigger is None:
        return ()
    trigger = sampling.trigger
    if isinstance(law, EventCompensated):
        return (measured(COMPENSATED, AT_CHECKS, value=float(excess(law))),)
    inner = unwrapped(law)
    if not receives_q_dq(scenario) or law is not inner or inner.includes_e2:
        return ()
    if not isinstance(scenario.actuator, actuators.Ideal) or sampling.queue > 0:
        return ()  # the torque of the run is not the command that the trigger holds
    threshold = np.asarray(trigger.relative) * np.abs(run.tau) + np.asarray(trigger.absolute)
    added = np.sum(np.abs(run.e2) * threshold, axis=1)
    at = int(np.argmax(added))
    return (measured(TRIGGERED, AT_CHECKS, value=float(added[at]), time=float(run.t[at])),)


def _margins(run: Rollout) -> np.ndarray:
    """Smallest distance of each joint to a bound at the recorded samples, (n,) [rad]."""
    return np.min(np.minimum(run.q - run.lower, run.upper - run.q), axis=0)


# --- many runs -----------------------------------------------------------------------------------


def _over_runs(runs: Iterable[tuple[int, Rollout]]) -> Certificate:
    """One certificate over many runs: each line is that of its worst run; the traces are those of
    the worst run of all.
    """
    by_name: dict[str, list[Line]] = {}
    indices: list[int] = []
    invalid: list[int] = []
    inaccurate = 0
    worst: tuple[tuple[float, float], int, Certificate] | None = None
    for index, run in runs:
        certificate = _certificate_of(run)
        indices.append(index)
        inaccurate += certificate.inaccurate
        if not is_valid(run):
            invalid.append(index)
        for line in certificate.lines:
            by_name.setdefault(line.name, []).append(dataclasses.replace(line, run=index))
        rank = _rank(certificate)
        if worst is None or rank < worst[0]:
            worst = (rank, index, certificate)
    if worst is None:
        raise checks.fail("run", "no runs", "at least one run")
    _, worst_index, certificate = worst
    return dataclasses.replace(
        certificate,
        lines=tuple(lines.over_runs(same, invalid) for same in by_name.values()),
        runs=tuple(indices),
        worst_run=worst_index,
        inaccurate=inaccurate,
    )


def _rank(certificate: Certificate) -> tuple[float, float]:
    """Sort key of certificates, the worst first: one that fails, then by the margin of the
    inequality.
    """
    inequalities = (line for line in certificate.lines if line.is_inequality)
    worst = min(lines.rank(line, lines.OVER_RUNS) for line in inequalities)
    verdict = 0.0 if certificate.verdict == FAILS else 1.0
    return min(worst, (verdict, worst[1]))

"""The certificate of one run under a law that receives the levels of the plant: (S.3)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iblf_jax.certificates import law_claim_lines, level_lines, lines, settling
from iblf_jax.certificates.claims import adaptive_law
from iblf_jax.certificates.level_summary import (
    LEVELS,
    LevelSummary,
    growth_along,
    level_summary,
)
from iblf_jax.certificates.lines import Line
from iblf_jax.certificates.result import Certificate, LevelLabel, LevelTraces
from iblf_jax.certificates.run_summary import Segment, in_two_passes
from iblf_jax.core.pytree import unwrapped
from iblf_jax.core.units import as_text
from iblf_jax.simulation.results import Rollout
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.world import plants

CLAIM = "the claim (S.3)"


def heading_of(scenario: Scenario) -> str:
    """Law, barriers, reading and observer, in words."""
    law = unwrapped(scenario.controller)
    adaptive = adaptive_law(scenario)
    parts = [type(law).__name__]
    if adaptive is not None:
        parts.insert(0, f"{type(adaptive).__name__} of {len(adaptive.parameters)}")
    if law.barrier is not None:
        parts.append(f"barrier {type(law.barrier).__name__}")
    if law.barriers:
        parts.append("barriers " + " ".join(type(x).__name__ for x in law.barriers))
    if law.reading:
        parts.append(f"reading {law.reading}")
    return ", ".join([*parts, f"observer {type(scenario.observer).__name__}"])


def level_certificate(run: Rollout) -> Certificate:
    """The certificate of one run, its arrays on the host."""
    summary, segments = in_two_passes(run, level_summary)
    checked: list[Line] = []
    own: list[Line] = []
    traces = []
    courses: list[settling.Course] = []
    has_settling = settling.has_settling_claim(run.scenario)
    for segment in segments:
        own += law_claim_lines.own_segment_lines(segment)
        checked += level_lines.segment_lines(segment)
        traces.append(_traces(segment))
        if has_settling:
            growth = growth_along(segment.proof.claim)
            courses.append(settling.course_of(segment, segment.proof.V, growth))
    return Certificate(
        heading_of(run.scenario),
        (
            *level_lines.run_lines(summary),
            *lines.merged(checked).values(),
            *settling.settling_lines(summary, courses, summary.why_not, 0.0),
            *lines.merged(own).values(),
        ),
        _numbers(summary),
        LevelTraces(*map(np.concatenate, zip(*traces, strict=True))),
        joints=plants.component_names(run.scenario.plant),
        claim=CLAIM,
        levels=_labels(run.scenario),
    )


def _numbers(summary: LevelSummary) -> dict[str, Any]:
    """The constants of the claim."""
    return {
        "rho": summary.rho,
        "rho2": summary.rho2,
        "V_start": summary.V_ends[0],
        "V_end": summary.V_ends[1],
        "d_largest": summary.d_largest,
        "d_tilde_largest": summary.d_tilde_largest,
        "jump_times": summary.jumps,
        "samples": summary.samples,
        "samples_left_out": summary.excluded,
    }


def _labels(scenario: Scenario) -> tuple[LevelLabel, ...]:
    """The levels of the model, in words."""
    plant = plants.as_plant(scenario.model)
    *units, _ = plants.units_of(plant)
    named = zip(plants.level_names(plant), units, strict=True)
    labels = []
    for level, (name, unit) in enumerate(named, start=1):
        bounded = scenario.context.bounds[level - 1] is not None
        labels.append(LevelLabel(name, as_text(unit), bounded))
    return tuple(labels)


def _traces(segment: Segment) -> LevelTraces:
    """The curves of the figure along a segment, at its recorded samples; NaN where there is no
    claim.  For a law that has only a claim about itself, V and the left side are those of that
    claim.
    """
    summary, proof = segment.summary, segment.proof
    nan = np.full(segment.t.shape, np.nan)
    traces = LevelTraces(
        t=segment.t,
        V=proof.V,
        envelope=nan,
        left=nan,
        disturbance_terms=nan,
        error=np.full(proof.d.shape, np.nan),
        error_bound=np.full(proof.d.shape, np.nan),
        d_tilde=np.linalg.norm(proof.d_tilde, axis=2),
        excluded=proof.excluded,
    )
    if proof.claim:
        traces = traces._replace(error=level_lines.errors(segment))
    if not summary.why_not:
        envelope = segment.envelopes[LEVELS].bound
        traces = traces._replace(
            envelope=envelope,
            left=np.where(proof.excluded, np.nan, level_lines.left_side(proof.claim)),
            disturbance_terms=proof.claim.disturbance_terms + proof.claim.lag,
            error_bound=level_lines.error_bounds(segment, envelope),
        )
    elif summary.claims.own is not None and not law_claim_lines.why_not_own(summary):
        left = np.where(proof.excluded, np.nan, law_claim_lines.own_left_side(proof))
        traces = traces._replace(V=proof.own.V, left=left)
    return LevelTraces(*(x[segment.recorded] for x in traces))


def unclaimed_level_traces(run: Any) -> LevelTraces:
    """The curves of a run, its arrays on the host, of which nothing is claimed."""
    nan = np.full(run.t.shape, np.nan)
    order = plants.order_of(run.scenario.model)
    error = np.full((*run.t.shape, order, run.n), np.nan)
    error[:, 0] = run.xi
    return LevelTraces(
        t=run.t,
        V=run.V,
        envelope=nan,
        left=nan,
        disturbance_terms=nan,
        error=error,
        error_bound=np.full_like(error, np.nan),
        d_tilde=np.full((*run.t.shape, order), np.nan),
        excluded=np.ones(run.t.shape, bool),
    )

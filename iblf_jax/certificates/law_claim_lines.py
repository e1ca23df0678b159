"""The lines of a certificate about the claim that a law states about itself (`claims`)."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from iblf_jax.certificates.claims import states_disturbance_terms
from iblf_jax.certificates.decay_lines import check_steps
from iblf_jax.certificates.level_terms import LEVEL_TERMS, is_about_levels
from iblf_jax.certificates.lines import (
    OWN_INEQUALITY,
    Line,
    Statement,
    not_applicable,
)
from iblf_jax.certificates.proof_terms import GENERAL_TERMS
from iblf_jax.certificates.run_summary import (
    Segment,
)
from iblf_jax.control.actuators import Ideal
from iblf_jax.core import checks

TORQUE_OF_ESTIMATES = " + dV/dq' . M0^-1 (tau(x_hat) - tau(x))"
"""What the error of estimated levels adds to T."""
OWN_ROUNDING = 8.0
"""Relative errors of the derivatives of a law's own V, in those of their terms."""


def why_not_own(summary: Any) -> str:
    """Why the law's claim about itself does not apply to a run; "" if it does."""
    actuator = summary.run.scenario.actuator
    if not isinstance(actuator, Ideal):
        about = "the law's own claim is about a torque that acts as it is commanded"
        return f"{about}, not about {checks.with_article(type(actuator).__name__)}"
    reason = _why_not_with_estimates(summary.run.scenario, summary.claims.own)
    if reason:
        return reason
    if summary.excluded == summary.samples:
        return f"{summary.why_excluded} all the time"
    return summary.why_invalid  # type: ignore[no-any-return]


def _why_not_with_estimates(scenario: Any, law: Any) -> str:
    """Why the law's claim does not apply to estimated levels; "" if it does.

    The claim is about a measured state.  For a law of robots without a state of its own and with
    the general T, the error of the estimates acts through the torque alone, which T then contains.
    """
    if not scenario.loop.observer.completes:
        return ""
    kind = type(scenario.observer).__name__
    about = f"the law's own claim is about a measured state, and {kind} estimates levels"
    if is_about_levels(scenario):
        return about
    if states_disturbance_terms(law):
        return f"{about}; the T that the law states does not contain their error"
    start = jax.eval_shape(law.init, scenario.initial.q, scenario.initial.dq, scenario.context)
    if jax.tree.leaves(start):
        return f"{about}, which act on the law's own state"
    return ""


def own_left_side(proof: Any) -> np.ndarray:
    """V' + W - T, which must not be positive, (T,)."""
    return proof.own.dV + proof.own.decay - proof.own.disturbance_terms


def own_segment_lines(segment: Segment) -> list[Line]:
    """The lines of the law's claim about itself for one segment; none for a law without one."""
    summary, proof, law = segment.summary, segment.proof, segment.summary.claims.own
    if law is None:
        return []
    own = proof.own
    states_terms = states_disturbance_terms(law)
    general = LEVEL_TERMS if is_about_levels(summary.run.scenario) else GENERAL_TERMS
    right_side = "what the law states" if states_terms else general
    if summary.run.scenario.loop.observer.completes:
        right_side += TORQUE_OF_ESTIMATES
    decay = "W >= 0: the decay that the law states"
    inequality = f"V' <= -W + T,  T: {right_side}"
    # Near 0, V and W are differences of numbers as large as their largest values.
    checked = (
        (Statement("own V", "own", "V >= 0", "1"), own.V, np.max(np.abs(own.V))),
        (Statement("own decay", "own", decay, "1/s"), own.decay, np.max(np.abs(own.decay))),
        (Statement(OWN_INEQUALITY, "own", inequality, "1/s"), -own_left_side(proof), own.size),
    )
    reason = why_not_own(summary)
    if reason:
        return [not_applicable(statement, reason) for statement, _, _ in checked]
    note = ""
    if summary.excluded:
        note = (
            f"{summary.excluded} of {summary.samples} samples are excluded: {summary.why_excluded}"
        )
    return [
        check_steps(segment, statement, margins, OWN_ROUNDING * summary.eps * sizes, note=note)
        for statement, margins, sizes in checked
    ]

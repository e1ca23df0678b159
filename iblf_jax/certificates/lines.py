"""The lines of a certificate: each inequality of Theorem 2 held against one run, stretch by
stretch.

Assumptions, gain conditions and rates come first, then the differential inequality, which is
checked at every sample; then what follows from it by integration: the envelope of V2 and the bounds
on xi, e2 and f_tilde.  For readings with a gap in their proof, the dropped terms are measured
beside the margin that the proof leaves for them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates import claims, own_law, weighted
from iblf_jax.certificates.result import FAILS, HOLDS, NOT_APPLICABLE, SEEN_ONLY, Line
from iblf_jax.certificates.trajectory import Trajectory, Whole
from iblf_jax.control.controllers import FullState
from iblf_jax.core.status import Status
from iblf_jax.engine.plan import CERTIFY_STRETCH
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import has

CONDITION = {1: "(3.17)", 2: "(3.25)"}
RHO = {1: "(3.19)", 2: "(3.27)"}
INEQUALITY = {1: "(3.18)", 2: "(3.26)"}
ENVELOPE = {1: "(3.20)", 2: "(3.28)"}
XI_BOUND = {1: "(3.22)", 2: "(3.30)"}
BOUNDS = {1: "(3.23)", 2: "(3.31)"}
LEFT = {1: "V2' + rho V2 <= 0", 2: "V2' + rho V2 - |f'|^2/2 <= 0"}
ENVELOPED = {1: "V2(t) <= V2(0) exp(-rho t)", 2: "V2(t) <= V2(0) exp(-rho t) + rho2/rho"}

Description = dict[str, Any]
"""The fields of a line that do not depend on the run."""
NO_BOUND = "the barrier states no bound on xi from V1"


ASSUMED = (
    "f bounded",
    "f' bounded",
    "reference inside",
    "start inside",
    "alpha inside",
    "start speed inside",
)
"""Lines that come before those of the gains."""


def over_run(whole: Whole, parts: Iterable[tuple[list[Line], dict[str, float]]]) -> list[Line]:
    """Every line of the certificate of one run, in the theorem's order, from those of its stretches
    (`of_stretch`).
    """
    found: dict[str, list[Line]] = {}
    largest: dict[str, float] = {}
    for lines, shares in parts:
        for line in lines:
            found.setdefault(line.name, []).append(line)
        for name, share in shares.items():
            largest[name] = max(share, largest.get(name, 0.0))
    merged = {name: _worst(same) for name, same in found.items()}
    for name, share in largest.items():
        merged[name] = dataclasses.replace(
            merged[name], note=f"at most {100 * share:.3g} % of that margin at one instant"
        )
    constant = [*gains(whole), *(line for case in claims.CASES for line in rates(whole, case))]
    first = [merged.pop(name) for name in ASSUMED if name in merged]
    return [*first, *constant, *merged.values()]


def _worst(same: list[Line]) -> Line:
    """One line from those of the stretches: failed before not applicable before held, then the
    smallest margin; the largest value.
    """
    rank = {FAILS: 0, NOT_APPLICABLE: 1, HOLDS: 2}

    def order(line: Line) -> tuple[float, float]:
        if line.margin is not None:
            return rank[line.verdict], line.margin
        return rank[line.verdict], np.inf if line.value is None else -line.value

    worst = min(same, key=order)
    values = [line.value for line in same if line.value is not None]
    broken = [line.first for line in same if line.first is not None]
    worst = dataclasses.replace(worst, first=min(broken, default=None))
    return (
        dataclasses.replace(worst, value=max(values))
        if worst.value is not None and values
        else worst
    )


def of_stretch(trajectory: Trajectory) -> tuple[list[Line], dict[str, float]]:
    """The lines that are about instants, for one stretch, and the largest share that each dropped
    term has of its margin there.
    """
    lines = [*assumptions(trajectory), *own_law.lines(trajectory, judged)]
    if is_full(trajectory.whole):
        lines += [*full_assumptions(trajectory), step_inequality(trajectory)]
    lines += [inequality(trajectory, case) for case in claims.CASES]
    lines += [envelope(trajectory, case) for case in claims.CASES]
    terms, shares = dropped(trajectory)
    return [*lines, *bounds(trajectory), *terms, *conclusions(trajectory)], shares


def is_full(whole: Whole) -> bool:
    """Whether the law bounds velocities too, with a claim of its own."""
    return isinstance(claims.law_of(whole.run.scenario), FullState)


def why_not(whole: Whole, case: int) -> str:
    """Why the claim of a case does not apply to this run; "" if it does."""
    if whole.no_claim or whole.no_run:
        return whole.no_claim or whole.no_run
    if case == 1 and whole.case == 2:
        return f"case 1 is for f' = 0; here |f'| reaches {whole.F_d:.4g} N m/s, see case 2"
    if not whole.rho[case, "run"] > 0:
        return f"the gain conditions {'(F.3)' if is_full(whole) else CONDITION[case]} are not met"
    if whole.left_out == whole.samples:
        return "the guard or a torque limit was at work all the time"
    return ""


def why_not_weighted(whole: Whole, case: int) -> str:
    """Why the claim with weights (`weighted`) of a case does not apply to this run; "" if it
    does.
    """
    if not weighted.is_stated(whole.run.scenario):
        return "the claim with weights is about the corrected law with a momentum observer"
    if whole.no_run:
        return whole.no_run
    if case == 1 and whole.case == 2:
        return f"case 1 is for f' = 0; here |f'| reaches {whole.F_d:.4g} N m/s, see case 2"
    if case not in whole.weights:
        return "the numbers of the run are not finite"
    if whole.left_out == whole.samples:
        return "the guard or a torque limit was at work all the time"
    return ""


def weighted_case(whole: Whole) -> int | None:
    """The case whose claim with weights applies to the run: the stronger one that does, or None."""
    return next((case for case in claims.CASES if not why_not_weighted(whole, case)), None)


def replaces_the_papers(whole: Whole) -> bool:
    """Whether the claim with weights replaces the paper's own: the barriers have other weights than
    1.
    """
    return weighted.has_other_weights(whole.run.scenario) and weighted_case(whole) is not None


NOT_NEEDED = (
    "the paper's own envelope of V2 is lost, stability is not: the claim with weights (W.1) does"
    " not need it"
)


def _of_the_papers(whole: Whole, line: Line) -> Line:
    """A line that only the paper's own envelope needs; where the claim with weights replaces it, it
    does not decide the verdict.
    """
    if line.verdict != FAILS or weighted_case(whole) is None:
        return line
    note = "; ".join(x for x in (NOT_NEEDED, line.note) if x)
    return dataclasses.replace(
        line, counts=line.counts and not replaces_the_papers(whole), note=note
    )


def applicable_case(whole: Whole) -> int | None:
    """The case whose bounds apply to the run: the stronger one that does, or None."""
    return next((case for case in claims.CASES if not why_not(whole, case)), None)


def left_side(trajectory: Trajectory, case: int) -> np.ndarray:
    """The left side of the differential inequality at every step, (T,) [1/s]."""
    proof = trajectory.proof
    left = proof.dV + trajectory.whole.rho[case, "run"] * proof.V
    return left if case == 1 else left - 0.5 * np.sum(proof.df**2, axis=1)


def judged(
    trajectory: Trajectory,
    margins: np.ndarray,
    tolerances: np.ndarray | float,
    description: Description,
) -> Line:
    """A line from margins at every step, (T,) or (T, n), with NaN where nothing is claimed."""
    if np.all(trajectory.proof.held):
        return Line(verdict=HOLDS, margin=np.inf, **description)
    margins = np.asarray(margins, float)
    tolerances = np.broadcast_to(np.asarray(tolerances, float), margins.shape)
    claimed = ~(
        trajectory.proof.held
        if margins.ndim == 1
        else np.broadcast_to(trajectory.proof.held[:, None], margins.shape)
    )
    broken = claimed & ~(margins >= -tolerances)
    watched = np.where(
        broken if np.any(broken) else claimed, np.nan_to_num(margins, nan=-np.inf), np.inf
    )
    place = np.unravel_index(np.argmin(watched), margins.shape)
    rows = np.flatnonzero(broken.reshape(margins.shape[0], -1).any(axis=1))
    return Line(
        verdict=FAILS if rows.size else HOLDS,
        first=float(trajectory.t[rows[0]]) if rows.size else None,
        margin=float(margins[place]),
        tolerance=float(tolerances[place]),
        time=float(trajectory.t[place[0]]),
        joint=int(place[1]) if margins.ndim == 2 else None,
        **description,
    )


def excluded(whole: Whole) -> str:
    """What was left out of a line, and where claims start anew, in words."""
    notes = []
    if whole.left_out:
        why = (
            "alpha was outside, or the guard or a torque limit at work"
            if is_full(whole)
            else "the guard or a torque limit was at work"
        )
        notes.append(f"{whole.left_out} of {whole.samples} samples are left out: {why}")
    if whole.jumps.size:
        notes.append(
            f"f jumps at t = {', '.join(f'{x:.4g}' for x in whole.jumps)} s, and the claim starts"
            " anew there"
        )
    return "; ".join(notes)


def assumptions(trajectory: Trajectory) -> list[Line]:
    """Bounds of Assumption 1 along the run, and feasibility of the reference, Assumption 2."""
    whole, sample, proof = trajectory.whole, trajectory.sample, trajectory.proof
    size, speed = np.linalg.norm(proof.f, axis=1), np.linalg.norm(proof.df, axis=1)
    lines = []
    for name, statement, values, unit in (
        ("f bounded", "|f| <= F_m", size, "N m"),
        (
            "f' bounded",
            "|f'| <= F_d between jumps",
            speed if whole.case == 2 else 0.0 * speed,
            "N m/s",
        ),
    ):
        at = int(np.argmax(np.nan_to_num(values, nan=np.inf)))
        jumps = (
            ""
            if name == "f bounded" or not whole.jumps.size
            else f"Assumption 1 is broken by a jump of f: {excluded(whole)}"
        )
        verdict = HOLDS if np.all(np.isfinite(values)) else FAILS
        lines.append(
            Line(
                name,
                "Assumption 1",
                statement,
                verdict,
                value=float(values[at]),
                unit=unit,
                time=float(trajectory.t[at]),
                note=jumps,
            )
        )
    room = np.minimum(sample.q_d - sample.lower, sample.upper - sample.q_d)
    row, joint = np.unravel_index(np.argmin(room), room.shape)
    feasible: Description = {
        "name": "reference inside",
        "equation": "Assumption 2",
        "statement": "k_lc < x_d < k_uc",
        "unit": "rad",
    }
    line = positive(
        feasible, float(room[row, joint]), joint=int(joint), time=float(trajectory.t[row])
    )
    # The status of a filter's run says nothing of this: its bounds are kept wherever the reference
    # goes.  The theorem needs it inside.
    lines.append(
        line if has(whole.run, "slack") else _as_status(whole, line, Status.INFEASIBLE_REFERENCE)
    )
    if trajectory.t[0] == 0:
        start = np.minimum(sample.q[0] - sample.lower[0], sample.upper[0] - sample.q[0])
        inside: Description = {
            "name": "start inside",
            "equation": "Theorem 2",
            "statement": "k_lc(0) < q(0) < k_uc(0)",
            "unit": "rad",
        }
        lines.append(positive(inside, float(start.min()), joint=int(start.argmin()), time=0.0))
    return lines


def positive(description: Description, margin: float, **more: Any) -> Line:
    """A line whose margin must be positive."""
    return Line(verdict=HOLDS if margin > 0 else FAILS, margin=margin, **description, **more)


def _as_status(whole: Whole, line: Line, flag: Status) -> Line:
    """A line about something that the run's status knows too: with the verdict of the status, which
    saw every step of the run itself.
    """
    verdict = FAILS if int(whole.run.status) & int(flag) else HOLDS
    if verdict == line.verdict:
        return line
    return dataclasses.replace(
        line, verdict=verdict, note="the verdict is that of the run's own status"
    )


def gains(whole: Whole) -> list[Line]:
    """The gain conditions (3.17) and (3.25)."""
    if is_full(whole):
        return _full_gains(whole)
    described = (
        ("K2", "(3.17)", "lambda_min(K2 - I/2) > 0", "K2", claims.LOWEST_K2, "N m s/rad"),
        ("kf, case 1", "(3.17)", "lambda_min(kf - I/2) > 0", "kf", claims.LOWEST_KF[1], "1/s"),
        ("kf, case 2", "(3.25)", "lambda_min(kf - I) > 0", "kf", claims.LOWEST_KF[2], "1/s"),
    )
    lines = []
    for name, equation, statement, field, lowest, unit in described:
        description: Description = {
            "name": name,
            "equation": equation,
            "statement": statement,
            "unit": unit,
        }
        if whole.claim is None:
            lines.append(Line(verdict=NOT_APPLICABLE, note=whole.no_claim, **description))
            continue
        margins = np.asarray(getattr(whole.claim, field)) - lowest
        spare = name == "kf, case 2" and whole.case == 1
        note = "f' = 0 on this run, so case 1 is what counts" if spare else ""
        line = positive(
            description,
            float(margins.min()),
            joint=int(margins.argmin()),
            counts=not spare,
            note=note,
        )
        lines.append(_of_the_papers(whole, line))
    return lines


def _full_gains(whole: Whole) -> list[Line]:
    """What (F.3) asks of kf and c."""
    lines = []
    for case in claims.CASES:
        half = "" if case == 1 else " - 1/2"
        statement = f"lambda_min(kf){half} - 1/(4 c lambda_min(M0)^2) > 0"
        description: Description = {
            "name": f"kf and c, case {case}",
            "equation": "(F.3)",
            "statement": statement,
            "unit": "1/s",
        }
        if not isinstance(whole.claim, claims.FullClaim):
            lines.append(Line(verdict=NOT_APPLICABLE, note=whole.no_claim, **description))
            continue
        margin = 0.5 * float(
            claims.rho_terms(whole.claim, whole.lambda_max, case, whole.lambda_min)[2]
        )
        spare = case == 2 and whole.case == 1
        needed = np.asarray(whole.claim.kf).min() - claims.LOWEST_FULL[case]
        note = f"lambda_min(M0) = {whole.lambda_min:.4g} kg m^2 along the run"
        note += (
            f": c > {0.25 / (needed * whole.lambda_min**2):.4g} would do"
            if margin <= 0 < needed
            else ""
        )
        lines.append(
            positive(
                description,
                margin,
                counts=not spare,
                note="f' = 0 on this run, so case 1 is what counts" if spare else note,
            )
        )
    return lines


def rates(whole: Whole, case: int) -> list[Line]:
    """The rate rho of one case, with lambda_max(M0) along the run and over the admissible box."""
    lines = []
    for where in ("run", "box"):
        name = f"rho, case {case}" + ("" if where == "run" else ", over the box")
        description: Description = {"name": name, "equation": RHO[case], "unit": "1/s"}
        description["statement"] = (
            "rho = min(decay of V1, 2 (K2 - 1/2)/lambda_max(M0), 2 (kf -"
            f" {claims.LOWEST_KF[case]:g})) > 0"
        )
        if is_full(whole):
            description["equation"] = "(F.3)"
            half = "" if case == 1 else " - 1/2"
            description["statement"] = (
                f"rho = min(decay of V1, decay of phi, 2 (kf{half} - 1/(4 c lambda_min(M0)^2))) > 0"
            )
        reason = whole.no_claim or ("" if case == 2 or whole.case == 1 else why_not(whole, 1))
        if reason or whole.claim is None:
            lines.append(Line(verdict=NOT_APPLICABLE, note=reason, **description))
            continue
        there: Any = whole if where == "run" else whole.over_box
        largest, smallest = there.lambda_max, there.lambda_min
        terms = np.asarray(
            claims.rho_terms(whole.claim, jnp.asarray(largest), case, jnp.asarray(smallest))
        )
        second = "the decay rate of phi" if is_full(whole) else "K2 over lambda_max(M0)"
        least = ("the decay rate of V1", second, "kf and c" if is_full(whole) else "kf")[
            int(np.argmin(terms))
        ]
        eigenvalue = (
            f"lambda_min(M0) = {smallest:.4g} kg m^2"
            if is_full(whole)
            else f"lambda_max(M0) = {largest:.4g} kg m^2"
        )
        note = (
            eigenvalue
            + (f" ({whole.over_box.searched})" if where == "box" else "")
            + f"; set by {least}"
        )
        counts = not (case == 2 and whole.case == 1)
        line = positive(
            description,
            whole.rho[case, where],
            value=whole.rho[case, where],
            note=note,
            counts=counts,
        )
        lines.append(_of_the_papers(whole, line))
    return lines


def inequality(trajectory: Trajectory, case: int) -> Line:
    """The differential inequality, at every step."""
    description: Description = {
        "name": f"inequality, case {case}",
        "equation": INEQUALITY[case],
        "statement": LEFT[case],
        "unit": "1/s",
    }
    reason = why_not(trajectory.whole, case)
    if reason:
        return Line(verdict=NOT_APPLICABLE, note=reason, **description)
    tolerance = trajectory.whole.eps * (
        trajectory.proof.terms + trajectory.whole.rho[case, "run"] * trajectory.proof.V
    )
    return judged(
        trajectory,
        -left_side(trajectory, case),
        tolerance,
        {**description, "note": excluded(trajectory.whole)},
    )


def full_assumptions(trajectory: Trajectory) -> list[Line]:
    """What Assumption 2 and the start are to the velocities."""
    sample, proof = trajectory.sample, trajectory.proof
    row, joint = np.unravel_index(np.argmin(proof.full.room), proof.full.room.shape)
    inside: Description = {
        "name": "alpha inside",
        "equation": "(F.1)",
        "statement": "v_l < alpha < v_u",
        "unit": "rad/s",
    }
    line = positive(
        inside, float(proof.full.room[row, joint]), joint=int(joint), time=float(trajectory.t[row])
    )
    lines = [_as_status(trajectory.whole, line, Status.ALPHA_INFEASIBLE)]
    if trajectory.t[0] == 0:
        start = np.minimum(sample.dq[0] - sample.dq_lower[0], sample.dq_upper[0] - sample.dq[0])
        inside = {
            "name": "start speed inside",
            "equation": "(F.1)",
            "statement": "v_l(0) < q'(0) < v_u(0)",
            "unit": "rad/s",
        }
        lines.append(positive(inside, float(start.min()), joint=int(start.argmin()), time=0.0))
    return lines


def step_inequality(trajectory: Trajectory) -> Line:
    """The inequality of the two barriers, at every step: whatever kf and c are."""
    statement = "(V1 + phi)' + decay of V1 and phi - s2 . M0^-1 f_tilde + c |s2|^2 <= 0"
    description: Description = {
        "name": "barriers",
        "equation": "(F.2)",
        "statement": statement,
        "unit": "1/s",
    }
    whole, proof = trajectory.whole, trajectory.proof
    if whole.no_claim or whole.no_run:
        return Line(verdict=NOT_APPLICABLE, note=whole.no_claim or whole.no_run, **description)
    return judged(
        trajectory,
        -proof.full.left,
        whole.eps * proof.terms,
        {**description, "note": excluded(whole)},
    )


def envelope(trajectory: Trajectory, case: int) -> Line:
    """The envelope of V2, at every step."""
    description: Description = {
        "name": f"envelope, case {case}",
        "equation": ENVELOPE[case],
        "statement": ENVELOPED[case],
    }
    reason = why_not(trajectory.whole, case)
    if reason:
        return Line(verdict=NOT_APPLICABLE, note=reason, **description)
    upper = trajectory.envelope[case]
    return judged(
        trajectory,
        upper.bound - trajectory.proof.V,
        upper.tolerance,
        {**description, "note": excluded(trajectory.whole)},
    )


@jax.jit
def _xi_bound(scenario: Scenario, t: jax.Array, V: jax.Array) -> jax.Array | None:
    """The barrier's own bound on |xi_i| where w_i V1_i <= V, (T, n), or None if it states none."""
    law: Any = claims.law_of(scenario)
    stated = getattr(law.barrier, "xi_bound", None)
    return (
        None
        if stated is None
        else jax.vmap(lambda t, V: stated(V / law.weight, scenario.context.tube(t)))(t, V)
    )


def xi_bound_along(trajectory: Trajectory, V: np.ndarray) -> np.ndarray:
    """The barrier's bound on |xi_i| where w_i V1_i <= V, (T, n); NaN if it states none."""
    places = np.minimum(
        np.arange(CERTIFY_STRETCH), V.size - 1
    )  # one program for stretches of every size
    found = _xi_bound(
        trajectory.whole.run.scenario,
        trajectory.t[places],
        jnp.asarray(V[places], trajectory.t.dtype),
    )
    return (
        np.full(trajectory.sample.q.shape, np.nan) if found is None else np.asarray(found)[: V.size]
    )


@jax.jit
def _e2_bound(
    scenario: Scenario, t: jax.Array, q: jax.Array, dq: jax.Array, V: jax.Array
) -> jax.Array | None:
    """The velocity barrier's own bound on |xi2| where phi <= V, (T, n), or None if it states
    none.
    """
    law: Any = claims.law_of(scenario)
    stated = getattr(law.velocity_barrier, "xi_bound", None)
    return (
        None
        if stated is None
        else jax.vmap(lambda t, q, dq, V: stated(V, law.tubes(t, q, dq, scenario.context)[1]))(
            t, q, dq, V
        )
    )


def bounds_along(trajectory: Trajectory, V: np.ndarray) -> dict[str, np.ndarray]:
    """The bounds on |xi| (by the barrier, by (3.23)), |e2| and |f_tilde| where V2 <= V; (T, n) for
    xi, else (T,).
    """
    places = np.minimum(np.arange(CERTIFY_STRETCH), V.size - 1)
    weight = np.asarray(claims.law_of(trajectory.whole.run.scenario).weight)
    e2: dict[str, np.ndarray] = {"e2": np.sqrt(2 * V / trajectory.whole.lambda_min)}
    if is_full(trajectory.whole):
        sample = trajectory.sample
        stated = _e2_bound(
            trajectory.whole.run.scenario,
            trajectory.t[places],
            sample.q[places],
            sample.dq[places],
            jnp.asarray(V[places], trajectory.t.dtype),
        )
        by_phi = np.full(sample.q.shape, np.nan) if stated is None else np.asarray(stated)[: V.size]
        e2 = {
            "e2": np.linalg.norm(by_phi * trajectory.proof.full.bound, axis=1),
            "xi2, by phi": by_phi,
        }
    return e2 | {
        "xi, by V1": xi_bound_along(trajectory, V),
        "xi": np.sqrt(2 * V[:, None] / weight),
        "f_tilde": np.sqrt(2 * V),
    }


def bounds(trajectory: Trajectory) -> list[Line]:
    """The bounds on xi, e2 and f_tilde that follow from the envelope of the case at hand."""
    case = applicable_case(trajectory.whole)
    shown = case or trajectory.whole.case
    descriptions: list[Description] = [
        {
            "name": "xi, by V1",
            "equation": XI_BOUND[shown],
            "statement": "V1 <= Vbar: |xi_i| <= sqrt(1 - exp(-Vbar/w_i)), or as the barrier says",
        },
        {"name": "xi", "equation": BOUNDS[shown], "statement": "|xi_i| <= sqrt(2 Vbar/w_i)"},
        {
            "name": "e2",
            "equation": BOUNDS[shown],
            "statement": "|e2| <= sqrt(2 Vbar/lambda_min(M0))",
            "unit": "rad/s",
        },
        {
            "name": "f_tilde",
            "equation": BOUNDS[shown],
            "statement": "|f_tilde| <= sqrt(2 Vbar)",
            "unit": "N m",
        },
    ]
    if is_full(trajectory.whole):
        descriptions[2] = {
            "name": "xi2, by phi",
            "equation": "(F.3)",
            "statement": "phi <= Vbar: |xi2_i| as the velocity barrier says",
        }
    if case is None:
        reason = why_not(trajectory.whole, trajectory.whole.case)
        return [
            Line(verdict=NOT_APPLICABLE, note=reason, **description) for description in descriptions
        ]
    upper, proof = trajectory.envelope[case], trajectory.proof
    tight, wide = (
        bounds_along(trajectory, upper.bound),
        bounds_along(trajectory, upper.bound + upper.tolerance),
    )
    sizes = {"xi, by V1": np.abs(proof.xi), "xi": np.abs(proof.xi)}
    if is_full(trajectory.whole):
        sizes |= {"xi2, by phi": np.abs(proof.full.xi2)}
    sizes |= {
        "e2": np.linalg.norm(proof.e2, axis=1),
        "f_tilde": np.linalg.norm(proof.f_tilde, axis=1),
    }
    lines = []
    for description in descriptions:
        name = description["name"]
        reason = _no_xi_bound(tight) if name.startswith("xi") and not np.all(proof.held) else ""
        if reason and (name == "xi" or np.all(np.isnan(tight["xi, by V1"]))):
            lines.append(Line(verdict=NOT_APPLICABLE, note=reason, **description))
            continue
        if name == "xi2, by phi" and np.all(np.isnan(tight[name])):
            lines.append(
                Line(
                    verdict=NOT_APPLICABLE,
                    note="the velocity barrier states no bound on xi2 from phi",
                    **description,
                )
            )
            continue
        note = "; ".join(
            x for x in (f"Vbar is the envelope of case {case}", excluded(trajectory.whole)) if x
        )
        lines.append(
            judged(
                trajectory,
                tight[name] - sizes[name],
                wide[name] - tight[name],
                {**description, "note": note},
            )
        )
    return lines


def _no_xi_bound(tight: dict[str, np.ndarray]) -> str:
    """Why |xi| <= sqrt(2 V) does not follow for this barrier; "" if it does (xi^2/2 <= V1, Theorem
    1).
    """
    if np.all(np.isnan(tight["xi, by V1"])):
        return NO_BOUND
    stronger = tight["xi, by V1"] <= tight["xi"] * (1 + 1e-9)
    return (
        ""
        if np.all(stronger | np.isnan(tight["xi"]))
        else "xi^2/2 <= V1 (Theorem 1) is not so for this barrier"
    )


def dropped(trajectory: Trajectory) -> tuple[list[Line], dict[str, float]]:
    """The size of the terms that the printed proof drops, against the margin that it leaves, and
    their largest share of it.
    """
    law, proof, case = (
        claims.law_of(trajectory.whole.run.scenario),
        trajectory.proof,
        applicable_case(trajectory.whole),
    )
    described = (
        (
            "dropped term of the law",
            "(3.13)",
            "e2^T M0' e2/2 alone <= the margin that the proof leaves",
            proof.dropped_e2,
        ),
        (
            "dropped term of the observer",
            "(3.11)",
            "-f_tilde^T kf M0' q' alone <= the margin that the proof leaves",
            proof.dropped_f,
        ),
    )
    by_law = (
        "the claim is exact: the law uses C0 alpha"
        if getattr(law, "reading", "") == "corrected"
        else ""
    )
    by_law = (
        "the claim is exact: C0 q' is cancelled, and e2 weighed without M0"
        if is_full(trajectory.whole)
        else by_law
    )
    exact = (by_law, _exact_observer(trajectory))
    lines, shares = [], {}
    for (name, equation, statement, term), none_dropped in zip(described, exact, strict=True):
        description: Description = {
            "name": name,
            "equation": equation,
            "statement": statement,
            "unit": "1/s",
            "counts": False,
        }
        reason = (
            trajectory.whole.no_claim
            or trajectory.whole.no_run
            or none_dropped
            or ("" if case else why_not(trajectory.whole, trajectory.whole.case))
        )
        if reason or case is None:
            lines.append(Line(verdict=NOT_APPLICABLE, note=reason, **description))
            continue
        proven = proof.dropped_e2 + proof.dropped_f - left_side(trajectory, case)
        tolerance = trajectory.whole.eps * proof.terms
        free = ~proof.held
        shares[name] = float(np.max(np.where(free, term / np.maximum(proven, tolerance), 0.0)))
        largest = float(np.max(np.abs(term[free]), initial=0.0))
        lines.append(
            judged(trajectory, proven - term, tolerance, {**description, "value": largest})
        )
    return lines, shares


def _exact_observer(trajectory: Trajectory) -> str:
    return (
        "the claim is exact: the observer has momentum form"
        if type(trajectory.whole.run.scenario.observer).__name__ == "Momentum"
        else ""
    )


def conclusions(trajectory: Trajectory) -> list[Line]:
    """Every joint inside its bounds, and every velocity of a law that bounds them."""
    first = conclusion(trajectory)
    if not is_full(trajectory.whole):
        return [first]
    sample, whole = trajectory.sample, trajectory.whole
    room = np.minimum(sample.dq - sample.dq_lower, sample.dq_upper - sample.dq)
    at, joint = np.unravel_index(np.argmin(np.nan_to_num(room, nan=-np.inf)), room.shape)
    description: Description = {
        "name": "velocities inside",
        "equation": "(F.3)",
        "statement": "v_l < q' < v_u",
        "unit": "rad/s",
    }
    line = positive(
        description, float(room[at, joint]), joint=int(joint), time=float(trajectory.t[at])
    )
    line = _as_status(whole, line, Status.VELOCITY_VIOLATED)
    if applicable_case(whole) is None:
        line = dataclasses.replace(
            line, verdict=NOT_APPLICABLE, note=f"{SEEN_ONLY}{why_not(whole, whole.case)})"
        )
    return [first, line]


def conclusion(trajectory: Trajectory) -> Line:
    """Properties (I) and (II): every joint inside its bounds, at every step."""
    description: Description = {
        "name": "joints inside",
        "equation": "(I), (II)",
        "statement": "|xi_i| < 1: -k_l < e1 < k_u",
    }
    room = 1.0 - np.abs(trajectory.sample.xi)
    at, joint = np.unravel_index(np.argmin(np.nan_to_num(room, nan=-np.inf)), room.shape)
    case = applicable_case(trajectory.whole)
    line = positive(
        description, float(room[at, joint]), joint=int(joint), time=float(trajectory.t[at])
    )
    line = _as_status(trajectory.whole, line, Status.BOUND_VIOLATED)
    if case is None and replaces_the_papers(trajectory.whole):
        case = weighted_case(trajectory.whole)
    unclaimed = (
        case is not None
        and _xi_bound(trajectory.whole.run.scenario, trajectory.t[:1], trajectory.proof.V[:1])
        is None
    )
    if case is None or unclaimed:
        reason = NO_BOUND if unclaimed else why_not(trajectory.whole, trajectory.whole.case)
        note = f"{SEEN_ONLY}{reason})"
        return Line(**{**vars(line), "verdict": NOT_APPLICABLE, "note": note})
    return line

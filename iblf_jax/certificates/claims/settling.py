"""The settling time that follows from the decays of a law, and the lines of a certificate about it.

A law whose gains are k(t, V) (`iblf_jax.decays`) has, with E = sum w_j V_j over its levels and
joints,

    E' <= -sum_j w_j rate_j(k_j(t, V_j)) V_j + g                                              (D.2)

with g = T - sum c_i w_i |s_i|^2 of (S.3) for `BarrierBackstepping`; for `Backstepping` E = V2
without the term of f_tilde, and

    g = e2 . f_tilde (+ 1/2 e2^T M0' e2 in the printed variant)         `Backstepping`

The second step of `Backstepping` has V = W = 1/2 e2^T M0 e2 with w = 1 and
e2^T K2 e2 + 2 k2(t, W) W >= 2 (mu + k2(t, W)) W, mu = lambda_min(M0^-1 K2).

The levels exchange V, so that only its sum is known.  Let D(t, E) be the least value of the sum in
(D.2) over all V_j >= 0 with sum w_j V_j = E.  Then E(t) <= v(t) with

    v' = -D(t, v) + rho2,   v(0) = E(0),   rho2 = sup max(g, 0) along the run                 (D.3)

v reaches the band of the decays, min_j w_j band_j, at the predicted settling time; every V_j is
inside its own band then.  v at the latest of the prescribed times bounds E there.  D is found on a
grid of shares of E, one joint of one level after the other, and (D.3) is integrated by RK4 in ln v.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates.claims._base import Claim, MainClaim, check_steps
from iblf_jax.certificates.lines import Line, Role, Statement, join_notes, not_applicable
from iblf_jax.certificates.summary import ENERGY_ROUNDING, Segment, Summary
from iblf_jax.certificates.terms import TORQUE
from iblf_jax.control.controllers import Backstepping, BarrierBackstepping, TrackingLaw
from iblf_jax.control.controllers._base import decay_of
from iblf_jax.control.decays import Decay
from iblf_jax.control.decays._base import energy_gain
from iblf_jax.core import programs
from iblf_jax.core.pytree import unwrapped
from iblf_jax.simulation.scenario import Scenario

SHARES = 48
"""Number of intervals of the grid of shares of E."""
INTERVALS = (400, 20_000)
"""Least and largest number of steps of the integration of (D.3)."""
VANISHING = 1e-12
"""Share of E(0) at which the gain of a vanishing error is taken."""
RELATIVE_ERROR = 2e-3
"""Error of D and of the integration of (D.3), relative to the predicted value."""
TIME = Statement(
    "settling time", "(D.3)", "E <= band from the predicted time on, v' = -D(t, v) + rho2", "s"
)
AT_DEADLINE = Statement("prescribed time", "(D.3)", "E(T) <= v(T),  v' = -D(t, v) + rho2")

INEQUALITY = Statement(
    "inequality, decays",
    "(D.2)",
    "E' <= -sum w V1 rate(k1(t, V1)) - e2^T K2 e2 - 2 k2(t, W) W + e2 . f_tilde",
    "1/s",
    Role.INEQUALITY,
)


class Part(NamedTuple):
    """One level of a law in (D.2)."""

    decay: Decay
    gain: jax.Array
    """Constant gain, (n,) [1/s]."""
    weight: jax.Array
    """(n,)."""
    rate: Any
    """Decay rate of V for a gain, a function."""


def parts_of(law: Backstepping | BarrierBackstepping) -> list[Part]:
    """The levels of a law that have a barrier."""
    if isinstance(law, BarrierBackstepping):
        rows = zip(law.barriers, law.k, law.weights, strict=True)
        return [
            Part(decay_of(law, i), k, w, barrier.decay_rate)
            for i, (barrier, k, w) in enumerate(rows)
        ]
    rate = law.barrier.decay_rate
    return [Part(decay_of(law, 0), law.k1, law.weight, rate)]


def effective_rate(part: Part, t: jax.Array, V: jax.Array) -> jax.Array:
    """Decay rate of the V of each joint at a time and at these values, (n,) [1/s]."""
    return part.rate(part.decay.effective_gain(t, part.gain, V))  # type: ignore[no-any-return]


# --- the least decay of a sum -------------------------------------------------------------------


def least_decay(
    law: Backstepping | BarrierBackstepping, mu: jax.Array, t: jax.Array, E: jax.Array
) -> jax.Array:
    """D(t, E), ().

    Args:
      law: with decays.
      mu: smallest eigenvalue of M0^-1 K2, () [1/s], for `Backstepping`.
      t: time, () [s].
      E: sum of w_j V_j, ().
    """
    values = E * jnp.linspace(0.0, 1.0, SHARES + 1)
    rows = []
    for part in parts_of(law):

        def of_share(value, part=part):
            return effective_rate(part, t, value / part.weight) * value

        rows += list(jax.vmap(of_share)(values).T)
    if isinstance(law, Backstepping):
        decay = decay_of(law, 1)
        rows.append(jax.vmap(lambda W: 2.0 * (mu + energy_gain(decay, t, W, law.k1)) * W)(values))
    # Min-plus convolution: of a share m of E, the parts before have i and the next part m - i.
    share = np.arange(SHARES + 1)
    of_next = share[:, None] - share[None, :]
    least = rows[0]
    for row in rows[1:]:
        sums = least[None, :] + row[np.maximum(of_next, 0)]
        least = jnp.min(jnp.where(of_next >= 0, sums, jnp.inf), axis=1)
    return least[-1]


def predicted(
    law: Backstepping | BarrierBackstepping, mu: float, start: float, rho2: float, end: float
) -> tuple[np.ndarray, np.ndarray]:
    """Times from 0 to `end`, and the prediction v of (D.3) at them, by RK4 in ln v.

    Args:
      law: with decays.
      mu: as `least_decay`.
      start: E(0), > 0.
      rho2: of (D.3).
      end: end of the run [s].
    """
    number = partial(jnp.asarray, dtype=jax.tree.leaves(law)[0].dtype)
    fastest = max(
        float(_least_decay(law, number(mu), number(t), number(E))) / E
        for t in (0.0, end)
        for E in (start, VANISHING * start)
    )
    count = int(np.clip(np.ceil(end * fastest), *INTERVALS))
    constants = (law, number(mu), number(rho2), number(end / count))
    logarithms = [jnp.log(number(start))]
    for i in range(count):
        logarithms.append(_step(*constants, number(i), logarithms[-1]))
    return np.linspace(0.0, end, count + 1), np.exp(np.asarray(logarithms, float))


_least_decay = programs.jit(least_decay)


@programs.jit
def _step(
    law: Backstepping | BarrierBackstepping,
    mu: jax.Array,
    rho2: jax.Array,
    h: jax.Array,
    i: jax.Array,
    logarithm: jax.Array,
) -> jax.Array:
    """The step i of `predicted`."""

    def rate(t, logarithm):
        v = jnp.exp(logarithm)
        return (rho2 - least_decay(law, mu, t, v)) / v

    t = i * h
    k_1 = rate(t, logarithm)
    k_2 = rate(t + 0.5 * h, logarithm + 0.5 * h * k_1)
    k_3 = rate(t + 0.5 * h, logarithm + 0.5 * h * k_2)
    k_4 = rate(t + h, logarithm + h * k_3)
    return logarithm + h / 6.0 * (k_1 + 2.0 * k_2 + 2.0 * k_3 + k_4)


# --- the claim ----------------------------------------------------------------------------------


class Course(NamedTuple):
    """What the lines need of the steps of a segment or of a run, (T,) each."""

    t: np.ndarray
    total: np.ndarray
    """E, the sum of w_j V_j."""
    disturbance_gain: np.ndarray
    """g of (D.2)."""
    noise: np.ndarray
    """Rounding error of sqrt(2 E)."""
    excluded: np.ndarray


class Settling(Claim):
    """The settling time that decays of a law predict."""

    key: ClassVar[str] = "settling"

    def why_not(self, scenario: Scenario) -> str:
        """Why a law predicts no settling time; "" if it has a decay that is not exponential."""
        law: TrackingLaw = unwrapped(scenario.controller)
        if not isinstance(law, Backstepping | BarrierBackstepping):
            return f"(D.2) is about laws with decays, not about {type(law).__name__}"
        if law.filter is not None:
            return "(D.2) is about exact derivatives, and the law has filters"
        if law.addition:
            return f"(D.2) is about (S.2), and the law has {law.addition}"
        if any(part.rate(part.gain) is None for part in parts_of(law)):
            return "a barrier states no decay rate of its V"
        if all(decay.constant for decay in law.decays):
            return "the decays of the law are exponential"
        return ""

    def why_not_in_run(self, summary: Summary) -> str:
        """Why (D.2) does not apply to a run; "" if it does."""
        return _main_claim(summary).why_no_settling(summary)

    def segment_data(self, segment: Segment) -> Course:
        """The course of E along a segment."""
        terms = segment.terms
        eps = float(np.finfo(terms.V.dtype).eps)
        noise = ENERGY_ROUNDING * eps * terms.sqrt_V_size
        main, E = _main_claim(segment.summary), terms.V
        if not main.omits_f_tilde:
            E = E - 0.5 * np.sum(terms.d_tilde**2, axis=1)
        gain_term = main.disturbance_gain_term(segment)
        return Course(segment.t, E, gain_term, noise, terms.excluded)

    def lines(self, segment: Segment) -> list[Line]:
        """The inequality (D.2) at every step of a segment, with the gains of each instant, for
        `Backstepping`.
        """
        summary, terms = segment.summary, segment.terms
        if not isinstance(summary.law, Backstepping):
            return []
        why_not = self.why_not_in_run(summary)
        if why_not:
            return [not_applicable(INEQUALITY, why_not)]
        dissipation = terms.claims[TORQUE].dissipation
        rate = terms.dV - np.sum(terms.d_tilde * terms.dd_tilde, axis=1)
        tolerance = summary.eps * (terms.size + np.abs(dissipation))
        note = join_notes(summary.exclusion_note(), summary.restart_note("f"))
        margins = _main_claim(summary).disturbance_gain_term(segment) - rate - dissipation
        return [check_steps(segment, INEQUALITY, margins, tolerance, note=note)]

    def run_lines(
        self, summary: Summary, data: list[Any], lines: Mapping[str, Line]
    ) -> Iterable[Line]:
        """The lines about the settling time of a run."""
        law: Backstepping | BarrierBackstepping = summary.law
        course = Course(*map(np.concatenate, zip(*data, strict=True)))
        why_not = self.why_not_in_run(summary) or _why_not_from_the_start(summary, course)
        band = _band(law)
        # The latest time of the decays that state one.
        stated = [decay.deadline() for decay in law.decays]
        ends = [float(np.max(np.asarray(time))) for time in stated if time is not None]
        deadline = max(ends, default=np.inf)
        statements = []
        if np.isfinite(band):
            statements.append(TIME)
        if np.isfinite(deadline):
            statements.append(AT_DEADLINE)
        if why_not:
            return [not_applicable(statement, why_not) for statement in statements]
        rho2 = max(float(np.max(course.disturbance_gain)), 0.0)
        mu = float(getattr(summary.reductions, "mu", np.inf))  # levels have no K2
        times, v = predicted(law, mu, float(course.total[0]), rho2, float(course.t[-1]))
        found = []
        if np.isfinite(band):
            found.append(_time_line(course, times, v, band, rho2))
        if np.isfinite(deadline):
            found.append(_deadline_line(course, times, v, deadline, rho2))
        return found


SETTLING = Settling()


def _main_claim(summary: Summary) -> MainClaim:
    """The claim from whose terms a settling time follows."""
    return next(claim for claim in summary.claims if isinstance(claim, MainClaim))


def _why_not_from_the_start(summary: Summary, course: Course) -> str:
    """Why (D.3) does not hold from the start of a run on; "" if it does."""
    if np.any(course.excluded):
        return "the prediction is from t = 0 on, and the claim excludes some samples"
    if summary.jumps.size:
        return "the prediction is from t = 0 on, and the disturbance jumps within the run"
    if not course.total[0] > 0.0:
        return "the run starts without an error"
    return ""


def _band(law: Backstepping | BarrierBackstepping) -> float:
    """The least w_j band_j of the decays that state a band; infinite if none does."""
    found = [np.inf]
    for part in parts_of(law):
        stated = part.decay.band()
        if stated is not None:
            found.append(float(np.min(np.asarray(part.weight * stated))))
    if isinstance(law, Backstepping):
        stated = decay_of(law, 1).band()
        if stated is not None:
            found.append(float(np.min(np.asarray(stated))))
    return min(found)


def _time_line(course: Course, times: np.ndarray, v: np.ndarray, band: float, rho2: float) -> Line:
    """The time from which E is inside the band, and the predicted one."""
    note = f"band {band:.4g}, rho2 = {rho2:.4g}"
    reached = np.flatnonzero(v <= band)
    if not reached.size:
        reason = f"the prediction falls to {v.min():.4g} within the run, and not into the {note}"
        return not_applicable(TIME, reason)
    # From there backward v is above the band: ln v is interpolated over the last interval.
    last = slice(max(reached[0] - 1, 0), reached[0] + 1)
    time = float(np.interp(-np.log(band), -np.log(v[last]), times[last])) * (1.0 + RELATIVE_ERROR)
    outside = np.flatnonzero(course.total > band)
    entered = 0.0
    if outside.size:
        entered = np.inf
        if outside[-1] + 1 < course.t.size:
            entered = float(course.t[outside[-1] + 1])
    step = float(course.t[1] - course.t[0])
    margin = time - entered
    verdict = "holds" if margin >= -step else "fails"
    note = f"predicted {time:.4g} s, {note}"
    return TIME.line(verdict, margin=margin, tolerance=step, value=entered, note=note)


def _deadline_line(
    course: Course, times: np.ndarray, v: np.ndarray, deadline: float, rho2: float
) -> Line:
    """E at the prescribed time, and what is predicted for it."""
    at = int(np.searchsorted(course.t, deadline))
    if at >= course.t.size:
        return not_applicable(AT_DEADLINE, f"the run ends before T = {deadline:.4g} s")
    bound = float(np.exp(np.interp(course.t[at], times, np.log(v)))) * (1.0 + RELATIVE_ERROR)
    tolerance = 0.5 * (np.sqrt(2.0 * bound) + course.noise[at]) ** 2 - bound
    margin = bound - float(course.total[at])
    verdict = "holds" if margin >= -tolerance else "fails"
    note = f"T = {deadline:.4g} s, v(T) = {bound:.4g}, rho2 = {rho2:.4g}"
    return AT_DEADLINE.line(
        verdict,
        margin=margin,
        tolerance=float(tolerance),
        value=float(course.total[at]),
        time=float(course.t[at]),
        note=note,
    )

"""One run as the certificate sees it: evidence at every sample, the constants of the claim, and the envelope of V2.

    case 1:  V2(t) <= V2(s) exp(-rho (t - s)) for t >= s                                                                 (3.20)
    case 2:  V2(t) <= V2(s) exp(-rho (t - s)) + rho2/rho,   rho2 = F_d^2/2, F_d = sup |f'| over the run                  (3.28)

The claim holds from any instant s on.  So where f jumps (Assumption 1 is broken there), and where the guard or a torque limit was at
work, the envelope starts anew at the next sample.

A run is not the exact solution: the envelope is widened by the integrator's own error in V2 (`evidence.defect`), carried along at the
rate of the claim, and by rounding, so that V2 may be followed down to where it is only noise.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from iblf_jax.certificates import claims
from iblf_jax.certificates.box import Extremes, eigenvalues_over
from iblf_jax.certificates.evidence import along_run, defects, rounding
from iblf_jax.closed_loop import LoopState
from iblf_jax.scenario import Scenario
from iblf_jax.status import Status, describe

DISBELIEVED = Status.NOT_FINITE | Status.STEP_TOO_LARGE
NOISE = 32.0
"""Units of the last place by which sqrt(2 V2) may be off, relative to the sizes of its terms."""


class Envelope(NamedTuple):
    """The bound on V2 along a run, (T,) each; NaN where nothing is claimed."""

    bound: np.ndarray
    """Right-hand side of (3.20) or (3.28)."""
    tolerance: np.ndarray
    """What rounding and the integrator add to it."""


class Facts(NamedTuple):
    """One run, on the host, with everything that the lines are made of."""

    run: Any
    """The Rollout, its arrays on the host."""
    evidence: Any
    """Its Evidence, time axis first, on the host."""
    eps: float
    """Relative error put down to rounding."""
    no_claim: str
    """Why Theorem 2 claims nothing about this loop; "" if it does."""
    no_run: str
    """Why nothing can be said about this run; "" if something can."""
    jumps: np.ndarray
    """Times within the run at which f jumps [s]."""
    case: int
    """1 if f' = 0, else 2."""
    rho: dict[tuple[int, str], float]
    """The rate, by case and by where lambda_max was taken ("run", "box") [1/s]."""
    F_d: float
    box: Extremes
    claim: claims.Claim | None
    envelope: dict[int, Envelope]


def facts_of(run: Any) -> Facts:
    """Everything that the lines are made of, for one run with its arrays on the host."""
    scenario = run.scenario
    states = LoopState(run.q, run.dq, run.controller_state, run.observer_state)
    evidence = jax.tree.map(np.asarray, along_run(scenario, run.t, states))
    no_claim = claims.why_no_claim(scenario)
    constants = None if no_claim else claims.claim(scenario)
    box = eigenvalues_over(scenario.model, np.min(run.lower, axis=0), np.max(run.upper, axis=0))
    # With plant and model alike, f is the torque of the disturbance component: f' = 0 can be seen exactly.
    case = 1 if bool(np.all(evidence.steady)) and same_tree(scenario.plant, scenario.model) else 2
    F_d = 0.0 if case == 1 else float(np.max(np.linalg.norm(evidence.df, axis=1)))
    rates, envelopes = {}, {}
    jumps = _jumps(scenario, run.t)
    if constants is not None:
        defect = np.asarray(defects(scenario, run.t, states, run.dt, method=run.method))
        for each in claims.CASES:
            for where, largest in (("run", evidence.lambda_max.max()), ("box", box.lambda_max)):
                rates[each, where] = float(claims.rho(constants, largest, each))
            offset = 0.0 if each == 1 else F_d**2 / 2
            envelopes[each] = _envelope(run, evidence, defect, jumps, rates[each, "run"], offset)
    believed = not int(run.status) & int(DISBELIEVED)
    no_run = "" if believed else f"the run is not to be believed: {describe(int(run.status) & int(DISBELIEVED))}"
    eps = rounding(np.asarray(run.q).dtype)
    return Facts(run, evidence, eps, no_claim, no_run, jumps, case, rates, F_d, box, constants, envelopes)


def same_structure(one: Any, other: Any) -> bool:
    """Whether two pytrees have one structure."""
    structure: Any = jax.tree.structure(one)
    return bool(structure == jax.tree.structure(other))


def same_tree(one: Any, other: Any) -> bool:
    """Whether two pytrees have one structure and the same numbers."""
    return same_structure(one, other) and all(
        np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    )


def _jumps(scenario: Scenario, t: np.ndarray) -> np.ndarray:
    times = np.sort(np.ravel(np.asarray(scenario.disturbance.jump_times())))
    return times[(times > t[0]) & (times <= t[-1])]


def starts_of(t: np.ndarray, held: np.ndarray, jumps: np.ndarray) -> np.ndarray:
    """At which samples the envelope starts anew, (T,) bool: the first, those after a jump, those after a held one."""
    fresh = np.searchsorted(jumps, t[1:], side="right") > np.searchsorted(jumps, t[:-1], side="right")
    return np.concatenate([[True], fresh | held[:-1]])


def _envelope(run: Any, evidence: Any, defect: np.ndarray, jumps: np.ndarray, rate: float, rho2: float) -> Envelope:
    """The envelope of V2 and its tolerance along a run; NaN at held samples, and everywhere if the rate is not positive."""
    t, V, size = run.t, evidence.V, run.t.shape[0]
    bound, tolerance = np.full(size, np.nan), np.full(size, np.nan)
    if not rate > 0:
        return Envelope(bound, tolerance)
    noise = NOISE * float(np.finfo(V.dtype).eps) * evidence.V_terms
    steps = np.rint(np.diff(t) / float(run.dt))
    starts = starts_of(t, evidence.held, jumps)
    first, carried = 0, 0.0
    for k in range(size):
        if starts[k]:
            first, carried = k, 0.0
        else:
            carried = carried * np.exp(-rate * (t[k] - t[k - 1])) + steps[k - 1] * defect[k - 1]
        if not evidence.held[k]:
            bound[k] = V[first] * np.exp(-rate * (t[k] - t[first])) + rho2 / rate
            widened = np.sqrt(2 * (bound[k] + carried)) + noise[first] + noise[k]
            tolerance[k] = 0.5 * widened**2 - bound[k]
    return Envelope(bound, tolerance)

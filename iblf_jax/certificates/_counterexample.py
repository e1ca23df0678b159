"""Search for a start and gains at which the differential inequality of Theorem 2 is broken.

The inequality is a statement about states, so a counterexample is one state: the start of a
scenario. The proof leaves

    V2' - 1/2 |f'|^2 <= -Q,
    Q = sum_i rate_i V1_i + e2^T (K2 - I/2) e2 + f_tilde^T (kf - I) f_tilde >= rho V2,        (3.24)

and `counterexample` maximises g = (V2' - 1/2 |f'|^2) / Q at t = 0 over perturbations of the
scenario (`studies.perturbation_cube`), from many starting points, with the exact gradient. Where
the proof is exact, g never exceeds -1, whatever is varied. g > -1 breaks (3.24); g > 0 breaks the
claim itself, (3.18) and (3.26) for every rho > 0: V2 grows where the theorem claims a decrease. For
law and observer as printed such starts exist, because the terms that the proof drops grow with the
cube of the joint velocity, and Q with its square.

For `controllers.BarrierBackstepping` g compares both sides of (S.3) in the same way,

    g = (V' - T) / Q,   Q = sum w_i decay_i + sum c_i w_i |s_i|^2

with V = sum w_i V_i, and g is -1 for barriers that decay exactly, at most -1 for the others.

Points at which the scenario cannot run (a start outside its bounds, a negative mass), or at which
nothing is claimed (the guard or a torque limit is active), are no counterexamples and are skipped.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates.claims._base import Claim
from iblf_jax.certificates.claims.levels import LEVELS
from iblf_jax.certificates.claims.theorem import LOWEST_K2, LOWEST_KF, THEOREM
from iblf_jax.certificates.claims.two_cases import gains_of
from iblf_jax.certificates.eigenvalues import maximise
from iblf_jax.certificates.terms import TORQUE, Terms, receives_q_dq, terms_and_sample
from iblf_jax.core import checks
from iblf_jax.core.presentation import Content, Result
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.distributions import Perturbation
from iblf_jax.studies.perturbation_cube import Cube, unit_cube
from iblf_jax.studies.worst import Losses, WorstCaseSearch, search

EXCLUDED = "The guard or a torque limit is active at the start, where nothing is claimed."


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Counterexample(Result):
    """The largest growth that `counterexample` found."""

    scenario: Scenario
    parameters: dict[str, np.ndarray]
    """Path -> value."""
    growth: float
    """The largest g that was found; at most -1 where the proof is exact, positive where V2 grows
    against the claim."""

    def _content(self) -> Content:
        drawn = [f"  {path}: {value}" for path, value in self.parameters.items()]
        return [f"Counterexample(growth {self.growth:+.4g})", *drawn]


class ClaimOnStates(NamedTuple):
    """A claim that a start may break."""

    claim: Claim
    relative_rate: Callable[[Scenario, Terms], jax.Array]
    """The g of the head of this module, ()."""


def _rate_of_levels(scenario: Scenario, terms: Terms) -> jax.Array:
    """The rate (V' - T) / Q of (S.3)."""
    claim = terms.claims[LEVELS.key]
    rate = terms.dV - claim.disturbance_terms - claim.lag
    return rate / (claim.dissipation + claim.by_slopes)  # type: ignore[no-any-return]


def _rate_of_theorem(scenario: Scenario, terms: Terms) -> jax.Array:
    """The rate (V2' - 1/2 |f'|^2) / Q of (3.24)."""
    gains, e2, f_tilde = gains_of(scenario), terms.e[1], terms.d_tilde
    M0 = terms.claims[TORQUE].M0
    V1 = terms.V - 0.5 * (e2 @ (M0 @ e2) + f_tilde @ f_tilde)
    by_e2 = e2 @ ((gains.K2 - LOWEST_K2) * e2)
    by_f = f_tilde @ ((gains.kf - LOWEST_KF[2]) * f_tilde)
    Q = jnp.min(gains.decay_rate) * V1 + by_e2 + by_f
    return (terms.dV - 0.5 * terms.dd @ terms.dd) / Q  # type: ignore[no-any-return]


def _claim_of(scenario: Scenario) -> ClaimOnStates:
    """The claim about a scenario, whether or not it applies."""
    if receives_q_dq(scenario):
        return ClaimOnStates(THEOREM, _rate_of_theorem)
    return ClaimOnStates(LEVELS, _rate_of_levels)


def _relative_rate(scenario: Scenario) -> tuple[jax.Array, jax.Array]:
    """The relative rate g at the start of a scenario, (), and whether the claim excludes it."""
    t, state = jnp.zeros((), scenario.initial.q.dtype), initial_state(scenario)
    claim, relative_rate = _claim_of(scenario)
    terms, _ = terms_and_sample(scenario, t, state, (claim,))
    return relative_rate(scenario, terms), terms.excluded


@checks.known_keywords
def counterexample(
    scenario: Scenario,
    perturbations: Mapping[str, Perturbation],
    *,
    starts: int = 16,
    seed: int = 0,
) -> Counterexample:
    """Maximises V2' - 1/2 |f'|^2, relative to the -Q of the proof, over starts and gains.    (3.24)

    Args:
      scenario: a scenario about which Theorem 2 or (S.3) makes a claim.
      perturbations: path -> `factor`, `offset` or `value` of a bounded distribution, as in
        `ij.falsify`: what varies, and in which range; inadmissible points (a start outside its
        bounds) are skipped.
      starts: number of random points from which to ascend.
      seed: of the random points.

    Returns:
      The largest growth that was found, a counterexample if its `growth` is positive; its scenario
      can be run.

    Raises:
      ValueError: no claim to break, an unknown path, a perturbation without finite ends, or
        perturbations without an admissible point.
    """
    scenario = canonical(scenario)
    _check_claimed(scenario)
    starts = checks.positive_integer("starts", starts)
    seed = checks.positive_integer("seed", seed, least=0, most=2**32 - 1)
    cube = unit_cube(scenario, perturbations, signs=False)
    checks.fits_memory("starts", starts, 8.0 * 2 * cube.size)
    problem = WorstCaseSearch(cube, _losses_of(scenario, cube), starts, (seed,), EXCLUDED)
    worst = search(problem, _ascend)
    values = cube.values(jnp.asarray(worst.u, scenario.initial.q.dtype))
    found = {path: np.asarray(value) for path, value in values.items()}
    return Counterexample(with_parameters(scenario, found), found, -worst.loss)


def _check_claimed(scenario: Scenario) -> None:
    """Raises ValueError for a scenario about which neither Theorem 2 nor (S.3) makes a claim."""
    reason = _claim_of(scenario).claim.why_not(scenario)
    if reason:
        got = type(scenario.controller).__name__
        raise checks.fail("scenario", got, "a scenario with a claim", f"{reason}.")


def _losses_of(scenario: Scenario, cube: Cube) -> Callable[[np.ndarray], Losses]:
    """The function of a point u, (1, d), with -g and its gradient; infinite where the claim
    excludes the start.
    """

    def rate_at(u: jax.Array) -> tuple[jax.Array, jax.Array]:
        return _relative_rate(with_parameters(scenario, cube.values(u)))

    rate_and_gradient = jax.jit(jax.value_and_grad(rate_at, has_aux=True))

    def losses(u: np.ndarray) -> Losses:
        (g, excluded), gradient = rate_and_gradient(jnp.asarray(u[0], scenario.initial.q.dtype))
        loss = np.inf if excluded or not np.isfinite(g) else -float(g)
        return Losses(np.array([loss]), -np.asarray(gradient)[None], np.asarray([excluded]))

    return losses


def _ascend(problem: WorstCaseSearch) -> None:
    """Ascends from each starting point. Points that are not usable have a constant value below that
    of the start, from which the line search turns back.
    """
    size = problem.cube.size
    for start in problem.points():
        floor = -problem(start[None]).values[0] - 1.0

        def value_and_gradient(u: np.ndarray, floor: float = floor) -> tuple[float, np.ndarray]:
            if problem.cube.why_inadmissible(u):
                return floor, np.zeros(size)
            found = problem(u[None])
            if not np.isfinite(found.values[0]):
                return floor, np.zeros(size)
            return -found.values[0], -found.gradients[0]

        maximise(value_and_gradient, start, np.zeros(size), np.ones(size))

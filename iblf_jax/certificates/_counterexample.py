"""Search for a start and gains at which the differential inequality of Theorem 2 is broken.

The inequality is a statement about states, so a counterexample is one state: the start of a
scenario.  The proof leaves

    V2' - 1/2 |f'|^2 <= -Q,   Q = sum_i rate_i V1_i + e2^T (K2 - I/2) e2 + f_tilde^T (kf - I)
    f_tilde >= rho V2,           (3.24)

and `counterexample` climbs  g = (V2' - 1/2 |f'|^2) / Q  at t = 0 over perturbations of the scenario
(`studies.cube`), from many starting points, with the exact gradient.  Where the proof is exact g
never exceeds -1, whatever is varied.  g > -1 breaks (3.24); g > 0 breaks the claim itself, (3.18)
and (3.26) for every rho > 0: V2 grows where the theorem has it fall.  For law and observer as
printed such starts exist, because the terms dropped from the proof grow with the cube of the joint
velocity, and Q with its square.

What cannot be run (a start outside its bounds, a negative mass) and where nothing is claimed (the
guard or a torque limit at work) is no counterexample: such points are passed over.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates import claims
from iblf_jax.certificates.eigenvalues import maximise
from iblf_jax.certificates.proof_terms import terms_at
from iblf_jax.control.controllers import Backstepping
from iblf_jax.core import checks
from iblf_jax.simulation.closed_loop import initial_state
from iblf_jax.simulation.paths import with_parameters
from iblf_jax.simulation.scenario import Scenario, canonical
from iblf_jax.studies.cube import bounded
from iblf_jax.studies.distributions import Perturbation


class Counterexample(NamedTuple):
    """The worst that `counterexample` found."""

    scenario: Scenario
    parameters: dict[str, np.ndarray]
    """Path -> value."""
    growth: float
    """g, largest found; at most -1 where the proof is exact, positive where V2 grows against the
    claim."""


def relative_growth(scenario: Scenario) -> jax.Array:
    """The growth g = (V2' - 1/2 |f'|^2) / Q at the start of a scenario, ().
    (3.24)
    """
    return _growth(scenario)[0]


def _growth(scenario: Scenario) -> tuple[jax.Array, jax.Array]:
    """The growth at the start, and whether the guard or a torque limit is at work there."""
    seen = terms_at(scenario, jnp.zeros((), scenario.initial.q.dtype), initial_state(scenario))
    constants: Any = claims.claim(scenario)
    M0 = scenario.model.mass_matrix(scenario.initial.q)
    V1 = seen.V - 0.5 * (seen.e2 @ (M0 @ seen.e2) + seen.f_tilde @ seen.f_tilde)
    by_e2 = seen.e2 @ ((constants.K2 - claims.LOWEST_K2) * seen.e2)
    by_f = seen.f_tilde @ ((constants.kf - claims.LOWEST_KF[2]) * seen.f_tilde)
    return (seen.dV - 0.5 * seen.df @ seen.df) / (
        jnp.min(constants.decay) * V1 + by_e2 + by_f
    ), seen.held


@checks.renamed(ranges="perturbations")
def counterexample(
    scenario: Scenario,
    perturbations: Mapping[str, Perturbation],
    *,
    starts: int = 16,
    seed: int = 0,
) -> Counterexample:
    """Climbs to the start and gains at which V2' - 1/2 |f'|^2 is largest relative to -Q of the
    proof.                    (3.24)

    Args:
      scenario: a scenario for which Theorem 2 claims something.
      perturbations: path -> `factor`, `offset` or `value` of a bounded distribution, as in
        `ij.falsify`: what may vary, and between which ends; what is inadmissible in them (a start
          outside its bounds) is passed over.
      starts: from how many random points to climb.
      seed: of the random points.

    Returns:
      The worst that was found, a `Counterexample` if its `growth` is positive; its scenario can be
      run.

    Raises:
      ValueError: no claim to break, an unknown path, a perturbation without ends, perturbations in
        which nothing admissible was found.
    """
    scenario = canonical(scenario)
    reason = claims.why_no_claim(scenario)
    if not reason and not isinstance(claims.law_of(scenario), Backstepping):
        reason = (
            f"Q is Theorem 2's; {type(claims.law_of(scenario)).__name__} has a claim of its own"
        )
    if reason:
        raise checks.fail(
            "scenario", type(scenario.controller).__name__, "a scenario with a claim", reason + "."
        )
    starts, seed = (
        checks.positive_integer("starts", starts),
        checks.positive_integer("seed", seed, least=0, most=2**32 - 1),
    )
    cube = bounded(scenario, perturbations, signs=False)
    checks.fits("starts", starts, 8.0 * 2 * cube.size)
    growth = jax.jit(
        jax.value_and_grad(
            lambda u: _growth(with_parameters(scenario, cube.values(u))), has_aux=True
        )
    )
    best = (-np.inf, np.zeros(0))

    def seen(u):
        """Why a point is no answer, g and its gradient there; the best point is kept."""
        nonlocal best
        why = cube.refused(u)
        if why:
            return why, -np.inf, np.zeros(cube.size)
        (g, held), slope = growth(jnp.asarray(u, scenario.initial.q.dtype))
        if held or not np.isfinite(g):
            return (
                "The guard or a torque limit is at work at the start, where nothing is claimed.",
                -np.inf,
                np.zeros(cube.size),
            )
        best = max(best, (float(g), u.copy()), key=lambda pair: pair[0])
        return "", float(g), np.asarray(slope)

    def climb(u, worse):
        """What the ascent sees: beyond what is admissible a plain below its start, from which the
        line search turns back.
        """
        why, g, slope = seen(u)
        return (worse, slope) if why else (g, slope)

    for point in cube.admissible_points(starts, seed, lambda u: seen(u)[0]):
        worse = seen(point)[1] - 1.0
        maximise(
            lambda u, worse=worse: climb(u, worse), point, np.zeros(cube.size), np.ones(cube.size)
        )
    values = {
        path: np.asarray(value)
        for path, value in cube.values(jnp.asarray(best[1], scenario.initial.q.dtype)).items()
    }
    return Counterexample(with_parameters(scenario, values), values, best[0])

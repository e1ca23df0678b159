"""The claims about closed loops, one object each; `_base.Claim` is what they have in common.

========  ==========================================================  ==============
Theorem   the backstepping law with the observer (3.11)               (3.16)-(3.31)
Weighted  the same with free weights, for every positive gain         (W.1)-(W.3)
Matched   a law of order 2 whose gain c meets the estimation error    (F.1)-(F.3)
Levels    a law with a barrier on every level of a plant              (S.1)-(S.4)
Settling  the settling time that decays of a law predict              (D.2), (D.3)
OwnClaim  what a law states about itself                              own
========  ==========================================================  ==============
"""

from __future__ import annotations

from iblf_jax.certificates.claims._base import Claim as Claim
from iblf_jax.certificates.claims._base import MainClaim
from iblf_jax.certificates.claims.levels import LEVELS
from iblf_jax.certificates.claims.matched import MATCHED
from iblf_jax.certificates.claims.own import OWN
from iblf_jax.certificates.claims.settling import SETTLING
from iblf_jax.certificates.claims.theorem import THEOREM
from iblf_jax.certificates.claims.weighted import WEIGHTED
from iblf_jax.certificates.terms import receives_q_dq
from iblf_jax.simulation.scenario import Scenario


def main_claim(scenario: Scenario) -> MainClaim:
    """The claim that a certificate of a scenario is about, whether or not it applies."""
    if receives_q_dq(scenario):
        return THEOREM
    if MATCHED.why_not(scenario):
        return LEVELS
    return MATCHED


def claims_of(scenario: Scenario) -> tuple[Claim, ...]:
    """All claims about a scenario, in the order of their lines.

    Raises:
      ValueError: a law that states half of a claim about itself.
    """
    main = main_claim(scenario)
    candidates: tuple[Claim, ...] = (OWN, main, SETTLING, WEIGHTED)
    if main is LEVELS:
        candidates = (main, SETTLING, OWN)
    return tuple(x for x in candidates if x is main or not x.why_not(scenario))

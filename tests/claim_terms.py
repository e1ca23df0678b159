"""The terms of all claims about a scenario at one of its states."""

import jax

from iblf_jax.certificates.claims import claims_of
from iblf_jax.certificates.terms import Terms, terms_and_sample
from iblf_jax.simulation.closed_loop import LoopState
from iblf_jax.simulation.scenario import Scenario


def terms_at(scenario: Scenario, t: jax.Array, state: LoopState) -> Terms:
    """The terms at a state of the loop at t, () [s]; for `vmap` over states, times and gains."""
    return terms_and_sample(scenario, t, state, claims_of(scenario))[0]

"""The auxiliary state of a limited input in a certificate: what the law within the limit receives.

With the auxiliary state the claims apply while the input is limited, too, with the additional term
(A.3) (`iblf_jax.control.controllers.saturated`).
"""

from __future__ import annotations

from typing import Any

from iblf_jax.control.controllers import LawContext, Saturated
from iblf_jax.control.controllers._base import layers_with_states
from iblf_jax.core.pytree import unwrapped
from iblf_jax.simulation.scenario import Scenario


def covers_limit(scenario: Scenario) -> bool:
    """Whether the law takes the shift of the auxiliary state of the limit around it."""
    outer: Any = scenario.controller
    if not isinstance(outer, Saturated) or not outer.has_auxiliary:
        return False
    return outer.law is unwrapped(outer) and outer.law.takes_shift


def inner_state(scenario: Scenario, state: Any) -> Any:
    """The state of the innermost law, from the state of the controller or from its rate."""
    *_, (_, innermost) = layers_with_states(scenario.controller, state)
    return innermost


def inner_context(scenario: Scenario, state: Any) -> LawContext:
    """The context of the law within the limit, from the state of the controller."""
    outer: Any = scenario.controller
    if not covers_limit(scenario):
        return scenario.context
    return scenario.context._replace(shift=outer.shift(state))

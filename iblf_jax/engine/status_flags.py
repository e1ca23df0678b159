"""Which status flags a sample raises, and whether a state is valid."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.core.status import Status, flag
from iblf_jax.simulation.closed_loop import LoopState, integrated_part
from iblf_jax.simulation.signals import (
    Sample,
    has,
    has_velocity_level_bounds,
    higher_alpha_margins,
    least_higher_margins,
    least_margin,
    margin_of,
)
from iblf_jax.world.bounds import NARROWEST


def sample_status(sample: Sample) -> jax.Array:
    """The flags that one sample raises, () int32."""
    found = (
        flag(jnp.any(~(least_margin(sample, 1) > 0)), Status.BOUND_VIOLATED)
        | flag(jnp.any(sample.guard_active), Status.GUARD_ACTIVE)
        | flag(jnp.any(sample.guard_active) & (sample.t > 0), Status.GUARD_STAYED)
        | flag(jnp.any(sample.saturated), Status.TORQUE_SATURATED)
        | flag(~jnp.isfinite(sample.V), Status.NOT_FINITE)
    )
    if not has(sample, "slack"):  # a filter keeps its bounds wherever the reference goes
        narrowest = jnp.minimum(sample.q_d - sample.lower, sample.upper - sample.q_d)
        found |= flag(jnp.any(narrowest < NARROWEST), Status.INFEASIBLE_REFERENCE)
    for signal in ("slack", "region_slack"):
        if has(sample, signal):
            found |= flag(jnp.any(getattr(sample, signal) > 0), Status.FILTER_INFEASIBLE)
    if has(sample, "region_margin"):
        found |= flag(jnp.any(~(sample.region_margin > 0)), Status.REGION_VIOLATED)
    if has_velocity_level_bounds(sample):
        alpha_margin = margin_of(sample, 2, sample.alpha)
        found |= flag(jnp.any(~(least_margin(sample, 2) > 0)), Status.VELOCITY_VIOLATED)
        found |= flag(jnp.any(~(alpha_margin > NARROWEST)), Status.ALPHA_INFEASIBLE)
    if has(sample, "higher_lower"):
        violated = jnp.any(~(least_higher_margins(sample) > 0))
        found |= flag(violated, Status.STATE_BOUND_VIOLATED)
        margins = higher_alpha_margins(sample)
        if margins is not None:
            found |= flag(jnp.any(~(margins > NARROWEST)), Status.ALPHA_INFEASIBLE)
    return found


def has_no_input(slope: LoopState) -> jax.Array:
    """Whether the input of a plant in strict-feedback form is not finite, by the rates of its
    levels: only that of the last level contains the input, () bool.
    """
    *others, last = (jnp.all(jnp.isfinite(rate)) for rate in slope.x)
    return jnp.all(jnp.stack(others)) & ~last


def is_valid(state: LoopState, limit: float) -> jax.Array:
    """Whether a state is finite, and its second level below a limit, () bool."""
    first, second, *others = state.x
    slow = jnp.all(jnp.abs(second) < limit)
    others = [first, *others, *jax.tree.leaves(integrated_part(state)[1:])]
    return jnp.all(jnp.stack([slow, *(jnp.all(jnp.isfinite(x)) for x in others)]))

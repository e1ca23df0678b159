"""Which status flags a sample raises, and whether a state is valid."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from iblf_jax.core.status import Status, flag
from iblf_jax.simulation.closed_loop import (
    LoopState,
    integrated_part,
)
from iblf_jax.simulation.signals import (
    Sample,
    has,
    least_level_margin,
    least_position_margin,
    least_speed_margin,
    level_margin,
    speed_margin,
)
from iblf_jax.world.bounds import NARROWEST


def sample_status(sample: Sample) -> jax.Array:
    """The flags that one sample raises, () int32."""
    found = (
        flag(jnp.any(~(least_position_margin(sample) > 0)), Status.BOUND_VIOLATED)
        | flag(jnp.any(sample.guard_active), Status.GUARD_ACTIVE)
        | flag(jnp.any(sample.guard_active) & (sample.t > 0), Status.GUARD_STAYED)
        | flag(jnp.any(sample.saturated), Status.TORQUE_SATURATED)
        | flag(~jnp.isfinite(sample.V), Status.NOT_FINITE)
    )
    if not has(sample, "slack"):  # a filter keeps its bounds wherever the reference goes
        narrowest = jnp.minimum(sample.q_d - sample.lower, sample.upper - sample.q_d)
        found |= flag(jnp.any(narrowest < NARROWEST), Status.INFEASIBLE_REFERENCE)
    for slack in (sample.slack, sample.region_slack):
        if not isinstance(slack, tuple):
            found |= flag(jnp.any(slack > 0), Status.FILTER_INFEASIBLE)
    if has(sample, "higher"):
        found |= _level_flags(sample)
    if has(sample, "region_margin"):
        found |= flag(jnp.any(~(sample.region_margin > 0)), Status.REGION_VIOLATED)
    if not has(sample, "dq_lower"):
        return found
    found |= flag(jnp.any(~(least_speed_margin(sample) > 0)), Status.VELOCITY_VIOLATED)
    return found | flag(
        jnp.any(~(speed_margin(sample, sample.alpha) > NARROWEST)), Status.ALPHA_INFEASIBLE
    )


def _level_flags(sample: Sample) -> jax.Array:
    """The flags of the levels from the third on, and of an input that has no value."""
    found = flag(jnp.any(~jnp.isfinite(sample.tau)), Status.SINGULAR_GAIN)
    if not has(sample, "higher_lower"):
        return found
    violated = ~(least_level_margin(sample) > 0)
    found |= flag(jnp.any(violated), Status.STATE_BOUND_VIOLATED)
    if not has(sample, "e_higher"):
        return found
    alphas = sample.higher - sample.e_higher
    return found | flag(
        jnp.any(~(level_margin(sample, alphas) > NARROWEST)), Status.ALPHA_INFEASIBLE
    )


def has_no_input(slope: LoopState) -> jax.Array:
    """Whether the input of a plant in strict-feedback form is not finite, by the rates of its
    levels: only that of the last level contains the input, () bool.
    """
    rates = [slope.q, slope.dq]
    if not isinstance(slope.higher, tuple):
        rates += list(slope.higher)
    *others, last = (jnp.all(jnp.isfinite(rate)) for rate in rates)
    return jnp.all(jnp.stack(others)) & ~last


def is_valid(state: LoopState, limit: float) -> jax.Array:
    """Whether a state is finite, and its second level below a limit, () bool."""
    slow = jnp.all(jnp.abs(state.dq) < limit)
    others = jax.tree.leaves((state.q, integrated_part(state)[2:]))
    return jnp.all(jnp.stack([slow, *(jnp.all(jnp.isfinite(x)) for x in others)]))

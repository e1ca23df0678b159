"""The velocity estimate of most drives: a low-pass filtered difference of positions."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.sensors._base import Velocity, above_nyquist
from iblf_jax.core.pytree import Leaf, component, leaf


class FilteredDifferenceValues(NamedTuple):
    """State of `FilteredDifference`."""

    y: jax.Array
    """The previous position, (n,) [rad]."""
    v: jax.Array
    """The previous velocity, (n,) [rad/s]."""


@component
class FilteredDifference(Velocity):
    """v_k = a v_(k-1) + (1 - a) (y_k - y_(k-1)) / T,   a = exp(-cutoff T).

    Args:
      cutoff: of the low pass, () or (n,) [rad/s], > 0.

    Source: first-order low pass, exact for a difference that is constant over a
      period; any text on digital filters.
    """

    cutoff: Leaf = leaf("rad/s", sign="positive")
    draws: ClassVar[int] = 0

    def advice(self, period: jax.Array) -> list[str]:
        """A warning about a cutoff that is above the Nyquist frequency."""
        return above_nyquist("cutoff", self.cutoff, period)

    def init(self, y: jax.Array, dq: jax.Array, period: jax.Array) -> FilteredDifferenceValues:
        """Settled at the velocity dq."""
        return FilteredDifferenceValues(y - period * dq, dq)

    def estimate(
        self,
        y: jax.Array,
        dq: jax.Array,
        normal: jax.Array,
        period: jax.Array,
        state: FilteredDifferenceValues,
    ) -> tuple[jax.Array, FilteredDifferenceValues]:
        """The filtered difference, (n,) [rad/s]."""
        a = jnp.exp(-self.cutoff * period)
        v = a * state.v + (1.0 - a) * (y - state.y) / period
        return v, FilteredDifferenceValues(y, v)

"""A high-gain observer of the levels that are not measured, and of the disturbance.

The measured levels divide a plant in strict-feedback form (S.1) into segments: each begins with a
measured level s and ends before the next one, with level e.  Within a segment the derivatives of
x_s are a chain of integrators, xi_1 = x_s, xi_2 = x_s', ... up to terms of the levels below, and a
correction of xi_{k+1} by v is one of x_{s+k} by (G_s ... G_{s+k-1})^-1 v.  The observer is a copy
of the model that the error of the measured level corrects in these coordinates:

    x_hat_{s+k}' = f + G x_hat_{s+k+1} + d_hat + (G_s ... G_{s+k-1})^-1 l_{k+1} (x_s - x_hat_s),
    d_hat_e'     = (G_s ... G_{e-1})^-1 l_{m+1} (x_s - x_hat_s),

with m levels in the segment, d_hat_e an estimate of the disturbance of its last level, and l the
coefficients of (z + bandwidth)^(m + 1): all poles of a chain of integrators are at -bandwidth.
A disturbance of another level of a segment appears as one of its last level, together with the
levels in between that would have the same effect on x_s.

In continuous time f and G are taken at the measured levels, and at x_hat for the others.  For a
robot of which q is measured, with e = q - q_hat and without d_hat_1,

    q_hat' = v_hat + 3 w e,    v_hat' = M0^-1 (tau - C0 v_hat - G0) + d_hat + 3 w^2 e,
    d_hat' = w^3 e,    M0 = M0(q), C0 = C0(q, v_hat), G0 = G0(q),    f_hat = M0 d_hat.

A function of q alone is then exact, and the error of q_hat does not act through dG0/dq.  M0(q),
G0(q) and their factors are those that law and plant compute as well.  The estimate is constant as
an acceleration: a constant torque f is followed with the lag 3/w of d = M0^-1 f.

The bandwidth must exceed the rates of the plant itself, such as sqrt(K/M + K/J) of a flexible
joint, because the copy of the model reproduces the other terms only as well as x_hat is known.

**Peaking.**  An error of the velocity at the start, v0, appears in d_hat as a peak of the size w v0
whose integral is v0, whatever w is.  So the loop tends to that with measured velocity for w ->
infinity only if the law receives a limited d_hat: `disturbance_limit`, and `limit` for the levels,
saturate the estimates outside the domain of interest.  They do not change the observer's state.

**Sampled.**  Between two samples the copy of the model moves by one step of the classical
Runge-Kutta method with the command held, from the corrected estimate: the measurement is not
constant over the period, so f and G are taken at x_hat.  The gains of a period T are those of a
polynomial filter with fading memory, with which all poles of the chain are at
a = exp(-bandwidth T).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.control.observers._base import Observer
from iblf_jax.control.observers.level import check_rows
from iblf_jax.core import checks
from iblf_jax.core.pytree import Leaf, component, leaf, static
from iblf_jax.core.units import LEVELS, RATES
from iblf_jax.world import plants
from iblf_jax.world.plants import Plant


class StateObserverValues(NamedTuple):
    """State of `StateObserver`."""

    x_hat: jax.Array
    """Estimate of all levels, (r, n)."""
    d_hat: Any
    """Estimate of the disturbance of the last level of each segment, one row a segment; `()` where
    it is not estimated."""


class Segment(NamedTuple):
    """Levels, counted from 1, of which the first alone is measured."""

    first: int
    last: int


Flow: TypeAlias = Callable[[jax.Array, jax.Array], jax.Array]
"""The rate of the state as a function of the time and the state."""

Gains: TypeAlias = Callable[[int], list[jax.Array]]
"""Number of derivatives -> the gain of each."""


@component
class StateObserver(Observer):
    """x_hat' = f + G x_hat_+ + d_hat + correction by (x_s - x_hat_s) at each measured level s.

    The law receives x_hat in the place of the levels that are not measured (head of this module).
    Level 1 must be measured, because the levels below a measured one do not follow from it.  A law
    of robots receives the torque M0(q) d_hat_2.

    Args:
      bandwidth: of the errors, () or (n,) [1/s], > 0.
      measured: the levels that the sensor measures, counted from 1, in ascending order; (1,) if
        not given.
      disturbance: whether it estimates the disturbance of the last level of each segment, as a
        constant; True if not given.
      offset: error of the estimate at the start, one number, r numbers or (r, n) [1], in the unit
        of each level; 0 if not given.  It has no effect on measured levels.
      limit: largest |x_hat| of the levels that the law receives, one number, r numbers or (r, n)
        [1], in the unit of each level, > 0; none if not given.  It has no effect on measured
        levels.
      disturbance_limit: largest |d_hat| that the law receives, one number, r numbers or (r, n)
        [1], in the unit of each level per second, > 0; none if not given.

    Source: J. P. Gauthier, H. Hammouri, S. Othman, IEEE Trans. Automatic Control 37 (1992) 875-880
      (high gain); N. Morrison, Introduction to Sequential Smoothing and Prediction, 1969 (fading
      memory); the extension by a disturbance as J. Han, IEEE Trans. Industrial Electronics 56
      (2009) 900-906; limits of the estimates: F. Esfandiari, H. K. Khalil, Int. J. Control 56
      (1992) 1007-1037.
    """

    bandwidth: Leaf = leaf("1/s", sign="positive")
    measured: tuple[int, ...] = static(default=(1,))
    disturbance: bool = static(default=True)
    offset: Leaf = leaf(LEVELS, shape="level", default=0.0)
    limit: Leaf = leaf(LEVELS, sign="positive limit", shape="level", default=None)
    disturbance_limit: Leaf = leaf(RATES, sign="positive limit", shape="level", default=None)

    def check(self) -> None:
        """Raises ValueError for levels that are not ascending from 1, or no bool."""
        name = "StateObserver.measured"
        if not isinstance(self.disturbance, bool):
            raise checks.fail("StateObserver.disturbance", self.disturbance, "True or False")
        expected = "levels in ascending order, from 1"
        remedy = "Such as measured=(1, 3) for the encoders of link and motor."
        if not isinstance(self.measured, tuple) or not self.measured:
            raise checks.fail(name, self.measured, expected, remedy)
        for level in self.measured:
            checks.positive_integer(name, level, most=plants.MAX_ORDER)
        if self.measured[0] != 1 or list(self.measured) != sorted(set(self.measured)):
            raise checks.fail(name, self.measured, expected, remedy)
        if self.disturbance_limit is not None and not self.disturbance:
            expected = "None with disturbance=False"
            remedy = "There is no estimate to limit; leave it out."
            name = "StateObserver.disturbance_limit"
            raise checks.fail(name, self.disturbance_limit, expected, remedy)

    def check_model(self, model: Plant) -> None:
        """Raises ValueError for a model that does not have the measured levels."""
        for name, value in (
            ("offset", self.offset),
            ("limit", self.limit),
            ("disturbance_limit", self.disturbance_limit),
        ):
            if value is not None:
                check_rows(f"observer.{name}", value, model)
        if self.measured[-1] > model.order:
            expected = f"levels from 1 to {model.order}, as the model has"
            raise checks.fail("observer.measured", self.measured, expected)

    def _segments(self, order: int) -> Iterator[Segment]:
        """The segments of a plant with this number of levels."""
        ends = [*(first - 1 for first in self.measured[1:]), order]
        for first, last in zip(self.measured, ends, strict=True):
            yield Segment(first, last)

    def init(self, x: jax.Array, model: Plant) -> StateObserverValues:
        """The levels at the start with the offset, and no disturbance."""
        x_hat = self._with_measured(x, x + jnp.broadcast_to(self.offset, x.shape))
        if not self.disturbance:
            return StateObserverValues(x_hat, ())
        return StateObserverValues(x_hat, jnp.zeros_like(x)[: len(self.measured)])

    def estimate(
        self, t: jax.Array, x: jax.Array, model: Plant, state: StateObserverValues
    ) -> jax.Array:
        """d_hat within its limit, (r, n); 0 where it is not estimated."""
        if not self.disturbance:
            return jnp.zeros_like(x)
        return _limited(self._of_levels(state.d_hat, model.order), self.disturbance_limit)

    def _of_levels(self, d_hat: jax.Array, order: int) -> jax.Array:
        """The disturbances of all levels from those of the segments, (r, n)."""
        rows = [jnp.zeros_like(d_hat[0])] * order
        for segment, row in zip(self._segments(order), d_hat, strict=True):
            rows[segment.last - 1] = row
        return jnp.stack(rows)

    def complete(
        self, t: jax.Array, x: jax.Array, model: Plant, state: StateObserverValues
    ) -> jax.Array:
        """The levels that the law receives, (r, n): the measured rows of x, and else x_hat within
        its limit.
        """
        return self._with_measured(x, _limited(state.x_hat, self.limit))

    def limit_excess(
        self, t: jax.Array, x: jax.Array, model: Plant, state: StateObserverValues
    ) -> Any:
        """The largest ratio of an estimate to its limit, less 1, () [1]: positive where a limit is
        active; `()` without limits.
        """
        ratios = []
        if self.limit is not None:
            estimated = self._with_measured(jnp.zeros_like(x), state.x_hat)
            ratios.append(jnp.max(jnp.abs(estimated) / self.limit))
        if self.disturbance_limit is not None:
            d_hat = self._of_levels(state.d_hat, model.order)
            ratios.append(jnp.max(jnp.abs(d_hat) / self.disturbance_limit))
        if not ratios:
            return ()
        return jnp.max(jnp.stack(ratios)) - 1.0

    def _with_measured(self, x: jax.Array, x_hat: jax.Array) -> jax.Array:
        """The measured rows of x and the other rows of x_hat, (r, n)."""
        rows = list(x_hat)
        for level in self.measured:
            rows[level - 1] = x[level - 1]
        return jnp.stack(rows)

    def derivative(
        self,
        t: jax.Array,
        x: jax.Array,
        u: jax.Array,
        model: Plant,
        state: StateObserverValues,
    ) -> StateObserverValues:
        """x_hat' and d_hat'."""

        def gains(count: int) -> list[jax.Array]:
            return [math.comb(count, i) * self.bandwidth**i for i in range(1, count + 1)]

        known = self._with_measured(x, state.x_hat)
        correction = self._correction(t, x, model, state, gains, known)
        predicted = self._flow(model, u, state.d_hat)(t, known)
        return StateObserverValues(predicted + correction.x_hat, correction.d_hat)

    def advance(
        self,
        t: jax.Array,
        x: jax.Array,
        u: jax.Array,
        model: Plant,
        state: StateObserverValues,
        period: jax.Array,
    ) -> StateObserverValues:
        """The prediction for the next sample: corrected by the measurement x, then moved by a
        period with the input u.
        """
        a = jnp.exp(-self.bandwidth * period)

        def gains(count: int) -> list[jax.Array]:
            return fading_memory_gains(a, count, period)

        correction = self._correction(t, x, model, state, gains, state.x_hat)
        x_hat = state.x_hat + correction.x_hat
        d_hat = jax.tree.map(jnp.add, state.d_hat, correction.d_hat)
        flow = self._flow(model, u, d_hat)
        # One step of the classical Runge-Kutta method.
        half = 0.5 * period
        first = flow(t, x_hat)
        second = flow(t + half, x_hat + half * first)
        third = flow(t + half, x_hat + half * second)
        fourth = flow(t + period, x_hat + period * third)
        x_hat = x_hat + period / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
        return StateObserverValues(x_hat, d_hat)

    def _flow(self, model: Plant, u: jax.Array, d_hat: jax.Array) -> Flow:
        """The rate of the model's state with the estimated disturbance, a function of t and x."""

        def flow(t: jax.Array, x: jax.Array) -> jax.Array:
            rate = plants.flow(model, t, x, u)
            if self.disturbance:
                rate = rate + self._of_levels(d_hat, model.order)
            return rate

        return flow

    def _correction(
        self,
        t: jax.Array,
        x: jax.Array,
        model: Plant,
        state: StateObserverValues,
        gains: Gains,
        known: jax.Array,
    ) -> StateObserverValues:
        """The correction of x_hat and d_hat by the errors of the measured levels.

        `gains(count)` are those of the derivatives of a measured level of the orders 0 to
        `count` - 1, and `known` the levels at which G is taken, (r, n).
        """
        x_hat = state.x_hat
        states: list[jax.Array] = []
        disturbances: list[jax.Array] = []
        for first, last in self._segments(model.order):
            error = x[first - 1] - x_hat[first - 1]
            levels = range(first, last + 1)
            # The disturbance of the last level is one more derivative.
            of_states = gains(len(levels) + self.disturbance)
            for level, gain in zip(levels, of_states, strict=False):
                states.append(_through_gains(model, first, level, t, known, gain * error))
            if self.disturbance:
                rate = of_states[-1] * error
                disturbances.append(_through_gains(model, first, last, t, known, rate))
        if not self.disturbance:
            return StateObserverValues(jnp.stack(states), ())
        return StateObserverValues(jnp.stack(states), jnp.stack(disturbances))


def _limited(x: jax.Array, limit: jax.Array | None) -> jax.Array:
    """An estimate within its limit; unchanged without one."""
    if limit is None:
        return x
    return jnp.clip(x, -limit, limit)


def _through_gains(
    model: Plant, first: int, level: int, t: jax.Array, x: jax.Array, v: jax.Array
) -> jax.Array:
    """(G_first ... G_{level-1})^-1 v, (n,)."""
    for i in range(first, level):

        def needed(rate: jax.Array, i: int = i) -> jax.Array:
            return plants.level_input(model, i, t, x, rate)

        # `level_input` is affine in the rate, so its derivative is the inverse of the gain.
        v = jax.jvp(needed, (jnp.zeros_like(v),), (v,))[1]
    return v


def fading_memory_gains(a: jax.Array, count: int, period: jax.Array) -> list[jax.Array]:
    """Gains by which an error of a measured signal corrects its derivatives of the orders 0 to
    `count` - 1, so that all poles of a chain of integrators are at a.

    With F the map of a chain of integrators from one sample to the next and C its output, the gain
    L of the correction places the eigenvalues of F - F L C at a:  L = F^-1 (F - a)^count O^-1 e,
    O = (C; C F; ...; C F^(count-1)), e the last unit vector (Ackermann's formula).

    Args:
      a: pole, () or (n,) [1].
      count: number of derivatives, with that of order 0.
      period: () [s].

    Returns:
      `count` gains, () or (n,) each [1/s^k for the derivative of order k].
    """
    # In the coordinates xi_k T^k / k! the map F has the binomial coefficients as its entries.
    F = np.array([[math.comb(j, i) for j in range(count)] for i in range(count)], float)
    powers = [np.linalg.matrix_power(F, j) for j in range(count + 1)]
    observability = np.stack([power[0] for power in powers[:count]])
    last = np.linalg.solve(observability, np.eye(count)[-1])
    # (F - a)^count by the binomial theorem: coefficient j is that of (-a)^j.
    coefficients = [
        math.comb(count, j) * np.linalg.solve(F, powers[count - j] @ last) for j in range(count + 1)
    ]
    gains = []
    for k in range(count):
        scaled = sum(float(vector[k]) * (-a) ** j for j, vector in enumerate(coefficients))
        gains.append(scaled * math.factorial(k) / period**k)
    return gains

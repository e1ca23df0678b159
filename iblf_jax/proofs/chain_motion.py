"""The rate of V of a plant in strict-feedback form whose plant is not the model.

The law is `controllers.BarrierBackstepping` with exact derivatives, the observer `LevelObserver` or
none, one number per level.  Plant and model, with d_i the difference that the observer estimates:

    x_i' = f_i + G_i x_{i+1} + external_i = f0_i + G0_i x_{i+1} + d_i,   i = 1..r,   x_{r+1} = u
    d_tilde = d - d_hat,   d_hat_i' = kappa_i d_tilde_i
    V = sum_i w_i V_i + sum_i (v_i/2) d_tilde_i^2

The last sum has the levels with kappa_i > 0; at the others d_hat_i = 0 and d_tilde_i = d_i.

**Motion.**  With R_i, the rate that the law desires (`controllers._levels`), and
I0_i(rate) = (rate - f0_i)/G0_i, the law is alpha_i = I0_i(R_i - d_hat_i), and

    nu_i = R_i + G0_i e_{i+1}   is the rate of x_i in the model's flow,
    x_i' = nu_i + d_tilde_i,   e_i' = x_i' - alpha_{i-1}'                                    (C.1)

alpha_{i-1}' differs from its rate beta_{i-1} in the model's flow, with d_hat held, by

    delta_{i-1} = the derivative of alpha_{i-1} along e_j' = d_tilde_j - delta_{j-1} and
                  d_hat_j' = kappa_j d_tilde_j,   j < i,

so that with the barriers' decay

    (sum w_i V_i)' = -sum w_i (decay_i + c_i s_i^2)
                     + sum w_i (s_i d_tilde_i + (dV_i/d alpha_{i-1}) delta_{i-1})             (C.2)

**Parameters.**  At a given rate x_i', the level above is

    Z_i(p; x_i') = (x_i' - f_i - external_i)/G_i,

which is affine in the parameters of most plants.  With m_i(p; rate) = I0_i(rate) - Z_i(p; rate),

    d_i = G0_i m_i(p; x_i')   where d_hat_i is an estimate,
    d_i = G_i m_i(p; nu_i)   where d_hat_i = 0                                               (C.3)

m_i is the external part at p0 less Z_i(p) - Z_i(p0), which is formed by (U.1).  x_i'' contains
d_tilde_i' = d_i' - kappa_i d_tilde_i.  With q_i its value for d_i' = 0,

    d_i' = (G_i/G0_i) (d/dt)(G0_i m_i) along (1, x', q_i)                                     (C.4)

    V' = (sum w_i V_i)' + sum v_i d_tilde_i (d_i' - kappa_i d_tilde_i)                        (C.5)

Errors and bounds are in the frame of the centre alpha_{i-1} of their tube.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control import controllers
from iblf_jax.control.barriers import Quadratic
from iblf_jax.core import taylor
from iblf_jax.proofs.forms import along
from iblf_jax.world import plants
from iblf_jax.world.bounds import NARROWEST, Bounds, Tube, bounds_at
from iblf_jax.world.disturbances import Disturbance
from iblf_jax.world.references import Reference

Column = tuple[jax.Array, ...]
"""A number (1,) for each level."""


class ChainParts(NamedTuple):
    """The parts of a scenario on which V' depends; a pytree."""

    model: plants.Plant
    law: controllers.BarrierBackstepping
    """Its barriers have no guard."""
    kappa: jax.Array
    """Gain of the observer, (r, 1) [1/s]."""
    reference: Reference
    bounds: tuple[Bounds | None, ...]
    """Of each level."""
    guards: jax.Array
    """Guard of the law's barrier of each level, 0 of those without one, (r, 1)."""

    @property
    def order(self) -> int:
        """Number of levels."""
        return self.law.order


class OpenTube(Tube):
    """A tube whose widths have no least value, because the derivative of a maximum is undecided on
    intervals.  Inside the guards (`inside_guards`) they are those of `Tube`.
    """

    @property
    def k_l(self) -> jax.Array:
        """k_l."""
        return self.q_d - self.lower

    @property
    def k_u(self) -> jax.Array:
        """k_u."""
        return self.upper - self.q_d


class ChainState(NamedTuple):
    """Time, errors and estimates, which determine the law."""

    t: jax.Array
    """() [s]."""
    e: Column
    """e_1, e_2, ..., as many as are known."""
    d_hat: Column
    """As many as are known."""


def remembered(errors: int, estimates: int) -> Callable:
    """A method (i, y) whose results are kept: the equations of a level are needed many times, and
    tracing them anew each time takes a time that is exponential in the number of levels.

    Args:
      errors: the method depends on e_1..e_{i + errors}.
      estimates: it depends on d_hat_1..d_hat_{i + estimates}.
    """

    def decorated(method: Callable) -> Callable:
        @functools.wraps(method)
        def once(self: LevelEquations, i: int, y: ChainState) -> Any:
            needed = ChainState(y.t, y.e[: i + errors], y.d_hat[: max(i + estimates, 0)])
            leaves = jax.tree.leaves(needed)
            key = (method.__name__, i, *map(id, leaves))
            if key not in self.kept:
                # The leaves are kept, too, so that no other object gets the id of one of them.
                self.kept[key] = (method(self, i, needed), leaves)
            return self.kept[key][0]

        return once

    return decorated


def derivative(function: Callable, y: ChainState, rates: ChainState) -> Any:
    """The derivative of a function of the first rows of y along their rates."""
    rows, estimates = len(rates.e), len(rates.d_hat)
    first = ChainState(y.t, y.e[:rows], y.d_hat[:estimates])
    return along(function, (first,), (rates,))


def error_above(y: ChainState, i: int, order: int) -> jax.Array:
    """e_{i+1} of row i, which is 0 for the last one."""
    if i == order - 1:
        return jnp.zeros(1)
    return y.e[i + 1]


class LevelEquations:
    """The equations of the law, level by level, as functions of t, e and d_hat.

    Args:
      parts: of the loop.
    """

    def __init__(self, parts: ChainParts) -> None:
        self.parts = parts
        self.kept: dict[tuple, tuple[Any, Any]] = {}

    @remembered(errors=0, estimates=0)
    def centre(self, i: int, y: ChainState) -> jax.Array:
        """alpha_{i-1}, around which the tube of row i is."""
        if i == 0:
            return self.parts.reference.position(y.t)
        desired = self.desired_rate(i - 1, y) - y.d_hat[i - 1]
        return plants.level_input(self.parts.model, i, y.t, self.state(i, y), desired)

    @remembered(errors=1, estimates=0)
    def centre_rate(self, i: int, y: ChainState) -> jax.Array:
        """beta_{i-1}, the rate of the centre in the model's flow."""
        return derivative(lambda y: self.centre(i, y), y, self.model_rates(i, y))

    def column(self, rows: Column) -> jax.Array:
        """The rows of a state, with zeros for those that are not known, (r, 1)."""
        zeros = [jnp.zeros(1)] * (self.parts.order - len(rows))
        return jnp.stack([*rows, *zeros])

    @remembered(errors=0, estimates=-1)
    def state(self, i: int, y: ChainState) -> jax.Array:
        """x_1..x_i, and zeros above, (r, 1)."""
        return self.column(tuple(self.centre(j, y) + y.e[j] for j in range(i)))

    @remembered(errors=1, estimates=0)
    def relative_tube(self, i: int, y: ChainState) -> OpenTube:
        """The tube of row i in the frame of its centre."""
        zero = jnp.zeros(1)
        bounds = self.parts.bounds[i]
        if bounds is None or isinstance(self.parts.law.barriers[i], Quadratic):
            return OpenTube(zero, zero, zero - 1.0, zero + 1.0, zero, zero)
        middle, rate = self.centre(i, y), self.centre_rate(i, y)
        now, moved = taylor.in_time(lambda t: bounds_at(bounds, t, zero), y.t, 1)
        lower, upper = now[0] - middle, now[1] - middle
        return OpenTube(zero, zero, lower, upper, moved[0] - rate, moved[1] - rate)

    def inside_guards(self, y: ChainState) -> jax.Array:
        """Whether all errors are inside the bounds and no guard is active, (1,) bool."""
        inside = jnp.ones(1, bool)
        for i, barrier in enumerate(self.parts.law.barriers):
            if isinstance(barrier, Quadratic):
                continue
            tube, share = self.relative_tube(i, y), 1.0 - self.parts.guards[i]
            inside &= (tube.k_l > NARROWEST) & (tube.k_u > NARROWEST)
            inside &= (y.e[i] < share * tube.k_u) & (y.e[i] > -share * tube.k_l)
        return inside

    @remembered(errors=1, estimates=0)
    def barrier_slope(self, i: int, y: ChainState) -> jax.Array:
        """s_i of row i."""
        return self.parts.law.barriers[i].slope(self.relative_tube(i, y), y.e[i])

    def virtual_rate(self, i: int, y: ChainState) -> jax.Array:
        """a_i - beta_{i-1} of row i, the virtual velocity of its barrier."""
        law = self.parts.law
        gain_o = None if law.o is None else law.o[i]
        tube = self.relative_tube(i, y)
        return law.barriers[i].virtual_velocity(  # type: ignore[no-any-return]
            tube, y.e[i], law.k[i], gain_o
        )

    @remembered(errors=1, estimates=0)
    def relative_desired_rate(self, i: int, y: ChainState) -> jax.Array:
        """R_i - beta_{i-1} of row i."""
        law = self.parts.law
        barrier = law.barriers[i]
        tube = self.relative_tube(i, y)
        rate = self.virtual_rate(i, y) - law.c[i] * barrier.slope(tube, y.e[i])
        if i == 0:
            return rate
        below = law.weights[i - 1] * self.barrier_slope(i - 1, y)
        x = self.state(i, y)
        coupling = plants.transposed_gain(self.parts.model, i, y.t, x, below) / law.weights[i]
        return rate - coupling * barrier.error_over_slope(tube, y.e[i])

    def desired_rate(self, i: int, y: ChainState) -> jax.Array:
        """R_i of row i."""
        return self.centre_rate(i, y) + self.relative_desired_rate(i, y)

    def model_gain(self, i: int, y: ChainState, v: jax.Array) -> jax.Array:
        """G0_i v of row i."""
        return plants.gain_times(self.parts.model, i + 1, y.t, self.state(i + 1, y), v)

    @remembered(errors=2, estimates=0)
    def model_error_rate(self, i: int, y: ChainState) -> jax.Array:
        """e_i' of row i in the model's flow, nu_i - beta_{i-1}."""
        pull = self.model_gain(i, y, error_above(y, i, self.parts.order))
        return self.relative_desired_rate(i, y) + pull

    def model_state_rate(self, i: int, y: ChainState) -> jax.Array:
        """nu_i of row i."""
        return self.centre_rate(i, y) + self.model_error_rate(i, y)

    def model_rates(self, i: int, y: ChainState) -> ChainState:
        """The rates of t, e_1..e_i and d_hat_1..d_hat_i in the model's flow."""
        rates = tuple(self.model_error_rate(j, y) for j in range(i))
        return ChainState(jnp.ones_like(y.t), rates, (jnp.zeros(1),) * i)

    def slope_by_centre(self, i: int, y: ChainState) -> jax.Array:
        """dV_i/d alpha_{i-1} at fixed x_i and t, of row i."""
        barrier = self.parts.law.barriers[i]
        zero, one = jnp.zeros(1), jnp.ones(1)
        tube = self.relative_tube(i, y)
        moved = OpenTube(zero, zero, -one, -one, zero, zero)
        return along(barrier.value, (tube, y.e[i]), (moved, -one))

    def weighted_dissipation(self, i: int, y: ChainState, energy: jax.Array) -> jax.Array:
        """w_i decay_i of row i, or a lower bound of it.

        Args:
          i: row.
          y: errors and estimates.
          energy: w_i V_i.
        """
        law = self.parts.law
        barrier = law.barriers[i]
        claimed = barrier.decay_rate(law.k[i]) * energy  # type: ignore[operator]
        if barrier.exact_decay:
            return claimed
        return jnp.maximum(self.exact_dissipation(i, y), claimed)

    def exact_dissipation(self, i: int, y: ChainState) -> jax.Array:
        """-w_i V_i' of row i for e_i' = a_i - beta_{i-1}."""
        law = self.parts.law
        tube = self.relative_tube(i, y)
        zero = jnp.zeros(1)
        moved = OpenTube(zero, zero, tube.dlower, tube.dupper, zero, zero)
        rates = (moved, self.virtual_rate(i, y))
        return -law.weights[i] * along(law.barriers[i].value, (tube, y.e[i]), rates)


class Motion(NamedTuple):
    """The motion at a point, a number (1,) for each level."""

    y: ChainState
    x_rate: Column
    d: Column
    d_tilde: Column
    error_rate: Column
    """e_i'."""
    delta: Column
    """delta_{i-1} of each row; 0 of the first."""
    d_hat_rate: Column


def with_estimate(
    equations: LevelEquations,
    observed: tuple[bool, ...],
    true: Any,
    i: int,
    y: ChainState,
    d_tilde: jax.Array,
) -> tuple[ChainState, jax.Array, jax.Array]:
    """The state with d_hat_i of row i, d_i and d_tilde_i.

    Args:
      equations: of the law.
      observed: of each row, whether its kappa is positive.
      true: the plant's difference from the model, a `chain_bound.TruePlant`.
      i: row.
      y: with e_{i+1} of the row and d_hat of the rows below.
      d_tilde: of the row, where it is observed.
    """
    nu = equations.model_state_rate(i, y)
    x = equations.state(i + 1, y)
    if observed[i]:
        d = equations.model_gain(i, y, true.mismatch(i, y.t, x, nu + d_tilde))
        return y._replace(d_hat=(*y.d_hat, d - d_tilde)), d, d_tilde
    m = true.mismatch(i, y.t, x, nu)
    d = true.ratio(i, y.t, x) * equations.model_gain(i, y, m)
    return y._replace(d_hat=(*y.d_hat, jnp.zeros(1))), d, d


def motion(
    equations: LevelEquations,
    observed: tuple[bool, ...],
    y: ChainState,
    d: Column,
    d_tilde: Column,
) -> Motion:
    """The motion at a point whose d and d_tilde are known."""
    kappa = equations.parts.kappa
    order = len(observed)
    x_rates: list[jax.Array] = []
    error_rates: list[jax.Array] = []
    deltas: list[jax.Array] = []
    surplus: list[jax.Array] = []  # of each e_i', over that of the model's flow
    estimates = tuple(kappa[j] * d_tilde[j] if observed[j] else jnp.zeros(1) for j in range(order))
    for i in range(order):
        delta = jnp.zeros(1)
        if i > 0:
            away = ChainState(jnp.zeros_like(y.t), tuple(surplus), estimates[:i])
            delta = derivative(lambda y, i=i: equations.centre(i, y), y, away)
        deltas.append(delta)
        surplus.append(d_tilde[i] - delta)
        error_rates.append(equations.model_error_rate(i, y) + surplus[i])
        x_rates.append(equations.model_state_rate(i, y) + d_tilde[i])
    return Motion(y, tuple(x_rates), d, d_tilde, tuple(error_rates), tuple(deltas), estimates)


def mismatch_rate(equations: LevelEquations, true: Any, i: int, now: Motion) -> jax.Array:
    """d_i' of (C.4) of an observed row."""
    y = now.y
    rates = ChainState(jnp.ones_like(y.t), now.error_rate[: i + 2], now.d_hat_rate[:i])
    # G0_i e_{i+1} is in nu_i, so that one more row moves.
    nu_rate = derivative(lambda y: equations.model_state_rate(i, y), y, rates)
    q = nu_rate - equations.parts.kappa[i] * now.d_tilde[i]
    x = equations.state(i + 1, y)
    x_rate = equations.column(now.x_rate[: i + 1])

    def rate_of_mismatch(t: jax.Array, x: jax.Array, rate: jax.Array) -> jax.Array:
        model = equations.parts.model
        return plants.gain_times(model, i + 1, t, x, true.mismatch(i, t, x, rate))

    point = (y.t, x, now.x_rate[i])
    return true.ratio(i, y.t, x) * along(rate_of_mismatch, point, (jnp.ones_like(y.t), x_rate, q))


class External(NamedTuple):
    """What acts on the plant besides its input."""

    rates: jax.Array
    """Of each level, (r, 1)."""
    input: jax.Array
    """Added to the input, (1,)."""


def external_at(
    disturbance: Disturbance, t: jax.Array, x: jax.Array, plant: Any, model: Any
) -> External:
    """The disturbance at a time."""
    rates = disturbance.rates(t, x, plant, model)
    if rates is None:
        rates = jnp.zeros_like(x)
    return External(rates, disturbance.torque(t, x[0], x[1], plant, model))


def level_above(
    plant: Any,
    disturbance: Disturbance,
    model: Any,
    i: int,
    t: jax.Array,
    x: jax.Array,
    rate: jax.Array,
) -> jax.Array:
    """Z_i of row i: the level above, or the input, with which x_i' is `rate`."""
    external = external_at(disturbance, t, x, plant, model)
    above = plants.level_input(plant, i + 1, t, x, rate - external.rates[i])
    return above - external.input if i == plant.order - 1 else above

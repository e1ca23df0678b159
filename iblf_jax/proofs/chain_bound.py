"""Points and bounds of V' on the level set V = c of a plant in strict-feedback form.

**Coordinates.**  x = (t - t_0, theta_1..theta_{N-1}, z_1..z_m, sign_1..sign_r, t_0), where N is r
and the number of observed levels.  Angles divide the level among its terms,

    (sqrt(w_i V_i/c) for each level, sqrt(v_i/(2c)) d_tilde_i for each observed one) = sphere(theta)

so that every x lies on the level set.  sign_i is the side of the tube on which e_i lies.

**Errors.**  The centre of the tube of row i is affine in the error of the row,

    alpha_{i-1} = alpha_0 + gamma e_i,   gamma = G0_{i-1}/G_{i-1} - 1,

because d_hat_{i-1} contains x_{i-1}', and gamma = 0 where it is no estimate.  The error at which
V_i has its value is the fixed point of e = error_at(V_i; tube around alpha_0 + gamma e).  On
intervals the iteration begins with all errors inside the bounds, so that sign_i e_i is in
[0, k_0/(1 + gamma)].
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers import Quadratic
from iblf_jax.kernels import hull, meet, with_sign
from iblf_jax.proofs import chain_motion, uncertainty
from iblf_jax.proofs.chain_motion import (
    ChainParts,
    ChainState,
    Column,
    LevelEquations,
    Motion,
    OpenTube,
)
from iblf_jax.proofs.forms import along, centre, derivative
from iblf_jax.proofs.matrices import sphere
from iblf_jax.proofs.uncertainty import Numbers, Places
from iblf_jax.world import plants
from iblf_jax.world.bounds import Tube, bounds_at
from iblf_jax.world.disturbances import Disturbance

CONTRACTIONS = 3
"""Iterations for the error on intervals; each reduces the width of what it began with by gamma."""
ITERATIONS = 60
"""Iterations for the error at a point."""


class Constants(NamedTuple):
    """The numbers of a problem; a pytree."""

    parts: ChainParts
    plant: plants.Plant
    disturbance: Disturbance
    coordinates: Numbers
    weights: jax.Array
    """v_i of each level, (r, 1)."""
    level: jax.Array
    """c."""


class TruePlant:
    """The plant at a point, or in a box of parameters.

    Args:
      constants: of the problem.
      places: of the uncertain entries.
      z: uncertain coordinates, (m,).
      is_box: whether differences are formed by the mean value theorem, for intervals.
    """

    def __init__(self, constants: Constants, places: Places, z: jax.Array, *, is_box: bool) -> None:
        self.parts = constants.parts
        self.equations = LevelEquations(constants.parts)
        self.is_box = is_box
        numbers = constants.coordinates
        nominal = (constants.plant, constants.disturbance)
        self.of_model = (constants.parts.model, constants.disturbance)
        self.leaves = uncertainty.leaves_at(places, numbers, nominal, z)
        if is_box:
            self.inside = uncertainty.between(places, numbers, nominal, self.of_model, z)
            self.difference = uncertainty.difference(places, numbers, nominal, self.of_model, z)

    def above(
        self,
        p: tuple[plants.Plant, Disturbance],
        i: int,
        t: jax.Array,
        x: jax.Array,
        rate: jax.Array,
    ) -> jax.Array:
        """Z_i of row i for a plant and a disturbance."""
        plant, disturbance = p
        return chain_motion.level_above(plant, disturbance, self.parts.model, i, t, x, rate)

    def mismatch(self, i: int, t: jax.Array, x: jax.Array, rate: jax.Array) -> jax.Array:
        """m_i of (C.3) of row i."""
        model = self.parts.model
        if not self.is_box:
            desired = plants.level_input(model, i + 1, t, x, rate)
            return desired - self.above(self.leaves, i, t, x, rate)
        external = chain_motion.external_at(self.of_model[1], t, x, model, model)
        # I0_i is affine in the rate; a difference of intervals would be too wide.
        of_level = along(
            lambda rate: plants.level_input(model, i + 1, t, x, rate),
            (jnp.zeros(1),),
            (external.rates[i],),
        )
        if i == model.order - 1:
            of_level = of_level + external.input
        moved = along(lambda p: self.above(p, i, t, x, rate), (self.inside,), (self.difference,))
        return of_level - moved

    def ratio(self, i: int, t: jax.Array, x: jax.Array) -> jax.Array:
        """G_i/G0_i of row i."""
        one = jnp.ones(1)
        true = plants.gain_times(self.leaves[0], i + 1, t, x, one)
        return true / plants.gain_times(self.parts.model, i + 1, t, x, one)

    def slope_of_centre(self, i: int, t: jax.Array, x: jax.Array) -> jax.Array:
        """The slope gamma of the centre of the row above row i, G0_i/G_i - 1."""
        zero, one = jnp.zeros(1), jnp.ones(1)
        slope = along(lambda rate: self.mismatch(i, t, x, rate), (zero,), (one,))
        return -plants.gain_times(self.parts.model, i + 1, t, x, slope)


class ChainMotionPoint(NamedTuple):
    """What coordinates mean physically."""

    now: Motion
    energy: Column
    """w_i V_i."""
    x: jax.Array
    """The state, (r, 1)."""
    u: jax.Array
    """The input, (1,)."""


def chain_motion_point(
    constants: Constants,
    observed: tuple[bool, ...],
    true: TruePlant,
    t: jax.Array,
    unit_vector: list[jax.Array],
    signs: jax.Array,
) -> ChainMotionPoint:
    """The motion at coordinates.

    Args:
      constants: of the problem.
      observed: of each level, whether it has an estimate.
      true: the plant.
      t: time.
      unit_vector: N numbers whose squares have the sum 1.
      signs: of the errors, (r,).
    """
    level, equations = constants.level, true.equations
    order = len(observed)
    energy = tuple((level * x**2).reshape(1) for x in unit_vector[:order])
    observed_rows = [i for i in range(order) if observed[i]]
    given: list[Any] = [None] * order
    for i, x in zip(observed_rows, unit_vector[order:], strict=True):
        given[i] = (jnp.sqrt(2.0 * level / constants.weights[i, 0]) * x).reshape(1)
    y = ChainState(t, (), ())
    d: list[jax.Array] = []
    d_tilde: list[jax.Array] = []

    def estimated(y: ChainState, i: int) -> tuple[ChainState, jax.Array, jax.Array]:
        return chain_motion.with_estimate(equations, observed, true, i, y, given[i])

    for i in range(order):
        at_centre = y
        slope = jnp.zeros(1)
        if i > 0:
            at_centre, _, _ = estimated(y._replace(e=(*y.e, jnp.zeros(1))), i - 1)
            if observed[i - 1]:
                slope = true.slope_of_centre(i - 1, t, equations.state(i, y))
        e = _error(constants, observed, true, i, at_centre, slope, energy[i], signs[i])
        y = y._replace(e=(*y.e, e))
        if i > 0:
            y, d_below, d_tilde_below = estimated(y, i - 1)
            d.append(d_below)
            d_tilde.append(d_tilde_below)
    y, d_last, d_tilde_last = estimated(y, order - 1)
    d.append(d_last)
    d_tilde.append(d_tilde_last)
    now = chain_motion.motion(equations, observed, y, tuple(d), tuple(d_tilde))
    x = equations.state(order, y)
    desired = equations.desired_rate(order - 1, y) - y.d_hat[order - 1]
    u = plants.level_input(constants.parts.model, order, t, x, desired)
    return ChainMotionPoint(now, energy, x, u)


def _error(
    constants: Constants,
    observed: tuple[bool, ...],
    true: TruePlant,
    i: int,
    at_centre: ChainState,
    slope: jax.Array,
    energy: jax.Array,
    sign: jax.Array,
) -> jax.Array:
    """e_i of row i; see the head of this module.

    Args:
      constants, observed, true: of the problem.
      i: row.
      at_centre: the state for e_i = 0.
      slope: gamma.
      energy: w_i V_i.
      sign: side of the tube.
    """
    parts = constants.parts
    barrier = parts.law.barriers[i]
    value = energy / parts.law.weights[i]
    if isinstance(barrier, Quadratic):
        return with_sign(sign * jnp.sqrt(2.0 * value), sign)
    zero = jnp.zeros(1)
    middle = true.equations.centre(i, at_centre)
    bounds: Any = parts.bounds[i]
    lower, upper = bounds_at(bounds, at_centre.t, middle)
    k_l, k_u = middle - lower, upper - middle

    # Where the first iterations leave the bounds, only a tube of positive width leads back.
    kind = OpenTube if true.is_box else Tube

    def next_error(e: jax.Array) -> jax.Array:
        tube = kind(zero, zero, -(k_l + slope * e), k_u - slope * e, zero, zero)
        return barrier.error_at(value, tube, sign > 0)  # type: ignore[return-value]

    if i == 0 and true.is_box:
        # Both widths of the first tube depend on the time: a mean-value form keeps their relation.
        return with_sign(
            meet(_first_error(parts, value, sign, at_centre.t), next_error(zero)), sign
        )
    if i == 0 or not observed[i - 1]:
        return with_sign(next_error(zero), sign)
    if not true.is_box:
        return jax.lax.fori_loop(0, ITERATIONS, lambda _, e: next_error(e), zero)
    side = jnp.where(sign > 0, k_u, -k_l)
    e = hull(zero, side / (1.0 + slope))
    for _ in range(CONTRACTIONS):
        e = meet(next_error(e), e)
    return with_sign(e, sign)


def _first_error(parts: ChainParts, value: jax.Array, sign: jax.Array, t: jax.Array) -> jax.Array:
    """e_1 at which V_1 has a value, by the mean-value form e(c) + e'(T) (t - c) in an interval T of
    times with the centre c.
    """
    bounds: Any = parts.bounds[0]

    def error(t: jax.Array) -> jax.Array:
        middle = parts.reference.position(t)
        lower, upper = bounds_at(bounds, t, middle)
        zero = jnp.zeros(1)
        tube = OpenTube(zero, zero, lower - middle, upper - middle, zero, zero)
        return parts.law.barriers[0].error_at(value, tube, sign > 0)  # type: ignore[return-value]

    c = centre(t)
    return error(c) + derivative(error)(t) * (t - c)


def lyapunov_rate(
    constants: Constants, observed: tuple[bool, ...], true: TruePlant, point: ChainMotionPoint
) -> jax.Array:
    """V' of (C.5), ()."""
    parts, now, equations = constants.parts, point.now, true.equations
    law, y = parts.law, now.y
    total = jnp.zeros(1)
    for i in range(parts.order):
        slope = equations.barrier_slope(i, y)
        total = total - equations.weighted_dissipation(i, y, point.energy[i])
        total = total - law.c[i] * law.weights[i] * slope**2
        push = slope * now.d_tilde[i]
        if i > 0:
            push = push + equations.slope_by_centre(i, y) * now.delta[i]
        total = total + law.weights[i] * push
        if observed[i]:
            d_rate = chain_motion.mismatch_rate(equations, true, i, now)
            d_tilde = now.d_tilde[i]
            fall = d_tilde * d_rate - parts.kappa[i] * d_tilde**2
            total = total + constants.weights[i] * fall
    return total[0]


def chain_bound(
    places: Places, observed: tuple[bool, ...], x: jax.Array, constants: Constants
) -> jax.Array:
    """Upper bounds of V' over the box x, (1,)."""
    order = constants.parts.order
    angles = order + sum(observed) - 1
    unit_vector = sphere([x[1 + k] for k in range(angles)])
    start = 1 + angles
    z = x[start : start + places.coordinates]
    signs = x[start + places.coordinates : -1]
    true = TruePlant(constants, places, z, is_box=True)
    point = chain_motion_point(constants, observed, true, x[-1] + x[0], unit_vector, signs)
    rate = lyapunov_rate(constants, observed, true, point)
    return jnp.where(true.equations.inside_guards(point.now.y), rate, jnp.inf)

"""The equations of barrier backstepping, level by level, for a plant in strict-feedback form.

`exact_levels` computes (S.2) with the derivatives of the virtual controls along the flow of the
model, and `filtered_levels` with filters in their place; `barrier_backstepping` has the equations.

All derivatives are along one trajectory (`core.taylor`): those of x_j of the orders up to r - j,
those of the reference and of the bounds, and then, level by level, those of alpha_i and of w_i s_i
of the orders up to r - i.  A *curve* is the list [y, y', y'', ...] at t.  `i` counts rows of x from
0, `level` = i + 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers import Barrier
from iblf_jax.control.controllers._base import LawContext
from iblf_jax.control.decays import Decay, Exponential
from iblf_jax.control.decays._base import gain_at
from iblf_jax.core import taylor
from iblf_jax.core.linalg import matvec, solve_spd
from iblf_jax.world import plants
from iblf_jax.world.bounds import Tube, bounds_at
from iblf_jax.world.plants import Plant


class Design(NamedTuple):
    """The barrier and the gains of one level of the law."""

    barrier: Barrier
    k: jax.Array
    """Gain, (n,) [1/s]."""
    o: jax.Array | None = None
    """Margin under the root of kappa, (n,) [1/s^2]; None for barriers without it."""
    c: jax.Array | None = None
    """Gain of the slope, (n,); None for 0."""
    weight: jax.Array | None = None
    """w_i, (n,); None for 1."""
    decay: Decay = Exponential()
    """Of V_i; it makes the gain a function of the time and of V_i."""
    gain_matrix: jax.Array | None = None
    """K of (S.6), (n, n); None for W."""
    weight_matrix: jax.Array | None = None
    """W of (S.6), (n, n); None for the unit matrix."""
    damping: jax.Array | None = None
    """gamma of the nonlinear damping (S.5), (n,); None for none."""
    regressor: Callable | None = None
    """phi(t, x), (r, n, m), of the nonlinear damping."""

    def slope(self, tube: Tube, position: jax.Array) -> jax.Array:
        """The slope of the level without its weight w, (n,)."""
        if self.weight_matrix is None:
            return self.barrier.slope(tube, position)
        return matvec(self.weight_matrix, position - tube.q_d)

    def value(self, tube: Tube, position: jax.Array) -> jax.Array:
        """V_i without its weight w, (n,); with a matrix only the sum over the components has a
        meaning.
        """
        if self.weight_matrix is None:
            return self.barrier.value(tube, position)
        error = position - tube.q_d
        return 0.5 * error * matvec(self.weight_matrix, error)

    def virtual_velocity(self, t: jax.Array, tube: Tube, position: jax.Array) -> jax.Array:
        """The virtual velocity a_i of the level, (n,), by its gain at this time."""
        gain = gain_at(self.decay, t, self.k, self.barrier, tube, position)
        if self.gain_matrix is None:
            return self.barrier.virtual_velocity(tube, position, gain, self.o)
        feedback = matvec(self.gain_matrix, gain * (position - tube.q_d))
        if self.weight_matrix is not None:
            feedback = solve_spd(self.weight_matrix, feedback)
        return tube.dq_d - feedback

    def coupling(self, tube: Tube, position: jax.Array, power: jax.Array) -> jax.Array:
        """The rate a, (n,), for which (w s) . a is e . power: power e/(w s), or W^-1 power/w."""
        if self.weight_matrix is not None:
            rate = solve_spd(self.weight_matrix, power)
        else:
            ratio: Any = self.barrier.error_over_slope(tube, position)
            rate = power * ratio
        if self.weight is not None:
            rate = rate / self.weight
        return rate

    def slope_gain(self, i: int, t: jax.Array, x: jax.Array) -> jax.Array | None:
        """The gain c + gamma |phi|^2 of the slope (S.5), (n,), of the level in row i of x; None for
        0.
        """
        if self.damping is None or self.regressor is None:
            return self.c
        added = self.damping * jnp.sum(self.regressor(t, x)[i] ** 2, axis=-1)
        return added if self.c is None else self.c + added


class Level(NamedTuple):
    """The results of one level of the law."""

    alpha: jax.Array
    """The virtual control alpha_i, which level i + 1 follows, (n,); u for the last level."""
    slope: jax.Array
    """w_i s_i, (n,)."""


def exact_levels(
    designs: Sequence[Design],
    t: jax.Array,
    x: jax.Array,
    d_hat: jax.Array,
    context: LawContext,
) -> tuple[list[Level], list[Tube]]:
    """All levels of (S.2) and their tubes, with the derivatives along the flow of the model.

    Args:
      designs: one for each level.
      t: time, () [s].
      x: state, (r, n).
      d_hat: estimate of what disturbances add to x', (r, n), or of the torque on the robot inside
        the plant, (n,) [N m].
      context: model, reference and bounds.
    """
    model, order = plants.as_plant(context.model), len(designs)
    state_curve = _curve_of_state(model, t, x, d_hat)
    time_curve = taylor.curve_of_time(t, order + 1)
    centre_curve = taylor.in_time(context.reference.position, t, order)
    slope_curve: list[Any] = [None] * order
    levels: list[Level] = []
    tubes: list[Tube] = []
    for i, design in enumerate(designs):
        terms = order - i  # the virtual control, and its derivatives that the levels above need
        lower, upper = _curve_of_bounds(
            context, i + 1, time_curve[: terms + 1], centre_curve[: terms + 1]
        )
        # The tube with its rates, and its derivatives.
        tube_curve = [_tube_of(centre_curve, lower, upper, m) for m in range(terms)]
        if i == order - 1:
            tube_curve = [context.shifted_tube(tube_curve[0])]
        level_at = partial(_level, design, i, model, d_hat)
        curves = (time_curve[:terms], state_curve[:terms], tube_curve, slope_curve[:terms])
        level_curve = taylor.along(level_at, list(zip(*curves, strict=True)))
        levels.append(level_curve[0])
        tubes.append(tube_curve[0])
        centre_curve = [level.alpha for level in level_curve]
        slope_curve = [level.slope for level in level_curve]
    return levels, tubes


def filtered_levels(
    designs: Sequence[Design],
    time_constants: jax.Array,
    form: str,
    t: jax.Array,
    x: jax.Array,
    d_hat: jax.Array,
    context: LawContext,
    state: jax.Array,
) -> tuple[list[Level], list[Tube]]:
    """All levels with filters in the place of exact derivatives, and the tubes of x_i - xi_i;
    arguments as `exact_levels`.

    Args:
      time_constants: mu_i of the filters, (r - 1, n) [s].
      form: one of `barrier_backstepping.FORMS`.
      state: beta_i, (r - 1, n), and below them xi_i, (r - 1, n), of the form "compensated".
    """
    model = plants.as_plant(context.model)
    last = len(designs) - 1
    compensations: Any = [None] * len(designs)
    if form == "compensated":
        compensations = compensations_of(state)
    levels: list[Level] = []
    tubes = [context.tube(t, acceleration=False)]
    slope = None
    for i, design in enumerate(designs):
        levels.append(_level(design, i, model, d_hat, t, x, tubes[i], slope, compensations[i]))
        slope = levels[i].slope
        if i == last:
            break
        alpha = levels[i].alpha
        rate = (alpha - state[i]) / time_constants[i]
        # The tube of the next level is around the virtual control or around its filter's output.
        centre = alpha if form == "derivative" else state[i]
        times = taylor.curve_of_time(t, 2)
        lower, upper = _curve_of_bounds(context, i + 2, times, [centre, rate])
        tube = _tube_of([centre, rate], lower, upper, 0)
        if i + 1 == last:
            tube = context.shifted_tube(tube)
        tubes.append(tube)
    return levels, tubes


def compensations_of(state: jax.Array) -> jax.Array:
    """xi_i of all levels, (r, n), from the state of a compensated law; xi_r is 0."""
    below_the_last = state[len(state) // 2 :]
    return jnp.concatenate([below_the_last, jnp.zeros_like(below_the_last[:1])])


def compensation_rates(
    designs: Sequence[Design],
    levels: Sequence[Level],
    t: jax.Array,
    x: jax.Array,
    context: LawContext,
    state: jax.Array,
) -> jax.Array:
    """xi_i' of a compensated law (S.4), (r - 1, n); arguments as `filtered_levels`."""
    model, xi = plants.as_plant(context.model), compensations_of(state)
    rates = []
    for i, design in enumerate(designs[:-1]):
        lag_of_filter = state[i] - levels[i].alpha
        effect = plants.gain_times(model, i + 1, t, x, lag_of_filter + xi[i + 1])
        rates.append(effect - design.k * xi[i])
    return jnp.stack(rates)


def _level(
    design: Design,
    i: int,
    model: Plant,
    d_hat: jax.Array,
    t: jax.Array,
    x: jax.Array,
    tube: Tube,
    slope_below: jax.Array | None,
    compensation: jax.Array | None = None,
) -> Level:
    """The virtual control alpha and the weighted slope of level i + 1 of (S.2).

    Args:
      design: of the level.
      i: its row in x.
      model: of the law.
      d_hat, t, x: as `exact_levels`.
      tube: of x[i] around the virtual control of the level below; its positions are in the unit of
        the level.
      slope_below: the weighted slope of the level below, (n,); None for the first level.
      compensation: xi_i of a compensated law, (n,); None for other laws.
    """
    level = i + 1
    below = level - 1
    position = x[i] if compensation is None else x[i] - compensation
    slope = design.slope(tube, position)
    rate = design.virtual_velocity(t, tube, position)
    if slope_below is not None:
        power = plants.transposed_gain(model, below, t, x, slope_below)
        rate = rate - design.coupling(tube, position, power)
    slope_gain = design.slope_gain(i, t, x)
    if slope_gain is not None:
        rate = rate - slope_gain * slope
    if compensation is not None:
        rate = rate - design.k * compensation
    rates, torque = _rates_and_torque(d_hat)
    if rates is not None:
        rate = rate - rates[i]
    alpha = plants.level_input(model, level, t, x, rate, torque)
    if design.weight is not None:
        slope = design.weight * slope
    return Level(alpha, slope)


def _tube_of(
    centre: list[jax.Array], lower: list[jax.Array], upper: list[jax.Array], m: int
) -> Tube:
    """Derivative m of a tube and of its rates, from the curves of its centre and of its bounds."""
    return Tube(centre[m], centre[m + 1], lower[m], upper[m], lower[m + 1], upper[m + 1])


# --- curves in time -----------------------------------------------------------------------------


def _curve_of_state(model: Plant, t: jax.Array, x: jax.Array, d_hat: jax.Array) -> list[jax.Array]:
    """The state and its derivatives along the flow of the model, of the orders 0 to r - 1, (r, n)
    each.

    Level j, counted from 1, is known up to the order r - j, because the input is not known yet.
    Entries beyond that are 0 and are not used.
    """
    rates, torque = _rates_and_torque(d_hat)
    order = model.order
    zero = jnp.zeros_like(x[0])

    def rates_below_the_last(t, x):
        rows = []
        for level in range(1, order):
            rate = plants.level_rate(model, level, t, x, x[level], torque)
            if rates is not None:
                rate = rate + rates[level - 1]
            rows.append(rate)
        return jnp.stack(rows)

    curve = [x]
    for m in range(1, order):
        points = list(zip(taylor.curve_of_time(t, m), curve, strict=True))
        # Derivative m of the state is derivative m - 1 of its rate.
        latest = taylor.along(rates_below_the_last, points)[-1]
        known = [latest[j] for j in range(order - m)]
        curve.append(jnp.stack([*known, *[zero] * m]))
    return curve


def _curve_of_bounds(
    context: LawContext, level: int, times: list[jax.Array], centre: list[jax.Array]
) -> tuple[list[jax.Array], list[jax.Array]]:
    """The bounds of a level and their derivatives, as many as those of its centre.

    A level without bounds has a tube of constant width.  Its barrier is `Quadratic`, which does not
    use the width.
    """
    bounds = context.bounds[level - 1]
    if bounds is None:
        return [centre[0] - 1.0, *centre[1:]], [centre[0] + 1.0, *centre[1:]]

    def sides(t, centre):
        return bounds_at(bounds, t, centre)

    followed = _followed(context, level)
    if followed is None:
        curve = taylor.along(sides, list(zip(times, centre, strict=True)))
    else:
        curve = taylor.in_time(lambda t: sides(t, followed(t)), times[0], len(times) - 1)
    return [lower for lower, _ in curve], [upper for _, upper in curve]


def _followed(context: LawContext, level: int) -> Callable | None:
    """The function of time that the bounds of a level may follow, such as a funnel does: x_d, or
    x_d' for the velocities of a robot; None for the virtual control below the level.
    """
    position = context.reference.position
    if level == 1:
        return position
    if level == 2 and plants.as_plant(context.model).reference_levels == 2:
        return lambda t: jax.jvp(position, (t,), (jnp.ones_like(t),))[1]
    return None


def _rates_and_torque(d_hat: jax.Array) -> tuple[jax.Array | None, jax.Array | float]:
    """The rates that an estimate adds to the levels, (r, n), and the torque that it adds to the
    robot, (n,) [N m].  An estimate is one of the two; the other is None, or 0.0.
    """
    if d_hat.ndim == 2:
        return d_hat, 0.0
    return None, d_hat

"""The terms of the claim about a plant in strict-feedback form, at one state of the closed loop.

The claim (S.3) is about `controllers.BarrierBackstepping`, whose Lyapunov function V = sum w_i V_i
depends on the time, on the state x of the model and on the estimate d_hat, through the errors and
through the virtual controls.  With d_tilde = d - d_hat,

    V' <= -sum w_i decay_i - sum c_i w_i |s_i|^2 + T
    T  = dV/dx . d_tilde + dV/dd_hat . d_hat'                                                 (S.3)

for any observer, because the law replaces x' by the flow of the model with the estimate and holds
the estimate.  dV/dx contains w_i s_i in level i, and dV_i/dalpha_{i-1} times the derivatives of
alpha_{i-1} in the levels below it; dV_i/dalpha_{i-1} is taken at fixed x_i and t, so that it moves
the error and the tube.  An observer with d_tilde' = d' - kappa d_tilde has d_hat' = kappa d_tilde
(`Observer.error_gain`), which is checked by itself.  Without an observer d_hat = 0 and
d_tilde = d.  A torque observer of the robot inside the plant gives f_hat, which is held, while
d_hat = M0^-1 f_hat in the second level is not: T has dV/df_hat . f_hat' then, and
f_hat' = kf f_tilde.

For barriers that decay exactly (`Barrier.exact_decay`), (S.3) is an equality.

With filters, beta_i takes the place of alpha_i in the errors and its rate is known exactly, so that
T = sum w_i s_i . d_tilde_i + sum w_i s_i . G_i (beta_i - alpha_i).  The last sum is the effect of
the filters' lag; it does not vanish with d_tilde, and only ultimate boundedness follows.

The auxiliary state lambda of a limited input (`controllers.Saturated`) moves the centre of the last
tube to alpha_{r-1} + lambda.  The claim then includes the instants at which the input is limited,
and T has the term (w_{r-1} s_{r-1})^T G_{r-1} lambda of (A.3), which is of the form of the lag.

V' is exact: dV/d(t, x, d_hat, state of the law), by forward-mode differentiation, times the rates
of these along the vector field of the whole loop.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from iblf_jax.certificates.auxiliary import covers_limit, inner_context, inner_state
from iblf_jax.certificates.claims import adaptive_law, own_claim, states_disturbance_terms
from iblf_jax.certificates.proof_terms import TORQUE_ROUNDING, OwnTerms
from iblf_jax.control.controllers import BarrierBackstepping, Law
from iblf_jax.control.controllers._base import decay_of
from iblf_jax.control.decays._base import gain_at
from iblf_jax.core.linalg import solve_spd
from iblf_jax.core.pytree import unwrapped
from iblf_jax.simulation.closed_loop import LoopState, evaluate, plant_input
from iblf_jax.simulation.levels import estimate
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Sample, margin_of
from iblf_jax.world import plants
from iblf_jax.world.bounds import NARROWEST, Tube

LEVEL_TERMS = "dV/dx . d_tilde + dV/dd_tilde . d'"
"""T of a law that receives the levels and has no `disturbance_terms`."""


class ClaimTerms(NamedTuple):
    """The terms of (S.3), () each unless noted."""

    dV: jax.Array
    """V', exact."""
    decay: jax.Array
    """sum w_i decay_i, where decay_i is at least the barrier's stated rate times V_i, for the gain
    k_i(t, V_i) of the instant."""
    by_slopes: jax.Array
    """sum c_i w_i |s_i|^2."""
    disturbance_terms: jax.Array
    """T, without the lag of filters."""
    lag: jax.Array
    """sum w_i s_i . G_i (c_i - alpha_i), c_i the centre of the tube of level i + 1, of a law with
    filters or with an auxiliary state, else 0."""
    size: jax.Array
    """Sum of the absolute values of the terms of V': rounding is relative to it."""
    sqrt_V_size: jax.Array
    """Error of sqrt(2 V) for a relative error of 1."""
    xi: jax.Array
    """Errors relative to their bounds, (r, n); 0 in levels without bounds."""
    e: jax.Array
    """Errors x_i - alpha_{i-1}, (r, n), in the units of the levels."""
    alpha_distance: jax.Array
    """Distance of alpha_{i-1} to the bounds of level i, (r, n); infinite without bounds."""
    k_l: jax.Array
    """Lower side of the tubes, (r, n), in the units of the levels."""
    k_u: jax.Array


class LevelTerms(NamedTuple):
    """The terms at one instant; along a run a time axis comes first."""

    V: jax.Array
    """sum w_i V_i, (); of other laws, V of the sample."""
    d: jax.Array
    """What x' differs from the flow of the model, (r, n), in units of the levels per second."""
    d_tilde: jax.Array
    """d - d_hat, (r, n)."""
    x_distance: jax.Array
    """Distance of x_i to the bounds of level i, (r, n); infinite without bounds."""
    estimate_error: jax.Array
    """d_hat' - kappa d_tilde, (r, n), or f_hat' - kf f_tilde, (n,), of an observer that states
    kappa, else 0."""
    estimate_size: jax.Array
    """Sum of the absolute values of the terms of `estimate_error`, of its shape."""
    excluded: jax.Array
    """Whether the claims exclude this instant, () bool: the guard at a bound or a limit of the
    input is active, or alpha_{i-1} is outside the bounds of level i."""
    claim: Any = ()
    """`ClaimTerms` of a `BarrierBackstepping`."""
    own: Any = ()
    """`OwnTerms` of a law that states a claim about itself."""

    @property
    def sqrt_V_size(self) -> jax.Array:
        """Error of sqrt(2 V) for a relative error of 1, ()."""
        return self.claim.sqrt_V_size  # type: ignore[no-any-return]


def is_about_levels(scenario: Scenario) -> bool:
    """Whether the law of a scenario receives the levels of the plant, so that (S.3), and not
    Theorem 2, is the claim to check.
    """
    return isinstance(unwrapped(scenario.controller), Law)


def level_terms_at(scenario: Scenario, t: jax.Array, state: LoopState) -> LevelTerms:
    """The terms at one state; pure, for `vmap` over states, times and gains.

    Args:
      scenario: canonical, with a law that receives the levels.
      t: time, () [s].
      state: state of the loop at t.
    """
    return level_terms_and_sample(scenario, t, state)[0]


def level_terms_and_sample(
    scenario: Scenario, t: jax.Array, state: LoopState
) -> tuple[LevelTerms, Sample]:
    """The terms at one state, and the sample that a run records there."""
    state_rate, sample = evaluate(scenario, t, state)
    law = unwrapped(scenario.controller)
    at, tangent = _point_and_rate(scenario, t, state, state_rate)
    d = _disturbance(scenario, state, state_rate, sample)
    d_tilde = d - _as_rates(scenario, at.x, at.estimate)
    sizes = _rate_sizes(scenario, at, d, d_tilde, tangent.x)
    estimate_error, estimate_size = _estimate_error(scenario, at, tangent, d_tilde, sizes)
    excluded = jnp.any(sample.guard_active)
    if not covers_limit(scenario):
        excluded |= jnp.any(sample.saturated) | _input_was_limited(scenario, at)
    V = sample.V
    claim: Any = ()
    own: Any = ()
    if isinstance(law, BarrierBackstepping):
        V, claim = _claim_terms(scenario, at, tangent, d_tilde, sizes)
        # e_i has no tube where alpha_{i-1} is outside the bounds of level i.
        excluded |= jnp.any(claim.alpha_distance <= NARROWEST)
    if own_claim(scenario) is not None:
        own = _own_terms(scenario, t, state, state_rate)
    terms = LevelTerms(
        V,
        d,
        d_tilde,
        _distances(scenario, sample, at.x),
        estimate_error,
        estimate_size,
        excluded,
        claim,
        own,
    )
    return terms, sample


class _Point(NamedTuple):
    """The arguments of V, or their rates along the loop."""

    t: jax.Array
    x: jax.Array
    estimate: jax.Array
    law_state: Any


def _point_and_rate(
    scenario: Scenario, t: jax.Array, state: LoopState, state_rate: LoopState
) -> tuple[_Point, _Point]:
    """The arguments of V at one state, and their rates."""
    loop = scenario.loop
    order = loop.model.order

    def estimated(t, state):
        return estimate(scenario, loop.observer, t, state.x[:order], state.observer)

    found, rates = jax.jvp(estimated, (t, state), (jnp.ones_like(t), state_rate))
    at = _Point(t, state.x[:order], found, state.controller)
    return at, _Point(jnp.ones_like(t), state_rate.x[:order], rates, state_rate.controller)


def _as_rates(scenario: Scenario, x: jax.Array, estimate: jax.Array) -> jax.Array:
    """An estimate as d_hat, (r, n): M0^-1 f_hat in the second level for a torque f_hat."""
    if estimate.ndim == 2:
        return estimate
    return plants.torque_as_rates(scenario.loop.model, x, estimate)


def _disturbance(
    scenario: Scenario, state: LoopState, state_rate: LoopState, sample: Sample
) -> jax.Array:
    """What x' differs from the flow of the model, (r, n)."""
    if plants.is_chain(scenario.model):
        return sample.disturbance
    # The sample of a robot has a torque.
    rates = solve_spd(scenario.model.mass_matrix(state.q), sample.disturbance)
    return jnp.stack([state_rate.q - state.dq, rates])


def _distances(scenario: Scenario, sample: Sample, x: jax.Array) -> jax.Array:
    """Distances of the levels of the model to their bounds, (r, n); infinite without bounds."""
    bounded = len(sample.level_lower[: len(x)])
    rows = [margin_of(sample, level, x[level - 1]) for level in range(1, bounded + 1)]
    return jnp.full_like(x, jnp.inf).at[:bounded].set(jnp.stack(rows))


def _input_was_limited(scenario: Scenario, at: _Point) -> jax.Array:
    """Whether a wrapper around the law changed its input, () bool.  A smooth limit changes it
    before the limit is reached, which the status flags do not show.
    """
    law: Any = adaptive_law(scenario) or unwrapped(scenario.controller)
    if law is scenario.controller:
        return jnp.zeros((), bool)
    own_state = inner_state(scenario, at.law_state)
    own, _ = law.command(*at[:3], scenario.context, own_state)
    limited, _ = scenario.loop.law.command(*at[:3], scenario.context, at.law_state)
    u, applied = plant_input(own), plant_input(limited)
    tolerance = TORQUE_ROUNDING * jnp.finfo(u.dtype).eps * jnp.abs(u)
    return jnp.any(jnp.abs(applied - u) > tolerance)


# --- (S.3) ----------------------------------------------------------------------------------------


def _claim_terms(
    scenario: Scenario, at: _Point, tangent: _Point, d_tilde: jax.Array, sizes: jax.Array
) -> tuple[jax.Array, ClaimTerms]:
    """V = sum w_i V_i, and the terms of (S.3) at one state."""
    law: Any = unwrapped(scenario.controller)
    flat, unflattened = ravel_pytree(at)

    def value(flat):
        point = unflattened(flat)
        context = inner_context(scenario, point.law_state)
        own_state = inner_state(scenario, point.law_state)
        levels, tubes = law.levels(*point[:3], context, own_state)
        values = [
            jnp.sum(w * barrier.value(tube, x))
            for w, barrier, tube, x in zip(law.weights, law.barriers, tubes, point.x, strict=True)
        ]
        V = jnp.sum(jnp.stack(values))
        return V, (V, levels, tubes)

    flat_slopes, (V, levels, tubes) = jax.jacfwd(value, has_aux=True)(flat)
    slopes = unflattened(flat_slopes)
    products = jax.tree.map(lambda slope, rate: jnp.sum(slope * rate), slopes, tangent)
    disturbance_terms = jnp.sum(slopes.x * d_tilde)
    disturbance_terms += jnp.sum(slopes.estimate * tangent.estimate)
    decay, by_slopes, size, square = (jnp.zeros_like(at.t) for _ in range(4))
    rows: dict[str, list[jax.Array]] = {"xi": [], "e": [], "distance": [], "k_l": [], "k_u": []}
    gaps = []
    for i, (level, tube, barrier) in enumerate(zip(levels, tubes, law.barriers, strict=True)):
        w, x = law.weights[i], at.x[i]
        # The claim holds for the gain of the instant, which a decay makes a function of t and V_i.
        gain = gain_at(decay_of(law, i), at.t, law.k[i], barrier, tube, x)
        stated = barrier.decay_rate(gain)
        if stated is not None:
            decay += jnp.sum(w * stated * barrier.value(tube, x))
        by_slopes += jnp.sum(law.c[i] * level.slope**2 / w)
        xi = _relative_error(scenario, i, tube, x)
        gap = _gap(xi, barrier.guard)
        gaps.append(gap)
        size += jnp.sum(jnp.abs(level.slope) / gap * (jnp.abs(tube.dq_d) + gain * jnp.abs(x)))
        near = jnp.abs(x) + jnp.abs(tube.q_d)
        square += jnp.sum(w * (near / gap) ** 2 / _ratio_at_centre(barrier, tube))
        rows["xi"].append(xi)
        rows["e"].append(x - tube.q_d)
        rows["distance"].append(_centre_distance(scenario, i, tube))
        rows["k_l"].append(tube.k_l)
        rows["k_u"].append(tube.k_u)
    size += jnp.sum(jnp.abs(slopes.x) / jnp.stack(gaps) * sizes)
    size += sum(jnp.abs(product) for product in jax.tree.leaves(products))
    size += decay + by_slopes
    return V, ClaimTerms(
        jnp.sum(jnp.stack(jax.tree.leaves(products))),
        decay,
        by_slopes,
        disturbance_terms,
        _lag(scenario, at, levels, tubes),
        size,
        jnp.sqrt(square),
        *(jnp.stack(row) for row in rows.values()),
    )


def _lag(scenario: Scenario, at: _Point, levels: list, tubes: list) -> jax.Array:
    """Sum of w_i s_i . G_i (c_i - alpha_i), c_i the centre of the tube of level i + 1, (); 0 for a
    law without filters and without an auxiliary state.
    """
    law: Any = unwrapped(scenario.controller)
    total = jnp.zeros_like(at.t)
    if law.filter is None and not covers_limit(scenario):
        return total
    plant = plants.as_plant(scenario.model)
    for i, (level, above) in enumerate(zip(levels[:-1], tubes[1:], strict=True)):
        effect = plants.transposed_gain(plant, i + 1, at.t, at.x, level.slope)
        total += jnp.sum(effect * (above.q_d - level.alpha))
    return total


def _relative_error(scenario: Scenario, i: int, tube: Tube, x: jax.Array) -> jax.Array:
    """The relative error of level i + 1, (n,); 0 without bounds."""
    if scenario.context.bounds[i] is None:
        return jnp.zeros_like(x)
    return tube.xi(x)


def _centre_distance(scenario: Scenario, i: int, tube: Tube) -> jax.Array:
    """Distance of the centre of the tube of level i + 1 to its bounds, (n,); infinite without
    bounds.
    """
    if scenario.context.bounds[i] is None:
        return jnp.full_like(tube.q_d, jnp.inf)
    return jnp.minimum(tube.q_d - tube.lower, tube.upper - tube.q_d)


def _gap(xi: jax.Array, guard: float) -> jax.Array:
    """Distance to the bound relative to the width of the tube, in [guard, 1]; 1 for a barrier
    without a guard.
    """
    if not guard > 0:
        return jnp.ones_like(xi)
    return jnp.clip(1.0 - jnp.abs(xi), guard, 1.0)


def _ratio_at_centre(barrier: Any, tube: Tube) -> jax.Array:
    """e/s at e = 0, (n,); that of k^2/2 for a barrier without one."""
    stated = barrier.error_over_slope(tube, tube.q_d)
    if stated is None:
        return 0.5 * jnp.minimum(tube.k_l, tube.k_u) ** 2
    return stated  # type: ignore[no-any-return]


def _rate_sizes(
    scenario: Scenario, at: _Point, d: jax.Array, d_tilde: jax.Array, dx: jax.Array
) -> jax.Array:
    """Sums of the absolute values of the terms of x', (r, n): f_i, G_i x_{i+1}, d_i and d_hat_i."""
    plant = plants.as_plant(scenario.model)
    zero = jnp.zeros_like(at.x[0])
    drift = jnp.stack(
        [plants.level_rate(plant, i + 1, at.t, at.x, zero, 0.0) for i in range(len(at.x))]
    )
    driven = dx - d - drift
    return jnp.abs(drift) + jnp.abs(driven) + jnp.abs(d) + jnp.abs(d_tilde)


# --- the estimate ---------------------------------------------------------------------------------


def _estimate_error(
    scenario: Scenario, at: _Point, tangent: _Point, error: jax.Array, sizes: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The error of d_hat' = kappa d_tilde and the size of its terms; 0 without a stated kappa."""
    zero = jnp.zeros_like(at.estimate)
    kappa = scenario.observer.error_gain
    if kappa is None:
        return zero, zero
    x = at.x
    if at.estimate.ndim == 1:
        # A torque observer: f_tilde = M0 d_tilde_2.
        M0 = plants.robot_of(scenario.model).mass_matrix(x[0])
        error, sizes, x = M0 @ error[1], jnp.abs(M0) @ sizes[1], jnp.abs(M0) @ jnp.abs(x[1])
    elif jnp.ndim(kappa) == 1:
        kappa = kappa[:, None]
    size = jnp.abs(tangent.estimate) + kappa * (sizes + jnp.abs(error) + jnp.abs(at.estimate))
    return tangent.estimate - kappa * error, size + kappa**2 * jnp.abs(x)


# --- the claim of a law about itself --------------------------------------------------------------


def _own_terms(
    scenario: Scenario, t: jax.Array, state: LoopState, state_rate: LoopState
) -> OwnTerms:
    """The terms of the law's claim about itself at one state, with x in the place of q and q', and
    d_tilde in the place of f_tilde.
    """
    law: Any = own_claim(scenario)
    context = scenario.context._replace(plant=scenario.plant)
    uses_observer = law.uses_observer

    def disturbances(t, state):
        state_rate, sample = evaluate(scenario, t, state)
        d = _disturbance(scenario, state, state_rate, sample)
        at, _ = _point_and_rate(scenario, t, state, state_rate)
        return d, d - _as_rates(scenario, at.x, at.estimate)

    along = (jnp.ones_like(t), state_rate)
    (d, d_tilde), (dd, dd_tilde) = jax.jvp(disturbances, (t, state), along)
    if not uses_observer:
        d_tilde, dd_tilde = d, dd
    at, tangent = _point_and_rate(scenario, t, state, state_rate)
    at = at._replace(law_state=inner_state(scenario, at.law_state))
    tangent = tangent._replace(law_state=inner_state(scenario, tangent.law_state))

    def lyapunov(t, x, d_tilde, law_state):
        return jnp.sum(law.lyapunov(t, x, d_tilde, context, law_state))

    point = (t, at.x, d_tilde, at.law_state)
    direction = (tangent.t, tangent.x, dd_tilde, tangent.law_state)
    V, dV = jax.jvp(lyapunov, point, direction)
    decay = jnp.sum(law.decay(*point[:3], context, at.law_state))
    slopes = jax.grad(lyapunov, argnums=(0, 1, 2, 3))(*point)
    if states_disturbance_terms(law):
        terms = jnp.sum(law.disturbance_terms(*point[:3], dd, context, at.law_state))
    else:
        terms = jnp.sum(slopes[1] * d_tilde) + jnp.sum(slopes[2] * dd)
    sizes = _rate_sizes(scenario, at, d, d_tilde, tangent.x)
    products = jax.tree.map(lambda a, b: jnp.sum(jnp.abs(a * b)), slopes, direction)
    size = sum(jax.tree.leaves(products)) + jnp.sum(jnp.abs(slopes[1]) * sizes)
    size += jnp.abs(decay) + jnp.abs(terms)
    return OwnTerms(V, dV, decay, terms, size, jnp.zeros((), bool))

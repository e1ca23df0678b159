"""The terms of the proof of Theorem 2 at one state of the closed loop.

The inequality V2' + rho V2 - 1/2 |f'|^2 <= 0 is a statement about states, not about runs. It is
therefore checked at each state with exact rates: V2' and f' are the derivatives of V2(t, x) and
f(t, x) along the vector field of the whole loop,

    V2' = dV2 . (1, x'),   f' = df . (1, x'),
    x = (q, q', state of the law, state of the observer),

by forward-mode differentiation of `closed_loop.evaluate`. No differences along a run are used. When
plant and model differ, f contains q" and tau, and its rate is still exact.

The printed proof drops two terms of V2', which this module computes:

    law with C0 q':            + 1/2 e2^T M0' e2       dropped in (3.13); zero with C0 alpha, by
                                                       skew symmetry
    observer (3.11), printed:  - f_tilde^T kf M0' q'   since f_tilde' = f' - kf f_tilde - kf M0' q'

The claim V' <= -W + T that a law states about itself (`controllers.LyapunovLaw`) is evaluated in
the same way. T is what the law's `disturbance_terms` returns. For a law without that method it is
the contribution of the uncertain term to V': by (2.1) the acceleration is that of the model under
an exact estimate, plus M0^-1 f_tilde, and f_tilde' = f' - f_hat', so

    T = dV/dq' . M0^-1 f_tilde + dV/df_tilde . f',

where the second term is zero for a V without f_tilde.  Where the law receives estimates x_hat of
levels (`observers.StateObserver`), T also has dV/dq' . M0^-1 (tau(x_hat) - tau(x)), with the true
error of the estimates: it says how much of V' they explain, and bounds nothing in advance.  For a
law that does not use the estimate, the uncertain term f takes the place of f_tilde.

Rounding: V2' is a sum of large terms that cancel, so its error is some units in the last place of
those terms. `ProofTerms.dV_size` is the sum of their absolute values.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from iblf_jax.certificates.auxiliary import covers_limit, inner_state
from iblf_jax.certificates.claims import (
    adaptive_law,
    decay_phi,
    decay_rate,
    own_claim,
    states_disturbance_terms,
)
from iblf_jax.control.controllers import Backstepping, FullState
from iblf_jax.control.controllers._base import decay_of, law_of_x
from iblf_jax.control.decays._base import energy_gain, gain_at
from iblf_jax.control.observers import Printed
from iblf_jax.core.linalg import matvec, solve_spd
from iblf_jax.core.pytree import unwrapped
from iblf_jax.simulation.closed_loop import LoopState, evaluate, rate
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Sample, has, margin_of
from iblf_jax.world import plants
from iblf_jax.world.bounds import NARROWEST
from iblf_jax.world.robots import friction_torque, mass_matrix_rate

DECAY_ROUNDING = 2.0
"""Error of V2' in units of the last place, relative to the sizes of its terms; the largest that
tests found is 0.1."""
TORQUE_ROUNDING = 8.0
"""Units in the last place by which equal torques may differ."""
GENERAL_TERMS = "dV/dq' . M0^-1 f_tilde + dV/df_tilde . f'"
"""T of a law without `disturbance_terms`."""


class FullTerms(NamedTuple):
    """Further terms of the claim of `controllers.FullState`."""

    left: jax.Array
    """(V1 + phi)' + decay rates times V1 and phi - s2 . M0^-1 f_tilde + c |s2|^2, () [1/s].
    (F.2)"""
    xi2: jax.Array
    """e2 relative to its bound, (n,) [1]."""
    bound: jax.Array
    """K of each joint's side, (n,) [rad/s]."""
    alpha_distance: jax.Array
    """Distance of alpha to the velocity bounds, (n,) [rad/s]."""
    growth: jax.Array
    """s2 . M0^-1 f_tilde - c |s2|^2, () [1/s]."""


class OwnTerms(NamedTuple):
    """The terms of a law's claim about itself, () each; along a run a time axis comes first."""

    V: jax.Array
    dV: jax.Array
    """V', exact, in the unit of V a second."""
    decay: jax.Array
    """W."""
    disturbance_terms: jax.Array
    """T."""
    size: jax.Array
    """Sum of the absolute values of the terms of V': rounding is relative to it."""
    limited: jax.Array
    """Whether a torque limit changed the law's torque, () bool: the claim does not apply then."""


class AuxiliaryTerms(NamedTuple):
    """The terms of (A.3) at one instant; along a run a time axis comes first."""

    growth: jax.Array
    """w s . lambda, ()."""
    excluded: jax.Array
    """Whether the guard at the bound is active, or alpha outside its bounds, () bool."""


class ProofTerms(NamedTuple):
    """The terms of the proof at one instant; along a run a time axis comes first."""

    V: jax.Array
    """V2, ()."""
    dV: jax.Array
    """V2', exact, () [1/s]."""
    f: jax.Array
    """The uncertain term, (n,) [N m]."""
    df: jax.Array
    """f', exact, (n,) [N m/s]."""
    f_tilde: jax.Array
    """f - f_hat, (n,) [N m]."""
    df_tilde: jax.Array
    """Its rate, exact, (n,) [N m/s]."""
    e2: jax.Array
    """q' - alpha, (n,) [rad/s]."""
    xi: jax.Array
    lambda_min: jax.Array
    """Smallest eigenvalue of M0(q), () [kg m^2]."""
    lambda_max: jax.Array
    dropped_e2: jax.Array
    """1/2 e2^T M0' e2 for the law as printed, else 0, () [1/s]."""
    dropped_f: jax.Array
    """-f_tilde^T kf M0' q' for the observer as printed, else 0, () [1/s]."""
    steady: jax.Array
    """Whether f' = 0 exactly, () bool: the plant equals the model at this time, and the other
    torque in f is constant."""
    excluded: jax.Array
    """Whether the claims exclude this instant, () bool: the guard at the bound or a torque limit is
    active, or alpha is outside its bounds."""
    dV_size: jax.Array
    """Sum of the absolute values of the terms of V2', () [1/s]: `rounding` times this is the error
    of V2'."""
    sqrt_V_size: jax.Array
    """Error of sqrt(2 V2) for a relative error of 1, ()."""
    mu: jax.Array
    """Smallest eigenvalue of M0^-1 K2, () [1/s]; NaN for a law whose K2 is no torque gain."""
    full: Any = ()
    """`FullTerms` of a law that bounds velocities."""
    own: Any = ()
    """`OwnTerms` of a law that states a claim about itself."""
    auxiliary: Any = ()
    """`AuxiliaryTerms` of a law that takes the shift of the limit around it."""
    decay: Any = ()
    """sum w V1 rate(k1(t, V1)) + e2^T K2 e2 + 2 g(t, W) W of a `Backstepping` law with decays, ()
    [1/s]."""


def rounding(dtype) -> float:
    """The relative error that is attributed to rounding in sums of this floating-point type."""
    return DECAY_ROUNDING * float(jnp.finfo(dtype).eps)


def terms_at(scenario: Scenario, t: jax.Array, state: LoopState) -> ProofTerms:
    """The terms of the proof at one state; pure, for `vmap` over states, times and gains.

    Args:
      scenario: canonical scenario of n joints.
      t: time, () [s].
      state: state of the loop at t.
    """
    terms, M0, _ = terms_and_sample(scenario, t, state)
    eigenvalues = jnp.linalg.eigvalsh(M0)
    mu = 1.0 / jnp.linalg.eigvalsh(mass_over_gain(scenario, M0))[-1]
    return ProofTerms(**terms, lambda_min=eigenvalues[0], lambda_max=eigenvalues[-1], mu=mu)


def mass_over_gain(scenario: Scenario, M0: Any) -> Any:
    """K2^(-1/2) M0 K2^(-1/2), (..., n, n) [s], with the eigenvalues of K2^-1 M0; NaN for laws other
    than the backstepping law.
    """
    law = unwrapped(scenario.controller)
    if not isinstance(law, Backstepping):
        return M0 * jnp.nan
    root = law.K2**0.5
    return M0 / (root[:, None] * root[None, :])


def terms_and_sample(
    scenario: Scenario, t: jax.Array, state: LoopState
) -> tuple[dict[str, Any], jax.Array, Sample]:
    """The `ProofTerms` at one state without the eigenvalues of M0, M0 itself, and the sample that a
    run records there.
    """
    state_rate = rate(scenario, t, state)
    now, rates, sample = jax.jvp(
        partial(_signals, scenario), (t, state), (jnp.ones_like(t), state_rate), has_aux=True
    )
    M0 = scenario.model.mass_matrix(state.q)
    dM0 = mass_matrix_rate(scenario.model, state.q, state.dq)
    f_tilde = now["disturbance"] - now["disturbance_estimate"]
    dropped_e2, dropped_f = _dropped_terms(scenario, dM0, state.dq, now["e2"], f_tilde)
    dV_size, sqrt_V_size = _term_sizes(scenario, t, state, M0, now, rates, f_tilde)
    plant_is_model = _are_equal(scenario.plant.at(t), scenario.model)
    proof = {
        "V": now["V"],
        "dV": rates["V"],
        "f": now["disturbance"],
        "df": rates["disturbance"],
        "f_tilde": f_tilde,
        "df_tilde": rates["disturbance"] - rates["disturbance_estimate"],
        "e2": now["e2"],
        "xi": now["xi"],
        "dropped_e2": dropped_e2,
        "dropped_f": dropped_f,
        "steady": plant_is_model & jnp.all(rates["external"] == 0.0),
        "excluded": (
            jnp.any(sample.guard_active | sample.saturated)
            | _torque_was_limited(scenario, t, state, now)
        ),
        "dV_size": dV_size,
        "sqrt_V_size": sqrt_V_size,
    }
    if own_claim(scenario) is not None:
        proof["own"] = _own_terms(scenario, t, state, state_rate, now, rates)
        proof["excluded"] |= proof["own"].limited
    if covers_limit(scenario):
        proof["auxiliary"] = _auxiliary_terms(sample, now["s"])
    if isinstance(unwrapped(scenario.controller), Backstepping):
        proof["decay"] = _decay_of_backstepping(scenario, t, state, M0, now["e2"])
    if isinstance(unwrapped(scenario.controller), FullState):
        proof["full"] = _full_terms(scenario, t, state, M0, rates, f_tilde)
        # e2 has no tube where alpha is outside the velocity bounds.
        proof["excluded"] |= jnp.any(proof["full"].alpha_distance <= NARROWEST)
    return proof, M0, sample


def _auxiliary_terms(sample: Sample, slope: jax.Array) -> AuxiliaryTerms:
    """The terms of (A.3) for a robot, given w s."""
    excluded = jnp.any(sample.guard_active)
    if has(sample, "dq_lower"):
        excluded |= jnp.any(margin_of(sample, 2, sample.alpha - sample.auxiliary) <= NARROWEST)
    return AuxiliaryTerms(jnp.sum(slope * sample.auxiliary), excluded)


def _signals(scenario: Scenario, t: jax.Array, state: LoopState):
    """The signals that are differentiated along the vector field of the loop, and the sample."""
    state_rate, sample = evaluate(scenario, t, state)
    law = unwrapped(scenario.controller)
    barrier_slope = jnp.zeros_like(state.q)
    if isinstance(law, Backstepping | FullState):
        barrier_slope = law.weight * law.barrier.slope(scenario.context.tube(t), state.q)
    # All of f where the plant is the model: the torques besides that of the law.
    external = jnp.zeros_like(state.q)
    robot = plants.robot_of(scenario.plant.at(t))
    if robot is not None:
        external = scenario.disturbance.torque(t, state.q, state.dq, robot, scenario.model)
        external += friction_torque(robot, state.dq)
    signals = {
        "V": sample.V,
        "disturbance": sample.disturbance,
        "disturbance_estimate": sample.disturbance_estimate,
        "tau": sample.tau,
        "alpha": sample.alpha,
        "xi": sample.xi,
        "e2": sample.e2,
        "dq_d": sample.dq_d,
        "ddq": state_rate.dq,
        "s": barrier_slope,
        "external": external,
    }
    return signals, sample


def _are_equal(one: Any, other: Any) -> jax.Array:
    """Whether two robots are equal, leaf by leaf, () bool."""
    structure: Any = jax.tree.structure(one)
    if structure != jax.tree.structure(other):
        return jnp.zeros((), bool)
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return jnp.all(jnp.stack([jnp.ones((), bool), *(jnp.all(a == b) for a, b in pairs)]))


def _dropped_terms(scenario: Scenario, dM0, dq, e2, f_tilde) -> tuple[jax.Array, jax.Array]:
    """The two terms that the printed proof drops; zero for a law or an observer without them."""
    law, zero = unwrapped(scenario.controller), jnp.zeros_like(e2[0])
    by_law, by_observer = zero, zero
    if isinstance(law, Backstepping) and law.reading == "printed":
        by_law = 0.5 * (e2 @ (dM0 @ e2))
    if isinstance(scenario.observer, Printed):
        by_observer = -f_tilde @ (scenario.observer.kf * (dM0 @ dq))
    return by_law, by_observer


def _torque_was_limited(scenario: Scenario, t: jax.Array, state: LoopState, now) -> jax.Array:
    """Whether a wrapper around the law of Theorem 2 changed its torque, () bool."""
    law = unwrapped(scenario.controller)
    is_law_of_theorem = isinstance(law, Backstepping | FullState)
    adapts = adaptive_law(scenario) is not None
    if law is scenario.controller or not is_law_of_theorem or adapts:
        return jnp.zeros((), bool)
    return _differs_from_command(scenario, law, t, state, now, ())


def _differs_from_command(
    scenario: Scenario, law: Any, t: jax.Array, state: LoopState, now, law_state: Any
) -> jax.Array:
    """Whether the torque differs from the command of a law, () bool. A smooth limit changes it
    before the limit is reached, which the status flags do not show.
    """
    f_hat = now["disturbance_estimate"]
    command, _ = law_of_x(law).command(t, state.x, f_hat, scenario.context, law_state)
    tolerance = TORQUE_ROUNDING * jnp.finfo(command.tau.dtype).eps * jnp.abs(command.tau)
    return jnp.any(jnp.abs(now["tau"] - command.tau) > tolerance)


def _decay_of_backstepping(scenario: Scenario, t: jax.Array, state: LoopState, M0, e2) -> Any:
    """The decay of sum w V1 + 1/2 e2^T M0 e2 with the gains of this instant, (); `()` for a law
    without decays or a barrier without a rate.
    """
    law: Any = unwrapped(scenario.controller)
    if not law.decays:
        return ()
    tube = scenario.context.tube(t)
    gain = gain_at(decay_of(law, 0), t, law.k1, law.barrier, tube, state.q)
    stated = decay_rate(law, gain)
    if stated is None:
        return ()
    decay = jnp.sum(law.weight * stated * law.barrier.value(tube, state.q)) + e2 @ (law.K2 * e2)
    W = 0.5 * e2 @ (M0 @ e2)
    second = decay_of(law, 1)
    if second.constant:
        return decay
    return decay + 2.0 * energy_gain(second, t, W, e2) * W


def _full_terms(
    scenario: Scenario, t: jax.Array, state: LoopState, M0, rates, f_tilde
) -> FullTerms:
    """The terms of (F.2) at one state."""
    law: FullState = unwrapped(scenario.controller)
    outer, inner = law.tubes(t, state.q, state.dq, scenario.context)
    s2 = law.velocity_barrier.slope(inner, state.dq)
    V1 = law.weight * law.barrier.value(outer, state.q)
    phi = law.velocity_barrier.value(inner, state.dq)
    barriers_rate = rates["V"] - f_tilde @ (rates["disturbance"] - rates["disturbance_estimate"])
    decays = jnp.zeros_like(V1)
    gains = (
        gain_at(decay_of(law, 0), t, law.k1, law.barrier, outer, state.q),
        gain_at(decay_of(law, 1), t, law.K2, law.velocity_barrier, inner, state.dq),
    )
    rates_of_barriers = (decay_rate(law, gains[0]), decay_phi(law, gains[1]))
    for stated, value in zip(rates_of_barriers, (V1, phi), strict=True):
        if stated is not None:
            decays = decays + stated * value
    growth = s2 @ solve_spd(M0, f_tilde) - jnp.sum(law.c * s2**2)
    left = barriers_rate + jnp.sum(decays) - growth
    above = state.dq > inner.q_d
    distance = jnp.minimum(inner.q_d - inner.lower, inner.upper - inner.q_d)
    bound = jnp.where(above, inner.k_u, inner.k_l)
    return FullTerms(left, inner.xi(state.dq), bound, distance, growth)


# --- sizes of the terms, for rounding ------------------------------------------------------------


def _gap(xi: jax.Array, guard: float) -> jax.Array:
    """Distance to the bound relative to the width of the tube, in [guard, 1]; 1 for a barrier
    without a guard. Relative errors grow by 1/gap near the bound.
    """
    if not guard > 0:
        return jnp.ones_like(xi)
    return jnp.clip(1.0 - jnp.abs(xi), guard, 1.0)


def _term_sizes(
    scenario: Scenario, t: jax.Array, state: LoopState, M0, now, rates, f_tilde
) -> tuple[jax.Array, jax.Array]:
    """`dV_size` and `sqrt_V_size` of `ProofTerms`."""
    law, zero = unwrapped(scenario.controller), jnp.zeros_like(state.q)
    K2 = zero if law.K2 is None else law.K2
    kf = zero if scenario.observer.kf is None else scenario.observer.kf
    guard = -1.0 if law.barrier is None else law.barrier.guard
    gap = _gap(now["xi"], guard)
    speeds = jnp.abs(state.dq) + jnp.abs(now["alpha"]) + jnp.abs(now["dq_d"])
    accelerations = jnp.abs(now["ddq"]) + jnp.abs(rates["alpha"])
    torque = (
        jnp.abs(M0) @ accelerations
        + jnp.abs(now["tau"])
        + jnp.abs(now["disturbance_estimate"])
        + K2 * speeds
        + jnp.abs(now["s"]) / gap
    )
    torque_rate = (
        jnp.abs(M0) @ jnp.abs(rates["ddq"])
        + jnp.abs(rates["tau"])
        + jnp.abs(rates["disturbance_estimate"])
        + K2 * accelerations
        + kf * torque
        + (jnp.abs(rates["s"]) + jnp.abs(now["s"]) * speeds) / gap
    )
    df, df_tilde = rates["disturbance"], rates["disturbance"] - rates["disturbance_estimate"]
    dV_size = (
        speeds @ (jnp.abs(now["s"]) / gap + torque)
        + (jnp.abs(f_tilde) + jnp.abs(df)) @ torque_rate
        + torque @ jnp.abs(df_tilde)
    )
    if isinstance(law, FullState):
        dV_size += _phi_term_sizes(law, scenario, t, state, M0, torque, accelerations)
    tube = scenario.context.tube(t)
    width = jnp.minimum(tube.k_l, tube.k_u)
    weight = jnp.ones_like(width) if law.weight is None else law.weight
    V_size = (
        jnp.sum(weight * (jnp.abs(state.q) / (width * gap)) ** 2)
        + speeds @ (jnp.abs(M0) @ speeds)
        + torque @ torque
    )
    return dV_size, jnp.sqrt(V_size)


def _phi_term_sizes(
    law: FullState, scenario: Scenario, t: jax.Array, state: LoopState, M0, torque, accelerations
) -> jax.Array:
    """Sum of the absolute values of the terms of phi', () [1/s]."""
    _, inner = law.tubes(t, state.q, state.dq, scenario.context)
    gap = _gap(inner.xi(state.dq), law.velocity_barrier.guard)
    inverse = jnp.stack([solve_spd(M0, row) for row in jnp.eye(torque.size, dtype=torque.dtype)])
    accelerations = accelerations + jnp.sum(jnp.abs(inverse) * torque, axis=1)
    s2 = jnp.abs(law.velocity_barrier.slope(inner, state.dq))
    return (s2 / gap) @ accelerations + jnp.sum(law.c * s2**2)


# --- the claim of a law about itself -------------------------------------------------------------


def _own_terms(
    scenario: Scenario,
    t: jax.Array,
    state: LoopState,
    state_rate: LoopState,
    now: dict[str, jax.Array],
    rates: dict[str, jax.Array],
) -> OwnTerms:
    """The terms of the law's claim about itself at one state.

    Args:
      scenario: canonical, with a law that states a claim about itself.
      t: time, () [s].
      state: of the loop at t.
      state_rate: its rate.
      now, rates: the `_signals` and their rates.
    """
    law: Any = own_claim(scenario)
    of_x: Any = law_of_x(law)
    context, q, dq = scenario.context._replace(plant=scenario.plant), state.q, state.dq
    own_state = inner_state(scenario, state.controller)
    own_rate = inner_state(scenario, state_rate.controller)
    df = rates["disturbance"]
    f_tilde, df_tilde = now["disturbance"], df
    if law.uses_observer:
        f_tilde = f_tilde - now["disturbance_estimate"]
        df_tilde = df_tilde - rates["disturbance_estimate"]

    def lyapunov(t, q, dq, f_tilde, law_state):
        return jnp.sum(of_x.lyapunov(t, jnp.stack([q, dq]), f_tilde, context, law_state))

    point = (t, q, dq, f_tilde, own_state)
    tangent = (jnp.ones_like(t), state_rate.q, state_rate.dq, df_tilde, own_rate)
    V, dV = jax.jvp(lyapunov, point, tangent)
    decay = jnp.sum(of_x.decay(t, state.x, f_tilde, context, own_state))
    slopes = jax.grad(lyapunov, argnums=(0, 1, 2, 3, 4))(*point)
    M0 = scenario.model.mass_matrix(q)
    if states_disturbance_terms(law):
        terms = jnp.sum(of_x.disturbance_terms(t, state.x, f_tilde, df, context, own_state))
    else:
        terms = slopes[2] @ solve_spd(M0, f_tilde) + slopes[3] @ df
        if scenario.loop.observer.completes:
            # The law received estimates: what that changes of the torque acts like f_tilde.
            f_hat = now["disturbance_estimate"]
            command, _ = of_x.command(t, state.x, f_hat, context, state.controller)
            terms += slopes[2] @ solve_spd(M0, now["tau"] - command.tau)
    size = _own_term_sizes(M0, slopes, tangent, now) + jnp.abs(decay) + jnp.abs(terms)
    limited = jnp.zeros((), bool)
    if law is not scenario.controller:
        limited = _differs_from_command(scenario, law, t, state, now, own_state)
    return OwnTerms(V, dV, decay, terms, size, limited)


def _own_term_sizes(M0, slopes, tangent, now) -> jax.Array:
    """Sum of the absolute values of the terms of V'. An acceleration has the rounding error of the
    torques of which it is a difference.
    """

    def product(slope, rate):
        return jnp.sum(jnp.abs(slope) * jnp.abs(rate))

    torques = jnp.abs(matvec(M0, tangent[2]))
    for name in ("tau", "disturbance", "disturbance_estimate"):
        torques = torques + jnp.abs(now[name])
    products = jax.tree.map(product, slopes, tangent)
    return sum(jax.tree.leaves(products)) + product(slopes[2], solve_spd(M0, torques))

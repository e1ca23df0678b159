"""What the closed loop does at one instant, as far as Theorem 2 speaks of it.

The inequality V2' + rho V2 - 1/2 |f'|^2 <= 0 is a statement about states, not about runs.  So it is
checked at each state with the exact rates: V2' and f' are the derivatives of V2(t, x) and f(t, x)
  along the vector field of the whole loop,

    V2' = dV2 . (1, x'),   f' = df . (1, x'),   x = (q, q', state of the law, state of the
    observer),

by forward-mode differentiation of `closed_loop.evaluate`.  No differences along a run enter, and
when plant and model differ, f contains q" and tau, and its rate is right all the same.

The printed proof drops two terms of V2', which this module measures:

    law with C0 q':             + 1/2 e2^T M0' e2              dropped in (3.13); zero with C0
    alpha, by skew symmetry observer (3.11) as printed: - f_tilde^T kf M0' q'          since
      f_tilde' = f' - kf f_tilde - kf M0' q'

Rounding: V2' is a sum of large terms that cancel, so the error of it is some units of the last
  place of those terms, whose sizes
are added up in `ProofTerms.terms`.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from iblf_jax.certificates import own_law
from iblf_jax.certificates.claims import decay_phi, decay_rate, law_of
from iblf_jax.control.controllers import Backstepping, FullState
from iblf_jax.control.observers import Printed
from iblf_jax.core.linalg import solve_spd
from iblf_jax.engine.execute import run_from
from iblf_jax.simulation import jumps
from iblf_jax.simulation.closed_loop import LoopState, evaluate, rate
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Sample
from iblf_jax.world.bounds import NARROWEST
from iblf_jax.world.robots import at_time, friction_torque, mass_matrix_rate

ROUNDING = 2.0
"""Units of the last place by which V2' may be off, relative to the sizes of its terms; 0.1 is the
most that was seen (tests)."""
UNCHANGED = 8.0
"""Units of the last place by which a torque may differ and still be the same."""


class ProofTerms(NamedTuple):
    """The loop at one instant; every field has a leading time axis along a run."""

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
    """Whether f' = 0 exactly, () bool: the plant is the model at this time, and the torque that is
    left in f does not change."""
    held: jax.Array
    """Whether the guard at the wall or a torque limit was at work, or alpha outside its bounds:
    nothing is claimed then, () bool."""
    terms: jax.Array
    """Sizes of the terms of V2', added up, () [1/s]: `rounding` times this is how exactly V2' is
    known."""
    df_terms: jax.Array
    """Sizes of the terms of f', added up, (n,) [N m/s]."""
    V_terms: jax.Array
    """Error of sqrt(2 V2) for one unit of relative error, ()."""
    slowest: jax.Array
    """Smallest eigenvalue of M0^-1 K2, () [1/s]; NaN for a law whose K2 is no torque's gain."""
    full: Any = ()
    """Of a law that bounds velocities too, its `FullTerms`."""
    own: Any = ()
    """Of a law that states a claim of its own, its `own_law.OwnTerms`."""


class FullTerms(NamedTuple):
    """What the claim of `controllers.FullState` has besides."""

    left: jax.Array
    """(V1 + phi)' + decay rates times V1 and phi - s2 . M0^-1 f_tilde + c |s2|^2, () [1/s].
    (F.2)"""
    xi2: jax.Array
    """E2 relative to its bound, (n,) [1]."""
    bound: jax.Array
    """K of each joint's side, (n,) [rad/s]."""
    room: jax.Array
    """Distance of alpha to the velocities' bounds, (n,) [rad/s]."""


def rounding(dtype) -> float:
    """The relative error that is put down to rounding in sums of this floating-point type."""
    return ROUNDING * float(jnp.finfo(dtype).eps)


def _probe(scenario: Scenario, t: jax.Array, state: LoopState):
    """What is differentiated along the loop's vector field."""
    slope_of_state, sample = evaluate(scenario, t, state)
    law = law_of(scenario)
    barrier_slope = jnp.zeros_like(state.q)
    if isinstance(law, Backstepping | FullState):
        barrier_slope = law.weight * law.barrier.slope(scenario.context.tube(t), state.q)
    smooth = {
        name: getattr(sample, name)
        for name in ("V", "disturbance", "disturbance_estimate", "tau", "alpha", "xi", "e2", "dq_d")
    }
    plant = at_time(scenario.plant, t)
    # All that f holds where the plant is the model: what is pushed besides the law's torque.
    pushed = scenario.disturbance.torque(
        t, state.q, state.dq, plant, scenario.model
    ) + friction_torque(plant, state.dq)
    return smooth | {"ddq": slope_of_state.dq, "s": barrier_slope, "pushed": pushed}, sample


def _alike(one: Any, other: Any) -> jax.Array:
    """Whether two robots are the same, leaf by leaf, () bool."""
    structure: Any = jax.tree.structure(one)
    if structure != jax.tree.structure(other):
        return jnp.zeros((), bool)
    same = [
        jnp.all(a == b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    ]
    return jnp.all(jnp.stack(same)) if same else jnp.ones((), bool)


def terms_at(scenario: Scenario, t: jax.Array, state: LoopState) -> ProofTerms:
    """The terms of the proof at one state; pure, for `vmap` over states, times and gains.

    Args:
      scenario: canonical scenario of n joints.
      t: time, () [s].
      state: state of the loop at t.
    """
    terms, M0, _ = _seen(scenario, t, state)
    eigenvalues = jnp.linalg.eigvalsh(M0)
    slowest = 1.0 / jnp.linalg.eigvalsh(_over_K2(scenario, M0))[-1]
    return ProofTerms(
        **terms, lambda_min=eigenvalues[0], lambda_max=eigenvalues[-1], slowest=slowest
    )


def _over_K2(scenario: Scenario, M0: Any) -> Any:
    """K2^(-1/2) M0 K2^(-1/2), (..., n, n) [s], whose eigenvalues are those of K2^-1 M0; NaN for
    other laws.
    """
    law = law_of(scenario)
    if not isinstance(law, Backstepping):
        return M0 * np.nan
    root = law.K2**0.5
    return M0 / (root[:, None] * root[None, :])


def _seen(
    scenario: Scenario, t: jax.Array, state: LoopState
) -> tuple[dict[str, jax.Array], jax.Array, Sample]:
    """The terms of the proof at one state but for the eigenvalues of M0, M0 itself, and the sample
    that a run records there.
    """
    along = rate(scenario, t, state)
    now, ahead, sample = jax.jvp(
        partial(_probe, scenario), (t, state), (jnp.ones_like(t), along), has_aux=True
    )
    M0 = scenario.model.mass_matrix(state.q)
    dM0 = mass_matrix_rate(scenario.model, state.q, state.dq)
    f_tilde = now["disturbance"] - now["disturbance_estimate"]
    dropped_e2, dropped_f = _dropped(scenario, dM0, state.dq, now["e2"], f_tilde)
    terms, df_terms, V_terms = _sizes(scenario, t, state, M0, now, ahead, f_tilde)
    proof = {
        "V": now["V"],
        "dV": ahead["V"],
        "f": now["disturbance"],
        "df": ahead["disturbance"],
        "f_tilde": f_tilde,
        "df_tilde": ahead["disturbance"] - ahead["disturbance_estimate"],
        "e2": now["e2"],
        "xi": now["xi"],
        "dropped_e2": dropped_e2,
        "dropped_f": dropped_f,
        "steady": (
            _alike(at_time(scenario.plant, t), scenario.model) & jnp.all(ahead["pushed"] == 0.0)
        ),
        "held": jnp.any(sample.guard_active | sample.saturated) | _limited(scenario, t, state, now),
        "terms": terms,
        "df_terms": df_terms,
        "V_terms": V_terms,
    }
    if own_law.stating_law(scenario) is not None:
        proof["own"] = own_law.terms_at(scenario, t, state, along, now, ahead)
        proof["held"] |= proof["own"].limited
    if isinstance(law_of(scenario), FullState):
        proof["full"] = _full(scenario, t, state, M0, ahead, f_tilde)
        # Where alpha is outside the velocities' bounds, e2 has no tube.
        proof["held"] |= jnp.any(proof["full"].room <= NARROWEST)
    return proof, M0, sample


def _full(scenario: Scenario, t: jax.Array, state: LoopState, M0, ahead, f_tilde) -> FullTerms:
    """The terms of (F.2) at one state."""
    law: FullState = law_of(scenario)
    outer, inner = law.tubes(t, state.q, state.dq, scenario.context)
    s2, V1, phi = (
        law.velocity_barrier.slope(inner, state.dq),
        law.weight * law.barrier.value(outer, state.q),
        law.velocity_barrier.value(inner, state.dq),
    )
    barriers_rate = ahead["V"] - f_tilde @ (ahead["disturbance"] - ahead["disturbance_estimate"])
    first, second = decay_rate(law), decay_phi(law)
    decays = jnp.sum(
        (0.0 if first is None else first) * V1 + (0.0 if second is None else second) * phi
    )
    left = barriers_rate + decays - s2 @ solve_spd(M0, f_tilde) + jnp.sum(law.c * s2**2)
    above = state.dq > inner.q_d
    room = jnp.minimum(inner.q_d - inner.lower, inner.upper - inner.q_d)
    return FullTerms(left, inner.xi(state.dq), jnp.where(above, inner.k_u, inner.k_l), room)


def _limited(scenario: Scenario, t: jax.Array, state: LoopState, now) -> jax.Array:
    """Whether a wrapper around the law changed its torque (a smooth limit does so before it is
    reached), () bool.
    """
    law = law_of(scenario)
    if law is scenario.controller or not isinstance(law, Backstepping | FullState):
        return jnp.zeros((), bool)
    own = law.command(t, state.q, state.dq, now["disturbance_estimate"], scenario.context, ())[
        0
    ].tau
    return jnp.any(jnp.abs(now["tau"] - own) > UNCHANGED * jnp.finfo(own.dtype).eps * jnp.abs(own))


def _dropped(scenario: Scenario, dM0, dq, e2, f_tilde) -> tuple[jax.Array, jax.Array]:
    """The two terms that the printed proof drops; zero for a law or an observer that has none."""
    law, zero = law_of(scenario), jnp.zeros_like(e2[0])
    by_law = (
        0.5 * (e2 @ (dM0 @ e2))
        if isinstance(law, Backstepping) and law.reading == "printed"
        else zero
    )
    by_observer = (
        -f_tilde @ (scenario.observer.kf * (dM0 @ dq))
        if isinstance(scenario.observer, Printed)
        else zero
    )
    return by_law, by_observer


def _sizes(
    scenario: Scenario, t: jax.Array, state: LoopState, M0, now, ahead, f_tilde
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sizes of the terms of V2' and f', and the error of sqrt(2 V2) for one unit of relative
    error.
    """
    law, observer = law_of(scenario), scenario.observer
    K2, kf = (
        getattr(law, "K2", jnp.zeros_like(state.q)),
        getattr(observer, "kf", jnp.zeros_like(state.q)),
    )
    guard = getattr(getattr(law, "barrier", None), "guard", -1.0)
    # How much nearer the wall than the tube is wide: relative errors grow by 1/gap there, if the
    # barrier has a wall.
    gap = jnp.clip(1.0 - jnp.abs(now["xi"]), guard, 1.0) if guard > 0 else jnp.ones_like(f_tilde)
    slow = jnp.abs(state.dq) + jnp.abs(now["alpha"]) + jnp.abs(now["dq_d"])
    fast = jnp.abs(now["ddq"]) + jnp.abs(ahead["alpha"])
    torque = (
        jnp.abs(M0) @ fast
        + jnp.abs(now["tau"])
        + jnp.abs(now["disturbance_estimate"])
        + K2 * slow
        + jnp.abs(now["s"]) / gap
    )
    torque_rate = (
        jnp.abs(M0) @ jnp.abs(ahead["ddq"])
        + jnp.abs(ahead["tau"])
        + jnp.abs(ahead["disturbance_estimate"])
        + K2 * fast
        + kf * torque
        + (jnp.abs(ahead["s"]) + jnp.abs(now["s"]) * slow) / gap
    )
    df, df_tilde = ahead["disturbance"], ahead["disturbance"] - ahead["disturbance_estimate"]
    terms = (
        slow @ (jnp.abs(now["s"]) / gap + torque)
        + (jnp.abs(f_tilde) + jnp.abs(df)) @ torque_rate
        + torque @ jnp.abs(df_tilde)
    )
    if isinstance(law, FullState):
        terms += _full_sizes(law, scenario, t, state, M0, torque, fast)
    tube = scenario.context.tube(t)
    width = jnp.minimum(tube.k_l, tube.k_u)
    weight = getattr(law, "weight", jnp.ones_like(width))
    reach = (
        jnp.sum(weight * (jnp.abs(state.q) / (width * gap)) ** 2)
        + slow @ (jnp.abs(M0) @ slow)
        + torque @ torque
    )
    return terms, torque_rate, jnp.sqrt(reach)


def _full_sizes(
    law: FullState, scenario: Scenario, t: jax.Array, state: LoopState, M0, torque, fast
) -> jax.Array:
    """Sizes of the terms of phi', added up, () [1/s]."""
    inner, barrier = law.tubes(t, state.q, state.dq, scenario.context)[1], law.velocity_barrier
    gap = (
        jnp.clip(1.0 - jnp.abs(inner.xi(state.dq)), max(barrier.guard, 0.0), 1.0)
        if barrier.guard > 0
        else jnp.ones_like(torque)
    )
    accelerations = fast + jnp.sum(
        jnp.abs(jnp.stack([solve_spd(M0, row) for row in jnp.eye(torque.size, dtype=torque.dtype)]))
        * torque,
        axis=1,
    )
    s2 = jnp.abs(barrier.slope(inner, state.dq))
    return (s2 / gap) @ accelerations + jnp.sum(law.c * s2**2)


class Place(NamedTuple):
    """A state of a run, and where it is in time: after so many steps of a size."""

    steps: jax.Array
    """(), a float."""
    size: jax.Array
    """() [s]."""
    state: LoopState


@dataclasses.dataclass(frozen=True)
class Look:
    """A step of the engine that stays where it is and records what is seen there."""

    is_derivative: ClassVar[bool] = True

    def __call__(self, inputs, place: Place, index: jax.Array, form):
        """The place, and what `_seen` gives."""
        return place, _seen(inputs.scenario, place.steps * place.size, place.state)


@dataclasses.dataclass(frozen=True)
class Onward:
    """A step of the engine that makes the run's own step, of any size, and records the state, V2
    and |f_tilde|^2/2 before it.
    """

    method: str

    def __call__(self, inputs, place: Place, index: jax.Array, form):
        """The place after the step; the state, V2 and |f_tilde|^2/2 before it."""
        number = place.steps + index.astype(place.steps.dtype)
        span = jumps.Span(number * place.size, (number + 1.0) * place.size, place.size)
        division = jumps.divided(inputs.scenario.jump_times(), span)
        made = jumps.integrated(
            self.method,
            partial(evaluate, inputs.scenario),
            division,
            place.state,
            rolled=form.rolled,
        )
        f_tilde = made.first.disturbance - made.first.disturbance_estimate
        return place._replace(state=made.state), (
            place.state,
            (made.first.V, 0.5 * jnp.sum(f_tilde**2)),
        )


def along_run(
    scenario: Scenario, index: np.ndarray, states: LoopState, dt: jax.Array, *, method: str
):
    """What a run is at some of its states.

    Args:
      scenario: canonical.
      index: numbers of the steps, (T,).
      states: the states before them, (T, ...).
      dt, method: of the run.

    Returns:
      The proof, the sample, and the integrator's errors in V2 and in |f_tilde|^2/2 over one step,
      on the host; (T, ...) each.
    """
    count = index.astype(dt.dtype)
    whole, halves = (
        Place(
            jax.device_put(part * count),
            jax.device_put(np.full_like(count, float(dt) / part)),
            states,
        )
        for part in (1, 2)
    )
    found = run_from(scenario, dt, whole, step=Look())[1]
    # One step against two half steps: the envelopes are held against a run in which V2 has fallen
    # below what the integrator resolves. Both go on for three, so that they are one call and
    # compile once.
    both = jax.tree.map(lambda *xs: np.concatenate(xs), whole, halves)
    levels = run_from(scenario, dt, both, step=Onward(method), steps=3)[1][1]
    proof, M0, sample = jax.tree.map(lambda x: np.asarray(x)[:, 0], found)
    # NumPy raises at what is not finite, where the terms say NaN.
    finite = np.all(np.isfinite(M0), axis=(1, 2), keepdims=True)
    eigenvalues = np.where(finite[..., 0], np.linalg.eigvalsh(np.where(finite, M0, 0.0)), np.nan)
    found = {
        "lambda_min": eigenvalues[:, 0],
        "lambda_max": eigenvalues[:, -1],
        "slowest": _slowest(scenario, M0),
    }
    return ProofTerms(**proof | found), sample, *map(_defect, levels)


def _slowest(scenario: Scenario, M0: np.ndarray) -> np.ndarray:
    """The smallest eigenvalue of M0^-1 K2 at each position, (T,) [1/s]; NaN where M0 is not
    finite.
    """
    over_K2 = np.asarray(_over_K2(scenario, M0))
    finite = np.all(np.isfinite(over_K2), axis=(1, 2))
    unit = np.eye(M0.shape[-1])
    return np.where(
        finite,
        1.0 / np.linalg.eigvalsh(np.where(finite[:, None, None], over_K2, unit))[:, -1],
        np.nan,
    )


def _defect(level: jax.Array) -> np.ndarray:
    """By how much one step of the run leads elsewhere than two half steps, (T,), of a level along
    both, (2 T, 3); twice, for safety.
    """
    whole, halves = np.split(np.asarray(level), 2)
    return 2.0 * np.abs(whole[:, 1] - halves[:, 2])

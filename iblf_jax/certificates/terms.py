"""The terms of the claims about a closed loop at one of its states, for a plant of any order.

An inequality such as V' + rho V - 1/2 |f'|^2 <= 0 is a statement about states, not about runs.  It
is therefore checked at each state with exact rates: V' and d' are the derivatives of V and of the
uncertain term d along the vector field of the whole loop,

    V' = dV . (1, x'),   d' = dd . (1, x'),
    x = (state of the plant, state of the law, state of the observer),

by forward-mode differentiation of `closed_loop.evaluate`.  No differences along a run are used.
When plant and model differ, d contains x' and the input, and its rate is still exact.

There is one record of terms, `Terms`.  A `Point` makes those that belong to every claim, and each
claim adds its own (`Claim.with_terms_of_claim`).  Two kinds of points differ in how they get
derivatives:

    TorquePoint   for claims about a robot and the torque f: the signals of the loop and their rates
    ChainPoint    for claims about levels: the arguments (t, x, d_hat, state of the law) of V and
                  their rates, because these claims need dV/dx and dV/dd_hat one by one

Rounding: V' is a sum of large terms that cancel, so its error is some units in the last place of
those terms.  `Terms.size` is the sum of their absolute values.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from iblf_jax.control.controllers import (
    AdaptiveParameters,
    Backstepping,
    BarrierBackstepping,
    LawContext,
    Saturated,
    TrackingLaw,
)
from iblf_jax.control.controllers._base import law_of_x, layers_with_states, position_barrier
from iblf_jax.core.linalg import matvec, solve_spd
from iblf_jax.core.pytree import layers, unwrapped
from iblf_jax.simulation.closed_loop import LoopState, evaluate, plant_input, rate
from iblf_jax.simulation.levels import disturbance_torque
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import Sample, margin_of
from iblf_jax.world import plants
from iblf_jax.world.robots import friction_torque

if TYPE_CHECKING:
    from iblf_jax.certificates.claims._base import Claim

TORQUE, ESTIMATED = "torque", "estimate"
"""Names of entries of `Terms.claims` that several claims read: of a robot, and of the estimate of
levels."""
DECAY_ROUNDING = 2.0
"""Error of V2' in units of the last place, relative to the sizes of its terms; the largest that
tests found is 0.1."""
TORQUE_ROUNDING = 8.0
"""Units in the last place by which equal torques may differ."""


class Terms(NamedTuple):
    """The terms at one instant; along a run a time axis comes first.  Terms that no claim about the
    loop needs are `()`.
    """

    V: Any
    """The Lyapunov function, (): V2 of (3.12), or sum w_i V_i of (S.3)."""
    d: jax.Array
    """The uncertain term: f, (n,) [N m], for claims about a torque, else x' minus the flow of the
    model, (r, n), in units of the levels a second."""
    d_tilde: jax.Array
    """d - d_hat, or f_tilde = f - f_hat."""
    distance: jax.Array
    """Distances of x_i to the bounds of level i, (r, n); infinite without bounds."""
    excluded: jax.Array
    """Whether the claims exclude this instant, () bool: the guard at a bound or a limit of the
    input is active, or a virtual control is outside the bounds of its level."""
    dV: Any = ()
    """V', exact, () [unit of V a second]."""
    dd: Any = ()
    """d', exact."""
    dd_tilde: Any = ()
    """Rate of d_tilde, exact."""
    e: Any = ()
    """Errors x_i - alpha_{i-1}, (r, n), in the units of the levels."""
    xi: Any = ()
    """Errors relative to their bounds, (r, n); 0 in levels without bounds."""
    size: Any = ()
    """Sum of the absolute values of the terms of V', (): rounding is relative to it."""
    sqrt_V_size: Any = ()
    """Error of sqrt(2 V) for a relative error of 1, ()."""
    claims: Any = ()
    """Terms of single claims: TORQUE for Theorem 2 and (F.3), ESTIMATED for the estimate of levels,
    else `Claim.key`."""


def rounding(dtype: DTypeLike) -> float:
    """The relative error that is attributed to rounding in sums of this floating-point type."""
    return DECAY_ROUNDING * float(jnp.finfo(dtype).eps)


def terms_and_sample(
    scenario: Scenario, t: jax.Array, state: LoopState, claims: Sequence[Claim]
) -> tuple[Terms, Sample]:
    """The terms of some claims at one state, and the sample that a run records there; pure, for
    `vmap` over states, times and gains.

    Args:
      scenario: canonical.
      t: time, () [s].
      state: state of the loop at t.
      claims: claims about the scenario, in any order, with one kind of points.
    """
    kinds = {claim.point for claim in claims if claim.point is not None}
    if len(kinds) != 1:
        raise ValueError(f"claims of one kind of points are needed, not of {len(kinds)}")
    point = kinds.pop()(scenario, t, state)
    terms = point.terms()
    for claim in claims:
        terms = claim.with_terms_of_claim(point, terms)
    return terms, point.sample


class Uncertain(NamedTuple):
    """The uncertain term, the error of its estimate, and their rates."""

    d: jax.Array
    d_tilde: jax.Array
    dd: jax.Array
    dd_tilde: jax.Array


class Point(metaclass=abc.ABCMeta):
    """One state of a closed loop and the rate of everything there.

    Args:
      scenario: canonical.
      t: time, () [s].
      state: state of the loop at t.
    """

    rate: LoopState
    """The rate of the state."""
    sample: Sample
    """What a run records at this state."""
    uncertain: Uncertain

    def __init__(self, scenario: Scenario, t: jax.Array, state: LoopState) -> None:
        self.scenario = scenario
        self.t = t
        self.state = state
        self.law: Any = unwrapped(scenario.controller)
        self.x = state.x[: scenario.loop.model.order]

    @abc.abstractmethod
    def terms(self) -> Terms:
        """The terms that do not belong to a claim."""

    @abc.abstractmethod
    def disturbance_power(self, slope: jax.Array, d_tilde: jax.Array) -> jax.Array:
        """dV/dx . d_tilde, () for the slopes dV/dx, (r, n)."""

    @abc.abstractmethod
    def rate_size(self, slope: jax.Array) -> jax.Array:
        """Rounding in dV/dx . x' for the slopes dV/dx, (): that of the terms of x'."""

    @cached_property
    def law_state(self) -> Any:
        """The state of the innermost law, and its rate."""
        return tuple(
            inner_state(self.scenario, each)
            for each in (self.state.controller, self.rate.controller)
        )

    @cached_property
    def distance(self) -> jax.Array:
        """Distances of the levels of the model to their bounds, (r, n); infinite without bounds."""
        x, sample = self.x, self.sample
        bounded = len(sample.level_lower[: len(x)])
        rows = [margin_of(sample, level, x[level - 1]) for level in range(1, bounded + 1)]
        return jnp.full_like(x, jnp.inf).at[:bounded].set(jnp.stack(rows))


# --- claims about a torque ------------------------------------------------------------------------


class TorquePoint(Point):
    """A state of the loop of a robot, whose uncertain term is the torque f."""

    now: dict[str, jax.Array]
    """The signals that are differentiated."""
    rates: dict[str, jax.Array]
    """Their rates along the vector field of the loop."""
    M0: jax.Array
    """The mass matrix of the model, (n, n) [kg m^2]."""

    def __init__(self, scenario: Scenario, t: jax.Array, state: LoopState) -> None:
        super().__init__(scenario, t, state)
        self.rate = rate(scenario, t, state)
        self.M0 = scenario.model.mass_matrix(self.x[0])
        along = (jnp.ones_like(t), self.rate)
        signals = partial(_signals, scenario)
        self.now, self.rates, self.sample = jax.jvp(signals, (t, state), along, has_aux=True)

    @cached_property
    def uncertain(self) -> Uncertain:  # type: ignore[override]
        """f, f_tilde and their rates, (n,) each [N m, N m/s]."""
        f, df = self.now["disturbance"], self.rates["disturbance"]
        f_hat, df_hat = self.now["disturbance_estimate"], self.rates["disturbance_estimate"]
        return Uncertain(f, f - f_hat, df, df - df_hat)

    def terms(self) -> Terms:
        """The terms that do not belong to a claim."""
        now, rates, sample = self.now, self.rates, self.sample
        f, f_tilde, df, df_tilde = self.uncertain
        xi = now["xi"]
        return Terms(
            V=now["V"],
            d=f,
            d_tilde=f_tilde,
            distance=self.distance,
            excluded=jnp.any(sample.guard_active | sample.saturated),
            dV=rates["V"],
            dd=df,
            dd_tilde=df_tilde,
            e=jnp.stack([sample.e1, now["e2"]]),
            xi=jnp.stack([xi, jnp.zeros_like(xi)]),
            claims={},
        )

    def disturbance_power(self, slope: jax.Array, d_tilde: jax.Array) -> jax.Array:
        """dV/dq' . M0^-1 f_tilde."""
        return slope[1] @ solve_spd(self.M0, d_tilde)

    def rate_size(self, slope: jax.Array) -> jax.Array:
        """Rounding in dV/dq' . q": an acceleration has the rounding error of the torques of which
        it is a difference.
        """
        torques = jnp.abs(matvec(self.M0, self.rate.dq))
        for name in ("tau", "disturbance", "disturbance_estimate"):
            torques = torques + jnp.abs(self.now[name])
        return jnp.sum(jnp.abs(slope[1]) * jnp.abs(solve_spd(self.M0, torques)))

    def differs_from_command(self, law: TrackingLaw, law_state: Any) -> jax.Array:
        """Whether the torque differs from the command of a law, () bool.  A smooth limit changes it
        before the limit is reached, which the status flags do not show.
        """
        f_hat = self.now["disturbance_estimate"]
        of_x = law_of_x(law)
        command, _ = of_x.command(self.t, self.state.x, f_hat, self.scenario.context, law_state)
        return _differ(command.tau, self.now["tau"])


def _differ(commanded: jax.Array, applied: jax.Array) -> jax.Array:
    """Whether two inputs differ beyond rounding, () bool."""
    tolerance = TORQUE_ROUNDING * jnp.finfo(commanded.dtype).eps * jnp.abs(commanded)
    return jnp.any(jnp.abs(applied - commanded) > tolerance)


def _signals(scenario: Scenario, t: jax.Array, state: LoopState) -> tuple[dict[str, Any], Sample]:
    """The signals that are differentiated along the vector field of the loop, and the sample."""
    state_rate, sample = evaluate(scenario, t, state)
    law: TrackingLaw = unwrapped(scenario.controller)
    barrier_slope = jnp.zeros_like(state.q)
    if isinstance(law, Backstepping | BarrierBackstepping):
        barrier, weight = position_barrier(law)
        barrier_slope = weight * barrier.slope(scenario.context.tube(t), state.q)
    # All of f where the plant is the model: the torques besides that of the law.
    external = jnp.zeros_like(state.q)
    robot = scenario.loop.plant.at(t).robot
    if robot is not None:
        external = disturbance_torque(scenario, t, state.q, state.dq)
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


def relative_gap(xi: jax.Array, guard: float) -> jax.Array:
    """Distance to the bound relative to the width of the tube, in [guard, 1]; 1 for a barrier
    without a guard.  Relative errors grow by 1/gap near the bound.
    """
    if not guard > 0:
        return jnp.ones_like(xi)
    return jnp.clip(1.0 - jnp.abs(xi), guard, 1.0)


# --- claims about levels --------------------------------------------------------------------------


class Arguments(NamedTuple):
    """The arguments of V, or their rates along the loop."""

    t: jax.Array
    x: jax.Array
    estimate: jax.Array
    law_state: Any


class ChainPoint(Point):
    """A state of a loop, with the arguments (t, x, d_hat, state of the law) of V and their
    rates.
    """

    def __init__(self, scenario: Scenario, t: jax.Array, state: LoopState) -> None:
        super().__init__(scenario, t, state)
        self.rate, self.sample = evaluate(scenario, t, state)

    @cached_property
    def arguments(self) -> tuple[Arguments, Arguments]:
        """The arguments of V, and their rates."""
        return _arguments(self.scenario, self.t, self.state, self.rate)

    @cached_property
    def d(self) -> jax.Array:
        """Rate x' minus the flow of the model, (r, n)."""
        return _disturbance(self.scenario, self.state, self.rate, self.sample)

    @cached_property
    def d_tilde(self) -> jax.Array:
        """The error d - d_hat, (r, n)."""
        at, _ = self.arguments
        return self.d - _as_rates(self.scenario, at.x, at.estimate)

    @cached_property
    def uncertain(self) -> Uncertain:  # type: ignore[override]
        """d, d_tilde and their rates, (r, n) each."""

        def disturbances(t: jax.Array, state: LoopState) -> tuple[jax.Array, jax.Array]:
            state_rate, sample = evaluate(self.scenario, t, state)
            d = _disturbance(self.scenario, state, state_rate, sample)
            at, _ = _arguments(self.scenario, t, state, state_rate)
            return d, d - _as_rates(self.scenario, at.x, at.estimate)

        along = (jnp.ones_like(self.t), self.rate)
        values, rates = jax.jvp(disturbances, (self.t, self.state), along)
        return Uncertain(*values, *rates)

    def terms(self) -> Terms:
        """The terms that do not belong to a claim."""
        sample = self.sample
        excluded = jnp.any(sample.guard_active)
        if not covers_limit(self.scenario):
            excluded |= jnp.any(sample.saturated) | self._input_was_limited()
        return Terms(sample.V, self.d, self.d_tilde, self.distance, excluded, claims={})

    def disturbance_power(self, slope: jax.Array, d_tilde: jax.Array) -> jax.Array:
        """dV/dx . d_tilde."""
        return jnp.sum(slope * d_tilde)

    def rate_size(self, slope: jax.Array) -> jax.Array:
        """Rounding in dV/dx . x'."""
        return jnp.sum(jnp.abs(slope) * self.sizes)

    @cached_property
    def sizes(self) -> jax.Array:
        """Sums of the absolute values of the terms of x', (r, n): f_i, G_i x_{i+1}, d_i and
        d_hat_i.
        """
        at, tangent = self.arguments
        plant = plants.as_plant(self.scenario.model)
        zero = jnp.zeros_like(at.x[0])
        drift = jnp.stack(
            [plants.level_rate(plant, i + 1, at.t, at.x, zero, 0.0) for i in range(len(at.x))]
        )
        driven = tangent.x - self.d - drift
        return jnp.abs(drift) + jnp.abs(driven) + jnp.abs(self.d) + jnp.abs(self.d_tilde)

    def _input_was_limited(self) -> jax.Array:
        """Whether a wrapper around the law changed its input, () bool.  A smooth limit changes it
        before the limit is reached, which the status flags do not show.
        """
        scenario = self.scenario
        law: Any = adaptive_law(scenario) or self.law
        if law is scenario.controller:
            return jnp.zeros((), bool)
        at, _ = self.arguments
        own, _ = law.command(*at[:3], scenario.context, inner_state(scenario, at.law_state))
        limited, _ = scenario.loop.law.command(*at[:3], scenario.context, at.law_state)
        return _differ(plant_input(own), plant_input(limited))


def _arguments(
    scenario: Scenario, t: jax.Array, state: LoopState, state_rate: LoopState
) -> tuple[Arguments, Arguments]:
    """The arguments of V at one state, and their rates."""
    loop = scenario.loop
    order = loop.model.order

    def estimated(t: jax.Array, state: LoopState) -> jax.Array:
        return loop.observer.estimate(t, state.x[:order], loop.model, state.observer)

    found, rates = jax.jvp(estimated, (t, state), (jnp.ones_like(t), state_rate))
    at = Arguments(t, state.x[:order], found, state.controller)
    return at, Arguments(jnp.ones_like(t), state_rate.x[:order], rates, state_rate.controller)


def _as_rates(scenario: Scenario, x: jax.Array, estimate: jax.Array) -> jax.Array:
    """An estimate as d_hat, (r, n): M0^-1 f_hat in the second level for a torque f_hat."""
    if estimate.ndim == 2:
        return estimate
    return plants.torque_as_rates(scenario.loop.model, x, estimate)


def _disturbance(
    scenario: Scenario, state: LoopState, state_rate: LoopState, sample: Sample
) -> jax.Array:
    """Rate x' minus the flow of the model, (r, n)."""
    if sample.disturbance.ndim == 2:
        return sample.disturbance
    # It is the torque on a robot.
    rates = solve_spd(scenario.model.mass_matrix(state.q), sample.disturbance)
    return jnp.stack([state_rate.q - state.dq, rates])


# --- laws inside others ---------------------------------------------------------------------------


def covers_limit(scenario: Scenario) -> bool:
    """Whether the law takes the shift of the auxiliary state of the limit around it, so that the
    claims apply while the input is limited, with the term (A.3) (`controllers.saturated`).
    """
    outer: Any = scenario.controller
    if not isinstance(outer, Saturated) or not outer.has_auxiliary:
        return False
    return outer.law is unwrapped(outer) and outer.law.takes_shift


def inner_state(scenario: Scenario, state: Any) -> Any:
    """The state of the innermost law, from the state of the controller or from its rate."""
    *_, (_, innermost) = layers_with_states(scenario.controller, state)
    return innermost


def inner_context(scenario: Scenario, state: Any) -> LawContext:
    """The context of the law within the limit, from the state of the controller."""
    outer: Any = scenario.controller
    if not covers_limit(scenario):
        return scenario.context
    return scenario.context._replace(shift=outer.shift(state))


def receives_q_dq(scenario: Scenario) -> bool:
    """Whether the law of a scenario receives q and q', and not all levels."""
    return not unwrapped(scenario.controller).receives_x


def adaptive_law(scenario: Scenario) -> AdaptiveParameters | None:
    """The law that changes the parameters of the model, or None."""
    for law in layers(scenario.controller):
        if isinstance(law, AdaptiveParameters):
            return law
    return None

"""The contract of a tracking law.

A law knows the model, the reference and the bounds (its `LawContext`), measures q and q', receives
the observer's estimate and commands a torque.  It also returns signals for records and
certificates: its virtual velocity alpha, its Lyapunov function V1, and whether a guard or a limit
was active.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from iblf_jax.control.decays import Decay, Exponential
from iblf_jax.core.optional import OptionalMembers
from iblf_jax.core.pytree import layers
from iblf_jax.world.bounds import Bounds, Tube, speed_limits_at, tube_at
from iblf_jax.world.references import Reference
from iblf_jax.world.regions import Along, Region, along
from iblf_jax.world.robots import Robot

State = Any
"""A pytree of arrays; `()` for a law without memory."""


class Shift(NamedTuple):
    """The auxiliary state lambda of a limited input (`Saturated`), which shifts the virtual control
    of the last level.
    """

    value: jax.Array
    """lambda, (n,) in the unit of the last level, [rad/s] for a robot."""
    rate: jax.Array
    """-k lambda, (n,)."""


class LawContext(NamedTuple):
    """The inputs of a law besides measurements: model, reference and bounds."""

    model: Robot
    reference: Reference
    bounds: Bounds
    velocity_bounds: Bounds | None = None
    regions: tuple[Region, ...] = ()
    state_bounds: tuple[Bounds | None, ...] = ()
    """Bounds of the levels from the second on of a plant in strict-feedback form."""
    shift: Shift | None = None
    """What a law that `takes_shift` adds to the virtual control of the last level, and to its
    rate."""
    plant: Any = None
    """The plant, for the methods of a `LyapunovLaw` whose V contains its true parameters; None
    where a law commands, because it does not know them."""

    def shifted(self, alpha: jax.Array, rate: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The virtual control of the last level and its rate, (n,) each, with the shift if there is
        one.
        """
        if self.shift is None:
            return alpha, rate
        return alpha + self.shift.value, rate + self.shift.rate

    def shifted_tube(self, tube: Tube) -> Tube:
        """The tube of the last level, moved by the shift if there is one: the error and its
        distances to the bounds are then those of x_r - lambda.
        """
        if self.shift is None:
            return tube
        q_d, dq_d = self.shifted(tube.q_d, tube.dq_d)
        lower, dlower = self.shifted(tube.lower, tube.dlower)
        upper, dupper = self.shifted(tube.upper, tube.dupper)
        return Tube(q_d, dq_d, lower, upper, dlower, dupper)

    def level_bounds(self, level: int) -> Bounds | None:
        """The bounds of a level, counted from 1; None where it has none."""
        if level == 1:
            return self.bounds
        if level == 2 and self.velocity_bounds is not None:
            return self.velocity_bounds
        if len(self.state_bounds) < level - 1:
            return None
        return self.state_bounds[level - 2]

    def tube(self, t: jax.Array, *, acceleration: bool = True) -> Tube:
        """Reference, bounds and their rates at time t [s]; arguments as `bounds.tube_at`."""
        return _tube(self.reference, self.bounds, t, acceleration)

    def speed_limits(self, t: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The bounds on the velocities at time t [s], (n,) each [rad/s]; requires velocity
        bounds.
        """
        return speed_limits_at(self.reference, self.velocity_bounds, t)  # type: ignore[arg-type]

    def regions_along(self, q: jax.Array, dq: jax.Array) -> Along:
        """Levels of all regions and their rates at q [rad] and dq [rad/s]; requires regions."""
        return along(self.regions, self.model, q, dq)


# Compiled inline, so that several callers at one instant trace it once.
@partial(jax.jit, static_argnums=3, inline=True)
def _tube(reference: Reference, bounds: Bounds, t: jax.Array, acceleration: bool) -> Tube:
    return tube_at(reference, bounds, t, acceleration=acceleration)


class Command(NamedTuple):
    """The output of a law at one instant; all fields are (n,)."""

    tau: jax.Array
    """Torque [N m]."""
    alpha: jax.Array
    """Virtual velocity [rad/s]; e2 = q' - alpha.  A law without one gives q_d'."""
    V1: jax.Array
    """Lyapunov function of the position error, joint by joint."""
    guard_active: jax.Array
    """bool: the barrier's guard limits the slope."""
    saturated: jax.Array
    """bool: the torque was cut to a limit."""
    slack: Any = ()
    """The violation of a filter's conditions, (n,) [rad/s^2]; `()` for laws without a filter."""
    region_slack: Any = ()
    """The violation of its conditions on m regions, (m,) [m/s^2]; `()` without regions."""
    alpha_higher: Any = ()
    """alpha_2 ... alpha_{r-1} of a plant of order r > 2, (r - 2, n), in the units of the levels
    that they are for; `()` for laws of robots."""
    input: Any = ()
    """The input of the plant, (n,), where it is not the torque `tau`: the voltage of a drive, say.
    Observers receive `tau`."""
    input_slope: Any = ()
    """dV/dx_r G_r, (n,): the derivative of the law's Lyapunov function along the input, e2 for
    V = V1 + 1/2 e2^T M0 e2; `()` for a law without a Lyapunov function."""
    auxiliary: Any = ()
    """The auxiliary state lambda of a limited input, (n,); `()` for laws without one."""


class Controller(Protocol):
    """The contract of a tracking law.

    A law with a proof of its own may also fit `LyapunovLaw`; then `certify` checks what it states.

    A law may also have these class attributes; `law_member` holds their defaults.

    - `gains`: the names of the leaves that `compare` scales together; ("k1", "K2") by default.
    - `uses_observer`: False if it does not use f_hat.
    - `needs_velocity_bounds`: True if it requires `LawContext.velocity_bounds`.
    - `includes_e2`: True if its V1 contains its term of e2, so that V2 adds no 1/2 e2^T M0 e2.
    - `filters`: True if its commands have a `slack`.
    - `takes_shift`: True if it adds `LawContext.shift` to the virtual control of the last level and
      to its rate (`LawContext.shifted`).
    - `has_auxiliary`: True if its commands have an `auxiliary`.
    - `receives_x`: True for a law of plants in strict-feedback form, which receives the state x,
      (r, n), in the place of q and q': `init(x, context)`, `command(t, x, d_hat, context, state)`
      and `switching(t, x, d_hat, context, state)`, with d_hat as the observer gives it, (r, n) or
      (n,).
    - `unlimited`: the same law without a limit of its own, by which a sampled loop is linearised;
      None for a law without one.
    - `wraps`: the name of the field that holds another law.  Paths then reach through it
      ("controller.K2").
    - `input_unit`: the unit of the input that an input map such as `WithDrive` commands; None for
      the input of the model, which is the torque for a robot.
    - `unit_factors`: the names of leaves that are factors only.  Which of their numbers are 1 may
      be compiled in (`engine.structural_constants`).

    - `energy`, `energy_decay`: methods of a law with an `input_slope`, which `AdaptiveParameters`
      uses.  They return the law's Lyapunov function without a term of the estimate, (), and how
      fast it decays, (), where the plant equals the model and there is no disturbance; arguments
      (t, q, dq, context), or (t, x, context).

    It may have these methods: `completed(context, x)` returns the law with values that depend on
    the model and on the start x, (r, n), where none were given; `advice()` returns a list of
    warnings; `check_start(context)` raises ValueError for fields that do not fit together, once the
    number of joints is known; `leaf_units()` returns the units of leaves that depend on other
    fields, by name; `unit_symbols(model)` returns the units of symbols in the units of its leaves.

    A law whose command is discontinuous, such as a sliding-mode law or `FullState` with some
    barriers, has `switching(t, q, dq, context, state)`.  It returns (m,) functions of q or q', and
    the command jumps where one of them crosses 0.  The derivatives of a run then contain the effect
    of such a jump on a perturbation (`engine.switching`); without the method they omit it.  A law
    that wraps another forwards the call with `switching_functions`.
    """

    def init(self, q: jax.Array, dq: jax.Array, context: LawContext) -> State:
        """State at the start of a run, given q [rad] and dq [rad/s] there; `()` for most laws."""
        ...

    def command(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_hat: jax.Array,
        context: LawContext,
        state: State,
    ) -> tuple[Command, State]:
        """The command, and the rate of the law's own state (same structure as the state).

        Args:
          t: time, () [s].
          q, dq: position [rad] and velocity [rad/s], (n,).
          f_hat: the observer's estimate of the uncertain term, (n,) [N m].
          context: model, reference and bounds.
          state: the law's own state.
        """
        ...


law_member = OptionalMembers(
    gains=("k1", "K2"),
    unit_factors=(),
    uses_observer=True,
    needs_velocity_bounds=False,
    includes_e2=False,
    filters=False,
    takes_shift=False,
    has_auxiliary=False,
    filter=None,
    unlimited=None,
    unit_symbols=lambda model: {},
    receives_x=False,
    input_unit=None,
    completed=None,
    advice=list,
    check_start=lambda context: None,
    switching=lambda t, q, dq, context, state: None,
    energy=None,
    energy_decay=None,
    disturbance_terms=None,
    barrier=None,
    barriers=(),
    decays=(),
    weight=None,
    reading="",
)
"""Reads optional members of a law: those that `Controller` and `LyapunovLaw` describe, and some
fields of laws with a barrier."""


def unlimited(law: Controller) -> Controller:
    """A law without its own limit; itself if it declares none."""
    return law_member.variant(law, "unlimited")  # type: ignore[no-any-return]


def switching_functions(law: Controller, *arguments: Any) -> jax.Array | None:
    """The functions at whose zeros a law's command jumps, (m,), or None if it declares none;
    arguments as `Controller.command`, without the estimate.
    """
    default = law_member.defaults["switching"]
    own = law_member(law, "switching")
    if own is default:
        return None
    functions: jax.Array | None = own(*arguments)
    return functions


def state_of_levels(q: jax.Array, dq: jax.Array, higher: Any) -> jax.Array:
    """The state x of a plant, (r, n), from its first two levels and the others."""
    first = jnp.stack([q, dq])
    return first if isinstance(higher, tuple) else jnp.concatenate([first, higher])


def no_state(law: Any, q: jax.Array, dq: jax.Array, context: LawContext) -> tuple[()]:
    """`init` of a law without a state."""
    return ()


def wrapped_advice(law: Any) -> list[str]:
    """`advice` of a law that wraps another: the other's."""
    return law_member(law.law, "advice")()  # type: ignore[no-any-return]


def wrapped_state(law: Any, *arguments: Any) -> State:
    """`init` of a law that wraps another and has no state of its own."""
    return law.law.init(*arguments)


def wrapped_switching(law: Any, *arguments: Any) -> jax.Array | None:
    """`switching` of a law that wraps another and has no state of its own: the other's."""
    return switching_functions(law.law, *arguments)


def layers_with_states(law: Any, state: Any) -> Iterator[tuple[Any, Any]]:
    """A law and the laws that it wraps, the outermost first, each with its state.

    Args:
      law: any `Controller`.
      state: of the law, or its rate.
    """
    for layer in layers(law):
        yield layer, state
        if law_member(layer, "has_auxiliary"):
            state = state.law


def decay_of(law: Any, i: int) -> Decay:
    """The decay of level i + 1 of a law: `Exponential` for a law that has no `decays`."""
    decays = law_member(law, "decays")
    if not decays:
        return Exponential()
    return decays[i]  # type: ignore[no-any-return]


class LyapunovLaw(Protocol):
    """The additional methods of a law with a Lyapunov function V and its decay W, which `certify`
    checks.

        V' <= -W + T

    `certify` differentiates V along the vector field of the loop and tests the inequality at every
    step of a run.  T is the result of `disturbance_terms`, by default the contribution of the
    uncertain term to V' for any law, T = dV/dq' . M0^-1 f_tilde + dV/df_tilde
    . f'.  V, W and T are (), or (n,) and then summed; unit and scale of V are the law's choice.

    A law that `receives_x` has these methods with x, (r, n), in the place of q and q', and with
    d_tilde, (r, n), in the place of f_tilde: `lyapunov(t, x, d_tilde, context, state)`.  T is then
    dV/dx . d_tilde + dV/dd_tilde . d' by default.
    """

    def lyapunov(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_tilde: jax.Array,
        context: LawContext,
        state: State,
    ) -> jax.Array:
        """V >= 0, () or (n,).

        Args:
          t: time, () [s].
          q, dq: position [rad] and velocity [rad/s], (n,).
          f_tilde: error of the observer's estimate, f - f_hat, (n,) [N m]; f itself for a law with
            `uses_observer = False`.
          context: model, reference and bounds.
          state: the law's own state.
        """
        ...

    def decay(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_tilde: jax.Array,
        context: LawContext,
        state: State,
    ) -> jax.Array:
        """W >= 0, () or (n,), in the unit of V a second: how fast V decreases where f_tilde = 0.
        Arguments as `lyapunov`.
        """
        ...

    def disturbance_terms(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_tilde: jax.Array,
        df: jax.Array,
        context: LawContext,
        state: State,
    ) -> jax.Array:
        """T, () or (n,), in the unit of V a second: what f_tilde and f' may add to V'.  A law may
        leave this method out.

        Args:
          t, q, dq, f_tilde, context, state: as `lyapunov`.
          df: rate of the uncertain term, f', (n,) [N m/s].
        """
        ...

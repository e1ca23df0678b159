"""The contract of a tracking law.

A law knows the model, the reference and the bounds (its `LawContext`), measures q and q', receives
the observer's estimate and commands a torque.  It also returns signals for records and
certificates: its virtual velocity alpha, its Lyapunov function V1, and whether a guard or a limit
was active.
"""

from __future__ import annotations

import abc
from collections.abc import Iterator
from functools import partial
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp

from iblf_jax.control.barriers import Barrier
from iblf_jax.control.decays import Decay, Exponential
from iblf_jax.core.families import adopt, attribute
from iblf_jax.core.pytree import Leaf, layers, wrapped_field
from iblf_jax.core.time import Timed
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


class Controller(Timed):
    """The contract of a tracking law.

    A law with a proof of its own is a `LyapunovLaw`; then `certify` checks what it states.

    A law of plants in strict-feedback form (`receives_x`) receives the state x, (r, n), in the
    place of q and q': `init(x, context)`, `command(t, x, d_hat, context, state)` and
    `switching(t, x, d_hat, context, state)`, with d_hat as the observer gives it, (r, n) or (n,).
    """

    gains: ClassVar[tuple[str, ...]] = ("k1", "K2")
    """The names of the leaves that `compare` scales together."""
    unit_factors: ClassVar[tuple[str, ...]] = ()
    """The names of leaves that are factors only.  Which of their numbers are 1 may be compiled in
    (`engine.structural_constants`)."""
    uses_observer: ClassVar[bool] = True
    """Whether it uses f_hat."""
    needs_velocity_bounds: ClassVar[bool] = False
    """Whether it requires `LawContext.velocity_bounds`."""
    includes_e2: ClassVar[bool] = False
    """Whether its V1 contains its term of e2, so that V2 adds no 1/2 e2^T M0 e2."""
    filters: ClassVar[bool] = False
    """Whether its commands have a `slack`."""
    receives_x: ClassVar[bool] = False
    """Whether it is a law of plants in strict-feedback form."""
    input_unit: ClassVar[str | None] = None
    """The unit of the input that an input map such as `WithDrive` commands; None for the input of
    the model, which is the torque for a robot."""

    barrier: Barrier | None = None
    """The barrier on the position error; None for a law without one."""
    barriers: tuple[Barrier, ...] = ()
    """The barriers of all levels of a law that has one a level."""
    decays: tuple[Decay, ...] = ()
    """The decays of its levels; exponential ones if there are none."""
    weight: Leaf = None
    """Weight of the barrier's V1, (n,); None for a law without one."""
    K2: Leaf = None
    """Gain of the velocity error, (n,); None for a law without one."""
    reading: str = ""
    """Of a law of the paper, "printed" or "corrected"."""
    filter: Leaf = None
    """Time constants of filters in place of exact derivatives [s]; None without filters."""

    @attribute
    def takes_shift(self) -> bool:
        """Whether it adds `LawContext.shift` to the virtual control of the last level and to its
        rate (`LawContext.shifted`).
        """
        return False

    @attribute
    def has_auxiliary(self) -> bool:
        """Whether its commands have an `auxiliary`."""
        return False

    @attribute
    def unlimited(self) -> Controller:
        """The same law without a limit of its own, by which a sampled loop is linearised."""
        return self

    def unit_symbols(self, model: Any) -> dict[str, Any]:
        """The units of symbols in the units of its leaves."""
        return {}

    def advice(self) -> list[str]:
        """Warnings about the values of the fields."""
        return []

    def completed(self, context: LawContext, x: jax.Array) -> Self:
        """The law with values that depend on the model and on the start x, (r, n), where none were
        given.
        """
        return self

    def check_start(self, context: LawContext) -> None:
        """Raises ValueError for fields that do not fit together, once the number of joints is
        known.
        """
        return

    @abc.abstractmethod
    def init(self, q: jax.Array, dq: jax.Array, context: LawContext) -> State:
        """State at the start of a run, given q [rad] and dq [rad/s] there; `()` for most laws."""

    @abc.abstractmethod
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

    def switching(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext, state: State
    ) -> jax.Array | None:
        """The functions of q or q', (m,), at whose zeros the command jumps, such as that of a
        sliding-mode law or of `FullState` with some barriers; None for a continuous command.

        The derivatives of a run contain the effect of such a jump on a perturbation
        (`engine.switching`).  A law that wraps another forwards the call.
        """
        return None

    def energy(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext
    ) -> jax.Array | None:
        """The Lyapunov function of a law with an `input_slope` without a term of the estimate, (),
        for `AdaptiveParameters`.
        """
        return None

    def energy_decay(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext
    ) -> jax.Array | None:
        """How fast `energy` decays, (), where the plant equals the model and there is no
        disturbance.
        """
        return None

    def lyapunov(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_tilde: jax.Array,
        context: LawContext,
        state: State,
    ) -> jax.Array | None:
        """As `LyapunovLaw.lyapunov`."""
        return None

    def decay(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_tilde: jax.Array,
        context: LawContext,
        state: State,
    ) -> jax.Array | None:
        """As `LyapunovLaw.decay`."""
        return None

    def disturbance_terms(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_tilde: jax.Array,
        df: jax.Array,
        context: LawContext,
        state: State,
    ) -> jax.Array | None:
        """T of `LyapunovLaw`, () or (n,), in the unit of V a second: what f_tilde and f' may add to
        V'; None for what they add for any law.

        Args:
          t, q, dq, f_tilde, context, state: as `LyapunovLaw.lyapunov`.
          df: rate of the uncertain term, f', (n,) [N m/s].
        """
        return None


class Wrapping(Controller):
    """A law that wraps another one, and has no state and no jump of its own."""

    law: Controller
    wraps = "law"

    def advice(self) -> list[str]:
        """The wrapped law's warnings."""
        return self.law.advice()

    def init(self, *arguments: Any) -> State:
        """The wrapped law's state."""
        return self.law.init(*arguments)

    def switching(self, *arguments: Any) -> jax.Array | None:
        """The functions at whose zeros the wrapped law's command jumps; arguments as its
        `switching`.
        """
        return self.law.switching(*arguments)


def adopt_layers(law: Any) -> None:
    """Makes laws of the classes of a law and of those that it wraps."""
    adopt(type(law), Controller)
    field = wrapped_field(law)
    if field:
        adopt_layers(vars(law)[field])


def state_of_levels(q: jax.Array, dq: jax.Array, higher: Any) -> jax.Array:
    """The state x of a plant, (r, n), from its first two levels and the others."""
    first = jnp.stack([q, dq])
    return first if isinstance(higher, tuple) else jnp.concatenate([first, higher])


def no_state(law: Any, q: jax.Array, dq: jax.Array, context: LawContext) -> tuple[()]:
    """`init` of a law without a state."""
    return ()


def layers_with_states(law: Any, state: Any) -> Iterator[tuple[Any, Any]]:
    """A law and the laws that it wraps, the outermost first, each with its state.

    Args:
      law: any `Controller`.
      state: of the law, or its rate.
    """
    for layer in layers(law):
        yield layer, state
        if layer.has_auxiliary:
            state = state.law


def decay_of(law: Any, i: int) -> Decay:
    """The decay of level i + 1 of a law: `Exponential` for a law that has no `decays`."""
    if not law.decays:
        return Exponential()
    return law.decays[i]  # type: ignore[no-any-return]


class LyapunovLaw(Controller):
    """The contract of a law with a Lyapunov function V and its decay W, which `certify`
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

    @abc.abstractmethod
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

    @abc.abstractmethod
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

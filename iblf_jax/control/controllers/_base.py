"""The contract of a tracking law.

A law is a `Law` of the state x or a `RobotLaw` of (q, q'); the loop calls both as a `Law`
(`law_of_x`).  It knows the model, the reference and the bounds (its `LawContext`), receives the
observer's estimate and commands an input.  It also returns signals for records and certificates:
its virtual control alpha, its Lyapunov function V1, and whether a guard or a limit was active.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import jax

from iblf_jax.control.barriers import Barrier
from iblf_jax.control.decays import Decay, Exponential
from iblf_jax.core import checks, families, former_names
from iblf_jax.core.families import attribute
from iblf_jax.core.pytree import Leaf, component, layers, wrapped_field
from iblf_jax.core.time import Timed
from iblf_jax.world import plants
from iblf_jax.world.bounds import Bounds, Tube, speed_limits_at, tube_at
from iblf_jax.world.plants import Plant
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

    model: Annotated[Robot, Plant]
    """As the scenario has it; `plants.as_plant` converts it."""
    reference: Reference
    bounds: tuple[Bounds, Bounds | None, *tuple[Bounds | None, ...]]
    """Of the levels x_1, x_2, ... of the plant; None for a level without."""
    regions: tuple[Region, ...] = ()
    shift: Shift | None = None
    """What a law that `takes_shift` adds to the virtual control of the last level, and to its
    rate."""
    plant: Any = None
    """The plant with its true parameters.  Set only where V is evaluated; None where the law
    commands."""

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

    def tube(self, t: jax.Array, *, acceleration: bool = True) -> Tube:
        """Reference, bounds of x_1 and their rates at time t [s]; arguments as `bounds.tube_at`."""
        return _tube(self.reference, self.bounds[0], t, acceleration)

    def speed_limits(self, t: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The bounds on the velocities of a robot at time t [s], (n,) each [rad/s]; requires
        `bounds[1]`.
        """
        return speed_limits_at(self.reference, self.bounds[1], t)  # type: ignore[arg-type]

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
    """Output of the law, (n,): of a law of robots the torque [N m], else the input u in its
    unit."""
    alpha: jax.Array
    """Virtual control alpha_1 of the second level, [rad/s] for a robot; e2 = x_2 - alpha.  A law
    without one gives q_d'."""
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


class TrackingLaw(Timed):
    """What every tracking law states: a `Law` of the state x, or a `RobotLaw` of q and q'."""

    receives_x: ClassVar[bool]
    """Whether it receives the state x, as a `Law` does, and not q and q'."""
    gains: ClassVar[tuple[str, ...]] = ("k1", "K2")
    """The names of the leaves that `compare` scales together."""
    factors: ClassVar[tuple[str, ...]] = ()
    """The names of leaves that are factors only.  Which of their numbers are 0 or 1 may be compiled
    in (`engine.structural_constants`)."""
    uses_observer: ClassVar[bool] = True
    """Whether it uses f_hat."""
    needs_robot: ClassVar[bool] = False
    """Whether its model must be a robot."""
    needs_velocity_bounds: ClassVar[bool] = False
    """Whether it requires bounds of the second level, `LawContext.bounds[1]`."""
    includes_e2: ClassVar[bool] = False
    """Whether its V1 contains its term of e2, so that V2 adds no 1/2 e2^T M0 e2."""
    has_slack: ClassVar[bool] = False
    """Whether its commands have a `slack`."""
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
    variant: str = ""
    """Of a law of the paper, "printed" or "corrected"."""
    filter: Leaf = None
    """Time constants of filters in place of exact derivatives [s]; None without filters."""
    filter_form: str = "surface"
    """What the errors of a law with filters contain."""

    @attribute
    def takes_shift(self) -> bool:
        """Whether it adds `LawContext.shift` to the virtual control of the last level and to its
        rate (`LawContext.shifted`).
        """
        return False

    @attribute
    def addition(self) -> str:
        """What it has that no claim about its plain form contains, in words; "" for nothing."""
        return ""

    @attribute
    def has_auxiliary(self) -> bool:
        """Whether its commands have an `auxiliary`."""
        return False

    @attribute
    def unlimited(self) -> TrackingLaw:
        """The same law without a limit of its own, by which a sampled loop is linearised."""
        return self

    def unit_symbols(self, model: Any) -> dict[str, Any]:
        """The units of symbols in the units of its leaves."""
        return {}

    def advice(self) -> list[str]:
        """Warnings about the values of the fields."""
        return []

    def with_defaults(self, context: LawContext, x: jax.Array) -> Self:
        """The law with values that depend on the model and on the start x, (r, n), where none were
        given.
        """
        return self

    def check_start(self, context: LawContext) -> None:
        """Raises ValueError for fields that do not fit together, once the number of joints is
        known.
        """
        return


class Law(TrackingLaw):
    """The contract of a law of plants in strict-feedback form, which receives the state x.

    The estimate d_hat is (r, n), what the disturbance adds to x', or the torque f_hat, (n,) [N m],
    of an observer of torques on a plant with a robot inside.

    A law may state a Lyapunov function of its own, which `certify` checks: `LyapunovLaw` with x in
    the place of q and q' and d_tilde in the place of f_tilde: (r, n), or the torque f_tilde, (n,),
    for a law that wraps one of robots.  T is then dV/dx . d_tilde + dV/dd_tilde . d' by default.
    """

    receives_x: ClassVar[bool] = True

    def init(self, x: jax.Array, context: LawContext) -> State:
        """State at the start of a run, given x, (r, n), there; `()` for most laws."""
        return ()

    @abc.abstractmethod
    def command(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> tuple[Command, State]:
        """The command, and the rate of the law's own state (same structure as the state).

        Args:
          t: time, () [s].
          x: state of the model, (r, n).
          d_hat: the observer's estimate, (r, n) or (n,).
          context: model, reference and bounds.
          state: the law's own state.
        """

    def switching(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> jax.Array | None:
        """The functions of x, (m,), at whose zeros the command jumps; None for a continuous
        command.  Arguments as `command`; unlike `RobotLaw.switching` it receives d_hat.
        """
        return None

    def energy(self, t: jax.Array, x: jax.Array, context: LawContext) -> jax.Array | None:
        """V for d_tilde = 0, (), of a law that states an `input_slope`; `AdaptiveParameters` needs
        it.
        """
        return None

    def energy_decay(self, t: jax.Array, x: jax.Array, context: LawContext) -> jax.Array | None:
        """How fast `energy` decays, (), where the plant equals the model and there is no
        disturbance.
        """
        return None

    def lyapunov(
        self, t: jax.Array, x: jax.Array, d_tilde: jax.Array, context: LawContext, state: State
    ) -> jax.Array | None:
        """V >= 0, () or (n,), for the error d_tilde of the estimate; None for a law without."""
        return None

    def decay(
        self, t: jax.Array, x: jax.Array, d_tilde: jax.Array, context: LawContext, state: State
    ) -> jax.Array | None:
        """W >= 0, () or (n,): how fast V decreases where d_tilde = 0; None for a law without."""
        return None

    def disturbance_terms(
        self,
        t: jax.Array,
        x: jax.Array,
        d_tilde: jax.Array,
        dd: jax.Array,
        context: LawContext,
        state: State,
    ) -> jax.Array | None:
        """T, () or (n,): what d_tilde and d' may add to V'; None for what they add for any law."""
        return None


class RobotLaw(TrackingLaw):
    """The contract of a law of robots, which receives q and q'.

    A law with a proof of its own is a `LyapunovLaw`; then `certify` checks what it states.
    """

    receives_x: ClassVar[bool] = False
    needs_robot = True

    def init(self, q: jax.Array, dq: jax.Array, context: LawContext) -> State:
        """State at the start of a run, given q [rad] and dq [rad/s] there; `()` for most laws."""
        return ()

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
        sliding-mode law; None for a continuous command.

        The derivatives of a run contain the effect of such a jump on a perturbation
        (`engine.switching`).  A law that wraps another forwards the call.
        """
        return None

    def energy(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, context: LawContext
    ) -> jax.Array | None:
        """V for f_tilde = 0, (), of a law that states an `input_slope`; `AdaptiveParameters` needs
        it.
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


@component
class RobotLawAdapter(Law):
    """Adapter from `RobotLaw` to `Law`: calls the law with q = x[0], dq = x[1].

    The loop creates it (`law_of_x`); users do not.

    Args:
      law: any law of robots.

    Source: none; the state of a robot is x = (q, q').
    """

    law: RobotLaw

    def init(self, x: jax.Array, context: LawContext) -> State:
        """State of the law."""
        with _explained_for_wrappers(self.law):
            return self.law.init(x[0], x[1], context)

    def command(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> tuple[Command, State]:
        """Command of the law, which receives the estimate as the torque f_hat."""
        f_hat = plants.as_plant(context.model).as_uncertain(x, d_hat)
        # One array for each level: robots test whether two velocities are the same object.
        q, dq = x[0], x[1]
        with _explained_for_wrappers(self.law):
            return self.law.command(t, q, dq, f_hat, context, state)

    def switching(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> jax.Array | None:
        """Switching functions of the law."""
        return self.law.switching(t, x[0], x[1], context, state)

    def energy(self, t: jax.Array, x: jax.Array, context: LawContext) -> jax.Array | None:
        """Energy of the law."""
        return self.law.energy(t, x[0], x[1], context)

    def energy_decay(self, t: jax.Array, x: jax.Array, context: LawContext) -> jax.Array | None:
        """Decay of the energy of the law."""
        return self.law.energy_decay(t, x[0], x[1], context)

    def lyapunov(
        self, t: jax.Array, x: jax.Array, d_tilde: jax.Array, context: LawContext, state: State
    ) -> jax.Array | None:
        """V of the law."""
        return self.law.lyapunov(t, x[0], x[1], d_tilde, context, state)

    def decay(
        self, t: jax.Array, x: jax.Array, d_tilde: jax.Array, context: LawContext, state: State
    ) -> jax.Array | None:
        """W of the law."""
        return self.law.decay(t, x[0], x[1], d_tilde, context, state)

    def disturbance_terms(
        self,
        t: jax.Array,
        x: jax.Array,
        d_tilde: jax.Array,
        dd: jax.Array,
        context: LawContext,
        state: State,
    ) -> jax.Array | None:
        """T of the law."""
        return self.law.disturbance_terms(t, x[0], x[1], d_tilde, dd, context, state)


@contextmanager
def _explained_for_wrappers(law: RobotLaw) -> Iterator[None]:
    """Turns the TypeError of a `RobotLaw` that calls a wrapped `Law` with (q, dq) into a message
    with the remedy.
    """
    try:
        yield
    except TypeError as error:
        of_x = [field for field, part in vars(law).items() if isinstance(part, Law)]
        if not of_x:
            raise
        name, field = type(law).__name__, of_x[0]
        raise checks.fail(
            f"{name}.{field}",
            checks.Words(f"{checks.with_article(type(vars(law)[field]).__name__)}, a law of x"),
            "a law of q and q', as it is called",
            f"Write {name} as a law of x: inherit from ij.controllers.Law, take x in the place of"
            f" q and dq, and call ij.controllers.law_of_x(self.{field}).",
        ) from error


def law_of_x(law: TrackingLaw) -> Law:
    """A law as the closed loop calls it."""
    if isinstance(law, Law):
        return law
    assert isinstance(law, RobotLaw)
    return RobotLawAdapter(law)


class Wrapping(Law):
    """A law that wraps another one, and has no state and no jump of its own."""

    law: TrackingLaw
    wraps = "law"

    @property
    def inner(self) -> Law:
        """The wrapped law as a law of x."""
        return law_of_x(self.law)

    def advice(self) -> list[str]:
        """The wrapped law's warnings."""
        return self.law.advice()

    @property
    def unlimited(self) -> TrackingLaw:
        """The wrapper around the wrapped law without its limits."""
        return dataclasses.replace(self, law=self.law.unlimited)  # type: ignore[type-var]

    def init(self, x: jax.Array, context: LawContext) -> State:
        """The wrapped law's state."""
        return self.inner.init(x, context)

    def switching(
        self, t: jax.Array, x: jax.Array, d_hat: jax.Array, context: LawContext, state: State
    ) -> jax.Array | None:
        """The functions at whose zeros the wrapped law's command jumps."""
        return self.inner.switching(t, x, d_hat, context, state)


def contract_of(law: object) -> type[Law] | type[RobotLaw]:
    """The contract that a law is meant to fit."""
    return families.contract_of(law, Law, RobotLaw)


def check_law(name: str, law: object, remedy: str) -> None:
    """Raises ValueError for something that is not a law; adopts its class and those of the laws
    that it wraps.
    """
    checks.conforms(name, law, contract_of(law), remedy)
    for former, present in former_names.ATTRIBUTES_OF_LAWS.items():
        member = getattr(law, former, None)
        if member is True or callable(member):
            expected = f"`{present}` in its place"
            raise checks.fail(f"{name}.{former}", checks.Words("a member"), expected)
    field = wrapped_field(law)
    if field:
        check_law(f"{name}.{field}", vars(law)[field], remedy)


def layers_with_states(law: TrackingLaw, state: State) -> Iterator[tuple[Any, Any]]:
    """A law and the laws that it wraps, the outermost first, each with its state.

    Args:
      law: any.
      state: of the law, or its rate.
    """
    for layer in layers(law):
        yield layer, state
        if layer.has_auxiliary:
            state = state.law


def decay_of(law: TrackingLaw, i: int) -> Decay:
    """The decay of level i + 1 of a law: `Exponential` for a law that has no `decays`."""
    if not law.decays:
        return Exponential()
    return law.decays[i]


def position_barrier(law: Any) -> tuple[Barrier, jax.Array]:
    """The barrier of the positions of a law that has one, and the weight of its V1, (n,)."""
    if law.barriers:
        return law.barriers[0], law.weights[0]
    return law.barrier, law.weight


class LyapunovLaw(RobotLaw):
    """The contract of a law with a Lyapunov function V and its decay W, which `certify`
    checks.

        V' <= -W + T

    `certify` differentiates V along the vector field of the loop and tests the inequality at every
    step of a run.  T is the result of `disturbance_terms`, by default the contribution of the
    uncertain term to V' for any law, T = dV/dq' . M0^-1 f_tilde + dV/df_tilde
    . f'.  V, W and T are (), or (n,) and then summed; unit and scale of V are the law's choice.
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

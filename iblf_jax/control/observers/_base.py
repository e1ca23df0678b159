"""The contract of a disturbance observer.

An observer knows the model, measures q and q' or all levels x, and receives the input that the law
commands, after the limits of `Saturated`; lag, delay and faults of an actuator are not in it.  It
returns an estimate of what its model does not contain: of the torque f of (2.1), or of the rates d
of (S.1).  Its state is part of the loop's state and is integrated with the plant; in a sampled loop
it goes from one period to the next.
"""

from __future__ import annotations

import abc
from typing import Any, Self

import jax

from iblf_jax.core import checks, families
from iblf_jax.core.families import attribute, is_default
from iblf_jax.core.pytree import Leaf, component
from iblf_jax.core.time import Timed
from iblf_jax.world.plants import Plant
from iblf_jax.world.robots import Robot

State = Any
"""A pytree of arrays; `()` for an observer without memory."""


class DisturbanceObserver(Timed):
    """What every observer states: an `Observer` of the state x, or a `RobotObserver` of q and
    q'.
    """

    kf: Leaf = None
    """Gain of an observer of the form (3.11), (n,) [1/s]; None for another one."""

    @attribute
    def error_gain(self) -> jax.Array | None:
        """The claim that the error of the estimate obeys f_tilde' = f' - kappa f_tilde: kappa, (n,)
        [1/s], or that of d_tilde, (r,) or (r, n) [1/s]; None without a claim.  `certify` checks it
        under laws of plants in strict-feedback form.
        """
        return None

    @attribute
    def noise_gain(self) -> jax.Array | None:
        """The factor from the noise of the measured levels to that of d_hat, (), (r,) or (r, n)
        [1/s]; None if it is not known.  A scenario whose sensor has noise warns with the product.
        """
        return None

    def check_model(self, model: Any) -> None:
        """Raises ValueError for a plant that does not fit the fields."""
        return

    def advice(self) -> list[str]:
        """Warnings about the values of the fields."""
        return []

    def at_period(self, period: jax.Array) -> Self:
        """The observer with gains for which a step of Euler has the same poles as the continuous
        observer has over one period [s].
        """
        return self


class Observer(DisturbanceObserver):
    """The contract of an observer of plants in strict-feedback form, which receives the state x."""

    @attribute
    def measured(self) -> tuple[int, ...] | None:
        """The levels that an observer with `complete` reads, counted from 1; None for all."""
        return None

    @attribute
    def advances(self) -> bool:
        """Whether it has `advance`."""
        return not is_default(self.advance, Observer.advance)

    @attribute
    def completes(self) -> bool:
        """Whether it has `complete`."""
        return not is_default(self.complete, Observer.complete)

    @abc.abstractmethod
    def init(self, x: jax.Array, model: Plant) -> State:
        """State at the start of a run, given x, (r, n), there."""

    @abc.abstractmethod
    def estimate(self, t: jax.Array, x: jax.Array, model: Plant, state: State) -> jax.Array:
        """d_hat, (r, n), what the disturbance adds to x', in the units of the levels a second; or
        a torque on the robot inside the plant, (n,) [N m].
        """

    @abc.abstractmethod
    def derivative(
        self, t: jax.Array, x: jax.Array, u: jax.Array, model: Plant, state: State
    ) -> State:
        """Rate of the state, given the input u, (n,), that the law commands, after the limits of
        `Saturated`.
        """

    def advance(
        self,
        t: jax.Array,
        x: jax.Array,
        u: jax.Array,
        model: Plant,
        state: State,
        period: jax.Array,
    ) -> State | None:
        """As `RobotObserver.advance`."""
        return None

    def complete(self, t: jax.Array, x: jax.Array, model: Plant, state: State) -> jax.Array | None:
        """The levels x, (r, n), with the estimates of an observer of levels in the place of those
        that the sensor need not measure; None for an observer that estimates none.
        """
        return None

    def limit_excess(self, t: jax.Array, x: jax.Array, model: Plant, state: State) -> Any:
        """Positive where a limit of the estimates that the law receives is active, () [1]; `()` for
        an observer without limits.
        """
        return ()


class RobotObserver(DisturbanceObserver):
    """The contract of an observer of robots, which receives q and q'.

    It also serves the robot inside a plant in strict-feedback form; `tau` is then the torque on its
    joints.
    """

    @abc.abstractmethod
    def init(self, q: jax.Array, dq: jax.Array, model: Robot) -> State:
        """State at the start of a run, given q [rad] and dq [rad/s] there."""

    @abc.abstractmethod
    def estimate(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, model: Robot, state: State
    ) -> jax.Array:
        """f_hat, (n,) [N m]."""

    @abc.abstractmethod
    def derivative(
        self, t: jax.Array, q: jax.Array, dq: jax.Array, tau: jax.Array, model: Robot, state: State
    ) -> State:
        """Rate of the state, given the torque `tau` (n,) [N m] that the law commands, after the
        limits of `Saturated`.
        """

    def advance(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        tau: jax.Array,
        model: Robot,
        state: State,
        period: jax.Array,
    ) -> State | None:
        """The state a period [s] later for constant measurements and torque; an observer without
        this method makes a step of Euler.
        """
        return None


@component
class ObserverOfRobot(Observer):
    """estimate(t, x, ...) = observer.estimate(t, x_1, x_2, ...): an observer of q and q' in the
    closed loop.

    It is no part of a scenario.

    Args:
      observer: any observer of robots.

    Source: none; the state of a robot is x = (q, q').
    """

    observer: RobotObserver

    @property
    def advances(self) -> bool:
        """Whether the observer has `advance`."""
        return not is_default(self.observer.advance, RobotObserver.advance)

    def at_period(self, period: jax.Array) -> ObserverOfRobot:
        """The observer with gains for steps of Euler."""
        return ObserverOfRobot(self.observer.at_period(period))

    def init(self, x: jax.Array, model: Plant) -> State:
        """State of the observer."""
        return self.observer.init(x[0], x[1], checks.given(model.robot))

    def estimate(self, t: jax.Array, x: jax.Array, model: Plant, state: State) -> jax.Array:
        """f_hat, (n,) [N m]."""
        return self.observer.estimate(t, x[0], x[1], checks.given(model.robot), state)

    def derivative(
        self, t: jax.Array, x: jax.Array, u: jax.Array, model: Plant, state: State
    ) -> State:
        """Rate of the observer's state under the torque on the joints."""
        q, dq, tau = x[0], x[1], _torque_on_joints(model, x, u)
        return self.observer.derivative(t, q, dq, tau, checks.given(model.robot), state)

    def advance(
        self,
        t: jax.Array,
        x: jax.Array,
        u: jax.Array,
        model: Plant,
        state: State,
        period: jax.Array,
    ) -> State | None:
        """The observer's state a period later under the torque on the joints."""
        q, dq, tau = x[0], x[1], _torque_on_joints(model, x, u)
        return self.observer.advance(t, q, dq, tau, checks.given(model.robot), state, period)


def _torque_on_joints(model: Plant, x: jax.Array, u: jax.Array) -> jax.Array:
    """The torque on the joints of the robot inside a plant, (n,) [N m]."""
    return checks.given(model.joint_torque(x, u))


def contract_of(observer: object) -> type[Observer] | type[RobotObserver]:
    """The contract that an observer is meant to fit."""
    return families.contract_of(observer, Observer, RobotObserver)

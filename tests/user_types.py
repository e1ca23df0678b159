"""What a type checker knows of what users get: `mypy` reads this file beside the package, and
nothing runs it."""

from __future__ import annotations

from typing import ClassVar, assert_type

import jax

import iblf_jax as ij


def of_a_run(scenario: ij.Scenario) -> None:
    """The signals of a run and its metrics are arrays."""
    run = ij.simulate(scenario, duration=1.0)
    assert_type(run.q, jax.Array)
    assert_type(run.disturbance_estimate, jax.Array)
    assert_type(run.metrics.rmse, jax.Array)
    assert_type(run[0], ij.Rollout)


@ij.component
class Drive(ij.actuators.Actuator):
    """An actuator of a user's, with the public types that its methods return."""

    gain: ij.Leaf = ij.leaf("1", sign="positive")

    def init(self, tau: jax.Array) -> ij.actuators.State:
        """The state that delivers a torque."""
        return tau

    def deliver(
        self, asked: jax.Array, dq: jax.Array, state: ij.actuators.State
    ) -> ij.actuators.Delivered:
        """Torque, whether a limit acted, and the rate of the state."""
        return ij.actuators.Delivered(state, asked > 1.0, self.gain * (asked - state))


@ij.component
class Wrapping(ij.controllers.Law):
    """A law of a user's that wraps another."""

    law: ij.controllers.TrackingLaw

    def init(self, x: jax.Array, context: ij.controllers.LawContext) -> ij.controllers.State:
        """The wrapped law's state."""
        return ij.controllers.law_of_x(self.law).init(x, context)

    def command(
        self,
        t: jax.Array,
        x: jax.Array,
        d_hat: jax.Array,
        context: ij.controllers.LawContext,
        state: ij.controllers.State,
    ) -> tuple[ij.controllers.Command, ij.controllers.State]:
        """The wrapped law's command."""
        return ij.controllers.law_of_x(self.law).command(t, x, d_hat, context, state)


@ij.component
class Barrier(ij.barriers.Barrier):
    """A barrier of a user's."""

    guard: float = ij.static(default=1e-3)
    uses_o: ClassVar[bool] = False
    value_unit: ClassVar[str] = "1"

    def value(self, tube: ij.bounds.Tube, q: jax.Array) -> jax.Array:
        """V1."""
        return 0.5 * ij.barriers.guarded_error(tube, q, self.guard).e ** 2

    def slope(self, tube: ij.bounds.Tube, q: jax.Array) -> jax.Array:
        """dV1/dq."""
        error: ij.barriers.GuardedError = ij.barriers.guarded_error(tube, q, self.guard)
        return error.e

    def virtual_velocity(
        self, tube: ij.bounds.Tube, q: jax.Array, k1: jax.Array, o: jax.Array | None
    ) -> jax.Array:
        """Alpha."""
        return tube.dq_d - k1 * (q - tube.q_d)

    def decay_rate(self, k1: jax.Array) -> jax.Array | None:
        """No claim."""
        return None

    def xi_bound(self, V: jax.Array, tube: ij.bounds.Tube) -> jax.Array | None:
        """No claim."""
        return None

    def error_over_slope(self, tube: ij.bounds.Tube, q: jax.Array) -> jax.Array | None:
        """No claim."""
        return None

    def error_at(self, V: jax.Array, tube: ij.bounds.Tube, above: jax.Array) -> jax.Array | None:
        """No claim."""
        return None


@ij.component
class Observer(ij.observers.RobotObserver):
    """An observer of a user's."""

    gain: ij.Leaf = ij.leaf("1/s", sign="positive")

    def init(self, q: jax.Array, dq: jax.Array, model: ij.robots.Robot) -> ij.observers.State:
        """The state at the start."""
        return 0.0 * q

    def estimate(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        model: ij.robots.Robot,
        state: ij.observers.State,
    ) -> jax.Array:
        """The estimate of f."""
        return state + self.gain * dq

    def derivative(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        tau: jax.Array,
        model: ij.robots.Robot,
        state: ij.observers.State,
    ) -> ij.observers.State:
        """Its rate."""
        return -self.gain * (state + tau)


@ij.component
class Push(ij.disturbances.Disturbance):
    """A disturbance of a user's."""

    size: ij.Leaf = ij.leaf("N m")

    def torque(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        plant: ij.robots.Robot,
        model: ij.robots.Robot,
    ) -> jax.Array:
        """The torque on the plant."""
        return self.size + 0.0 * q

    def jump_times(self) -> jax.Array:
        """None."""
        return jax.numpy.zeros(0)


@ij.component
class Sensor(ij.sensors.RobotSensor):
    """A sensor of a user's."""

    draws: ClassVar[int] = 0

    def init(self, q: jax.Array, dq: jax.Array, period: jax.Array) -> ij.sensors.State:
        """No state."""
        return ()

    def measure(
        self,
        q: jax.Array,
        dq: jax.Array,
        normal: jax.Array,
        period: jax.Array,
        state: ij.sensors.State,
    ) -> tuple[ij.sensors.Measurement, ij.sensors.State]:
        """The measurement and the next state."""
        return ij.sensors.Measurement(q, dq), ()


@ij.component
class Plant(ij.plants.Plant):
    """A plant of a user's."""

    n: ClassVar[int] = 1
    order: ClassVar[int] = 2
    units: ClassVar[tuple[ij.plants.Units, ...]] = ("m", "m/s", "N")

    def drift(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """f."""
        return 0.0 * x

    def gain(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """G."""
        return 1.0 + 0.0 * x


@ij.component
class Largest(ij.metrics.Fold):
    """A metric of a user's."""

    units: ClassVar[dict[str, str]] = {"largest": "rad"}

    def init(self, sample: ij.metrics.Sample) -> jax.Array:
        """Zero."""
        return 0.0 * sample.e1

    def update(self, acc: jax.Array, sample: ij.metrics.Sample) -> jax.Array:
        """The larger one."""
        return jax.numpy.maximum(acc, sample.e1)

    def finish(self, acc: jax.Array) -> dict[str, jax.Array]:
        """The result by name."""
        return {"largest": acc}


def of_own_parts(scenario: ij.Scenario, sample: ij.metrics.Sample, tube: ij.bounds.Tube) -> None:
    """Parts of a user's own fit where the package's do."""
    actuator: ij.actuators.Actuator = Drive(gain=3.0)
    law: ij.controllers.Law = Wrapping(law=scenario.controller)
    barrier: ij.barriers.Barrier = Barrier()
    observer: ij.observers.RobotObserver = Observer(gain=2.0)
    disturbance: ij.disturbances.Disturbance = Push(size=1.0)
    sensor: ij.sensors.RobotSensor = Sensor()
    plant: ij.plants.Plant = Plant()
    ij.controllers.Backstepping(k1=2.0, K2=20.0, barrier=barrier)
    ij.simulate(scenario, duration=1.0, metrics=(Largest(),))
    ij.with_parts(scenario, actuator=actuator, controller=law, observer=observer, sensor=sensor)
    ij.with_parts(scenario, disturbance=disturbance, plant=plant)
    assert_type(sample.e1, jax.Array)
    assert_type(tube.q_d, jax.Array)
    assert_type(actuator.deliver(sample.tau, sample.dq, ()), ij.actuators.Delivered)

"""What a type checker knows of what users get: `mypy` reads this file beside the package, and
nothing runs it."""

from typing import ClassVar, assert_type

import jax
from jax import Array

import iblf_jax as ij

Robot = ij.robots.Robot
State = ij.observers.State
Tube = ij.bounds.Tube


def of_a_run(scenario: ij.Scenario) -> None:
    run = ij.simulate(scenario, duration=1.0)
    assert_type(run.q, Array)
    assert_type(run.disturbance_estimate, Array)
    assert_type(run.metrics.rmse, Array)
    assert_type(run[0], ij.Rollout)


@ij.component
class Drive(ij.actuators.Actuator):
    gain: ij.Leaf = ij.leaf("1", sign="positive")

    def init(self, tau: Array) -> ij.actuators.State:
        return tau

    def deliver(self, asked: Array, dq: Array, state: ij.actuators.State) -> ij.actuators.Delivered:
        return ij.actuators.Delivered(state, asked > 1.0, self.gain * (asked - state))


@ij.component
class Wrapping(ij.controllers.Law):
    law: ij.controllers.TrackingLaw

    def init(self, x: Array, context: ij.controllers.LawContext) -> ij.controllers.State:
        return ij.controllers.law_of_x(self.law).init(x, context)

    def command(
        self,
        t: Array,
        x: Array,
        d_hat: Array,
        context: ij.controllers.LawContext,
        state: ij.controllers.State,
    ) -> tuple[ij.controllers.Command, ij.controllers.State]:
        return ij.controllers.law_of_x(self.law).command(t, x, d_hat, context, state)


@ij.component
class Barrier(ij.barriers.Barrier):
    guard: float = ij.static(default=1e-3)
    uses_o: ClassVar[bool] = False
    value_unit: ClassVar[str] = "1"

    def value(self, tube: Tube, q: Array) -> Array:
        return 0.5 * ij.barriers.guarded_error(tube, q, self.guard).e ** 2

    def slope(self, tube: Tube, q: Array) -> Array:
        error: ij.barriers.GuardedError = ij.barriers.guarded_error(tube, q, self.guard)
        return error.e

    def virtual_velocity(self, tube: Tube, q: Array, k1: Array, o: Array | None) -> Array:
        return tube.dq_d - k1 * (q - tube.q_d)

    def decay_rate(self, k1: Array) -> Array | None:
        return None

    def xi_bound(self, V: Array, tube: Tube) -> Array | None:
        return None

    def error_over_slope(self, tube: Tube, q: Array) -> Array | None:
        return None

    def error_at(self, V: Array, tube: Tube, above: Array) -> Array | None:
        return None


@ij.component
class Observer(ij.observers.RobotObserver):
    gain: ij.Leaf = ij.leaf("1/s", sign="positive")

    def init(self, q: Array, dq: Array, model: Robot) -> State:
        return 0.0 * q

    def estimate(self, t: Array, q: Array, dq: Array, model: Robot, state: State) -> Array:
        return state + self.gain * dq

    def derivative(
        self, t: Array, q: Array, dq: Array, tau: Array, model: Robot, state: State
    ) -> State:
        return -self.gain * (state + tau)


@ij.component
class Push(ij.disturbances.Disturbance):
    size: ij.Leaf = ij.leaf("N m")

    def torque(self, t: Array, q: Array, dq: Array, plant: Robot, model: Robot) -> Array:
        return self.size + 0.0 * q

    def jump_times(self) -> Array:
        return jax.numpy.zeros(0)


@ij.component
class Sensor(ij.sensors.RobotSensor):
    draws: ClassVar[int] = 0

    def measure(
        self, q: Array, dq: Array, normal: Array, period: Array, state: ij.sensors.State
    ) -> tuple[ij.sensors.Measurement, ij.sensors.State]:
        return ij.sensors.Measurement(q, dq), ()


@ij.component
class Plant(ij.plants.Plant):
    n: ClassVar[int] = 1
    order: ClassVar[int] = 2
    units: ClassVar[tuple[ij.plants.Units, ...]] = ("m", "m/s", "N")

    def drift(self, t: Array, x: Array) -> Array:
        return 0.0 * x

    def gain(self, t: Array, x: Array) -> Array:
        return 1.0 + 0.0 * x


@ij.component
class Largest(ij.metrics.Fold):
    units: ClassVar[dict[str, str]] = {"largest": "rad"}

    def init(self, sample: ij.metrics.Sample) -> Array:
        return 0.0 * sample.e1

    def update(self, acc: Array, sample: ij.metrics.Sample) -> Array:
        return jax.numpy.maximum(acc, sample.e1)

    def finish(self, acc: Array) -> dict[str, Array]:
        return {"largest": acc}


def of_own_parts(scenario: ij.Scenario, sample: ij.metrics.Sample, tube: Tube) -> None:
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
    assert_type(sample.e1, Array)
    assert_type(tube.q_d, Array)
    assert_type(actuator.deliver(sample.tau, sample.dq, ()), ij.actuators.Delivered)

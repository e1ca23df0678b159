"""What a type checker knows of what users get: `mypy` reads this file beside the package, and
nothing runs it."""

from __future__ import annotations

from typing import assert_type

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
class Drive:
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
class Wrapping:
    """A law of a user's that wraps another, and states a claim of its own."""

    law: ij.controllers.Controller

    def init(
        self, q: jax.Array, dq: jax.Array, context: ij.controllers.LawContext
    ) -> ij.controllers.State:
        """The wrapped law's state."""
        return self.law.init(q, dq, context)

    def command(
        self,
        t: jax.Array,
        q: jax.Array,
        dq: jax.Array,
        f_hat: jax.Array,
        context: ij.controllers.LawContext,
        state: ij.controllers.State,
    ) -> tuple[ij.controllers.Command, ij.controllers.State]:
        """The wrapped law's command."""
        return self.law.command(t, q, dq, f_hat, context, state)


def of_own_parts(scenario: ij.Scenario, sample: ij.metrics.Sample, tube: ij.bounds.Tube) -> None:
    """Parts of a user's own fit where the package's do."""
    actuator: ij.actuators.Actuator = Drive(gain=3.0)
    law: ij.controllers.Controller = Wrapping(law=scenario.controller)
    ij.with_parts(scenario, actuator=actuator, controller=law)
    assert_type(sample.e1, jax.Array)
    assert_type(tube.q_d, jax.Array)
    assert_type(actuator.deliver(sample.tau, sample.dq, ()), ij.actuators.Delivered)

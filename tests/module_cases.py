"""Parts with a network as a field, which several test files look at."""

from typing import Any

import jax.numpy as jnp

import iblf_jax as ij


@ij.component
class Learned:
    """Torque of a network of q and q'."""

    net: Any

    def torque(self, t, q, dq, plant, model):
        return self.net(jnp.concatenate([q, dq]))

    def jump_times(self):
        return jnp.zeros(0)


@ij.component
class NetworkObserver:
    """f_hat = net(q') + the estimate of the rest by the inner observer."""

    observer: ij.observers.RobotObserver
    net: Any

    def init(self, q, dq, model):
        return self.observer.init(q, dq, model)

    def estimate(self, t, q, dq, model, state):
        return self.observer.estimate(t, q, dq, model, state) + self.net(dq)

    def derivative(self, t, q, dq, tau, model, state):
        return self.observer.derivative(t, q, dq, tau + self.net(dq), model, state)

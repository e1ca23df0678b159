"""A network that has learned the friction: an observer adds a small Equinox network to its
estimate, and the network is trained by the gradient of a simulated run.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from matplotlib import pyplot
from scipy.optimize import minimize

import iblf_jax as ij

jax.config.update("jax_enable_x64", True)


@ij.component
class WithNetwork:
    """f_hat = net(q' / speed) + the inner observer's estimate of the rest.

    M0 q" + C0 q' + G0 = (tau + net) + (f - net): the inner observer receives tau + net as torque.
    """

    observer: Any
    net: Any
    speed: ij.Leaf = ij.leaf("rad/s", sign="positive", shape="scalar", default=0.1)
    wraps = "observer"

    def learned(self, dq):
        """The network's torque, (n,) [N m]."""
        return self.net(dq / self.speed)

    def init(self, q, dq, model):
        """State of the inner observer."""
        return self.observer.init(q, dq, model)

    def estimate(self, t, q, dq, model, state):
        """f_hat, (n,) [N m]."""
        return self.observer.estimate(t, q, dq, model, state) + self.learned(dq)

    def derivative(self, t, q, dq, tau, model, state):
        """Rate of the state of the inner observer."""
        rest = tau + self.learned(dq)
        return self.observer.derivative(t, q, dq, rest, model, state)


momentum = ij.observers.Momentum(kf=10.0)
on_reference = ij.Initial(q=[0.5, 0.64], dq=[0.14, 0.0])
paper = ij.presets.zhang_yan_2024()
friction = ij.disturbances.Friction(viscous=0.3, coulomb=1.0, width=0.1)
alone = ij.with_parts(paper, disturbance=friction, observer=momentum, initial=on_reference)
# Friction is odd in the velocity, and so is a network without biases.
untrained = eqx.nn.MLP(
    2, 2, 4, 1, jnp.tanh, use_bias=False, use_final_bias=False, key=jax.random.key(0)
)
start = ij.with_parts(alone, observer=WithNetwork(momentum, untrained))
weights = {p.path: p.value for p in ij.parameters(start) if ".net." in p.path}
print(*weights)


# %% The gradient of a run of four seconds by the sixteen weights trains the network. The loss is
# the tracking error, which a robot measures; the friction itself is not used.
numbers, as_weights = ravel_pytree(weights)


@jax.jit
@jax.value_and_grad
def loss(numbers):
    """Mean square tracking error [1e-6 rad^2]."""
    changed = ij.with_parameters(start, as_weights(numbers))
    return 1e6 * jnp.mean(ij.simulate(changed, duration=4.0, dt=1e-3).e1 ** 2)


options = {"maxiter": 25}
found = minimize(loss, numbers, method="L-BFGS-B", jac=True, options=options)
learned = ij.with_parameters(start, as_weights(jnp.asarray(found.x)))
before = float(loss(numbers)[0])
print(f"mean square error: {before:.3f} -> {found.fun:.3f} (1e-6 rad^2)")

# %% The network is the better choice where the friction is that of the training or larger: it
# reacts without delay, and the observer only has to estimate the rest. Where half of the friction
# or less is left, the network compensates a torque that is not there, and the observer alone is
# better.
# A wider range of conditions needs a wider range of training runs.
FACTORS = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0)
rmse: dict[str, list[float]] = {"observer alone": [], "with the network": []}
for factor in FACTORS:
    changes = {"disturbance.coulomb": factor, "disturbance.viscous": 0.3 * factor}
    for name, scenario in zip(rmse, (alone, learned), strict=True):
        changed = ij.with_parameters(scenario, changes)
        run = ij.simulate(changed, duration=7.0, dt=1e-3)
        rmse[name].append(1e3 * float(jnp.sqrt(jnp.mean(run.metrics.rmse**2))))
    print(f"{factor:4.2f} of the friction: {rmse['observer alone'][-1]:.3f} mrad alone,", end=" ")
    print(f"{rmse['with the network'][-1]:.3f} mrad with the network")

figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
speeds = jnp.linspace(-0.3, 0.3, 121)
pairs = jnp.stack([speeds, 0.0 * speeds], axis=1)
zero = jnp.zeros(2)
true = jax.vmap(lambda dq: friction.torque(0.0, zero, dq, None, None))(pairs)
left.plot(speeds, true[:, 0], color="0.3", label="friction")
for name, scenario in {"untrained": start, "trained": learned}.items():
    left.plot(speeds, jax.vmap(scenario.observer.learned)(pairs)[:, 0], label=f"network, {name}")
left.axvspan(-0.14, 0.14, color="0.93", label="velocities of the training")
left.set(xlabel="velocity of joint 0 [rad/s]", ylabel="torque [N m]")
left.legend()
for name, values in rmse.items():
    right.plot(FACTORS, values, "o-", label=name)
right.axvline(1.0, color="0.7", linestyle=":")
right.set(xlabel="friction, relative to the training", ylabel="RMS error [mrad]", ylim=0.0)
right.legend()

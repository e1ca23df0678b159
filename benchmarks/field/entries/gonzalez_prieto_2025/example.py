"""A prescribed time and a predefined error bound (Gonzalez Prieto 2025): an oscillator reaches a
band around its reference in 0.5 s, under a barrier and an estimate of the disturbance.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

BAND, REACHED, Z0, R = 0.05, 0.5, 4.0, 2.0
T = REACHED * (1.0 + BAND / (Z0 - BAND))
RATE, FASTEST = 2.0 / T, 2.0 * np.pi * 7.0
B = 2.0 * RATE * R**2 / FASTEST**2
GAIN, SLOPE = (2.0 + B) / (2.0 * B) + RATE / B, (1.0 + RATE) / 2.0


@ij.component
class VanDerPol:
    """x2' = damping (1 - x1^2) x2 - stiffness x1 + u."""

    damping: ij.Leaf = ij.leaf("1/s", sign="positive")
    stiffness: ij.Leaf = ij.leaf("1/s^2", sign="positive")
    n = 1
    order = 2
    units = ("1", "1/s", "1/s^2")

    def drift(self, t, x):
        """f_1 and f_2."""
        second = self.damping * (1.0 - x[0] ** 2) * x[1] - self.stiffness * x[0]
        return jnp.stack([jnp.zeros_like(x[0]), second])

    def gain(self, t, x):
        """G_1 and G_2."""
        return jnp.ones_like(x)


@ij.component
class Force:
    """The disturbance of x2' in run.py."""

    def torque(self, t, q, dq, plant, model):
        """d(t), (1,)."""
        w = FASTEST * t
        d = 3.0 * jnp.sin(w - 1.2) - 1.5 * jnp.cos(2.0 * w + 0.98)
        d += 3.5 * jnp.cos(0.75 * w + 0.05) * jnp.exp(jnp.cos(5.75 * w + 0.43))
        return jnp.broadcast_to(d, q.shape)

    def jump_times(self):
        """The time at which the law, not the disturbance, is discontinuous: steps end there."""
        return jnp.array([REACHED])


# %% The law has a reference x_c, whose error z = x_c - x_d is 0.05 at 0.5 s. e = x1 - x_c stays
# inside a barrier, and an estimate replaces the disturbance.
def decay(t):
    """The factor of z' = -factor z."""
    return 1.0 / (T - jnp.minimum(t, REACHED))


@ij.component
class PrescribedTime:
    """u of run.py; with `complete`, x_c'' in the place of x_d'', and the derivative of s - e'."""

    complete: bool = ij.static()
    gains = ()
    uses_observer = False
    receives_x = True

    def errors(self, t, x, z, context):
        """e, its derivative, and s."""
        tube = context.tube(t)
        e, de = x[0] - tube.q_d - z, x[1] - tube.dq_d + decay(t) * z
        return e, de, de + SLOPE * e

    def init(self, x, context):
        """The error z = x1 - x_d, and the part of the estimate for which it begins at 0."""
        z = x[0] - context.tube(jnp.zeros(())).q_d
        return jnp.stack([z, -GAIN * self.errors(jnp.zeros(()), x, z, context)[2]])

    def command(self, t, x, d_hat, context, state):
        """The input, and the rates of z and of the estimate's part."""
        z, part = state
        e, de, s = self.errors(t, x, z, context)
        push = (0.5 / (BAND**2 - e**2) + 0.5 + RATE / 2.0) * s
        reference = context.tube(t).ddq_d
        if self.complete:
            reference = reference + jnp.where(t < REACHED, 0.0, decay(t) ** 2) * z - SLOPE * de
        u = -context.model.drift(t, x)[1] - GAIN * s - part + reference - push
        V, free = 0.5 * jnp.log(BAND**2 / (BAND**2 - e**2)), jnp.zeros(u.shape, bool)
        rates = jnp.stack([-decay(t) * z, GAIN * push])
        return ij.controllers.Command(u, x[1] - s, V, free, free), rates


@ij.component
class Reached:
    """sign (z + 0.05) from the reference."""

    sign: ij.Leaf = ij.leaf("1")

    def at(self, t, q_d):
        """The bound, (1,)."""
        late = BAND * jnp.exp(-jnp.maximum(t - REACHED, 0.0) / (T - REACHED))
        return q_d + self.sign * (jnp.where(t < REACHED, Z0 * (1.0 - t / T), late) + BAND)


def task(complete):
    """The published task."""
    return ij.Scenario(
        plant=VanDerPol(damping=3.0, stiffness=2.0),
        reference=ij.references.Sinusoid(0.0, 1.0, frequency=8.0 * np.pi, phase=np.pi / 2),
        bounds=ij.Bounds(lower=Reached(-1.0), upper=Reached(1.0)),
        disturbance=ij.disturbances.Levels((None, Force())),
        controller=PrescribedTime(complete),
        initial=ij.Initial(x=[[5.0], [-2.0]]),
    )


scenario = task(True)
cases = {"complete": scenario, "as printed": task(False)}
runs = {name: ij.simulate(case, duration=0.75, dt=5e-5) for name, case in cases.items()}
t = np.asarray(runs["complete"].t)
d = np.asarray(Force().torque(t, t, None, None, None))
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
labels = ("error $x_1 - x_d$", "$s$", "error of the estimate")
found = {}
for name, run in runs.items():
    z, part = np.asarray(run.controller_state)[..., 0].T
    s = np.asarray(run.x[:, 1] - run.alpha)[:, 0]
    found[name] = (np.abs(run.e1[:, 0] - z), np.abs(s), np.abs(GAIN * s + part - d))
    for panel, curve, label in zip(axes, (run.e1, s, GAIN * s + part - d), labels, strict=True):
        panel.plot(t, curve, label=name)
        panel.set(xlabel="time $t$ [s]", ylabel=label)
axes[0].legend()

# %% What the runs give, and the time at which z is 0.05 under the adaptive width of run.py.
late = t > REACHED
grid = np.linspace(0.0, 0.999 * T, 100_001)
factor = np.log(Z0 / (2.0 * BAND - BAND * grid / T)) / np.log(Z0 / BAND) / (T - grid)
adaptive = Z0 * np.exp(-np.cumsum(factor) * grid[1])
reached = {
    "least input [1/s^2]": float(runs["as printed"].tau.min()),
    "largest input [1/s^2]": float(runs["as printed"].tau.max()),
    "largest |s| after 0.5 s [1/s]": float(found["as printed"][1][late].max()),
}
holds = {"e stays inside its barrier": all(bool(e.max() < BAND) for e, _, _ in found.values())}
evidence = {f"s_{name[:2]}": float(s[late].max()) for name, (_, s, _) in found.items()}
evidence |= {f"d_{name[:2]}": float(w[late].max()) for name, (_, _, w) in found.items()}
evidence["later"] = float(np.interp(-BAND, -adaptive, grid))
uncertain = ("plant.damping", "plant.stiffness")

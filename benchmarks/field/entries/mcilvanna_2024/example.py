"""A bound on the error, fixed time (McIlvanna et al. 2024): the general example of the paper under
its law, under a logarithmic barrier and under backstepping.
"""

from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

BOUND = 0.105


# %% All three laws divide by g2 = 10 sin(x2) cos(x1), which is 0 at x2 = 0 and at x1 = pi/2. The
# input of this page is v = g2 u therefore, and G_2 = 1.
def drift(t, x):
    """f_1 and f_2."""
    return jnp.full_like(x, 2.0)


def gain(t, x):
    """g_1 and 1."""
    return jnp.stack([5.0 * jnp.cos(x[0]) + 2.0 * x[0], jnp.ones_like(x[0])])


@ij.component
class Ramp:
    """x_d = t + sin(2 pi t/5) + 0.1."""

    def position(self, t):
        """x_d, (1,)."""
        return jnp.reshape(t + jnp.sin(0.4 * jnp.pi * t) + 0.1, (1,))


def powers(n):
    """10 (1/2)^(3/4) |n|^(1/2) sign n + 10 (1/2)^2 n^3, with the model's polynomial near 0."""
    small = 1.25 * n * 1e2 - 0.25 * n**3 * 1e10
    root = jnp.sign(n) * jnp.sqrt(jnp.maximum(jnp.abs(n), 1e-9))
    return 10.0 * (0.5**0.75 * jnp.where(jnp.abs(n) < 1e-4, small, root) + 0.25 * n**3)


def smoothed(n, h):
    """About |h| sign n: n h^2/sqrt(n^2 h^2 + 1e-10)."""
    return n * h**2 / jnp.sqrt(n**2 * h**2 + 1e-10)


@ij.component
class Published:
    """The laws of the model, by name; its weight of V_1 is 1."""

    k: ij.Leaf = ij.leaf("1", shape=(2,))
    kind: str = ij.static()
    weight: ij.Leaf = ij.leaf("1", sign="positive", default=1.0)
    gains = ("k",)
    uses_observer = False
    receives_x = True

    def first(self, t, x1, context):
        """alpha_1, and the derivative of V_1 by x1."""
        tube = context.tube(t)
        z = x1 - tube.q_d
        g1 = gain(t, jnp.stack([x1, x1]))[0]
        room = BOUND**2 - z**2
        if self.kind == "backstepping":
            return (-2.0 - self.k[0] * z + tube.dq_d) / g1, z
        if self.kind == "logarithmic":
            return (-2.0 - room * self.k[0] * z + tube.dq_d) / g1, z / room
        n = BOUND**2 * z / room
        w = BOUND**2 * (BOUND**2 + z**2) / room**2
        return -(smoothed(n * w, powers(n) / w - tube.dq_d) + 2.0) / g1, n * w

    def command(self, t, x, d_hat, context, state):
        """The input v = g2 u."""
        g1 = gain(t, x)[0]
        moving = (jnp.ones_like(t), 2.0 + g1 * x[1])
        alpha = partial(self.first, context=context)
        (value, slope), (rate, _) = jax.jvp(alpha, (t, x[0]), moving)
        z2 = x[1] - value
        inner = rate - self.k[1] * z2
        if self.kind == "fixed time":
            inner = -smoothed(z2, powers(z2) - rate)
        free = jnp.zeros(z2.shape, bool)
        v = inner - 2.0 - self.weight * g1 * slope
        return ij.controllers.Command(v, value, 0.5 * z2**2, free, free), ()


def task(kind, k1):
    """The published task."""
    side = ij.bounds.Funnel
    return ij.Scenario(
        plant=ij.plants.StrictFeedback(drift, gain, n=1, order=2),
        reference=Ramp(),
        bounds=ij.Bounds(lower=side(-BOUND, -BOUND, 0.0), upper=side(BOUND, BOUND, 0.0)),
        controller=Published([k1, 10.0], kind),
        initial=ij.Initial(x=[[0.0], [0.01]]),
    )


# %% The scenario has the model's logarithmic law, as the fixed-time law needs steps of 1 us.
scenario = task("logarithmic", 10.0)
fixed = task("fixed time", 10.0)
runs = {
    "logarithmic": ij.simulate(scenario, duration=0.7, dt=1e-4),
    "backstepping": ij.simulate(task("backstepping", 5.0), duration=0.7, dt=1e-4),
    "fixed time, 1 us": ij.simulate(fixed, duration=0.7, dt=1e-6, record_every=100),
    "fixed time, 10 us": ij.simulate(fixed, duration=0.7, dt=1e-5, record_every=10),
    "fixed time, 1 ms": ij.simulate(fixed, duration=0.7, dt=1e-3),
}
figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
for panel, end in zip(axes, (0.7, 0.1), strict=True):
    for name, run in runs.items():
        panel.plot(run.t, run.e1, "--" if "10 us" in name or "ms" in name else "-", label=name)
    panel.axhline(BOUND, color="k", linestyle=":")
    panel.axhline(-BOUND, color="k", linestyle=":")
    panel.set(xlabel="time $t$ [s]", ylabel="error $z_1$", xlim=(0.0, end))
axes[0].legend(fontsize="x-small")

# %% What the runs give: errors at 0.05 s and at the end, and the input u = v/g2 near x2 = 0.
log = runs["logarithmic"]
fine = runs["fixed time, 1 us"]
x1, x2 = np.asarray(log.x[:, 0, 0]), np.asarray(log.x[:, 1, 0])
u = np.abs(log.tau[:, 0] / (10.0 * np.sin(x2) * np.cos(x1)))
at = {name: float(np.abs(np.interp(0.05, run.t, run.e1[:, 0]))) for name, run in runs.items()}
settled = float(fine.t[np.flatnonzero(np.abs(fine.e1[:, 0]) > 1e-3)[-1]])
evidence = {
    "coarse": at["fixed time, 1 ms"],
    "finer": at["fixed time, 10 us"],
    "finest": at["fixed time, 1 us"],
    "u_fine": float(u[np.asarray(log.t) > 0.4].max()),
    "u_coarse": float(u[np.asarray(log.t) > 0.4][::10].max()),
    "u_usual": float(np.median(u)),
    "rate": 10.0 * BOUND**2,
}
holds = {
    "the error stays inside its bound": all(
        bool(np.abs(run.e1).max() < BOUND) for run in runs.values()
    ),
    "the error is small before the bound 0.687 s of the settling time": settled < 0.687,
}
print(f"fixed time: |z1| < 0.001 from {settled:.3f} s on; {evidence}")

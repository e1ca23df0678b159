"""Prescribed performance of a surface (after Bechlioulis et al. 2013): an oscillator is stabilised
by a law that does not know it, with the measured state and with a high-gain observer.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

LIMIT = 5.0


@ij.component
class VanDerPol:
    """x2' = -damping (x1^2 - 1) x2 - x1 + 1 + (input_gain + sin(x1 x2)) u."""

    damping: ij.Leaf = ij.leaf("1/s", sign="positive")
    input_gain: ij.Leaf = ij.leaf("1/s^2", sign="positive")
    n = 1
    order = 2
    units = ("1", "1/s", "1")

    def drift(self, t, x):
        """f_1 and f_2."""
        second = -self.damping * (x[0] ** 2 - 1.0) * x[1] - x[0] + 1.0
        return jnp.stack([jnp.zeros_like(x[0]), second])

    def gain(self, t, x):
        """G_1 and G_2."""
        return jnp.stack([jnp.ones_like(x[0]), self.input_gain + jnp.sin(x[0] * x[1])])


# %% The law. Where the estimate of sigma is outside its funnel the logarithm is complex, and the
# limited input is -5 or 5. `by_modulus` has the input of the program there, which is always 5:
# `min` and `max` compare complex numbers by modulus in MATLAB and in GNU Octave (run: 5).
@ij.component
class PublishedLaw:
    """u = -k ln((1 + xi)/(1 - xi)), xi = sigma/rho, sigma = 6 x1 + x2 of the state, or of the
    estimate of a high-gain observer, with an input within 5.
    """

    k: ij.Leaf = ij.leaf("1", sign="positive")
    surface: ij.Bounds
    observer: bool = ij.static(default=False)
    by_modulus: bool = ij.static(default=False)
    gains = ("k",)
    uses_observer = False
    receives_x = True
    includes_e2 = True

    def init(self, x: jax.Array, context: ij.controllers.LawContext):
        """The estimate begins at (0.8, 0)."""
        return jnp.array([[0.8], [0.0]], x.dtype) if self.observer else ()

    def command(self, t, x, d_hat, context, state):
        """The input, and the rate of the estimate."""
        seen = state if self.observer else x
        sigma = 6.0 * seen[0] + seen[1]
        xi = sigma / self.surface.upper.at(t, jnp.zeros_like(sigma))
        outside = jnp.abs(xi) >= 1.0
        epsilon = jnp.arctanh(jnp.where(outside, 0.0, xi))
        u = -2.0 * self.k * epsilon
        rate = ()
        if self.observer:
            edge = jnp.full_like(u, LIMIT) if self.by_modulus else -LIMIT * jnp.sign(xi)
            u = jnp.where(outside, edge, jnp.clip(u, -LIMIT, LIMIT))
            error = x[0] - state[0]
            rate = jnp.stack([state[1] + 10.0 / 0.01 * error, 25.0 / 0.01**2 * error])
        free = jnp.zeros_like(outside)
        alpha = x[1] - sigma  # the record then has sigma as the error of the second level
        return ij.controllers.Command(u, alpha, 0.5 * epsilon**2, free, outside), rate


def funnel(initial, final, rate):
    """The bounds -rho and rho, rho = (initial - final) exp(-rate t) + final."""
    side = ij.bounds.Funnel
    return ij.Bounds(lower=side(-initial, -final, rate), upper=side(initial, final, rate))


def task(rate, **law):
    """Stabilisation of 0. sigma inside rho implies the bounds of x1, as |x1(0)| is below them."""
    narrow = 0.01 / 6.0
    return ij.Scenario(
        plant=VanDerPol(damping=2.0, input_gain=2.0),
        reference=ij.references.Sinusoid(offset=0.0, amplitude=0.0),
        bounds=funnel(9.99 / (6.0 - rate) + narrow, narrow, rate),
        controller=PublishedLaw(k=5.0, surface=funnel(10.0, 0.01, rate), **law),
        initial=ij.Initial(x=[[1.0], [-1.0]]),
    )


rates = {"state, rate 0.5": 0.5, "state, rate 1": 1.0, "state, rate 2": 2.0}
scenario = task(0.5)
cases = {name: task(rate) for name, rate in rates.items()}
cases["observer, rate 0.5"] = task(0.5, observer=True)
cases["observer as printed, rate 0.5"] = task(0.5, observer=True, by_modulus=True)
runs = {name: ij.simulate(case, duration=5.0, dt=1e-4) for name, case in cases.items()}
sigma = {name: np.asarray(run.x[:, 1] - run.alpha)[:, 0] for name, run in runs.items()}
t = np.asarray(runs["state, rate 0.5"].t)
rho = {rate: 9.99 * np.exp(-rate * t) + 0.01 for rate in rates.values()}

figure, axes = plt.subplots(2, 2, figsize=(10, 5), layout="constrained")
for name, run in runs.items():
    style = ":" if "printed" in name else "-"
    curves = (run.x[:, 0], run.tau, sigma[name], run.tau)
    for panel, curve in zip(axes.flat, curves, strict=True):
        panel.plot(t, curve, label=name, linestyle=style)
labels = ("$x_1$", "input $u$", r"$\sigma$ or its estimate", "input $u$, the first 50 ms")
for panel, label in zip(axes.flat, labels, strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, 5.0))
axes[1, 0].plot(t, np.stack([rho[0.5], -rho[0.5]], 1), "k--", linewidth=0.8)
axes[1, 0].set(ylim=(-12.0, 12.0))
axes[1, 1].set(xlim=(0.0, 0.05))
axes[0, 0].legend(fontsize="x-small")

# %% What the runs give.
printed, corrected = runs["observer as printed, rate 0.5"], runs["observer, rate 0.5"]
peak = np.abs(sigma["observer, rate 0.5"]) / rho[0.5]
evidence = {
    "ratio": float(peak.max()),
    "duration": float(np.count_nonzero(peak >= 1.0) * 0.1),
    "right": float(np.interp(0.02, t, corrected.x[:, 1, 0])),
    "wrong": float(np.interp(0.02, t, printed.x[:, 1, 0])),
    "start": float(np.abs(runs["state, rate 0.5"].tau[0, 0])),
    "needed": max(float(np.abs(runs[name].tau).max()) for name in rates),
}
holds = {
    "sigma stays inside its funnel": all(
        bool(np.all(np.abs(sigma[name]) < rho[rate])) for name, rate in rates.items()
    ),
    "the state stays inside the bounds that the funnel implies": all(
        bool(np.asarray(run.metrics.margin).min() > 0) for run in runs.values()
    ),
}
for name, run in runs.items():
    print(f"{name}: {ij.Status(int(run.status))!r}, x at the end {run.x[-1, :, 0]},", end=" ")
    print(f"u in [{run.tau.min():.3f}, {run.tau.max():.3f}]")
uncertain = ("plant.damping", "plant.input_gain")

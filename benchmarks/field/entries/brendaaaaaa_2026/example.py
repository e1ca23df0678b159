"""Prescribed time inside bounds on all states (TiSSaT 2026): three integrators shall reach their
reference before a prescribed time. The published motion depends on the program's time step.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

RHO, FILTER = 8.0, 0.3


@ij.component
class Shrinking:
    """The bound final + (initial - final) exp(-t), whatever the reference is."""

    initial: ij.Leaf = ij.leaf("1")
    final: ij.Leaf = ij.leaf("1")

    def at(self, t, q_d):
        """The bound, (1,)."""
        return jnp.broadcast_to(self.final + (self.initial - self.final) * jnp.exp(-t), q_d.shape)


def drift(t, x):
    """f_1, f_2 and f_3."""
    return jnp.zeros_like(x)


def gain(t, x):
    """G_1, G_2 and G_3."""
    return jnp.ones_like(x)


# %% The law. A state x between -L and H is replaced by zeta = 1/2 H x/(H - x) + 1/2 L x/(L + x),
# whose derivative by x is f, and by time g. The gain mu = 1/(T - t)^2 is infinite at the prescribed
# time T, and filters of 0.3 s form the derivatives of alpha_1 and alpha_2.
def mapped(x, L, H):
    """The mapped state."""
    return 0.5 * H * x / (H - x) + 0.5 * L * x / (L + x)


def unmapped(zeta, L, H):
    """The state x for which `mapped` is zeta."""
    b = H * L - zeta * (H - L)
    root = jnp.sqrt(b**2 + 4.0 * (0.5 * (H - L) + zeta) * zeta * H * L)
    return 2.0 * zeta * H * L / (b + root)


def slope(x, L, H):
    """The derivative of `mapped` by x."""
    return 0.5 * H**2 / (H - x) ** 2 + 0.5 * L**2 / (L + x) ** 2


@ij.component
class PrescribedTime:
    """u of main.m, with the filters' outputs as its state."""

    time: ij.Leaf = ij.leaf("s", sign="positive")
    k: ij.Leaf = ij.leaf("1", shape=(3,))
    uses_observer = False
    receives_x = True
    gains = ("k",)

    def virtual(self, t, x, context):
        """z_1, f_1 and alpha_1."""
        tube = context.tube(t)
        L, H, dL, dH = -tube.lower, tube.upper, -tube.dlower, tube.dupper

        def by_time(x):
            return -0.5 * x**2 * dH / (H - x) ** 2 + 0.5 * x**2 * dL / (L + x) ** 2

        target_rate = slope(tube.q_d, L, H) * tube.dq_d + by_time(tube.q_d)
        z = mapped(x[0], L, H) - mapped(tube.q_d, L, H)
        f, mu = slope(x[0], L, H), 1.0 / (self.time - t) ** 2
        change = x[1] - mapped(x[1], 30.0, 20.0)
        alpha = -(f / (4.0 * RHO) * change**2 + f + mu * self.k[0] / f) * z
        alpha -= mu / (4.0 * f * RHO) * (by_time(x[0]) - target_rate) ** 2 * z
        return z, f, alpha

    def second(self, t, x, first, filtered):
        """z_2, f_2 and alpha_2."""
        z1, f1, _ = first
        z, f = mapped(x[1], 30.0, 20.0) - filtered, slope(x[1], 30.0, 20.0)
        mu = 1.0 / (self.time - t) ** 2
        change = x[2] - mapped(x[2], 180.0, 150.0)
        alpha = -(f / (4.0 * RHO) * change**2 + f + (1.0 / FILTER**2 + mu * self.k[1]) / f) * z
        return z, f, alpha - f1 / f * z1

    def init(self, x: jax.Array, context: ij.controllers.LawContext):
        """The filters begin at alpha_1 and alpha_2."""
        first = self.virtual(jnp.zeros((), x.dtype), x, context)
        return jnp.stack([first[2], self.second(0.0, x, first, first[2])[2]])

    def command(self, t, x, d_hat, context, state):
        """The input, and the rates of the filters."""
        first = self.virtual(t, x, context)
        z2, f2, alpha2 = self.second(t, x, first, state[0])
        z3, f3 = mapped(x[2], 180.0, 150.0) - state[1], slope(x[2], 180.0, 150.0)
        mu = 1.0 / (self.time - t) ** 2
        u = -(1.0 / FILTER**2 + mu * self.k[2]) / f3 * z3 - f2 / f3 * z2
        free, V = jnp.zeros(u.shape, bool), 0.5 * first[0] ** 2
        alpha, higher = unmapped(state[0], 30.0, 20.0), unmapped(state[1], 180.0, 150.0)[None]
        command = ij.controllers.Command(u, alpha, V, free, free, alpha_higher=higher)
        return command, (jnp.stack([first[2], alpha2]) - state) / FILTER


def between(lower, upper):
    """Constant bounds."""
    return ij.Bounds(lower=ij.bounds.Constant(lower), upper=ij.bounds.Constant(upper))


shrinking = ij.Bounds(lower=Shrinking(-30.0, -10.0), upper=Shrinking(28.0, 10.0))
scenario = ij.Scenario(
    plant=ij.plants.StrictFeedback(drift, gain, n=1, order=3),
    reference=ij.references.Sinusoid(offset=0.0, amplitude=3.0, frequency=0.5),
    bounds=(shrinking, between(-30.0, 20.0), between(-180.0, 150.0)),
    controller=PrescribedTime(time=1.55, k=[0.1, 0.1, 10.0]),
    initial=ij.Initial(x=[[7.5], [5.0], [-10.0]]),
)
runs = {"converged, rk4": ij.simulate(scenario, duration=1.5, dt=5e-5)}
for step in (1e-3, 2e-4, 2e-5):
    name = f"euler, {1e3 * step:g} ms"
    runs[name] = ij.simulate(scenario, duration=1.5, dt=step, method="euler")

figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name, run in runs.items():
    style = "k-" if "rk4" in name else "-"
    for panel, curve in zip(axes, (run.e1, run.x[:, 1], run.x[:, 2]), strict=True):
        panel.plot(run.t, curve, style, linewidth=1.0, label=name)
for panel, label in zip(axes, ("error $x_1 - x_d$", "$x_2$", "$x_3$"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label)
axes[0].legend(fontsize="x-small")

# %% What the runs give.
for name, run in runs.items():
    low, high = np.asarray(run.x[..., 0]).min(axis=0), np.asarray(run.x[..., 0]).max(axis=0)
    print(f"{name}: error at 1.5 s {run.e1[-1, 0]:.4f}, x from {low.round(2)} to {high.round(2)}")
labels = ("converged", "printed", "shorter", "shortest")
evidence = {label: float(run.e1[-1, 0]) for label, run in zip(labels, runs.values(), strict=True)}
x = np.asarray(runs["converged, rk4"].x[..., 0])
holds = {
    "all states stay inside their bounds": bool(
        np.asarray(runs["converged, rk4"].metrics.margin).min() > 0
        and np.all((x[:, 1] > -30.0) & (x[:, 1] < 20.0))
        and np.all((x[:, 2] > -180.0) & (x[:, 2] < 150.0))
    )
}

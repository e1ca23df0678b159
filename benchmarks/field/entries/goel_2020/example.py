"""Bounds on the full state (after Tee and Ge 2012): the integral barrier on the state, on both
levels of a plant of order 2, with exact derivatives and with a filter. The published law is that
of the package with `barriers.StateBarrier` on both levels and weights of 1: its term of coupling
is the exchange of (S.2), and V' = -sum k_i kc_i^2 z_i^2/(kc_i^2 - x_i^2).
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij


@ij.component
class Plant:
    """x1' = a x1^2 + x2, x2' = b x1 x2 + c x1 + (1 + x1^2) u."""

    a: ij.Leaf = ij.leaf("1", shape="scalar", default=0.1)
    b: ij.Leaf = ij.leaf("1", shape="scalar", default=0.1)
    c: ij.Leaf = ij.leaf("1", shape="scalar", default=-0.2)
    n, order, units = 1, 2, ("1", "1", "1")

    def drift(self, t, x):
        """f_1 and f_2."""
        return jnp.stack([self.a * x[0] ** 2, self.b * x[0] * x[1] + self.c * x[0]])

    def gain(self, t, x):
        """G_1 and G_2."""
        return jnp.stack([jnp.ones_like(x[0]), 1.0 + x[0] ** 2])


def within(size):
    """The bounds -size and size."""
    return ij.Bounds(lower=ij.bounds.Constant(-size), upper=ij.bounds.Constant(size))


def law(**fields):
    """The law of both levels."""
    states = (ij.barriers.StateBarrier(), ij.barriers.StateBarrier())
    return ij.controllers.BarrierBackstepping(k=(5.0, 5.0), barriers=states, weights=1.0, **fields)


scenario = ij.Scenario(
    plant=Plant(),
    reference=ij.references.Sinusoid(offset=0.0, amplitude=0.2, frequency=2.5),
    bounds=(within(1.0), within(2.5)),
    controller=law(),
    initial=ij.Initial(x=[[0.5], [2.0]]),
)
uncertain = ("plant.a", "plant.b", "plant.c")
constant = ij.with_parts(
    scenario,
    reference=ij.references.Sinusoid(offset=0.2, amplitude=0.0),
    initial=ij.Initial(x=[[0.4], [2.0]]),
)


# %% The model's filter begins at 0, and its second error is that of alpha_1 itself. The filter of
# the package begins at alpha_1; the second error is that of its output, for which its bound of V is
# derived, or with filter_form="derivative" that of alpha_1. The model's variant is a law here.
@ij.component
class ModelFilter:
    """mu beta' + beta = alpha_1; beta' in the place of alpha_1', and z_2 = x_2 - alpha_1."""

    mu: ij.Leaf = ij.leaf("s", sign="positive")
    receives_x = True
    includes_e2 = True

    def init(self, x: jax.Array, context: ij.controllers.LawContext) -> jax.Array:
        """The filter begins at 0."""
        return jnp.zeros_like(x[0])

    def command(self, t, x, d_hat, context, state):
        """The input, and beta'."""
        barrier, k = ij.barriers.StateBarrier(), jnp.full_like(x[0], 5.0)
        f, G = context.model.drift(t, x), context.model.gain(t, x)
        first = context.tube(t)
        alpha = barrier.virtual_velocity(first, x[0], k, None) - f[0]
        rate = (alpha - state) / self.mu
        side, zero = jnp.full_like(alpha, 2.5), jnp.zeros_like(alpha)
        second = ij.bounds.Tube(alpha, rate, -side, side, zero, zero)
        exchange = barrier.error_over_slope(second, x[1]) * barrier.slope(first, x[0])
        u = (barrier.virtual_velocity(second, x[1], k, None) - exchange - f[1]) / G[1]
        V = barrier.value(first, x[0]) + barrier.value(second, x[1])
        no = jnp.zeros(x[0].shape, bool)
        return ij.controllers.Command(u, alpha, V, no, no), rate


cases = {
    "exact derivatives": scenario,
    "exact derivatives, constant reference": constant,
    "filter of the package": ij.with_parts(scenario, controller=law(filter=0.02)),
    "filter of the model": ij.with_parts(scenario, controller=ModelFilter(0.02)),
}
runs = {name: ij.simulate(case, duration=10.0, dt=1e-3) for name, case in cases.items()}
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name, run in runs.items():
    for panel, curve in zip(axes, (run.x[:, 0], run.x[:, 1], run.tau), strict=True):
        panel.plot(run.t, curve, label=name)
for panel, limit in zip(axes, (1.0, 2.5), strict=False):
    panel.axhline(limit, color="k", linestyle=":", linewidth=0.8)
    panel.axhline(-limit, color="k", linestyle=":", linewidth=0.8)
for panel, label in zip(axes, ("$x_1$ [1]", "$x_2$ [1]", "input $u$ [1]"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, 3.0))
axes[0].legend(fontsize="x-small")

# %% The numbers of the runs. With exact derivatives alpha_1 comes close to the bound 2.5 of x2: the
# condition of the law, that alpha_1 is inside these bounds, holds with a small margin.
for name, run in runs.items():
    print(f"{name}: {ij.Status(int(run.status))!r}, |alpha_1| <= {np.abs(run.alpha).max():.4f}")
model, second = runs["filter of the model"], runs["exact derivatives, constant reference"]
late = model.t > 3.0
reached = {
    "largest e1 [1]": float(model.e1.max()),
    "least input with the filter [1]": float(model.tau.min()),
    "largest input with the filter [1]": float(model.tau.max()),
    "largest x1, constant reference [1]": float(second.x[:, 0].max()),
    "input at the start, constant reference [1]": float(second.tau[0, 0]),
    "largest input, constant reference [1]": float(second.tau.max()),
    "least x2, constant reference [1]": float(second.x[:, 1].min()),
}
ripple = (np.abs(model.e1[late]).max() < 0.002) & (np.abs(model.tau[late]).max() < 1.2)
statement = (
    "with the filter the error has a ripple of 0.002 and the input stays within 1.2 after 3 s"
)
inside = [np.all(np.abs(run.x) < [[1.0], [2.5]]) for run in runs.values()]
holds = {"both states stay inside their bounds": all(inside), statement: bool(ripple)}


# %% The derivative of rho_1 at z_1 = 0.
def rho(z, y):
    """rho_1 at z != 0, for kc = 1."""
    return np.log((1 + z + y) * (1 - y) / ((1 - z - y) * (1 + y))) / (2 * z)


y, step = 0.1, 1e-4
evidence = {
    "from_zero": float(model.tau.min()),
    "from_alpha": float(np.abs(runs["filter of the package"].tau).max()),
    "exact": float(np.abs(runs["exact derivatives"].tau).max()),
    "limit": float((rho(step, y) - rho(-step, y)) / (2 * step)),
    "corrected": y / (1 - y**2) ** 2,
    "branch": 0.5 * (1 / (1 + y) ** 2 + 1 / (1 - y) ** 2),
    "zeros": sum(int(np.sum(run.e1 == 0.0)) for run in runs.values()),
    "states": sum(np.size(run.e1) for run in runs.values()),
    "x_start": float(second.x[0, 0, 0]),
    "x_end": float(second.x[-1, 0, 0]),
    "e_end": float(second.e1[-1, 0]),
}

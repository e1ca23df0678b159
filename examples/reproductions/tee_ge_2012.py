"""Bounds on the full state (Tee and Ge 2012): the integral barrier on the state, on both levels of a plant of order 2, with exact derivatives and with a filter.

K. P. Tee, S. S. Ge, Control of state-constrained nonlinear systems using integral barrier Lyapunov
functionals, 51st IEEE CDC (2012) 3239-3244. The numerical example of the paper was not accessible.
The numbers are those of a public Simulink model which states that it follows the paper
(github.com/RaghavvGoel/IntegralBarrierLyapunov); whether they are the paper's is not known.

| printed | value | where |
| --- | --- | --- |
| plant | x1' = 0.1 x1^2 + x2, x2' = 0.1 x1 x2 - 0.2 x1 + (1 + x1^2) u | Dynamic.m |
| bounds | -1 < x1 < 1, -2.5 < x2 < 2.5 | kc1, kc2 in Controller.m |
| gains | k1 = k2 = 5 1/s | Controller.m |
| reference | 0.2 sin 2.5t; 0.2 in a second run | iBLF.slx |
| start | (0.5, 2.0); (0.4, 2.0) in the second run | iBLF.slx, results |
| filter | 0.02 s, from 0 | iBLF.slx |

**Published result**, read from the pictures of the model: with the filter the error increases from
0.5 to about 0.513 and is about 0 after 1.5 s with a ripple of 0.002; the input has a minimum of
about -71 and a maximum of about 3.2, and remains within 1.2 later. With the constant reference and
without the filter x1 has a maximum of 0.514, the input begins at about -17.1 and has a maximum of
about 1.05, and the minimum of x2 is about -0.59.

**The published law is that of the package** with `barriers.State` on both levels and weights of 1:
its term of coupling is the exchange of (S.2), and V' = -sum k_i kc_i^2 z_i^2/(kc_i^2 - x_i^2).

**Corrected:** the derivative of alpha_1, which the model has by hand, has a wrong term of the
reference's acceleration; the package forms it automatically. The model uses it without the filter
only.

**Not printed:** the branch of the law at z_1 = 0, which the model has in part; the package's
barrier is written without a division by z_1.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij


def drift(t, x):
    """f_1 and f_2."""
    return jnp.stack([0.1 * x[0] ** 2, 0.1 * x[0] * x[1] - 0.2 * x[0]])


def gain(t, x):
    """G_1 and G_2."""
    return jnp.stack([jnp.ones_like(x[0]), 1.0 + x[0] ** 2])


def within(size):
    """The bounds -size and size."""
    return ij.Bounds(lower=ij.bounds.Constant(-size), upper=ij.bounds.Constant(size))


def law(**fields):
    """The law of both levels."""
    state = ij.barriers.State()
    return ij.controllers.BarrierBackstepping(
        k=(5.0, 5.0), barriers=(state, state), weights=1.0, **fields
    )


scenario = ij.Scenario(
    plant=ij.plants.StrictFeedback(drift, gain, n=1, order=2),
    reference=ij.references.Sinusoid(offset=0.0, amplitude=0.2, frequency=2.5),
    bounds=within(1.0),
    state_bounds=(within(2.5),),
    controller=law(),
    initial=ij.Initial(x=[[0.5], [2.0]]),
)
constant = ij.with_parts(
    scenario,
    reference=ij.references.Sinusoid(offset=0.2, amplitude=0.0),
    initial=ij.Initial(x=[[0.4], [2.0]]),
)


# %% The model's filter begins at 0, and its second error is that of alpha_1 itself. The filter of
# the package begins at alpha_1, and the second error is that of its output, for which its bound of V
# is derived. The model's variant is a law of this page.
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
        barrier, k = ij.barriers.State(), jnp.full_like(x[0], 5.0)
        f, G = context.model.drift(t, x), context.model.gain(t, x)
        first = context.tube(t)
        alpha = barrier.virtual_velocity(first, x[0], k, None) - f[0]
        rate = (alpha - state) / self.mu
        side, still = jnp.full_like(alpha, 2.5), jnp.zeros_like(alpha)
        second = ij.bounds.Tube(alpha, rate, -side, side, still, still)
        exchange = barrier.error_over_slope(second, x[1]) * barrier.slope(first, x[0])
        u = (barrier.virtual_velocity(second, x[1], k, None) - exchange - f[1]) / G[1]
        V = barrier.value(first, x[0]) + barrier.value(second, x[1])
        inside = jnp.zeros(x[0].shape, bool)
        return ij.controllers.Command(u, alpha, V, inside, inside), rate


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
for panel, label in zip(axes, ("$x_1$", "$x_2$", "input $u$"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, 3.0))
axes[0].legend(fontsize="x-small")

# %% The numbers of the runs.
for name, run in runs.items():
    x, e, u = np.asarray(run.x[..., 0]), np.asarray(run.e1[:, 0]), np.asarray(run.tau[:, 0])
    late = run.t > 3.0
    at = [float(np.interp(time, run.t, e)) for time in (0.5, 1.0, 2.0)]
    print(f"{name}: {ij.Status(int(run.status))!r}")
    print(f"   V(0) = {run.V[0]:.5f}, u(0) = {u[0]:.4f}, u in [{u.min():.3f}, {u.max():.4f}]")
    print(f"   x1 in [{x[:, 0].min():.4f}, {x[:, 0].max():.5f}], x2 in", end=" ")
    print(f"[{x[:, 1].min():.4f}, {x[:, 1].max():.4f}], largest |alpha_1|", end=" ")
    print(f"{np.abs(run.alpha).max():.4f}")
    print(f"   e1 at 0.5, 1 and 2 s: {at[0]:.5f}, {at[1]:.5f}, {at[2]:.2e}; largest {e.max():.5f};")
    print(f"   after 3 s |e1| <= {np.abs(e[late]).max():.6f}, |u| <= {np.abs(u[late]).max():.3f}")

# %% With the filter from 0 the input peaks at about -71, as in the pictures of the model: the peak
# is the transient of the filter. Started at alpha_1, the filter has no such transient, and the
# motion is near that of exact derivatives. With exact derivatives alpha_1 comes close to the bound
# 2.5 of x2: the condition of the law, that alpha_1 is inside these bounds, holds with a small margin.

# %% **Not reproduced:** the pictures of the model as curves, which are not available as numbers. One
# of them shows x1 in the place of the error that it names, and another start than the model has.

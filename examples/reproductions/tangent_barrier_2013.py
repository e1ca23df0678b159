"""A bound on the output, tangent barrier (IFAC 2013): an error within 0.06 of the reference, kept by a barrier of this page and broken without one.

Tangent barrier Lyapunov functions for the control of output-constrained nonlinear systems, IFAC
2013, doi 10.3182/20130902-3-CN-3020.00122. The text of the paper is not openly accessible. The
numbers are those of a public Simulink model which states that it reproduces the symmetric part of
the paper (github.com/XernicRose/symmetric-tan-type-BLF-control-for-constrained-nonlinear-systems);
whether they are the paper's is not known.

| printed | value | where |
| --- | --- | --- |
| plant | x1' = 0.1 x1^2 + x2, x2' = 0.1 x1 x2 - 0.2 x1 + (1 + x1^2) u | plant in tan_blf.slx |
| reference | y_d = 0.2 + 0.3 sin t | the same |
| bound of the error | k_b = 0.06, so that x1 < 0.56 | the same |
| start | (0.25, 1.5) | the same |
| gains | k1 = k2 = 2 1/s | the same |
| law | alpha_1 = -f_1 - k1 z1^2 cos^3(xi)/sin(xi) + y_d', xi = pi z1/(2 k_b) | the same |

**Published result:** none of the model; its repository has no curves of a run.

**The published barrier is not one of the package:** its law is that of V_1 = (k_b/pi) tan^2(xi), with
V' = -k1 z1^2 - k2 z2^2. `barriers.Tan` is V_1 = (k_b^2/pi) tan(pi z1^2/(2 k_b^2)), with V_1' =
-k1 V_1 at z2 = 0. The published one is a class of this page, which `BarrierBackstepping` accepts
like those of the package.

**Corrected:** the model's law has the term -0.2 x2 of f_2 where its plant has -0.2 x1. Its
derivative of alpha_1, by hand, has wrong terms; what reaches the law is a sliding-mode
differentiator, of which the model takes the estimate of alpha_1 in the place of its derivative. This
page has the f_2 of the plant and exact derivatives.

**Not printed:** the limit of alpha_1 at z1 = 0, which is removable, and what happens at the bound:
the package's `guarded_error` limits the slope from 0.999 k_b on.
"""

import math

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

K_B = 0.06


@ij.component
class TangentSquared:
    """V = (k/pi) tan^2(xi), alpha = x_d' - k1 e^2 cos^3(xi)/sin(xi), xi = pi e/(2 k), k constant."""

    guard = 1e-3
    uses_o = False
    ratio_jumps = False
    value_unit = "1"

    def value(self, tube: ij.bounds.Tube, q: jax.Array) -> jax.Array:
        """V."""
        e, beyond, k, _ = ij.barriers.guarded_error(tube, q, self.guard)
        V = k / math.pi * jnp.tan(0.5 * math.pi * e / k) ** 2
        return V + self.slope(tube, q) * beyond

    def slope(self, tube: ij.bounds.Tube, q: jax.Array) -> jax.Array:
        """sin(xi)/cos^3(xi)."""
        e, _, k, _ = ij.barriers.guarded_error(tube, q, self.guard)
        xi = 0.5 * math.pi * e / k
        return jnp.sin(xi) / jnp.cos(xi) ** 3

    def error_over_slope(self, tube: ij.bounds.Tube, q: jax.Array) -> jax.Array:
        """The ratio e cos^3(xi)/sin(xi), which is 2 k/pi at e = 0."""
        e, _, k, _ = ij.barriers.guarded_error(tube, q, self.guard)
        cosine = jnp.cos(0.5 * math.pi * e / k)
        return 2.0 * k / math.pi * cosine**3 / jnp.sinc(0.5 * e / k)

    def virtual_velocity(self, tube, q, k1, o):
        """The virtual control, for a constant k."""
        e, beyond, _, _ = ij.barriers.guarded_error(tube, q, self.guard)
        return tube.dq_d - k1 * (e * self.error_over_slope(tube, q) + beyond)


def drift(t, x):
    """f_1 and f_2."""
    return jnp.stack([0.1 * x[0] ** 2, 0.1 * x[0] * x[1] - 0.2 * x[0]])


def gain(t, x):
    """G_1 and G_2."""
    return jnp.stack([jnp.ones_like(x[0]), 1.0 + x[0] ** 2])


def scenario(barrier):
    """The published task with a barrier on the output."""
    side = ij.bounds.Funnel
    return ij.Scenario(
        plant=ij.plants.StrictFeedback(drift, gain, n=1, order=2),
        reference=ij.references.Sinusoid(offset=0.2, amplitude=0.3),
        bounds=ij.Bounds(lower=side(-K_B, -K_B, 0.0), upper=side(K_B, K_B, 0.0)),
        controller=ij.controllers.BarrierBackstepping(
            k=(2.0, 2.0), barriers=(barrier, ij.barriers.Quadratic()), weights=1.0
        ),
        initial=ij.Initial(x=[[0.25], [1.5]]),
    )


members = {
    "published barrier": TangentSquared(),
    "Log": ij.barriers.Log(),
    "Quadratic, no barrier": ij.barriers.Quadratic(),
}
runs = {name: ij.simulate(scenario(b), duration=10.0, dt=5e-5) for name, b in members.items()}
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name, run in runs.items():
    for panel, curve in zip(axes, (run.x[:, 0], run.e1, run.tau), strict=True):
        panel.plot(run.t, curve, label=name)
axes[0].axhline(0.56, color="k", linestyle=":", linewidth=0.8)
for limit in (-K_B, K_B):
    axes[1].axhline(limit, color="k", linestyle=":", linewidth=0.8)
axes[2].set(yscale="symlog")
for panel, label in zip(axes, ("$x_1$", "error $z_1$", "input $u$"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, 4.0))
axes[0].legend(fontsize="x-small")

# %% The numbers of the runs. Without a barrier x1 leaves the bound 0.56 from the same start.
for name, run in runs.items():
    z, u, V = (np.asarray(curve) for curve in (run.e1[:, 0], run.tau[:, 0], run.V))
    at = " ".join(f"{np.interp(time, run.t, z):.6g}" for time in (0.1, 0.5, 1.0, 2.0, 5.0))
    print(f"{name}: {ij.Status(int(run.status))!r}")
    print(f"   V(0) = {V[0]:.6f}, largest step of V {np.diff(V).max():.1e},", end=" ")
    print(f"u(0) = {u[0]:.5f}, u in [{u.min():.3f}, {u.max():.3f}]")
    print(f"   largest |z1| {np.abs(z).max():.5f}, largest x1 {np.max(run.x[:, 0]):.4f};", end=" ")
    print(f"|u| <= {np.abs(u[run.t > 7.0]).max():.4f} after 7 s")
    print(f"   z1 at 0.1, 0.5, 1, 2 and 5 s: {at}")

# %% V(0) gives the largest error that a barrier allows. With `barriers.Tan` it is beyond the guard,
# because this barrier is flat up to the bound, and a run with it is flagged.
tan = ij.barriers.Tan()
case = scenario(tan)
V_start = ij.simulate(case, duration=1e-4, dt=5e-5).V[0]
xi = float(tan.xi_bound(V_start, case.context.tube(jnp.zeros(())))[0])
print(
    f"Tan: V(0) = {V_start:.6f} allows |z1| <= {xi:.5f} k_b; the guard is at {1 - tan.guard:g} k_b"
)

# %% **Not reproduced:** the motion of the model as it stands, with its differentiator and its f_2; the
# asymmetric part and the results of the paper.

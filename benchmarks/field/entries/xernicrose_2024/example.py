"""A bound on the output, tangent barrier (after Tang, Tee, He 2013): a barrier keeps the error
within 0.06; without one it leaves this bound. The published law is that of V_1 = (k_b/pi)
tan^2(xi), with V' = -k1 z1^2 - k2 z2^2, which is not `barriers.Tan`; it is a class of this page.
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
    """V = (k/pi) tan^2(xi), alpha = x_d' - k1 e^2 cos^3(xi)/sin(xi), xi = pi e/(2 k)."""

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


def drift_of_the_law(t, x):
    """f_1 and f_2, as the law of the model has them."""
    return jnp.stack([0.1 * x[0] ** 2, 0.1 * x[0] * x[1] - 0.2 * x[1]])


def task(barrier):
    """The published task with a barrier on the output."""
    side = ij.bounds.Funnel
    return ij.Scenario(
        plant=Plant(),
        reference=ij.references.Sinusoid(offset=0.2, amplitude=0.3),
        bounds=ij.Bounds(lower=side(-K_B, -K_B, 0.0), upper=side(K_B, K_B, 0.0)),
        controller=ij.controllers.BarrierBackstepping(
            k=(2.0, 2.0), barriers=(barrier, ij.barriers.Quadratic()), weights=1.0
        ),
        initial=ij.Initial(x=[[0.25], [1.5]]),
    )


scenario = task(TangentSquared())
uncertain = ("plant.a", "plant.b", "plant.c")
wrong = ij.plants.StrictFeedback(drift_of_the_law, Plant().gain, n=1, order=2)
cases = {
    "published barrier": scenario,
    "Log": task(ij.barriers.Log()),
    "Quadratic, no barrier": task(ij.barriers.Quadratic()),
    "published barrier, $f_2$ of the model's law": ij.with_parts(scenario, model=wrong),
}
runs = {name: ij.simulate(case, duration=10.0, dt=5e-5) for name, case in cases.items()}
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name, run in runs.items():
    for panel, curve in zip(axes, (run.x[:, 0], run.e1, run.tau), strict=True):
        panel.plot(run.t, curve, label=name)
axes[0].axhline(0.56, color="k", linestyle=":", linewidth=0.8)
for limit in (-K_B, K_B):
    axes[1].axhline(limit, color="k", linestyle=":", linewidth=0.8)
axes[2].set(yscale="symlog")
for panel, label in zip(axes, ("$x_1$ [1]", "error $z_1$ [1]", "input $u$ [1]"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, 4.0))
axes[0].legend(fontsize="x-small")

# %% The numbers of the runs. Without a barrier x1 leaves the bound 0.56 from the same start.
for name, run in runs.items():
    z, u, V = (np.asarray(curve) for curve in (run.e1[:, 0], run.tau[:, 0], run.V))
    print(f"{name}: {ij.Status(int(run.status))!r}, V(0) = {V[0]:.6f},", end=" ")
    print(f"largest step of V {np.diff(V).max():.1e}, u in [{u.min():.3f}, {u.max():.3f}]")
    print(f"   largest |z1| {np.abs(z).max():.5f}, largest x1 {np.max(run.x[:, 0]):.4f}")
published = runs["published barrier"]
holds = {"the error stays within k_b = 0.06": bool(np.all(np.abs(published.e1) < K_B))}


# %% The derivative of alpha_1 that the model has by hand, at the start.
def alpha(t, x1):
    """The published alpha_1."""
    z = x1 - 0.2 - 0.3 * np.sin(t)
    xi = 0.5 * np.pi * z / K_B
    return -0.1 * x1**2 - 2.0 * z**2 * np.cos(xi) ** 3 / np.sin(xi) + 0.3 * np.cos(t)


def by_hand(x1, x2):
    """The formula of the model for alpha_1' at t = 0."""
    z, dx1, dy, ddy = x1 - 0.2, 0.1 * x1**2 + x2, 0.3, 0.0
    xi, rate = 0.5 * np.pi * z / K_B, 0.5 * np.pi * dx1 / K_B
    c, s = np.cos(xi), np.sin(xi)
    by_x1 = -0.2 * x1 * dx1 + 2.0 * z**2 * c**4 / s**2 * rate - 4.0 * z * dx1 * c**3 / s
    return (by_x1 + 6.0 * z**2 * c**2 * rate) * dx1 + ddy / dy * 0.2**2


x1, x2 = 0.25, 1.5
wrong_V = np.asarray(list(runs.values())[-1].V)
evidence = {
    "right_V": float(published.V[-1]),
    "wrong_least": float(wrong_V.min()),
    "wrong_V": float(wrong_V[np.argmin(wrong_V) :].max()),
    "hand": float(by_hand(x1, x2)),
    "exact": float(alpha(1e-30j, x1 + 1e-30j * (0.1 * x1**2 + x2)).imag / 1e-30),
}
print(evidence)

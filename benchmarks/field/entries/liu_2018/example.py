"""A bound on the output, logarithmic barrier (Liu 2018): a servo drive follows a sine within 0.51
of it, with the law of the textbook and with that of the package. They differ in alpha_1 only: the
gain (k_b^2 - z1^2) k1 of the textbook decreases to 0 at the bound, so that V' = -k1 z1^2 - k2 z2^2,
where `barriers.Log` has V_1' <= -2 k1 V_1 at z2 = 0.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

K_B = 0.51
LOG = ij.barriers.Log()


@ij.component
class TextbookLog:
    """`barriers.Log` with alpha = x_d' - (k^2 - e^2) k1 e, for a constant k."""

    guard = LOG.guard
    uses_o = False
    value_unit = "1"

    def value(self, tube: ij.bounds.Tube, q: jax.Array) -> jax.Array:
        """1/2 ln(k^2/(k^2 - e^2))."""
        return LOG.value(tube, q)

    def slope(self, tube: ij.bounds.Tube, q: jax.Array) -> jax.Array:
        """e/(k^2 - e^2)."""
        return LOG.slope(tube, q)

    def error_over_slope(self, tube: ij.bounds.Tube, q: jax.Array) -> jax.Array:
        """k^2 - e^2."""
        return LOG.error_over_slope(tube, q)

    def virtual_velocity(self, tube, q, k1, o):
        """The virtual control, for a constant k."""
        e, beyond, _, _ = ij.barriers.guarded_error(tube, q, self.guard)
        return tube.dq_d - k1 * (self.error_over_slope(tube, q) * e + beyond)


@ij.component
class Drive:
    """x1' = x2, x2' = -friction x2 + input_gain u."""

    friction: ij.Leaf = ij.leaf("1/s", shape="scalar")
    input_gain: ij.Leaf = ij.leaf("rad/(V s^2)", sign="positive", shape="scalar")
    n, order, units = 1, 2, ("rad", "rad/s", "V")

    def drift(self, t, x):
        """f_1 and f_2."""
        return jnp.stack([jnp.zeros_like(x[0]), -self.friction * x[1]])

    def gain(self, t, x):
        """G_1 and G_2."""
        one = jnp.ones_like(x[0])
        return jnp.stack([one, self.input_gain * one])


def task(barrier):
    """The published task with a barrier on the output."""
    side = ij.bounds.Funnel
    return ij.Scenario(
        plant=Drive(friction=25.0, input_gain=133.0),
        reference=ij.references.Sinusoid(offset=0.0, amplitude=1.0),
        bounds=ij.Bounds(lower=side(-K_B, -K_B, 0.0), upper=side(K_B, K_B, 0.0)),
        controller=ij.controllers.BarrierBackstepping(
            k=(10.0, 10.0), barriers=(barrier, ij.barriers.Quadratic()), weights=1.0
        ),
        initial=ij.Initial(x=[[0.5], [0.0]]),
    )


scenario = task(TextbookLog())
uncertain = ("plant.friction", "plant.input_gain")
cases = {"published alpha": scenario, "Log of the package": task(LOG)}
runs = {name: ij.simulate(case, duration=10.0, dt=1e-3) for name, case in cases.items()}
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name, run in runs.items():
    for panel, curve in zip(axes, (run.x[:, 0], run.e1, run.tau), strict=True):
        panel.plot(run.t, curve, label=name)
for panel, limit in zip(axes, (1.51, K_B), strict=False):
    panel.axhline(limit, color="k", linestyle=":", linewidth=0.8)
    panel.axhline(-limit, color="k", linestyle=":", linewidth=0.8)
for panel, label in zip(axes, ("$x_1$ [rad]", "error $z_1$ [rad]", "input $u$ [V]"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label)
axes[2].set(xlim=(0.0, 2.0))
axes[0].legend(fontsize="x-small")

# %% The numbers of the runs.
for name, run in runs.items():
    x, z, u = (np.asarray(run.x[:, i, 0]) for i in (0, 1)), np.asarray(run.e1[:, 0]), run.tau[:, 0]
    V = np.asarray(run.V)
    at = " ".join(f"{np.interp(time, run.t, z):.5g}" for time in (1.0, 2.0, 5.0))
    ranges = [f"[{row.min():.4f}, {row.max():.5f}]" for row in x]
    small = float(run.t[np.max(np.flatnonzero(np.abs(z) >= 0.01))])
    print(f"{name}: {ij.Status(int(run.status))!r}")
    print(f"   V(0) = {V[0]:.6f}, largest step of V {np.diff(V).max():.1e},", end=" ")
    print(f"u(0) = {u[0]:.6f}, largest |u| {np.abs(u).max():.4f}")
    print(f"   x1 in {ranges[0]}, x2 in {ranges[1]}, largest |z1| {np.abs(z).max():.4f}")
    print(f"   z1 at 1, 2 and 5 s: {at}; |z1| < 0.01 after {small:.3f} s")
published = runs["published alpha"]
holds = {
    "the error stays within k_b = 0.51": bool(np.all(np.abs(published.e1) < K_B)),
    "the output stays within 1.51": bool(np.all(np.abs(published.x[:, 0]) < 1.51)),
}

"""Attitude and rates inside shrinking bounds (Golestani et al. 2022): a spacecraft under a PD law
with gains that grow near the bounds, and with limited torques.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

INERTIA = [[20.0, 1.2, 0.9], [1.2, 17.0, 1.4], [0.9, 1.4, 15.0]]


@ij.component
class Spacecraft:
    """q' = (q4 I + q^x) w/2 for the vector part q of a quaternion, J w' = -w x J w + u + d."""

    inertia: ij.Leaf = ij.leaf("kg m^2", shape="any")
    d: ij.Leaf = ij.leaf("N m")  # amplitudes of the disturbance
    n, order = 3, 2
    units = ("1", "rad/s", "N m")

    def drift(self, t, x):
        """The gyroscopic term and the disturbance."""
        d = self.d * jnp.sin(jnp.array([1.0, 1.2, 1.5]) * t)
        torque = d - jnp.cross(x[1], self.inertia @ x[1])
        return jnp.stack([jnp.zeros(3), jnp.linalg.inv(self.inertia) @ torque])

    def gain(self, t, x):
        """The matrix of the kinematics, and J^-1."""
        q4 = jnp.sqrt(jnp.maximum(1.0 - x[0] @ x[0], 1e-12))
        cross = jax.vmap(lambda axis: jnp.cross(x[0], axis), out_axes=1)(jnp.eye(3))
        return jnp.stack([0.5 * (q4 * jnp.eye(3) + cross), jnp.linalg.inv(self.inertia)])


@ij.component
class FiniteTime:
    """(r0 - rT (1 + t/T)) exp(2.5 t/(t - T)) + rT for t < T, and rT from T on."""

    r0: ij.Leaf = ij.leaf("1", shape="scalar")
    rT: ij.Leaf = ij.leaf("1", shape="scalar")
    T: ij.Leaf = ij.leaf("s", shape="scalar")

    def at(self, t, q_d):
        """The bound."""
        left = jnp.maximum(self.T - t, 0.01)
        fall = (self.r0 - self.rT * (1.0 + t / self.T)) * jnp.exp(-2.5 * t / left)
        return jnp.where(t < self.T, fall, 0.0) + self.rT + 0.0 * q_d


@ij.component
class ConstrainedPD:
    """u = -40 q - kd w - (1.5 g(q/rho_q) + 1.2 g(w/rho_w)) s - theta sat(s/0.01), s = w + c q."""

    kd: ij.Leaf = ij.leaf("N m s/rad", shape="scalar")
    c: ij.Leaf = ij.leaf("1/s", shape="scalar")
    limit: ij.Leaf = ij.leaf("N m", shape="scalar")
    even: ij.Leaf = ij.leaf("1", shape="scalar", default=1.0)
    receives_x = True

    def init(self, x, context):
        """The estimate begins at 0."""
        return jnp.zeros(())

    def growth(self, x):
        """The function g: 1/(1 - x^2)^2, or 1/(1 - x)^2 as printed."""
        x = jnp.clip(x, -0.9999, 0.9999)
        return 1.0 / (1.0 - jnp.where(self.even > 0.0, x**2, x)) ** 2

    def command(self, t, x, d_hat, context, state):
        """The torque, and theta' = (|s| - 2 exp(-t/2) theta)/0.1."""
        q, w = x
        s, u = w + self.c * q, -40.0 * q - self.kd * w
        near_q = self.growth(q / context.bounds[0].upper.at(t, q))
        near_w = self.growth(w / context.bounds[1].upper.at(t, w))
        u -= (1.5 * near_q + 1.2 * near_w) * s + state * jnp.clip(s / 0.01, -1.0, 1.0)
        u = jnp.clip(u, -self.limit, self.limit)
        rate = 10.0 * (jnp.sqrt(s @ s + 1e-12) - 2.0 * jnp.exp(-0.5 * t) * state)
        return ij.controllers.Command(u, 0.0 * w, 0.0 * q, q != q, q != q), rate


def task(T, law, q=(0.2, -0.15, -0.25), w=(0.0, 0.0, 0.0), r0=0.3):
    """The published task."""
    sides = ((r0, 0.008), (0.4, 0.005))
    return ij.Scenario(
        plant=Spacecraft(INERTIA, [0.05, 0.1, 0.15]),
        model=Spacecraft(INERTIA, 0.0),
        reference=ij.references.Sinusoid(0.0, 0.0),
        bounds=[ij.Bounds(FiniteTime(-r, -f, T), FiniteTime(r, f, T)) for r, f in sides],
        controller=law,
        initial=ij.Initial(x=[q, w]),
    )


law, formula = (ConstrainedPD(kd=40.0, c=1.5, limit=2.0, even=even) for even in (1.0, 0.0))
printed = ConstrainedPD(kd=20.0, c=1.5, limit=2.5, even=0.0)
scenario = task(15.0, law)
cases = {
    "15 s": scenario,
    "10 s": task(10.0, law),
    "printed formula": task(15.0, formula),
    "as printed": task(15.0, printed, w=(0.03, 0.02, -0.01)),
    "part 2, bound 0.5": task(15.0, law, (0.3, -0.2, -0.3), (-0.02, -0.02, 0.025), r0=0.5),
}
runs = {name: ij.simulate(case, duration=20.0, dt=2e-3) for name, case in cases.items()}


def share(run):
    """The largest ratios of attitude and rates to their bounds."""
    sides = [level.upper for level in run.scenario.bounds]
    bounds = [jax.vmap(lambda t, s=s: s.at(t, jnp.zeros(3)))(run.t) for s in sides]
    return jnp.abs(run.x / jnp.stack(bounds, axis=1)).max(axis=(0, 2))


figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name, style in {"15 s": "-", "as printed": ":"}.items():
    run = runs[name]
    for axis in range(3):
        axes[0].plot(run.t, run.x[:, 0, axis], style, color=f"C{axis}", label=f"{name}, {axis + 1}")
        axes[1].plot(run.t, run.x[:, 1, axis], style, color=f"C{axis}")
        axes[2].plot(run.t, run.tau[:, axis], style, color=f"C{axis}")
axes[1].plot([1.55, 1.2, 1.5], [-0.152, 0.12, 0.196], "ko", fillstyle="none")  # figure 5
for panel, label in zip(axes, ("quaternion $q$", "rate [rad/s]", "torque [N m]"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, 8.0))
axes[0].legend(fontsize="x-small")

# %% What the figures show, and what the runs give.
w = {name: np.asarray(run.x[:, 1]) for name, run in runs.items()}
reached = {"largest torque of axis 1, 15 s [N m]": float(runs["15 s"].tau[:, 0].max())}
for name in ("15 s", "10 s"):
    reached[f"least rate of axis 1, {name} [rad/s]"] = w[name][:, 0].min()
    reached[f"largest rate of axis 3, {name} [rad/s]"] = w[name][:, 2].max()
reached["largest rate of axis 2, 15 s [rad/s]"] = w["15 s"][:, 1].max()
shares = {name: share(run) for name, run in runs.items()}
largest = max(float(x.max()) for x in shares.values())
holds = {"attitude and rates stay inside their bounds": largest < 1.0}
evidence = {
    "rate_printed": w["as printed"][:, 0].min(),
    "torque_printed": float(runs["as printed"].tau[:, 0].max()),
    "at_minus": float(printed.growth(-0.99)),
    "at_plus": float(printed.growth(0.99)),
    "share_printed": float(shares["printed formula"][1]),
    "share_corrected": float(shares["15 s"][1]),
    "share_half": float(shares["part 2, bound 0.5"].max()),
}
for name, run in runs.items():
    print(
        f"{name}: {ij.Status(int(run.status))!r}, at most {shares[name]} of the bounds of q and w"
    )

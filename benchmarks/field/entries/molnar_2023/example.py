"""Connected cruise control behind a car that stops: the time headway of a barrier function is kept
by a filter, or by gains from a chart of safe gains, and not by the gains that are stable only.

The leading car goes at 15 m/s and stops within 2.5 s, with up to 10 m/s^2. The input is the
acceleration of the following car. The distance D must satisfy h = (D - D_sf)/T - v >= 0.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

STANDSTILL, KAPPA, V_MAX, SAFE, HEADWAY = 5.0, 0.6, 15.0, 1.0, 1 / 0.6


def leader(t):
    """Position [m] and speed [m/s] of the leading car, whose acceleration has these ramps."""
    ramps = [(-10.0, 3.0), (10.0, 4.0), (10.0, 4.5), (-10.0, 5.5)]
    after = [(slope, jnp.maximum(t - time, 0.0)) for slope, time in ramps]
    x = 30.0 + 15.0 * t + sum(slope * d**3 / 6.0 for slope, d in after)
    return x, 15.0 + sum(slope * d**2 / 2.0 for slope, d in after)


@ij.component
@ij.robots.from_energy
class Car:
    """(mass + payload) x" = u, with a mass of 1: u is the acceleration."""

    mass: ij.Leaf = ij.leaf("kg", sign="positive", shape="scalar", default=1.0)
    payload: ij.Leaf = ij.leaf("kg", sign="nonnegative", shape="scalar", default=0.0)
    n, joints, kinds = 1, ("car",), ("prismatic",)

    def mass_matrix(self, q):
        """The mass, (1, 1)."""
        return (self.mass + self.payload) * jnp.eye(1, dtype=q.dtype)

    def potential(self, q):
        """None."""
        return jnp.zeros_like(q[0])

    def tip(self, q):
        """The point (x, 0)."""
        return jnp.stack([q[0], jnp.zeros_like(q[0])])


@ij.component
class Behind:
    """The position at the desired distance: 5 m, and the speed over kappa."""

    continuous_derivatives = 1

    def position(self, t):
        """(1,) [m]."""
        x, v = leader(t)
        return jnp.stack([x - STANDSTILL - v / KAPPA])

    def jump_times(self):
        """Where the acceleration of the leader has kinks."""
        return jnp.array([3.0, 4.0, 4.5, 5.5])


@ij.component
class Safe:
    """The position at the least distance of 1 m."""

    def at(self, t, q_d):
        """(1,) [m]."""
        return jnp.stack([leader(t)[0] - SAFE])


# %% The law: u_d = A (V(D) - v) + B (W(v_L) - v), V(D) = min(kappa (D - 5), 15), W = min(v_L, 15);
# with the filter u = min(u_d, the acceleration for which h' = -h).
@ij.component
class CruiseControl:
    """Connected cruise control, filtered or not; `forward` adds V(D) >= 0 to the printed V."""

    A: ij.Leaf = ij.leaf("1/s", sign="nonnegative", shape="scalar")
    B: ij.Leaf = ij.leaf("1/s", sign="nonnegative", shape="scalar")
    filtered: bool = ij.static(default=True)
    forward: bool = ij.static(default=True)
    uses_observer = False
    gains = ()

    def command(self, t, q, dq, f_hat, context, state):
        """The acceleration."""
        x, v = leader(t)
        D = x - q
        slowest = 0.0 if self.forward else -jnp.inf
        wanted = jnp.clip(KAPPA * (D - STANDSTILL), slowest, V_MAX)
        u = self.A * (wanted - dq) + self.B * (jnp.minimum(v, V_MAX) - dq)
        if self.filtered:
            u = jnp.minimum(u, (v - dq) / HEADWAY + (D - SAFE) / HEADWAY - dq)
        zero, inside = jnp.zeros_like(q), jnp.zeros(q.shape, bool)
        return ij.controllers.Command(u, context.tube(t).dq_d, zero, inside, inside), ()


def case(A, B, filtered, forward=True):
    """The published task with these gains."""
    return ij.Scenario(
        plant=Car(),
        reference=Behind(),
        bounds=ij.Bounds(lower=ij.bounds.Funnel(-50.0, -50.0, 0.0), upper=Safe()),
        controller=CruiseControl(A, B, filtered, forward),
        initial=ij.Initial(q=[0.0], dq=[15.0]),
    )


constraints = {"h [m/s]": lambda t, x: (leader(t)[0] - x[0] - SAFE) / HEADWAY - x[1]}
scenario = case(0.4, 0.3, True)
chart = abs(1.0 / HEADWAY - 0.3) * V_MAX / KAPPA / (STANDSTILL - SAFE)
cases = {
    "filtered": scenario,
    "filtered, as printed": case(0.4, 0.3, True, forward=False),
    "not filtered": case(0.4, 0.3, False, forward=False),
    "B of the chart": case(0.4, 0.6, False, forward=False),
    "A of the chart": case(chart, 0.3, False, forward=False),
}
runs = {name: ij.simulate(one, duration=20.0, dt=1e-3) for name, one in cases.items()}

# %% The distance, the speed and the headway h of each run.
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
least, slowest = {}, {}
for name, run in runs.items():
    t, v = np.asarray(run.t), np.asarray(run.dq[:, 0])
    D = np.asarray(leader(t)[0]) - np.asarray(run.q[:, 0])
    h = (D - SAFE) / HEADWAY - v
    least[name], slowest[name] = float(h.min()), float(v.min())
    for panel, curve in zip(axes, (D, v, h), strict=True):
        panel.plot(t, curve, label=name)
    print(f"{name}: least h {h.min():.4f} m/s, least D {D.min():.3f} m,", end=" ")
    print(f"least v {v.min():.4f} m/s, u from {np.min(run.tau):.3f} to {np.max(run.tau):.3f} m/s^2")
for panel, label in zip(axes, ("$D$ [m]", "$v$ [m/s]", "$h$ [m/s]"), strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, 12.0))
    panel.axhline(0.0, color="k", linestyle=":", linewidth=0.8)
axes[0].legend(fontsize="x-small")

reached = {}
charted = min(least["B of the chart"], least["A of the chart"])
holds = {
    "A = 0.4 1/s, B = 0.3 1/s without the filter violate the headway": least["not filtered"] < 0.0,
    "the filter keeps the headway": least["filtered, as printed"] >= 0.0,
    "gains of the safety chart keep the headway without a filter": charted >= 0.0,
}
evidence = {"backward": -slowest["filtered, as printed"], "unfiltered": -slowest["not filtered"]}
evidence |= {"forward": slowest["filtered"], "least_h": least["filtered"]}

"""Positions only, and tanh of the errors (PourMohammad 2023): a two-link arm from a start far away
under a law with a filter in place of the velocities.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

P1, P2, P3, P4, P5, P6 = 8.77, 0.51, 0.76, 0.62, 74.48, 6.174
G = 9.8


@ij.component
class PublishedArm(ij.robots.TwoLink):
    """The arm with M_22 = p4, which is smaller than the constant p3 of M_12."""

    def mass_matrix(self, q):
        """M(q)."""
        return ij.robots.TwoLink.mass_matrix(self, q) - jnp.diag(jnp.array([0.0, P3 - P4]))


def arm():
    """Two links with the numbers p1 ... p6; the masses are free."""
    m1, m2 = 20.0, 2.0
    lc2 = P6 / G / m2
    l1 = P2 / (m2 * lc2)
    lc1 = (P5 / G - m2 * l1) / m1
    I1 = P1 - P3 - m1 * lc1**2 - m2 * l1**2
    return PublishedArm([m1, m2], [l1, 2.0 * lc2], [lc1, lc2], [I1, P3 - m2 * lc2**2], g=G)


@ij.component
class FilteredPD:
    """u = M q_d" + C q_d' + G + Kd r - Kp tanh e, r = q_c - K0 e, and the filter
    q_c' = -a K0 tanh e - (a K0 + K1) r, which begins at K0 e.
    """

    Kp: ij.Leaf = ij.leaf("N m")
    Kd: ij.Leaf = ij.leaf("N m")
    K0: ij.Leaf = ij.leaf("1", shape="scalar")
    K1: ij.Leaf = ij.leaf("1/s", shape="scalar")
    a: ij.Leaf = ij.leaf("1/s", shape="scalar")
    velocity_in_C: bool = ij.static(default=False)
    gains = ("Kp", "Kd")
    uses_observer = False

    def init(self, q, dq, context):
        """The filter begins at K0 e."""
        return self.K0 * (q - context.tube(jnp.zeros(())).q_d)

    def command(self, t, q, dq, f_hat, context, state):
        """The torque, and the rate of the filter."""
        tube, model = context.tube(t), context.model
        e = q - tube.q_d
        r = state - self.K0 * e
        rate = -self.a * self.K0 * jnp.tanh(e) - (self.a * self.K0 + self.K1) * r
        velocity = dq if self.velocity_in_C else tube.dq_d
        tau = model.coriolis(q, velocity, tube.dq_d) + model.gravity(q) + self.Kd * r
        tau = tau + model.mass_matrix(q) @ tube.ddq_d - self.Kp * jnp.tanh(e)
        no = jnp.zeros(q.shape, bool)
        return ij.controllers.Command(tau, tube.dq_d, 0.0 * q, no, no), rate


VERTICAL = np.array([-np.pi / 2, 0.0])  # q1 = 0 of the program is the lower vertical
GAINS = {"Kp": [80.0, 100.0], "Kd": [33.0, 10.0], "K0": 45.0, "K1": 40.0, "a": 0.03}
wide = ij.bounds.Funnel
scenario = ij.Scenario(
    plant=arm(),
    reference=ij.references.Sinusoid(offset=VERTICAL, amplitude=1.0, frequency=np.pi),
    bounds=ij.Bounds(wide(-4.0, -4.0, 0.0), wide(4.0, 4.0, 0.0)),
    controller=FilteredPD(**GAINS),
    initial=ij.Initial(q=VERTICAL + np.array([3.0, -2.0])),
)
published = ij.with_parts(scenario, controller=FilteredPD(**GAINS, velocity_in_C=True))
fast = ij.with_parts(published, initial=ij.Initial(q=published.initial.q, dq=[-10.0, 0.0]))
options = {"duration": 5.0, "dt": 5e-4}
runs = {
    "positions only": ij.simulate(scenario, **options),
    "as published": ij.simulate(published, **options),
    "as published, from -10 rad/s": ij.simulate(fast, **options),
}
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name in ("positions only", "as published"):
    run = runs[name]
    for panel, curve in zip(axes, (run.e1[:, 0], run.tau[:, 0], run.tau[:, 1]), strict=True):
        panel.plot(run.t, curve, label=name)
# Points of the figures of the program, read from the pictures.
times = np.array([0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0, 1.25, 2.5, 3.5])
errors = np.array([2.83, 2.62, 2.28, 2.0, 1.76, 1.55, 1.06, 0.6, 0.26, -0.04, -0.01])
torques = np.array([60.8, 75.5, 4.9, -53.8, -69.9, -62.9, 4.2, 62.9, 65.0, -35.7, 34.3])
axes[0].plot(times, errors, "o", markersize=4, fillstyle="none", color="k", label="published")
axes[1].plot(times, torques, "o", markersize=4, fillstyle="none", color="k")
labels = ("error of joint 0 [rad]", "torque of joint 0 [N m]", "torque of joint 1 [N m]")
for panel, label in zip(axes, labels, strict=True):
    panel.set(xlabel="time $t$ [s]", ylabel=label)
axes[0].legend(fontsize="x-small")

# %% What the figures show, and what the runs give.
run = runs["as published"]
reached = {
    f"{word} torque of joint {joint} [N m]": float(reduce(np.asarray(run.tau)[:, joint]))
    for joint in (0, 1)
    for word, reduce in {"largest": np.max, "least": np.min}.items()
} | {
    "error of joint 0 at 0.5 s [rad]": float(np.interp(0.5, run.t, run.e1[:, 0])),
    "error of joint 0 at 1 s [rad]": float(np.interp(1.0, run.t, run.e1[:, 0])),
}
holds = {
    "the errors converge to zero": max(
        np.abs(np.asarray(x.e1)[np.asarray(x.t) > 4.0]).max() for x in runs.values()
    )
    < 2e-3
}


def misfit(name):
    """The largest distance of the torque of joint 0 from the points [N m]."""
    return float(np.abs(np.interp(times, runs[name].t, runs[name].tau[:, 0]) - torques).max())


evidence = {
    "misfit_velocity": misfit("as published"),
    "misfit_positions": misfit("positions only"),
    "torque_velocity": float(run.tau[:, 0].max()),
    "torque_positions": float(runs["positions only"].tau[:, 0].max()),
    "torque_fast": float(runs["as published, from -10 rad/s"].tau[:, 0].max()),
}
for name, other in runs.items():
    print(f"{name}: {ij.Status(int(other.status))!r}, torques from", end=" ")
    print(f"{other.tau.min(axis=0).round(1)} to {other.tau.max(axis=0).round(1)} N m")

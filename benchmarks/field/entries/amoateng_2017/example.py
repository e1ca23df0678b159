"""A dead zone and a bound on the error (Amoateng 2017): a two-link arm under a logarithmic
barrier, compared with the authors' data.
"""

from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import iblf_jax as ij

BOUND, LOWER, UPPER = 0.005, -4.5, 2.5


def push(t):
    """The disturbance of the program, which its law knows [N m]."""
    return 1.5 * (1.0 - jnp.exp(-0.28 * t)) * jnp.sin(0.5 * np.pi * t)


@ij.component
class Push:
    """-push(t) on both joints."""

    def torque(self, t, q, dq, plant, model):
        """The torques."""
        return jnp.full_like(q, -push(t))

    def jump_times(self):
        """None."""
        return jnp.zeros(0)


@ij.component
class PublishedLaw:
    """u = -e/(b^2 - e^2) - k2 (q' - alpha) + C alpha + G + M q_d" + d.

    alpha = q_d' - (b^2 - |e|^2) k1 e.
    """

    k1: ij.Leaf = ij.leaf("1", shape="scalar")
    k2: ij.Leaf = ij.leaf("N m s/rad", shape="scalar")

    def init(self, q, dq, context):
        """The program's integrator of the torque begins at 0."""
        return jnp.zeros_like(q)

    def command(self, t, q, dq, f_hat, context, state):
        """The torque, and the rate of the curve that the program plots as torque."""
        tube, model = context.tube(t), context.model
        e = q - tube.q_d
        alpha = tube.dq_d - (BOUND**2 - e @ e) * self.k1 * e
        u = model.coriolis(q, dq, alpha) + model.gravity(q) + model.mass_matrix(q) @ tube.ddq_d
        u += push(t) - e / (BOUND**2 - e**2) - self.k2 * (dq - alpha)
        applied = jnp.maximum(u - UPPER, 0.0) + jnp.minimum(u - LOWER, 0.0)
        no = jnp.zeros(q.shape, bool)
        return ij.controllers.Command(u, alpha, 0.0 * q, no, no), applied - state


scenario = ij.Scenario(
    plant=ij.robots.TwoLink(mass=1.0, length=[0.8, 0.7], centre=[0.8, 0.7], inertia=0.0, g=9.8),
    reference=ij.references.Sinusoid(offset=0.0, amplitude=0.1, frequency=np.pi / 2),
    bounds=ij.Bounds(ij.bounds.Funnel(-BOUND, -BOUND, 0.0), ij.bounds.Funnel(BOUND, BOUND, 0.0)),
    controller=PublishedLaw(k1=5.0, k2=5.0),
    disturbance=Push(),
    actuator=ij.actuators.DeadZone(lower=LOWER, upper=UPPER),
    initial=ij.Initial(q=[0.0, 0.0]),
)
cases = {
    "published": scenario,
    "published, gains 50": ij.with_parameters(
        scenario, {"controller.k1": 50.0, "controller.k2": 50.0}
    ),
    "without k1": ij.with_parameters(scenario, {"controller.k1": 0.0}),
    "without the dead zone": ij.with_parts(scenario, actuator=ij.actuators.Ideal()),
}
runs = {name: ij.simulate(case, duration=20.0, dt=2e-4) for name, case in cases.items()}
data = np.loadtxt(Path(__file__).with_name("data.csv"), delimiter=",", skiprows=1)
t = data[:, 0]
run = runs["published"]
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for name, other in runs.items():
    axes[0].plot(other.t, 1e3 * other.e1[:, 0], label=name)
axes[0].plot(t, 1e3 * data[:, 1], "o", markersize=3, fillstyle="none", color="C0", label="data")
axes[0].plot(t, 1e3 * data[:, 5], "o", markersize=3, fillstyle="none", color="C1")
axes[0].set(xlabel="time $t$ [s]", ylabel="error $e_1$ of joint 0 [mrad]", xlim=(0.0, 0.6))
axes[1].plot(run.t, run.tau[:, 0], label="torque")
axes[1].plot(run.t, run.controller_state[:, 0], label="behind a lag of 1 s")
axes[1].plot(t, data[:, 3], "o", markersize=3, fillstyle="none", label="data")
axes[1].set(xlabel="time $t$ [s]", ylabel="torque of joint 0 [N m]", xlim=(0.0, 2.0))
axes[2].plot(run.t, 1e6 * np.abs(run.e1), label=["joint 0", "joint 1"])
axes[2].axhline(1e6 * UPPER * BOUND**2, color="k", linestyle=":", label="$2.5 b^2$")
axes[2].set(xlabel="time $t$ [s]", ylabel="error [$\\mu$rad]", yscale="log")
for panel in axes:
    panel.legend(fontsize="x-small")

# %% What the data have, and what the runs give. The data are 300 samples, one every 67 ms.
samples = np.linspace(0.0, 20.0, 300)


def sampled(name):
    """The errors at the times of the data."""
    columns = np.asarray(runs[name].e1).T
    return np.stack([np.interp(samples, runs[name].t, e) for e in columns], axis=1)


def distance(name, first):
    """The largest distance from the data, whose errors begin with a column."""
    columns = np.asarray(runs[name].e1).T
    found = [np.interp(t, runs[name].t, e) - data[:, first + j] for j, e in enumerate(columns)]
    return float(np.abs(found).max())


largest = {name: np.abs(other.e1).max(axis=0) for name, other in runs.items()}
late, end = np.asarray(run.t) > 10.0, samples > 10.0
reached = {
    f"largest error of joint {joint} among the samples, gains {gain} [rad]": np.abs(
        sampled(name)[:, joint]
    ).max()
    for name, gain in {"published": 5, "published, gains 50": 50}.items()
    for joint in (0, 1)
} | {"largest error of joint 0 after 10 s [rad]": np.abs(sampled("published")[end, 0]).max()}
holds = {"the errors stay within 0.005 rad": max(x.max() for x in largest.values()) < BOUND}
start = np.asarray(run.e1)[np.asarray(run.t) < 2.0, 0]
evidence = {
    "frequency": np.count_nonzero(np.diff(np.signbit(start))) / 4.0,
    "least_torque": np.asarray(run.tau)[:, 0].min(),
    "torque": np.abs(run.tau[:, 0]).max(),
    "integrator": np.abs(run.controller_state[:, 0]).max(),
    "sampled": 1e3 * np.abs(sampled("published, gains 50")[:, 0]).max(),
    "continuous": 1e3 * largest["published, gains 50"][0],
    "last_crossing": np.asarray(run.t)[(np.asarray(run.tau) <= 0.0).any(axis=1)].max(),
    "least_command": np.asarray(run.tau)[late].min() + UPPER,
    "offset": 1e6 * UPPER * BOUND**2,
    "late": 1e6 * np.abs(run.e1[late]).max(),
    "late_ideal": 1e6 * np.abs(runs["without the dead zone"].e1[late]).max(),
    "effect_of_k1": 1e9 * np.abs(run.e1 - runs["without k1"].e1).max(),
}
for name, other in runs.items():
    print(f"{name}: {ij.Status(int(other.status))!r}, largest errors {largest[name].round(6)} rad")
print(f"distance from the data {distance('published', 1):.1e} rad, at gains of 50", end=" ")
print(f"{distance('published, gains 50', 5):.1e} rad")
